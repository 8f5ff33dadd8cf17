"""Which limits a trajectory violates, and when."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mjfim.excitation.limits.constraints import FORCE_KINDS, constraint_set_of
from mjfim.excitation.limits.limits import Limit
from mjfim.excitation.limits.verification import Verification, usage_within_samples, verify
from mjfim.excitation.task import DesignTask
from mjfim.model.units import LENGTH
from mjfim.records.design import LimitUsage, LimitViolation
from mjfim.records.trajectory import Trajectory


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
    played = free.plant.observe(free.theta, trajectory.ctrl, constraints.observations)
    if played is None:
        return

    for usage in usage_within_samples(free, constraints, played[1]):
        limit = limits.get((usage.kind, usage.name))
        if limit is not None and (np.abs(usage.share) > 1.0).any():
            yield _violation_of(usage, limit, clamped=True)


def _violation_of(usage: LimitUsage, limit: Limit, *, clamped: bool = False) -> LimitViolation:
    """The violation of a limit, given its usage, which is outside somewhere."""
    outside = np.flatnonzero(np.abs(usage.share) > 1.0)
    worst = int(np.argmax(np.abs(usage.share)))
    return LimitViolation(
        kind=usage.kind,
        name=usage.name,
        since=float(usage.t[outside[0]]),
        t=float(usage.t[worst]),
        value=_value_at(limit, usage, worst),
        lower=_finite(limit.lower),
        upper=_finite(limit.upper),
        unit=limit.unit,
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
    listed = [*_violations_over_time(task, found, limits), *_violations_at_the_end(task, found)]
    return tuple(sorted(listed, key=lambda violation: violation.since))


def _violations_over_time(
    task: DesignTask, found: Verification, limits: dict[tuple[str, str], Limit]
) -> Iterator[LimitViolation]:
    """Violations of ranges and of the clearance."""
    for usage in found.usage:
        outside = np.flatnonzero(np.abs(usage.share) > 1.0)
        if not outside.size or found.margins.get(usage.kind, 0.0) >= 0.0:
            continue

        limit = limits.get((usage.kind, usage.name))
        if limit is not None:
            yield _violation_of(usage, limit)
            continue

        worst = int(np.argmax(np.abs(usage.share)))
        clearance = task.experiment.limits.clearance or 0.0
        yield LimitViolation(
            kind=usage.kind,
            name=usage.name,
            since=float(usage.t[outside[0]]),
            t=float(usage.t[worst]),
            value=clearance / float(usage.share[worst]),
            lower=clearance,
            upper=None,
            unit=LENGTH,
        )


def _value_at(limit: Limit, usage: LimitUsage, row: int) -> float:
    """The limited quantity at a row of its usage [unit of the limit]."""
    share = float(usage.share[row])
    if np.isfinite(limit.upper):
        return limit.upper - (1.0 - share) * limit.scale
    return limit.lower + (1.0 + share) * limit.scale


def _finite(bound: float) -> float | None:
    """A bound; None where it is infinite."""
    return bound if np.isfinite(bound) else None


def _violations_at_the_end(task: DesignTask, found: Verification) -> Iterator[LimitViolation]:
    """Violations of the tolerances of the final state."""
    boundary = task.experiment.boundary
    for kind, tolerance in (
        ("end_position", boundary.position),
        ("end_velocity", boundary.velocity),
    ):
        margin = found.margins.get(kind, 0.0)
        if not margin < 0.0:
            continue
        yield LimitViolation(
            kind=kind,
            name="final state",
            since=task.horizon,
            t=task.horizon,
            value=tolerance - margin,
            lower=None,
            upper=tolerance,
        )
