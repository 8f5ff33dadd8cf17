"""Tables of designs, recordings and controls, for robot controllers and other programs.

`mjfim.records.base` saves and loads the records; this module adds the tables that need the
experiment: recordings and controls as CSV, and those with which a robot plays a design.
`design.csv` is for a controller that applies the control, `reference.csv` for a position-controlled
robot.

Rows are engine steps at the controller's rate; nothing is interpolated. With feedback the robot
applies `u = ctrl + gain (planned - measured)`, the difference in the tangent space: rotations of
ball and free joints are rotation vectors in the measured body's frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError, SimulationDivergedError
from mjfim.experiment.given import check_fits
from mjfim.experiment.system import System
from mjfim.files import read_arrays, relative_name, replacing, write_json
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
from mjfim.records.base import ShownRecord
from mjfim.records.design import TRAJECTORY_ARRAYS, Design
from mjfim.records.studies import Comparison
from mjfim.records.trajectory import Labels, Recording, Trajectory

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


def simulate_playback(
    system: System, trajectory: Trajectory, gain: Array
) -> tuple[Trajectory, Array]:
    """Simulate a designed trajectory at `playback_rate`, at the parameters of the design.

    Args:
        system: The system.
        trajectory: The design, N samples.
        gain: (N, nu, nx) feedback gains of the samples [control unit / state unit].

    Returns:
        The trajectory of M samples, one for each period of the controller, and the gains, which are
        held over each sample of the design: (M, nu, nx).

    Raises:
        SimulationDivergedError: The simulation diverges.
    """
    steps = system.stated_grid.playback_steps
    rows = system.grid.substeps // steps
    held = np.repeat(trajectory.ctrl, rows, axis=0)

    states = _rollout(system, trajectory.state[:1], held, steps)
    qpos, qvel, act = system.space.split(states)
    t = np.arange(len(held) + 1, dtype=np.float64) * (system.dt / rows)
    played = Trajectory(t=t, qpos=qpos, qvel=qvel, act=act, ctrl=held)
    return played, np.repeat(gain, rows, axis=0)


def design_columns(playback: Trajectory, gain: Array, system: System) -> dict[str, Array]:
    """Return the columns of `design.csv` by name, each (M+1,): time, state, controls and gains.

    Controls and gains hold until the next row; the last row has none (NaN).

    Args:
        playback: The design by periods of the controller, M of them.
        gain: (M, nu, nx) feedback gains [control unit / state unit].
        system: The system.
    """
    held = np.concatenate([playback.ctrl, gain.reshape(playback.samples, -1)], axis=1)
    held = np.concatenate([held, np.full((1, held.shape[1]), np.nan)])
    controls = [f"ctrl:{name}" for name in system.controls]
    gains = gain_names(system.model, system.controls)

    columns = {"t": playback.t}
    columns |= dict(zip(state_names(system.model), playback.state.T, strict=True))
    return columns | dict(zip([*controls, *gains], held.T, strict=True))


def reference_columns(playback: Trajectory, system: System) -> dict[str, Array]:
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
    rows = replace(playback, ctrl=held)

    force = np.empty_like(playback.qvel)
    for k, data in forward_samples(system.model_at(system.theta), rows, range(len(held))):
        force[k] = data.qfrc_actuator

    qacc = _accelerations(playback, system)
    names = [component.name for component in state_components(system.model)]
    dofs = dof_names(system.model)
    columns = {"t": playback.t}
    planned = np.concatenate([playback.qpos, playback.qvel], axis=1)
    columns |= dict(zip(names, planned.T, strict=True))
    columns |= {f"qacc:{name}": qacc[:, i] for i, name in enumerate(dofs)}
    return columns | {f"force:{name}": force[:, i] for i, name in enumerate(dofs)}


def _accelerations(playback: Trajectory, system: System) -> Array:
    """(M+1, nv) changes of the velocity over single engine steps, divided by the timestep."""
    steps = system.stated_grid.playback_steps
    states = _rollout(system, playback.state[:1], np.repeat(playback.ctrl, steps, axis=0), 1)
    change = np.diff(system.space.split(states)[1], axis=0) / float(system.model.opt.timestep)
    return np.concatenate([change[::steps], change[-1:]])


def _rollout(system: System, start: Array, ctrl: Array, steps: int) -> Array:
    """(M+1, nq+nv+na) states of the design's model under controls (M, nu) of some engine steps."""
    simulator = BatchSimulator(system.plant.simulator.model, substeps=steps)
    out = simulator.rollout([system.plant.model(system.theta)], start, ctrl[None])
    if not out.finite[0]:
        raise SimulationDivergedError("the designed control diverges when it is simulated again")
    return np.asarray(out.states[0])


# Fewest rows of a trajectory that a design can have.
MIN_ROWS = 3

# Largest deviation of one sample period of a design from their mean, relative to the mean.
SPACING_TOLERANCE = 1e-3


def write_data(
    folder: Path,
    record: ShownRecord,
    system: System | None = None,
    further: Mapping[str, object] | None = None,
) -> None:
    """Write the JSON file, the npz file and the tables of a result, each complete or not at all.

    A design has the tables design.csv and reference.csv, a comparison a control of each method. The
    JSON file names the experiment file and its model, relative to the folder.

    Args:
        folder: Folder for the files; made if it does not exist.
        record: The result.
        system: Its experiment; None for a comparison of robots.
        further: Further entries of the JSON file.
    """
    tables = {} if system is None else _tables(record, system)
    record.save_archive(folder)
    for name, columns in tables.items():
        write_table(folder / f"{name}.csv", columns)
    values = {**summary_with_origin(record, system, folder), **(further or {})}
    write_json(folder / f"{record.file_stem}.json", values)


