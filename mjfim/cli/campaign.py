"""`mjfim campaign`: rounds of design, recording and estimate until all targets are reached."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import mjfim
from mjfim.cli.common import ExperimentFile, Run, print_result, say_written, verb, writing
from mjfim.cli.progress import ProgressDisplay, progress, say
from mjfim.errors import ExperimentError, RecordingError

if TYPE_CHECKING:
    from mjfim.excitation.task import DesignTask
    from mjfim.output.campaign_folder import CampaignFolder
    from mjfim.records.events import Event


@verb(without=("as_json",))
def campaign(
    experiment: ExperimentFile,
    run: Run,
    rounds: Annotated[int, typer.Option(min=1, help="Largest number of rounds.")] = 10,
    wanted: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE",
            help="Target accuracy of parameters that state none, as a fraction of the guess.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the simulated noise.")] = 0,
    real: Annotated[
        bool, typer.Option("--real", help="Record on a real robot, one round per call.")
    ] = False,
    recordings: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="Recording of the last design; may be given several times; implies --real.",
        ),
    ] = None,
    resume: Annotated[
        bool,
        typer.Option(
            "--resume",
            help="Continue a simulated campaign, with its settings, after its last complete round.",
        ),
    ] = False,
) -> int:
    """Repeat design, recording and estimate until every target accuracy is reached.

    Without --real, the robot is simulated at the `true` values. With --real, each call estimates
    the parameters from all recordings so far and writes the design of the next round into
    DIR/round_K/. Then play its design.csv on the robot, and call again with --recordings.

    A simulated campaign that was stopped or killed is continued with --resume.
    """
    stated = mjfim.Experiment.from_file(experiment)

    from mjfim.excitation.task import DesignTask
    from mjfim.experiment.packing import with_model
    from mjfim.output.campaign_folder import CampaignFolder, campaign_settings
    from mjfim.output.pages.studies import campaign_page
    from mjfim.records.studies import CampaignStatus

    stated = with_target_accuracies(with_model(stated), wanted)
    task = DesignTask.resolve(stated, threads=run.threads)
    folder = CampaignFolder(run.output, task.system, run.pictures)
    simulated = not (real or recordings)
    settings = campaign_settings(task.experiment, seed) if simulated else {}
    if simulated:
        _require_simulation(folder, task.experiment, settings, resume=resume)
    names = folder.next_files(simulated=simulated)
    run.claim(mjfim.Campaign, task.experiment, recordings or (), names)

    with run.workers() as workers, progress("designing") as display:
        lab = _Lab(task=task, folder=folder, display=display, rounds=rounds)
        if simulated:
            # The campaign in the folder may have ended between a design and its recording.
            for number in range(1, folder.designed + 1):
                if not folder.recordings(number):
                    lab.record(mjfim.Design.load(folder.round(number)), number, seed)
        else:
            folder.add_recordings(recordings or [])

        def measure(design: mjfim.Design, number: int) -> mjfim.Recording | None:
            """Write the design of a round; simulate its recording, or let the user record it."""
            lab.write(design, number, settings)
            return lab.record(design, number, seed) if simulated else None

        found = lab.campaign(measure, workers)

    true = task.parameters.true if simulated else None
    with writing(run.output):
        remarks = folder.write_campaign(found, simulated=simulated)
    page = campaign_page(found, true)
    print_result(False, {}, page, verbose=run.verbose)
    for remark in remarks:
        say(f"warning: {remark}")
    if found.status is CampaignStatus.WAITING:
        say(
            f"next: play {folder.round(folder.designed)}/design.csv on the robot and record it, "
            "then repeat this call with --recordings FILE.csv"
        )
    say_written(run.output)
    return 0 if page.verdict.ok else 1


@dataclass(kw_only=True)
class _Lab:
    """Folder and state of the rounds of a campaign.

    Attributes:
        task: The task as stated.
        folder: The folder of the campaign.
        display: Display of progress.
        rounds: Largest number of rounds.
        estimate: Estimate of the last complete round.
    """

    task: DesignTask
    folder: CampaignFolder
    display: ProgressDisplay
    rounds: int
    estimate: mjfim.Estimate | None = None

    def campaign(self, measure: Any, workers: Any) -> mjfim.Campaign:
        """Identify from the recordings in the folder, and make the further rounds."""
        from mjfim.excitation.shortest_horizon import target_accuracies
        from mjfim.records.studies import CampaignStatus

        done = list(self.folder.recorded_rounds())
        self._begin_round(len(done))
        is_waiting = self.folder.designed > self.folder.recorded
        # While the first design is not recorded, there is no data to identify from.
        if is_waiting and not done:
            return mjfim.Campaign(
                parameters=self.task.parameters.names,
                wanted=target_accuracies(self.task),
                rounds=(),
                status=CampaignStatus.WAITING,
            )

        # While a design is not recorded, no further design is made.
        found = mjfim.run_campaign(
            self.task.experiment,
            measure,
            rounds=len(done) if is_waiting else self.rounds,
            threads=self.task.system.threads,
            callback=self._show,
            executor=workers,
            done=done,
        )
        if is_waiting and found.status is CampaignStatus.EXHAUSTED and len(done) < self.rounds:
            return replace(found, status=CampaignStatus.WAITING)
        return found

    def write(self, design: mjfim.Design, number: int, settings: dict[str, Any]) -> None:
        """Write the design of a round, and the experiment with which it was made."""
        from mjfim.files import write_json
        from mjfim.output.archive import write_data
        from mjfim.output.folders import SETTINGS_FILE
        from mjfim.studies.campaign import restate_experiment

        # A call that continues the campaign needs the settings as soon as there is a round.
        if settings and not self.folder.has_rounds:
            write_json(self.folder.path / SETTINGS_FILE, settings)
        experiment = restate_experiment(self.task, design.theta, self.estimate)
        write_data(self.folder.round(number), design, self.task.restated(experiment).system)

    def record(self, design: mjfim.Design, number: int, seed: int) -> mjfim.Recording:
        """Simulate the recording of a round, write it, and read it as --resume does."""
        from mjfim.experiment.system import simulate_system
        from mjfim.output.archive import write_recording
        from mjfim.recordings.read import read_recording

        system, path = self.task.system, self.folder.round(number) / "recording.csv"
        recording = simulate_system(system, design.trajectory, seed + number - 1)
        write_recording(path, recording, system)
        return read_recording(path, system.channels)

    def _show(self, event: Event) -> None:
        """Show the progress, and write and print the estimate of a complete round."""
        from mjfim.excitation.shortest_horizon import target_accuracies
        from mjfim.output.campaign_folder import accuracy_sentence
        from mjfim.records.studies import Round

        finished = getattr(event, "result", None)
        if not isinstance(finished, Round):
            self.display(event)
            return

        self._begin_round(finished.number)
        self.estimate = finished.estimate
        finished.estimate.save(self.folder.round(finished.number))
        sentence = accuracy_sentence(finished.estimate, target_accuracies(self.task))
        say(f"round {finished.number}: {sentence}")
        for warning in finished.warnings:
            say(f"  warning: {warning}")

    def _begin_round(self, done: int) -> None:
        """Name the round that begins."""
        self.display.heading = f"round {min(done + 1, self.rounds)} of at most {self.rounds}"


def _require_simulation(
    folder: CampaignFolder,
    experiment: mjfim.Experiment,
    settings: dict[str, Any],
    *,
    resume: bool,
) -> None:
    """Check that a simulated campaign can begin, or continue with the settings of its begin."""
    from mjfim.output.campaign_folder import require_same_settings

    if all(spec.true is None for spec in experiment.parameters.values()):
        raise ExperimentError(
            f"{experiment.source}: no parameter states a `true` value, which the simulated robot "
            "needs; state one, or use --real"
        )
    if folder.has_rounds and not resume:
        raise RecordingError(
            f"{folder.path}: this folder holds a campaign already; choose another folder, or "
            "continue the campaign with --resume, or with --real if its recordings are those of a "
            "real robot"
        )
    if resume and folder.has_real_recordings:
        raise RecordingError(
            f"{folder.path}: the recordings of this campaign are those of a real robot, to which "
            "--resume would add simulated ones; continue it with --real"
        )
    if resume and folder.has_rounds:
        require_same_settings(folder.path, settings)


def with_target_accuracies(experiment: mjfim.Experiment, share: float | None) -> mjfim.Experiment:
    """Return the experiment with a target accuracy for every parameter that states none.

    Args:
        experiment: The experiment.
        share: Target accuracy as a fraction of the guess; None leaves the experiment unchanged.
    """
    from mjfim.experiment.system import System

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
