"""Whether derivatives tell what finite changes of the parameters do.

Two difference steps disagree at points at which derivatives do not exist: contacts, dry friction,
joint limits and clamped actuators.

A derivative says what an infinitely small change of a parameter does. Dry friction, contacts and
strong curvature answer otherwise to a change as large as the standard deviation. The outputs are
simulated at theta - 2 s v and theta + 2 s v, along each principal direction v of the covariance
with the standard deviation s. Where the derivatives hold, the whitened outputs differ by 4. The
covariance is that of difference steps of up to 2 s: those of shorter ones may be too small by any
factor, where a contact sticks and slips.

Where a motion hardly determines a parameter, the largest such step shows it: two robots that differ
much, whose outputs differ by less than a test of the noise can tell.
"""

from __future__ import annotations

import itertools
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mjfim.arrays import (
    NORMAL_95,
    POORLY_KNOWN_SHARE,
    Array,
    evenly_spread_indices,
    scaled_to_unit_diagonal,
)
from mjfim.information.criteria import SINGULAR_RATIO
from mjfim.information.null_space import LEAST_EFFECT, LEAST_RELATIVE_EFFECT
from mjfim.model.coordinates import output_label
from mjfim.model.parameter_writer import ParameterWriter
from mjfim.model.parameters import ParameterSet
from mjfim.plant.active_constraints import active_constraints
from mjfim.plant.outputs import Noise
from mjfim.plant.plant import SENSITIVITY_STEP, Plant
from mjfim.records.rehearsal import FiniteSteps, Separation, Valley
from mjfim.records.trajectory import Sensitivity, Trajectory

# ---- roughness

# Ratio of the second difference step to the first one; the second step changes a parameter by
# 0.3 %.
LONGER_STEP_FACTOR = 300.0

# Smallest ratio of the second step to the first one. It holds for parameters with a weak effect,
# whose first step is already long.
LEAST_STEP_FACTOR = 3.0

# The third step is the second one divided by this number, and at least `LEAST_MEDIUM_FACTOR` times
# the first one.
MEDIUM_STEP_DIVISOR = 3.0
LEAST_MEDIUM_FACTOR = 1.5

# If a derivative exists, the disagreement decreases at least by this factor from the second to the
# third step.
SMOOTH_DECREASE = 6.0

# Two derivatives disagree if they differ by more than this number (relative).
DISAGREEMENT_TOLERANCE = 1e-2

# The size of an output's derivative, to which a disagreement is related, is at least this fraction
# of the parameter's largest derivative.
NEGLIGIBLE_OUTPUT = 1e-3


def disagreement(fine: Array, coarse: Array) -> Array:
    """Relative disagreement of two derivatives of the outputs.

    Args:
        fine: (N+1, ny, p) whitened derivatives with the shorter step.
        coarse: (N+1, ny, p) whitened derivatives with the longer step.

    Returns:
        (N+1, p) largest difference over all outputs, each relative to its largest value over time.
    """
    size = np.maximum(np.abs(fine).max(axis=0), np.abs(coarse).max(axis=0))
    size = np.maximum(size, NEGLIGIBLE_OUTPUT * size.max(axis=0, initial=0.0))
    relative = np.abs(fine - coarse) / np.where(size > 0.0, size, 1.0)
    return np.asarray(relative.max(axis=1))


def steps_disagree(
    plant: Plant,
    noise: Noise,
    theta: Array,
    trajectory: Trajectory,
    fine: Sensitivity | None = None,
) -> bool:
    """Whether two difference steps disagree along a trajectory.

    Args:
        plant: The plant.
        noise: Noise of the measured outputs.
        theta: (p,) parameter values.
        trajectory: The trajectory.
        fine: Its sensitivity with the shorter step, if it is known.
    """
    derivatives = plant.derivatives
    fine = fine or derivatives.sensitivity(theta, trajectory)
    # A trajectory that diverges after a small change of the parameters has no derivative at all.
    if fine is None:
        return True

    G = noise.whiten(fine.G)
    visible = visible_columns(plant.parameters, G)

    def error(factors: Array) -> Array:
        """Largest disagreements with steps that are longer by factors: (p,); NaN if it diverges."""
        coarse = derivatives.sensitivity(theta, trajectory, factors * SENSITIVITY_STEP)
        if coarse is None:
            return np.array([np.nan])
        return np.asarray(disagreement(G, noise.whiten(coarse.G))[:, visible].max(axis=0))

    factors = _longer_factors(plant)
    longer = error(factors)
    if longer.max(initial=0.0) <= DISAGREEMENT_TOLERANCE:
        return False

    # If a derivative exists, the error of central differences decreases by a factor of nine with a
    # third of the step. The trajectory is then smooth, only strongly curved.
    medium = np.maximum(factors / MEDIUM_STEP_DIVISOR, LEAST_MEDIUM_FACTOR)
    # Dry friction may switch between the shorter steps as well, however little they disagree.
    tolerated = 0.0 if plant.model(theta).dof_frictionloss.any() else DISAGREEMENT_TOLERANCE
    return not only_curved(error(medium), longer, tolerated)


