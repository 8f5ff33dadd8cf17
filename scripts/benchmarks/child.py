"""What several benchmarks need: options, studies of many runs, tables, kept results."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from rich.progress import track
from rich.table import Table

from mjfim.arrays import Array
from mjfim.files import write_json
from mjfim.parallel import cores

# Top folder of the repository, and the folder with the models and the data of others beside it.
ROOT = Path(__file__).resolve().parents[2]
SHARED = ROOT.parent / "shared"

# What one run of a study found, by name; and a cell of a table about several of them.
Outcome = Mapping[str, Any]
Cell = Callable[[Sequence[Outcome]], str]


def options_of(description: str | None, runs: int = 0) -> argparse.ArgumentParser:
    """Parser of the options of a benchmark, whose help is the docstring of its module.

    Args:
        description: The docstring.
        runs: Number of runs of a study, which has the options that all studies have; 0 for none.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if runs:
        parser.add_argument("--runs", type=int, default=runs, help="number of runs")
        parser.add_argument("--seed", type=int, default=0)
        parser.add_argument("--processes", type=int, default=cores(), help="runs side by side")
        parser.add_argument("-o", "--output", type=Path, help="JSON file with all outcomes")
    return parser


def with_paths(parser: argparse.ArgumentParser) -> argparse.Namespace:
    """Parsed arguments with data, model in MJCF, and the folder of the output, which is made."""
    parser.add_argument("paths", type=Path, nargs=3, help="data, model in MJCF, output")
    args = parser.parse_args()
    args.paths[-1].mkdir(parents=True, exist_ok=True)
    return args


def write_log(path: Path, names: Sequence[str], *columns: ArrayLike, form: str = "%.6f") -> None:
    """Write a CSV file, whose columns may be arrays of several."""
    rows = np.column_stack(columns)
    np.savetxt(path, rows, form, delimiter=",", header=",".join(names), comments="")


def overlap(first: Array, second: Array) -> Array:
    """Whether (..., 2) intervals overlap."""
    lower, upper = np.maximum(first, second)[..., 0], np.minimum(first, second)[..., 1]
    return np.asarray(lower <= upper)


def study(
    run: Callable[..., Any],
    jobs: Sequence[tuple[Any, ...]],
    processes: int,
    output: Path | None = None,
) -> list[Any]:
    """Results of a function for all jobs, in their order, with a bar of progress.

    Args:
        run: Function at the top of a module.
        jobs: Its arguments for each job.
        processes: Number of jobs side by side.
        output: JSON file that is written anew after each job, so that a study may be stopped.
    """
    found = []
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        results = pool.map(run, *zip(*jobs, strict=True))
        for outcome in track(results, "runs", total=len(jobs)):
            found.append(outcome)
            if output is not None:
                write_json(output, {"runs": found})
    return found


def new_table(title: str, *headings: str, texts: int = 1) -> Table:
    """Make an empty table.

    Args:
        title: Its title.
        *headings: Headings of the columns.
        texts: Number of the first columns, which hold text; the others hold numbers.
    """
    table = Table(title=title, title_justify="left")
    for i, heading in enumerate(headings):
        table.add_column(heading, justify="left" if i < texts else "right")
    return table


def table_of(
    title: str,
    outcomes: Sequence[Outcome],
    keys: Sequence[str],
    columns: Mapping[str, Cell],
    *,
    has_all: bool = False,
) -> Table:
    """Table with a row for each group of outcomes in which some texts are equal.

    Args:
        title: Title of the table.
        outcomes: The outcomes.
        keys: Names of the texts.
        columns: Cells about a group, by the heading of their column.
        has_all: Whether a last row is about all outcomes.
    """
    table = new_table(title, *keys, "runs", *columns, texts=len(keys))
    groups: dict[tuple[str, ...], list[Outcome]] = {}
    for outcome in outcomes:
        groups.setdefault(tuple(outcome[key] for key in keys), []).append(outcome)
    if has_all:
        groups["all", *[""] * (len(keys) - 1)] = list(outcomes)
    for texts, group in groups.items():
        cells = [cell(group) for cell in columns.values()]
        table.add_row(*texts, str(len(group)), *cells)
    return table


def values_of(outcomes: Sequence[Outcome], key: str) -> Array:
    """All values of a name, which has one or several in each outcome."""
    return np.concatenate([np.zeros(0), *(np.atleast_1d(each[key]) for each in outcomes)])


def share(outcomes: Sequence[Outcome], key: str) -> float:
    """Mean of all values of a name; NaN of none."""
    values = values_of(outcomes, key)
    return float(values.mean()) if values.size else float("nan")


def percent(key: str) -> Cell:
    """The mean of all values in percent, `-` of none."""

    def cell(group: Sequence[Outcome]) -> str:
        mean = share(group, key)
        return "-" if np.isnan(mean) else f"{100.0 * mean:.0f} %"

    return cell


def median(key: str, form: str = ".0f") -> Cell:
    """The median of all values."""
    return lambda group: f"{np.median(values_of(group, key)):{form}}"


def rms(values: Array, axis: int | None = None) -> Array:
    """Root mean square of all values, or along an axis."""
    return np.asarray(np.sqrt(np.mean(values**2, axis=axis)))


def kept(file: Path, compute: Callable[[], Any], *, is_shown: bool) -> Any:
    """What a JSON file holds, which is computed first where the file is absent.

    Args:
        file: The file.
        compute: Computes it; None for nothing.
        is_shown: Whether nothing is computed.

    Returns:
        None where there is nothing.
    """
    found = None if is_shown or file.is_file() else compute()
    if found is not None:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps(found), encoding="utf-8")
    return json.loads(file.read_text(encoding="utf-8")) if file.is_file() else None
