"""The first control of an experiment: a chirp that stays within all ranges."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.model.servos import actuator_gear, commanded_joint
from mjfim.model.sizes import control_sizes, translations
from mjfim.studies.first_experiment.start import Start

# Share of the range of a control that the first trial uses to each side of the resting control.
RANGE_SHARE = 0.5

# Angle that a free rotation moves in the first trial [rad], and share of the robot's length that a
# free translation moves.
ANGLE = 0.5
LENGTH_SHARE = 0.5

# Factor between successive trials, and their number.
SHRINKING = 0.5
TRIALS = 16


def first_amplitudes(
    model: Any, start: Start, influence: Array, length: float, period: float
) -> Array:
    """Amplitudes of the controls with which the search begins.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        start: Initial state and resting control.
        influence: (nv, nu) derivatives of the accelerations by the controls.
        length: Length of the robot [m].
        period: Characteristic period of its motion [s].

    Returns:
        (nu,) amplitudes: a share of the room within the control's range, or, without a range, what
        moves a joint by half a radian or by half of the robot's length. A control that rests at an
        end of its range gets 0.
    """
    distance = np.where(translations(model), LENGTH_SHARE * length, ANGLE)
    wanted = distance * (2.0 * np.pi / period) ** 2

    # A control that moves nothing in the start gets its natural size.
    amplitudes = control_sizes(model, period)
    for i in range(model.nu):
        if model.actuator_ctrllimited[i]:
            low, high = model.actuator_ctrlrange[i]
            room = min(start.control[i] - low, high - start.control[i])
            amplitudes[i] = RANGE_SHARE * max(room, 0.0)
        elif np.any(influence[:, i]):
            moved = np.abs(influence[:, i]) > 0.0
            amplitudes[i] = float((wanted[moved] / np.abs(influence[moved, i])).min())

    # The joint follows the control of a position servo.
    for actuator in range(model.nactuator):
        control = int(model.actuator_ctrladr[actuator])
        joint = commanded_joint(model, actuator)
        if joint is not None and not model.actuator_ctrllimited[control]:
            gear = abs(actuator_gear(model, actuator))
            amplitudes[control] = gear * float(distance[int(model.jnt_dofadr[joint])])

    return rounded(amplitudes)


def rounded(values: Array) -> Array:
    """Numbers with two significant digits."""
    return np.array([float(f"{value:.2g}") for value in values])


def largest_feasible(amplitudes: Array, feasible: Callable[[Array], bool]) -> Array | None:
    """Shrink amplitudes until a motion keeps all limits.

    Args:
        amplitudes: (nu,) amplitudes of the first trial.
        feasible: Whether the motion with some amplitudes keeps all limits.

    Returns:
        (nu,) amplitudes with two significant digits, or None where even tiny ones do not.
    """
    for trial in range(TRIALS):
        shrunk = rounded(amplitudes * SHRINKING**trial)
        if feasible(shrunk):
            return shrunk
    return None
