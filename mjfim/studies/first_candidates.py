"""What a first experiment may propose: the wishes, parameters, noise, and motors of a URDF."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np

from mjfim.errors import ExperimentError, ModelError, unknown
from mjfim.model.coordinates import joint_names
from mjfim.model.elements import element_count, element_name, identifier, names_of
from mjfim.model.inertia import body_inertia
from mjfim.model.loading import load_spec
from mjfim.model.units import servo_kind
from mjfim.studies import GROUPS, Group

# Comment at the head of the MJCF.
COMMENT = (
    " The URDF with one motor for each joint; the range of a motor is the effort of its joint. "
)


def read_urdf(path: Path) -> tuple[Callable[[str], str], dict[str, float]]:
    """Read a URDF, and give each revolute or prismatic joint a motor.

    Args:
        path: The URDF.

    Returns:
        A function that writes an MJCF which attaches the URDF, whose path it gets, and adds the
        motors; and the velocity limits of the URDF by joint name [m/s or rad/s]. MJCF has none.

    Raises:
        ModelError: The URDF cannot be read, or has no joint to drive.
    """
    spec = load_spec(path)
    driven = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    joints = [joint for joint in spec.joints if joint.name and joint.type in driven]
    if not joints:
        raise ModelError(f"{path}: the URDF has no revolute or prismatic joint that a motor drives")

    def mjcf(file: str) -> str:
        """Text of the MJCF; the path of the URDF is relative to it or absolute."""
        root = ElementTree.Element("mujoco", model=f"{spec.modelname} with motors")
        root.append(ElementTree.Comment(COMMENT))
        asset = ElementTree.SubElement(root, "asset")
        ElementTree.SubElement(asset, "model", name="robot", file=file)
        world = ElementTree.SubElement(root, "worldbody")
        ElementTree.SubElement(world, "attach", model="robot", prefix="")

        # The range of a motor is that of the force of its joint, where the URDF states one.
        actuators = ElementTree.SubElement(root, "actuator")
        for joint in joints:
            attributes = {"name": joint.name, "joint": joint.name}
            low, high = map(float, joint.actfrcrange)
            if low < high:
                attributes["ctrlrange"] = f"{low:.9g} {high:.9g}"
            ElementTree.SubElement(actuators, "motor", attributes)

        ElementTree.indent(root)
        return ElementTree.tostring(root, encoding="unicode") + "\n"

    return mjcf, _velocities(path)


def _velocities(path: Path) -> dict[str, float]:
    """Velocity limits of a URDF by joint name."""
    found: dict[str, float] = {}
    for joint in ElementTree.parse(path).getroot().iter("joint"):
        limit: Any = joint.find("limit")
        text = None if limit is None else limit.get("velocity")
        name = joint.get("name")
        if text is None or name is None:
            continue
        value = float(text)
        if value > 0.0:
            found[name] = value
    return found


# Largest deviation of a sample period from a whole number of timesteps, relative to a timestep.
STEP_TOLERANCE = 1e-6


@dataclass(frozen=True, kw_only=True)
class Wishes:
    """Wishes for a first experiment; what is None is proposed.

    Attributes:
        groups: Groups of parameters that are wanted.
        payload: Body that carries an unknown payload; None without one.
        keyframe: Keyframe in which the experiment starts.
        rate: Rate of samples and controls [Hz].
        horizon: Duration of the experiment [s].
        sigmas: Standard deviations of measured joints by kind: "angle" [rad], "length" [m],
            "angular velocity" [rad/s], "velocity" [m/s]. Sensors whose noise the MJCF states keep
            it.
    """

    groups: Sequence[Group] = GROUPS
    payload: str | None = None
    keyframe: str | None = None
    rate: float | None = None
    horizon: float | None = None
    sigmas: Mapping[str, float] = field(default_factory=dict)


def groups_of(text: str) -> list[Group]:
    """Groups of parameters from a list with commas. Raises ExperimentError for an unknown one.

    Args:
        text: The names.
    """
    found: list[Group] = []
    for name in (part.strip() for part in text.split(",")):
        group = next((each for each in GROUPS if each == name), None)
        if group is None:
            raise ExperimentError(unknown("group", name, GROUPS))
        found.append(group)
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
    timestep = float(model.opt.timestep)
    steps = 1.0 / (rate * timestep) if rate > 0.0 else 0.0
    near = max(round(steps), 1)
    if abs(steps - near) <= STEP_TOLERANCE * near:
        return rate

    rates = ", ".join(f"{1.0 / (k * timestep):.6g}" for k in (near + 1, near, near - 1) if k)
    raise ExperimentError(
        f"a period of {rate:g} Hz is no whole number of timesteps of {timestep:g} s; rates nearby: "
        f"{rates}"
    )


# Bodies at the end of the chain whose mass and centre of mass are proposed.
LAST_BODIES = 3

# Bodies lighter than this share of the median mass are not proposed.
SMALL_MASS = 0.1

# Size of an unknown payload, relative to the mass of the body that carries it.
PAYLOAD_SHARE = 0.2

AXES = ("x", "y", "z")

# Fields of joints in each group: (field, array of the model, meaning).
JOINT_FIELDS: dict[Group, tuple[tuple[str, str, str], ...]] = {
    "friction": (
        ("damping", "dof_damping", "viscous friction"),
        ("frictionloss", "dof_frictionloss", "dry friction"),
    ),
    "motors": (("armature", "dof_armature", "inertia of the drive"),),
}


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A parameter that may be proposed.

    Attributes:
        name: Name of its table in the experiment file.
        group: Group to which it belongs.
        path: Parameter path.
        meaning: What it is, for the comment.
        offset: Constant that is added to the parameter [unit of the path].
        guess: Stated guess; None for the value in the model.
        scale: Stated scale; None for the default.
        bounds: Stated bounds, or None.
    """

    name: str
    group: Group
    path: str
    meaning: str
    offset: float = 0.0
    guess: float | None = None
    scale: float | None = None
    bounds: tuple[float, float] | None = None

    def table(self) -> dict[str, Any]:
        """The table `[parameters.<name>]` of the experiment file."""
        table: dict[str, Any] = {"target": self.path}
        if self.offset:
            table = {"targets": [{"path": self.path, "offset": self.offset}]}
        if self.guess is not None:
            table["guess"] = self.guess
        if self.scale is not None:
            table["scale"] = self.scale
        if self.bounds is not None:
            table["bounds"] = list(self.bounds)
        return table


