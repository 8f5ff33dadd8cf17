"""Simulations in which control laws compute the controls from a log and from the state.

All simulations take each tick of a law together: Python evaluates the law once for all of them, and
MuJoCo steps them up to the next tick.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NoReturn

import mujoco
import numpy as np
import scipy
from mujoco.batch import Batch

from mjfim.arrays import Array
from mjfim.model.control_laws import MEASURED_SUMS, ControlLaw, ControlLaws
from mjfim.model.loading import silence_mujoco_log
from mjfim.plant.batch import (
    BatchSimulator,
    Rollouts,
    SubstepObservations,
    is_accepted,
)
from mjfim.plant.running_law import (
    InputContext,
    LawCommands,
    LawMemory,
    LawNumbers,
    RunningLaws,
    Ticks,
    distinct_curves,
    lead_time,
    memory_at_begin,
    of_curves,
)
from mjfim.plant.state_space import StateSizes

HINGE = mujoco.mjtJoint.mjJNT_HINGE

# Number of batches that are kept, one for each of the latest numbers of simulations.
KEPT_BATCHES = 6


class ClosedLoopSimulator(BatchSimulator):
    """Steps many simulations under control laws, whose numbers are those of each model.

    Controls of other methods are inputs: columns of a log, see `ControlLaws`. Single samples cannot
    be stepped, because a law remembers what happened before them.

    Attributes:
        laws: The laws.
    """

    is_open_loop: ClassVar[bool] = False

    def __init__(self, model: Any, laws: ControlLaws, **options: Any) -> None:
        """Build the simulator.

        Args:
            model: Model copy that no other code changes, with the numbers of the laws.
            laws: The laws.
            **options: Options of `BatchSimulator`.
        """
        super().__init__(model, **options)
        self.laws = laws

    def lead(self, models: Sequence[Any]) -> int:
        """Number of samples before a curve whose inputs still have an effect on it.

        Args:
            models: Models with the numbers of the laws.
        """
        timestep = self.model.opt.timestep
        numbers = LawNumbers.of(models, self.laws.laws, len(models))
        longest = max(law.tick for law in self.laws.laws) * timestep
        joints = [self.model.joint(law.joint) for law in self.laws.laws]
        turns = [self.model.stat.extent, 2.0 * np.pi]
        spans = [
            np.ptp(joint.range) if np.ptp(joint.range) else turns[int(joint.type[0] == HINGE)]
            for joint in joints
        ]
        seconds = lead_time(numbers, longest, np.array(spans))
        return int(np.ceil(seconds / (self.substeps * timestep))) + 1

    def rollout(
        self,
        models: Sequence[Any],
        start: Array,
        ctrl: Array,
        observations: SubstepObservations | None = None,
        context: InputContext | None = None,
    ) -> Rollouts:
        """Simulate many curves in closed loop.

        Args:
            models: One model for all simulations, or one for each.
            start: (m, ns) initial states.
            ctrl: (m, N, w) inputs: columns of the log, each held over its sample or a point of a
                continuous signal, and further columns of `ControlLaws` where they are known.
            observations: None: nothing is observed between the samples.
            context: Inputs before and after the curves; None where the curves begin recordings.

        Returns:
            The simulated curves, with the memory of the laws at their end.
        """
        if observations is not None:
            self._refuse()
        if context is None:
            begin = np.zeros(len(ctrl), dtype=np.intp)
            context = InputContext.of_interval(ctrl, begin, slice(0, ctrl.shape[1]), 0, None)

        batch = self._batch_of(len(ctrl))
        batch.set_models(models[0] if len(models) == 1 else list(models))
        self._load(batch, start, models)
        groups = [
            self._group(i, models, start, ctrl, context) for i in range(len(self.laws.by_tick))
        ]
        for group in groups:
            batch.bind("ctrl")[:, group.controls] = group.held
        with silence_mujoco_log(), np.errstate(over="ignore", invalid="ignore"):
            return self._run(batch, ctrl, groups)

    def controls_along(self, model: Any, t: Array, states: Array, ctrl: Array) -> Array:
        """Controls that the laws compute along a known motion from the begin of a recording.

        Args:
            model: A model with the numbers of the laws.
            t: (n,) times of the states, at least four [s].
            states: (n, ns) states, between which the motion is a cubic spline.
            ctrl: (N, w) inputs, as those of `rollout`.

        Returns:
            (N, nu) mean controls over each sample.
        """
        N, nq = len(ctrl), self.space.nq
        motion = scipy.interpolate.make_interp_spline(t, states, k=3)
        inputs, begin = ctrl[None], np.zeros(1, dtype=np.intp)
        context = InputContext.of_interval(inputs, begin, slice(0, N), 0, None)
        found = np.zeros((N, self.model.nu))
        columns, direct = self.laws.direct
        found[:, direct] = ctrl[:, columns]
        for i in range(len(self.laws.by_tick)):
            group = self._group(i, [model], states[:1], inputs, context)
            steps = np.arange(0, N * self.substeps, group.period)
            # The last sample may end after the motion.
            at = motion(np.minimum(steps * self.model.opt.timestep, t[-1]))[:, None]
            pairs = zip(at[..., group.positions], at[..., nq + group.velocities], strict=True)
            controls = np.concatenate([group.evaluate(q, v) for q, v in pairs])
            held = np.repeat(controls, group.period, axis=0)[: N * self.substeps]
            found[:, group.controls] = held.reshape(N, self.substeps, -1).mean(axis=1)
        return found

    def _run(self, batch: Batch, ctrl: Array, groups: Sequence[RunningLaws]) -> Rollouts:
        """Simulate curves from one tick to the next.

        Args:
            batch: The m simulations, with the initial states.
            ctrl: (m, N, w) inputs.
            groups: The laws in the loop, grouped by their periods.
        """
        space, substeps = self.space, self.substeps
        count, samples = ctrl.shape[:2]
        end = samples * substeps
        # A step after the last sample gives its sensor data.
        total = end + int(self.sensors)
        # Time, qpos, qvel and act are the first numbers of MuJoCo's state.
        recorded = batch.state[:, 1 : 1 + space.nq + space.nv + space.na]
        qpos, qvel, applied = (batch.bind(name) for name in ("qpos", "qvel", "ctrl"))
        sensed = batch.bind("sensordata") if self.sensors else np.zeros((count, 0))
        states = np.zeros((count, samples + 1, recorded.shape[1]))
        sensor_data = np.zeros((count, samples + 1, sensed.shape[1]))
        controls = np.zeros((count, samples, applied.shape[1]))
        is_clipped = np.zeros((count, samples, len(self.laws.laws)), dtype=bool)
        places = [[self.laws.laws.index(law) for law in group.laws] for group in groups]
        inputs, direct = self.laws.direct
        time, largest = np.zeros(count), np.zeros(count)
        memory: tuple[LawMemory, ...] = ()

        # Engine steps before which something happens. The first step of a sample computes the
        # sensor data that belong to its begin.
        begins = np.arange(0, end + 1, substeps)
        ticks = [np.arange(0, total, group.period) for group in groups]
        stops = np.unique(np.concatenate([begins, begins + int(self.sensors), *ticks]))
        for step, length in zip(stops.tolist(), [*np.diff(stops).tolist(), 0], strict=True):
            sample, inside = divmod(step, substeps)
            is_begin = inside == 0 and step <= end
            if is_begin:
                states[:, sample] = recorded
                # Controls without a law.
                applied[:, direct] = ctrl[:, min(sample, samples - 1), inputs]
            if step == end:
                time[:] = batch.bind("time")
                memory = tuple(group.memory for group in groups)
            for group in groups:
                if step < total and step % group.period == 0:
                    control = group.evaluate(qpos[:, group.positions], qvel[:, group.velocities])
                    largest = np.maximum(largest, np.abs(control).max(axis=1))
                    applied[:, group.controls] = control
            # The controls of a sample are known now.
            if is_begin and step < end:
                controls[:, sample] = applied
                for group, place in zip(groups, places, strict=True):
                    is_clipped[:, sample, place] = group.is_clipped
            if length:
                batch.step(None, nstep=length)
            if is_begin:
                sensor_data[:, sample] = sensed
        self._count.steps += count * total

        finite = self._on_time(time, end)
        finite &= np.isfinite(states).all(axis=(1, 2)) & is_accepted(largest)
        return Rollouts(
            states=states,
            sensors=self._sensor_data(sensor_data) if self.sensors else None,
            finite=finite,
            controls=controls,
            is_clipped=is_clipped,
            memory=memory,
        )

    def _recorded(
        self, models: Sequence[Any], start: Array, held: Array, record: Sequence[Any]
    ) -> dict[Any, Array]:
        """Refuse to step single samples."""
        self._refuse()

    def closed_loop(
        self, model: Any, reference: Array, mu: Array, K: Array
    ) -> tuple[Array, Array, bool]:
        """Refuse another feedback beside the laws."""
        self._refuse()

    def _refuse(self) -> NoReturn:
        """Raise NotImplementedError: control laws remember what happened before a sample."""
        raise NotImplementedError("control laws have a memory, which single samples do not show")

    def _batch_of(self, count: int) -> Batch:
        """A batch of exactly `count` simulations, which steps faster than a part of a larger one.

        The batches of the latest counts are kept: a fit asks for few of them again and again.
        """
        key = f"closed loop of {count}"
        batch = self._batches.pop(key, None) or Batch(self.model, count, min(self.threads, count))
        kept = [name for name in self._batches if name.startswith("closed loop of ")]
        for name in kept[: max(len(kept) + 1 - KEPT_BATCHES, 0)]:
            del self._batches[name]
        self._batches[key] = batch
        return batch

    def _group(
        self,
        index: int,
        models: Sequence[Any],
        start: Array,
        ctrl: Array,
        context: InputContext,
    ) -> RunningLaws:
        """Laws with one period, ready for curves that begin at a tick.

        Args:
            index: Place of the laws among the groups of laws.
            models: One model for all m curves, or one for each.
            start: (m, ns) initial states.
            ctrl: (m, N, w) inputs.
            context: Inputs before and after the curves.
        """
        laws = self.laws.by_tick[index]
        count, N = ctrl.shape[:2]
        period, lead = laws[0].tick, context.before.shape[1]
        total = N * self.substeps + int(self.sensors)
        ticks = Ticks(
            period=period,
            before=lead * self.substeps // period,
            count=-(-total // period),
            substeps=self.substeps,
            timestep=self.model.opt.timestep,
        )

        numbers = LawNumbers.of(models, laws, count)
        window = np.concatenate([context.before, ctrl, context.after], axis=1)
        known = None if context.memory is None else context.memory[index]
        # Most simulations of a derivative share inputs and all numbers that commands depend on.
        # Their commands are computed once.
        firsts, place = distinct_curves(laws, numbers, window, known)
        distinct = LawCommands.of(
            laws,
            of_curves(numbers, firsts),
            window[firsts],
            lead,
            ticks,
            None if known is None else of_curves(known, firsts),
        )
        commands = of_curves(distinct, place)
        if known is None:
            sums = self._measured_sums(laws, ctrl, context)
            velocities = [law.v + self.space.nq for law in laws]
            state = (start[:, [law.q for law in laws]], start[:, velocities])
            known = memory_at_begin(numbers, commands, ticks, state, sums)

        begins = context.memory is None
        return RunningLaws(laws, numbers, commands, ticks, known, begins=begins)

    def _measured_sums(
        self, laws: Sequence[ControlLaw], ctrl: Array, context: InputContext
    ) -> Array | None:
        """(m, c, 4) sums of the measured errors before the curves; None where they are not known.

        They are NaN for curves at the begin of recordings.
        """
        is_known = ctrl.shape[2] > len(self.laws.inputs)
        if not is_known or not any(law.integrates for law in laws):
            return None

        without = np.zeros((len(ctrl), len(MEASURED_SUMS)))
        columns = [
            ctrl[:, 0, self.laws.sums_of(law)] if law.integrates else without for law in laws
        ]
        sums = np.stack(columns, axis=1)
        sums[context.samples == 0] = np.nan
        return sums


def input_sizes(laws: ControlLaws, sizes: StateSizes) -> Array:
    """Natural sizes of the inputs of control laws, where no log shows them.

    Args:
        laws: The laws and the inputs.
        sizes: Sizes of the states and of the controls.

    Returns:
        (w,) sizes [unit of the input]; factors have the size 1.
    """
    found = np.ones(len(laws.inputs))
    inputs, controls = laws.direct
    found[inputs] = sizes.control[controls]
    for law in laws.laws:
        natural = {
            "reference": sizes.position[law.v],
            "reference_velocity": sizes.velocity[law.v],
            "feedforward": sizes.control[law.control],
        }
        for quantity, column in law.columns.items():
            found[column] = natural.get(quantity, 1.0)
    return found
