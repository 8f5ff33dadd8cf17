"""The limits at every engine step of the model as the user wrote it: clamps, stops, contacts and all."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mjfim.bounds import fence_of
from mjfim.engine import Engine
from mjfim.errors import ExperimentError
from mjfim.setup import Setup
from mjfim.trajectory import Array, Trajectory

SAME = 1e-6  # deviation of a state, in its unit, up to which two simulations are the same


@dataclass(frozen=True)
class Audit:
    """margins: worst of each kind over all engine steps, in its unit, negative outside

    deviation: largest difference of a state at the samples from the trajectory that was designed
    """

    margins: dict[str, float]
    deviation: float

    @property
    def kept(self) -> bool:
        """Every limit holds."""
        return all(margin >= 0.0 for margin in self.margins.values())


def audit(setup: Setup, trajectory: Trajectory) -> Audit:
    """Play a trajectory's control open loop on the untouched model at the design's theta."""
    fence = fence_of(setup)
    model = setup.model_at(setup.theta)
    engine = Engine(model, setup.substeps)
    out = engine.rollout([model], setup.plant.start(setup.theta)[None], trajectory.ctrl[None], fence.taps)
    if not out.finite[0] or out.tapped is None:
        return Audit(dict.fromkeys((*fence.kinds, "simulation"), -np.inf), np.inf)
    played = setup.plant.trajectory(out.states[0], trajectory.ctrl)
    margins = fence.margins(replace(fence, clearance=None).sight(played, out.tapped[0], slopes=False))
    if fence.clearance is not None:
        margins["clearance"] = fence.clearance.nearest(_positions(setup, engine, played))[0] - fence.least
    deviation = float(np.abs(setup.space.minus(played.state, trajectory.state)).max())
    return Audit(margins, deviation)


def _positions(setup: Setup, engine: Engine, played: Trajectory) -> Array:
    """(N * substeps, nq) positions at every engine step."""
    fine = Engine(engine.model, 1)
    held = np.repeat(played.ctrl, setup.substeps, axis=0)
    return np.asarray(fine.rollout([engine.model], played.state[:1], held[None]).states[0][:, : setup.space.nq])


def require_inside(setup: Setup) -> None:
    """Raise ExperimentError where the start itself is outside a limit, or cannot be held where it has to be."""
    start = setup.plant.start(setup.theta)
    qpos, qvel, _ = setup.space.split(start)
    units = {c.name: c.unit for c in setup.coordinates}
    for limit in setup.limits:
        if limit.kind in ("position", "velocity"):
            value = float((qpos if limit.kind == "position" else qvel)[limit.index])
            if not limit.lower <= value <= limit.upper:
                unit = units[limit.name] + ("/s" if limit.kind == "velocity" else "")
                raise ExperimentError(
                    f"{setup.experiment.source}: limits.{limit.kind}.{limit.name}: the start is at {value:g} {unit}, outside "
                    f"[{limit.lower:g}, {limit.upper:g}]; widen the limit (where it is the MJCF's, there) or move the start"
                )
    try:
        fence = fence_of(setup)
    except ExperimentError as error:
        raise ExperimentError(f"{setup.experiment.source}: {error}") from None
    if fence.clearance is not None:
        distance, _, pair = fence.clearance.nearest(start[None, : setup.space.nq])
        if distance < fence.least:
            what = "in collision" if distance < 0.0 else "too close"
            raise ExperimentError(
                f"{setup.experiment.source}: limits.clearance: the start is {what}: {pair.name} are {distance:.3g} m apart, "
                f"wanted {fence.least:g} m; move the start, lower the clearance, or list the pair's bodies in limits.ignored"
            )
    for where, hold in (("boundary.start", fence.before), ("boundary.end", fence.after)):
        for limit in setup.limits:
            if hold is not None and limit.kind == "control" and not limit.lower <= hold[limit.index] <= limit.upper:
                raise ExperimentError(
                    f"{setup.experiment.source}: {where}: holding still takes {limit.name} = {hold[limit.index]:.4g}, outside "
                    f"limits.control [{limit.lower:g}, {limit.upper:g}]"
                )
