"""Physical terms that a model may lack, in the order in which they are tested: simple ones first.

Numbers of the model come first (friction, damping, inertia, springs, gains, gravity), then terms of
the library (`mjfim.model.terms`), then errors of the sensors.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.experiment.system import System
from mjfim.model.coordinates import ScalarJoint, scalar_joints
from mjfim.model.elements import element_name, names_of
from mjfim.model.integrators import is_rk4
from mjfim.model.paths import unit_of
from mjfim.model.sizes import LEAST_MOVE_PER_SAMPLE, force_sizes, position_sizes
from mjfim.model.terms.drives import SHORT_LAG
from mjfim.model.terms.library import KINDS
from mjfim.model.terms.term import Term, TermTable
from mjfim.records.terms import AddedTerm, TermParameter

# Size at which the sensitivity of a term is taken where it is zero in the model, relative to the
# inertia of its joint and the natural time of the motion.
LINEARISATION_SIZE = 1e-4

# Stribeck speeds that are tried, over the root mean square of the speed of the joint.
STRIBECK_SHARES = (0.03, 0.1, 0.3)

# Friction with the Stribeck effect in words.
STRIBECK = "Stribeck friction"

# Kind of the term of the library for friction that grows with the load, and this term in words.
LOAD = "load_dependent_friction"
LOAD_FRICTION = "friction that grows with the torque"

# Fields of a joint that are candidates, with their names in words.
JOINT_TERMS = {
    "frictionloss": "dry friction",
    "damping": "viscous damping",
    "damping[1]": "quadratic damping",
    "armature": "rotor inertia",
    "stiffness": "a spring",
}

# Latencies of a control law that are candidates, with their names in words.
LATENCIES = {
    "latency": "late commands of the driver",
    "feedback_latency": "late feedback of the driver",
}

# Smallest component of gravity, as a share of it, that does not count as zero.
MIN_GRAVITY_SHARE = 1e-9

# Types of sensors whose components change with the orientation of their site.
VECTOR_SENSORS = (
    mujoco.mjtSensor.mjSENS_ACCELEROMETER,
    mujoco.mjtSensor.mjSENS_GYRO,
    mujoco.mjtSensor.mjSENS_VELOCIMETER,
    mujoco.mjtSensor.mjSENS_MAGNETOMETER,
    mujoco.mjtSensor.mjSENS_FORCE,
    mujoco.mjtSensor.mjSENS_TORQUE,
)


@dataclass(frozen=True, kw_only=True)
class CandidateParameter:
    """A number whose effect is tested.

    Attributes:
        path: Parameter path.
        unit: Unit of the number; may be empty.
        positive: True where only positive values make sense.
        value: Value without the term [unit].
        linearised_at: Value at which its sensitivity is taken [unit].
        size: Small size of the number, larger than 0 [unit].
    """

    path: str
    unit: str
    positive: bool
    value: float
    linearised_at: float
    size: float


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A term to test.

    Attributes:
        description: The term in words.
        tested: Numbers that are tested together, the main one first.
        further: Parameters that belong to the term but have no effect of their own at zero.
        added: Table of the library that it needs; None for numbers of the model.
        variant_of: What several candidates are variants of, of which only the best one is reported;
            empty for a candidate of its own.
        kind: The kind of term in words, which other joints may have as well; empty for a term of no
            joint.
        joint: Name of its joint; empty where `kind` is.
        source: Publication that describes the term; may be empty.
    """

    description: str
    tested: tuple[CandidateParameter, ...]
    further: tuple[TermParameter, ...] = ()
    added: AddedTerm | None = None
    variant_of: str = ""
    kind: str = ""
    joint: str = ""
    source: str = ""

    @property
    def path(self) -> str:
        """Path of the main number."""
        return self.tested[0].path


