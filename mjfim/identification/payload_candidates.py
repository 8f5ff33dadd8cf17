"""Payloads that a model may lack: a mass at the last moving body of each chain.

The effect of a small load is linear in its mass, at a place that is given. Two places are tested on
the line from the origin of the body through its centre of mass, and a fit finds the place itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.experiment.system import System
from mjfim.identification.candidates import (
    LINEARISATION_SIZE,
    Candidate,
    added_term,
    field_of_term,
    has_term,
)
from mjfim.model.elements import element_name
from mjfim.model.sizes import model_length
from mjfim.model.terms.base import AXES
from mjfim.model.terms.library import KINDS
from mjfim.records.terms import TermParameter

# Kind of the term in the library.
KIND = "payload"

# Places that are tested, as multiples of the vector from the origin of the body to its centre of
# mass: the centre itself, and about the end of the body.
PLACES = (1.0, 2.0)

# Poses of the robot in which the directions of a body are compared, and their smallest difference
# that counts; the directions have length 1.
POSES = 8
LEAST_TURN = 1e-6


def payload_candidates_of(system: System) -> Iterator[Candidate]:
    """A payload at each moving body that moves no other one, and that has no payload yet.

    Bodies that terms have added, such as those of contacts, do not belong to the robot. Where all
    inertial parameters of a body are unknown, a payload is a part of them.

    Args:
        system: The system.
    """
    model: Any = system.source.stated.model
    known = {spec.inertial for spec in system.experiment.parameters.values()}
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)

    for body in _last_bodies(model):
        name = element_name(model, "body", body)
        if not name or name in known or has_term(system, KIND, name):
            continue
        rotation = data.xmat[body].reshape(3, 3)
        centre = rotation.T @ (data.subtree_com[body] - data.xpos[body])
        axes = _axes_with_effect(model, body)

        # At the origin of the body, both places are the same.
        places = PLACES if np.linalg.norm(centre) > LEAST_TURN * model_length(model) else PLACES[:1]
        for place in places:
            yield _payload(system, name, place * centre, axes)


def _payload(system: System, body: str, place: Array, axes: tuple[int, ...]) -> Candidate:
    """A payload at a place: (3,) in the frame of a body, which a fit moves along some axes [m]."""
    model: Any = system.source.stated.model
    number = int(model.body(body).id)
    values = {axis: float(x) for axis, x in zip(AXES, place, strict=True) if x}
    added = added_term(system, KIND, body, values)
    size = LINEARISATION_SIZE * float(model.body_subtreemass[model.body_rootid[number]])
    mass = field_of_term(added, "mass", "kg", positive=True, size=size)
    coordinates = tuple(
        TermParameter(
            path=f"term/{added.name}:{AXES[i]}",
            value=float(place[i]),
            unit="m",
            scale=model_length(model),
        )
        for i in axes
    )
    return Candidate(
        description=f"a payload at {body}",
        tested=(mass,),
        further=coordinates,
        added=added,
        variant_of=added.name,
        source=KINDS[KIND].sources[0],
    )


def _last_bodies(model: mujoco.MjModel) -> list[int]:
    """Bodies that move, and with which no body moves that has joints of its own."""
    # A body with joints is welded to no other one; a mocap body has none.
    moving = np.flatnonzero(model.body_jntnum).tolist()
    carriers = {int(model.body_weldid[model.body_parentid[body]]) for body in moving}
    return [body for body in moving if body not in carriers]


def _axes_with_effect(model: mujoco.MjModel, body: int) -> tuple[int, ...]:
    """Axes of a body along which the place of a load has an effect of its own.

    Along an axis whose direction in the world never changes, such as that of the hinges of a planar
    robot, the place changes neither the velocity of a load nor the work of gravity.
    """
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    directions = []
    for _ in range(POSES):
        data.qpos[:] = model.qpos0
        mujoco.mj_integratePos(model, data.qpos, rng.standard_normal(model.nv), 1.0)
        mujoco.mj_kinematics(model, data)
        directions.append(data.xmat[body].reshape(3, 3).copy())

    # Of the axes of a body that is turned against the hinges, as many have an effect of their own
    # as there are directions in which a place has one; those with the largest effect come first.
    turned = np.concatenate(directions[1:]) - np.tile(directions[0], (POSES - 1, 1))
    _, R, order = scipy.linalg.qr(turned, mode="economic", pivoting=True)
    count = int((np.abs(np.diag(R)) > LEAST_TURN).sum())
    return tuple(sorted(order[:count].tolist()))
