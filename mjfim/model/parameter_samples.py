"""Samples of the parameters from their priors or bounds."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from scipy.special import ndtri
from scipy.stats import qmc

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.model.parameters import ParameterSet

HALVINGS = 20  # of a sample's distance from the guess, until its bodies can exist
SAME_SIGN = 0.05  # least share of a scalar's value that a normal sample keeps


def sample_parameters(
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
    p, outside = len(parameters), parameters.outside_model
    stated = [
        q.prior is not None or bool(np.isfinite(q.bounds).all()) for q in parameters.parameters
    ]
    free = [j for j in range(p) if stated[j] and not outside[j]]
    if not free:
        raise ExperimentError(
            "robust: no parameter has a prior or bounds to sample from; state `prior` or `bounds`"
        )
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
