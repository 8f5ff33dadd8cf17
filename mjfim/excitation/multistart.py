"""Several starts under hard limits: all compete on blunt barriers, the best go on to sharp ones."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from mjfim.arrays import Array
from mjfim.excitation.constrained import Chase, ConstrainedSearch, perform, pursue
from mjfim.excitation.constraints import ConstraintSet, constraint_set_of
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.interior_point import SHRINK_FACTORS, BarrierSchedule, updated_tightening
from mjfim.excitation.unconstrained import Stage
from mjfim.excitation.verification import verify
from mjfim.parallel import collect_finished, workers_of
from mjfim.records.design import HistoryRow, Status

KEPT = 4  # one in so many goes on


HALFWAY, SHARP = (
    0.01,
    1e-3,
)  # mu down to which starts compete, and where they are few, on samples as stated


SPAN = 3.0  # times mu there with which the second round begins


PROOFS, LATE, PATIENCE = (
    3,
    1e-3,
    60,
)  # repetitions of a winner that leaks, their first mu, their iterations


EARLY, SPARE = (
    0.5,
    0.05,
)  # share of the iterations and of the time for the first round, and of the time for repetitions


@dataclass(frozen=True, eq=False)
class Lead:
    """What a start goes on with. control: (N, nu) or None;  cost: J, on the stated model where it keeps its limits there"""

    control: Array | None
    cost: float


@dataclass(frozen=True, eq=False)
class Multistart:
    """What all starts have in common.

    fine: the experiment on its lifted plant;  coarse: on a plant that is quicker to step, or smoother, or None
    executor: that runs the starts, None: one after the other here
    begun: when the time began to count, by `time.perf_counter`
    """

    fine: Stage
    coarse: Stage | None
    executor: Executor | None = None
    begun: float = field(default_factory=time.perf_counter)

    @cached_property
    def _constraints(self) -> ConstraintSet:
        """The limits on the plant without clamps."""
        return constraint_set_of(self.fine.task)

    @property
    def _seconds(self) -> float:
        """That are left."""
        stated = self.fine.task.experiment.descent.seconds
        return np.inf if stated is None else max(self.begun + stated - time.perf_counter(), 0.0)

    @property
    def _faithful(self) -> bool:
        """The coarse level differs by its timestep alone: its minima are nearly those of the stated one."""
        if self.coarse is None:
            return True
        level = self.coarse.task.system.variant
        return replace(level, timestep_factor=1) == self.fine.task.system.variant

    def run(self, starts: Sequence[InitialControl], chases: list[Chase]) -> Iterator[HistoryRow]:
        """Every iterate; `chases` gets one entry per start, the winners' ones after the second round."""
        d = self.fine.task.experiment.descent
        reserve = SPARE * (d.seconds or 0.0)
        first = self.coarse or self.fine
        if (
            len(starts) == 1
            and self.coarse is None
            and starts[0].basis is None
            and starts[0].repeats == 1
        ):
            yield from self._round(
                self.fine,
                starts,
                BarrierSchedule(),
                d.max_iterations,
                self._seconds - reserve,
                chases,
            )
            return
        share = EARLY * self._seconds / self._turns(len(starts))
        last = SHARP if len(starts) < KEPT and self._faithful else HALFWAY
        yield from self._round(
            first,
            starts,
            BarrierSchedule(last=last),
            round(EARLY * d.max_iterations),
            share,
            chases,
        )
        if any(chase.status is Status.INTERRUPTED for chase in chases):
            return
        leads = [Lead(chase.control, chase.cost) for chase in chases]
        if self.coarse is not None or any(start.repeats > 1 for start in starts):
            leads = [
                self._judge(chase, start) for start, chase in zip(starts, chases, strict=False)
            ]
        order = sorted(
            (i for i, lead in enumerate(leads) if lead.control is not None),
            key=lambda i: leads[i].cost,
        )
        kept = order[: max(1, len(chases) // KEPT)]
        if not kept:
            return
        again = [
            InitialControl(name=chases[i].name, control=np.asarray(leads[i].control)) for i in kept
        ]
        for i in order[len(kept) :]:
            if np.isfinite(leads[i].cost):
                chases[i].status = Status.LEFT
        left = max(self._seconds - reserve, 0.0) / self._turns(len(again))
        done = max((row.iteration for i in kept for row in chases[i].history), default=0)
        second: list[Chase] = []
        try:
            for row in self._round(
                self.fine,
                again,
                BarrierSchedule(first=min(SPAN * last, HALFWAY)),
                d.max_iterations - done,
                left,
                second,
            ):
                yield replace(row, iteration=row.iteration + done + 1)
        finally:  # also where the user interrupts
            found = {chase.name: chase for chase in second}
            for i in kept:
                if chases[i].name in found:
                    _continue(chases[i], found[chases[i].name])
            best = min(chases, key=lambda chase: chase.cost)
            if np.isfinite(best.cost) and best.status in (
                Status.LEFT,
                Status.INFEASIBLE,
            ):  # better after all
                best.status = Status.MAX_ITERATIONS

    def prove(self, chases: list[Chase]) -> Iterator[HistoryRow]:
        """Hold back a winner that leaves a limit on the untouched model, between what the barrier looked at; a few times."""
        held = dict[str, float]()
        for _ in range(PROOFS):
            leaking = self._leaking(chases)
            if leaking is None:
                return
            if self._seconds == 0.0:
                break
            i, shares = leaking
            held = updated_tightening(held, shares)
            best, again = chases[i], list[Chase]()
            start = InitialControl(name=best.name, control=np.asarray(best.control))
            try:
                yield from self._round(
                    self.fine,
                    [start],
                    BarrierSchedule(first=LATE),
                    PATIENCE,
                    self._seconds,
                    again,
                    held,
                )
            finally:  # also where the user interrupts
                for chase in again:
                    if np.isfinite(chase.cost):
                        chase.history = _joined(best.history, chase.history)
                        chase.steps += best.steps
                        chases[i] = chase
        leaking = self._leaking(chases)
        if leaking is not None:
            self._shrink(chases[leaking[0]])

    def _leaking(self, chases: list[Chase]) -> tuple[int, dict[str, float]] | None:
        """Which one wins and leaves a limit on the untouched model, and its shares; None where there is none."""
        if not chases or any(chase.status is Status.INTERRUPTED for chase in chases):
            return None
        i = min(range(len(chases)), key=lambda i: chases[i].cost)
        if chases[i].control is None or not np.isfinite(chases[i].cost):
            return None
        task = self.fine.task
        found = verify(task, task.plant.simulate(task.theta, np.asarray(chases[i].control)))
        return (
            None
            if found.is_feasible or not np.isfinite(found.deviation)
            else (i, found.relative_margins)
        )

    def _judge(self, chase: Chase, start: InitialControl) -> Lead:
        """Replace a coarse level's cost by that on the stated model, of what was found or of the start if that is better.

        Returns what to go on with: that, or what leaks here as the coarse level saw it, since the second round brings it back.
        """
        lead = Lead(chase.control, chase.cost)
        found = [control for control in (chase.control, start.over_horizon) if control is not None]
        costs = [self._worth(control) for control in found]
        best = int(np.argmin(costs))
        chase.cost = costs[best]
        if np.isfinite(chase.cost):
            chase.control = found[best]
        leaks = lead.control is not None and np.isinf(costs[0])
        return lead if leaks else Lead(chase.control, chase.cost)

    def _worth(self, control: Array) -> float:
        """J on the stated model, infinite outside the limits, also where a clamp alone keeps a force inside."""
        task, constraints = self.fine.task, self._constraints
        watched = task.plant.observe(task.theta, control, constraints.observations)
        if watched is None:
            return np.inf
        values = constraints.evaluate(*watched, slopes=False)
        if not constraints.is_feasible(values) or not verify(task, values.trajectory).is_feasible:
            return np.inf
        return self.fine.problem.point(values.trajectory).cost

    def _shrink(self, chase: Chase) -> None:
        """Shrink a control about the centre until no limit is left, if it ever is."""
        task = self.fine.task
        for share in SHRINK_FACTORS:
            control = task.centre + share * (np.asarray(chase.control) - task.centre)
            cost = self._worth(control)
            if np.isfinite(cost):
                chase.control, chase.cost = control, cost
                return

    def _turns(self, count: int) -> int:
        """How many of the tasks run after one another."""
        return -(-max(count, 1) // workers_of(self.executor))

    def _round(
        self,
        stage: Stage,
        starts: Sequence[InitialControl],
        schedule: BarrierSchedule,
        budget: int,
        seconds: float,
        chases: list[Chase],
        held: Mapping[str, float] | None = None,
    ) -> Iterator[HistoryRow]:
        """Every iterate of one descent per start, at most `budget` each."""
        level, combinations = stage.task, stage.basis
        stated = level.experiment.descent.tolerance
        common = ConstrainedSearch(
            level.experiment,
            starts[0],
            replace(schedule, tolerance=max(schedule.tolerance, stated)),
            max(budget, 1),
            seconds,
            combinations,
            level.added_information,
            level.system.variant,
            max(workers_of(self.executor) // len(starts), 1)
            if self.executor is not None
            else level.system.threads,
            held or {},
            time.time() - (time.perf_counter() - self.begun),
        )
        searches = [replace(common, start=start) for start in starts]
        if self.executor is None:
            for search in searches:
                if chases and self._seconds == 0.0:
                    return
                chases.append(Chase(search.start.name))
                yield from pursue(search, chases[-1], level)
            return
        futures: list[Future[Chase]] = []
        try:
            futures += [self.executor.submit(perform, search) for search in searches]
            for future in futures:
                if chases and self._seconds == 0.0 and future.cancel():
                    continue
                chases.append(future.result())
                yield from chases[-1].history
        except (
            BaseException
        ):  # the user's Ctrl-C, that of what watches the iterates, or a fault: nothing may run on
            chases += collect_finished(self.executor, futures[len(chases) :])
            raise


def _continue(chase: Chase, later: Chase) -> None:
    """Bring a start of the first round to where it came in the second, but for what it had found better before."""
    if later.control is not None and not later.cost > chase.cost:
        chase.control, chase.cost = later.control, later.cost
    chase.history = _joined(chase.history, later.history)
    chase.steps += later.steps
    chase.status, chase.slope = later.status, later.slope
    if np.isfinite(chase.cost) and later.status is Status.INFEASIBLE:
        chase.status = Status.MAX_ITERATIONS


def _joined(early: tuple[HistoryRow, ...], late: tuple[HistoryRow, ...]) -> tuple[HistoryRow, ...]:
    """One history of two rounds."""
    if not early:
        return late
    end = early[-1]
    moved = (
        replace(r, iteration=r.iteration + end.iteration + 1, steps=r.steps + end.steps)
        for r in late
    )
    return (*early, *moved)
