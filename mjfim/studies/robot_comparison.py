"""Comparison of two estimates: two robots of one kind, or one robot before and after.

Each parameter is tested by Student's test. It uses the honest standard deviations of both estimates
and the scatter between recordings, which is assumed to be the same for both robots. All parameters
together are tested by the statistic of Wald. The p-values are corrected for the number of tests by
the method of Holm (1979). `mjfim compare-robots` calls `compare_estimates`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import permutations

import numpy as np
import scipy

from mjfim.arguments import checked
from mjfim.arrays import NORMAL_95, Array
from mjfim.errors import ExperimentError, first_ones
from mjfim.experiment.parameters import INITIAL_STATE_PREFIX
from mjfim.identification.assessment.honest_covariance import (
    agreeing_covariance,
    stretched_formal_covariance,
)
from mjfim.identification.assessment.recording_comparison import (
    between_variance,
    f_tail,
    satterthwaite,
)
from mjfim.records.check import join_names
from mjfim.records.estimate import Estimate
from mjfim.records.robots import RobotComparison

# Probability of finding a difference where there is none.
LEVEL = 0.05

# Probability of finding a difference that is as large as the detectable one.
POWER = 0.8

# Degrees of freedom of standard deviations that count as known.
MANY_DEGREES = 1e6

# Eigenvalues of a correlation matrix below this share of the largest one count as zero.
RANK_TOLERANCE = 1e-9


@checked
def compare_estimates(
    first: Estimate, second: Estimate, *, names: Sequence[str] = ("A", "B")
) -> RobotComparison:
    """Compare two robots, or one robot before and after, by their estimates.

    Args:
        first: Estimate of the first robot.
        second: Estimate of the second robot, from other recordings.
        names: Names of both robots.

    Returns:
        Differences of the parameters that both estimates determine, and their significance.

    Raises:
        ExperimentError: The two names are not different, or the estimates have no parameter in
            common, or come from the same recordings.
    """
    names = tuple(names)
    if len(names) != 2 or names[0] == names[1]:
        raise ExperimentError(f"names: {names} must be two different names, one for each robot")

    robots = dict(zip(names, (first, second), strict=True))
    common = [name for name in first.parameters if name in second.parameters]
    if not common:
        raise ExperimentError(
            f"{names[0]} and {names[1]} have no parameter in common "
            f"({first_ones(first.parameters)} and {first_ones(second.parameters)}); identify both "
            "with the same parameters"
        )
    shared = _shared_recordings(first, second)
    if len(shared) == len(first.recordings) == len(second.recordings) > 0:
        raise ExperimentError(
            f"{names[0]} and {names[1]} are estimates from the same recordings, so that nothing "
            "can differ but the experiments; record each robot"
        )

    compared = [name for name in common if not _why_not_compared(name, robots)]
    both = [(each, [each.parameters.index(name) for name in compared]) for each in robots.values()]
    values = np.array([each.theta[index] for each, index in both])
    is_single = np.array([(each.sizes == np.abs(each.theta))[index] for each, index in both])

    # Both robots share one variance between recordings, because a few recordings of one robot
    # determine it poorly.
    tau2, freedom, numbers = np.stack([_scatter(each, compared) for each, _ in both], axis=1)
    total = freedom.sum(axis=0)
    between = (freedom * tau2).sum(axis=0) / np.maximum(total, 1.0) / numbers
    std = np.sqrt(np.array([honest_std(each)[index] for each, index in both]) ** 2 + between)

    # Few recordings determine this variance, so the degrees of freedom of Student's test are few.
    difference = values[1] - values[0]
    width = np.hypot(*std)
    known = np.where(width > 0.0, width, 1.0)
    degrees = satterthwaite(between.sum(axis=0) / known**2, MANY_DEGREES, total)
    p = 2.0 * scipy.special.stdtr(degrees, -np.abs(difference) / known)
    t = scipy.special.stdtrit(degrees, 0.975)
    found = scipy.special.stdtrit(degrees, 1.0 - 0.5 * LEVEL / (len(compared) + 1))
    covariance = _covariance(*both[0], std[0]) + _covariance(*both[1], std[1])
    middle = float(np.median(degrees)) if compared else MANY_DEGREES
    corrected = holm(np.append(p, f_tail(*_wald(difference, covariance), middle)))

    return RobotComparison(
        names=names,
        recordings=(len(first.recordings), len(second.recordings)),
        parameters=tuple(compared),
        units=tuple(first.units[j] for j in both[0][1]),
        is_single=np.array(is_single.all(axis=0), dtype=np.float64),
        values=values,
        std=std,
        interval=np.column_stack([difference - t * width, difference + t * width]),
        p=corrected[:-1],
        detectable=(found + scipy.special.stdtrit(degrees, POWER)) * width,
        joint_p=float(corrected[-1]),
        level=LEVEL,
        remarks=tuple(_remarks(robots, common)),
        is_reliable=all(each.converged and not each.misfit for each, _ in both),
    )


# ---- what is known about each robot


def honest_std(estimate: Estimate) -> Array:
    """(p,) standard deviations of an estimate, without the scatter between recordings [theta-unit].

    They are those of its 95 % intervals, which allow for autocorrelated residuals.
    """
    low, high = estimate.interval.T
    below, above = estimate.theta - low, high - estimate.theta
    at_bound = np.isin(estimate.parameters, estimate.at_bound)
    half_width = np.where(at_bound, np.maximum(below, above), 0.5 * (high - low))
    without_scatter = np.maximum(estimate.std, estimate.std_sandwich)

    # Where recordings disagree, the interval already contains their scatter.
    disagrees = (estimate.between_recordings > 0.0) & (estimate.recording_comparison is not None)
    return np.maximum(without_scatter, np.where(disagrees, 0.0, half_width / NORMAL_95))


def _covariance(estimate: Estimate, index: Sequence[int], std: Array) -> Array:
    """(q, q) covariance of some parameters, which agrees with their standard deviations.

    Combinations that the estimate knows better than single parameters remain so.

    Args:
        estimate: The estimate.
        index: Indices of the q parameters.
        std: (q,) their standard deviations [theta-unit].
    """
    place = np.ix_(index, index)
    if len(estimate.honest_covariance) == len(estimate.parameters):
        return agreeing_covariance(np.array(estimate.honest_covariance[place]), std)

    # Estimates of earlier versions have formal correlations only.
    complete = np.array(estimate.std)
    complete[list(index)] = std
    return stretched_formal_covariance(estimate, complete)[place]


def _scatter(estimate: Estimate, parameters: Sequence[str]) -> Array:
    """Scatter of q parameters between the recordings of one robot.

    Returns:
        (3, q) variances between recordings [theta-unit²], their degrees of freedom, and effective
        numbers of recordings in the weighted means, at least 1.
    """
    found = np.zeros((3, len(parameters)))
    found[2] = 1.0
    comparison = estimate.recording_comparison
    if comparison is None:
        return found
    variance = between_variance(comparison.values, comparison.std**2)
    for j, name in enumerate(parameters):
        if name not in comparison.parameters:
            continue
        k = comparison.parameters.index(name)
        found[0, j] = variance[k]
        found[1, j] = max(np.isfinite(comparison.values[:, k]).sum() - 1, 0)
        std = comparison.std[:, k]
        weights = std[np.isfinite(std) & (std > 0.0)] ** -2.0
        if weights.size:
            found[2, j] = np.sum(weights) ** 2 / np.sum(weights**2)
    return found


# ---- tests


def holm(p: Array) -> Array:
    """Correct p-values for the number of tests (Holm 1979).

    Args:
        p: (q,) p-values.

    Returns:
        (q,) corrected p-values. With probability 1 - L, none of those below L is a false finding.
    """
    order = np.argsort(p, kind="stable")
    factors = np.arange(len(p), 0, -1)
    corrected = np.empty(len(p))
    corrected[order] = np.minimum(np.maximum.accumulate(factors * p[order]), 1.0)
    return corrected


def _wald(difference: Array, covariance: Array) -> tuple[float, int]:
    """Wald's statistic of a difference with a covariance, and the rank of the covariance."""
    if not len(difference):
        return 0.0, 0
    std = np.sqrt(np.diag(covariance))
    scale = np.where(std > 0.0, std, 1.0)
    eigenvalues, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    is_known = eigenvalues > RANK_TOLERANCE * eigenvalues.max()
    along = vectors[:, is_known].T @ (difference / scale)
    return float(np.sum(along**2 / eigenvalues[is_known])), int(is_known.sum())