def _longer_factors(plant: Plant) -> Array:
    """(p,) ratios of the second to the first difference step of each parameter."""
    factors = LONGER_STEP_FACTOR * plant.parameters.magnitude / plant.derivatives.parameter_scale
    return np.maximum(factors, LEAST_STEP_FACTOR)


def only_curved(medium: Array, longer: Array, tolerated: float) -> bool:
    """Whether disagreements decrease with the step as those of derivatives that exist.

    Args:
        medium: (p,) disagreement of the shorter and the medium step.
        longer: (p,) disagreement of the shorter and the longer step.
        tolerated: Disagreement of the medium step that counts as agreement; it may be round-off.
    """
    allowed = np.maximum(longer / SMOOTH_DECREASE, tolerated)
    return bool((medium <= allowed).all())


def visible_columns(parameters: ParameterSet, G: Array) -> np.ndarray:
    """Find the parameters whose effect is larger than round-off.

    Args:
        parameters: The p parameters.
        G: (N+1, ny, p) whitened derivatives of the outputs.

    Returns:
        (p,) True if a parameter has such an effect.
    """
    length = np.linalg.norm(G, axis=(0, 1)) * parameters.magnitude
    strongest = length.max(initial=0.0)
    return np.asarray((length > LEAST_EFFECT) & (length > LEAST_RELATIVE_EFFECT * strongest))


# ---- steps along the covariance

# Length of a step to either side [standard deviations].
STEP_LENGTH = 2.0

# Largest step, relative to the magnitude of a parameter.
MAX_RELATIVE_STEP = 0.5

# Largest number of times that a step is halved because the simulation diverges.
MAX_HALVINGS = 5

# Largest number of samples at which the causes of an approximation are looked for.
CAUSE_SAMPLES = 200


def finite_steps(
    plant: Plant,
    noise: Noise,
    theta: Array,
    trajectory: Trajectory,
    *,
    information: Array,
    prior: Array,
    predicted: Array,
) -> FiniteSteps:
    """Compare predicted standard deviations with those of finite steps along a trajectory.

    Args:
        plant: The plant.
        noise: Noise of the measured outputs.
        theta: (p,) parameter values.
        trajectory: The trajectory, an open-loop simulation at theta.
        information: (p, p) information about the parameters, with the prior.
        prior: (p, p) information that does not come from the trajectory.
        predicted: (p,) standard deviations by derivatives, infinite where there are none.
    """
    p = plant.parameters
    # The shortest steps may show little more than how contacts chatter.
    step = STEP_LENGTH * predicted / plant.derivatives.parameter_scale
    step = np.clip(step, SENSITIVITY_STEP, SENSITIVITY_STEP * _longer_factors(plant))
    sensitivity = plant.derivatives.sensitivity(theta, trajectory, step)
    if sensitivity is not None:
        G = noise.whiten(sensitivity.G).reshape(-1, len(theta))
        information = prior + G.T @ G
    unit, size = scaled_to_unit_diagonal(information)
    values, vectors = np.linalg.eigh(unit)
    known = values > SINGULAR_RATIO * values[-1]
    values, axes = values[known], vectors[:, known] / size[:, None]
    of_prior = np.einsum("jd,jk,kd->d", axes, prior, axes)
    of_data = np.maximum(values - of_prior, 0.0)

    # (2, d) lengths forward and backward, with which no parameter leaves its bounds, nor moves by
    # more than half of its magnitude.
    steps = axes / np.sqrt(values)
    length = np.full((2, len(values)), STEP_LENGTH)
    for side, direction in enumerate((steps, -steps)):
        room = np.where(direction > 0.0, (p.upper - theta)[:, None], (theta - p.lower)[:, None])
        most = np.where(p.changes_model, MAX_RELATIVE_STEP * p.magnitude, np.inf)
        room = np.clip(room, 0.0, most[:, None])
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = np.where(direction != 0.0, room / np.abs(direction), np.inf)
        length[side] = np.minimum(length[side], reach.min(axis=0, initial=np.inf))

    # What has no room, or no data, cannot be refuted.
    is_tested = (length.sum(axis=0) > 0.0) & (of_data > 0.0)
    ratio = np.where(is_tested, np.nan, 1.0)
    left = np.flatnonzero(is_tested)
    for _ in range(MAX_HALVINGS + 1):
        if not len(left):
            break
        sides = (length[0, left], -length[1, left])
        moves = np.concatenate([(steps[:, left] * side).T for side in sides])
        y, finite = plant.measure(theta + moves, trajectory.ctrl)
        y = y.reshape(2, len(left), *y.shape[1:])
        is_finite = np.asarray(np.reshape(finite, (2, -1)).all(axis=0))
        for i, d in enumerate(left.tolist()):
            if is_finite[i]:
                change = np.linalg.norm(noise.whitened_rows(y[0, i] - y[1, i]))
                ratio[d] = change / (length[:, d].sum() * np.sqrt(of_data[d] / values[d]))
        left = left[~is_finite]
        length[:, left] /= 2.0

    variance = np.full(len(theta), np.inf)
    weight = of_prior + np.where(np.isfinite(ratio), ratio, 0.0) ** 2 * of_data
    alone = np.isfinite(predicted)
    with np.errstate(divide="ignore", invalid="ignore"):
        parts = np.where(axes != 0.0, axes**2 / weight, 0.0)
        variance[alone] = parts[alone].sum(axis=1)
    found = FiniteSteps(
        names=p.names,
        predicted=predicted,
        std=np.sqrt(variance),
        length=0.5 * length.sum(axis=0),
        ratio=ratio,
    )
    if found.confirmed.all():
        return found
    samples = evenly_spread_indices(trajectory.samples, CAUSE_SAMPLES).tolist()
    played = trajectory if plant.laws is None else plant.applied(theta, trajectory)[0]
    return replace(found, causes=active_constraints(plant.model(theta), played, samples))


