"""The equation of motion along measured motions, as rows of a least-squares problem.

There is an equation for each degree of freedom: the force that the measured motion needs, less that
of the actuators. Where a recording holds the force of an actuator, the measured force takes the
place of the model's, and the law of the actuator is a further equation. The equations are averaged
over windows (`averages`) that are longer where the motion is known less exactly.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.measured_forces import MeasuredForce
from mjfim.identification.measured_motion import measured_motion
from mjfim.identification.recorded_equations import (
    Equation,
    EquationModel,
    RecordedEquations,
    friction_speeds,
)
from mjfim.model.control_laws import ControlLaws
from mjfim.model.variants import RELAXED, Relaxation
from mjfim.plant.equation_of_motion import EquationTerms

# Points at which all equations of all recordings are evaluated, at most.
MOST_POINTS = 20_000


@dataclass(frozen=True, kw_only=True, eq=False)
class Rows:
    """Averages of all equations along all recordings, at one value of the parameters.

    Attributes:
        residual: (R,) residuals, equation by equation [N or N m].
        explained: (R,) forces that the model needs, or its forces of actuators.
        measured: (R,) forces with which these are compared.
        inertial: (R,) inertial part of the forces that the motion needs; zero for laws.
    """

    residual: Array
    explained: Array
    measured: Array
    inertial: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class MotionEquations:
    """The equations along all recordings as functions of the parameters.

    Attributes:
        model: The system that is evaluated.
        recorded: The equations along each recording.
    """

    model: EquationModel
    recorded: tuple[RecordedEquations, ...]

    @staticmethod
    def of(
        system: System,
        recordings: Sequence[AlignedRecording],
        theta: Array,
        *,
        forces: tuple[MeasuredForce, ...],
        laws: ControlLaws | None,
    ) -> MotionEquations:
        """The equations along recordings.

        Args:
            system: The system that was recorded, without control laws.
            recordings: The recordings.
            theta: (p,) parameters at which the windows are chosen.
            forces: Forces of actuators that are measured in a recording.
            laws: Laws that have computed controls of the recordings; None without any.

        Returns:
            The equations.

        Raises:
            RecordingError: A degree of freedom was not measured.
        """
        durations = np.array([float(recording.t[-1]) for recording in recordings])
        shares = MOST_POINTS * durations / durations.sum()
        motions = [
            measured_motion(system, recording, theta, max(int(share), 2))
            for recording, share in zip(recordings, shares, strict=True)
        ]
        model = EquationModel(
            system=system.with_variant(RELAXED, Relaxation(constraints=True)),
            measured_forces=forces,
            laws=laws,
            friction_speeds=friction_speeds(motions),
        )

        # Contacts and stops act in the stated model.
        stated = EquationModel(
            system=system, measured_forces=(), laws=laws, friction_speeds=model.friction_speeds
        )
        recorded = []
        for motion in motions:
            compiled = system.plant.model(theta)
            points = stated.points(
                motion, compiled, theta, stated.activations([compiled], motion)[0]
            )
            constrained = stated.equation.constrained(compiled, points)
            recorded.append(model.recorded(motion, theta, constrained))
        return MotionEquations(model=model, recorded=tuple(recorded))

    @property
    def equations(self) -> tuple[Equation, ...]:
        """The equations."""
        return self.model.equations

    # ---- rows

    @property
    def counts(self) -> np.ndarray:
        """(E,) number of rows of each equation."""
        return np.array(
            [
                sum(len(each.averages[i]) for each in self.recorded)
                for i in range(len(self.equations))
            ]
        )

    @property
    def equation_of_row(self) -> np.ndarray:
        """(R,) index of the equation of each row."""
        return np.repeat(np.arange(len(self.equations)), self.counts)

    @property
    def recording_of_row(self) -> np.ndarray:
        """(R,) index of the recording of each row."""
        parts = [
            np.full(len(each.averages[i]), k)
            for i in range(len(self.equations))
            for k, each in enumerate(self.recorded)
        ]
        return np.concatenate(parts) if parts else np.zeros(0, dtype=int)

    @property
    def times(self) -> Array:
        """(R,) time of each row [s]."""
        parts = [each.averages[i].t for i in range(len(self.equations)) for each in self.recorded]
        return np.concatenate(parts)

    def cutoff(self, equation: int) -> float:
        """Frequency up to which an equation is used, the lowest of all recordings [Hz].

        Args:
            equation: Index of the equation.
        """
        return 1.0 / max(each.averages[equation].length for each in self.recorded)

    def rows(self, thetas: Array) -> list[Rows]:
        """Rows at several values of the parameters.

        Args:
            thetas: (m, p) parameters [theta-unit].

        Returns:
            The rows at each value; NaN where a model cannot be compiled.
        """
        plant = self.model.system.plant
        models, compiled = plant.try_models(thetas)
        found: list[list[Rows]] = [[] for _ in thetas]
        for each in self.recorded:
            act = self.model.activations(models, each.motion)
            for k, (model, theta) in enumerate(zip(models, thetas, strict=True)):
                points = self.model.points(each.motion, model, theta, act[min(k, len(act) - 1)])
                terms = self.model.equation.terms(model, points)
                found[k].append(self._averaged(each, terms))
        return [self._joined(parts, bool(ok)) for parts, ok in zip(found, compiled, strict=True)]

    # ---- parts of it

    def _averaged(self, each: RecordedEquations, terms: EquationTerms) -> Rows:
        """Averages of the equations along one recording, equation by equation."""
        measured = np.array(terms.actuation)
        for place in np.flatnonzero(each.has_force).tolist():
            force, values = self.model.measured_forces[place], each.forces[:, place]
            if force.is_of_joint:
                measured[:, force.dof] = values
            else:
                error = values - terms.actuator_force[:, force.actuator]
                measured += error[:, None] * each.moments[:, place]

        parts: list[list[Array]] = [[], [], []]
        for equation, averages in zip(self.equations, each.averages, strict=True):
            if equation.dof >= 0:
                series = [terms.needed, measured, terms.inertial]
                columns = [values[:, equation.dof] for values in series]
            else:
                columns = [
                    self._law(terms, equation.law),
                    each.forces[:, equation.law],
                    np.zeros(len(measured)),
                ]
            for part, column in zip(parts, columns, strict=True):
                part.append(averages.of(column))
        explained, compared, inertial = (np.concatenate(part) for part in parts)
        return Rows(
            residual=explained - compared,
            explained=explained,
            measured=compared,
            inertial=inertial,
        )

    def _law(self, terms: EquationTerms, place: int) -> Array:
        """(n,) force of the model that a measured force corresponds to."""
        force = self.model.measured_forces[place]
        if force.is_of_joint:
            return np.asarray(terms.actuation[:, force.dof])
        return np.asarray(terms.actuator_force[:, force.actuator])

    def _joined(self, parts: Sequence[Rows], compiled: bool) -> Rows:
        """Rows of all recordings, equation by equation."""
        ends = [np.cumsum([len(a) for a in each.averages])[:-1] for each in self.recorded]

        def joined(name: str) -> Array:
            """One field of the rows."""
            pieces = [
                np.split(getattr(part, name), end) for part, end in zip(parts, ends, strict=True)
            ]
            values = np.concatenate(
                [piece[i] for i in range(len(self.equations)) for piece in pieces]
            )
            return values if compiled else np.full_like(values, np.nan)

        return Rows(
            residual=joined("residual"),
            explained=joined("explained"),
            measured=joined("measured"),
            inertial=joined("inertial"),
        )
