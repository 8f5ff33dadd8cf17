"""Draws of the parameters from the uncertainty of an estimate, for domain randomisation.

The distribution is normal about the estimate, with its honest covariance
(`honest_covariance.py`), and truncated at the bounds. Inertias of whole bodies
move along straight lines of their barycentric coordinates, along which forces are linear, so that
combinations that the recordings know well stay known in the drawn robots. Combinations that only
the CAD prior determines stay at the estimate. Draws with an unphysical inertia are replaced: where
whole inertias are parameters, by draws from the distribution that is truncated at the inertias that
no body has, a convex region of the barycentric coordinates, and else by further draws.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import MAX_SAMPLES, ExperimentError, first_ones, listed
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.assessment.accuracy import InertiaCombinations
from mjfim.identification.assessment.honest_covariance import (
    covariance_root,
    honest_covariance,
)
from mjfim.identification.assessment.truncated_normal import MatrixBound, draw_truncated_normal
from mjfim.identification.linear_coordinates import UnknownBody, unknown_bodies
from mjfim.model.inertia import BARYCENTRIC_DERIVATIVES, pseudo_inertia_of
from mjfim.model.parameters import ParameterSet
from mjfim.model.targets import ModelField
from mjfim.records.estimate import Estimate, ParameterDraws
from mjfim.records.events import begin_stage

# Number of times that draws with an unphysical inertia are replaced before the search for physical
# ones is given up.
MAX_ROUNDS = 200


def draw_parameters(
    experiment: Experiment, estimate: Estimate, count: int, rng: np.random.Generator
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

    combinations = _undetermined(system.parameters, estimate, drawn)
    if len(combinations):
        # The distribution given that these combinations stay as they are. What is known of sums,
        # such as a moment of inertia and the armature of its joint, is known of the parameters that
        # are still drawn. Roots orthogonal to the combinations lose no digits of it.
        root = covariance_root(covariance)
        _, _, axes = np.linalg.svd(combinations @ root)
        kept = root @ axes[len(combinations) :].T
        covariance = np.asarray(kept @ kept.T)
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
        held_combinations=len(combinations),
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


def _undetermined(parameters: ParameterSet, estimate: Estimate, drawn: np.ndarray) -> Array:
    """(m, q) weights in the combinations of inertias that only the CAD prior determines.

    Args:
        parameters: The parameters.
        estimate: The estimate.
        drawn: (q,) indices in theta of the drawn parameters, ascending.
    """
    found = None
    if len(estimate.data) == len(parameters):
        found = InertiaCombinations.of(parameters, estimate.theta, estimate.data)
    if found is None:
        return np.zeros((0, len(drawn)))

    of_inertias = found.undetermined
    weights = np.zeros((len(of_inertias), len(drawn)))
    weights[:, np.searchsorted(drawn, found.columns)] = of_inertias
    return weights


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
    places = [
        (body, np.searchsorted(drawn, body.columns)) for body in unknown_bodies(system.parameters)
    ]
    physical = [
        bound
        for body, place in places
        if (bound := _physical_bound(body, place, centre)) is not None
    ]
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
        for i, row in zip(missing, range(len(missing)), strict=True):
            robot = _moved(places, centre, tried[row])
            if robot is not None and _is_physical(system, estimate, drawn, robot):
                values[i], is_physical[row] = robot, True
        missing = missing[~is_physical]
        if not len(missing):
            return values, replaced
        replaced += len(missing)

    raise ExperimentError(
        f"{len(missing)} of {count} drawn robots still had an unphysical inertia after they had "
        f"been replaced {MAX_ROUNDS} times; the recordings determine the inertias too poorly. "
        "State them as a whole (`inertial`) with a `cad_prior`, or with a narrower `prior`"
    )


def _physical_bound(body: UnknownBody, place: np.ndarray, centre: Array) -> MatrixBound | None:
    """The pseudo-inertia of a body as a bound of the draws; None if it is unphysical at the centre.

    Args:
        body: A body whose whole inertia is drawn.
        place: (10,) places of its coordinates.
        centre: (q,) centre of the distribution.
    """
    begin = centre[place]
    linear = body.linear(begin)
    if not body.is_physical(linear):
        return None

    # Pseudo-inertias are linear in the barycentric coordinates, and these in the draws.
    slopes = np.zeros((len(centre), *BARYCENTRIC_DERIVATIVES.shape[1:]))
    slopes[place] = np.tensordot(body.linear_slopes(begin), BARYCENTRIC_DERIVATIVES, axes=1)
    return MatrixBound(at_mean=pseudo_inertia_of(linear), slopes=slopes)


def _moved(
    places: Sequence[tuple[UnknownBody, np.ndarray]], centre: Array, values: Array
) -> Array | None:
    """(q,) parameters whose inertias have moved along straight lines; None where no body is there.

    Args:
        places: Bodies whose whole inertia is drawn, and the (10,) places of their coordinates.
        centre: (q,) parameters at which the lines begin.
        values: (q,) parameters without curvature, drawn from the normal distribution.
    """
    robot = np.array(values)
    for body, place in places:
        begin, step = centre[place], values[place] - centre[place]
        if not body.is_physical_after(begin, step):
            return None
        robot[place] = body.moved(begin, step)
    return robot


def _is_physical(system: System, estimate: Estimate, drawn: np.ndarray, values: Array) -> bool:
    """Whether all bodies have physical inertias at drawn values: (q,) of the parameters `drawn`."""
    theta = np.array(estimate.theta)
    theta[drawn] = values
    if system.impossible(theta):
        return False

    # Principal moments that are parameters of their own need a test: of a rigid body, no moment
    # exceeds the sum of the others, and MuJoCo refuses an MJCF in which one does.
    fields = [target.field for p in system.parameters.parameters for target in p.targets]
    moments_of = [f for f in fields if isinstance(f, ModelField) and f.array == "body_inertia"]
    bodies = sorted({field.rows[0] for field in moments_of})
    if not bodies:
        return True
    moments = np.sort(system.model_at(theta).body_inertia[bodies], axis=1)
    return bool((moments[:, 2] <= moments[:, 0] + moments[:, 1]).all())
