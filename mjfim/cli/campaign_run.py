"""The work of `mjfim campaign`: its rounds, with the folder into which they are written."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path

import mjfim
from mjfim.cli.common import errors
from mjfim.errors import ExperimentError, RecordingError
from mjfim.excitation.target_accuracy import target_accuracies
from mjfim.excitation.task import DesignTask
from mjfim.experiment.simulate import simulate_system
from mjfim.experiment.system import System
from mjfim.files import write_json
from mjfim.output.archive import write_design, write_recording
from mjfim.output.campaign_folder import (
    SETTINGS_FILE,
    CampaignFolder,
    accuracy_sentence,
    campaign_settings,
    require_same_settings,
)
from mjfim.output.picture_format import PictureFormat
from mjfim.recordings.read import read_recording
from mjfim.records.campaign import Campaign, CampaignStatus, Round
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.events import Callback, Event, StudyEvent
from mjfim.records.trajectory import Recording
from mjfim.studies.redesign import restate_experiment


class CampaignRun:
    """A campaign of the command line: its task, its folder, and the last estimate.

    Attributes:
        task: The task as stated.
        folder: The folder of the campaign.
        display: Shows the progress of designs and estimates, or None.
        executor: Does the work of designs and estimates; None for this process.
    """

    def __init__(
        self, path: Path, task: DesignTask, pictures: PictureFormat = PictureFormat.PNG
    ) -> None:
        """Prepare a campaign.

        Args:
            path: Folder of the campaign.
            task: The task as stated.
            pictures: Format of the pictures.

        Raises:
            ExperimentError: No parameter states a target accuracy.
        """
        self.task = task
        self.folder = CampaignFolder(path, task.system, pictures)
        self._wanted = target_accuracies(task)
        self.display: Callback | None = None
        self.executor: Executor | None = None
        self._estimate: Estimate | None = None

    def require_simulation(self, seed: int, *, resume: bool) -> None:
        """Check that a simulated campaign can begin, or continue.

        Args:
            seed: Seed of the simulated noise.
            resume: Whether a campaign in the folder is continued.

        Raises:
            ExperimentError: No parameter states a true value.
            RecordingError: The folder holds a campaign that is not continued, one with recordings
                of a real robot, or one that began with other settings.
        """
        experiment = self.task.experiment
        if all(spec.true is None for spec in experiment.parameters.values()):
            raise ExperimentError(
                f"{experiment.source}: no parameter states a `true` value, which the simulated "
                "robot needs; state one, or use --real"
            )
        if self.folder.has_rounds and not resume:
            raise RecordingError(
                f"{self.folder.path}: this folder holds a campaign already; choose another folder, "
                "or continue the campaign with --resume, or with --real if its recordings are "
                "those of a real robot"
            )
        if resume and self.folder.has_real_recordings:
            raise RecordingError(
                f"{self.folder.path}: the recordings of this campaign are those of a real robot, "
                "to which --resume would add simulated ones; continue it with --real"
            )
        if resume and self.folder.has_rounds:
            require_same_settings(self.folder.path, campaign_settings(experiment, seed))

    def simulated(self, rounds: int, seed: int) -> Campaign:
        """Run a campaign on a robot that is the model at its true values.

        Args:
            rounds: Largest number of rounds.
            seed: Seed of the noise of the first round; each further round adds 1.
        """

        def record(design: Design, number: int) -> Recording:
            """Simulate the recording of a round, write it, and read it as --resume does."""
            system, path = self.task.system, self.folder.round(number) / "recording.csv"
            recording = simulate_system(system, design.trajectory, seed + number - 1)
            write_recording(path, recording, system)
            return read_recording(path, system.channels)

        settings = campaign_settings(self.task.experiment, seed)

        def measure(design: Design, number: int) -> Recording:
            """Write the design of a round, and simulate its recording."""
            # A call that continues the campaign needs the settings as soon as there is a round.
            if not self.folder.has_rounds:
                write_json(self.folder.path / SETTINGS_FILE, settings)
            self._write_design(design, number)
            return record(design, number)

        # The campaign in the folder may have ended between a design and its recording.
        for number in self.folder.unrecorded_rounds():
            record(Design.load(self.folder.round(number)), number)

        return mjfim.run_campaign(
            self.task.experiment,
            measure,
            rounds=rounds,
            threads=self.task.system.threads,
            callback=self._finish_round,
            executor=self.executor,
            done=list(self.folder.recorded_rounds()),
        )

    def real(self, rounds: int, files: Sequence[Path]) -> Campaign:
        """Identify from all recordings so far, and design the next round.

        Args:
            rounds: Largest number of rounds.
            files: Recordings of the last design; files that are known already are left out.

        Raises:
            RecordingError: A file cannot be read, or no round waits for it.
        """
        self.folder.add_recordings(files)
        done = list(self.folder.recorded_rounds())
        is_waiting = self.folder.designed > self.folder.recorded

        # While the first design is not recorded, there is no data to identify from.
        if is_waiting and not done:
            return Campaign(
                parameters=self.task.parameters.names,
                wanted=self._wanted,
                rounds=(),
                status=CampaignStatus.WAITING,
            )

        def measure(design: Design, number: int) -> None:
            """Write the design of a round, which ends this call."""
            self._write_design(design, number)

        # While a design is not recorded, no further design is made.
        limit = len(done) if is_waiting else rounds
        found = mjfim.run_campaign(
            self.task.experiment,
            measure,
            rounds=limit,
            threads=self.task.system.threads,
            callback=self._finish_round,
            executor=self.executor,
            done=done,
        )
        if is_waiting and found.status is CampaignStatus.EXHAUSTED and len(done) < rounds:
            return replace(found, status=CampaignStatus.WAITING)
        return found

    def _write_design(self, design: Design, number: int) -> None:
        """Write the design of a round, and the experiment with which it was made."""
        experiment = restate_experiment(self.task, design.theta, self._estimate)
        system = self.task.restated(experiment).system
        write_design(self.folder.round(number), design, system)

    def _finish_round(self, event: Event) -> None:
        """Show the progress, and write and print the estimate of a complete round."""
        if self.display is not None:
            self.display(event)
        if not isinstance(event, StudyEvent) or not isinstance(event.result, Round):
            return

        finished = event.result
        self._estimate = finished.estimate
        finished.estimate.save(self.folder.round(finished.number))
        sentence = accuracy_sentence(finished.estimate, self._wanted)
        errors.print(f"round {finished.number}: {sentence}", markup=False)
        for warning in finished.warnings:
            errors.print(f"  warning: {warning}", style="yellow", markup=False)


def with_target_accuracies(experiment: mjfim.Experiment, share: float | None) -> mjfim.Experiment:
    """Return the experiment with a target accuracy for every parameter that states none.

    Args:
        experiment: The experiment.
        share: Target accuracy as a fraction of the guess; None leaves the experiment unchanged.
    """
    if share is None:
        return experiment

    parameters = System.resolve(experiment).parameters
    tables = {}
    for name, guess in zip(parameters.names, parameters.guess.tolist(), strict=True):
        spec = experiment.parameters.get(name)
        if spec is None or spec.wanted is not None or spec.inertial is not None:
            continue
        if guess and not spec.nuisance:
            tables[name] = {"wanted": share * abs(guess)}
    return experiment.replace(parameters=tables)
