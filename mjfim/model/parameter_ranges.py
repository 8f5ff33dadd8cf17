"""Bounds that physics sets to parameters, which hold in every fit unless others are stated."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.model.control_laws import FIELDS as LAW_FIELDS
from mjfim.model.parameters import Parameter, ParameterSet, Target
from mjfim.model.paths import ParameterPath

# Fields that cannot be negative, by kind of element. Bodies are not among them: their masses and
# inertias are kept physical together, see `ParameterWriter.unphysical_bodies`.
NOT_NEGATIVE = {
    "joint": ("damping", "frictionloss", "armature", "stiffness"),
    "tendon": ("damping", "frictionloss", "armature", "stiffness"),
    "geom": ("mass", "density", "size", "friction"),
    "pair": ("friction",),
    "option": ("density", "viscosity"),
    "controller": tuple(name for name in LAW_FIELDS if name not in ("saturation", "integral")),
}


def physical_bounds(targets: Iterable[Target]) -> tuple[float, float]:
    """Range of a parameter in which all of its targets are physical.

    Args:
        targets: Numbers inside the model that the parameter sets, each to `scale * parameter +
            offset`.

    Returns:
        Lower and upper bound [parameter unit]; infinite where physics sets none.
    """
    low, high = -np.inf, np.inf
    for target in targets:
        # Values of the parameter at which the target is at its bounds.
        ends = [
            (bound - target.offset) / target.scale + 0.0 if np.isfinite(bound) else bound
            for bound in _bounds_of(target)
        ]
        if target.scale < 0.0:
            infinite = [-end if np.isinf(end) else end for end in ends]
            ends = infinite[::-1]
        low, high = max(low, ends[0]), min(high, ends[1])
    return low, high


def _bounds_of(target: Target) -> tuple[float, float]:
    """Smallest and largest physical value of a target [unit of the number]."""
    if target.term is not None:
        return target.term.bounds

    path = ParameterPath.parse(target.path)
    if path.field not in NOT_NEGATIVE.get(path.kind, ()):
        return -np.inf, np.inf

    # A coefficient of higher order may be negative while the whole force brakes: dry friction that
    # decreases with the speed has one.
    if path.kind == "joint" and path.component > 0:
        return -np.inf, np.inf
    return 0.0, np.inf


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
        if (parameter.prior is not None or np.isfinite(parameter.bounds).all())
        and not parameters.outside_model[j]
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
