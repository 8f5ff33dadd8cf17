"""Dry friction, smoothed near zero velocity so that derivatives of a trajectory exist.

The engine's dry friction changes its sign from one step to the next, and sticks for some steps. The
information of a trajectory then jumps by the contribution of such a step, and small differences do
not show the jump. Smoothed friction is a viscous force that saturates, `f clip(v / s, -1, 1)`. It
is nearly the engine's friction where joints move, and smooth where they reverse: a joint stays
below the speed s for several engine steps, over which the force averages.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mjfim.arrays import Array

# Smoothing speed s of a degree of freedom over its fastest speed.
SMOOTHING_SPEED_FRACTION = 0.02

# Impedance of the smoothed friction constraint, so low that the force follows velocities and not
# accelerations.
SMOOTHED_IMPEDANCE = 1e-3

# Smallest impedance that MuJoCo uses.
MIN_IMPEDANCE = 1e-4

# Smallest damping of a friction constraint for which a sticking speed is computed [1/s].
MIN_DAMPING = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class _FrictionArrays:
    """Arrays of MjModel that hold the friction constraints of n joints' degrees of freedom, or of n tendons.

    Attributes:
        loss: (n,) friction loss [N or N m].
        inverse_weight: (n,) inverse inertia at the constraint.
        impedance: (n, 5) `solimp`.
        reference: (n, 2) `solref`.
    """

    loss: Array
    inverse_weight: Array
    impedance: Array
    reference: Array


def has_dry_friction(model: Any) -> bool:
    """Whether any joint or tendon has dry friction."""
    return bool(model.dof_frictionloss.any() or model.tendon_frictionloss.any())


def smoothing_speeds_of(model: Any, fastest: Array) -> tuple[float, ...]:
    """Smoothing speeds s of every degree of freedom, then of every tendon [m/s or rad/s].

    None is below the speed at which the engine's friction sticks.

    Args:
        model: The model (`mujoco.MjModel`).
        fastest: (nv,) fastest speeds of the degrees of freedom [m/s or rad/s].
    """
    sticking = np.concatenate([_sticking_speeds(arrays) for arrays in _friction_arrays(model)])
    proportional = np.concatenate([SMOOTHING_SPEED_FRACTION * fastest, np.zeros(model.ntendon)])
    return tuple(np.maximum(sticking, proportional).tolist())


def smooth_dry_friction(model: Any, speeds: tuple[float, ...]) -> None:
    """Write smoothed friction into a model that the caller owns, in place, wherever it has dry friction.

    Args:
        model: The model (`mujoco.MjModel`).
        speeds: Smoothing speeds of every degree of freedom, then of every tendon; 0 keeps the
            engine's friction.
    """
    remaining = np.asarray(speeds)
    for arrays in _friction_arrays(model):
        loss = arrays.loss
        weight = arrays.inverse_weight
        s, remaining = remaining[: len(loss)], remaining[len(loss) :]
        smoothed = (loss > 0.0) & (s > 0.0)

        # A steeper law would be unstable with this timestep.
        s = np.maximum(s, loss * weight * model.opt.timestep)

        resistance = (1.0 - SMOOTHED_IMPEDANCE) / SMOOTHED_IMPEDANCE * weight
        damping = SMOOTHED_IMPEDANCE * (loss * resistance)[smoothed] / s[smoothed]
        arrays.impedance[smoothed] = (SMOOTHED_IMPEDANCE, SMOOTHED_IMPEDANCE, 1e-3, 0.5, 2.0)
        arrays.reference[smoothed, 0] = -1.0
        arrays.reference[smoothed, 1] = -damping


def _friction_arrays(model: Any) -> tuple[_FrictionArrays, _FrictionArrays]:
    """Views of the friction constraints of joints, and of tendons."""
    joints = _FrictionArrays(
        loss=model.dof_frictionloss,
        inverse_weight=model.dof_invweight0,
        impedance=model.dof_solimp,
        reference=model.dof_solref,
    )
    tendons = _FrictionArrays(
        loss=model.tendon_frictionloss,
        inverse_weight=model.tendon_invweight0,
        impedance=model.tendon_solimp_fri,
        reference=model.tendon_solref_fri,
    )
    return joints, tendons


def _sticking_speeds(arrays: _FrictionArrays) -> Array:
    """(n,) speeds below which the engine's friction brakes with less than its full force, and so sticks.

    The constraint asks for a deceleration of damping times speed; its force cannot exceed the
    friction loss.
    """
    impedance = np.maximum(arrays.impedance[:, 1], MIN_IMPEDANCE)
    reference = arrays.reference

    # A positive first reference is a time constant (MuJoCo's standard form); else the second one is
    # the damping itself.
    standard = reference[:, 0] > 0.0
    time_constant = np.where(standard, impedance * reference[:, 0], 1.0)
    damping = np.where(standard, 2.0 / time_constant, -reference[:, 1] / impedance)

    return np.asarray(arrays.loss * arrays.inverse_weight / np.maximum(damping, MIN_DAMPING))
