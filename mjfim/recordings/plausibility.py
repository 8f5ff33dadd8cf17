"""What speaks against the data themselves, before any fit: roughness, spikes, columns that contradict each other."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.signal import medfilt

from mjfim.arrays import Array
from mjfim.model.coordinates import scalar_joints
from mjfim.recordings.channels import Channels
from mjfim.records.recording import Recording

ROWS = 200_000  # looked at
RUN = 7  # rows of the running median
ROUGH = 0.1  # share of a measured column's variance that a running median takes away
NOISY = 3.0  # stated sigmas that the rough part has at least
JUMPY = 0.5  # the same of a control, which may jump by intent
ALIKE = 0.5  # correlation of a control with the row before, below which it jumps
OUTSIDE = 1e-3  # share of rows with a control out of its range
APART = 0.1  # of the way, by which positions and the integral of velocities may part
STRETCH = 0.2  # [s] over which they are compared


def plausibility_remarks(channels: Channels, recording: Recording) -> tuple[str, ...]:
    """Sentences; none where nothing speaks against the data."""
    t = recording.t[:ROWS]
    return (
        *_controls(channels, recording.ctrl[:ROWS]),
        *_rough(channels, recording),
        *_contradictions(channels, t, recording),
    )


def _controls(channels: Channels, ctrl: Array) -> Iterator[str]:
    model = channels.model
    for i, name in enumerate(channels.controls):
        u = ctrl[:, i]
        if len(u) < 4 * RUN or not float(np.std(u)) > 0.0:
            continue
        if model.nactuator == model.nu and model.actuator_ctrllimited[i]:
            low, high = model.actuator_ctrlrange[i]
            slack = 1e-6 * (high - low)
            share = float(np.mean((u < low - slack) | (u > high + slack)))
            if share > OUTSIDE:
                yield (
                    f"control {name!r} is outside its ctrlrange [{low:g}, {high:g}] in {100 * share:.2g} % of the rows (it goes "
                    f"from {u.min():.3g} to {u.max():.3g}); the simulation clamps it there"
                )
        rough, echo = _share(u), _echo(u)
        if rough > JUMPY and echo < ALIKE:
            yield (
                f"control {name!r} jumps from row to row ({100 * rough:.0f} % of its variance lies within {RUN} rows, "
                f"correlation with the row before {echo:.2f}): where it was measured rather than commanded, its noise acts as a "
                "force that was never there, and parameters come out wrong"
            )


def _rough(channels: Channels, recording: Recording) -> Iterator[str]:
    """Columns that jump by more than the stated noise and by much of their motion."""
    sigma = dict(zip(channels.outputs, channels.sigma.tolist(), strict=True))
    for i, name in enumerate(recording.outputs):
        column = recording.y[:ROWS, i]
        column = column[np.isfinite(column)]
        if len(column) < 4 * RUN or not float(np.std(column)) > 0.0:
            continue
        share = _share(column)
        if share > ROUGH and np.sqrt(share * np.var(column)) > NOISY * sigma.get(name, 0.0):
            yield (
                f"{name} is rough: {100 * share:.0f} % of its variance lies within {RUN} rows, which no smooth motion does; "
                "its noise, spikes or steps hide what the robot did"
            )


def _contradictions(channels: Channels, t: Array, recording: Recording) -> Iterator[str]:
    """Positions that do not move as their velocities say."""
    names = recording.outputs
    for c in scalar_joints(channels.model):
        pair = (f"qpos:{c.name}", f"qvel:{c.name}")
        if not all(name in names for name in pair):
            continue
        q, v = (recording.y[:ROWS, names.index(name)] for name in pair)
        both = np.isfinite(q) & np.isfinite(v)
        if both.sum() < 4 * RUN:
            continue
        at, q, v = t[both], q[both], v[both]
        dq, dv, lag = ways(at, q, v, STRETCH, len(at) // 4)
        size = float(np.std(dq))
        apart = float(np.std(dq - dv)) / size if size > 0.0 else 0.0
        sigmas = dict(zip(channels.outputs, channels.sigma.tolist(), strict=True))
        own = np.sqrt(2.0) * sigmas.get(pair[0], 0.0)
        summed = sigmas.get(pair[1], 0.0) * np.sqrt(lag) * float(np.median(np.diff(at)))
        if apart > APART and apart * size > NOISY * np.hypot(own, summed):
            yield f"{pair[0]} and the integral of {pair[1]} part by {100 * apart:.0f} % of the way: one of them is wrong, or late"


def _share(x: Array) -> float:
    """Share of the variance that a running median takes away."""
    return float(np.var(x - medfilt(x, RUN)) / np.var(x))


def _echo(x: Array) -> float:
    """Correlation of a value with the one before."""
    d = x - x.mean()
    return float(d[1:] @ d[:-1] / (d @ d))


def ways(t: Array, q: Array, v: Array, stretch: float, most: int) -> tuple[Array, Array, int]:
    """Differences of q and of the integral of v over a stretch [s] of at most so many rows, and how many it is.

    t, q, v: (M,) without NaN
    """
    steps = np.diff(t)
    lag = int(np.clip(round(stretch / float(np.median(steps))), 1, most))
    way = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * steps)])
    return q[lag:] - q[:-lag], way[lag:] - way[:-lag], lag
