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
from dataclasses import dataclass, field, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.excitation.controls_within_limits import ControlsWithinLimits, InsideControl
from mjfim.excitation.evaluation import point_at_stated_rate
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import BarrierSchedule
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.merged_results import append_run, renumber, without_discarded_winner
from mjfim.excitation.multistart import Multistart
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.run_result import RunResult, Runs
from mjfim.excitation.search_round import RoundTerms
from mjfim.excitation.survivors import HALVING_RATE
from mjfim.excitation.winner_repair import SECONDS_AFTER_STOP
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

# Largest part of J on the stated plant that a coarse level may miss. Beyond that it is wrong, and
# the next level begins where this one began, if that is better.
LARGEST_ERROR = 1.0 / 3.0

# Number of iterations for which there has to be time before a round on a finer level begins.
FEWEST_ITERATIONS = 2.0

# Number of iterations for which each start of the first round should have time.
ITERATIONS_OF_A_START = 50


@dataclass(eq=False, kw_only=True)
class _State:
    """Results of the rounds so far.

    Attributes:
        starts: Controls with which the next round begins, the best one first.
        results: Result of every start by its name; the costs are those on the stated plant.
        mu: Weight of the barrier with which the next round begins.
        seconds_per_step: Time of an iteration over the engine steps of one simulation [s]; 0 before
            the first round.
        steps: Engine steps on the stated plant between the rounds.
    """

    starts: list[InitialControl]
    results: dict[str, RunResult] = field(default_factory=dict)
    mu: float = BarrierSchedule().first
    seconds_per_step: float = 0.0
    steps: int = 0

    @property
    def iterations(self) -> int:
        """Largest number of iterations of one start so far."""
        histories = [result.history for result in self.results.values()]
        return max((rows[-1].iteration + 1 for rows in histories if rows), default=0)

    @property
    def has_feasible(self) -> bool:
        """Whether there is a control that keeps all limits."""
        return any(np.isfinite(result.cost) for result in self.results.values())

    def discard_others(self) -> None:
        """Mark starts within the limits that do not take part in the next round."""
        continuing = {start.name for start in self.starts}
        for name, result in self.results.items():
            is_usable = np.isfinite(result.cost) and result.status is not Status.LOST
            if name not in continuing and is_usable:
                self.results[name] = replace(result, status=Status.LEFT)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Candidate:
    """A control with which the next round may begin.

    Attributes:
        cost: J by which candidates are compared: that on the coarse level, or that on the stated
            plant where the coarse one is too low.
        start: The control.
        is_new: Whether the round has found it; else the round began with it.
    """

    cost: float
    start: InitialControl
    is_new: bool = True


