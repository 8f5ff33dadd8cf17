"""`mjfim validate`: whether an experiment file is correct, without simulating a motion."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import AsJson, Verbose, print_result, verb
from mjfim.errors import ExperimentError


@verb()
def validate(
    experiment: Annotated[
        Path | None, typer.Argument(metavar="EXPERIMENT", help="Experiment file (TOML).")
    ] = None,
    schema: Annotated[
        bool,
        typer.Option("--schema", help="Print the JSON schema of experiment files, for editors."),
    ] = False,
    as_json: AsJson = False,
    verbose: Verbose = False,
) -> None:
    """Say whether an experiment file is correct, and what it states."""
    if schema:
        from mjfim.experiment.schema import json_schema

        typer.echo(json.dumps(json_schema(), indent=2, ensure_ascii=False))
        return
    if experiment is None:
        raise ExperimentError("validate needs an experiment file, or --schema")
    read = mjfim.Experiment.from_file(experiment)

    from mjfim.output.pages.files import experiment_page
    from mjfim.studies.inventory import stated_experiment

    stated = stated_experiment(read)
    print_result(as_json, stated.summary(), experiment_page(stated), verbose=verbose)
