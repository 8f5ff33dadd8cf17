"""What a first experiment may propose: the wishes, parameters, noise, and motors of a URDF."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import field, replace
from functools import partial
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError, ModelError, first_ones, unknown
from mjfim.experiment.signals import rates_near, whole_number
from mjfim.model.coordinates import joint_dofs, joint_names
from mjfim.model.elements import (
    actuator_force_sizes,
    control_sizes,
    element_name,
    force_sizes,
    free_name,
    identifier,
    names_of,
    position_sizes,
    translations,
)
from mjfim.model.inertia import body_inertia
from mjfim.model.loading import NO_PACKAGES, ModelSource, load_spec
from mjfim.model.model_files import PACKAGE
from mjfim.model.paths import matches, unit_of
from mjfim.model.units import actuator_gear, commanded_joint, servo_kind
from mjfim.studies import EVERY_GROUP, GROUPS, Group

# Comment at the head of the MJCF.
COMMENT = (
    " The URDF with one motor for each joint; the range of a motor is the effort of its joint. "
)


def read_urdf(
    path: Path, packages: Mapping[str, str] = NO_PACKAGES
) -> tuple[Callable[[str], str], dict[str, float]]:
    """Read a URDF, and give each revolute or prismatic joint a motor.

    Args:
        path: The URDF.
        packages: Folders of ROS packages by name, which the MJCF states as custom texts.

    Returns:
        A function that writes an MJCF which attaches the URDF, whose path it gets, and adds the
        motors; and the velocity limits of the URDF by joint name [m/s or rad/s]. MJCF has none.

    Raises:
        ModelError: The URDF cannot be read, or has no joint to drive.
    """
    spec = load_spec(path, packages=packages)
    driven = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    joints = [joint for joint in spec.joints if joint.name and joint.type in driven]
    if not joints:
        raise ModelError(f"{path}: the URDF has no revolute or prismatic joint that a motor drives")

    mjcf = partial(_with_motors, spec.modelname, joints, packages)
    return mjcf, _velocities(path)


def _with_motors(name: str, joints: Sequence[Any], packages: Mapping[str, str], file: str) -> str:
    """Text of the MJCF of a URDF, by its relative or absolute path, with motors at joints."""
    element = ElementTree.SubElement
    root = ElementTree.Element("mujoco", model=f"{name} with motors")
    root.append(ElementTree.Comment(COMMENT))
    if packages:
        custom = element(root, "custom")
        for name, folder in packages.items():
            element(custom, "text", name=f"{PACKAGE}{name}", data=folder)
    element(element(root, "asset"), "model", name="robot", file=file)
    element(element(root, "worldbody"), "attach", model="robot", prefix="")

    # The range of a motor is that of the force of its joint, where the URDF states one.
    actuators = element(root, "actuator")
    for joint in joints:
        attributes = {"name": joint.name, "joint": joint.name}
        low, high = map(float, joint.actfrcrange)
        if low < high:
            attributes["ctrlrange"] = f"{low:.9g} {high:.9g}"
        element(actuators, "motor", attributes)

    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _velocities(path: Path) -> dict[str, float]:
    found = {}
    for joint in ElementTree.parse(path).getroot().iter("joint"):
        limit = joint.find("limit")
        text = None if limit is None else limit.get("velocity")
        name = joint.get("name")
        if text is None or name is None:
            continue
        value = float(text)
        if value > 0.0:
            found[name] = value
    return found


@record
class Wishes:
    """Wishes for a first experiment; what is None is proposed.

    Attributes:
        groups: Groups of parameters that are wanted.
        unknown: Patterns of paths of parameters, or paths by name, instead of the groups.
        payload: Body that carries an unknown payload; None without one.
        keyframe: Keyframe in which the experiment starts.
        rate: Rate of samples and controls [Hz].
        horizon: Duration of the experiment [s].
        sigmas: Standard deviations of measured joints by kind: "angle" [rad], "length" [m],
            "angular velocity" [rad/s], "velocity" [m/s]. Sensors whose noise the MJCF states keep
            it.
        packages: Folders of ROS packages by name.
        row: Time from one row of a log to the next [s]; None without a log.
    """

    groups: Sequence[Group] = GROUPS
    unknown: Sequence[str] | Mapping[str, str] | None = None
    payload: str | None = None
    keyframe: str | None = None
    rate: float | None = None
    horizon: float | None = None
    sigmas: Mapping[str, float] = field(default_factory=dict)
    packages: Mapping[str, str] = field(default_factory=dict)
    row: float | None = None


def rounded(value: float, digits: int = 2) -> float:
    """A number with so many significant digits."""
    return float(f"{value:.{digits}g}")


def groups_of(text: str) -> list[Group]:
    """Groups of parameters from a list with commas. Raises ExperimentError for an unknown one.

    Args:
        text: The names.
    """
    found: list[Any] = [part.strip() for part in text.split(",")]
    for name in found:
        if name not in EVERY_GROUP:
            raise ExperimentError(f"parameters: {unknown('group', name, EVERY_GROUP)}")
    return found


def resting_keyframes(model: Any) -> list[str]:
    """Names of the keyframes in which the model does not move.

    Args:
        model: The compiled model (`mujoco.MjModel`).
    """
    keys = [model.key(i) for i in range(model.nkey)]
    return [key.name for key in keys if key.name and not key.qvel.any()]


def require_keyframe(model: Any, name: str) -> str:
    """The name of a keyframe without motion. Raises ExperimentError for another name.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        name: The name.
    """
    names = resting_keyframes(model)
    if name not in names:
        raise ExperimentError(unknown("keyframe at rest", name, names))
    return name


def require_rate(model: Any, rate: float) -> float:
    """A rate whose period is a whole number of timesteps. Raises ExperimentError for another one.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        rate: The rate [Hz].
    """
    timestep = model.opt.timestep
    steps = 1.0 / (rate * timestep) if rate > 0.0 else 0.0
    if whole_number(steps) is not None:
        return rate
    raise ExperimentError(
        f"a period of {rate:g} Hz is no whole number of timesteps of {timestep:g} s; rates nearby: "
        f"{rates_near(steps, timestep)}"
    )


# Bodies at the end of the chain whose mass and centre of mass are proposed; bodies of equal depth
# and mass, such as the feet of a robot, count once.
LAST_BODIES = 3

# Bodies lighter than this share of the median mass are not proposed.
SMALL_MASS = 0.1

# Size of an unknown payload, relative to the mass of the body that carries it.
PAYLOAD_SHARE = 0.2

# Size of an unknown payload, relative to what the strongest actuator holds at the robot's length;
# and of friction that the MJCF does not state, relative to the force of the joint's actuators.
STRENGTH_SHARE = 0.05

# A robot with more joints than this has one unknown for all elements with equal values.
FEW_JOINTS = 3

# Samples of the largest proposed delay.
LONGEST_DELAY = 10

AXES = ("x", "y", "z")

# Fields of joints in each group: (field, array of the model, meaning).
JOINT_FIELDS: dict[Group, tuple[tuple[str, str, str], ...]] = {
    "friction": (
        ("damping", "dof_damping", "viscous friction"),
        ("frictionloss", "dof_frictionloss", "dry friction"),
    ),
    "motors": (("armature", "dof_armature", "inertia of the drive"),),
    "servos": (("damping[1]", "dof_dampingpoly", "drag that grows with speed"),),
}

# Powers of a natural frequency and of the size of a coordinate, by which a force of friction is
# divided for the sizes of fields of joints.
POWERS = {"damping": (1, 1), "armature": (2, 1), "damping[1]": (2, 2)}


@record
class Candidate:
    """A parameter that may be proposed.

    Attributes:
        name: Name of its table in the experiment file.
        group: Group to which it belongs.
        paths: Parameter paths that it sets.
        quantity: What it is, for the comment.
        owners: Names of the elements that have it; none for the whole robot.
        value: Value in the model [unit of the paths].
        family: Number of the bodies that are alike, to which its body belongs.
        offset: Constant that is added to the parameter [unit of the paths].
        guess: Stated guess; None for the value in the model.
        scale: Stated scale; None for the default.
        bounds: Stated bounds, or None.
    """

    name: str
    group: Group
    paths: tuple[str, ...]
    quantity: str
    owners: tuple[str, ...] = ()
    value: float = 0.0
    family: int = 0
    offset: float = 0.0
    guess: float | None = None
    scale: float | None = None
    bounds: tuple[float, float] | None = None

    @property
    def meaning(self) -> str:
        """What it is, for the comment."""
        return f"{self.quantity} of {first_ones(self.owners)}" if self.owners else self.quantity

    @property
    def is_absent(self) -> bool:
        """Whether the model has no such effect; such a parameter stands in a comment only."""
        return self.bounds is not None and self.value == 0.0 and bool(self.owners)

    def table(self) -> dict[str, Any]:
        """The table `[parameters.<name>]` of the experiment file."""
        table: dict[str, Any] = {"target": self.paths[0]}
        if self.offset or len(self.paths) > 1:
            added = {"offset": self.offset} if self.offset else {}
            table = {"targets": [{"path": path, **added} for path in self.paths]}
        if self.guess is not None:
            table["guess"] = self.guess
        if self.scale is not None:
            table["scale"] = self.scale
        if self.bounds is not None:
            table["bounds"] = list(self.bounds)
        return table


def candidates(
    model: Any,
    groups: Sequence[Group],
    payload: str | None,
    *,
    length: float,
    period: float,
    rate: float,
) -> list[Candidate]:
    """Parameters of the wanted groups that exist in a model, with unique names.

    The payload that is asked for comes first, then what servos have, then the rest by group.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        groups: Wanted groups.
        payload: Body that carries an unknown payload; None without one.
        length: Length of the robot [m].
        period: Characteristic period of its motion [s].
        rate: Rate of samples [Hz].

    Raises:
        ExperimentError: The body of the payload does not exist, or has no mass.
    """
    friction = list(_joint_fields(model, "friction", period))
    drives = list(_joint_fields(model, "motors", period))
    found = list(_servos(model))
    found += [*friction, *drives, _delay(rate)] if found else []
    # The last body carries what the robot grasps. With a stated payload, its mass is known.
    if payload is None:
        for body, family in _last_bodies(model, 1):
            found += _mass_and_centre(model, body, family, "payload")
    # The inertia of the body that carries the load is known.
    found += [*friction, *_inertia(model), *drives]
    found = [
        each
        for each in found
        if each.group in groups and not each.paths[0].startswith(f"body/{payload}:")
    ]
    if payload is not None:
        found = [*_payload(model, payload, length, period), *found]
    return _tied(model, found)


# Numbers of servos in the order in which logs of references and angles determine them: name, path
# by actuator and joint, and what it is; and those that equal servos share.
OF_SERVOS = (
    ("kp", "controller/{0}:kp", "gain of the position"),
    ("friction", "joint/{1}:frictionloss", "dry friction"),
    ("latency", "controller/{0}:latency", "latency"),
    ("kd", "controller/{0}:kd", "gain of the velocity"),
    ("damping", "joint/{1}:damping", "viscous friction"),
    ("drag", "joint/{1}:damping[1]", "drag that grows with speed"),
    ("duty", "controller/{0}:saturation", "largest force"),
    ("armature", "joint/{1}:armature", "inertia of the drive"),
)
SHARED = ("kp", "kd", "duty", "armature")

# First guess of a latency [rows of the log].
FIRST_LATENCY = 0.5

# Smallest error at which a servo has its largest force, in natural sizes of the coordinate. Servos
# of many models are much stiffer than real ones. The gain kd answers a change with kp at most.
LEAST_ERROR = 0.1

# Upper bound of the largest force, over that of the model. A force that no motion reaches would
# grow without end.
LARGEST_FORCE = 10.0


def servo_laws(
    model: Any, period: float, row: float
) -> tuple[dict[str, dict[str, Any]], list[Candidate]]:
    """Laws that take the place of position servos, and the numbers of servos that a log shows.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        period: Characteristic period of the motion of the robot [s].
        row: Time from one row of the log to the next [s].

    Returns:
        Tables of `[controllers]` by actuator, none without such servos; and the parameters.
    """
    fields = {
        each.paths[0]: each
        for group in JOINT_FIELDS
        for each in _joint_fields(model, group, period)
    }
    laws: dict[str, dict[str, Any]] = {}
    servos, alike, driven = [], dict[str, int](), set[str]()
    for i in range(model.nactuator):
        actuator, number = element_name(model, "actuator", i), commanded_joint(model, i)
        joint = "" if number is None else element_name(model, "joint", number)
        if not actuator or not joint or actuator_gear(model, i) != 1.0 or joint in driven:
            continue
        driven.add(joint)
        kp, kd = float(model.actuator_gainprm[i, 0]), -float(model.actuator_biasprm[i, 2])
        limits = {}
        low, high = model.actuator_forcerange[i].tolist()
        if model.actuator_forcelimited[i] and low == -high:
            limits = {"saturation": [low, high]}
            size = position_sizes(model)[model.jnt_dofadr[number]]
            kp = min(kp, rounded(high / (LEAST_ERROR * size)))
        law = laws[actuator] = {
            "kp": kp,
            "kd": kd if 0.0 < kd < kp * row else rounded(kp * row),
            "reference_velocity": "difference",
            "rate": 1.0 / float(model.opt.timestep),
            "latency": rounded(FIRST_LATENCY * row),
            **limits,
        }
        first = alike.setdefault(f"{law} {fields[f'joint/{joint}:armature'].value}", i)
        servos.append((actuator, joint, i, first))

    upper = {
        name: LARGEST_FORCE * law["saturation"][1]
        for name, law in laws.items()
        if "saturation" in law
    }
    found = [
        Candidate(
            name=f"{actuator}_{name}",
            group="servos",
            paths=(path.format(actuator, joint),),
            quantity=quantity,
            owners=(actuator,),
            family=first if name in SHARED else i,
            scale=None if "joint" not in path else fields[path.format(actuator, joint)].scale,
            bounds={"drag": (0.0, np.inf), "duty": (0.0, upper.get(actuator, np.inf))}.get(name),
        )
        for name, path, quantity in OF_SERVOS
        for actuator, joint, i, first in servos
        if name != "duty" or actuator in upper
    ]
    return laws, _tied(model, found)


def stated_candidates(
    source: ModelSource, unknown: Sequence[str] | Mapping[str, str], proposed: Sequence[Candidate]
) -> list[Candidate]:
    """Parameters that a user states, with sizes and bounds of those that would be proposed.

    Args:
        source: The model.
        unknown: See `Wishes`.
        proposed: Candidates of all groups. Those of a payload that is asked for stay.

    Raises:
        ExperimentError: A pattern matches no number of the model.
    """
    known = {path: each for each in proposed for path in each.paths}
    named = unknown
    if not isinstance(named, Mapping):
        named = {path: path for path in matches(named, source.model, source.decoration)}
    stated = []
    for name, path in named.items():
        field = path.rpartition(":")[2]
        like = Candidate(name=name, group=GROUPS[0], paths=(path,), quantity=field)
        stated.append(
            replace(known.get(path, like), name=name, paths=(path,), owners=(), offset=0.0)
        )
    # The delay has a guess, too, and masses that are proposed by themselves have none.
    asked = [each for each in proposed if each.group == "payload" and each.guess is not None]
    return [*asked, *stated]


def _tied(model: Any, found: Sequence[Candidate]) -> list[Candidate]:
    """The candidates without repeated paths, with one for all equal values of a large robot.

    Candidates of servos state by their families what is equal.
    """
    families: dict[tuple[str, ...], dict[str, Candidate]] = {}
    for each in found:
        unit, value = unit_of(model, each.paths[0]), f"{each.value:.6g}"
        key: tuple[str, ...] = (each.quantity, value, unit, f"{each.family}")
        is_small = model.njnt <= FEW_JOINTS and each.group != "servos"
        if is_small or not each.owners:
            key = (*each.paths, f"{each.offset}")
        families.setdefault(key, {}).setdefault(each.paths[0], each)

    # A family that is all of its kind needs no name of an element.
    kinds = Counter(quantity for quantity, *_ in families)
    tied: dict[str, Candidate] = {}
    for first, *others in (list(family.values()) for family in families.values()):
        name = first.name
        if others:
            name = first.name.removeprefix(f"{first.owners[0]}_")
            if kinds[first.quantity] > 1:
                name = f"{name}_{first.owners[0]}_and_{len(others)}_more"
        name = free_name(name, tied)
        # The strongest joint sets the size of what the model does not have.
        strongest = max((first, *others), key=lambda each: each.scale or 0.0)
        tied[name] = replace(
            first,
            name=name,
            scale=strongest.scale,
            bounds=strongest.bounds,
            paths=(*first.paths, *(each.paths[0] for each in others)),
            owners=(*first.owners, *(each.owners[0] for each in others)),
        )
    return list(tied.values())


def require_carrier(model: Any, name: str) -> int:
    """Number of a body that can carry a payload. Raises ExperimentError for another one.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        name: Name of the body.
    """
    body = identifier(model, "body", name)
    if body < 0:
        raise ExperimentError(f"payload: {unknown('body', name, names_of(model, 'body'))}")
    if not float(model.body_mass[body]) > 0.0:
        raise ExperimentError(
            f"payload: body {name!r} has no mass; name the body with mass that carries the load"
        )
    return body


def _load_size(model: Any, mass: float, length: float, period: float) -> float:
    """Mass of a load that is usual at a body of some mass [kg]."""
    # A light wrist carries more than a share of its own mass.
    moving = model.body_mass[model.body_weldid > 0].sum()
    size = max(PAYLOAD_SHARE * mass, STRENGTH_SHARE * moving)
    gravity = np.linalg.norm(model.opt.gravity)
    if gravity > 0.0 and model.nu:
        torques = _strengths(model, period) * np.where(translations(model), length, 1.0)
        size = max(size, STRENGTH_SHARE * torques.max() / (gravity * length))
    return float(size)


def _payload(model: Any, name: str, length: float, period: float) -> Iterator[Candidate]:
    """Mass and first moments of an unknown payload that is fixed to a body."""
    body = require_carrier(model, name)
    mass = float(model.body_mass[body])
    radius = body_inertia(model, body).gyration_radius
    scale = _load_size(model, mass, length, period)
    yield Candidate(
        name="payload",
        group="payload",
        paths=(f"body/{name}:mass",),
        quantity=f"mass of the load at {name}",
        offset=mass,
        guess=0.0,
        scale=rounded(scale),
    )
    moments = mass * model.body_ipos[body]
    for i, axis in enumerate(AXES):
        yield Candidate(
            name=f"payload_moment_{axis}",
            group="payload",
            paths=(f"body/{name}:firstmoment[{i}]",),
            quantity=f"mass times {axis} of the load's centre of mass, in the frame of {name}",
            offset=float(moments[i]),
            guess=0.0,
            scale=rounded(scale * radius),
        )


def _delay(rate: float) -> Candidate:
    """The delay between the clocks of the controls and of the measurements."""
    return Candidate(
        name="delay",
        group="motors",
        paths=("output:delay",),
        quantity="delay of all measurements",
        guess=0.0,
        scale=rounded(1.0 / rate),
        bounds=(0.0, rounded(LONGEST_DELAY / rate)),
    )


def _last_bodies(model: Any, families: int) -> list[tuple[int, int]]:
    """Moving bodies with mass and a name at the end of the chain, each with its family's number.

    A family has equal mass and number of joints above it; those with most joints come first.
    """
    depth = np.zeros(model.nbody, dtype=int)
    for body in range(1, model.nbody):
        depth[body] = depth[model.body_parentid[body]] + model.body_jntnum[body]
    moving = [
        body
        for body in np.flatnonzero(depth).tolist()
        if model.body_mass[body] > 0.0 and element_name(model, "body", body)
    ]

    # Fingers and markers are too light to matter.
    typical = np.median(model.body_mass[moving]) if moving else 0.0
    alike = defaultdict(list)
    for body in moving:
        if model.body_mass[body] >= SMALL_MASS * typical:
            alike[-depth[body], -rounded(model.body_mass[body], 6)].append(body)
    last = sorted(alike.items())[:families]
    return [(body, i) for i, (_, bodies) in enumerate(last) for body in bodies]


def _mass_and_centre(model: Any, body: int, family: int, group: Group) -> Iterator[Candidate]:
    name = element_name(model, "body", body)
    mass = float(model.body_mass[body])
    yield Candidate(
        name=f"{name}_mass",
        group=group,
        paths=(f"body/{name}:mass",),
        quantity="mass",
        owners=(name,),
        value=mass,
        family=family,
        bounds=(0.0, rounded(10.0 * mass, 3)),
    )
    for i, axis in enumerate(AXES):
        yield Candidate(
            name=f"{name}_com_{axis}",
            group=group,
            paths=(f"body/{name}:ipos[{i}]",),
            quantity=f"{axis} of the centre of mass",
            owners=(name,),
            value=float(model.body_ipos[body, i]),
            family=family,
        )


def _inertia(model: Any) -> Iterator[Candidate]:
    """Masses, centres of mass and principal inertias of the last bodies."""
    bodies = _last_bodies(model, LAST_BODIES)
    for body, family in bodies:
        yield from _mass_and_centre(model, body, family, "inertia")
    for body, family in bodies:
        name = element_name(model, "body", body)
        for i, axis in enumerate(AXES):
            if model.body_inertia[body, i] > 0.0:
                yield Candidate(
                    name=f"{name}_inertia_{axis}",
                    group="inertia",
                    paths=(f"body/{name}:inertia[{i}]",),
                    quantity=f"principal moment of inertia {axis}",
                    owners=(name,),
                    value=float(model.body_inertia[body, i]),
                    family=family,
                )


def _joint_fields(model: Any, group: Group, period: float) -> Iterator[Candidate]:
    """Fields of joints; those that are zero in the model have a natural size."""
    forces = STRENGTH_SHARE * _strengths(model, period)
    sizes = position_sizes(model)
    frequency = 2.0 * np.pi / period
    for quantity, array, meaning in JOINT_FIELDS[group]:
        power, of_size = POWERS.get(quantity, (0, 0))
        for joint in range(model.njnt):
            name = element_name(model, "joint", joint)
            dof = model.jnt_dofadr[joint]
            value = float(np.ravel(getattr(model, array)[dof])[0])
            size = float(forces[dof] / frequency**power / sizes[dof] ** of_size)
            if name and (value > 0.0 or joint_dofs(model, joint) == 1):
                yield Candidate(
                    name=f"{name}_{quantity}",
                    group=group,
                    paths=(f"joint/{name}:{quantity}",),
                    quantity=meaning,
                    owners=(name,),
                    value=value,
                    scale=None if value > 0.0 else rounded(size),
                    bounds=(0.0, rounded(10.0 * (value or size), 3)),
                )


def _strengths(model: Any, period: float) -> Array:
    """(nv,) force of the actuators at each joint; without any, that of a natural motion."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    forces, controls = actuator_force_sizes(model, period), control_sizes(model, period)
    for i in range(model.nactuator):
        # The control of a motor is its force.
        is_motor = model.actuator_ctrlnum[i] == 1 and not model.actuator_biastype[i]
        if is_motor and not model.actuator_forcelimited[i]:
            gain = abs(model.actuator_gainprm[i, 0])
            forces[model.actuator_outadr[i]] = gain * controls[model.actuator_ctrladr[i]]

    # The moments hold gears, and the ways of tendons.
    moments = np.zeros((len(forces), model.nv))
    places = (data.moment_rownnz, data.moment_rowadr, data.moment_colind)
    mujoco.mju_sparse2dense(moments, data.actuator_moment, *places)
    strongest = (np.abs(moments) * forces[:, None]).max(axis=0, initial=0.0)
    return np.asarray(np.maximum(strongest, force_sizes(model, period)))


