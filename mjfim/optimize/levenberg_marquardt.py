"""Levenberg-Marquardt inside bounds, and undamped Gauss-Newton, on condensed least squares.

Gauss-Newton is the method of the paper. The damping of Levenberg-Marquardt follows the ratio of the
actual to the predicted decrease of the cost (Nielsen 1999). Where damped steps gain little, a part
of the step without damping is tried. Bounds hold in every step, because each step is the solution
of a bounded linear least-squares problem. The module knows arrays and one protocol, not MuJoCo.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Protocol

import numpy as np

from mjfim.arrays import Array, record
from mjfim.optimize.condensed_least_squares import (
    Condensed,
    Step,
    bounded_least_squares,
    triangle,
)
from mjfim.parallel.budget import Budget, StopReason

# Largest number of linearisations of the curved rows within a step.
MAX_LINEARISATIONS = 60

# Decrease of the cost, relative to that since the begin of the step, below which a step has ended.
LEAST_DECREASE = 1e-6

# Halvings of a part of a step that leaves the region or raises the cost.
MAX_HALVINGS = 30

# Rows `[J, r]` at the end of a step of the common unknowns: (c,), with derivatives by that step;
# None where the step leaves the region in which they exist.
CurvedRows = Callable[[Array], Array | None]


def step_over_curved_rows(
    condensed: Condensed,
    curved: CurvedRows,
    damping: float,
    scale: Array,
    lower: Array,
    upper: Array,
) -> Step:
    """Minimiser of the damped linearised cost, whose common rows are curved.

    Args:
        condensed: The linearisation, with the common rows at the begin of the step.
        curved: The common rows along the step.
        damping: Damping factor.
        scale: (n+c,) scale of every unknown.
        lower: (c,) lower bounds of the step of the common unknowns, at most 0.
        upper: (c,) upper bounds of the step of the common unknowns, at least 0.

    Returns:
        The step with its predicted decrease.
    """
    data = triangle(condensed.damped_rows(damping, scale))
    at = np.zeros(condensed.common_count)
    rows = condensed.common_rows
    first = cost = _half_squares(data[:, -1]) + _half_squares(rows[:, -1])

    for _ in range(MAX_LINEARISATIONS):
        # Rows are written as functions of the whole step.
        of_step = np.column_stack([rows[:, :-1], rows[:, -1] - rows[:, :-1] @ at])
        joined = triangle(np.concatenate([data, of_step]))
        wanted = bounded_least_squares(joined[:, :-1], -joined[:, -1], lower, upper)

        part = wanted - at
        for _ in range(MAX_HALVINGS):
            found = curved(at + part)
            if found is not None:
                residual = data[:, :-1] @ (at + part) + data[:, -1]
                found_cost = _half_squares(residual) + _half_squares(found[:, -1])
                if found_cost < cost:
                    break
            part = 0.5 * part
        else:
            break

        at, rows, decrease, cost = at + part, found, cost - found_cost, found_cost
        if decrease <= LEAST_DECREASE * (first - cost):
            break

    # The decrease of the step counts the curved rows at its end in place of the linear ones.
    step = condensed.step_to(at, damping, scale)
    linear = condensed.common_rows
    residual = linear[:, -1] + linear[:, :-1] @ at
    missed = _half_squares(rows[:, -1]) - _half_squares(residual)
    return replace(step, predicted_decrease=step.predicted_decrease - missed)


def _half_squares(residual: Array) -> float:
    """Half of the sum of squares."""
    return 0.5 * float(residual @ residual)


# Damping of the first step, relative to the squared column norms of the Jacobian.
INITIAL_DAMPING = 1e-3

# Damping (nearly zero) of the step whose length estimates the distance to the minimum, and of the
# first step of a search that begins near it.
WEAK_DAMPING = 1e-6

# Damping above which the search gives up: no step lowers the cost.
MAX_DAMPING = 1e12

# Damping never falls below this value, so that it can still grow by multiplication.
MIN_DAMPING = 1e-15

# Smallest value from which the damping grows after a rejected step.
MIN_RAISED_DAMPING = 1e-12

# Ratio of the actual to the predicted decrease below which a step is rejected.
MIN_DECREASE_RATIO = 1e-4

# Ratio of the actual to the predicted decrease, above which a larger one does not change the
# damping further.
MAX_DECREASE_RATIO = 10.0

# Decrease of the cost, relative to the cost, below which an iteration counts as stagnant.
RELATIVE_STAGNATION = 1e-6

# Decrease of the cost below which an iteration counts as stagnant. A step to the minimum that is
# 0.14 standard deviations long lowers the cost by this much.
ABSOLUTE_STAGNATION = 1e-2

# Share of the predicted decrease below which an iteration counts as stagnant.
PREDICTED_STAGNATION = 0.1

# Number of consecutive stagnant iterations after which the search ends, and that number where the
# true accuracy is much worse than the formal one, or where a linearisation takes long.
MAX_STAGNANT_ITERATIONS = 3
MAX_ROUGH_ITERATIONS = 2

# Length of a step [standard deviations] that the roughness of a simulation can explain. Where a
# predicted step is shorter and does not lower the cost, the search has converged.
SHORT_STEP = 0.3

# This length for the private unknowns [standard deviations]. They are no result, and where a joint
# sticks, residuals are rough along them.
SHORT_PRIVATE_STEP = 1.0

# This length where the true accuracy is much worse than the formal one [true standard deviations]:
# the model does not explain the data, and the residuals are rough besides.
SHORT_ROUGH_STEP = 0.5

# Length of the step before the first one [standard deviations], which is assumed. The first step of
# a search counts as the last one only if it is so short that a quadratic decrease of this step
# explains it.
ASSUMED_LENGTH = 1.0

# A step is complete if the predicted step is shorter than this multiple of it.
COMPLETE_STEP = 1.1

# Ratio of the actual to the predicted decrease above which a step is lengthened, and the largest
# factor by which it is.
MIN_RATIO_TO_LENGTHEN = 1.2
MAX_LENGTHENING = 3.0

# Number of iterations after which a part of a step without damping is tried, the largest part, and
# a limit below which none is tried.
MANY_ITERATIONS = 15
FIRST_PART = 0.25
LAST_PART = 0.05

# Share of what a part promises. A part is tried where the damped step gains less than this share.
SMALL_SHARE = 0.5

# Decrease of the cost, relative to the cost, below which a search is near enough to its minimum for
# its residuals to show how much they are autocorrelated.
NEAR_DECREASE = 1e-2

# A search has no chance to beat a cost if it would stay above it with this multiple of the decrease
# that is left by its linearisation. The first iterations may be far from a linear range.
FUTILE_FACTOR = 3.0
MIN_ITERATIONS_TO_BEAT = 3

# Private unknowns have converged when their steps are below this multiple of the tolerance.
PRIVATE_TOLERANCE = 10.0

# Smallest fraction of a Gauss-Newton step that is tried.
MIN_FRACTION = 1e-8

# Smallest predicted decrease in the denominator of the decrease ratio.
SMALLEST_DECREASE = 1e-300


@record
class UnknownValues:
    """Values of all unknowns of a fit.

    Attributes:
        theta: (p,) parameters that all recordings share; entries that are private or per recording
            are unused.
        private: (P, n) private unknowns of each segment, e.g. its initial state.
        per_recording: (K, e) parameters with a value for each recording.
    """

    theta: Array
    private: Array
    per_recording: Array = field(default_factory=lambda: np.zeros((0, 0)))


class Problem(Protocol):
    """Cost as a function of the unknowns, whose gradient is that of a sum of squares.

    The cost is half of the sum of squared residuals and priors. A robust loss may replace the
    square, and minus the logarithm of the likelihood the whole, where the noise is estimated.
    """

    def bounds_at(self, at: UnknownValues) -> tuple[Array, Array]:
        """(c,) lower and (c,) upper bounds of each common unknown where the others stay."""

    def cost(self, at: UnknownValues) -> float:
        """The cost, up to a constant.

        Args:
            at: The unknowns.

        Returns:
            The cost; infinite where a simulation diverges.
        """

    def condense(self, at: UnknownValues) -> Condensed | None:
        """Linearise about the unknowns.

        Args:
            at: The unknowns.

        Returns:
            The condensed linearisation; None where a perturbed simulation diverges.
        """

    def moved(self, at: UnknownValues, step: Step, fraction: float) -> UnknownValues:
        """The unknowns after a fraction of a step, inside the bounds.

        Args:
            at: The unknowns.
            step: Step of all unknowns.
            fraction: Fraction of the step.

        Returns:
            The moved unknowns.
        """

    def common_values(self, at: UnknownValues) -> Array:
        """Values of the common unknowns.

        Args:
            at: The unknowns.

        Returns:
            (c,) values.
        """


@dataclass(frozen=True, kw_only=True, eq=False)
class Solution:
    """Result of a search.

    Attributes:
        unknowns: Best values that were found.
        condensed: Linearisation at the unknowns, or less than one tolerance away from them.
        cost: Cost at the unknowns.
        iterations: Number of iterations, including the last incomplete one.
        success: True where the search converged.
        status: Sentence that says why the search ended.
        interrupted: True where the stop token ended the search.
        stuck: True where no step lowered the cost, although the linearisation predicts one.
        rough: True where the search ended near the minimum, by `SearchSettings.rough_share`, or
            where it was slow.
        slow: True where the search ended because its iterations brought little, by
            `SearchSettings.stagnant_share`.
    """

    unknowns: UnknownValues
    condensed: Condensed
    cost: float
    iterations: int
    success: bool
    status: str
    interrupted: bool = False
    stuck: bool = False
    rough: bool = False
    slow: bool = False


@record
class SearchSettings:
    """Settings of a search.

    Attributes:
        max_iterations: Largest number of iterations.
        tolerance: Length of a step below which the search has converged: the root mean square over
            the common unknowns [standard deviations].
        damped: True for Levenberg-Marquardt, False for Gauss-Newton.
        relinearise_at_end: Whether to linearise once more at the solution. False saves one
            linearisation: the search ends when the next step is expected to be below the tolerance.
        rough_share: Predicted decrease of the cost, as a share of the cost, below which a step is
            the last one. It serves searches that need not converge; 0 for the others.
        rough_above: Cost above which alone `rough_share` ends the search.
        curved_rows: The common rows at the end of a step from given unknowns, where they are not
            linear along a step (`step_over_curved_rows`); None where they are.
        begins_near: Whether the search begins near the minimum, with hardly any damping. Damping
            would slow it down along combinations that the data determine little.
        in_true_deviations: True to measure lengths in standard deviations that allow for
            autocorrelated residuals, because what is far below the true accuracy need not be
            searched for. False for formal standard deviations.
        cost_to_beat: Cost above which a minimum is of no use. The search ends where its linearised
            cost stays clearly above it.
        lengthens: Whether a step is lengthened where the cost falls by more than predicted. Robust
            losses are linearised by weights that make the curvature of the linearised cost too
            large, so that steps are too short.
        stagnant_share: Decrease of the cost, as a share of it, up to which an iteration is of
            little use. Two of them in turn end a search that need not converge; 0 for the others.
    """

    max_iterations: int = 60
    tolerance: float = 1e-4
    damped: bool = True
    relinearise_at_end: bool = True
    rough_share: float = 0.0
    rough_above: float = 0.0
    curved_rows: Callable[[UnknownValues, Array], Array | None] | None = None
    begins_near: bool = False
    in_true_deviations: bool = False
    cost_to_beat: float = np.inf
    lengthens: bool = False
    stagnant_share: float = 0.0


# What is called after every accepted iteration: with its number from 1, the cost at the new
# unknowns, and the length of the step of the common unknowns [standard deviations].
Callback = Callable[[int, float, float], None]


def minimise(
    problem: Problem,
    start: UnknownValues,
    settings: SearchSettings,
    budget: Budget | None = None,
    callback: Callback | None = None,
) -> Solution | None:
    """Search for a local minimum of the cost from an initial guess.

    The budget is asked before every trial step and before every linearisation. When it is
    exhausted, the best values so far are returned; nothing is raised.

    Args:
        problem: Cost and linearisation.
        start: Initial guess.
        settings: Tolerance, number of iterations and kind of step.
        budget: Time and stop token; default: no limit.
        callback: Called after every accepted iteration.

    Returns:
        The solution, or None where the initial guess or its neighbourhood diverges.
    """
    cost = problem.cost(start)
    condensed = problem.condense(start) if np.isfinite(cost) else None
    if condensed is None:
        return None

    at = start, cost, condensed
    return _Search(problem, settings, budget or Budget(), callback, at).run()


@dataclass(frozen=True, kw_only=True, eq=False)
class _Trial:
    """A step and the point to which it leads.

    Attributes:
        step: The complete step.
        unknowns: Values after the fraction of the step.
        cost: Cost at these values.
        fraction: Fraction of the step that was taken; above 1 where it was lengthened.
        ratio: Actual decrease of the cost over the predicted one.
    """

    step: Step
    unknowns: UnknownValues
    cost: float
    fraction: float
    ratio: float


class _Search:
    """State of one search: the current point, its linearisation and the damping."""

    def __init__(
        self,
        problem: Problem,
        settings: SearchSettings,
        budget: Budget,
        callback: Callback | None,
        at: tuple[UnknownValues, float, Condensed],
    ) -> None:
        self.problem, self.settings, self.budget, self.callback = (
            problem,
            settings,
            budget,
            callback,
        )
        self.unknowns, self.cost, self.condensed = at
        self.iteration = self.stagnant_iterations = self.slow_iterations = 0
        self.damping, self.damping_growth = 0.0, 2.0
        if settings.damped:
            self.damping = WEAK_DAMPING if settings.begins_near else INITIAL_DAMPING
        # A length of many unknowns is compared with the root mean square of each.
        self.unknowns_length = float(np.sqrt(max(self.condensed.common_count, 1)))
        self.previous_length = ASSUMED_LENGTH
        self.unit, self.unit_is_known = 1.0, not settings.in_true_deviations
        self.scale = self.condensed.column_norms

    def run(self) -> Solution:
        """Iterate until the search ends."""
        while self.iteration < self.settings.max_iterations:
            if (ended := self._iterate()) is not None:
                return ended

        return self._solution(f"not converged in {self.settings.max_iterations} iterations")

    def _iterate(self) -> Solution | None:
        """Take one step and linearise at its end; return the solution where the search ends."""
        if (stopped := self._stopped()) is not None:
            return stopped

        # Marquardt's scaling: column norms never shrink, so that the damping does not forget a
        # column.
        self.iteration += 1
        self.scale = np.maximum(self.scale, self.condensed.column_norms)

        trial = self._accepted_trial()
        if isinstance(trial, Solution):
            return trial

        if self.cost - trial.cost < NEAR_DECREASE * self.cost:
            self._find_unit()

        # The search ends where the cost no longer falls, even if the linearisation predicts a
        # decrease.
        predicted = self._predicted_step()
        trial = self._bolder(trial, predicted)
        if self._stagnates(trial, predicted):
            self.unknowns = trial.unknowns
            self.cost = trial.cost
            return self._without_progress(predicted)

        converged = self._converged(trial, predicted)
        futile = self._is_futile(trial, predicted)
        near = trial.fraction == 1.0 and self._is_near(trial, predicted)
        if self.settings.lengthens and not (converged or futile or near):
            trial = self._lengthened(trial)
        slow = self._is_slow(trial)
        self.previous_length = trial.fraction * trial.step.common_length
        self.unknowns = trial.unknowns
        self.cost = trial.cost
        if self.callback is not None:
            self.callback(self.iteration, self.cost, self.previous_length)

        if converged:
            # The last step is linearised at its end where the settings ask for it.
            relinearises = self.settings.relinearise_at_end
            anew = self.problem.condense(self.unknowns) if relinearises else None
            self.condensed = self.condensed.after(trial.step) if anew is None else anew
            return self._solution("converged: the step vanished", success=True)
        if near or (slow and trial.fraction == 1.0):
            self.condensed = self.condensed.after(trial.step)
            return self._solution("near the minimum", success=True, rough=True, slow=not near)
        if futile:
            return self._solution("stopped: another minimum costs less")
        return self._linearise(trial.ratio)

    def _linearise(self, ratio: float) -> Solution | None:
        """Adapt the damping to the ratio of actual to predicted decrease, and linearise.

        Return the solution where the search ends.
        """
        if self.settings.damped:
            # Source: Nielsen (1999), eq. 2.5.
            factor = max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3)
            self.damping = max(self.damping * factor, MIN_DAMPING)
            self.damping_growth = 2.0
        if (stopped := self._stopped()) is not None:
            return stopped
        linearised = self.problem.condense(self.unknowns)
        if linearised is None:
            return self._solution("stopped: the simulation diverges next to the estimate")
        self.condensed = linearised
        return None

    def _lengthened(self, trial: _Trial) -> _Trial:
        """A longer step along an accepted one, if the cost falls further there; else this step.

        The decrease that a step without damping and bounds predicts is half of what its slope
        alone promises. A parabola with this slope through both costs has its minimum at
        `1 / (2 - ratio)` of the step; this is a little less than it is for a part of a step.

        Args:
            trial: The accepted step from the present unknowns.
        """
        if trial.ratio < MIN_RATIO_TO_LENGTHEN or self.budget.exhausted is not None:
            return trial
        factor = MAX_LENGTHENING
        if trial.ratio < 2.0:
            factor = min(1.0 / (2.0 - trial.ratio), MAX_LENGTHENING)
        fraction = factor * trial.fraction
        further = self.problem.moved(self.unknowns, trial.step, fraction)
        cost = self.problem.cost(further)
        if cost >= trial.cost:
            return trial
        return replace(trial, unknowns=further, cost=cost, fraction=fraction)

    def _bolder(self, trial: _Trial, predicted: Step) -> _Trial:
        """A part of the step without damping, if the cost falls further there; else the trial.

        Damping shortens steps most along combinations that the data determine little, such as the
        common scale of gains, friction and inertia. Where residuals are rough in other directions,
        the damping stays large, and such a search would creep. Short searches need no such parts,
        and take more iterations with them.

        Args:
            trial: The accepted step from the present unknowns.
            predicted: The step without damping.
        """
        may_creep = self.iteration > MANY_ITERATIONS and self.damping > INITIAL_DAMPING
        fraction = FIRST_PART if may_creep else 0.0
        while fraction > LAST_PART and self.budget.exhausted is None:
            expected = SMALL_SHARE * fraction * predicted.predicted_decrease
            if self.cost - trial.cost >= expected:
                break
            part = self._trial(predicted, fraction)
            # Its own ratio decides on the damping: what is rough stays damped.
            if part.cost < trial.cost:
                return part
            fraction *= 0.5
        return trial

    def _accepted_trial(self) -> _Trial | Solution:
        """Raise the damping until a step lowers the cost.

        Return a solution where no step lowers it, or where the budget is exhausted.
        """
        step = self._step(self.damping)
        while True:
            trial = self._trial(step)

            # A step below the tolerance may miss the predicted decrease: round-off of the
            # simulation hides it.
            small = self._is_small(trial.step)
            if trial.cost <= self.cost and (trial.ratio > MIN_DECREASE_RATIO or small):
                return trial

            if small or self.damping > MAX_DAMPING or not self.settings.damped:
                return self._without_progress(self._predicted_step())

            self.damping = max(self.damping, MIN_RAISED_DAMPING) * self.damping_growth
            self.damping_growth *= 2.0
            step = self._step(self.damping)

            if (stopped := self._stopped()) is not None:
                return stopped

    def _trial(self, step: Step, fraction: float = 1.0) -> _Trial:
        """Evaluate a fraction of a step.

        Without damping, the step is halved while it raises the cost.
        """
        while True:
            unknowns = self.problem.moved(self.unknowns, step, fraction)
            cost = self.problem.cost(unknowns)

            useless = fraction < MIN_FRACTION or self._is_small(step)
            if self.settings.damped or cost <= self.cost or useless:
                break
            fraction *= 0.5

        expected = fraction * (2.0 - fraction) * step.predicted_decrease
        ratio = (self.cost - cost) / max(expected, SMALLEST_DECREASE)
        return _Trial(
            step=step,
            unknowns=unknowns,
            cost=cost,
            fraction=fraction,
            ratio=min(ratio, MAX_DECREASE_RATIO),
        )

    def _step(self, damping: float) -> Step:
        """Minimiser of the damped linearised cost, within the bounds."""
        values = self.problem.common_values(self.unknowns)
        lower, upper = (bound - values for bound in self.problem.bounds_at(self.unknowns))
        lower, upper = np.minimum(lower, 0.0), np.maximum(upper, 0.0)
        curved = self.settings.curved_rows
        if curved is None:
            return self.condensed.step(damping, self.scale, lower, upper)
        along = partial(curved, self.unknowns)
        return step_over_curved_rows(self.condensed, along, damping, self.scale, lower, upper)

    def _predicted_step(self) -> Step:
        """Step to the minimum of the linearised cost, without damping.

        A damped step may be short far from the minimum, so its length does not show convergence.
        """
        return self._step(WEAK_DAMPING if self.settings.damped else 0.0)

    def _find_unit(self) -> None:
        """Find the unit of lengths by the residuals, if it is not known yet."""
        if not self.unit_is_known:
            self.unit = self.condensed.true_deviation
            self.unit_is_known = True

    @property
    def _tolerance(self) -> float:
        """Length of a step [formal standard deviations] below which the search has converged."""
        return self.settings.tolerance * self.unit * self.unknowns_length

    def _is_small(self, step: Step) -> bool:
        """Whether a step is below the tolerance."""
        private_tolerance = PRIVATE_TOLERANCE * self.settings.tolerance * self.unit
        is_short = step.common_length < self._tolerance
        return is_short and step.private_length < private_tolerance

    def _stagnates(self, trial: _Trial, predicted: Step) -> bool:
        """Count consecutive iterations that hardly lower the cost; True after too many of them."""
        absolute = ABSOLUTE_STAGNATION * self.unknowns_length**2
        negligible = min(RELATIVE_STAGNATION * self.cost, absolute)

        # A search that converges slowly, but as predicted, goes on, unless what it can gain is far
        # below the true accuracy.
        most = MAX_STAGNANT_ITERATIONS
        if not self.settings.relinearise_at_end:
            # Long iterations are not worth a small share of the true standard deviations. Where
            # the linearisation predicts no more either, a single one is enough.
            negligible = absolute * self.unit**2
            is_predicted = predicted.predicted_decrease <= negligible
            most = 1 if self.unit > 1.0 and is_predicted else MAX_ROUGH_ITERATIONS
        elif self.unit > 1.0:
            negligible *= self.unit**2
            most = MAX_ROUGH_ITERATIONS
        else:
            negligible = min(negligible, PREDICTED_STAGNATION * predicted.predicted_decrease)
        is_stagnant = self.cost - trial.cost <= negligible
        self.stagnant_iterations = self.stagnant_iterations + 1 if is_stagnant else 0
        return self.stagnant_iterations >= most

    def _converged(self, trial: _Trial, predicted: Step) -> bool:
        """Whether the step that was taken is the last one."""
        if trial.fraction != 1.0:
            return False

        # A short step proves convergence only where damping did not shorten it.
        if (
            self.damping <= INITIAL_DAMPING
            and self._is_small(trial.step)
            and self._is_small(predicted)
        ):
            return True

        if self.settings.relinearise_at_end:
            return False

        # Or where the next step is expected to be below the tolerance: Gauss-Newton steps shrink
        # quadratically near the minimum.
        length = trial.step.common_length
        next_length = np.inf
        if self.previous_length > 0.0:
            next_length = length * (length / self.previous_length) ** 2

        complete = (
            predicted.common_length < COMPLETE_STEP * length
            and predicted.private_length < SHORT_STEP * self.unit
        )
        short = SHORT_STEP * self.unit * self.unknowns_length
        return complete and length < short and next_length < self._tolerance

    def _is_near(self, trial: _Trial, predicted: Step) -> bool:
        """Whether a search that need not converge has come near the minimum.

        The minimum of the linearised cost was not much lower than the cost.
        """
        is_small = predicted.predicted_decrease < self.settings.rough_share * self.cost
        return is_small and trial.cost > self.settings.rough_above

    def _is_slow(self, trial: _Trial) -> bool:
        """Count consecutive iterations of little use; True after too many of them."""
        share = self.settings.stagnant_share
        is_slow = self.cost - trial.cost <= share * self.cost
        self.slow_iterations = self.slow_iterations + 1 if is_slow else 0
        return share > 0.0 and self.slow_iterations >= MAX_ROUGH_ITERATIONS

    def _is_futile(self, trial: _Trial, predicted: Step) -> bool:
        """Whether the minimum will cost more than what is to be beaten.

        The linearised cost may miss its own minimum by some times what is left of the decrease.
        """
        if self.iteration < MIN_ITERATIONS_TO_BEAT:
            return False
        left = max(trial.cost - (self.cost - predicted.predicted_decrease), 0.0)
        return trial.cost - FUTILE_FACTOR * left > self.settings.cost_to_beat

    def _without_progress(self, predicted: Step) -> Solution:
        """Solution where no step lowers the cost: converged if the predicted step is short."""
        self._find_unit()
        short = SHORT_ROUGH_STEP * self.unit if self.unit > 1.0 else SHORT_STEP
        is_short = predicted.common_length < short * self.unknowns_length
        if is_short and predicted.private_length < max(short, SHORT_PRIVATE_STEP):
            return self._solution("converged: the residual stopped falling", success=True)

        return self._solution(
            "stopped: no step lowers the residual any more, though the linearised model predicts "
            "one",
            stuck=True,
        )

    def _stopped(self) -> Solution | None:
        """Best values so far, where the budget is exhausted."""
        reason = self.budget.exhausted
        if reason is None:
            return None
        return self._solution(
            f"{reason.value}; the best estimate so far",
            interrupted=reason is StopReason.REQUESTED,
        )

    def _solution(self, status: str, success: bool = False, **more: bool) -> Solution:
        """The current point as a solution, with further fields of it."""
        return Solution(
            unknowns=self.unknowns,
            condensed=self.condensed,
            cost=self.cost,
            iterations=self.iteration,
            success=success,
            status=status,
            **more,
        )
