"""Equations of motion along one recording: windows, measured forces, and points that count."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.experiment.system import System
from mjfim.identification.averages import Averages, hann_averages
from mjfim.identification.known_controls import GAINS, controls_along, held_controls
from mjfim.identification.measured_forces import MeasuredForce
from mjfim.identification.measured_motion import POINTS_PER_INTERVAL, REACH, MeasuredMotion
from mjfim.identification.steady_bristles import bristles_of
from mjfim.model.control_laws import ControlLaws
from mjfim.model.coordinates import actuator_names, dof_names
from mjfim.model.sizes import translations
from mjfim.model.targets import ModelField
from mjfim.plant.equation_of_motion import EquationOfMotion, MotionPoints
from mjfim.plant.equation_of_motion import activations as simulated_activations

# Length of a window over the distance of the knots of the splines. Shorter windows give friction
# that is a little better and inertias that are worse.
WINDOW_PER_SPACING = 6.0

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


@dataclass(frozen=True, kw_only=True)
class Equation:
    """One of the equations.

    Attributes:
        name: Name of its degree of freedom, or `law of` an actuator.
        unit: Unit of its force; empty for laws.
        dof: Its degree of freedom; -1 for the law of an actuator.
        law: Place among the measured forces of the one whose law it is; -1 for a degree of freedom.
    """

    name: str
    unit: str = ""
    dof: int = -1
    law: int = -1


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordedEquations:
    """The equations along one recording.

    Attributes:
        motion: The measured motion.
        forces: (n, f) measured forces of actuators at its points [N or N m].
        has_force: (f,) True for the forces that this recording holds.
        moments: (n, f, nv) forces on the degrees of freedom per force of a single actuator.
        averages: Averages of each equation.
    """

    motion: MeasuredMotion
    forces: Array
    has_force: np.ndarray
    moments: Array
    averages: tuple[Averages, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class EquationModel:
    """A system whose equations are evaluated along motions.

    Attributes:
        system: The system, whose plant has no constraints.
        measured_forces: The measured forces.
        laws: Laws that have computed controls of the recordings; None without any. The system has
            none: controls are its inputs.
        friction_speeds: (nv,) speeds below which dry friction is viscous [m/s or rad/s].
    """

    system: System
    measured_forces: tuple[MeasuredForce, ...]
    laws: ControlLaws | None
    friction_speeds: Array

    @cached_property
    def equation(self) -> EquationOfMotion:
        """The equation of motion of the plant."""
        return EquationOfMotion(
            simulator=self.system.plant.simulator.with_substeps(1),
            friction_speeds=self.friction_speeds,
        )

    @cached_property
    def equations(self) -> tuple[Equation, ...]:
        """Equations of the degrees of freedom, and laws of actuators with a measured force.

        Where no recording shows the control of an actuator, its force has no equation.
        """
        return tuple(_equations(self.system, self.measured_forces))

    @cached_property
    def gain_rows(self) -> frozenset[int]:
        """Places, among the custom numbers of the model, of the gains of laws with an equation."""
        model, names = self.system.model, actuator_names(self.system.model)
        known = [force for force in self.measured_forces if force.has_known_control]
        laws = () if self.laws is None else self.laws.laws
        return frozenset(
            law.row(gain)
            for law in laws
            if any(force.contains(model, names.index(law.actuator)) for force in known)
            for gain in GAINS
        )

    def points(self, motion: MeasuredMotion, model: Any, theta: Array, act: Array) -> MotionPoints:
        """Points of a motion.

        Args:
            motion: The motion.
            model: The model at these parameters, with the numbers of the laws.
            theta: (p,) parameters, of which only delays matter.
            act: (n, na) activations.
        """
        delay = float(self.system.parameters.delay_derivative @ theta)
        return MotionPoints(
            states=np.concatenate([motion.qpos, motion.qvel, act], axis=1),
            acceleration=motion.qacc,
            ctrl=controls_along(motion, model, self.laws, delay),
        )

    def activations(self, models: Sequence[Any], motion: MeasuredMotion) -> list[Array]:
        """Activations of actuators along a motion.

        Args:
            models: The models.
            motion: The motion.

        Returns:
            (n, na) activations for each model; for all of them together where they are equal.
        """
        system = self.system
        if not system.space.na:
            return [np.zeros((len(motion.t), 0))]

        # The joints are held in the simulation, so that bristles follow from the measured velocity.
        bristles, first = bristles_of(models[0]), models[0]
        move_alike = all(
            np.array_equal(each.actuator_dynprm, first.actuator_dynprm) for each in models
        )
        are_equal = move_alike and all(
            bristle.friction(each) == bristle.friction(first)
            for bristle in bristles
            for each in models
        )
        found = self._simulated(models[:1] if move_alike else models, motion)
        chosen = models[:1] if are_equal else models
        acts = [np.array(found[0 if move_alike else k]) for k in range(len(chosen))]

        directions = self.equation.directions(motion.qvel)
        for act, model in zip(acts, chosen, strict=True):
            for bristle in bristles:
                speed = bristle.speed(model, motion.qvel)
                direction = np.sign(speed) * np.abs(directions[:, bristle.dof])
                act[:, bristle.address] = bristle.deflection(model, speed, direction)
        return acts

    def _simulated(self, models: Sequence[Any], motion: MeasuredMotion) -> list[Array]:
        """(n, na) activations along a motion for each model, at joints that are held."""
        recording = motion.recording
        found = simulated_activations(
            self.system.plant.simulator,
            models,
            self.system.nominal_initial_state,
            held_controls(recording, self.laws, self.system.model.nu),
        )
        samples = recording.dt * np.arange(found.shape[1])
        return [
            np.stack([np.interp(motion.t, samples, column) for column in act.T], axis=1)
            for act in found
        ]

    def recorded(
        self, motion: MeasuredMotion, theta: Array, constrained: np.ndarray
    ) -> RecordedEquations:
        """The equations along one recording, with windows that suit its motion.

        Args:
            motion: The motion.
            theta: (p,) parameters at which the windows are chosen.
            constrained: (n, nv) True where contacts, stops or equalities act.
        """
        model = self.system.plant.model(theta)
        points = self.points(motion, model, theta, self.activations([model], motion)[0])

        # Points where unknown forces act do not count.
        usable = motion.usable & ~constrained
        coupling = self.equation.coupling(model, points)
        matters = coupling >= LEAST_CONTRIBUTION * coupling.max(axis=1, keepdims=True)
        spacing = np.where(matters, motion.spacing, 0.0).max(axis=1)

        # A degree of freedom needs the measured forces that act on it.
        forces, near = self._forces(motion)
        has_force = np.asarray(near.any(axis=0))
        moments = self._moments(model, points)
        touched = np.asarray(moments.any(axis=0))
        for place, force in enumerate(self.measured_forces):
            touched[place, force.dof] |= force.is_of_joint
            if has_force[place]:
                usable[:, touched[place]] &= near[:, place : place + 1]

        slow = np.abs(motion.qvel) < self.friction_speeds
        slow &= self._has_friction(model)
        at_no_point = np.zeros(len(motion.t), dtype=bool)
        averages = []
        for equation in self.equations:
            dof, place = equation.dof, equation.law
            if dof >= 0:
                found = _windows(motion, spacing[dof], usable[:, dof], slow[:, dof])
            else:
                finest = motion.spacing[touched[place]].max(initial=0.0)
                known = near[:, place] & motion.usable[:, touched[place]].all(axis=1)
                found = _windows(motion, finest, known, at_no_point)
            averages.append(found)
        return RecordedEquations(
            motion=motion,
            forces=forces,
            has_force=has_force,
            moments=moments,
            averages=tuple(averages),
        )

    def _moments(self, model: Any, points: MotionPoints) -> Array:
        """(n, f, nv) forces on the degrees of freedom per measured force of single actuators."""
        measured = self.measured_forces
        is_single = np.array([not force.is_of_joint for force in measured], dtype=bool)
        moments = np.zeros((len(points.states), len(measured), model.nv))
        if is_single.any():
            addresses = [force.actuator for force in measured if not force.is_of_joint]
            moments[:, is_single] = self.equation.moments(model, points, addresses)
        return moments

    def _forces(self, motion: MeasuredMotion) -> tuple[Array, np.ndarray]:
        """(n, f) measured forces at the points of a motion, and True where they are known."""
        count = len(motion.t)
        forces = np.zeros((count, len(self.measured_forces)))
        near = np.zeros((count, len(self.measured_forces)), dtype=bool)
        reach = REACH * POINTS_PER_INTERVAL * motion.step
        for place, force in enumerate(self.measured_forces):
            values = motion.recording.y[:, force.output]
            if np.isfinite(values).any():
                forces[:, place], near[:, place] = motion.smoothed(values, reach)
        return forces, near

    def _has_friction(self, model: Any) -> np.ndarray:
        """(nv,) True for degrees of freedom on which dry friction may act."""
        found = np.asarray(model.dof_frictionloss > 0.0)
        found[[bristle.dof for bristle in bristles_of(model)]] = True
        for parameter in self.system.parameters.parameters:
            for target in parameter.targets:
                field = target.field
                if isinstance(field, ModelField) and field.array == "dof_frictionloss":
                    found[list(field.rows)] = True
        return found


def friction_speeds(motions: Sequence[MeasuredMotion]) -> Array:
    """Speeds below which the sign of dry friction is not sure.

    Args:
        motions: Motions of all recordings.

    Returns:
        (nv,) speeds [m/s or rad/s].
    """
    sigma = np.max([motion.speed_sigma for motion in motions], axis=0)
    fastest = np.max([np.abs(motion.qvel).max(axis=0) for motion in motions], axis=0)
    return np.asarray(np.maximum(UNSURE_SIGMAS * sigma, SLOW_SHARE * fastest))


def _windows(
    motion: MeasuredMotion, spacing: float, usable: np.ndarray, slow: np.ndarray
) -> Averages:
    """Windows of an equation, most of which are not at rest where that is possible."""
    length = WINDOW_PER_SPACING * max(spacing, motion.step)
    length = min(length, LONGEST_WINDOW * float(motion.t[-1]))
    every = hann_averages(motion.t, length, usable, slow, 1.0)
    for share in SLOW_SHARES:
        found = hann_averages(motion.t, length, usable, slow, share)
        if len(found) >= FEWEST_WINDOWS * len(every):
            return found
    return every


def _equations(system: System, measured: Sequence[MeasuredForce]) -> Iterator[Equation]:
    """Equations of all degrees of freedom, and laws of the actuators whose force is measured."""
    is_translation = translations(system.model)
    for dof, name in enumerate(dof_names(system.model)):
        yield Equation(name=name, unit="N" if is_translation[dof] else "N m", dof=dof)
    for place, force in enumerate(measured):
        if force.has_known_control:
            yield Equation(name=f"law of {force.name}", law=place)
