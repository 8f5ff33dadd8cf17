"""`mjfim list` and `mjfim validate`: what a model offers, and what an experiment file states."""

from __future__ import annotations

import json
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated, Literal

import typer

import mjfim
from mjfim.cli.common import AsJson, ModelFile, Verbose, print_result, verb
from mjfim.errors import ExperimentError

# Kinds of entries, as in `mjfim.records.inventory.KINDS`.
Kind = Literal["parameters", "outputs", "actuators", "keyframes", "limits", "terms"]


@verb()
def list_(
    model: ModelFile,
    wanted: Annotated[
        str | None,
        typer.Argument(
            metavar="PATTERN",
            help="Part of the paths and names that are wanted, `damping` for example; * and ? "
            "stand for any characters.",
        ),
    ] = None,
    kind: Annotated[
        Kind | None, typer.Option("--kind", help="List only entries of this kind.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """List the parameters, outputs, actuators, keyframes, limits and terms of a model."""
    from mjfim.output.pages.files import inventory_page
    from mjfim.studies.inventory import list_model

    inventory = list_model(model)
    if kind is not None:
        inventory = inventory.only(kind)

    if wanted is not None:
        # Brackets are no part of the pattern's syntax.
        pattern = f"*{wanted.lower()}*".replace("[", "[[]")
        inventory = inventory.selected(lambda name: fnmatchcase(name.lower(), pattern))
        if not inventory.count:
            raise ExperimentError(
                f"{model}: no path or name contains {wanted!r}; `mjfim list {model}` lists all"
            )

    # The user asked for these entries, so the page leaves none out.
    print_result(as_json, inventory.summary(), inventory_page(inventory), verbose=True)


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
