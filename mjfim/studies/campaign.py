"""`mjfim.run_campaign`: design, record, identify, design again with what is known by then, until it is known as well as wanted.

Redesigns are made at the estimate of all recordings so far, whose information counts as known before (see `redesign`).
Every estimate is of all recordings and starts from the last one; priors stay about the stated guess, where they belong.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import stop_on_interrupt
from mjfim.errors import ExperimentError, MjfimError, SimulationDivergedError
from mjfim.excitation.design import design_budget, design_task
from mjfim.excitation.target_accuracy import (
    largest_ratio_to_target,
    require_reachable,
    target_accuracies,
)
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.identification.identify import identify_system
from mjfim.records.campaign import Campaign, CampaignStatus, EarlierRound, Round
from mjfim.records.design import Design, Status
from mjfim.records.estimate import Estimate
from mjfim.records.events import DesignCallback
from mjfim.records.recording import Recording
from mjfim.studies.redesign import Past, redesigned, restated

PROGRESS = (
    0.99  # of the last round's worst σ over the wanted one; a round that leaves more made none
)
JUMP = 4.0  # standard deviations that an estimate moves from one round to the next only where something is wrong
Measure = Callable[[Design, int], Recording | Sequence[Recording] | None]


def run_campaign(
    experiment: Experiment,
    measure: Measure,
    rounds: int = 10,
    callback: DesignCallback | None = None,
    threads: int | None = None,
    report: Callable[[Round], None] | None = None,
    done: Sequence[EarlierRound] = (),
    executor: Executor | None = None,
) -> Campaign:
    """Design, record and identify in turn until every parameter's `wanted` σ is reached, or the rounds are used up.

    measure: plays a design and returns what was recorded, `(design, round)`, the first round being 1; None: not recorded yet,
    and the campaign ends with that design pending. Of a simulated robot:
    `lambda design, k: mjfim.simulate(robot, design.trajectory, seed=k)`
    callback: called with every iterate of every design;  report: with every round
    done: rounds that are recorded already, whose designs are not made anew
    executor: of `concurrent.futures`, runs several starts under hard limits at once
    Ctrl-C ends the campaign after the last complete round. Raises ExperimentError where nothing is wanted,
    UnidentifiableError where a wanted parameter cannot be told alone, and whatever `design` and `identify` raise.
    """
    if rounds < 1:
        raise ExperimentError(f"run_campaign: {rounds} rounds; at least 1")
    if experiment.earlier:
        raise ExperimentError(
            f"{experiment.source}: earlier: a campaign's estimate comes from recordings alone; give those of earlier "
            "experiments (`done` in Python) instead of the information they left"
        )
    return _Loop(DesignTask.resolve(experiment, threads=threads), callback, report, executor).run(
        measure, rounds, done
    )


class _Loop:
    """A campaign on its way. base: the experiment as stated, by which everything is identified"""

    def __init__(
        self,
        base: DesignTask,
        callback: DesignCallback | None,
        report: Callable[[Round], None] | None,
        executor: Executor | None,
    ) -> None:
        self.base, self.wanted = base, target_accuracies(base)
        self.callback, self.report, self.executor = callback, report, executor
        self.rounds: list[Round] = []
        self.pending: Design | None = None

    def run(self, measure: Measure, count: int, done: Sequence[EarlierRound]) -> Campaign:
        """The whole loop."""
        try:
            for played in done:
                if not self._record(played):
                    return self._concluded(CampaignStatus.INTERRUPTED)
            while not self._formally() and len(self.rounds) < count:
                ended = self._play(measure)
                if ended is not None:
                    return self._concluded(ended)
        except KeyboardInterrupt:
            return self._concluded(CampaignStatus.INTERRUPTED)
        if not self._formally():
            return self._concluded(CampaignStatus.EXHAUSTED)
        last = self.rounds[-1].estimate
        doubtful = last.misfit or any(_doubts(last, self.wanted))
        return self._concluded(CampaignStatus.DOUBTFUL if doubtful else CampaignStatus.REACHED)

    def _play(self, measure: Measure) -> CampaignStatus | None:
        """One round; says how the campaign ends where it does before the recording."""
        found, told = self._design()
        self.pending = found
        if found.status is Status.INTERRUPTED:
            return CampaignStatus.INTERRUPTED
        if found.status is Status.INFEASIBLE:
            return CampaignStatus.INFEASIBLE
        require_reachable(self.base, found, self.wanted)
        answer = measure(found, len(self.rounds) + 1)
        recordings = (answer,) if isinstance(answer, Recording) else tuple(answer or ())
        if not recordings:
            return CampaignStatus.WAITING
        recorded = self._record(
            EarlierRound(
                recordings=recordings,
                theta=found.theta,
                predicted=found.final.std,
                control=found.trajectory.ctrl,
            ),
            found,
            told,
        )
        if not recorded:
            return CampaignStatus.INTERRUPTED
        self.pending = None
        return None

    def _design(self) -> tuple[Design, tuple[str, ...]]:
        """The better of the designs from the initial control and from the last round's, at the estimate.

        Where there is none at the estimate, at the last place where there was one, and a warning.
        """
        if not self.rounds:
            stated = self.base.restated(restated(self.base))
            with stop_on_interrupt() as stop:
                budget = design_budget(stated, stop)
                return design_task(
                    stated, callback=self.callback, executor=self.executor, budget=budget
                ), ()
        first, last = self.rounds[0], self.rounds[-1]
        count = sum(len(r.recordings) for r in self.rounds)
        past = Past(last.estimate, count, first.theta, first.control, last.control)
        try:
            return redesigned(
                self.base, past, last.estimate.theta, self.callback, self.executor
            ), ()
        except MjfimError as error:
            told = f"no design at the estimate, so it is made where the last was: {error}"
            return redesigned(self.base, past, last.theta, self.callback, self.executor), (told,)

    def _record(
        self, played: EarlierRound, found: Design | None = None, told: tuple[str, ...] = ()
    ) -> bool:
        """Identify from all recordings and keep the round; False where the identification was interrupted."""
        p, last = self.base.parameters, self.rounds[-1] if self.rounds else None
        theta = p.guess if played.theta is None else played.theta
        blank = np.full(len(p), np.nan)
        recordings = [*(r for each in self.rounds for r in each.recordings), *played.recordings]
        estimate = identified(self.base, recordings, theta if last is None else last.estimate.theta)
        if estimate is None:
            return False
        warnings = [
            *told,
            *(f"design: {sentence}" for sentence in (found.warnings if found is not None else ())),
        ]
        warnings += [*estimate.warnings, *self._suspicions(estimate)]
        self.rounds.append(
            Round(
                number=len(self.rounds) + 1,
                theta=theta,
                predicted=blank if played.predicted is None else played.predicted,
                control=played.recordings[0].ctrl if played.control is None else played.control,
                recordings=played.recordings,
                estimate=estimate,
                design=found,
                warnings=tuple(warnings),
            )
        )
        if self.report is not None:
            self.report(self.rounds[-1])
        return True

    def _suspicions(self, now: Estimate) -> Iterator[str]:
        """What the step from the last round to this one says against the model, or against going on."""
        names = self.base.parameters.names
        yield from _doubts(now, self.wanted)
        if not self.rounds:
            return
        before = self.rounds[-1].estimate
        known = np.isfinite(before.std) & (before.std > 0.0)
        moved = np.zeros(len(names))
        moved[known] = np.abs(now.theta - before.theta)[known] / before.std[known]
        for j in np.flatnonzero(moved > JUMP).tolist():
            yield (
                f"{names[j]} moved from {before.theta[j]:.4g} to {now.theta[j]:.4g}, {moved[j]:.1f} σ of the last round's "
                "estimate: formal σ is not accuracy; the model or the noise is wrong, or the last fit was a false minimum"
            )
        (was, _), (is_, j) = (
            largest_ratio_to_target(before.std, self.wanted),
            largest_ratio_to_target(now.std, self.wanted),
        )
        if is_ > PROGRESS * was:
            yield f"no progress: the worst σ over the wanted one went from {was:.3g} to {is_:.3g} ({names[j]})"

    def _formally(self) -> bool:
        """Every wanted σ is reached."""
        return (
            bool(self.rounds)
            and largest_ratio_to_target(self.rounds[-1].attained, self.wanted)[0] <= 1.0
        )

    def _concluded(self, status: CampaignStatus) -> Campaign:
        warnings = [f"round {r.number}: {sentence}" for r in self.rounds for sentence in r.warnings]
        names = self.base.parameters.names
        return Campaign(
            parameters=names,
            wanted=self.wanted,
            rounds=tuple(self.rounds),
            status=status,
            pending=self.pending,
            warnings=tuple(warnings),
        )


def identified(base: DesignTask, recordings: Sequence[Recording], start: Array) -> Estimate | None:
    """Estimate from all recordings; where that is a misfit or fails, from the stated guess too, and the better one.

    None where it was interrupted: a round is complete or it is not kept.
    """
    found: list[Estimate] = []
    fault: SimulationDivergedError | None = None
    for begin in (start, base.parameters.guess):
        if found and (not found[0].misfit or np.array_equal(begin, start)):
            break
        try:
            found.append(identify_system(base.system, recordings, start=begin))
        except SimulationDivergedError as error:
            fault = fault or error
        if found and found[-1].interrupted:
            return None
    if not found:
        raise fault or SimulationDivergedError("no start of the fit can be simulated")
    return min(found, key=lambda e: e.chi2)


def _doubts(estimate: Estimate, wanted: Array) -> Iterator[str]:
    """Why the formal standard deviations of wanted parameters are not to be trusted, besides a misfit."""
    at = [
        n
        for n, w in zip(estimate.parameters, wanted, strict=True)
        if np.isfinite(w) and n in estimate.at_bound
    ]
    if at:
        yield f"wanted, but at a bound: {', '.join(at)}"
    if not estimate.success and not estimate.combinations and not at:
        yield f"the fit did not succeed: {estimate.status}"
