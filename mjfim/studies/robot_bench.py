"""A bench of simulated robots that differ from the model, on which a design is played.

A delay of the control acts like a delay of the measurement: the robot stands still before it
begins, so that it makes the motion without delay at a later time. This also holds with feedback,
provided that the recorded control is the one that was sent, not the one that has arrived.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, SimulationDivergedError
from mjfim.excitation.limits.constraints import SUBSTEP_KINDS, constraint_set_of
from mjfim.excitation.limits.limits import Limit
from mjfim.excitation.task import DesignTask
from mjfim.experiment.packing import opened_file
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.identify import identify_system
from mjfim.information.criteria import standard_deviations
from mjfim.model.coordinates import tangent_names
from mjfim.model.parameter_writer import ParameterWriter
from mjfim.plant.batch import BatchSimulator
from mjfim.plant.outputs import outputs_by_state
from mjfim.recordings.control_table import read_playback
from mjfim.records.estimate import Estimate
from mjfim.records.studies import RobotConditions, RobotRun
from mjfim.records.trajectory import Recording

# Largest number of attempts to draw a robot whose bodies are physical.
MAX_DRAWS = 500

# Largest acceleration of a robot that counts as standing still, relative to the size of each
# coordinate over the square of the horizon.
MAX_REST_MOVE = 1e-4

# Delays at which further fits start where the first fit ends in a misfit [s].
FURTHER_DELAYS = (2e-3, 4e-3, 8e-3, 16e-3)

# Smallest deviation of an initial position that makes it an unknown.
MIN_START_DEVIATION = 1e-9

# Factor by which the errors of the parameters are reduced after as many unphysical draws as there
# are parameters.
DRAW_SHRINKAGE = 0.9


class RobotBench:
    """A design, and simulated robots on which it is played.

    Attributes:
        conditions: Differences between the robots and the model.
        stated: The task as the experiment states it.
        task: The task for the recordings, with the delay and the initial positions as unknowns. Its
            samples are the steps of the engine, where a delay is exact.
        plan: Rows of design.csv.
        timestep: Timestep of the engine [s].
        steps_per_row: Number of engine steps per row of the plan.
        late_steps: Number of engine steps by which the control is late.
        constraints: Constraints of the stated task.
        limits: All l limits that are checked.
        rest: (nu,) control before the motion begins [unit of the actuator]; None where the
            experiment begins in motion.
        sensed: (ns,) index of the output that measures each entry of the state; -1 where no output
            measures it.
    """

    def __init__(self, experiment: Experiment, table: Path, conditions: RobotConditions) -> None:
        """Read the design and resolve the experiment.

        Args:
            experiment: The experiment of the design.
            table: The design.csv.
            conditions: Differences between the robots and the model.

        Raises:
            ExperimentError: The duration of the design is not that of the experiment, or the
                conditions cannot be simulated.
            RecordingError: The design cannot be read.
        """
        conditions.check()
        self.conditions = conditions
        stated = DesignTask.resolve(experiment, threads=1)
        with opened_file(experiment, table) as file:
            self.plan = read_playback(file, stated.system.channels)
        self.stated = stated.released_as(self.plan.state[0])
        self.timestep = float(self.stated.system.model.opt.timestep)

        duration = float(self.plan.t[-1])
        if abs(duration - self.stated.horizon) > 0.5 * self.timestep:
            raise ExperimentError(
                f"{table}: the design lasts {duration:g} s, the experiment "
                f"{self.stated.horizon:g} s; give the design of this experiment"
            )

        # A later control would never act.
        if conditions.latency > duration:
            raise ExperimentError(
                f"latency: {conditions.latency:g} s is longer than the design, which lasts "
                f"{duration:g} s; state a shorter delay"
            )

        self.steps_per_row = round(self.plan.period / self.timestep)
        self.late_steps = round(conditions.latency / self.timestep)
        remainder = abs(conditions.latency - self.late_steps * self.timestep)
        if self.late_steps < 0 or remainder > 1e-6 * self.timestep:
            raise ExperimentError(
                f"latency: {conditions.latency:g} s is no whole number of timesteps of "
                f"{self.timestep:g} s; state a multiple of the timestep"
            )

        self.constraints = constraint_set_of(self.stated)

        # First the limits on observed quantities, in the order of the observations.
        stated_limits = self.stated.limits
        within = [limit for kind in SUBSTEP_KINDS for limit in stated_limits if limit.kind == kind]
        others = [limit for limit in stated_limits if limit.kind not in SUBSTEP_KINDS]
        nearest = self.constraints.clearance
        if nearest is not None:
            others.append(
                Limit(
                    kind="clearance",
                    name="nearest pair",
                    index=0,
                    lower=nearest.least,
                    upper=np.inf,
                    size=nearest.scale,
                )
            )
        self.limits = (*within, *others)

        # The controls of a robot arrive late, at any engine step, so its samples are engine steps.
        self._observations = self.constraints.observations.of_single_steps()
        self._simulator = BatchSimulator(
            self.stated.system.model_at(self.stated.theta),
            sensors=self.stated.system.outputs.needs_sensors,
            threads=1,
        )

        self.rest = self._rest_control()
        space = self.stated.space
        self.sensed = np.full(space.nq + space.nv + space.na, -1)
        for entry, output in outputs_by_state(
            self.stated.system.model, self.stated.system.outputs
        ).items():
            self.sensed[entry] = output
        if conditions.feedback and (self.sensed < 0).all():
            raise ExperimentError(
                "--feedback: the gains need a measured position or velocity of a joint, and the "
                "experiment measures none"
            )

        # Robots are first drawn with the stated unknowns, to find the initial positions that depend
        # on the parameters. These become unknowns of the task for the recordings.
        self.task = self.stated
        recorded = DesignTask.resolve(self._experiment_of_recordings(experiment), threads=1)
        self.task = recorded.released_as(self.plan.state[0])

    # ---- the experiment for the recordings

    def _rest_control(self) -> Array | None:
        """Control before the motion begins.

        Returns:
            (nu,) control [unit of the actuator]; None where the experiment begins in motion, and
            where there are no actuators.

        Raises:
            ExperimentError: The experiment begins in motion, but the conditions have a latency.
        """
        if not self.stated.controls:
            return None
        try:
            return self.stated.initial_hold
        except ExperimentError as error:
            if self.late_steps:
                raise ExperimentError(
                    f"{error}; the design can be played without a latency only (--latency 0)"
                ) from None
            return None

    def _experiment_of_recordings(self, stated: Experiment) -> Experiment:
        """The experiment with one sample per engine step, and with the unknowns of the robots."""
        nuisance = stated.nuisance.model_dump(exclude_unset=True)
        if self.late_steps:
            nuisance["delay"] = nuisance.get("delay") or True

        movable = self._movable_positions()
        if nuisance.get("initial") is None and movable:
            nuisance["initial"] = dict.fromkeys(movable, True)

        return stated.replace(
            nuisance=nuisance,
            rate=1.0 / self.timestep,
            measure_rate=stated.measure_rate or stated.rate,
            playback_rate=None,
        )

    def _movable_positions(self) -> list[str]:
        """Names of the initial positions that depend on the parameters of a robot.

        They are found from robots that are drawn at random.
        """
        task = self.stated
        moved = np.zeros(task.space.nv, dtype=bool)

        for seed in range(2 * len(task.parameters)):
            theta = self._drawn(np.random.default_rng(seed))
            start = self._start(task.system.model_at(theta), theta, self.conditions.feedback)
            deviation = task.space.minus(start, task.plant.nominal_initial_state)
            moved |= np.abs(deviation[: task.space.nv]) > MIN_START_DEVIATION

        names = tangent_names(task.system.model)[: task.space.nv]
        return [name for name, has_moved in zip(names, moved, strict=True) if has_moved]

    # ---- robots

    def _drawn(self, rng: np.random.Generator) -> Array:
        """Draw the parameters of a robot whose bodies are physical.

        No error of a parameter is larger than the standard deviation of its prior. Errors are
        reduced where the bodies would be unphysical.

        Args:
            rng: Random numbers.

        Returns:
            (p,) parameters, with delay and biases, but without deviations of the initial state
            [theta-unit].

        Raises:
            ExperimentError: No physical robot was found.
        """
        p = self.task.parameters
        wrong = self.conditions.wrong
        size = np.where(p.guess == 0.0, p.scale, np.abs(p.guess))
        prior = np.array([0.0 if q.prior is None else q.prior for q in p.parameters])
        reach = np.where(prior > 0.0, np.minimum(wrong * size, prior), wrong * size)

        for attempt in range(MAX_DRAWS):
            shrinkage = DRAW_SHRINKAGE ** (attempt // len(p))
            error = rng.choice([-1.0, 1.0], len(p)) * reach * shrinkage
            theta = np.where(p.changes_model, p.guess + error, prior * rng.standard_normal(len(p)))
            theta = self._with_delay(np.clip(theta, p.lower, p.upper))
            if not ParameterWriter(p).unphysical_bodies(self.task.plant.source, theta):
                return theta

        raise ExperimentError(
            f"errors of {wrong:.0%} in the parameters lead to unphysical bodies; state a smaller "
            "error"
        )

    def _with_delay(self, theta: Array) -> Array:
        """(p,) parameters with the true delay [theta-unit]."""
        delay = self.late_steps * self.timestep
        is_delay = self.task.parameters.delay_derivative != 0.0
        return np.asarray(np.where(is_delay, delay, theta))

    def _start(self, model: Any, theta: Array, feedback: bool) -> Array:
        """Initial state of a robot: its equilibrium near the initial state of the model.

        Args:
            model: Model of the robot.
            theta: (p,) parameters of the robot [theta-unit].
            feedback: Whether the gains act.

        Returns:
            (ns,) initial state; that of the model where there is no equilibrium and no latency.

        Raises:
            SimulationDivergedError: There is no equilibrium, and the control is late.
        """
        if self.rest is None:
            return self.task.plant.initial_state(theta)

        state, acceleration, moves = self._equilibrium(model, feedback)
        if moves <= MAX_REST_MOVE:
            return state
        if self.late_steps == 0:
            return np.array(self.stated.plant.nominal_initial_state)

        advice = (
            "play without a latency" if feedback else "play with --feedback, or without a latency"
        )
        raise SimulationDivergedError(
            "a robot with other parameters does not stand still at the start "
            f"(it accelerates by {acceleration:.2g} per s²): {advice}"
        )

    def _equilibrium(self, model: Any, feedback: bool) -> tuple[Array, float, float]:
        """Find an equilibrium of a robot near the initial state of the model.

        Args:
            model: Model of the robot.
            feedback: Whether the first gain acts on the state.

        Returns:
            (ns,) state, the largest acceleration that is left, and the same relative to the size of
            its coordinate over the square of the horizon.
        """
        space, sizes = self.stated.space, self.stated.plant.sizes
        data = mujoco.MjData(model)
        nominal = np.array(self.stated.plant.nominal_initial_state)
        # Positions and activations may change by multiples of their sizes; velocities stay zero.
        directions = np.delete(np.diag(sizes.state), np.arange(space.nv, 2 * space.nv), axis=0)
        time = self.stated.horizon
        rates = np.concatenate([sizes.position / time**2, sizes.activation / time])

        def relative_rates(move: Array) -> Array:
            """Accelerations and rates of the activations after a move, relative to their sizes."""
            state = space.plus(nominal, move @ directions)
            data.qpos[:], data.qvel[:], data.act[:] = space.split(state)
            data.ctrl[:] = self._before_start(state, feedback)
            mujoco.mj_forward(model, data)
            return np.asarray(np.concatenate([data.qacc, data.act_dot]) / rates)

        still = np.zeros(len(directions))
        move = scipy.optimize.least_squares(
            relative_rates, still, jac="3-point", xtol=1e-14, ftol=1e-15, gtol=1e-15, max_nfev=50
        ).x
        found = np.abs(relative_rates(move))
        state = space.plus(nominal, move @ directions)
        return state, float((found * rates).max(initial=0.0)), float(found.max(initial=0.0))

    # ---- one robot

    def run(self, number: int) -> RobotRun:
        """Play the design on one robot, check the limits, and identify the robot.

        Args:
            number: Number of the robot. This number and the seed of the conditions determine all
                random numbers.
        """
        rng = np.random.default_rng([self.conditions.seed, number])
        theta = self._drawn(rng)
        noise = self.conditions.loudness * self.task.system.noise.sample(len(self.plan.t), rng)

        try:
            recording, margins, start = self.play(theta, noise, self.conditions.feedback)
            system, na = self.task.system, self.task.space.na
            # The recording begins with the activations of the robot. These are no unknowns, because
            # they follow from the control before the motion begins.
            if na:
                state = np.array(system.plant.nominal_initial_state)
                state[-na:] = start[-na:]
                system = replace(
                    system,
                    nominal_initial_state=state,
                    plant=system.plant.with_initial_state(state),
                )

            # The true deviations of the initial state, as far as they are unknowns.
            matrix = system.parameters.initial_state_derivative(system.space.nx)
            used = matrix.any(axis=0)
            deviation = system.space.minus(start, system.plant.nominal_initial_state)
            theta[used] = np.linalg.lstsq(matrix[:, used], deviation)[0]
            estimate, restarted = self._identified(recording, system)
        except SimulationDivergedError as error:
            return RobotRun(
                theta=theta,
                estimate=np.full(len(theta), np.nan),
                covariance=np.full((len(theta), len(theta)), np.nan),
                margins=np.full(len(self.limits), -np.inf),
                fit=np.nan,
                misfit=True,
                trouble=str(error),
            )

        return RobotRun(
            theta=theta,
            estimate=estimate.theta,
            covariance=estimate.covariance,
            margins=margins,
            fit=estimate.chi2 / estimate.dof,
            misfit=estimate.misfit,
            restarted=restarted,
            trouble="" if estimate.success else estimate.status,
        )

    def _identified(self, recording: Recording, system: System) -> tuple[Estimate, bool]:
        """Identify a robot from its recording.

        Where the fit from the guess is a misfit, further fits start at other delays.

        Returns:
            The best estimate, and True if there were further fits.
        """
        best = identify_system(system, [recording])
        if not best.misfit:
            return best, False

        p = system.parameters
        starts = [p.guess]
        if p.delay_derivative.any():
            is_delay = p.delay_derivative != 0.0
            starts += [np.where(is_delay, delay, p.guess) for delay in FURTHER_DELAYS]

        for start in starts:
            try:
                other = identify_system(system, [recording], method="newton", start=start)
            except SimulationDivergedError:
                continue

            if other.success and other.chi2 < best.chi2:
                best = other
            if not best.misfit:
                break

        return best, True

    def play(self, theta: Array, noise: Array, feedback: bool) -> tuple[Recording, Array, Array]:
        """Play the plan on one robot.

        Args:
            theta: (p,) parameters of the robot [theta-unit].
            noise: (M+1, ny) noise of the outputs at the rows of the plan [y-unit].
            feedback: Whether the gains act.

        Returns:
            The recording, (l,) margins divided by half of their ranges, and (ns,) initial state of
            the robot.

        Raises:
            SimulationDivergedError: The simulation diverges, or the robot does not stand still at
                the start.
        """
        task, rows = self.task, len(self.plan.ctrl)
        model = task.system.model_at(theta)
        start = self._start(model, theta, feedback)
        before = self._before_start(start, feedback)
        noise = noise + task.system.plant.calibration.bias @ theta
        sent = self._sent(model, start, before, noise, feedback)

        # The control arrives late. Until then the robot gets the control before the motion begins.
        held = np.repeat(sent, self.steps_per_row, axis=0)
        applied = np.concatenate([np.tile(before, (self.late_steps, 1)), held])
        out = self._simulator.rollout([model], start[None], applied[None], self._observations)
        if not out.finite[0] or out.observed is None:
            raise SimulationDivergedError("the robot's simulation diverges")

        # Noise is added at the rows of the plan; samples that are not measured are NaN.
        last = rows * self.steps_per_row + 1
        sensors = None if out.sensors is None else out.sensors[0, :last]
        h = task.system.outputs(out.states[0, :last], sensors)
        y = task.system.plant.calibration.factor(theta) * h
        y[:: self.steps_per_row] += noise
        y[task.system.noise.measured(last - 1) == 0.0] = np.nan

        recording = Recording(
            t=np.arange(last, dtype=np.float64) * self.timestep,
            ctrl=held,
            y=y,
            outputs=task.system.outputs.names,
            name="robot",
        )
        qpos = out.states[0][:, : task.space.nq]
        margins = self._margins(out.observed[0], sent, before, qpos, feedback)
        return recording, margins, start

    def _margins(
        self, observed: Array, sent: Array, before: Array, qpos: Array, feedback: bool
    ) -> Array:
        """Smallest margins of all limits.

        Args:
            observed: (n, rows, w) observations at every engine step, with further rows of forces.
            sent: (M, nu) controls that were sent [unit of the actuator].
            before: (nu,) control before the motion begins [unit of the actuator].
            qpos: (n+1, nq) positions at every engine step.
            feedback: True where the controller uses the gains.

        Returns:
            (l,) margins, divided by half of their ranges.
        """
        constraints = self.constraints
        bounds = constraints.substeps.bounds
        quantities = constraints.substeps.quantities(observed)
        inside = bounds.margin(quantities).min(axis=(0, 1), initial=np.inf) / bounds.scale

        # Rates from row to row of design.csv, with the change from the control before the motion,
        # and the change to the control after its end.
        after = None if feedback or constraints.rate is None else constraints.rate.control_after
        after = sent[-1] if after is None else after
        changes = np.diff(sent, axis=0, prepend=before[None], append=after[None])
        rates = changes / self.plan.period

        margins = []
        for i, limit in enumerate(self.limits):
            if limit.kind in SUBSTEP_KINDS:
                margins.append(float(inside[i]))
            elif limit.kind == "clearance" and constraints.clearance is not None:
                nearest = constraints.clearance.distances.nearest(qpos)[0]
                margins.append((nearest - limit.lower) / limit.scale)
            else:
                values = (sent if limit.kind == "control" else rates)[:, limit.index]
                margin = np.minimum(values - limit.lower, limit.upper - values).min()
                margins.append(float(margin) / limit.scale)

        return np.array(margins)

    # ---- the controller, with or without feedback

    def _before_start(self, state: Array, feedback: bool) -> Array:
        """Control before the motion; with feedback, the first gain acts on the state.

        Args:
            state: (ns,) state in which the robot stands.
            feedback: Whether the gains act.

        Returns:
            (nu,) control [unit of the actuator].
        """
        if self.rest is None:
            return np.asarray(self.plan.ctrl[0])
        if not feedback:
            return self.rest
        return np.asarray(self.rest + self.plan.gain[0] @ self._deviation(state, 0))

    def _sent(self, model: Any, start: Array, before: Array, noise: Array, feedback: bool) -> Array:
        """Controls that the controller sends.

        Args:
            model: Model of the robot.
            start: (ns,) initial state of the robot.
            before: (nu,) control before the motion begins [unit of the actuator].
            noise: (M+1, ny) noise of the outputs that the controller reads [y-unit].
            feedback: Whether the gains act.

        Returns:
            (M, nu) controls [unit of the actuator].
        """
        rows = len(self.plan.ctrl)
        if not feedback:
            return self._clipped(self.plan.ctrl)

        data = mujoco.MjData(model)
        qpos, qvel, act = self.stated.space.split(start)
        data.qpos[:] = qpos
        data.qvel[:] = qvel
        data.act[:] = act

        sent = np.zeros((rows, len(before)))
        read = np.flatnonzero(self.sensed >= 0)

        for step in range(rows * self.steps_per_row):
            row, phase = divmod(step, self.steps_per_row)
            if phase == 0:
                state = np.concatenate([data.qpos, data.qvel, data.act])
                state[read] += noise[row, self.sensed[read]]
                move = self.plan.gain[row] @ self._deviation(state, row)
                sent[row] = self._clipped(self.plan.ctrl[row] + move)

            arrived = (step - self.late_steps) // self.steps_per_row
            data.ctrl[:] = before if arrived < 0 else sent[arrived]
            mujoco.mj_step(model, data)

        return sent

    def _clipped(self, control: Array) -> Array:
        """Controls in the ranges to which the controller clips [unit of the actuator]."""
        bounds = self.constraints.control.bounds
        return np.asarray(np.clip(control, bounds.lower, bounds.upper))

    def _deviation(self, state: Array, row: int) -> Array:
        """(nx,) planned minus measured state; zero for entries that are not measured."""
        planned = self.plan.state[row]
        measured = np.where(self.sensed >= 0, state, planned)
        for q, _ in self.stated.space.quaternions:
            measured[q : q + 4] /= np.linalg.norm(measured[q : q + 4])

        return self.stated.space.minus(planned, measured)

    # ---- predictions of the model

    def planned(self) -> Array:
        """(l,) margins of the plan on the model, divided by half of their ranges.

        They are computed without noise and without feedback.
        """
        no_noise = np.zeros((len(self.plan.t), len(self.task.system.outputs)))
        theta = self._with_delay(self.task.parameters.guess)
        _, margins, _ = self.play(theta, no_noise, False)
        return margins

    def predicted(self) -> Array:
        """(p,) predicted standard deviations at the guess with the true delay [theta-unit]."""
        task = self.task
        theta = self._with_delay(task.parameters.guess)
        control = np.repeat(self.plan.ctrl, self.steps_per_row, axis=0)
        found = task.plant.derivatives.predict(theta, control)
        if found is None:
            raise SimulationDivergedError("the plan diverges when it is simulated at the guess")

        J = task.system.noise.whitened_rows(found[1])
        return standard_deviations(J.T @ J + task.parameters.prior_information)
