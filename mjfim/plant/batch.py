"""The batch: many MuJoCo simulations in one call, Python never in the inner loop. Counts every step it takes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from mjfim.arrays import Array
from mjfim.model.mujoco_log import silence_mujoco_log
from mjfim.parallel import cores
from mjfim.plant.state_space import StateSpace

RECORDED_STATE = int(
    mujoco.mjtState.mjSTATE_TIME
    | mujoco.mjtState.mjSTATE_QPOS
    | mujoco.mjtState.mjSTATE_QVEL
    | mujoco.mjtState.mjSTATE_ACT
)


# MuJoCo resets a state it finds bad, time included: starting late makes that visible at any sample.
START_TIME = 1.0
# Larger controls MuJoCo replaces by zero.
MAX_CONTROL = float(mujoco.mjMAXVAL)
CLOCK_SENSOR = int(mujoco.mjtSensor.mjSENS_CLOCK)
SMALL_BATCH = (
    64  # rollouts of a handful of models keep their own batch beside those of a Monte-Carlo study
)


def state_space(model: Any) -> StateSpace:
    """Layout of a model's state."""
    scalar_q, scalar_v, quaternions = [], [], []
    for j in range(model.njnt):
        q, v, kind = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j]), int(model.jnt_type[j])
        if kind == int(mujoco.mjtJoint.mjJNT_FREE):
            scalar_q += [q, q + 1, q + 2]
            scalar_v += [v, v + 1, v + 2]
            quaternions.append((q + 3, v + 3))
        elif kind == int(mujoco.mjtJoint.mjJNT_BALL):
            quaternions.append((q, v))
        else:
            scalar_q.append(q)
            scalar_v.append(v)
    return StateSpace(
        model.nq,
        model.nv,
        model.na,
        np.array(scalar_q, np.intp),
        np.array(scalar_v, np.intp),
        tuple(quaternions),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class SubstepObservations:
    """What is looked at between the samples, w numbers per engine step: addresses or dofs of each kind, side by side.

    q: positions, v: velocities after the step;  a: change of velocity over the step, per second
    f: actuator forces, j: joint forces of the actuators, during the step
    substeps: engine steps of a sample that derivatives look at, counted from 1;  timestep: [s]
    """

    positions: np.ndarray
    velocities: np.ndarray
    accelerations: np.ndarray
    actuator_forces: np.ndarray
    joint_forces: np.ndarray
    derivative_substeps: tuple[int, ...]
    timestep: float

    @property
    def fields(self) -> tuple[str, ...]:
        """MjData fields that are recorded beside the state."""
        return ("actuator_force",) * bool(len(self.actuator_forces)) + ("qfrc_actuator",) * bool(
            len(self.joint_forces)
        )

    def values(
        self, qpos: Array, qvel: Array, before: Array, read: Callable[[str], Array]
    ) -> Array:
        """(..., w) from states after a step, velocities before it, and a reader of MjData fields."""
        parts = [
            qpos[..., self.positions],
            qvel[..., self.velocities],
            (qvel[..., self.accelerations] - before[..., self.accelerations]) / self.timestep,
        ]
        if len(self.actuator_forces):
            parts.append(read("actuator_force")[..., self.actuator_forces])
        if len(self.joint_forces):
            parts.append(read("qfrc_actuator")[..., self.joint_forces])
        return np.concatenate(parts, axis=-1)


@dataclass(frozen=True, eq=False)
class Rollouts:
    """Many simulated curves.

    states: (m, N+1, ns);  sensors: (m, N+1, nsensordata) or None;  finite: (m,) False = diverged
    observed: (m, N, substeps, w) at every engine step, or None
    """

    states: Array
    sensors: Array | None
    finite: np.ndarray
    observed: Array | None = None


@dataclass(frozen=True, eq=False)
class Stepped:
    """One sample of many simulations. states: (n, ns) after it;  sensors: (n, nsensordata) before it, or None

    observed: (n, looked-at substeps, w), or None
    """

    states: Array
    sensors: Array | None
    observed: Array | None


class BatchSimulator:
    """Steps many simulations of models that share one layout.

    model: the caller's private copy;  substeps: `mj_step` calls per sample;  sensors: whether sensor data is wanted
    steps: `mj_step` calls so far
    """

    def __init__(
        self, model: Any, substeps: int = 1, sensors: bool = False, threads: int | None = None
    ) -> None:
        self.model = model
        self.space = state_space(model)
        self.substeps = substeps
        self.sensors = sensors
        self.threads = threads or cores()
        self.steps = 0
        self._batches: dict[str, Batch] = {}
        self._data = mujoco.MjData(model)
        self._clocks = model.sensor_adr[model.sensor_type == CLOCK_SENSOR]
        self._mocap = np.flatnonzero(model.body_mocapid >= 0)[
            np.argsort(model.body_mocapid[model.body_mocapid >= 0])
        ]

    def _batch(self, kind: str, count: int) -> Batch:
        """A batch of at least `count` simulations; making one costs milliseconds, so it grows and is kept."""
        batch = self._batches.get(kind)
        if batch is None or batch.nsim < count:
            batch = self._batches[kind] = Batch(self.model, count, min(self.threads, count))
        return batch

    def _load(self, batch: Batch, states: Array, models: Sequence[Any]) -> np.ndarray | None:
        """Write states into the first simulations of a batch; returns their ids, None for all of them."""
        n = len(states)
        qpos, qvel, act = self.space.split(states)
        batch.bind("qpos")[:n] = qpos
        batch.bind("qvel")[:n] = qvel
        if self.space.na:
            batch.bind("act")[:n] = act
        batch.bind("qacc_warmstart")[:n] = 0.0
        batch.bind("time")[:n] = START_TIME
        if len(self._mocap):  # a batch keeps the places of the model that it was made with
            mocap_pos, mocap_quat = batch.bind("mocap_pos"), batch.bind("mocap_quat")
            for i, model in enumerate(models):
                own = slice(None, n) if len(models) == 1 else i
                mocap_pos[own], mocap_quat[own] = (
                    model.body_pos[self._mocap],
                    model.body_quat[self._mocap],
                )
        return None if n == batch.nsim else np.arange(n)

    def step(
        self,
        models: Sequence[Any],
        states: Array,
        ctrl: Array,
        observations: SubstepObservations | None = None,
    ) -> Stepped:
        """One sample of every simulation.

        states: (n, ns);  ctrl: (n, nu), held. Each model steps its equal, contiguous share. Diverged simulations are NaN.
        """
        share = len(states) // len(models)
        parts = [
            self._share(
                model,
                states[i * share : (i + 1) * share],
                ctrl[i * share : (i + 1) * share],
                observations,
            )
            for i, model in enumerate(models)
        ]
        sensed = (
            np.concatenate([p.sensors for p in parts if p.sensors is not None])
            if self.sensors
            else None
        )
        observed = (
            None
            if observations is None
            else np.concatenate([p.observed for p in parts if p.observed is not None])
        )
        return Stepped(np.concatenate([p.states for p in parts]), sensed, observed)

    def _share(
        self, model: Any, states: Array, ctrl: Array, observations: SubstepObservations | None
    ) -> Stepped:
        count = len(states)
        batch = self._batch("step", count)
        batch.set_models(model)
        ids = self._load(batch, states, [model])
        batch.bind("ctrl")[:count] = ctrl
        looks = () if observations is None else observations.derivative_substeps
        sensed, done, observed = None, 0, []
        if self.sensors:
            batch.bind("sensordata")
        for name in () if observations is None else observations.fields:
            batch.bind(name)
        with silence_mujoco_log():
            for stop in sorted({*looks, *((1,) if self.sensors else ()), self.substeps}):
                if stop - done > 1 and stop in looks:
                    batch.step(ids, nstep=stop - done - 1)
                    done = stop - 1
                before = (
                    np.array(batch.bind("qvel")[:count])
                    if observations is not None and len(observations.accelerations)
                    else np.empty((0, 0))
                )
                batch.step(ids, nstep=stop - done)
                done = stop
                if self.sensors and stop == 1:
                    sensed = self._sensed(batch.bind("sensordata")[:count])
                if observations is not None and stop in looks:
                    before = (
                        before if len(observations.accelerations) else batch.bind("qvel")[:count]
                    )
                    now = (batch.bind("qpos")[:count], batch.bind("qvel")[:count], before)
                    observed.append(
                        observations.values(*now, lambda name: batch.bind(name)[:count])
                    )
        self.steps += self.substeps * count
        names = ("qpos", "qvel", "act") if self.space.na else ("qpos", "qvel")
        out = np.concatenate([batch.bind(name)[:count] for name in names], axis=1)
        timestep = float(self.model.opt.timestep)
        elapsed = batch.bind("time").reshape(-1)[:count] - START_TIME
        bad = np.abs(elapsed - self.substeps * timestep) > 0.5 * timestep
        out[bad | ~_acceptable(ctrl).all(axis=1)] = np.nan
        return Stepped(out, sensed, np.stack(observed, axis=1) if observed else None)

    def rollout(
        self,
        models: Sequence[Any],
        start: Array,
        ctrl: Array,
        observations: SubstepObservations | None = None,
    ) -> Rollouts:
        """Open-loop simulations from start: (m, ns) under ctrl: (m, N, nu), each sample held over its substeps."""
        count, N, _ = ctrl.shape
        batch = self._batch("rollout" if count <= SMALL_BATCH else "rollouts", count)
        batch.set_models(
            models[0] if len(models) == 1 else [*models, *[models[-1]] * (batch.nsim - count)]
        )
        ids = self._load(batch, start, models)
        held = np.repeat(ctrl, self.substeps, axis=1)
        record: tuple[Any, ...] = (RECORDED_STATE,)
        if self.sensors:  # one more step: sensor data belongs to the state before a step
            held, record = (
                np.concatenate([held, held[:, -1:]], axis=1),
                (RECORDED_STATE, "sensordata"),
            )
        if observations is not None:
            record = (*record, *observations.fields)
        with silence_mujoco_log():
            out = batch.rollout(held.shape[1], np.ascontiguousarray(held), record=record, ids=ids)
        self.steps += count * held.shape[1]
        last = N * self.substeps
        rows = out[RECORDED_STATE][:, self.substeps - 1 : last : self.substeps]
        states = np.concatenate([start[:, None], rows[:, :, 1:]], axis=1)
        on_time = (
            np.abs(rows[:, -1, 0] - START_TIME - last * self.model.opt.timestep)
            < 0.5 * self.model.opt.timestep
        )
        finite = on_time & np.isfinite(states).all(axis=(1, 2)) & _acceptable(ctrl).all(axis=(1, 2))
        sensed = self._sensed(out["sensordata"][:, :: self.substeps]) if self.sensors else None
        return Rollouts(
            states,
            sensed,
            finite,
            None if observations is None else self._observed(observations, start, out, last),
        )

    def _observed(
        self, observations: SubstepObservations, start: Array, out: dict[Any, Array], last: int
    ) -> Array:
        """(m, N, substeps, w) from the records of a rollout of `last` engine steps."""
        qpos, qvel, _ = self.space.split(out[RECORDED_STATE][:, :last, 1:])
        before = np.concatenate([self.space.split(start)[1][:, None], qvel[:, :-1]], axis=1)
        rows = observations.values(qpos, qvel, before, lambda name: out[name][:, :last])
        return np.asarray(
            rows.reshape(len(start), last // self.substeps, self.substeps, rows.shape[-1])
        )

    def _sensed(self, data: Array) -> Array:
        """A copy of sensor data: (..., nsensordata), its clocks as if time had begun at zero."""
        out = np.array(data)
        out[..., self._clocks] -= START_TIME
        return out

    def closed_loop(
        self, model: Any, reference: Array, mu: Array, K: Array
    ) -> tuple[Array, Array, bool]:
        """Projection: `u = mu + K (alpha - x)`. Returns states (N+1, ns), ctrl (N, nu), and False if it diverged.

        reference: alpha, (N+1, ns);  mu: (N, nu);  K: (N, nu, nx)
        """
        space, N, substeps = self.space, len(mu), self.substeps
        scalar = not space.quaternions
        data = self._data
        mujoco.mj_resetData(model, data)
        data.time = START_TIME
        data.qpos[:], data.qvel[:], data.act[:] = space.split(reference[0])
        states, used = np.empty((N + 1, reference.shape[1])), np.empty_like(mu)
        states[0] = reference[0]
        ctrl, qpos, qvel, act = data.ctrl, data.qpos, data.qvel, data.act
        with np.errstate(over="ignore", invalid="ignore"), silence_mujoco_log():
            for now, q, v, a, alpha, u, open_loop, gain in zip(
                states, *space.split(states[1:]), reference, used, mu, K, strict=False
            ):
                u[:] = gain.dot(alpha - now if scalar else space.minus(alpha, now))
                u += open_loop
                ctrl[:] = u
                mujoco.mj_step(model, data, substeps)
                q[:], v[:], a[:] = qpos, qvel, act
        self.steps += N * substeps
        on_time = (
            abs(data.time - START_TIME - N * substeps * model.opt.timestep)
            < 0.5 * model.opt.timestep
        )
        return states, used, bool(on_time and np.isfinite(states).all() and _acceptable(used).all())


def _acceptable(ctrl: Array) -> np.ndarray:
    """Which controls MuJoCo takes as they are."""
    return np.asarray(np.abs(ctrl) <= MAX_CONTROL)
