"""Files of the robots that are drawn from an estimate: a table, and a model for each robot."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

import numpy as np

from mjfim.errors import ModelError
from mjfim.experiment.system import System
from mjfim.files import remove_earlier_result
from mjfim.output.archive import write_table
from mjfim.output.manifest import MANIFEST
from mjfim.output.models.mjcf import identified_files, write_identified
from mjfim.records.estimate import Estimate

# Table of the drawn robots, and folder of their models.
SAMPLES_TABLE = "samples.csv"
SAMPLES_FOLDER = "samples"

# Name of the model of a robot without its ending, by its number from 1; and names of all files that
# an earlier run has written into the folder.
ROBOT = "robot_{:04d}"
ROBOT_FILES = r"robot_\d+(_.*)?\.(xml|urdf)"


def sample_files(folder: Path, count: int, model: Path) -> tuple[str, ...]:
    """List the files of drawn robots, relative to the folder of the estimate.

    Args:
        folder: Folder of the estimate.
        count: Number of robots; without any, there are no files.
        model: The user's model.
    """
    if not count:
        return ()

    # The names of all files begin with the name of the robot.
    first = ROBOT.format(1)
    others = identified_files(folder / SAMPLES_FOLDER / f"{first}.xml", model)
    endings = [".xml", *(name.removeprefix(first) for name in others)]
    robots = [f"{SAMPLES_FOLDER}/{ROBOT.format(i + 1)}" for i in range(count)]
    return (SAMPLES_TABLE, *(f"{robot}{ending}" for robot in robots for ending in endings))


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
    columns: dict[str, np.ndarray] = {"robot": np.arange(1, len(draws) + 1)}
    for name, unit, values in zip(draws.parameters, draws.units, draws.values.T, strict=True):
        columns[f"{name} [{unit}]" if unit else name] = values
    write_table(folder / SAMPLES_TABLE, columns)

    # Robots differ in their numbers alone, so that a remark stands for all of them.
    remarks: Counter[str] = Counter()
    theta = np.array(estimate.theta)
    for i in range(len(draws)):
        path = folder / SAMPLES_FOLDER / f"{ROBOT.format(i + 1)}.xml"
        theta[~system.parameters.initial_deviations] = draws.values[i]
        try:
            found = write_identified(path, system, theta)
        except ModelError as error:
            _clear_models(folder / SAMPLES_FOLDER)
            return [f"no models of drawn robots were written: {error}"]
        remarks.update(remark.replace(path.stem, "robot") for remark in found)
    return [
        f"{SAMPLES_FOLDER}/: {remark}"
        + (f" ({count} of {len(draws)} robots)" if count < len(draws) else "")
        for remark, count in remarks.items()
    ]


def clear_samples(folder: Path) -> None:
    """Remove the files of drawn robots that an earlier run wrote.

    Args:
        folder: Folder of the estimate.
    """
    if (folder / SAMPLES_TABLE).is_file():
        remove_earlier_result(folder / SAMPLES_TABLE)
    _clear_models(folder / SAMPLES_FOLDER)


def _clear_models(place: Path) -> None:
    """Remove the models of drawn robots, and their folder where nothing else is in it."""
    if not place.is_dir():
        return
    for stale in list(place.iterdir()):
        if re.fullmatch(ROBOT_FILES, stale.name):
            remove_earlier_result(stale)
    if {file.name for file in place.iterdir()} <= {MANIFEST}:
        (place / MANIFEST).unlink(missing_ok=True)
        place.rmdir()
