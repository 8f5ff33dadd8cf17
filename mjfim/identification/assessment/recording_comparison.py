"""Comparison of recordings: what each suggests alone, their scatter, and which of them is odd.

Each recording suggests values of its own, one Gauss-Newton step from the common estimate, by its
part of the last linearisation; nothing is simulated. Whether recordings agree is tested with
information matrices, so that recordings may determine some directions of the parameters only.

Single quantities are averaged by random effects. Estimate y_k of recording k is the mean, plus a
deviation of this recording with the variance tau², plus an error with the known variance v_k. tau²
is estimated by the method of Paule & Mandel (Consensus values and weighting factors, 1982), which
chooses it so that the weighted squares of the deviations are as large as expected.

The interval for what another recording suggests is that of Student's distribution for a new
observation, with the weighted scatter of the recordings. With equal variances it is exact, for any
tau², while intervals of random effects for the value without its error are too short where
recordings are few.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import PurePath

import numpy as np
import scipy

from mjfim.arrays import Array, record, scaled_to_unit_diagonal
from mjfim.identification.assessment.accuracy import FitResult
from mjfim.identification.assessment.robust_covariance import (
    Blocks,
    independent_blocks,
    recording_evidence,
    t_quantile,
    weighted,
)
from mjfim.information.criteria import standard_deviations
from mjfim.records.robots import (
    OddRecording,
    RecordingComparison,
    difference_text,
    p_text,
    value_text,
)

# Newton steps for tau², of which the weighted squares are a decreasing function.
MAX_NEWTON_STEPS = 60

# Relative change of tau² at which the steps end, and relative excess of the squares that counts.
TAU_TOLERANCE = 1e-10


def random_effects(values: Array, variances: Array) -> tuple[Array, Array, Array]:
    """Average estimates of several recordings.

    Args:
        values: (K, q) estimates; NaN where a recording gives none.
        variances: (K, q) their variances.

    Returns:
        (q,) means, NaN where no recording estimates the quantity, (q,) their variances, and (q,)
        variances between recordings.
    """
    tau2 = between_variance(values, variances)
    weights, mean, _ = weighted(values, variances, tau2)
    total = weights.sum(axis=0)
    is_known = total > 0.0
    variance = np.where(is_known, 1.0 / np.where(is_known, total, 1.0), np.inf)
    return np.where(is_known, mean, np.nan), variance, tau2


def heterogeneity(values: Array, variances: Array, freedom: float) -> tuple[Array, Array]:
    """Test whether estimates scatter between recordings.

    Args:
        values: (K, q) estimates; NaN where a recording gives none.
        variances: (K, q) their variances.
        freedom: Degrees of freedom of the variances.

    Returns:
        (q,) I²: share of the scatter that is between recordings, 0 to 1; and (q,) p-values of the
        hypothesis that there is none, 1 where fewer than two recordings estimate the quantity.
    """
    weights, _, deviation = weighted(values, variances)
    squares = np.sum(weights * deviation**2, axis=0)
    others = np.maximum(np.sum(weights > 0.0, axis=0) - 1, 1)
    # Cochran's Q, by the F distribution because the variances are estimated as well.
    p = scipy.special.fdtrc(others, freedom, squares / others)
    return 1.0 - others / np.maximum(squares, others), p


def prediction(values: Array, variances: Array, tau2: Array) -> Array:
    """(q, 2) 95 % intervals of what another recording suggests; infinite with fewer than three.

    Args:
        values: (K, q) estimates; NaN where a recording gives none.
        variances: (K, q) their variances.
        tau2: (q,) variances between recordings.
    """
    weights, mean, deviation = weighted(values, variances, tau2)
    scatter, total = np.sum(weights * deviation**2, axis=0), weights.sum(axis=0)
    count = np.sum(weights > 0.0, axis=0)
    enough = count > 2
    others = np.where(enough, count - 1, 1)

    # Another recording has the mean weight of the present ones.
    new_variance = (1.0 + count) / np.where(enough, total, 1.0)
    reach = t_quantile(others) * np.sqrt(scatter / others * new_variance)
    reach = np.where(enough, reach, np.inf)
    return np.column_stack([mean - reach, mean + reach])


def between_variance(values: Array, variances: Array) -> Array:
    """Variances between recordings, by the method of Paule & Mandel.

    Args:
        values: (K, q) estimates; NaN where a recording gives none.
        variances: (K, q) their variances.

    Returns:
        (q,) variances tau²; 0 where the variances explain the scatter.
    """
    tau2 = np.zeros(values.shape[1])
    expected = np.sum(weighted(values, variances)[0] > 0.0, axis=0) - 1
    moves = expected > 0

    for _ in range(MAX_NEWTON_STEPS):
        weights, _, deviation = weighted(values, variances, tau2)
        squares = np.sum(weights * deviation**2, axis=0)
        slope = np.sum(weights**2 * deviation**2, axis=0)

        # Where the variances explain the scatter, tau² stays 0.
        moves = moves & (np.abs(squares - expected) > TAU_TOLERANCE * expected) & (slope > 0.0)
        step = np.where(moves, (squares - expected) / np.where(moves, slope, 1.0), 0.0)
        new = np.maximum(tau2 + step, 0.0)
        if (np.abs(new - tau2) <= TAU_TOLERANCE * new).all():
            break
        tau2 = new
    return tau2


# ---- several quantities at once


# What a recording says about s unknowns, possibly in some directions only: an array (s, s+1)
# `[A, A theta]` of the information A and of its product with the estimate. Those of several
# recordings add.


def with_scatter(parts: Array, tau2: Array) -> Array:
    """Evidence of recordings that scatter about their mean.

    The information is `(A^-1 + T)^-1 = A (1 + T A)^-1`, which exists for a singular A as well.

    Args:
        parts: (..., s, s+1) what recordings say.
        tau2: (s, s) covariance T between recordings.
    """
    return _symmetric(np.linalg.solve(np.eye(len(tau2)) + parts[..., :-1] @ tau2, parts))


def _symmetric(parts: np.ndarray) -> Array:
    """The parts, whose information is symmetric but for rounding."""
    A = parts[..., :-1]
    return np.concatenate([0.5 * (A + np.swapaxes(A, -1, -2)), parts[..., -1:]], axis=-1)


def difference(parts: Array) -> tuple[float, int]:
    """Sum of squares by which parts contradict each other, and its degrees of freedom.

    It is the increase of the weighted squares if all parts have the same unknowns. Directions about
    which at most one part knows anything contribute nothing. If the parts agree, it has a
    chi-squared distribution.

    Args:
        parts: (K, s, s+1) the parts; their information has a common scale.
    """
    squares, rank = 0.0, 0
    for sign, part in (*((1, part) for part in parts), (-1, parts.sum(axis=0))):
        eigenvalues, vectors = np.linalg.eigh(part[:, :-1])
        is_known = eigenvalues > TOLERANCE
        along = vectors[:, is_known].T @ part[:, -1]
        squares += sign * float(np.sum(along**2 / eigenvalues[is_known]))
        rank += sign * int(is_known.sum())
    return max(squares, 0.0), rank


# ---- distributions


def satterthwaite(share: Array, within: float, between: int | np.ndarray) -> Array:
    """Degrees of freedom of variances of two parts (Satterthwaite 1946).

    Args:
        share: (s,) share of the part between recordings, 0 to 1.
        within: Degrees of freedom of the part within recordings.
        between: Degrees of freedom of the part between recordings, one number or (s,).
    """
    share = np.clip(share, 0.0, 1.0)
    return 1.0 / ((1.0 - share) ** 2 / within + share**2 / np.maximum(between, 1))


def f_tail(squares: float, dof: int, freedom: float) -> float:
    """Probability that a sum of squares is larger by chance; 1 where there is nothing to test.

    Args:
        squares: Sum of squares in units of its variances.
        dof: Its degrees of freedom.
        freedom: Degrees of freedom of the variances.
    """
    return float(scipy.special.fdtrc(dof, freedom, squares / dof)) if dof > 0 else 1.0


# Eigenvalues of the scaled information of all recordings below this share of the largest one, and
# of one recording over that of all, count as zero.
TOTAL_TOLERANCE, TOLERANCE = 1e-12, 1e-9

# Share of a parameter in directions about which nothing is known, up to which it is known.
UNKNOWN_SHARE = 1e-6


@record
class RecordingViews:
    """Evidence of single recordings, in coordinates z in which all of them have unit information.

    Attributes:
        theta: (s,) estimate from all recordings, where z = 0; NaN for unknowns that they do not
            determine.
        directions: (s, r) derivative of theta by z.
        parts: (K, r, r+1) what each of K recordings says about z.
        values: (K, s) values that each recording alone suggests; NaN where it determines none.
        std: (K, s) their standard deviations; infinite where there is none.
        freedom: Degrees of freedom of the scatter within the recordings.
    """

    theta: Array
    directions: Array
    parts: Array
    values: Array
    std: Array
    freedom: float

    def scatter(self, tau2: Array) -> Array:
        """(r, r) covariance of z between recordings.

        Args:
            tau2: (s,) variances of theta between recordings.
        """
        inverse = np.linalg.pinv(self.directions)
        return inverse * tau2 @ inverse.T


def recording_views(theta: Array, evidence: Blocks) -> RecordingViews:
    """Find what single recordings say about the unknowns that they share.

    Args:
        theta: (s,) estimate from all recordings [theta-unit].
        evidence: What each of K recordings says.
    """
    equations = np.array([evidence.normal_equations(k) for k in range(evidence.count)])
    scaled, scale = scaled_to_unit_diagonal(equations[..., :-1].sum(axis=0))
    eigenvalues, vectors = np.linalg.eigh(scaled)
    is_known = eigenvalues > TOTAL_TOLERANCE * eigenvalues.max(initial=0.0)
    directions = vectors[:, is_known] / np.sqrt(eigenvalues[is_known]) / scale[:, None]

    # Unknowns that a direction without information moves are not determined.
    is_determined = np.linalg.norm(vectors[:, ~is_known], axis=1) <= UNKNOWN_SHARE
    known_theta = np.where(is_determined, theta, np.nan)

    # Each recording in the coordinates z, and its estimate.
    moved = directions.T @ equations @ scipy.linalg.block_diag(directions, 1.0)
    eigenvalues, vectors = np.linalg.eigh(moved[..., :-1])
    transposed = np.swapaxes(vectors, 1, 2)
    is_known = eigenvalues > TOLERANCE
    inverses = np.where(is_known, 1.0 / np.where(is_known, eigenvalues, 1.0), 0.0)[:, None]
    inverses = vectors * inverses @ transposed
    roots = vectors * np.sqrt(np.maximum(eigenvalues, 0.0))[:, None] @ transposed
    steps = -inverses @ moved[..., -1:]
    scatters = []
    for k, step in enumerate(steps[..., 0]):
        # An interrupted fit may have used no segment of a recording.
        centred = evidence.centred_scores(k, directions @ step) @ directions
        count = len(centred)
        scatters.append(centred.T @ centred * (count / max(count - 1, 1)))

    # Scores scatter within all recordings together at least as the information says, because a few
    # blocks often scatter little by chance.
    eigenvalues, vectors = np.linalg.eigh(np.sum(scatters, axis=0))
    pooled = vectors * np.maximum(eigenvalues, 1.0) @ vectors.T

    # Scores of a recording scatter more than its information says by a factor of at least 1.
    expected = np.sum(inverses * (roots @ pooled @ roots), axis=(1, 2))
    expected = np.where(expected > 0.0, expected, np.inf)
    factors = np.maximum(np.sum(inverses * scatters, axis=(1, 2)) / expected, 1.0)
    matrices = roots @ np.linalg.inv(pooled) @ roots / factors[:, None, None]
    parts = _symmetric(np.concatenate([matrices, matrices @ steps], axis=2))

    found = [_estimate(known_theta, directions, part) for part in parts]
    return RecordingViews(
        theta=known_theta,
        directions=directions,
        parts=parts,
        values=np.array([value for value, _ in found]),
        std=np.array([std for _, std in found]),
        freedom=float(max(len(evidence.equations) - evidence.count, 1)),
    )


def _estimate(theta: Array, directions: Array, part: Array) -> tuple[Array, Array]:
    """(s,) estimate of a part, and (s,) standard deviations; NaN and infinite where it has none."""
    eigenvalues, vectors = np.linalg.eigh(part[:, :-1])
    is_known = eigenvalues > TOLERANCE
    root = vectors[:, is_known] / np.sqrt(eigenvalues[is_known])

    # A parameter is known if no unknown direction moves it.
    size = np.linalg.norm(directions, axis=1)
    unknown = np.linalg.norm(directions @ vectors[:, ~is_known], axis=1)
    determined = np.isfinite(theta) & (size > 0.0) & (unknown <= UNKNOWN_SHARE * size)
    axes = directions @ root
    value = theta + axes @ (root.T @ part[:, -1])
    return (
        np.where(determined, value, np.nan),
        np.where(determined, np.linalg.norm(axes, axis=1), np.inf),
    )


# Probability to name an odd recording where all are equal.
ODD_LEVEL = 0.01

# Corrected p-value up to which a parameter of an odd recording is named, and most of them.
NAMED_LEVEL, MAX_NAMED = 0.05, 3

# Fewest recordings among which one can be odd.
FEWEST = 3


def odd_recordings(
    views: RecordingViews,
    recordings: Sequence[str],
    parameters: Sequence[str],
    units: Sequence[str],
    is_single: np.ndarray,
) -> list[OddRecording]:
    """Find the recordings that differ from the others; at most a minority can.

    Args:
        views: What each of K recordings says about s parameters.
        recordings: Their K names.
        parameters: Names of the s parameters.
        units: Units of the s parameters; may be empty.
        is_single: (s,) True for single numbers, False for entries of vectors and tensors.

    Returns:
        The odd recordings, the most significant one first.
    """
    remaining = list(range(len(views.parts)))
    most = (len(remaining) - 1) // 2
    found: list[OddRecording] = []

    while len(remaining) >= FEWEST and len(found) < most:
        tests = {k: _left_out(views, k, remaining) for k in remaining}
        worst = min(remaining, key=lambda k: tests[k][0])
        p, each, others = tests[worst]
        if p > ODD_LEVEL:
            break
        remaining.remove(worst)
        differences = {}
        for j in np.argsort(each, kind="stable")[:MAX_NAMED].tolist():
            if each[j] > NAMED_LEVEL:
                break
            own, (mean, std) = views.values[worst, j], others[:, j]
            difference = difference_text(own, mean, std, units[j], is_single=bool(is_single[j]))
            own_text = value_text(own, views.std[worst, j])
            numbers = f"{own_text} against {value_text(mean, std)} {units[j]}".rstrip()
            differences[parameters[j]] = (
                f"its {parameters[j]} is {difference} that of the others "
                f"({numbers}, {p_text(each[j])})"
            )
        found.append(
            OddRecording(
                index=worst,
                name=recordings[worst],
                p=p,
                parameters=tuple(differences),
                differences=tuple(differences.values()),
            )
        )
    return found


def _left_out(
    views: RecordingViews, k: int, remaining: Sequence[int]
) -> tuple[float, Array, Array]:
    """Test whether recording k differs from the other remaining ones.

    Returns:
        The p-value, corrected for the number of tests of all recordings, (s,) p-values of single
        parameters, corrected likewise, and (2, s) means of the others with their standard
        deviations.
    """
    others = [i for i in remaining if i != k]
    values, variances = views.values[others], views.std[others] ** 2
    mean, variance_of_mean, tau2 = random_effects(values, variances)

    # Single parameters, by Student's distribution. The scatter between the others is known from
    # few of them.
    gap = views.values[k] - mean
    variance = views.std[k] ** 2 + variance_of_mean + tau2
    is_known = np.isfinite(gap) & np.isfinite(variance)
    variance = np.where(is_known, variance, 1.0)
    share = np.where(is_known, tau2 / variance, 0.0)
    freedom = satterthwaite(share, views.freedom, len(others) - 1)
    t = np.where(is_known, np.abs(gap), 0.0) / np.sqrt(variance)
    each = 2.0 * scipy.special.stdtr(freedom, -t)

    # All parameters together.
    parts = with_scatter(views.parts, views.scatter(tau2))
    squares, dof = difference(np.array([parts[k], parts[others].sum(axis=0)]))
    mean_share = np.array([share[is_known].mean() if is_known.any() else 0.0])
    (joint_freedom,) = satterthwaite(mean_share, views.freedom, len(others) - 1)
    joint = f_tail(squares, dof, float(joint_freedom))

    # Two kinds of tests of every remaining recording.
    tests = 2.0 * len(remaining)
    each = np.minimum(tests * max(int(is_known.sum()), 1) * each, 1.0)
    p = min(tests * joint, float(each.min(initial=1.0)), 1.0)
    return p, each, np.array([mean, np.sqrt(variance_of_mean)])


def compare_recordings(fit: FitResult) -> RecordingComparison | None:
    """Compare the recordings of a fit with each other.

    Args:
        fit: The fit.

    Returns:
        The comparison; None for a single recording, and where the recordings have no parameter of
        the robot in common.
    """
    problem, solution, robust = fit.problem, fit.solution, fit.accuracy.robust
    parameters = problem.parameters
    recordings = tuple(PurePath(recording.name).name for recording in problem.recordings)
    if len(recordings) < 2 or not len(problem.shared):
        return None

    condensed = solution.condensed
    recording_of_block = problem.recording_of_block
    blocks = independent_blocks(
        condensed, recording_of_block, problem.mean_block_rows, fit.independent_rows
    )
    evidence = recording_evidence(condensed, blocks, recording_of_block, problem.own_columns)
    # Parameters of the robot that are stated to differ have their values already.
    stated = [i for i, j in enumerate(problem.per_recording) if parameters.changes_model[j]]
    std = standard_deviations(condensed.information())
    if robust is not None:
        std = np.maximum(std, robust.sandwich)
    index = [*problem.shared.tolist(), *problem.per_recording[stated].tolist()]
    theta = solution.unknowns.theta
    found = compare_evidence(
        theta[problem.shared],
        evidence,
        recordings=recordings,
        parameters=tuple(parameters.names[j] for j in index),
        units=tuple(problem.system.units[j] for j in index),
        is_single=(parameters.sizes(theta) == np.abs(theta))[problem.shared],
        stated=(solution.unknowns.per_recording[:, stated], std[problem.own_columns[:, stated]]),
    )

    # Intervals end at the bounds of the parameters.
    low = np.fmin(parameters.lower[index], found.mean)[:, None]
    high = np.fmax(parameters.upper[index], found.mean)[:, None]
    is_known = np.isfinite(found.prediction)
    return replace(
        found,
        interval=np.clip(found.interval, low, high),
        prediction=np.where(is_known, np.clip(found.prediction, low, high), found.prediction),
    )


def compare_evidence(
    theta: Array,
    evidence: Blocks,
    *,
    recordings: Sequence[str],
    parameters: Sequence[str],
    units: Sequence[str],
    is_single: np.ndarray,
    stated: tuple[Array, Array] | None = None,
) -> RecordingComparison:
    """Compare recordings by what they say about the unknowns that they share.

    Args:
        theta: (s,) estimate from all recordings [theta-unit].
        evidence: What each of K recordings says.
        recordings: Their K names.
        parameters: Names of the s unknowns, and of e parameters that are stated to differ.
        units: Their units; may be empty.
        is_single: (s,) True for single numbers, such as masses, False for entries of vectors and
            tensors.
        stated: (K, e) values of the parameters that are stated to differ, whose scatter is no
            surprise, and (K, e) their standard deviations; default: none.
    """
    views = recording_views(theta, evidence)
    count, values, std = len(theta), views.values, views.std
    if stated is not None:
        values, std = np.column_stack([values, stated[0]]), np.column_stack([std, stated[1]])
    mean, variance, tau2 = random_effects(values, std**2)
    deviation = np.sqrt(variance)
    total = with_scatter(views.parts, views.scatter(tau2[:count])).sum(axis=0)
    mean[:count], deviation[:count] = _estimate(views.theta, views.directions, total)
    share = tau2 / np.where(deviation > 0.0, deviation**2 * evidence.count, 1.0)
    reach = t_quantile(satterthwaite(share, views.freedom, evidence.count - 1)) * deviation
    squares, dof = difference(views.parts)
    is_stated = np.arange(len(parameters)) >= count
    between, p = heterogeneity(values, std**2, views.freedom)
    return RecordingComparison(
        recordings=tuple(recordings),
        parameters=tuple(parameters),
        units=tuple(units),
        is_stated=is_stated.astype(np.float64),
        values=values,
        std=std,
        mean=mean,
        interval=np.column_stack([mean - reach, mean + reach]),
        tau=np.sqrt(tau2),
        share=between,
        p=np.where(is_stated, 1.0, np.minimum(count * p, 1.0)),
        prediction=prediction(values, std**2, tau2),
        joint_p=f_tail(squares, dof, views.freedom),
        odd=tuple(odd_recordings(views, recordings, parameters, units, is_single)),
    )
