"""Rows of score tests: the linearisation of a problem beside columns of further parameters.

Further parameters belong to an extended model, which contains the stated one. Their score needs the
residuals and the columns of the stated model at its solution, which are the same for all further
parameters. They are simulated once, and every extended model only by its own parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.segment_simulation import SegmentBatch
from mjfim.optimize.condensed_least_squares import Condensed, triangle
from mjfim.optimize.levenberg_marquardt import UnknownValues


@dataclass(frozen=True, kw_only=True, eq=False)
class WeightedRows:
    """The values of one segment that count, row by row.

    Attributes:
        rows: (n, m) whitened rows `[J_private, J_common, r]`, weighted by the loss.
        weight: (n,) their weights.
    """

    rows: Array
    weight: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class ScoreRows:
    """Linearisation of a stated problem at its solution, row by row.

    Attributes:
        problem: The problem.
        at: Its solution.
        segments: The rows of every segment that has some, by its index.
    """

    problem: FitProblem
    at: UnknownValues
    segments: Mapping[int, WeightedRows]

    @classmethod
    def of(cls, problem: FitProblem, at: UnknownValues) -> ScoreRows | None:
        """Linearise a problem at its solution.

        Args:
            problem: The problem, of so few data that all rows fit into memory.
            at: Its solution.

        Returns:
            The rows; None where a perturbed simulation diverges.
        """
        segments: dict[int, WeightedRows] = {}
        batches = problem.batches(derivatives=True)
        for found in problem.of_batches(weighted_rows_of_batch, batches, at):
            if found is None:
                return None
            segments.update(found)
        return cls(problem=problem, at=at, segments=segments)

    def beside(
        self, extended: FitProblem, begin: UnknownValues, further: Sequence[int]
    ) -> Condensed | None:
        """Condense these rows with the columns of further parameters.

        Args:
            extended: The problem of the extended model, with the same segments and measured values.
            begin: Its unknowns at the solution of the stated problem.
            further: (k,) indices of the further parameters in theta of the extended model, which
                all recordings share.

        Returns:
            Rows `[J_private, J_common, J_further, r]`; None where a perturbed simulation diverges.
        """
        columns = self._columns(extended, begin, further)
        if columns is None:
            return None

        m = self.problem.simulation.private_count + self.problem.layout.column_count + 1
        m += len(further)
        blocks = np.zeros((len(self.problem.segments), m, m))
        for segment, found in self.segments.items():
            weighted = columns[segment] * found.weight[:, None]
            rows = _inserted(found.rows, weighted)

            # A segment may have fewer values than columns; rows of zeros complete its triangle.
            blocks[segment] = triangle(np.concatenate([np.zeros((m, m)), rows]))

        private = self.problem.prior_rows.private(self.at)
        common = self.problem.prior_rows.common(self.at)
        return Condensed(
            blocks=blocks,
            segment_of_block=np.arange(len(blocks)),
            private_rows=_inserted(private, np.zeros((*private.shape[:-1], len(further)))),
            common_rows=_inserted(common, np.zeros((len(common), len(further)))),
        )

    def _columns(
        self, extended: FitProblem, begin: UnknownValues, further: Sequence[int]
    ) -> dict[int, Array] | None:
        """(n, k) whitened columns of the further parameters by segment; None for divergence."""
        wanted = np.zeros(len(extended.system.parameters), dtype=bool)
        wanted[list(further)] = True

        # The initial states are those of the solution: their columns are known.
        known, begin = extended.from_known_states(begin)
        batches = known.batches(derivatives=True, wanted=wanted, central=self._is_central(further))

        parts: dict[int, list[Array]] = {}
        for found in known.of_batches(sensitivities_of_batch, batches, begin):
            if found is None:
                return None
            for segment, sensitivity in found:
                parts.setdefault(segment, []).append(sensitivity[:, list(further)])
        return {segment: np.concatenate(each) for segment, each in parts.items()}

    def _is_central(self, further: Sequence[int]) -> bool:
        """Whether differences are two-sided, as for a problem with all columns."""
        if self.problem.central is not None:
            return self.problem.central
        simulation = self.problem.simulation
        stated = int(simulation.layout.estimated.sum()) + simulation.private_count
        return simulation.affords_two_sided(stated + len(further))


def weighted_rows_of_batch(
    problem: FitProblem, at: UnknownValues, batch: SegmentBatch
) -> dict[int, WeightedRows] | None:
    """Linearise the segments of a batch, row by row.

    Args:
        problem: The problem.
        at: The unknowns.
        batch: The batch, with derivatives.

    Returns:
        The rows of every segment by its index; None where a perturbed simulation diverges.
    """
    parts: dict[int, list[tuple[Array, Array]]] = {}
    for rows in problem.simulation.rows_of_batch(at, batch):
        if rows is None:
            return None
        linearised = problem.whitened.linearised(rows)
        weight = problem.loss.weight(linearised.r)
        values = np.column_stack([linearised.J, linearised.r])
        parts.setdefault(rows.segment, []).append((values * weight[:, None], weight))
    return {
        segment: WeightedRows(
            rows=np.concatenate([rows for rows, _ in each]),
            weight=np.concatenate([weight for _, weight in each]),
        )
        for segment, each in parts.items()
    }


def sensitivities_of_batch(
    problem: FitProblem, at: UnknownValues, batch: SegmentBatch
) -> list[tuple[int, Array]] | None:
    """Whitened derivatives by theta of a batch whose initial states are known.

    Args:
        problem: The problem.
        at: The unknowns.
        batch: The batch, with derivatives.

    Returns:
        Index of a segment and (n, p) derivatives of some of its values that count, in their order;
        None where a perturbed simulation diverges.
    """
    found = []
    for rows in problem.simulation.rows_of_batch(at, batch):
        if rows is None:
            return None
        found.append((rows.segment, problem.whitened.sensitivity(rows)))
    return found


def _inserted(rows: Array, columns: Array) -> Array:
    """Rows `[J, r]` with further columns before the last one."""
    return np.concatenate([rows[..., :-1], columns, rows[..., -1:]], axis=-1)
