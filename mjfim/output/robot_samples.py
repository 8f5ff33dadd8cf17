"""Files of the robots that are drawn from an estimate: a table, and a model for each robot."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ModelError
from mjfim.experiment.system import System
from mjfim.files import remove_earlier_result
from mjfim.identification.parameter_draws import complete_theta
from mjfim.output.archive import write_table
from mjfim.output.manifest import MANIFEST
from mjfim.output.models.mjcf import identified_files, write_identified
from mjfim.records.estimate import Estimate, ParameterDraws

# Table of the drawn robots, and folder of their models.
SAMPLES_TABLE = "samples.csv"
SAMPLES_FOLDER = "samples"

# Names of all files that an earlier run has written into the folder.
SAMPLE_NAMES = r"robot_\d+(_.*)?\.(xml|urdf)"


def sample_files(folder: Path, count: int, model: Path) -> tuple[str, ...]:
    """List the files of drawn robots, relative to the folder of the estimate.

    Args:
        folder: Folder of the estimate.
        count: Number of robots; without any, there are no files.
        model: The user's model.
    """
    if not count:
        return ()

    # The names of copies begin with the name of the robot, so that one robot shows all of them.
    first = _model_name(0)
    stem = Path(first).stem
    others = identified_files(folder / SAMPLES_FOLDER / first, model)
    endings = [name.removeprefix(stem) for name in (first, *others)]
    names = [
        f"{SAMPLES_FOLDER}/{Path(_model_name(i)).stem}{ending}"
        for i in range(count)
        for ending in endings
    ]
    return (SAMPLES_TABLE, *names)


def write_samples(folder: Path, estimate: Estimate, system: System) -> list[str]:
    """Write the table and the models of the robots that are drawn from an estimate.

    Models are written for all robots or for none.

    Args:
        folder: Folder of the estimate.
        estimate: An estimate with draws.
        system: The system that was identified.

    Returns:
        Sentences about models that could not be written completely.
    """
    draws = estimate.draws
    assert draws is not None
    write_table(folder / SAMPLES_TABLE, _columns(draws))

    # Robots differ in their numbers alone, so that a remark stands for all of them.
    remarks: Counter[str] = Counter()
    for i in range(len(draws)):
        try:
            found = _write_robot(folder, i, system, complete_theta(system, estimate, draws, i))
        except ModelError as error:
            _clear_models(folder)
            return [f"no models of drawn robots were written: {error}"]
        remarks.update(found)
    return [
        f"{SAMPLES_FOLDER}/: {remark}"
        + (f" ({count} of {len(draws)} robots)" if count < len(draws) else "")
        for remark, count in remarks.items()
    ]


def _write_robot(folder: Path, robot: int, system: System, theta: Array) -> list[str]:
    """Write the models of one robot; return sentences that do not name it."""
    path = folder / SAMPLES_FOLDER / _model_name(robot)
    remarks = write_identified(path, system, theta)
    return [remark.replace(path.stem, "robot") for remark in remarks]


def clear_samples(folder: Path) -> None:
    """Remove the files of drawn robots that an earlier run wrote.

    Args:
        folder: Folder of the estimate.
    """
    if (folder / SAMPLES_TABLE).is_file():
        remove_earlier_result(folder / SAMPLES_TABLE)
    _clear_models(folder)


def _clear_models(folder: Path) -> None:
    """Remove the models of drawn robots, and their folder where nothing else is in it."""
    place = folder / SAMPLES_FOLDER
    if not place.is_dir():
        return

    for stale in list(place.iterdir()):
        if re.fullmatch(SAMPLE_NAMES, stale.name):
            remove_earlier_result(stale)
    if {file.name for file in place.iterdir()} <= {MANIFEST}:
        (place / MANIFEST).unlink(missing_ok=True)
        place.rmdir()


def _model_name(robot: int) -> str:
    """Name of the model of a robot, by its index."""
    return f"robot_{robot + 1:04d}.xml"


def _columns(draws: ParameterDraws) -> dict[str, np.ndarray]:
    """Columns of the table: the number of the robot, and every parameter with its unit."""
    columns: dict[str, np.ndarray] = {"robot": np.arange(1, len(draws) + 1)}
    for j, (name, unit) in enumerate(zip(draws.parameters, draws.units, strict=True)):
        columns[f"{name} [{unit}]" if unit else name] = draws.values[:, j]
    return columns
