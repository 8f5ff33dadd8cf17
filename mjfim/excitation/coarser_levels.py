"""Coarse levels of a descent under hard limits, with longer timesteps and longer samples."""

from __future__ import annotations

from dataclasses import replace

from mjfim.errors import ExperimentError, SimulationDivergedError
from mjfim.excitation.levels import (
    MAX_CONSTRAINED_COARSE_CHANGE,
    MIN_COARSE_SAMPLES,
    TIMESTEP_FACTORS,
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
    has_one_step = _longest_timestep(task) == 1
    first = _first_point(fine)
    if task.experiment.descent.coarse != "auto" or not has_one_step or first is None:
        return ()

    variants = [replace(_smooth(task), sample_factor=factor) for factor in _factors(task)]
    levels = [_similar_level(fine, first, variant) for variant in variants]
    return tuple(level for level in levels if level is not None)


def quickest_level(fine: DescentLevel) -> DescentLevel | None:
    """Make the coarsest level, for a first look at other optima.

    Args:
        fine: The stated level, on the plant without clamps.

    Returns:
        The level with the longest timestep and the longest samples with which the initial control
        costs nearly as much; None without one, or with a stated `descent.coarse`.
    """
    task = fine.task
    first = _first_point(fine)
    if task.experiment.descent.coarse != "auto" or first is None:
        return None

    longest = replace(_smooth(task), timestep_factor=_longest_timestep(task))
    for factor in _factors(task):
        level = _similar_level(fine, first, replace(longest, sample_factor=factor))
        if level is not None:
            return level
    return None


def _longest_timestep(task: DesignTask) -> int:
    """Largest factor of the timestep that divides the engine steps of a sample; 1 without one."""
    substeps = task.system.grid.substeps
    return next((factor for factor in TIMESTEP_FACTORS if substeps % factor == 0), 1)


def _factors(task: DesignTask) -> list[int]:
    """Factors of the samples that divide the horizon and leave enough samples."""
    N = task.samples
    return [k for k in SAMPLE_FACTORS if N % k == 0 and MIN_COARSE_SAMPLES * k <= N]


def _smooth(task: DesignTask) -> ModelVariant:
    """The variant of a task, with dry friction that is smooth in the motion as well."""
    stated = task.system.variant
    return replace(stated, smoothed=bool(stated.smoothing_speeds))


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
