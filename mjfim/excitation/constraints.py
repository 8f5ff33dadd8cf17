"""The hard limits of an experiment on its plant: what is looked at, how it begins and ends, what its control may do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.excitation.limits import Limit
from mjfim.excitation.task import DesignTask
from mjfim.model.geom_distance import GeomDistances
from mjfim.model.geom_pairs import find_geom_pairs
from mjfim.optimize.barrier import BarrierExpansion, Bounds
from mjfim.optimize.lq import Weights
from mjfim.plant.batch import SubstepObservations
from mjfim.plant.state_space import StateSpace
from mjfim.records.trajectory import Trajectory
from mjfim.signals import spline_basis

LOOKS = 5  # engine steps of a sample that the barrier looks at, at most
REACH = 0.1  # [m] beyond the least clearance at which distances begin to matter
SHOWN = (
    "position",
    "velocity",
    "acceleration",
    "force",
    "joint_force",
)  # in the order of the observations


def derivative_substeps_of(substeps: int) -> tuple[int, ...]:
    """Engine steps of a sample that derivatives look at: the first ones, where a held control jolts, to the last."""
    return tuple(
        sorted({round(s) for s in np.geomspace(1, substeps, min(LOOKS, substeps)).tolist()})
    )


def _of(limits: tuple[Limit, ...], kind: str) -> list[Limit]:
    return [limit for limit in limits if limit.kind == kind]


def _dense(limits: list[Limit], count: int) -> Bounds | None:
    """Ranges of all controls, infinite where none is stated; None without any."""
    if not limits:
        return None
    lower, upper = np.full(count, -np.inf), np.full(count, np.inf)
    for limit in limits:
        lower[limit.index], upper[limit.index] = limit.lower, limit.upper
    return Bounds.from_range(lower, upper)


def constraint_set_of(task: DesignTask, every: bool = False) -> ConstraintSet:
    """The limits that hold a design, or every stated one. Raises ExperimentError for what cannot be.

    Without limits.enforce only its boundary holds a design.
    """
    e, nu = task.experiment, len(task.controls)
    limits = task.limits if every or e.limits.enforce else ()
    rows = {kind: _of(limits, kind) for kind in SHOWN}
    flat = [limit for kind in SHOWN for limit in rows[kind]]
    q, v, a, f, j = (
        np.array([limit.index for limit in rows[kind]], dtype=np.intp) for kind in SHOWN
    )
    observations = SubstepObservations(
        positions=q,
        velocities=v,
        accelerations=a,
        actuator_forces=f,
        joint_forces=j,
        derivative_substeps=derivative_substeps_of(task.system.grid.substeps),
        timestep=float(task.plant.simulator.model.opt.timestep),
    )
    shown = Bounds.from_range(
        np.array([limit.lower for limit in flat]), np.array([limit.upper for limit in flat])
    )
    free = np.full(nu, np.inf)
    control = _dense(_of(limits, "control"), nu) or Bounds(
        lower=-free, upper=free, scale=_sizes(task)
    )
    clearance, least = None, 0.0
    if e.limits.clearance is not None and (every or e.limits.enforce):
        least = e.limits.clearance
        clearance = _kept_clear(task, least + REACH)
    return ConstraintSet(
        space=task.space,
        dt=task.dt,
        observations=observations,
        shown=shown,
        kinds=tuple(limit.kind for limit in flat),
        names=tuple(limit.name for limit in flat),
        control=control,
        rate=_dense(_of(limits, "control_rate"), nu),
        before=task.initial_hold if e.boundary.start == "rest" else None,
        after=task.final_hold if e.boundary.end == "rest" else None,
        seam=e.boundary.end == "periodic",
        end=None if e.boundary.end == "free" else _end(task),
        target=task.target,
        clearance=clearance,
        least=least,
    )


def _kept_clear(task: DesignTask, reach: float) -> GeomDistances:
    """Distances of all pairs that are not ignored. Raises ExperimentError where there are none, or unknown bodies."""
    try:
        near = find_geom_pairs(
            task.system.model, [frozenset(pair) for pair in task.experiment.limits.ignored]
        )
        return GeomDistances(task.system.model_at(task.theta), near, reach)
    except ExperimentError as error:
        raise ExperimentError(f"limits.{error}") from None


def _sizes(task: DesignTask) -> Array:
    """(nu,) how large a control is where nothing bounds it: as large as the initial one is."""
    size = np.abs(task.control - task.system.rest).max(axis=0)
    return np.where(size > 0.0, size, 1.0)


def _end(task: DesignTask) -> Bounds:
    b, nv, na = task.experiment.boundary, task.space.nv, task.space.na
    width = np.concatenate([np.full(nv, b.position), np.full(nv, b.velocity), np.full(na, np.inf)])
    return Bounds.from_range(-width, width)


def bandwidth_basis(task: DesignTask, t: Array) -> Array | None:
    """(N, M) splines at times t: (N,) of which the control minus its centre is made, where its bandwidth is limited."""
    e = task.experiment
    if e.limits.bandwidth is None:
        return None
    if e.limits.bandwidth > 0.5 * e.rate:
        raise ExperimentError(
            f"limits.bandwidth: {e.limits.bandwidth:g} Hz; a control at {e.rate:g} Hz has {0.5 * e.rate:g} Hz at most"
        )
    return boundary_splines(task, t, e.limits.bandwidth)


def boundary_splines(task: DesignTask, t: Array, bandwidth: float) -> Array:
    """(N, M) splines of a bandwidth [Hz] at times t: (N,) that begin and end as the experiment does."""
    e = task.experiment
    begins, periodic = e.boundary.start == "rest", e.boundary.end == "periodic"
    ends = e.boundary.end == "rest" or (periodic and begins)
    return spline_basis(t, task.horizon, bandwidth, begins, ends, periodic and not begins)


END_WEIGHT = 0.1  # of a condition at the end, over that of one that is held all the time


@dataclass(frozen=True, eq=False)
class ConstraintValues:
    """What the limits look at along a trajectory.

    observed: (N, substeps, w);  distances: (N, m) [m] at the samples 1 ... N, or None
    slopes: (N, m, nv) their derivatives by position, or None where not wanted
    """

    trajectory: Trajectory
    observed: Array
    distances: Array | None = None
    slopes: Array | None = None


@dataclass(frozen=True, eq=False)
class ConstraintSet:
    """The limits of an experiment.

    observations, shown: what is looked at within samples, its ranges (w,), and the kind of each
    control, rate: ranges of (nu,), the latter per second, or None
    before, after: (nu,) control before the first and after the last sample, None where free;  seam: after is the first one
    end, target: ranges of x_N - target, (nx,) and (ns,), or None
    clearance, least: [m] distances and the least allowed, or None
    """

    space: StateSpace
    dt: float
    observations: SubstepObservations
    shown: Bounds
    kinds: tuple[str, ...]
    names: tuple[str, ...]
    control: Bounds
    rate: Bounds | None = None
    before: Array | None = None
    after: Array | None = None
    seam: bool = False
    end: Bounds | None = None
    target: Array | None = None
    clearance: GeomDistances | None = None
    least: float = 0.0

    def tightened(self, shares: Mapping[str, float]) -> ConstraintSet:
        """Some kinds held back from their bounds, by shares of half of their ranges."""
        inner = np.array([shares.get(kind, 0.0) for kind in self.kinds])
        end = [shares.get(kind, 0.0) for kind in ("end_position", "end_velocity")]
        return replace(
            self,
            shown=self.shown.tightened(inner),
            control=self.control.tightened(shares.get("control", 0.0)),
            rate=None
            if self.rate is None
            else self.rate.tightened(shares.get("control_rate", 0.0)),
            least=self._held_clear(shares.get("clearance", 0.0)),
            end=None
            if self.end is None
            else self.end.tightened(np.repeat([*end, 0.0], self._parts)),
        )

    def _held_clear(self, share: float) -> float:
        """The least distance raised by a share of it, at most half of the way to where distances no longer matter."""
        if self.clearance is None:
            return self.least
        return min(self.least * (1.0 + share), 0.5 * (self.least + self.clearance.reach))

    @property
    def _parts(self) -> tuple[int, int, int]:
        """Positions, velocities and activations in the tangent space."""
        return self.space.nv, self.space.nv, self.space.na

    def evaluate(self, trajectory: Trajectory, observed: Array, slopes: bool) -> ConstraintValues:
        """Look at a trajectory. observed: (N, substeps, w) at every engine step"""
        if self.clearance is None:
            return ConstraintValues(trajectory, observed)
        near = self.clearance(trajectory.qpos[1:], slopes)
        return ConstraintValues(trajectory, observed, near.d, near.slope)

    def rates(self, ctrl: Array) -> Array:
        """(N+1, nu) rates of the control into each sample and out of the last, zero where free."""
        first = ctrl[0] if self.before is None else self.before
        last = ctrl[-1] if self.after is None else self.after
        if self.seam:
            last = ctrl[0]
        return np.diff(ctrl, axis=0, prepend=first[None], append=last[None]) / self.dt

    def is_feasible(self, values: ConstraintValues, *, strictly: bool = False) -> bool:
        """Tell whether all constraints hold.

        Args:
            values: Constrained quantities along a trajectory.
            strictly: A margin of zero counts as a violation.
        """
        margins = self.margins(values).values()
        return all(margin > 0.0 if strictly else margin >= 0.0 for margin in margins)

    def margins(self, values: ConstraintValues) -> dict[str, float]:
        """Worst margin of each kind, in its unit, negative outside."""
        return self._worst(values, relative=False)

    def relative_margins(self, values: ConstraintValues) -> dict[str, float]:
        """The same over half of the range of each."""
        return self._worst(values, relative=True)

    def _worst(self, values: ConstraintValues, relative: bool) -> dict[str, float]:
        worst: dict[str, float] = {}

        def tell(kind: str, margins: Array, scale: Array | float) -> None:
            margin = float((margins / scale if relative else margins).min(initial=np.inf))
            if np.isfinite(margin):
                worst[kind] = min(margin, worst.get(kind, margin))

        shown, ctrl = self.shown.margin(values.observed), values.trajectory.ctrl
        for i, kind in enumerate(self.kinds):
            tell(kind, shown[..., i], float(self.shown.scale[i]))
        tell("control", self.control.margin(ctrl), self.control.scale)
        if self.rate is not None:
            tell("control_rate", self.rate.margin(self.rates(ctrl)), self.rate.scale)
        if self.end is not None:
            margin, nv = self.end.margin(self._ended(values.trajectory)), self.space.nv
            tell("end_position", margin[:nv], self.end.scale[:nv])
            tell("end_velocity", margin[nv : 2 * nv], self.end.scale[nv : 2 * nv])
        if values.distances is not None:
            tell("clearance", values.distances - self.least, self.least)
        return worst

    def _ended(self, trajectory: Trajectory) -> Array:
        if self.target is None:
            raise ValueError("no target, no end")
        return self.space.minus(trajectory.state[-1], self.target)

    def _weight(self, N: int) -> float:
        """Of a number that is held at every sample: the barrier is a mean over time."""
        return 1.0 / N

    def value(self, values: ConstraintValues, delta: float) -> float:
        """The barrier."""
        N, looked = len(values.observed), np.array(self.observations.derivative_substeps) - 1
        weight, ctrl = self._weight(N), values.trajectory.ctrl
        total = self.shown.barrier(values.observed[:, looked], delta, weight / len(looked)).value
        total += self.control.barrier(ctrl, delta, weight).value
        if self.rate is not None:
            total += self.rate.barrier(self.rates(ctrl), delta, weight).value
        if self.end is not None:
            total += self.end.barrier(self._ended(values.trajectory), delta, END_WEIGHT).value
        if values.distances is not None:
            total += self._near(values.distances).barrier(values.distances, delta, weight).value
        return total

    def _near(self, distances: Array) -> Bounds:
        """Distances between the least allowed one and where they are no longer looked at."""
        if self.clearance is None:
            raise ValueError("nothing is kept clear")
        m = distances.shape[1]
        return Bounds(
            lower=np.full(m, self.least),
            upper=np.full(m, np.inf),
            scale=np.full(m, self.clearance.reach - self.least),
        )

    def expand(self, values: ConstraintValues, rise: Array, delta: float) -> BarrierExpansion:
        """Expansion about a trajectory. rise: (N, looked-at substeps, w, nx+nu) derivative of the observations"""
        N, looked = len(values.observed), np.array(self.observations.derivative_substeps) - 1
        nx, ctrl = self.space.nx, values.trajectory.ctrl
        nu, weight = ctrl.shape[1], self._weight(N)
        barrier = self.shown.barrier(values.observed[:, looked], delta, weight / len(looked))
        both = np.einsum("kswi,ksw->ki", rise, barrier.slope)
        flat = rise.reshape(N, -1, nx + nu)
        H = np.swapaxes(flat * barrier.curvature.reshape(N, -1, 1), 1, 2) @ flat
        a, b, Q = np.zeros((N + 1, nx)), both[:, nx:], np.zeros((N + 1, nx, nx))
        a[:-1], Q[:-1], S, R = both[:, :nx], H[:, :nx, :nx], H[:, nx:, :nx], H[:, nx:, nx:].copy()
        barrier = self.control.barrier(ctrl, delta, weight)
        b = b + barrier.slope
        R[:, np.arange(nu), np.arange(nu)] += barrier.curvature
        W = np.zeros((N + 1, nu))
        if self.rate is not None:
            barrier = self.rate.barrier(self.rates(ctrl), delta, weight)
            b += (barrier.slope[:-1] - barrier.slope[1:]) / self.dt
            W = barrier.curvature / self.dt**2
            if self.seam:
                b[0] += barrier.slope[-1] / self.dt
            if self.before is None:
                b[0] -= barrier.slope[0] / self.dt
                W[0] = 0.0
            if self.after is None and not self.seam:
                b[-1] += barrier.slope[-1] / self.dt
                W[-1] = 0.0
        if self.end is not None:
            ended = self._ended(values.trajectory)
            barrier, moved = (
                self.end.barrier(ended, delta, END_WEIGHT),
                self.space.minus_derivative(ended),
            )
            a[-1] += moved.T @ barrier.slope
            Q[-1] += moved.T @ (barrier.curvature[:, None] * moved)
        if values.distances is not None and values.slopes is not None:
            barrier, nv = (
                self._near(values.distances).barrier(values.distances, delta, weight),
                self.space.nv,
            )
            a[1:, :nv] += np.einsum("km,kmi->ki", barrier.slope, values.slopes)
            Q[1:, :nv, :nv] += (
                np.swapaxes(values.slopes * barrier.curvature[..., None], 1, 2) @ values.slopes
            )
        step = np.full(nu, np.inf) if self.rate is None else self.rate.scale * self.dt
        return BarrierExpansion(
            a=a,
            b=b,
            weights=Weights(Q=Q, S=S, R=R, W=W),
            observations=rise / self.shown.scale[:, None],
            control_scale=self.control.scale,
            control_step_scale=step,
        )