def candidates(
    model: Any, groups: Sequence[Group] = GROUPS, payload: str | None = None
) -> list[Candidate]:
    """Parameters of the wanted groups that exist in a model, with unique names.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        groups: Wanted groups.
        payload: Body that carries an unknown payload; None without one.

    Raises:
        ExperimentError: The body of the payload does not exist, or has no mass.
    """
    found: list[Candidate] = []
    if payload is not None:
        found += _payload(model, payload)

    # The last body carries what the robot grasps. With a stated payload, its mass is known.
    elif "payload" in groups:
        for body in _bodies_from_the_end(model)[:1]:
            found += _mass_and_centre(model, body, "payload")
    if "friction" in groups:
        found += _joint_fields(model, "friction")
    if "inertia" in groups:
        found += _inertia(model)
    if "motors" in groups:
        found += _joint_fields(model, "motors")
        found += _servos(model)

    # The inertia of the body that carries the load is known.
    own = [
        each
        for each in found
        if each.group == "payload" or not each.path.startswith(f"body/{payload}:")
    ]
    return list(_with_unique_names(own))


def _with_unique_names(found: Iterable[Candidate]) -> Iterator[Candidate]:
    """The candidates without repeated paths; equal names get a number."""
    paths, names = set(), set()
    for each in found:
        key = (each.path, each.offset)
        if key in paths:
            continue
        name, number = each.name, 2
        while name in names:
            name, number = f"{each.name}_{number}", number + 1
        paths.add(key)
        names.add(name)
        yield replace(each, name=name)


def require_carrier(model: Any, name: str) -> int:
    """Number of a body that can carry a payload. Raises ExperimentError for another one.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        name: Name of the body.
    """
    body = identifier(model, "body", name)
    if body < 0:
        raise ExperimentError(f"--payload: {unknown('body', name, names_of(model, 'body'))}")
    if not float(model.body_mass[body]) > 0.0:
        raise ExperimentError(
            f"--payload: body {name!r} has no mass; name the body with mass that carries the load"
        )
    return body


def _payload(model: Any, name: str) -> Iterator[Candidate]:
    """Mass and first moments of an unknown payload that is fixed to a body."""
    body = require_carrier(model, name)
    mass = float(model.body_mass[body])
    radius = body_inertia(model, body).gyration_radius
    yield Candidate(
        name="payload",
        group="payload",
        path=f"body/{name}:mass",
        meaning=f"mass of the load at {name}",
        offset=mass,
        guess=0.0,
        scale=float(f"{PAYLOAD_SHARE * mass:.2g}"),
    )
    moments = mass * np.asarray(model.body_ipos[body])
    for i, axis in enumerate(AXES):
        yield Candidate(
            name=f"payload_moment_{axis}",
            group="payload",
            path=f"body/{name}:firstmoment[{i}]",
            meaning=f"mass times {axis} of the load's centre of mass, in the frame of {name}",
            offset=float(moments[i]),
            guess=0.0,
            scale=float(f"{PAYLOAD_SHARE * mass * radius:.2g}"),
        )


