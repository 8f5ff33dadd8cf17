"""Physical terms that a model may lack, in the order in which they are tested: simple ones first.

A term of the library says itself where it may be missing (`mjfim/model/terms/term.py`); the others
are numbers of the model and of the measurement.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import field, replace
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError
from mjfim.experiment.system import System
from mjfim.model.coordinates import ScalarJoint, scalar_joints
from mjfim.model.elements import (
    LEAST_MOVE_PER_SAMPLE,
    element_name,
    force_sizes,
    free_name,
    names_of,
    position_sizes,
)
from mjfim.model.paths import resolve, unit_of
from mjfim.model.terms.library import KINDS
from mjfim.model.terms.term import Term as LibraryTerm
from mjfim.model.terms.term import TermTable
from mjfim.records.terms import TermNumber

# Size at which the sensitivity of a term is taken where it is zero in the model, relative to the
# inertia of its joint and the natural time of the motion.
LINEARISATION_SIZE = 1e-4

# Smallest size of a term that simulations look for, relative to its natural size.
SCREENED_SIZE = 1.0 / 27.0

# Numbers of a control law that are candidates, with their names in words.
LAW_NUMBERS = {
    "kp": "another gain of the driver of {}",
    "kd": "damping by the driver of {}",
    "latency": "late commands of the driver of {}",
    "time_constant": "filtered references of the driver of {}",
    "feedback_latency": "late feedback of the driver of {}",
    "velocity_time_constant": "filtered velocities of the driver of {}",
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


@record
class Effect:
    """A number whose effect is tested.

    Attributes:
        path: Target of its parameter.
        unit: Its unit; may be empty.
        value: Its value in the model [unit].
        begin: Value at which its effect is linearised [unit].
        size: A small size of it [unit].
        positive: Whether it cannot be negative.
    """

    path: str
    unit: str
    value: float
    begin: float
    size: float
    positive: bool = False


@record
class Candidate:
    """A term to test.

    Attributes:
        description: The term in words.
        tested: The numbers whose effects are tested, the main one first.
        further: Numbers that a fit estimates besides.
        tables: Tables `[terms.<name>]` of the library that it needs.
        kind: The term in words without its joint; empty for terms of no single joint.
        joint: Name of its joint; empty for terms of no single joint.
        source: Publication that describes it; may be empty.
        alone: Name of a kind that is tested apart from the others; empty for most.
        screened: Whether simulations with some sizes look for it in place of a linear test.
    """

    description: str
    tested: tuple[Effect, ...]
    further: tuple[TermNumber, ...] = ()
    tables: dict[str, dict[str, str | dict[str, float]]] = field(default_factory=dict)
    kind: str = ""
    joint: str = ""
    source: str = ""
    alone: str = ""
    screened: bool = False


def candidates_of(system: System, speeds: Array) -> tuple[list[Candidate], list[str]]:
    """All terms that are not among the parameters and the terms of a system.

    Args:
        system: The system.
        speeds: (nv,) typical speeds of the degrees of freedom [m/s or rad/s].

    Returns:
        The candidates, and terms in words, each with the reason, that the model cannot have.
    """
    # Paths of the numbers that parameters set, those of first entries without their index.
    targets = {
        _without_index(target.path)
        for parameter in system.parameters.parameters
        for target in parameter.targets
    }
    library, impossible = _library_terms(system, speeds, targets)
    numbers = (*_joint_terms(system), *_law_numbers(system), *_gains(system), *_tilts(system))
    further = (*_misalignments(system), *_output_errors(system))
    found = [
        candidate
        for candidate in (*numbers, *library, *further)
        if not targets & {_without_index(each.path) for each in candidate.tested}
    ]
    return found, impossible


def _without_index(path: str) -> str:
    """A path without the index of a first entry, which may be stated or not."""
    return path.removesuffix("[0]")


# ---- numbers of the model and of the measurement


def _number(
    system: System, path: str, size: float = 1.0, unit: str = "", *, positive: bool = False
) -> Effect:
    """A number that a path names; one that cannot be negative is tested at a small size."""
    source = system.source
    target = resolve(system.model, path, system.outputs.names, source.decoration, source.terms)
    value = target.read(system.model)
    return Effect(
        path=path,
        unit=unit or unit_of(system.model, path),
        value=value,
        begin=value or (size if positive else 0.0),
        size=size,
        positive=positive,
    )


def _at_joint(words: str, name: str, joint: str, number: Effect) -> Candidate:
    """A candidate that is one number of a joint, or of a driver of this joint with its own name."""
    return Candidate(
        description=words.format(name),
        tested=(number,),
        kind=words.replace(" of {}", ""),
        joint=joint,
    )


def _joint_terms(system: System) -> Iterator[Candidate]:
    """Friction, damping, rotor inertia and stiffness of every joint with one degree of freedom."""
    time = _period_of(system) / LEAST_MOVE_PER_SAMPLE
    force = LINEARISATION_SIZE * force_sizes(system.model, time)
    length = position_sizes(system.model)
    sizes = {
        "frictionloss": ("dry friction of {}", force),
        "damping": ("viscous damping of {}", force * time / length),
        "damping[1]": ("quadratic damping of {}", force * time**2 / length**2),
        "armature": ("rotor inertia of {}", force * time**2 / length),
        "stiffness": ("a spring of {}", force / length),
    }
    for joint in _stated_joints(system):
        for name, (words, size) in sizes.items():
            path = f"joint/{joint.name}:{name}"
            number = _number(system, path, float(size[joint.v]), positive=True)
            yield _at_joint(words, joint.name, joint.name, number)


def _stated_joints(system: System) -> tuple[ScalarJoint, ...]:
    """Slides and hinges of the MJCF with a name, without those that terms have added."""
    added = {c.address for c in system.source.coordinates.state if c.is_added}
    return tuple(
        joint
        for joint in scalar_joints(system.model)
        if joint.q not in added and element_name(system.model, "joint", joint.joint)
    )


def _period_of(system: System) -> float:
    """Stated sample period [s]; logs of another rate are fitted with shorter samples."""
    return 1.0 / system.experiment.rate


def _law_numbers(system: System) -> Iterator[Candidate]:
    """Gains, latencies and filters of every control law."""
    time = LINEARISATION_SIZE * _period_of(system)
    for law in () if system.laws is None else system.laws.laws:
        values = law.numbers(system.model)
        follows = law.reference_differences or "reference_velocity" in law.columns
        possible = dict.fromkeys(LAW_NUMBERS, True) | {
            "kp": values["kp"] > 0.0,
            # A gain that only brakes is viscous damping of the joint.
            "kd": values["kp"] > 0.0 and follows,
            "velocity_time_constant": values["kd"] > 0.0,
        }
        sizes = {"kp": LINEARISATION_SIZE * values["kp"], "kd": time * values["kp"]}
        # A filter has no effect up to a part of the period of its law.
        tick = law.tick * float(system.model.opt.timestep)
        begins = {"time_constant": tick, "velocity_time_constant": tick}
        for name, words in LAW_NUMBERS.items():
            if possible[name]:
                path, size = f"controller/{law.actuator}:{name}", sizes.get(name, time)
                number = _number(system, path, size, positive=True)
                number = replace(number, begin=max(number.begin, begins.get(name, 0.0)))
                candidate = _at_joint(words, law.actuator, law.joint, number)
                # The other numbers are linearised without filters.
                yield replace(candidate, alone=name if name in begins else "")


def _gains(system: System) -> Iterator[Candidate]:
    """Gain of every direct drive, such as a torque constant; servos have gains of their own."""
    model: Any = system.model
    fixed, without_bias = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtBias.mjBIAS_NONE)
    for actuator in range(model.nactuator):
        name, gain = element_name(model, "actuator", actuator), model.actuator_gainprm[actuator, 0]
        is_plain = int(model.actuator_gaintype[actuator]) == fixed
        is_plain &= int(model.actuator_biastype[actuator]) == without_bias
        if name and gain and is_plain:
            size = LINEARISATION_SIZE * abs(float(gain))
            number = _number(system, f"actuator/{name}:gainprm[0]", size)
            yield Candidate(description=f"another gain of {name}", tested=(number,))


def _tilts(system: System) -> Iterator[Candidate]:
    """Components of gravity along the axes of the world that the model has none along."""
    gravity = np.abs(system.model.opt.gravity)
    strength = float(np.linalg.norm(gravity))
    has_tilt = any(spec.kind == "tilt" for spec in system.experiment.terms.values())
    if strength == 0.0 or has_tilt:
        return
    for axis in np.flatnonzero(gravity <= MIN_GRAVITY_SHARE * strength).tolist():
        number = _number(system, f"option:gravity[{axis}]", LINEARISATION_SIZE * strength)
        yield Candidate(description=f"a tilt of the base along {'xyz'[axis]}", tested=(number,))


def _misalignments(system: System) -> Iterator[Candidate]:
    """Wrong orientation of every site that carries a measured vector sensor."""
    model: Any = system.model
    measured = {output.sensor for output in system.outputs.outputs if output.sensor is not None}
    sites: dict[str, str] = {}
    for sensor in range(model.nsensor):
        first, count = int(model.sensor_adr[sensor]), int(model.sensor_dim[sensor])
        if int(model.sensor_type[sensor]) in VECTOR_SENSORS and measured & {
            *range(first, first + count)
        }:
            site = element_name(model, "site", int(model.sensor_objid[sensor]))
            sites.setdefault(site, element_name(model, "sensor", sensor))

    for site, measured_by in sites.items():
        if site:
            paths = [f"site/{site}:rot[{axis}]" for axis in range(3)]
            tested = tuple(_number(system, path, unit="rad") for path in paths)
            yield Candidate(description=f"misalignment of {measured_by}", tested=tested)


def _output_errors(system: System) -> Iterator[Candidate]:
    """A constant bias and a wrong scale of every output, and a delay of all."""
    outputs = system.outputs.outputs
    for output in outputs:
        number = _number(system, f"output/{output.name}:bias", unit=output.unit)
        yield Candidate(description=f"bias of {output.name}", tested=(number,))
    for output in outputs:
        number = _number(system, f"output/{output.name}:scale")
        yield Candidate(description=f"scale of {output.name}", tested=(number,))

    # The delay is negative where the controls act later than the readings are late.
    if not system.parameters.delay_derivative.any():
        size = LINEARISATION_SIZE * _period_of(system)
        delay = _number(system, "output:delay", size, "s")
        yield Candidate(description="a delay between controls and outputs", tested=(delay,))


# ---- terms of the library


def _library_terms(
    system: System, speeds: Array, targets: set[str]
) -> tuple[list[Candidate], list[str]]:
    """Terms of the library, and those that the model cannot have, each with the reason."""
    model = system.source.stated.model
    joints = {joint.name: joint for joint in _stated_joints(system)}
    found, impossible = [], []
    for kind in KINDS.values():
        elements = names_of(model, kind.acts_on) if kind.words else []
        for element in elements:
            joint = joints.get(_joint_of(model, kind.acts_on, element))
            if _has_term(system, kind, element) or not _is_beside(system, kind, joint, targets):
                continue
            speed = 0.0 if joint is None else float(speeds[joint.v])
            try:
                for values, estimated in kind.shapes(model, element, speed):
                    found.append(_library_term(system, kind, element, values, estimated))
            except ExperimentError as error:
                # The message begins with a key, and ends with what would be right.
                reason = str(error).partition(": ")[2].partition(";")[0]
                if kind.beside and not kind.screened:
                    impossible.append(f"{kind.words.format(element)} ({reason})")
    return found, impossible


def _joint_of(model: Any, acts_on: str, element: str) -> str:
    """Name of the joint on which an element acts; empty for none."""
    if acts_on != "actuator":
        return element if acts_on == "joint" else ""
    actuator = model.actuator(element)
    if int(actuator.trntype[0]) != int(mujoco.mjtTrn.mjTRN_JOINT):
        return ""
    return element_name(model, "joint", int(actuator.trnid[0]))


def _has_term(system: System, kind: type[LibraryTerm], element: str) -> bool:
    """Whether a system has a term of a kind at an element, or a body's inertia is unknown."""
    experiment = system.experiment
    if kind.acts_on == "body" and element in {
        spec.inertial for spec in experiment.parameters.values()
    }:
        return True
    return any(
        (spec.kind == kind.kind or (kind.screened and KINDS[spec.kind].screened))
        and element in (spec.joint, spec.actuator, spec.body)
        for spec in experiment.terms.values()
    )


