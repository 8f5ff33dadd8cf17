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
from mjfim.identification.extended_problems import new_private_columns
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.segment_simulation import SegmentBatch
from mjfim.identification.whitened_rows import WeightedRows
from mjfim.optimize.condensed_least_squares import Condensed, triangle
from mjfim.optimize.levenberg_marquardt import UnknownValues


@dataclass(frozen=True, kw_only=True, eq=False)
class FurtherColumns:
    """Whitened columns of an extended model that the stated one does not have.

    Attributes:
        private: (n, q) derivatives by the q initial states of new coordinates, by segment.
        further: (n, k) derivatives by the k further parameters, by segment.
        private_rows: (P, q, q) rows of the weak priors on these initial states, whose residuals are
            zero.
    """

    private: Mapping[int, Array]
    further: Mapping[int, Array]
    private_rows: Array


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

    def condensed_with(
        self, extended: FitProblem, begin: UnknownValues, names: Sequence[str]
    ) -> Condensed | None:
        """Condense these rows with the columns of further parameters.

        Args:
            extended: The problem of the extended model, with the same segments and measured values.
            begin: Its unknowns at the solution of the stated problem.
            names: Names of the k further parameters, which all recordings share.

        Returns:
            One block of rows `[J_private, J_new, J_common, J_further, r]` for each of the P
            segments. Its private unknowns are the n of the stated problem and the q initial states
            of new coordinates; its common unknowns are the c of the stated problem and the further
            parameters. None where a perturbed simulation diverges.
        """
        columns = self._columns(extended, begin, names)
        if columns is None:
            return None

        n, P = self.problem.simulation.private_count, len(self.problem.segments)
        q, k = columns.private_rows.shape[1], len(names)
        m = n + q + self.problem.layout.column_count + k + 1
        blocks = np.zeros((P, m, m))
        for segment, found in self.segments.items():
            weight = found.weight[:, None]
            new, further = columns.private[segment], columns.further[segment]
            rows = _completed(found.rows, n, weight * new, weight * further)

            # A segment may have fewer values than columns; rows of zeros complete its triangle.
            blocks[segment] = triangle(np.concatenate([np.zeros((m, m)), rows]))

        # Priors of the stated unknowns, and weak ones on the initial states of new coordinates.
        private = self.problem.prior_rows.private(self.at)
        common = self.problem.prior_rows.common(self.at)
        known = _completed(private, n, _zeros(private, q), _zeros(private, k))
        weak = np.zeros((P, q, m))
        weak[:, :, n : n + q] = columns.private_rows
        return Condensed(
            blocks=blocks,
            segment_of_block=np.arange(P),
            private_rows=np.concatenate([known, weak], axis=1),
            common_rows=_completed(common, 0, _zeros(common, 0), _zeros(common, k)),
        )

    def _columns(
        self, extended: FitProblem, begin: UnknownValues, names: Sequence[str]
    ) -> FurtherColumns | None:
        """Columns of further parameters and of new coordinates; None where it diverges."""
        all_names = extended.system.parameters.names
        wanted = np.isin(all_names, list(names))
        places = [all_names.index(name) for name in names]

        # The other initial states are those of the solution, whose columns are known.
        new = new_private_columns(self.problem, extended)
        known, begin = extended.from_known_states(begin, new)
        batches = known.batches(
            derivatives=True, wanted=wanted, central=self._is_two_sided(len(new) + len(names))
        )

        parts: dict[int, list[Array]] = {}
        for found in known.of_batches(sensitivity_of_batch, batches, begin):
            if found is None:
                return None
            for segment, sensitivity in found:
                parts.setdefault(segment, []).append(sensitivity)

        q = len(new)
        whole = {segment: np.concatenate(each) for segment, each in parts.items()}
        return FurtherColumns(
            private={segment: each[:, :q] for segment, each in whole.items()},
            further={segment: each[:, q:][:, places] for segment, each in whole.items()},
            private_rows=known.prior_rows.private(begin)[:, :q, :q],
        )

    def _is_two_sided(self, further: int) -> bool:
        """Whether differences by further directions are two-sided.

        With much data they are one-sided, as in a linearisation by all parameters at once.
        """
        if self.problem.central is not None:
            return self.problem.central
        simulation = self.problem.simulation
        stated = int(simulation.layout.estimated.sum()) + simulation.private_count
        return simulation.affords_two_sided(stated + further)


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
    parts: dict[int, list[WeightedRows]] = {}
    for rows in problem.simulation.rows_of_batch(at, batch):
        if rows is None:
            return None
        weighted = problem.whitened.linearised(rows).weighted(problem.loss)
        parts.setdefault(rows.segment, []).append(weighted)
    return {
        segment: WeightedRows(
            rows=np.concatenate([part.rows for part in each]),
            weight=np.concatenate([part.weight for part in each]),
        )
        for segment, each in parts.items()
    }


def sensitivity_of_batch(
    problem: FitProblem, at: UnknownValues, batch: SegmentBatch
) -> list[tuple[int, Array]] | None:
    """Whitened derivatives of a batch, by the private unknowns and by theta.

    Args:
        problem: The problem.
        at: The unknowns.
        batch: The batch, with derivatives.

    Returns:
        Index of a segment and (n, q + p) derivatives of some of its values that count, in their
        order; None where a perturbed simulation diverges.
    """
    found = []
    for rows in problem.simulation.rows_of_batch(at, batch):
        if rows is None:
            return None
        found.append((rows.segment, problem.whitened.sensitivity(rows)))
    return found


def _completed(rows: Array, private: int, new: Array, further: Array) -> Array:
    """Rows with columns after the first ones, and with further columns before the last one.

    Args:
        rows: (..., private + c + 1) rows `[J_private, J_common, r]`.
        private: Number of the first columns.
        new: (..., q) columns that follow them.
        further: (..., k) columns before the last one.
    """
    first, middle, last = rows[..., :private], rows[..., private:-1], rows[..., -1:]
    return np.concatenate([first, new, middle, further, last], axis=-1)


def _zeros(rows: Array, count: int) -> Array:
    """(..., count) columns of zeros beside some rows."""
    return np.zeros((*rows.shape[:-1], count))
