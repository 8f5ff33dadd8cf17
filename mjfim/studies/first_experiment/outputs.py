"""Measured outputs of a first experiment and their noise."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.model.coordinates import joint_names
from mjfim.model.elements import element_count, element_name

# Standard deviation of measured angles [rad], of lengths relative to the robot's length, and of
# velocities relative to the length or the radian per period.
ANGLE_SIGMA = 1e-3
LENGTH_SIGMA = 1e-3
VELOCITY_SIGMA = 1e-2


@dataclass(frozen=True, kw_only=True)
class ProposedNoise:
    """Noise of one output.

    Attributes:
        key: Key of the table `noise`.
        sigma: Standard deviation [output unit].
        stated: Whether the MJCF states it.
    """

    key: str
    sigma: float
    stated: bool


def proposed_noise(model: Any, length: float, period: float) -> list[ProposedNoise]:
    """Noise of the sensors whose noise the MJCF states; else of all joints, by their type.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        length: Length of the robot [m].
        period: Characteristic period of its motion [s].
    """
    sensors = list(_sensors(model))
    return sensors or list(_joints(model, length, period))


def _sensors(model: Any) -> Iterator[ProposedNoise]:
    """Sensors with a name whose noise the MJCF states."""
    for i in range(element_count(model, "sensor")):
        name = element_name(model, "sensor", i)
        sigma = float(model.sensor_noise[i])
        if name and sigma > 0.0:
            yield ProposedNoise(key=name, sigma=sigma, stated=True)


def _joints(model: Any, length: float, period: float) -> Iterator[ProposedNoise]:
    """Positions and velocities of all joints."""
    sigmas = {
        "pos": _rounded(LENGTH_SIGMA * length),
        "rot": ANGLE_SIGMA,
        "vel": _rounded(VELOCITY_SIGMA * length / period),
        "omega": _rounded(VELOCITY_SIGMA / period),
    }
    for field in ("qpos", "qvel"):
        length_key, angle_key = ("pos", "rot") if field == "qpos" else ("vel", "omega")
        for joint, name in enumerate(joint_names(model)):
            kind = mujoco.mjtJoint(int(model.jnt_type[joint]))
            key = f"{field}:{name}"
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                yield ProposedNoise(key=f"{key}.pos", sigma=sigmas[length_key], stated=False)
                yield ProposedNoise(key=f"{key}.rot", sigma=sigmas[angle_key], stated=False)
                continue
            slides = kind == mujoco.mjtJoint.mjJNT_SLIDE
            sigma = sigmas[length_key if slides else angle_key]
            yield ProposedNoise(key=key, sigma=sigma, stated=False)


def _rounded(value: float) -> float:
    """A number with one significant digit."""
    return float(np.format_float_scientific(value, precision=0))
