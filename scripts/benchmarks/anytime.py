"""J against seconds: the design beside its baselines at every budget, as a table.

    python -m scripts.benchmarks anytime FOLDER [--seconds 2 3 5 10]
    [--examples cart_pendulum_limits]
    python -m scripts.benchmarks anytime FOLDER --show        # the results in FOLDER

Each method runs anew for each budget, in one thread, because a search plans with its budget. The
seconds are those of the processor, so that the table is nearly the same on a busy machine. Results
are kept in FOLDER as JSON, and those that are there already are not computed again.

The exit code is 1 where a baseline is better than the design at any budget.
"""

from __future__ import annotations

import time
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

import mjfim
from mjfim.errors import MjfimError
from mjfim.experiment.schema import Experiment
from mjfim.parallel.budget import measured_by
from mjfim.records.studies import DESIGN
from scripts.benchmarks.child import ROOT, kept, new_table, options_of

# Baselines that run without further wishes: the best ones of the whole list.
METHODS = ("multisine", "fourier5", "fourier15", "splines")

# Relative difference of two costs below which they count as equal.
TIE = 1e-3


def compute(path: Path, seconds: float) -> list[dict[str, Any]] | None:
    """Run all methods on an example with one budget.

    Args:
        path: Experiment file.
        seconds: Budget of every method [s of the processor].

    Returns:
        J of each method on the unmodified model, infinite where no control keeps the limits, and
        the time that it took [s]; None where the example cannot be designed.
    """
    # Known optima are those of a free end.
    experiment = Experiment.from_file(path).replace(boundary={"end": "free"})
    try:
        with measured_by(time.process_time):
            found = mjfim.compare(experiment, seconds=seconds, methods=METHODS, threads=1)
    except MjfimError as error:
        print(f"{path.stem}: {error}")
        return None
    rows = []
    for row in found.rows:
        cost = row.cost if row.sound else np.inf
        told = f"{row.method} {cost:.6g} ({row.seconds:.1f} s)"
        print(f"{path.stem}, {seconds:g} s: {told}", flush=True)
        rows.append({"method": row.method, "cost": cost, "used": row.seconds})
    return rows


def main() -> int:
    """Run what is missing and print the table; 1 if a baseline is better."""
    parser = options_of(__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", nargs="+", type=float, default=[2.0, 3.0, 5.0, 10.0])
    parser.add_argument("--examples", nargs="*", help="names of examples; default: all")
    parser.add_argument("--show", action="store_true", help="only show the results in the folder")
    args = parser.parse_args()

    title = "J within the same seconds of the processor, one thread"
    headings = [f"{seconds:g} s" for seconds in args.seconds]
    table = new_table(title, "experiment", "method", *headings, texts=2)
    tried: list[tuple[float, str, bool]] = []
    for path in sorted((ROOT / "models").glob("*.toml")):
        if args.examples is not None and path.stem not in args.examples:
            continue
        mine, theirs = [], []
        for seconds in args.seconds:
            rows = kept(
                args.folder / f"{path.stem}_{seconds:g}s.json",
                partial(compute, path, seconds),
                is_shown=args.show,
            )
            costs = {row["method"]: row["cost"] for row in rows or ()}
            own = costs.pop(DESIGN, np.inf)
            best, method = min(((J, method) for method, J in costs.items()), default=(np.inf, ""))
            is_beaten = best < (own - TIE * abs(own) if np.isfinite(own) else own)
            tried += [(seconds, path.stem, is_beaten)] * (rows is not None)
            mine.append(f"{own:.5g}{' [red]beaten[/red]' if is_beaten else ''}")
            theirs.append(f"{best:.5g} {method}")
        if tried and tried[-1][1] == path.stem:
            table.add_row(path.stem, "design", *mine)
            table.add_row("", "best baseline", *theirs)
            table.add_section()

    Console(highlight=False, width=60 + 24 * len(args.seconds)).print(table)
    for seconds in args.seconds:
        group = {name: is_beaten for budget, name, is_beaten in tried if budget == seconds}
        losses = [name for name, is_beaten in group.items() if is_beaten]
        wins = len(group) - len(losses)
        sentence = f"{seconds:g} s: the design is best in {wins} of {len(group)}"
        print(f"{sentence}; a baseline wins in {', '.join(losses)}" if losses else sentence)
    return int(not tried or any(is_beaten for *_, is_beaten in tried))
