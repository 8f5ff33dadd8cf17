"""The hard-limited cart-pendulum: mjfim and CasADi + IPOPT with equal time.

    python -m scripts.benchmarks benchmark_limits [--seconds 60] [--seed 0]

The limits are |u| <= 5 N and |s| <= 1 m. The criterion is E at the true values, without weights
(models/cart_pendulum_limits.toml). CasADi + IPOPT works on the hand-derived model, from many
starts. Both use all cores, in as many processes. The clock of both starts when their processes run
and have imported their libraries: that of mjfim before the experiment is built, that of the peer
once its derivatives are compiled. As long as time is left, mjfim designs again with other random
starts.
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
from mjfim.records.events import DesignEvent
from scripts.benchmarks.run_in_subprocess import run_in_subprocess

# Top folder of the repository.
ROOT = Path(__file__).resolve().parents[2]

# Experiment under hard limits.
EXPERIMENT = ROOT / "models" / "cart_pendulum_limits.toml"

# Times at which the results are compared, besides the end [s].
MARKS = (5.0, 10.0, 20.0, 40.0)

# Sample rate of the experiment, at which each sample is one engine step [Hz].
RATE = 100.0

# Time that a design takes beside its search, to build the experiment and to verify its result [s].
BESIDE_SEARCH = 0.5

# What a design imports when it begins.
LIBRARIES = ("mjfim.excitation.design", "scipy.linalg")

# Best known lambda_min.
BEST = 403.4

# Code of the process that runs the peer.
PEER = """
from scripts.benchmarks import casadi_limits as p
r = p.limited_starts(float(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
found = [r.history, len(r.searched), r.build_seconds]
"""


@dataclass(frozen=True)
class SolverResult:
    """Result of one solver.

    Attributes:
        solver: Name of the solver.
        history: Time [s] and lambda_min of every better control inside the limits.
        starts: Number of starts.
        prepared: Time before its clock starts [s].
        margin: Smallest margin at any engine step [N or m], or None where only samples count.
    """

    solver: str
    history: tuple[tuple[float, float], ...]
    starts: int
    prepared: float
    margin: float | None

    def after(self, seconds: float) -> float:
        """Return the best lambda_min that was found within a time [s], 0 if there is none."""
        values = [value for t, value in self.history if t <= seconds]
        return max(values, default=0.0)


def run_mjfim(seconds: float, seed: int) -> SolverResult:
    """Design one time after another until the time is used up or Ctrl-C is pressed.

    Args:
        seconds: Wall time [s].
        seed: Seed of the first design; each further design has the next one.

    Returns:
        Result of mjfim.
    """
    begun = time.perf_counter()
    history: list[tuple[float, float]] = []
    starts = 0
    best = 0.0
    margin = 0.0

    def watch(event: DesignEvent) -> None:
        """Keep iterates on the stated plant, whose samples are engine steps, inside the limits."""
        row = event.row
        if row.rate == RATE and row.margin >= 0.0:
            known = max((value for _, value in history), default=0.0)
            if row.min_eigenvalue > known:
                history.append((time.perf_counter() - clock, row.min_eigenvalue))

    with mjfim.Pool() as executor, stop_on_interrupt() as stop:
        import_libraries(executor)
        clock = time.perf_counter()
        while not stop.requested and (left := seconds - (time.perf_counter() - clock)) > 1.0:
            descent = {"seed": seed, "seconds": left - BESIDE_SEARCH}
            experiment = Experiment.from_file(EXPERIMENT).replace(descent=descent)
            design = mjfim.design(experiment, executor=executor, callback=watch)
            seed += 1
            starts += len(design.starts)

            value = float(design.final.eigenvalues[0])
            smallest = min(design.limits.values())
            if smallest >= 0.0 and value > best:
                best = value
                margin = smallest
                history.append((time.perf_counter() - clock, value))

    return SolverResult(
        solver="mjfim",
        history=tuple(history),
        starts=starts,
        prepared=clock - begun,
        margin=margin,
    )


def import_libraries(executor: mjfim.Pool) -> None:
    """Start all processes of a pool, and import there and here what a design needs."""
    statement = f"import {', '.join(LIBRARIES)}"
    tasks = [executor.submit(exec, statement) for _ in range(executor.max_workers)]
    exec(statement)
    for task in tasks:
        task.result()


def run_peer(seconds: float, seed: int) -> SolverResult | None:
    """Run CasADi + IPOPT; return None where it is not installed.

    Args:
        seconds: Wall time [s].
        seed: Seed of the random starts.

    Returns:
        Result of the peer.
    """
    found = run_in_subprocess(PEER, seconds, seed, cores())
    if found is None:
        return None

    history, starts, build_seconds = found
    return SolverResult(
        solver="CasADi + IPOPT",
        history=tuple((t, value) for t, value in history),
        starts=starts,
        prepared=build_seconds,
        margin=None,
    )


def limits_table(results: list[SolverResult], seconds: float) -> Table:
    """Compare the results as table (f).

    Args:
        results: Results of the solvers.
        seconds: Wall time of each [s].

    Returns:
        Table with one row for each solver.
    """
    title = f"(f) hard limits: λ_min within the same seconds (best known {BEST})"
    marks = [*(t for t in MARKS if t < seconds), seconds]
    times = [f"{t:g} s" for t in marks]

    table = Table(title=title, title_justify="left")
    table.add_column("solver")
    for heading in (*times, "starts", "before", "worst margin, every step"):
        table.add_column(heading, justify="right")

    for result in results:
        best = [result.after(t) for t in marks]
        values = [f"{value:.2f}" if value else "-" for value in best]
        margin = "samples only" if result.margin is None else f"{result.margin:.1e}"
        prepared = f"{result.prepared:.1f} s"
        table.add_row(result.solver, *values, str(result.starts), prepared, margin)

    return table


def run_both(seconds: float, seed: int) -> list[SolverResult]:
    """Run both solvers one after the other; the peer is left out where it is not installed."""
    peer = run_peer(seconds, seed)
    mine = run_mjfim(seconds, seed)
    return [mine] if peer is None else [mine, peer]


def main() -> None:
    """Compare the solvers and print the table, then the results as JSON."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()

    results = run_both(args.seconds, args.seed)
    Console(highlight=False, width=130).print(limits_table(results, args.seconds))
    for result in results:
        print(json.dumps(dataclasses.asdict(result)))
