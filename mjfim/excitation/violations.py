"""Which limits a trajectory violates, and when."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mjfim.excitation.limits import Limit
from mjfim.excitation.task import DesignTask
from mjfim.excitation.verification import Verification
from mjfim.model.units import LENGTH
from mjfim.records.design import LimitUsage, LimitViolation


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

        worst = int(np.argmax(np.abs(usage.share)))
        limit = limits.get((usage.kind, usage.name))
        if limit is None:
            unit = LENGTH
            lower, upper = task.experiment.limits.clearance, None
            value = (lower or 0.0) / float(usage.share[worst])
        else:
            unit = limit.unit
            lower, upper = _finite(limit.lower), _finite(limit.upper)
            value = _value_at(limit, usage, worst)

        yield LimitViolation(
            kind=usage.kind,
            name=usage.name,
            since=float(usage.t[outside[0]]),
            t=float(usage.t[worst]),
            value=value,
            lower=lower,
            upper=upper,
            unit=unit,
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
