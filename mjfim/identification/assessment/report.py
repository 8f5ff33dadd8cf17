"""The estimate that a user reads: values, accuracy, predictions and warnings of a solved fit."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.errors import first_ones, listed
from mjfim.experiment.labels import labels_of_system
from mjfim.experiment.stated_units import probable_degrees
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import changes_within_samples
from mjfim.identification.assessment.accuracy import Accuracy, accuracy_of
from mjfim.identification.assessment.fit_quality import FitQuality
from mjfim.identification.assessment.flipped_signs import (
    POOR_FIT,
    flipped_signs,
    sentence_about_signs,
    sufficient_squares,
)
from mjfim.identification.assessment.honest_covariance import with_honest_covariance
from mjfim.identification.assessment.predictability import UnpredictableMotion, unpredictable_motion
from mjfim.identification.assessment.predictions import predict_unfitted
from mjfim.identification.assessment.recording_comparison import compare_recordings
from mjfim.identification.assessment.residual_tests import is_smaller_than_noise, misfit_reasons
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.linear_coordinates import CadPrior
from mjfim.identification.search import of_subset
from mjfim.identification.starts import values_of_start
from mjfim.identification.task import FitTask
from mjfim.identification.terms import TermTests, find_missing_terms
from mjfim.information.null_space import NullSpace
from mjfim.model.control_laws import FIELDS, law_unit
from mjfim.model.parameters import ParameterSet
from mjfim.model.units import FORCE_UNITS, control_unit
from mjfim.optimize.levenberg_marquardt import Solution, UnknownValues
from mjfim.parallel.budget import Budget
from mjfim.recordings.checks import plausibility_remarks
from mjfim.records.estimate import (
    MAX_NOMINAL_ROWS,
    ControlLawInLoop,
    Estimate,
    HorizonStudy,
    Prediction,
    Restart,
)
from mjfim.records.estimate_parts import InverseDynamicsFit
from mjfim.records.events import begin_stage
from mjfim.records.robots import RecordingComparison
from mjfim.records.trajectory import Recording

# Numbers with which a law is more than a position servo, unless they have no effect.
BEYOND_SERVOS = (
    "ki",
    "slew",
    "latency",
    "time_constant",
    "feedback_latency",
    "velocity_time_constant",
)


def laws_in_loop(
    system: System, theta: Array, clipped: Mapping[str, float]
) -> tuple[ControlLawInLoop, ...]:
    """Describe the laws at some parameters.

    Args:
        system: The system.
        theta: (p,) parameters [theta-unit].
        clipped: Share of the samples at which the limits of a law clip its control, by actuator.

    Returns:
        The laws; none where logs hold the controls themselves.
    """
    if system.laws is None:
        return ()
    model = system.plant.model(theta)
    paths = {target.path for p in system.parameters.parameters for target in p.targets}
    found = []
    for law in system.laws.laws:
        values = law.numbers(model)
        numbers: dict[str, float] = {}
        units: dict[str, str] = {}
        for field, names in FIELDS.items():
            is_end = len(names) > 1
            for i, name in enumerate(names):
                key = f"{field}[{i}]" if is_end else field
                if np.isfinite(values[name]) and (is_end or values[name] != 0.0):
                    numbers[key] = values[name]
                    units[key] = law_unit(model, law.actuator, field)

        plain = not any(name in numbers for name in BEYOND_SERVOS) and not law.differences
        unit = control_unit(model, int(model.actuator(law.actuator).id))
        is_servo = plain and unit in FORCE_UNITS.values() and set(law.columns) == {"reference"}
        estimated = (key for key in numbers if f"controller/{law.actuator}:{key}" in paths)
        found.append(
            ControlLawInLoop(
                actuator=law.actuator,
                joint=law.joint,
                rate=1.0 / (law.tick * float(model.opt.timestep)),
                columns=tuple(system.laws.columns[i] for i in law.columns.values()),
                numbers=numbers,
                units=units,
                estimated=tuple(estimated),
                clipped=clipped.get(law.actuator, 0.0),
                is_servo=is_servo,
            )
        )
    return tuple(found)


# Distance from the guess [prior standard deviations] above which an estimate contradicts its prior.
IMPLAUSIBLE_PRIOR_DISTANCE = 4.0

# Distance from a bound, relative to the magnitude of the parameter, at which an estimate counts as
# at the bound.
BOUND_TOLERANCE = 1e-6


# Largest number of poorly known parameters that have a warning each.
MAX_SEPARATE_WARNINGS = 4

# A recording is remarked on if at least this share of the changes of its control lies inside
# engine steps of the model.
MIN_SHARE_WITHIN_SAMPLES = 0.05

# Number of samples after which the motion that an estimate holds for animations ends.
MAX_MOTION_SAMPLES = 200_000

# Relative rounding of the ratio of two periods.
ROUNDING = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class FitResult:
    """Result of the searches of one identification.

    Attributes:
        task: System, recordings and settings.
        problem: The least-squares problem, with the noise of the last search.
        solution: Its solution.
        quality: Size and whiteness of its residuals.
        null_space: Directions of theta about which neither recordings nor priors contain
            information.
        held_out: Problem of the held-out recordings; None without any.
        subset: Indices of segments that are quick to simulate, evenly spread over the data.
        restart: How the fit was repeated from fits over segments; None where it was not.
        horizons: Lengths of segments that were compared; None where they were not.
        inverse_dynamics: The fit to the equation of motion from which the search started, or None.
        begun_instead: Where it began instead of the stated start, at which the model diverges, in
            words; empty where it does not diverge there.
    """

    task: FitTask
    problem: FitProblem
    solution: Solution
    quality: FitQuality
    null_space: NullSpace
    held_out: FitProblem | None
    subset: np.ndarray
    restart: Restart | None
    horizons: HorizonStudy | None = None
    inverse_dynamics: InverseDynamicsFit | None = None
    begun_instead: str = ""

    @property
    def theta(self) -> Array:
        """(p,) estimate, with the values of the first recording."""
        return self.problem.theta(self.solution.unknowns)

    @property
    def quick(self) -> tuple[FitProblem, UnknownValues]:
        """The problem of the segments that are quick to simulate, and its unknowns."""
        return self.problem.of_segments(self.subset), of_subset(self.solution.unknowns, self.subset)

    @cached_property
    def accuracy(self) -> Accuracy:
        """Accuracy of the estimate."""
        rows = self.quality.correlation_rows(self.problem.row_count)
        inflation = self.quality.inflation
        return accuracy_of(self.problem, self.solution, self.null_space, rows, inflation)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Findings:
    """Everything about a fit that its warnings depend on.

    Attributes:
        result: The fit.
        comparison: Comparison of the recordings, or None.
        tests: Tests of terms that the model may lack.
        reasons: Reasons for a misfit, in sentences; empty where there is none.
        at_bound: Names of the parameters at a bound or beyond it.
        outside: True where a parameter is beyond a bound.
        interrupted: True after a request to stop.
        unpredictable: A motion that is too unstable for the segments of a poor fit, or None.
        flipped: Signals whose sign looks flipped, in words.
    """

    result: FitResult
    comparison: RecordingComparison | None
    tests: TermTests
    reasons: tuple[str, ...]
    at_bound: tuple[str, ...]
    outside: bool
    interrupted: bool
    unpredictable: UnpredictableMotion | None
    flipped: tuple[str, ...]


def estimate_from(
    result: FitResult,
    budget: Budget,
    refuted: Collection[str] = (),
    tests: TermTests | None = None,
) -> Estimate:
    """Assess a fit and make the estimate.

    After a request to stop, missing terms and predictions are left out; the rest of the estimate is
    complete.

    Args:
        result: The fit.
        budget: Budget with the stop token.
        refuted: Keys of terms (`Term.key`) that are not missing, because a fit or the
            prediction of left-out data is no better with them. They are not named as missing terms,
            and are no reason for a misfit.
        tests: Tests of terms that this model may lack, where they are known; None to make them.

    Returns:
        The estimate, without its time and engine steps.

    Raises:
        SimulationDivergedError: The simulation diverges at the estimate.
    """
    task, quality, problem, solution = result.task, result.quality, result.problem, result.solution
    system, parameters = task.system, task.system.parameters

    # Optional parts, each of which takes about as long as a search. There are no tests of terms
    # where the fit is too poor for them.
    if tests is None:
        begin_stage("looking for terms that the model lacks")
        tests = TermTests()
        if not (budget.stop.requested or quality.unexplained):
            found = find_missing_terms(problem, task.recordings, solution.unknowns)
            tests = TermTests() if budget.stop.requested else found
    tests = tests.without(refuted)
    predictions = _predictions(result, budget)
    reasons = misfit_reasons(
        quality.chi2, quality.dof, task.noise_is_stated, quality.whiteness, tests.named
    )

    begin_stage("computing the intervals")
    accuracy = result.accuracy
    rows = quality.correlation_rows(problem.row_count)
    at_bound, outside = _at_bounds(parameters, result.theta, task.settings.hold)

    # A good fit needs no advice.
    is_poor = bool(reasons or quality.unexplained) or not solution.success
    unpredictable = None
    if is_poor and not solution.interrupted:
        unpredictable = unpredictable_motion(problem, solution.unknowns)
    findings = _Findings(
        result=result,
        comparison=compare_recordings(problem, solution, rows, accuracy.robust),
        tests=tests,
        reasons=reasons,
        at_bound=at_bound,
        outside=outside,
        interrupted=budget.stop.requested,
        unpredictable=unpredictable,
        flipped=_flipped_signs(result, budget),
    )
    undetermined = accuracy.singular or accuracy.single_unidentifiable
    per_recording = zip(
        problem.layout.per_recording, solution.unknowns.per_recording.T.tolist(), strict=True
    )
    quick, at = result.quick
    interval = accuracy.interval
    if result.horizons is not None:
        interval = result.horizons.widened(interval)
    estimate = Estimate(
        parameters=parameters.names,
        units=system.units,
        prior=parameters.prior_information + CadPrior.of(parameters).information(result.theta),
        theta=result.theta,
        std=accuracy.std,
        covariance=accuracy.covariance,
        initial_theta=task.start,
        chi2=quality.chi2,
        dof=quality.dof,
        status=solution.status,
        success=solution.success and not (undetermined or outside),
        misfit=bool(reasons),
        iterations=solution.iterations,
        residual_rms=quality.rms,
        at_bound=at_bound,
        predicted=quality.predicted,
        recordings=_as_aligned(problem, task.recordings),
        warnings=tuple(_warnings(findings)),
        combinations=tuple(str(group) for group in accuracy.groups),
        data=accuracy.data_information,
        std_sandwich=accuracy.sandwich,
        interval=interval,
        between_recordings=accuracy.between,
        sigma=dict(zip(system.outputs.names, problem.noise.sigma.tolist(), strict=True)),
        reasons=reasons,
        whiteness=quality.whiteness,
        sloppy=tuple(name for name, _ in accuracy.poorly_known),
        missing_terms=tests.named,
        tested_data=tests.data,
        per_recording={parameters.names[j]: tuple(values) for j, values in per_recording},
        worst_residual=quality.worst_residual if reasons else None,
        predictions=predictions,
        robust_uncertainty=accuracy.robust,
        motion=problem.motion(solution.unknowns, 0, MAX_MOTION_SAMPLES),
        interrupted=findings.interrupted,
        labels=labels_of_system(system),
        trace=np.array([task.start, *(problem.theta(each) for each in solution.iterates)]),
        nominal=_nominal_outputs(result),
        segments=_beginnings(problem),
        sizes=parameters.sizes(result.theta),
        restart=result.restart,
        controllers=laws_in_loop(system, result.theta, quick.clipped_shares(at)),
        horizons=result.horizons,
        held=task.settings.hold,
        inverse_dynamics=result.inverse_dynamics,
        recording_comparison=findings.comparison,
        prior_directions=accuracy.prior_directions,
    )
    return with_honest_covariance(estimate, parameters, accuracy.robust_covariance)


def _flipped_signs(result: FitResult, budget: Budget) -> tuple[str, ...]:
    """Signals whose sign looks flipped; only a very poor fit can have any."""
    quality, noise_is_stated = result.quality, result.task.noise_is_stated
    is_poor = noise_is_stated and quality.chi2 > POOR_FIT * quality.dof
    if budget.stop.requested or not (is_poor or quality.unexplained):
        return ()
    problem, at = result.quick
    squares = 2.0 * problem.cost(at)
    enough = sufficient_squares(squares, problem.value_count, noise_is_stated=noise_is_stated)
    return flipped_signs(
        result.task, result.problem, enough, result.subset, result.null_space, budget
    )


def _predictions(result: FitResult, budget: Budget) -> tuple[Prediction, ...]:
    """Predictions of data that were not fitted; none after a request to stop."""
    if budget.stop.requested:
        return ()

    found = predict_unfitted(result.problem, result.solution, result.held_out, budget)
    complete = () if budget.stop.requested else found
    if result.held_out is None:
        return complete

    # The budget may have ended the predictions early.
    recordings = _as_aligned(result.held_out, result.task.held_out)
    return tuple(
        replace(prediction, recording=recording)
        for prediction, recording in zip(complete, recordings, strict=False)
    )


def _at_bounds(
    parameters: ParameterSet, theta: Array, held: Sequence[str]
) -> tuple[tuple[str, ...], bool]:
    """Names of the parameters at a bound or beyond it, and whether any is beyond.

    Those that are held are where the user wants them.
    """
    tolerance = BOUND_TOLERANCE * parameters.magnitude
    below = theta < parameters.lower - tolerance
    above = theta > parameters.upper + tolerance

    distance_below = theta - parameters.lower
    distance_above = parameters.upper - theta
    at_bound = np.flatnonzero(np.minimum(distance_below, distance_above) < tolerance)
    names = tuple(parameters.names[j] for j in at_bound if parameters.names[j] not in held)
    return names, bool((below | above).any())


def _nominal_outputs(result: FitResult) -> tuple[Array, ...]:
    """(M, ny) outputs of the model at the initial guess, from the fitted initial states.

    There are none where the model diverges, and none of much data, whose figures do without them.
    """
    problem, at = result.problem, result.solution.unknowns
    if problem.row_count > MAX_NOMINAL_ROWS:
        return ()
    guess = problem.begin(result.task.start)
    if problem.layout.free_starts:
        guess = replace(guess, private=at.private)
    return tuple(problem.predict(guess) or ())


def _beginnings(problem: FitProblem) -> tuple[Array, ...]:
    """Times at which the segments of each recording begin [s]."""
    begins: list[list[float]] = [[] for _ in problem.recordings]
    for segment in problem.segments:
        t = problem.recordings[segment.recording].t[segment.rows]
        begins[segment.recording] += t[:1].tolist()
    return tuple(np.array(times) for times in begins)


def _as_aligned(problem: FitProblem, recordings: Sequence[Recording]) -> tuple[Recording, ...]:
    """Recordings with their outputs in the order of the experiment, as a problem compares them."""
    names = problem.system.outputs.names
    return tuple(
        Recording(
            t=aligned.t,
            ctrl=recording.ctrl[: len(aligned.t) - 1],
            y=aligned.y,
            outputs=names,
            name=aligned.name,
        )
        for aligned, recording in zip(problem.recordings, recordings, strict=True)
    )


def _warnings(findings: _Findings) -> Iterator[str]:
    """Sentences that a user should read besides the numbers, the most serious ones first."""
    result = findings.result
    if findings.flipped:
        yield sentence_about_signs(findings.flipped)
    yield from _warnings_of_search(findings)
    yield from _warnings_of_misfit(findings)
    yield from _warnings_of_recordings(findings)
    yield from _warnings_of_bounds(findings)
    yield from probable_degrees(result.task.system.experiment, result.task.system.source)

    # Where the misfit is, and where it may come from.
    if findings.reasons and findings.result.quality.worst_residual is not None:
        yield str(findings.result.quality.worst_residual)
    if findings.reasons:
        yield from _warnings_of_rate(result)
    for term in findings.tests.named:
        yield f"the model may lack {term}"
    if findings.tests.data is not None and findings.tests.data.untested:
        yield f"terms that the model may lack: {findings.tests.data.untested_sentence}"
    if findings.reasons and findings.tests.data is not None and findings.tests.data.impossible:
        yield f"terms that the model may lack: {findings.tests.data.impossible_sentence}"

    yield from _implausible_estimates(result.task.system.parameters, result.theta)
    yield from _warnings_of_poorly_known(findings.result.accuracy.poorly_known)
    yield from _warnings_of_data(findings)


def _warnings_of_poorly_known(found: Sequence[tuple[str, str]]) -> Iterator[str]:
    """Warnings about parameters that are poorly known: a sentence each, or one about many."""
    if len(found) <= MAX_SEPARATE_WARNINGS:
        for name, remark in found:
            yield f"sloppy: {name} {remark}"
        return

    name, remark = found[0]
    yield (
        f"sloppy: {len(found)} parameters are poorly known: {listed([name for name, _ in found])}. "
        f"For example, {name} {remark}. More varied motions, priors, or `--select`, which pools or "
        "holds such parameters, may help"
    )


def _warnings_of_data(findings: _Findings) -> Iterator[str]:
    """Remarks about poor data, each with the recordings for which it holds."""
    result = findings.result
    channels = result.task.system.channels
    names: dict[str, list[str]] = {}
    for recording, predicted in zip(
        result.task.recordings, findings.result.quality.predicted, strict=True
    ):
        for remark in plausibility_remarks(channels, recording, predicted):
            names.setdefault(remark, []).append(Path(recording.name).name)
    for remark, recordings in names.items():
        yield f"poor data in {first_ones(recordings)}: {remark}"


def _warnings_of_rate(result: FitResult) -> Iterator[str]:
    """Warnings about recordings whose control changes inside the engine steps of the model."""
    system = result.problem.system
    dt, held = system.dt, np.ones(len(system.inputs), dtype=bool)
    if system.laws is not None:
        held = system.laws.held
    for recording in result.task.recordings:
        count = len(recording.t) - 1
        share = changes_within_samples(recording.t, recording.ctrl[:count, held], dt)
        if share < MIN_SHARE_WITHIN_SAMPLES:
            continue

        period = float(np.median(np.diff(recording.t)))
        yield (
            f"{100 * share:.0f} % of the changes of the control in {Path(recording.name).name} lie "
            f"inside the engine steps of the model ({dt:g} s), which hold its mean: this alone can "
            f"cause a misfit. State a timestep in the MJCF that divides the period of the log, for "
            f'example timestep="{_dividing_timestep(period, dt):.4g}", and rate = '
            f"{1.0 / period:.4g} in the experiment file"
        )


def _dividing_timestep(period: float, timestep: float) -> float:
    """Longest timestep [s] of at most `timestep` [s] of which a period [s] is a whole number."""
    return period / math.ceil(period / timestep * (1.0 - ROUNDING))


def _warnings_of_search(findings: _Findings) -> Iterator[str]:
    """Warnings about an interrupted search, a poor minimum and undetermined parameters."""
    result = findings.result
    quality, accuracy = result.quality, result.accuracy
    if result.begun_instead:
        yield (
            f"the model diverges at the start ({values_of_start(result.task)}): the search began "
            f"{result.begun_instead} instead"
        )

    if findings.unpredictable is not None:
        yield str(findings.unpredictable)

    if findings.interrupted and not result.solution.interrupted:
        yield "interrupted after the search: there are no predictions of data that were not fitted"

    if quality.unexplained:
        yield (
            f"the fit explains little of the motion of {listed(quality.unexplained)}: probably "
            "a local minimum. Shorter segments (fit.segments), more starts (fit.starts) or a "
            "better guess may find a better one"
        )

    for group in accuracy.groups:
        yield (
            f"not identifiable separately: {group.short}; what the recordings do not determine "
            "was held at the start"
        )

    if accuracy.singular:
        yield "the recordings do not determine all parameters: the information is singular"


def _warnings_of_misfit(findings: _Findings) -> Iterator[str]:
    """Warnings about residuals that differ from the stated noise."""
    quality = findings.result.quality
    noise_is_stated = findings.result.task.noise_is_stated
    if findings.reasons:
        wrong = "The model or the noise is" if noise_is_stated else "The model is"
        yield (
            f"misfit: {'; '.join(findings.reasons)}. {wrong} wrong, "
            "and the formal standard deviations are not the accuracy"
        )
    elif noise_is_stated and is_smaller_than_noise(quality.chi2, quality.dof):
        ratio = np.sqrt(quality.chi2 / quality.dof)
        yield f"residuals are only {ratio:.2f} times the stated noise: the stated σ is too large"


def _warnings_of_recordings(findings: _Findings) -> Iterator[str]:
    """Warnings about recordings that contradict each other."""
    for odd in () if findings.comparison is None else findings.comparison.odd:
        yield str(odd)

    robust = findings.result.accuracy.robust
    if robust is None or not robust.apart:
        return

    names = findings.result.task.system.parameters.names
    index = findings.result.problem.layout.parameter_of_column
    apart = [names[index[column]] for column in robust.apart]
    yield (
        f"recordings disagree on {listed(apart)} by more than the scatter within each recording: "
        "something differs between them that is not in the model; the intervals allow for it"
    )


def _warnings_of_bounds(findings: _Findings) -> Iterator[str]:
    """Warnings about parameters at their bounds."""
    names = listed(findings.at_bound)
    if findings.outside:
        yield f"outside its bounds, which the method newton ignores: {names}; use least_squares"
    elif findings.at_bound:
        yield f"at a bound: {names}; formal standard deviations are not valid there"


def _implausible_estimates(parameters: ParameterSet, theta: Array) -> Iterator[str]:
    """Warnings about estimates that contradict their stated priors, or the CAD prior."""
    for parameter, value in zip(parameters.parameters, theta, strict=True):
        if parameter.prior is None:
            continue

        distance = abs(value - parameter.guess) / parameter.prior
        if distance > IMPLAUSIBLE_PRIOR_DISTANCE:
            yield (
                f"{parameter.name} is {distance:.0f} prior standard deviations from its guess: "
                "the prior or the estimate is wrong"
            )

    # The prior of an inertia is normal in ten directions, so that its distance is compared with the
    # quantile of as rare an event.
    rare = 2.0 * scipy.special.ndtr(-IMPLAUSIBLE_PRIOR_DISTANCE)
    for body in CadPrior.of(parameters).bodies:
        residual = body.difference(theta[body.columns]).residual / body.prior_sigma
        distance = float(np.linalg.norm(residual))
        if distance > np.sqrt(scipy.special.chdtri(len(residual), rare)):
            group = parameters.parameters[int(body.columns[0])].group
            yield (
                f"the inertia of {group} is {distance:.0f} prior standard deviations (cad_prior) "
                "from that of the model: the model's inertia, its cad_prior or the estimate is "
                "wrong"
            )
