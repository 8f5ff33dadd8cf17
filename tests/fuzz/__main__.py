"""Run the fuzz suite by hand: `python -m tests.fuzz --problems 500 --inputs 1000 --kills 200`."""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from mjfim.parallel import cores
from tests.fuzz.outcome import KINDS, Case, Outcome
from tests.fuzz.workers import run_cases
from tests.support.paths import ROOT


def report(outcome: Outcome, verbose: bool) -> None:
    """Print a case that failed; with `verbose` every case."""
    if outcome.complaint:
        print(f"FAILED: --only {outcome.case}: {outcome.description}", flush=True)
        print("    " + outcome.complaint.replace("\n", "\n    "), flush=True)
    elif verbose:
        about = f"{outcome.group}, {outcome.seconds:.1f} s, {outcome.description}"
        print(f"{outcome.case}: {about}", flush=True)


def summarize(outcomes: list[Outcome], seconds: float) -> None:
    """Print how many cases of each kind ended how, and the seeds of what failed."""
    print(f"\n{len(outcomes)} cases in {seconds:.0f} s on {cores()} cores")
    for kind in KINDS:
        own = [outcome for outcome in outcomes if outcome.case.kind == kind]
        if not own:
            continue
        seeds = [outcome.case.seed for outcome in own]
        groups = ", ".join(f"{n} {group}" for group, n in Counter(o.group for o in own).items())
        print(f"{kind}: {len(own)} cases, seeds {min(seeds)} to {max(seeds)}: {groups}")

        failed = [str(outcome.case) for outcome in own if outcome.complaint]
        print(f"  failed: {len(failed)} {' '.join(failed)}".rstrip())


def main() -> int:
    """Run the cases that the command line asks for; exit code 1 if a case failed."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    for kind in KINDS:
        parser.add_argument(f"--{kind}s", type=int, default=0, help=f"number of {kind}s")
    parser.add_argument("--seed", type=int, default=0, help="first seed of every kind")
    parser.add_argument("--workers", type=int, default=cores(), help="processes side by side")
    parser.add_argument(
        "--seconds", type=float, default=float("inf"), help="no case begins after this time"
    )
    parser.add_argument(
        "--only", type=Case.parse, action="append", metavar="KIND:SEED", help="run this case alone"
    )
    parser.add_argument("--here", action="store_true", help="with --only: in this process")
    parser.add_argument("--verbose", action="store_true", help="print every case")
    args = parser.parse_args()

    counts = {kind: getattr(args, f"{kind}s") for kind in KINDS}
    cases = args.only or [
        Case(kind=kind, seed=args.seed + i) for kind, count in counts.items() for i in range(count)
    ]
    begin = time.monotonic()
    outcomes = []
    found = _here(cases) if args.here else run_cases(cases, args.workers, args.seconds)
    for outcome in found:
        report(outcome, args.verbose or args.only is not None)
        outcomes.append(outcome)

    summarize(outcomes, time.monotonic() - begin)
    return int(any(outcome.complaint for outcome in outcomes))


def _here(cases: list[Case]) -> Iterator[Outcome]:
    """Run cases in this process, for a debugger; their files stay."""
    from tests.fuzz.workers import run_case

    home = Path(tempfile.mkdtemp(prefix="mjfim-fuzz-"))
    sys.path.insert(0, str(ROOT))
    os.chdir(home)
    for case in cases:
        folder = Path(tempfile.mkdtemp(dir=home))
        print(f"{case}: files in {folder}")
        yield run_case(case, folder)


if __name__ == "__main__":
    sys.exit(main())
