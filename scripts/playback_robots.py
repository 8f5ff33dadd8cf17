"""Robots that are not the model, and a design played on them; see playback.py.

A delayed control is a delayed measurement: before the start all stands still, so the robot does the same, only later. That holds
with feedback as well, as long as the recorded control is the one that was sent, not the one that has arrived.
"""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from rich.console import Console
from rich.progress import track
from threadpoolctl import threadpool_limits

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, SimulationDivergedError
from mjfim.excitation.constraints import SUBSTEP_KINDS, constraint_set_of
from mjfim.excitation.limits import Limit
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.identification.identify import identify_system
from mjfim.information.marginal import standard_deviations
from mjfim.model.coordinates import joint_dofs, joint_names
from mjfim.plant.batch import BatchSimulator
from mjfim.recordings.design_table import read_playback
from mjfim.records.estimate import Estimate
from mjfim.records.recording import Recording

LATENCY = 5e-3  # [s]
DRAWS = 500  # attempts at a robot that can exist
STILL = 1e-5  # [per s²] acceleration at rest
NEWTON = 50  # steps towards standing still
LAGS = (2e-3, 4e-3, 8e-3, 16e-3)  # [s] where else the search for a delay begins
MOVED = 1e-9  # deviation of a start that counts


@dataclass(frozen=True)
class Conditions:
    """What the robot has that the model has not.

    wrong: share by which every parameter is off;  latency: of the control [s];  feedback: with the gains
    loudness: noise over the stated one;  seed: of everything random
    """

    wrong: float = 0.2
    latency: float = LATENCY
    feedback: bool = False
    loudness: float = 1.0
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Run:
    """One robot. theta, estimate: (p,);  covariance: (p, p);  margins: (l,) worst of each limit over half of its range

    fit: squared residual over its degrees of freedom;  again: the first start of the search ended in a misfit
    trouble: a sentence, or empty
    """

    theta: Array
    estimate: Array
    covariance: Array
    margins: Array
    fit: float
    misfit: bool
    again: bool = False
    trouble: str = ""

    @property
    def std(self) -> Array:
        """(p,)"""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def far(self, chosen: np.ndarray) -> float:
        """Squared distance of the truth from the estimate, of some parameters together: chi-squared distributed.

        chosen: indices
        """
        e = (self.estimate - self.theta)[chosen]
        return float(e @ np.linalg.solve(self.covariance[np.ix_(chosen, chosen)], e))


