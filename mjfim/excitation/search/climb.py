"""Moves of the anytime search: a candidate climbs some rungs of the ladder of levels.

A move descends on each rung, and then compares what it has found on the stated plant. It is a task
of its own, here or on a worker, with a number of iterations and a time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.limits.verification import verify
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.prior_information import EarlierExperiments
from mjfim.excitation.search.descent import Barrier, FreeMemory, Ground, Step
from mjfim.excitation.search.inside import InsideSearch, with_corrected_end
from mjfim.excitation.search.levels import DescentLevel
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.model.variants import ModelVariant
from mjfim.parallel import (
    offer_result,
    one_blas_thread,
    pool_stop_token,
)
from mjfim.parallel.budget import Budget, StopReason, StopToken
from mjfim.parallel.shared_value import KeptPerThread, SharedValue
from mjfim.records.design import (
    HistoryRow,
    StartResult,
    Status,
    extended,
    iterate_motion,
)
from mjfim.records.events import DesignEvent

# Largest weight with which a violated limit is tightened in the next stage. Where the result
# violates a limit of the unmodified model, the stages from the second weight on are repeated.
TIGHTENING_MU = 4e-3
REPEATED_MU = 1e-3
MAX_REPEATED_STAGES = 3

# Largest weight with which the multipliers of the barrier are those of the limits, and largest
# slope of the merit over the weight. The error of a multiplier is about the root of this ratio.
PRICED_MU = 1e-2
PRICED_SLOPE = 0.01

# A violation at the end of a stage tightens the limit by this many times the violation; a limit
# that holds with a margin is released by this share of the margin.
TIGHTENING_GAIN = 1.2
RELEASE_GAIN = 0.5

# A stage may take this many times its equal share of the time that is left.
STAGE_SHARE_FACTOR = 1.5

# Step length, relative to the full step, up to which a step is short. A descent is held up when
# half of its last steps are short, though the slope is this many times that of convergence.
SHORT = 0.05
SHORT_WINDOW = 12
STEEP = 100.0

# Step length, relative to the full step, below which the derivatives of a descent without a barrier
# mislead.
LEAST_STEP = 1e-5

# Largest part of J on the stated plant that a coarse level may miss.
LARGEST_ERROR = 1.0 / 3.0

# Number of tasks that a worker keeps, those of all levels of a design.
KEPT_GROUNDS = 2


@record
class Rung:
    """A level of the ladder.

    Attributes:
        variant: Plant of the level.
        barrier: Barrier of the limits; None for a descent without one.
        share: Share of the time that is left and of the iterations.
    """

    variant: ModelVariant
    barrier: Barrier | None = None
    share: float = 1.0


# Rungs, one after the other.
Rungs = tuple[Rung, ...]


@record
class Candidate:
    """A control on its way up the ladder. It can be pickled.

    Attributes:
        name: Name of the initial control.
        control: (N / repeats, nu) control with which the next move begins [u-unit].
        curves: (N, M) curves of which the control is a sum on the first rung; None for a free one.
        repeats: How often the control is played, one after the other.
        rank: Cost by which it is compared with others.
        cost: J of the best control, as seen on the stated plant.
        best: (N, nu) control of lowest cost that was seen there; None where there is none yet.
        point: Its evaluation, where it is known.
        first_weight: Barrier weight with which the next rung begins; None for the usual one.
        begins_inside: The next descent begins strictly inside the limits, even from near them.
        status: Status of the last descent; None where its time was over.
        slope: Slope of the cost at the last iterate.
        history: Iterates.
        prices: Exponents of the limits at the end of the last stage, see `InteriorProblem`.
        steps: Engine steps.
        has_left: A descent without a barrier has left the limits, or was misled by derivatives.
        is_held_up: Its steps were very short.
        is_judged: The last descent was compared on the stated plant.
    """

    name: str
    control: Array
    curves: Array | None = None
    repeats: int = 1
    rank: float = np.inf
    cost: float = np.inf
    best: Array | None = None
    point: DesignPoint | None = None
    first_weight: float | None = None
    begins_inside: bool = False
    status: Status | None = None
    slope: float = np.inf
    history: tuple[HistoryRow, ...] = ()
    prices: Mapping[str, float] = field(default_factory=dict)
    steps: int = 0
    has_left: bool = False
    is_held_up: bool = False
    is_judged: bool = False

    @property
    def over_horizon(self) -> Array:
        """(N, nu) control over the whole horizon [u-unit]."""
        return self.control if self.repeats == 1 else np.tile(self.control, (self.repeats, 1))

    @property
    def iterations(self) -> int:
        """Number of the next iteration."""
        return self.history[-1].iteration + 1 if self.history else 0

    @property
    def ended(self) -> Status:
        """Status at the end of the search."""
        if self.status in (Status.INTERRUPTED, Status.LEFT):
            return self.status
        if self.best is None:
            return self.status if self.status is Status.STALLED else Status.INFEASIBLE
        return self.status or Status.MAX_ITERATIONS

    @property
    def start_result(self) -> StartResult:
        """The candidate as a row of the design's table of starts."""
        last = self.history[-1].iteration if self.history else 0
        return StartResult(name=self.name, cost=self.cost, status=self.ended, iterations=last)

    def improved(self, control: Array, point: DesignPoint) -> Candidate:
        """The candidate with a control that was seen on the stated plant, where it costs less."""
        if point.cost > self.cost or not np.isfinite(point.cost):
            return self
        return replace(self, best=control, cost=point.cost, point=point)


