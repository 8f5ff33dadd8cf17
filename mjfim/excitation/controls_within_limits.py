"""Controls that keep hard limits from the beginning.

Where the initial control is far outside the limits, a share of it keeps them, but may tell little.
Random controls of several bandwidths, each as large as the limits allow, often tell much more: a
stiff servo with a weak motor, for example, can follow small, quick motions only. The search then
begins with the best of these controls. All of them are judged by simulations without derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.excitation.bandwidth import bandwidth_basis
from mjfim.excitation.constraint_kinds import ConstraintValues
from mjfim.excitation.constraints import ConstraintSet, constraint_set_of
from mjfim.excitation.interior_point import MAX_START_VIOLATION, nearly_inside
from mjfim.excitation.levels import DescentLevel, moved_alike
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.task import FADE_SHARE
from mjfim.excitation.verification import verify
from mjfim.records.design import ScaledStart
from mjfim.records.trajectory import Trajectory

# A control outside limits is reduced by this factor until it is inside, to the least share at most.
# The largest share is then found to a ratio.
SHARE_STEP = 0.25
LEAST_SHARE = 1e-6
SHARE_RATIO = 1.05

# Bandwidths of the random controls, relative to the largest one that the control can have.
BANDWIDTHS = (0.06, 0.15, 0.35, 0.6, 1.0)

# Factors by which the deviation of a single actuator is enlarged while all limits hold.
SINGLE_FACTORS = (2.0, 1.4)

# Number of random changes of the best control, and their size relative to it.
CHANGES = 24
CHANGE_SIZE = 0.3

# Share of the budget after which no further control is tried.
TRIAL_SHARE = 0.4

# A search begins with this share of the best control, some distance away from the limits.
BEGIN_SHARE = 0.95


@dataclass(frozen=True, kw_only=True, eq=False)
class LimitedCost:
    """Cost of controls that keep all limits.

    Attributes:
        level: The stated level, on the plant without clamps.
        first: The experiment's initial control, evaluated on the unmodified plant; None where it is
            not known.
    """

    level: DescentLevel
    first: DesignPoint | None = None

    @cached_property
    def constraints(self) -> ConstraintSet:
        """The limits on the plant without clamps."""
        return constraint_set_of(self.level.task)

    def values(self, control: Array) -> ConstraintValues | None:
        """Limited quantities along a control: (N, nu); None where the simulation diverges."""
        task = self.level.task
        observed = task.plant.observe(task.theta, control, self.constraints.observations)
        if observed is None:
            return None
        return self.constraints.evaluate(*observed, slopes=False)

    def trajectory(self, control: Array) -> Trajectory | None:
        """Trajectory of a control: (N, nu); None where it violates a limit.

        A force that keeps its limit only because a clamp cuts it off violates this limit.
        """
        return self._accepted(self.values(control))

    def _accepted(self, values: ConstraintValues | None) -> Trajectory | None:
        """Trajectory of limited quantities that keep all limits on the unmodified model, too."""
        if values is None or not self.constraints.is_feasible(values):
            return None
        return values.trajectory if verify(self.level.task, values.trajectory).is_feasible else None

    def point(self, control: Array) -> DesignPoint | None:
        """Evaluate a control: (N, nu); None where it violates a limit."""
        trajectory = self.trajectory(control)
        if trajectory is None:
            return None

        # The initial control has been evaluated already.
        known = None if self.first is None else moved_alike(self.first, trajectory)
        return self.level.problem.point(trajectory) if known is None else known

    def __call__(self, control: Array) -> float:
        """J of a control: (N, nu); infinite where it violates a limit."""
        point = self.point(control)
        return np.inf if point is None else point.cost

    def is_far_outside(self, values: ConstraintValues | None) -> bool:
        """Check whether a limit is violated by more than the barrier can remove.

        Args:
            values: Limited quantities along a control; None where the simulation diverges.
        """
        if values is None:
            return True
        return not nearly_inside(self.constraints.relative_margins(values), MAX_START_VIOLATION)

    def outside_start(self, control: Array, budget: Budget) -> OutsideStart | None:
        """Describe an initial control, (N, nu), outside limits; None where it keeps them.

        Args:
            control: The initial control [u-unit].
            budget: Time of the whole design, and the token that stops it.
        """
        if budget.stop.requested:
            return None
        values = self.values(control)
        if self._accepted(values) is not None:
            return None

        scaled = ControlsWithinLimits(cost=self, budget=budget).scaled(control)
        is_far = self.is_far_outside(values)
        return OutsideStart(control=control, scaled=scaled, is_far=is_far)


def limited_cost_of(stage: DescentLevel, first: DesignPoint | None = None) -> LimitedCost | None:
    """Cost of controls that keep all limits, at the stated level; None without hard limits.

    Args:
        stage: The stated level.
        first: The experiment's initial control, evaluated there; None where it is not known.
    """
    if not stage.task.is_limited:
        return None
    return LimitedCost(level=DescentLevel(stage.task.relaxed(), stage.basis), first=first)


def keeps_limits(limited: LimitedCost | None, point: DesignPoint) -> bool:
    """Check whether the motion of a point keeps the hard limits.

    Args:
        limited: Cost of controls that keep them; None without hard limits.
        point: The point, which begins at the stated initial state.
    """
    if limited is None:
        return True
    curve = point.trajectory
    return curve is not None and limited.trajectory(curve.ctrl) is not None


@dataclass(frozen=True, kw_only=True, eq=False)
class InsideControl:
    """A control that keeps all limits.

    Attributes:
        about: (nu,) control about which it deviates [u-unit].
        deviation: (N, nu) deviation [u-unit].
        cost: J along the control.
        criterion: phi, the information term of the cost.
        min_eigenvalue: Smallest eigenvalue of the information per second that the cost uses.
        share: Share of a larger deviation.
    """

    about: Array
    deviation: Array
    cost: float
    criterion: float
    min_eigenvalue: float
    share: float = 1.0

    @property
    def control(self) -> Array:
        """(N, nu) control [u-unit]."""
        return np.asarray(self.about + self.deviation)

    @property
    def begin(self) -> Array:
        """(N, nu) control with which a search begins, some distance away from the limits."""
        return np.asarray(self.about + BEGIN_SHARE * self.deviation)

    @property
    def record(self) -> ScaledStart:
        """The control as an entry of the design."""
        return ScaledStart(share=self.share, cost=self.cost, min_eigenvalue=self.min_eigenvalue)


@dataclass(frozen=True, kw_only=True, eq=False)
class OutsideStart:
    """An initial control that violates a limit.

    Attributes:
        control: (N, nu) the control [u-unit].
        scaled: The largest share of it that keeps all limits; None where no share does.
        is_far: Whether it violates a limit by more than the barrier can remove.
    """

    control: Array
    scaled: InsideControl | None
    is_far: bool

    @property
    def record(self) -> ScaledStart | None:
        """The scaled control as an entry of the design."""
        return None if self.scaled is None else self.scaled.record


@dataclass(frozen=True, kw_only=True, eq=False)
class ControlsWithinLimits:
    """Search for controls that keep all limits, without derivatives.

    Attributes:
        cost: Cost of controls that keep all limits.
        budget: Time of the whole design, and the token that stops it.
        share: Share of the budget after which no further control is tried.
    """

    cost: LimitedCost
    budget: Budget
    share: float = TRIAL_SHARE

    def scaled(self, control: Array) -> InsideControl | None:
        """Scale a control about each control that nearly holds the start; the best one counts.

        Args:
            control: (N, nu) control outside the limits [u-unit].

        Returns:
            The largest share that keeps all limits; None where no share does.
        """
        found: list[InsideControl] = []
        for centre in self.cost.level.task.centres:
            if self.budget.stop.requested:
                break
            inside = self.largest(centre, self.fitted(control - centre))
            if inside is not None:
                found.append(inside)
        return min(found, key=lambda inside: inside.cost, default=None)

    def best(self, scaled: InsideControl) -> InsideControl:
        """Find a control that tells more than the scaled initial control.

        Args:
            scaled: The scaled initial control.

        Returns:
            The best of it, of random controls of several bandwidths and of changes of the best one.
        """
        best = self.enlarged(scaled)
        rng = np.random.default_rng(self.cost.level.task.experiment.descent.seed)

        for deviation in self._random(rng):
            best = self._better(best, deviation)

        for _ in range(CHANGES):
            if self.is_over:
                break
            best = self._better(best, self._changed(best.deviation, rng))
        return best

    @property
    def is_over(self) -> bool:
        """Whether no further control is tried."""
        return self.budget.exhausted is not None or self.budget.used > self.share

    def _better(self, best: InsideControl, deviation: Array) -> InsideControl:
        """The best control so far, or a new one of any size where that costs less."""
        found = self.largest(best.about, deviation)
        if found is None or found.cost >= best.cost:
            return best
        return self.enlarged(found)

    def _random(self, rng: np.random.Generator) -> Iterator[Array]:
        """Random deviations, (N, nu) each, that reach the bounds of the controls."""
        widths = self.cost.constraints.control.bounds.scale
        for bandwidth in BANDWIDTHS:
            if self.is_over:
                return
            noise = self.noise(bandwidth, rng)
            yield self.fitted(widths * noise / np.abs(noise).max(axis=0))

    def _changed(self, deviation: Array, rng: np.random.Generator) -> Array:
        """A deviation, (N, nu), with a random change of every actuator in proportion to it."""
        noise = self.noise(float(rng.choice(BANDWIDTHS)), rng)
        sizes = np.sqrt((deviation**2).mean(axis=0) / (noise**2).mean(axis=0))
        return np.asarray(deviation + self.fitted(CHANGE_SIZE * sizes * noise))

    def noise(self, bandwidth: float, rng: np.random.Generator) -> Array:
        """Random curves that fade in, and fade out where the design ends at rest.

        Args:
            bandwidth: Their bandwidth, relative to half of the sample rate.
            rng: Source of random numbers.

        Returns:
            (N, nu) curves.
        """
        task = self.cost.level.task
        N, nu = task.control.shape
        lines = max(round(bandwidth * (N // 2)), 1)
        spectrum = np.zeros((N // 2 + 1, nu), dtype=np.complex128)
        spectrum[1 : lines + 1].real = rng.standard_normal((lines, nu))
        spectrum[1 : lines + 1].imag = rng.standard_normal((lines, nu))

        # Even a motion that does not begin at rest must not jump at once.
        begin = np.clip(np.arange(N)[:, None] / (FADE_SHARE * N), 0.0, 1.0)
        return np.asarray(begin * task.fade(N) * np.fft.irfft(spectrum, n=N, axis=0))

    def fitted(self, deviation: Array) -> Array:
        """The nearest deviation, (N, nu), that has the bandwidth which the experiment allows."""
        task = self.cost.level.task
        basis = bandwidth_basis(task, task.stated_times)
        if basis is None:
            return deviation
        return np.asarray(basis @ np.linalg.lstsq(basis, deviation)[0])

    def largest(self, about: Array, deviation: Array) -> InsideControl | None:
        """Find the largest share of a deviation that keeps all limits.

        Args:
            about: (nu,) control about which it deviates [u-unit].
            deviation: (N, nu) deviation [u-unit].

        Returns:
            The control; None where no share keeps all limits, or where it tells nothing.
        """
        for keeps in (self._nearly_keeps, self._keeps):
            share = self._largest_share(about, deviation, keeps)
            if share is None:
                return None
            found = self.inside(about, share * deviation, share)
            if found is not None:
                return found
        return None

    def _nearly_keeps(self, control: Array) -> bool:
        """Check the limits on the plant of the search only, which is much quicker."""
        values = self.cost.values(control)
        return values is not None and self.cost.constraints.is_feasible(values)

    def _keeps(self, control: Array) -> bool:
        """Check the limits on the unmodified model as well."""
        return self.cost.trajectory(control) is not None

    def _largest_share(
        self, about: Array, deviation: Array, keeps: Callable[[Array], bool]
    ) -> float | None:
        """The largest share of a deviation, (N, nu), with which a control passes a test."""
        share, outside = 1.0, np.inf
        while not keeps(about + share * deviation):
            share, outside = SHARE_STEP * share, share
            if share < LEAST_SHARE or self.budget.stop.requested:
                return None

        # Bisect between the share that keeps the limits and the next larger one that does not.
        while np.isfinite(outside) and outside > SHARE_RATIO * share:
            middle = float(np.sqrt(share * outside))
            if keeps(about + middle * deviation):
                share = middle
            else:
                outside = middle
        return share

    def inside(self, about: Array, deviation: Array, share: float) -> InsideControl | None:
        """A control with its cost; None where it violates a limit or tells nothing."""
        point = self.cost.point(about + deviation)
        if point is None or point.criterion is None or not np.isfinite(point.cost):
            return None
        return InsideControl(
            about=about,
            deviation=deviation,
            cost=point.cost,
            criterion=point.criterion.value,
            min_eigenvalue=float(point.criterion.eigenvalues[0]),
            share=share,
        )

    def enlarged(self, inside: InsideControl) -> InsideControl:
        """Enlarge the deviation of one actuator after the other while all limits hold."""
        if inside.deviation.shape[1] == 1:
            return inside

        for keeps in (self._nearly_keeps, self._keeps):
            factors = self._largest_factors(inside, keeps)
            if (factors == 1.0).all():
                return inside
            found = self.inside(inside.about, factors * inside.deviation, inside.share)
            if found is not None:
                return found if found.cost < inside.cost else inside
        return inside

    def _largest_factors(self, inside: InsideControl, keeps: Callable[[Array], bool]) -> Array:
        """(nu,) factors of the deviations of the actuators with which a control passes a test."""
        actuators = inside.deviation.shape[1]
        factors = np.ones(actuators)
        for factor in SINGLE_FACTORS:
            for i in range(actuators):
                larger = np.array(factors)
                larger[i] *= factor
                if self.is_over:
                    return factors
                if keeps(inside.about + larger * inside.deviation):
                    factors = larger
        return factors
