"""A design as a robot's controller plays it, at the controller's own rate: state, control, the gains about them (design.csv),
and the joint motion that a position-controlled robot follows (reference.csv). No interpolation: rows are engine steps.

Feedback: `u = ctrl + gain (planned - measured)`, the difference in the tangent space: rotations of ball and free joints as
rotation vectors in the measured body's frame.
"""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.experiment.system import System
from mjfim.model.coordinates import gain_names, state_components, state_names
from mjfim.plant.active_constraints import forward_samples
from mjfim.plant.batch import BatchSimulator
from mjfim.records.playback import Playback
from mjfim.records.trajectory import Trajectory


def simulate_playback(system: System, trajectory: Trajectory, gain: Array) -> Playback:
    """A designed trajectory at `playback_rate`, simulated again at the design's theta. gain: (N, nu, nx)

    Raises SimulationDivergedError where it cannot be simulated.
    """
    rows = system.grid.substeps // system.stated_grid.playback_steps
    simulator = BatchSimulator(
        system.plant.simulator.model, substeps=system.stated_grid.playback_steps
    )
    held = np.repeat(trajectory.ctrl, rows, axis=0)
    out = simulator.rollout([system.plant.model(system.theta)], trajectory.state[:1], held[None])
    if not out.finite[0]:
        raise SimulationDivergedError("the designed control diverges when it is simulated again")
    t = np.arange(len(held) + 1, dtype=np.float64) * (system.dt / rows)
    return Playback(t=t, state=out.states[0], ctrl=held, gain=np.repeat(gain, rows, axis=0))


def design_columns(playback: Playback, system: System) -> dict[str, Array]:
    """design.csv: t, state, ctrl, gains; the end has neither control nor gains."""
    M = len(playback.ctrl)
    ctrl = np.concatenate([playback.ctrl, np.full((1, len(system.controls)), np.nan)])
    flat = playback.gain.reshape(M, -1)
    gain = np.concatenate([flat, np.full((1, flat.shape[1]), np.nan)])
    return {
        "t": playback.t,
        **dict(zip(state_names(system.model), playback.state.T, strict=True)),
        **{f"ctrl:{name}": ctrl[:, i] for i, name in enumerate(system.controls)},
        **dict(zip(gain_names(system.model, system.controls), gain.T, strict=True)),
    }


def reference_columns(playback: Playback, system: System) -> dict[str, Array]:
    """reference.csv: what a position-controlled robot follows, and the feed-forward that goes with it. No empty field.

    qpos, qvel: planned;  qacc:<joint>: MuJoCo's acceleration there under the row's control
    force:<joint>: what the actuators apply at the joint. In the last row the last control is held on.
    """
    held = np.concatenate([playback.ctrl, playback.ctrl[-1:]])
    qpos, qvel, act = system.space.split(playback.state)
    rows = Trajectory(t=playback.t, qpos=qpos, qvel=qvel, act=act, ctrl=held)
    qacc, force = np.empty_like(qvel), np.empty_like(qvel)
    for k, data in forward_samples(system.model_at(system.theta), rows, range(len(held))):
        qacc[k], force[k] = data.qacc, data.qfrc_actuator
    names = [c.name for c in state_components(system.model)]
    dofs = [name.removeprefix("qvel:") for name in names[system.space.nq :]]
    return {
        "t": playback.t,
        **dict(zip(names, np.concatenate([qpos, qvel], axis=1).T, strict=True)),
        **{f"qacc:{name}": qacc[:, i] for i, name in enumerate(dofs)},
        **{f"force:{name}": force[:, i] for i, name in enumerate(dofs)},
    }
