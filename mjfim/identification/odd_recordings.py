"""Recordings that are odd: they differ from the mean of the others more than these scatter.

The scatter of the recording, that of the mean of the others, and the scatter between the others
count. The most significant recording is set aside, and the remaining ones are compared again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.identification.random_effects import (
    between_variance,
    difference,
    f_tail,
    random_effects,
    satterthwaite,
    total_of,
)
from mjfim.identification.recording_views import TOLERANCE, RecordingViews
from mjfim.records.robots import OddParameter, OddRecording

# Probability to name an odd recording where all are equal.
ODD_LEVEL = 0.01

# Corrected p-value up to which a parameter of an odd recording is named, and most of them.
NAMED_LEVEL, MAX_NAMED = 0.05, 3

# Fewest recordings among which one can be odd.
FEWEST = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class _Difference:
    """Difference of one recording from others.

    Attributes:
        index: Index of the recording.
        p: p-value, corrected for the number of tests of all recordings.
        each: (s,) p-values of single parameters, corrected likewise.
        others: (s,) mean of the others.
        others_std: (s,) its standard deviation, without the scatter between them.
    """

    index: int
    p: float
    each: Array
    others: Array
    others_std: Array


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
        worst = min((_left_out(views, k, remaining) for k in remaining), key=lambda each: each.p)
        if worst.p > ODD_LEVEL:
            break
        remaining.remove(worst.index)
        order = np.argsort(worst.each, kind="stable")[:MAX_NAMED]
        named = [
            OddParameter(
                name=parameters[j],
                unit=units[j],
                value=float(views.values[worst.index, j]),
                std=float(views.std[worst.index, j]),
                others=float(worst.others[j]),
                others_std=float(worst.others_std[j]),
                p=float(worst.each[j]),
                is_single=bool(is_single[j]),
            )
            for j in order
            if worst.each[j] <= NAMED_LEVEL
        ]
        found.append(
            OddRecording(
                index=worst.index,
                name=recordings[worst.index],
                p=worst.p,
                parameters=tuple(named),
            )
        )
    return found


def _left_out(views: RecordingViews, k: int, remaining: Sequence[int]) -> _Difference:
    """Test whether recording k differs from the other remaining ones."""
    others = [i for i in remaining if i != k]
    values, variances = views.values[others], views.std[others] ** 2
    tau2 = between_variance(values, variances)
    effects = random_effects(values, variances, views.freedom)

    # Single parameters, by Student's distribution. The scatter between the others is known from
    # few of them.
    gap = views.values[k] - effects.mean
    variance = views.std[k] ** 2 + effects.variance + tau2
    is_known = np.isfinite(gap) & np.isfinite(variance)
    variance = np.where(is_known, variance, 1.0)
    share = np.where(is_known, tau2 / variance, 0.0)
    freedom = satterthwaite(share, views.freedom, len(others) - 1)
    t = np.where(is_known, np.abs(gap), 0.0) / np.sqrt(variance)
    each = 2.0 * scipy.special.stdtr(freedom, -t)

    # All parameters together.
    scatter = views.scatter(tau2)
    parts = [views.parts[i].with_scatter(scatter) for i in others]
    squares, dof = difference([views.parts[k].with_scatter(scatter), total_of(parts)], TOLERANCE)
    mean_share = np.array([share[is_known].mean() if is_known.any() else 0.0])
    (joint_freedom,) = satterthwaite(mean_share, views.freedom, len(others) - 1)
    joint = f_tail(squares, dof, float(joint_freedom))

    # Two kinds of tests of every remaining recording.
    tests = 2.0 * len(remaining)
    each = np.minimum(tests * max(int(is_known.sum()), 1) * each, 1.0)
    p = min(tests * joint, float(each.min(initial=1.0)), 1.0)
    return _Difference(
        index=k, p=p, each=each, others=effects.mean, others_std=np.sqrt(effects.variance)
    )
