"""Uncertainty of an estimate where residuals are not white noise.

Three methods use the condensed blocks of the last linearisation, without another simulation:

- The sandwich covariance is `H^-1 (sum_b g_b g_b' + W) H^-1`, with the score g_b of block b, the
  information H and the information W of the priors.
- The bootstrap draws blocks with replacement and takes a Gauss-Newton step for each draw.
- Estimates from single recordings are compared with each other.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from mjfim.arrays import NORMAL_95, Array, record, scaled_pseudo_inverse, scaled_to_unit_diagonal
from mjfim.information.criteria import GROUPS, without_chance
from mjfim.optimize.condensed_least_squares import Condensed

# Length of an independent block over the autocorrelation time of the residuals.
LENGTH_PER_CORRELATION_TIME = 4.0

# Autocorrelation time [rows] up to which residuals count as white.
WHITE_TIME = 1.5

# Smallest number of independent blocks, for any autocorrelation time.
MIN_BLOCKS = 20

# Eigenvalues of the scaled information about the unknowns of a single recording below this share of
# the largest one count as zero.
OWN_TOLERANCE = 1e-14


@record
class Blocks:
    """Normal equations of B blocks that count as independent, about c unknowns.

    They are all common unknowns of a fit, or those that all K recordings share: there, unknowns
    that belong to a single recording are eliminated, and follow at their optimum.

    Attributes:
        equations: (B, c, c+1) information H of each block and its score g, the gradient of half of
            its squared residuals: `[H, g]`.
        recording: (B,) index of the recording.
        priors: Rows `[J, r]` of priors: one array (l, c+1) of all of them, or K arrays of those on
            unknowns that belong to each recording.
    """

    equations: Array
    recording: np.ndarray
    priors: tuple[Array, ...]

    @property
    def count(self) -> int:
        """Number of recordings K, whose priors are apart."""
        return len(self.priors)

    def normal_equations(self, k: int) -> Array:
        """(c, c+1) normal equations `[H, g]` of recording k."""
        rows = self.priors[k]
        return np.asarray(self.equations[self.recording == k].sum(axis=0) + rows[:, :-1].T @ rows)

    def centred_scores(self, k: int, step: Array) -> Array:
        """(b, c) scores of recording k after a step (c,) to its own estimate, less their mean.

        At this estimate, differences between recordings do not count as scatter within one.
        """
        scores = self.equations[self.recording == k] @ np.append(step, 1.0)
        return np.asarray(scores - scores.sum(axis=0) / max(len(scores), 1))


def recording_evidence(
    condensed: Condensed, blocks: Blocks, recording: np.ndarray, own: np.ndarray
) -> Blocks:
    """Collect what single recordings say about the unknowns that all of them share.

    Args:
        condensed: Linearisation at the minimum.
        blocks: Its independent blocks.
        recording: (b,) index of the recording of every block of the linearisation.
        own: (K, e) common columns of the unknowns that belong to each recording; e may be 0.
    """
    known = condensed.reduced_private_rows
    c = condensed.common_count
    recording_of_segment = np.zeros(condensed.segment_count, dtype=int)
    recording_of_segment[condensed.segment_of_block] = recording

    shared = np.setdiff1d(np.arange(c), own)
    equations = np.zeros((len(blocks.equations), len(shared), len(shared) + 1))
    priors = []

    for k, columns in enumerate(own):
        # Priors on the initial states of the recording, and on its other unknowns.
        rows = known[recording_of_segment == k].reshape(-1, c + 1)
        concerns_own = (condensed.common_rows[:, columns] != 0.0).any(axis=1)
        rows = np.concatenate([rows, condensed.common_rows[concerns_own]])

        # The unknowns of the recording follow the shared ones: d own = response @ d shared.
        of_recording = blocks.recording == k
        own_equations = blocks.equations[of_recording]
        H = (own_equations.sum(axis=0) + rows[:, :-1].T @ rows)[:, :-1]
        inverse = scaled_pseudo_inverse(H[np.ix_(columns, columns)], OWN_TOLERANCE)
        follows = np.zeros((c, len(shared)))
        follows[shared] = np.eye(len(shared))
        follows[columns] = -inverse @ H[np.ix_(columns, shared)]

        wide = scipy.linalg.block_diag(follows, 1.0)
        equations[of_recording] = follows.T @ own_equations @ wide
        priors.append(rows @ wide)

    return Blocks(equations=equations, recording=blocks.recording, priors=tuple(priors))


def independent_blocks(
    condensed: Condensed, recording: np.ndarray, rows: np.ndarray, min_rows: float
) -> Blocks:
    """Merge the blocks of a linearisation to longer ones that count as independent.

    Args:
        condensed: The linearisation.
        recording: (b,) index of the recording of every block of the linearisation, ascending.
        rows: (b,) number of rows of every block.
        min_rows: Smallest number of rows of a longer block.
    """
    label = merge_blocks(recording, rows, min_rows)
    count = int(label.max(initial=-1)) + 1
    c = condensed.common_count

    equations = np.zeros((count, c, c + 1))
    np.add.at(equations[..., :-1], label, condensed.block_information)
    np.add.at(equations[..., -1], label, condensed.block_scores)

    recording_of_label = np.zeros(count, dtype=int)
    recording_of_label[label] = recording
    known = condensed.reduced_private_rows.reshape(-1, c + 1)
    return Blocks(
        equations=equations,
        recording=recording_of_label,
        priors=(np.concatenate([condensed.common_rows, known]),),
    )


def block_length(correlation_rows: Sequence[float], rows: int) -> float:
    """Number of rows of a block that counts as independent.

    Args:
        correlation_rows: Autocorrelation time of the residuals of every output [rows].
        rows: Number of all rows.

    Returns:
        Four autocorrelation times, or one row for white noise; at most a twentieth of all rows.
    """
    longest = max(correlation_rows, default=1.0)
    wanted = LENGTH_PER_CORRELATION_TIME * longest if longest > WHITE_TIME else 1.0
    return min(wanted, max(rows / MIN_BLOCKS, 1.0))


def merge_blocks(recording: np.ndarray, rows: np.ndarray, min_rows: float) -> np.ndarray:
    """Merge consecutive blocks of a recording to longer blocks with enough rows.

    The last block of a recording has at least half of `min_rows`, if the recording is that long.

    Args:
        recording: (b,) index of the recording of every block, ascending.
        rows: (b,) number of rows of every block.
        min_rows: Smallest number of rows of a longer block.

    Returns:
        (b,) number of the longer block to which each block belongs.
    """
    # Rows from each block to the end of its recording.
    to_end = np.cumsum(rows[::-1])[::-1]
    after_recording = np.searchsorted(recording, recording, side="right")
    left_in_recording = to_end - np.append(to_end, 0.0)[after_recording]

    numbers = np.zeros(len(rows), dtype=int)
    number = -1
    filled = 0.0
    for b in range(len(rows)):
        is_new_recording = b == 0 or recording[b] != recording[b - 1]
        is_full = filled >= min_rows and left_in_recording[b] >= 0.5 * min_rows
        if is_new_recording or is_full:
            number += 1
            filled = 0.0
        numbers[b] = number
        filled += rows[b]
    return numbers


# Confidence level of the intervals.
LEVEL = 0.95

# Eigenvalues of a scaled information (unit diagonal) below this share of the largest one count as
# zero.
INVERSE_TOLERANCE = 1e-14

# Probability below which the test rejects that recordings agree.
SIGNIFICANCE = 1e-3

# Number of bootstrap replicates that are computed at once.
REPLICATES_AT_ONCE = 200

# Condition number of the scaled information of one recording, above which the recording does not
# determine all unknowns.
MAX_CONDITION_OF_RECORDING = 1e12

# Condition number of the scaled information of a bootstrap draw, above which the draw does not
# determine all unknowns.
MAX_CONDITION_OF_DRAW = 1e14

# Smallest variance in a denominator.
SMALLEST_VARIANCE = 1e-300


@record
class Uncertainty:
    """Robust uncertainty of the c unknowns that all recordings have in common [theta-unit].

    It allows for autocorrelated residuals and for recordings that disagree.

    Attributes:
        sandwich: (c,) standard deviations that allow for autocorrelated residuals.
        interval: (c, 2) 95 % intervals, which cover the formal, sandwich and bootstrap intervals.
        between: (c,) standard deviation between recordings that their standard deviations do not
            explain.
        apart: Indices of the unknowns on which recordings disagree.
        each: (K, c) estimates from each recording alone; NaN where a recording has too little
            information.
        draws: (n, c) bootstrap replicates of the estimate.
        covariance: (c, c) covariance that is in every direction at least the formal one and the
            sandwich one, without the scatter between recordings.
    """

    sandwich: Array
    interval: Array
    between: Array
    apart: tuple[int, ...]
    each: Array
    draws: Array
    covariance: Array


def robust_uncertainty(
    condensed: Condensed,
    theta: Array,
    recording: np.ndarray,
    rows: np.ndarray,
    *,
    min_rows: float,
    draws: int,
    rng: np.random.Generator,
    own: np.ndarray,
    inflation: float = 1.0,
    is_white: bool = True,
) -> Uncertainty:
    """Uncertainty of the common unknowns at a minimum.

    Args:
        condensed: Linearisation at the minimum, where the gradient vanishes.
        theta: (c,) values of the common unknowns.
        recording: (b,) index of the recording of every block of the linearisation, ascending.
        rows: (b,) number of rows of every block.
        min_rows: Blocks are merged to longer ones with at least this number of rows, which count as
            independent.
        draws: Number of bootstrap replicates.
        rng: Random generator of the bootstrap.
        own: (K, e) columns of the unknowns that belong to each of K recordings; e may be 0.
        inflation: Factor of the formal variances from which the covariance of combinations begins.
            The scatter of few blocks says nothing about most combinations of many unknowns.
        is_white: Whether residuals are white noise; otherwise, the scatter between few groups of
            blocks counts as well.

    Returns:
        The uncertainty.
    """
    blocks = independent_blocks(condensed, recording, rows, min_rows)
    information, scores = blocks.equations[..., :-1], blocks.equations[..., -1]
    count = len(scores)
    prior_rows = blocks.priors[0][:, :-1]
    prior = prior_rows.T @ prior_rows
    of_data = information.sum(axis=0)

    # Sandwich and formal covariance.
    root = inverse_root(of_data + prior)
    of_scatter = _sandwich(scores, prior, root)
    sandwich = np.sqrt(np.maximum(np.diag(of_scatter), 0.0))
    formal = np.linalg.norm(root, axis=1)

    # Larger and correlated residuals widen what the data say, but not the priors.
    of_noise = _in_unknowns(root.T @ (inflation * of_data + prior) @ root, root)

    replicates = _bootstrap(blocks, draws, rng)

    # Separate estimates from each recording, with the priors on its private unknowns.
    evidence = recording_evidence(condensed, blocks, recording, own)
    shared = np.setdiff1d(np.arange(len(theta)), own)
    of_shared, between_shared, apart = _compare_recordings(theta[shared], evidence)
    each = np.full((len(of_shared), len(theta)), np.nan)
    each[:, shared] = of_shared
    between = np.zeros(len(theta))
    between[shared] = between_shared

    # The hull of the formal, the sandwich and the bootstrap interval. Quantiles of Student's
    # distribution allow for the number of blocks from which the sandwich covariance comes.
    factor = float(t_quantile(max(count - 1, 1))) / NORMAL_95
    half_width = np.maximum(
        NORMAL_95 * np.hypot(formal, between), factor * NORMAL_95 * np.hypot(sandwich, between)
    )
    number = min(GROUPS, count // 2)
    # The part of the formal deviations that comes from the data.
    by_data = np.sqrt(np.maximum(np.diag(_in_unknowns(root.T @ of_data @ root, root)), 0.0))
    for order in () if is_white or number < 2 else _orders(information):
        groups = np.array_split(order, number)
        sums = np.array([scores[g].sum(axis=0) for g in groups])
        scatter = np.diag(_sandwich(sums, np.zeros_like(prior), root))
        # Few groups tell little about each unknown, and more about all of them: one of which they
        # show a small scatter by chance is raised towards the usual one. Priors stay as they are.
        # Ratios below the floor change nothing.
        t = t_quantile(number - 1)
        ratio = np.sqrt(np.maximum(scatter, 0.0)) / np.maximum(by_data, SMALLEST_VARIANCE)
        ratio = np.maximum(ratio, NORMAL_95 / t)
        common = shared[by_data[shared] > 0.0]
        if len(common):
            usual = without_chance(ratio[common], number - 1)
            ratio[common] = np.maximum(ratio[common], usual)
        wide = np.sqrt(formal**2 + (ratio**2 - 1.0) * by_data**2 + between**2)
        half_width = np.maximum(half_width, t * wide)
    low, high = theta - half_width, theta + half_width
    if len(replicates):
        tails = np.quantile(replicates, [0.5 - LEVEL / 2.0, 0.5 + LEVEL / 2.0], axis=0)
        low, high = np.minimum(low, theta + tails[0]), np.maximum(high, theta + tails[1])
    return Uncertainty(
        sandwich=sandwich,
        interval=np.column_stack([low, high]),
        between=between,
        apart=tuple(shared[apart].tolist()),
        each=each,
        draws=theta + replicates,
        covariance=covering_covariance(of_noise, factor**2 * of_scatter),
    )


def _sandwich(scores: Array, prior: Array, root: Array) -> Array:
    """(c, c) sandwich covariance of the unknowns.

    Args:
        scores: (n, c) scores of parts that count as independent.
        prior: (c, c) information of the priors.
        root: (c, k) factor of the formal covariance.
    """
    count = len(scores)
    along = (scores - scores.mean(axis=0)) @ root
    scatter = along.T @ along * (count / max(count - 1, 1))
    return _in_unknowns(scatter + root.T @ prior @ root, root)


def _orders(information: Array) -> tuple[np.ndarray, np.ndarray]:
    """Orders of (B, c, c) blocks: in time, and by the strength of their excitation."""
    _, scale = scaled_to_unit_diagonal(information.sum(axis=0))
    strength = np.sum(np.diagonal(information, axis1=1, axis2=2) / scale**2, axis=1)
    return np.arange(len(information)), np.argsort(strength, kind="stable")


def t_quantile(freedom: np.ndarray | int, level: float = LEVEL) -> Array:
    """Half widths of intervals of Student's distribution [standard deviations].

    Args:
        freedom: Degrees of freedom, at least 1.
        level: Probability that an interval holds the true value.
    """
    return np.asarray(scipy.special.stdtrit(freedom, 0.5 + 0.5 * level))


def inverse_root(information: Array) -> Array:
    """(c, k) factor A of the pseudo-inverse `A A'` of an information: (c, c).

    Products with the factor keep the digits of combinations that are known far better than others,
    which products with the inverse lose.

    Args:
        information: (c, c) information of the unknowns.

    Returns:
        (c, k) factor; eigenvalues of the scaled information that count as zero are left out.
    """
    scaled, scale = scaled_to_unit_diagonal(information)
    values, vectors = np.linalg.eigh(scaled)
    is_known = values > INVERSE_TOLERANCE * values.max(initial=0.0)
    return np.asarray(vectors[:, is_known] / np.sqrt(values[is_known]) / scale[:, None])


def _in_unknowns(covariance: Array, root: Array) -> Array:
    """(c, c) covariance of the unknowns from that of the coordinates of a root.

    Args:
        covariance: (k, k) covariance of the coordinates, symmetric but for rounding, which would
            not be small in combinations that are known well.
        root: (c, k) the root.
    """
    return root @ (0.5 * (covariance + covariance.T)) @ root.T


def covering_covariance(first: Array, second: Array) -> Array:
    """Covariance that is in every direction at least as large as two others.

    Args:
        first: (c, c) a covariance.
        second: (c, c) another one, which may be singular.

    Returns:
        (c, c) covariance; it is larger than both only where they differ in their axes.
    """
    root = covariance_root(first)
    relative = np.linalg.pinv(root, rcond=INVERSE_TOLERANCE)
    ratios, axes = np.linalg.eigh(relative @ second @ relative.T)
    spread = root @ axes
    return np.asarray((spread * np.maximum(ratios, 1.0)) @ spread.T)


def covariance_root(covariance: Array, tolerance: float = -1.0) -> Array:
    """(p, k) factor A of a covariance `A A'`: (p, p), which may be singular.

    Args:
        covariance: (p, p) the covariance.
        tolerance: Eigenvalues of the correlations up to this share of the largest one are left out;
            default: none of them.
    """
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    scale = np.where(std > 0.0, std, 1.0)
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    first = int(np.searchsorted(values, tolerance * values.max(initial=0.0), side="right"))
    return np.asarray(
        scale[:, None] * vectors[:, first:] * np.sqrt(np.maximum(values[first:], 0.0))
    )


def _bootstrap(blocks: Blocks, draws: int, rng: np.random.Generator) -> Array:
    """(n, c) Gauss-Newton steps to the estimates from drawn blocks.

    Draws that do not determine all unknowns are left out.
    """
    count = len(blocks.equations)
    prior_rows = blocks.priors[0][:, :-1]

    steps = [np.zeros_like(prior_rows[:0])]
    for first in range(0, draws, REPLICATES_AT_ONCE):
        # Each replicate weights a block by the number of times that it was drawn.
        n = min(REPLICATES_AT_ONCE, draws - first)
        drawn = np.tensordot(
            rng.multinomial(count, np.full(count, 1.0 / count), size=n), blocks.equations, axes=1
        )
        H = drawn[..., :-1] + prior_rows.T @ prior_rows

        # Priors are drawn as well, from their normal distribution.
        g = (
            drawn[..., -1]
            - blocks.equations[..., -1].sum(axis=0)
            + rng.standard_normal((n, len(prior_rows))) @ prior_rows
        )

        usable = _condition_number(H) < MAX_CONDITION_OF_DRAW
        steps.append(-np.linalg.solve(H[usable], g[usable][..., None])[..., 0])
    return np.concatenate(steps)


def _compare_recordings(theta: Array, evidence: Blocks) -> tuple[Array, Array, np.ndarray]:
    """Separate estimates from each recording, and their differences beyond their scatter.

    The variance between recordings is estimated by the method of DerSimonian & Laird (1986).

    Args:
        theta: (s,) estimate from all recordings.
        evidence: What single recordings say about these unknowns.

    Returns:
        (K, s) estimates, (s,) standard deviations between recordings, and (s,) True for unknowns
        on which they disagree.
    """
    c, K = len(theta), evidence.count
    each = np.full((K, c), np.nan)
    variance = np.full((K, c), np.inf)
    formal = np.ones((K, c))
    total = np.zeros((c, c))
    centred_scores = [np.zeros((0, c))]
    for k in range(K):
        # Normal equations of the recording and of the priors on its private unknowns, one
        # Gauss-Newton step away from the common estimate.
        equations = evidence.normal_equations(k)
        H, g = equations[:, :-1], equations[:, -1]
        if _condition_number(H) > MAX_CONDITION_OF_RECORDING:
            continue
        inverse = scaled_pseudo_inverse(H, INVERSE_TOLERANCE)
        step = -inverse @ g
        each[k] = theta + step
        formal[k] = np.diag(inverse)
        centred = evidence.centred_scores(k, step)
        correction = len(centred) / max(len(centred) - 1, 1)
        variance[k] = np.diag(inverse @ (centred.T @ centred * correction) @ inverse)
        total += H
        centred_scores.append(centred)

    # The relative scatter within each recording is at least that of all recordings together,
    # because a few blocks often scatter little by chance.
    joined = np.concatenate(centred_scores)
    freedom = max(len(joined) - (len(centred_scores) - 1), 1)
    inverse = scaled_pseudo_inverse(total, INVERSE_TOLERANCE)
    scatter = joined.T @ joined * (len(joined) / freedom)
    expected = np.maximum(np.diag(inverse), SMALLEST_VARIANCE)
    inflation = np.maximum(np.diag(inverse @ scatter @ inverse) / expected, 1.0)
    variance = np.maximum(variance, formal * inflation)

    # Compare the weighted scatter of the estimates with the scatter that their variances explain.
    others = np.maximum(np.isfinite(each).sum(axis=0) - 1, 1)
    w, _, deviation = weighted(each, variance)
    found = np.sum(w * deviation**2, axis=0)
    apart = scipy.special.fdtrc(others, freedom, found / others) < SIGNIFICANCE
    between, w = np.zeros(c), w[:, apart]
    sums = w.sum(axis=0)
    between[apart] = np.sqrt((found - others)[apart] / (sums - np.sum(w**2, axis=0) / sums))
    return each, between, apart


def weighted(
    values: Array, variances: Array, tau2: Array | float = 0.0
) -> tuple[Array, Array, Array]:
    """Average estimates of recordings that scatter.

    Args:
        values: (K, q) estimates; NaN where a recording gives none.
        variances: (K, q) their variances; infinite where there is none.
        tau2: (q,) further variances, between recordings.

    Returns:
        (K, q) weights, zero where there is no estimate, (q,) weighted means, and (K, q) deviations
        from them.
    """
    known = np.isfinite(values) & np.isfinite(variances) & (variances > 0.0)
    weights = np.where(known, 1.0 / (np.where(known, variances, 1.0) + tau2), 0.0)
    total = weights.sum(axis=0)
    finite = np.where(known, values, 0.0)
    mean = np.sum(weights * finite, axis=0) / np.where(total > 0.0, total, 1.0)
    return weights, mean, np.where(known, values - mean, 0.0)


def _condition_number(H: Array) -> Array:
    """(...) condition numbers of information matrices: (..., c, c).

    They do not depend on the units of the unknowns, because the diagonal is scaled to 1.
    """
    scaled, _ = scaled_to_unit_diagonal(H)
    return np.asarray(np.linalg.cond(scaled))