# ---- two robots that a motion does not tell apart

# Number of lengths among which the largest step is searched.
LENGTHS = 256

# A parameter whose effect is less than this fraction of the largest one moves by round-off.
LEAST_SHARE = 1e-7


def valley(
    motions: Sequence[tuple[Plant, Trajectory]],
    noise: Noise,
    theta: Array,
    *,
    information: Array,
    prior: Array,
    std: Array,
) -> Valley | None:
    """Find two robots with different parameters that a motion does not tell apart.

    The parameter that is known worst moves, and the others as its covariance with them says: so
    they hide it best. The robots lie on both sides of theta. Their distance grows until the outputs
    of two of the three, with the prior, differ by 1.96 standard deviations, or the worst parameter
    changes by half; the others stop at their bounds. One direction has one degree of freedom, so
    that a chi-square test at 95 % does not find a smaller difference.

    Args:
        motions: The motion and, where there is one, the designed motion, each with its plant.
        noise: Noise of the measured outputs.
        theta: (p,) parameter values.
        information: (p, p) information along the first motion, with the prior.
        prior: (p, p) information that does not come from the motion.
        std: (p,) standard deviations after the first motion [theta-unit].

    Returns:
        The two robots; None where every parameter is known well, or a simulation diverges.
    """
    plant, trajectory = motions[0]
    p = plant.parameters
    sizes = p.sizes(theta)
    share = np.zeros(len(p))
    share[p.interest] = NORMAL_95 * (std / sizes)[p.interest]
    worst = int(np.argmax(share))
    if share[worst] < POORLY_KNOWN_SHARE:
        return None

    unit, size = scaled_to_unit_diagonal(information)
    values, vectors = np.linalg.eigh(unit)
    column = (vectors / np.maximum(values, SINGULAR_RATIO)) @ vectors[worst]
    column[np.abs(column) < LEAST_SHARE * np.abs(column).max()] = 0.0
    step = column / size * (MAX_RELATIVE_STEP * sizes[worst] * size[worst] / column[worst])
    reach = np.where(p.changes_model, MAX_RELATIVE_STEP * p.magnitude, np.inf)
    lower, upper = np.maximum(theta - reach, p.lower), np.minimum(theta + reach, p.upper)
    writer = ParameterWriter(p)

    def robots(length: int) -> Array:
        """(2, p) parameters of the robots, by the number of the length."""
        return np.clip(theta + length / LENGTHS * np.array([step, -step]), lower, upper)

    def differ(length: int) -> bool:
        """Whether a robot is impossible, or differs by more than the noise from any other."""
        three = np.array([*robots(length), theta])
        y, finite = plant.measure(three, trajectory.ctrl)
        if not finite.all() or any(writer.unphysical_bodies(plant.source, row) for row in three):
            return True
        for a, b in itertools.combinations(range(3), 2):
            gap = three[a] - three[b]
            square = np.sum(noise.whitened_rows(y[a] - y[b]) ** 2) + gap @ prior @ gap
            if square > NORMAL_95**2:
                return True
        return False

    pair = robots(bisect_left(range(1, LENGTHS + 1), True, key=differ))
    measured = [each.measure(pair, motion.ctrl) for each, motion in motions]
    if not (np.any(pair[0] != pair[1]) and all(finite.all() for _, finite in measured)):
        return None

    # The output is that in which the last motion shows most.
    y = measured[-1][0]
    seen = noise.measured(y.shape[1] - 1)
    output = int(np.argmax(np.linalg.norm((y[0] - y[1]) * seen / noise.sigma, axis=0)))
    along = []
    for (y, _), (_, motion) in zip(measured, motions, strict=True):
        square = (noise.whiten(y[0] - y[1]) ** 2 * seen).sum(axis=1)
        distance = np.sqrt(np.cumsum(square))
        along.append(Separation(t=motion.t, y=y[:, :, output], distance=distance))
    return Valley(
        parameters=p.names,
        units=tuple(each.unit for each in p.parameters),
        nominal=theta,
        sizes=sizes,
        theta=pair,
        output=output_label(plant.source.model, plant.outputs.names[output]),
        sigma=float(noise.sigma[output]),
        motion=along[0],
        designed=along[1] if len(along) > 1 else None,
    )
