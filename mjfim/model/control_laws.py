"""Control laws of drivers: their numbers inside a model, and what they read of a log and a state.

MuJoCo has no discrete laws. The numbers of a law are custom numbers (`numeric`) of a private copy
of the model, which MuJoCo ignores; parameters set them like any other number, and a simulation
finds those of each model in the model itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import mujoco
import numpy as np

from mjfim.arrays import record
from mjfim.errors import ExperimentError
from mjfim.model.loading import ModelSource
from mjfim.model.targets import ModelField
from mjfim.model.units import FORCE_UNITS, control_unit, joint_unit, per_second

# Beginning of the names of the custom numbers of laws.
PREFIX = "mjfim controller "

# What the control of an actuator is, by the code that the custom numbers hold.
Kind = Literal["torque", "voltage", "current"]
KINDS: tuple[Kind | None, ...] = (None, "torque", "voltage", "current")

# Custom numbers of a law, in their order. The first ones describe it and are no parameters; `servo`
# is 1 where the law takes the place of a position servo of the MJCF.
DESCRIPTION = ("joint", "kind", "servo")
NUMBERS = (
    "kp",
    "kd",
    "ki",
    "integral",
    "integral_limit",
    "saturation_low",
    "saturation_high",
    "slew",
    "latency",
    "time_constant",
    "feedback_latency",
    "velocity_time_constant",
    "acceleration",
    "jump",
)

# Field of a parameter path -> names of its numbers.
FIELDS = {
    **{name: (name,) for name in NUMBERS if not name.startswith("saturation_")},
    "saturation": ("saturation_low", "saturation_high"),
}

# Numbers that are times [s].
TIMES = ("latency", "time_constant", "feedback_latency", "velocity_time_constant")

# Quantities that a law may read from a log, by the beginning of the name of the column.
Quantity = Literal["reference", "reference_velocity", "feedforward", "gain", "enable"]

# Quantities that a driver may interpolate between the rows of a log.
CONTINUOUS: tuple[Quantity, ...] = ("reference", "reference_velocity", "feedforward")


# One column of a log that drives a simulation: its name, such as `ctrl:<actuator>` or
# `reference:<actuator>`, its unit, which is empty where it is not evident, and the address in ctrl
# that it sets, None for a column that a law reads.
InputColumn = tuple[str, str, int | None]


@record
class ControlLaw:
    """The law with which the driver of one actuator computes its control.

    Attributes:
        actuator: Name of the actuator.
        control: Address of its control in ctrl.
        joint: Name of the joint whose position the law reads.
        q: Address of the position in qpos.
        v: Address of the velocity in qvel.
        first: Place of the law's first number among the custom numbers of the model.
        tick: Engine steps from one evaluation of the law to the next.
        columns: Indices of the input columns that it reads, by quantity.
        interpolated: True where the log holds points of a continuous reference, false where it
            holds commands that last until the next row.
        differences: True where the driver takes the velocity from differences of the position.
        reference_differences: True where the driver takes the velocity of the reference from
            differences of the reference.
        integrates: True where the law may have an integral.
        replaces_servo: True where the law takes the place of a position servo of the MJCF.
    """

    actuator: str
    control: int
    joint: str
    q: int
    v: int
    first: int
    tick: int
    columns: Mapping[Quantity, int]
    interpolated: bool
    differences: bool
    reference_differences: bool
    integrates: bool
    replaces_servo: bool

    def numbers(self, model: Any) -> dict[str, float]:
        """Values of all `NUMBERS` in a model, by name."""
        values = model.numeric_data[self.first :].tolist()
        return dict(zip(NUMBERS, values, strict=False))


# Columns that follow the inputs of a log for every law with an integral, see `ControlLaws`.
MEASURED_SUMS = ("sum", "reference", "position", "share")


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlLaws:
    """All control laws of an experiment, and the input columns that drive a simulation.

    Inputs of a simulation are the columns of the log. Further columns follow for every law with an
    integral (`MEASURED_SUMS`), where they are known: the sum of the measured errors, times the
    period of the law, since the begin of the recording, or since the law was off; the reference and
    the position at that time; and the share of the first integral that is left, 0 after the law was
    off. Only their values at the begin of a simulation matter.

    Attributes:
        laws: The laws.
        inputs: Columns of the log.
    """

    laws: tuple[ControlLaw, ...]
    inputs: tuple[InputColumn, ...]

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the input columns."""
        return tuple(name for name, _, _ in self.inputs)

    @cached_property
    def direct(self) -> tuple[np.ndarray, np.ndarray]:
        """Indices of the inputs that are controls themselves, and their addresses in ctrl."""
        pairs = [(i, place) for i, (_, _, place) in enumerate(self.inputs) if place is not None]
        both = np.array(pairs, dtype=np.intp).reshape(-1, 2)
        return both[:, 0], both[:, 1]

    @cached_property
    def held(self) -> np.ndarray:
        """(w,) True for inputs that last until the next row of a log."""
        held = np.ones(len(self.inputs), dtype=bool)
        for law in self.laws:
            for quantity, column in law.columns.items():
                held[column] = not law.interpolated or quantity not in CONTINUOUS
        return held

    @cached_property
    def period(self) -> int:
        """Engine steps after which the evaluations of all laws repeat."""
        return int(np.lcm.reduce([law.tick for law in self.laws]))

    @property
    def integrating(self) -> tuple[ControlLaw, ...]:
        """The laws with an integral."""
        return tuple(law for law in self.laws if law.integrates)

    def sums_of(self, law: ControlLaw) -> slice:
        """Places of the further columns of a law with an integral."""
        first = len(self.inputs) + len(MEASURED_SUMS) * self.integrating.index(law)
        return slice(first, first + len(MEASURED_SUMS))

    @cached_property
    def by_tick(self) -> tuple[tuple[ControlLaw, ...], ...]:
        """The laws, grouped by the period of their evaluation."""
        ticks = dict.fromkeys(law.tick for law in self.laws)
        return tuple(tuple(law for law in self.laws if law.tick == tick) for tick in ticks)