@dataclass(frozen=True, kw_only=True, eq=False)
class CoarseToFine(Multistart):
    """Rounds of descents on finer and finer levels.

    Attributes:
        levels: The coarser levels, the coarsest first; none for the rounds of `Multistart`.
    """

    levels: tuple[DescentLevel, ...]

    def run(self, starts: Sequence[InitialControl]) -> Runs:
        """Optimise from all starts on the coarsest level, then the best of them on finer ones.

        Args:
            starts: The initial controls.

        Yields:
            Every iterate.

        Returns:
            One result per start that was begun; its cost is that on the stated plant.
        """
        if not self.levels:
            return (yield from super().run(starts))

        plant = self.fine.task.plant
        state = _State(starts=self._affordable(starts))
        levels = (*self.levels, self.fine)

        weights = (*LAST_WEIGHTS[len(self.levels)], BarrierSchedule().last)
        for level, last_mu in zip(levels, weights, strict=True):
            if state.results and self._is_over(level, state):
                break

            # The last iterations are for the stated level.
            is_first_or_last = not state.results or level is self.fine
            if not is_first_or_last and state.iterations >= self._max_iterations:
                continue

            state.discard_others()
            found = yield from self._run_level(level, state, last_mu)
            steps_before = plant.engine_steps
            self._take(found, level, state)
            is_over = self._is_last_round(found, level)
            if not is_over:
                self._choose_starts(found, level, state, last_mu)
            state.steps += plant.engine_steps - steps_before
            if is_over:
                break

        results = without_discarded_winner(list(state.results.values()))
        if results:
            results[0] = replace(results[0], steps=results[0].steps + state.steps)
        return results

    def _is_last_round(self, found: Sequence[RunResult], level: DescentLevel) -> bool:
        """Check whether the search ends with the results of a round on a level."""
        if level is self.fine or self.budget.stop.requested:
            return True
        return len(found) > 0 and self._are_beaten(found)

    def _affordable(self, starts: Sequence[InitialControl]) -> list[InitialControl]:
        """The first starts, as many as can be optimised roughly in the time of the first round."""
        seconds = ROUND_SHARE * self._seconds_left
        if len(starts) == 1 or np.isinf(seconds):
            return list(starts)

        # Measure an iteration at the initial control, without its line search. The first simulation
        # of a level takes longer, because it builds models.
        problem, initial = self.levels[0].problem, self.levels[0].task.initial
        problem.expand(problem.point(initial))
        begun = self.budget.seconds_used
        problem.expand(problem.point(initial))
        each = ITERATIONS_OF_A_START * (self.budget.seconds_used - begun)
        counts = range(1, len(starts) + 1)
        affordable = [count for count in counts if self.rounds.turns(count) * each <= seconds]
        return list(starts[: max(affordable, default=1)])

    def _is_over(self, level: DescentLevel, state: _State) -> bool:
        """Check whether there is no time for a useful round on a level."""
        if self.budget.stop.requested:
            return True

        # A coarse level does not end within the limits, so that it cannot help any more.
        if self.budget.exhausted is not None and level is not self.fine:
            return True
        if not state.has_feasible:
            return False

        seconds = state.seconds_per_step * _engine_steps(level)
        return self._seconds_left < FEWEST_ITERATIONS * seconds

    @property
    def _seconds_left(self) -> float:
        """Time that is left for rounds [s]."""
        return max(self.budget.seconds_left - self._reserved_seconds, 0.0)

    def _run_level(self, level: DescentLevel, state: _State, last_mu: float) -> Runs:
        """Run one round on a level down to a barrier weight."""
        share = 1.0 if level is self.fine else ROUND_SHARE
        iterations_left = self._max_iterations - state.iterations
        turns = self.rounds.turns(len(state.starts))
        begun = self.budget.seconds_used

        terms = RoundTerms(
            schedule=BarrierSchedule(first=state.mu, last=last_mu),
            max_iterations=int(np.ceil(share * max(iterations_left, 1))),
            seconds=share * self._seconds_left / turns,
        )
        events = self.rounds.run(level, state.starts, terms)
        found = yield from renumber(events, state.iterations)

        longest = max((len(result.history) for result in found), default=0)
        elapsed = self.budget.seconds_used - begun
        state.seconds_per_step = elapsed / max(turns * longest, 1) / _engine_steps(level)
        return found

    def _take(self, found: Sequence[RunResult], level: DescentLevel, state: _State) -> None:
        """Take the results of a round, with the controls that keep all limits.

        All of them are brought inside the limits. After the end of the time this goes on for a few
        seconds only, as soon as there is any control inside.
        """
        waiting = Budget(seconds=SECONDS_AFTER_STOP)
        merged: dict[str, RunResult] = {}
        has_feasible = state.has_feasible

        for result in sorted(found, key=lambda result: result.cost):
            is_late = self.budget.exhausted is not None and waiting.exhausted is not None
            stated = result
            if level is not self.fine:
                stated = self._on_stated_plant(
                    result, level, is_tried=not (is_late and has_feasible)
                )

            merged[result.name] = self._merged(state.results.get(result.name), stated)
            has_feasible = has_feasible or bool(np.isfinite(stated.cost))

        # The results stay in the order of the starts.
        state.results.update({result.name: merged[result.name] for result in found})

    def _choose_starts(
        self, found: Sequence[RunResult], level: DescentLevel, state: _State, last_mu: float
    ) -> None:
        """Choose the starts and the barrier weight of the round after one on a coarse level.

        A round without any usable control changes nothing but the level.
        """
        begun = {start.name: start for start in state.starts}
        usable = [result for result in found if result.control is not None]
        count = max(1, len(usable) // HALVING_RATE)

        # The cost of a candidate is never lower than that on the coarse level. So the rest need not
        # be checked as soon as there are enough better ones.
        candidates: list[_Candidate] = []
        for result in sorted(usable, key=lambda result: result.cost):
            if sum(candidate.cost <= result.cost for candidate in candidates) >= count:
                break
            candidates.append(self._candidate(result, begun[result.name], level))

        best = sorted(candidates, key=lambda candidate: candidate.cost)[:count]
        state.starts = [candidate.start for candidate in best] or state.starts
        if any(candidate.is_new for candidate in best):
            state.mu = last_mu

    def _candidate(
        self, result: RunResult, begun: InitialControl, level: DescentLevel
    ) -> _Candidate:
        """The control that a coarse level has found, or the one before where that is better.

        The control before is tried only where the found one costs much more on the stated plant
        than on the coarse level.

        Args:
            result: Result of a round on a coarse level, with a control.
            begun: Control with which the round began.
            level: The coarse level.
        """
        control = self._without_jumps(np.asarray(result.control), level)
        found = InitialControl(name=result.name, control=control)
        point = self._point_without_limits(control)
        cost = np.inf if point is None else point.cost
        if point is not None and cost - result.cost <= LARGEST_ERROR * self.fine.problem.size(
            point
        ):
            return _Candidate(cost=result.cost, start=found)

        point_before = self._point_without_limits(begun.control)
        cost_before = np.inf if point_before is None else point_before.cost
        is_new = cost < cost_before
        return _Candidate(
            cost=max(result.cost, min(cost, cost_before)),
            start=found if is_new else replace(begun, basis=None),
            is_new=is_new,
        )

    def _on_stated_plant(
        self, result: RunResult, level: DescentLevel, *, is_tried: bool
    ) -> RunResult:
        """Result of a coarse level with a control that keeps all limits on the stated plant.

        Args:
            result: The result.
            level: The coarse level.
            is_tried: Whether there is time to look for such a control; without it, J is infinite.
        """
        inside = self._inside(result, level) if is_tried else None
        status = result.status
        if inside is None:
            has_ended = is_tried and status not in (Status.INTERRUPTED, Status.LOST)
            status = Status.INFEASIBLE if has_ended else status

        # An optimum of a coarse level is none of the stated one.
        elif status is Status.INFEASIBLE:
            status = Status.MAX_ITERATIONS
        status = Status.MAX_ITERATIONS if status.success else status

        return replace(
            result,
            control=result.control if inside is None else inside.control,
            cost=np.inf if inside is None else inside.cost,
            status=status,
            earlier=(),
        )

    def _merged(self, before: RunResult | None, result: RunResult) -> RunResult:
        """Result of a start after a round, with the best control that keeps all limits.

        Args:
            before: Its result before the round, or None.
            result: Its result of this round; J is that on the stated plant.
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

    def _inside(self, result: RunResult, level: DescentLevel) -> InsideControl | None:
        """The largest share of a control of a coarse level that keeps all limits."""
        if result.control is None:
            return None
        centre = self.fine.task.centre
        control = self._without_jumps(result.control, level)

        # This takes a few simulations, also after a request to stop, so that nothing is lost.
        trials = ControlsWithinLimits(cost=self._limited_cost, budget=Budget())
        return trials.largest(centre, control - centre)

    def _without_jumps(self, control: Array, level: DescentLevel) -> Array:
        """A control of a level, (N, nu), without steps where rates of controls are limited."""
        factor = level.task.system.variant.sample_factor
        if factor == 1 or self._limited_cost.constraints.rate is None:
            return control

        # A control that consists of curves, such as a Fourier series, is smooth already.
        values = control[::factor]
        if not np.array_equal(control, np.repeat(values, factor, axis=0)):
            return control

        # The values of the longer samples hold at their middles.
        middles = factor * (np.arange(len(values)) + 0.5) - 0.5
        times = np.arange(len(control))
        columns = [np.interp(times, middles, column) for column in values.T]
        return np.stack(columns, axis=1)

    def _point_without_limits(self, control: Array) -> DesignPoint | None:
        """A control, (N, nu), on the stated plant, inside limits or not; None if it diverges."""
        point = point_at_stated_rate(self.fine, control)
        return None if point is None or point.trajectory is None else point


def _engine_steps(level: DescentLevel) -> int:
    """Engine steps of one simulation on a level."""
    return level.task.samples * level.task.system.grid.substeps
