"""Where derivatives do not exist: contacts, dry friction, limits and clamps make two difference steps disagree."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.experiment.system import Setup
from mjfim.information.null_space import BLIND, FAINT
from mjfim.plant.active_constraints import active_constraints
from mjfim.plant.derivatives import SENSITIVITY_STEP
from mjfim.records.check import Roughness
from mjfim.records.trajectory import Sensitivity, Trajectory

LONGER = 300.0  # the second step, times the first: a change of 0.3 %
LEAST = 3.0  # the same for parameters so weak that the first step is long already
TOLERANCE = 1e-2  # relative disagreement that is told
CURVED = 6.0  # by how much the disagreement at least falls with a third of the step where a derivative exists
MINOR = 1e-3  # of the largest effect of a parameter; an output that shows less of it tells nothing


def disagreement(fine: Array, coarse: Array) -> Array:
    """(N+1, p) relative disagreement of two derivatives G: (N+1, ny, p), each output's against its own largest value."""
    size = np.maximum(np.abs(fine).max(axis=0), np.abs(coarse).max(axis=0))
    size = np.maximum(size, MINOR * size.max(axis=0, initial=0.0))
    return np.asarray((np.abs(fine - coarse) / np.where(size > 0.0, size, 1.0)).max(axis=1))


def roughness(
    setup: Setup, theta: Array, trajectory: Trajectory, fine: Sensitivity | None = None
) -> Roughness | None:
    """The worst disagreement along a trajectory, or None where it is below `TOLERANCE`. fine: by the first step, if known"""
    plant = setup.plant
    fine = plant.derivatives.sensitivity(theta, trajectory) if fine is None else fine
    longer = np.maximum(
        LONGER * setup.parameters.magnitude / plant.derivatives.parameter_scale, LEAST
    )
    coarse = plant.derivatives.sensitivity(theta, trajectory, longer * SENSITIVITY_STEP)
    names = setup.parameters.names
    if fine is None or coarse is None:
        causes = active_constraints(setup.model_at(theta), trajectory, range(trajectory.samples))
        return Roughness(
            error=np.inf, parameter=", ".join(names), sample=0, time=0.0, causes=causes
        )
    G = setup.noise.whiten(fine.G)
    kept = np.flatnonzero(visible_columns(setup, G))
    if not len(kept):
        return None
    error = disagreement(G, setup.noise.whiten(coarse.G))[:, kept]
    worst = int(np.argmax(error.max(axis=0)))
    if not error[:, worst].max() > TOLERANCE:
        return None
    between = plant.derivatives.sensitivity(
        theta, trajectory, np.maximum(longer / 3.0, 1.5) * SENSITIVITY_STEP
    )
    if between is not None:
        less = disagreement(G, setup.noise.whiten(between.G))[:, kept]
        if (less.max(axis=0) * CURVED <= error.max(axis=0)).all():
            return (
                None  # the error of central differences falls ninefold: strongly curved, but smooth
            )
    first = int(np.argmax(error[:, worst] > TOLERANCE))
    near = range(max(first - 2, 0), min(first + 1, trajectory.samples))
    causes = active_constraints(setup.model_at(theta), trajectory, near)
    return Roughness(
        error=float(error[:, worst].max()),
        parameter=names[kept[worst]],
        sample=first,
        time=float(trajectory.t[first]),
        causes=causes,
    )


def visible_columns(setup: Setup, G: Array) -> np.ndarray:
    """(p,) True where a parameter has an effect that stands out of round-off. G: (N+1, ny, p), whitened"""
    length = np.linalg.norm(G, axis=(0, 1)) * setup.parameters.magnitude
    return np.asarray((length > BLIND) & (length > FAINT * length.max(initial=0.0)))
