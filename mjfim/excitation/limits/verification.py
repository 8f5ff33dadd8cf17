"""Verification of a design at every engine step of the unmodified model, and its violations.

The unmodified model has all clamps, stops and contacts that the user's MJCF states. It is played
with the exact constraint solver of the design and with the solver settings of the MJCF; the worse
of both counts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.excitation.limits.constraint_kinds import (
    ConstraintValues,
    ControlConstraint,
    ControlRateConstraint,
)
from mjfim.excitation.limits.constraints import (
    FORCE_KINDS,
    ConstraintSet,
    constraint_set_of,
    quantities_at,
)
from mjfim.excitation.limits.limits import Limit
from mjfim.excitation.task import DesignTask
from mjfim.experiment.packing import named_file
from mjfim.model.units import LENGTH
from mjfim.model.variants import unconstrained
from mjfim.plant.batch import BatchSimulator, SubstepObservations
from mjfim.records.design import LimitUsage, LimitViolation
from mjfim.records.trajectory import Trajectory

# Deviation of a state up to which two simulations agree, relative to the sizes of the state.
SAME_STATE_TOLERANCE = 1e-6

# Excess up to which a control that holds a state is inside its limit, over half of the range: the
# search for it leaves rounding errors.
HELD_TOLERANCE = 1e-6

# Limits that a state keeps or violates whatever the control is.
STATE_KINDS = ("position", "tilt", "velocity", "angular_velocity", "tendon_length")

# Share of the clearance that stands for contact where the clearance is divided by the distance.
CONTACT_SHARE = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class Verification:
    """Margins of all limits when a control is played open loop on the unmodified model.

    Attributes:
        margins: Smallest margin of each kind over all engine steps, negative outside [unit of the
            kind].
        relative_margins: These margins over half of each range, or over the clearance.
        deviation: Largest difference of a state at the samples from the designed trajectory,
            relative to the size of the state, with the exact solver; infinite where either
            simulation diverges.
        unenforced: Kinds that are checked, but not enforced.
        usage: Position of every limited quantity in its range over time.
        by_stated_solver: Kinds that are violated only with the solver settings of the MJCF.
    """

    margins: dict[str, float]
    relative_margins: dict[str, float]
    deviation: float
    unenforced: frozenset[str] = frozenset()
    usage: tuple[LimitUsage, ...] = ()
    by_stated_solver: frozenset[str] = frozenset()

    @property
    def is_feasible(self) -> bool:
        """True where every limit that is enforced holds."""
        return all(
            margin >= 0.0 for kind, margin in self.margins.items() if kind not in self.unenforced
        )


def verify(task: DesignTask, trajectory: Trajectory, *, briefly: bool = False) -> Verification:
    """Play the control of a trajectory open loop on the unmodified model, at the theta of the task.

    Args:
        task: The task; all stated limits are checked, enforced or not.
        trajectory: The designed trajectory.
        briefly: Whether margins matter only where all limits hold, and usage not at all. Where
            another limit is violated, distances of geoms, which take longest, are not measured.

    Returns:
        Margins and usage of all limits; infinitely negative margins where the simulation diverges.
    """
    constraints = constraint_set_of(task, every=True)
    model = task.system.model_at(task.theta)
    exact = _played(task, constraints, trajectory.ctrl, model)
    found = _verification(task, constraints, trajectory, exact, model, briefly)
    if briefly and not found.is_feasible:
        return found
    # Without constraint forces, the settings of their solver do not matter.
    if exact is None or unconstrained(model) or not np.isfinite(found.deviation):
        return found

    model = task.system.model_with_stated_solver(task.theta)
    stated = _played(task, constraints, trajectory.ctrl, model)
    # Both solvers give the same motion where no constraint force acts along it.
    if (
        stated is not None
        and stated.trajectory.moves_as(exact.trajectory)
        and np.array_equal(stated.observed, exact.observed)
    ):
        return found
    return _worse_of(found, _verification(task, constraints, trajectory, stated, model, briefly))


def _played(
    task: DesignTask, constraints: ConstraintSet, ctrl: Array, model: Any
) -> ConstraintValues | None:
    """Play a control, (N, nu), on one model; None where the simulation diverges.

    The distances between geoms are not measured.
    """
    simulator = BatchSimulator(model, substeps=task.system.grid.substeps)
    start = task.plant.initial_state(task.theta)
    out = simulator.rollout([model], start[None], ctrl[None], constraints.observations)
    if not out.finite[0] or out.observed is None:
        return None
    motion = task.plant.trajectory(out.states[0], ctrl)
    return ConstraintValues(trajectory=motion, observed=out.observed[0])


def _verification(
    task: DesignTask,
    constraints: ConstraintSet,
    trajectory: Trajectory,
    values: ConstraintValues | None,
    model: Any,
    briefly: bool,
) -> Verification:
    """Check all limits of a trajectory along its control as one model plays it.

    Args:
        task: The task.
        constraints: Its limits.
        trajectory: The trajectory.
        values: What `_played` returns for the model.
        model: The model.
        briefly: See `verify`.
    """
    unenforced = frozenset[str]()
    if not task.experiment.limits.enforce:
        unenforced = frozenset({"clearance", *(limit.kind for limit in task.limits)})
    if values is None:
        margins = dict.fromkeys((*constraints.substeps.kinds, "simulation"), -np.inf)
        return Verification(
            margins=margins, relative_margins=margins, deviation=np.inf, unenforced=unenforced
        )

    # All limits but the clearance.
    motion = values.trajectory
    others = replace(constraints, clearance=None)
    margins = others.margins(values)
    relative_margins = others.relative_margins(values)
    usage = [
        *usage_within_samples(task, constraints, values.observed),
        *_bounded_usage(task, constraints.control, values),
    ]
    if constraints.rate is not None:
        usage.extend(_bounded_usage(task, constraints.rate, values))

    difference = task.space.minus(motion.state, trajectory.state)
    found = Verification(
        margins=margins,
        relative_margins=relative_margins,
        deviation=float(np.abs(difference / task.sizes[: task.space.nx]).max()),
        unenforced=unenforced,
        usage=tuple(usage),
    )
    clearance = constraints.clearance
    if clearance is None or (briefly and not found.is_feasible):
        return found

    # The clearance, at every engine step instead of at the samples.
    held = np.repeat(motion.ctrl, task.system.grid.substeps, axis=0)
    steps = BatchSimulator(model).rollout([model], motion.state[:1], held[None]).states[0]
    positions = steps[1:, : task.space.nq]
    if briefly:
        distance, _ = clearance.distances.nearest(positions)
    else:
        nearest = clearance.distances(positions, slopes=False)[0].min(axis=1)
        t = _engine_times(task, len(positions))
        share = clearance.least / np.maximum(nearest, CONTACT_SHARE * clearance.least)
        # Within reach, the engine step at which geoms are nearest is known by now.
        row = int(nearest.argmin())
        is_within_reach = nearest[row] < clearance.distances.reach
        candidates = positions[row : row + 1] if is_within_reach else positions
        distance, pair = clearance.distances.nearest(candidates)
        usage.append(
            LimitUsage(kind="clearance", name=pair, t=t, share=share, lower=clearance.least)
        )
    margin = distance - clearance.least
    return replace(
        found,
        margins={**margins, "clearance": margin},
        relative_margins={**relative_margins, "clearance": margin / clearance.least},
        usage=tuple(usage),
    )


def _worse_of(exact: Verification, stated: Verification) -> Verification:
    """Join the verifications with the exact solver and with the solver settings of the MJCF."""
    # A simulation that diverges, or in which another limit is violated already, has no clearance.
    if stated.margins.keys() != exact.margins.keys():
        return stated

    by_stated_solver = frozenset(
        kind for kind, margin in stated.margins.items() if margin < 0.0 <= exact.margins[kind]
    )
    usage = [
        max(pair, key=lambda used: float(np.abs(used.share).max(initial=0.0)))
        for pair in zip(exact.usage, stated.usage, strict=True)
    ]
    return replace(
        exact,
        margins=_smaller_of(exact.margins, stated.margins),
        relative_margins=_smaller_of(exact.relative_margins, stated.relative_margins),
        usage=tuple(usage),
        by_stated_solver=by_stated_solver,
    )


def _smaller_of(first: dict[str, float], second: dict[str, float]) -> dict[str, float]:
    """The smaller margin of each kind."""
    return {kind: min(margin, second[kind]) for kind, margin in first.items()}


def _farthest(shares: Array, observations: SubstepObservations, steps: int) -> Array:
    """(N, steps, w) the farthest position of all rows, (N, rows, w), that belong to a step."""
    within = shares[:, :steps].copy()
    for row, step in enumerate(observations.force_rows, start=steps):
        farther = np.abs(shares[:, row]) > np.abs(within[:, step])
        within[:, step] = np.where(farther, shares[:, row], within[:, step])
    return within


def usage_within_samples(
    task: DesignTask, constraints: ConstraintSet, observed: Array
) -> Iterator[LimitUsage]:
    """Find the position of the limited quantities in their ranges, at every engine step.

    Args:
        task: The task.
        constraints: Its limits.
        observed: (N, rows, w) observations of a simulation.

    Yields:
        The usage of every limit on a quantity within samples.
    """
    substeps = constraints.substeps
    quantities = substeps.quantities(observed)
    N, _, count = quantities.shape
    steps = task.system.grid.substeps
    shares = substeps.bounds.relative_position(quantities)
    positions = _farthest(shares, constraints.observations, steps).reshape(N * steps, count)

    t = _engine_times(task, len(positions))
    for i, (kind, name) in enumerate(zip(substeps.kinds, substeps.names, strict=True)):
        yield LimitUsage(
            kind=kind,
            name=name,
            t=t,
            share=positions[:, i],
            lower=float(substeps.bounds.lower[i]),
            upper=float(substeps.bounds.upper[i]),
        )


def _bounded_usage(
    task: DesignTask,
    constraint: ControlConstraint | ControlRateConstraint,
    values: ConstraintValues,
) -> Iterator[LimitUsage]:
    """Position of the controls, or of their rates, in those ranges that are stated."""
    bounds = constraint.bounds
    positions = bounds.relative_position(constraint.quantity(values))
    t = np.arange(len(positions), dtype=np.float64) * task.dt

    bounded = np.isfinite(bounds.lower) | np.isfinite(bounds.upper)
    for i in np.flatnonzero(bounded).tolist():
        yield LimitUsage(
            kind=constraint.kind,
            name=task.controls[i],
            t=t,
            share=positions[:, i],
            lower=float(bounds.lower[i]),
            upper=float(bounds.upper[i]),
        )


def _engine_times(task: DesignTask, count: int) -> Array:
    """(count,) times after each engine step [s]."""
    return np.arange(1, count + 1) * task.dt / task.system.grid.substeps


def require_feasible_start(task: DesignTask) -> None:
    """Check that the limits and the boundary can be kept before anything is designed.

    Args:
        task: The task.

    Raises:
        ExperimentError: A limit cannot be kept, or excludes the initial state, the final state or a
            control that holds one.
    """
    with named_file(task.experiment):
        constraints = constraint_set_of(task, every=True)
        task.bandwidth_basis(task.stated_times)
        if not task.experiment.limits.enforce:
            return

        boundary = task.experiment.boundary
        start = task.plant.initial_state(task.theta)

        _require_inside(task, constraints, "the initial state", start)
        if boundary.end == "rest":
            _require_inside(task, constraints, "the final state", task.target)

        if boundary.start == "rest":
            _require_held(task, constraints, "boundary.start", start, task.initial_hold)
        if boundary.end == "rest":
            _require_held(task, constraints, "boundary.end", task.target, task.final_hold)


def _require_inside(task: DesignTask, constraints: ConstraintSet, where: str, state: Array) -> None:
    """Require that a state, (ns,), keeps the limits on its motion and on distances."""
    for limit, value in _quantities_at(task, constraints, state, task.system.rest):
        if limit.kind not in STATE_KINDS or limit.lower <= value <= limit.upper:
            continue
        raise ExperimentError(
            f"limits.{limit.kind}.{limit.name}: {where} is at {value:g} {limit.unit}, outside "
            f"[{limit.lower:g}, {limit.upper:g}]; widen the limit (in the MJCF if it is stated "
            f"there) or move {where}"
        )

    clearance = constraints.clearance
    if clearance is None:
        return
    distance, pair = clearance.distances.nearest(state[None, : task.space.nq])
    if distance < clearance.least:
        fault = "in collision" if distance < 0.0 else "too close"
        raise ExperimentError(
            f"limits.clearance: {where} is {fault}: {pair} are {distance:.3g} m apart, but "
            f"have to be {clearance.least:g} m apart; move {where}, lower the clearance, or list "
            "the pair's bodies in limits.ignored"
        )


def _quantities_at(
    task: DesignTask, constraints: ConstraintSet, state: Array, ctrl: Array
) -> Iterator[tuple[Limit, float]]:
    """Each limit within samples, with its quantity at a state under a control."""
    substeps = constraints.substeps
    limits = {(limit.kind, limit.name): limit for limit in task.limits}
    values = quantities_at(task, substeps, state, ctrl).tolist()
    for kind, name, value in zip(substeps.kinds, substeps.names, values, strict=True):
        yield limits[kind, name], value


def _require_held(
    task: DesignTask, constraints: ConstraintSet, where: str, state: Array, hold: Array
) -> None:
    """Require that the control that holds a state keeps the limits on controls and forces.

    Args:
        task: The task.
        constraints: Its constraints.
        where: Key of the experiment file, for the error message.
        state: (ns,) state.
        hold: (nu,) control that holds it [u-unit].

    Raises:
        ExperimentError: A control or a force is outside its limit.
    """
    controls = [(limit, hold[limit.index]) for limit in task.limits if limit.kind == "control"]
    forces = [
        (limit, value)
        for limit, value in _quantities_at(task, constraints, state, hold)
        if limit.kind in FORCE_KINDS
    ]
    for limit, value in (*controls, *forces):
        gap = HELD_TOLERANCE * limit.scale
        if not limit.lower - gap <= value <= limit.upper + gap:
            has_range = limit.kind in ("joint_force", "tendon_force")
            or_range = " or the MJCF's actuatorfrcrange" if has_range else ""
            raise ExperimentError(
                f"{where}: standing still requires {limit.name} = {value:.4g}, outside "
                f"limits.{limit.kind}{or_range} [{limit.lower:g}, {limit.upper:g}]"
            )


def all_violations_of(task: DesignTask, trajectory: Trajectory) -> tuple[LimitViolation, ...]:
    """List the limits that a trajectory violates, also those that hold by a clamp only.

    A design has to keep the limits of forces without the help of clamps, since derivatives do not
    hold where a force is clamped.

    Args:
        task: The task.
        trajectory: The trajectory.

    Returns:
        One entry for every limited joint, actuator and final state outside its range, and for every
        force that a clamp cuts off, the first one first.
    """
    listed = violations_of(task, verify(task, trajectory))
    if not task.is_limited or not task.experiment.limits.enforce:
        return listed

    known = {(violation.kind, violation.name) for violation in listed}
    clamped = [v for v in _clamped_forces(task, trajectory) if (v.kind, v.name) not in known]
    return tuple(sorted([*listed, *clamped], key=lambda violation: violation.since))


def _clamped_forces(task: DesignTask, trajectory: Trajectory) -> Iterator[LimitViolation]:
    """Forces outside their limits when the control is played on the plant without clamps."""
    limits = {(limit.kind, limit.name): limit for limit in task.limits if limit.kind in FORCE_KINDS}
    if not limits:
        return

    free = task.relaxed()
    constraints = constraint_set_of(free)
    values = constraints.along(free.plant, free.theta, trajectory.ctrl)
    if values is None:
        return

    for usage in usage_within_samples(free, constraints, values.observed):
        limit = limits.get((usage.kind, usage.name))
        if limit is not None and (np.abs(usage.share) > 1.0).any():
            yield _violation_of(usage, limit, clamped=True)


def _violation_of(
    usage: LimitUsage, limit: Limit | None, *, clamped: bool = False
) -> LimitViolation:
    """The violation of a limit, or of the clearance without one; the usage is outside somewhere."""
    outside = np.flatnonzero(np.abs(usage.share) > 1.0)
    worst = int(np.argmax(np.abs(usage.share)))
    share, bounds = float(usage.share[worst]), limit or usage
    if limit is None:
        value = usage.lower / share
    elif np.isfinite(limit.upper):
        value = limit.upper - (1.0 - share) * limit.scale
    else:
        value = limit.lower + (1.0 + share) * limit.scale
    return LimitViolation(
        kind=usage.kind,
        name=usage.name,
        since=float(usage.t[outside[0]]),
        t=float(usage.t[worst]),
        value=value,
        lower=bounds.lower if np.isfinite(bounds.lower) else None,
        upper=bounds.upper if np.isfinite(bounds.upper) else None,
        unit=LENGTH if limit is None else limit.unit,
        clamped=clamped,
    )


def violations_of(task: DesignTask, found: Verification) -> tuple[LimitViolation, ...]:
    """List the limits that a trajectory violates.

    Args:
        task: The task.
        found: Verification of the trajectory.

    Returns:
        One entry for every limited joint, actuator and final state outside its range.
    """
    limits = {(limit.kind, limit.name): limit for limit in task.limits}
    listed = [
        _violation_of(usage, limits.get((usage.kind, usage.name)))
        for usage in found.usage
        if found.margins.get(usage.kind, 0.0) < 0.0 and (np.abs(usage.share) > 1.0).any()
    ]
    boundary = task.experiment.boundary
    tolerances = {"end_position": boundary.position, "end_velocity": boundary.velocity}
    for kind, tolerance in tolerances.items():
        margin = found.margins.get(kind, 0.0)
        if margin < 0.0:
            violation = LimitViolation(
                kind=kind,
                name="final state",
                since=task.horizon,
                t=task.horizon,
                value=tolerance - margin,
                lower=None,
                upper=tolerance,
            )
            listed.append(violation)
    return tuple(sorted(listed, key=lambda violation: violation.since))