# Iterates as they are found, and at the end the candidates after their moves.
Moved = Generator[DesignEvent, None, list[Candidate]]


class Grounds:
    """The levels of a design in one process, each made when it is used first.

    Args:
        task: The stated task; without the clamps of the model where it has limits.
        combinations: Basis of the identifiable combinations; None where all are identifiable.
        first: The initial control, evaluated; None where it is not known.
    """

    def __init__(
        self, task: DesignTask, combinations: Array | None, first: DesignPoint | None = None
    ) -> None:
        self.stated = DescentLevel(task, combinations, first=first)
        self._levels = {task.system.variant: self.stated}
        self._grounds: dict[tuple[ModelVariant, int], Ground] = {}
        self._steps_before = self._counted_steps

    def keep(self, level: DescentLevel) -> None:
        """Keep a level that was made already."""
        if level.task.system.variant not in self._levels:
            self._levels[level.task.system.variant] = level
            self._steps_before += level.task.plant.engine_steps

    def level(self, variant: ModelVariant) -> DescentLevel:
        """The level of a variant of the plant."""
        if variant not in self._levels:
            task = self.stated.task.with_variant(variant)
            self.keep(DescentLevel(task, self.stated.basis))
        return self._levels[variant]

    def ground(self, variant: ModelVariant, candidate: Candidate) -> Ground:
        """The ground of a candidate on a variant of the plant."""
        level = self.level(variant)
        if candidate.curves is not None:
            return Ground.of(level, candidate.curves, candidate.repeats)
        key = variant, candidate.repeats
        if key not in self._grounds:
            # What a process makes once is no work of a move, which any process may do.
            before = self.steps
            self._grounds[key] = Ground.of(level, None, candidate.repeats)
            self._steps_before += self.steps - before
        return self._grounds[key]

    @property
    def is_limited(self) -> bool:
        """Whether there are hard limits."""
        return self.stated.task.is_limited

    @property
    def steps(self) -> int:
        """Engine steps on all levels since the search began."""
        return self._counted_steps - self._steps_before

    @property
    def _counted_steps(self) -> int:
        """Engine steps of all plants since they were made."""
        tasks = [level.task for level in self._levels.values()]
        tasks += [ground.task for ground in self._grounds.values()]
        plants = {id(task.plant): task.plant for task in tasks}
        return sum(plant.engine_steps for plant in plants.values())


def made_grounds(
    experiment: Experiment,
    variant: ModelVariant,
    combinations: Array | None,
    added: EarlierExperiments | None,
    threads: int,
) -> Grounds:
    """Make the levels of a design in a worker."""
    task = DesignTask.resolve(experiment, threads=threads, added=added)
    return Grounds(task.with_variant(variant), combinations)


@dataclass(frozen=True, kw_only=True, eq=False)
class Move:
    """Order to let a candidate climb some rungs.

    Attributes:
        candidate: The candidate.
        rungs: The rungs, one after the other.
        is_last: The result has to keep the limits of the unmodified model.
        iterations: Largest number of iterations.
        seconds: Time [s].
        budget: Budget of the design.
        keeps_curves: The candidate remains a sum of its curves.
        may_continue: Another move follows where the time is over before the descent.
        plan: How a worker makes the levels; None in the process of the design.
    """

    candidate: Candidate
    rungs: Rungs
    is_last: bool
    iterations: int
    seconds: float
    budget: Budget
    keeps_curves: bool = False
    may_continue: bool = False
    plan: SharedValue[Callable[[], Grounds]] | None = None


_kept = KeptPerThread[Grounds](KEPT_GROUNDS)


