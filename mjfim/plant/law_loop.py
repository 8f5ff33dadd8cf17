"""The loop of control laws and engine: simulation of many curves from one tick to the next."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from mujoco.batch import Batch

from mjfim.arrays import Array
from mjfim.model.control_laws import ControlLaws
from mjfim.plant.input_context import LoopTrace
from mjfim.plant.law_commands import Ticks
from mjfim.plant.running_law import LawMemory, RunningLaws


@dataclass(frozen=True, kw_only=True, eq=False)
class LawGroup:
    """C laws with one period in the loop.

    Attributes:
        running: The laws in the loop.
        ticks: Engine steps at which they are evaluated.
        controls: (c,) addresses of their controls in ctrl.
        positions: (c,) addresses of the positions that they read in qpos.
        velocities: (c,) addresses of the velocities that they read in qvel.
        places: (c,) places of the laws among all laws.
    """

    running: RunningLaws
    ticks: Ticks
    controls: np.ndarray
    positions: np.ndarray
    velocities: np.ndarray
    places: np.ndarray


class LawLoop:
    """Simulation of m curves from one tick to the next.

    Args:
        laws: All laws, and the inputs.
        batch: The m simulations, with the initial states.
        ctrl: (m, N, w) inputs.
        groups: The laws, grouped by their periods.
        substeps: Engine steps of a sample.
        sensors: True if sensor data are wanted. A step after the last sample gives its data.

    Attributes:
        end: Engine steps of all samples.
        total: Engine steps that are taken.
        states: (m, N+1, ns) states.
        sensor_data: (m, N+1, nsensordata) sensor data that belong to the states, or None.
        time: (m,) time of each simulation at the end of the samples [s].
        largest: (m,) largest magnitudes of the controls so far [u-unit].
    """

    def __init__(
        self,
        *,
        laws: ControlLaws,
        batch: Batch,
        ctrl: Array,
        groups: Sequence[LawGroup],
        substeps: int,
        sensors: bool,
    ) -> None:
        self._laws = laws
        self._batch = batch
        self._ctrl = ctrl
        self._groups = groups
        self._substeps = substeps

        count, samples = ctrl.shape[:2]
        self.end = samples * substeps
        self.total = self.end + int(sensors)

        # Time, qpos, qvel and act are the first numbers of MuJoCo's state.
        model = batch.model
        self._recorded = batch.state[:, 1 : 1 + model.nq + model.nv + model.na]
        self._applied = batch.bind("ctrl")
        self._sensed = batch.bind("sensordata") if sensors else None

        self.states = np.zeros((count, samples + 1, self._recorded.shape[1]))
        self.sensor_data = None
        if self._sensed is not None:
            self.sensor_data = np.zeros((count, samples + 1, self._sensed.shape[1]))
        self.time = np.zeros(count)
        self.largest = np.zeros(count)

        self._controls = np.zeros((count, samples, model.nu))
        self._is_clipped = np.zeros((count, samples, len(laws.laws)), dtype=bool)
        self._memory: tuple[LawMemory, ...] = ()

    def run(self) -> LoopTrace:
        """Simulate the curves, and return what the laws have done."""
        qpos, qvel = self._batch.bind("qpos"), self._batch.bind("qvel")
        for group in self._groups:
            self._applied[:, group.controls] = group.running.held

        for length, sample, due in self._plan():
            if sample is not None:
                self._begin(sample)
            for group in due:
                self._evaluate(group, qpos, qvel)
            if sample is not None:
                self._note(sample)
            if length:
                self._batch.step(None, nstep=length)
            if sample is not None and self.sensor_data is not None:
                self.sensor_data[:, sample] = self._sensed

        return LoopTrace(controls=self._controls, is_clipped=self._is_clipped, memory=self._memory)

    def _plan(self) -> Iterator[tuple[int, int | None, list[LawGroup]]]:
        """Everything that happens between engine steps.

        Yields:
            Number of steps up to the next event, the sample that begins now or None, and the laws
            that are evaluated now.
        """
        begins = np.arange(0, self.end + 1, self._substeps)
        stops = [begins, np.array([self.total])]
        stops += [np.arange(g.ticks.first, self.total, g.ticks.period) for g in self._groups]

        # The first step of a sample computes the sensor data that belong to its begin.
        if self._sensed is not None:
            stops.append(begins + 1)
        steps = np.unique(np.concatenate(stops))
        for step, length in zip(steps.tolist(), [*np.diff(steps).tolist(), 0], strict=True):
            sample, inside = divmod(step, self._substeps)
            due = [g for g in self._groups if (step - g.ticks.first) % g.ticks.period == 0]
            is_over = step >= self.total
            is_begin = inside == 0 and step <= self.end
            yield length, sample if is_begin else None, [] if is_over else due

    def _begin(self, sample: int) -> None:
        """Record the states at the begin of a sample, and set the controls without a law."""
        self.states[:, sample] = self._recorded
        last = self._ctrl.shape[1] - 1
        if sample > last:
            self.time[:] = self._batch.bind("time")
            self._memory = tuple(group.running.memory for group in self._groups)

        inputs, direct = self._laws.direct
        if len(direct):
            self._applied[:, direct] = self._ctrl[:, min(sample, last), inputs]

    def _evaluate(self, group: LawGroup, qpos: Array, qvel: Array) -> None:
        """Evaluate laws at the current states and apply their controls."""
        control = group.running.evaluate(qpos[:, group.positions], qvel[:, group.velocities])
        self.largest = np.maximum(self.largest, np.abs(control).max(axis=1))
        self._applied[:, group.controls] = control

    def _note(self, sample: int) -> None:
        """Note the controls of a sample, once they are known."""
        if sample == self._ctrl.shape[1]:
            return
        self._controls[:, sample] = self._applied
        for group in self._groups:
            if group.running.has_limits:
                self._is_clipped[:, sample, group.places] = group.running.is_clipped
