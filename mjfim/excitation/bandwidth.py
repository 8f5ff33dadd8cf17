"""Controls of limited bandwidth, as sums of splines."""

from __future__ import annotations

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.signals import spline_basis


def bandwidth_basis(task: DesignTask, t: Array) -> Array | None:
    """Make the splines of the bandwidth that the experiment states.

    Args:
        task: The task.
        t: (N,) times [s].

    Returns:
        (N, M) splines whose sums are the allowed deviations of the control from its centre; None
        where the bandwidth is not limited.

    Raises:
        ExperimentError: The bandwidth is above half of the sample rate.
    """
    bandwidth, rate = task.experiment.limits.bandwidth, task.experiment.rate
    if bandwidth is None:
        return None

    highest = 0.5 * rate
    if bandwidth > highest:
        raise ExperimentError(
            f"limits.bandwidth: {bandwidth:g} Hz; a control at {rate:g} Hz has {highest:g} Hz at "
            "most"
        )
    return boundary_splines(task, t, bandwidth)


def boundary_splines(task: DesignTask, t: Array, bandwidth: float) -> Array:
    """Make splines that begin and end as the experiment's `[boundary]` states.

    Args:
        task: The task.
        t: (N,) times [s].
        bandwidth: Their bandwidth [Hz].

    Returns:
        (N, M) splines.
    """
    boundary = task.experiment.boundary
    starts_at_rest = boundary.start == "rest"
    periodic = boundary.end == "periodic"

    # A periodic control that starts at rest ends at rest too.
    ends_at_rest = boundary.end == "rest" or (periodic and starts_at_rest)
    return spline_basis(
        t, task.horizon, bandwidth, starts_at_rest, ends_at_rest, periodic and not starts_at_rest
    )
