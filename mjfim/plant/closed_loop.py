"""Simulations in which control laws compute the controls from a log and from the state.

All simulations take each tick of a law together: Python evaluates the law once for all of them, and
MuJoCo steps them up to the next tick.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, NoReturn

import numpy as np
from mujoco.batch import Batch

from mjfim.arrays import Array
from mjfim.model.control_laws import MEASURED_SUMS, ControlLaw, ControlLaws
from mjfim.model.mujoco_log import silence_mujoco_log
from mjfim.plant.batch import (
    BatchSimulator,
    EngineSteps,
    Rollouts,
    SampleSteps,
    SubstepObservations,
    is_accepted,
)
from mjfim.plant.input_context import InputContext, LoopTrace
from mjfim.plant.law_commands import LawCommands, Ticks, lead_time
from mjfim.plant.law_loop import LawGroup, LawLoop
from mjfim.plant.law_numbers import LawNumbers
from mjfim.plant.running_law import RunningLaws, memory_at_begin
from mjfim.plant.state_sizes import StateSizes

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

    def __init__(
        self,
        model: Any,
        laws: ControlLaws,
        *,
        substeps: int = 1,
        sensors: bool = False,
        threads: int | None = None,
    ) -> None:
        """Build the simulator.

        Args:
            model: Model copy that no other code changes, with the numbers of the laws.
            laws: The laws.
            substeps: `mj_step` calls per sample.
            sensors: True if sensor data are requested.
            threads: Number of threads; None takes all cores.
        """
        super().__init__(model, substeps=substeps, sensors=sensors, threads=threads)
        self.laws = laws

    def lead(self, models: Sequence[Any]) -> int:
        """Number of samples before a curve whose inputs still have an effect on it.

        Args:
            models: Models with the numbers of the laws.
        """
        timestep = float(self.model.opt.timestep)
        numbers = LawNumbers.of(models, self.laws.laws, len(models))
        longest = max(law.tick for law in self.laws.laws) * timestep
        return int(np.ceil(lead_time(numbers, longest) / (self.substeps * timestep))) + 1

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
            context = InputContext.none(ctrl)

        # Curves that begin at different times between two ticks take their ticks separately.
        phases = (context.samples * self.substeps) % self.laws.period
        if (phases == phases[0]).all():
            return self._in_phase(models, start, ctrl, context, int(phases[0]))

        groups = [np.flatnonzero(phases == phase) for phase in np.unique(phases)]
        parts = [
            self._in_phase(
                models if len(models) == 1 else [models[i] for i in chosen.tolist()],
                start[chosen],
                ctrl[chosen],
                context.of_curves(chosen),
                int(phases[chosen[0]]),
            )
            for chosen in groups
        ]
        return _joined(parts, np.argsort(np.concatenate(groups)))

    def step(
        self,
        models: Sequence[Any],
        states: Array,
        ctrl: Array,
        observations: SubstepObservations | None = None,
    ) -> SampleSteps:
        """Refuse to step single samples."""
        self._refuse()

    def engine_steps(
        self, model: Any, states: Array, ctrl: Array, fields: Sequence[str]
    ) -> EngineSteps:
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

    def _in_phase(
        self, models: Sequence[Any], start: Array, ctrl: Array, context: InputContext, phase: int
    ) -> Rollouts:
        """Simulate curves that begin `phase` engine steps after a common tick of all laws."""
        batch = self._batch_of(len(ctrl))
        batch.set_models(models[0] if len(models) == 1 else list(models))
        self._load(batch, start, models)
        groups = [
            self._group(i, models, start, ctrl, context, phase)
            for i in range(len(self.laws.by_tick))
        ]
        loop = LawLoop(
            laws=self.laws,
            batch=batch,
            ctrl=ctrl,
            groups=groups,
            substeps=self.substeps,
            sensors=self.sensors,
        )
        with silence_mujoco_log(), np.errstate(over="ignore", invalid="ignore"):
            trace = loop.run()
        self._count.steps += len(ctrl) * loop.total

        finite = self._on_time(loop.time, loop.end)
        finite &= np.isfinite(loop.states).all(axis=(1, 2)) & is_accepted(loop.largest)
        sensors = None if loop.sensor_data is None else self._sensor_data(loop.sensor_data)
        return Rollouts(states=loop.states, sensors=sensors, finite=finite, loop=trace)

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
        phase: int,
    ) -> LawGroup:
        """Laws with one period, ready for curves that begin `phase` engine steps after a tick.

        Args:
            index: Place of the laws among the groups of laws.
            models: One model for all m curves, or one for each.
            start: (m, ns) initial states.
            ctrl: (m, N, w) inputs.
            context: Inputs before and after the curves.
            phase: Engine steps from a common tick of all laws to the begin of the curves.
        """
        laws = self.laws.by_tick[index]
        count, N = ctrl.shape[:2]
        period, lead = laws[0].tick, context.before.shape[1]
        first = -phase % period
        total = N * self.substeps + int(self.sensors)
        ticks = Ticks(
            first=first,
            period=period,
            before=(lead * self.substeps + first) // period,
            count=max(-(-(total - first) // period), 0),
            substeps=self.substeps,
            timestep=float(self.model.opt.timestep),
        )

        numbers = LawNumbers.of(models, laws, count)
        window = np.concatenate([context.before, ctrl, context.after], axis=1)
        commands = LawCommands.of(laws, numbers, window, lead, ticks)

        q, v = [law.q for law in laws], [law.v + self.space.nq for law in laws]
        known = None if context.memory is None else context.memory[index]
        if known is None:
            sums = self._measured_sums(laws, ctrl, context)
            state = (start[:, q], start[:, v])
            known = memory_at_begin(laws, numbers, commands, ticks, state, sums)

        begins = context.memory is None and first == 0
        running = RunningLaws(
            laws, numbers, commands, ticks, known, begins=begins, first=commands.before
        )
        return LawGroup(
            running=running,
            ticks=ticks,
            controls=np.array([law.control for law in laws]),
            positions=np.array(q),
            velocities=np.array(v) - self.space.nq,
            places=np.array([self.laws.laws.index(law) for law in laws]),
        )

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


def _joined(parts: Sequence[Rollouts], places: np.ndarray) -> Rollouts:
    """Put curves together.

    Args:
        parts: Rollouts of some curves each.
        places: (m,) place of each curve among those of all parts.
    """
    loops = [part.loop for part in parts if part.loop is not None]
    sensors = [part.sensors for part in parts if part.sensors is not None]
    return Rollouts(
        states=np.concatenate([part.states for part in parts])[places],
        sensors=np.concatenate(sensors)[places] if sensors else None,
        finite=np.concatenate([part.finite for part in parts])[places],
        loop=LoopTrace.joined(loops, places),
    )


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
