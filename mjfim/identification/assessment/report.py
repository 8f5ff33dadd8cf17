"""The estimate that a user reads: values, accuracy, predictions and warnings of a solved fit."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy

from mjfim.arrays import UNDETERMINED_SHARE, Array
from mjfim.errors import MjfimError, SimulationDivergedError, first_ones, listed
from mjfim.experiment.stated_units import probable_degrees
from mjfim.experiment.system import labels_of_system, laws_in_loop
from mjfim.identification.aligned_recording import changes_within_samples
from mjfim.identification.assessment.accuracy import FitResult
from mjfim.identification.assessment.honest_covariance import with_honest_covariance
from mjfim.identification.assessment.recording_comparison import compare_recordings
from mjfim.identification.assessment.residual_tests import (
    are_white,
    is_larger_than_noise,
    is_smaller_than_noise,
    misfit_reasons,
)
from mjfim.identification.assessment.term_tests import TermTests, find_missing_terms
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.inverse_dynamics import residual_forces
from mjfim.identification.left_out import predict_unfitted
from mjfim.identification.linear_coordinates import cad_bodies, cad_information
from mjfim.identification.search import values_of_start
from mjfim.identification.segments import MIN_SAMPLES
from mjfim.model.parameters import ParameterSet
from mjfim.optimize.levenberg_marquardt import UnknownValues
from mjfim.parallel.budget import Budget
from mjfim.plant.outputs import Noise
from mjfim.recordings.checks import plausibility_remarks
from mjfim.records.estimate import (
    MAX_NOMINAL_ROWS,
    Estimate,
    Prediction,
)
from mjfim.records.estimate_parts import ResidualForce
from mjfim.records.events import begin_stage
from mjfim.records.robots import RecordingComparison
from mjfim.records.trajectory import Recording

# Distance from the guess [prior standard deviations] above which an estimate contradicts its prior.
IMPLAUSIBLE_PRIOR_DISTANCE = 4.0

# Distance from a bound, relative to the magnitude of the parameter, at which an estimate counts as
# at the bound.
BOUND_TOLERANCE = 1e-6

# Distance from the last physical value, relative to the value, at which an inertia is at a bound.
PHYSICAL_TOLERANCE = 1e-3


# Largest number of values of all recordings by which forces are compared.
MOST_FORCE_VALUES = 100_000

# Longest list of remarks on poorly known parameters [characters].
REMARKS_TEXT = 400

# Share of the sum of squared residuals above which a missing term is the most probable cause.
TELLING_SHARE = 0.1

# Command that decides between terms; the page of the estimate has the files in place of the words.
SELECT = "mjfim identify EXPERIMENT RECORDING --select -o FOLDER"

# A recording is remarked on if at least this share of the changes of its control lies inside
# engine steps of the model.
MIN_SHARE_WITHIN_SAMPLES = 0.05

# Number of samples after which the motion that an estimate holds for animations ends.
MAX_MOTION_SAMPLES = 200_000

# Relative rounding of the ratio of two periods.
ROUNDING = 1e-6


def estimate_from(
    result: FitResult,
    budget: Budget,
    refuted: Collection[str] | None = None,
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
            and are no reason for a misfit. None where no term was tried.
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
            # Terms are compared with the noise that the residuals show.
            tested, noise = problem, problem.noise
            is_larger = is_larger_than_noise(quality.chi2, quality.dof)
            if is_larger and are_white(quality.whiteness):
                seen = quality.chi2 / quality.dof * noise.covariance
                tested = problem.with_noise(Noise(covariance=seen, strides=noise.strides))
            found = find_missing_terms(tested, solution.unknowns)
            tests = TermTests() if budget.stop.requested else found
    tests = tests.without(refuted or ())
    predictions = _predictions(result, budget)
    reasons = misfit_reasons(
        quality.chi2,
        quality.dof,
        task.noise_is_stated,
        quality.whiteness,
        tests.named,
        quality.worst_residual,
    )

    begin_stage("computing the intervals")
    accuracy = result.accuracy
    at_bound, outside = _at_bounds(result)
    comparison = compare_recordings(result)

    undetermined = accuracy.singular or accuracy.single_unidentifiable
    converged = solution.success and not (undetermined or outside)
    interrupted = budget.stop.requested
    groups = (
        f"not identifiable separately: {group.short}; what the recordings do not determine was "
        "held. Remove or fix one of them, give it a prior, or record other motions"
        for group in accuracy.groups
    )
    stated = (*probable_degrees(system.experiment, system.source), *groups)
    causes: tuple[str, ...] = ()
    if reasons or quality.unexplained or not converged:
        causes = (*_causes(result, tests, is_selected=refuted is not None), *stated)
    if outside:
        names = listed(at_bound)
        newton = f"outside its bounds, which the method newton ignores: {names}; use least_squares"
        causes = (newton, *causes)
    worst_first = sorted(accuracy.poorly_known, key=lambda each: -each[2])
    remarks = [f"{name} {remark}" for name, remark, _ in worst_first]
    poor = [first_ones(remarks, "; ", REMARKS_TEXT)] if remarks else []
    is_undetermined = bool(worst_first) and worst_first[0][2] >= UNDETERMINED_SHARE
    known = (
        *_limits_of_search(result, at_bound, reasons, interrupted=interrupted),
        *(() if causes else stated),
        *_contradictions(result, comparison),
        *_implausible_estimates(parameters, result.theta),
        *(poor if is_undetermined else ()),
    )
    details = (*_where_it_fails(result, reasons, tests), *(() if is_undetermined else poor))
    per_recording = zip(
        problem.per_recording, solution.unknowns.per_recording.T.tolist(), strict=True
    )
    quick, at = result.quick
    interval = accuracy.interval
    if result.horizons is not None:
        interval = result.horizons.widened(interval)
    estimate = Estimate(
        parameters=parameters.names,
        units=system.units,
        prior=parameters.prior_information + cad_information(cad_bodies(parameters), result.theta),
        theta=result.theta,
        std=accuracy.std,
        covariance=accuracy.covariance,
        initial_theta=task.start,
        chi2=quality.chi2,
        dof=quality.dof,
        status=solution.status,
        converged=converged,
        misfit=bool(reasons),
        iterations=solution.iterations,
        residual_rms=quality.rms,
        at_bound=at_bound,
        predicted=quality.predicted,
        recordings=_as_aligned(problem, task.recordings),
        warnings=(*causes, *known, *details),
        causes=causes,
        details=details,
        nuisance=tuple(p.name for p in parameters.parameters if p.nuisance),
        combinations=tuple(str(group) for group in accuracy.groups),
        data=accuracy.data_information,
        std_sandwich=accuracy.sandwich,
        interval=interval,
        between_recordings=accuracy.between,
        sigma=dict(zip(system.outputs.names, problem.noise.sigma.tolist(), strict=True)),
        reasons=reasons,
        whiteness=quality.whiteness,
        sloppy=tuple(name for name, _, _ in accuracy.poorly_known),
        missing_terms=tests.named,
        tested_data=tests.data,
        per_recording={parameters.names[j]: tuple(values) for j, values in per_recording},
        worst_residual=quality.worst_residual if reasons else None,
        predictions=predictions,
        motion=problem.motion(solution.unknowns, 0, MAX_MOTION_SAMPLES),
        interrupted=interrupted,
        labels=labels_of_system(system),
        nominal=_nominal_outputs(result),
        segments=tuple(
            np.array([each.t[s.rows.start] for s in problem.segments if s.recording == k])
            for k, each in enumerate(problem.recordings)
        ),
        sizes=parameters.sizes(result.theta),
        restart=result.restart,
        controllers=laws_in_loop(system, result.theta, quick.clipped_shares(at)),
        horizons=result.horizons,
        held=task.settings.hold,
        inverse_dynamics=result.inverse_dynamics,
        residual_forces=() if interrupted else _residual_forces(result),
        recording_comparison=comparison,
        prior_directions=accuracy.prior_directions,
        in_time=accuracy.in_time,
        experiment=system.experiment,
    )
    return with_honest_covariance(estimate, parameters, accuracy.robust_covariance)


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


def _residual_forces(result: FitResult) -> tuple[ResidualForce, ...]:
    """Forces that the model does not explain at each joint; none where no log shows them.

    Of much data, the first rows of every recording are enough for a picture.
    """
    problem, at = result.problem, result.solution.unknowns
    count = len(problem.recordings)
    rows = MOST_FORCE_VALUES // (count * len(problem.system.outputs))
    parts = [each.first_rows(rows) for each in problem.recordings]
    thetas = [problem.theta_of_recording(at, k) for k in range(count)]
    try:
        return residual_forces(problem.system, parts, thetas)
    except (MjfimError, np.linalg.LinAlgError):
        return ()


def _nearly_unphysical(problem: FitProblem, at: UnknownValues) -> np.ndarray:
    """Parameters near a bound at which an inertia is no longer that of a body."""
    lower, upper = problem.bounds_at(at)
    values = problem.common_values(at)
    near = np.minimum(values - lower, upper - values) < PHYSICAL_TOLERANCE * np.abs(values)
    near &= (lower > problem.lower) | (upper < problem.upper)
    return np.asarray(problem.parameter_of_column[near])


def _at_bounds(result: FitResult) -> tuple[tuple[str, ...], bool]:
    """Names of the parameters at a bound or beyond it, and whether any is beyond.

    Those that are held are where the user wants them. A bound of an inertia may be the last value
    at which its body is physical.
    """
    parameters, theta, held = result.task.system.parameters, result.theta, result.task.settings.hold
    tolerance = BOUND_TOLERANCE * parameters.magnitude
    distance = np.minimum(theta - parameters.lower, parameters.upper - theta)
    is_beyond = bool((distance < -tolerance).any())
    distance[_nearly_unphysical(result.problem, result.solution.unknowns)] = 0.0
    at_bound = np.flatnonzero(distance < tolerance)
    names = tuple(parameters.names[j] for j in at_bound if parameters.names[j] not in held)
    return names, is_beyond


def _nominal_outputs(result: FitResult) -> tuple[Array, ...]:
    """(M, ny) outputs of the model at the initial guess, from the fitted initial states.

    There are none where the model diverges, and none of much data, whose figures do without them.
    """
    problem, at = result.problem, result.solution.unknowns
    if problem.row_count > MAX_NOMINAL_ROWS:
        return ()
    guess = problem.begin(result.task.start)
    if problem.free_starts:
        guess = replace(guess, private=at.private)
    return tuple(problem.predict(guess) or ())


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


def _causes(result: FitResult, tests: TermTests, *, is_selected: bool) -> Iterator[str]:
    """Probable causes of a poor fit, each with its cure, the most probable one first."""
    quality = result.quality
    problem, solution = result.problem, result.solution
    if not solution.interrupted and (advice := unpredictable_motion(problem, solution.unknowns)):
        yield advice
    # A term that explains a good part of the residuals comes before what may not matter.
    likely = list(_likely_terms(tests, is_selected=is_selected))
    is_telling = bool(likely) and tests.likely[0].share > TELLING_SHARE
    yield from likely if is_telling else ()
    yield from _remarks_on_rate(result)
    yield from () if is_telling else likely
    yield from _remarks_on_data(result)
    if quality.unexplained:
        yield (
            f"the fit explains little of the motion of {listed(quality.unexplained)}: probably "
            "a local minimum. Shorter segments (fit.segments), more starts (fit.starts) or a "
            "better guess may find a better one"
        )


def _likely_terms(tests: TermTests, *, is_selected: bool) -> Iterator[str]:
    """The term that the model most probably lacks, or some that are alike, and their cure."""
    if not tests.likely:
        return
    terms = " or ".join(map(str, tests.likely))
    alike = ", which the log hardly tells apart" if len(tests.likely) > 1 else ""
    advice = "Add" if is_selected else f"Let `{SELECT}` decide, or add"
    yield (
        f"the model may lack {terms}{alike}. {advice} at the end of the experiment file:\n"
        f"{tests.likely[0].recipe}"
    )


def _where_it_fails(result: FitResult, reasons: Sequence[str], tests: TermTests) -> Iterator[str]:
    """Kind and place of a misfit, and further terms that the model may lack."""
    if reasons:
        yield f"misfit: {'; '.join(reasons)}; the formal standard deviations are not the accuracy"
    if reasons and result.quality.worst_residual is not None:
        yield str(result.quality.worst_residual)
    for term in tests.named[len(tests.likely) if reasons else 0 :]:
        yield f"the model may lack {term}; to estimate it, add:\n{term.recipe}"
    if tests.data is not None:
        found = (tests.data.untested_sentence, tests.data.impossible_sentence if reasons else "")
        yield from (f"terms that the model may lack: {each}" for each in found if each)


def _remarks_on_data(result: FitResult) -> Iterator[str]:
    """Remarks about poor data, each with the recordings for which it holds."""
    channels = result.task.system.channels
    names: dict[str, list[str]] = {}
    for recording, predicted in zip(result.task.recordings, result.quality.predicted, strict=True):
        for remark in plausibility_remarks(channels, recording, predicted):
            names.setdefault(remark, []).append(Path(recording.name).name)
    for remark, recordings in names.items():
        yield f"poor data in {first_ones(recordings)}: {remark}"


def _remarks_on_rate(result: FitResult) -> Iterator[str]:
    """Remarks on recordings whose control changes inside the engine steps of the model."""
    system = result.problem.system
    dt, held = system.dt, np.ones(len(system.inputs), dtype=bool)
    if system.laws is not None:
        held = system.laws.held
    shares, period = {}, dt
    for recording in result.task.recordings:
        count = len(recording.t) - 1
        share = changes_within_samples(recording.t, recording.ctrl[:count, held], dt)
        if share >= MIN_SHARE_WITHIN_SAMPLES:
            shares[Path(recording.name).name] = share
            period = float(np.median(np.diff(recording.t)))
    if shares:
        # The longest timestep of which the period of the log is a whole number.
        timestep = period / math.ceil(period / dt * (1.0 - ROUNDING))
        yield (
            f"{100 * max(shares.values()):.0f} % of the changes of the control in "
            f"{first_ones([*shares])} lie inside the engine steps of the model ({dt:g} s), which "
            "hold its mean: this alone can cause a misfit. State a timestep in the MJCF that "
            f'divides the period of the log, for example timestep="{timestep:.4g}", and rate = '
            f"{1.0 / period:.4g} in the experiment file"
        )


def _limits_of_search(
    result: FitResult, at_bound: Sequence[str], reasons: Sequence[str], *, interrupted: bool
) -> Iterator[str]:
    """Warnings about the data, the start, the end, and what the recordings do not determine."""
    problem = result.problem
    fitted, whole = problem.sample_count, sum(len(each.t) - 1 for each in problem.recordings)
    if result.task.settings.seconds is not None and fitted < whole:
        dt = problem.system.dt
        yield (
            f"only {len(problem.segments)} segments, {fitted * dt:.3g} of {whole * dt:.3g} s, were "
            "fitted. Fit the final model to all data"
        )
    yield from (sentence for sentence, _ in result.task.elsewhere)
    if result.begun_instead:
        yield (
            f"the model diverges at the start ({values_of_start(result.task)}): the search began "
            f"{result.begun_instead} instead"
        )
    if result.touches:
        yield (
            f"stops or contacts act: {result.touches}. The residuals jump where a touch comes or "
            "goes; shorter segments (fit.segments) make the fit easier"
        )
    if interrupted and not result.solution.interrupted:
        yield "interrupted after the search: there are no predictions of data that were not fitted"
    if result.accuracy.singular:
        yield "the recordings do not determine all parameters: the information is singular"
    if at_bound:
        yield f"at a bound: {listed(at_bound)}; formal standard deviations are not valid there"
    chi2, dof = result.quality.chi2, result.quality.dof
    ratio = np.sqrt(chi2 / dof)
    if result.task.noise_is_stated and not reasons and is_smaller_than_noise(chi2, dof):
        yield f"residuals are only {ratio:.2f} times the stated noise: the stated σ is too large"


def _contradictions(result: FitResult, comparison: RecordingComparison | None) -> Iterator[str]:
    """Warnings about recordings that contradict each other."""
    for odd in () if comparison is None else comparison.odd:
        yield str(odd)

    robust = result.accuracy.robust
    if robust is None or not robust.apart:
        return

    system, index = result.task.system, result.problem.parameter_of_column
    logs = [Path(recording.name).name for recording in result.task.recordings]
    apart = []
    for column in robust.apart:
        values, j = robust.each[:, column], index[column]
        low, high = int(np.nanargmin(values)), int(np.nanargmax(values))
        apart.append(
            f"{system.parameters.names[j]} (from {values[low]:.3g} in {logs[low]} to "
            f"{values[high]:.3g} {system.units[j]}".rstrip()
            + f" in {logs[high]})"
        )
    yield (
        f"recordings disagree on {first_ones(apart)} by more than the scatter within each "
        "recording. They may depend on the excitation, or something differs between the "
        "recordings that the model lacks. The intervals allow for it"
    )


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
    for body in cad_bodies(parameters):
        residual = body.difference(theta[body.columns])[0] / body.prior_sigma
        distance = float(np.linalg.norm(residual))
        if distance > np.sqrt(scipy.special.chdtri(len(residual), rare)):
            group = parameters.parameters[int(body.columns[0])].group
            yield (
                f"the inertia of {group} is {distance:.0f} prior standard deviations (cad_prior) "
                "from that of the model: the model's inertia, its cad_prior or the estimate is "
                "wrong"
            )


# ---- motions that no simulation follows
#
# Unstable and chaotic motions amplify a deviation exponentially. The residuals of one simulation
# over a long time then have many local minima, in which a fit ends. Shorter segments avoid that.

# Largest number of samples of a motion along which the amplification is computed.
MAX_SAMPLES = 20_000

# Amplification over a segment above which shorter segments are recommended. A damped or a free
# motion stays far below it, because deviations do not grow exponentially there.
MAX_AMPLIFICATION = 1e3

# Amplification over a segment of the recommended length.
GOOD_AMPLIFICATION = 30.0

# Amplification above which rounding errors alone change the whole motion.
ROUNDING_AMPLIFICATION = 1e14

# Smallest number of samples of a recommended segment.
LEAST_SAMPLES = 2 * MIN_SAMPLES

# Digits of a recommended length.
LENGTH_DIGITS = 2


def sentence_about_instability(amplification: float, length: float, recommended: float) -> str:
    """Advice about a motion that is too unstable for the segments of a fit.

    Args:
        amplification: Common logarithm of the amplification of a small deviation.
        length: Time within which it grows so much [s].
        recommended: Length of segments over which deviations typically grow less than
            `GOOD_AMPLIFICATION` times [s].
    """
    rounding = ""
    if amplification > np.log10(ROUNDING_AMPLIFICATION):
        rounding = ", and rounding errors alone change it"
    return (
        f"the motion is unstable or chaotic: a small deviation grows 1e{amplification:.0f}-fold "
        f"within {length:.3g} s, so the residuals of one simulation have many local minima"
        f"{rounding}. State fit.segments = {recommended:g} in the experiment file: segments with "
        "free initial states, over which it typically grows less than "
        f"{GOOD_AMPLIFICATION:.0f}-fold"
    )


def unpredictable_motion(problem: FitProblem, at: UnknownValues) -> str:
    """Compare the amplification along the longest recording with the segments of a fit.

    Args:
        problem: Problem with the segments.
        at: The unknowns.

    Returns:
        Advice with the amplification and a better length; empty if the segments suit the motion,
        and with control laws, of whose memory a state shows nothing.
    """
    if problem.system.laws is not None:
        return ""
    longest = max(problem.segments, key=lambda segment: segment.samples)
    samples = min(longest.samples, MAX_SAMPLES)
    motion = problem.motion(at, longest.recording, longest.begin + samples)
    if motion is None:
        return ""

    rows = slice(longest.begin, longest.begin + samples + 1)
    motion = replace(
        motion,
        t=motion.t[rows],
        qpos=motion.qpos[rows],
        qvel=motion.qvel[rows],
        act=motion.act[rows],
        ctrl=motion.ctrl[longest.begin : longest.begin + samples],
    )
    plant = problem.system.plant
    try:
        A, _, _, _ = plant.derivatives.jacobians(problem.theta(at), motion)
    except SimulationDivergedError:
        return ""

    # Deviations are relative to the size of the motion.
    moves = plant.space.minus(motion.state, motion.state[:1])
    typical = amplifications(A, np.abs(moves).max(axis=0))
    if typical[-1] <= np.log10(MAX_AMPLIFICATION):
        return ""

    good = np.flatnonzero(typical <= np.log10(GOOD_AMPLIFICATION))
    samples = max(2 ** int(good[-1]) if len(good) else 1, LEAST_SAMPLES)
    return sentence_about_instability(
        float(typical[-1]),
        float(2 ** (len(typical) - 1) * plant.dt),
        float(f"{samples * plant.dt:.{LENGTH_DIGITS}g}"),
    )


def amplifications(A: Array, sizes: Array) -> Array:
    """Typical amplification of a deviation over windows of 1, 2, 4, ... samples.

    Args:
        A: (N, nx, nx) transition matrices.
        sizes: (nx,) magnitude of each component of the state, to which deviations are relative;
            components of size zero do not count.

    Returns:
        (n,) common logarithms of the spectral norms, averaged over all windows of a length; the
        last window is the longest power of two within N samples.
    """
    moving = np.flatnonzero(sizes > 0.0)
    if not len(moving):
        return np.zeros(1)
    scale = sizes[moving]
    products = A[:, moving][:, :, moving] * scale / scale[:, None]
    logarithms = np.zeros(len(products))

    found = []
    while True:
        # Products are normalised, because their norms may exceed the largest number.
        norms = np.linalg.norm(products, 2, axis=(1, 2))
        products = products / np.where(norms > 0.0, norms, 1.0)[:, None, None]
        with np.errstate(divide="ignore"):
            logarithms = logarithms + np.log10(norms)
        found.append(logarithms.mean())

        even = len(products) // 2 * 2
        if not even:
            return np.array(found)
        products = products[1::2] @ products[:even:2]
        logarithms = logarithms[:even:2] + logarithms[1::2]
