"""Descents under hard limits from coarse to fine levels, with fewer and fewer starts.

An iteration on a coarse level takes a small part of the time of one on the stated level, and its
minima lie close to those of the stated level. So most of the way is done there: all starts are
optimised with a large barrier weight on the coarsest level, the best of them with smaller weights
on finer levels, and the best one of all on the stated level in the end. After each round, the
largest share of each control that keeps all limits of the unmodified model is kept, so that there
is a good control within the limits however early the time ends.
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
from mjfim.excitation.multistart import HALVING_RATE, Multistart, append_run, renumber
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.run_result import RunResult, Runs
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

# Largest part of J on the stated plant that a coarse level may miss. Beyond that it misleads, and
# the next level begins where this one began, if that is better.
LARGEST_ERROR = 1.0 / 3.0

# Number of iterations for which there has to be time before a round on a finer level begins.
FEWEST_ITERATIONS = 2.0

# Number of iterations for which each start of the first round should have time.
ITERATIONS_OF_A_START = 50


@dataclass(eq=False, kw_only=True)
class _State:
    """What the rounds have found so far.

    Attributes:
        starts: Controls with which the next round begins, the best one first.
        results: Result of every start by its name; the costs are those on the stated plant.
        mu: Weight of the barrier with which the next round begins.
        seconds_per_step: Time of an iteration over the engine steps of one simulation [s]; 0 before
            the first round.
    """

    starts: list[InitialControl]
    results: dict[str, RunResult] = field(default_factory=dict)
    mu: float = BarrierSchedule().first
    seconds_per_step: float = 0.0

    @property
    def iterations(self) -> int:
        """Largest number of iterations of one start so far."""
        histories = [result.history for result in self.results.values()]
        return max((rows[-1].iteration + 1 for rows in histories if rows), default=0)

    @property
    def has_feasible(self) -> bool:
        """Whether there is a control that keeps all limits."""
        return any(np.isfinite(result.cost) for result in self.results.values())


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

        state = _State(starts=self._affordable(starts))
        levels = (*self.levels, self.fine)

        weights = (*LAST_WEIGHTS[len(self.levels)], BarrierSchedule().last)
        for level, last_mu in zip(levels, weights, strict=True):
            if state.results and self._is_over(level, state):
                break

            found = yield from self._run_level(level, state, last_mu)
            self._take(found, level, state, last_mu)
            if found and all(r.is_held_up and r.cost > self.cost_to_beat for r in found):
                break

        return list(state.results.values())

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
        affordable = [count for count in counts if self._turns(count) * each <= seconds]
        return list(starts[: max(affordable, default=1)])

    def _is_over(self, level: DescentLevel, state: _State) -> bool:
        """Check whether there is no time for a useful round on a level."""
        if self.budget.stop.requested:
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
        turns = self._turns(len(state.starts))
        begun = self.budget.seconds_used

        events = self._round(
            level,
            state.starts,
            BarrierSchedule(first=state.mu, last=last_mu),
            int(np.ceil(share * max(iterations_left, 1))),
            share * self._seconds_left / turns,
        )
        found = yield from renumber(events, state.iterations)

        longest = max((len(result.history) for result in found), default=0)
        elapsed = self.budget.seconds_used - begun
        state.seconds_per_step = elapsed / max(turns * longest, 1) / _engine_steps(level)
        return found

    def _take(
        self, found: Sequence[RunResult], level: DescentLevel, state: _State, last_mu: float
    ) -> None:
        """Take the results of a round, and choose the starts and the weight of the next one."""
        begun = {start.name: start for start in state.starts}
        candidates: list[tuple[float, InitialControl]] = []
        state.mu = last_mu

        for result in found:
            merged = self._merged(state.results.get(result.name), result, level)
            state.results[result.name] = merged
            if result.control is None or level is self.fine:
                continue

            control = self._at_stated_rate(result.control, level)
            start = InitialControl(name=result.name, control=control)
            if self._is_misled(start, result.cost):
                start = self._better(start, begun[result.name])
            candidates.append((result.cost, start))

        # A round without any usable control changes nothing but the level.
        candidates.sort(key=lambda candidate: candidate[0])
        count = max(1, len(candidates) // HALVING_RATE)
        state.starts = [start for _, start in candidates[:count]] or state.starts[:1]

    def _is_misled(self, found: InitialControl, cost: float) -> bool:
        """Check whether a control costs much more on the stated plant than on a coarse level."""
        point = self._point_without_limits(found.control)
        if point is None:
            return True
        return not point.cost - cost <= LARGEST_ERROR * self.fine.problem.size(point)

    def _better(self, found: InitialControl, begun: InitialControl) -> InitialControl:
        """The better of the control that a misleading level has found and of that before it."""
        points = [self._point_without_limits(start.control) for start in (found, begun)]
        costs = [np.inf if point is None else point.cost for point in points]
        return found if costs[0] < costs[1] else replace(begun, basis=None)

    def _merged(
        self, before: RunResult | None, result: RunResult, level: DescentLevel
    ) -> RunResult:
        """Result of a start after a round, with the best control that keeps all limits.

        Args:
            before: Its result before the round, or None.
            result: Its result of this round.
            level: Level of the round.
        """
        merged = result if before is None else append_run(before, result)
        inside = None
        if level is not self.fine:
            inside = self._inside(result, level)
            cost = np.inf if inside is None else inside.cost
            control = result.control if inside is None else inside.control
            merged = replace(merged, control=control, cost=cost, earlier=())
        if before is None:
            return merged

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
        control = self._at_stated_rate(result.control, level)

        # This takes a few simulations, also after a request to stop, so that nothing is lost.
        trials = ControlsWithinLimits(cost=self._limited_cost, budget=Budget())
        return trials.largest(centre, control - centre)

    def _at_stated_rate(self, control: Array, level: DescentLevel) -> Array:
        """A control of a level, (N, nu), without steps where rates of controls are limited."""
        factor = level.task.system.variant.sample_factor
        if factor == 1 or self._limited_cost.constraints.rate is None:
            return control

        # The values of the longer samples hold at their middles.
        values = control[::factor]
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
