"""Dry friction as a viscous force that saturates: nearly the same where joints move, and smooth where they turn round.

The engine's friction changes sign from one step to the next and sticks for some. What a trajectory tells then jumps by what
such a step tells, and no small difference sees it. `f clip(v / s, -1, 1)`, at a speed s that takes several steps to cross,
averages over them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mjfim.arrays import Array

SMOOTHING_SPEED_FRACTION = 0.02  # s over the fastest speed
SOFT = 1e-3  # impedance of the softened constraint: it answers velocities, not accelerations


def has_dry_friction(model: Any) -> bool:
    """Whether any joint or tendon has dry friction."""
    return bool(model.dof_frictionloss.any() or model.tendon_frictionloss.any())


def smoothing_speeds_of(model: Any, fastest: Array) -> tuple[float, ...]:
    """s of every degree of freedom, then of every tendon, no less than the speed at which the engine's own friction sticks.

    fastest: (nv,) speeds of the degrees of freedom
    """
    own = np.concatenate([_sticking(*rows) for rows in _frictions(model)])
    return tuple(
        np.maximum(
            own, np.concatenate([SMOOTHING_SPEED_FRACTION * fastest, np.zeros(model.ntendon)])
        ).tolist()
    )


def smooth_dry_friction(model: Any, speeds: tuple[float, ...]) -> None:
    """Write the softened law into a model that the caller owns, for the friction that it has, in place."""
    rest = np.asarray(speeds)
    for loss, weight, impedance, reference in _frictions(model):
        s, rest = rest[: len(loss)], rest[len(loss) :]
        on = (loss > 0.0) & (s > 0.0)
        s = np.maximum(
            s, loss * weight * model.opt.timestep
        )  # a longer timestep bears no steeper law
        resistance = (1.0 - SOFT) / SOFT * weight
        impedance[on] = (SOFT, SOFT, 1e-3, 0.5, 2.0)
        reference[on, 0] = -1.0
        reference[on, 1] = -SOFT * (loss * resistance)[on] / s[on]


def _frictions(model: Any) -> tuple[tuple[Array, Array, Array, Array], ...]:
    """Loss, inverse weight, impedance and reference of the friction of joints, and of tendons."""
    return (
        (model.dof_frictionloss, model.dof_invweight0, model.dof_solimp, model.dof_solref),
        (
            model.tendon_frictionloss,
            model.tendon_invweight0,
            model.tendon_solimp_fri,
            model.tendon_solref_fri,
        ),
    )


def _sticking(loss: Array, weight: Array, impedance: Array, reference: Array) -> Array:
    """Speed from which the engine's friction, as strong as it may be, decelerates as it wants to."""
    most = np.maximum(impedance[:, 1], 1e-4)
    standard = reference[:, 0] > 0.0
    damping = np.where(
        standard, 2.0 / np.where(standard, most * reference[:, 0], 1.0), -reference[:, 1] / most
    )
    return np.asarray(loss * weight / np.maximum(damping, 1e-9))
