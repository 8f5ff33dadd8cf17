"""Choice of the length of the segments, by predictions of left-out data over several times.

Where a model does not explain the data, its estimates depend on the length of the segments: short
ones show quick effects, long ones show what adds up. Fits over each of several lengths predict
parts of the data that were left out, over times of each length. The lengths are compared by the
relative error over all these times, so that no time dominates because its errors are larger.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.identification.assessment.accuracy import FitResult
from mjfim.identification.assessment.honest_covariance import jackknife_std, student_quantile
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.left_out import (
    MAX_FOLDS,
    HeldOutLosses,
    LeftOutPart,
    blocks_of,
    fit_without,
    joined_losses,
    left_out_parts,
    losses_of,
    stretches_of,
)
from mjfim.identification.search import FitSearch
from mjfim.identification.segments import spread_over_data
from mjfim.identification.starts import segment_lengths
from mjfim.records.estimate import HorizonStudy
from mjfim.records.events import begin_stage

# Number of samples of a fit, and of the predictions over one horizon; of more data, segments that
# are spread over them are used.
MAX_SAMPLES = 10_000

# Number of samples of all recordings above which whole recordings are not among the lengths.
MAX_WHOLE_SAMPLES = 50_000

# Share of the mean loss by which predictions have to be worse before a shorter length is chosen.
RELEVANT_SHARE = 0.01

# Smallest number of parts of the data whose scatter tells differences from chance, and the
# probability of a difference by chance.
MIN_PARTS = 3
SIGNIFICANCE = 0.01

# Probability that an interval holds the true value.
CONFIDENCE = 0.95


def choose_length(
    search: FitSearch, problem: FitProblem, whole: FitResult
) -> tuple[HorizonStudy, float | None, Array] | None:
    """Compare lengths of segments by predictions of left-out data, and choose one.

    Args:
        search: Searches of the identification.
        problem: The problem of whole recordings, with the noise of their fit.
        whole: The fit over whole recordings.

    Returns:
        The comparison, the chosen length [s], None for whole recordings, and the (p,) estimate over
        it; None where fewer than two lengths can be compared, where a parameter moves the initial
        state, or after a request to stop.
    """
    system = search.task.system
    if system.parameters.initial_state_derivative(system.space.nx).any():
        return None
    tried = _problems(search, problem, whole)
    parts = _parts(problem)
    lengths: list[float | None] = []
    problems: list[FitProblem] = []
    fits: list[Array] = []
    for number, (length, part) in enumerate(tried):
        begin_stage("comparing lengths of the segments", number, len(tried))
        found = _fitted(search, whole, length, part, parts)
        if search.interrupted:
            return None
        if found is not None:
            lengths.append(length)
            problems.append(part)
            fits.append(found)
    if len(fits) < 2:
        return None

    # Losses of each fit over each horizon.
    sigma = system.noise.sigma
    blocks, budget = blocks_of(parts), search.budget
    losses = [
        [
            joined_losses(
                [
                    losses_of(each, theta, part, blocks, sigma, budget)
                    for part, theta in zip(parts, fit[1:], strict=True)
                ]
            )
            for each in problems
        ]
        for fit in fits
    ]
    if search.interrupted:
        return None
    chosen = _chosen([_over_all_horizons(losses, i) for i in range(len(fits))])
    longest = max(float(recording.t[-1]) for recording in problem.recordings)
    differences = [fit - fits[chosen] for fit in fits]
    study = HorizonStudy(
        lengths=np.array([longest if length is None else length for length in lengths]),
        errors=np.array([[each.error for each in row] for row in losses]),
        chosen=chosen,
        is_whole=lengths[-1] is None,
        parameters=system.parameters.names,
        units=tuple(system.units),
        theta=np.array([fit[0] for fit in fits]),
        half_widths=np.array([_half_width(fit[1:], CONFIDENCE) for fit in fits]),
        # Whether estimates differ by more than the scatter of their differences explains.
        is_apart=np.array(
            [
                (np.abs(each[0]) > _half_width(each[1:], 1.0 - SIGNIFICANCE))
                & (len(parts) >= MIN_PARTS)
                for each in differences
            ]
        ),
    )
    return study, lengths[chosen], fits[chosen][0]


def _problems(
    search: FitSearch, problem: FitProblem, whole: FitResult
) -> list[tuple[float | None, FitProblem]]:
    """Lengths of segments [s], shortest first, and their problems; None for the whole."""
    found: list[tuple[float | None, FitProblem]] = []
    for length in segment_lengths(problem.recordings):
        part = problem.cut(length)
        if part is not None:
            found.append((length, part.pinned(search.task.start, whole.null_space)))
    if problem.sample_count <= MAX_WHOLE_SAMPLES:
        found.append((None, problem))
    return [(length, _affordable(part)) for length, part in found]


def _fitted(
    search: FitSearch,
    whole: FitResult,
    length: float | None,
    problem: FitProblem,
    parts: Sequence[LeftOutPart],
) -> Array | None:
    """(K+1, p) estimates over segments of a length, of all data and without each of K parts.

    None where a simulation diverges.
    """
    name = "whole recordings" if length is None else f"segments of {length:.2g} s"
    begin = search.with_initial_states(problem, problem.begin(whole.theta))
    try:
        weighted, solution = search.solve(problem, begin, f"comparison, {name}", is_rough=True)
    except SimulationDivergedError:
        return None
    estimates = [weighted.theta(solution.unknowns)]
    for part in parts:
        others = fit_without(weighted, search.budget, solution=solution, part=part)
        if others is None:
            return None
        estimates.append(weighted.theta(others))
    return np.array(estimates)


def _parts(problem: FitProblem) -> tuple[LeftOutPart, ...]:
    """Parts that are left out: groups of recordings, or stretches of a few ones."""
    count = len(problem.recordings)
    if count >= MAX_FOLDS:
        return tuple(left_out_parts(problem))

    parts: list[LeftOutPart] = []
    for i, recording in enumerate(problem.recordings):
        bounds = np.linspace(0.0, float(recording.t[-1]), -(-MAX_FOLDS // count) + 1)
        parts += stretches_of(recording.name, i, bounds[:-1].tolist())
    return tuple(parts)


def _affordable(problem: FitProblem) -> FitProblem:
    """Segments of a problem, spread over the data, that can be simulated often."""
    count = len(problem.segments)
    wanted = max(int(MAX_SAMPLES * count / problem.sample_count), MAX_FOLDS)
    if wanted >= count:
        return problem
    return problem.of_segments(spread_over_data(count, wanted))


def _over_all_horizons(losses: Sequence[Sequence[HeldOutLosses]], index: int) -> HeldOutLosses:
    """Losses of one fit over all horizons, each relative to the smallest mean loss there.

    Args:
        losses: Losses of each fit over each horizon.
        index: Index of the fit.
    """
    row = losses[index]
    least = [
        min(each[h].error ** 2 for each in losses if np.isfinite(each[h].error))
        for h in range(len(row))
    ]
    scales = np.maximum(least, np.finfo(float).tiny)
    return HeldOutLosses(
        losses=np.concatenate([each.losses / s for each, s in zip(row, scales, strict=True)]),
        counts=np.concatenate([each.counts for each in row]),
        parts=np.concatenate([each.parts for each in row]),
        estimates=row[0].estimates,
    )


def _chosen(losses: Sequence[HeldOutLosses]) -> int:
    """Index of the longest segments whose predictions are not clearly worse than the best ones."""
    best = min(losses, key=lambda each: each.error)
    relevant = RELEVANT_SHARE * best.error**2
    good = []
    for i, each in enumerate(losses):
        reduction = each.reduction(best)
        if not (reduction.is_clear and reduction.mean > relevant):
            good.append(i)
    return max(good)


def _half_width(without: Array, confidence: float) -> Array:
    """(p,) half widths of intervals by the jackknife over K parts; NaN with fewer than two.

    Args:
        without: (K, p) values without each part.
        confidence: Probability that an interval holds the true value.
    """
    if len(without) < 2:
        return np.full(without.shape[1], np.nan)
    return student_quantile(len(without), confidence) * jackknife_std(without)
