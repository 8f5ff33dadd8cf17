"""Draws of the parameters from the uncertainty of an estimate, for domain randomisation.

The distribution is normal about the estimate and truncated at the bounds. Its standard deviations
are those of the 95 % intervals, which also cover autocorrelated residuals and recordings that
disagree; its correlations are those of the formal covariance. Draws with an unphysical inertia are
replaced.
"""

from __future__ import annotations

import numpy as np
import scipy

from mjfim.amounts import MAX_SAMPLES
from mjfim.arrays import Array
from mjfim.errors import ExperimentError, first_ones, listed
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.truncated_normal import draw_truncated_normal
from mjfim.model.targets import ModelField
from mjfim.records.estimate import Estimate
from mjfim.records.parameter_draws import ParameterDraws

# Half width of the 95 % interval of a normal distribution [standard deviations].
HALF_WIDTH = float(scipy.special.ndtri(0.975))

# Distance of the end of an interval from a bound, relative to the width of the interval, at which
# the bound has cut the interval off.
CUT_OFF = 1e-9

# Number of times that draws with an unphysical inertia are replaced before the search for physical
# ones is given up.
MAX_ROUNDS = 50


def draw_parameters(
    experiment: Experiment, estimate: Estimate, count: int, rng: np.random.Generator
) -> ParameterDraws:
    """Draw robots that are compatible with an estimate, for domain randomisation.

    Args:
        experiment: The experiment that was identified; with added terms,
            `experiment.replace(parameters=estimate.selection.parameters)`.
        estimate: The estimate.
        count: Number of robots, from 1 to 10 000.
        rng: Source of random numbers.

    Returns:
        The draws, which keep the bounds and have physical inertias.

    Raises:
        ExperimentError: The count is out of range, the estimate is not one of this experiment, the
            recordings leave a parameter undetermined, or hardly any draw is physical.
    """
    return draw_parameters_system(System.resolve(experiment), estimate, count, rng)


def draw_parameters_system(
    system: System, estimate: Estimate, count: int, rng: np.random.Generator
) -> ParameterDraws:
    """Draw robots that are compatible with an estimate of a resolved system.

    Args:
        system: The system that was identified, with the terms that a selection has added.
        estimate: The estimate.
        count: Number of robots, from 1 to 10 000.
        rng: Source of random numbers.

    Returns:
        The draws, which keep the bounds and have physical inertias.

    Raises:
        ExperimentError: See `draw_parameters`.
    """
    if not 1 <= count <= MAX_SAMPLES:
        raise ExperimentError(
            f"the number of drawn robots is {count}; it must be from 1 to {MAX_SAMPLES}"
        )

    names = system.parameters.names
    if names != estimate.parameters:
        raise ExperimentError(
            f"the estimate is one of other parameters ({first_ones(estimate.parameters)}) than the "
            f"experiment ({first_ones(names)}); after a selection of terms, use "
            "experiment.replace(parameters=estimate.selection.parameters)"
        )

    # Deviations of the initial state belong to a recording, not to the robot.
    drawn = np.flatnonzero(~system.parameters.initial_deviations)
    covariance = honest_covariance(system, estimate)[np.ix_(drawn, drawn)]
    undetermined = [names[j] for j in drawn[~np.isfinite(np.diag(covariance))]]
    if undetermined:
        raise ExperimentError(
            f"the recordings do not determine {listed(undetermined)}, so that there is no "
            "uncertainty from which robots could be drawn; state a `prior`, or fix the parameter "
            "by leaving it out of the experiment"
        )

    lower, upper = system.parameters.lower[drawn], system.parameters.upper[drawn]
    centre = _centre(estimate)[drawn]
    outside = [names[j] for j in drawn[(centre < lower) | (centre > upper)]]
    if outside:
        raise ExperimentError(
            f"the estimate of {listed(outside)} lies outside of its bounds, inside which robots "
            "are drawn; identify with the method least_squares, which keeps bounds"
        )

    values, replaced = _physical_draws(
        system, estimate, drawn, centre, covariance, count=count, rng=rng
    )
    return ParameterDraws(
        parameters=tuple(names[j] for j in drawn),
        units=tuple(system.units[j] for j in drawn),
        values=values,
        centre=centre,
        std=np.sqrt(np.diag(covariance)),
        replaced=replaced,
    )


def complete_theta(system: System, estimate: Estimate, draws: ParameterDraws, robot: int) -> Array:
    """Parameters of a drawn robot, with deviations of the initial state as estimated.

    Args:
        system: The system that was identified.
        estimate: The estimate.
        draws: Draws from its uncertainty.
        robot: Index of the robot.

    Returns:
        (p,) values [theta-unit].
    """
    theta = np.array(estimate.theta)
    theta[~system.parameters.initial_deviations] = draws.values[robot]
    return theta


