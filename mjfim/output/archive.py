"""Files of designs, recordings and controls, for robot controllers and other programs.

`mjfim.records.base` saves and loads the records; this module adds the tables that need the
experiment: design.csv, reference.csv, recordings and controls as CSV.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError
from mjfim.experiment.system import System
from mjfim.files import read_arrays, replacing, write_json
from mjfim.output.playback import design_columns, reference_columns, simulate_playback
from mjfim.records.base import ShownRecord
from mjfim.records.design import TRAJECTORY_ARRAYS, Design
from mjfim.records.trajectory import Recording, Trajectory

# Fewest rows of a trajectory that a design can have.
MIN_ROWS = 3

# Largest deviation of one sample period of a design from their mean, relative to the mean.
SPACING_TOLERANCE = 1e-3

# Largest relative difference between the sample periods of a design and of an experiment that
# belong together.
PERIOD_TOLERANCE = 1e-6


def write_design(folder: Path, design: Design, system: System) -> None:
    """Write design.npz, design.csv, reference.csv and design.json, each complete or not at all.

    `Design.load` reads the design back. design.json names the experiment file and
    its model, relative to the folder.

    Args:
        folder: Folder for the files; made if it does not exist.
        design: The design.
        system: The experiment for which it was made.
    """
    playback = simulate_playback(system, design.trajectory, design.final.gain)

    design.save_archive(folder)
    write_table(folder / "design.csv", design_columns(playback, system))
    write_table(folder / "reference.csv", reference_columns(playback, system))

    write_json(folder / "design.json", {**origin_of(system, folder), **design.summary()})


def summary_with_origin(
    record: ShownRecord, system: System, folder: Path | None
) -> dict[str, object]:
    """Return the contents of a result's JSON file, which `--json` prints as well.

    Args:
        record: The result.
        system: The experiment of the result.
        folder: Folder of results, relative to which files are named; without one, none are.
    """
    origin = {} if folder is None else origin_of(system, folder)
    return {**origin, **record.summary()}


def origin_of(system: System, folder: Path) -> dict[str, str | None]:
    """Return the files of an experiment and of its model, relative to a folder of results.

    Args:
        system: The experiment.
        folder: The folder.

    Returns:
        The paths, with slashes; None for an experiment that is no file.
    """
    files = {"experiment": Path(system.experiment.source), "model": system.model_path}
    return {
        name: _relative(file, folder) if file.is_file() else None for name, file in files.items()
    }


def _relative(file: Path, folder: Path) -> str:
    """Return the path of a file relative to a folder; on another drive, the absolute path."""
    try:
        return Path(os.path.relpath(file.resolve(), folder.resolve())).as_posix()
    except ValueError:
        return file.resolve().as_posix()


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


def write_control(path: Path, control: Array, system: System) -> None:
    """Write a control as a table that `initial.control` of an experiment reads.

    Args:
        path: CSV file to write.
        control: (N, nu) control [unit of the actuator].
        system: The experiment, which names the actuators.
    """
    columns = {"t": np.arange(len(control), dtype=np.float64) * system.dt}
    for i, name in enumerate(system.controls):
        columns[name] = control[:, i]
    write_table(path, columns)


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

    columns = {"t": recording.t}
    for i, name in enumerate(system.inputs):
        columns[name] = ctrl[:, i]
    for i, name in enumerate(recording.outputs):
        columns[name] = recording.y[:, i]
    write_table(path, columns)


def read_design(path: Path) -> dict[str, Trajectory]:
    """Read the trajectories of a design.npz.

    The file may come from any version of mjfim or from another program. `Design.load` reads the
    whole design.

    Args:
        path: The npz file.

    Returns:
        The designed trajectory as `final`, and the initial one as `initial` if the file holds it.

    Raises:
        RecordingError: The file cannot be read, lacks an array, or its arrays do not fit each
            other. Pickles are refused.
    """
    arrays = read_arrays(path, "design")
    missing = [key for key in TRAJECTORY_ARRAYS if key not in arrays]
    if missing:
        expected = ", ".join((*TRAJECTORY_ARRAYS, "gain", "sensitivity"))
        raise RecordingError(f"{path}: array {missing[0]!r} is missing; a design holds {expected}")
    has_initial = all(f"initial_{key}" in arrays for key in TRAJECTORY_ARRAYS)
    initial = {"initial": _trajectory(path, "initial_", arrays)} if has_initial else {}
    return {**initial, "final": _trajectory(path, "", arrays)}


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

    periods = np.diff(found["t"].astype(np.float64))
    mean = float(periods.mean())
    if mean <= 0.0 or np.abs(periods - mean).max() > SPACING_TOLERANCE * mean:
        raise RecordingError(
            f"{path}: array '{prefix}t' must increase by equal periods; they are "
            f"{periods.min():g} s to {periods.max():g} s"
        )
    return Trajectory(**found)


def check_fits(path: Path, trajectory: Trajectory, system: System) -> None:
    """Check that a design belongs to an experiment.

    Args:
        path: File of the design, for the message.
        trajectory: Its trajectory.
        system: The experiment.

    Raises:
        RecordingError: The design was made for another model or another rate.
    """
    wanted = (system.model.nq, system.model.nv, len(system.controls))
    found = (trajectory.qpos.shape[1], trajectory.qvel.shape[1], trajectory.ctrl.shape[1])
    if found != wanted:
        raise RecordingError(
            f"{path}: made for (nq, nv, nu) = {found}, the experiment's model has {wanted}"
        )

    if abs(trajectory.dt - system.dt) > PERIOD_TOLERANCE * system.dt:
        raise RecordingError(
            f"{path}: sampled at {1 / trajectory.dt:g} Hz, the experiment at {1 / system.dt:g} Hz"
        )
