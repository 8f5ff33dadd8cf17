"""The limits at every engine step of the model as the user wrote it: clamps, stops, contacts and all."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.excitation.constraints import (
    ConstraintSet,
    ConstraintValues,
    bandwidth_basis,
    constraint_set_of,
)
from mjfim.excitation.task import DesignTask
from mjfim.plant.batch import BatchSimulator
from mjfim.records.design import LimitUsage
from mjfim.records.trajectory import Trajectory

SAME_STATE_TOLERANCE = (
    1e-6  # deviation of a state, in its unit, up to which two simulations are the same
)


@dataclass(frozen=True)
class Verification:
    """margins: worst of each kind over all engine steps, in its unit, negative outside

    deviation: largest difference of a state at the samples from the trajectory that was designed
    relative_margins: the margins over half of each range;  unenforced: kinds that are checked, not enforced
    usage: of every limit over time
    """

    margins: dict[str, float]
    relative_margins: dict[str, float]
    deviation: float
    unenforced: frozenset[str] = frozenset()
    usage: tuple[LimitUsage, ...] = ()

    @property
    def is_feasible(self) -> bool:
        """Every limit that is enforced holds."""
        return all(
            margin >= 0.0 for kind, margin in self.margins.items() if kind not in self.unenforced
        )


def verify(task: DesignTask, trajectory: Trajectory) -> Verification:
    """Play a trajectory's control open loop on the untouched model at the design's theta."""
    constraints = constraint_set_of(task, every=True)
    told = (
        frozenset()
        if task.experiment.limits.enforce
        else {"clearance", *(limit.kind for limit in task.limits)}
    )
    model = task.system.model_at(task.theta)
    simulator = BatchSimulator(model, substeps=task.system.grid.substeps)
    out = simulator.rollout(
        [model],
        task.plant.initial_state(task.theta)[None],
        trajectory.ctrl[None],
        constraints.observations,
    )
    if not out.finite[0] or out.observed is None:
        lost = dict.fromkeys((*constraints.kinds, "simulation"), -np.inf)
        return Verification(lost, lost, np.inf, frozenset(told))
    played = task.plant.trajectory(out.states[0], trajectory.ctrl)
    values = replace(constraints, clearance=None).evaluate(played, out.observed[0], slopes=False)
    margins, shares = constraints.margins(values), constraints.relative_margins(values)
    usage = [*_usage(task, constraints, values)]
    if constraints.clearance is not None:
        positions = _positions(task, simulator, played)
        distance, _, pair = constraints.clearance.nearest(positions)
        margins["clearance"] = distance - constraints.least
        over = np.maximum(constraints.clearance(positions, slopes=False).d.min(axis=1), 1e-9)
        t = np.arange(1, len(positions) + 1) * task.dt / task.system.grid.substeps
        usage.append(
            LimitUsage(kind="clearance", name=pair.name, t=t, share=constraints.least / over)
        )
        shares["clearance"] = margins["clearance"] / constraints.least
    deviation = float(np.abs(task.space.minus(played.state, trajectory.state)).max())
    return Verification(margins, shares, deviation, frozenset(told), tuple(usage))


def _usage(
    task: DesignTask, constraints: ConstraintSet, values: ConstraintValues
) -> Iterator[LimitUsage]:
    """Of whatever has a range, within samples at every engine step."""
    N, substeps, w = values.observed.shape
    observed, ctrl = values.observed.reshape(N * substeps, w), values.trajectory.ctrl
    t = np.arange(1, len(observed) + 1) * task.dt / task.system.grid.substeps
    for kind, name, share in zip(
        constraints.kinds,
        constraints.names,
        constraints.shown.relative_position(observed).T,
        strict=True,
    ):
        yield LimitUsage(kind=kind, name=name, t=t, share=share)
    bands = [("control", constraints.control, ctrl, task.t)]
    if constraints.rate is not None:
        bands.append(
            (
                "control_rate",
                constraints.rate,
                constraints.rates(ctrl),
                np.append(task.t, task.t[-1] + task.dt),
            )
        )
    for kind, band, used, times in bands:
        for i, name in enumerate(task.controls):
            if np.isfinite(band.lower[i]) or np.isfinite(band.upper[i]):
                yield LimitUsage(
                    kind=kind, name=name, t=times, share=band.relative_position(used)[:, i]
                )


def _positions(task: DesignTask, simulator: BatchSimulator, played: Trajectory) -> Array:
    """(N * substeps, nq) positions at every engine step."""
    fine = BatchSimulator(simulator.model)
    held = np.repeat(played.ctrl, task.system.grid.substeps, axis=0)
    return np.asarray(
        fine.rollout([simulator.model], played.state[:1], held[None]).states[0][1:, : task.space.nq]
    )


def require_feasible_start(task: DesignTask) -> None:
    """Raise ExperimentError where limits cannot be, exclude the start or the end, or either cannot be held at rest."""
    try:
        constraints = constraint_set_of(task, every=True)
        bandwidth_basis(task, task.stated_times)
        places = {"the start": task.plant.initial_state(task.theta)}
        if task.experiment.boundary.end == "rest":
            places["the end"] = task.target
        if task.experiment.limits.enforce:
            for where, state in places.items():
                _require_inside(task, constraints, where, state)
            start, end = task.plant.initial_state(task.theta), task.target
            for where, state, hold in (
                ("boundary.start", start, constraints.before),
                ("boundary.end", end, constraints.after),
            ):
                if hold is not None:
                    _require_held(task, where, state, hold)
    except ExperimentError as error:
        raise ExperimentError(f"{task.experiment.source}: {error}") from None


def _require_inside(task: DesignTask, constraints: ConstraintSet, where: str, state: Array) -> None:
    qpos, qvel, _ = task.space.split(state)
    units = {c.name: c.unit for c in task.system.coordinates}
    for limit in task.limits:
        if limit.kind in ("position", "velocity"):
            value = float((qpos if limit.kind == "position" else qvel)[limit.index])
            if not limit.lower <= value <= limit.upper:
                unit = units[limit.name] + ("/s" if limit.kind == "velocity" else "")
                raise ExperimentError(
                    f"limits.{limit.kind}.{limit.name}: {where} is at {value:g} {unit}, outside "
                    f"[{limit.lower:g}, {limit.upper:g}]; widen the limit (where it is the MJCF's, there) or move {where}"
                )
    if constraints.clearance is not None:
        distance, _, pair = constraints.clearance.nearest(state[None, : task.space.nq])
        if distance < constraints.least:
            what = "in collision" if distance < 0.0 else "too close"
            raise ExperimentError(
                f"limits.clearance: {where} is {what}: {pair.name} are {distance:.3g} m apart, wanted {constraints.least:g} m; "
                f"move {where}, lower the clearance, or list the pair's bodies in limits.ignored"
            )


def _require_held(task: DesignTask, where: str, state: Array, hold: Array) -> None:
    model = task.plant.model(task.theta)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:] = task.space.split(state)
    data.ctrl[:] = hold
    mujoco.mj_forward(model, data)
    needed = {"control": hold, "force": data.actuator_force, "joint_force": data.qfrc_actuator}
    for limit in task.limits:
        if (
            limit.kind in needed
            and not limit.lower <= needed[limit.kind][limit.index] <= limit.upper
        ):
            what = (
                "limits.force or the MJCF's actuatorfrcrange"
                if limit.kind == "joint_force"
                else f"limits.{limit.kind}"
            )
            raise ExperimentError(
                f"{where}: holding still takes {limit.name} = {needed[limit.kind][limit.index]:.4g}, outside "
                f"{what} [{limit.lower:g}, {limit.upper:g}]"
            )
