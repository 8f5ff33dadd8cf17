"""`mjfim.check`: the parameters that an experiment or recordings can identify, and how accurately.

It needs no fit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import StopToken, stop_on_interrupt
from mjfim.errors import RecordingError, SimulationDivergedError, first_ones, shortened
from mjfim.excitation.designable import require_evaluated
from mjfim.excitation.objective import DesignPoint, DesignProblem
from mjfim.excitation.release_space import ReleaseSpace
from mjfim.excitation.task import DesignTask
from mjfim.excitation.task_parts import require_design_keys
from mjfim.experiment.schema import Experiment
from mjfim.experiment.stated_units import probable_degrees
from mjfim.experiment.system import System
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.fit_workers import FitWorkers
from mjfim.identification.segments import recorded_release
from mjfim.identification.sensitivity_rows import sensitivity_rows
from mjfim.identification.task import refuse_same_data
from mjfim.information.fisher import FisherInformation
from mjfim.information.identifiability import Identifiability, IdentifiabilityTest
from mjfim.information.marginal import shared
from mjfim.parallel import ExecutorLike, one_blas_thread
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from mjfim.records.check import (
    CONFOUNDED_CORRELATION,
    Check,
    ConfoundedPair,
    ParameterCheck,
    ParameterGroup,
    SelfTest,
    groups_in_words,
    join_names,
)
from mjfim.records.design import CombinationAccuracy
from mjfim.records.events import begin_stage, shown_progress
from mjfim.records.trajectory import Recording, Trajectory
from mjfim.studies.derivative_test import self_test
from mjfim.studies.design_outlook import DesignOutlook
from mjfim.studies.probe_workers import ProbeWorkers
from mjfim.studies.random_references import random_references

# Target standard deviation where none is stated, relative to the size of the parameter.
DEFAULT_RELATIVE_STD = 0.05

# Number of repetitions above which a target accuracy counts as unreachable.
MAX_REPETITIONS = 1_000_000_000

# Largest number of samples of a recording along which the derivatives are tested.
MAX_TESTED_SAMPLES = 2000


def check(
    experiment: Experiment,
    recordings: Sequence[Recording] = (),
    trajectory: Trajectory | None = None,
    *,
    threads: int | None = None,
    stop: StopToken | None = None,
    progress: bool = True,
    executor: ExecutorLike | None = None,
) -> Check:
    """Check which parameters can be identified, at the parameter values that a design uses.

    Without recordings and without a trajectory, the initial control of the experiment is checked.

    Args:
        experiment: Experiment to check.
        recordings: Recordings that are checked instead of the initial control.
        trajectory: Trajectory, of a design for example, whose control is checked instead.
        threads: Threads of MuJoCo; None for all cores.
        stop: Ends the check early, as Ctrl-C does; the record then says what is missing.
        progress: False for no sign of progress in a notebook.
        executor: Where the work is done (`mjfim.ExecutorLike`); None for this process. It
            differentiates recordings side by side, and random motions where these are needed.

    Raises:
        RecordingError: Recordings are unusable, or given together with a trajectory.
        SimulationDivergedError: The trajectory cannot be simulated.
    """
    if recordings and trajectory is not None:
        raise RecordingError("check either recordings or a designed trajectory, not both")

    with shown_progress("checking", None, progress):
        system = System.resolve(experiment, threads=threads)
        if recordings:
            return check_recordings(system, recordings, stop, executor)

        require_design_keys(system, "check without recordings")
        return check_task(DesignTask.of(system), trajectory, stop, executor)


@one_blas_thread()
def check_task(
    task: DesignTask,
    trajectory: Trajectory | None = None,
    stop: StopToken | None = None,
    executor: ExecutorLike | None = None,
) -> Check:
    """Check the initial control of a task, or the control of a trajectory.

    See `check`.
    """
    source = "the initial control" if task.controls else "the initial state"
    if trajectory is not None:
        task = replace(task.released_as(trajectory.state[0]), release=task.release)
    curve = task.initial
    if trajectory is not None:
        curve, source = task.plant.simulate(task.theta, trajectory.ctrl), "the given trajectory"

    # A start that diverges is refused in the words of a design.
    begin_stage("simulating the motion and its sensitivities")
    problem, point = _evaluate(task, curve)
    if trajectory is None:
        require_evaluated(task, point)
    if point.information is None or point.sensitivity is None:
        raise SimulationDivergedError("the simulation diverges when the parameters change a little")

    # From here on, there is something to report when the check is stopped.
    with stop_on_interrupt(stop) as token:
        stage = _Stages(token)
        test = _identifiability_test(task, executor, token)
        identifiability = stage.identifiability(test.along, curve, point.sensitivity)
        tested = stage.test_derivatives(task, problem, point, identifiability)
        outlook = DesignOutlook()
        if trajectory is None and not token.requested:
            outlook = DesignOutlook.of(task, identifiability)
        return _Assessment(
            task=task,
            source=source,
            duration=float(curve.t[-1]),
            identifiability=identifiability,
            data=_common_information(task, [point.information - task.information.prior]),
            tested=tested,
            missing=tuple(stage.missing),
            outlook=outlook,
        ).check()


@one_blas_thread()
def check_recordings(
    system: System,
    recordings: Sequence[Recording],
    stop: StopToken | None = None,
    executor: ExecutorLike | None = None,
) -> Check:
    """Check which parameters recordings identify; derivatives are tested along the longest one.

    See `check`.
    """
    refuse_same_data(recordings, ())
    begin_stage("simulating the recordings")
    fit = FitProblem.of(system, recordings, data_only=True)
    if executor is not None:
        fit = fit.on_workers(FitWorkers(executor))
    longest = max(fit.recordings, key=lambda recording: len(recording.ctrl))
    task = _task_along(recorded_release(system, longest), system, longest.ctrl[:MAX_TESTED_SAMPLES])

    problem, point = _evaluate(task, task.initial)
    if point.information is None or point.sensitivity is None:
        raise SimulationDivergedError("the simulation diverges when the parameters change a little")

    # Rows of G at the times of the measurements, and the error of their finite differences.
    recorded = sensitivity_rows(fit, fit.begin(task.theta))
    J, error = (np.concatenate(part) for part in zip(*recorded, strict=True))
    count = len(recordings)

    # From here on, there is something to report when the check is stopped.
    with stop_on_interrupt(stop) as token:
        stage = _Stages(token)
        test = _identifiability_test(task, executor, token)
        identifiability = stage.identifiability(test.of_rows, task.initial, J, error)
        return _Assessment(
            task=task,
            source=f"{count} recording{'s' if count > 1 else ''}",
            duration=float(sum(recording.t[-1] for recording in fit.recordings)),
            identifiability=identifiability,
            data=_common_information(task, [rows.T @ rows for rows, _ in recorded]),
            tested=stage.test_derivatives(task, problem, point, identifiability),
            missing=tuple(stage.missing),
        ).check()


def _identifiability_test(
    task: DesignTask, executor: ExecutorLike | None, stop: StopToken
) -> IdentifiabilityTest:
    """The test of a task; an executor differentiates its random motions."""
    test = task.identifiability_test
    if task.system.laws is not None:
        test = replace(test, probes=partial(random_references, task))
    if executor is None:
        return test
    workers = ProbeWorkers(executor=executor, task=task, stop=stop)
    return replace(test, differentiated=workers.differentiated)


def _task_along(start: Array, system: System, control: Array) -> DesignTask:
    """Task along a recorded control: (N, nu), from the release: (ns,) of the recording."""
    if not system.experiment.initial.free:
        return DesignTask.along(system, control)

    task = DesignTask.along(system.released(start), control)
    return replace(task, release=ReleaseSpace.of(system, task.limits))


def _evaluate(task: DesignTask, curve: Trajectory) -> tuple[DesignProblem, DesignPoint]:
    """The cost of a task, evaluated along a trajectory.

    The tracking term of the cost refers to that trajectory.
    """
    stated = task.problem
    running = replace(stated.running, desired_state=curve.state)
    problem = replace(stated, running=running)
    return problem, problem.point(curve, CENTRAL_DIFFERENCES)


def evaluate_and_test(task: DesignTask) -> None:
    """Do the main work of a check along the initial control of a task, to measure its duration.

    Args:
        task: The task.

    Raises:
        SimulationDivergedError: The simulation diverges.
    """
    problem, point = _evaluate(task, task.initial)
    self_test(task, problem, point)


class _Stages:
    """Stages of a check that are left out after a request to stop.

    Attributes:
        missing: What was left out, in words.
    """

    def __init__(self, stop: StopToken) -> None:
        self.missing: list[str] = []
        self._stop = stop

    def identifiability(
        self, test: Callable[..., Identifiability], *arguments: object
    ) -> Identifiability:
        """Test identifiability; random controls are tried only where there is a doubt.

        Args:
            test: The test, which asks before every random control whether it has to stop.
            *arguments: Its arguments.
        """
        begin_stage("testing which parameters can be told apart")
        found = test(*arguments, self._is_stopped)
        if found.along_trajectory.count and self._is_stopped():
            self.missing.append("what other controls would show")
        return found

    def test_derivatives(
        self,
        task: DesignTask,
        problem: DesignProblem,
        point: DesignPoint,
        identifiability: Identifiability,
    ) -> SelfTest:
        """Test the derivatives at a point, with a criterion of the identifiable combinations."""
        information = replace(problem.information, basis=identifiability.basis)
        visible = replace(problem, information=information)
        tested = self_test(task, visible, visible.reevaluated(point), self._is_stopped)
        if not tested.finished:
            self.missing.append("the test of the derivatives")
        return tested

    def _is_stopped(self) -> bool:
        """Whether a stop is requested."""
        return self._stop.requested


def _common_information(task: DesignTask, matrices: Sequence[Array]) -> Array:
    """(p, p) sum of information matrices about the parameters that all recordings share.

    Parameters with a separate value for each recording are marginalised out.
    """
    p = task.parameters
    total = np.zeros_like(task.prior)
    for each in matrices:
        total = total + shared(each, p.prior_information, p.recording_specific)
    return np.asarray(total)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Assessment:
    """Everything that a check is computed from.

    Attributes:
        task: Task that holds the parameters and the criterion.
        source: Name of the checked data for sentences.
        duration: Duration of the checked data [s].
        identifiability: Combinations that can be identified.
        data: (p, p) information of the checked data [1 / theta-unit^2], without priors.
        tested: Test of the derivatives.
        missing: What was left out after a request to stop, in words.
        outlook: What a design would say about the initial control.
    """

    task: DesignTask
    source: str
    duration: float
    identifiability: Identifiability
    data: Array
    tested: SelfTest
    missing: tuple[str, ...]
    outlook: DesignOutlook = field(default_factory=DesignOutlook)

    def check(self) -> Check:
        """The record for the user."""
        task, found = self.task, self.identifiability
        information = self._information()
        total = self.data + task.prior

        # Standard deviations of the wanted parameters. They are infinite where a parameter cannot
        # be identified individually.
        covariance = information.covariance(total)
        spread = np.sqrt(np.diag(covariance))
        std = np.full(len(task.parameters), np.inf)
        std[task.parameters.interest] = np.nan_to_num(spread, nan=np.inf)
        correlation = covariance / np.outer(spread, spread)

        # Eigenvalues of the criterion, without combinations that no experiment can identify.
        criterion = replace(task.information, basis=found.basis)
        eigenvalues = criterion.evaluate(self.data + criterion.prior).eigenvalues

        rows = self._rows(information, std)
        confounded = _confounded_pairs(found.names, correlation)
        not_excited = self._not_excited()
        combined: tuple[CombinationAccuracy, ...] = ()
        if not not_excited:
            values = task.theta[task.parameters.interest]
            combined = found.combinations(information, values, total, total)

        verdict = _Verdict(
            rows=rows,
            not_separable=found.groups_along_all,
            not_excited=not_excited,
            confounded=confounded,
            tested=self.tested,
            source=self.source,
            missing=self.missing,
        )
        return Check(
            source=self.source,
            horizon=self.duration,
            rows=rows,
            wanted=found.names,
            information=total,
            eigenvalues=np.maximum(eigenvalues, 0.0),
            correlation=correlation,
            confounded=confounded,
            not_separable=found.groups_along_all,
            not_excited=not_excited,
            self_test=self.tested,
            verdict=(
                *self.outlook.sentences(),
                *verdict.sentences(),
                *_probable_degrees(task),
            ),
            combined=combined,
            missing=self.missing,
            refused=self.outlook.refused,
            violations=self.outlook.violations,
        )

    def _information(self) -> FisherInformation:
        """Criterion and covariances of the combinations that the checked data can identify."""
        here = self.identifiability.along_trajectory
        basis = here.basis if here.count else None
        return replace(self.task.information, prior=self.task.prior, basis=basis)

    def _not_excited(self) -> tuple[ParameterGroup, ...]:
        """Groups that the checked data do not separate, although another control would."""
        found = self.identifiability
        if found.along_trajectory.count <= found.along_all.count:
            return ()

        never_shown = {str(group) for group in found.groups_along_all}
        return tuple(g for g in found.groups_along_trajectory if str(g) not in never_shown)

    def _rows(self, information: FisherInformation, std: Array) -> tuple[ParameterCheck, ...]:
        """Predicted accuracy of every parameter; std: (p,) [theta-unit]."""
        p = self.task.parameters
        sizes = p.sizes(self.task.theta)
        rows = []
        for j, parameter in enumerate(p.parameters):
            value = float(self.task.theta[j])

            size = float(sizes[j])
            wanted = parameter.wanted or DEFAULT_RELATIVE_STD * size

            repetitions = 0
            if not parameter.nuisance:
                repetitions = self._repetitions(information, j, wanted)

            row = ParameterCheck(
                name=parameter.name,
                unit=parameter.unit,
                value=value,
                nuisance=parameter.nuisance,
                size=size,
                std=float(std[j]),
                relative=float(std[j] / size),
                wanted=wanted,
                stated=parameter.wanted is not None,
                repetitions=repetitions,
                seconds=repetitions * self.duration,
            )
            rows.append(row)

        return tuple(rows)

    def _repetitions(self, information: FisherInformation, parameter: int, wanted: float) -> int:
        """Smallest number of repetitions that reaches the wanted standard deviation.

        Args:
            information: Gives the covariance of an information matrix.
            parameter: Index of the parameter.
            wanted: Wanted standard deviation [theta-unit].

        Returns:
            The number; 0 where no number of repetitions suffices.
        """
        interest = information.interest
        if interest is None:
            interest = np.arange(len(self.data))
        place = int(np.flatnonzero(interest == parameter)[0])

        def suffices(repetitions: int) -> bool:
            """Whether this number of repetitions reaches the wanted standard deviation."""
            total = repetitions * self.data + self.task.prior
            variance = information.covariance(total)[place, place]
            return bool(variance <= wanted**2)

        # Double the number until it suffices, then bisect.
        low, high = 0, 1
        while not suffices(high):
            low, high = high, 2 * high
            if high > MAX_REPETITIONS:
                return 0

        while high - low > 1:
            middle = (low + high) // 2
            if suffices(middle):
                high = middle
            else:
                low = middle
        return high


def _probable_degrees(task: DesignTask) -> tuple[str, ...]:
    """Warnings about angles of the experiment that look like degrees."""
    return probable_degrees(task.experiment, task.system.source)


def _confounded_pairs(names: Sequence[str], correlation: Array) -> tuple[ConfoundedPair, ...]:
    """Confounded pairs of parameters, in descending order of their correlation.

    Args:
        names: Names of the t parameters.
        correlation: (t, t) correlation of their estimates.
    """
    strong = np.triu(np.abs(correlation) > CONFOUNDED_CORRELATION, k=1)
    pairs = []
    for i, j in np.argwhere(strong).tolist():
        pair = ConfoundedPair(
            first=names[i],
            second=names[j],
            correlation=float(correlation[i, j]),
        )
        pairs.append(pair)

    return tuple(sorted(pairs, key=lambda pair: -abs(pair.correlation)))


@dataclass(frozen=True, kw_only=True, eq=False)
class _Verdict:
    """Findings of a check, from which sentences for the user are made.

    Attributes:
        rows: Accuracy of every parameter.
        not_separable: Groups whose members no control can separate.
        not_excited: Groups that the checked data do not separate, although another control would.
        confounded: Strongly correlated pairs.
        tested: Test of the derivatives.
        source: Name of the checked data.
        missing: What was left out after a request to stop, in words.
    """

    rows: Sequence[ParameterCheck]
    not_separable: Sequence[ParameterGroup]
    not_excited: Sequence[ParameterGroup]
    confounded: Sequence[ConfoundedPair]
    tested: SelfTest
    source: str
    missing: Sequence[str]

    def sentences(self) -> Iterator[str]:
        """Sentences for the user, the most serious first."""
        if self.missing:
            yield f"interrupted, so this check is incomplete; it lacks {join_names(self.missing)}"
        yield from self._about_derivatives()
        yield from self._about_identifiability()

        identifiable = [row for row in self.rows if not row.nuisance and np.isfinite(row.std)]
        if not identifiable:
            yield f"no parameter can be identified individually from {self.source}"
            return

        yield from self._about_accuracy(identifiable)
        yield from self._about_correlation()

    def _about_derivatives(self) -> Iterator[str]:
        """Reason why the numbers of the check cannot be trusted, where the self-test failed."""
        tested = self.tested
        if tested.roughness is not None:
            yield f"{tested.roughness}"
        elif tested.finished and not tested.passed:
            yield (
                f"the derivatives do not agree (psi recursion {tested.recursion:.1e}, slope "
                f"{tested.slope:.1e}); {tested.likely_cause}. Shorten horizon or timestep, or "
                "smooth what switches, before you trust these numbers"
            )

    def _groups_left_to_priors(self) -> tuple[list[ParameterGroup], list[ParameterGroup]]:
        """Inseparable groups that remain unknown, and those that priors alone resolve."""
        known = {row.name for row in self.rows if np.isfinite(row.std)}
        unknown, resolved = [], []
        for group in self.not_separable:
            if set(group.members) <= known:
                resolved.append(group)
            else:
                unknown.append(group)

        return unknown, resolved

    def _about_identifiability(self) -> Iterator[str]:
        """Combinations that cannot be identified, and advice for the user."""
        unknown, resolved = self._groups_left_to_priors()
        if unknown:
            yield (
                "not identifiable separately from this initial state, with any tested control: "
                f"{groups_in_words(unknown)}. Remove or fix one parameter of each group, give it "
                "a prior, or measure another output; a design uses the identifiable combinations"
            )
        if resolved:
            names = first_ones([group.short_names for group in resolved], "; ")
            yield f"separated by priors only, not by data: {names}"
        if self.not_excited:
            yield (
                f"not excited by {self.source}, but another control would show: "
                f"{groups_in_words(self.not_excited)}. Move those joints more"
            )

    def _about_accuracy(self, identifiable: Sequence[ParameterCheck]) -> Iterator[str]:
        """Comparison of the predicted standard deviations with the wanted ones."""
        missed = [row for row in identifiable if row.repetitions != 1]
        unknown, _ = self._groups_left_to_priors()

        if missed:
            worst = max(identifiable, key=lambda row: row.std / row.wanted)
            needed = "no number of repetitions reaches"
            if worst.repetitions:
                needed = f"{worst.repetitions:,} repetitions ({worst.seconds:,.0f} s) reach"
            wanted = f"{worst.wanted:.3g} {worst.unit}".rstrip()
            yield (
                f"{len(missed)} of {len(identifiable)} parameters miss the wanted σ with "
                f"{self.source} alone; the worst is {worst.name}: {needed} {wanted}. A designed "
                "excitation (`mjfim design`) needs fewer"
            )
        elif self.tested.passed and not self.missing and not unknown and not self.not_excited:
            yield (
                f"every identifiable parameter reaches its wanted σ with {self.source}: "
                "nothing more is needed"
            )

    def _about_correlation(self) -> Iterator[str]:
        """Confounded pairs of parameters."""
        if not self.confounded:
            return

        pairs = [
            f"{shortened(pair.first)} / {shortened(pair.second)} ({pair.correlation:+.3f})"
            for pair in self.confounded
        ]
        yield (
            f"confounded pairs (correlation of the estimates): {first_ones(pairs)}; "
            "fixing one parameter of a pair makes the other more accurate"
        )
