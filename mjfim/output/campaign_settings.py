"""The settings with which a simulated campaign began; the call that continues it needs the same."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mjfim.errors import RecordingError, first_ones, shortened
from mjfim.experiment.input_files import input_files
from mjfim.experiment.schema import Experiment
from mjfim.files import as_json, read_json, write_json
from mjfim.output.manifest import fingerprint

# File with the settings, in the folder of the campaign.
SETTINGS_FILE = "settings.json"


def campaign_settings(experiment: Experiment, seed: int) -> dict[str, Any]:
    """Collect what determines the designs and recordings of a simulated campaign.

    Args:
        experiment: The experiment as stated, with all target accuracies.
        seed: Seed of the simulated noise.

    Returns:
        The settings as JSON values.
    """
    source = Path(experiment.source)
    sums = {
        os.path.relpath(file, experiment.directory): fingerprint(file)["sha256"]
        for file in input_files(experiment)
        if file != source and file.is_file()
    }
    values = experiment.model_dump(mode="json", exclude_unset=True)
    stated = {key: value for key, value in values.items() if key not in ("directory", "source")}
    settings: dict[str, Any] = json.loads(
        as_json({"seed": seed, "experiment": stated, "files": sums})
    )
    return settings


def write_settings(folder: Path, settings: Mapping[str, Any]) -> None:
    """Write the settings of a campaign that begins.

    Args:
        folder: Folder of the campaign.
        settings: The settings.
    """
    write_json(folder / SETTINGS_FILE, settings)


def require_same_settings(folder: Path, settings: Mapping[str, Any]) -> None:
    """Check that a campaign is continued with the settings with which it began.

    Args:
        folder: Folder of the campaign, which has rounds.
        settings: The settings of this call.

    Raises:
        RecordingError: A setting differs, or the folder does not hold the settings.
    """
    path = folder / SETTINGS_FILE
    if not path.is_file():
        raise RecordingError(
            f"{path}: no such file, so --resume cannot check that this call has the settings of "
            "the campaign (it may be from an older version); begin a campaign in another folder"
        )

    differences = list(_differences(read_json(path), settings))
    if differences:
        raise RecordingError(
            f"{folder}: --resume needs the settings with which the campaign began: "
            f"{first_ones(differences, '; ')}. Repeat the call with these settings, or begin a "
            "campaign in another folder"
        )


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    """Describe each setting that differs: `--seed was 5, is 6`."""
    old, new = dict(_leaves(before)), dict(_leaves(now))
    for place in sorted({*old, *new}):
        if old.get(place) == new.get(place):
            continue
        table, *keys = place
        if table == "files":
            yield f"the file {keys[0]} was changed"
        else:
            # Targets of --wanted are part of the experiment.
            name = ".".join(keys) if keys else f"--{table}"
            yield f"{name} was {_shown(old.get(place))}, is {_shown(new.get(place))}"


def _leaves(values: object, *place: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield all values of nested tables, each with its keys."""
    if not isinstance(values, Mapping):
        yield place, values
        return
    for key, value in values.items():
        yield from _leaves(value, *place, str(key))


def _shown(value: object) -> str:
    """Return a value for a message."""
    return "not stated" if value is None else shortened(json.dumps(value))
