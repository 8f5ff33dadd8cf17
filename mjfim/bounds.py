"""The hard limits of an experiment on its plant: what is looked at, how it begins and ends, what its control may do."""

from __future__ import annotations

import numpy as np

from mjfim.barrier import Band
from mjfim.basis import spline_basis
from mjfim.clearance import Clearance, pairs
from mjfim.engine import Taps
from mjfim.errors import ExperimentError
from mjfim.experiment import Experiment
from mjfim.fence import Fence
from mjfim.limits import Limit
from mjfim.setup import Setup
from mjfim.trajectory import Array

LOOKS = 5  # engine steps of a sample that the barrier looks at, at most
REACH = 0.1  # [m] beyond the least clearance at which distances begin to matter
SHOWN = ("position", "velocity", "acceleration", "force", "joint_force")  # in the order of the taps


def looked_at(substeps: int) -> tuple[int, ...]:
    """Engine steps of a sample that derivatives look at: the first ones, where a held control jolts, to the last."""
    return tuple(sorted({round(s) for s in np.geomspace(1, substeps, min(LOOKS, substeps)).tolist()}))


def _of(limits: tuple[Limit, ...], kind: str) -> list[Limit]:
    return [limit for limit in limits if limit.kind == kind]


def _dense(limits: list[Limit], count: int) -> Band | None:
    """Ranges of all controls, infinite where none is stated; None without any."""
    if not limits:
        return None
    lower, upper = np.full(count, -np.inf), np.full(count, np.inf)
    for limit in limits:
        lower[limit.index], upper[limit.index] = limit.lower, limit.upper
    return Band.of(lower, upper)


def fence_of(setup: Setup, every: bool = False) -> Fence:
    """The limits that hold a design, or every stated one. Raises ExperimentError for what cannot be.

    Without limits.enforce only its boundary holds a design.
    """
    e, nu = setup.experiment, len(setup.controls)
    limits = setup.limits if every or e.limits.enforce else ()
    rows = {kind: _of(limits, kind) for kind in SHOWN}
    flat = [limit for kind in SHOWN for limit in rows[kind]]
    q, v, a, f, j = (np.array([limit.index for limit in rows[kind]], dtype=np.intp) for kind in SHOWN)
    taps = Taps(q, v, a, f, j, looked_at(setup.substeps), float(setup.plant.engine.model.opt.timestep))
    shown = Band.of(np.array([limit.lower for limit in flat]), np.array([limit.upper for limit in flat]))
    free = np.full(nu, np.inf)
    control = _dense(_of(limits, "control"), nu) or Band(-free, free, _sizes(setup))
    clearance, least = None, 0.0
    if e.limits.clearance is not None and (every or e.limits.enforce):
        least = e.limits.clearance
        clearance = _kept_clear(setup, least + REACH)
    return Fence(
        space=setup.space,
        dt=setup.dt,
        taps=taps,
        shown=shown,
        kinds=tuple(limit.kind for limit in flat),
        names=tuple(limit.name for limit in flat),
        control=control,
        rate=_dense(_of(limits, "control_rate"), nu),
        before=setup.hold if e.boundary.start == "rest" else None,
        after=setup.final_hold if e.boundary.end == "rest" else None,
        seam=e.boundary.end == "periodic",
        end=None if e.boundary.end == "free" else _end(setup),
        target=setup.target,
        clearance=clearance,
        least=least,
    )


def _kept_clear(setup: Setup, reach: float) -> Clearance:
    """Distances of all pairs that are not ignored. Raises ExperimentError where there are none, or unknown bodies."""
    try:
        near = pairs(setup.model, [frozenset(pair) for pair in setup.experiment.limits.ignored])
        return Clearance(setup.model_at(setup.theta), near, reach)
    except ExperimentError as error:
        raise ExperimentError(f"limits.{error}") from None


def _sizes(setup: Setup) -> Array:
    """(nu,) how large a control is where nothing bounds it: as large as the initial one is."""
    size = np.abs(setup.control - setup.rest).max(axis=0)
    return np.where(size > 0.0, size, 1.0)


def _end(setup: Setup) -> Band:
    b, nv, na = setup.experiment.boundary, setup.space.nv, setup.space.na
    width = np.concatenate([np.full(nv, b.position), np.full(nv, b.velocity), np.full(na, np.inf)])
    return Band.of(-width, width)


def basis_of(setup: Setup, t: Array) -> Array | None:
    """(N, M) splines at times t: (N,) of which the control minus its centre is made, where its bandwidth is limited."""
    e = setup.experiment
    if e.limits.bandwidth is None:
        return None
    if e.limits.bandwidth > 0.5 * e.rate:
        raise ExperimentError(
            f"limits.bandwidth: {e.limits.bandwidth:g} Hz; a control at {e.rate:g} Hz has {0.5 * e.rate:g} Hz at most"
        )
    return splines_of(e, t, e.limits.bandwidth)


def splines_of(e: Experiment, t: Array, bandwidth: float) -> Array:
    """(N, M) splines of a bandwidth [Hz] at times t: (N,) that begin and end as the experiment does."""
    begins, periodic = e.boundary.start == "rest", e.boundary.end == "periodic"
    ends = e.boundary.end == "rest" or (periodic and begins)
    return spline_basis(t, e.horizon, bandwidth, begins, ends, periodic and not begins)
