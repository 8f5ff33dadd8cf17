"""Whitened residuals of simulated rows, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.identification.segment_simulation import SegmentRows, SegmentSimulation
from mjfim.optimize.robust_losses import RobustLoss
from mjfim.plant.noise import Noise


@dataclass(frozen=True, kw_only=True, eq=False)
class LinearisedRows:
    """The values of some rows that count, row by row.

    Attributes:
        row: (n,) place of the row of every value among the simulated rows.
        r: (n,) whitened residuals [standard deviations].
        J: (n, n_private + c) derivatives by the private, then by the common unknowns.
    """

    row: np.ndarray
    r: Array
    J: Array

    def weighted(self, loss: RobustLoss) -> Array:
        """(n, m) rows `[J_private, J_common, r]`, each with the weight that linearises a loss.

        Their squares are those of iteratively reweighted least squares.

        Args:
            loss: The loss of a whitened residual.
        """
        return np.column_stack([self.J, self.r]) * loss.weight(self.r)[:, None]


@dataclass(frozen=True, kw_only=True, eq=False)
class WhitenedRows:
    """Comparison of simulated rows with the measured values that count.

    Attributes:
        problem: Simulation of the segments.
        masks: (M, ny) for every recording, True for the measured values that count.
        noise: Noise of the outputs.
    """

    problem: SegmentSimulation
    masks: tuple[np.ndarray, ...]
    noise: Noise

    def residual(self, rows: SegmentRows) -> Array:
        """Whitened residuals of some rows.

        Args:
            rows: Predictions.

        Returns:
            (n,) residuals of the values that count, row by row [standard deviations].
        """
        mask = self._mask_of(rows)
        segment = self.problem.segments[rows.segment]
        measured = self.problem.recordings[segment.recording].y[rows.rows]

        # Values that do not count may be NaN.
        residual = np.where(mask, rows.y - measured, 0.0)
        return self.noise.whiten_present(residual, mask)

    def linearised(self, rows: SegmentRows) -> LinearisedRows:
        """Whitened residuals of some rows and their derivatives by the unknowns.

        Args:
            rows: Predictions with derivatives.
        """
        mask = self._mask_of(rows)
        segment = self.problem.segments[rows.segment]
        common, private = rows.jacobians
        columns = self.problem.layout.to_columns(common, segment.recording)
        G = np.concatenate([private, columns], axis=2)

        return LinearisedRows(
            row=np.broadcast_to(np.arange(len(mask))[:, None], mask.shape)[mask],
            r=self.residual(rows),
            J=self.noise.whiten_present(G, mask),
        )

    def sensitivity(self, rows: SegmentRows) -> Array:
        """Whitened derivatives, by the initial state where that is free, then by theta.

        Args:
            rows: Predictions with derivatives.

        Returns:
            (k, n+p) derivatives of the values that count.
        """
        common, private = rows.jacobians
        G = common
        if self.problem.layout.free_starts:
            G = np.concatenate([private, common], axis=2)
        return self.noise.whiten_present(G, self._mask_of(rows))

    def _mask_of(self, rows: SegmentRows) -> np.ndarray:
        """(k, ny) True for the values of k rows that count."""
        recording = self.problem.segments[rows.segment].recording
        return np.asarray(self.masks[recording][rows.rows])
