"""Remarks about the quality of measured data.

They concern noise, spikes, and columns that contradict each other.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.model.coordinates import scalar_joints
from mjfim.recordings.channels import Channels
from mjfim.records.trajectory import Recording

# Only the first rows of a long recording are inspected.
MAX_ROWS = 200_000

# Width of the running median filter that separates smooth motion from noise and spikes [rows].
MEDIAN_ROWS = 7

# Length of the shortest column that is inspected [rows].
MIN_ROWS = 4 * MEDIAN_ROWS

# A measured column is rough if the running median removes more than this fraction of its variance,
# and a fitted model does not explain this part.
MAX_ROUGH_SHARE = 0.1

# A deviation counts only if it exceeds this number of stated standard deviations of the noise.
SIGNIFICANT_SIGMAS = 3.0

# A control is rough if the running median removes more than this fraction of its variance. The
# limit is higher than for measured columns, because a control may jump intentionally.
MAX_ROUGH_CONTROL_SHARE = 0.5

# A control that jumps intentionally is still correlated with the previous row. Below this
# correlation it is considered noise.
MIN_CONTROL_CORRELATION = 0.5

# Largest fraction of the rows in which a control may be outside its range.
MAX_SHARE_OUTSIDE_RANGE = 1e-3

# Tolerance of the range of a control, as a fraction of its width.
RANGE_TOLERANCE = 1e-6

# A position and the integral of its velocity contradict each other if their displacements differ by
# more than this fraction of the displacements' standard deviation.
MAX_DISAGREEMENT = 0.1

# Time over which displacements are compared [s].
COMPARISON_TIME = 0.2


def plausibility_remarks(
    channels: Channels, recording: Recording, predicted: Array | None = None
) -> tuple[str, ...]:
    """Describe properties of a recording that make its data implausible.

    Args:
        channels: Names, ranges and noise of the recording's columns.
        recording: The measured data.
        predicted: (M, m) outputs of a fitted model at the rows of the recording, in the order of
            the channels; None before a fit. A motion that is quick at the rate of the recording
            is rough, too, and only a model tells it from noise.

    Returns:
        One sentence per remark; empty if the data are plausible.
    """
    return (
        *_control_remarks(channels, recording.ctrl[:MAX_ROWS]),
        *_roughness_remarks(channels, recording, predicted),
        *_contradiction_remarks(channels, recording),
    )


def _control_remarks(channels: Channels, ctrl: Array) -> Iterator[str]:
    """Remarks about controls ctrl: (M-1, nu) that are outside their range or look like noise."""
    model = channels.model
    for column, u in zip(channels.control_columns, ctrl.T, strict=True):
        # References of control laws jump where the user commands it, and have no range.
        if not (column.startswith("ctrl:") and _moves(u[1:]) and _moves(u[:-1])):
            continue
        name = column.removeprefix("ctrl:")
        i = channels.controls.index(name)
        low, high = model.actuator_ctrlrange[i]
        tolerance = RANGE_TOLERANCE * (high - low)
        share = float(np.mean((u < low - tolerance) | (u > high + tolerance)))
        if model.actuator_ctrllimited[i] and share > MAX_SHARE_OUTSIDE_RANGE:
            yield (
                f"control {name!r} is outside its ctrlrange [{low:g}, {high:g}] in "
                f"{100 * share:.2g} % of the rows (it ranges from {u.min():.3g} to {u.max():.3g}); "
                "the simulation clamps it to the range"
            )

        rough, correlation = _rough_share(u), float(np.corrcoef(u[1:], u[:-1])[0, 1])
        if rough > MAX_ROUGH_CONTROL_SHARE and correlation < MIN_CONTROL_CORRELATION:
            yield (
                f"control {name!r} jumps from row to row ({100 * rough:.0f} % of its variance lies "
                f"within {MEDIAN_ROWS} rows, correlation with the previous row {correlation:.2f}): "
                "if it was measured instead of commanded, the simulation treats its noise as a "
                "force, and the estimates are biased"
            )


def _roughness_remarks(
    channels: Channels, recording: Recording, predicted: Array | None
) -> Iterator[str]:
    """Remarks about outputs whose jumps are large compared with both their noise and motion."""
    sigma = _sigma_by_name(channels)
    for i, name in enumerate(recording.outputs):
        y = recording.y[:MAX_ROWS, i]
        present = np.isfinite(y)
        y = y[present]
        if not _moves(y):
            continue

        share, explanation = _rough_share(y), "is too quick for a smooth motion"
        if predicted is not None and name in channels.outputs:
            motion = predicted[:MAX_ROWS, channels.outputs.index(name)][present]
            unexplained = np.var(_rough_part(y) - _rough_part(motion)) / np.var(y)
            share = min(share, float(unexplained))
            explanation = "is not explained by the identified motion"
        rough_std = np.sqrt(share * np.var(y))
        if share > MAX_ROUGH_SHARE and rough_std > SIGNIFICANT_SIGMAS * sigma.get(name, 0.0):
            yield (
                f"{name} is rough: {100 * share:.0f} % of its variance lies within {MEDIAN_ROWS} "
                f"rows and {explanation}; noise, spikes or steps hide the motion of the robot"
            )


def _contradiction_remarks(channels: Channels, recording: Recording) -> Iterator[str]:
    """Remarks about joints whose position does not follow the integral of their velocity."""
    t = recording.t[:MAX_ROWS]
    columns = {name: recording.y[:MAX_ROWS, i] for i, name in enumerate(recording.outputs)}
    sigma = _sigma_by_name(channels)
    for joint in scalar_joints(channels.model):
        position, velocity = joint.position_column, joint.velocity_column
        if position not in columns or velocity not in columns:
            continue
        both = np.isfinite(columns[position]) & np.isfinite(columns[velocity])
        if both.sum() < MIN_ROWS:
            continue

        q, v = columns[position][both], columns[velocity][both]
        dq, dv, lag = displacements(t[both], q, v, COMPARISON_TIME, len(q) // 4)
        size = float(np.std(dq))
        # Noise of a difference of positions, and of an integral of velocities.
        integral = np.sqrt(lag) * float(np.median(np.diff(t[both])))
        expected = np.hypot(
            np.sqrt(2.0) * sigma.get(position, 0.0), integral * sigma.get(velocity, 0.0)
        )
        difference = float(np.std(dq - dv))
        if size > 0.0 and difference > max(MAX_DISAGREEMENT * size, SIGNIFICANT_SIGMAS * expected):
            yield (
                f"{position} and the integral of {velocity} differ by "
                f"{100 * difference / size:.0f} % of the motion; one of them is wrong or delayed"
            )


def displacements(
    t: Array, q: Array, v: Array, duration: float, max_lag: int
) -> tuple[Array, Array, int]:
    """Compute displacements over a fixed number of rows from a position and from a velocity.

    Args:
        t: (M,) times [s].
        q: (M,) positions without NaN.
        v: (M,) velocities without NaN.
        duration: Approximate time of a displacement [s].
        max_lag: Largest number of rows of a displacement.

    Returns:
        (M-lag,) differences of the position, (M-lag,) integrals of the velocity by the trapezoidal
        rule, and lag, the number of rows of a displacement.
    """
    steps = np.diff(t)
    lag = int(np.clip(round(duration / float(np.median(steps))), 1, max_lag))

    means = 0.5 * (v[1:] + v[:-1])
    integral = np.concatenate([[0.0], np.cumsum(means * steps)])
    return q[lag:] - q[:-lag], integral[lag:] - integral[:-lag], lag


def _sigma_by_name(channels: Channels) -> dict[str, float]:
    """Standard deviation of the noise by name of the output."""
    return dict(zip(channels.outputs, channels.sigma.tolist(), strict=True))


def _moves(x: Array) -> bool:
    """Whether a column x: (M,) is long enough to be inspected, and not constant."""
    return len(x) >= MIN_ROWS and float(np.std(x)) > 0.0


def _rough_share(x: Array) -> float:
    """Fraction of the variance of x: (M,) that a running median removes."""
    return float(np.var(_rough_part(x)) / np.var(x))


def _rough_part(x: Array) -> Array:
    """(M,) what a running median removes from x: (M,); beyond its ends, x keeps its last values."""
    smooth: Array = scipy.ndimage.median_filter(x, size=MEDIAN_ROWS, mode="nearest")
    return x - smooth
