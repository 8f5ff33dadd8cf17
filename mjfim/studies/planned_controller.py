"""The controller that plays a design on a robot: the planned control, with or without feedback."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.optimize.barrier import Bounds
from mjfim.plant.state_space import StateSpace
from mjfim.records.trajectory import Playback


@dataclass(frozen=True, kw_only=True, eq=False)
class PlannedController:
    """The controller that plays a design on a robot, with or without feedback.

    Attributes:
        plan: Rows of design.csv.
        space: Layout of the state.
        bounds: Ranges of the nu controls, to which the controller clips [unit of the actuator].
        rest: (nu,) control before the motion begins [unit of the actuator]; None where the
            experiment begins in motion.
        sensed: (ns,) index of the output that measures each entry of the state; -1 where no output
            measures it.
        steps_per_row: Number of engine steps per row of the plan.
        late_steps: Number of engine steps by which the control is late.
        feedback: True where the controller uses the gains.
    """

    plan: Playback
    space: StateSpace
    bounds: Bounds
    rest: Array | None
    sensed: np.ndarray
    steps_per_row: int
    late_steps: int
    feedback: bool

    def before_start(self, state: Array) -> Array:
        """Control before the motion; with feedback, the first gain acts on the state.

        Args:
            state: (ns,) state in which the robot stands.

        Returns:
            (nu,) control [unit of the actuator].
        """
        if self.rest is None:
            return np.asarray(self.plan.ctrl[0])
        if not self.feedback:
            return self.rest
        return np.asarray(self.rest + self.plan.gain[0] @ self._deviation(state, 0))

    def sent(self, model: Any, start: Array, before: Array, noise: Array) -> Array:
        """Controls that the controller sends.

        Args:
            model: Model of the robot.
            start: (ns,) initial state of the robot.
            before: (nu,) control before the motion begins [unit of the actuator].
            noise: (M+1, ny) noise of the outputs that the controller reads [y-unit].

        Returns:
            (M, nu) controls [unit of the actuator].
        """
        rows = len(self.plan.ctrl)
        if not self.feedback:
            return np.stack([self._command(start, k) for k in range(rows)])

        data = mujoco.MjData(model)
        qpos, qvel, act = self.space.split(start)
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
                sent[row] = self._command(state, row)

            arrived = (step - self.late_steps) // self.steps_per_row
            data.ctrl[:] = before if arrived < 0 else sent[arrived]
            mujoco.mj_step(model, data)

        return sent

    def _command(self, state: Array, row: int) -> Array:
        """(nu,) control for a row of the plan at a measured state: (ns,) [unit of the actuator]."""
        control = self.plan.ctrl[row]
        if self.feedback:
            control = control + self.plan.gain[row] @ self._deviation(state, row)

        return np.asarray(np.clip(control, self.bounds.lower, self.bounds.upper))

    def _deviation(self, state: Array, row: int) -> Array:
        """(nx,) planned minus measured state; zero for entries that are not measured."""
        planned = self.plan.state[row]
        measured = np.where(self.sensed >= 0, state, planned)
        for q, _ in self.space.quaternions:
            measured[q : q + 4] /= np.linalg.norm(measured[q : q + 4])

        return self.space.minus(planned, measured)
