"""`mjfim.run_campaign`: design, record and identify in rounds, until every target is reached.

Every estimate uses all recordings; its fit starts at the last estimate. Priors remain centred at
the stated guess. A redesign is made at the estimate of all recordings so far, whose information it
uses as prior information.

The scales of the parameters remain those of the stated experiment, so that criteria of different
rounds can be compared. The balance between information and effort must remain as well. In the first
design, phi_1 is the share of the information in J, and `d(log phi) * phi_1 = d(effort)` at the
optimum. The n-th of equal experiments changes log phi by 1/n only, so phi is weighted by n phi_1 /
phi_n there (by n with D-optimality, whose phi is a logarithm). Otherwise every round would use less
effort than the one before, and a round at values below the guess less than the first round.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import (
    ExperimentError,
    MjfimError,
    SimulationDivergedError,
    listed,
)
from mjfim.excitation.design import design_budget, design_task
from mjfim.excitation.evaluation import criterion_of
from mjfim.excitation.prior_information import EarlierExperiments, expected_inflation
from mjfim.excitation.shortest_horizon import (
    largest_ratio_to_target,
    require_reachable,
    target_accuracies,
)
from mjfim.excitation.task import DesignTask
from mjfim.experiment.arguments import checked
from mjfim.experiment.given import RecordingsLike, recordings_of
from mjfim.experiment.schema import Experiment, ExperimentLike, experiment_of
from mjfim.identification.identify import identify_system
from mjfim.model.parameters import Parameter
from mjfim.parallel import ExecutorLike, Workers
from mjfim.parallel.budget import StopToken, stop_on_interrupt
from mjfim.records.design import Design, Status
from mjfim.records.estimate import Estimate
from mjfim.records.events import Callback, StudyEvent, shown_progress
from mjfim.records.studies import Campaign, CampaignStatus, RecordedRound, Round
from mjfim.records.trajectory import Recording

# Smallest distance of guesses from bounds, relative to the size of a parameter.
BOUND_GAP = 1e-3

# Largest value of that distance, as a share of the range between the bounds.
MAX_BOUND_GAP = 0.25

# A robust redesign draws its samples within this number of standard deviations about the estimate.
SAMPLING_RANGE = 2.5

# Smallest value of that range, relative to the size of a parameter, so that bounds do not coincide.
MIN_SAMPLING_RANGE = 1e-9


def _known(estimate: Estimate) -> EarlierExperiments:
    """What the recordings so far tell, with the noise and the residuals that they show."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.sqrt(np.diag(estimate.honest_covariance)) / estimate.std
    inflation = expected_inflation([(ratio, len(estimate.recordings))])
    return EarlierExperiments(information=estimate.data, inflation=inflation, sigma=estimate.sigma)


def _information_weight(base: DesignTask, moved: Experiment, rounds: Sequence[Round]) -> float:
    """Weight of the criterion that keeps the balance between information and effort.

    A relative gain of information then costs as much effort as in the first design.
    """
    stated = moved.cost.information
    count = sum(len(each.recordings) for each in rounds) + 1
    if moved.cost.criterion == "D":
        return stated * count

    first_task = base.restated(restate_experiment(base, rounds[0].theta))
    task = base.restated(moved, added=_known(rounds[-1].estimate))
    try:
        first = criterion_of(first_task, rounds[0].control)
        last = criterion_of(task, rounds[-1].control)
    except (MjfimError, ValueError):
        # Where a value is missing, take the weight for equal experiments.
        return stated * count**2

    return float(stated * count * first / last)