def candidates_of(system: System, speeds: Array) -> Iterator[Candidate]:
    """All terms that are not among the parameters and the terms of a system.

    Args:
        system: The system.
        speeds: (nv,) root mean square of the speeds in the recordings [m/s or rad/s].
    """
    targets = targeted_paths(system)
    of_model = (*_joint_terms(system), *_latencies(system), *_gains(system), *_tilts(system))
    of_library = (*_frictions(system, speeds, targets), *_lags(system))
    of_sensors = (*_misalignments(system), *_output_errors(system))
    for candidate in (*of_model, *of_library, *of_sensors):
        if not targets & {_without_index(each.path) for each in candidate.tested}:
            yield candidate

    # The delay is negative where the controls act later than the readings are late.
    if not system.parameters.delay_derivative.any():
        delay = CandidateParameter(
            path="output:delay",
            unit="s",
            positive=False,
            value=0.0,
            linearised_at=0.0,
            size=LINEARISATION_SIZE * period_of(system),
        )
        yield Candidate(description="a delay between controls and outputs", tested=(delay,))


def load_candidates_of(system: System) -> Iterator[Candidate]:
    """Friction that grows with the torque of a motor, at hinges that have dry friction.

    It is simulated by contacts, so that these candidates are not tested together with others.

    Args:
        system: The system.
    """
    for name in _loaded_motors(system):
        added = added_term(system, LOAD, name)
        try:
            least = _least_load_friction(system, added)
        except ExperimentError:
            continue
        coefficient = CandidateParameter(
            path=f"term/{added.name}:coefficient",
            unit="",
            positive=True,
            value=0.0,
            linearised_at=least.value("coefficient"),
            size=LINEARISATION_SIZE,
        )
        yield Candidate(
            description=f"{LOAD_FRICTION} of {name}",
            tested=(coefficient,),
            added=added,
            source=KINDS[LOAD].sources[0],
        )


def impossible_terms_of(system: System) -> Iterator[str]:
    """Terms in words, each with the reason, that a model lacks and cannot have.

    Args:
        system: The system.
    """
    targets = targeted_paths(system)
    if is_rk4(system.model):
        for joint in _rubbing_joints(system, targets):
            if not any(has_term(system, kind, joint.name) for kind in ("stribeck", "lugre")):
                yield f"{STRIBECK} of {joint.name} (its bristle is unstable with RK4)"
    for name in _loaded_motors(system):
        try:
            _least_load_friction(system, added_term(system, LOAD, name))
        except ExperimentError as error:
            # The message begins with a key, and ends with what would be right.
            reason = str(error).partition(": ")[2].partition(";")[0]
            yield f"{LOAD_FRICTION} of {name} ({reason})"


def _loaded_motors(system: System) -> Iterator[str]:
    """Names of the actuators at joints with dry friction, without friction that grows with load.

    Actuators that terms have added are none of them.
    """
    model: Any = system.source.stated.model
    targets = targeted_paths(system)
    for actuator in range(model.nactuator):
        name = element_name(model, "actuator", actuator)
        if not name or int(model.actuator_trntype[actuator]) != int(mujoco.mjtTrn.mjTRN_JOINT):
            continue

        joint = int(model.actuator_trnid[actuator, 0])
        rubs = _has_dry_friction(
            model, element_name(model, "joint", joint), int(model.jnt_dofadr[joint]), targets
        )
        if rubs and not has_term(system, LOAD, name):
            yield name


def _least_load_friction(system: System, added: AddedTerm) -> Term:
    """The term at its least value; ExperimentError where it is impossible, such as at a servo."""
    table = TermTable(name=added.name, element=(("actuator", added.element_name),))
    return KINDS[LOAD].of(table, system.source.stated.model, period_of(system))


def targeted_paths(system: System) -> set[str]:
    """Paths of the numbers that parameters set, those of first entries without their index.

    Args:
        system: The system.
    """
    return {
        _without_index(target.path)
        for parameter in system.parameters.parameters
        for target in parameter.targets
    }


def _without_index(path: str) -> str:
    """A path without the index of a first entry, which may be stated or not."""
    return path.removesuffix("[0]")


def _has_dry_friction(model: Any, joint: str, v: int, targets: set[str]) -> bool:
    """Whether a joint with the degree of freedom v has dry friction, stated or as a parameter."""
    return bool(model.dof_frictionloss[v]) or f"joint/{joint}:frictionloss" in targets


