"""The plant in MuJoCo's own discrete time: `x_{k+1} = F(x_k, u_k, theta)`, `y_k = h(x_k, u_k, theta)`, and derivatives.

Every derivative is a difference of MuJoCo steps, all samples and perturbations batched into one call. Tangent-space
coordinates throughout (`StateSpace`).
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjfim.engine import Engine
from mjfim.errors import SimulationDiverged
from mjfim.lq import TangentCurve
from mjfim.outputs import OutputMap
from mjfim.parameters import ParameterSet
from mjfim.trajectory import Array, Linearization, Sensitivity, Trajectory


@dataclass(frozen=True)
class Accuracy:
    """Steps of the differences, relative to the size of what is perturbed.

    central: two-sided in state and control, else one-sided
    delta: state and control step of mixed differences;  epsilon: step along (psi w, w)
    """

    central: bool
    delta: float
    epsilon: float


FAST = Accuracy(central=False, delta=1e-6, epsilon=3e-3)
CENTRAL = Accuracy(central=True, delta=1e-4, epsilon=1e-3)
FIRST_DERIVATIVE_STEP = 1e-6
SENSITIVITY_STEP = 1e-5


@dataclass(frozen=True, eq=False)
class Bilinear:
    """First and mixed second derivatives along one direction (psi w, w), r of them.

    A: (N, nx, nx);  B: (N, nx, nu)
    F_mixed: (r, N, nx+nu, nx) d/dz_i of `DF[psi w, w]`;  h_mixed: (r, N+1, nx+nu, ny) likewise for h, or None where zero
    C: (N+1, ny, nx);  D: (N+1, ny, nu)
    """

    A: Array
    B: Array
    C: Array
    D: Array
    F_mixed: Array
    h_mixed: Array | None


class Plant:
    """A model, its parameters and its measured outputs.

    model: compiled at any theta (a private copy is made);  start: (ns,) initial state;  rate: samples per second [Hz]
    """

    def __init__(
        self,
        model: Any,
        parameters: ParameterSet,
        outputs: OutputMap,
        start: Array,
        substeps: int,
        threads: int | None = None,
    ) -> None:
        self.parameters = parameters
        self.outputs = outputs
        self.start = np.array(start, dtype=np.float64)
        self.base = model
        self.engine = Engine(model, substeps, outputs.needs_sensors, threads)
        self.space = self.engine.space
        self.nu = int(model.nu)
        self.dt = substeps * float(model.opt.timestep)
        self._models: dict[bytes, Any] = {}
        self._pool: list[Any] = []

    def model(self, theta: Array) -> Any:
        """The model at theta: (p,); kept for the few values in use."""
        key = np.asarray(theta, dtype=np.float64).tobytes()
        if key not in self._models:
            if len(self._models) > 8:
                self._models.clear()
            self._models[key] = self.parameters.model(self.base, np.asarray(theta))
        return self._models[key]

    def trajectory(self, states: Array, ctrl: Array) -> Trajectory:
        """Record from states: (N+1, ns) and ctrl: (N, nu)."""
        qpos, qvel, act = self.space.split(states)
        return Trajectory(np.arange(len(states), dtype=np.float64) * self.dt, qpos, qvel, act, ctrl)

    def simulate(self, theta: Array, ctrl: Array) -> Trajectory:
        """Open-loop trajectory from the start under ctrl: (N, nu). Raises SimulationDiverged."""
        out = self.engine.rollout([self.model(theta)], self.start[None], np.asarray(ctrl)[None])
        if not out.finite[0]:
            raise SimulationDiverged(
                "the simulation diverges under this control; a smaller amplitude or timestep may help"
            )
        return self.trajectory(out.states[0], ctrl)

    def measure(self, theta: Array, ctrl: Array) -> tuple[Array, np.ndarray]:
        """Outputs of many simulations under one control. theta: (m, p), ctrl: (N, nu) -> y (m, N+1, ny), finite (m,)."""
        start = np.broadcast_to(self.start, (len(theta), len(self.start)))
        held = np.broadcast_to(ctrl, (len(theta), *np.shape(ctrl)))
        out = self.engine.rollout(self._many(theta), start, held)
        return self.outputs(out.states, out.sensors), out.finite

    def _many(self, theta: Array) -> list[Any]:
        """A reusable pool of models, one per row of theta."""
        while len(self._pool) < len(theta):
            self._pool.append(copy.copy(self.base))
        for model, row in zip(self._pool, theta, strict=False):
            self.parameters.write(model, row)
        return self._pool[: len(theta)]

    def predict(self, theta: Array, ctrl: Array, step: float = SENSITIVITY_STEP) -> tuple[Array, Array] | None:
        """Outputs y: (N+1, ny) and their derivative G: (N+1, ny, p) by central differences; None if one diverged."""
        p, h = len(self.parameters), step * self.parameters.step
        y, finite = self.measure(np.concatenate([theta[None], theta + np.diag(h), theta - np.diag(h)]), ctrl)
        if not finite.all():
            return None
        return y[0], np.moveaxis((y[1 : p + 1] - y[p + 1 :]) / (2.0 * h[:, None, None]), 0, 2)

    def project(self, theta: Array, base: Trajectory, zeta: TangentCurve, gamma: float, K: Array) -> Trajectory | None:
        """P(xi + gamma zeta) about the base trajectory; None if it diverged. K: (N, nu, nx), all zero = open loop."""
        mu = base.ctrl + gamma * zeta.v
        model = self.model(theta)
        if not K.any():
            out = self.engine.rollout([model], base.state[:1], mu[None])
            return self.trajectory(out.states[0], mu) if out.finite[0] else None
        alpha = self.space.plus(base.state, gamma * zeta.z)
        states, ctrl, finite = self.engine.closed_loop(model, alpha, mu, K)
        return self.trajectory(states, ctrl) if finite else None

    def difference(self, new: Trajectory, old: Trajectory) -> TangentCurve:
        """(x_new - x_old, u_new - u_old) in the tangent space."""
        return TangentCurve(self.space.minus(new.state, old.state), new.ctrl - old.ctrl)

    def steps_of(self, trajectory: Trajectory) -> Array:
        """(nx+nu,) magnitudes to which difference steps are relative, at least 1 for states."""
        nv, na = self.space.nv, self.space.na
        dq = np.ones(nv)
        speed = np.maximum(1.0, np.abs(trajectory.qvel).max(axis=0, initial=0.0))
        act = np.maximum(1.0, np.abs(trajectory.act).max(axis=0, initial=0.0)) if na else np.zeros(0)
        ctrl = np.abs(trajectory.ctrl).max(axis=0)
        return np.concatenate([dq, speed, act, np.where(ctrl > 1e-3, ctrl, 1.0)])

    def sensitivity(self, theta: Array, trajectory: Trajectory, step: float = SENSITIVITY_STEP) -> Sensitivity | None:
        """psi and G by central differences of 2p whole rollouts under the same control; None if one diverged."""
        p = len(self.parameters)
        h = step * self.parameters.step
        thetas = np.concatenate([theta + np.diag(h), theta - np.diag(h)])
        start = np.broadcast_to(trajectory.state[0], (2 * p, trajectory.state.shape[1]))
        ctrl = np.broadcast_to(trajectory.ctrl, (2 * p, *trajectory.ctrl.shape))
        out = self.engine.rollout(self._many(thetas), start, ctrl)
        if not out.finite.all():
            return None
        width = 2.0 * h[:, None, None]
        dx = self.space.minus(out.states[:p], out.states[p:]) / width
        ds = None if out.sensors is None else (out.sensors[:p] - out.sensors[p:]) / width
        return Sensitivity(np.moveaxis(dx, 0, 2), np.moveaxis(self.outputs.tangent(dx, ds), 0, 2))

    def linearize(self, theta: Array, trajectory: Trajectory, step: float = FIRST_DERIVATIVE_STEP) -> Linearization:
        """A, B, E, C, D, H by central differences in one batch per model. Raises SimulationDiverged."""
        nx, p = self.space.nx, len(self.parameters)
        states, ctrl = self._ends(trajectory)
        A, B, C, D = self.jacobians(theta, trajectory, step)
        theta_step = step * self.parameters.step
        thetas = np.concatenate([theta + np.diag(theta_step), theta - np.diag(theta_step)])
        same = np.broadcast_to(states, (2 * p, *states.shape)).reshape(-1, states.shape[1])
        held = np.broadcast_to(ctrl, (2 * p, *ctrl.shape)).reshape(-1, self.nu)
        dp, hp = self._halves(self._many(thetas), same, held, p, theta_step)
        E = np.moveaxis(_finite(dp[:, :-1]), 0, 2)
        H = np.moveaxis(self.outputs.tangent(np.zeros((p, len(states), nx)), hp), 0, 2)
        return Linearization(A, B, E, C, D, H)

    def jacobians(
        self, theta: Array, trajectory: Trajectory, step: float = FIRST_DERIVATIVE_STEP
    ) -> tuple[Array, Array, Array, Array]:
        """A, B, C, D of `linearize` alone."""
        nx = self.space.nx
        z_step = step * self.steps_of(trajectory)
        count = len(z_step)
        xs, us = self._perturbed(*self._ends(trajectory), np.concatenate([np.diag(z_step), -np.diag(z_step)]))
        dz, hz = self._halves([self.model(theta)], xs, us, count, z_step)
        dx = np.moveaxis(_finite(dz[:, :-1]), 0, 2)
        dy = np.moveaxis(self.outputs.tangent(self._identity(dz.shape[1]), hz), 0, 2)
        return dx[..., :nx], dx[..., nx:], dy[..., :nx], dy[..., nx:]

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

    def _halves(self, models: list[Any], xs: Array, us: Array, count: int, step: Array) -> tuple[Array, Array | None]:
        """Central quotients of a batch whose first half is the plus side: (count, n, nx) and sensors (count, n, ns)."""
        out, sensed = self.engine.step(models, xs, us)
        width = 2.0 * step[:, None, None]
        pair = out.reshape(2, count, -1, out.shape[1])
        dx = self.space.minus(pair[0], pair[1]) / width
        if sensed is None:
            return dx, None
        s = sensed.reshape(2, count, -1, sensed.shape[1])
        return dx, (s[0] - s[1]) / width

    def bilinear(
        self, theta: Array, trajectory: Trajectory, psi: Array, directions: Array, accuracy: Accuracy
    ) -> Bilinear:
        """Derivatives of `DF[psi w, w]` by (x, u) for each direction w, and A, B from the same steps.

        psi: (N+1, nx, p);  directions: (r, p). Mixed differences: the pair +-epsilon along (psi w, w) at every (x, u)
        perturbed by +-delta (or +delta and none). The means of the pairs give A and B.
        """
        states, ctrl = self._ends(trajectory)
        delta = accuracy.delta * self.steps_of(trajectory)
        count = len(delta)
        moves = np.concatenate([np.diag(delta), -np.diag(delta) if accuracy.central else np.zeros((1, count))])
        xs, us = self._perturbed(states, ctrl, moves)
        shape = (len(moves), len(states), -1)
        firsts, mixed, h_firsts, h_mixed = [], [], [], []
        for w in directions:
            push = psi @ w
            epsilon = accuracy.epsilon / max(np.abs(push).max(), np.abs(w / self.parameters.step).max())
            shift = np.broadcast_to(epsilon * push, (len(moves), *push.shape)).reshape(-1, push.shape[1])
            both = np.concatenate([self.space.plus(xs, shift), self.space.plus(xs, -shift)])
            models = self._many(np.stack([theta + epsilon * w, theta - epsilon * w]))
            out, sensed = self.engine.step(models, both, np.concatenate([us, us]))
            pair = out.reshape(2, *shape)
            widths = (2.0 if accuracy.central else 1.0) * delta[:, None, None]
            slope = self.space.minus(pair[0], pair[1]) / (2.0 * epsilon)
            mixed.append((slope[:count] - slope[count:]) / widths)
            firsts.append(np.mean(self.space.minus(pair[:, :count], pair[:, count:]), axis=0) / widths)
            if sensed is not None:
                s = sensed.reshape(2, *shape)
                tilt = (s[0] - s[1]) / (2.0 * epsilon)
                h_mixed.append((tilt[:count] - tilt[count:]) / widths)
                h_firsts.append(np.mean(s[:, :count] - s[:, count:], axis=0) / widths)
        return self._bilinear(firsts, mixed, h_firsts, h_mixed)

    def _bilinear(
        self, firsts: list[Array], mixed: list[Array], h_firsts: list[Array], h_mixed: list[Array]
    ) -> Bilinear:
        nx, count = self.space.nx, self.space.nx + self.nu
        first = np.mean(firsts, axis=0)
        n = first.shape[1]
        dy = self.outputs.tangent(self._identity(n), np.mean(h_firsts, axis=0) if h_firsts else None)
        second = None
        if h_mixed:
            tangents = [self.outputs.tangent(np.zeros((count, n, nx)), h) for h in h_mixed]
            second = np.moveaxis(np.array(tangents), 1, 2)
        AB = np.moveaxis(first[:, :-1], 0, 2)
        CD = np.moveaxis(dy, 0, 2)
        F_mixed = np.moveaxis(np.array(mixed)[:, :, :-1], 1, 2)
        return Bilinear(AB[..., :nx], AB[..., nx:], CD[..., :nx], CD[..., nx:], F_mixed, second)


def _finite(derivative: Array) -> Array:
    if not np.isfinite(derivative).all():
        raise SimulationDiverged("a perturbed step diverged while linearising")
    return derivative
