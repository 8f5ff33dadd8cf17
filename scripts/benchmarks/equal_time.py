"""Whether designs of an arm became better in equal time than at an earlier commit.

    python -m scripts.benchmarks equal_time [--commit 2ef51a6] [--seconds 30] [--parameters 10 70]

Each experiment of `benchmark_arm` is designed twice, in processes of their own: by the code of this
folder, and by that of the commit, which git checks out into a temporary folder. J is printed at the
same seconds of the processor since the search began, so that other programs matter little.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from mjfim.budget import Budget, StopToken
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.records.events import DesignEvent

REPOSITORY = Path(__file__).resolve().parents[2]

# Shares of the time at which J is printed.
SHARES = (0.1, 0.2, 0.35, 0.5, 0.75, 1.0)

# Iterations that no run reaches, so that the time ends it.
ENDLESS = 100_000


def costs_over_time(tables: Mapping[str, Any], seconds: float) -> list[tuple[float, float]]:
    """Run one design until the seconds of the processor are used up.

    Args:
        tables: Tables of the experiment.
        seconds: Seconds of the processor for the search.

    Returns:
        Seconds since the search began, and the best J so far, of every iterate.
    """
    task = DesignTask.resolve(Experiment(**tables))
    token = StopToken()
    begun = time.process_time()
    found: list[tuple[float, float]] = []

    def note(event: DesignEvent) -> None:
        """Note the iterate, and end the run where its time is over."""
        spent = time.process_time() - begun
        if spent > seconds:
            token.request()
        best = min([event.row.cost, *(cost for _, cost in found[-1:])])
        found.append((spent, best))

    design_task(task, callback=note, budget=Budget(stop=token))
    return found


def at_times(found: Sequence[tuple[float, float]], times: Sequence[float]) -> list[float]:
    """Best J at each of some times; infinite before the first iterate."""
    return [
        min((cost for spent, cost in found if spent <= at), default=float("inf")) for at in times
    ]


def run_in(folder: Path, tables: Mapping[str, Any], seconds: float) -> list[tuple[float, float]]:
    """Run one design with the package of a folder, in a process of its own."""
    order = json.dumps({"tables": tables, "seconds": seconds})
    command = [sys.executable, "-B", str(Path(__file__).resolve()), "--order", order]
    done = subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        check=True,
        capture_output=True,
        text=True,
    )
    return [(spent, cost) for spent, cost in json.loads(done.stdout.splitlines()[-1])]


def compare(commit: str, counts: Sequence[int], seconds: float) -> None:
    """Print J over time, of the commit and of this folder."""
    # Only this process needs the experiments; that of the commit receives their tables.
    from scripts.benchmarks.benchmark_arm import ARM, tables_of

    times = [share * seconds for share in SHARES]
    print(f"{'J after seconds of the processor':34s}" + "".join(f"{at:11.1f}" for at in times))

    with tempfile.TemporaryDirectory() as temporary:
        before = Path(temporary) / "before"
        git = ["git", "-C", str(REPOSITORY), "worktree"]
        subprocess.run([*git, "add", "--detach", str(before), commit], check=True)
        try:
            for p in counts:
                tables = tables_of(ARM, p, ENDLESS)
                for name, folder in ((commit, before), ("this folder", REPOSITORY)):
                    found = at_times(run_in(folder, tables, seconds), times)
                    numbers = "".join(f"{cost:11.4g}" for cost in found)
                    print(f"p = {p:3d}, {name:25s}{numbers}", flush=True)
        finally:
            subprocess.run([*git, "remove", "--force", str(before)], check=True)


def main() -> int:
    """Compare with a commit, or run one design for the process that compares."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--commit", default="2ef51a6")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--parameters", type=int, nargs="+", default=[10, 30, 70])
    parser.add_argument("--order", help=argparse.SUPPRESS)
    args = parser.parse_args()

    if args.order:
        order = json.loads(args.order)
        print(json.dumps(costs_over_time(order["tables"], order["seconds"])))
        return 0

    compare(args.commit, args.parameters, args.seconds)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