def period_of(system: System) -> float:
    """Stated sample period [s]; logs of another rate are fitted with shorter samples.

    Args:
        system: The system.
    """
    return 1.0 / system.experiment.rate


def has_term(system: System, kind: str, element: str) -> bool:
    """Whether a system has a term of the library at an element already.

    Args:
        system: The system.
        kind: Kind of the term.
        element: Name of the joint, actuator or body.
    """
    return any(
        spec.kind == kind and element in (spec.joint, spec.actuator, spec.body)
        for spec in system.experiment.terms.values()
    )


def added_term(
    system: System, kind: str, element: str, values: dict[str, float] | None = None
) -> AddedTerm:
    """A table of the library for an element, under a name that is free in the model.

    Args:
        system: The system.
        kind: Kind of the term.
        element: Name of the joint, actuator or body.
        values: Values of fields that no parameter sets [unit of the field].
    """
    taken = {*system.experiment.terms}
    for each in ("joint", "actuator", "tendon", "body"):
        taken.update(names_of(system.model, each))

    stem = f"{element}_{kind}"
    name, number = stem, 2
    while name in taken:
        name, number = f"{stem}_{number}", number + 1
    return AddedTerm(
        name=name,
        kind=kind,
        element=KINDS[kind].acts_on,
        element_name=element,
        values=values or {},
    )


# ---- numbers of the model


def _single(description: str, parameter: CandidateParameter) -> Candidate:
    """A candidate that is one number of the model."""
    return Candidate(description=description, tested=(parameter,))


def _not_negative(path: str, unit: str, value: float, size: float) -> CandidateParameter:
    """A number that is not negative, which is tested at a small size where it is zero."""
    return CandidateParameter(
        path=path,
        unit=unit,
        positive=True,
        value=value,
        linearised_at=value or size,
        size=size,
    )


def _of_joint(words: str, name: str, number: CandidateParameter, joint: str) -> Candidate:
    """A candidate that is one number of a joint, or of a driver of this joint with its own name."""
    return Candidate(description=f"{words} of {name}", tested=(number,), kind=words, joint=joint)


def _joint_terms(system: System) -> Iterator[Candidate]:
    """Friction, damping, rotor inertia and stiffness of every joint with one degree of freedom."""
    model: Any = system.model
    time = period_of(system) / LEAST_MOVE_PER_SAMPLE
    force = LINEARISATION_SIZE * force_sizes(model, time)
    stiffness = force / position_sizes(model)
    sizes = {
        "frictionloss": force,
        "damping": stiffness * time,
        "damping[1]": stiffness * time**2 / position_sizes(model),
        "armature": stiffness * time**2,
        "stiffness": stiffness,
    }

    for joint in stated_joints(system):
        for field, words in JOINT_TERMS.items():
            # MuJoCo stores stiffness by joint, the other fields by degree of freedom.
            if field == "stiffness":
                value = float(model.jnt_stiffness[joint.joint])
            elif field == "damping[1]":
                value = float(model.dof_dampingpoly[joint.v, 0])
            else:
                value = float(getattr(model, f"dof_{field}")[joint.v])

            size = float(sizes[field][joint.v])
            path = f"joint/{joint.name}:{field}"
            number = _not_negative(path, unit_of(model, path), value, size)
            yield _of_joint(words, joint.name, number, joint.name)


def stated_joints(system: System) -> tuple[ScalarJoint, ...]:
    """Slides and hinges of the MJCF, without those that terms have added.

    Args:
        system: The system.
    """
    added = {c.address for c in system.source.coordinates.state if c.is_added}
    return tuple(joint for joint in scalar_joints(system.model) if joint.q not in added)


