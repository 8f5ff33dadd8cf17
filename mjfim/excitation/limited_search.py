"""Search within hard limits: descents, and random changes where these gain more."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.excitation.coarse_to_fine import CoarseToFine
from mjfim.excitation.coarser_levels import coarser_levels
from mjfim.excitation.controls_within_limits import (
    ControlsWithinLimits,
    InsideControl,
    LimitedCost,
)
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.levels import DescentLevel, easier_level
from mjfim.excitation.limited_rounds import LimitedRounds
from mjfim.excitation.limited_searches import LimitedSearches
from mjfim.excitation.merged_results import append_run
from mjfim.excitation.multistart import Multistart
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.random_search import LEAST_PROGRESS, PATIENCE, RandomSearch
from mjfim.excitation.run_result import RunResult, Runs
from mjfim.excitation.short_budget import still_allows_few_evaluations
from mjfim.excitation.task import DesignTask
from mjfim.parallel import ExecutorLike
from mjfim.records.design import HistoryRow, Status
from mjfim.records.events import DesignEvent

# Share of the time for random controls before a descent whose derivatives may mislead.
PROBE_SHARE = 0.1

# Number of evaluations in the time that is left below which all of it is for random controls. With
# dry friction, a descent takes about ten of them to make a smooth level, to take a step, and to
# bring its result inside the limits.
FEWEST_EVALUATIONS = 20.0

# Share of the time that is left for random changes of a control, between two descents, and for the
# report of the design after the last changes.
RANDOM_SHARE = 0.5
CLOSING_SHARE = 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundWithinLimits:
    """Controls that a search within hard limits has found.

    Attributes:
        results: Result of every start that was begun.
        inside: The best control that keeps all limits and was not found by a descent; None where
            there is none. A search that was stopped has not compared it with the results.
    """

    results: list[RunResult]
    inside: InsideControl | None


@dataclass(frozen=True, kw_only=True, eq=False)
class LimitedSearch:
    """Search for the best control within hard limits.

    Where contacts open and close, or where dry friction changes its sign, a descent may be held
    up far from any optimum. Random changes need no derivatives, and then gain more in the same
    time.

    Attributes:
        limited: Cost of controls that keep all limits.
        is_rough: Whether derivatives fail somewhere along the first start.
        executor: Runs several starts side by side, or None.
        budget: Time of the search and the token that stops it.
        first: The experiment's initial control, evaluated on the unmodified plant; None where it is
            not known.
        is_brief: Whether the time allows few evaluations only, by the first one.
        evaluation_seconds: Time of the first evaluation [s].
    """

    limited: LimitedCost
    is_rough: bool
    executor: ExecutorLike | None
    budget: Budget
    first: DesignPoint | None = None
    is_brief: bool = False
    evaluation_seconds: float = 0.0

    def run(
        self, starts: list[InitialControl], inside: InsideControl | None
    ) -> Generator[DesignEvent, None, FoundWithinLimits]:
        """Descend from several starts, and change controls at random where that gains more.

        Args:
            starts: The initial controls.
            inside: A control that keeps all limits, or None.

        Yields:
            Every iterate, and every random control that is better than all before.

        Returns:
            What was found.
        """
        plant = self._task.plant
        steps = plant.engine_steps
        search = RandomSearch(
            cost=self.limited,
            name=starts[0].name,
            time=self.budget,
            seed=self._task.experiment.descent.seed,
        )

        # Where derivatives may mislead, a descent has to be better than some random controls. With
        # little time, there is nothing else.
        best, cost_to_beat = inside, np.inf
        rows: tuple[HistoryRow, ...] = ()
        is_over = False
        if self.is_rough:
            best = self._best_inside(starts[0].control, inside)
        if best is not None and best is not inside:
            is_over = self._has_few_evaluations
            budget = self.budget.share(1.0 - CLOSING_SHARE if is_over else PROBE_SHARE)
            best, rows = yield from search.run(best, budget, patience=np.inf if is_over else 0)
            cost_to_beat = best.cost if rows else np.inf

        # A descent does not begin after the time is over.
        if best is not None and (is_over or self.budget.exhausted is not None):
            rows = rows or (search.row(best, 0),)
            result = self._without_descent(starts[0].name, best, rows)
            result = replace(result, steps=plant.engine_steps - steps)
            return FoundWithinLimits(results=[result], inside=best)

        results = yield from self._descend(starts, cost_to_beat=cost_to_beat)
        winner = min(range(len(results)), key=lambda i: results[i].cost, default=None)
        if winner is None or self.budget.stop.requested:
            return FoundWithinLimits(results=results, inside=best)
        if results[winner].is_held_up or results[winner].cost > cost_to_beat:
            results = list(results)
            result = results[winner]
            results[winner] = yield from self._helped_by_chance(search, result, best)
        return FoundWithinLimits(results=results, inside=best)

    @property
    def _has_few_evaluations(self) -> bool:
        """Whether the time that is left allows too few evaluations for a descent."""
        return self.budget.seconds_left < FEWEST_EVALUATIONS * self.evaluation_seconds

    def _without_descent(
        self, name: str, best: InsideControl, rows: tuple[HistoryRow, ...]
    ) -> RunResult:
        """Result of a search that had no time for a descent.

        Args:
            name: Name of the initial control.
            best: The best control within limits.
            rows: The random controls that led to it.
        """
        is_stopped = self.budget.stop.requested
        return RunResult(
            name=name,
            control=best.control,
            cost=best.cost,
            status=Status.INTERRUPTED if is_stopped else Status.MAX_ITERATIONS,
            history=rows,
        )

    def _descend(
        self,
        starts: list[InitialControl],
        *,
        cost_to_beat: float = np.inf,
        done: int = 0,
    ) -> Runs:
        """Descend within limits from several starts, after `done` iterations."""
        free = self.limited.level
        has_parts = any(start.repeats > 1 for start in starts)
        levels = () if done or has_parts else coarser_levels(free, self.first)
        searches = LimitedSearches(
            stated=free,
            executor=self.executor,
            budget=self.budget,
            until_held_up=True,
            cost_to_beat=cost_to_beat,
        )
        search: LimitedRounds
        if levels:
            search = CoarseToFine(searches=searches, starts=starts, levels=levels)
        else:
            coarse = None if done else easier_level(free, self.first)
            search = Multistart(
                searches=searches,
                starts=starts,
                coarse=coarse,
                is_brief=coarse is not None and self._is_brief_with(coarse),
                iterations_done=done,
            )
        constrained = yield from search.run()
        return (yield from search.tighten_winner(constrained))

    def _is_brief_with(self, coarse: DescentLevel) -> bool:
        """Check by an evaluation on a quicker level whether the time allows few evaluations.

        The first evaluation of a design may include work that is done once: workers start, models
        are copied. All that is done by now.
        """
        ratio = self.limited.level.engine_steps / coarse.engine_steps
        if not self.is_brief or ratio <= 1.0:
            return False
        if self.budget.exhausted is not None:
            return True

        begun = self.budget.seconds_used
        coarse.problem.point(coarse.task.initial)
        seconds = self.budget.seconds_used - begun
        return still_allows_few_evaluations(self.budget, ratio * seconds)

    def _helped_by_chance(
        self,
        search: RandomSearch,
        result: RunResult,
        inside: InsideControl | None,
    ) -> Generator[DesignEvent, None, RunResult]:
        """Continue a descent that is held up by random changes, and descend again from there.

        What makes more progress gets the time: random changes go on until they find nothing better
        for a while, the descent until it is held up again. Where one of them gains nothing, the
        rest of the time is for random changes.

        Args:
            search: The random search.
            result: Result of the descent.
            inside: A control that keeps all limits, or None.
        """
        best = self._best_inside(result.control, inside)
        if best is None:
            return result

        is_descent_useful = True
        while True:
            before = best
            result, best = yield from self._changed(search, result, best, is_descent_useful)
            done = result.history[-1].iteration if result.history else 0
            is_over = self.budget.exhausted is not None
            if is_over or not is_descent_useful or done >= self._max_iterations:
                return result

            is_descent_useful = _is_progress(before, best) and not self._has_few_evaluations
            if not is_descent_useful:
                continue

            # Descend from there.
            start = InitialControl(name=result.name, control=best.begin)
            found = yield from self._descend([start], done=done)
            if not found:
                return result
            descended = found[0]
            before, best = best, self._best_inside(descended.control, best) or best
            is_descent_useful = _is_progress(before, best)
            result = append_run(result, descended)
            result = replace(result, control=best.control, cost=best.cost)
            if not descended.is_held_up and best is not before:
                return result

    def _changed(
        self, search: RandomSearch, result: RunResult, best: InsideControl, is_descent_useful: bool
    ) -> Generator[DesignEvent, None, tuple[RunResult, InsideControl]]:
        """Change the best control at random, for a part of the time or for the rest of it."""
        plant = search.cost.level.task.plant
        steps = plant.engine_steps
        share, patience = 1.0 - CLOSING_SHARE, np.inf
        if is_descent_useful:
            share, patience = RANDOM_SHARE, float(PATIENCE)

        found, rows = yield from search.run(best, self.budget.share(share), patience)
        changed = RunResult(
            name=result.name,
            control=found.control,
            cost=found.cost,
            status=Status.BEST_SEEN if np.isinf(self.budget.deadline) else Status.MAX_ITERATIONS,
            slope=result.slope,
            history=rows,
            steps=plant.engine_steps - steps,
        )
        return append_run(result, changed), found

    @property
    def _max_iterations(self) -> int:
        """Largest number of iterations of one start."""
        return self._task.experiment.descent.max_iterations

    def _best_inside(
        self, control: Array | None, other: InsideControl | None
    ) -> InsideControl | None:
        """The largest share of a control, (N, nu), within limits, or another one that is better."""
        found = None
        if control is not None:
            trials = ControlsWithinLimits(cost=self.limited, budget=self.budget)
            centre = self._task.centre
            found = trials.largest(centre, control - centre)
        known = [inside for inside in (found, other) if inside is not None]
        return min(known, key=lambda inside: inside.cost, default=None)

    @property
    def _task(self) -> DesignTask:
        """The task on the plant without clamps."""
        return self.limited.level.task


def _is_progress(before: InsideControl, after: InsideControl) -> bool:
    """Check whether a control costs clearly less than another one."""
    return after.cost < before.cost - LEAST_PROGRESS * abs(before.cost)
