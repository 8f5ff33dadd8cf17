"""J against seconds: the design beside its baselines at every budget, as a table.

    python -m scripts.benchmarks anytime FOLDER [--seconds 2 3 5 10]
    [--examples cart_pendulum_limits] [--methods fourier5 fourier15]
    python -m scripts.benchmarks anytime FOLDER --show        # the results in FOLDER

Each method runs anew for each budget, in one thread, because a search plans with its budget. The
seconds are those of the processor, so that the table is nearly the same on a busy machine. Results
are kept in FOLDER as JSON, and those that are there already are not computed again.

The exit code is 1 where a baseline is better than the design at any budget.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import mjfim
from mjfim.arrays import record
from mjfim.errors import MjfimError
from mjfim.experiment.schema import Experiment
from mjfim.parallel.budget import measured_by, stop_on_interrupt
from mjfim.records.studies import DESIGN
from mjfim.studies.baselines import TITLES
from scripts.benchmarks.child import ROOT, new_table, options_of

# Folder of the examples.
EXAMPLES = ROOT / "models"

# Budgets of every method [s of the processor].
SECONDS = (2.0, 3.0, 5.0, 10.0)

# Baselines that run without further wishes: the best ones of the whole list.
METHODS = ("multisine", "fourier5", "fourier15", "splines")

# Relative difference of two costs below which they count as equal.
TIE = 1e-3


@record
class Found:
    """Result of one method within one budget.

    Attributes:
        case: Name of the experiment.
        method: Key of the method.
        seconds: Its budget [s of the processor].
        cost: J on the unmodified model; infinite where no control keeps the limits.
        used: Time that it took [s of the processor].
        steps: Engine steps that it took.
        found_by: Name of the start or attempt that led to the control.
    """

    case: str
    method: str
    seconds: float
    cost: float
    used: float
    steps: int
    found_by: str


def examples(names: list[str] | None) -> Iterator[tuple[str, Experiment]]:
    """Yield the shipped examples whose control can be designed, by their names."""
    for path in sorted(EXAMPLES.glob("*.toml")):
        if names is None or path.stem in names:
            # Known optima are those of a free end.
            yield path.stem, Experiment.from_file(path).replace(boundary={"end": "free"})


def run(case: str, experiment: Experiment, seconds: float, methods: list[str]) -> list[Found]:
    """Run all methods on one experiment with one budget.

    Args:
        case: Name of the experiment.
        experiment: The experiment.
        seconds: Budget of every method [s of the processor].
        methods: Keys of the baselines.

    Returns:
        What each method found, the design last.
    """
    with measured_by(time.process_time):
        found = mjfim.compare(experiment, seconds=seconds, methods=methods, threads=1)

    return [
        Found(
            case=case,
            method=row.method,
            seconds=seconds,
            cost=row.cost if row.sound else np.inf,
            used=row.seconds,
            steps=row.steps,
            found_by=row.found_by,
        )
        for row in found.rows
    ]


class Results:
    """All results of one experiment.

    Args:
        case: Name of the experiment.
        rows: What each method found within each budget.
    """

    def __init__(self, case: str, rows: list[Found]) -> None:
        self.case = case
        self.rows = rows

    @property
    def budgets(self) -> list[float]:
        """All budgets [s], ascending."""
        return sorted({row.seconds for row in self.rows})

    @property
    def methods(self) -> list[str]:
        """Keys of all methods, the design last."""
        return list(dict.fromkeys(row.method for row in self.rows))

    def cost(self, method: str, seconds: float) -> float:
        """J of a method with a budget [s]; infinite where it found nothing."""
        rows = (row for row in self.rows if row.method == method and row.seconds == seconds)
        return min((row.cost for row in rows), default=np.inf)

    def best_baseline(self, seconds: float) -> tuple[float, str]:
        """The lowest J of all baselines with a budget [s], and the key of the baseline."""
        others = [method for method in self.methods if method != DESIGN]
        costs = [(self.cost(method, seconds), method) for method in others]
        return min(costs, default=(np.inf, ""))

    def is_beaten(self, seconds: float) -> bool:
        """Whether a baseline with the same budget [s] is better than the design."""
        mine, theirs = self.cost(DESIGN, seconds), self.best_baseline(seconds)[0]
        return theirs < mine - TIE * abs(mine) if np.isfinite(mine) else np.isfinite(theirs)


def table(results: list[Results], budgets: list[float]) -> Table:
    """Print J of the design and of the best baseline for every budget."""
    title = "J within the same seconds of the processor, one thread"
    headings = ("experiment", "method", *[f"{seconds:g} s" for seconds in budgets])
    made = new_table(title, *headings, texts=2)
    for each in results:
        made.add_row(each.case, "design", *[_cell(each, seconds) for seconds in budgets])
        best = [each.best_baseline(seconds) for seconds in budgets]
        made.add_row("", "best baseline", *[f"{cost:.5g} {method}" for cost, method in best])
        made.add_section()
    return made


def _cell(results: Results, seconds: float) -> str:
    """J of the design, marked where a baseline is better."""
    mark = " [red]beaten[/red]" if results.is_beaten(seconds) else ""
    return f"{results.cost(DESIGN, seconds):.5g}{mark}"


def verdicts(results: list[Results], budgets: list[float]) -> Iterator[str]:
    """Yield a sentence per budget [s]: of how many experiments the design is the best result."""
    for seconds in budgets:
        tried = [each for each in results if seconds in each.budgets]
        beaten = [each.case for each in tried if each.is_beaten(seconds)]
        sentence = (
            f"{seconds:g} s: the design is best in {len(tried) - len(beaten)} of {len(tried)}"
        )
        yield f"{sentence}; a baseline wins in {', '.join(beaten)}" if beaten else sentence


def main() -> int:
    """Run what is missing and print the table; 1 if a baseline is better."""
    parser = options_of(__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", nargs="+", type=float, default=list(SECONDS))
    parser.add_argument("--examples", nargs="*", help="names of examples; default: all")
    parser.add_argument("--methods", nargs="+", choices=list(TITLES), default=list(METHODS))
    parser.add_argument("--show", action="store_true", help="only show the results in the folder")
    args = parser.parse_args()

    args.folder.mkdir(parents=True, exist_ok=True)
    results: list[Results] = []
    with stop_on_interrupt() as stop:
        for case, experiment in examples(args.examples):
            rows: list[Found] = []
            for seconds in args.seconds:
                file = args.folder / f"{case}_{seconds:g}s.json"
                if not file.is_file() and not (args.show or stop.requested):
                    _compute(case, experiment, seconds, args.methods, file)
                if file.is_file():
                    kept = json.loads(file.read_text(encoding="utf-8"))
                    rows += [Found(**row) for row in kept]
            if rows:
                results.append(Results(case, rows))

    if not results:
        return 1
    Console(highlight=False, width=60 + 24 * len(args.seconds)).print(table(results, args.seconds))
    for verdict in verdicts(results, args.seconds):
        print(verdict)
    beaten = [each.is_beaten(seconds) for each in results for seconds in each.budgets]
    return int(any(beaten))


def _compute(
    case: str, experiment: Experiment, seconds: float, methods: list[str], file: Path
) -> None:
    """Run all methods with one budget and keep the results in a file."""
    try:
        rows = run(case, experiment, seconds, methods)
    except MjfimError as error:
        print(f"{case}: {error}")
        return
    for row in rows:
        print(f"{case}, {seconds:g} s: {row.method} {row.cost:.6g} ({row.used:.1f} s)", flush=True)
    file.write_text(json.dumps([asdict(row) for row in rows]), encoding="utf-8")
