"""`mjfim init`: a first experiment file for a model."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mjfim.cli.common import Force, ModelFile, claim_file, verb
from mjfim.cli.progress import out, progress, say
from mjfim.errors import ExperimentError
from mjfim.files import replacing
from mjfim.studies import GROUPS

if TYPE_CHECKING:
    from mjfim.studies.first_candidates import Wishes
    from mjfim.studies.first_experiment import Proposal


@verb()
def init(
    model: ModelFile,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            metavar="EXPERIMENT.toml",
            help="Experiment file to write; default: the model's name with .toml, in this folder.",
        ),
    ] = None,
    parameters: Annotated[
        str,
        typer.Option(
            metavar="GROUPS",
            help="Groups of parameters to propose, separated by commas: payload, friction, "
            "inertia, motors; with --log also servos: the laws of position servos.",
        ),
    ] = ",".join(GROUPS),
    payload: Annotated[
        str | None,
        typer.Option(metavar="BODY", help="Body that carries a load of unknown mass and place."),
    ] = None,
    package: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=DIR",
            help="Folder of a ROS package whose meshes a URDF names by package://; repeatable. "
            "Others are found in ROS_PACKAGE_PATH and in the folders above the URDF.",
        ),
    ] = None,
    ask: Annotated[
        bool,
        typer.Option(
            "--ask",
            help="Ask for the start, the parameters, rate, duration and noise. Enter takes what is "
            "proposed; answers may come from a file or a pipe, one a line.",
        ),
    ] = False,
    log: Annotated[
        Path | None,
        typer.Option(
            metavar="LOG",
            help="Log of another program; its columns are proposed as the table [recording].",
        ),
    ] = None,
    force: Force = False,
) -> None:
    """Write a first experiment file for a model, with a comment for every choice."""
    from dataclasses import replace

    import numpy as np

    from mjfim.cli.questions import ask as ask_for
    from mjfim.experiment.schema import Experiment
    from mjfim.experiment.system import System
    from mjfim.model.given import packed
    from mjfim.model.model_files import is_urdf
    from mjfim.recordings.formats import read_columns
    from mjfim.recordings.proposal import log_time, proposed_recording
    from mjfim.recordings.read import recording_paths
    from mjfim.recordings.section import RecordingSpec
    from mjfim.studies.first_candidates import Wishes, groups_of
    from mjfim.studies.first_experiment import experiment_text, propose_experiment

    model = Path(packed(str(model), Path())[0])
    file = output or Path(f"{model.stem}.toml")
    companion = file.with_name(f"{file.stem}_motors.xml")
    packages = {}
    for name, _, place in (each.partition("=") for each in package or ()):
        if not Path(place).is_dir() or not place:
            raise ExperimentError(f"--package: needs NAME=DIR with a folder, not {name}={place}")
        packages[name] = str(Path(place).resolve())
    table, row = None, None
    if log is not None:
        table = read_columns(recording_paths([log], RecordingSpec())[0], RecordingSpec())
        steps = np.diff(log_time(table)[1])
        rising = steps[steps > 0.0]
        row = float(np.median(rising)) if len(rising) else None
    wishes = Wishes(groups=groups_of(parameters), payload=payload, packages=packages, row=row)
    claim_file(file, [model], force=force)
    if is_urdf(model):
        claim_file(companion, [model], force=force)

    def propose(wanted: Wishes) -> Proposal:
        """The experiment that fulfils some wishes."""
        with progress("looking at the model"):
            return propose_experiment(model, file.parent, wanted, companion_name=companion.name)

    proposal = propose(ask_for(propose, wishes) if ask else wishes)
    text = experiment_text(proposal)
    if table is not None:
        experiment = Experiment(**proposal.values(), directory=file.parent)
        channels = System.resolve(experiment, source=proposal.source).channels
        # What servos of the MJCF take, a log holds in either case.
        found = proposed_recording(table, replace(channels, model=proposal.compiled))
        text += f"\n# Read {table.source.name}: check what was guessed.\n{found}\n"

    if proposal.companion is not None:
        with replacing(companion) as temporary:
            temporary.write_text(proposal.companion, encoding="utf-8")
        say(f"wrote {companion}")
    with replacing(file) as temporary:
        temporary.write_text(text, encoding="utf-8")

    say(f"wrote {file}")
    for remark in proposal.remarks:
        say(remark)
    after = f"check {file}" if log is None else f"identify {file} {log}"
    out.print(f"next: mjfim {after}", soft_wrap=True)
