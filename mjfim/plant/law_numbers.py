"""Numbers of control laws in many simulations: gains, limits and times, read from their models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.model.control_laws import NUMBERS, ControlLaw


@dataclass(frozen=True, kw_only=True, eq=False)
class LawNumbers:
    """Numbers of c laws in m simulations, each (m, c), with the unit u of the control.

    Attributes:
        kp: Gain of the position [u/rad or u/m].
        kd: Gain of the velocity [u s/rad or u s/m].
        ki: Gain of the integral of the error of the position [u/(rad s) or u/(m s)].
        integral: Integral at the begin of a recording [u].
        integral_limit: Largest magnitude of the integral [u].
        saturation_low: Smallest control [u].
        saturation_high: Largest control [u].
        slew: Largest change of the control per second [u/s].
        latency: Time from a command in the log to its effect [s].
        time_constant: Time constant of the filter of the reference [s].
        feedback_latency: Time from a measurement to the effect of the control [s].
        velocity_time_constant: Time constant of the filter of the velocity [s].
    """

    kp: Array
    kd: Array
    ki: Array
    integral: Array
    integral_limit: Array
    saturation_low: Array
    saturation_high: Array
    slew: Array
    latency: Array
    time_constant: Array
    feedback_latency: Array
    velocity_time_constant: Array

    @classmethod
    def of(cls, models: Sequence[Any], laws: Sequence[ControlLaw], count: int) -> LawNumbers:
        """Read the numbers.

        Args:
            models: One model for all simulations, or one for each; successive simulations often
                share one.
            laws: The c laws.
            count: Number m of simulations.
        """
        places = np.array([[law.first + i for law in laws] for i in range(len(NUMBERS))])
        rows: list[Array] = []
        for i, model in enumerate(models):
            known = i > 0 and model is models[i - 1]
            rows.append(rows[-1] if known else np.array(model.numeric_data[places]))

        stacked = np.stack(rows, axis=1)
        if len(models) == 1:
            stacked = np.repeat(stacked, count, axis=1)
        return cls(**dict(zip(NUMBERS, stacked, strict=True)))


def filter_shares(time_constant: Array, period: float) -> Array:
    """Share of a new value that a filter of first order takes over in one period.

    Args:
        time_constant: Time constants [s]; 0 for no filter.
        period: The period [s].

    Returns:
        Shares of the same shape, 1 without a filter.
    """
    filtered = time_constant > 0.0
    ratio = period / np.where(filtered, time_constant, 1.0)
    return np.asarray(np.where(filtered, -np.expm1(-ratio), 1.0))
