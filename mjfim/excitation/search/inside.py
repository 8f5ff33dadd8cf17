"""Controls that keep all hard limits, found without derivatives.

A control is scaled about one that nearly holds the start, enlarged one actuator at a time, and
changed at random. Simulations show whether it keeps the limits, first on the plant of the search
and then on the unmodified model. So these controls count where derivatives mislead, as with dry
friction. They are also a first result, long before a descent has one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from mjfim.arrays import Array, record
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.evaluation import UNSTABLE_GROWTH, growth_along
from mjfim.excitation.limits.constraint_kinds import ConstraintValues, EndStateConstraint
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.search.levels import DescentLevel
from mjfim.excitation.task import FADE_SHARE
from mjfim.parallel.budget import Budget
from mjfim.records.design import ScaledStart

# Shares of a control that are tried first; below the last one, each share is the same factor
# smaller, to the least share at most. The largest share is then found to a ratio.
SHARES = (1.0, 0.95)
SHARE_STEP = 0.25
LEAST_SHARE = 1e-6
SHARE_RATIO = 1.05

# A descent begins with this share of a control that is as large as the limits allow.
BEGIN_SHARE = 0.95

# Factors by which the deviation of a single actuator is enlarged while all limits hold.
SINGLE_FACTORS = (2.0, 1.4)

# Bandwidths of random controls, relative to the largest one that the control can have. Neighbours
# differ much, because a search may end early.
BANDWIDTHS = (0.6, 0.15, 1.0, 0.35, 0.06)
CONTROLS_PER_BANDWIDTH = 2

# Size of a random change relative to the control, at first and within bounds. It changes by one
# factor after a success and by another after a failure; four failures undo one success.
FIRST_SIZE = 0.3
SMALLEST_SIZE, LARGEST_SIZE = 0.03, 1.0
AFTER_SUCCESS = 1.5
AFTER_FAILURE = AFTER_SUCCESS**-0.25

# Share of the changes that concern one actuator alone.
SINGLE_SHARE = 0.5

# Factor by which a control that amplifies disturbances too much is made smaller, and the number of
# sizes that are tried.
SMALLER = 0.6
SMALLER_TRIALS = 3

# Decrease of the cost that counts as progress (relative).
LEAST_PROGRESS = 0.01


@record
class InsideControl:
    """A control that keeps all limits.

    Attributes:
        about: (nu,) control from which it deviates [u-unit].
        deviation: (N, nu) deviation [u-unit].
        point: Its motion with its information and its cost.
        share: Share of the deviation from which it was made by scaling.
    """

    about: Array
    deviation: Array
    point: DesignPoint
    share: float = 1.0

    @property
    def control(self) -> Array:
        """(N, nu) control [u-unit]."""
        return np.asarray(self.about + self.deviation)

    @property
    def begin(self) -> Array:
        """(N, nu) control with which a descent begins, some distance away from the limits."""
        return np.asarray(self.about + BEGIN_SHARE * self.deviation)

    @property
    def cost(self) -> float:
        """J of the control."""
        return self.point.cost

    @property
    def record(self) -> ScaledStart:
        """The control as an entry of the design."""
        criterion = self.point.criterion
        smallest = 0.0 if criterion is None else float(criterion.eigenvalues[0])
        return ScaledStart(share=self.share, cost=self.cost, min_eigenvalue=smallest)


def is_progress(before: float, after: float) -> bool:
    """Check whether a cost is clearly lower than another one."""
    return after < before - LEAST_PROGRESS * abs(before)


def largest_share(keeps: Callable[[float], bool], budget: Budget) -> float | None:
    """Find the largest share of a control that passes a test.

    Args:
        keeps: The test.
        budget: A request to stop ends the search for a larger share.

    Returns:
        The share, up to a ratio of `SHARE_RATIO`; None where no share passes.
    """
    share, outside = 1.0, np.inf
    smaller = iter(SHARES[1:])
    while not keeps(share):
        outside, share = share, next(smaller, SHARE_STEP * share)
        if share < LEAST_SHARE:
            return None

    # Bisect between the share that passes and the next larger one that does not.
    while SHARE_RATIO * share < outside < np.inf and not budget.stop.requested:
        middle = float(np.sqrt(share * outside))
        if keeps(middle):
            share = middle
        else:
            outside = middle
    return share


class InsideSearch:
    """Search for controls that keep all limits, by scaling and by random changes.

    Args:
        level: The level, on the plant without the clamps that limits make unreachable.
        seed: Seed of the random changes.
    """

    def __init__(self, level: DescentLevel, seed: int) -> None:
        self.level = level
        self._rng = np.random.default_rng(seed)
        # Bandwidths of random controls that have not been tried yet. None stands for the best
        # control so far, as large as the limits allow.
        self._untried: deque[float | None] = deque((None, *CONTROLS_PER_BANDWIDTH * BANDWIDTHS))

    def scaled(self, control: Array, budget: Budget) -> InsideControl | None:
        """Scale a control, (N, nu), about each control that nearly holds the start.

        Returns:
            The scaled control of lowest cost; None where no share keeps the limits.
        """
        found = [
            self.largest(centre, self.fitted(control - centre), budget)
            for centre in self.level.task.centres
        ]
        return min((each for each in found if each), key=lambda each: each.cost, default=None)

    def largest(self, about: Array, deviation: Array, budget: Budget) -> InsideControl | None:
        """Find the largest share of a deviation, (N, nu), about (nu,), that keeps all limits.

        The limits on the unmodified model are checked at the end, and at every share only where
        that fails. A request to stop ends the search for a larger share.
        """
        for keeps in (self.level.nearly_keeps, self.level.keeps):

            def passes(share: float, keeps: Callable[[Array], bool] = keeps) -> bool:
                """Whether a share of the deviation passes the test."""
                return keeps(about + share * deviation)

            share = largest_share(passes, budget)
            if share is None:
                return None
            found = self._evaluated(about, share * deviation, share)
            if found is not None:
                return found
        return None

    def improvements(
        self, best: InsideControl, budget: Budget, patience: float
    ) -> Iterator[InsideControl]:
        """Yield controls, each of which costs less than all before.

        Random controls of all bandwidths come first, then random changes of the best control.

        Args:
            best: The best control so far.
            budget: Ends the search.
            patience: Number of changes without clear progress after which the search ends.
        """
        while self._untried and budget.exhausted is None:
            found = self._repeatable(self._proposed(best, self._untried.popleft(), budget), best)
            if found is not None:
                best = found
                yield best

        size, without_progress = FIRST_SIZE, 0
        successes = np.ones(len(BANDWIDTHS))
        while without_progress < patience and budget.exhausted is None:
            # Bandwidths that have led to improvements are tried more often.
            choice = int(self._rng.choice(len(BANDWIDTHS), p=successes / successes.sum()))
            found = self._repeatable(
                self.largest(best.about, self._changed(best, BANDWIDTHS[choice], size), budget),
                best,
            )
            if found is None:
                size = max(size * AFTER_FAILURE, SMALLEST_SIZE)
                without_progress += 1
                continue

            without_progress = 0 if is_progress(best.cost, found.cost) else without_progress + 1
            size = min(size * AFTER_SUCCESS, LARGEST_SIZE)
            successes[choice] += 1.0
            best = found
            yield best

    def fitted(self, deviation: Array) -> Array:
        """The nearest deviation, (N, nu), that has the bandwidth which the experiment allows."""
        task = self.level.task
        basis = task.bandwidth_basis(task.stated_times)
        if basis is None:
            return deviation
        return np.asarray(basis @ np.linalg.lstsq(basis, deviation)[0])

    def _evaluated(self, about: Array, deviation: Array, share: float) -> InsideControl | None:
        """A control with its cost; None where it violates a limit or tells nothing."""
        point = self.level.inside(about + deviation)
        if point is None or not np.isfinite(point.cost):
            return None
        return InsideControl(about=about, deviation=deviation, point=point, share=share)

    def _proposed(
        self, best: InsideControl, bandwidth: float | None, budget: Budget
    ) -> InsideControl | None:
        """A random control of a bandwidth, or the best one, as large as the limits allow."""
        widths = self._widths
        if bandwidth is None:
            used = float((np.abs(best.deviation) / widths).max())
            wanted = best.deviation / max(used, LEAST_SHARE)
        else:
            noise = self._noise(bandwidth)
            wanted = self.fitted(widths * noise / np.abs(noise).max(axis=0))
        found = self.largest(best.about, wanted, budget)
        if found is None or (bandwidth is not None and found.cost >= best.cost):
            return found
        return self._enlarged(found, budget)

    def _enlarged(self, inside: InsideControl, budget: Budget) -> InsideControl:
        """Enlarge the deviation of one actuator after the other while all limits hold."""
        actuators = inside.deviation.shape[1]
        factors = np.ones(actuators)
        for factor in SINGLE_FACTORS if actuators > 1 else ():
            for i in range(actuators):
                larger = np.array(factors)
                larger[i] *= factor
                if budget.exhausted is not None:
                    break
                if self.level.nearly_keeps(inside.about + larger * inside.deviation):
                    factors = larger
        if (factors == 1.0).all():
            return inside
        found = self._evaluated(inside.about, factors * inside.deviation, inside.share)
        return inside if found is None or found.cost >= inside.cost else found

    def _changed(self, best: InsideControl, bandwidth: float, size: float) -> Array:
        """(N, nu) deviation with a random change of all actuators, or of one of them."""
        noise = self._noise(bandwidth)
        actuators = noise.shape[1]
        if actuators > 1 and self._rng.random() < SINGLE_SHARE:
            noise[:, np.arange(actuators) != self._rng.integers(actuators)] = 0.0

        # An actuator that rests gets a change in proportion to the others.
        widths = self._widths
        used = np.sqrt(((best.deviation / widths) ** 2).mean(axis=0))
        used = widths * np.maximum(used, used.mean())
        strength = np.sqrt((noise**2).mean(axis=0))
        strength = np.where(strength > 0.0, strength, 1.0)
        return np.asarray(best.deviation + self.fitted(size * used * noise / strength))

    def _noise(self, bandwidth: float) -> Array:
        """(N, nu) random curves that fade in, and fade out where the design ends at rest."""
        task = self.level.task
        N, nu = task.control.shape
        lines = max(round(bandwidth * (N // 2)), 1)
        spectrum = np.zeros((N // 2 + 1, nu), dtype=np.complex128)
        spectrum[1 : lines + 1].real = self._rng.standard_normal((lines, nu))
        spectrum[1 : lines + 1].imag = self._rng.standard_normal((lines, nu))

        # Even a motion that does not begin at rest must not jump at once.
        begin = np.clip(np.arange(N)[:, None] / (FADE_SHARE * N), 0.0, 1.0)
        return np.asarray(begin * task.fade(N) * np.fft.irfft(spectrum, n=N, axis=0))

    def _repeatable(self, found: InsideControl | None, best: InsideControl) -> InsideControl | None:
        """A control, or a smaller one of its form, that costs less and can be repeated.

        A control that amplifies small disturbances much cannot be repeated on a robot, whatever
        its information is.
        """
        for _ in range(SMALLER_TRIALS):
            if found is None or found.cost >= best.cost:
                return None
            growth = self._growth(found.control)
            if growth <= UNSTABLE_GROWTH or growth <= self._largest_growth:
                return found
            deviation, share = SMALLER * found.deviation, SMALLER * found.share
            found = self._evaluated(found.about, deviation, share)
        return None

    @cached_property
    def _largest_growth(self) -> float:
        """Largest amplification of a small disturbance that a control may have."""
        return max(UNSTABLE_GROWTH, self._growth(self.level.task.control))

    def _growth(self, control: Array) -> float:
        """Amplification of a small disturbance along a control: (N, nu)."""
        task = self.level.task
        try:
            return growth_along(task, task.plant.simulate(task.theta, control))
        except SimulationDivergedError:
            return np.inf

    @property
    def _widths(self) -> Array:
        """(nu,) half of the ranges of the controls [u-unit]."""
        return self.level.constraints.control.bounds.scale


# Singular values of the reachable ends, relative to the largest one, below which they count as
# zero: no control of reasonable size reaches these directions.
LEAST_REACH = 1e-6

# Shares of a control that are tried, and the largest number of corrections of each.
CORRECTION_SHARES = (1.0, 0.98, 0.94, 0.85, 0.72, 0.55, 0.35)
CORRECTIONS = 2


def _end_correction(level: DescentLevel, values: ConstraintValues) -> Array | None:
    """The smallest change of a control that moves the last state of a motion, to first order.

    It keeps the bandwidth that the experiment states. Without one it is free at each sample.

    Args:
        level: The level whose plant is linearised.
        values: Limited quantities along the motion.

    Returns:
        (N, nu, nv) change of the control [u-unit] for a unit of each component of the last state
        that has a tolerance [x-unit]. None with a free end, and where the motion diverges or is so
        unstable that its derivatives overflow.
    """
    constraints, task = level.constraints, level.task
    if constraints.end is None:
        return None
    try:
        A, B, _ = task.plant.derivatives.observation_jacobians(
            task.theta, values.trajectory, constraints.observations
        )
    except SimulationDivergedError:
        return None

    # Derivative of the last state by the control of each sample, in sizes of the controls.
    bounded = _has_tolerance(constraints.end)
    sizes = constraints.control.bounds.scale
    reach = np.eye(len(bounded))[bounded]
    by_control = np.empty((len(A), len(reach), B.shape[2]))
    with np.errstate(over="ignore", invalid="ignore"):
        for k in reversed(range(len(A))):
            by_control[k] = reach @ B[k] * sizes
            reach = reach @ A[k]

        # A control of limited bandwidth is a sum of splines, of which only the shares are free.
        curves = task.bandwidth_basis(task.stated_times)
        by_share = by_control if curves is None else np.tensordot(curves.T, by_control, axes=1)

        # States have several units, so that each row is divided by its tolerance.
        tolerance = constraints.end.bounds.scale[bounded]
        flat = by_share.transpose(1, 0, 2).reshape(len(tolerance), -1) / tolerance[:, None]
    if not np.isfinite(flat).all():
        return None

    inverse = np.linalg.pinv(flat, rcond=LEAST_REACH) / tolerance
    change = inverse.reshape(len(by_share), B.shape[2], len(tolerance)) * sizes[:, None]
    if curves is not None:
        change = np.tensordot(curves, change, axes=1)
    return np.asarray(change)


def _has_tolerance(end: EndStateConstraint) -> NDArray[np.bool_]:
    """(nx,) True for each component of the last state that has a tolerance."""
    return np.isfinite(end.bounds.upper)


def with_corrected_end(level: DescentLevel, control: Array, budget: Budget) -> InsideControl | None:
    """Find a large share of a control that keeps all limits, when its end is corrected.

    Args:
        level: The level, on the plant without the clamps that limits make unreachable.
        control: (N, nu) control, whose motion misses its target by little [u-unit].
        budget: A request to stop ends the search.

    Returns:
        The control; None where the motion does not miss its target, or no share helps.
    """
    centre = level.task.centre
    end, change = level.constraints.end, None
    for share in CORRECTION_SHARES:
        candidate = np.asarray(centre + share * (control - centre))
        for corrections_left in reversed(range(1 + CORRECTIONS)):
            values = level.values(candidate)
            if values is None or budget.stop.requested:
                break
            if level.constraints.is_feasible(values):
                point = level.point_along(values) if level.keeps_along(values) else None
                if point is not None and np.isfinite(point.cost):
                    deviation = candidate - centre
                    return InsideControl(about=centre, deviation=deviation, point=point)
                break
            margins = level.constraints.margins(values)
            misses = any(each < 0.0 for kind, each in margins.items() if kind.startswith("end_"))
            if not (misses and corrections_left):
                break
            # The change of the control hardly depends on its size, so that it is computed once.
            change = _end_correction(level, values) if change is None else change
            if end is None or change is None:
                return None
            difference = end.space.minus(values.trajectory.state[-1], end.target)
            candidate = np.asarray(candidate - change @ difference[_has_tolerance(end)])
    return None
