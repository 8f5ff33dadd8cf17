"""How far an estimate may be off where residuals are no white noise: sandwich covariance, block bootstrap, recordings apart.

All from the condensed blocks of the last linearisation, without a further simulation. With g_b the score of block b, H its
information and W that of the priors, `cov = H^-1 (sum g_b g_b' + W) H^-1`; the bootstrap draws blocks with replacement and
takes a Gauss-Newton step for each draw.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.stats import f as fisher
from scipy.stats import t as student

from mjfim.arrays import Array, scaled_pseudo_inverse, scaled_to_unit_diagonal
from mjfim.optimize.condensed_least_squares import Condensed
from mjfim.records.estimate import Uncertainty

LEVEL = 0.95

# Eigenvalues of an information scaled to unit diagonal below this share of the largest one count as zero.
INVERSE_TOLERANCE = 1e-14

APART = 1e-3  # probability below which recordings disagree
TIMES = 4.0  # a block is that many times as long as residuals hang together
MOST_SHARE = (
    20  # of the data that a block may take at most, inverse, so that enough of them are left
)
CHUNK = 200  # replicates at once
ALONE = 1e12  # condition of a recording's information, unknowns in units of their own, that still tells all of them
DRAWN = 1e14  # and of that of a draw


def uncertainty(
    condensed: Condensed,
    theta: Array,
    recording: np.ndarray,
    rows: np.ndarray,
    together: float,
    draws: int,
    rng: np.random.Generator,
) -> Uncertainty:
    """Of theta: (c,), where the gradient vanishes.

    recording, rows: of each block;  together: rows of a block at least;  draws: bootstrap replicates
    """
    merged = merge(recording, rows, together)
    count = int(merged.max(initial=-1)) + 1
    c = condensed.common_count
    scores, grams = np.zeros((count, c)), np.zeros((count, c, c))
    np.add.at(scores, merged, condensed.block_scores)
    np.add.at(grams, merged, condensed.block_information)
    known = condensed.reduced_private_rows
    prior = np.concatenate([condensed.common_rows, known.reshape(-1, c + 1)])[:, :-1]
    H = grams.sum(axis=0) + prior.T @ prior
    inverse = scaled_pseudo_inverse(H, INVERSE_TOLERANCE)
    about = scores - scores.mean(axis=0)
    S = about.T @ about * (count / max(count - 1, 1)) + prior.T @ prior
    sandwich = np.sqrt(np.maximum(np.diag(inverse @ S @ inverse), 0.0))
    formal = np.sqrt(np.maximum(np.diag(inverse), 0.0))
    replicates = _bootstrap(scores, grams, prior, draws, rng)
    kept = merged_owner(recording, merged, count)
    owners = np.zeros(condensed.segment_count, dtype=int)
    owners[condensed.segment_of_block] = recording
    each, between, apart = _recordings(
        theta, scores, grams, kept, [known[owners == k] for k in range(kept.max() + 1)]
    )
    wide = float(student.ppf(0.5 + LEVEL / 2.0, max(count - 1, 1)))
    normal = float(student.ppf(0.5 + LEVEL / 2.0, 1e9))
    half = np.maximum(normal * np.hypot(formal, between), wide * np.hypot(sandwich, between))
    low, high = theta - half, theta + half
    if len(replicates):
        tails = np.quantile(replicates, [0.5 - LEVEL / 2.0, 0.5 + LEVEL / 2.0], axis=0)
        low, high = np.minimum(low, theta + tails[0]), np.maximum(high, theta + tails[1])
    return Uncertainty(
        sandwich=sandwich,
        interval=np.column_stack([low, high]),
        between=between,
        apart=apart,
        each=each,
        blocks=count,
        draws=theta + replicates,
    )


def together(times: Sequence[float], total: int) -> float:
    """Rows of a block from those over which the residuals of each output hang together. total: of all rows"""
    longest = max(times, default=1.0)
    return min(TIMES * longest if longest > 1.5 else 1.0, max(total / MOST_SHARE, 1.0))


def merge(recording: np.ndarray, rows: np.ndarray, together: float) -> np.ndarray:
    """(B,) number of the longer block to which each block belongs: runs of one recording with at least so many rows.

    The last of a recording has at least half as many, if the recording has.  recording: (B,) ascending
    """
    out, label, filled = np.zeros(len(rows), dtype=int), -1, np.inf
    left = np.cumsum(rows[::-1])[::-1]  # from a block to the end of all
    ends = np.append(left, 0.0)[np.searchsorted(recording, recording, side="right")]
    for b in range(len(rows)):
        new = b == 0 or recording[b] != recording[b - 1]
        if new or (filled >= together and left[b] - ends[b] >= 0.5 * together):
            label, filled = label + 1, 0.0
        out[b] = label
        filled += rows[b]
    return out


def merged_owner(recording: np.ndarray, merged: np.ndarray, count: int) -> np.ndarray:
    """(count,) recording of every longer block."""
    owner = np.zeros(count, dtype=int)
    owner[merged] = recording
    return owner


def _bootstrap(
    scores: Array, grams: Array, prior: Array, draws: int, rng: np.random.Generator
) -> Array:
    """(n, c) Gauss-Newton steps to the estimates of drawn blocks; draws that do not tell everything are left out."""
    count, c = scores.shape
    known = prior.T @ prior
    found = []
    for first in range(0, draws, CHUNK):
        n = min(CHUNK, draws - first)
        weights = rng.multinomial(count, np.full(count, 1.0 / count), size=n).astype(np.float64)
        H = np.tensordot(weights, grams, axes=1) + known
        g = weights @ scores - scores.sum(axis=0) + rng.standard_normal((n, len(prior))) @ prior
        usable = _condition(H) < DRAWN
        found.append(-np.linalg.solve(H[usable], g[usable][..., None])[..., 0])
    return np.concatenate(found) if found else np.zeros((0, c))


def _recordings(
    theta: Array, scores: Array, grams: Array, owner: np.ndarray, known: Sequence[Array]
) -> tuple[Array, Array, tuple[int, ...]]:
    """What each recording alone says, and how much they differ beyond their own scatter (DerSimonian & Laird 1986).

    Its scatter is what its own blocks say, or those of all together if that is more: few blocks often scatter little by chance.
    known: rows of what is known before of each recording's start
    """
    c, count = len(theta), len(known)
    each, variance = np.full((count, c), np.nan), np.full((count, c), np.inf)
    formal, total, within = np.ones((count, c)), np.zeros((c, c)), [np.zeros((0, c))]
    for k in range(count):
        mine = owner == k
        rows = known[k].reshape(-1, c + 1)
        H = grams[mine].sum(axis=0) + rows[:, :-1].T @ rows[:, :-1]
        g = scores[mine].sum(axis=0) + rows[:, :-1].T @ rows[:, -1]
        if _condition(H) > ALONE:
            continue
        inverse = scaled_pseudo_inverse(H, INVERSE_TOLERANCE)
        # at its own estimate: what sets recordings apart is no scatter
        own = scores[mine] - grams[mine] @ (inverse @ g)
        own = own - own.mean(axis=0)
        each[k], formal[k] = theta - inverse @ g, np.diag(inverse)
        variance[k] = np.diag(inverse @ own.T @ own @ inverse) * len(own) / max(len(own) - 1, 1)
        total += H
        within.append(own)
    inflation, free = _inflation(total, np.concatenate(within), len(within) - 1)
    variance = np.maximum(variance, formal * inflation)
    between, apart = np.zeros(c), []
    for j in range(c):
        some = np.isfinite(each[:, j])
        if some.sum() < 2:
            continue
        y, w = each[some, j], 1.0 / variance[some, j]
        spread, others = float(np.sum(w * (y - np.sum(w * y) / w.sum()) ** 2)), int(some.sum()) - 1
        if fisher.sf(spread / others, others, free) < APART:
            apart.append(j)
            between[j] = np.sqrt(max(spread - others, 0.0) / (w.sum() - np.sum(w**2) / w.sum()))
    return each, between, tuple(apart)


def _inflation(H: Array, scores: Array, recordings: int) -> tuple[Array, int]:
    """(c,) variances from the scatter of scores within recordings over formal ones, at least 1; its degrees of freedom."""
    free = max(len(scores) - recordings, 1)
    inverse = scaled_pseudo_inverse(H, INVERSE_TOLERANCE)
    S = scores.T @ scores * (len(scores) / free)
    formal = np.maximum(np.diag(inverse), 1e-300)
    return np.asarray(np.maximum(np.diag(inverse @ S @ inverse) / formal, 1.0)), free


def _condition(H: Array) -> Array:
    """(...) condition of informations: (..., c, c), independent of the units of the unknowns."""
    return np.asarray(np.linalg.cond(scaled_to_unit_diagonal(H)[0]))
