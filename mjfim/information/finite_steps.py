"""Standard deviations by finite steps of the parameters along the axes of their covariance.

A derivative says what an infinitely small change of a parameter does. Dry friction, contacts and
strong curvature answer otherwise to a change as large as the standard deviation. The outputs are
simulated at theta - 2 s v and theta + 2 s v, along each principal direction v of the covariance
with the standard deviation s. Where the derivatives hold, the whitened outputs differ by 4.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mjfim.arrays import Array, evenly_spread_indices, scaled_to_unit_diagonal
from mjfim.information.criteria import SINGULAR_RATIO
from mjfim.plant.active_constraints import active_constraints
from mjfim.plant.outputs import Noise
from mjfim.plant.plant import Plant
from mjfim.records.rehearsal import FiniteSteps
from mjfim.records.trajectory import Trajectory

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
