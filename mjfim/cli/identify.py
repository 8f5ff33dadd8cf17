"""`mjfim identify`: the parameters from recordings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import (
    AsJson,
    ExperimentFile,
    Folder,
    Threads,
    _say,
    errors,
    out,
    progress,
    verb,
    writing,
)
from mjfim.errors import ExperimentError
from mjfim.experiment.system import System
from mjfim.identification.identify import identify_system
from mjfim.output.folders import check_folder
from mjfim.output.summaries import describe_estimate, describe_logs
from mjfim.output.text import render
from mjfim.recordings.read import read_log
from mjfim.records.events import FitEvent


@verb
def identify(
    experiment: ExperimentFile,
    recordings: Annotated[
        list[Path], typer.Argument(metavar="RECORDING...", help="Logs of any format that is read.")
    ],
    output: Folder,
    held_out: Annotated[
        list[Path] | None,
        typer.Option(
            "--held-out",
            metavar="FILE",
            help="Log that is predicted, not fitted; may be given several times.",
        ),
    ] = None,
    method: Annotated[
        str, typer.Option(help="least_squares (with bounds) or newton (the paper's).")
    ] = "least_squares",
    as_json: AsJson = False,
    threads: Threads = None,
) -> None:
    """Estimate the parameters from recordings, and say how far that is to be trusted."""
    if method not in ("least_squares", "newton"):
        raise ExperimentError(f"--method {method!r}: valid: least_squares, newton")
    system = System.resolve(mjfim.Experiment.from_file(experiment), threads=threads)
    check_folder(output)
    with progress() as bar:
        task = bar.add_task("reading", total=None)
        loaded, kept = (
            [read_log(path, system.channels) for path in paths]
            for paths in (recordings, held_out or [])
        )
        if not as_json:
            out.print(render(describe_logs([log.summary for log in (*loaded, *kept)])))

        def show(event: FitEvent) -> None:
            text = (
                f"{event.phase}: iteration {event.iteration}, half of the squares {event.cost:.6g}, "
                f"step {event.step:.2g} σ"
            )
            bar.update(task, description=text)
            if not errors.is_terminal and event.iteration % 5 == 0:
                errors.print(text, markup=False)

        result = identify_system(
            system,
            [log.recording for log in loaded],
            method="newton" if method == "newton" else "least_squares",
            held_out=[log.recording for log in kept],
            callback=show,
        )
    with writing(output) as results:
        for sentence in results.leave_estimate(output, result, system):
            errors.print(f"warning: {sentence}", markup=False)
    _say(
        as_json,
        result.summary(),
        render(describe_estimate(result)),
    )
    errors.print(f"wrote {output}/")
    raise typer.Exit(0 if result.success and not result.misfit and not result.interrupted else 1)
