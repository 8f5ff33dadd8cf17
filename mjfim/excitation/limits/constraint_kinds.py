"""Kinds of inequality constraints along a trajectory: margins, barrier and its expansion.

All kinds follow one protocol, so that the barrier of a constraint set is a sum over its members.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from mjfim.arrays import Array, record
from mjfim.model.clearance import GeomDistances
from mjfim.optimize.cost_models import BarrierDerivatives, Bounds
from mjfim.optimize.lq import TangentCurve, Weights
from mjfim.plant.batch import SubstepObservations
from mjfim.plant.state_space import StateSpace
from mjfim.records.trajectory import Trajectory

# Norm over its bound below which the limits of the derivatives at zero hold; the error is the
# square of it.
NEARLY_ZERO = 1e-8


@record
class Magnitude:
    """The norm of some observed numbers, or the angle whose half has this norm as its sine.

    Attributes:
        columns: Places of the c numbers among all observed numbers.
        is_angle: True for an angle.
    """

    columns: tuple[int, ...]
    is_angle: bool

    def value(self, observed: Array) -> Array:
        """The limited quantity, not negative.

        Args:
            observed: (..., w) observed numbers.

        Returns:
            (...) norms [unit of the numbers], or angles [rad].
        """
        norm = np.linalg.norm(observed[..., self.columns], axis=-1)
        if not self.is_angle:
            return np.asarray(norm)
        return np.asarray(2.0 * np.arcsin(np.minimum(norm, 1.0)))

    def norm_at(self, quantity: float) -> float:
        """The norm at a value of the quantity.

        Args:
            quantity: The limited quantity, at most pi where it is an angle.
        """
        return float(np.sin(0.5 * quantity)) if self.is_angle else quantity

    def bounds(self, upper: float, scale: float) -> Bounds:
        """Bounds of the norm, from the upper bound of the quantity and from that bound at first."""
        highest, size = np.array([self.norm_at(upper)]), np.array([self.norm_at(scale)])
        return Bounds(lower=-highest, upper=highest, scale=size)

    def barrier(
        self, observed: Array, upper: float, scale: float, *, delta: float, weight: float
    ) -> BarrierDerivatives:
        """Barrier of the norm with its derivatives by the observed numbers.

        Args:
            observed: (..., w) observed numbers.
            upper: Upper bound of the quantity.
            scale: Bound of the quantity before it was tightened.
            delta: Relative distance below which the barrier is relaxed.
            weight: Factor of the barrier of every vector.
        """
        vectors = observed[..., self.columns]
        norm = np.linalg.norm(vectors, axis=-1, keepdims=True)
        bounds = self.bounds(upper, scale)
        value, slope, curvature = bounds.barrier(norm, delta, weight)

        # At zero, slope over norm tends to the curvature.
        is_zero = norm <= NEARLY_ZERO * bounds.scale
        safe = np.where(is_zero, 1.0, norm)
        across = np.where(is_zero, curvature, slope / safe)
        direction = np.where(is_zero, 0.0, vectors / safe)

        outer = direction[..., :, None] * direction[..., None, :]
        identity = np.eye(len(self.columns))
        bend = (curvature - across)[..., None]
        return value, across * vectors, across[..., None] * identity + bend * outer


# Weight of a constraint on the final state in the barrier. A constraint that holds at every sample
# has the weight 1 / N.
END_WEIGHT = 0.1

# Clearance over the reach of distances below which margins are relative to this share of the reach.
NEGLIGIBLE_CLEARANCE = 1e-6


@record
class ConstraintValues:
    """The constrained quantities along a trajectory.

    Attributes:
        trajectory: The trajectory.
        observed: (N, rows, w) quantities at every engine step of a sample, followed by the further
            rows of forces [unit of each quantity].
        distances: (N, m) distances at the samples 1 ... N [m], or None without a clearance.
        distance_slopes: (N, m, nv) derivatives of the distances by the position [m / q-unit], or
            None where they were not requested.
        observation_jacobian: (N, S, w, nx+nu) derivatives of the quantities at S rows of each
            sample by the state and the control at the beginning of the sample, or None where
            they were not requested.
    """

    trajectory: Trajectory
    observed: Array
    distances: Array | None = None
    distance_slopes: Array | None = None
    observation_jacobian: Array | None = None

    @property
    def weight(self) -> float:
        """Weight of one sample in the barrier, which is a mean over time."""
        return 1.0 / len(self.observed)

    @property
    def jacobian(self) -> Array:
        """The derivatives of the quantities. Raises ValueError where there are none."""
        if self.observation_jacobian is None:
            raise ValueError("the observations have no derivatives")
        return self.observation_jacobian


class KindMargins(NamedTuple):
    """Margins of the quantities of one kind.

    Attributes:
        kind: Name of the kind, as in the experiment file.
        margins: (...) distances to the nearer bound, negative outside [unit of the quantity].
        scale: Number or array that makes the margins relative [unit of the quantity].
    """

    kind: str
    margins: Array
    scale: Array | float


# Derivatives of the barrier by the state (N+1, nx) [1 / x-unit] and by the control (N, nu)
# [1 / u-unit], and its Gauss-Newton Hessian. Every kind of constraint adds its part in place.
ExpansionSums = tuple[Array, Array, Weights]


@dataclass(frozen=True, kw_only=True, eq=False)
class Constraint(ABC):
    """Inequality constraints of one or several kinds: quantities between bounds.

    Attributes:
        kind: Kind of the limits, where there is one.
        bounds: Ranges of the quantities.
    """

    kind: ClassVar[str] = ""

    bounds: Bounds

    @abstractmethod
    def quantity(self, values: ConstraintValues) -> Array:
        """The quantities that are single numbers, with one column for each range."""

    @abstractmethod
    def change(self, values: ConstraintValues, step: TangentCurve) -> Array:
        """Change of the quantities along a tangent curve, to first order.

        Args:
            values: The constrained quantities with their derivatives.
            step: The tangent curve.
        """

    @abstractmethod
    def add_expansion(
        self, values: ConstraintValues, delta: float, sums: ExpansionSums, factors: Array | None
    ) -> None:
        """Add the derivatives of the barrier to the sums.

        Args:
            values: The constrained quantities with their derivatives.
            delta: Relaxation of the barrier, a relative margin.
            sums: Sums over all kinds, changed in place.
            factors: Factors of the curvature, ordered like `slacks`; None for 1.
        """

    @property
    def number_bounds(self) -> Bounds:
        """Ranges of the quantities that are single numbers with a sign."""
        return self.bounds

    def weight(self, values: ConstraintValues) -> float:
        """Weight of one row of the quantities in the barrier."""
        return values.weight

    def tightened(self, fractions: Mapping[str, float]) -> Self:
        """Narrow the ranges by the fraction of their half-width for this kind."""
        return replace(self, bounds=self.bounds.tightened(fractions.get(self.kind, 0.0)))

    def margins(self, values: ConstraintValues) -> Iterator[KindMargins]:
        """Margins of every constrained quantity, by kind."""
        yield KindMargins(self.kind, self.bounds.margin(self.quantity(values)), self.bounds.scale)

    def barrier(
        self, values: ConstraintValues, delta: float, factors: Array | None = None
    ) -> BarrierDerivatives:
        """The barrier with its derivatives by the quantities.

        Args:
            values: The constrained quantities.
            delta: Relaxation of the barrier, a relative margin.
            factors: Factors of the curvature, ordered like `slacks`; default: 1.
        """
        numbers, weight = self.quantity(values), self.weight(values)
        return self.number_bounds.barrier(numbers, delta, weight, factors)

    def narrowing(self, values: ConstraintValues, delta: float) -> Array:
        """Derivative of the barrier by the share of its scale by which each range narrows, (w,)."""
        numbers, weight = self.quantity(values), self.weight(values)
        return self.number_bounds.narrowing(numbers, delta, weight)

    def slacks(self, values: ConstraintValues) -> Array:
        """Relative distances of the numbers to both bounds, (2, ...); infinite without a bound."""
        return self.number_bounds.slacks(self.quantity(values))

    def slack_changes(self, values: ConstraintValues, step: TangentCurve) -> Array:
        """Changes of these distances along a tangent curve, to first order."""
        return self.number_bounds.slack_changes(self.change(values, step))


@dataclass(frozen=True, kw_only=True, eq=False)
class SubstepConstraint(Constraint):
    """Ranges of positions, velocities, accelerations, angles, speeds and forces.

    These quantities are observed at every engine step, so within the samples as well.

    Attributes:
        observations: The w observed numbers.
        bounds: Ranges of the n quantities, (n,); a magnitude has the range from minus its bound to
            its bound.
        kinds: Kind of each quantity.
        names: Name of the joint, actuator or tendon of each quantity.
        columns: For each quantity the observed numbers that it consists of.
        angles: For each quantity True where it is an angle without a sign.
    """

    observations: SubstepObservations
    kinds: tuple[str, ...]
    names: tuple[str, ...]
    columns: tuple[tuple[int, ...], ...]
    angles: tuple[bool, ...]

    @cached_property
    def numbers(self) -> NDArray[np.intp]:
        """Places of the quantities that are single numbers with a sign."""
        return np.array([i for i, each in enumerate(self.columns) if len(each) == 1], np.intp)

    @cached_property
    def number_columns(self) -> NDArray[np.intp]:
        """Observed numbers that are these quantities."""
        return np.array([self.columns[i][0] for i in self.numbers], np.intp)

    @cached_property
    def magnitudes(self) -> tuple[tuple[int, Magnitude], ...]:
        """Places of the quantities that are norms of several numbers, with their definition."""
        return tuple(
            (i, Magnitude(columns=each, is_angle=self.angles[i]))
            for i, each in enumerate(self.columns)
            if len(each) > 1
        )

    @property
    def column_scale(self) -> Array:
        """(w,) scale of every observed number: that of its quantity [unit of the number]."""
        scale = np.ones(sum(len(each) for each in self.columns))
        scale[self.number_columns] = self.bounds.scale[self.numbers]
        for i, magnitude in self.magnitudes:
            scale[list(magnitude.columns)] = magnitude.norm_at(float(self.bounds.scale[i]))
        return scale

    def tightened(
        self, fractions: Mapping[str, float], room: Array | float = np.inf
    ) -> SubstepConstraint:
        """Narrow the ranges by a fraction of their half-width, by kind, and by at most `room`."""
        each = np.array([fractions.get(kind, 0.0) for kind in self.kinds])
        return replace(self, bounds=self.bounds.tightened(np.minimum(each, np.maximum(room, 0.0))))

    def quantities(self, observed: Array) -> Array:
        """The limited quantities.

        Args:
            observed: (..., w) observed numbers.

        Returns:
            (..., n) quantities [unit of each kind].
        """
        found = np.empty((*observed.shape[:-1], len(self.columns)))
        found[..., self.numbers] = observed[..., self.number_columns]
        for i, magnitude in self.magnitudes:
            found[..., i] = magnitude.value(observed)
        return found

    def _observed(self, values: ConstraintValues) -> Array:
        """(N, S, w) numbers at the S rows with derivatives."""
        return values.observed[:, np.array(self.observations.derivative_rows)]

    def quantity(self, values: ConstraintValues) -> Array:
        """See `Constraint.quantity`; at the rows with derivatives."""
        return self._observed(values)[..., self.number_columns]

    @cached_property
    def number_bounds(self) -> Bounds:
        """See `Constraint.number_bounds`."""
        return Bounds(
            lower=self.bounds.lower[self.numbers],
            upper=self.bounds.upper[self.numbers],
            scale=self.bounds.scale[self.numbers],
        )

    def weight(self, values: ConstraintValues) -> float:
        """Weight of one row with derivatives."""
        return values.weight / len(self.observations.derivative_rows)

    def change(self, values: ConstraintValues, step: TangentCurve) -> Array:
        """See `Constraint.change`."""
        moved = np.concatenate([step.z[:-1], step.v], axis=1)
        jacobian = values.jacobian[:, :, self.number_columns]
        return np.asarray(np.einsum("kswi,ki->ksw", jacobian, moved))

    def margins(self, values: ConstraintValues) -> Iterator[KindMargins]:
        """Margins at every engine step, one item per quantity. See `Constraint.margins`."""
        margins = self.bounds.margin(self.quantities(values.observed))
        for i, kind in enumerate(self.kinds):
            yield KindMargins(kind, margins[..., i], float(self.bounds.scale[i]))

    def barrier(
        self, values: ConstraintValues, delta: float, factors: Array | None = None
    ) -> BarrierDerivatives:
        """See `Constraint.barrier`; the value counts magnitudes as well."""
        value, slope, curvature = super().barrier(values, delta, factors)
        vectors = (each[0] for _, each in self._vector_barriers(values, delta))
        return value + sum(vectors), slope, curvature

    def narrowing(self, values: ConstraintValues, delta: float) -> Array:
        """See `Constraint.narrowing`; angles count as the norms from which they are computed."""
        observed, weight = self._observed(values), self.weight(values)
        found = np.zeros(len(self.columns))
        found[self.numbers] = super().narrowing(values, delta)
        for i, magnitude in self.magnitudes:
            bounds = magnitude.bounds(float(self.bounds.upper[i]), float(self.bounds.scale[i]))
            norm = np.linalg.norm(observed[..., magnitude.columns], axis=-1, keepdims=True)
            found[i] = bounds.narrowing(norm, delta, weight)[0]
        return found

    def add_expansion(
        self, values: ConstraintValues, delta: float, sums: ExpansionSums, factors: Array | None
    ) -> None:
        """See `Constraint.add_expansion`; the Hessian is one matrix product per sample."""
        # Slope of the barrier by every observed number, and its curvature times the Jacobian.
        jacobian = values.jacobian
        slope, bent = np.zeros(jacobian.shape[:3]), np.zeros(jacobian.shape)
        columns = self.number_columns
        _, slope[..., columns], curvature = super().barrier(values, delta, factors)
        bent[:, :, columns] = curvature[..., None] * jacobian[:, :, columns]
        for i, (_, slopes, curvature) in self._vector_barriers(values, delta):
            columns = np.array(self.columns[i])
            slope[..., columns] = slopes
            bent[:, :, columns] = curvature @ jacobian[:, :, columns]

        # Gradient by the state and the control, (N, nx+nu).
        a, b, weights = sums
        N, nx = len(jacobian), a.shape[1]
        gradient = np.einsum("kswi,ksw->ki", jacobian, slope)
        a[:-1] += gradient[:, :nx]
        b += gradient[:, nx:]

        # Gauss-Newton Hessian J' (curvature) J of every sample, with all numbers in rows.
        flat = jacobian.reshape(N, -1, jacobian.shape[-1])
        hessian = np.swapaxes(bent.reshape(flat.shape), 1, 2) @ flat
        weights.Q[:-1] += hessian[:, :nx, :nx]
        weights.S[:] += hessian[:, nx:, :nx]
        weights.R[:] += hessian[:, nx:, nx:]

    def _vector_barriers(
        self, values: ConstraintValues, delta: float
    ) -> Iterator[tuple[int, BarrierDerivatives]]:
        """Barriers of the magnitudes by their places, with derivatives by observed numbers."""
        observed, weight = self._observed(values), self.weight(values)
        for i, magnitude in self.magnitudes:
            upper, scale = float(self.bounds.upper[i]), float(self.bounds.scale[i])
            yield i, magnitude.barrier(observed, upper, scale, delta=delta, weight=weight)


class ControlConstraint(Constraint):
    """Ranges of the controls.

    Attributes:
        bounds: Range of each control, (nu,) [u-unit].
    """

    kind = "control"

    def quantity(self, values: ConstraintValues) -> Array:
        """(N, nu) controls [u-unit]."""
        return values.trajectory.ctrl

    def change(self, values: ConstraintValues, step: TangentCurve) -> Array:
        """See `Constraint.change`."""
        return step.v

    def add_expansion(
        self, values: ConstraintValues, delta: float, sums: ExpansionSums, factors: Array | None
    ) -> None:
        """See `Constraint.add_expansion`."""
        _, slope, curvature = self.barrier(values, delta, factors)
        _, b, weights = sums
        diagonal = np.arange(b.shape[1])

        b += slope
        weights.R[:, diagonal, diagonal] += curvature


@record
class ControlRateConstraint(Constraint):
    """Ranges of the rates of the controls.

    A rate is the change of a control from one sample to the next over the time in which it is
    played: the period of the rows of design.csv. Every row of a sample has the same control, so
    that the control changes within one row.

    Attributes:
        bounds: Range of the rate of each control, (nu,) [u-unit / s].
        dt: Period of the rows of design.csv, the sample period without a `playback_rate` [s].
        control_before: (nu,) control before the first sample [u-unit]; None where it is free.
        control_after: (nu,) control after the last sample [u-unit]; None where it is free.
        periodic: The control after the last sample is that of the first one.
    """

    kind = "control_rate"

    dt: float
    control_before: Array | None = None
    control_after: Array | None = None
    periodic: bool = False

    def quantity(self, values: ConstraintValues) -> Array:
        """(N+1, nu) rates of the controls [u-unit / s]."""
        return self.rates(values.trajectory.ctrl)

    def rates(self, ctrl: Array) -> Array:
        """Compute the rates of the control into each sample and out of the last one.

        Args:
            ctrl: (N, nu) control [u-unit].

        Returns:
            (N+1, nu) rates [u-unit / s], zero at an end where the control is free.
        """
        return self._rates_between(ctrl, self.control_before, self.control_after)

    def _rates_between(self, curve: Array, before: Array | None, after: Array | None) -> Array:
        """Compute the rates of a curve and at its ends.

        Args:
            curve: (N, nu) control, or a change of it [u-unit].
            before: (nu,) value before the first sample; None where it is free.
            after: (nu,) value after the last sample; None where it is free.
        """
        first = curve[0] if before is None else before
        last = curve[-1] if after is None else after
        if self.periodic:
            last = curve[0]
        return np.diff(curve, axis=0, prepend=first[None], append=last[None]) / self.dt

    def change(self, values: ConstraintValues, step: TangentCurve) -> Array:
        """See `Constraint.change`."""
        # Controls that are stated beside the curve do not change.
        unchanged = np.zeros(step.v.shape[1])
        before = None if self.control_before is None else unchanged
        after = None if self.control_after is None else unchanged
        return self._rates_between(step.v, before, after)

    def add_expansion(
        self, values: ConstraintValues, delta: float, sums: ExpansionSums, factors: Array | None
    ) -> None:
        """See `Constraint.add_expansion`."""
        _, by_rate, curvature = self.barrier(values, delta, factors)
        slope = by_rate / self.dt

        # A control raises the rate into its sample and lowers the rate out of it.
        _, b, weights = sums
        b += (by_rate[:-1] - by_rate[1:]) / self.dt
        W = weights.W
        W += curvature / self.dt**2

        # After the last sample a periodic control returns to that of the first sample.
        if self.periodic:
            b[0] += slope[-1]

        # At a free end the rate is zero, whatever the control is.
        if self.control_before is None:
            b[0] -= slope[0]
            W[0] = 0.0
        if self.control_after is None and not self.periodic:
            b[-1] += slope[-1]
            W[-1] = 0.0


@record
class EndStateConstraint(Constraint):
    """Tolerances of the final state about a target.

    Attributes:
        space: Layout of the state.
        bounds: Ranges of the difference from the target, (nx,); activations are free [x-unit].
        target: (ns,) state at which the trajectory has to end.
    """

    space: StateSpace
    target: Array

    def quantity(self, values: ConstraintValues) -> Array:
        """(nx,) final state minus the target."""
        return self.space.minus(values.trajectory.state[-1], self.target)

    def weight(self, values: ConstraintValues) -> float:
        """Weight of the final state in the barrier."""
        return END_WEIGHT

    def tightened(self, fractions: Mapping[str, float]) -> Self:
        """Narrow the tolerances by a fraction of their half-width, by kind."""
        position = fractions.get("end_position", 0.0)
        velocity = fractions.get("end_velocity", 0.0)

        space = self.space
        each = np.repeat([position, velocity, 0.0], (space.nv, space.nv, space.na))
        return replace(self, bounds=self.bounds.tightened(each))

    def _slope(self, values: ConstraintValues) -> Array:
        """(nx, nx) derivative by the final state; the difference of rotations is not linear."""
        return self.space.minus_derivative(self.quantity(values))

    def change(self, values: ConstraintValues, step: TangentCurve) -> Array:
        """See `Constraint.change`."""
        return np.asarray(self._slope(values) @ step.z[-1])

    def margins(self, values: ConstraintValues) -> Iterator[KindMargins]:
        """See `Constraint.margins`."""
        margins = self.bounds.margin(self.quantity(values))
        scale = self.bounds.scale

        nv = self.space.nv
        positions, velocities = slice(nv), slice(nv, 2 * nv)
        yield KindMargins("end_position", margins[positions], scale[positions])
        yield KindMargins("end_velocity", margins[velocities], scale[velocities])

    def add_expansion(
        self, values: ConstraintValues, delta: float, sums: ExpansionSums, factors: Array | None
    ) -> None:
        """See `Constraint.add_expansion`."""
        _, slope, curvature = self.barrier(values, delta, factors)
        J = self._slope(values)
        a, _, weights = sums
        a[-1] += J.T @ slope
        weights.Q[-1] += J.T @ (curvature[:, None] * J)


@dataclass(frozen=True, kw_only=True, eq=False)
class ClearanceConstraint(Constraint):
    """Distances between geoms that have to be at least a clearance.

    Attributes:
        distances: Measures the distances of all pairs up to its reach, where the barrier is zero.
    """

    distances: GeomDistances

    @classmethod
    def of(cls, distances: GeomDistances, least: float) -> ClearanceConstraint:
        """The constraint with a clearance [m]."""
        each = np.ones(len(distances.columns))
        scale = (distances.reach - least) * each
        bounds = Bounds(lower=least * each, upper=np.inf * each, scale=scale)
        return cls(distances=distances, bounds=bounds)

    @property
    def least(self) -> float:
        """The clearance [m]."""
        return float(self.bounds.lower[0])

    @property
    def scale(self) -> float:
        """Distance to which margins are relative: the clearance, unless it is negligible [m]."""
        return max(self.least, NEGLIGIBLE_CLEARANCE * self.distances.reach)

    def tightened(self, fractions: Mapping[str, float]) -> ClearanceConstraint:
        """Raise the clearance by a fraction of it, at most half of the way to the reach."""
        raised = self.least * (1.0 + fractions.get("clearance", 0.0))
        highest = 0.5 * (self.least + self.distances.reach)
        return self.of(self.distances, min(raised, highest))

    def quantity(self, values: ConstraintValues) -> Array:
        """(N, m) distances between geoms [m]. Raises ValueError where they were not measured."""
        if values.distances is None:
            raise ValueError("the distances were not measured")
        return values.distances

    def _slopes(self, values: ConstraintValues) -> Array:
        """(N, m, nv) derivatives of the distances by the position [m / q-unit]."""
        if values.distance_slopes is None:
            raise ValueError("the distances have no derivatives")
        return values.distance_slopes

    def change(self, values: ConstraintValues, step: TangentCurve) -> Array:
        """See `Constraint.change`."""
        slopes = self._slopes(values)
        return np.asarray(np.einsum("kmi,ki->km", slopes, step.z[1:, : slopes.shape[2]]))

    def margins(self, values: ConstraintValues) -> Iterator[KindMargins]:
        """See `Constraint.margins`."""
        yield KindMargins("clearance", self.quantity(values) - self.least, self.scale)

    def add_expansion(
        self, values: ConstraintValues, delta: float, sums: ExpansionSums, factors: Array | None
    ) -> None:
        """See `Constraint.add_expansion`."""
        _, slope, curvature = self.barrier(values, delta, factors)
        slopes = self._slopes(values)
        nv = slopes.shape[2]

        # Distances are measured at the samples 1 ... N.
        a, _, weights = sums
        a[1:, :nv] += np.einsum("km,kmi->ki", slope, slopes)
        weights.Q[1:, :nv, :nv] += np.swapaxes(slopes * curvature[..., None], 1, 2) @ slopes
