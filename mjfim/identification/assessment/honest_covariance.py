"""One covariance of all parameters that agrees with the intervals of single ones.

It begins with the robust covariance of a fit (`robust_covariance.py`), which is right for
combinations of parameters, and adds what the intervals contain besides:

- the scatter between recordings that disagree;
- the estimates over other lengths of segments that chance does not explain;
- the scatter of the estimates without each part of the data, where terms were selected.

All of them are added as the vectors that they are, so that a combination which does not change from
one recording, length or part to the next stays as well known as it is. At last, the variances of
single parameters are stretched or shrunk to those of the intervals, with the distribution of all
other parameters given this one as it is: of all normal distributions with the wanted variance, this
one has the least Kullback-Leibler divergence (Csiszár, I-divergence geometry of probability
distributions, Annals of Probability, 1975).

The covariance contains neither the error of a model that lacks a term nor that of held parameters.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mjfim.arrays import NORMAL_95, Array
from mjfim.identification.assessment.robust_covariance import (
    Uncertainty,
    covariance_root,
    covering_covariance,
    t_quantile,
)
from mjfim.model.parameters import ParameterSet
from mjfim.records.estimate import Estimate, HorizonStudy


def jackknife_deviations(without_parts: Array) -> Array:
    """(K, p) deviations whose sum of squares is the variance; zero with fewer than two parts.

    Args:
        without_parts: (K, p) estimates without each of K parts of the data [theta-unit].
    """
    K = len(without_parts)
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


# Distance of the end of an interval from a bound, relative to the width of the interval, at which
# the bound has cut the interval off.
CUT_OFF = 1e-9

# Standard deviations that exceed those of the intervals by at most this share are left as they are.
# Quantiles of a bootstrap scatter by as much.
AGREEMENT = 0.1


# ---- the covariance of an estimate


def honest_covariance(parameters: ParameterSet, estimate: Estimate) -> Array:
    """(p, p) covariance of an estimate, for draws of robots and as prior knowledge.

    It is that of the estimate; of estimates of earlier versions, which have none, the formal one
    with the standard deviations of the intervals. Parameters that differ between recordings also
    scatter as they do between them.

    Args:
        parameters: The parameters that were identified.
        estimate: The estimate.

    Returns:
        The covariance [products of theta-units]; infinite on the diagonal where a parameter is not
        determined.
    """
    covariance = np.array(estimate.honest_covariance)
    if len(covariance) != len(estimate.parameters):
        covariance = stretched_formal_covariance(estimate, interval_std(parameters, estimate))

    for name, values in estimate.per_recording.items():
        if len(values) > 1:
            j = estimate.parameters.index(name)
            covariance[j, j] += np.var(values, ddof=1)
    return covariance


def with_honest_covariance(
    estimate: Estimate,
    parameters: ParameterSet,
    covariance: Array | None = None,
    without_parts: Array | None = None,
) -> Estimate:
    """The estimate with a covariance that agrees with its intervals.

    Args:
        estimate: The estimate, with its intervals.
        parameters: Its parameters.
        covariance: (p, p) covariance of the fit, infinite on the diagonal where a parameter is not
            determined; default: the honest covariance that the estimate has.
        without_parts: (K, p) estimates without each part of the data, whose scatter is part of the
            intervals [theta-unit]; default: none.
    """
    found = np.array(estimate.honest_covariance if covariance is None else covariance)
    if len(found) != len(estimate.parameters):
        return estimate

    std = interval_std(parameters, estimate)
    std[parameters.initial_deviations] = np.nan
    known = np.flatnonzero(np.isfinite(np.diag(found)))
    place = np.ix_(known, known)
    inner = found[place]
    if covariance is not None and estimate.horizons is not None:
        inner = _covering(inner, _differences(inner, estimate.horizons, known))
    if without_parts is not None and len(without_parts) > 1:
        # Deviations between the parts of the data, by Student's factor, like the intervals.
        factor = t_quantile(len(without_parts) - 1) / NORMAL_95
        inner = _covering(inner, factor * jackknife_deviations(without_parts)[:, known])
    found[place] = agreeing_covariance(inner, std[known])
    return replace(estimate, honest_covariance=found)


def interval_std(parameters: ParameterSet, estimate: Estimate) -> Array:
    """(p,) standard deviations of normal distributions with the 95 % intervals [theta-unit].

    An end of an interval that a bound cuts off says nothing about the width, so that the other side
    counts there.

    Args:
        parameters: The parameters that were identified.
        estimate: The estimate.
    """
    low, high = estimate.interval.T
    below, above = estimate.theta - low, high - estimate.theta
    width = high - low
    tolerance = CUT_OFF * np.where(np.isfinite(width), width, 0.0)
    is_cut_below = low <= parameters.lower + tolerance
    is_cut_above = high >= parameters.upper - tolerance

    # Half of the width, and the longer side where a bound has cut the other one off. Where bounds
    # have cut both, the interval says nothing, and the deviations that led to it remain.
    half_width = np.where(is_cut_below | is_cut_above, np.maximum(below, above), 0.5 * width)
    robust = np.hypot(estimate.std_sandwich, estimate.between_recordings)
    return np.asarray(np.maximum(half_width / NORMAL_95, np.maximum(estimate.std, robust)))


def stretched_formal_covariance(estimate: Estimate, std: Array) -> Array:
    """(p, p) covariance with given standard deviations and the correlations of the formal one.

    It is too wide or too narrow for combinations of strongly correlated parameters, and serves for
    estimates of earlier versions alone.

    Args:
        estimate: The estimate.
        std: (p,) standard deviations [theta-unit]; infinite where a parameter is not determined.
    """
    # A parameter that the fit holds has no correlation with the others.
    formal = np.sqrt(np.diag(estimate.covariance))
    is_known = np.isfinite(formal) & (formal > 0.0) & np.isfinite(std)
    scale = np.where(is_known, std, 0.0) / np.where(is_known, formal, 1.0)
    shared = np.where(np.isfinite(estimate.covariance), estimate.covariance, 0.0)
    covariance = scale[:, None] * shared * scale
    np.fill_diagonal(covariance, std**2)
    return np.asarray(covariance)


# ---- its parts


def between_covariance(robust: Uncertainty) -> Array:
    """(c, c) covariance between recordings of the common unknowns on which they disagree.

    Variances are those of the uncertainty. Correlations are those of the estimates from single
    recordings. K recordings show K - 1 directions at most, so that a share of 1/K is taken as
    uncorrelated.

    Args:
        robust: The robust uncertainty of the common unknowns.
    """
    covariance = np.diag(robust.between**2)
    apart = np.array(robust.apart, dtype=np.intp)
    each = robust.each[:, apart]
    each = each[np.isfinite(each).all(axis=1)]
    count = len(each)
    if len(apart) < 2 or count < 2:
        return covariance

    deviation = each - each.mean(axis=0)
    sizes = np.linalg.norm(deviation, axis=0)
    directions = deviation / np.where(sizes > 0.0, sizes, 1.0)
    correlation = (1.0 - 1.0 / count) * (directions.T @ directions)
    np.fill_diagonal(correlation, 1.0)
    between = robust.between[apart]
    covariance[np.ix_(apart, apart)] = between[:, None] * correlation * between
    return covariance


def agreeing_covariance(covariance: Array, std: Array) -> Array:
    """Covariance whose standard deviations are those of the intervals of single parameters.

    None of them is smaller. They are at most by `AGREEMENT` larger, but where a wider interval of a
    correlated parameter widens this one as well, because a combination of both is known.

    Args:
        covariance: (p, p) covariance.
        std: (p,) standard deviations; 0 for parameters that are held, NaN where any will do.

    Returns:
        (p, p) covariance.
    """
    size = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    is_wanted = np.isfinite(std) & (std > 0.0)
    is_moving = is_wanted & (size > 0.0)
    root = covariance_root(covariance)
    root[std == 0.0] = 0.0

    # A factor that all variances have in common changes no correlation.
    excess = size[is_moving] / std[is_moving]
    root /= max(float(excess.min(initial=np.inf)), 1.0) if len(excess) else 1.0

    # Shrinking first: each step also shrinks or stretches the others, but never the other way.
    for j in np.flatnonzero(is_moving).tolist():
        _stretch(root, j, min((1.0 + AGREEMENT) * std[j] / np.linalg.norm(root[j]), 1.0))
    for j in np.flatnonzero(is_moving).tolist():
        _stretch(root, j, max(std[j] / np.linalg.norm(root[j]), 1.0))

    # Parameters about which the covariance says nothing are uncorrelated.
    return root @ root.T + np.diag(np.where(is_wanted & ~is_moving, std, 0.0) ** 2)


def _stretch(root: Array, j: int, factor: float) -> None:
    """Multiply the standard deviation of one parameter, the others given it staying as they are.

    Args:
        root: (p, k) factor A of the covariance `A A'`, which is changed in place.
        j: Index of the parameter.
        factor: The factor.
    """
    axis = root[j] / np.linalg.norm(root[j])
    root += (factor - 1.0) * np.outer(root @ axis, axis)


def _covering(covariance: Array, deviations: Array) -> Array:
    """(p, p) covariance that covers another one and deviations: (n, p), [theta-unit]."""
    if not deviations.any():
        return covariance
    return covering_covariance(covariance, deviations.T @ deviations)


def _differences(covariance: Array, study: HorizonStudy, known: np.ndarray) -> Array:
    """(n, k) differences of estimates over other lengths that chance does not explain.

    Intervals hold these estimates, so that they are as far as the end of an interval. Parameters
    whose differences chance does explain follow the others as their correlation tells.

    Args:
        covariance: (k, k) covariance of the determined parameters.
        study: The comparison of lengths.
        known: (k,) indices in theta of the determined parameters.
    """
    root = covariance_root(covariance)
    apart = np.asarray(study.is_apart, dtype=bool)[:, known]
    differences = (study.theta - study.theta[study.chosen])[:, known] / NORMAL_95
    return np.array(
        [
            root @ (np.linalg.pinv(root[is_apart]) @ difference[is_apart])
            for is_apart, difference in zip(apart, differences, strict=True)
        ]
    )