def _is_beside(
    system: System, kind: type[LibraryTerm], joint: ScalarJoint | None, targets: set[str]
) -> bool:
    """Whether the field acts that a term needs, in the model or as a parameter."""
    if not kind.beside:
        return True
    if joint is None:
        return False
    value = float(getattr(system.model, f"dof_{kind.beside}")[joint.v])
    return value > 0.0 or f"joint/{joint.name}:{kind.beside}" in targets


def _library_term(
    system: System,
    kind: type[LibraryTerm],
    element: str,
    values: dict[str, float],
    estimated: tuple[str, ...],
) -> Candidate:
    """A term at an element; ExperimentError where the model cannot have it."""
    taken = {*system.experiment.terms}
    for each in ("joint", "actuator", "tendon", "body"):
        taken.update(names_of(system.model, each))
    name = free_name(f"{element}_{kind.kind}", taken)
    stated = {key: value for key, value in values.items() if value}
    table = TermTable(name=name, element=((kind.acts_on, element),), values=tuple(stated.items()))
    term = kind.of(table, system.source.stated.model, _period_of(system))
    main = term.quantity(kind.size)
    size = main.size * (SCREENED_SIZE if kind.screened else LINEARISATION_SIZE)
    tested = Effect(
        path=f"term/{name}:{kind.size}",
        unit=main.unit,
        value=0.0,
        begin=main.value or size,
        size=size,
        positive=main.bounds[0] >= 0.0,
    )
    quantities = {key: term.quantity(key) for key in estimated}
    further = tuple(
        TermNumber(
            path=f"term/{name}:{key}",
            value=quantity.value,
            unit=quantity.unit,
            # A number that is never zero is compared with itself.
            scale=quantity.value if quantity.bounds[0] > 0.0 else quantity.size,
        )
        for key, quantity in quantities.items()
    )
    stated_table: dict[str, str | dict[str, float]] = {"kind": kind.kind, kind.acts_on: element}
    if stated:
        stated_table["values"] = stated
    return Candidate(
        description=kind.words.format(element),
        tested=(tested,),
        further=further,
        tables={name: stated_table},
        kind=kind.words.replace(" of {}", "") if kind.acts_on == "joint" else "",
        joint=element if kind.acts_on == "joint" else "",
        source=kind.sources[0],
        alone=kind.kind if kind.alone else "",
        screened=kind.screened,
    )