def _bodies_from_the_end(model: Any) -> list[int]:
    """Numbers of moving bodies with mass and a name, those with most joints below them first."""
    depth = np.zeros(model.nbody, dtype=int)
    for body in range(1, model.nbody):
        depth[body] = depth[model.body_parentid[body]] + int(model.body_jntnum[body])
    moving = [
        body
        for body in range(1, model.nbody)
        if depth[body] and model.body_mass[body] > 0.0 and element_name(model, "body", body)
    ]

    # Fingers and markers are too light to matter.
    typical = float(np.median(model.body_mass[moving])) if moving else 0.0
    moving = [body for body in moving if model.body_mass[body] >= SMALL_MASS * typical]
    return sorted(moving, key=lambda body: (-depth[body], -float(model.body_mass[body])))


def _mass_and_centre(model: Any, body: int, group: Group) -> Iterator[Candidate]:
    """Mass and centre of mass of a body."""
    name = element_name(model, "body", body)
    mass = float(model.body_mass[body])
    yield Candidate(
        name=f"{name}_mass",
        group=group,
        path=f"body/{name}:mass",
        meaning=f"mass of {name}",
        bounds=(0.0, float(f"{10.0 * mass:.3g}")),
    )
    for i, axis in enumerate(AXES):
        yield Candidate(
            name=f"{name}_com_{axis}",
            group=group,
            path=f"body/{name}:ipos[{i}]",
            meaning=f"{axis} of the centre of mass of {name}",
        )


def _inertia(model: Any) -> Iterator[Candidate]:
    """Masses, centres of mass and principal inertias of the last bodies."""
    bodies = _bodies_from_the_end(model)[:LAST_BODIES]
    for body in bodies:
        yield from _mass_and_centre(model, body, "inertia")
    for body in bodies:
        name = element_name(model, "body", body)
        for i, axis in enumerate(AXES):
            if model.body_inertia[body, i] > 0.0:
                yield Candidate(
                    name=f"{name}_inertia_{axis}",
                    group="inertia",
                    path=f"body/{name}:inertia[{i}]",
                    meaning=f"principal moment of inertia {axis} of {name}",
                )


def _joint_fields(model: Any, group: Group) -> Iterator[Candidate]:
    """Fields of joints that are not zero."""
    for quantity, array, meaning in JOINT_FIELDS[group]:
        for joint in range(model.njnt):
            name = element_name(model, "joint", joint)
            value = float(getattr(model, array)[int(model.jnt_dofadr[joint])])
            if name and value > 0.0:
                yield Candidate(
                    name=f"{name}_{quantity}",
                    group=group,
                    path=f"joint/{name}:{quantity}",
                    meaning=f"{meaning} of {name}",
                    bounds=(0.0, float(f"{10.0 * value:.3g}")),
                )


def _servos(model: Any) -> Iterator[Candidate]:
    """Gains of the servos."""
    for i in range(model.nactuator):
        name = element_name(model, "actuator", i)
        has_gain = float(model.actuator_gainprm[i, 0]) != 0.0
        if name and has_gain and servo_kind(model, i) == "position":
            yield Candidate(
                name=f"{name}_kp",
                group="motors",
                path=f"actuator/{name}:kp",
                meaning=f"gain of the servo {name}",
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
    model: Any, length: float, period: float, wanted: Mapping[str, float]
) -> list[ProposedNoise]:
    """Noise of the sensors whose noise the MJCF states; else of all joints, by their type.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        length: Length of the robot [m].
        period: Characteristic period of its motion [s].
        wanted: Standard deviations of joints that the user states, by kind; see `Wishes.sigmas`.
    """
    typical = {
        "angle": ANGLE_SIGMA,
        "length": _rounded(LENGTH_SIGMA * length),
        "angular velocity": _rounded(VELOCITY_SIGMA / period),
        "velocity": _rounded(VELOCITY_SIGMA * length / period),
    }
    return list(_sensors(model)) or list(_joints(model, {**typical, **wanted}))


def _sensors(model: Any) -> Iterator[ProposedNoise]:
    """Sensors with a name whose noise the MJCF states."""
    for i in range(element_count(model, "sensor")):
        name = element_name(model, "sensor", i)
        sigma = float(model.sensor_noise[i])
        if name and sigma > 0.0:
            yield name, sigma, ""


def _joints(model: Any, sigmas: Mapping[str, float]) -> Iterator[ProposedNoise]:
    """Positions and velocities of all joints."""
    kinds = {"qpos": ("length", "angle"), "qvel": ("velocity", "angular velocity")}
    for quantity, (length_kind, angle_kind) in kinds.items():
        for joint, name in enumerate(joint_names(model)):
            kind = mujoco.mjtJoint(int(model.jnt_type[joint]))
            key = f"{quantity}:{name}"
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                yield f"{key}.pos", sigmas[length_kind], length_kind
                yield f"{key}.rot", sigmas[angle_kind], angle_kind
                continue
            moved = length_kind if kind == mujoco.mjtJoint.mjJNT_SLIDE else angle_kind
            yield key, sigmas[moved], moved


def _rounded(value: float) -> float:
    """A number with one significant digit."""
    return float(np.format_float_scientific(value, precision=0))