def restate_experiment(
    base: DesignTask, theta: Array | None = None, estimate: Estimate | None = None
) -> Experiment:
    """State the experiment of a redesign.

    Its guesses are the given parameters, its scales are unchanged, and it has no true values.
    Guesses keep a small distance from bounds. The parameters of a declared inertia change only
    where the recordings determine all of them. With `[robust]`, whose samples are drawn between the
    bounds, the bounds shrink to a region about the estimate.

    Args:
        base: Task of the experiment as stated.
        theta: (p,) new guesses [theta-unit]; None keeps the stated ones.
        estimate: Estimate from the recordings so far, or None.
    """
    experiment, p = base.experiment, base.parameters
    tables = {}

    for name, spec in experiment.parameters.items():
        table = spec.model_dump(exclude_unset=True)
        table.pop("true", None)
        if spec.inertial is None:
            tables[name] = {**table, **_restated_keys(base, p.names.index(name), theta, estimate)}
            continue

        # A declared inertia is either kept, or replaced by its individual parameters.
        # The recordings have to determine all of them, each more accurately than its size.
        members = [j for j, parameter in enumerate(p.parameters) if parameter.group == name]
        if (
            theta is None
            or estimate is None
            or not (np.diag(estimate.data)[members] * p.magnitude[members] ** 2 > 1.0).all()
        ):
            tables[name] = table
            continue
        for j in members:
            member = _member_table(p.parameters[j])
            tables[p.names[j]] = {**member, **_restated_keys(base, j, theta, estimate)}

    values = experiment.model_dump(exclude_unset=True)
    values["parameters"] = tables
    values["cost"] = {**values.get("cost", {}), "linearize_at": "guess"}
    return experiment.restated(values)


def _member_table(parameter: Parameter) -> dict[str, Any]:
    """Table of a single parameter of a declared inertia, without the keys of a redesign."""
    table = {
        "target": parameter.targets[0].path,
        "unit": parameter.unit,
        "nuisance": parameter.nuisance,
    }
    return table if parameter.prior is None else {**table, "prior": parameter.prior}


def _restated_keys(
    base: DesignTask, index: int, theta: Array | None, estimate: Estimate | None
) -> dict[str, Any]:
    """Keys that a redesign changes in the table of a parameter.

    These are the guess, the scale and, with `[robust]`, the bounds.
    """
    parameter = base.parameters.parameters[index]
    size = float(base.parameters.magnitude[index])
    if theta is None:
        return {"guess": parameter.guess, "scale": parameter.scale}

    low, high = parameter.bounds
    gap = min(BOUND_GAP * size, MAX_BOUND_GAP * (high - low))
    guess = float(np.clip(theta[index], low + gap, high - gap))
    keys: dict[str, Any] = {"guess": guess, "scale": parameter.scale}

    # Robust designs sample parameters that have a prior or bounds.
    is_bounded = np.isfinite(parameter.bounds).all()
    is_sampled = base.experiment.robust is not None and (parameter.prior is not None or is_bounded)
    if is_sampled and estimate is not None and np.isfinite(estimate.std[index]):
        reach = max(SAMPLING_RANGE * float(estimate.std[index]), MIN_SAMPLING_RANGE * size)
        keys["bounds"] = (max(low, guess - reach), min(high, guess + reach))
    return keys


# A round makes no progress where the largest ratio of sigma to target stays above this share of the
# ratio in the last round.
NO_PROGRESS_RATIO = 0.99

# Change of an estimate from one round to the next above which a warning is given [standard
# deviations].
SUSPICIOUS_CHANGE = 4.0

# Records the experiment that was designed for a round: (design, number of the round from 1).
Measure = Callable[[Design, int], RecordingsLike | None]


