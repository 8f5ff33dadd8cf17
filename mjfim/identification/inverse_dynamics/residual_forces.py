"""Forces that the actuators give along the measured motions beyond those that the model needs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mjfim.arrays import Array, evenly_spread_indices
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.inverse_dynamics.equations import MotionEquations, RecordedEquations
from mjfim.identification.inverse_dynamics.motion import measured_forces
from mjfim.model.coordinates import dof_names
from mjfim.model.elements import translations
from mjfim.records.estimate_parts import ResidualForce

# Largest number of points of a joint that a record holds.
MOST_POINTS = 4000


def residual_forces(
    system: System, recordings: Sequence[AlignedRecording], thetas: Sequence[Array]
) -> tuple[ResidualForce, ...]:
    """Compare the forces of the actuators with those that the model needs, at every point.

    Points near the ends of a recording do not count, because noise is larger there.

    Args:
        system: The system on the grid of the recordings.
        recordings: The recordings.
        thetas: (p,) parameters for each of them [theta-unit].

    Returns:
        The forces of the hinges and slides that have points.

    Raises:
        ExperimentError: Control laws compute controls, and a force of such an actuator was not
            measured.
        RecordingError: A degree of freedom was not measured.
    """
    forces, laws = measured_forces(system, recordings), system.laws
    system = system.without_laws()
    rng = np.random.default_rng(0)
    along = []
    for recording, theta in zip(recordings, thetas, strict=True):
        equations = MotionEquations.of(system, [recording], theta, forces=forces, laws=laws)
        along.append(_series(equations, theta, rng))

    names, is_slide = dof_names(system.model), translations(system.model)
    found = []
    for dof in system.space.scalar_v.tolist():
        series = np.concatenate([each[:, usable[:, dof], dof] for each, usable in along], axis=1)
        position, speed, residual, force, by_noise = series
        if not len(residual):
            continue
        shown = evenly_spread_indices(len(residual), MOST_POINTS)
        found.append(
            ResidualForce(
                joint=names[dof],
                unit="N" if is_slide[dof] else "N m",
                position=position[shown],
                speed=speed[shown],
                force=residual[shown],
                sigma=float(np.sqrt(np.mean(by_noise**2))),
                size=float(np.sqrt(np.mean(force**2))),
            )
        )
    return tuple(found)


def _series(
    equations: MotionEquations, theta: Array, rng: np.random.Generator
) -> tuple[Array, np.ndarray]:
    """Series along the one recording of some equations, by degree of freedom.

    Returns:
        (5, n, nv) positions, velocities, residual forces, forces of the actuators, and changes of
        the residual forces by noise of the measurements; and (n, nv) True for points that count.
    """
    (each,) = equations.recorded
    motion, space = each.motion, equations.system.space
    residual, force = _residual(equations, each, theta)

    # The same motion with the noise that the splines leave.
    count = len(motion.t)
    noise = motion.sigma[:, None] * rng.standard_normal((3, count, space.nv))
    rest = np.zeros((count, space.na))
    state = np.concatenate([motion.qpos, motion.qvel, rest], axis=1)
    qpos, qvel, _ = space.split(space.plus(state, np.concatenate([*noise[:2], rest], axis=1)))
    noisy = replace(
        each,
        motion=replace(motion, qpos=qpos, qvel=qvel, qacc=motion.qacc + noise[2]),
        forces=each.forces + each.force_sigma * rng.standard_normal(each.forces.shape),
    )
    by_noise = _residual(equations, noisy, theta)[0] - residual

    position = np.zeros_like(motion.qvel)
    position[:, space.scalar_v] = motion.qpos[:, space.scalar_q]
    to_end = np.minimum(motion.t, motion.t[-1] - motion.t)
    usable = each.usable & (to_end[:, None] > motion.spacing) & np.isfinite(residual + by_noise)
    return np.stack([position, motion.qvel, residual, force, by_noise]), usable


def _residual(
    equations: MotionEquations, each: RecordedEquations, theta: Array
) -> tuple[Array, Array]:
    """(n, nv) forces of the actuators less those that the motion needs, and the former alone."""
    model = equations.system.plant.model(theta)
    (points,) = equations.points([model], each.motion, theta[None])
    terms = equations.equation.terms(model, points)
    force, _ = equations.forces_along(each, terms)
    return force - terms.needed, force