def _tilts(system: System) -> Iterator[Candidate]:
    """Components of gravity along the axes of the world that the model has none along.

    A base that is not level turns gravity in the frame of the base.
    """
    model: Any = system.model
    gravity = np.array(model.opt.gravity)
    strength = float(np.linalg.norm(gravity))
    level = np.flatnonzero(np.abs(gravity) <= MIN_GRAVITY_SHARE * strength)
    has_tilt = any(spec.kind == "tilt" for spec in system.experiment.terms.values())
    if strength == 0.0 or has_tilt:
        return

    for axis in level.tolist():
        number = CandidateParameter(
            path=f"option:gravity[{axis}]",
            unit="m/s²",
            positive=False,
            value=float(gravity[axis]),
            linearised_at=float(gravity[axis]),
            size=LINEARISATION_SIZE * strength,
        )
        yield _single(f"a tilt of the base along {'xyz'[axis]}", number)


def _latencies(system: System) -> Iterator[Candidate]:
    """Latencies of every control law."""
    laws = () if system.laws is None else system.laws.laws
    for field, words in LATENCIES.items():
        for law in laws:
            path, value = f"controller/{law.actuator}:{field}", law.numbers(system.model)[field]
            latency = _not_negative(path, "s", value, LINEARISATION_SIZE * period_of(system))
            yield _of_joint(words, law.actuator, latency, law.joint)


def _gains(system: System) -> Iterator[Candidate]:
    """Gain of every direct drive, such as a torque constant; servos have gains of their own."""
    model: Any = system.model
    fixed, without_bias = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtBias.mjBIAS_NONE)
    for actuator in range(model.nactuator):
        name = element_name(model, "actuator", actuator)
        gain = float(model.actuator_gainprm[actuator, 0])
        is_direct = int(model.actuator_gaintype[actuator]) == fixed
        if not (name and gain and is_direct) or model.actuator_biastype[actuator] != without_bias:
            continue

        path = f"actuator/{name}:gainprm[0]"
        number = CandidateParameter(
            path=path,
            unit=unit_of(model, path),
            positive=False,
            value=gain,
            linearised_at=gain,
            size=LINEARISATION_SIZE * abs(gain),
        )
        yield _single(f"another gain of {name}", number)


# ---- terms of the library


def _frictions(system: System, speeds: Array, targets: set[str]) -> Iterator[Candidate]:
    """Richer friction of every joint that has dry friction, in the model or as a parameter."""
    model: Any = system.model
    force = force_sizes(model, period_of(system) / LEAST_MOVE_PER_SAMPLE)
    for joint in _rubbing_joints(system, targets):
        size = LINEARISATION_SIZE * float(force[joint.v])
        yield from _asymmetric(system, joint, size)
        if not is_rk4(model):
            yield from _stribeck(system, joint, float(speeds[joint.v]), size)


def _rubbing_joints(system: System, targets: set[str]) -> Iterator[ScalarJoint]:
    """Joints with a name that have dry friction, in the model or as a parameter."""
    for joint in stated_joints(system):
        if element_name(system.model, "joint", joint.joint) and _has_dry_friction(
            system.model, joint.name, joint.v, targets
        ):
            yield joint


def _asymmetric(system: System, joint: ScalarJoint, size: float) -> Iterator[Candidate]:
    """Friction of a joint that differs by direction."""
    kind = "asymmetric_friction"
    if has_term(system, kind, joint.name):
        return
    added = added_term(system, kind, joint.name)
    offset = field_of_term(added, "offset", unit_of_force(joint), positive=False, size=size)
    yield Candidate(
        description=f"friction of {joint.name} that differs by direction",
        tested=(offset,),
        added=added,
        kind="friction that differs by direction",
        joint=joint.name,
        source=KINDS[kind].sources[0],
    )


