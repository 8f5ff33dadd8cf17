"""A campaign on disk: designs, recordings and estimates by round; what `sequential.py` goes on from."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from sequential_picture import figure

from mjfim.errors import ModelError, RecordingError
from mjfim.excitation.target_accuracy import target_accuracies
from mjfim.excitation.task import DesignTask
from mjfim.output.archive import check_fits, read_design, write_design
from mjfim.output.mjcf.write import write_identified
from mjfim.output.plots import style
from mjfim.output.plots.style import save
from mjfim.recordings.read import read_recording
from mjfim.records.campaign import Campaign, EarlierRound, Round
from mjfim.records.design import Design
from mjfim.records.serialization import write_json
from mjfim.studies.redesign import restated

told = Console(stderr=True, highlight=False, soft_wrap=True)


class Folder:
    """A campaign on disk. task: of the experiment as stated"""

    def __init__(self, path: Path, task: DesignTask) -> None:
        self.path, self.task = path, task
        self.rounds: list[Round] = []

    def round(self, number: int) -> Path:
        """Where a round is kept."""
        return self.path / f"round_{number}"

    def recordings(self, number: int) -> list[Path]:
        """Recordings of a round."""
        return sorted(self.round(number).glob("recording*.csv"))

    @property
    def designed(self) -> int:
        """Number of rounds that have a design."""
        return next(
            k
            for k in range(len(list(self.path.glob("round_*"))) + 1)
            if not self._has_design(k + 1)
        )

    @property
    def recorded(self) -> int:
        """Number of rounds that have recordings as well."""
        return next((k for k in range(self.designed) if not self.recordings(k + 1)), self.designed)

    def _has_design(self, number: int) -> bool:
        return all((self.round(number) / name).is_file() for name in ("design.json", "design.npz"))

    def take(self, files: Sequence[Path]) -> None:
        """Copy recordings that are not here yet to the round that waits for them."""
        known = {path.read_bytes() for k in range(self.designed) for path in self.recordings(k + 1)}
        for file in files:
            read_recording(file, self.task.system.channels)
        new = [file for file in dict.fromkeys(files) if file.read_bytes() not in known]
        waiting = self.recorded + 1
        if new and waiting > self.designed:
            raise RecordingError(
                f"{new[0]}: no design waits for a recording in {self.path}; repeat the call without it to design the next "
                "round (is it a recording of an earlier one, changed?)"
            )
        for i, file in enumerate(new):
            name = "recording.csv" if len(new) == 1 else f"recording_{i + 1}.csv"
            shutil.copyfile(file, self.round(waiting) / name)

    def done(self) -> Iterator[EarlierRound]:
        """The rounds that are recorded."""
        names = self.task.parameters.names
        for k in range(1, self.recorded + 1):
            file = self.round(k) / "design.json"
            try:
                values = json.loads(file.read_text(encoding="utf-8"))
                theta = np.array(values["theta"], dtype=np.float64)
                std = np.array(values["final"]["std"], dtype=np.float64)  # null, not alone, is NaN
                own = tuple(values["parameters"])
            except (ValueError, KeyError, TypeError):
                raise RecordingError(f"{file}: not a design.json of mjfim") from None
            if own != names or theta.shape != std.shape or len(theta) != len(names):
                raise RecordingError(
                    f"{file}: designed for {', '.join(own)}; the experiment has {', '.join(names)}"
                )
            trajectory = read_design(self.round(k) / "design.npz")["final"]
            check_fits(self.round(k) / "design.npz", trajectory, self.task.system)
            recordings = tuple(
                read_recording(path, self.task.system.channels) for path in self.recordings(k)
            )
            yield EarlierRound(
                recordings=recordings,
                theta=theta,
                predicted=np.where(np.isnan(std), np.inf, std),
                control=trajectory.ctrl,
            )

    def leave_design(self, design: Design, number: int) -> None:
        """What the robot needs."""
        last = self.rounds[-1].estimate if self.rounds else None
        made = self.task.restated(restated(self.task, design.theta, last))
        write_design(self.round(number), design, made.system)

    def report(self, now: Round) -> None:
        """Keep a round, and say what it told."""
        self.rounds.append(now)
        write_json(self.round(now.number) / "estimate.json", now.estimate.summary())
        told.print(f"round {now.number}: {described(now, self.task)}", markup=False)
        for sentence in now.warnings:
            told.print(f"  warning: {sentence}", style="yellow", markup=False)

    def leave(self, campaign: Campaign, simulated: bool) -> None:
        """campaign.json, campaign.png and identified.xml."""
        write_json(self.path / "campaign.json", summary(campaign, self.task, simulated))
        if campaign.estimate is None:
            return
        save(figure(campaign, self.task, simulated), self.path / "campaign.png")
        try:
            write_identified(
                self.path / "identified.xml", self.task.system, campaign.estimate.theta
            )
        except ModelError as error:
            told.print(f"warning: {error}", markup=False)


def described(now: Round, task: DesignTask) -> str:
    """The wanted parameters after a round."""
    aims = target_accuracies(task)
    e, parts = now.estimate, []
    for j, name in enumerate(e.parameters):
        if np.isfinite(aims[j]):
            parts.append(
                f"{name} {style.format_with_uncertainty(float(e.theta[j]), float(e.std[j]))} (wanted {aims[j]:.3g})"
            )
    return ", ".join(parts)


def summary(campaign: Campaign, task: DesignTask, simulated: bool) -> dict[str, Any]:
    """Contents of campaign.json."""
    return {
        "status": campaign.status.name.lower(),
        "message": str(campaign),
        "reached": campaign.reached,
        "simulated": simulated,
        "parameters": list(campaign.parameters),
        "units": list(task.system.units),
        "wanted": campaign.wanted,
        "true": task.parameters.true if simulated else None,
        "rounds": [
            {
                "number": r.number,
                "designed_at": r.theta,
                "predicted": r.predicted,
                "recordings": len(r.recordings),
                "theta": r.estimate.theta,
                "std": r.attained,
                "chi2": r.estimate.chi2,
                "dof": r.estimate.dof,
                "misfit": r.estimate.misfit,
                "warnings": list(r.warnings),
            }
            for r in campaign.rounds
        ],
        "warnings": list(campaign.warnings),
    }
