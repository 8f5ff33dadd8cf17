"""Scatter of the estimates without each part of the data, which gives their variance.

It contains what differs between the parts of the data, also what no model explains. Source: Efron
and Stein, The jackknife estimate of variance, Annals of Statistics, 1981.
"""

from __future__ import annotations

import numpy as np
import scipy

from mjfim.arrays import Array


def jackknife_deviations(without_parts: Array) -> Array:
    """(K, p) deviations whose sum of squares is the variance; zero with fewer than two parts.

    Args:
        without_parts: (K, p) estimates without each of K parts of the data [theta-unit].
    """
    K = len(without_parts)
    if K < 2:
        return np.zeros_like(without_parts)
    scatter = without_parts - without_parts.mean(axis=0)
    return np.asarray(np.sqrt((K - 1) / K) * scatter)


def jackknife_std(without_parts: Array) -> Array:
    """(p,) standard errors of the estimates [theta-unit]; NaN with fewer than two parts.

    Args:
        without_parts: (K, p) estimates without each of K parts of the data [theta-unit].
    """
    if len(without_parts) < 2:
        return np.full(without_parts.shape[1], np.nan)
    return np.asarray(np.linalg.norm(jackknife_deviations(without_parts), axis=0))


def student_quantile(parts: int, confidence: float) -> float:
    """Half width of an interval in standard errors that K parts have given.

    Args:
        parts: Number K of parts, at least 2.
        confidence: Probability that the interval holds the true value.
    """
    return float(scipy.special.stdtrit(parts - 1, 0.5 + 0.5 * confidence))
