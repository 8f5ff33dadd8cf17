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

    cases = args.only or [
        Case(kind=kind, seed=args.seed + i)
        for kind in KINDS
        for i in range(getattr(args, f"{kind}s"))
    ]
    begin, failed = time.monotonic(), []
    groups: Counter[str] = Counter()
    for outcome in _here(cases) if args.here else run_cases(cases, args.workers, args.seconds):
        groups[f"{outcome.case.kind}: {outcome.group}"] += 1
        if outcome.complaint:
            failed.append(f"FAILED: --only {outcome.case}")
        if outcome.complaint or args.verbose or args.only:
            about = f"{outcome.group}, {outcome.seconds:.1f} s, {outcome.description}"
            print(f"{outcome.case}: {about}\n{outcome.complaint}".strip(), flush=True)

    print(f"\n{groups.total()} cases in {time.monotonic() - begin:.0f} s on {cores()} cores")
    print("\n".join([*(f"{group}: {count}" for group, count in sorted(groups.items())), *failed]))
    return int(bool(failed))


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