@checked
def run_campaign(
    experiment: ExperimentLike,
    measure: Measure,
    *,
    rounds: int = 10,
    callback: Callback | None = None,
    threads: int | None = None,
    done: Sequence[RecordedRound] = (),
    executor: ExecutorLike | None = None,
    stop: StopToken | None = None,
    progress: bool = True,
) -> Campaign:
    """Design, record and identify in rounds until every target standard deviation is reached.

    The campaign also ends after a given number of rounds.

    Args:
        experiment: Experiment whose parameters state the `wanted` standard deviations.
        measure: Plays a design and returns its recording or recordings: `measure(design, number)`,
            where the number of the first round is 1. It returns None where nothing is recorded yet;
            the campaign then ends with that design pending. For a simulated robot: `lambda design,
            number: mjfim.simulate(robot, design, seed=number)`.
        rounds: Largest number of rounds.
        callback: Called with the events of every design and estimation, and with a `StudyEvent`
            after every round, whose `result` is the `Round`.
        threads: Threads of MuJoCo; None for all cores.
        done: Rounds that are recorded already and not designed again. A `RecordedRound` is a tuple
            (design, recordings), where `recordings` is a tuple of `Recording`, and `design` is None
            for recordings that were made without one.
        executor: Where the work is done (`mjfim.ExecutorLike`); None for this process. It
            divides every design and every estimate.
        stop: Ends the campaign early, as Ctrl-C does, after the last complete round.
        progress: False for no bar of progress in a notebook; a callback replaces the bar as well.

    Raises:
        ExperimentError: No parameter states a target, or the request is faulty.
        UnidentifiableError: A parameter with a target cannot be identified alone.
        MjfimError: As `mjfim.design` and `mjfim.identify` raise it.
    """
    experiment = experiment_of(experiment)
    if rounds < 1:
        raise ExperimentError(f"run_campaign: {rounds} rounds; needs at least 1")
    if experiment.earlier:
        raise ExperimentError(
            f"{experiment.source}: earlier: the estimate of a campaign comes from recordings "
            "alone; give the recordings of earlier experiments (`done` in Python) instead of "
            "their information"
        )

    task = DesignTask.resolve(experiment, threads=threads)
    with (
        stop_on_interrupt(stop) as token,
        shown_progress("campaign", callback, progress) as show,
    ):
        campaign = _CampaignRun(
            base=task,
            wanted=target_accuracies(task),
            count=rounds,
            callback=show,
            executor=Workers.of_any(executor),
            stop=token,
        )
        return campaign.record(campaign.run(measure, done))


