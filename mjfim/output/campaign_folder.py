"""The folder of a campaign, which holds a subfolder for each round.

A later call continues the campaign from the designs, recordings and estimates in it.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ModelError, RecordingError, first_ones, listed, shortened
from mjfim.experiment.given import check_fits
from mjfim.experiment.packing import input_files
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.files import as_json, read_json, replacing
from mjfim.output.archive import write_data
from mjfim.output.export.mjcf import write_identified
from mjfim.output.folders import (
    DESIGN_ARCHIVE,
    IDENTIFIED,
    SETTINGS_FILE,
    identified_models,
    write_pictures,
)
from mjfim.output.manifest import fingerprint, write_optional
from mjfim.output.page import REPORT, PictureFormat
from mjfim.output.plots import studies
from mjfim.output.plots.pictures import Pictures
from mjfim.output.report import write_report
from mjfim.output.words import format_with_uncertainty
from mjfim.recordings.read import read_recording
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.studies import Campaign, RecordedRound

# Files of the estimate after a round.
ESTIMATE_ARCHIVE = ("estimate.json", "estimate.npz")


class CampaignFolder:
    """The folder of a campaign; `round_<number>/` holds the files of a round, from 1.

    Attributes:
        path: The folder, which need not exist yet.
        system: The experiment as stated.
        picture_format: Format of the picture.
    """

    def __init__(
        self, path: Path, system: System, picture_format: PictureFormat = PictureFormat.PNG
    ) -> None:
        self.path = path
        self.system = system
        self.picture_format = picture_format

    # ---- contents of the folder

    def round(self, number: int) -> Path:
        """Folder of a round."""
        return self.path / f"round_{number}"

    def recordings(self, number: int) -> list[Path]:
        """Recordings of a round."""
        return sorted(self.round(number).glob("recording*.csv"))

    @property
    def has_rounds(self) -> bool:
        """True where the folder holds a campaign."""
        return any(self.path.glob("round_*"))

    @property
    def has_real_recordings(self) -> bool:
        """True where campaign.json says that the recordings are not simulated."""
        try:
            return read_json(self.path / "campaign.json").get("simulated") is False
        except RecordingError:
            return False

    @property
    def designed(self) -> int:
        """Number of rounds that have a design."""
        number = 0
        while all((self.round(number + 1) / f"design.{end}").is_file() for end in ("json", "npz")):
            number += 1
        return number

    @property
    def recorded(self) -> int:
        """Number of rounds that have a design and recordings."""
        return sum(1 for _ in itertools.takewhile(self.recordings, range(1, self.designed + 1)))

    def next_files(self, *, simulated: bool) -> list[str]:
        """List the models, and the files in folders of rounds, that the next call may replace.

        Args:
            simulated: Whether recordings are simulated, too.

        Returns:
            Names relative to the folder.
        """
        names = [*identified_models(self.path, self.system.model_path)]
        designed, recorded = self.designed, self.recorded
        for place in self.path.glob("round_*"):
            number = int(place.name.removeprefix("round_") or 0)

            # Designs and recordings are kept, and all estimates are made again.
            of_round = list(ESTIMATE_ARCHIVE)
            of_round += DESIGN_ARCHIVE if number > designed else ()
            of_round += ["recording.csv"] if simulated and number > recorded else []
            names += [f"{place.name}/{name}" for name in of_round]
        return names

    def recorded_rounds(self) -> Iterator[RecordedRound]:
        """Yield the rounds that are recorded, the first one first.

        Raises:
            RecordingError: A design or a recording cannot be read, or belongs to another
                experiment.
        """
        names = self.system.parameters.names
        for number in range(1, self.recorded + 1):
            folder = self.round(number)
            design = Design.load(folder)
            if design.parameters != names:
                raise RecordingError(
                    f"{folder / 'design.json'}: designed for {listed(design.parameters)}; "
                    f"the experiment has {listed(names)}"
                )

            check_fits(folder / "design.npz", design.trajectory, self.system)
            paths = self.recordings(number)
            yield design, tuple(read_recording(path, self.system.channels) for path in paths)

    # ---- additions to the folder

    def add_recordings(self, files: Sequence[Path]) -> None:
        """Copy new recordings to the first round that has a design but no recording.

        Args:
            files: The recordings; those whose contents are in the folder already are not copied.

        Raises:
            RecordingError: A recording cannot be read, or no round lacks a recording.
        """
        numbers = range(1, self.designed + 1)
        known = {path.read_bytes() for number in numbers for path in self.recordings(number)}

        # Read all files first, so that none is copied if one of them is unusable.
        for file in files:
            read_recording(file, self.system.channels)

        new = [file for file in dict.fromkeys(files) if file.read_bytes() not in known]
        waiting = self.recorded + 1
        if new and waiting > self.designed:
            raise RecordingError(
                f"{new[0]}: every design in {self.path} has a recording already; repeat the call "
                "without this file to design the next round (or is it a changed recording of an "
                "earlier round?)"
            )

        for i, file in enumerate(new):
            name = "recording.csv" if len(new) == 1 else f"recording_{i + 1}.csv"
            with replacing(self.round(waiting) / name) as temporary:
                shutil.copyfile(file, temporary)

    def write_campaign(self, campaign: Campaign, *, simulated: bool) -> list[str]:
        """Write campaign.json, campaign.npz, tables, the picture and the identified model.

        Args:
            campaign: The campaign.
            simulated: True where the recordings were simulated at the true values.

        Returns:
            Sentences about the identified model.
        """
        true = self.system.parameters.true if simulated else None
        further = {"simulated": simulated, "units": list(self.system.units), "true": true}
        write_data(self.path, campaign, self.system, further)
        write_optional(REPORT, lambda: write_report(self.path))
        if campaign.estimate is None:
            return []

        pictures: Pictures = {"campaign": partial(studies.campaign, campaign, true)}
        write_pictures(self.path, pictures, self.picture_format)
        try:
            estimate, file = campaign.estimate, self.path / IDENTIFIED
            return write_identified(file, self.system, estimate.theta, estimate)
        except ModelError as error:
            return [str(error)]


def accuracy_sentence(estimate: Estimate, wanted: Array) -> str:
    """Return estimates of the parameters with a target accuracy: `m 2.001 ± 0.005 (wanted 0.006)`.

    Args:
        estimate: The estimate.
        wanted: (p,) standard deviations aimed at [theta-unit]; infinite where none is.
    """
    parts = []
    for j, name in enumerate(estimate.parameters):
        if np.isfinite(wanted[j]):
            value, std = float(estimate.theta[j]), float(estimate.std[j])
            parts.append(f"{name} {format_with_uncertainty(value, std)} (wanted {wanted[j]:.3g})")
    return first_ones(parts) if parts else ""


# ---- settings of a simulated campaign


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
    return "not stated" if value is None else shortened(json.dumps(value))