def _servos(model: Any) -> Iterator[Candidate]:
    """Gains of the servos."""
    for i in range(model.nactuator):
        name = element_name(model, "actuator", i)
        gain = float(model.actuator_gainprm[i, 0])
        if name and gain != 0.0 and servo_kind(model, i) == "position":
            yield Candidate(
                name=f"{name}_kp",
                group="motors",
                paths=(f"actuator/{name}:kp",),
                quantity="gain of the servo",
                owners=(name,),
                value=gain,
            )


# Standard deviation of measured angles [rad], of lengths relative to the robot's length, and of
# velocities relative to the length or the radian per period.
ANGLE_SIGMA = 1e-3
LENGTH_SIGMA = 1e-3
VELOCITY_SIGMA = 1e-2


# Noise of an output: key of the table `noise`, standard deviation [output unit], and kind of a
# joint's coordinate, see `Wishes.sigmas`; the kind is empty where the MJCF states the noise.
ProposedNoise = tuple[str, float, str]


def proposed_noise(
    model: Any, length: float, period: float, wanted: Mapping[str, float], *, flies: bool
) -> list[ProposedNoise]:
    """Noise of the sensors whose noise the MJCF states; else of all joints, by their type.

    The feedback that keeps a robot in the air needs its motion, so that both are measured there.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        length: Length of the robot [m].
        period: Characteristic period of its motion [s].
        wanted: Standard deviations of joints that the user states, by kind; see `Wishes.sigmas`.
        flies: Whether the robot flies.
    """
    typical = {
        "angle": ANGLE_SIGMA,
        "length": rounded(LENGTH_SIGMA * length, 1),
        "angular velocity": rounded(VELOCITY_SIGMA / period, 1),
        "velocity": rounded(VELOCITY_SIGMA * length / period, 1),
    }
    sensors = [
        (name, float(model.sensor_noise[identifier(model, "sensor", name)]), "")
        for name in names_of(model, "sensor")
    ]
    stated = [sensor for sensor in sensors if sensor[1] > 0.0]
    joints = list(_joints(model, {**typical, **wanted}))
    return [*stated, *joints] if flies or not stated else stated


def _joints(model: Any, sigmas: Mapping[str, float]) -> Iterator[ProposedNoise]:
    """Positions and velocities of all joints."""
    kinds = {"qpos": ("length", "angle"), "qvel": ("velocity", "angular velocity")}
    for quantity, (length_kind, angle_kind) in kinds.items():
        for joint, name in enumerate(joint_names(model)):
            kind = mujoco.mjtJoint(model.jnt_type[joint])
            key = f"{quantity}:{name}"
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                yield f"{key}.pos", sigmas[length_kind], length_kind
                yield f"{key}.rot", sigmas[angle_kind], angle_kind
                continue
            moved = length_kind if kind == mujoco.mjtJoint.mjJNT_SLIDE else angle_kind
            yield key, sigmas[moved], moved
