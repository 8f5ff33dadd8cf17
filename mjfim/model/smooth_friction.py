"""Dry friction, smoothed near zero velocity so that derivatives of a trajectory exist.

The dry friction of the engine changes its sign from one step to the next, and joints stick for some
steps. The information of a trajectory then jumps by the contribution of such a step, and small
differences do not show the jump. Smoothed friction is a viscous force that saturates,
`f clip(v / s, -1, 1)`. It is nearly the engine's friction where joints move, and smooth where they
reverse: a joint stays below the speed s for several engine steps, over which the force averages.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mjfim.arrays import Array

# Smoothing speed s of a degree of freedom, divided by its fastest speed.
SMOOTHING_SPEED_FRACTION = 0.02

# Impedance of the smoothed friction constraint. It is so low that the force depends on velocities
# and not on accelerations.
SMOOTHED_IMPEDANCE = 1e-3

# Smallest impedance that MuJoCo uses.
MIN_IMPEDANCE = 1e-4

# Smallest damping of a friction constraint for which a sticking speed is computed, relative to one
# per timestep.
MIN_DAMPING = 1e-12


@dataclass(frozen=True, kw_only=True, eq=False)
class _FrictionArrays:
    """Arrays of MjModel with the friction constraints of n degrees of freedom or of n tendons.

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

    No smoothing speed is below the speed at which the engine's friction sticks.

    Args:
        model: The model (`mujoco.MjModel`).
        fastest: (nv,) fastest speeds of the degrees of freedom [m/s or rad/s].
    """
    step = float(model.opt.timestep)
    sticking = np.concatenate(
        [_sticking_speeds(arrays, step) for arrays in _friction_arrays(model)]
    )
    proportional = np.concatenate([SMOOTHING_SPEED_FRACTION * fastest, np.zeros(model.ntendon)])
    return tuple(np.maximum(sticking, proportional).tolist())


def smooth_dry_friction(model: Any, speeds: tuple[float, ...]) -> None:
    """Replace the dry friction of a model by smoothed friction, in place.

    Args:
        model: The model (`mujoco.MjModel`), a private copy of the caller.
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


def _sticking_speeds(arrays: _FrictionArrays, timestep: float) -> Array:
    """(n,) speeds below which the engine's friction sticks.

    Below such a speed, friction brakes with less than its full force: the constraint asks for a
    deceleration of damping times speed, and its force cannot exceed the friction loss.
    """
    impedance = np.maximum(arrays.impedance[:, 1], MIN_IMPEDANCE)
    reference = arrays.reference

    # In MuJoCo's standard form the first number of `solref` is positive and is a time constant.
    # Otherwise the second number is the damping itself.
    standard = reference[:, 0] > 0.0
    time_constant = np.where(standard, impedance * reference[:, 0], 1.0)
    damping = np.where(standard, 2.0 / time_constant, -reference[:, 1] / impedance)

    damping = np.maximum(damping, MIN_DAMPING / timestep)
    return np.asarray(arrays.loss * arrays.inverse_weight / damping)
