"""The folder of a campaign, which holds a subfolder for each round.

A later call continues the campaign from the designs, recordings and estimates in it.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ModelError, RecordingError, first_ones, listed
from mjfim.experiment.system import System
from mjfim.files import read_json, replacing, write_json
from mjfim.output import plots
from mjfim.output.archive import check_fits, origin_of, write_design
from mjfim.output.campaign_parameters import CampaignParameters
from mjfim.output.campaign_settings import SETTINGS_FILE
from mjfim.output.folders import (
    DESIGN_ARCHIVE,
    IDENTIFIED,
    TABLE_FILES,
    parts_of_identified,
    write_pictures,
    write_tables,
)
from mjfim.output.models.mjcf import write_identified
from mjfim.output.optional_files import write_optional
from mjfim.output.picture_format import PictureFormat
from mjfim.output.report import REPORT
from mjfim.output.report.build import write_report
from mjfim.recordings.read import read_recording
from mjfim.records.campaign import Campaign, EarlierRound, Round
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate

if TYPE_CHECKING:
    from mjfim.output.plots.pictures import Pictures

# Files of a campaign beside the folders of its rounds.
CAMPAIGN_FILES = (
    SETTINGS_FILE,
    "campaign.json",
    "campaign.npz",
    REPORT,
    "campaign.png",
    *TABLE_FILES,
    IDENTIFIED,
)

# Files of the estimate after a round.
ESTIMATE_ARCHIVE = ("estimate.json", "estimate.npz")


class CampaignFolder:
    """The folder of a campaign; `round_<number>/` holds the files of a round.

    Attributes:
        path: The folder.
        system: The experiment as stated.
        picture_format: Format of the picture.
    """

    def __init__(
        self, path: Path, system: System, picture_format: PictureFormat = PictureFormat.PNG
    ) -> None:
        """Describe a folder, which need not exist yet.

        Args:
            path: The folder.
            system: The experiment as stated.
            picture_format: Format of the picture.
        """
        self.path = path
        self.system = system
        self.picture_format = picture_format

    # ---- contents of the folder

    def round(self, number: int) -> Path:
        """Return the folder of a round.

        Args:
            number: Number of the round, from 1.
        """
        return self.path / f"round_{number}"

    def recordings(self, number: int) -> list[Path]:
        """Return the recordings of a round.

        Args:
            number: Number of the round, from 1.
        """
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

    def unrecorded_rounds(self) -> list[int]:
        """Numbers of the rounds that have a design, but no recording."""
        numbers = range(1, self.designed + 1)
        return [number for number in numbers if not self.recordings(number)]

    def next_files(self, *, simulated: bool) -> list[str]:
        """List the files that the next call may write; in the folders of rounds, existing ones.

        Args:
            simulated: Whether recordings are simulated, too.

        Returns:
            Names relative to the folder.
        """
        files = self.picture_format.files(CAMPAIGN_FILES)
        names = [*files, *parts_of_identified(self.path, self.system.model_path)]
        designed, recorded = self.designed, self.recorded
        for number in self._numbers():
            # Designs and recordings are kept, and all estimates are made again.
            of_round = list(ESTIMATE_ARCHIVE)
            if number > designed:
                of_round += DESIGN_ARCHIVE
            if simulated and number > recorded:
                of_round.append("recording.csv")
            names += [f"{self.round(number).name}/{name}" for name in of_round]
        return names

    def _numbers(self) -> list[int]:
        """Numbers of the rounds that have a folder, ascending."""
        numbers = [path.name.removeprefix("round_") for path in self.path.glob("round_*")]
        return sorted(int(number) for number in numbers if number.isdecimal())

    @property
    def designed(self) -> int:
        """Number of rounds that have a design."""
        number = 0
        while self._has_design(number + 1):
            number += 1
        return number

    @property
    def recorded(self) -> int:
        """Number of rounds that have a design and recordings."""
        designed = self.designed
        number = 0
        while number < designed and self.recordings(number + 1):
            number += 1
        return number

    def _has_design(self, number: int) -> bool:
        """Return whether both files of a round's design exist."""
        return all((self.round(number) / name).is_file() for name in ("design.json", "design.npz"))

    def recorded_rounds(self) -> Iterator[EarlierRound]:
        """Yield the rounds that are recorded.

        Yields:
            The rounds, the first one first.

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

            trajectory = design.trajectory
            check_fits(folder / "design.npz", trajectory, self.system)
            recordings = [
                read_recording(path, self.system.channels) for path in self.recordings(number)
            ]
            std = design.final.std
            yield EarlierRound(
                recordings=tuple(recordings),
                theta=design.theta,
                predicted=np.where(np.isnan(std), np.inf, std),
                control=trajectory.ctrl,
                design=design,
            )

    # ---- additions to the folder

    def add_recordings(self, files: Sequence[Path]) -> None:
        """Copy new recordings to the first round that has a design but no recording.

        Args:
            files: The recordings; those whose contents are in the folder already are not copied.

        Raises:
            RecordingError: A recording cannot be read, or no round lacks a recording.
        """
        known: set[bytes] = set()
        for number in range(1, self.designed + 1):
            known.update(path.read_bytes() for path in self.recordings(number))

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

    def write_design(self, design: Design, number: int, system: System) -> None:
        """Write the files of a round's design, which include those that the robot plays.

        Args:
            design: The design.
            number: Number of the round, from 1.
            system: The experiment for which the design was made.
        """
        write_design(self.round(number), design, system)

    def write_round(self, finished: Round) -> None:
        """Write the estimate after a round.

        Args:
            finished: The round.
        """
        finished.estimate.save(self.round(finished.number))

    def write_campaign(self, campaign: Campaign, *, simulated: bool) -> str:
        """Write campaign.json, campaign.npz, tables, the picture and identified.xml.

        Args:
            campaign: The campaign.
            simulated: True where the recordings were simulated at the true values.

        Returns:
            A warning where identified.xml could not be written; else empty.
        """
        campaign.save_archive(self.path)
        write_json(self.path / "campaign.json", self._summary(campaign, simulated=simulated))
        write_optional(REPORT, lambda: write_report(self.path, Campaign))
        if campaign.estimate is None:
            return ""

        write_tables(self.path, campaign)
        self._write_figure(campaign, simulated=simulated)
        try:
            write_identified(self.path / IDENTIFIED, self.system, campaign.estimate.theta)
        except ModelError as error:
            return str(error)
        return ""

    def _write_figure(self, campaign: Campaign, *, simulated: bool) -> None:
        """Write the picture of the campaign."""
        parameters = CampaignParameters.stated(self.system.parameters, simulated=simulated)
        pictures: Pictures = {"campaign": partial(plots.campaign_figure, campaign, parameters)}
        write_pictures(self.path, pictures, self.picture_format)

    def _summary(self, campaign: Campaign, *, simulated: bool) -> dict[str, Any]:
        """Return the contents of campaign.json."""
        return {
            **origin_of(self.system, self.path),
            **campaign.summary(),
            "simulated": simulated,
            "units": list(self.system.units),
            "true": self.system.parameters.true if simulated else None,
        }


def accuracy_sentence(estimate: Estimate, wanted: Array) -> str:
    """Return estimates of the parameters with a target accuracy: `m 2.001 ± 0.005 (wanted 0.006)`.

    Args:
        estimate: The estimate.
        wanted: (p,) standard deviations aimed at [theta-unit]; infinite where none is.
    """
    from mjfim.output.plots.style import (
        format_with_uncertainty,
    )  # imports matplotlib, which is slow

    parts = []
    for j, name in enumerate(estimate.parameters):
        if np.isfinite(wanted[j]):
            value, std = float(estimate.theta[j]), float(estimate.std[j])
            parts.append(f"{name} {format_with_uncertainty(value, std)} (wanted {wanted[j]:.3g})")
    return first_ones(parts) if parts else ""
