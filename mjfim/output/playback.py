"""Tables with which a robot plays a design.

`design.csv` is for a controller that applies the control, `reference.csv` for a position-controlled
robot.

Rows are engine steps at the controller's rate; nothing is interpolated. With feedback the robot
applies `u = ctrl + gain (planned - measured)`, the difference in the tangent space: rotations of
ball and free joints are rotation vectors in the measured body's frame.
"""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.experiment.system import System
from mjfim.model.coordinates import dof_names, gain_names, state_components, state_names
from mjfim.plant.active_constraints import forward_samples
from mjfim.plant.batch import BatchSimulator
from mjfim.records.trajectory import Playback, Trajectory

# When a controller should use the gains. It is the name of the last column of design.csv, so it has
# neither commas nor quotation marks; the column holds zeros.
GAIN_NOTE = (
    "gains are for u = ctrl + gain (planned state - measured state). Use them where small errors "
    "grow along the motion (torque control without servos; mjfim design warns about it) and the "
    "state is measured with little noise and delay. Leave them out where position servos correct "
    "errors already. Record the control that was really sent in both cases"
)


def simulate_playback(system: System, trajectory: Trajectory, gain: Array) -> Playback:
    """Simulate a designed trajectory at `playback_rate`, at the parameters of the design.

    Args:
        system: The system.
        trajectory: The design, N samples.
        gain: (N, nu, nx) feedback gains of the samples [control unit / state unit].

    Returns:
        The trajectory and the gains, one row for each period of the controller.

    Raises:
        SimulationDivergedError: The simulation diverges.
    """
    steps = system.stated_grid.playback_steps
    rows = system.grid.substeps // steps
    held = np.repeat(trajectory.ctrl, rows, axis=0)

    simulator = BatchSimulator(system.plant.simulator.model, substeps=steps)
    model = system.plant.model(system.theta)
    out = simulator.rollout([model], trajectory.state[:1], held[None])
    if not out.finite[0]:
        raise SimulationDivergedError("the designed control diverges when it is simulated again")

    t = np.arange(len(held) + 1, dtype=np.float64) * (system.dt / rows)
    return Playback(t=t, state=out.states[0], ctrl=held, gain=np.repeat(gain, rows, axis=0))


def design_columns(playback: Playback, system: System) -> dict[str, Array]:
    """Return the columns of `design.csv` by name, each (M+1,): time, state, controls and gains.

    The name of the last column says when to use the gains; the column holds zeros.

    Controls and gains hold until the next row; the last row has none (NaN).

    Args:
        playback: The design by periods of the controller, M of them.
        system: The system.
    """
    M = len(playback.ctrl)
    no_control = np.full((1, len(system.controls)), np.nan)
    ctrl = np.concatenate([playback.ctrl, no_control])

    gain = playback.gain.reshape(M, -1)
    no_gain = np.full((1, gain.shape[1]), np.nan)
    gain = np.concatenate([gain, no_gain])

    columns = {"t": playback.t}
    columns |= dict(zip(state_names(system.model), playback.state.T, strict=True))
    columns |= {f"ctrl:{name}": ctrl[:, i] for i, name in enumerate(system.controls)}
    columns |= dict(zip(gain_names(system.model, system.controls), gain.T, strict=True))
    columns[f"note: {GAIN_NOTE}"] = np.zeros(M + 1)
    return columns


def reference_columns(playback: Playback, system: System) -> dict[str, Array]:
    """Return the columns of `reference.csv` by name, each (M+1,).

    They hold the planned motion and the feed-forward forces that belong to it.

    `qpos:<joint>` and `qvel:<joint>` are planned. `qacc:<joint>` is the acceleration of this motion
    as `limits.acceleration` limits it: the change of the velocity over the engine step that begins
    at the row, divided by the timestep. It is not MuJoCo's `qacc`, from which implicit integrators
    and RK4 make another change of the velocity. The last row has that of the last engine step.

    `force:<joint>` is what the actuators apply at the joint, by `mj_forward`; the last row
    continues the last control.

    Args:
        playback: The design by periods of the controller, M of them.
        system: The system.
    """
    held = np.concatenate([playback.ctrl, playback.ctrl[-1:]])
    qpos, qvel, act = system.space.split(playback.state)
    rows = Trajectory(t=playback.t, qpos=qpos, qvel=qvel, act=act, ctrl=held)

    qacc = _accelerations(playback, system)
    force = np.empty_like(qvel)
    for k, data in forward_samples(system.model_at(system.theta), rows, range(len(held))):
        force[k] = data.qfrc_actuator

    names = [component.name for component in state_components(system.model)]
    motion = np.concatenate([qpos, qvel], axis=1)
    columns = {"t": playback.t}
    columns |= dict(zip(names, motion.T, strict=True))
    dofs = dof_names(system.model)
    columns |= {f"qacc:{name}": qacc[:, i] for i, name in enumerate(dofs)}
    columns |= {f"force:{name}": force[:, i] for i, name in enumerate(dofs)}
    return columns


def _accelerations(playback: Playback, system: System) -> Array:
    """(M+1, nv) changes of the velocity over an engine step, divided by the timestep.

    Those of the M periods belong to the first engine step of the period, the last one to the last
    engine step of the last period.
    """
    steps = system.stated_grid.playback_steps
    held = np.repeat(playback.ctrl, steps, axis=0)
    simulator = BatchSimulator(system.plant.simulator.model)
    model = system.plant.model(system.theta)
    out = simulator.rollout([model], playback.state[:1], held[None])

    _, velocity, _ = system.space.split(out.states[0])
    change = np.diff(velocity, axis=0) / float(model.opt.timestep)
    return np.concatenate([change[::steps], change[-1:]])
