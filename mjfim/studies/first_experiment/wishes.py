"""Wishes of a user for a first experiment; everything else follows from the model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from mjfim.errors import ExperimentError, unknown

Group = Literal["payload", "friction", "inertia", "motors"]

# Groups of parameters, in the order of preference.
GROUPS: tuple[Group, ...] = ("payload", "friction", "inertia", "motors")


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
