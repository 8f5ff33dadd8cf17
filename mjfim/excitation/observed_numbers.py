"""The numbers that a simulation observes for limits, and the place of each limit among them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.excitation.limits import Limit
from mjfim.model.limited_elements import (
    actuators_of_tendon,
    quaternion_address,
    quaternion_joints,
    tilt_weights,
    turn_weights,
)
from mjfim.plant.batch import SubstepObservations

# Attribute of `SubstepObservations` to which each kind of limit belongs; angles are turns.
SOURCES = {
    "position": "positions",
    "velocity": "velocities",
    "angular_velocity": "velocities",
    "acceleration": "accelerations",
    "force": "actuator_forces",
    "joint_force": "joint_forces",
    "tendon_force": "tendon_forces",
    "tendon_length": "tendon_lengths",
}

# The attributes in the order of the observed numbers.
ORDER = (
    "positions",
    "velocities",
    "accelerations",
    "turns",
    "actuator_forces",
    "joint_forces",
    "tendon_forces",
    "tendon_lengths",
)


def observed_numbers(
    model: Any, limits: tuple[Limit, ...]
) -> tuple[SubstepObservations, tuple[tuple[int, ...], ...]]:
    """Choose the numbers that have to be observed for some limits.

    Args:
        model: MjModel.
        limits: n limits on quantities within samples.

    Returns:
        The observations of a single engine step without further rows, and for each of the n limits
        the places of its numbers among them.
    """
    sources = [_source(limit) for limit in limits]
    places: dict[int, tuple[int, ...]] = {}
    begin = 0
    for source in ORDER:
        for i, limit in enumerate(limits):
            if sources[i] == source:
                places[i] = tuple(range(begin, begin + limit.count))
                begin += limit.count

    chosen = {
        source: [limit for limit, each in zip(limits, sources, strict=True) if each == source]
        for source in ORDER
    }
    turns = [np.arange(x.index, x.index + 4) for x in chosen["turns"] for _ in range(x.count)]
    weights = [_turn_weights(model, limit) for limit in chosen["turns"]]
    observations = SubstepObservations(
        positions=_addresses(chosen["positions"]),
        velocities=_addresses(chosen["velocities"]),
        accelerations=_addresses(chosen["accelerations"]),
        actuator_forces=_addresses(chosen["actuator_forces"]),
        joint_forces=_addresses(chosen["joint_forces"]),
        turns=np.array(turns, dtype=np.intp).reshape(-1, 4),
        turn_weights=np.concatenate([np.zeros((0, 4)), *weights]),
        tendon_forces=tuple(actuators_of_tendon(model, x.index) for x in chosen["tendon_forces"]),
        tendon_lengths=_addresses(chosen["tendon_lengths"]),
        derivative_substeps=(1,),
        timestep=float(model.opt.timestep),
    )
    return observations, tuple(places[i] for i in range(len(limits)))


def _source(limit: Limit) -> str:
    """The attribute of `SubstepObservations` that holds the numbers of a limit."""
    return "turns" if limit.is_angle else SOURCES[limit.kind]


def _addresses(limits: Iterable[Limit]) -> np.ndarray:
    """Addresses of all numbers of some limits."""
    each = [limit.index + i for limit in limits for i in range(limit.count)]
    return np.array(each, dtype=np.intp)


def _turn_weights(model: Any, limit: Limit) -> Array:
    """(count, 4) weights of the quaternion of a limited angle."""
    joint = next(j for j in quaternion_joints(model) if quaternion_address(model, j) == limit.index)
    return tilt_weights(model, joint) if limit.kind == "tilt" else turn_weights(model, joint)
