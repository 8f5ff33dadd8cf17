"""Several coarse levels of a descent under hard limits, with longer and longer samples."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from mjfim.excitation.levels import MIN_COARSE_SAMPLES, DescentLevel, first_point, similar_level
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.task import DesignTask

# Factors by which the samples of the levels are longer, the coarsest level first. The timestep
# becomes longer by the same factor.
SAMPLE_FACTORS = (8, 4, 2)


def coarser_levels(
    fine: DescentLevel, evaluated: DesignPoint | None = None
) -> tuple[DescentLevel, ...]:
    """Make several coarser levels where each sample is one engine step.

    With more engine steps in a sample, one level with a longer timestep is enough (`easier_level`).

    Args:
        fine: The stated level, on the plant without clamps.
        evaluated: The initial control on the unmodified plant; None where it is not known.

    Returns:
        The levels on which the initial control costs nearly as much, the coarsest first; none with
        a stated `descent.coarse`.
    """
    task = fine.task
    if task.experiment.descent.coarse != "auto" or task.system.grid.substeps > 1:
        return ()

    first = first_point(fine, evaluated)
    if first is None:
        return ()

    # Dry friction is smooth in the motion as well.
    stated = task.system.variant
    smooth = replace(stated, smoothed=bool(stated.smoothing_speeds))
    variants = [replace(smooth, sample_factor=factor) for factor in _factors(task)]
    levels = [similar_level(fine, first, partial(task.with_variant, each)) for each in variants]
    return tuple(level for level in levels if level is not None)


def _factors(task: DesignTask) -> list[int]:
    """Factors of the samples that divide the horizon and leave enough samples."""
    N = task.samples
    return [k for k in SAMPLE_FACTORS if N % k == 0 and MIN_COARSE_SAMPLES * k <= N]
