"""Anytime search for the best control.

Candidates climb a ladder of rungs, from levels that are quick to the stated one, and a share of
them goes on from each rung. Moves take a candidate and a time and yield a better one: a descent on
a rung, scaling into the limits, and random changes. A candidate counts when it was seen on the
stated plant; the best one so far is the result at any moment, the start included. On an executor,
descents run side by side. Each is one task or several, which may be lost without harm to others.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import islice

import numpy as np

from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.search.climb import (
    Candidate,
    Climb,
    Grounds,
    Move,
    Moved,
    Rung,
    Rungs,
    made_grounds,
    move_in_worker,
    row_of,
)
from mjfim.excitation.search.descent import MU_FACTOR, Barrier
from mjfim.excitation.search.inside import InsideControl, InsideSearch, is_progress
from mjfim.excitation.search.levels import DescentLevel, coarser_levels, easier_level
from mjfim.experiment.packing import for_workers
from mjfim.information.finite_steps import steps_disagree
from mjfim.parallel import (
    ExecutorLike,
    Workers,
    carry_out,
)
from mjfim.parallel.budget import Budget
from mjfim.parallel.shared_value import SharedValue
from mjfim.plant.active_constraints import nothing_acts_along
from mjfim.records.design import (
    ScaledStart,
    Status,
    extended,
)
from mjfim.records.events import DesignEvent

# Number of further controls without progress after which a search ends.
FURTHER_STARTS = 3

# On each rung, one of this number of candidates goes on to the next rung.
HALVING_RATE = 4

# Share of the time that is left, and of the iterations, for a rung below the stated one: with
# several coarse levels, and with one.
COARSE_SHARE = 0.4
FIRST_SHARE = 0.5

# Barrier weights with which coarse levels end, by their number. Iterations on the stated level are
# so expensive that the levels before have to come near the optimum.
LAST_WEIGHTS: dict[int, tuple[float, ...]] = {
    1: (1e-3,),
    2: (0.03, 3e-4),
    3: (0.03, 3e-4, 1e-4),
}

# Barrier on the stated level after several coarse ones. So close to the optimum, the barrier alone
# keeps the cost above the lowest one.
SHARP_BARRIER = Barrier(
    first=1e-3, last=1e-5, relaxation=0.1, tolerance=1e-6, follows_curvature=True
)

# Barrier weights with which a single coarse level ends. The second one is for few candidates on a
# level that differs from the stated one by its timestep only. The minima of both levels are close
# then.
FIRST_LAST_WEIGHT = 0.01
CLOSE_LAST_WEIGHT = 1e-3

# Barrier weight and share of the time of a single coarse level, where there is time for only few
# evaluations on the stated level.
BRIEF_LAST_WEIGHT = 0.03
BRIEF_SHARE = 0.75

# First barrier weight where weights in the cost bound the control.
LIGHT_BARRIER = 1e-3

# Number of evaluations for which there has to be time before a descent.
FEWEST_EVALUATIONS = 20.0

# Number of evaluations for which there has to be time before coarse levels are made.
LADDER_EVALUATIONS = 5.0

# Number of iterations for which each candidate should have time on the first rung.
ITERATIONS_OF_A_START = 50

# Number of iterations for which there has to be time before a further rung. The time of one
# evaluation counts as that of an iteration.
FEWEST_ITERATIONS = 6.0

# Number of iterations for which there has to be time in each stage of the barrier, where time is
# short.
ITERATIONS_OF_A_STAGE = 5.0

# Shares of the time for random changes before a descent: where derivatives may mislead, and where
# the start is far outside the limits.
PROBE_SHARE = 0.1
OUTSIDE_SHARE = 0.4

# Shares of the time for random changes between two descents, and at the end. The rest is for the
# report.
RANDOM_SHARE = 0.5
CLOSING_SHARE = 0.95

# Factor by which a control is enlarged in each step, where there is no time for a descent.
ENLARGING = 1.25

# Longest time of a move on a worker [s], and in evaluations; the longer one counts. Between two
# moves the iterates are shown. Where workers do not see a request to stop, it takes one move at
# most.
MOVE_SECONDS = 8.0
MOVE_EVALUATIONS = 60.0

# Number of random changes without progress after which other moves follow.
PATIENCE = 16


@dataclass(kw_only=True, eq=False)
class Search:
    """Search for the best control of a design.

    Attributes:
        stage: The stated level on the unmodified plant.
        first: The initial control, evaluated on it.
        budget: Ends the search.
        executor: Workers that carry out the descents; None for this process.
        evaluation_seconds: Time of one evaluation [s].
        keeps_curves: Candidates remain sums of their curves on all rungs.
        remote_steps: Engine steps of the workers.
    """

    stage: DescentLevel
    first: DesignPoint
    budget: Budget
    executor: ExecutorLike | None = None
    evaluation_seconds: float = 0.0
    keeps_curves: bool = False
    remote_steps: int = field(default=0, init=False)
    _cost_by_chance: float = field(default=np.inf, init=False)

    @cached_property
    def grounds(self) -> Grounds:
        """The levels in this process."""
        task = self.stage.task
        task = task.relaxed() if task.is_limited else task
        grounds = Grounds(task, self.stage.basis, self.first)
        grounds.keep(self.stage)
        return grounds

    @cached_property
    def inside(self) -> InsideSearch:
        """Search without derivatives, for controls that keep the limits."""
        return InsideSearch(self.grounds.stated, self.stage.task.experiment.descent.seed)

    @cached_property
    def scaled(self) -> InsideControl | None:
        """The initial control, scaled into the limits; None where no share of it keeps them."""
        return self.inside.scaled(self.stage.task.control, self.budget)

    @property
    def scaled_start(self) -> ScaledStart | None:
        """The scaled control, for the record; None if the initial control keeps the limits."""
        if not self.grounds.is_limited or self.keeps_limits(self.first) or self.scaled is None:
            return None
        return self.scaled.record

    def keeps_limits(self, point: DesignPoint) -> bool:
        """Check whether the motion of a point keeps the hard limits."""
        if not self.grounds.is_limited:
            return True
        return point.trajectory is not None and self.grounds.stated.keeps(point.trajectory.ctrl)

    @property
    def steps(self) -> int:
        """Engine steps since the search began, also those of workers."""
        return self.grounds.steps + self.remote_steps

    def run(self, candidates: Sequence[Candidate], further: Iterable[Candidate] = ()) -> Moved:
        """Yield every iterate; return the candidates that were begun.

        Args:
            candidates: Controls from which the search begins. The first one is always begun, the
                others as time allows.
            further: Controls that follow under hard limits while there is time and they help. The
                first one is the initial control as a sum of curves.
        """
        if not self.grounds.is_limited and not self.keeps_curves:
            return (yield from self._moved(candidates, self._free_rungs, is_last=True))
        if self.keeps_curves:
            return (yield from self._run_inside(list(candidates)))

        further = iter(further)
        done = []
        waiting = list(candidates)
        begins_as_stated = waiting[0].control is self.stage.task.control
        if self._is_bounded_by_weights and not self._is_determinant:
            if begins_as_stated and not self._has_time():
                waiting[0] = self._enlarged(waiting[0])
            free = [each for each in waiting if each.curves is None and each.repeats == 1]
            climbed = yield from self._moved(free, self._free_rungs, is_last=True)
            found = {each.name: self._judged(each) for each in climbed}
            # What seems to be an optimum is none where derivatives mislead.
            goes_on = (
                self.budget.exhausted is None and begins_as_stated and self._derivatives_mislead
            )
            done = [each for each in found.values() if not (each.has_left or goes_on)]
            left = {each.name for each in done}
            waiting = [
                replace(found.get(each.name, each), has_left=False)
                for each in waiting
                if each.name not in left
            ]
        if waiting:
            series = next(further, None)
            if series is not None and waiting[0].control is self.stage.task.control:
                # A control with few numbers improves quickly; on the next rung it is free.
                waiting[0] = replace(waiting[0], curves=series.curves)
            # Where derivatives mislead and time is short, random changes come first.
            is_misleading = begins_as_stated and self._derivatives_mislead
            is_short = is_misleading and not self._has_time(evaluations=LADDER_EVALUATIONS)
            ladder = () if is_short else self._ladder(waiting)
            level = self.grounds.level(ladder[0].variant) if ladder else None
            waiting[0] = yield from self._prepared(waiting[0], level, is_misleading=is_misleading)
            if is_misleading and not self._has_time(level):
                return [*done, replace(waiting[0], status=Status.MAX_ITERATIONS)]
            done += yield from self._run_inside(waiting, ladder)
        return (yield from self._followed(done, further))

    def _followed(self, done: list[Candidate], further: Iterator[Candidate]) -> Moved:
        """Begin with further controls, until several of them in turn did not help."""
        size = self._worker_count
        in_vain = 0
        least = min((each.cost for each in done), default=np.inf)
        while in_vain < FURTHER_STARTS and self._has_time():
            batch = list(islice(further, size))
            if not batch:
                break
            before = least
            done += yield from self._run_inside(batch)
            # A request to stop leaves no result of the batch.
            least = min((each.cost for each in done), default=np.inf)
            in_vain = 0 if is_progress(before, least) else in_vain + size
        return done

    # ---- before a descent

    def _enlarged(self, first: Candidate) -> Candidate:
        """The first candidate, enlarged while it keeps all limits and its cost falls."""
        stated = self.grounds.stated
        centre = stated.task.centre
        control, least = first.over_horizon, self.first.cost
        while self.budget.used < OUTSIDE_SHARE and self.budget.exhausted is None:
            larger = np.asarray(centre + ENLARGING * (control - centre))
            point = stated.inside(larger)
            if point is None or not point.cost < least:
                break
            control, least = larger, point.cost
            first = replace(first.improved(control, point), control=control, repeats=1)
        return first

    def _prepared(
        self, first: Candidate, level: DescentLevel | None, *, is_misleading: bool
    ) -> Generator[DesignEvent, None, Candidate]:
        """The first candidate with a control within the limits, where one is found.

        The control is scaled into the limits. Where the start is far outside them, and where
        derivatives may mislead, random controls are tried as well.
        """
        best = None if first.best is not None else self._inside_of(first)
        if best is None:
            return first
        first = first.improved(best.control, best.point)
        ground = self.grounds.ground(self.grounds.stated.task.system.variant, first)
        is_outside = not ground.is_near(first.control)
        share = 0.0
        if is_misleading:
            share = PROBE_SHARE if self._has_time(level) else CLOSING_SHARE
        elif is_outside and self._has_time(level):
            share = OUTSIDE_SHARE
        if share:
            first, best = yield from self._by_chance(first, best, share)
        return replace(first, control=best.begin) if is_outside else first

    def _inside_of(self, candidate: Candidate) -> InsideControl | None:
        """The better of a candidate and the initial control, both scaled into the limits."""
        centre = self.grounds.stated.task.centre
        found = [self.scaled]
        if candidate.control is not self.stage.task.control:
            deviation = candidate.over_horizon - centre
            found.append(self.inside.largest(centre, deviation, self.budget))
        return min((each for each in found if each), key=lambda each: each.cost, default=None)

    # ---- descents within the limits

    def _run_inside(self, candidates: list[Candidate], ladder: Rungs = ()) -> Moved:
        """Let candidates climb within the limits, in batches while there is time."""
        ladder = ladder or self._ladder(candidates)
        done: list[Candidate] = []
        waiting = self._affordable(candidates, ladder[0])
        while waiting and (not done or self.budget.exhausted is None):
            size = max(HALVING_RATE, self._worker_count)
            done += yield from self._climbed(waiting[:size], ladder)
            waiting = waiting[size:]
        if done and self.grounds.is_limited and all(each.best is None for each in done):
            done[0] = yield from self._begun_inside(done[0], ladder[-1])
        return (yield from self._helped_by_chance(done, ladder))

    def _begun_inside(
        self, candidate: Candidate, rung: Rung
    ) -> Generator[DesignEvent, None, Candidate]:
        """Descend once more where nothing keeps the limits, from controls strictly inside.

        These are the constant controls that nearly hold the initial state, and the one that the
        candidate has found. Those that are outside are first moved inside by the barrier alone.
        """
        task = self.grounds.stated.task
        holding = [np.tile(centre, (task.samples, 1)) for centre in reversed(task.centres)]
        for control in (*holding, candidate.over_horizon):
            if self.budget.exhausted is not None or candidate.best is not None:
                break
            curves = candidate.curves if self.keeps_curves else None
            begun = replace(candidate, control=control, curves=curves, repeats=1, history=())
            begun = replace(begun, begins_inside=True, first_weight=None)
            for moved in (yield from self._moved([begun], (rung,), is_last=True)):
                rows = [
                    replace(row, iteration=candidate.iterations + row.iteration)
                    for row in moved.history
                ]
                candidate = replace(moved, history=extended(candidate.history, rows))
        return candidate

    def _climbed(self, batch: list[Candidate], ladder: Rungs) -> Moved:
        """Let a batch climb the ladder; a share of it goes on from each rung."""
        results = {}
        for number, rung in enumerate(ladder):
            is_last = number == len(ladder) - 1
            if number:
                if any(each.best is not None for each in batch):
                    level = self.grounds.ground(rung.variant, batch[0]).level
                    if not self._has_time(level, FEWEST_ITERATIONS):
                        break
                rung = self._in_time(rung, ladder[number - 1], batch)
            batch = yield from self._moved(batch, (rung,), is_last=is_last)
            results.update({each.name: each for each in batch})
            if self.budget.exhausted is not None or is_last:
                break
            ranked = sorted(batch, key=lambda each: each.rank)
            batch = ranked[: max(len(ranked) // HALVING_RATE, 1)]
            for each in ranked[len(batch) :]:
                if each.best is not None:
                    results[each.name] = replace(each, status=Status.LEFT)
        return list(results.values())

    def _in_time(self, rung: Rung, before: Rung, batch: list[Candidate]) -> Rung:
        """A rung with as many stages of the barrier as there is time for.

        The time of an iteration is that on the rung before, in proportion to the engine steps.
        """
        level = self.grounds.ground(before.variant, batch[0]).level
        rows = [row for row in batch[0].history if row.rate == 1.0 / level.task.dt]
        barrier = rung.barrier
        if barrier is None or len(rows) < 2 or np.isinf(self.budget.seconds_left):
            return rung
        each = (
            self.grounds.stated.engine_steps
            / level.engine_steps
            * (rows[-1].seconds - rows[0].seconds)
            / (len(rows) - 1)
        )
        iterations = self.budget.seconds_left / len(batch) / max(each, 1e-9)
        stages = max(int(iterations / ITERATIONS_OF_A_STAGE), 1)
        if stages >= len(barrier.weights):
            return rung
        last = max(barrier.first / MU_FACTOR ** (stages - 1), barrier.last)
        return replace(rung, barrier=replace(barrier, last=last, relaxation=Barrier.relaxation))

    # ---- random changes

    def _helped_by_chance(self, done: list[Candidate], ladder: Rungs) -> Moved:
        """Change the best control at random where descents are held up, and descend from there."""
        place = min(range(len(done)), key=lambda i: done[i].cost, default=None)
        if place is None or self.keeps_curves:
            return done
        best = done[place]
        is_useful = True
        while best.best is not None and self.budget.exhausted is None:
            is_beaten = best.cost >= self._cost_by_chance
            if not (best.is_held_up or is_beaten) or best.iterations >= self._max_iterations:
                break
            before = best.cost
            centre = self.grounds.stated.task.centre
            inside = self.inside.largest(centre, best.best - centre, self.budget)
            if inside is None:
                break
            share = RANDOM_SHARE if is_useful else CLOSING_SHARE
            best, inside = yield from self._by_chance(best, inside, share)
            done[place] = best
            has_gained = is_progress(before, best.cost)
            if not is_useful and not has_gained:
                break
            is_useful = has_gained and self._has_time()
            if not is_useful:
                continue
            before = best.cost
            begun = replace(best, control=inside.begin, is_held_up=False)
            moved = yield from self._moved([begun], ladder[-1:], is_last=True)
            if moved:
                best = moved[0]
                done[place] = best
            is_useful = is_progress(before, best.cost)
        return done

    def _has_time(
        self, level: DescentLevel | None = None, evaluations: float = FEWEST_EVALUATIONS
    ) -> bool:
        """Whether there is time for so many evaluations on a level, or on the stated one."""
        stated = self.grounds.stated
        steps = stated.engine_steps if level is None else level.engine_steps
        seconds = self.evaluation_seconds * steps / stated.engine_steps
        return self.budget.seconds_left > evaluations * seconds

    def _by_chance(
        self, candidate: Candidate, inside: InsideControl, share: float
    ) -> Generator[DesignEvent, None, tuple[Candidate, InsideControl]]:
        """Improve a candidate by random changes of a control within the limits."""
        budget = self.budget.share(share)
        candidate = candidate.improved(inside.control, inside.point)
        for found in self.inside.improvements(inside, budget, PATIENCE):
            inside = found
            candidate = candidate.improved(found.control, found.point)
            values = self.grounds.stated.values(found.control)
            margins = (
                {} if values is None else self.grounds.stated.constraints.relative_margins(values)
            )
            row = row_of(
                found.point,
                iteration=candidate.iterations,
                seconds=self.budget.seconds_used,
                steps=self.steps,
                rate=1.0 / self.stage.task.dt,
                margins=margins,
            )
            candidate = replace(candidate, history=extended(candidate.history, [row]))
            yield DesignEvent(start=candidate.name, row=row)
        self._cost_by_chance = candidate.cost
        return candidate, inside

    def _judged(self, candidate: Candidate) -> Candidate:
        """A candidate of a descent without a barrier, judged on the stated plant."""
        if candidate.has_left and candidate.control is self.stage.task.control:
            return candidate
        climb = Climb(self.grounds, self._move(candidate, (), self.budget.seconds_left, True))
        status = candidate.status
        return replace(climb.judged(self.grounds.stated.task.system.variant), status=status)

    # ---- rungs, and what they depend on

    @cached_property
    def _is_bounded_by_weights(self) -> bool:
        """Whether weights on all controls may keep the limits without a barrier.

        A barrier is needed for a boundary, a bandwidth, limits on control rates and a clearance.
        """
        task = self.stage.task
        limits = task.experiment.limits
        needs_barrier = task.is_shaped or bool(limits.control_rate) or limits.clearance is not None
        return not needs_barrier and bool((task.control_weight > 0.0).all())

    @property
    def _is_determinant(self) -> bool:
        """Whether the design is D-optimal; the quasi-Newton direction of the barrier is better."""
        return self.stage.task.experiment.cost.criterion == "D"

    @cached_property
    def _free_rungs(self) -> Rungs:
        """The coarse and the stated level without a barrier."""
        stated = Rung(variant=self.stage.task.system.variant)
        # A single iteration is for the stated level: one on a coarse level may not lower J there.
        is_fine = self.stage.task.experiment.descent.method != "lbfgs" or self._max_iterations < 2
        coarse = None if is_fine else easier_level(self.stage, self.first)
        if coarse is None:
            return (stated,)
        self.grounds.keep(coarse)
        return (Rung(variant=coarse.task.system.variant), stated)

    def _ladder(self, candidates: Sequence[Candidate]) -> Rungs:
        """The rungs within the limits."""
        stated = self.grounds.stated
        variant = stated.task.system.variant
        tolerance = stated.task.experiment.descent.tolerance
        if not stated.task.is_limited:
            return (Rung(variant=variant, barrier=Barrier(first=Barrier.last * 3.0)),)
        has_parts = any(each.repeats > 1 for each in candidates)
        levels = () if has_parts else coarser_levels(stated, self.first)
        if levels:
            weights = LAST_WEIGHTS[len(levels)]
            first, rungs = Barrier().first, []
            for level, last in zip(levels, weights, strict=True):
                self.grounds.keep(level)
                barrier = Barrier(first=first, last=last, follows_curvature=True)
                rungs.append(
                    Rung(variant=level.task.system.variant, barrier=barrier, share=COARSE_SHARE)
                )
                first = last
            sharp = replace(SHARP_BARRIER, tolerance=max(SHARP_BARRIER.tolerance, tolerance))
            return (*rungs, Rung(variant=variant, barrier=sharp))

        usual = Barrier(tolerance=max(Barrier.tolerance, tolerance))
        if self._is_bounded_by_weights and self._is_determinant:
            usual = replace(usual, first=LIGHT_BARRIER)
        coarse = easier_level(stated, self.first)
        is_free = all(each.curves is None and each.repeats == 1 for each in candidates)
        if coarse is None and len(candidates) == 1 and (is_free or self.keeps_curves):
            return (Rung(variant=variant, barrier=usual),)
        level = coarse or stated
        self.grounds.keep(level)
        is_close = replace(level.task.system.variant, timestep_factor=1) == variant
        is_few = len(candidates) < HALVING_RATE and is_close
        last = CLOSE_LAST_WEIGHT if is_few else FIRST_LAST_WEIGHT
        share = FIRST_SHARE
        if not self._has_time() and level.engine_steps < stated.engine_steps:
            last, share = BRIEF_LAST_WEIGHT, BRIEF_SHARE
        return (
            Rung(
                variant=level.task.system.variant,
                barrier=replace(usual, last=min(last, usual.first)),
                share=share,
            ),
            Rung(
                variant=variant,
                barrier=replace(usual, first=min(3.0 * last, FIRST_LAST_WEIGHT, usual.first)),
            ),
        )

    def _affordable(self, candidates: list[Candidate], rung: Rung) -> list[Candidate]:
        """The first candidates, as many as can be optimised roughly in the time of a rung."""
        seconds = rung.share * self.budget.seconds_left
        if len(candidates) == 1 or np.isinf(seconds):
            return candidates
        # Measure an iteration without its line search. The first one builds models.
        level = self.grounds.ground(rung.variant, candidates[0]).level
        level.problem.expand(level.problem.point(level.task.initial))
        begun = self.budget.seconds_used
        level.problem.expand(level.problem.point(level.task.initial))
        each = ITERATIONS_OF_A_START * (self.budget.seconds_used - begun)
        return candidates[: max(int(self._worker_count * seconds / max(each, 1e-9)), 1)]

    @property
    def _max_iterations(self) -> int:
        """Largest number of iterations of one candidate."""
        return self.stage.task.experiment.descent.max_iterations

    @cached_property
    def _derivatives_mislead(self) -> bool:
        """Whether derivatives may mislead along the initial control."""
        task = self.stage.task
        if self.first.trajectory is None:
            return False
        if self.grounds.stated.task.system.variant.smoothing_speeds:
            return True
        # Derivatives exist where nothing touches, rubs, stops or clamps.
        model = task.system.model_at(task.theta)
        if nothing_acts_along(model, self.first.trajectory, task.system.grid.substeps):
            return False
        return steps_disagree(
            task.plant,
            task.system.noise,
            task.theta,
            self.first.trajectory,
            self.first.sensitivity,
        )

    # ---- descents, here or on workers

    @property
    def _worker_count(self) -> int:
        """Number of moves that run side by side."""
        return 1 if self.executor is None else Workers.of(self.executor).count

    def _move(self, candidate: Candidate, rungs: Rungs, seconds: float, is_last: bool) -> Move:
        """A move for a candidate. seconds: its time [s]."""
        left = max(self._max_iterations - max(candidate.iterations - 1, 0), 1)
        share = rungs[0].share if rungs else 1.0
        return Move(
            candidate=candidate,
            rungs=rungs,
            is_last=is_last,
            iterations=int(np.ceil(share * left)),
            seconds=seconds,
            budget=self.budget,
            keeps_curves=self.keeps_curves,
        )

    def _moved(self, candidates: Sequence[Candidate], rungs: Rungs, *, is_last: bool) -> Moved:
        """Let candidates climb some rungs; those for which there is no time are left out."""
        share = rungs[0].share if len(rungs) == 1 else 1.0
        if self.executor is not None and (len(candidates) > 1 or self.grounds.is_limited):
            return (yield from self._moved_on_workers(candidates, rungs, share, is_last))

        moved: list[Candidate] = []
        end = self.budget.seconds_used + share * self.budget.seconds_left
        for candidate in candidates:
            if moved and self.budget.exhausted is not None:
                break
            # On a single rung, the candidates that wait share the time that is left of it. Without
            # a barrier, each of them may take all time.
            seconds = end - self.budget.seconds_used
            if len(rungs) == 1:
                seconds /= len(candidates) - len(moved)
            if rungs[0].barrier is None:
                seconds = self.budget.seconds_left
            climb = Climb(self.grounds, self._move(candidate, rungs, max(seconds, 0.0), is_last))
            found = yield from climb.run()
            moved.append(_named_stop(found, self.budget))
        return moved

    def _moved_on_workers(
        self,
        candidates: Sequence[Candidate],
        rungs: Rungs,
        share: float,
        is_last: bool,
    ) -> Moved:
        """Let candidates climb some rungs on the workers of the executor."""
        assert self.executor is not None
        workers = Workers.of(self.executor)
        plan = self._plan(workers.threads_for(len(candidates)))
        end = self.budget.seconds_used + share * self.budget.seconds_left
        longest = max(MOVE_SECONDS, MOVE_EVALUATIONS * self.evaluation_seconds)
        results = {each.name: each for each in candidates}
        waiting = list(candidates)
        while waiting:
            turns = -(-len(waiting) // workers.count)
            seconds = max(end - self.budget.seconds_used, 0.0) / turns
            moves = [
                # A candidate that has found a control climbs the last rung only.
                replace(
                    self._move(
                        each,
                        rungs if each.best is None else rungs[-1:],
                        min(seconds, longest),
                        is_last,
                    ),
                    may_continue=seconds > longest and each.iterations <= self._max_iterations,
                    plan=plan,
                )
                for each in waiting
            ]
            before, waiting = waiting, []
            for index, ended in carry_out(self.executor, move_in_worker, moves, self.budget):
                begun = before[index]
                if not ended:
                    # What was lost with its worker is done here.
                    found = yield from Climb(self.grounds, moves[index]).run()
                else:
                    found = ended[0]
                    self.remote_steps += found.steps - begun.steps
                    for row in found.history[len(begun.history) :]:
                        if not self.budget.stop.requested:
                            yield DesignEvent(start=found.name, row=row)
                results[found.name] = found
                has_moved = len(found.history) > len(begun.history)
                is_over = found.is_judged or found.has_left or found.is_held_up or found.status
                if moves[index].may_continue and has_moved and not is_over:
                    waiting.append(found)
            if self.budget.exhausted is not None:
                break

        moved = [results[each.name] for each in candidates if results[each.name] is not each]
        return [self._ended(each, rungs[-1], is_last) for each in moved]

    def _ended(self, found: Candidate, rung: Rung, is_last: bool) -> Candidate:
        """A candidate after its last move, judged on the stated plant."""
        if rung.barrier is not None and not (found.is_judged or found.has_left):
            move = self._move(found, (rung,), 0.0, is_last)
            judged = Climb(self.grounds, move).judged(rung.variant)
            found = replace(judged, status=found.status)
        return _named_stop(found, self.budget)

    def _plan(self, threads: int) -> SharedValue[Callable[[], Grounds]]:
        """How a worker with some threads makes the levels, which all moves share."""
        if threads not in self._plans:
            task = self.grounds.stated.task
            plan = partial(
                made_grounds,
                for_workers(task.experiment, task.system.source),
                task.system.variant,
                self.stage.basis,
                task.added,
                threads,
            )
            self._plans[threads] = SharedValue(uuid.uuid4().hex, plan)
        return self._plans[threads]

    @cached_property
    def _plans(self) -> dict[int, SharedValue[Callable[[], Grounds]]]:
        """Plans by the threads of each move."""
        return {}


def _named_stop(candidate: Candidate, budget: Budget) -> Candidate:
    """A candidate whose status says that a request has stopped its descent, where that is so."""
    if budget.stop.requested and candidate.status is None:
        return replace(candidate, status=Status.INTERRUPTED)
    return candidate
