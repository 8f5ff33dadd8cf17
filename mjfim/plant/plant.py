"""The plant in MuJoCo's own discrete time: `x_{k+1} = F(x_k, u_k, theta)`, `y_k = h(x_k, u_k, theta)`, and derivatives.

Every derivative is a difference of MuJoCo steps, all samples and perturbations batched into one call. Tangent-space
coordinates throughout (`StateSpace`).
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ModelError, SimulationDiverged
from mjfim.model.parameters import ParameterSet
from mjfim.model.variants import Source
from mjfim.optimize.lq import TangentCurve
from mjfim.plant.batch import BatchSimulator, SubstepObservations
from mjfim.plant.delay import OutputDelay
from mjfim.plant.outputs import OutputMap
from mjfim.records.trajectory import Linearization, Sensitivity, Trajectory


@dataclass(frozen=True)
class DifferenceAccuracy:
    """Steps of the differences, relative to the size of what is perturbed.

    central: two-sided in state and control, else one-sided
    shared: one-sided also along (psi w, w) and in the parameters, so that all directions share their origin
    delta: state and control step of mixed differences;  epsilon: step along (psi w, w)
    """

    central: bool
    delta: float
    epsilon: float
    shared: bool = False


FORWARD_DIFFERENCES = DifferenceAccuracy(central=False, delta=1e-6, epsilon=3e-3)
SHARED_ORIGIN = DifferenceAccuracy(central=False, delta=1e-6, epsilon=1e-3, shared=True)
SHARED_ORIGIN_SHORT = DifferenceAccuracy(central=False, delta=1e-6, epsilon=1e-5, shared=True)
CENTRAL_DIFFERENCES = DifferenceAccuracy(central=True, delta=1e-4, epsilon=1e-3)
FIRST_DERIVATIVE_STEP = 1e-6
SENSITIVITY_STEP = 1e-5
MIN_PARAMETER_EFFECT = (
    1e-2  # relative effect of a parameter below which its difference steps are lengthened
)
MAX_STEP_FACTOR = 100.0  # times at most
MAX_NUMBERS_AT_ONCE = 8_000_000  # numbers that the states of many long curves take at once


@dataclass(frozen=True, eq=False)
class Response:
    """Outputs of S curves over some samples and their derivatives. first: sample of the curve at which they begin

    y: (S, n+1, ny);  common: (S, n+1, ny, p) by theta;  private: (S, n+1, ny, k) by directions of the start
    The derivatives are None where they were not asked for.
    """

    first: int
    y: Array
    common: Array | None
    private: Array | None


@dataclass(frozen=True, eq=False)
class Bilinear:
    """First and mixed second derivatives along one direction (psi w, w), r of them.

    A: (N, nx, nx);  B: (N, nx, nu)
    F_mixed: (r, N, nx+nu, nx) d/dz_i of `DF[psi w, w]`;  h_mixed: (r, N+1, nx+nu, ny) likewise for h, or None where zero
    C: (N+1, ny, nx);  D: (N+1, ny, nu)
    output_delay: of the outputs, or None;  delay_derivative: (p,) its derivative by theta
    observation_jacobian: (N, looked-at substeps, w, nx+nu) derivative of the observations, or None
    """

    A: Array
    B: Array
    C: Array
    D: Array
    F_mixed: Array
    h_mixed: Array | None
    output_delay: OutputDelay | None = None
    delay_derivative: Array | None = None
    observation_jacobian: Array | None = None


class Plant:
    """A model, its parameters and its measured outputs.

    source: of the private copies that are stepped;  start: (ns,) nominal initial state;  substeps: `mj_step` per sample
    smooth: the plant that mixed differences are taken on: itself, or where it has kinks one that has none
    """

    def __init__(
        self,
        source: Source,
        parameters: ParameterSet,
        outputs: OutputMap,
        start: Array,
        substeps: int,
        threads: int | None = None,
        smooth: Plant | None = None,
    ) -> None:
        self.smooth = self if smooth is None else smooth
        self.parameters = parameters
        self.outputs = outputs
        self.source = source
        self.simulator = BatchSimulator(source.model, substeps, outputs.needs_sensors, threads)
        self.space = self.simulator.space
        self.nominal_initial_state = np.array(start, dtype=np.float64)
        self.nu = int(source.model.nu)
        self.dt = substeps * float(source.model.opt.timestep)
        self._start_matrix = parameters.initial_state_derivative(self.space.nx)
        self._bias = parameters.bias_derivative(len(outputs))
        self._reach = np.ones(len(parameters))
        self._models: dict[bytes, Any] = {}
        self._pool: list[Any] = []

    def calibrated(self, theta: Array, trajectory: Trajectory) -> Plant:
        """A plant whose difference steps stand out of the round-off of a trajectory; engine and caches are shared.

        Args:
            theta: (p,) parameters of the trajectory [theta-unit].
            trajectory: Trajectory on which the effect of every parameter is measured.

        Returns:
            The plant with longer difference steps for parameters that hardly move this trajectory, or the plant itself
            if a perturbed rollout diverges.
        """
        found = self.sensitivity(theta, trajectory)
        if found is None:
            return self

        size = np.concatenate(
            [self.difference_sizes(trajectory)[: self.space.nx], np.ones(len(self.outputs))]
        )
        both = np.concatenate([found.psi, found.G], axis=1) * self.parameters.magnitude
        effect = (np.abs(both).max(axis=0) / size[:, None]).max(axis=0)

        other = copy.copy(self)
        other._reach = np.clip(
            MIN_PARAMETER_EFFECT / np.maximum(effect, 1e-300), 1.0, MAX_STEP_FACTOR
        )
        if self.smooth is self:
            other.smooth = other
        return other

    @property
    def engine_steps(self) -> int:
        """MuJoCo steps taken so far, also for differences on the smooth one."""
        return self.simulator.steps + (0 if self.smooth is self else self.smooth.simulator.steps)

    @property
    def quickest_accuracy(self) -> DifferenceAccuracy:
        """The quickest differences that this plant bears."""
        return SHARED_ORIGIN_SHORT if self.smooth.source.soft else SHARED_ORIGIN

    @property
    def parameter_scale(self) -> Array:
        """(p,) change of each parameter that moves the trajectory noticeably; differences are relative to it."""
        return np.asarray(self.parameters.magnitude * self._reach)

    def initial_state(self, theta: Array) -> Array:
        """(..., ns) initial states at theta: (..., p)."""
        return self.space.plus(self.nominal_initial_state, np.asarray(theta) @ self._start_matrix.T)

    def output_delay(self, theta: Array, samples: int) -> OutputDelay | None:
        """The delay of the outputs at theta: (p,) over N+1 samples; None where nothing delays."""
        if not self.parameters.delay_derivative.any():
            return None
        return OutputDelay.on_grid(
            samples, float(self.parameters.delay_derivative @ theta), self.dt
        )

    def model(self, theta: Array) -> Any:
        """The model at theta: (p,); kept for the few values in use."""
        key = np.asarray(theta, dtype=np.float64).tobytes()
        if key not in self._models:
            if len(self._models) > 64:
                self._models.clear()
            self._models[key] = self.parameters.model(self.source, np.asarray(theta))
        return self._models[key]

    def trajectory(self, states: Array, ctrl: Array) -> Trajectory:
        """Record from states: (N+1, ns) and ctrl: (N, nu)."""
        qpos, qvel, act = self.space.split(states)
        return Trajectory(
            t=np.arange(len(states), dtype=np.float64) * self.dt,
            qpos=qpos,
            qvel=qvel,
            act=act,
            ctrl=ctrl,
        )

    def simulate(self, theta: Array, ctrl: Array) -> Trajectory:
        """Open-loop trajectory from the start under ctrl: (N, nu). Raises SimulationDiverged."""
        out = self.simulator.rollout(
            [self.model(theta)], self.initial_state(theta)[None], np.asarray(ctrl)[None]
        )
        if not out.finite[0]:
            raise SimulationDiverged(
                "the simulation diverges under this control; a smaller amplitude or timestep may help"
            )
        return self.trajectory(out.states[0], ctrl)

    def measure(self, theta: Array, ctrl: Array) -> tuple[Array, np.ndarray]:
        """Outputs of many simulations under one control. theta: (m, p), ctrl: (N, nu) -> y (m, N+1, ny), finite (m,)."""
        held = np.broadcast_to(ctrl, (len(theta), *np.shape(ctrl)))
        models, sound = self._many(theta)
        out = self.simulator.rollout(models, self.initial_state(theta), held)
        y = self.outputs(out.states, out.sensors) + (theta @ self._bias.T)[:, None]
        if self.parameters.delay_derivative.any():
            delays = (self.output_delay(row, y.shape[1]) for row in theta)
            y = np.stack(
                [
                    own if delay is None else delay.apply(own)
                    for delay, own in zip(delays, y, strict=True)
                ]
            )
        return y, out.finite & sound

    def _many(self, theta: Array) -> tuple[list[Any], np.ndarray]:
        """A reusable pool of models, one per row of theta, and which of them could be compiled."""
        if self.parameters.needs_compile.any():
            return self._compiled(theta)
        sound = np.ones(len(theta), dtype=bool)
        while len(self._pool) < len(theta):
            self._pool.append(copy.copy(self.source.model))
        for model, row in zip(self._pool, theta, strict=False):
            self.parameters.write(model, row)
            self.source.settle(model)
        return self._pool[: len(theta)], sound

    def _all(self, theta: Array) -> list[Any]:
        """Models, one per row of theta. Raises SimulationDiverged where one cannot be compiled."""
        models, sound = self._many(theta)
        if not sound.all():
            raise SimulationDiverged(
                "MuJoCo cannot compile the model when the parameters move a little"
            )
        return models

    def _compiled(self, theta: Array) -> tuple[list[Any], np.ndarray]:
        models, sound = [], np.ones(len(theta), dtype=bool)
        for i, row in enumerate(theta):
            try:
                models.append(self.parameters.model(self.source, row))
            except ModelError:
                models.append(self.source.model)
                sound[i] = False
        return models, sound

    def predict(
        self, theta: Array, ctrl: Array, step: float = SENSITIVITY_STEP
    ) -> tuple[Array, Array] | None:
        """Outputs y: (N+1, ny) and their derivative G: (N+1, ny, p) by central differences; None if one diverged."""
        found = self._differences(theta, self.initial_state(theta), ctrl, step, None)
        return None if found is None else (found[0], found[1].G)

    def responses(
        self,
        theta: Array,
        starts: Array,
        ctrl: Array,
        free: Array | None = None,
        central: bool = True,
        chunk: int = MAX_NUMBERS_AT_ONCE,
        step: float = SENSITIVITY_STEP,
        sought: np.ndarray | None = None,
    ) -> Iterator[Response | None]:
        """Curves from starts: (S, ns) under ctrl: (S, N, nu), one stretch of time after the other; None where one diverges.

        free: (nx, k) directions of the start by which to differentiate as well, None: no derivatives at all
        central: two-sided differences;  chunk: numbers that the states of a stretch may take
        sought: (p,) parameters by which to differentiate, None: all; biases are for nothing. Outputs are without delay
        """
        wanted = (
            self.parameters.changes_motion
            if sought is None
            else self.parameters.changes_motion & sought
        )
        moving = np.flatnonzero(wanted & (free is not None))
        k, p, N = 0 if free is None else free.shape[1], len(theta), ctrl.shape[1]
        h = (step * self.parameter_scale)[moving]
        moves = np.zeros((len(moving) + k, p))
        moves[np.arange(len(moving)), moving] = h
        nudges = moves @ self._start_matrix.T
        if free is not None:
            nudges[len(moving) :] = step * free.T
        sides = [np.zeros((1, p)), moves, *([-moves] if central else [])]
        pushes = [np.zeros((1, nudges.shape[1])), nudges, *([-nudges] if central else [])]
        models, sound = self._many(np.concatenate([theta + side for side in sides]))
        now = self.space.plus(starts, np.concatenate(pushes)[:, None])
        J, S = now.shape[:2]
        every = [model for model in models for _ in range(S)] if J > 1 else models
        n = int(np.clip(chunk / (J * S * self.simulator.substeps * (1 + now.shape[2])), 1, N))
        width = np.concatenate([h, np.full(k, step)]) * (2.0 if central else 1.0)
        for first in range(0, N, n):
            held = ctrl[:, first : first + n]
            used = np.broadcast_to(held, (J, *held.shape)).reshape(J * S, *held.shape[1:])
            out = self.simulator.rollout(every, now.reshape(J * S, -1), used)
            if not (out.finite.all() and sound.all()):
                yield None
                return
            states = out.states.reshape(J, S, held.shape[1] + 1, -1)
            sensors = (
                None if out.sensors is None else out.sensors.reshape(J, S, held.shape[1] + 1, -1)
            )
            y = (
                self.outputs(states[0], None if sensors is None else sensors[0])
                + self._bias @ theta
            )
            if free is None:
                yield Response(first, y, None, None)
            else:
                G = self._quotients(states, sensors, width, central)
                common = np.zeros((*y.shape, p))
                common[..., moving] = G[..., : len(moving)]
                yield Response(first, y, common + self._bias, G[..., len(moving) :])
            now = states[:, :, -1]

    def _quotients(
        self, states: Array, sensors: Array | None, width: Array, central: bool
    ) -> Array:
        """(S, n+1, ny, q) differences of outputs from states: (1 + q or 1 + 2q, S, n+1, ns) whose first is the origin."""
        q, here = len(width), states[0]
        over = width.reshape(-1, 1, 1, 1)
        dx = self.space.minus(states[1 : q + 1], states[q + 1 :] if central else here) / over
        ds = None
        if sensors is not None:
            ds = (sensors[1 : q + 1] - (sensors[q + 1 :] if central else sensors[0])) / over
        return np.moveaxis(self.outputs.tangent(here, dx, ds), 0, 3)

    def project(
        self, theta: Array, base: Trajectory, zeta: TangentCurve, gamma: float, K: Array
    ) -> Trajectory | None:
        """P(xi + gamma zeta) about the base trajectory; None if it diverged. K: (N, nu, nx), all zero = open loop."""
        mu = base.ctrl + gamma * zeta.v
        model = self.model(theta)
        if not K.any():
            out = self.simulator.rollout([model], base.state[:1], mu[None])
            return self.trajectory(out.states[0], mu) if out.finite[0] else None
        with np.errstate(over="ignore", invalid="ignore"):
            alpha = self.space.plus(base.state, gamma * zeta.z)
        states, ctrl, finite = self.simulator.closed_loop(model, alpha, mu, K)
        return self.trajectory(states, ctrl) if finite else None

    def observe(
        self, theta: Array, ctrl: Array, observations: SubstepObservations
    ) -> tuple[Trajectory, Array] | None:
        """The open-loop trajectory under ctrl: (N, nu) and the observations at every engine step, (N, substeps, w).

        None if it diverged.
        """
        out = self.simulator.rollout(
            [self.model(theta)],
            self.initial_state(theta)[None],
            np.asarray(ctrl)[None],
            observations,
        )
        if not out.finite[0] or out.observed is None:
            return None
        return self.trajectory(out.states[0], ctrl), out.observed[0]

    def difference(self, new: Trajectory, old: Trajectory) -> TangentCurve:
        """(x_new - x_old, u_new - u_old) in the tangent space."""
        return TangentCurve(z=self.space.minus(new.state, old.state), v=new.ctrl - old.ctrl)

    def difference_sizes(self, trajectory: Trajectory) -> Array:
        """(nx+nu,) magnitudes to which difference steps are relative, at least 1 for states."""
        nv, na = self.space.nv, self.space.na
        dq = np.ones(nv)
        speed = np.maximum(1.0, np.abs(trajectory.qvel).max(axis=0, initial=0.0))
        act = (
            np.maximum(1.0, np.abs(trajectory.act).max(axis=0, initial=0.0)) if na else np.zeros(0)
        )
        ctrl = np.abs(trajectory.ctrl).max(axis=0)
        return np.concatenate([dq, speed, act, np.where(ctrl > 1e-3, ctrl, 1.0)])

    def sensitivity(
        self,
        theta: Array,
        trajectory: Trajectory,
        step: float | Array = SENSITIVITY_STEP,
        central: bool = True,
    ) -> Sensitivity | None:
        """psi and G by differences of whole rollouts under the same control; None if one diverged.

        step: relative to `parameter_scale`, one number or (p,);  central: else one-sided where no sensor is an output
        """
        central = central or self.outputs.needs_sensors
        found = self._differences(
            theta, trajectory.state[0], trajectory.ctrl, step, trajectory.state, central
        )
        return None if found is None else found[1]

    def _differences(
        self,
        theta: Array,
        start: Array,
        ctrl: Array,
        step: float | Array,
        states: Array | None,
        central: bool = True,
    ) -> tuple[Array, Sensitivity] | None:
        """Outputs (N+1, ny) and sensitivity from rollouts at theta +- h, one pair per parameter that moves anything.

        states: (N+1, ns) at theta where they are known already; else, and where sensors delay, one more rollout
        """
        moving = np.flatnonzero(self.parameters.changes_motion)
        m, p, N = len(moving), len(theta), len(ctrl)
        delay = self.output_delay(theta, N + 1)
        own = states is None or (delay is not None and self.outputs.needs_sensors)
        h = (step * self.parameter_scale)[moving]
        moves = np.zeros((m, p))
        moves[np.arange(m), moving] = h
        moves = np.concatenate([moves, -moves if central else moves[:0], np.zeros((int(own), p))])
        psi, G = np.zeros((N + 1, self.space.nx, p)), np.zeros((N + 1, len(self.outputs), p))
        sensors, here = None, np.zeros((N + 1, 0)) if states is None else states
        if len(moves):
            starts = self.space.plus(start, moves @ self._start_matrix.T)
            held = np.broadcast_to(ctrl, (len(moves), *ctrl.shape))
            models, sound = self._many(theta + moves)
            out = self.simulator.rollout(models, starts, held)
            if not (out.finite & sound).all():
                return None
            if own:
                here, sensors = out.states[-1], None if out.sensors is None else out.sensors[-1]
            width = (2.0 if central else 1.0) * h[:, None, None]
            dx = (
                self.space.minus(out.states[:m], out.states[m : 2 * m] if central else here) / width
            )
            ds = None if out.sensors is None else (out.sensors[:m] - out.sensors[m : 2 * m]) / width
            psi[..., moving] = np.moveaxis(dx, 0, 2)
            G[..., moving] = np.moveaxis(self.outputs.tangent(here, dx, ds), 0, 2)
        G += self._bias
        y = self.outputs(here, sensors) + self._bias @ theta
        if delay is not None:
            G = delay.apply(G) + delay.derivative(y)[..., None] * self.parameters.delay_derivative
            y = delay.apply(y)
        return y, Sensitivity(psi=psi, G=G)

    def linearize(
        self, theta: Array, trajectory: Trajectory, step: float = FIRST_DERIVATIVE_STEP
    ) -> Linearization:
        """A, B, E, C, D, H by central differences in one batch per model. Raises SimulationDiverged."""
        p = len(self.parameters)
        states, ctrl = self._ends(trajectory)
        A, B, C, D = self.jacobians(theta, trajectory, step)
        dp, hp = self._by_theta(theta, states, ctrl, step)
        E = np.moveaxis(_finite(dp[:, :-1]), 0, 2)
        H = np.moveaxis(
            self.outputs.tangent(states, np.zeros((p, len(states), self.space.nx)), hp), 0, 2
        )
        H = H + self._bias
        return Linearization(A=A, B=B, E=E, C=C, D=D, H=H)

    def one_step(
        self, theta: Array, trajectory: Trajectory, samples: np.ndarray, step: float
    ) -> Array:
        """(n, p) effects of each parameter on the next state and on the sensors, at some samples, in natural units.

        Rows are relative to the sizes of states and to the largest effect on each sensor. Raises SimulationDiverged.
        """
        p, states = len(self.parameters), trajectory.state[samples]
        dx, ds = self._by_theta(theta, states, trajectory.ctrl[samples], step)
        parts = [_finite(dx) / (self.dt * self.difference_sizes(trajectory)[: self.space.nx])]
        if ds is not None:
            dy = self.outputs.tangent(states, np.zeros_like(dx), ds)
            size = np.abs(dy * self.parameters.magnitude[:, None, None]).max(axis=(0, 1))
            parts.append(dy / np.where(size > 0.0, size, 1.0))
        return np.concatenate([part.reshape(p, -1) for part in parts], axis=1).T

    def _by_theta(
        self, theta: Array, states: Array, ctrl: Array, step: float
    ) -> tuple[Array, Array | None]:
        """Derivatives of one sample by every parameter: (p, n, nx), and of the sensors (p, n, ns) or None."""
        p, h = len(self.parameters), step * self.parameter_scale
        models = self._all(np.concatenate([theta + np.diag(h), theta - np.diag(h)]))
        same = np.broadcast_to(states, (2 * p, *states.shape)).reshape(-1, states.shape[1])
        held = np.broadcast_to(ctrl, (2 * p, *ctrl.shape)).reshape(-1, self.nu)
        return self._halves(models, same, held, p, h)

    def jacobians(
        self, theta: Array, trajectory: Trajectory, step: float = FIRST_DERIVATIVE_STEP
    ) -> tuple[Array, Array, Array, Array]:
        """A, B, C, D of `linearize` alone."""
        nx = self.space.nx
        z_step = step * self.difference_sizes(trajectory)
        count = len(z_step)
        xs, us = self._perturbed(
            *self._ends(trajectory), np.concatenate([np.diag(z_step), -np.diag(z_step)])
        )
        dz, hz = self._halves([self.model(theta)], xs, us, count, z_step)
        dx = np.moveaxis(_finite(dz[:, :-1]), 0, 2)
        dy = np.moveaxis(
            self.outputs.tangent(trajectory.state, self._identity(dz.shape[1]), hz), 0, 2
        )
        return dx[..., :nx], dx[..., nx:], dy[..., :nx], dy[..., nx:]

    def observation_jacobians(
        self,
        theta: Array,
        trajectory: Trajectory,
        observations: SubstepObservations,
        step: float = FIRST_DERIVATIVE_STEP,
    ) -> tuple[Array, Array, Array]:
        """A, B and the derivatives (N, looked-at substeps, w, nx+nu) of the observations, by one-sided differences."""
        nx, states, ctrl = self.space.nx, trajectory.state[:-1], trajectory.ctrl
        delta = step * self.difference_sizes(trajectory)
        moves = np.concatenate([np.diag(delta), np.zeros((1, len(delta)))])
        xs, us = self._perturbed(states, ctrl, moves)
        stepped = self.simulator.step([self.model(theta)], xs, us, observations)
        if stepped.observed is None:
            raise ValueError("nothing was observed")
        out = stepped.states.reshape(len(moves), len(states), -1)
        rise = stepped.observed.reshape(len(moves), len(states), *stepped.observed.shape[1:])
        AB = np.moveaxis(_finite(self.space.minus(out[:-1], out[-1:]) / delta[:, None, None]), 0, 2)
        slopes = np.moveaxis((rise[:-1] - rise[-1:]) / delta[:, None, None, None], 0, 3)
        return AB[..., :nx], AB[..., nx:], slopes

    def _identity(self, samples: int) -> Array:
        """(nx+nu, samples, nx) tangent step of the state per unit of (x, u)."""
        nx = self.space.nx
        step = np.zeros((nx + self.nu, samples, nx))
        step[:nx] = np.eye(nx)[:, None, :]
        return step

    def _ends(self, trajectory: Trajectory) -> tuple[Array, Array]:
        """States and controls at all N+1 samples; the last control is held for the outputs of the last sample."""
        return trajectory.state, np.concatenate([trajectory.ctrl, trajectory.ctrl[-1:]])

    def _perturbed(self, states: Array, ctrl: Array, moves: Array) -> tuple[Array, Array]:
        """Every sample moved by each row of moves: (k, nx+nu) -> flat states (k*n, ns) and controls (k*n, nu)."""
        nx = self.space.nx
        xs = self.space.plus(states[None], moves[:, None, :nx])
        us = ctrl[None] + moves[:, None, nx:]
        return xs.reshape(-1, states.shape[1]), us.reshape(-1, self.nu)

    def _halves(
        self, models: list[Any], xs: Array, us: Array, count: int, step: Array
    ) -> tuple[Array, Array | None]:
        """Central quotients of a batch whose first half is the plus side: (count, n, nx) and sensors (count, n, ns)."""
        stepped = self.simulator.step(models, xs, us)
        out, sensed = stepped.states, stepped.sensors
        width = 2.0 * step[:, None, None]
        pair = out.reshape(2, count, -1, out.shape[1])
        dx = self.space.minus(pair[0], pair[1]) / width
        if sensed is None:
            return dx, None
        s = sensed.reshape(2, count, -1, sensed.shape[1])
        return dx, (s[0] - s[1]) / width

    def bilinear(
        self,
        theta: Array,
        trajectory: Trajectory,
        psi: Array,
        directions: Array,
        accuracy: DifferenceAccuracy,
        observations: SubstepObservations | None = None,
    ) -> Bilinear:
        """Derivatives of `DF[psi w, w]` by (x, u) for each direction w, and A, B.

        psi: (N+1, nx, p);  directions: (r, p). Mixed differences are those of the smooth plant, all else is this one's.
        """
        if accuracy.shared and not self.simulator.sensors:
            return self._drafted(theta, trajectory, psi, directions, accuracy, observations)
        found = self._paired(theta, trajectory, psi, directions, accuracy, observations)
        if self.smooth is self:
            return found
        smooth = self.smooth._paired(theta, trajectory, psi, directions, accuracy, None)
        return replace(found, F_mixed=smooth.F_mixed, h_mixed=smooth.h_mixed)

    def _paired(
        self,
        theta: Array,
        trajectory: Trajectory,
        psi: Array,
        directions: Array,
        accuracy: DifferenceAccuracy,
        observations: SubstepObservations | None,
    ) -> Bilinear:
        """Pairs +-epsilon along (psi w, w) at every (x, u) moved by +-delta (or +delta and none); their means give A and B."""
        states, ctrl = self._ends(trajectory)
        delta = accuracy.delta * self.difference_sizes(trajectory)
        count = len(delta)
        moves = np.concatenate(
            [np.diag(delta), -np.diag(delta) if accuracy.central else np.zeros((1, count))]
        )
        xs, us = self._perturbed(states, ctrl, moves)
        shape = (len(moves), len(states), -1)
        firsts, mixed, h_firsts, h_mixed = [], [], [], []
        observed = None
        for r, w in enumerate(directions):
            push = psi @ w
            epsilon = self._epsilon(accuracy, push, w)
            shift = np.broadcast_to(epsilon * push, (len(moves), *push.shape)).reshape(
                -1, push.shape[1]
            )
            both = np.concatenate([self.space.plus(xs, shift), self.space.plus(xs, -shift)])
            models = self._all(np.stack([theta + epsilon * w, theta - epsilon * w]))
            stepped = self.simulator.step(
                models, both, np.concatenate([us, us]), observations if r == 0 else None
            )
            sensed, pair = stepped.sensors, stepped.states.reshape(2, *shape)
            widths = (2.0 if accuracy.central else 1.0) * delta[:, None, None]
            if stepped.observed is not None:
                t = stepped.observed.reshape(
                    2, len(moves), len(states), *stepped.observed.shape[1:]
                )
                rise = np.mean(t[:, :count] - t[:, count:], axis=0) / widths[..., None]
                observed = np.moveaxis(rise[:, :-1], 0, 3)
            slope = self.space.minus(pair[0], pair[1]) / (2.0 * epsilon)
            mixed.append((slope[:count] - slope[count:]) / widths)
            firsts.append(
                np.mean(self.space.minus(pair[:, :count], pair[:, count:]), axis=0) / widths
            )
            if sensed is not None:
                s = sensed.reshape(2, *shape)
                tilt = (s[0] - s[1]) / (2.0 * epsilon)
                h_mixed.append((tilt[:count] - tilt[count:]) / widths)
                h_firsts.append(np.mean(s[:, :count] - s[:, count:], axis=0) / widths)
        nx, unit = self.space.nx, self._identity(len(states))
        dy = self.outputs.tangent(states, unit, np.mean(h_firsts, axis=0) if h_firsts else None)
        second = None
        if h_mixed or self.outputs.curved:
            bends = [
                self.outputs.bend(states, unit, psi @ w, h_mixed[r] if h_mixed else None)
                for r, w in enumerate(directions)
            ]
            second = np.moveaxis(np.array(bends), 1, 2)
        AB = np.moveaxis(np.mean(firsts, axis=0)[:, :-1], 0, 2)
        CD = np.moveaxis(dy, 0, 2)
        F_mixed = np.moveaxis(np.array(mixed)[:, :, :-1], 1, 2)
        return Bilinear(
            AB[..., :nx],
            AB[..., nx:],
            CD[..., :nx],
            CD[..., nx:],
            F_mixed,
            second,
            self.output_delay(theta, len(states)),
            self.parameters.delay_derivative,
            observed,
        )

    def _drafted(
        self,
        theta: Array,
        trajectory: Trajectory,
        psi: Array,
        directions: Array,
        accuracy: DifferenceAccuracy,
        observations: SubstepObservations | None,
    ) -> Bilinear:
        """`bilinear` by one-sided differences, for outputs that are no sensors: a batch at the origin serves all directions."""
        states, ctrl = self._ends(trajectory)
        delta = accuracy.delta * self.difference_sizes(trajectory)
        count, nx = len(delta), self.space.nx
        moves = np.concatenate([np.diag(delta), np.zeros((1, count))])
        xs, us = self._perturbed(states, ctrl, moves)
        shape, widths = (len(moves), len(states), -1), delta[:, None, None]
        stepped = self.simulator.step([self.model(theta)], xs, us, observations)
        origin = stepped.states.reshape(shape)
        first = self.space.minus(origin[:count], origin[count:]) / widths
        if self.smooth is not self:
            origin = self.smooth.simulator.step([self.smooth.model(theta)], xs, us).states.reshape(
                shape
            )
        observed, mixed = None, []
        if stepped.observed is not None:
            t = stepped.observed.reshape(len(moves), len(states), *stepped.observed.shape[1:])
            observed = np.moveaxis((t[:count, :-1] - t[count:, :-1]) / widths[..., None], 0, 3)
        for w in directions:
            push = psi @ w
            epsilon = self._epsilon(accuracy, push, w)
            shift = np.broadcast_to(epsilon * push, (len(moves), *push.shape)).reshape(
                -1, push.shape[1]
            )
            models = self.smooth._all((theta + epsilon * w)[None])
            out = self.smooth.simulator.step(models, self.space.plus(xs, shift), us).states
            slope = self.space.minus(out.reshape(shape), origin) / epsilon
            mixed.append((slope[:count] - slope[count:]) / widths)
        unit = self._identity(len(states))
        second = None
        if self.outputs.curved:
            second = np.moveaxis(
                np.array([self.outputs.bend(states, unit, psi @ w, None) for w in directions]), 1, 2
            )
        AB = np.moveaxis(first[:, :-1], 0, 2)
        CD = np.moveaxis(self.outputs.tangent(states, unit, None), 0, 2)
        F_mixed = np.moveaxis(np.array(mixed)[:, :, :-1], 1, 2)
        delay = self.output_delay(theta, len(states))
        parts = (AB[..., :nx], AB[..., nx:], CD[..., :nx], CD[..., nx:], F_mixed, second)
        return Bilinear(*parts, delay, self.parameters.delay_derivative, observed)

    def _epsilon(self, accuracy: DifferenceAccuracy, push: Array, w: Array) -> float:
        """Step along (psi w, w): relative to the larger of its two parts."""
        inside = np.where(self.parameters.changes_model, np.abs(w / self.parameter_scale), 0.0).max(
            initial=0.0
        )
        return float(accuracy.epsilon / max(np.abs(push).max(initial=0.0), inside, 1e-300))


def _finite(derivative: Array) -> Array:
    if not np.isfinite(derivative).all():
        raise SimulationDiverged("a perturbed step diverged while linearising")
    return derivative
