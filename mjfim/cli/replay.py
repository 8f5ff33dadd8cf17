"""`mjfim replay`: display of results in the Rerun viewer."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import ExperimentOfDesign, Force, claim_file, verb
from mjfim.cli.progress import say
from mjfim.errors import RecordingError
from mjfim.files import replacing


@verb()
def replay(
    source: Annotated[
        Path, typer.Argument(metavar="DIR | FILE.rrd | DESIGN.npz", help="What to show.")
    ],
    save: Annotated[
        Path | None,
        typer.Option(metavar="FILE.rrd", help="Write a file instead of opening the viewer."),
    ] = None,
    experiment: ExperimentOfDesign = None,
    force: Force = False,
) -> None:
    """Show a result in the Rerun viewer."""
    from mjfim.experiment.given import check_fits
    from mjfim.experiment.system import System, labels_of_system
    from mjfim.output import archive
    from mjfim.output import rerun as rerun_log
    from mjfim.output.folders import find_experiment_file, find_rerun_file

    if save is not None and save.suffix != ".rrd":
        raise RecordingError(f"--save {save}: a Rerun file ends in .rrd")
    target = save or Path(tempfile.mkdtemp(prefix="mjfim-")) / "replay.rrd"
    if save is not None:
        inputs = sorted(source.iterdir()) if source.is_dir() else [source]
        claim_file(save, inputs, force=force)
    if source.suffix == ".npz":
        stated = experiment or find_experiment_file(source)
        system = System.resolve(mjfim.Experiment.from_file(stated))
        named = archive.read_design(source)
        for trajectory in named.values():
            check_fits(source, trajectory, system)
        rerun_log.log_trajectories(
            target, system.model_at(system.theta), named, labels_of_system(system)
        )
    else:
        found = find_rerun_file(source)
        if save is not None:
            with replacing(save) as temporary:
                shutil.copyfile(found, temporary)
        target = save or found
    if save is None:
        rerun_log.show(target)
    else:
        say(f"wrote {target}")
