"""Run the fuzz suite by hand: `python -m scripts.fuzz --problems 500 --inputs 1000 --kills 200`."""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import typer

from mjfim.parallel import cores
from tests.fuzz.outcome import KINDS, Case, Outcome
from tests.fuzz.workers import run_case, run_cases
from tests.support.paths import ROOT


def main(
    problems: int = 0,
    mechanisms: int = 0,
    inputs: int = 0,
    kills: int = 0,
    permissions: int = 0,
    logs: int = 0,
    seed: int = 0,
    workers: int = cores(),
    only: list[str] | None = None,
    here: bool = False,
    verbose: bool = False,
) -> None:
    """Run some cases of each kind from a seed on, or only the cases KIND:SEED.

    With `--here`, they run in this process. Exit code 1 if a case failed.
    """
    counts = {
        "problem": problems,
        "mechanism": mechanisms,
        "input": inputs,
        "kill": kills,
        "permission": permissions,
        "log": logs,
    }
    cases = [Case.parse(text) for text in only or ()] or [
        Case(kind=kind, seed=seed + i) for kind in KINDS for i in range(counts[kind])
    ]
    begin, failed = time.monotonic(), []
    groups: Counter[str] = Counter()
    for outcome in _here(cases) if here else run_cases(cases, workers, np.inf):
        groups[f"{outcome.case.kind}: {outcome.group}"] += 1
        if outcome.complaint:
            failed.append(f"FAILED: --only {outcome.case}")
        if outcome.complaint or verbose or only:
            about = f"{outcome.group}, {outcome.seconds:.1f} s, {outcome.description}"
            print(f"{outcome.case}: {about}\n{outcome.complaint}".strip(), flush=True)

    print(f"\n{groups.total()} cases in {time.monotonic() - begin:.0f} s on {cores()} cores")
    print("\n".join([*(f"{group}: {count}" for group, count in sorted(groups.items())), *failed]))
    raise typer.Exit(int(bool(failed)))


def _here(cases: list[Case]) -> Iterator[Outcome]:
    """Run cases in this process, for a debugger; their files stay."""
    home = Path(tempfile.mkdtemp(prefix="mjfim-fuzz-"))
    sys.path.insert(0, str(ROOT))
    os.chdir(home)
    for case in cases:
        folder = Path(tempfile.mkdtemp(dir=home))
        print(f"{case}: files in {folder}")
        yield run_case(case, folder)


if __name__ == "__main__":
    typer.run(main)
