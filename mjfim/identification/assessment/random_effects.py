"""Random effects: means of estimates that scatter more than their standard deviations explain.

Estimate y_k of recording k is the mean, plus a deviation of this recording with the variance tau²,
plus an error with the known variance v_k. tau² is estimated by the method of Paule & Mandel
(Consensus values and weighting factors, 1982), which chooses it so that the weighted squares of the
deviations are as large as expected.

The interval for what another recording suggests is that of Student's distribution for a new
observation, with the weighted scatter of the recordings. With equal variances it is exact, for any
tau², while intervals of random effects for the value without its error are too short where
recordings are few.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from mjfim.arrays import Array

# Newton steps for tau², of which the weighted squares are a decreasing function.
MAX_NEWTON_STEPS = 60

# Relative change of tau² at which the steps end, and relative excess of the squares that counts.
TAU_TOLERANCE = 1e-10

# Confidence level of intervals.
LEVEL = 0.95


@dataclass(frozen=True, kw_only=True, eq=False)
class RandomEffects:
    """Means of q quantities over recordings.

    Attributes:
        count: (q,) number of recordings that estimate each quantity.
        mean: (q,) means; NaN where no recording estimates the quantity.
        variance: (q,) variances of the means.
        tau2: (q,) variances between recordings.
        share: (q,) I²: share of the scatter that is between recordings, 0 to 1.
        p: (q,) p-values of the hypothesis that there is no scatter between recordings; 1 where
            fewer than two recordings estimate the quantity.
        prediction: (q, 2) 95 % intervals of what another recording suggests; infinite with fewer
            than three.
    """

    count: np.ndarray
    mean: Array
    variance: Array
    tau2: Array
    share: Array
    p: Array
    prediction: Array


def random_effects(values: Array, variances: Array, freedom: float) -> RandomEffects:
    """Average estimates of several recordings.

    Args:
        values: (K, q) estimates; NaN where a recording gives none.
        variances: (K, q) their variances.
        freedom: Degrees of freedom of the variances.
    """
    known = np.isfinite(values) & np.isfinite(variances) & (variances > 0.0)
    count = known.sum(axis=0)

    # Cochran's Q, by the F distribution because the variances are estimated as well.
    squares, _, _ = _weighted_squares(values, variances, known, np.zeros(values.shape[1]))
    others = np.maximum(count - 1, 1)
    p = np.where(count > 1, scipy.special.fdtrc(others, freedom, squares / others), 1.0)
    share = np.maximum(1.0 - others / np.maximum(squares, others), 0.0)

    tau2 = between_variance(values, variances)
    scatter, mean, total = _weighted_squares(values, variances, known, tau2)
    mean = np.where(count > 0, mean, np.nan)
    variance = np.where(count > 0, 1.0 / np.where(count > 0, total, 1.0), np.inf)

    # Another recording, with the mean weight of the present ones. Its interval is not known with
    # fewer than three of them.
    enough = count > 2
    t = scipy.special.stdtrit(others, 0.5 + LEVEL / 2.0)
    new_variance = (1.0 + count) / np.where(enough, total, 1.0)
    reach = np.where(enough, t * np.sqrt(scatter / others * new_variance), np.inf)
    return RandomEffects(
        count=count,
        mean=mean,
        variance=variance,
        tau2=tau2,
        share=np.asarray(np.where(count > 1, share, 0.0)),
        p=p,
        prediction=np.column_stack([mean - reach, mean + reach]),
    )


def between_variance(values: Array, variances: Array) -> Array:
    """Variances between recordings, by the method of Paule & Mandel.

    Args:
        values: (K, q) estimates; NaN where a recording gives none.
        variances: (K, q) their variances.

    Returns:
        (q,) variances tau²; 0 where the variances explain the scatter.
    """
    known = np.isfinite(values) & np.isfinite(variances) & (variances > 0.0)
    expected = known.sum(axis=0) - 1
    tau2 = np.zeros(values.shape[1])
    moves = expected > 0

    for _ in range(MAX_NEWTON_STEPS):
        squares, mean, _ = _weighted_squares(values, variances, known, tau2)
        weights = _weights(variances, known, tau2)
        slope = np.sum(weights**2 * np.where(known, values - mean, 0.0) ** 2, axis=0)

        # Where the variances explain the scatter, tau² stays 0.
        moves = moves & (np.abs(squares - expected) > TAU_TOLERANCE * expected) & (slope > 0.0)
        step = np.where(moves, (squares - expected) / np.where(moves, slope, 1.0), 0.0)
        new = np.maximum(tau2 + step, 0.0)
        if (np.abs(new - tau2) <= TAU_TOLERANCE * new).all():
            break
        tau2 = new
    return tau2


def _weights(variances: Array, known: np.ndarray, tau2: Array) -> Array:
    """(K, q) weights of the estimates, zero where there is none."""
    total = np.where(known, variances, 1.0) + tau2
    return np.where(known, 1.0 / total, 0.0)


def _weighted_squares(
    values: Array, variances: Array, known: np.ndarray, tau2: Array
) -> tuple[Array, Array, Array]:
    """(q,) weighted squares of deviations, (q,) weighted means, and (q,) sums of the weights."""
    weights = _weights(variances, known, tau2)
    total = weights.sum(axis=0)
    finite = np.where(known, values, 0.0)
    mean = np.sum(weights * finite, axis=0) / np.where(total > 0.0, total, 1.0)
    squares = np.sum(weights * np.where(known, values - mean, 0.0) ** 2, axis=0)
    return squares, mean, total


# ---- several quantities at once


@dataclass(frozen=True, kw_only=True, eq=False)
class Information:
    """Knowledge about s unknowns, possibly in some directions only.

    Attributes:
        matrix: (s, s) information A.
        vector: (s,) information times estimate, `A theta`.
    """

    matrix: Array
    vector: Array

    def __add__(self, other: Information) -> Information:
        return Information(matrix=self.matrix + other.matrix, vector=self.vector + other.vector)

    def with_scatter(self, tau2: Array) -> Information:
        """Knowledge about the mean of recordings that scatter.

        The information is `(A^-1 + T)^-1 = A (1 + T A)^-1`, which exists for a singular A as well.

        Args:
            tau2: (s, s) covariance T between recordings.
        """
        if not tau2.any():
            return self
        left = np.eye(len(tau2)) + self.matrix @ tau2
        matrix = np.linalg.solve(left, self.matrix)
        vector = np.asarray(np.linalg.solve(left, self.vector), dtype=np.float64)
        return Information(matrix=0.5 * (matrix + matrix.T), vector=vector)


def total_of(parts: list[Information]) -> Information:
    """Add what several recordings say.

    Args:
        parts: At least one part.
    """
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total


def difference(parts: list[Information], tolerance: float) -> tuple[float, int]:
    """Sum of squares by which parts contradict each other, and its degrees of freedom.

    It is the increase of the weighted squares if all parts have the same unknowns. Directions about
    which at most one part knows anything contribute nothing. If the parts agree, it has a
    chi-squared distribution.

    Args:
        parts: The parts; their matrices have a common scale.
        tolerance: Eigenvalues below this number count as zero.
    """
    total = total_of(parts)
    squares, rank = 0.0, 0
    for part in parts:
        own, own_rank = _explained(part, tolerance)
        squares, rank = squares + own, rank + own_rank
    joint, joint_rank = _explained(total, tolerance)
    return max(squares - joint, 0.0), rank - joint_rank


def _explained(part: Information, tolerance: float) -> tuple[float, int]:
    """Squares `theta' A theta` at the estimate of a part, and the rank of its information."""
    eigenvalues, vectors = np.linalg.eigh(part.matrix)
    is_known = eigenvalues > tolerance
    along = vectors[:, is_known].T @ part.vector
    return float(np.sum(along**2 / eigenvalues[is_known])), int(is_known.sum())


# ---- distributions


def satterthwaite(share: Array, within: float, between: int | np.ndarray) -> Array:
    """Degrees of freedom of variances of two parts (Satterthwaite 1946).

    Args:
        share: (s,) share of the part between recordings, 0 to 1.
        within: Degrees of freedom of the part within recordings.
        between: Degrees of freedom of the part between recordings, one number or (s,).
    """
    share = np.clip(share, 0.0, 1.0)
    return np.asarray(1.0 / ((1.0 - share) ** 2 / within + share**2 / np.maximum(between, 1)))


def t_quantile(freedom: Array) -> Array:
    """Half widths of 95 % intervals of Student's distribution [standard deviations].

    Args:
        freedom: (s,) degrees of freedom.
    """
    return np.asarray(scipy.special.stdtrit(freedom, 0.5 + LEVEL / 2.0))


def f_tail(squares: float, dof: int, freedom: float) -> float:
    """Probability that a sum of squares is larger by chance; 1 where there is nothing to test.

    Args:
        squares: Sum of squares in units of its variances.
        dof: Its degrees of freedom.
        freedom: Degrees of freedom of the variances.
    """
    return float(scipy.special.fdtrc(dof, freedom, squares / dof)) if dof > 0 else 1.0