def _stribeck(system: System, joint: ScalarJoint, speed: float, size: float) -> Iterator[Candidate]:
    """Stribeck friction of a joint at several speeds."""
    kind = "stribeck"
    if has_term(system, kind, joint.name) or not speed > 0.0:
        return
    for share in STRIBECK_SHARES:
        stribeck_speed = share * speed
        added = added_term(system, kind, joint.name, {"speed": stribeck_speed})
        excess = field_of_term(added, "excess", unit_of_force(joint), positive=True, size=size)
        further = TermParameter(
            path=f"term/{added.name}:speed",
            value=stribeck_speed,
            unit=f"{joint.unit}/s",
            scale=stribeck_speed,
        )
        yield Candidate(
            description=f"{STRIBECK} of {joint.name}",
            tested=(excess,),
            further=(further,),
            added=added,
            variant_of=added.name,
            kind=STRIBECK,
            joint=joint.name,
            source=KINDS[kind].sources[0],
        )


def _lags(system: System) -> Iterator[Candidate]:
    """Lag of every actuator without dynamics whose force is plain."""
    model: Any = system.model
    kind = "actuator_lag"
    gains = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE))
    biases = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))
    for actuator in range(model.nactuator):
        name = element_name(model, "actuator", actuator)
        is_plain = (
            int(model.actuator_gaintype[actuator]) in gains
            and int(model.actuator_biastype[actuator]) in biases
            and int(model.actuator_dyntype[actuator]) == int(mujoco.mjtDyn.mjDYN_NONE)
            and int(model.actuator_ctrlnum[actuator]) == 1
        )
        if not name or not is_plain or has_term(system, kind, name):
            continue

        added = added_term(system, kind, name)
        lag = CandidateParameter(
            path=f"term/{added.name}:time_constant",
            unit="s",
            positive=True,
            value=0.0,
            linearised_at=SHORT_LAG * float(model.opt.timestep),
            size=LINEARISATION_SIZE * period_of(system),
        )
        yield Candidate(
            description=f"a lag of {name}",
            tested=(lag,),
            added=added,
            source=KINDS[kind].sources[0],
        )


def field_of_term(
    added: AddedTerm, field: str, unit: str, *, positive: bool, size: float
) -> CandidateParameter:
    """A field of a term of the library that is zero without the term.

    Args:
        added: The table of the term.
        field: Name of the field.
        unit: Its unit; may be empty.
        positive: True where only positive values make sense.
        size: Small size of the field, larger than 0 [unit].
    """
    return CandidateParameter(
        path=f"term/{added.name}:{field}",
        unit=unit,
        positive=positive,
        value=0.0,
        linearised_at=size,
        size=size,
    )


def unit_of_force(joint: ScalarJoint) -> str:
    """Unit of the force at a joint.

    Args:
        joint: The joint.
    """
    return "N" if joint.unit == "m" else "N m"


# ---- errors of the sensors


def _misalignments(system: System) -> Iterator[Candidate]:
    """Wrong orientation of every site that carries a measured vector sensor."""
    model: Any = system.model
    measured = {output.sensor for output in system.outputs.outputs if output.sensor is not None}
    kinds = [int(kind) for kind in VECTOR_SENSORS]
    sites: dict[str, str] = {}
    for sensor in range(model.nsensor):
        first, count = int(model.sensor_adr[sensor]), int(model.sensor_dim[sensor])
        if int(model.sensor_type[sensor]) in kinds and measured & {*range(first, first + count)}:
            site = element_name(model, "site", int(model.sensor_objid[sensor]))
            sites.setdefault(site, element_name(model, "sensor", sensor))

    for site, measured_by in sites.items():
        if site:
            tested = tuple(_small(f"site/{site}:rot[{axis}]", "rad") for axis in range(3))
            yield Candidate(description=f"misalignment of {measured_by}", tested=tested)


def _output_errors(system: System) -> Iterator[Candidate]:
    """A constant bias and a wrong scale of every output."""
    outputs = system.outputs.outputs
    for output in outputs:
        bias = _small(f"output/{output.name}:bias", output.unit)
        yield _single(f"bias of {output.name}", bias)
    for output in outputs:
        yield _single(f"scale of {output.name}", _small(f"output/{output.name}:scale", ""))


def _small(path: str, unit: str) -> CandidateParameter:
    """A deviation from the stated model, whose effect is linear."""
    return CandidateParameter(
        path=path, unit=unit, positive=False, value=0.0, linearised_at=0.0, size=1.0
    )
