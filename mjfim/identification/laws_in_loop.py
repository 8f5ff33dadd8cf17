"""The control laws with which recordings were simulated, at an estimate."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from mjfim.arrays import Array
from mjfim.experiment.system import System
from mjfim.model.control_laws import FIELDS, ControlLaw, law_unit
from mjfim.model.units import FORCE_UNITS, control_unit
from mjfim.records.estimate import ControlLawInLoop

# Numbers with which a law is more than a position servo, unless they have no effect.
BEYOND_SERVOS = (
    "ki",
    "slew",
    "latency",
    "time_constant",
    "feedback_latency",
    "velocity_time_constant",
)


def laws_in_loop(
    system: System, theta: Array, clipped: Mapping[str, float]
) -> tuple[ControlLawInLoop, ...]:
    """Describe the laws at some parameters.

    Args:
        system: The system.
        theta: (p,) parameters [theta-unit].
        clipped: Share of the samples at which the limits of a law clip its control, by actuator.

    Returns:
        The laws; none where logs hold the controls themselves.
    """
    if system.laws is None:
        return ()
    return tuple(
        _law_in_loop(system, law, theta, clipped.get(law.actuator, 0.0)) for law in system.laws.laws
    )


def _law_in_loop(system: System, law: ControlLaw, theta: Array, clipped: float) -> ControlLawInLoop:
    """Describe one law."""
    assert system.laws is not None
    model = system.plant.model(theta)
    values = law.numbers(model)

    numbers: dict[str, float] = {}
    units: dict[str, str] = {}
    for field, names in FIELDS.items():
        for i, name in enumerate(names):
            key = field if len(names) == 1 else f"{field}[{i}]"
            is_end = len(names) > 1
            if np.isfinite(values[name]) and (is_end or values[name] != 0.0):
                numbers[key] = values[name]
                units[key] = law_unit(model, law.actuator, field)

    paths = {target.path for p in system.parameters.parameters for target in p.targets}
    plain = not any(name in numbers for name in BEYOND_SERVOS) and not law.differences
    is_force = control_unit(model, int(model.actuator(law.actuator).id)) in FORCE_UNITS.values()
    return ControlLawInLoop(
        actuator=law.actuator,
        joint=law.joint,
        rate=1.0 / (law.tick * float(model.opt.timestep)),
        columns=tuple(system.laws.columns[i] for i in law.columns.values()),
        numbers=numbers,
        units=units,
        estimated=tuple(key for key in numbers if f"controller/{law.actuator}:{key}" in paths),
        clipped=clipped,
        is_servo=plain and is_force and set(law.columns) == {"reference"},
    )
