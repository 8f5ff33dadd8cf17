"""Whether designs of an arm became better in equal time than at an earlier commit.

    python -m scripts.benchmarks equal_time [--commit 2ef51a6] [--seconds 30] [--parameters 10 70]

Each experiment of `benchmark_arm` is designed twice, in processes of their own: by the code of this
folder, and by that of the commit, which git extracts into a temporary folder. J is printed at the
same seconds of the processor since the search began, so that other programs matter little.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from scripts.benchmarks.benchmark_arm import ARM, tables_of
from scripts.benchmarks.checkouts import ROOT, earlier_checkout
from scripts.benchmarks.run_in_subprocess import measure_in_subprocess

# Shares of the time at which J is printed.
SHARES = (0.1, 0.2, 0.35, 0.5, 0.75, 1.0)

# Iterations that no run reaches, so that the time ends it.
ENDLESS = 100_000


def at_times(found: Sequence[tuple[float, float]], times: Sequence[float]) -> list[float]:
    """Best J at each of some times; infinite before the first iterate."""
    return [
        min((cost for spent, cost in found if spent <= at), default=float("inf")) for at in times
    ]


def compare(commit: str, counts: Sequence[int], seconds: float) -> None:
    """Print J over time, of the commit and of this folder."""
    times = [share * seconds for share in SHARES]
    print(f"{'J after seconds of the processor':34s}" + "".join(f"{at:11.1f}" for at in times))

    with earlier_checkout(commit) as before:
        for p in counts:
            tables = tables_of(ARM, p, ENDLESS)
            for name, folder in ((commit, before), ("this folder", ROOT)):
                curve = measure_in_subprocess(
                    "costs_over_time", folder, tables=tables, seconds=seconds
                )
                found = at_times(curve or [], times)
                numbers = "".join(f"{cost:11.4g}" for cost in found)
                print(f"p = {p:3d}, {name:25s}{numbers}", flush=True)


def main() -> int:
    """Compare with a commit."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--commit", default="2ef51a6")
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--parameters", type=int, nargs="+", default=[10, 30, 70])
    args = parser.parse_args()

    compare(args.commit, args.parameters, args.seconds)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