@dataclass(kw_only=True, eq=False)
class _CampaignRun:
    """A campaign while it runs.

    Attributes:
        base: Task of the experiment as stated, with which all estimates are made.
        wanted: (p,) target standard deviations [theta-unit], infinite where there is none.
        count: Largest number of rounds.
        callback: Called with all events.
        executor: Where the work is done.
        stop: Ends the campaign early.
        rounds: Complete rounds.
        pending: Design that is not recorded yet.
    """

    base: DesignTask
    wanted: Array
    count: int
    callback: Callback | None
    executor: ExecutorLike | None
    stop: StopToken
    rounds: list[Round] = field(default_factory=list)
    pending: Design | None = None

    def run(self, measure: Measure, done: Sequence[RecordedRound]) -> CampaignStatus:
        """Make all rounds.

        Args:
            measure: Plays a design and returns its recordings.
            done: Rounds that are recorded already.

        Returns:
            The reason for which the campaign ended.
        """
        for design, recordings in done:
            if not self._add_round(design, recordings):
                return CampaignStatus.INTERRUPTED

        while not self._targets_reached() and len(self.rounds) < self.count:
            status = self._make_round(measure)
            if status is not None:
                return status

        if not self._targets_reached():
            return CampaignStatus.EXHAUSTED
        last = self.rounds[-1].estimate
        is_doubtful = last.misfit or any(_doubts(last, self.wanted))
        return CampaignStatus.DOUBTFUL if is_doubtful else CampaignStatus.REACHED

    def _make_round(self, measure: Measure) -> CampaignStatus | None:
        """Design, record and identify once.

        Returns:
            None after a complete round, else the reason for which the campaign ends.
        """
        design, remarks = self._design()
        self.pending = design
        if design.status is Status.INTERRUPTED:
            return CampaignStatus.INTERRUPTED
        if design.status is Status.INFEASIBLE:
            return CampaignStatus.INFEASIBLE
        require_reachable(self.base, design, self.wanted)

        answer = measure(design, len(self.rounds) + 1)
        recordings = () if answer is None else recordings_of(self.base.system, answer)

        # A recording that the user interrupted is not used.
        if self.stop.requested:
            return CampaignStatus.INTERRUPTED
        if not recordings:
            return CampaignStatus.WAITING

        if not self._add_round(design, recordings, remarks):
            return CampaignStatus.INTERRUPTED
        self.pending = None
        return None

    def _design(self) -> tuple[Design, tuple[str, ...]]:
        """Design at the estimate, or at the parameters of the last design where that fails.

        Returns:
            The design, and remarks for the user.
        """
        if not self.rounds:
            task = self.base.restated(restate_experiment(self.base))
            return self._designed(task, executor=self.executor), ()

        last = self.rounds[-1]
        try:
            return self._redesign(last.estimate.theta), ()
        except MjfimError as error:
            remark = (
                "no design could be made at the estimate; it is made at the parameters of the last "
                f"design instead: {error}"
            )
            return self._redesign(last.theta), (remark,)

    def _redesign(self, theta: Array) -> Design:
        """Design again at theta, (p,), with the information of the recordings so far.

        One design starts at the initial control and one at the control of the last design; the
        better of the two is returned.
        """
        base, last = self.base, self.rounds[-1]
        estimate = last.estimate
        moved = restate_experiment(base, theta, last.estimate)
        moved = moved.replace(cost={"information": _information_weight(base, moved, self.rounds)})
        known = _known(estimate)
        task = base.restated(moved, added=known)
        first = self._designed(task, executor=self.executor)
        if last.control.shape != task.control.shape or first.status is Status.INTERRUPTED:
            return first

        # The second design starts at the control of the last design, and nowhere else.
        only_start = {"starts": 1, "previous": (), "fourier": (), "repeats": ()}
        task = base.restated(moved.replace(descent=only_start), added=known)
        try:
            second = self._designed(task, initial_control=last.control)
        except SimulationDivergedError:
            # The old control may be too strong for the new parameters.
            return first

        if second.status is Status.INTERRUPTED:
            return second
        return min(
            (first, second),
            key=lambda design: (design.status is Status.INFEASIBLE, design.final.cost),
        )

    def _designed(self, task: DesignTask, **further: Any) -> Design:
        """Design within the budget of a task."""
        budget = design_budget(task, self.stop)
        return design_task(task, callback=self.callback, budget=budget, **further)

    def _add_round(
        self,
        design: Design | None,
        recordings: tuple[Recording, ...],
        remarks: Sequence[str] = (),
    ) -> bool:
        """Identify from all recordings and keep the round.

        Args:
            design: The design of the round; None for recordings that were made without one.
            recordings: Its recordings.
            remarks: Remarks about the design.

        Returns:
            False where the identification was interrupted.
        """
        p = self.base.parameters
        theta = p.guess if design is None else design.theta
        start = self.rounds[-1].estimate.theta if self.rounds else theta

        earlier = [recording for r in self.rounds for recording in r.recordings]
        estimate = identify_all(
            self.base,
            [*earlier, *recordings],
            start,
            callback=self.callback,
            stop=self.stop,
            executor=self.executor,
        )
        if estimate is None:
            return False

        warnings = list(remarks)
        if design is not None:
            warnings += [f"design: {sentence}" for sentence in design.warnings]
        warnings += estimate.warnings
        warnings += self._suspicions(estimate)

        current = Round(
            number=len(self.rounds) + 1,
            theta=theta,
            predicted=np.full(len(p), np.nan) if design is None else design.final.std,
            control=recordings[0].ctrl if design is None else design.trajectory.ctrl,
            recordings=recordings,
            estimate=estimate,
            design=design,
            warnings=tuple(warnings),
        )
        self.rounds.append(current)
        self._report(current)
        return True

    def _report(self, current: Round) -> None:
        if self.callback is None:
            return

        ratio, j = largest_ratio_to_target(current.attained, self.wanted)
        event = StudyEvent(
            study="campaign",
            part=f"round {current.number}",
            index=current.number - 1,
            count=self.count,
            share=1.0,
            message=f"largest ratio of σ to target: {ratio:.3g} ({self.base.parameters.names[j]})",
            result=current,
        )
        self.callback(event)

    def _suspicions(self, current: Estimate) -> Iterator[str]:
        """Reasons to doubt the model, or to expect nothing of further rounds.

        Args:
            current: Estimate of the round that has just been made.
        """
        yield from _doubts(current, self.wanted)
        if not self.rounds:
            return

        names = self.base.parameters.names
        before = self.rounds[-1].estimate
        known = np.isfinite(before.std) & (before.std > 0.0)
        moves = np.abs(current.theta - before.theta)
        change = np.divide(moves, before.std, out=np.zeros(len(names)), where=known)
        for j in np.flatnonzero(change > SUSPICIOUS_CHANGE).tolist():
            yield (
                f"{names[j]} moved from {before.theta[j]:.4g} to {current.theta[j]:.4g}, by "
                f"{change[j]:.1f} σ of the last round's estimate: the formal σ is not the "
                "accuracy; the model or the noise is wrong, or the last fit ended in a false "
                "minimum"
            )

        ratio_before, _ = largest_ratio_to_target(before.std, self.wanted)
        ratio, j = largest_ratio_to_target(current.std, self.wanted)
        if ratio > NO_PROGRESS_RATIO * ratio_before:
            yield (
                f"no progress: the largest ratio of σ to its target went from {ratio_before:.3g} "
                f"to {ratio:.3g} ({names[j]})"
            )

    def _targets_reached(self) -> bool:
        """Whether the formal standard deviations reach every target."""
        if not self.rounds:
            return False

        ratio, _ = largest_ratio_to_target(self.rounds[-1].attained, self.wanted)
        return ratio <= 1.0

    def record(self, status: CampaignStatus) -> Campaign:
        """The record for the user."""
        warnings = [f"round {r.number}: {sentence}" for r in self.rounds for sentence in r.warnings]
        return Campaign(
            parameters=self.base.parameters.names,
            wanted=self.wanted,
            rounds=tuple(self.rounds),
            status=status,
            pending=self.pending,
            warnings=tuple(warnings),
        )