@one_blas_thread()
def move_in_worker(move: Move) -> Candidate:
    """Let a candidate climb, for an executor."""
    assert move.plan is not None
    grounds = _kept.get(move.plan.digest, move.plan.value)
    stated, of_pool = move.budget.stop, pool_stop_token()
    stop = StopToken(also=lambda: stated.requested or of_pool.requested)
    climb = Climb(grounds, replace(move, budget=move.budget.with_stop(stop))).run()
    while True:
        try:
            next(climb)
        except StopIteration as end:
            found: Candidate = end.value
            return found


class Climb:
    """A candidate that climbs some rungs.

    Args:
        grounds: The levels.
        move: The order.
    """

    def __init__(self, grounds: Grounds, move: Move) -> None:
        self._grounds = grounds
        self._move = move
        self._budget = Budget(seconds=move.seconds, stop=move.budget.stop)
        self._begin = replace(move.candidate, is_judged=False, status=None)
        self.candidate = self._begin
        self._steps_before = grounds.steps - move.candidate.steps
        # Cost of the best control on its own level. The last control, with its cost there and the
        # size of this cost, need not keep the limits.
        self._level_cost = np.inf
        self._latest: tuple[Array, float, float] | None = None
        self._are_short: deque[bool] = deque(maxlen=SHORT_WINDOW)

    def run(self) -> Generator[DesignEvent, None, Candidate]:
        """Yield every iterate; return the candidate."""
        memory = FreeMemory()
        try:
            for rung in self._move.rungs:
                ground = self._grounds.ground(rung.variant, self.candidate)
                if rung.barrier is None:
                    yield from self._descend_freely(ground, memory)
                else:
                    # What was begun before may have to begin bluntly.
                    barrier, first = rung.barrier, self.candidate.first_weight
                    if first is not None:
                        barrier = replace(barrier, first=max(first, barrier.last))
                    yield from self._descend_inside(ground, barrier)
                if self.candidate.has_left or self._is_over:
                    break
        except (SimulationDivergedError, np.linalg.LinAlgError):
            self.candidate = replace(self.candidate, status=Status.STALLED)
        # Stages that end without convergence before the time is over leave the best that was seen.
        if rung.barrier is not None and self.candidate.status is None and not self._is_over:
            self.candidate = replace(self.candidate, status=Status.BEST_SEEN)
        is_unfinished = self._move.may_continue and self._budget.exhausted is StopReason.SECONDS
        if rung.barrier is not None and not self.candidate.has_left:
            if not is_unfinished:
                return self.judged(rung.variant)
            weight = self.candidate.history[-1].mu if self.candidate.history else None
            self.candidate = replace(self.candidate, first_weight=weight)
        return self.candidate

    @property
    def _is_over(self) -> bool:
        """Whether the time or the iterations of the move are used up."""
        return self._budget.exhausted is not None or self._iterations_left <= 0

    @property
    def _iterations_left(self) -> int:
        """Number of iterations that are left."""
        used = self.candidate.iterations - self._begin.iterations
        return self._move.iterations - max(used - 1, 0)

    # ---- moves

    def _descend_freely(self, ground: Ground, memory: FreeMemory) -> Iterator[DesignEvent]:
        """Descend on a level without a barrier, until the descent leaves the limits."""
        controls = [self.candidate.over_horizon, self._begin.over_horizon]
        is_limited, offset = self._grounds.is_limited, self.candidate.iterations
        done = offset - self._begin.iterations
        last = -1
        for step in ground.descend_freely(
            controls, memory, done, self._budget, is_limited=is_limited
        ):
            if step.iterate.index <= last and not step.iterate.status:
                offset = self.candidate.iterations
            last = step.iterate.index
            is_misled = is_limited and 0.0 < step.iterate.gamma < LEAST_STEP
            if step.has_left or is_misled:
                self.candidate = replace(self.candidate, has_left=True)
                return
            yield from self._recorded(step, ground, offset)
            if self._is_over:
                return
        if is_limited and last >= 0 and not step.is_inside:
            self.candidate = replace(self.candidate, has_left=True)

    def _descend_inside(self, ground: Ground, barrier: Barrier) -> Iterator[DesignEvent]:
        """Descend through stages with a falling weight of the barrier.

        The last stage is repeated within tighter limits while its result violates one.
        """
        begin = ground.begin(
            self.candidate.control, self._budget, strictly=self.candidate.begins_inside
        )
        if begin is None:
            return
        self.candidate = replace(self.candidate, begins_inside=False)
        weights, direction = barrier.weights, ground.direction()
        point = ground.problem(barrier, weights[0], {}).point(begin)
        tightening: dict[str, float] = {}
        number = repeated = 0
        while point.values is not None and repeated <= MAX_REPEATED_STAGES:
            left = len(weights) - number
            share = 1.0 if left == 1 else min(STAGE_SHARE_FACTOR / left, 1.0)
            budget = self._budget.share(share)
            problem = ground.problem(barrier, weights[number], tightening)
            iterations = int(np.ceil(max(self._iterations_left, 1) / left))
            offset = max(self.candidate.iterations - bool(number or repeated), 0)
            for step in ground.stage(barrier, problem, point, direction, iterations, self._budget):
                yield from self._recorded(step, ground, offset)
                if budget.exhausted is not None or self.candidate.is_held_up:
                    break
            if self._is_over or self.candidate.is_held_up:
                return

            point, status = step.iterate.point, step.iterate.status
            weight = weights[number]
            if weight <= PRICED_MU and step.iterate.slope <= PRICED_SLOPE * weight:
                prices = problem.prices(point, ground.task.controls)
                self.candidate = replace(self.candidate, prices=prices)
            margins = self._margins(step) if left == 1 else step.margins
            is_outside = min(margins.values(), default=0.0) < 0.0
            if left == 1 and not is_outside and status not in (None, Status.MAX_ITERATIONS):
                return
            if weights[number] <= TIGHTENING_MU:
                tightening = tightened(tightening, margins)
            number += left > 1
            if left == 1 and is_outside:
                repeated += 1
                sharp = [i for i, weight in enumerate(weights) if weight <= REPEATED_MU]
                number = sharp[0] if sharp and step.is_inside else number

    def _recorded(self, step: Step, ground: Ground, offset: int) -> Iterator[DesignEvent]:
        """Take an iterate into the candidate, and yield it where it is new."""
        found, iterate = self.candidate, step.iterate
        cost = np.inf if step.point is None or not step.is_inside else step.point.cost
        found = replace(found, slope=iterate.slope, status=iterate.status)
        is_stated = not ground.task.system.variant.is_coarse
        if step.mu:
            if step.point is not None:
                size = ground.level.problem.size(step.point)
                self._latest = step.control, step.point.cost, size
            if cost <= self._level_cost:
                self._level_cost, found = cost, replace(found, control=step.control)
        elif step.is_inside:
            found = replace(found, control=step.control, repeats=1, curves=None)
            if is_stated and step.point is not None and not self._grounds.is_limited:
                found = found.improved(step.control, step.point)
            elif is_stated and cost <= self._level_cost:
                self._level_cost = cost

        row = row_of(
            step.point,
            iteration=offset + iterate.index,
            slope=iterate.slope,
            gamma=iterate.gamma,
            seconds=self._move.budget.seconds_used,
            steps=self._grounds.steps - self._steps_before,
            rate=1.0 / ground.task.dt,
            mu=step.mu,
            margins=step.margins,
        )
        found = replace(found, steps=row.steps, is_held_up=self._holds_up(row, step))
        last = found.history[-1] if found.history else None
        is_new = last is None or (last.iteration, last.rate, last.mu) != (
            row.iteration,
            row.rate,
            row.mu,
        )
        if is_new:
            found = replace(found, history=extended(found.history, [row]))
        self.candidate = found
        stopped = found if found.status else replace(found, status=Status.INTERRUPTED)
        offer_result(stopped)
        if self._budget.stop.requested:
            self.candidate = stopped
        if is_new:
            yield DesignEvent(start=found.name, row=row)

    def _holds_up(self, row: HistoryRow, step: Step) -> bool:
        """Whether the last steps of a descent inside the limits were very short."""
        tolerance = self._grounds.stated.task.experiment.descent.tolerance
        self._are_short.append(0.0 < row.gamma <= SHORT and row.slope > STEEP * tolerance)
        return bool(step.mu) and step.is_inside and 2 * sum(self._are_short) >= SHORT_WINDOW

    def _margins(self, step: Step) -> Mapping[str, float]:
        """Relative margins of an iterate, on the unmodified model as well where it is the last."""
        if not (step.is_inside and self._move.is_last):
            return step.margins
        task = self._grounds.stated.task
        control = np.tile(step.control, (self.candidate.repeats, 1))
        try:
            found = verify(task, task.plant.simulate(task.theta, control))
        except SimulationDivergedError:
            return step.margins
        exact = found.relative_margins
        return {kind: min(each, exact.get(kind, each)) for kind, each in step.margins.items()}

    # ---- the stated plant

    def judged(self, variant: ModelVariant) -> Candidate:
        """Compare what a rung has found on the stated plant, where it has to keep all limits.

        Where the coarse level is wrong, the next rung begins where this one began.

        Args:
            variant: Plant of the rung.
        """
        found, begun, stated = self.candidate, self._begin, self._grounds.stated
        last, level_cost, is_far_lower = self._last()
        control = without_jumps(stated, last.over_horizon, variant.sample_factor)
        curves = found.curves if self._move.keeps_curves else None
        following = replace(
            found, control=control, curves=curves, repeats=1, first_weight=None, is_judged=True
        )
        values = stated.values(control)
        point = stated.point_along(values)
        if point is None:
            return replace(begun, history=found.history, steps=found.steps, is_judged=True)

        if stated.keeps_along(values):
            following = following.improved(control, point)
            return replace(following, rank=point.cost)

        centre = stated.task.centre
        search = InsideSearch(stated, 0)
        for each in (
            with_corrected_end(stated, control, self._budget),
            search.largest(centre, control - centre, self._budget),
        ):
            if each is not None:
                following = following.improved(each.control, each.point)
        if last is not found and (inside := stated.inside(found.over_horizon)) is not None:
            following = following.improved(found.over_horizon, inside)
        if is_far_lower and following.best is not None and not self._move.is_last:
            # Where the rung ends outside the limits, the next one begins inside.
            return replace(following, control=following.best, rank=following.cost)
        error = point.cost - level_cost
        if error <= LARGEST_ERROR * stated.problem.size(point):
            return replace(following, rank=min(level_cost, following.cost))
        if begun.cost < point.cost:
            blunt = begun.first_weight
            following = replace(following, control=begun.over_horizon, first_weight=blunt)
        return replace(following, rank=min(point.cost, following.cost))

    def _last(self) -> tuple[Candidate, float, bool]:
        """The candidate with its last control if that costs less on its level, and its cost there.

        A small violation ends after scaling, or on the next rung. When the time is over, only a
        control that costs far less is worth the simulations. The third value tells whether it does.
        """
        found, lowest, latest = self.candidate, self._level_cost, self._latest
        if latest is None or self._move.budget.stop.requested or latest[1] >= lowest:
            return found, lowest, False
        control, level_cost, size = latest
        is_far_lower = lowest - level_cost > LARGEST_ERROR * size
        if not is_far_lower and self._move.budget.exhausted is not None:
            return found, lowest, False
        return replace(found, control=control), level_cost, is_far_lower


