"""Optimisation under hard limits from several initial controls, with successive halving.

In the first round all starts are optimised with a large barrier weight, if possible on a plant that
is quicker to simulate. The best of them continue on the stated plant with a small barrier weight.
The best result may violate a limit of the unmodified model between the times at which the barrier
is evaluated; then it is optimised again within tighter limits.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mjfim.budget import Budget
from mjfim.excitation.controls_within_limits import LimitedCost
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import BarrierSchedule
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.merged_results import continued, merge_rounds, renumber
from mjfim.excitation.rescue import Rescue
from mjfim.excitation.run_result import RunResult, Runs
from mjfim.excitation.search_round import RoundTerms, SearchRounds
from mjfim.excitation.survivors import HALVING_RATE, choose_survivors, discard_others
from mjfim.excitation.tightened_runs import run_within_tighter_limits
from mjfim.excitation.winner_repair import WinnerRepair
from mjfim.parallel import ExecutorLike

# Last barrier weight mu of the first round.
FIRST_ROUND_MU = 0.01

# Last barrier weight mu of the first round with fewer than `HALVING_RATE` starts, where the coarse
# level differs by its timestep only: its minima are then close to those of the stated level.
FEW_STARTS_MU = 1e-3

# Ratio of the first mu of the second round to the last mu of the first round.
MU_RESTART_FACTOR = 3.0

# Share of the iterations and of the time for the first round.
FIRST_ROUND_SHARE = 0.5

# Share of the time that is reserved for runs within tighter limits.
RESERVED_SHARE = 0.05


@dataclass(frozen=True, kw_only=True, eq=False)
class Multistart:
    """Successive halving of several starts under hard limits.

    Attributes:
        fine: The stated level, on the plant without clamps.
        coarse: A level that is quicker to simulate, or smoother; None without one.
        executor: Runs the starts side by side; None to run them one by one in this process.
        budget: Time of the whole design, and the token that stops it.
        until_held_up: End searches whose steps become very short.
        cost_to_beat: Cost that random controls have reached, see `ConstrainedSearch`.
        iterations_done: Iterations of the design before.
    """

    fine: DescentLevel
    coarse: DescentLevel | None
    executor: ExecutorLike | None = None
    budget: Budget
    until_held_up: bool = False
    cost_to_beat: float = np.inf
    iterations_done: int = 0

    def run(self, starts: Sequence[InitialControl]) -> Runs:
        """Optimise from all starts in two rounds.

        Args:
            starts: The initial controls.

        Yields:
            Every iterate.

        Returns:
            One result per start that was begun; those of the survivors include the second round.
        """
        if self._needs_one_round(starts):
            return (yield from self._run_single_round(starts))

        few_starts = len(starts) < HALVING_RATE and self._differs_by_timestep_only
        last_mu = FEW_STARTS_MU if few_starts else FIRST_ROUND_MU
        results = yield from self._run_first_round(starts, last_mu)
        if self.budget.stop.requested:
            return results

        # The survivors are chosen by their cost on the stated plant.
        results, candidates = self._compare_on_stated_plant(results, starts)
        survivors = choose_survivors(candidates)
        if not survivors or self._are_beaten([candidates[i] for i in survivors]):
            return results

        results = discard_others(results, candidates, survivors)
        done = max((row.iteration for i in survivors for row in results[i].history), default=0)
        second = yield from self._run_second_round(
            [continued(candidates[i]) for i in survivors],
            first_mu=min(MU_RESTART_FACTOR * last_mu, FIRST_ROUND_MU),
            done=done,
        )
        return merge_rounds(results, second)

    def tighten_winner(self, results: Sequence[RunResult]) -> Runs:
        """Make the best result keep all limits of the unmodified model.

        It is optimised again within tighter limits. Where that does not help, its control is
        shrunk. Where no start found anything feasible, a feasible motion is searched for.

        Args:
            results: Result of every start.

        Yields:
            Every iterate.

        Returns:
            The results, of which the best one is replaced.
        """
        results = yield from run_within_tighter_limits(self.rounds, self.repair, results)
        results = self.repair.repaired(results)
        if any(np.isfinite(result.cost) for result in results) or self.budget.stop.requested:
            return results

        rescue = Rescue(rounds=self.rounds, repair=self.repair, max_iterations=self._max_iterations)
        return (yield from rescue.run(results))

    @cached_property
    def rounds(self) -> SearchRounds:
        """Runs the searches of a round."""
        return SearchRounds(
            executor=self.executor,
            budget=self.budget,
            until_held_up=self.until_held_up,
            cost_to_beat=self.cost_to_beat,
        )

    @cached_property
    def repair(self) -> WinnerRepair:
        """Makes results keep all limits of the unmodified model."""
        return WinnerRepair(cost=self._limited_cost, budget=self.budget)

    # ---- properties of the task

    @cached_property
    def _limited_cost(self) -> LimitedCost:
        """Cost of controls that keep all limits on the stated plant."""
        return LimitedCost(level=self.fine)

    @property
    def _reserved_seconds(self) -> float:
        """Time that is reserved for runs within tighter limits [s]; 0 without a limit of time."""
        return RESERVED_SHARE * (self.fine.task.experiment.descent.seconds or 0.0)

    @property
    def _differs_by_timestep_only(self) -> bool:
        """True where the coarse level has a longer timestep, but the stated samples and friction.

        Its minima are then close to those of the stated level.
        """
        if self.coarse is None:
            return True

        variant = self.coarse.task.system.variant
        return replace(variant, timestep_factor=1) == self.fine.task.system.variant

    def _needs_one_round(self, starts: Sequence[InitialControl]) -> bool:
        """Check whether there is one start only, whose control is free, and one level."""
        if len(starts) > 1 or self.coarse is not None:
            return False

        return all(start.basis is None and start.repeats == 1 for start in starts)

    # ---- choice of the survivors

    def _compare_on_stated_plant(
        self, results: Sequence[RunResult], starts: Sequence[InitialControl]
    ) -> tuple[list[RunResult], list[RunResult]]:
        """Results with their cost on the stated plant, and the candidates of the second round."""
        repeats = any(start.repeats > 1 for start in starts)
        if self.coarse is None and not repeats:
            return list(results), list(results)

        by_name = {start.name: start for start in starts}
        pairs = [self.reevaluate(result, by_name[result.name]) for result in results]
        return [result for result, _ in pairs], [candidate for _, candidate in pairs]

    def reevaluate(self, result: RunResult, start: InitialControl) -> tuple[RunResult, RunResult]:
        """Replace the cost on a coarse level by that on the stated plant.

        Args:
            result: Result of the first round.
            start: Its initial control.

        Returns:
            The result with the better of the found and the initial control, by their costs on the
            stated plant, and the candidate with which the second round would continue. The
            candidate differs from the result where the found control violates a limit on the
            stated plant: it is then the found control with its cost on the coarse level, because
            the second round makes it feasible again.
        """
        found = [control for control in (result.control, start.over_horizon) if control is not None]
        costs = [self._limited_cost(control) for control in found]

        best = int(np.argmin(costs))
        reevaluated = replace(result, cost=costs[best])
        if np.isfinite(reevaluated.cost):
            reevaluated = replace(reevaluated, control=found[best])

        violates = result.control is not None and np.isinf(costs[0])
        candidate = result if violates else reevaluated
        return reevaluated, candidate

    def _are_beaten(self, candidates: Sequence[RunResult]) -> bool:
        """Check whether all candidates are held up where random controls cost less."""
        return all(each.is_held_up and each.cost > self.cost_to_beat for each in candidates)

    # ---- the rounds

    @property
    def _max_iterations(self) -> int:
        """Largest number of iterations of one start over all rounds."""
        return max(self.fine.task.experiment.descent.max_iterations - self.iterations_done, 1)

    def _run_single_round(self, starts: Sequence[InitialControl]) -> Runs:
        """Optimise on the stated plant with all barrier weights."""
        terms = RoundTerms(
            schedule=BarrierSchedule(),
            max_iterations=self._max_iterations,
            seconds=self.budget.seconds_left - self._reserved_seconds,
        )
        return (yield from self.rounds.run(self.fine, starts, terms))

    def _run_first_round(self, starts: Sequence[InitialControl], last_mu: float) -> Runs:
        """Optimise all starts down to barrier weight `last_mu`, if possible on a coarse level."""
        seconds = FIRST_ROUND_SHARE * self.budget.seconds_left
        terms = RoundTerms(
            schedule=BarrierSchedule(last=last_mu),
            max_iterations=round(FIRST_ROUND_SHARE * self._max_iterations),
            seconds=seconds / self.rounds.turns(len(starts)),
        )
        return (yield from self.rounds.run(self.coarse or self.fine, starts, terms))

    def _run_second_round(
        self, starts: Sequence[InitialControl], *, first_mu: float, done: int
    ) -> Runs:
        """Continue the survivors on the stated plant, after `done` iterations."""
        seconds = max(self.budget.seconds_left - self._reserved_seconds, 0.0)
        terms = RoundTerms(
            schedule=BarrierSchedule(first=first_mu),
            max_iterations=self._max_iterations - done,
            seconds=seconds / self.rounds.turns(len(starts)),
        )
        events = self.rounds.run(self.fine, starts, terms)
        return (yield from renumber(events, done + 1))
