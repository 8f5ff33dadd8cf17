"""Robust design: the guess is wrong by assumption, so phi is pooled over samples of the parameters.

mean    1/S sum_s phi_s
worst   (1/S sum_s phi_s^q)^(1/q), a smooth maximum; for D-optimality, whose phi is a logarithm, log-mean-exp of q phi
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import logsumexp, ndtri
from scipy.stats import qmc

from mjfim.errors import ExperimentError
from mjfim.parameters import ParameterSet
from mjfim.trajectory import Array

SHARPNESS = 20.0
HALVINGS = 20  # of a sample's distance from the guess, until its bodies can exist
SAME_SIGN = 0.05  # least share of a scalar's value that a normal sample keeps


@dataclass(frozen=True, eq=False)
class Pool:
    """How phi at several parameter values becomes one number.

    thetas: (S, p), the guess first;  over: mean or worst;  logarithmic: True for D-optimality
    """

    thetas: Array
    over: Literal["mean", "worst"]
    logarithmic: bool = False

    def value(self, phi: Sequence[float]) -> float:
        """The pooled criterion; infinite where one of them is."""
        values = np.asarray(phi, dtype=np.float64)
        if not np.isfinite(values).all():
            return np.inf
        if self.over == "mean":
            return float(values.mean())
        if self.logarithmic:
            return float((logsumexp(SHARPNESS * values) - np.log(len(values))) / SHARPNESS)
        top = values.max()
        return float(top * np.mean((values / top) ** SHARPNESS) ** (1.0 / SHARPNESS))

    def weights(self, phi: Sequence[float]) -> Array:
        """(S,) derivative of the pooled criterion by each phi."""
        values = np.asarray(phi, dtype=np.float64)
        if self.over == "mean":
            return np.full(len(values), 1.0 / len(values))
        if self.logarithmic:
            return np.asarray(np.exp(SHARPNESS * values - logsumexp(SHARPNESS * values)))
        pooled = self.value(phi)
        return np.asarray((values / pooled) ** (SHARPNESS - 1.0) / len(values))


def sampled(
    parameters: ParameterSet,
    theta: Array,
    count: int,
    seed: int,
    impossible: Callable[[Array], Sequence[int]] | None = None,
) -> Array:
    """(count, p) parameter values: theta itself, then a Latin hypercube over the priors (normal) or the bounds (uniform).

    Normal samples keep within the bounds, within 2.5 standard deviations, and do not change the sign of a scalar (a mass, a
    damping). Parameters with neither prior nor bounds, and those outside the model, stay at theta; raises ExperimentError
    where that holds for all. Where bodies of a sample cannot exist, the parameters that make them go half of their way back
    to theta, again and again (at most `HALVINGS` times, then all the way).

    impossible: indices of the parameters that make bodies which cannot exist; nobody looks where it is left out
    """
    p, outside = len(parameters), parameters.outside
    stated = [q.prior is not None or bool(np.isfinite(q.bounds).all()) for q in parameters.parameters]
    free = [j for j in range(p) if stated[j] and not outside[j]]
    if not free:
        raise ExperimentError("robust: no parameter has a prior or bounds to sample from; state `prior` or `bounds`")
    out = np.tile(theta, (count, 1))
    if count > 1:
        u = qmc.LatinHypercube(len(free), rng=np.random.default_rng(seed)).random(count - 1)
        for column, j in enumerate(free):
            q = parameters.parameters[j]
            low, high = q.bounds
            if q.prior is not None:
                drawn = theta[j] + q.prior * np.clip(ndtri(u[:, column]), -2.5, 2.5)
                if q.size == abs(q.guess) and theta[j] > 0.0:
                    low = max(low, SAME_SIGN * theta[j])
                elif q.size == abs(q.guess) and theta[j] < 0.0:
                    high = min(high, SAME_SIGN * theta[j])
                out[1:, j] = np.clip(drawn, low, high)
            else:
                out[1:, j] = low + (high - low) * u[:, column]
    if impossible is not None:
        for row in out[1:]:
            _tame(row, theta, impossible)
    return out


def _tame(sample: Array, theta: Array, impossible: Callable[[Array], Sequence[int]]) -> None:
    """Move a sample: (p,) in place towards theta: (p,) until its bodies can exist."""
    columns: list[int] = []
    for _ in range(HALVINGS):
        columns = list(impossible(sample))
        if not columns:
            return
        sample[columns] = 0.5 * (sample[columns] + theta[columns])
    while columns := list(impossible(sample)):
        if np.array_equal(sample[columns], theta[columns]):
            return
        sample[columns] = theta[columns]
