"""What the verbs share: the app, argument types, progress on stderr, exit codes."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

import mjfim
from mjfim.errors import MjfimError, NoResultError
from mjfim.records.serialization import as_json as records_as_json

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Design the experiment that identifies a MuJoCo model's parameters, then identify them.",
)


errors = Console(stderr=True, highlight=False, soft_wrap=True)


out = Console(highlight=False, width=None if sys.stdout.isatty() else 110)


ExperimentFile = Annotated[
    Path, typer.Argument(metavar="EXPERIMENT", help="Experiment file (TOML).")
]
DesignFile = Annotated[
    Path, typer.Argument(metavar="DESIGN.npz", help="design.npz that `mjfim design` left.")
]
Folder = Annotated[
    Path,
    typer.Option("--output", "-o", metavar="DIR", help="Folder for the results, made if absent."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the summary to stdout as JSON.")]
Threads = Annotated[int | None, typer.Option(min=1, help="Threads for MuJoCo; default: all cores.")]


class Unfinished(Exception):
    """Ctrl-C while results were being written; says where."""


@contextmanager
def writing(folder: Path) -> Iterator[ModuleType]:
    """Make the folder and bring what writes into it; an interruption in here is not one before any result."""
    from mjfim.output import folders as results  # brings matplotlib and rerun

    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield results
    except KeyboardInterrupt:
        raise Unfinished(str(folder)) from None


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(mjfim.__version__)
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Design the experiment that identifies a MuJoCo model's parameters, then identify them."""


def interrupted_without_result() -> typer.Exit:
    """Say that there is nothing to write, and return the exit that says so to the shell."""
    errors.print("mjfim: interrupted before there was a result; nothing was written")
    return typer.Exit(1)


def verb(function: Callable[..., None]) -> Callable[..., None]:
    """Turn misuse into one message and exit code 2, and Ctrl-C before any result into exit code 1."""

    @functools.wraps(function)
    def wrapped(*args: Any, **kwargs: Any) -> None:
        try:
            function(*args, **kwargs)
        except NoResultError:
            raise interrupted_without_result() from None
        except MjfimError as error:
            errors.print(f"mjfim: {error}", markup=False)
            raise typer.Exit(2) from None
        except OSError as error:
            errors.print(
                f"mjfim: {error.filename or 'cannot write'}: {error.strerror or error}",
                markup=False,
            )
            raise typer.Exit(1) from None
        except Unfinished as unfinished:
            errors.print(
                f"mjfim: interrupted; {unfinished}/ holds some of the results, each file complete",
                markup=False,
            )
            raise typer.Exit(1) from None
        except KeyboardInterrupt:
            raise interrupted_without_result() from None

    app.command(function.__name__.replace("_", "-"))(wrapped)
    return wrapped


@contextmanager
def progress() -> Iterator[Progress]:
    """A transient progress display on stderr; silent where stderr is not a terminal."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal) as bar:
        yield bar


def _say(as_json: bool, summary: dict[str, Any], text: Any) -> None:
    if as_json:
        typer.echo(records_as_json(summary), nl=False)
    else:
        out.print(text)
