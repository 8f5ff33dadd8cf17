"""Condensed rows of the whitened sensitivity of recordings by theta."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from itertools import zip_longest

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.identification.fit_problem import BatchWork, FitProblem
from mjfim.identification.segment_simulation import SegmentBatch, SegmentRows
from mjfim.information.null_space import COARSER_STEP_FACTOR
from mjfim.optimize.condensed_least_squares import triangle
from mjfim.optimize.levenberg_marquardt import UnknownValues
from mjfim.plant.derivatives import SENSITIVITY_STEP


def sensitivity_rows(
    problem: FitProblem,
    at: UnknownValues,
    *,
    with_error: bool = True,
    wanted: np.ndarray | None = None,
) -> list[tuple[Array, Array]]:
    """Condensed rows of the whitened sensitivity G, and their change with a longer step.

    The longer difference step shows the error of the differences. Where the whole initial state is
    free, rows are projected onto the complement of its derivatives.

    Args:
        problem: The problem.
        at: The unknowns.
        with_error: False for changes of zero and one-sided differences, at a quarter of the cost.
        wanted: (p,) True for the parameters whose columns are wanted; default: all of them.

    Returns:
        (k, p) rows and (k, p) changes of every segment [standard deviations / theta-unit], k at
        most 2p + 2n.

    Raises:
        SimulationDivergedError: A perturbed simulation diverges.
    """
    if wanted is None:
        wanted = np.ones(len(problem.system.parameters), dtype=bool)
    condensed = _condensed_sensitivity(problem, at, with_error, wanted)
    n = problem.private_count if problem.layout.free_starts else 0

    found = []
    for segment in sorted(condensed):
        J, change = np.split(condensed[segment], 2, axis=1)
        by_theta = J[:, n:]
        change_by_theta = change[:, n:]

        # A free initial state explains everything in the span of its derivatives.
        Q = np.linalg.qr(J[:, :n])[0]
        remaining = by_theta - Q @ (Q.T @ by_theta)
        remaining_change = change_by_theta - Q @ (Q.T @ change_by_theta)
        found.append((remaining, remaining_change))
    return found


def _condensed_sensitivity(
    problem: FitProblem, at: UnknownValues, with_error: bool, wanted: np.ndarray
) -> dict[int, Array]:
    """Triangle of the whitened sensitivity and its change with a longer step, by segment.

    Its (k, 2 (n+p)) rows hold the derivatives and, next to them, their changes.
    """
    work: BatchWork[dict[int, Array]] = sensitivities_without_error
    if with_error:
        work = sensitivities_of_batch
    batches = list(
        problem.batches(derivatives=True, central=with_error, step=SENSITIVITY_STEP, wanted=wanted)
    )
    condensed: dict[int, Array] = {}
    results = problem.of_batches(work, batches, at)
    for batch, found in zip(batches, results, strict=True):
        if found is None:
            raise SimulationDivergedError(
                f"{_names(problem, batch)}: the simulation diverges under the recorded control"
            )
        condensed.update(found)
    return condensed


def _names(problem: FitProblem, batch: SegmentBatch) -> str:
    """Names of the recordings of a batch, one of which diverges."""
    recordings = {problem.segments[segment].recording for segment in batch.segments}
    return " or ".join(problem.recordings[index].name for index in sorted(recordings))


def sensitivities_of_batch(
    problem: FitProblem, at: UnknownValues, batch: SegmentBatch
) -> dict[int, Array] | None:
    """Condense the whitened sensitivity of a batch, and its change with a longer step.

    Args:
        problem: The problem.
        at: The unknowns.
        batch: The batch, with derivatives.

    Returns:
        (k, 2 (n+p)) triangle of each segment by its index; None where a perturbed simulation
        diverges.
    """
    longer = replace(batch, step=COARSER_STEP_FACTOR * batch.step)
    coarse = problem.rows_of_batch(at, longer)
    return _condensed_batch(problem, problem.rows_of_batch(at, batch), coarse)


def sensitivities_without_error(
    problem: FitProblem, at: UnknownValues, batch: SegmentBatch
) -> dict[int, Array] | None:
    """Condense the whitened sensitivity of a batch. See `sensitivities_of_batch`.

    Its change with a longer step is not computed, and zero.
    """
    return _condensed_batch(problem, problem.rows_of_batch(at, batch), ())


def _condensed_batch(
    problem: FitProblem, fine: Iterable[SegmentRows | None], coarse: Iterable[SegmentRows | None]
) -> dict[int, Array] | None:
    """(k, 2 (n+p)) triangle of each segment by its index; None where a simulation diverges.

    Args:
        problem: The problem.
        fine: Simulated rows of a batch.
        coarse: Those with a longer step of the differences, as far as they were simulated.
    """
    condensed: dict[int, Array] = {}
    for rows, coarse_rows in zip_longest(fine, coarse):
        if rows is None:
            return None

        # Without a simulation with the longer step, the change is unknown.
        J = problem.whitened.sensitivity(rows)
        change = np.zeros_like(J)
        if coarse_rows is not None:
            change = problem.whitened.sensitivity(coarse_rows) - J

        both = np.concatenate([J, change], axis=1)
        earlier = condensed.get(rows.segment, both[:0])
        condensed[rows.segment] = triangle(np.concatenate([earlier, both]))
    return condensed
