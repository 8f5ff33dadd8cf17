"""Condensed rows of the whitened sensitivity of recordings by theta."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import zip_longest

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.identification.fit_problem import BatchWork, FitProblem
from mjfim.identification.segment_simulation import SegmentBatch, SegmentRows
from mjfim.information.null_space import COARSER_STEP_FACTOR
from mjfim.optimize.condensed_least_squares import triangle
from mjfim.optimize.levenberg_marquardt import UnknownValues
from mjfim.plant.plant import SENSITIVITY_STEP


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
    work: BatchWork[dict[int, Array]] = partial(_of_batch, with_error=with_error)
    batches = list(
        problem.batches(derivatives=True, central=with_error, step=SENSITIVITY_STEP, wanted=wanted)
    )
    condensed: dict[int, Array] = {}
    for batch, of_batch in zip(batches, problem.of_batches(work, batches, at), strict=True):
        if of_batch is None:
            recordings = {problem.segments[segment].recording for segment in batch.segments}
            names = [problem.recordings[index].name for index in sorted(recordings)]
            raise SimulationDivergedError(
                f"{' or '.join(names)}: the simulation diverges under the recorded control"
            )
        condensed.update(of_batch)
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


def _of_batch(
    problem: FitProblem, at: UnknownValues, batch: SegmentBatch, *, with_error: bool
) -> dict[int, Array] | None:
    """Condense the whitened sensitivity of a batch, and its change with a longer step.

    Returns:
        (k, 2 (n+p)) triangle of each segment by its index; None where a perturbed simulation
        diverges. Changes are zero without an error.
    """
    fine = problem.rows_of_batch(at, batch)
    coarse: Iterator[SegmentRows | None] = iter(())
    if with_error:
        coarse = problem.rows_of_batch(at, replace(batch, step=COARSER_STEP_FACTOR * batch.step))

    def sensitivity(rows: SegmentRows) -> Array:
        """(k, n+p) derivatives by the initial state where that is free, then by theta."""
        common, private = rows.jacobians
        both = [private, common] if problem.layout.free_starts else [common]
        G = np.concatenate(both, axis=2)
        return problem.noise.whiten_present(G, problem.mask_of(rows))

    condensed: dict[int, Array] = {}
    for rows, coarse_rows in zip_longest(fine, coarse):
        if rows is None:
            return None

        # Without a simulation with the longer step, the change is unknown.
        J = sensitivity(rows)
        change = np.zeros_like(J)
        if coarse_rows is not None:
            change = sensitivity(coarse_rows) - J

        both = np.concatenate([J, change], axis=1)
        earlier = condensed.get(rows.segment, both[:0])
        condensed[rows.segment] = triangle(np.concatenate([earlier, both]))
    return condensed
