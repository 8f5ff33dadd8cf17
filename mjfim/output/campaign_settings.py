"""The settings with which a simulated campaign began; the call that continues it needs the same."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from mjfim.errors import RecordingError
from mjfim.experiment.input_files import input_files
from mjfim.experiment.schema import Experiment
from mjfim.files import as_json, read_json, write_json
from mjfim.output.manifest import Fingerprint

# File with the settings, in the folder of the campaign.
SETTINGS_FILE = "settings.json"

# Largest number of differences that a message lists, and of characters of a value in it.
LISTED_DIFFERENCES = 3
SHOWN_VALUE = 40


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
        os.path.relpath(file, experiment.directory): Fingerprint.of(file).sha256
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
        listed = "; ".join(differences[:LISTED_DIFFERENCES])
        more = len(differences) - LISTED_DIFFERENCES
        raise RecordingError(
            f"{folder}: --resume needs the settings with which the campaign began: {listed}"
            f"{f'; and {more} more' if more > 0 else ''}. Repeat the call with these settings, or "
            "begin a campaign in another folder"
        )


def _differences(before: Mapping[str, Any], now: Mapping[str, Any]) -> Iterator[str]:
    """Describe each setting that differs: `--seed was 5, is 6`."""
    if before.get("seed") != now["seed"]:
        yield f"--seed was {before.get('seed')}, is {now['seed']}"

    # Targets of --wanted are part of the experiment.
    old, new = (dict(_leaves(values.get("experiment"))) for values in (before, now))
    for key in sorted({*old, *new}):
        if old.get(key) != new.get(key):
            yield f"{key} was {_shown(old.get(key))}, is {_shown(new.get(key))}"

    sums, present = (dict(_leaves(values.get("files"))) for values in (before, now))
    for name in sorted({*sums, *present}):
        if sums.get(name) != present.get(name):
            yield f"the file {name} was changed"


def _leaves(values: object, place: str = "") -> Iterator[tuple[str, Any]]:
    """Yield all values of nested tables, each with its key: `parameters.m.guess`."""
    if not isinstance(values, Mapping):
        yield place, values
        return
    for key, value in values.items():
        yield from _leaves(value, f"{place}.{key}" if place else str(key))


def _shown(value: object) -> str:
    """Return a value for a message."""
    if value is None:
        return "not stated"
    text = json.dumps(value)
    return text if len(text) <= SHOWN_VALUE else f"{text[:SHOWN_VALUE]}…"
