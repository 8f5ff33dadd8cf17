"""Verification of a design on the model as the user wrote it, at every engine step: with its clamps, stops and contacts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.excitation.bandwidth import bandwidth_basis
from mjfim.excitation.constraint_kinds import ClearanceConstraint, ConstraintValues
from mjfim.excitation.constraints import ConstraintSet, constraint_set_of
from mjfim.excitation.limits import Limit
from mjfim.excitation.task import DesignTask
from mjfim.plant.batch import BatchSimulator
from mjfim.records.design import LimitUsage
from mjfim.records.trajectory import Trajectory

# Deviation of a state up to which two simulations agree [unit of the state].
SAME_STATE_TOLERANCE = 1e-6

# Distance that stands for contact where a clearance is divided by the distance [m].
CONTACT_DISTANCE = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Verification:
    """Margins of all limits when a control is played open loop on the unmodified model.

    Attributes:
        margins: Smallest margin of each kind over all engine steps, negative outside [unit of the
            kind].
        relative_margins: These margins over half of each range, or over the clearance.
        deviation: Largest difference of a state at the samples from the designed trajectory [unit
            of the state].
        unenforced: Kinds that are checked, not enforced.
        usage: Position of every limited quantity in its range over time.
    """

    margins: dict[str, float]
    relative_margins: dict[str, float]
    deviation: float
    unenforced: frozenset[str] = frozenset()
    usage: tuple[LimitUsage, ...] = ()

    @property
    def is_feasible(self) -> bool:
        """True where every limit that is enforced holds."""
        return all(
            margin >= 0.0 for kind, margin in self.margins.items() if kind not in self.unenforced
        )


def verify(task: DesignTask, trajectory: Trajectory) -> Verification:
    """Play the control of a trajectory open loop on the unmodified model, at the theta of the task.

    Args:
        task: The task; all stated limits are checked, enforced or not.
        trajectory: The designed trajectory.

    Returns:
        Margins and usage of all limits; infinitely negative margins where the simulation diverges.
    """
    constraints = constraint_set_of(task, every=True)
    unenforced: frozenset[str] = frozenset()
    if not task.experiment.limits.enforce:
        unenforced = frozenset({"clearance", *(limit.kind for limit in task.limits)})

    model = task.system.model_at(task.theta)
    simulator = BatchSimulator(model, substeps=task.system.grid.substeps)
    out = simulator.rollout(
        [model],
        task.plant.initial_state(task.theta)[None],
        trajectory.ctrl[None],
        constraints.observations,
    )
    if not out.finite[0] or out.observed is None:
        lost = dict.fromkeys((*constraints.substeps.kinds, "simulation"), -np.inf)
        return Verification(
            margins=lost, relative_margins=lost, deviation=np.inf, unenforced=unenforced
        )

    # Distances are measured at every engine step below, not at the samples.
    played = task.plant.trajectory(out.states[0], trajectory.ctrl)
    others = replace(constraints, clearance=None)
    values = others.evaluate(played, out.observed[0], slopes=False)
    margins, relative_margins = others.margins(values), others.relative_margins(values)
    usage = list(_usage(task, constraints, values))

    clearance = constraints.clearance
    if clearance is not None:
        positions = _positions_at_engine_steps(task, simulator, played)
        distance, used = _clearance_usage(task, clearance, positions)
        usage.append(used)
        margins["clearance"] = distance - clearance.least
        relative_margins["clearance"] = margins["clearance"] / clearance.least

    deviation = float(np.abs(task.space.minus(played.state, trajectory.state)).max())
    return Verification(
        margins=margins,
        relative_margins=relative_margins,
        deviation=deviation,
        unenforced=unenforced,
        usage=tuple(usage),
    )


def _usage(
    task: DesignTask, constraints: ConstraintSet, values: ConstraintValues
) -> Iterator[LimitUsage]:
    """Position of every quantity in its range: within samples at every engine step, of controls at every sample."""
    substeps, ctrl = constraints.substeps, values.trajectory.ctrl
    N, steps, w = values.observed.shape
    observed = values.observed.reshape(N * steps, w)
    positions = substeps.bounds.relative_position(observed)

    t = np.arange(1, len(observed) + 1) * task.dt / task.system.grid.substeps
    for i, (kind, name) in enumerate(zip(substeps.kinds, substeps.names, strict=True)):
        yield LimitUsage(kind=kind, name=name, t=t, share=positions[:, i])

    limited = [("control", constraints.control.bounds, ctrl, task.t)]
    if constraints.rate is not None:
        times = np.append(task.t, task.t[-1] + task.dt)
        rates = constraints.rate.rates(ctrl)
        limited.append(("control_rate", constraints.rate.bounds, rates, times))

    for kind, bounds, used, times in limited:
        bounded = np.isfinite(bounds.lower) | np.isfinite(bounds.upper)
        positions = bounds.relative_position(used)
        for i in np.flatnonzero(bounded).tolist():
            yield LimitUsage(kind=kind, name=task.controls[i], t=times, share=positions[:, i])


def _clearance_usage(
    task: DesignTask, clearance: ClearanceConstraint, positions: Array
) -> tuple[float, LimitUsage]:
    """The least distance [m] over positions: (n, nq) at n engine steps, and the usage of the clearance over time."""
    distance, _, pair = clearance.distances.nearest(positions)
    nearest = clearance.distances(positions, slopes=False).d.min(axis=1)

    t = np.arange(1, len(positions) + 1) * task.dt / task.system.grid.substeps
    share = clearance.least / np.maximum(nearest, CONTACT_DISTANCE)
    return distance, LimitUsage(kind="clearance", name=pair.name, t=t, share=share)


def _positions_at_engine_steps(
    task: DesignTask, simulator: BatchSimulator, played: Trajectory
) -> Array:
    """(N * substeps, nq) positions after every engine step."""
    single_steps = BatchSimulator(simulator.model)
    held = np.repeat(played.ctrl, task.system.grid.substeps, axis=0)
    out = single_steps.rollout([simulator.model], played.state[:1], held[None])
    return np.asarray(out.states[0][1:, : task.space.nq])


def require_feasible_start(task: DesignTask) -> None:
    """Check that the limits and the boundary can be kept before anything is designed.

    Args:
        task: The task.

    Raises:
        ExperimentError: A limit cannot be kept, or excludes the initial state, the final state or a
            control that holds one.
    """
    try:
        _require_feasible_start(task)
    except ExperimentError as error:
        raise ExperimentError(f"{task.experiment.source}: {error}") from None


def _require_feasible_start(task: DesignTask) -> None:
    """As `require_feasible_start`; errors do not name the experiment file yet."""
    constraints = constraint_set_of(task, every=True)
    bandwidth_basis(task, task.stated_times)
    if not task.experiment.limits.enforce:
        return

    boundary = task.experiment.boundary
    start = task.plant.initial_state(task.theta)

    _require_inside(task, constraints, "the initial state", start)
    if boundary.end == "rest":
        _require_inside(task, constraints, "the final state", task.target)

    if boundary.start == "rest":
        _require_held(task, "boundary.start", start, task.initial_hold)
    if boundary.end == "rest":
        _require_held(task, "boundary.end", task.target, task.final_hold)


def _require_inside(task: DesignTask, constraints: ConstraintSet, where: str, state: Array) -> None:
    """Raise ExperimentError where a state (ns,) violates a limit on positions, velocities or distances."""
    qpos, qvel, _ = task.space.split(state)
    units = {c.name: c.unit for c in task.system.coordinates}

    for limit in task.limits:
        if limit.kind not in ("position", "velocity"):
            continue
        numbers = qpos if limit.kind == "position" else qvel
        value = float(numbers[limit.index])
        if not limit.lower <= value <= limit.upper:
            unit = units[limit.name] + ("/s" if limit.kind == "velocity" else "")
            raise ExperimentError(
                f"limits.{limit.kind}.{limit.name}: {where} is at {value:g} {unit}, outside "
                f"[{limit.lower:g}, {limit.upper:g}]; widen the limit (where it is the MJCF's, "
                f"there) or move {where}"
            )

    if constraints.clearance is None:
        return
    least = constraints.clearance.least
    distance, _, pair = constraints.clearance.distances.nearest(state[None, : task.space.nq])
    if distance < least:
        fault = "in collision" if distance < 0.0 else "too close"
        raise ExperimentError(
            f"limits.clearance: {where} is {fault}: {pair.name} are {distance:.3g} m apart, wanted "
            f"{least:g} m; move {where}, lower the clearance, or list the pair's bodies in "
            "limits.ignored"
        )


def _require_held(task: DesignTask, where: str, state: Array, hold: Array) -> None:
    """Raise ExperimentError where the control `hold`: (nu,) that holds a state: (ns,) violates a limit on forces or controls."""
    model = task.plant.model(task.theta)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:] = task.space.split(state)
    data.ctrl[:] = hold
    mujoco.mj_forward(model, data)

    needed = {"control": hold, "force": data.actuator_force, "joint_force": data.qfrc_actuator}
    for limit in task.limits:
        if limit.kind not in needed:
            continue
        value = needed[limit.kind][limit.index]
        if not limit.lower <= value <= limit.upper:
            raise ExperimentError(
                f"{where}: holding still takes {limit.name} = {value:.4g}, outside "
                f"{_key_of(limit)} [{limit.lower:g}, {limit.upper:g}]"
            )


def _key_of(limit: Limit) -> str:
    """The key or range by which a user states a limit."""
    if limit.kind == "joint_force":
        return "limits.force or the MJCF's actuatorfrcrange"
    return f"limits.{limit.kind}"
