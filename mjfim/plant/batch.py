"""Many MuJoCo simulations in one call, without a Python loop over engine steps.

Every engine step is counted.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, ClassVar

import mujoco
import numpy as np
from mujoco.batch import Batch

from mjfim.arrays import Array, record
from mjfim.model.limited_elements import (
    QUATERNION_PLACE,
    quaternion_address,
    quaternion_joints,
)
from mjfim.model.loading import silence_mujoco_log
from mjfim.parallel import cores
from mjfim.plant.running_law import InputContext, LawMemory
from mjfim.plant.state_space import StateSpace

# Components of MuJoCo's state that a rollout records after every engine step: the time, then qpos,
# qvel and act.
RECORDED_STATE = int(
    mujoco.mjtState.mjSTATE_TIME
    | mujoco.mjtState.mjSTATE_QPOS
    | mujoco.mjtState.mjSTATE_QVEL
    | mujoco.mjtState.mjSTATE_ACT
)

# Time at which simulations start [s]. MuJoCo resets a diverged state and its time to zero; the time
# then shows that the simulation diverged.
START_TIME = 1.0

# Magnitude above which MuJoCo replaces controls by zero.
MAX_CONTROL = float(mujoco.mjMAXVAL)

# Type of the sensors that show the time.
CLOCK_SENSOR = int(mujoco.mjtSensor.mjSENS_CLOCK)

# Largest number of rollouts that use the small batch. A larger number, as in a Monte Carlo study,
# uses a second batch, so that the small one stays small.
SMALL_BATCH = 64


def state_space(model: Any) -> StateSpace:
    """Layout of a model's state.

    Args:
        model: Compiled MuJoCo model.

    Returns:
        The layout.
    """
    # The place of a quaternion in the position of a joint is that of its rotation in the velocity.
    quaternions = tuple(
        (
            quaternion_address(model, joint),
            int(model.jnt_dofadr[joint]) + QUATERNION_PLACE[model.jnt_type[joint]],
        )
        for joint in quaternion_joints(model)
    )
    in_quaternions = [q + i for q, _ in quaternions for i in range(4)]
    rotations = [v + i for _, v in quaternions for i in range(3)]
    return StateSpace(
        nq=model.nq,
        nv=model.nv,
        na=model.na,
        scalar_q=np.setdiff1d(np.arange(model.nq), in_quaternions),
        scalar_v=np.setdiff1d(np.arange(model.nv), rotations),
        quaternions=quaternions,
    )


@record
class SubstepObservations:
    """Quantities that are observed at the engine steps within a sample.

    There are w numbers per engine step: positions, velocities, accelerations and turns, then the
    forces of actuators, on joints and of tendons, and the lengths of tendons, which count as forces
    below.

    A force is what MuJoCo keeps in its field after the step. That is the force at the beginning of
    the step, which a force sensor reads, and with RK4 the force of the last of its four stages.
    Where forces change within an engine step, rollouts have further rows with the same positions,
    velocities and accelerations and other forces: with RK4 those at the beginning of every step,
    and always those at the end of the sample under its control.

    Attributes:
        positions: Addresses in qpos, after the step.
        velocities: Addresses in qvel, after the step.
        accelerations: Addresses in qvel whose change over the step, divided by the timestep, is
            observed. This is what the robot does; with implicit integrators and with RK4 it
            differs from qacc.
        actuator_forces: Addresses in actuator_force.
        joint_forces: Addresses in qfrc_actuator.
        turns: (n, 4) addresses in qpos of quaternions, after the step.
        turn_weights: (n, 4) weights of their components; the weighted sums are observed.
        tendon_forces: For each tendon, the addresses in actuator_force of its actuators; the sum
            of their forces is observed.
        tendon_lengths: Addresses in ten_length; the lengths belong to the same instant as forces.
        derivative_substeps: Engine steps of a sample, counted from 1, at which derivatives are
            taken; the last one ends the sample.
        timestep: Engine timestep [s].
        force_rows: Engine step of a sample, counted from 0, to which each further row of a
            rollout belongs; the last one is the end of the sample. Empty where forces are constant
            under a constant control.
    """

    positions: np.ndarray
    velocities: np.ndarray
    accelerations: np.ndarray
    actuator_forces: np.ndarray
    joint_forces: np.ndarray
    derivative_substeps: tuple[int, ...]
    timestep: float
    turns: np.ndarray
    turn_weights: Array
    tendon_forces: tuple[tuple[int, ...], ...]
    tendon_lengths: np.ndarray
    force_rows: tuple[int, ...] = ()

    def of_single_steps(self) -> SubstepObservations:
        """Return the same observations of samples that last one engine step.

        Every engine step then has the further rows that a sample had.
        """
        rows = (0, 0) if self.has_stages else (0,)
        return replace(self, derivative_substeps=(1,), force_rows=rows if self.force_rows else ())

    @property
    def has_stages(self) -> bool:
        """Whether the forces at the beginning of the engine steps are further rows, as for RK4."""
        return len(self.force_rows) > 1

    @property
    def derivative_rows(self) -> tuple[int, ...]:
        """Rows of a rollout for which derivatives are taken.

        Of the further rows it is the first one: with RK4 the beginning of the sample, where the
        control has changed, and otherwise its end.
        """
        steps = tuple(step - 1 for step in self.derivative_substeps)
        return (*steps, self.derivative_substeps[-1]) if self.force_rows else steps

    @property
    def fields(self) -> tuple[str, ...]:
        """MjData fields that have to be recorded in addition to the state."""
        names = []
        if len(self.actuator_forces) or self.tendon_forces:
            names.append("actuator_force")
        if len(self.joint_forces):
            names.append("qfrc_actuator")
        if len(self.tendon_lengths):
            names.append("ten_length")
        return tuple(names)

    def values(
        self, qpos: Array, qvel: Array, qvel_before: Array, read: Callable[[str], Array]
    ) -> Array:
        """Observed values of engine steps.

        Args:
            qpos: (..., nq) positions after the steps.
            qvel: (..., nv) velocities after the steps.
            qvel_before: (..., nv) velocities before the steps; needed only for accelerations.
            read: Returns an MjData field of the steps, (..., size), by its name.

        Returns:
            (..., w) observed values.
        """
        change = qvel[..., self.accelerations] - qvel_before[..., self.accelerations]
        motion = [qpos[..., self.positions], qvel[..., self.velocities], change / self.timestep]
        if len(self.turns):
            motion.append((qpos[..., self.turns] * self.turn_weights).sum(axis=-1))
        if not self.fields:
            return np.concatenate(motion, axis=-1)
        return np.concatenate([*motion, self.forces(read)], axis=-1)

    def forces(self, read: Callable[[str], Array]) -> Array:
        """Observed forces, the last of the observed values; there is at least one.

        Args:
            read: Returns an MjData field, (..., size), by its name.

        Returns:
            (..., f) observed forces.
        """
        parts = []
        if len(self.actuator_forces):
            parts.append(read("actuator_force")[..., self.actuator_forces])
        if len(self.joint_forces):
            parts.append(read("qfrc_actuator")[..., self.joint_forces])
        if self.tendon_forces:
            forces = read("actuator_force")
            sums = [forces[..., list(pulling)].sum(axis=-1) for pulling in self.tendon_forces]
            parts.append(np.stack(sums, axis=-1))
        if len(self.tendon_lengths):
            parts.append(read("ten_length")[..., self.tendon_lengths])
        return np.concatenate(parts, axis=-1)


@record
class Rollouts:
    """Many simulated curves.

    Attributes:
        states: (m, N+1, ns) states.
        sensors: (m, N+1, nsensordata) sensor data that belong to the states, or None if not
            requested.
        finite: (m,) False where a simulation diverged.
        observed: (m, N, rows, w) observations at every engine step of a sample, and then the
            further rows of `SubstepObservations.force_rows`; None if not requested.
        controls: (m, N, nu) controls at the begin of every sample that control laws have applied
            [u-unit]; None without laws.
        is_clipped: (m, N, laws) True where the range or the largest change of a control has clipped
            it; None without laws.
        memory: Memory of the laws at the end of the curves, grouped by their periods; None without
            laws.
    """

    states: Array
    sensors: Array | None
    finite: np.ndarray
    observed: Array | None = None
    controls: Array | None = None
    is_clipped: np.ndarray | None = None
    memory: tuple[LawMemory, ...] | None = None


# One sample of n simulations: the (n, ns) states after it, NaN where a simulation diverged; (n,
# nsensordata) sensor data that belong to the states before it, or None if not requested; and (n, S,
# w) observations at the S rows of `SubstepObservations.derivative_rows`, or None.
SampleSteps = tuple[Array, Array | None, Array | None]


class BatchSimulator:
    """Steps many simulations of models that share one memory layout.

    Attributes:
        model: Private model copy from which batches are made.
        space: Layout of the state.
        substeps: `mj_step` calls per sample.
        sensors: True if sensor data are requested.
        threads: Number of threads.
        is_open_loop: True where the inputs of a simulation are the controls themselves.
    """

    is_open_loop: ClassVar[bool] = True

    def __init__(
        self,
        model: Any,
        *,
        substeps: int = 1,
        sensors: bool = False,
        threads: int | None = None,
    ) -> None:
        """Build the simulator.

        Args:
            model: Model copy that no other code changes.
            substeps: `mj_step` calls per sample.
            sensors: True if sensor data are requested.
            threads: Number of threads; None takes all cores.
        """
        self.model = model
        self.space = state_space(model)
        self.substeps = substeps
        self.sensors = sensors
        self.threads = threads or cores()
        # Shared by simulators with samples of other lengths.
        self._count = SimpleNamespace(steps=0)
        self._batches: dict[str, Batch] = {}
        self._data = mujoco.MjData(model)
        self._clocks = model.sensor_adr[model.sensor_type == CLOCK_SENSOR]

        mocap_bodies = np.flatnonzero(model.body_mocapid >= 0)
        self._mocap_bodies = mocap_bodies[np.argsort(model.body_mocapid[mocap_bodies])]

    @property
    def steps(self) -> int:
        """`mj_step` calls so far, those of `with_substeps` and of workers included."""
        return int(self._count.steps)

    def add_steps(self, steps: int) -> None:
        """Count `mj_step` calls that a worker has made for this simulator.

        Args:
            steps: Their number.
        """
        self._count.steps += steps

    def with_substeps(self, substeps: int) -> BatchSimulator:
        """A simulator with samples of another length; memory and counted steps are shared.

        Args:
            substeps: `mj_step` calls per sample.

        Returns:
            The simulator.
        """
        other = copy.copy(self)
        other.substeps = substeps
        return other

    def step(
        self,
        models: Sequence[Any],
        states: Array,
        ctrl: Array,
        observations: SubstepObservations | None = None,
    ) -> SampleSteps:
        """Advance every simulation by one sample.

        Args:
            models: Models; each steps an equal, contiguous share of the simulations.
            states: (n, ns) states before the sample.
            ctrl: (n, nu) controls, held over the sample.
            observations: Quantities to observe within the sample, or None.

        Returns:
            The sample of every simulation.
        """
        share = len(states) // len(models)
        each = models if len(models) == 1 else [model for model in models for _ in range(share)]
        found = self._open_loop(each, states, ctrl[:, None], observations, at_end=False)
        after = found.states[:, 1]
        after[~found.finite] = np.nan
        observed = None
        if observations is not None and found.observed is not None:
            observed = found.observed[:, 0, list(observations.derivative_rows)]
        sensors = None if found.sensors is None else found.sensors[:, 0]
        return after, sensors, observed

    def rollout(
        self,
        models: Sequence[Any],
        start: Array,
        ctrl: Array,
        observations: SubstepObservations | None = None,
        context: InputContext | None = None,
    ) -> Rollouts:
        """Simulate many curves in open loop.

        Args:
            models: One model for all simulations, or one for each.
            start: (m, ns) initial states.
            ctrl: (m, N, nu) controls, each held over its sample.
            observations: Quantities to observe at every engine step, or None.
            context: Inputs before and after the curves, which matter to control laws only.

        Returns:
            The simulated curves.
        """
        return self._open_loop(models, start, ctrl, observations, at_end=True)

    def engine_steps(
        self, model: Any, states: Array, ctrl: Array, fields: Sequence[str]
    ) -> tuple[Array, dict[str, Array]]:
        """Advance every simulation by one sample and record its engine steps.

        Args:
            model: The model.
            states: (n, ns) states before the sample.
            ctrl: (n, nu) controls, held over the sample.
            fields: MjData fields that an engine step computes before it moves the state.

        Returns:
            (n, s+1, ns) states before the s engine steps, and after the last one; the fields that
            belong to the states before the steps, each (n, s, ...). They have no meaning where a
            simulation diverges.
        """
        held = np.repeat(ctrl[:, None], self.substeps, axis=1)
        out = self._recorded([model], states, held, (RECORDED_STATE, *fields))
        after = out[RECORDED_STATE][:, :, 1:]
        states = np.concatenate([states[:, None], after], axis=1)
        return states, {name: out[name] for name in fields}

    def _open_loop(
        self,
        models: Sequence[Any],
        start: Array,
        ctrl: Array,
        observations: SubstepObservations | None,
        *,
        at_end: bool,
    ) -> Rollouts:
        """Simulate curves, see `rollout`. at_end: whether sensors of the last state are needed."""
        held = np.repeat(ctrl, self.substeps, axis=1)
        record: tuple[Any, ...] = (RECORDED_STATE,)
        if self.sensors:
            record = (*record, "sensordata")
            # Sensor data belong to the state before a step. One more step gives those of the last
            # state.
            if at_end:
                held = np.concatenate([held, held[:, -1:]], axis=1)
        if observations is not None:
            record = (*record, *observations.fields)
        out = self._recorded(models, start, held, record)

        # Engine step i is recorded after the step: sample k ends with step k * substeps.
        engine_steps = ctrl.shape[1] * self.substeps
        rows = out[RECORDED_STATE][:, self.substeps - 1 : engine_steps : self.substeps]
        states = np.concatenate([start[:, None], rows[:, :, 1:]], axis=1)
        finite = self._on_time(rows[:, -1, 0], engine_steps)
        finite &= np.isfinite(states).all(axis=(1, 2))
        finite &= is_accepted(ctrl).all(axis=(1, 2))

        sensors = observed = None
        if self.sensors:
            sensors = self._sensor_data(out["sensordata"][:, :: self.substeps])
        if observations is not None:
            observed = self._observed(observations, models, start, out, ctrl)
        return Rollouts(states=states, sensors=sensors, finite=finite, observed=observed)

    def _recorded(
        self, models: Sequence[Any], start: Array, held: Array, record: Sequence[Any]
    ) -> dict[Any, Array]:
        """Records after each engine step of simulations under held: (m, engine steps, nu)."""
        count, steps = held.shape[:2]
        batch, ids = self._loaded(
            "small" if count <= SMALL_BATCH else "large", models, start, count
        )
        with silence_mujoco_log():
            out = batch.rollout(steps, np.ascontiguousarray(held), record=record, ids=ids)
        self._count.steps += count * steps
        return dict(out)

    def closed_loop(
        self, model: Any, reference: Array, mu: Array, K: Array
    ) -> tuple[Array, Array, bool]:
        """Simulate one curve under `u = mu + K (alpha - x)`: the projection of (alpha, mu).

        Args:
            model: The model.
            reference: (N+1, ns) states alpha; the simulation starts at the first.
            mu: (N, nu) controls of the curve.
            K: (N, nu, nx) feedback gains [u-unit / x-unit].

        Returns:
            (N+1, ns) states, (N, nu) controls, and False if the simulation diverged.
        """
        space, N, substeps = self.space, len(mu), self.substeps
        subtracts = not space.quaternions
        data = self._data
        mujoco.mj_resetData(model, data)
        data.time = START_TIME
        data.qpos[:], data.qvel[:], data.act[:] = space.split(reference[0])

        states = np.empty((N + 1, reference.shape[1]))
        states[0] = reference[0]
        used = np.empty_like(mu)

        # This is the only place where Python steps MuJoCo sample by sample. The loop runs over
        # views, because every look-up of an attribute costs time.
        ctrl, qpos, qvel, act = data.ctrl, data.qpos, data.qvel, data.act
        next_qpos, next_qvel, next_act = space.split(states[1:])
        curves = (states, next_qpos, next_qvel, next_act, reference, used, mu, K)
        with np.errstate(over="ignore", invalid="ignore"), silence_mujoco_log():
            for now, q, v, a, alpha, u, feedforward, gain in zip(*curves, strict=False):
                u[:] = gain.dot(alpha - now if subtracts else space.minus(alpha, now))
                u += feedforward
                ctrl[:] = u
                mujoco.mj_step(model, data, substeps)
                q[:], v[:], a[:] = qpos, qvel, act
        self._count.steps += N * substeps

        finite = (
            np.isfinite(states).all()
            and is_accepted(used).all()
            and self._on_time(np.array(data.time), N * substeps)
        )
        return states, used, bool(finite)

    def _loaded(
        self, kind: str, models: Sequence[Any], states: Array, count: int
    ) -> tuple[Batch, np.ndarray | None]:
        """A batch of at least `count` simulations, of which the first ones begin at given states.

        Args:
            kind: Use of the batch; batches are kept, and grow.
            models: One model for all simulations, or one for each.
            states: (count, ns) states.
            count: Number of simulations.

        Returns:
            The batch and the simulations that are to be stepped; None for all.
        """
        batch = self._batches.get(kind)
        if batch is None or batch.nsim < count:
            batch = Batch(self.model, count, min(self.threads, count))
            self._batches[kind] = batch
        padding = [models[-1]] * (batch.nsim - count)
        batch.set_models(models[0] if len(models) == 1 else [*models, *padding])
        self._load(batch, states, models)
        return batch, None if count == batch.nsim else np.arange(count)

    def _load(self, batch: Batch, states: Array, models: Sequence[Any]) -> None:
        """Write states: (n, ns) into the first n simulations of a batch."""
        n = len(states)
        qpos, qvel, act = self.space.split(states)
        batch.bind("qpos")[:n] = qpos
        batch.bind("qvel")[:n] = qvel
        if self.space.na:
            batch.bind("act")[:n] = act
        batch.bind("qacc_warmstart")[:n] = 0.0
        batch.bind("time")[:n] = START_TIME

        # A batch keeps the mocap poses of the model that it was made with.
        bodies = self._mocap_bodies
        for i, model in enumerate(models if len(bodies) else ()):
            # A single model belongs to all simulations.
            simulations = slice(None, n) if len(models) == 1 else i
            batch.bind("mocap_pos")[simulations] = model.body_pos[bodies]
            batch.bind("mocap_quat")[simulations] = model.body_quat[bodies]

    def _observed(
        self,
        observations: SubstepObservations,
        models: Sequence[Any],
        start: Array,
        out: dict[Any, Array],
        ctrl: Array,
    ) -> Array:
        """(m, N, rows, w) observations from the records of a rollout under ctrl: (m, N, nu)."""
        m, N, nu = ctrl.shape
        end = N * self.substeps
        after = out[RECORDED_STATE][:, :end, 1:]
        before = np.concatenate([start[:, None], after[:, :-1]], axis=1)
        qpos, qvel, _ = self.space.split(after)
        qvel_before = self.space.split(before)[1]
        found = observations.values(qpos, qvel, qvel_before, lambda name: out[name][:, :end])
        observed = found.reshape(m, N, self.substeps, found.shape[-1])
        if not observations.force_rows:
            return observed

        # Further rows have the forces at the beginning of the engine steps, and at the end of the
        # samples.
        shape = (m, N, self.substeps, start.shape[1])
        begun = before.reshape(shape)[:, :, : len(observations.force_rows) - 1]
        states = np.concatenate([begun, after.reshape(shape)[:, :, -1:]], axis=2)
        rows = states.shape[2]
        each = models
        if len(models) > 1:
            each = [model for model in models for _ in range(N * rows)]
        # Values that are not finite belong to simulations that diverged.
        flat = np.nan_to_num(states.reshape(-1, start.shape[1]), posinf=0.0, neginf=0.0)
        batch, ids = self._loaded("forces", each, flat, len(flat))
        held = np.broadcast_to(ctrl[:, :, None], (m, N, rows, nu))
        batch.bind("ctrl")[: len(flat)] = held.reshape(-1, nu)
        for name in observations.fields:
            batch.bind(name)
        with silence_mujoco_log():
            batch.forward(ids)
        forces = observations.forces(lambda name: batch.bind(name)[: len(flat)])
        further = observed[:, :, list(observations.force_rows)]
        further[..., -forces.shape[-1] :] = forces.reshape(m, N, rows, -1)
        return np.concatenate([observed, further], axis=2)

    def _sensor_data(self, data: Array) -> Array:
        """A copy of sensor data: (..., nsensordata) whose clocks count from zero."""
        copied = np.array(data)
        copied[..., self._clocks] -= START_TIME
        return copied

    def _on_time(self, time: Array, engine_steps: int) -> np.ndarray:
        """True where a simulation ends at the expected time.

        MuJoCo resets the time of a simulation that diverges.
        """
        timestep = float(self.model.opt.timestep)

        duration = engine_steps * timestep
        error = np.abs(time - START_TIME - duration)
        return error < 0.5 * timestep


def is_accepted(ctrl: Array) -> np.ndarray:
    """True for controls that MuJoCo applies unchanged."""
    return np.abs(ctrl) <= MAX_CONTROL