def tightened(before: Mapping[str, float], margins: Mapping[str, float]) -> dict[str, float]:
    """Choose how far limits are moved inwards in the next stage.

    Args:
        before: Share of half of its range by which each kind of limits was moved before.
        margins: Relative margins with which they then hold.
    """
    return {
        kind: max(
            0.0,
            before.get(kind, 0.0) - (TIGHTENING_GAIN if margin < 0.0 else RELEASE_GAIN) * margin,
        )
        for kind, margin in margins.items()
    }


def without_jumps(level: DescentLevel, control: Array, factor: int) -> Array:
    """A control of longer samples without steps, where rates of controls are limited.

    Args:
        level: The stated level.
        control: (N, nu) control [u-unit].
        factor: Factor by which its samples are longer.
    """
    values = control[::factor]
    is_stepped = factor > 1 and np.array_equal(control, np.repeat(values, factor, axis=0))
    if level.constraints.rate is None or not is_stepped:
        return control

    # The values of the longer samples hold at their middles.
    middles = factor * (np.arange(len(values)) + 0.5) - 0.5
    times = np.arange(len(control))
    return np.stack([np.interp(times, middles, column) for column in values.T], axis=1)


def row_of(
    point: DesignPoint | None,
    *,
    iteration: int,
    seconds: float,
    steps: int,
    rate: float,
    slope: float = np.nan,
    gamma: float = np.nan,
    mu: float = 0.0,
    margins: Mapping[str, float],
) -> HistoryRow:
    """An iterate as a row of the history."""
    criterion = None if point is None else point.criterion
    return HistoryRow(
        iteration=iteration,
        cost=np.inf if point is None else point.cost,
        criterion=np.inf if criterion is None else criterion.value,
        min_eigenvalue=0.0 if criterion is None else float(criterion.eigenvalues[0]),
        slope=slope,
        gamma=gamma,
        seconds=seconds,
        steps=steps,
        rate=rate,
        mu=mu,
        margin=min(margins.values(), default=np.nan),
        margins=dict(margins),
        motion=iterate_motion(None if point is None else point.trajectory),
    )
