"""The hard-limited cart-pendulum beside CasADi + IPOPT with many starts on the hand-derived model:
the same seconds for both.

    python -m scripts.benchmarks benchmark_limits [--seconds 60] [--seed 0]

|u| <= 5 N, |s| <= 1 m, E at the actual values, no weights (models/cart_pendulum_limits.toml). Both
use all cores, in as many processes. mjfim's clock runs from before the experiment is built; the
peer's starts once its derivatives are compiled. As long as seconds are left, mjfim designs again,
with other random starts.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table

import mjfim
from mjfim.budget import stop_on_interrupt
from mjfim.experiment.schema import Experiment
from mjfim.parallel import cores
from scripts.benchmarks.run_in_subprocess import run_in_subprocess

ROOT = Path(__file__).resolve().parents[2]
EXPERIMENT = ROOT / "models" / "cart_pendulum_limits.toml"
MARKS = (5.0, 10.0, 20.0, 40.0)  # [s] at which the race is looked at, and at its end
BEST = 403.4  # lambda_min, the best known
PEER = """
from scripts.benchmarks import casadi_limits as p
r = p.limited_starts(float(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
found = [r.history, len(r.searched), r.build_seconds]
"""


@dataclass(frozen=True)
class Race:
    """One side. history: (seconds, lambda_min) of every better control inside the limits;  starts:
    that were tried

    prepared: seconds before its clock began;  margin: worst one at any engine step [N or m], or
    None where only samples count
    """

    solver: str
    history: tuple[tuple[float, float], ...]
    starts: int
    prepared: float
    margin: float | None

    def after(self, seconds: float) -> float:
        """Best lambda_min within so many seconds, 0 if none."""
        return max((value for t, value in self.history if t <= seconds), default=0.0)


def own(seconds: float, seed: int) -> Race:
    """Run mjfim: multistarts one after the other, until the time is used up or Ctrl-C is pressed."""
    clock = time.perf_counter()
    history: list[tuple[float, float]] = []
    starts, margin = 0, 0.0

    with mjfim.Pool() as executor, stop_on_interrupt() as stop:
        while not stop.requested and (left := seconds - (time.perf_counter() - clock)) > 1.0:
            descent = {"seed": seed, "seconds": left}
            design = mjfim.design(
                Experiment.from_file(EXPERIMENT).replace(descent=descent), executor=executor
            )
            value = float(design.final.eigenvalues[0])
            seed += 1
            starts += len(design.starts)
            if min(design.limits.values()) >= 0.0 and value > max(
                (v for _, v in history), default=0.0
            ):
                history.append((time.perf_counter() - clock, value))
                margin = min(design.limits.values())
    return Race("mjfim", tuple(history), starts, 0.0, margin)


def peer(seconds: float, seed: int) -> Race | None:
    """CasADi + IPOPT; None where it is missing."""
    found = run_in_subprocess(PEER, seconds, seed, cores())
    if found is None:
        return None
    history, starts, built = found
    return Race("CasADi + IPOPT", tuple((t, value) for t, value in history), starts, built, None)


def table(races: list[Race], seconds: float) -> Table:
    """(f)"""
    rows = Table(
        title=f"(f) hard limits: λ_min within the same seconds (best known {BEST})",
        title_justify="left",
    )
    marks = [*(t for t in MARKS if t < seconds), seconds]
    for i, heading in enumerate(
        ("solver", *(f"{t:g} s" for t in marks), "starts", "before", "worst margin, every step")
    ):
        rows.add_column(heading, justify="right" if i else "left")
    for race in races:
        values = [f"{v:.2f}" if (v := race.after(t)) else "-" for t in marks]
        margin = "samples only" if race.margin is None else f"{race.margin:.1e}"
        rows.add_row(race.solver, *values, str(race.starts), f"{race.prepared:.1f} s", margin)
    return rows


def races(seconds: float, seed: int) -> list[Race]:
    """Both, one after the other."""
    theirs = peer(seconds, seed)
    return [own(seconds, seed), *([] if theirs is None else [theirs])]


def main() -> None:
    """Race and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    found = races(args.seconds, args.seed)
    Console(highlight=False, width=130).print(table(found, args.seconds))
    for race in found:
        print(json.dumps(dataclasses.asdict(race)))
