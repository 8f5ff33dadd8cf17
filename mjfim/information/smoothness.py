"""Where derivatives do not exist: contacts, dry friction, limits and clamps make two difference steps disagree."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.information.null_space import LEAST_EFFECT, LEAST_RELATIVE_EFFECT
from mjfim.model.parameters import ParameterSet
from mjfim.plant.active_constraints import active_constraints
from mjfim.plant.derivatives import SENSITIVITY_STEP
from mjfim.plant.noise import Noise
from mjfim.plant.plant import Plant
from mjfim.records.check import Roughness
from mjfim.records.trajectory import Sensitivity, Trajectory

LONGER = 300.0  # the second step, times the first: a change of 0.3 %
LEAST = 3.0  # the same for parameters so weak that the first step is long already
DISAGREEMENT_TOLERANCE = 1e-2  # relative disagreement that is told
CURVED = 6.0  # by how much the disagreement at least falls with a third of the step where a derivative exists
MINOR = 1e-3  # of the largest effect of a parameter; an output that shows less of it tells nothing


def disagreement(fine: Array, coarse: Array) -> Array:
    """(N+1, p) relative disagreement of two derivatives G: (N+1, ny, p), each output's against its own largest value."""
    size = np.maximum(np.abs(fine).max(axis=0), np.abs(coarse).max(axis=0))
    size = np.maximum(size, MINOR * size.max(axis=0, initial=0.0))
    return np.asarray((np.abs(fine - coarse) / np.where(size > 0.0, size, 1.0)).max(axis=1))


def roughness(
    plant: Plant,
    noise: Noise,
    model: Any,
    theta: Array,
    trajectory: Trajectory,
    fine: Sensitivity | None = None,
) -> Roughness | None:
    """Find the worst disagreement of two difference steps along a trajectory.

    Args:
        plant: The plant.
        noise: Noise of the measured outputs.
        model: The user's model at theta, in which the causes are looked for.
        theta: (p,) parameter values.
        trajectory: The trajectory.
        fine: Its sensitivity by the shorter step, if it is known.

    Returns:
        The worst disagreement and what causes it; None where it is below `DISAGREEMENT_TOLERANCE`.
    """
    parameters = plant.parameters
    fine = plant.derivatives.sensitivity(theta, trajectory) if fine is None else fine
    longer = np.maximum(LONGER * parameters.magnitude / plant.derivatives.parameter_scale, LEAST)
    coarse = plant.derivatives.sensitivity(theta, trajectory, longer * SENSITIVITY_STEP)
    names = parameters.names

    if fine is None or coarse is None:
        causes = active_constraints(model, trajectory, range(trajectory.samples))
        return Roughness(
            error=np.inf, parameter=", ".join(names), sample=0, time=0.0, causes=causes
        )

    G = noise.whiten(fine.G)
    visible = np.flatnonzero(visible_columns(parameters, G))
    if not len(visible):
        return None

    error = disagreement(G, noise.whiten(coarse.G))[:, visible]
    worst = int(np.argmax(error.max(axis=0)))
    if not error[:, worst].max() > DISAGREEMENT_TOLERANCE:
        return None

    # Where a derivative exists, the error of central differences falls ninefold with a third of the step:
    # the trajectory is strongly curved, but smooth.
    medium = np.maximum(longer / 3.0, 1.5) * SENSITIVITY_STEP
    between = plant.derivatives.sensitivity(theta, trajectory, medium)
    if between is not None:
        smaller = disagreement(G, noise.whiten(between.G))[:, visible]
        if (smaller.max(axis=0) * CURVED <= error.max(axis=0)).all():
            return None

    first = int(np.argmax(error[:, worst] > DISAGREEMENT_TOLERANCE))
    near = range(max(first - 2, 0), min(first + 1, trajectory.samples))
    causes = active_constraints(model, trajectory, near)
    return Roughness(
        error=float(error[:, worst].max()),
        parameter=names[visible[worst]],
        sample=first,
        time=float(trajectory.t[first]),
        causes=causes,
    )


def visible_columns(parameters: ParameterSet, G: Array) -> np.ndarray:
    """(p,) True where a parameter has an effect that stands out of round-off. G: (N+1, ny, p), whitened."""
    length = np.linalg.norm(G, axis=(0, 1)) * parameters.magnitude
    return np.asarray(
        (length > LEAST_EFFECT) & (length > LEAST_RELATIVE_EFFECT * length.max(initial=0.0))
    )
