"""Layout of the unknowns of a fit: shared by recordings, per recording, or private to segments.

The common columns of a linearisation are the parameters that all recordings share, then those of
the first recording, then those of the second, and so on. Deviations of initial states are private
unknowns of the segments.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mjfim.arrays import Array
from mjfim.identification.linear_coordinates import CadPrior, UnknownBody, unknown_bodies
from mjfim.information.null_space import NullSpace
from mjfim.model.parameters import ParameterSet
from mjfim.optimize.condensed_least_squares import Step
from mjfim.optimize.levenberg_marquardt import UnknownValues


@dataclass(frozen=True, kw_only=True, eq=False)
class UnknownLayout:
    """Positions of the p parameters among the c = s + K e common and the n private unknowns.

    Attributes:
        parameters: The p parameters.
        shared: (s,) indices in theta of the parameters that all recordings share.
        per_recording: (e,) indices in theta of the parameters with a value for each recording.
        private: (n,) indices in theta of the nuisance deviations of the initial state.
        recordings: Number of recordings K.
        lower: (c,) lower bounds of the common unknowns [theta-unit].
        upper: (c,) upper bounds of the common unknowns [theta-unit].
        free_starts: True where the whole initial state of every segment is private, and theta holds
            none of it.
    """

    parameters: ParameterSet
    shared: np.ndarray
    per_recording: np.ndarray
    private: np.ndarray
    recordings: int
    lower: Array
    upper: Array
    free_starts: bool

    @staticmethod
    def of(
        parameters: ParameterSet,
        recordings: int,
        *,
        free_starts: bool,
        bounded: bool,
        held: Collection[str] = (),
    ) -> UnknownLayout:
        """The layout of the unknowns of a fit.

        Args:
            parameters: The parameters.
            recordings: Number of recordings.
            free_starts: Whether initial states are measured and then free.
            bounded: Whether the parameters have bounds.
            held: Names of parameters that are no unknowns.

        Returns:
            The layout.
        """
        is_per_recording = parameters.recording_specific & ~parameters.initial_deviations
        is_held = np.isin(parameters.names, list(held))
        shared = np.flatnonzero(~parameters.recording_specific & ~is_held)
        per_recording = np.flatnonzero(is_per_recording)

        columns = np.concatenate([shared, np.tile(per_recording, recordings)])
        layout = UnknownLayout(
            parameters=parameters,
            shared=shared,
            per_recording=per_recording,
            private=np.flatnonzero(parameters.initial_deviations),
            recordings=recordings,
            lower=parameters.lower[columns],
            upper=parameters.upper[columns],
            free_starts=free_starts,
        )
        return layout if bounded else layout.unbounded()

    def unbounded(self) -> UnknownLayout:
        """This layout without bounds."""
        infinite = np.full(self.column_count, np.inf)
        return replace(self, lower=-infinite, upper=infinite)

    def without_shared(self) -> UnknownLayout:
        """This layout with the shared parameters held, so that they have no columns."""
        count = len(self.shared)
        return replace(
            self, shared=self.shared[:0], lower=self.lower[count:], upper=self.upper[count:]
        )

    @property
    def column_count(self) -> int:
        """Number of common unknowns c."""
        return len(self.shared) + self.recordings * len(self.per_recording)

    @property
    def parameter_of_column(self) -> np.ndarray:
        """(c,) index in theta of every common column."""
        return np.concatenate([self.shared, np.tile(self.per_recording, self.recordings)])

    @property
    def first_columns(self) -> np.ndarray:
        """(s+e,) common columns of the shared parameters and of those of the first recording."""
        return np.arange(len(self.shared) + len(self.per_recording))

    @property
    def own_columns(self) -> np.ndarray:
        """(K, e) common columns of the unknowns that belong to each recording."""
        count = len(self.per_recording)
        columns = len(self.shared) + np.arange(self.recordings * count)
        return columns.reshape(self.recordings, count)

    @property
    def estimated(self) -> np.ndarray:
        """(p,) True for the parameters that have common columns."""
        mask = np.zeros(len(self.parameters), dtype=bool)
        mask[self.parameter_of_column] = True
        return mask

    def begin(self, theta: Array, segments: int, width: int) -> UnknownValues:
        """Unknowns at given parameters, with stated or measured initial states.

        Args:
            theta: (p,) parameter values.
            segments: Number of segments.
            width: Number of private unknowns of a segment.

        Returns:
            The unknowns.
        """
        theta = np.array(theta, dtype=np.float64)
        start = np.zeros(width) if self.free_starts else theta[self.private]
        return UnknownValues(
            theta=theta,
            private=np.tile(start, (segments, 1)),
            per_recording=np.tile(theta[self.per_recording], (self.recordings, 1)),
        )

    def common_values(self, at: UnknownValues) -> Array:
        """Values of the common unknowns.

        Args:
            at: The unknowns.

        Returns:
            (c,) values.
        """
        return np.concatenate([at.theta[self.shared], at.per_recording.ravel()])

    def moved(self, at: UnknownValues, step: Step, fraction: float) -> UnknownValues:
        """The unknowns after a fraction of a step.

        Common unknowns are clipped to the bounds, which rounding might exceed. Inertias of whole
        bodies move along straight lines of their barycentric coordinates. Where a body would not be
        physical there, all unknowns move a smaller fraction: what the bodies do together is then as
        the linearisation predicts.

        Args:
            at: The unknowns.
            step: Step of all unknowns.
            fraction: Fraction of the step.

        Returns:
            The moved unknowns.
        """
        count, bodies = len(self.shared), self.shared_bodies
        by_theta = np.zeros(len(at.theta))
        by_theta[self.shared] = fraction * step.common[:count]
        shares = [
            body.physical_share(at.theta[body.columns], by_theta[body.columns]) for body in bodies
        ]
        share = min(shares, default=1.0)
        fraction = share * fraction

        values = self.common_values(at) + fraction * step.common
        values = np.clip(values, self.lower, self.upper)
        theta = np.array(at.theta)
        theta[self.shared] = values[:count]
        for body in bodies:
            own = share * by_theta[body.columns]
            theta[body.columns] = body.moved(at.theta[body.columns], own)
        return UnknownValues(
            theta=theta,
            private=at.private + fraction * step.private,
            per_recording=values[count:].reshape(at.per_recording.shape),
        )

    @cached_property
    def shared_bodies(self) -> tuple[UnknownBody, ...]:
        """Bodies whose whole inertia is unknown, with one value in all recordings."""
        bodies = unknown_bodies(self.parameters)
        return tuple(body for body in bodies if np.isin(body.columns, self.shared).all())

    def theta_of_recording(self, at: UnknownValues, recording: int) -> Array:
        """Parameters of one recording.

        Deviations of the initial state are not filled in.

        Args:
            at: The unknowns.
            recording: Index of the recording.

        Returns:
            (p,) parameters [theta-unit].
        """
        theta = np.array(at.theta)
        theta[self.per_recording] = at.per_recording[recording]
        return theta

    def theta(self, at: UnknownValues) -> Array:
        """Parameters, with the values of the first recording and of its first segment.

        Args:
            at: The unknowns.

        Returns:
            (p,) parameters [theta-unit].
        """
        theta = self.theta_of_recording(at, 0)
        if not self.free_starts and len(self.private):
            theta[self.private] = at.private[0]
        return theta

    def to_columns(self, G: Array, recording: int) -> Array:
        """Derivatives of one recording by the common unknowns.

        Args:
            G: (..., p) derivatives by theta.
            recording: Index of the recording.

        Returns:
            (..., c) derivatives; zero by the unknowns of other recordings.
        """
        s = len(self.shared)
        e = len(self.per_recording)
        first = s + recording * e

        columns = np.zeros((*G.shape[:-1], self.column_count))
        columns[..., :s] = G[..., self.shared]
        columns[..., first : first + e] = G[..., self.per_recording]
        return columns

    def prior_rows(self, at: UnknownValues) -> Array:
        """Rows of prior knowledge on the common unknowns.

        Args:
            at: The unknowns.

        Returns:
            (l, c+1) rows `[J, r]`, with residuals in standard deviations of the prior.
        """
        index = self.parameter_of_column
        weight = self.parameters.prior_weight[index]

        deviation = self.common_values(at) - self.parameters.guess[index]
        rows = np.column_stack([np.diag(weight), weight * deviation])[weight > 0.0]

        # Parameters that an earlier estimate knows are shared by all recordings.
        earlier = self.parameters.earlier_rows
        if earlier is None:
            return np.asarray(rows)
        residual = earlier @ (self.theta_of_recording(at, 0) - self.parameters.guess)
        known = np.column_stack([self.to_columns(earlier, 0), residual])
        return np.concatenate([rows, known])


@dataclass(frozen=True, kw_only=True, eq=False)
class Pins:
    """Rows that hold combinations of parameters which no recording determines.

    Attributes:
        rows: (k, p) coefficients of the combinations, each over the magnitude of the parameter.
        theta: (p,) parameters at which the combinations are held.
    """

    rows: Array
    theta: Array

    @classmethod
    def none(cls, parameters: ParameterSet) -> Pins:
        """No combination is held.

        Args:
            parameters: The parameters.
        """
        return cls(rows=np.zeros((0, len(parameters))), theta=np.array(parameters.guess))

    @classmethod
    def of(cls, parameters: ParameterSet, theta: Array, null_space: NullSpace) -> Pins:
        """Hold the directions about which there is no information.

        A pin has the weight of a prior whose standard deviation is the magnitude of the parameters.

        Args:
            parameters: The parameters.
            theta: (p,) parameters at which the combinations are held.
            null_space: Directions of theta about which there is no information.
        """
        magnitude = parameters.magnitude
        orthonormal = np.linalg.qr(null_space.directions / magnitude[:, None])[0]
        return cls(rows=orthonormal.T / magnitude, theta=np.array(theta))

    def residual(self, theta: Array) -> Array:
        """Differences of the combinations from their held values.

        Args:
            theta: (p,) parameters.

        Returns:
            (k,) differences.
        """
        return np.asarray(self.rows @ (theta - self.theta))

    def released(self) -> Pins:
        """These pins without any combination."""
        return Pins(rows=self.rows[:0], theta=self.theta)


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
