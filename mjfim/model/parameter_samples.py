"""Samples of the parameters from their priors or bounds."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.model.parameters import Parameter, ParameterSet

# Largest deviation of a sample from the centre of its prior [standard deviations].
MAX_DEVIATION = 2.5

# Number of times that the distance of a sample from the guess is halved until its bodies are
# physical; then it is set to zero.
MAX_HALVINGS = 20

# A sample of the prior of a scalar is at least this share of the scalar's value, so that it does
# not change its sign.
MIN_SHARE_OF_VALUE = 0.05


def sample_parameters(
    parameters: ParameterSet,
    theta: Array,
    count: int,
    seed: int,
    unphysical: Callable[[Array], Sequence[int]] | None = None,
) -> Array:
    """Sample the parameters from their priors or bounds.

    The first sample is theta; the others form a Latin hypercube over normal priors or, without a
    prior, uniformly over the bounds. Samples of a prior stay within the bounds and within 2.5
    standard deviations, and do not change the sign of a scalar (a mass, a damping). Parameters with
    neither prior nor bounds, and those outside the model, stay at theta. Where bodies of a sample
    are unphysical, the distance of the parameters that determine them from theta is halved until
    they are physical.

    Args:
        parameters: The parameters.
        theta: (p,) values about which priors are centred.
        count: Number of samples, theta included.
        seed: Seed of the random numbers.
        unphysical: Gives for a sample (p,) the indices of the parameters that determine unphysical
            bodies; None for no check.

    Returns:
        (count, p) samples.

    Raises:
        ExperimentError: No parameter has a prior or bounds.
    """
    free = [
        j
        for j, parameter in enumerate(parameters.parameters)
        if _has_distribution(parameter) and not parameters.outside_model[j]
    ]
    if not free:
        raise ExperimentError(
            "robust: no parameter has a prior or bounds to sample from; state `prior` or `bounds`"
        )

    samples = np.tile(theta, (count, 1))
    if count > 1:
        generator = np.random.default_rng(seed)
        quantiles = scipy.stats.qmc.LatinHypercube(len(free), rng=generator).random(count - 1)
        for column, j in enumerate(free):
            parameter = parameters.parameters[j]
            samples[1:, j] = _values(parameter, float(theta[j]), quantiles[:, column])

    if unphysical is not None:
        for sample in samples[1:]:
            make_physical(sample, theta, unphysical)
    return samples


def _has_distribution(parameter: Parameter) -> bool:
    """Whether a parameter has a prior or finite bounds."""
    return parameter.prior is not None or bool(np.isfinite(parameter.bounds).all())


def _values(parameter: Parameter, value: float, quantiles: Array) -> Array:
    """Values of a parameter (n,) at quantiles (n,) of its distribution about a value."""
    low, high = parameter.bounds
    if parameter.prior is None:
        return np.asarray(low + (high - low) * quantiles)

    # A parameter whose magnitude is that of its guess is a scalar, which keeps its sign.
    is_scalar = parameter.size == abs(parameter.guess)
    if is_scalar and value > 0.0:
        low = max(low, MIN_SHARE_OF_VALUE * value)
    elif is_scalar and value < 0.0:
        high = min(high, MIN_SHARE_OF_VALUE * value)

    deviations = np.clip(scipy.special.ndtri(quantiles), -MAX_DEVIATION, MAX_DEVIATION)
    return np.asarray(np.clip(value + parameter.prior * deviations, low, high))


def make_physical(
    sample: Array, theta: Array, unphysical: Callable[[Array], Sequence[int]]
) -> None:
    """Move a sample in place towards theta until its bodies are physical.

    Args:
        sample: (p,) parameters, which are changed.
        theta: (p,) parameters of physical bodies.
        unphysical: Gives for a sample the indices of the parameters that determine unphysical
            bodies.
    """
    for _ in range(MAX_HALVINGS):
        columns = list(unphysical(sample))
        if not columns:
            return
        sample[columns] = 0.5 * (sample[columns] + theta[columns])

    while columns := list(unphysical(sample)):
        # A sample at theta cannot be moved any closer.
        if np.array_equal(sample[columns], theta[columns]):
            return
        sample[columns] = theta[columns]
