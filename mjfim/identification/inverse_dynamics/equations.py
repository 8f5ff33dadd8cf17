"""The equation of motion along measured motions, as rows of a least-squares problem.

Each row is the average of an equation over a window of Hann, which passes what the splines of the
motion follow and hardly any noise of the accelerations above it. The equations are those of the
degrees of freedom, with measured forces in place of modelled ones where there are any, and the laws
of the actuators whose forces are measured. Points at which unknown forces act, of contacts and of
joint limits, do not count, nor do those far from any reading.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from mjfim.arrays import Array, evenly_spread_indices, record
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.inverse_dynamics.motion import (
    MeasuredForce,
    MeasuredMotion,
    measured_forces,
    measured_motion,
)
from mjfim.identification.segments import bristle_deflection, bristles_of
from mjfim.model.control_laws import ControlLaws
from mjfim.model.coordinates import dof_names
from mjfim.model.elements import translations
from mjfim.model.targets import ModelField
from mjfim.model.units import actuator_gear
from mjfim.model.variants import RELAXED, Relaxation
from mjfim.plant.batch import BatchSimulator
from mjfim.plant.closed_loop import ClosedLoopSimulator
from mjfim.plant.equation_of_motion import EquationOfMotion, MotionPoints
from mjfim.plant.equation_of_motion import activations as simulated_activations
from mjfim.records.estimate_parts import ResidualForce

# Points at which all equations of all recordings are evaluated, at most.
MOST_POINTS = 20_000

# Length of a window over the distance of the knots of the splines. Shorter windows give friction
# that is a little better and inertias that are worse.
WINDOW_PER_SPACING = 6.0

# Number of averages per length of the window. Their noise is correlated.
PER_WINDOW = 4

# Largest share of the weight of a window on points that do not count.
MOST_UNUSABLE = 0.02

# Accelerations that contribute less than this share of the largest contribution to an equation do
# not lengthen its window.
LEAST_CONTRIBUTION = 0.1

# Longest window, as a share of a recording.
LONGEST_WINDOW = 0.1

# Speed below which the sign of dry friction is not sure: in standard deviations of the noise, and
# at least this share of the largest speed.
UNSURE_SIGMAS = 3.0
SLOW_SHARE = 0.02

# Largest share of a window on such speeds; larger ones are tried in turn where too few windows
# remain.
SLOW_SHARES = (0.1, 0.3, 1.0)
FEWEST_WINDOWS = 0.2


# Name of a degree of freedom, or of a law; unit of its forces, empty for laws; and the degree of
# freedom, or the index of the measured force whose law it is.
Equation = tuple[str, str, int]

# Averages of a series of n points: their (k, n) weights, the (k,) middles of their windows [s], and
# the length of a window [s].
Windows = tuple[scipy.sparse.csr_array, Array, float]


@record
class RecordedEquations:
    """The equations along one recording.

    Attributes:
        motion: The measured motion.
        forces: (n, f) measured forces.
        force_sigma: (f,) their standard deviations by noise.
        has_force: (f,) True for those that the recording holds.
        moments: (n, f, nv) forces on the degrees of freedom per measured force.
        usable: (n, nv) True where all that acts on a degree of freedom is known.
        windows: Windows of each equation.
    """

    motion: MeasuredMotion
    forces: Array
    force_sigma: Array
    has_force: np.ndarray
    moments: Array
    usable: np.ndarray
    windows: tuple[Windows, ...]


@record
class MotionEquations:
    """The equations of a system along all recordings as functions of the parameters.

    Rows are averages of all equations. Those of one recording follow each other, and within it
    those of one equation.

    Attributes:
        system: The system, without control laws.
        laws: The control laws whose inputs a recording holds; None without any.
        friction_speeds: (nv,) speeds below which the sign of dry friction is not sure.
        forces: The measured forces.
        equations: The equations: of the degrees of freedom, and laws of measured forces.
        recorded: The equations along each recording.
        assumes_friction: Whether dry friction may act that is not in the model.
    """

    system: System
    laws: ControlLaws | None
    friction_speeds: Array
    forces: tuple[MeasuredForce, ...]
    equations: tuple[Equation, ...]
    recorded: tuple[RecordedEquations, ...] = ()
    assumes_friction: bool = False

    @staticmethod
    def of(
        system: System,
        recordings: Sequence[AlignedRecording],
        theta: Array,
        *,
        forces: tuple[MeasuredForce, ...],
        laws: ControlLaws | None,
        assumes_friction: bool = False,
    ) -> MotionEquations:
        """The equations along recordings, without contacts and limits.

        Args:
            system: The system without control laws.
            recordings: The recordings.
            theta: (p,) parameters at which windows are chosen.
            forces: The measured forces.
            laws: The control laws of the recordings; None without any.
            assumes_friction: Whether dry friction may act that is not in the model.
        """
        durations = np.array([float(recording.t[-1]) for recording in recordings])
        shares = MOST_POINTS * durations / durations.sum()
        motions = [
            measured_motion(system, recording, theta, max(int(share), 2))
            for recording, share in zip(recordings, shares, strict=True)
        ]
        sigma = np.max([motion.sigma[1] for motion in motions], axis=0)
        fastest = np.max([np.abs(motion.qvel).max(axis=0) for motion in motions], axis=0)
        units = np.where(translations(system.model), "N", "N m").tolist()
        of_dofs = [
            (name, unit, dof)
            for dof, (name, unit) in enumerate(zip(dof_names(system.model), units, strict=True))
        ]
        of_laws = [
            (f"law of {force.name}", "", place)
            for place, force in enumerate(forces)
            if force.is_modelled
        ]
        stated = MotionEquations(
            system=system,
            laws=laws,
            friction_speeds=np.maximum(UNSURE_SIGMAS * sigma, SLOW_SHARE * fastest),
            forces=forces,
            equations=(*of_dofs, *of_laws),
            assumes_friction=assumes_friction,
        )
        relaxed = system.with_variant(RELAXED, Relaxation(constraints=True))
        found = replace(stated, system=relaxed)
        recorded = []
        for motion in motions:
            # Contacts and stops act in the stated model.
            compiled = system.plant.model(theta)
            (points,) = stated.points([compiled], motion, theta[None])
            constrained = stated.equation.constrained(compiled, points)
            recorded.append(_recorded(found, motion, theta, constrained))
        return replace(found, recorded=tuple(recorded))

    @cached_property
    def equation(self) -> EquationOfMotion:
        """The equation of motion of the plant."""
        simulator = self.system.plant.simulator.with_substeps(1)
        return EquationOfMotion(simulator=simulator, friction_speeds=self.friction_speeds)

    def points(
        self, models: Sequence[Any], motion: MeasuredMotion, thetas: Array
    ) -> list[MotionPoints]:
        """Points of a motion for each compiled model, of parameters (k, p)."""
        acts = self._activations(models, motion)
        delays = thetas @ self.system.parameters.delay_derivative
        return [
            (
                np.concatenate([motion.qpos, motion.qvel, act], axis=1),
                motion.qacc,
                self._stated(motion.control(delay)),
            )
            for act, delay in zip(acts, delays.tolist(), strict=True)
        ]

    def _stated(self, inputs: Array) -> Array:
        """(n, nu) controls that are inputs themselves, zero for those of laws; inputs: (n, w)."""
        if self.laws is None:
            return inputs
        columns, controls = self.laws.direct
        found = np.zeros((len(inputs), self.system.model.nu))
        found[:, controls] = inputs[:, columns]
        return found

    def _activations(self, models: Sequence[Any], motion: MeasuredMotion) -> list[Array]:
        """(n, na) activations along a motion for each model.

        The joints are held in the simulation, so that bristles follow from the measured velocity.
        """
        plant, recording = self.system.plant, motion.recording
        if not self.system.space.na:
            return [np.zeros((len(motion.t), 0)) for _ in models]
        first = models[0]
        are_alike = all(np.array_equal(m.actuator_dynprm, first.actuator_dynprm) for m in models)
        simulated = simulated_activations(
            plant.simulator,
            models[:1] if are_alike else models,
            self.system.nominal_initial_state,
            self._stated(recording.ctrl),
        )
        samples = recording.dt * np.arange(simulated.shape[1])
        directions = self.equation.directions(motion.qvel)
        found = []
        for k, model in enumerate(models):
            columns = simulated[0 if are_alike else k].T
            act = np.stack([np.interp(motion.t, samples, column) for column in columns], axis=1)
            for actuator, address, dof in bristles_of(model):
                speed = actuator_gear(model, actuator) * motion.qvel[:, dof]
                direction = np.sign(speed) * np.abs(directions[:, dof])
                act[:, address] = bristle_deflection(model, actuator, speed, direction)
            found.append(act)
        return found

    @property
    def has_friction(self) -> np.ndarray:
        """(nv,) True for degrees of freedom on which dry friction may act."""
        model: Any = self.system.model
        found = np.asarray((model.dof_frictionloss > 0.0) | self.assumes_friction)
        found[[dof for _, _, dof in bristles_of(model)]] = True
        for parameter in self.system.parameters.parameters:
            for target in parameter.targets:
                field = target.field
                if isinstance(field, ModelField) and field.array == "dof_frictionloss":
                    found[list(field.rows)] = True
        return found

    # ---- rows

    @cached_property
    def places(self) -> tuple[np.ndarray, ...]:
        """(R,) index of the recording of each row, and (R,) that of the equation."""
        counts = [len(t) for each in self.recorded for _, t, _ in each.windows]
        shape = len(self.recorded), len(self.equations)
        return tuple(np.repeat(np.indices(shape).reshape(2, -1), counts, axis=1))

    def mean_squares(self, values: Array) -> Array:
        """(E,) mean squares of values of the rows: (R,), by equation; 0 without rows."""
        of_row, count = self.places[1], len(self.equations)
        squares = np.bincount(of_row, values**2, minlength=count)
        return np.asarray(squares / np.maximum(np.bincount(of_row, minlength=count), 1))

    def rows(self, thetas: Array) -> Array:
        """Rows at several values of the parameters.

        Args:
            thetas: (k, p) parameters.

        Returns:
            (k, 3, R) forces that the model needs or predicts, forces that act in the model or are
            measured, and the inertial part of the needed ones [N or N m]; NaN where a model does
            not compile.
        """
        models, compiled = self.system.plant.try_models(thetas)
        parts = []
        for each in self.recorded:
            points = zip(models, self.points(models, each.motion, thetas), strict=True)
            parts.append([self._averaged(each, *self.equation.terms(*pair)) for pair in points])
        rows = np.concatenate(parts, axis=2)
        rows[~compiled] = np.nan
        return rows

    def forces_along(self, each: RecordedEquations, forces: Array) -> tuple[Array, Array]:
        """Forces of the actuators along one recording.

        Args:
            each: The equations along the recording.
            forces: (n, nv+nf) forces by the model, see `EquationOfMotion.terms`.

        Returns:
            (n, nv) forces on the degrees of freedom, measured where the recording holds them and by
            the model elsewhere, and (n, f) the forces by the model in place of measured ones
            [N or N m].
        """
        nv = self.system.space.nv
        measured = forces[:, :nv].copy()
        modelled = np.zeros_like(each.forces)
        for place, force in enumerate(self.forces):
            values = each.forces[:, place]
            column = force.dof if force.is_of_joint else nv + force.actuator
            modelled[:, place] = forces[:, column]
            if each.has_force[place] and force.is_of_joint:
                measured[:, force.dof] = values
            elif each.has_force[place]:
                error = values - modelled[:, place]
                measured += error[:, None] * each.moments[:, place]
        return measured, modelled

    def _averaged(
        self, each: RecordedEquations, needed: Array, inertial: Array, forces: Array
    ) -> Array:
        """(3, r) explained, measured and inertial forces along one recording."""
        measured, modelled = self.forces_along(each, forces)
        parts = []
        nothing = np.zeros(len(measured))
        for (_, unit, place), (weights, _, _) in zip(self.equations, each.windows, strict=True):
            if unit:
                series = [needed[:, place], measured[:, place], inertial[:, place]]
            else:
                series = [modelled[:, place], each.forces[:, place], nothing]
            parts.append(np.stack([weights @ values for values in series]))
        return np.concatenate(parts, axis=1)


def _recorded(
    of: MotionEquations, motion: MeasuredMotion, theta: Array, constrained: np.ndarray
) -> RecordedEquations:
    """The equations along one recording, with windows that suit its motion."""
    forces = of.forces
    model = of.system.plant.model(theta)
    (points,) = of.points([model], motion, theta[None])

    # A degree of freedom needs the measured forces that act on it, and the accelerations that
    # matter determine the length of its windows.
    usable = motion.usable & ~constrained
    coupling = of.equation.coupling(model, points)
    matters = coupling >= LEAST_CONTRIBUTION * coupling.max(axis=1, keepdims=True)
    spacing = np.where(matters, motion.spacing, 0.0).max(axis=1)
    count = len(motion.t)
    measured, sigma = np.zeros((count, len(forces))), np.zeros(len(forces))
    near = np.zeros((count, len(forces)), dtype=bool)
    moments = np.zeros((count, len(forces), model.nv))
    touched = np.zeros((len(forces), model.nv), dtype=bool)
    for place, force in enumerate(forces):
        if force.is_of_joint:
            touched[place, force.dof] = True
        else:
            moments[:, place] = of.equation.moments(model, points, [force.actuator])[:, 0]
            touched[place] = moments[:, place].any(axis=0)
        values = motion.recording.y[:, force.output]
        if np.isfinite(values).any():
            measured[:, place], near[:, place], sigma[place] = motion.smoothed(values)
            usable[:, touched[place]] &= near[:, place : place + 1]
    slow = (np.abs(motion.qvel) < of.friction_speeds) & of.has_friction

    windows = []
    for _, unit, place in of.equations:
        if unit:
            found = _windows(motion, spacing[place], usable[:, place], slow[:, place])
        else:
            known = near[:, place] & motion.usable[:, touched[place]].all(axis=1)
            finest = motion.spacing[touched[place]].max(initial=0.0)
            found = _windows(motion, finest, known, np.zeros_like(known))
        windows.append(found)
    return RecordedEquations(
        motion=motion,
        forces=measured,
        force_sigma=sigma,
        has_force=np.asarray(near.any(axis=0)),
        moments=moments,
        usable=usable,
        windows=tuple(windows),
    )


def _windows(
    motion: MeasuredMotion, spacing: float, usable: np.ndarray, slow: np.ndarray
) -> Windows:
    """Windows of an equation, most of which are not at rest where that is possible."""
    length = WINDOW_PER_SPACING * max(spacing, motion.step)
    length = min(length, LONGEST_WINDOW * float(motion.t[-1]))
    half = max(round(0.5 * length / motion.step), 1) - 1
    window = np.hanning(2 * half + 3)[1:-1]
    stride = max(round(length / motion.step / PER_WINDOW), 1)
    centres = np.arange(half, len(motion.t) - half, stride)
    columns = centres[:, None] + np.arange(-half, half + 1)
    values = np.broadcast_to(window / window.sum(), columns.shape)
    ends = len(window) * np.arange(len(centres) + 1)
    shape = (len(centres), len(motion.t))
    weights = scipy.sparse.csr_array((values.ravel(), columns.ravel(), ends), shape)

    possible = weights @ ~usable <= MOST_UNUSABLE
    resting = weights @ slow
    for share in SLOW_SHARES:
        kept = possible & (resting <= share)
        if kept.sum() >= FEWEST_WINDOWS * possible.sum():
            break
    return weights[kept], motion.t[centres[kept]], length


# Largest number of points of a joint that a record holds.
MOST_POINTS = 4000


def residual_forces(
    system: System, recordings: Sequence[AlignedRecording], thetas: Sequence[Array]
) -> tuple[ResidualForce, ...]:
    """Compare the forces of the actuators with those that the model needs, at every point.

    Points near the ends of a recording do not count, because noise is larger there. Controls of
    control laws are those that they compute along the measured motion.

    Args:
        system: The system on the grid of the recordings.
        recordings: The recordings.
        thetas: (p,) parameters for each of them [theta-unit].

    Returns:
        The forces of the hinges and slides that have points.

    Raises:
        RecordingError: A degree of freedom was not measured.
    """
    laws, simulator = system.laws, system.plant.simulator
    system = system.without_laws()
    forces = measured_forces(system, recordings)
    rng = np.random.default_rng(0)
    along = []
    for recording, theta in zip(recordings, thetas, strict=True):
        equations = MotionEquations.of(system, [recording], theta, forces=forces, laws=laws)
        along.append(_series(equations, simulator, theta, rng))

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
    equations: MotionEquations,
    simulator: BatchSimulator,
    theta: Array,
    rng: np.random.Generator,
) -> tuple[Array, np.ndarray]:
    """Series along the one recording of some equations, by degree of freedom.

    Returns:
        (5, n, nv) positions, velocities, residual forces, forces of the actuators, and changes of
        the residual forces by noise of the measurements; and (n, nv) True for points that count.
    """
    (each,) = equations.recorded
    motion, space = each.motion, equations.system.space
    residual, force = _residual(equations, simulator, each, theta)

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
    by_noise = _residual(equations, simulator, noisy, theta)[0] - residual

    position = np.zeros_like(motion.qvel)
    position[:, space.scalar_v] = motion.qpos[:, space.scalar_q]
    to_end = np.minimum(motion.t, motion.t[-1] - motion.t)
    usable = each.usable & (to_end[:, None] > motion.spacing) & np.isfinite(residual + by_noise)
    return np.stack([position, motion.qvel, residual, force, by_noise]), usable


def _residual(
    equations: MotionEquations, simulator: BatchSimulator, each: RecordedEquations, theta: Array
) -> tuple[Array, Array]:
    """(n, nv) forces of the actuators less those that the motion needs, and the former alone."""
    model, motion = equations.system.plant.model(theta), each.motion
    if isinstance(simulator, ClosedLoopSimulator):
        states = np.concatenate([motion.qpos, motion.qvel], axis=1)
        inputs = motion.recording.ctrl[: int(np.ceil(motion.t[-1] / motion.recording.dt))]
        ctrl = simulator.controls_along(model, motion.t, states, inputs)
        motion = replace(motion, recording=replace(motion.recording, ctrl=ctrl))
        equations = replace(equations, laws=None)
    (points,) = equations.points([model], motion, theta[None])
    needed, _, forces = equations.equation.terms(model, points)
    force, _ = equations.forces_along(each, forces)
    return force - needed, force
