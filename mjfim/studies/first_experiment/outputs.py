"""Measured outputs of a first experiment and their noise."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
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
        kind: Kind of a joint's coordinate, see `Wishes.sigmas`; empty for sensors.
    """

    key: str
    sigma: float
    stated: bool
    kind: str = ""


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
    sensors = list(_sensors(model))
    return sensors or list(_joints(model, {**typical_sigmas(length, period), **wanted}))


def typical_sigmas(length: float, period: float) -> dict[str, float]:
    """Typical standard deviations of joints by kind.

    Args:
        length: Length of the robot [m].
        period: Characteristic period of its motion [s].
    """
    return {
        "angle": ANGLE_SIGMA,
        "length": _rounded(LENGTH_SIGMA * length),
        "angular velocity": _rounded(VELOCITY_SIGMA / period),
        "velocity": _rounded(VELOCITY_SIGMA * length / period),
    }


def _sensors(model: Any) -> Iterator[ProposedNoise]:
    """Sensors with a name whose noise the MJCF states."""
    for i in range(element_count(model, "sensor")):
        name = element_name(model, "sensor", i)
        sigma = float(model.sensor_noise[i])
        if name and sigma > 0.0:
            yield ProposedNoise(key=name, sigma=sigma, stated=True)


def _joints(model: Any, sigmas: Mapping[str, float]) -> Iterator[ProposedNoise]:
    """Positions and velocities of all joints."""
    kinds = {"qpos": ("length", "angle"), "qvel": ("velocity", "angular velocity")}
    for field, (length_kind, angle_kind) in kinds.items():
        for joint, name in enumerate(joint_names(model)):
            kind = mujoco.mjtJoint(int(model.jnt_type[joint]))
            key = f"{field}:{name}"
            if kind == mujoco.mjtJoint.mjJNT_FREE:
                yield _noise(f"{key}.pos", length_kind, sigmas)
                yield _noise(f"{key}.rot", angle_kind, sigmas)
                continue
            slides = kind == mujoco.mjtJoint.mjJNT_SLIDE
            yield _noise(key, length_kind if slides else angle_kind, sigmas)


def _noise(key: str, kind: str, sigmas: Mapping[str, float]) -> ProposedNoise:
    """Noise of an output of some kind."""
    return ProposedNoise(key=key, sigma=sigmas[kind], stated=False, kind=kind)


def _rounded(value: float) -> float:
    """A number with one significant digit."""
    return float(np.format_float_scientific(value, precision=0))
