"""Two arms under hard limits: the design beside Fourier series with the same seconds on the same
cores, as a table.

    python -m scripts.benchmarks arms_table FOLDER [--seconds 600] [--arms panda so_arm100]
    [--horizons 5 10] python -m scripts.benchmarks arms_table FOLDER --show        # the table of
    what was run so far

Every case is run by `mjfim.compare` and kept in FOLDER as JSON; cases that are there already are
left alone. The experiments are those of arms: from home, rest to rest, limits of position,
velocity, force, control rate and distance. Among the design's own starts is a Fourier series of 15
harmonics; all methods use all cores, in as many processes.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
from dataclasses import asdict, dataclass
from pathlib import Path

from rich.console import Console

import mjfim
from mjfim.budget import stop_on_interrupt
from mjfim.parallel import cores
from mjfim.records.comparison import Comparison, MethodResult
from scripts.benchmarks import arms

FEW, MANY = ("fourier5", "fourier5-mjfim"), ("fourier15-mjfim",)
PITCH = 0.2  # [Hz] of the series that is among the design's starts
WANTED = 0.1  # least gain over five harmonics


@dataclass(frozen=True)
class Case:
    """One comparison. few, many, design: worst relative sigma, infinite where nothing keeps the
    limits

    tightest, share: kind of the design's worst margin, and that over half of its range;  kept:
    whether all are, everywhere seconds: of the design;  budget: of every method
    """

    arm: str
    horizon: float
    dry: bool
    parameters: int
    few: float
    many: float
    design: float
    tightest: str
    share: float
    kept: bool
    seconds: float
    budget: float
    found_by: str

    @property
    def gain(self) -> float:
        """By what share sigma is smaller than that of five harmonics."""
        return 1.0 - self.design / self.few

    @property
    def met(self) -> bool:
        """Feasible, clearly better than five harmonics, never worse than fifteen."""
        return self.kept and self.gain >= WANTED and self.design <= self.many * (1.0 + 1e-3)


def run(
    arm: str, horizon: float, dry: bool, args: argparse.Namespace, console: Console
) -> Case | None:
    """Compare on one arm; None where the comparison was interrupted before the design."""
    stated = arms.experiment(arm, horizon, dry, args.folder / "models")
    experiment = stated.replace(descent={"fourier": [PITCH], "max_iterations": 100_000})
    with mjfim.Pool() as executor:
        found = mjfim.compare(
            experiment, seconds=args.seconds, methods=args.methods, executor=executor
        )
    for row in found.rows:
        console.print(
            f"  {row.title}: {row.worst_relative_std:.4g}, {row.outcome.value}, {row.seconds:.0f} "
            f"s, {row.found_by}"
        )
    ours = found.design
    if ours is None:
        return None
    kind, share = ours.tightest
    return Case(
        arm,
        horizon,
        dry,
        len(found.parameters),
        best(found, FEW),
        best(found, MANY),
        ours.worst_relative_std if ours.sound else float("inf"),
        kind,
        share,
        ours.sound,
        ours.seconds,
        args.seconds,
        ours.found_by,
    )


def best(found: Comparison, methods: tuple[str, ...]) -> float:
    """Smallest worst relative sigma of some methods."""

    def worth(row: MethodResult) -> float:
        return row.worst_relative_std if row.sound else float("inf")

    return min((worth(row) for row in found.rows if row.method in methods), default=float("inf"))


def markdown(cases: list[Case]) -> str:
    """A table per arm, for the README."""
    lines = [
        f"Worst relative σ; every method with {cases[0].budget:g} s on {cores()} cores. 'Inside': "
        "the design keeps all limits at every engine step of the untouched model, by at least so "
        "much of half of the range.",
    ]
    for arm in dict.fromkeys(c.arm for c in cases):
        lines += [
            "",
            f"| {arm} | horizon | unknowns | Fourier, 5 harmonics | 15 harmonics | mjfim | "
            "smaller than 5 by | inside |",
            "|---|---|---|---|---|---|---|---|",
        ]
        for c in cases:
            if c.arm == arm:
                inside = (
                    f"{100 * c.share:.2g} % ({c.tightest.replace('_', ' ')})" if c.kept else "no"
                )
                lines.append(
                    f"| {'dry' if c.dry else 'smooth'} | {c.horizon:g} s | {c.parameters} | "
                    f"{c.few:.3g} | {c.many:.3g} | **{c.design:.3g}** | {100 * c.gain:.0f} % | "
                    f"{inside} |"
                )
    return "\n".join(lines)


def main() -> None:
    """Run what is missing and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seconds", type=float, default=600.0, help="of every method")
    parser.add_argument("--arms", nargs="+", choices=list(arms.ARMS), default=list(arms.ARMS))
    parser.add_argument("--horizons", nargs="+", type=float, default=[5.0, 10.0])
    parser.add_argument("--joints", nargs="+", choices=["smooth", "dry"], default=["smooth", "dry"])
    parser.add_argument("--methods", nargs="+", choices=[*FEW, *MANY], default=[*FEW, *MANY])
    parser.add_argument("--show", action="store_true", help="only print what was run so far")
    args = parser.parse_args()
    console, cases = Console(highlight=False, width=150), []
    with stop_on_interrupt() as stop:
        for arm, joints, horizon in itertools.product(args.arms, args.joints, args.horizons):
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

    if cases:
        print(markdown(cases))
    sys.exit(0 if cases and all(case.met for case in cases) else 1)