# ---- what limits the comparison


def _why_not_compared(name: str, robots: Mapping[str, Estimate]) -> str:
    """Reason why a parameter of both estimates is not compared; empty where it is."""
    if name.startswith(INITIAL_STATE_PREFIX):
        return "it belongs to a recording"
    units = [each.units[each.parameters.index(name)] or "none" for each in robots.values()]
    if units[0] != units[1]:
        return f"its units differ ({units[0]} and {units[1]})"
    for robot, estimate in robots.items():
        if name in estimate.per_recording:
            return f"{robot} has a value for each recording"
        if not np.isfinite(estimate.std[estimate.parameters.index(name)]):
            return f"the recordings of {robot} do not determine it"
    return ""


def _remarks(robots: Mapping[str, Estimate], common: Sequence[str]) -> Iterator[str]:
    """Sentences that limit the comparison, the most serious ones first."""
    for robot, estimate in robots.items():
        if not estimate.converged:
            yield f"the estimate of {robot} is not reliable: {estimate.status}"
        if estimate.misfit:
            yield (
                f"the model does not explain the recordings of {robot} (misfit); its error acts "
                "like a difference, and the intervals do not cover it"
            )

    yield from _remarks_on_recordings(robots)
    for (robot, estimate), (other, another) in permutations(robots.items()):
        missing = [
            name
            for name in estimate.parameters
            if name not in another.parameters and not name.startswith(INITIAL_STATE_PREFIX)
        ]
        if missing:
            yield (
                f"{first_ones(missing)}: a parameter of {robot}, but fixed for {other}, which can "
                "shift other parameters"
            )
    yield from _remarks_on_parameters(robots, common)