def honest_covariance(system: System, estimate: Estimate) -> Array:
    """(p, p) covariance with the standard deviations that the 95 % intervals stand for.

    An end of an interval that a bound cuts off says nothing about the width, so that the other side
    counts there. Parameters that differ between recordings also scatter as they do between them.
    The correlations are those of the formal covariance.

    Args:
        system: The system that was identified.
        estimate: The estimate.

    Returns:
        The covariance [products of theta-units]; infinite on the diagonal where a parameter is not
        determined.
    """
    std = _honest_std(system, estimate)
    for name, values in estimate.per_recording.items():
        if len(values) > 1:
            j = estimate.parameters.index(name)
            std[j] = np.hypot(std[j], np.std(values, ddof=1))

    # A parameter that the fit holds has no correlation with the others.
    formal = np.sqrt(np.diag(estimate.covariance))
    is_known = np.isfinite(formal) & (formal > 0.0)
    scale = np.where(is_known, 1.0 / np.where(is_known, formal, 1.0), 0.0)
    shared = np.where(np.isfinite(estimate.covariance), estimate.covariance, 0.0)
    correlation = scale[:, None] * shared * scale
    np.fill_diagonal(correlation, 1.0)

    is_finite = np.isfinite(std)
    finite = np.where(is_finite, std, 0.0)
    covariance = finite[:, None] * correlation * finite
    covariance[~is_finite, ~is_finite] = np.inf
    return np.asarray(covariance)


def _honest_std(system: System, estimate: Estimate) -> Array:
    """(p,) standard deviations of normal distributions with the 95 % intervals [theta-unit]."""
    low, high = estimate.interval.T
    below, above = estimate.theta - low, high - estimate.theta
    width = high - low
    tolerance = CUT_OFF * np.where(np.isfinite(width), width, 0.0)
    is_cut_below = low <= system.parameters.lower + tolerance
    is_cut_above = high >= system.parameters.upper - tolerance

    # Half of the width, and the longer side where a bound has cut the other one off. Where bounds
    # have cut both, the interval says nothing, and the deviations that led to it remain.
    half_width = np.where(is_cut_below | is_cut_above, np.maximum(below, above), 0.5 * width)
    robust = np.hypot(estimate.std_sandwich, estimate.between_recordings)
    return np.asarray(np.maximum(half_width / HALF_WIDTH, np.maximum(estimate.std, robust)))


def _centre(estimate: Estimate) -> Array:
    """(p,) estimates, with the means of parameters that differ between recordings."""
    centre = np.array(estimate.theta)
    for name, values in estimate.per_recording.items():
        centre[estimate.parameters.index(name)] = np.mean(values)
    return centre


def _physical_draws(
    system: System,
    estimate: Estimate,
    drawn: np.ndarray,
    centre: Array,
    covariance: Array,
    *,
    count: int,
    rng: np.random.Generator,
) -> tuple[Array, int]:
    """(n, q) draws with physical inertias, and the number of draws that were replaced.

    Args:
        system: The system that was identified.
        estimate: The estimate.
        drawn: (q,) indices in theta of the drawn parameters.
        centre: (q,) centre of the distribution.
        covariance: (q, q) its covariance before truncation.
        count: Number of draws n.
        rng: Source of random numbers.

    Raises:
        ExperimentError: Hardly any draw is physical.
    """
    lower, upper = system.parameters.lower[drawn], system.parameters.upper[drawn]
    values = np.zeros((count, len(drawn)))
    missing = np.arange(count)
    replaced = 0

    for _ in range(MAX_ROUNDS):
        values[missing] = draw_truncated_normal(centre, covariance, lower, upper, len(missing), rng)
        is_physical = [_is_physical(system, estimate, drawn, values[i]) for i in missing]
        missing = missing[~np.array(is_physical)]
        if not len(missing):
            return values, replaced
        replaced += len(missing)

    raise ExperimentError(
        f"{len(missing)} of {count} drawn robots still had an unphysical inertia after they had "
        f"been replaced {MAX_ROUNDS} times; the recordings determine the inertias too poorly. "
        'State them in the coordinates "logcholesky", which are physical for all values, or with '
        "a `prior`"
    )


def _is_physical(system: System, estimate: Estimate, drawn: np.ndarray, values: Array) -> bool:
    """Whether all bodies have physical inertias at drawn values: (q,) of the parameters `drawn`."""
    theta = np.array(estimate.theta)
    theta[drawn] = values
    if system.impossible(theta):
        return False

    # Principal moments that are parameters of their own need a test: of a rigid body, no moment
    # exceeds the sum of the others, and MuJoCo refuses an MJCF in which one does.
    bodies = _bodies_with_moments(system)
    if not bodies:
        return True
    moments = np.sort(system.model_at(theta).body_inertia[bodies], axis=1)
    return bool((moments[:, 2] <= moments[:, 0] + moments[:, 1]).all())


def _bodies_with_moments(system: System) -> list[int]:
    """Numbers of the bodies of which principal moments of inertia are parameters."""
    fields = [target.field for p in system.parameters.parameters for target in p.targets]
    moments = [f for f in fields if isinstance(f, ModelField) and f.array == "body_inertia"]
    return sorted({field.rows[0] for field in moments})
