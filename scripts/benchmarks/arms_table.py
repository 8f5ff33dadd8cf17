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
from functools import partial
from math import inf, isfinite
from pathlib import Path
from typing import Any

from rich.console import Console

import mjfim
from mjfim.records.studies import DESIGN
from scripts.benchmarks import arms
from scripts.benchmarks.child import kept, options_of

# Methods with five and with fifteen harmonics.
FEW, MANY = "fourier5", "fourier15"


HEAD = """\
| robot, friction of the joints | seconds | unknowns | 5 harmonics | 15 harmonics | mjfim | gain |
|---|---|---|---|---|---|---|"""


def run(
    arm: str, horizon: float, dry: bool, args: argparse.Namespace, console: Console
) -> dict[str, Any] | None:
    """Compare the methods on one arm.

    Args:
        arm: Name of the arm.
        horizon: Duration [s].
        dry: Whether the joints have dry friction.
        args: Options of the command line.
        console: Receives one line for each method.

    Returns:
        Number of unknowns, and worst relative sigmas, infinite where no control keeps the limits;
        None without a design.
    """
    console.print(f"{arm}, {'dry' if dry else 'smooth'}, {horizon:g} s")
    stated = arms.experiment(arm, horizon, dry, args.folder / "models")
    # One start of the design is a series at 0.2 Hz.
    experiment = stated.replace(descent={"fourier": [0.2], "max_iterations": 100_000})
    with mjfim.Pool() as executor:
        found = mjfim.compare(
            experiment, seconds=args.seconds, methods=[FEW, MANY], executor=executor
        )

    sigma = {}
    for row in found.rows:
        result = f"{row.worst_relative_std:.4g}, {row.outcome.value}"
        console.print(f"  {row.title}: {result}, {row.seconds:.0f} s, {row.found_by}")
        sigma[row.method] = row.worst_relative_std if row.sound else inf
    if found.design is None:
        return None
    few, many, design = (sigma[method] for method in (FEW, MANY, DESIGN))
    unknowns, is_sound = len(found.parameters), found.design.sound
    return {"parameters": unknowns, "few": few, "many": many, "design": design, "kept": is_sound}


def main() -> int:
    """Run the cases that are missing and print the table; 1 if a design does not win."""
    parser = options_of(__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=600.0, help="time of every method")
    parser.add_argument("--arms", nargs="+", choices=list(arms.ARMS), default=list(arms.ARMS))
    parser.add_argument("--horizons", nargs="+", type=float, default=[5.0, 10.0])
    parser.add_argument("--show", action="store_true", help="only print the results in the folder")
    args = parser.parse_args()

    console = Console(highlight=False, width=150)
    lines, gains = [HEAD], []
    for arm, joints, horizon in itertools.product(args.arms, ("smooth", "dry"), args.horizons):
        found = kept(
            args.folder / f"{arm}_{joints}_{horizon:g}s.json",
            partial(run, arm, horizon, joints == "dry", args, console),
            is_shown=args.show,
        )
        if found is None:
            continue
        series = [found["few"], found["many"]]
        gains.append(1.0 - found["design"] / min(series) if found["kept"] else -inf)
        result = ("none", "")
        if found["kept"]:
            result = (f"**{found['design']:.3g}**", f"{100 * gains[-1]:.0f} %")
        told = [f"{sigma:.3g}" if isfinite(sigma) else "none" for sigma in series]
        cells = (f"{arm}, {joints}", f"{horizon:g}", str(found["parameters"]), *told, *result)
        lines.append(f"| {' | '.join(cells)} |")
    print(*lines, sep="\n")
    return 0 if gains and min(gains) > 0.0 else 1
