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
from mjfim.model.coordinates import (
    QUATERNION,
    dof_names,
    gain_names,
    split_unit,
    state_components,
    state_names,
)
from mjfim.plant.active_constraints import forward_samples
from mjfim.plant.batch import BatchSimulator
from mjfim.plant.state_space import logarithm
from mjfim.records.labels import Labels
from mjfim.records.trajectory import Playback, Trajectory

# Angle of a whole turn [rad].
TURN = 2.0 * np.pi


def shown_positions(labels: Labels, *qpos: Array) -> tuple[tuple[str, ...], tuple[Array, ...]]:
    """Return positions by degree of freedom, with their labels.

    Args:
        labels: Labels of the model's columns. Where they do not say which columns are a
            quaternion, as in records of earlier versions, qpos is returned as it is.
        qpos: (n, nq) positions of any number of trajectories [m or rad; unit quaternions].

    Returns:
        The labels, and the (n, nv) positions of each trajectory; orientations are rotation vectors
        [rad].
    """
    names = [split_unit(label)[0] for label in labels.qpos]
    first = [k for k, name in enumerate(names) if name.endswith(f".{QUATERNION[0]}")]
    if len(names) - len(first) != len(labels.positions):
        return labels.qpos, qpos

    shown = []
    for values in qpos:
        parts, done = [], 0
        for k in first:
            parts += [values[:, done:k], rotation_vectors(values[:, k : k + 4])]
            done = k + 4
        shown.append(np.hstack([*parts, values[:, done:]]))
    return labels.positions, tuple(shown)


def rotation_vectors(quaternions: Array) -> Array:
    """Return rotation vectors that change without jumps, also beyond half a turn.

    Args:
        quaternions: (n, 4) unit quaternions, the real part first.

    Returns:
        (n, 3) rotation vectors [rad].
    """
    vectors = logarithm(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True))
    angles = np.linalg.norm(vectors, axis=1)
    for k in range(1, len(vectors)):
        if angles[k] == 0.0:
            continue

        # Whole turns about the same axis are the same orientation.
        axis = vectors[k] / angles[k]
        turns = np.round((vectors[k - 1] @ axis - angles[k]) / TURN)
        vectors[k] += turns * TURN * axis
    return vectors


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

    states = _rollout(system, trajectory.state[:1], held, steps)
    t = np.arange(len(held) + 1, dtype=np.float64) * (system.dt / rows)
    return Playback(t=t, state=states, ctrl=held, gain=np.repeat(gain, rows, axis=0))


def design_columns(playback: Playback, system: System) -> dict[str, Array]:
    """Return the columns of `design.csv` by name, each (M+1,): time, state, controls and gains.

    The name of the last column says when to use the gains; the column holds zeros.

    Controls and gains hold until the next row; the last row has none (NaN).

    Args:
        playback: The design by periods of the controller, M of them.
        system: The system.
    """
    rows = len(playback.ctrl)
    held = np.concatenate([playback.ctrl, playback.gain.reshape(rows, -1)], axis=1)
    held = np.concatenate([held, np.full((1, held.shape[1]), np.nan)])
    controls = [f"ctrl:{name}" for name in system.controls]
    gains = gain_names(system.model, system.controls)

    columns = {"t": playback.t}
    columns |= dict(zip(state_names(system.model), playback.state.T, strict=True))
    columns |= dict(zip([*controls, *gains], held.T, strict=True))
    return columns | {f"note: {GAIN_NOTE}": np.zeros(rows + 1)}


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

    force = np.empty_like(qvel)
    for k, data in forward_samples(system.model_at(system.theta), rows, range(len(held))):
        force[k] = data.qfrc_actuator

    # The changes of the velocity over single engine steps.
    steps = system.stated_grid.playback_steps
    states = _rollout(system, playback.state[:1], np.repeat(playback.ctrl, steps, axis=0), 1)
    change = np.diff(system.space.split(states)[1], axis=0) / float(system.model.opt.timestep)
    qacc = np.concatenate([change[::steps], change[-1:]])

    names = [component.name for component in state_components(system.model)]
    dofs = dof_names(system.model)
    columns = {"t": playback.t}
    columns |= dict(zip(names, np.concatenate([qpos, qvel], axis=1).T, strict=True))
    columns |= {f"qacc:{name}": qacc[:, i] for i, name in enumerate(dofs)}
    return columns | {f"force:{name}": force[:, i] for i, name in enumerate(dofs)}


def _rollout(system: System, start: Array, ctrl: Array, steps: int) -> Array:
    """(M+1, nq+nv+na) states of the design's model under controls (M, nu) of some engine steps."""
    simulator = BatchSimulator(system.plant.simulator.model, substeps=steps)
    out = simulator.rollout([system.plant.model(system.theta)], start, ctrl[None])
    if not out.finite[0]:
        raise SimulationDivergedError("the designed control diverges when it is simulated again")
    return np.asarray(out.states[0])
