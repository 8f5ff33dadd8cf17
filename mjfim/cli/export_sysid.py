"""`mjfim export-sysid`: recordings for `mujoco.sysid`, and a comparison of both estimators."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import (
    ExperimentFile,
    Folder,
    Force,
    Verbose,
    claim_folder,
    errors,
    out,
    progress,
    verb,
    writing,
)
from mjfim.output.text import render


@verb
def export_sysid(
    experiment: ExperimentFile,
    recordings: Annotated[
        list[Path], typer.Argument(metavar="RECORDING", help="Logs of any format that is read.")
    ],
    output: Folder,
    verbose: Verbose = False,
    force: Force = False,
) -> None:
    """Pass recordings and parameters to mujoco.sysid, and compare its estimates with mjfim's."""
    from mjfim.experiment.input_files import input_files
    from mjfim.experiment.system import System
    from mjfim.output.folders import SYSID_FILES
    from mjfim.output.sysid import comparison as sysid_comparison
    from mjfim.output.sysid.sequences import require_extra
    from mjfim.recordings.read import read_recording, recording_paths
    from mjfim.records.events import begin_stage

    require_extra()
    system = System.resolve(mjfim.Experiment.from_file(experiment))
    inputs = input_files(system.experiment, recordings)
    claim_folder(output, SYSID_FILES, inputs, force=force)
    with progress("reading"):
        logs = recording_paths(recordings, system.channels)
        loaded = [read_recording(path, system.channels) for path in logs]

    with progress("fitting") as show:
        result = sysid_comparison.compare_with_sysid(system, loaded, show)
    summary = sysid_comparison.describe_sysid_comparison(result)
    out.print(render(summary, verbose=verbose))
    for sentence in result.warnings:
        errors.print(f"warning: {sentence}", markup=False)

    with writing(output):
        begin_stage("writing the report of mujoco.sysid")
        sysid_comparison.write_sysid_comparison(output, result)
    out.print(f"wrote {output}: comparison.json, sysid_report.html", soft_wrap=True)
