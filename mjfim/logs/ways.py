"""How far a joint goes over a stretch of time, by its positions and by its velocities."""

from __future__ import annotations

import numpy as np

from mjfim.trajectory import Array


def ways(t: Array, q: Array, v: Array, stretch: float, most: int) -> tuple[Array, Array, int]:
    """Differences of q and of the integral of v over a stretch [s] of at most so many rows, and how many it is.

    t, q, v: (M,) without NaN
    """
    steps = np.diff(t)
    lag = int(np.clip(round(stretch / float(np.median(steps))), 1, most))
    way = np.concatenate([[0.0], np.cumsum(0.5 * (v[1:] + v[:-1]) * steps)])
    return q[lag:] - q[:-lag], way[lag:] - way[:-lag], lag
