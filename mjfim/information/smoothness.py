"""Detection of points at which derivatives do not exist, by a disagreement of difference steps.

Such points are contacts, dry friction, joint limits and clamped actuators.
"""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.information.null_space import LEAST_EFFECT, LEAST_RELATIVE_EFFECT
from mjfim.model.parameters import ParameterSet
from mjfim.plant.outputs import Noise
from mjfim.plant.plant import SENSITIVITY_STEP, Plant
from mjfim.records.trajectory import Sensitivity, Trajectory

# Ratio of the second difference step to the first one; the second step changes a parameter by
# 0.3 %.
LONGER_STEP_FACTOR = 300.0

# Smallest ratio of the second step to the first one. It holds for parameters with a weak effect,
# whose first step is already long.
LEAST_STEP_FACTOR = 3.0

# The third step is the second one divided by this number, and at least `LEAST_MEDIUM_FACTOR` times
# the first one.
MEDIUM_STEP_DIVISOR = 3.0
LEAST_MEDIUM_FACTOR = 1.5

# If a derivative exists, the disagreement decreases at least by this factor from the second to the
# third step.
SMOOTH_DECREASE = 6.0

# A trajectory is rough if two derivatives differ by more than this number (relative).
DISAGREEMENT_TOLERANCE = 1e-2

# The size of an output's derivative, to which a disagreement is related, is at least this fraction
# of the parameter's largest derivative.
NEGLIGIBLE_OUTPUT = 1e-3


def disagreement(fine: Array, coarse: Array) -> Array:
    """Relative disagreement of two derivatives of the outputs.

    Args:
        fine: (N+1, ny, p) whitened derivatives with the shorter step.
        coarse: (N+1, ny, p) whitened derivatives with the longer step.

    Returns:
        (N+1, p) largest difference over all outputs, each relative to its largest value over time.
    """
    size = np.maximum(np.abs(fine).max(axis=0), np.abs(coarse).max(axis=0))
    size = np.maximum(size, NEGLIGIBLE_OUTPUT * size.max(axis=0, initial=0.0))
    relative = np.abs(fine - coarse) / np.where(size > 0.0, size, 1.0)
    return np.asarray(relative.max(axis=1))


def is_rough(
    plant: Plant,
    noise: Noise,
    theta: Array,
    trajectory: Trajectory,
    fine: Sensitivity | None = None,
) -> bool:
    """Whether two difference steps disagree along a trajectory.

    Args:
        plant: The plant.
        noise: Noise of the measured outputs.
        theta: (p,) parameter values.
        trajectory: The trajectory.
        fine: Its sensitivity with the shorter step, if it is known.
    """
    derivatives = plant.derivatives
    # Ratio of the second to the first difference step of each parameter.
    factors = LONGER_STEP_FACTOR * plant.parameters.magnitude / derivatives.parameter_scale
    factors = np.maximum(factors, LEAST_STEP_FACTOR)
    coarse = derivatives.sensitivity(theta, trajectory, factors * SENSITIVITY_STEP)
    if fine is None:
        fine = derivatives.sensitivity(theta, trajectory)
    # A trajectory that diverges after a small change of the parameters has no derivative at all.
    if fine is None or coarse is None:
        return True

    G = noise.whiten(fine.G)
    visible = np.flatnonzero(visible_columns(plant.parameters, G))
    error = disagreement(G, noise.whiten(coarse.G))[:, visible]
    if not error.max(initial=0.0) > DISAGREEMENT_TOLERANCE:
        return False

    # If a derivative exists, the error of central differences decreases by a factor of nine with a
    # third of the step. The trajectory is then smooth, only strongly curved.
    medium = np.maximum(factors / MEDIUM_STEP_DIVISOR, LEAST_MEDIUM_FACTOR)
    between = derivatives.sensitivity(theta, trajectory, medium * SENSITIVITY_STEP)
    if between is None:
        return True
    smaller = disagreement(G, noise.whiten(between.G))[:, visible]
    # Dry friction may switch between the shorter steps as well, however little they disagree.
    has_friction = bool(np.any(plant.model(theta).dof_frictionloss))
    tolerated = 0.0 if has_friction else DISAGREEMENT_TOLERANCE
    return not only_curved(smaller.max(axis=0), error.max(axis=0), tolerated)


def only_curved(medium: Array, longer: Array, tolerated: float) -> bool:
    """Whether disagreements decrease with the step as those of derivatives that exist.

    Args:
        medium: (p,) disagreement of the shorter and the medium step.
        longer: (p,) disagreement of the shorter and the longer step.
        tolerated: Disagreement of the medium step that counts as agreement; it may be round-off.
    """
    allowed = np.maximum(longer / SMOOTH_DECREASE, tolerated)
    return bool((medium <= allowed).all())


def visible_columns(parameters: ParameterSet, G: Array) -> np.ndarray:
    """Find the parameters whose effect is larger than round-off.

    Args:
        parameters: The p parameters.
        G: (N+1, ny, p) whitened derivatives of the outputs.

    Returns:
        (p,) True if a parameter has such an effect.
    """
    length = np.linalg.norm(G, axis=(0, 1)) * parameters.magnitude
    strongest = length.max(initial=0.0)
    return np.asarray((length > LEAST_EFFECT) & (length > LEAST_RELATIVE_EFFECT * strongest))
