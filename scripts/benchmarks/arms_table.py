"""Two arms under hard limits: the design beside Fourier series with equal time, as a table.

    python -m scripts.benchmarks arms_table FOLDER [--seconds 600] [--arms panda so_arm100]
    [--horizons 5 10]
    python -m scripts.benchmarks arms_table FOLDER --show        # the results in FOLDER

Every case is run by `mjfim.compare` and kept in FOLDER as JSON; cases that are there already are
not run again. The experiments are those of arms: from home, rest to rest, limits of position,
velocity, force, control rate and distance. One start of the design is a Fourier series of 15
harmonics. All methods use all cores, in as many processes.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from dataclasses import asdict, dataclass
from math import isfinite
from pathlib import Path

from rich.console import Console

import mjfim
from mjfim.parallel.budget import stop_on_interrupt
from mjfim.records.studies import DESIGN, Comparison
from scripts.benchmarks import arms
from scripts.benchmarks.child import options_of

# Methods with five and with fifteen harmonics.
FEW, MANY = "fourier5", "fourier15"

# Frequency of the series that is one start of the design [Hz].
FUNDAMENTAL = 0.2


HEAD = """\
| robot, friction of the joints | seconds | unknowns | 5 harmonics | 15 harmonics | mjfim | gain |
|---|---|---|---|---|---|---|"""


@dataclass(frozen=True)
class Case:
    """One comparison.

    Attributes:
        arm: Name of the arm.
        horizon: Duration [s].
        dry: Whether the joints have dry friction.
        parameters: Number of unknowns.
        few: Worst relative sigma with five harmonics, infinite where no control keeps the limits.
        many: Worst relative sigma with fifteen harmonics.
        design: Worst relative sigma of the design.
        kept: Whether the design keeps all limits.
        seconds: Time of the design [s].
        budget: Time of every method [s].
        found_by: Start from which the design was found.
    """

    arm: str
    horizon: float
    dry: bool
    parameters: int
    few: float
    many: float
    design: float
    kept: bool
    seconds: float
    budget: float
    found_by: str

    @property
    def gain(self) -> float:
        """Share by which sigma is smaller than the best of the series."""
        return 1.0 - self.design / min(self.few, self.many)

    @property
    def met(self) -> bool:
        """Whether the design keeps all limits and is better than both series."""
        return self.kept and self.gain > 0.0


def run(
    arm: str, horizon: float, dry: bool, args: argparse.Namespace, console: Console
) -> Case | None:
    """Compare the methods on one arm.

    Args:
        arm: Name of the arm.
        horizon: Duration [s].
        dry: Whether the joints have dry friction.
        args: Options of the command line.
        console: Receives one line for each method.

    Returns:
        The case; None if the comparison was interrupted before the design.
    """
    stated = arms.experiment(arm, horizon, dry, args.folder / "models")
    experiment = stated.replace(descent={"fourier": [FUNDAMENTAL], "max_iterations": 100_000})
    with mjfim.Pool() as executor:
        found = mjfim.compare(
            experiment, seconds=args.seconds, methods=[FEW, MANY], executor=executor
        )

    for row in found.rows:
        result = f"{row.worst_relative_std:.4g}, {row.outcome.value}"
        console.print(f"  {row.title}: {result}, {row.seconds:.0f} s, {row.found_by}")

    design = found.design
    if design is None:
        return None

    return Case(
        arm=arm,
        horizon=horizon,
        dry=dry,
        parameters=len(found.parameters),
        few=sigma_of(found, FEW),
        many=sigma_of(found, MANY),
        design=sigma_of(found, DESIGN),
        kept=design.sound,
        seconds=design.seconds,
        budget=args.seconds,
        found_by=design.found_by,
    )


def sigma_of(found: Comparison, method: str) -> float:
    """Return the worst relative sigma of a method, infinite if its control violates a limit."""
    row = next(row for row in found.rows if row.method == method)
    return row.worst_relative_std if row.sound else float("inf")


def markdown_row(case: Case) -> str:
    """Write a case as a row of Markdown."""
    series = [f"{sigma:.3g}" if isfinite(sigma) else "none" for sigma in (case.few, case.many)]
    robot = f"{case.arm}, {'dry' if case.dry else 'smooth'}"
    result = f"**{case.design:.3g}** | {100 * case.gain:.0f} %" if case.kept else "none |"
    return f"| {robot} | {case.horizon:g} | {case.parameters} | {' | '.join(series)} | {result} |"


def main() -> None:
    """Run the cases that are missing and print the table; exit code 1 if a case fails."""
    parser = options_of(__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=600.0, help="time of every method")
    parser.add_argument("--arms", nargs="+", choices=list(arms.ARMS), default=list(arms.ARMS))
    parser.add_argument("--horizons", nargs="+", type=float, default=[5.0, 10.0])
    parser.add_argument("--show", action="store_true", help="only print the results in the folder")
    args = parser.parse_args()

    console = Console(highlight=False, width=150)
    cases = []
    with stop_on_interrupt() as stop:
        for arm, joints, horizon in itertools.product(args.arms, ("smooth", "dry"), args.horizons):
            file = args.folder / f"{arm}_{joints}_{horizon:g}s.json"
            if not file.is_file():
                if args.show or stop.requested:
                    continue

                console.print(f"{arm}, {joints}, {horizon:g} s")
                args.folder.mkdir(parents=True, exist_ok=True)
                case = run(arm, horizon, joints == "dry", args, console)
                if case is None:
                    continue
                file.write_text(json.dumps(asdict(case)), encoding="utf-8")

            cases.append(Case(**json.loads(file.read_text(encoding="utf-8"))))

    print(*[HEAD, *map(markdown_row, cases)], sep="\n")
    sys.exit(0 if cases and all(case.met for case in cases) else 1)
