"""Rows of priors and pins, which stand beside those of the recordings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mjfim.arrays import Array
from mjfim.identification.cad_prior import CadPrior
from mjfim.identification.pins import Pins
from mjfim.identification.unknowns import UnknownLayout
from mjfim.optimize.levenberg_marquardt import UnknownValues

# Standard deviation of the prior on a free initial state, relative to the natural sizes of the
# state. This weak prior keeps components finite that no output determines.
FREE_START_SIGMA = 1e3


@dataclass(frozen=True, kw_only=True, eq=False)
class PriorRows:
    """Rows of priors and pins on the unknowns of a simulation.

    Attributes:
        layout: Layout of the unknowns.
        segment_count: Number of segments.
        start_sizes: (n,) natural sizes of the private unknowns of a segment.
        pins: Combinations that no recording determines, and their values.
        with_priors: Whether priors of the parameters count.
    """

    layout: UnknownLayout
    segment_count: int
    start_sizes: Array
    pins: Pins
    with_priors: bool

    def common(self, at: UnknownValues) -> Array:
        """Rows on the common unknowns.

        Args:
            at: The unknowns.

        Returns:
            (l, c+1) rows `[J, r]`.
        """
        layout = self.layout
        rows = np.zeros((0, layout.column_count + 1))
        if self.with_priors:
            rows = self.of_parameters(at)
        if self._pins_involve_private:
            return rows

        residual = self.pins.residual(layout.theta(at))
        columns = layout.to_columns(self.pins.rows, 0)
        return np.concatenate([rows, np.column_stack([columns, residual])])

    def of_parameters(self, at: UnknownValues) -> Array:
        """Rows of the priors on the common unknowns, without pins.

        Args:
            at: The unknowns.

        Returns:
            (l, c+1) rows `[J, r]`: the stated priors, then those from the model's inertias.
        """
        layout = self.layout
        rows = [layout.prior_rows(at)]
        is_own = np.zeros(len(layout.parameters), dtype=bool)
        is_own[layout.per_recording] = True

        # An inertia with a value for each recording has a prior in each of them.
        rows.append(self._cad_rows(self._cad.of_bodies(~is_own), at, 0))
        own = self._cad.of_bodies(is_own)
        rows += [self._cad_rows(own, at, k) for k in range(layout.recordings) if own.bodies]
        return np.concatenate(rows)

    def along_step(self, at: UnknownValues, common: Array) -> Array | None:
        """Rows on the common unknowns at the end of a step of them, with derivatives by that step.

        Inertias move along straight lines of their barycentric coordinates (`UnknownLayout.moved`).

        Args:
            at: Unknowns at the begin of the step.
            common: (c,) the step.

        Returns:
            (l, c+1) rows `[J, r]`; None where a body is not physical at the end.
        """
        layout = self.layout
        theta = np.array(at.theta)
        own = np.array(at.per_recording)
        count = len(layout.shared)
        theta[layout.shared] += common[:count]
        own += common[count:].reshape(own.shape)

        follows = np.eye(len(theta))
        for body in layout.shared_bodies:
            begin = at.theta[body.columns]
            step = theta[body.columns] - begin
            if not body.is_physical_after(begin, step):
                return None
            theta[body.columns] = body.moved(begin, step)

            # Without a way through barycentric coordinates, from which those of a body that is
            # nearly a rod cannot always be found.
            at_end, at_begin = body.linear_slopes(theta[body.columns]), body.linear_slopes(begin)
            follows[np.ix_(body.columns, body.columns)] = np.linalg.solve(at_end.T, at_begin.T)

        end = replace(at, theta=theta, per_recording=own)
        rows = self.common(end)
        shared = np.ix_(layout.shared, layout.shared)
        rows[:, :count] = rows[:, :count] @ follows[shared]
        return rows

    def _cad_rows(self, prior: CadPrior, at: UnknownValues, recording: int) -> Array:
        """(l, c+1) rows of the priors on inertias, with the values of one recording."""
        layout = self.layout
        found = prior.rows(layout.theta_of_recording(at, recording))
        columns = layout.to_columns(found[:, :-1], recording)
        return np.column_stack([columns, found[:, -1]])

    @cached_property
    def _cad(self) -> CadPrior:
        """Priors from the model's inertias."""
        return CadPrior.of(self.layout.parameters)

    def private(self, at: UnknownValues) -> Array:
        """Rows on the private unknowns of every segment.

        Args:
            at: The unknowns.

        Returns:
            (P, k, m) rows `[J_private, J_common, r]`.
        """
        layout, count = self.layout, self.segment_count
        n = len(self.start_sizes)
        m = n + layout.column_count + 1
        diagonal = np.arange(n)

        # A weak prior on a free initial state, for components that no output determines.
        if layout.free_starts:
            rows = np.zeros((count, n, m))
            sigma = FREE_START_SIGMA * self.start_sizes
            rows[:, diagonal, diagonal] = 1.0 / sigma
            rows[:, :, -1] = at.private / sigma
            return rows
        if not n:
            return np.zeros((count, 0, m))

        # Stated priors on the deviations of the initial state.
        parameters, private = layout.parameters, layout.private
        weight = parameters.prior_weight[private] * self.with_priors
        pin_count = len(self.pins.rows) if self._pins_involve_private else 0
        rows = np.zeros((count, n + pin_count, m))
        rows[:, diagonal, diagonal] = weight
        rows[:, :n, -1] = weight * (at.private - parameters.guess[private])

        # Pins that involve private unknowns belong to the first segment.
        if pin_count:
            rows[0, n:, :n] = self.pins.rows[:, private]
            rows[0, n:, n:-1] = layout.to_columns(self.pins.rows, 0)
            rows[0, n:, -1] = self.pins.residual(layout.theta(at))
        return rows

    @cached_property
    def _pins_involve_private(self) -> bool:
        """True where pins involve private unknowns."""
        return bool(self.pins.rows[:, self.layout.private].any())
