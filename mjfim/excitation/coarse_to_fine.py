"""Descents under hard limits from coarse to fine levels, with fewer and fewer starts.

An iteration on a coarse level takes a small part of the time of one on the stated level, and its
minima lie close to those of the stated level. So most of the way is done there: all starts are
optimised with a large barrier weight on the coarsest level, and after each level the best quarter
of them continues with smaller weights on the next finer one, up to the stated level. After each
round, the largest share of each control that keeps all limits of the unmodified model is kept, so
that there is a good control within the limits however early the time ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mjfim.excitation.coarse_comparison import CoarseComparison
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import BarrierSchedule
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.limited_rounds import LimitedRounds
from mjfim.excitation.limited_searches import SearchTerms
from mjfim.excitation.merged_results import append_run
from mjfim.excitation.rounds import Entry, Judge, Round
from mjfim.excitation.run_result import RunResult
from mjfim.records.design import Status

# Share of the time that is left, and of the iterations, for a round that is not the last one.
ROUND_SHARE = 0.4

# Barrier weights with which the coarse levels end, by their number. Iterations on the stated level
# are so expensive that the levels before have to come near the optimum.
LAST_WEIGHTS: dict[int, tuple[float, ...]] = {
    1: (1e-3,),
    2: (0.03, 3e-4),
    3: (0.03, 3e-4, 1e-4),
}

# Barrier weight with which the stated level begins. It is larger than that with which the level
# before ends, because the jumps of a control move to other samples.
STATED_FIRST_WEIGHT = 1e-3

# Smallest barrier weight on the stated level, the ratio of the barrier's relaxation to its weight,
# and the slope at which the descent has converged there. With the optimum so close, only the
# barrier keeps the cost above it.
STATED_LAST_WEIGHT = 1e-5
STATED_RELAXATION = 0.1
STATED_TOLERANCE = 1e-6

# Number of iterations in the time of a search on the stated level below which its five stages would
# end before a step. It then begins with the barrier weight of the level before, and ends with the
# usual smallest one.
FEW_ITERATIONS = 10.0

# Number of iterations for which each start of the first round should have time.
ITERATIONS_OF_A_START = 50


@dataclass(frozen=True, kw_only=True, eq=False)
class CoarseToFine(LimitedRounds):
    """Rounds of descents on finer and finer levels.

    Attributes:
        levels: The coarser levels, the coarsest first; at least one.
    """

    levels: tuple[DescentLevel, ...]

    @cached_property
    def rounds(self) -> Sequence[Round]:
        """A round on each level."""
        weights = LAST_WEIGHTS[len(self.levels)]
        coarse = [
            Round(level=level, last_mu=mu, next_mu=mu, share=ROUND_SHARE)
            for level, mu in zip(self.levels, weights, strict=True)
        ]
        coarse[-1] = replace(coarse[-1], next_mu=STATED_FIRST_WEIGHT)
        return [*coarse, Round(level=self.searches.stated, last_mu=STATED_LAST_WEIGHT)]

    def terms(self, entry: Entry, seconds: float) -> SearchTerms:
        """Return the limits of the search of a start, see `RoundPlan`."""
        stage = self.rounds[entry.round]
        is_stated = stage.level is self.searches.stated
        share = 1.0 if is_stated else ROUND_SHARE
        left = max(self.max_iterations - entry.done, 1)

        # The descents end so close to an optimum that a sharp barrier takes most iterations.
        schedule = BarrierSchedule(first=entry.mu, last=stage.last_mu, follows_curvature=True)
        if is_stated:
            is_short = seconds < FEW_ITERATIONS * self.seconds_of_iteration(entry)
            sharp = replace(self.sharpest, first=entry.mu)
            schedule = self._short_schedule(entry) if is_short else sharp
        return SearchTerms(
            schedule=schedule,
            max_iterations=int(np.ceil(share * left)),
            seconds=seconds,
        )

    def judge(self, entry: Entry) -> Judge | None:
        """Who judges the result of a start, see `RoundPlan`."""
        is_last = entry.round == len(self.rounds) - 1
        return None if is_last else self.comparison(self.rounds[entry.round].level)

    def late(self, entry: Entry, result: RunResult, *, is_tried: bool) -> RunResult:
        """Result of a start that was not judged, see `RoundPlan`.

        It is brought inside the limits, which takes a few simulations.
        """
        compared = self.comparison(self.rounds[entry.round].level)
        return compared.on_stated_plant(self.limited_cost, result, is_tried=is_tried)

    def merged(self, before: RunResult | None, result: RunResult) -> RunResult:
        """Result of a start after a further round, see `RoundPlan`.

        It has the best control that keeps all limits.
        """
        if before is None:
            return result
        merged = append_run(before, result)
        if merged.control is None:
            merged = replace(merged, control=before.control)

        # The best control of an earlier round remains, also as a substitute.
        was_inside = np.isfinite(before.cost) and before.control is not None
        if was_inside and not merged.cost <= before.cost:
            status = Status.BEST_SEEN if merged.status.success else merged.status
            status = Status.MAX_ITERATIONS if status is Status.INFEASIBLE else status
            return replace(
                merged,
                control=before.control,
                cost=before.cost,
                earlier=before.earlier,
                status=status,
            )
        if was_inside and before.control is not None:
            return replace(merged, earlier=(*merged.earlier, before.control))
        return merged

    def may_begin(self, entry: Entry, *, has_feasible: bool) -> bool:
        """Check whether there is time for a useful search, see `RoundPlan`."""
        level = self.rounds[entry.round].level

        # A coarse level does not end within the limits, so that it cannot help any more.
        if self.searches.budget.exhausted is not None and level is not self.searches.stated:
            return False
        if not has_feasible:
            return True

        return self.has_time_for(entry)

    def next_round(self, number: int, done: int) -> int:
        """Number of the round that follows another one, see `RoundPlan`.

        The last iterations are for the stated level.
        """
        return number + 1 if done < self.max_iterations else len(self.rounds) - 1

    @property
    def sharpest(self) -> BarrierSchedule:
        """See `LimitedRounds.sharpest`."""
        return BarrierSchedule(
            first=STATED_FIRST_WEIGHT,
            last=STATED_LAST_WEIGHT,
            relaxation=STATED_RELAXATION,
            tolerance=STATED_TOLERANCE,
            follows_curvature=True,
        )

    def comparison(self, level: DescentLevel) -> CoarseComparison:
        """Who compares the results of a coarse level.

        Args:
            level: The level.
        """
        return CoarseComparison(sample_factor=level.task.system.variant.sample_factor)

    def affordable(self) -> Sequence[InitialControl]:
        """The first starts, as many as can be optimised roughly in the time of the first round."""
        starts = self.starts
        seconds = ROUND_SHARE * self.seconds_left
        if len(starts) == 1 or np.isinf(seconds):
            return starts

        # Measure an iteration at the initial control, without its line search. The first simulation
        # of a level takes longer, because it builds models.
        problem, initial = self.levels[0].problem, self.levels[0].task.initial
        problem.expand(problem.point(initial))
        begun = self.searches.budget.seconds_used
        problem.expand(problem.point(initial))
        each = ITERATIONS_OF_A_START * (self.searches.budget.seconds_used - begun)
        counts = range(1, len(starts) + 1)
        affordable = [n for n in counts if self.searches.turns(n) * each <= seconds]
        return starts[: max(affordable, default=1)]

    def _short_schedule(self, entry: Entry) -> BarrierSchedule:
        """Stages of the stated level where there is time for few iterations."""
        # A control that is far from an optimum still needs a blunt barrier.
        first = self.rounds[-2].last_mu if entry.mu <= STATED_FIRST_WEIGHT else entry.mu
        return BarrierSchedule(first=first, follows_curvature=True)