def _remarks_on_recordings(robots: Mapping[str, Estimate]) -> Iterator[str]:
    """Sentences on recordings that both estimates contain, and on robots with one recording."""
    shared = _shared_recordings(*robots.values())
    if shared:
        yield (
            f"both estimates contain {first_ones(shared)}, which makes them alike; identify each "
            "robot from its own recordings"
        )

    single = [robot for robot, estimate in robots.items() if len(estimate.recordings) < 2]
    if len(single) == 2:
        yield (
            "single recordings say nothing about the scatter between recordings of one robot, "
            "which may look like a difference; two or more of each robot are better"
        )
    elif single:
        yield f"of {single[0]} there is a single recording; it is taken to scatter like the other"


def _remarks_on_parameters(robots: Mapping[str, Estimate], common: Sequence[str]) -> Iterator[str]:
    """Sentences on parameters that are not compared, and on priors."""
    for name in common:
        why = _why_not_compared(name, robots)
        if why and not name.startswith(INITIAL_STATE_PREFIX):
            yield f"{name} is not compared: {why}"

    with_prior = [
        name
        for name in common
        if all(np.diag(each.prior)[each.parameters.index(name)] > 0.0 for each in robots.values())
    ]
    if with_prior:
        yield (
            f"{first_ones(with_prior)}: the priors of both estimates draw them to one value, so "
            "that a difference looks smaller than it is"
        )

    with_model = [
        robot for robot, estimate in robots.items() if estimate.prior_directions is not None
    ]
    if with_model:
        yield (
            f"{join_names(with_model)}: combinations of inertias that the recordings do not show "
            "are those of the model (cad_prior), which makes robots alike; identify both with "
            "cad_prior = false"
        )


def _shared_recordings(first: Estimate, second: Estimate) -> list[str]:
    """Names of recordings that are part of both estimates."""
    return [
        recording.name
        for recording in first.recordings
        if any(
            recording.y.shape == other.y.shape
            and np.array_equal(recording.t, other.t)
            and np.array_equal(recording.y, other.y, equal_nan=True)
            for other in second.recordings
        )
    ]
