"""Several coarse levels of a descent under hard limits, with longer and longer samples."""

from __future__ import annotations

from dataclasses import replace

from mjfim.errors import ExperimentError, SimulationDivergedError
from mjfim.excitation.levels import (
    MAX_CONSTRAINED_COARSE_CHANGE,
    MIN_COARSE_SAMPLES,
    DescentLevel,
    has_similar_cost,
)
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.task import DesignTask
from mjfim.model.variants import ModelVariant

# Factors by which the samples of the levels are longer, the coarsest level first. The timestep
# becomes longer by the same factor.
SAMPLE_FACTORS = (8, 4, 2)


def coarser_levels(fine: DescentLevel) -> tuple[DescentLevel, ...]:
    """Make several coarser levels where each sample is one engine step.

    With more engine steps in a sample, one level with a longer timestep is enough (`easier_level`).

    Args:
        fine: The stated level, on the plant without clamps.

    Returns:
        The levels on which the initial control costs nearly as much, the coarsest first; none with
        a stated `descent.coarse`.
    """
    task = fine.task
    if task.experiment.descent.coarse != "auto" or task.system.grid.substeps > 1:
        return ()

    first = _first_point(fine)
    if first is None:
        return ()

    # Dry friction is smooth in the motion as well.
    stated = task.system.variant
    smooth = replace(stated, smoothed=bool(stated.smoothing_speeds))
    variants = [replace(smooth, sample_factor=factor) for factor in _factors(task)]
    levels = [_similar_level(fine, first, variant) for variant in variants]
    return tuple(level for level in levels if level is not None)


def _factors(task: DesignTask) -> list[int]:
    """Factors of the samples that divide the horizon and leave enough samples."""
    N = task.samples
    return [k for k in SAMPLE_FACTORS if N % k == 0 and MIN_COARSE_SAMPLES * k <= N]


def _first_point(fine: DescentLevel) -> DesignPoint | None:
    """The initial control on the stated level; None where the simulation diverges."""
    try:
        return fine.problem.point(fine.task.initial)
    except SimulationDivergedError:
        return None


def _similar_level(
    fine: DescentLevel, first: DesignPoint, variant: ModelVariant
) -> DescentLevel | None:
    """A level on a variant of the plant; None where the initial control costs much else there."""
    try:
        level = DescentLevel(fine.task.with_variant(variant), fine.basis)
    except ExperimentError:
        return None

    size = fine.problem.size(first)
    return level if has_similar_cost(level, first, size, MAX_CONSTRAINED_COARSE_CHANGE) else None
