"""Unknowns of a fit and priors on them: shared, per recording, or private to segments.

The common columns of a linearisation are the parameters that all recordings share, then those of
the first recording, then those of the second, and so on. Deviations of initial states are private
unknowns of the segments.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from typing import Self

import numpy as np

from mjfim.arrays import Array, record
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.linear_coordinates import (
    UnknownBody,
    cad_bodies,
    cad_rows,
    unknown_bodies,
)
from mjfim.identification.segments import Segment
from mjfim.information.null_space import NullSpace
from mjfim.model.parameters import ParameterSet
from mjfim.model.targets import InertiaField, ModelField
from mjfim.optimize.condensed_least_squares import Step
from mjfim.optimize.levenberg_marquardt import UnknownValues

# Standard deviation of the prior on a free initial state, relative to the natural sizes of the
# state. This weak prior keeps components finite that no output determines.
FREE_START_SIGMA = 1e3

# Largest move of a piece of an inertia without a bound [magnitudes], and halvings of a move until
# its body is physical.
LARGEST_MOVE = 100.0
HALVINGS_TO_BOUND = 16

# Smallest fraction of a step that is halved.
SMALLEST_FRACTION = 1e-9


@record
class FitUnknowns:
    """The p parameters among the c = s + K e common and the n private unknowns of a segment.

    Attributes:
        system: The system, with difference steps calibrated along a recording.
        parameters: The p parameters.
        recordings: The K recordings on the sample grid.
        segments: The P segments.
        start_directions: (nx, n) directions of the initial state along which the private unknowns
            move it.
        shared: (s,) indices in theta of the parameters that all recordings share.
        free_starts: True where the whole initial state of every segment is private, and theta holds
            none of it.
        bounded: Whether the parameters have bounds.
        with_priors: Whether priors of the parameters count.
        pins: (k, p) coefficients of combinations that no recording determines and that are held,
            each over the magnitude of the parameter.
        pinned_at: (p,) parameters at which these combinations are held.
    """

    system: System
    parameters: ParameterSet
    recordings: tuple[AlignedRecording, ...]
    segments: tuple[Segment, ...]
    start_directions: Array
    shared: np.ndarray
    free_starts: bool
    bounded: bool
    with_priors: bool
    pins: Array
    pinned_at: Array

    def with_shared_held(self) -> Self:
        """This problem with all shared parameters held: they have no columns, and need no pins."""
        return replace(self, shared=self.shared[:0], pins=self.pins[:0])

    def pinned(self, theta: Array, null_space: NullSpace) -> Self:
        """This problem with the combinations of parameters held that no recording determines.

        A pin has the weight of a prior whose standard deviation is the magnitude of the parameters.

        Args:
            theta: (p,) parameters at which the combinations are held.
            null_space: Directions of theta about which there is no information.

        Returns:
            The problem.
        """
        magnitude = self.parameters.magnitude
        orthonormal = np.linalg.qr(null_space.directions / magnitude[:, None])[0]
        return replace(self, pins=orthonormal.T / magnitude, pinned_at=np.array(theta))

    # ---- positions

    @cached_property
    def per_recording(self) -> np.ndarray:
        """(e,) indices in theta of the parameters with a value for each recording."""
        parameters = self.parameters
        return np.flatnonzero(parameters.recording_specific & ~parameters.initial_deviations)

    @cached_property
    def private(self) -> np.ndarray:
        """(n,) indices in theta of the nuisance deviations of the initial state."""
        return np.flatnonzero(self.parameters.initial_deviations)

    @property
    def private_count(self) -> int:
        """Number of private unknowns of a segment n."""
        return int(self.start_directions.shape[1])

    @property
    def column_count(self) -> int:
        """Number of common unknowns c."""
        return len(self.shared) + len(self.recordings) * len(self.per_recording)

    @cached_property
    def parameter_of_column(self) -> np.ndarray:
        """(c,) index in theta of every common column."""
        return np.concatenate([self.shared, np.tile(self.per_recording, len(self.recordings))])

    @cached_property
    def lower(self) -> Array:
        """(c,) lower bounds of the common unknowns [theta-unit]."""
        return np.where(self.bounded, self.parameters.lower[self.parameter_of_column], -np.inf)

    @cached_property
    def upper(self) -> Array:
        """(c,) upper bounds of the common unknowns [theta-unit]."""
        return np.where(self.bounded, self.parameters.upper[self.parameter_of_column], np.inf)

    @cached_property
    def _of_inertias(self) -> np.ndarray:
        """Common columns of shared pieces of inertias, which may make a body unphysical."""
        columns = []
        whole = [body.columns for body in self.shared_bodies]
        for column, j in enumerate(self.shared.tolist()):
            for target in self.parameters.parameters[j].targets:
                field = target.field
                if isinstance(field, ModelField):
                    has_mass = field.array == "body_mass" and not self.lower[column] > 0.0
                    columns += [column] * (has_mass or field.array == "body_inertia")
                elif isinstance(field, InertiaField) and field.parametrisation != "logcholesky":
                    columns += [column] * (not np.isin(j, whole))
        return np.unique(np.array(columns, dtype=np.intp))

    def _last_possible(self, theta: Array, j: int, inside: float) -> float:
        """Last value of parameter j that is possible, between one inside and that of theta."""
        theta, end = np.array(theta), theta[j]
        for _ in range(HALVINGS_TO_BOUND):
            theta[j] = middle = 0.5 * (inside + end)
            if self.system.impossible(theta):
                end = middle
            else:
                inside = middle
        return inside

    def bounds_at(self, at: UnknownValues) -> tuple[Array, Array]:
        """Bounds of each common unknown where the others stay: the stated ones and physical ones.

        Args:
            at: The unknowns.

        Returns:
            (c,) lower and (c,) upper bounds [theta-unit].
        """
        bounds = np.array([self.lower, self.upper])
        if not self.bounded or not len(self._of_inertias) or self.system.impossible(at.theta):
            return bounds[0], bounds[1]
        for column in self._of_inertias.tolist():
            j = self.shared[column]
            for side, sign in enumerate((-1.0, 1.0)):
                theta, inside, end = np.array(at.theta), at.theta[j], bounds[side, column]
                if not np.isfinite(end):
                    end = inside + sign * LARGEST_MOVE * self.parameters.magnitude[j]
                theta[j] = end
                if self.system.impossible(theta):
                    bounds[side, column] = self._last_possible(theta, j, inside)
        return bounds[0], bounds[1]

    @property
    def first_columns(self) -> np.ndarray:
        """(s+e,) common columns of the shared parameters and of those of the first recording."""
        return np.arange(len(self.shared) + len(self.per_recording))

    @property
    def own_columns(self) -> np.ndarray:
        """(K, e) common columns of the unknowns that belong to each recording."""
        columns = np.arange(len(self.shared), self.column_count)
        return columns.reshape(len(self.recordings), len(self.per_recording))

    @property
    def estimated(self) -> np.ndarray:
        """(p,) True for the parameters that have common columns."""
        mask = np.zeros(len(self.parameters), dtype=bool)
        mask[self.parameter_of_column] = True
        return mask

    def begin(self, theta: Array) -> UnknownValues:
        """Unknowns at given parameters, with every initial state as stated or measured.

        Args:
            theta: (p,) parameters.

        Returns:
            The unknowns.
        """
        theta = np.array(theta, dtype=np.float64)
        start = np.zeros(self.private_count) if self.free_starts else theta[self.private]
        return UnknownValues(
            theta=theta,
            private=np.tile(start, (len(self.segments), 1)),
            per_recording=np.tile(theta[self.per_recording], (len(self.recordings), 1)),
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
        # Pieces of inertias that move together may leave the bounds of each.
        impossible = self.system.impossible
        is_guarded = self.bounded and len(self._of_inertias) and fraction > SMALLEST_FRACTION
        if is_guarded and impossible(theta) and not impossible(at.theta):
            return self.moved(at, step, 0.5 * fraction)
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

    # ---- priors and pins

    def prior_rows(self, at: UnknownValues) -> Array:
        """Rows of the priors on the common unknowns, without pins.

        Args:
            at: The unknowns.

        Returns:
            (l, c+1) rows `[J, r]`, with residuals in standard deviations: the stated priors, then
            those from the model's inertias.
        """
        parameters, index = self.parameters, self.parameter_of_column
        weight = parameters.prior_weight[index]
        deviation = self.common_values(at) - parameters.guess[index]
        rows = [np.column_stack([np.diag(weight), weight * deviation])[weight > 0.0]]

        # Parameters that an earlier estimate knows are shared by all recordings.
        earlier = parameters.earlier_rows
        if earlier is not None:
            residual = earlier @ (self.theta_of_recording(at, 0) - parameters.guess)
            rows.append(np.column_stack([self.to_columns(earlier, 0), residual]))

        return np.concatenate([*rows, *self._rows_of_inertias(at)])

    def _rows_of_inertias(self, at: UnknownValues) -> Iterator[Array]:
        """Rows `[J, r]` of the priors from the model's inertias, on the common unknowns.

        An inertia with a value for each recording has a prior in each of them.
        """
        is_own = np.isin(np.arange(len(self.parameters)), self.per_recording)
        for is_wanted, count in ((~is_own, 1), (is_own, len(self.recordings))):
            bodies = [body for body in self._cad_bodies if is_wanted[body.columns].all()]
            for recording in range(count if bodies else 0):
                found = cad_rows(bodies, self.theta_of_recording(at, recording))
                columns = self.to_columns(found[:, :-1], recording)
                yield np.column_stack([columns, found[:, -1]])

    @cached_property
    def _cad_bodies(self) -> tuple[UnknownBody, ...]:
        """Bodies with a prior from the model's inertias."""
        return cad_bodies(self.parameters)

    @property
    def _pins_involve_private(self) -> bool:
        """True where pins involve private unknowns."""
        return bool(self.pins[:, self.private].any())

    def _pin_rows(self, at: UnknownValues) -> Array:
        """(k, c+1) rows `[J, r]` of the pins on the common unknowns."""
        residual = self.pins @ (self.theta(at) - self.pinned_at)
        return np.column_stack([self.to_columns(self.pins, 0), residual])

    def common_rows(self, at: UnknownValues) -> Array:
        """(l, c+1) rows `[J, r]` of priors and pins on the common unknowns."""
        rows = np.zeros((0, self.column_count + 1))
        if self.with_priors:
            rows = self.prior_rows(at)
        return rows if self._pins_involve_private else np.concatenate([rows, self._pin_rows(at)])

    def common_rows_after(self, at: UnknownValues, common: Array) -> Array | None:
        """Rows on the common unknowns at the end of a step of them, with derivatives by that step.

        Inertias move along straight lines of their barycentric coordinates, as in `moved`.

        Args:
            at: Unknowns at the begin of the step.
            common: (c,) the step.

        Returns:
            (l, c+1) rows `[J, r]`; None where a body is not physical at the end.
        """
        theta = np.array(at.theta)
        count = len(self.shared)
        theta[self.shared] += common[:count]

        follows = np.eye(len(theta))
        for body in self.shared_bodies:
            columns = body.columns
            begin = at.theta[columns]
            step = theta[columns] - begin
            if not body.is_physical_after(begin, step):
                return None
            theta[columns] = body.moved(begin, step)

            # Without a way through barycentric coordinates, from which those of a body that is
            # nearly a rod cannot always be found.
            follows[np.ix_(columns, columns)] = np.linalg.solve(
                body.linear_slopes(theta[columns]).T, body.linear_slopes(begin).T
            )

        own = at.per_recording + common[count:].reshape(at.per_recording.shape)
        rows = self.common_rows(replace(at, theta=theta, per_recording=own))
        rows[:, :count] @= follows[np.ix_(self.shared, self.shared)]
        return rows

    def private_rows(self, at: UnknownValues) -> Array:
        """Rows on the private unknowns of every segment.

        Args:
            at: The unknowns.

        Returns:
            (P, k, m) rows `[J_private, J_common, r]`.
        """
        count, n = at.private.shape
        # A weak prior on a free initial state, for components that no output determines; stated
        # priors on the deviations of another one.
        if self.free_starts:
            sizes = np.abs(self.start_directions).T @ self.system.plant.sizes.state
            weight = 1.0 / (FREE_START_SIGMA * sizes)
            deviation = at.private
        else:
            weight = self.parameters.prior_weight[self.private] * self.with_priors
            deviation = at.private - self.parameters.guess[self.private]
        pin_count = len(self.pins) if self._pins_involve_private and not self.free_starts else 0
        rows = np.zeros((count, n + pin_count, n + self.column_count + 1))
        rows[:, :n, :n] = np.diag(weight)
        rows[:, :n, -1] = weight * deviation

        # Pins that involve private unknowns belong to the first segment.
        if pin_count:
            rows[0, n:, :n] = self.pins[:, self.private]
            rows[0, n:, n:] = self._pin_rows(at)
        return rows
