"""Draws of the parameters from the uncertainty of an estimate, for domain randomisation.

The distribution is normal about the estimate, with its honest covariance (`honest_covariance.py`),
and truncated at the bounds. Inertias of whole bodies move along straight lines of their barycentric
coordinates, along which forces are linear, so that combinations that the recordings know well stay
known in the drawn robots. Combinations that only the CAD prior determines stay at the estimate.
Draws with an unphysical inertia are replaced: where whole inertias are parameters, by draws from
the distribution that is truncated at the inertias that no body has, a convex region of the
barycentric coordinates, and else by further draws.

Truncated draws are made by Gibbs sampling (Robert, Simulation of truncated normal variables,
Statistics and Computing, 1995) in coordinates in which the untruncated distribution is standard
normal. There, correlations slow nothing down, and without a bound in reach each sweep is an
independent draw. Every draw is the end of a chain of its own, so that the draws are independent.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.errors import MAX_SAMPLES, ExperimentError, first_ones, listed
from mjfim.experiment.arguments import checked
from mjfim.experiment.schema import ExperimentLike
from mjfim.experiment.system import System
from mjfim.identification.assessment.accuracy import inertia_combinations
from mjfim.identification.assessment.honest_covariance import honest_covariance
from mjfim.identification.assessment.robust_covariance import covariance_root
from mjfim.identification.linear_coordinates import unknown_bodies
from mjfim.model.inertia import BARYCENTRIC_DERIVATIVES, pseudo_inertia_of
from mjfim.records.estimate import Estimate, ParameterDraws
from mjfim.records.events import begin_stage

# Bounds farther from the mean than this are left out [standard deviations]; the probability beyond
# them is 1e-15.
REACH = 8.0

# Sweeps of a chain over all coordinates.
SWEEPS = 200

# Many chains with many matrices take fewer sweeps, so that about this number of matrices is
# factorised. The fewest sweeps are made in any case, because a chain has to forget its begin. They
# may exceed the number: 1000 draws of the whole inertias of seven bodies, with 76 coordinates, take
# 26.6 million matrices.
MAX_FACTORISED = 10_000_000
MIN_SWEEPS = 50

# Share of the way to a matrix that is not positive definite that one move may go.
INSIDE = 1.0 - 1e-6

# Eigenvalues of the correlation matrix below this share of the largest one count as zero.
RANK_TOLERANCE = 1e-12

# Coefficients of a bound below this share of the largest one do not limit a coordinate.
SMALLEST_COEFFICIENT = 1e-12


def draw_truncated_normal(
    mean: Array,
    covariance: Array,
    lower: Array,
    upper: Array,
    count: int,
    rng: np.random.Generator,
    *,
    matrices: Sequence[tuple[Array, Array]] = (),
) -> Array:
    """Draw from a normal distribution that is truncated at bounds.

    Args:
        mean: (p,) mean of the untruncated distribution, inside the bounds or on them.
        covariance: (p, p) covariance of the untruncated distribution; it may be singular.
        lower: (p,) lower bounds; may be infinite.
        upper: (p,) upper bounds; may be infinite.
        count: Number of draws n.
        rng: Source of random numbers.
        matrices: Symmetric matrices that are positive definite inside the bounds, each as the
            (d, d) matrix at the mean and its (p, d, d) derivatives by the variables; default: none.

    Returns:
        (n, p) draws inside the bounds.
    """
    factor = covariance_root(covariance, RANK_TOLERANCE)

    # Bounds within reach, as `normals @ z <= distance`, in standard deviations of their variable.
    std = np.linalg.norm(factor, axis=1)
    scale = np.where(std > 0.0, std, 1.0)
    unit = factor / scale[:, None]
    above, below = (upper - mean) / scale, (mean - lower) / scale
    is_above, is_below = (std > 0.0) & (above < REACH), (std > 0.0) & (below < REACH)
    normals = np.concatenate([unit[is_above], -unit[is_below]])
    distance = np.concatenate([above[is_above], below[is_below]])

    # Derivatives of the matrices by the coordinates z, in a basis in which each of them is the unit
    # matrix at z = 0. This removes the units of its rows and columns.
    cones = []
    for at_mean, slopes in matrices:
        inverse = np.linalg.inv(np.linalg.cholesky(at_mean))
        cones.append(inverse @ np.tensordot(factor.T, slopes, axes=1) @ inverse.T)

    if not len(distance) and not cones:
        z = rng.standard_normal((count, factor.shape[1]))
    else:
        z = np.zeros((count, factor.shape[1]))
        affordable = MAX_FACTORISED // max(z.size * len(cones), 1)
        for _ in range(int(np.clip(affordable, MIN_SWEEPS, SWEEPS))):
            _sweep(z, normals, distance, cones, rng)

    # Rounding may exceed a bound.
    return np.clip(mean + z @ factor.T, lower, upper)


def _sweep(
    z: Array, normals: Array, distance: Array, cones: Sequence[Array], rng: np.random.Generator
) -> None:
    """Draw every coordinate anew, given the others.

    Args:
        z: (n, k) present points of the chains, which are changed in place.
        normals: (m, k) coefficients of the bounds of single variables.
        distance: (m,) their distances from the mean, not negative.
        cones: (k, d, d) derivatives of each matrix by the coordinates.
        rng: Source of random numbers.
    """
    room = distance - z @ normals.T
    matrices = [np.eye(cone.shape[1]) + np.tensordot(z, cone, axes=1) for cone in cones]
    for i in range(z.shape[1]):
        g, before = normals[:, i], np.array(z[:, i])
        room = room + before[:, None] * g

        # The present value is inside the bounds but for rounding.
        rises, falls = g > SMALLEST_COEFFICIENT, g < -SMALLEST_COEFFICIENT
        high = np.min(room[:, rises] / g[rises], axis=1, initial=np.inf)
        low = np.max(room[:, falls] / g[falls], axis=1, initial=-np.inf)
        high, low = np.maximum(high, before), np.minimum(low, before)

        # Moves until a matrix is no longer positive definite.
        for cone, at in zip(cones, matrices, strict=True):
            inverse = np.linalg.inv(np.linalg.cholesky(at))
            eigenvalues = np.linalg.eigvalsh(inverse @ cone[i] @ inverse.transpose(0, 2, 1))
            with np.errstate(divide="ignore"):
                low = np.maximum(low, before - INSIDE / np.maximum(eigenvalues[:, -1], 0.0))
                high = np.minimum(high, before + INSIDE / np.maximum(-eigenvalues[:, 0], 0.0))

        z[:, i] = _draw_between(low, high, rng)
        for cone, at in zip(cones, matrices, strict=True):
            at += (z[:, i] - before)[:, None, None] * cone[i]
        room = room - z[:, i : i + 1] * g


def _draw_between(low: Array, high: Array, rng: np.random.Generator) -> Array:
    """(n,) draws from the standard normal distribution between bounds: (n,) each."""
    # The distribution function has all digits in the lower tail only, so that intervals in the
    # upper half are mirrored.
    is_mirrored = high > -low
    begin = np.where(is_mirrored, -high, low)
    end = np.where(is_mirrored, -low, high)

    p_begin, p_end = scipy.special.ndtr(begin), scipy.special.ndtr(end)
    u = rng.random(len(low))
    drawn = np.clip(scipy.special.ndtri(p_begin + u * (p_end - p_begin)), begin, end)
    return np.asarray(np.where(is_mirrored, -drawn, drawn))


# Number of times that draws with an unphysical inertia are replaced before the search for physical
# ones is given up.
MAX_ROUNDS = 200


@checked
def draw_parameters(
    experiment: ExperimentLike, estimate: Estimate, count: int, rng: np.random.Generator
) -> ParameterDraws:
    """Draw robots that are compatible with an estimate, for domain randomisation.

    Args:
        experiment: The experiment that was identified; after a selection of terms,
            `mjfim.selected_experiment(experiment, estimate.selection)`.
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
            "mjfim.selected_experiment(experiment, estimate.selection)"
        )

    # Deviations of the initial state belong to a recording, not to the robot.
    drawn = np.flatnonzero(~system.parameters.initial_deviations)
    covariance = honest_covariance(system.parameters, estimate)[np.ix_(drawn, drawn)]
    undetermined = [names[j] for j in drawn[~np.isfinite(np.diag(covariance))]]
    if undetermined:
        raise ExperimentError(
            f"the recordings do not determine {listed(undetermined)}, so that there is no "
            "uncertainty from which robots could be drawn; state a `prior`, or fix the parameter "
            "by leaving it out of the experiment"
        )

    lower, upper = system.parameters.lower[drawn], system.parameters.upper[drawn]
    centre = np.array(estimate.theta)
    for name, of_recordings in estimate.per_recording.items():
        centre[names.index(name)] = np.mean(of_recordings)
    centre = centre[drawn]
    outside = [names[j] for j in drawn[(centre < lower) | (centre > upper)]]
    if outside:
        raise ExperimentError(
            f"the estimate of {listed(outside)} lies outside of its bounds, inside which robots "
            "are drawn; identify with the method least_squares, which keeps bounds"
        )

    found, held = None, 0
    if len(estimate.data) == len(names):
        found = inertia_combinations(system.parameters, estimate.theta, estimate.data)
    if found is not None and not found[1].all():
        # The distribution given that combinations stay as they are which only the CAD prior
        # determines. What is known of sums, such as a moment of inertia and the armature of its
        # joint, is known of the parameters that are still drawn. Roots orthogonal to the
        # combinations lose no digits of it.
        columns, is_determined, axes = found
        held = int(np.sum(~is_determined))
        root = covariance_root(covariance)
        of_inertias = root[np.searchsorted(drawn, columns)]
        _, _, directions = np.linalg.svd(np.linalg.inv(axes)[~is_determined] @ of_inertias)
        kept = root @ directions[held:].T
        covariance = kept @ kept.T
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
        held_combinations=held,
    )


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
    bodies = unknown_bodies(system.parameters)
    start = np.array(estimate.theta)
    start[drawn] = centre

    # Pseudo-inertias are linear in the barycentric coordinates, and these in the draws. Bodies that
    # are not physical at the centre do not bound the draws.
    physical = []
    for body in bodies:
        begin = start[body.columns]
        linear = body.linear(begin)
        if body.is_physical(linear):
            slopes = np.zeros((len(start), *BARYCENTRIC_DERIVATIVES.shape[1:]))
            by_draws = body.linear_slopes(begin)
            slopes[body.columns] = np.tensordot(by_draws, BARYCENTRIC_DERIVATIVES, axes=1)
            physical.append((pseudo_inertia_of(linear), slopes[drawn]))
    values = np.zeros((count, len(drawn)))
    missing = np.arange(count)
    replaced = 0

    for attempt in range(MAX_ROUNDS):
        # Most inertias are known well, so that hardly any draw is unphysical. Only where one is,
        # draws are made inside the physical region, which takes longer.
        matrices = physical if attempt else []
        if matrices:
            begin_stage("drawing robots inside the physical inertias")
        tried = draw_truncated_normal(
            centre, covariance, lower, upper, len(missing), rng, matrices=matrices
        )
        is_physical = np.zeros(len(missing), dtype=bool)
        for row, i in enumerate(missing):
            theta = np.array(start)
            theta[drawn] = tried[row]
            # Inertias move along straight lines of their barycentric coordinates.
            for body in bodies:
                begin = start[body.columns]
                step = theta[body.columns] - begin
                if not body.is_physical_after(begin, step):
                    break
                theta[body.columns] = body.moved(begin, step)
            else:
                if not system.impossible(theta):
                    values[i], is_physical[row] = theta[drawn], True
        missing = missing[~is_physical]
        if not len(missing):
            return values, replaced
        replaced += len(missing)

    raise ExperimentError(
        f"{len(missing)} of {count} drawn robots still had an unphysical inertia after they had "
        f"been replaced {MAX_ROUNDS} times; the recordings determine the inertias too poorly. "
        "State them as a whole (`inertial`) with a `cad_prior`, or with a narrower `prior`"
    )