def identify_all(
    base: DesignTask,
    recordings: Sequence[Recording],
    start: Array,
    *,
    callback: Callback | None = None,
    stop: StopToken | None = None,
    executor: ExecutorLike | None = None,
) -> Estimate | None:
    """Estimate the parameters from all recordings.

    Where the fit fails or its result is a misfit, a second fit starts at the stated guess.

    Args:
        base: Task of the experiment as stated.
        recordings: All recordings.
        start: (p,) parameters at which the fit begins [theta-unit].
        callback: Called with a `FitEvent` for every iterate.
        stop: Ends the fit early.
        executor: Where the work is done (`mjfim.ExecutorLike`); None for this process.

    Returns:
        The better of the estimates; None where a fit was interrupted, because an incomplete round
        is not kept.

    Raises:
        SimulationDivergedError: The model diverges at `start` and at the guess.
    """
    found: list[Estimate] = []
    first_error = None
    for begin in (start, base.parameters.guess):
        # The guess is needed only where the first fit is bad.
        if found and (not found[0].misfit or np.array_equal(begin, start)):
            break

        try:
            estimate = identify_system(
                base.system,
                recordings,
                start=begin,
                callback=callback,
                stop=stop,
                executor=executor,
            )
        except SimulationDivergedError as error:
            first_error = first_error or error
            continue
        if estimate.interrupted:
            return None
        found.append(estimate)

    if not found:
        raise first_error or SimulationDivergedError(
            "the simulation diverges wherever the fit starts"
        )
    return min(found, key=lambda estimate: estimate.chi2)


def _doubts(estimate: Estimate, wanted: Array) -> Iterator[str]:
    """Reasons, except a misfit, not to trust the formal standard deviations.

    Args:
        estimate: The estimate.
        wanted: (p,) target standard deviations [theta-unit], infinite where there is none.
    """
    at_bound = [
        name
        for name, target in zip(estimate.parameters, wanted, strict=True)
        if np.isfinite(target) and name in estimate.at_bound
    ]
    if at_bound:
        yield f"at a bound are the estimates of these parameters with a target: {listed(at_bound)}"
    elif not estimate.converged and not estimate.combinations:
        yield f"the fit did not succeed: {estimate.status}"