def _tables(record: ShownRecord, system: System) -> dict[str, Mapping[str, np.ndarray]]:
    """The columns of the tables of a result, by the names of the tables."""
    if isinstance(record, Design):
        playback, gain = simulate_playback(system, record.trajectory, record.final.gain)
        return {
            "design": design_columns(playback, gain, system),
            "reference": reference_columns(playback, system),
        }
    if isinstance(record, Comparison):
        return {
            f"control_{row.method}": control_columns(row.control, system)
            for row in record.rows
            if row.control is not None
        }
    return {}


def summary_with_origin(
    record: ShownRecord, system: System | None, folder: Path | None
) -> dict[str, object]:
    """Return the contents of a result's JSON file, which `--json` prints as well.

    Args:
        record: The result.
        system: The experiment of the result; None for a comparison of robots.
        folder: Folder of results, relative to which files are named; without one, none are.
    """
    if system is None or folder is None:
        return record.summary()
    # An experiment that is no file has no name.
    files = {"experiment": Path(system.experiment.source), "model": system.model_path}
    origin = {
        name: relative_name(file, folder) if file.is_file() else None
        for name, file in files.items()
    }
    return {**origin, **record.summary()}


def write_table(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Write columns as CSV with all digits; NaN is an empty field.

    Args:
        path: File to write.
        columns: (M,) values by name of the column.
    """
    import pyarrow.csv  # slow; a check without a folder writes no table

    arrays = {
        name: pyarrow.array(np.asarray(values), from_pandas=True)
        for name, values in columns.items()
    }
    with replacing(path) as temporary:
        options = pyarrow.csv.WriteOptions(quoting_style="none")
        pyarrow.csv.write_csv(pyarrow.table(arrays), temporary, options)


def control_columns(control: Array, system: System) -> dict[str, Array]:
    """Return the columns of a control: (N, nu), as `initial.control` reads them."""
    t = np.arange(len(control), dtype=np.float64) * system.dt
    return {"t": t, **dict(zip(system.controls, control.T, strict=True))}


def write_recording(path: Path, recording: Recording, system: System) -> None:
    """Write a recording as CSV.

    The columns are `t`, the controls `ctrl:<actuator>` or what control laws read, and the outputs.
    A field is empty where nothing was measured.

    Args:
        path: CSV file to write.
        recording: The recording.
        system: The experiment, which names the actuators.
    """
    # The last row has no control.
    no_control = np.full((1, recording.ctrl.shape[1]), np.nan)
    ctrl = np.concatenate([recording.ctrl, no_control])

    controls = dict(zip(system.inputs, ctrl.T, strict=True))
    outputs = dict(zip(recording.outputs, recording.y.T, strict=True))
    write_table(path, {"t": recording.t, **controls, **outputs})


def read_design(path: Path, system: System) -> dict[str, Trajectory]:
    """Read the trajectories of a design.npz.

    The file may come from any version of mjfim or from another program. `Design.load` reads the
    whole design.

    Args:
        path: The npz file.
        system: The experiment.

    Returns:
        The designed trajectory as `final`, and the initial one as `initial` if the file holds it.

    Raises:
        RecordingError: The file cannot be read, lacks an array, or its arrays do not fit each
            other or the experiment. Pickles are refused.
    """
    arrays = read_arrays(path, "design")
    missing = [key for key in TRAJECTORY_ARRAYS if key not in arrays]
    if missing:
        expected = ", ".join((*TRAJECTORY_ARRAYS, "gain", "sensitivity"))
        raise RecordingError(f"{path}: array {missing[0]!r} is missing; a design holds {expected}")
    has_initial = all(f"initial_{key}" in arrays for key in TRAJECTORY_ARRAYS)
    prefixes = {"initial": "initial_", "final": ""} if has_initial else {"final": ""}
    named = {name: _trajectory(path, prefix, arrays) for name, prefix in prefixes.items()}
    for trajectory in named.values():
        check_fits(path, trajectory, system)
    return named


def _trajectory(path: Path, prefix: str, arrays: Mapping[str, np.ndarray]) -> Trajectory:
    """Build a trajectory from arrays that are finite numbers and fit each other."""
    found = {key: arrays[prefix + key] for key in TRAJECTORY_ARRAYS}
    rows = found["t"].size
    for key, array in found.items():
        count = rows - 1 if key == "ctrl" else max(rows, MIN_ROWS)
        is_shaped = array.ndim == (1 if key == "t" else 2) and len(array) == count
        if not is_shaped or array.dtype.kind not in "fiu" or not np.isfinite(array).all():
            wanted = f"({count},)" if key == "t" else f"({count}, columns)"
            raise RecordingError(
                f"{path}: array '{prefix}{key}' must hold finite numbers of the shape {wanted}; it "
                f"has the shape {array.shape}"
            )

    _require_equal_periods(f"{path}: array '{prefix}t'", found["t"].astype(np.float64))
    return Trajectory(**found)


def _require_equal_periods(name: str, t: Array) -> None:
    """Raise RecordingError where times do not increase by equal periods."""
    periods = np.diff(t)
    mean = periods.mean()
    if mean <= 0.0 or np.abs(periods - mean).max() > SPACING_TOLERANCE * mean:
        raise RecordingError(
            f"{name} must increase by equal periods; they are {periods.min():g} s to "
            f"{periods.max():g} s"
        )