class Bench:
    """A design, and robots to play it on.

    stated: the experiment as it is;  task: as its recordings are read: on the engine's grid, where a delay is exact, with delay
    and start unknown
    plan: rows of design.csv;  limits: all that are looked at
    """

    def __init__(self, experiment: Experiment, table: Path, conditions: Conditions) -> None:
        self.conditions = conditions
        self.stated = DesignTask.resolve(experiment, threads=1)
        self.plan = read_playback(table, self.stated.system.channels)
        e, timestep = experiment, float(self.stated.system.model.opt.timestep)
        if abs(self.plan.t[-1] - e.horizon) > 0.5 * timestep:
            raise ExperimentError(
                f"{table}: it lasts {self.plan.t[-1]:g} s, the experiment {e.horizon:g} s"
            )
        self.timestep = timestep
        self.every, self.late = (
            round(self.plan.period / timestep),
            round(conditions.latency / timestep),
        )
        if self.late < 0 or abs(conditions.latency - self.late * timestep) > 1e-6 * timestep:
            raise ExperimentError(
                f"latency: {conditions.latency:g} s is no whole number of timesteps of {timestep:g} s"
            )
        self.constraints = constraint_set_of(self.stated)
        self.limits = _looked_at(self.stated)
        self.rest = self._rest()
        self._simulator = BatchSimulator(
            self.stated.system.model_at(self.stated.theta),
            sensors=self.stated.system.outputs.needs_sensors,
            threads=1,
        )
        self.task, self.sensed = self.stated, _sensed(self.stated)
        if conditions.feedback and (self.sensed < 0).all():
            raise ExperimentError(
                "--feedback: no position or velocity of a joint is measured, the gains have nothing to act on"
            )
        self.task = DesignTask.resolve(self._read_as(e), threads=1)

    def _rest(self) -> Array | None:
        """(nu,) control before the start, None where the experiment begins on the move."""
        try:
            return self.stated.initial_hold
        except ExperimentError as error:
            if self.late:
                raise ExperimentError(
                    f"{error}; without a latency (--latency 0) it can be played"
                ) from None
            return None

    def _read_as(self, e: Experiment) -> Experiment:
        """The experiment on the engine's grid, and with the unknowns that playing it adds."""
        nuisance = e.nuisance.model_dump(exclude_unset=True)
        if self.late:
            nuisance["delay"] = nuisance.get("delay") or True
        moved = self._movable()
        if nuisance.get("initial") is None and moved:
            nuisance["initial"] = dict.fromkeys(moved, True)
        rate = {
            "rate": 1.0 / self.timestep,
            "measure_rate": e.measure_rate or e.rate,
            "playback_rate": None,
        }
        return e.replace(nuisance=nuisance, **rate)

    def _movable(self) -> list[str]:
        """Positions at which a robot may stand still elsewhere than the model, because its parameters differ."""
        task, moved = self.stated, np.zeros(self.stated.space.nv, dtype=bool)
        for theta in (
            self._drawn(np.random.default_rng(i)) for i in range(2 * len(task.parameters))
        ):
            start = self._start(task.system.model_at(theta), theta, self.conditions.feedback)
            deviation = task.space.minus(start, task.plant.nominal_initial_state)
            moved |= np.abs(deviation[: task.space.nv]) > MOVED
        return [
            label for label, hit in zip(_dof_labels(task.system.model), moved, strict=True) if hit
        ]

    def _drawn(self, rng: np.random.Generator) -> Array:
        """(p,) parameters of a robot that can exist, its delay and biases too; its start comes later.

        No parameter is off by more than its prior, which says how well it is known, or than bodies can be.
        """
        p, wrong = self.task.parameters, self.conditions.wrong
        size = np.where(p.guess == 0.0, p.scale, np.abs(p.guess))
        known = np.array([0.0 if q.prior is None else q.prior for q in p.parameters])
        reach = np.where(known > 0.0, np.minimum(wrong * size, known), wrong * size)
        for attempt in range(DRAWS):
            off = rng.choice([-1.0, 1.0], len(p)) * reach * 0.9 ** (attempt // len(p))
            theta = np.where(p.changes_model, p.guess + off, known * rng.standard_normal(len(p)))
            theta = self._with_delay(np.clip(theta, p.lower, p.upper))
            if not p.writer.unphysical_bodies(self.task.plant.source, theta):
                return theta
        raise ExperimentError(
            f"{wrong:.0%} wrong parameters make bodies that cannot exist; try less"
        )

    def _with_delay(self, theta: Array) -> Array:
        """theta with the true delay."""
        return np.asarray(
            np.where(self.task.parameters.delay_derivative != 0.0, self.late * self.timestep, theta)
        )

    def _command(self, state: Array, row: int, feedback: bool) -> Array:
        """(nu,) what the controller sends on reading a state."""
        u = self.plan.ctrl[row]
        if feedback:
            u = u + self.plan.gain[row] @ self._deviation(state, row)
        return np.asarray(
            np.clip(u, self.constraints.control.bounds.lower, self.constraints.control.bounds.upper)
        )

    def _deviation(self, state: Array, row: int) -> Array:
        """(nx,) planned minus measured; what is not measured counts as planned."""
        plan, space = self.plan.state[row], self.stated.space
        seen = np.where(self.sensed >= 0, state, plan)
        for q, _ in space.quaternions:
            seen[q : q + 4] /= np.linalg.norm(seen[q : q + 4])
        return space.minus(plan, seen)

    def _before(self, state: Array, feedback: bool) -> Array:
        """(nu,) control before the start; with feedback, what the first gain makes of where the robot stands."""
        if self.rest is None:
            return np.asarray(self.plan.ctrl[0])
        if not feedback:
            return self.rest
        return np.asarray(self.rest + self.plan.gain[0] @ self._deviation(state, 0))

    def _start(self, model: Any, theta: Array, feedback: bool) -> Array:
        """(ns,) where a robot stands still before the start. Raises SimulationDivergedError where it stands nowhere near."""
        space = self.stated.space
        if self.rest is None:
            return self.task.plant.initial_state(theta)
        data, state = mujoco.MjData(model), np.array(self.stated.plant.nominal_initial_state)
        moves = np.delete(np.eye(space.nx), np.arange(space.nv, 2 * space.nv), axis=0)

        def push(x: Array) -> Array:
            data.qpos[:], data.qvel[:], data.act[:] = space.split(x)
            data.ctrl[:] = self._before(x, feedback)
            mujoco.mj_forward(model, data)
            return np.concatenate([data.qacc, data.act_dot])

        for _ in range(NEWTON):
            now = push(state)
            slope = np.stack(
                [
                    push(space.plus(state, 1e-6 * m)) - push(space.plus(state, -1e-6 * m))
                    for m in moves
                ],
                1,
            )
            step = np.linalg.lstsq(slope / 2e-6, -now, rcond=1e-9)[0]
            state = space.plus(state, step @ moves)
            if np.abs(step).max(initial=0.0) < 1e-12:
                break
        left = float(np.abs(push(state)).max(initial=0.0))
        if left <= STILL:
            return state
        if self.late == 0:
            return np.array(self.stated.plant.nominal_initial_state)
        raise SimulationDivergedError(
            f"a robot with other parameters does not stand still at the start (it accelerates by {left:.2g} per s²): "
            + (
                "play without a latency"
                if feedback
                else "play with --feedback, or without a latency"
            )
        )

    def _sent(self, model: Any, start: Array, before: Array, noise: Array, feedback: bool) -> Array:
        """(M, nu) commands. noise: (M+1, ny) of what the controller reads"""
        M = len(self.plan.ctrl)
        if not feedback:
            return np.stack([self._command(start, k, False) for k in range(M)])
        data, space = mujoco.MjData(model), self.stated.space
        data.qpos[:], data.qvel[:], data.act[:] = space.split(start)
        sent, read = np.zeros((M, len(before))), np.flatnonzero(self.sensed >= 0)
        for step in range(M * self.every):
            row, phase = divmod(step, self.every)
            if phase == 0:
                state = np.concatenate([data.qpos, data.qvel, data.act])
                state[read] += noise[row, self.sensed[read]]
                sent[row] = self._command(state, row, True)
            came = (step - self.late) // self.every
            data.ctrl[:] = before if came < 0 else sent[came]
            mujoco.mj_step(model, data)
        return sent

    def run(self, number: int) -> Run:
        """Play on one robot, look at its limits, identify it."""
        rng = np.random.default_rng([self.conditions.seed, number])
        theta = self._drawn(rng)
        noise = self.conditions.loudness * self.task.system.noise.sample(len(self.plan.t), rng)
        blank = np.full(len(theta), np.nan)
        failed = Run(
            theta,
            blank,
            np.full((len(theta),) * 2, np.nan),
            np.full(len(self.limits), -np.inf),
            np.nan,
            True,
        )
        try:
            recording, margins, start = self.play(theta, noise, self.conditions.feedback)
            self._put_start(theta, start)
            estimate, again = self._identified(recording)
        except SimulationDivergedError as error:
            return replace(failed, trouble=str(error))
        fit = estimate.chi2 / estimate.dof
        words = "" if estimate.success else estimate.status
        return Run(
            theta, estimate.theta, estimate.covariance, margins, fit, estimate.misfit, again, words
        )

    def _put_start(self, theta: Array, start: Array) -> None:
        """Write the true deviation of the start into theta, as far as it is an unknown.

        Activations are none: they follow from the control that was sent before the start.
        """
        task, na = self.task, self.task.space.na
        task.plant.nominal_initial_state[len(start) - na :] = start[len(start) - na :]
        matrix = task.parameters.initial_state_derivative(task.space.nx)
        used = matrix.any(axis=0)
        deviation = task.space.minus(start, task.plant.nominal_initial_state)
        theta[used] = np.linalg.lstsq(matrix[:, used], deviation)[0]

    def _identified(self, recording: Recording) -> tuple[Estimate, bool]:
        """The estimate from the guess, and whether it took another start: where one ends in a misfit, others are tried."""
        best = identify_system(self.task.system, [recording])
        if not best.misfit:
            return best, False
        p = self.task.parameters
        starts = [
            p.guess,
            *(
                np.where(p.delay_derivative != 0.0, lag, p.guess)
                for lag in LAGS
                if p.delay_derivative.any()
            ),
        ]
        for start in starts:
            try:
                other = identify_system(self.task.system, [recording], method="newton", start=start)
            except SimulationDivergedError:
                continue
            best = other if other.success and other.chi2 < best.chi2 else best
            if not best.misfit:
                break
        return best, True

    def play(self, theta: Array, noise: Array, feedback: bool) -> tuple[Recording, Array, Array]:
        """The recording of a robot, its margins (l,) over half of their ranges, and its start (ns,).

        noise: (M+1, ny). Raises SimulationDivergedError.
        """
        task, M = self.task, len(self.plan.ctrl)
        model = task.system.model_at(theta)
        start = self._start(model, theta, feedback)
        before = self._before(start, feedback)
        noise = noise + task.parameters.bias_derivative(len(task.system.outputs)) @ theta
        sent = self._sent(model, start, before, noise, feedback)
        applied = np.concatenate(
            [np.tile(before, (self.late, 1)), np.repeat(sent, self.every, axis=0)]
        )
        out = self._simulator.rollout(
            [model], start[None], applied[None], self.constraints.observations
        )
        if not out.finite[0] or out.observed is None:
            raise SimulationDivergedError("the robot's simulation diverges")
        last = M * self.every + 1
        y = task.system.outputs(
            out.states[0, :last], None if out.sensors is None else out.sensors[0, :last]
        )
        y[:: self.every] += noise
        y[task.system.noise.measured(last - 1) == 0.0] = np.nan
        t = np.arange(last, dtype=np.float64) * self.timestep
        recording = Recording(
            t=t,
            ctrl=np.repeat(sent, self.every, axis=0),
            y=y,
            outputs=task.system.outputs.names,
            name="robot",
        )
        margins = self._margins(
            out.observed[0, :, 0], sent, before, out.states[0][:, : task.space.nq], feedback
        )
        return recording, margins, start

    def _margins(
        self, shown: Array, sent: Array, before: Array, qpos: Array, feedback: bool
    ) -> Array:
        """(l,) in the order of the limits. shown, qpos: at every engine step;  sent: (M, nu)"""
        constraints, worst = self.constraints, []
        bounds = constraints.substeps.bounds
        inside = bounds.margin(shown).min(axis=0, initial=np.inf) / bounds.scale
        ahead = round(
            self.task.dt / self.plan.period
        )  # rates are over one sample, as they are in the design
        held = None if constraints.rate is None else constraints.rate.control_after
        after = sent[-1] if feedback or held is None else held
        line = np.concatenate([np.tile(before, (ahead, 1)), sent, np.tile(after, (ahead, 1))])
        rates = (line[ahead:] - line[:-ahead]) / self.task.dt
        for i, limit in enumerate(self.limits):
            if limit.kind in SUBSTEP_KINDS:
                worst.append(float(inside[i]))
            elif limit.kind == "clearance" and constraints.clearance is not None:
                worst.append(
                    constraints.clearance.distances.nearest(qpos)[0] / constraints.clearance.least
                    - 1.0
                )
            else:
                u = (sent if limit.kind == "control" else rates)[:, limit.index]
                worst.append(
                    float(np.minimum(u - limit.lower, limit.upper - u).min()) / limit.scale
                )
        return np.array(worst)

    def planned(self) -> Array:
        """(l,) margins of the plan: on the model, without noise and feedback."""
        silence = np.zeros((len(self.plan.t), len(self.task.system.outputs)))
        return self.play(self._with_delay(self.task.parameters.guess), silence, False)[1]

    def predicted(self) -> Array:
        """(p,) standard deviations before any run: at the guess, along the plan, the delay as it is."""
        task = self.task
        found = task.plant.derivatives.predict(
            self._with_delay(task.parameters.guess), np.repeat(self.plan.ctrl, self.every, axis=0)
        )
        if found is None:
            raise SimulationDivergedError("the plan diverges at the guess")
        J = task.system.noise.whitened_rows(found[1])
        return standard_deviations(J.T @ J + task.parameters.prior_information)


def _looked_at(task: DesignTask) -> tuple[Limit, ...]:
    """All limits, those that are held within samples first, in the order of the observations."""
    within = [limit for kind in SUBSTEP_KINDS for limit in task.limits if limit.kind == kind]
    least = task.experiment.limits.clearance
    near = (
        []
        if least is None
        else [Limit(kind="clearance", name="nearest pair", index=0, lower=least, upper=np.inf)]
    )
    return (*within, *(limit for limit in task.limits if limit.kind not in SUBSTEP_KINDS), *near)


def _dof_labels(model: Any) -> Iterator[str]:
    """nv names of start deviations."""
    for j, name in enumerate(joint_names(model)):
        width = joint_dofs(model, j)
        yield from (f"qpos:{name}" if width == 1 else f"qpos:{name}[{i}]" for i in range(width))


def _sensed(task: DesignTask) -> np.ndarray:
    """(ns,) output that measures each number of the state, -1 where none does."""
    model, found = task.system.model, np.full(task.space.nq + task.space.nv + task.space.na, -1)
    kinds = {
        int(mujoco.mjtSensor.mjSENS_JOINTPOS): 0,
        int(mujoco.mjtSensor.mjSENS_JOINTVEL): task.space.nq,
    }
    encoders = {}
    for i in range(model.nsensor):
        if int(model.sensor_type[i]) in kinds:
            joint, shift = int(model.sensor_objid[i]), kinds[int(model.sensor_type[i])]
            address = model.jnt_dofadr[joint] if shift else model.jnt_qposadr[joint]
            encoders[int(model.sensor_adr[i])] = shift + int(address)
    for i, output in enumerate(task.system.outputs.outputs):
        place = output.state if output.sensor is None else encoders.get(output.sensor)
        if place is not None:
            found[place] = i
    return found


_BENCH: list[Bench] = []


def _begin(experiment: Experiment, table: Path, conditions: Conditions) -> None:
    """A worker's own bench."""
    threadpool_limits(1)
    _BENCH[:] = [Bench(experiment, table, conditions)]


def _one(number: int) -> Run:
    return _BENCH[0].run(number)


def play_all(
    experiment: Experiment, table: Path, conditions: Conditions, count: int, jobs: int
) -> list[Run]:
    """All runs, in parallel."""
    own = (experiment, table, conditions)
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, count), context, _begin, own) as pool:
        console = Console(stderr=True)
        return list(
            track(
                pool.map(_one, range(count)),
                "playing",
                total=count,
                console=console,
                transient=True,
            )
        )