def controllers_of(model: Any) -> list[str]:
    """Names of the actuators whose laws a compiled model (`mujoco.MjModel`) holds."""
    names = [model.numeric(i).name for i in range(model.nnumeric)]
    return [name.removeprefix(PREFIX) for name in names if name.startswith(PREFIX)]


def with_laws(source: ModelSource, numbers: Mapping[str, Mapping[str, float]]) -> ModelSource:
    """A model with the numbers of control laws, and motors where laws take the place of servos.

    Args:
        source: The user's model, without laws.
        numbers: Values of `DESCRIPTION` and `NUMBERS` by name, for every actuator with a law.
    """
    every = tuple(
        (actuator, tuple(values[name] for name in (*DESCRIPTION, *NUMBERS)))
        for actuator, values in numbers.items()
    )

    def add(spec: Any) -> None:
        """Add custom numbers, which MuJoCo ignores."""
        for actuator, data in every:
            spec.add_numeric(name=f"{PREFIX}{actuator}", size=len(data), data=list(data))
            if numbers[actuator]["servo"]:
                motor = spec.actuator(actuator)
                lag, numbers_of_lag = motor.dyntype, motor.dynprm.copy()
                motor.set_to_motor()
                motor.dyntype, motor.dynprm = lag, numbers_of_lag
                # Its control was a position, and the law has the range of its force.
                motor.ctrllimited = motor.forcelimited = mujoco.mjtLimited.mjLIMITED_FALSE

    return source.with_elements(every, add)


def first_number(model: Any, actuator: str) -> int:
    """Place of the first of `NUMBERS` of the law of an actuator among all custom numbers."""
    numeric = model.numeric(f"{PREFIX}{actuator}")
    return int(model.numeric_adr[numeric.id]) + len(DESCRIPTION)


def is_law_number(field: object) -> bool:
    """Whether the field of a target is a number of a control law, a custom number of the model."""
    return isinstance(field, ModelField) and field.array == "numeric_data"


def law_field(model: Any, actuator: str, field: str, index: int | None) -> ModelField:
    """The field of a number of a law.

    Args:
        model: The compiled model (`mujoco.MjModel`), which holds the law.
        actuator: Name of the actuator.
        field: A key of `FIELDS`.
        index: Index of the component; None for both ends of a range, of which the lower one is
            minus the upper one.

    Raises:
        ExperimentError: The law does not limit anything by this number.
    """
    first, names = first_number(model, actuator), FIELDS[field]
    place = first + NUMBERS.index(names[-1 if index is None else index])
    if not np.isfinite(model.numeric_data[place]):
        raise ExperimentError(
            f"the law states no {field}, so that there is no number from which a fit could begin; "
            f"state `{field}` in [controllers.{actuator}]"
        )

    # A time is compared with the timestep of the engine, below which it hardly matters, and an
    # integral with the range of the control.
    size = 0.0
    if field in TIMES:
        size = model.opt.timestep
    elif field == "integral":
        low = first + NUMBERS.index("saturation_low")
        ends = np.abs(model.numeric_data[low : low + 2])
        size = float(ends[np.isfinite(ends)].max(initial=0.0))
    # The lower end of a range stands before the upper one.
    lower = ("numeric_data", place - 1, 0, -1.0)
    followers = (lower,) if index is None and len(names) > 1 else ()
    return ModelField(array="numeric_data", rows=(place,), size=size, followers=followers)


def law_unit(model: Any, actuator: str, field: str) -> str:
    """Unit of a number of a law; empty where that of the control is not evident, or without a law.

    Args:
        model: The compiled model (`mujoco.MjModel`), which holds the law.
        actuator: Name of the actuator.
        field: A key of `FIELDS`.
    """
    if field in TIMES:
        return "s"
    if actuator not in controllers_of(model):
        return ""

    first = first_number(model, actuator) - len(DESCRIPTION)
    joint, kind, _ = (int(model.numeric_data[first + i]) for i in range(len(DESCRIPTION)))
    coordinate = joint_unit(model, joint)
    profile = {"jump": coordinate, "acceleration": f"{coordinate}/s²"}
    if field in profile:
        return profile[field]
    unit = unit_of_control(model, model.actuator(actuator).id, coordinate, KINDS[kind])
    if not unit:
        return ""
    gains = {"kp": f"{unit}/{coordinate}", "kd": f"{unit} s/{coordinate}"}
    gains |= {"ki": f"{unit}/({coordinate} s)", "slew": per_second(unit)}
    return gains.get(field, unit)


def unit_of_control(model: Any, actuator: int, coordinate: str, kind: Kind | None) -> str:
    """Unit of the control that a law computes; empty where it is not evident.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        actuator: Number of the actuator.
        coordinate: Unit of the coordinate of its joint.
        kind: What the control is; None where the model says it.
    """
    units = {"voltage": "V", "current": "A", "torque": FORCE_UNITS[coordinate]}
    return units[kind] if kind is not None else control_unit(model, actuator)
