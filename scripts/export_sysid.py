"""Recordings and parameters for `mujoco.sysid`, its HTML report, and both estimators on the same data.

    pip install 'mjfim[sysid]'
    python scripts/export_sysid.py models/cart_pendulum.toml recording.csv -o out/sysid

sysid runs twice: weighted by the noise that the experiment states, and as is, where each signal counts relative to the
norm of what was measured. DIR gets comparison.json and sysid_report.html (of the weighted fit; a browser loads its plotting
library from the network). To go on with sysid in Python,
take `sysid_sequences.export(task, recordings)`. Exit code 0, or 2 for misuse.
"""

from __future__ import annotations

import argparse
import io
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from mujoco import sysid
from rich import box
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from sysid_sequences import Exported, build, export, hushed, require_extra

import mjfim
from mjfim.arrays import Array
from mjfim.atomic_io import replacing
from mjfim.errors import MjfimError
from mjfim.excitation.task import DesignTask
from mjfim.identification.identify import identify_system
from mjfim.output.folders import check_folder
from mjfim.recordings.read import read_recording
from mjfim.records.estimate import Estimate
from mjfim.records.serialization import write_json

ITERATIONS = 200
HEADINGS = (
    "parameter",
    "true",
    "start",
    "mjfim",
    "formal σ",
    "95 % interval",
    "sysid\nweighted",
    "sysid\nas is",
)

say = Console(highlight=False, soft_wrap=True)
told = Console(stderr=True, highlight=False, soft_wrap=True)


@dataclass(frozen=True, eq=False)
class Fitted:
    """A fit by sysid. theta: (p,);  chi2: squared residual whitened by the stated noise, there

    ended: sysid's last words;  found: ParameterDict, result: OptimizeResult, for its report
    """

    theta: Array
    chi2: float
    seconds: float
    ended: str
    found: Any
    result: Any


def fitted(exported: Exported, weighted: bool) -> Fitted:
    """sysid's own optimiser, from the guess."""
    words, clock = io.StringIO(), time.perf_counter()
    with hushed():
        found, result = sysid.optimize(
            exported.parameters,
            exported.residual(weighted),
            verbose=False,
            max_iters=ITERATIONS,
            output=words,
        )
    seconds = time.perf_counter() - clock
    theta = np.array(found.as_vector())
    lines = [line for line in words.getvalue().splitlines() if line.startswith("Terminated")]
    return Fitted(theta, chi2(exported, theta), seconds, lines[-1] if lines else "", found, result)


def chi2(exported: Exported, theta: Array) -> float:
    """Squared residual of the recordings at theta: (p,), whitened by the stated noise."""
    with hushed():
        residuals, _, _ = exported.residual(weighted=True)(theta, exported.parameters.copy())
    return float(sum(np.sum(r**2) for r in residuals[: len(exported.sequences.measured_rollout)]))


def report(exported: Exported, fit: Fitted) -> str:
    """sysid's HTML."""
    return str(
        sysid.default_report(
            [exported.sequences],
            exported.parameters,
            fit.found,
            exported.residual(weighted=True),
            fit.result,
            title=f"{exported.sequences.name}: mujoco.sysid, weighted by the stated noise",
            build_model=build,
            generate_videos=False,
        ).build()
    )


def table(task: DesignTask, estimate: Estimate, weighted: Fitted, default: Fitted) -> Table:
    """Both estimators, parameter by parameter."""
    rows = Table(
        title="The same data, two estimators",
        title_justify="left",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )
    for heading in HEADINGS:
        folds = heading in ("parameter", "95 % interval")
        rows.add_column(
            heading,
            justify="left" if heading == "parameter" else "right",
            no_wrap=not folds,
            min_width=9 if folds else None,
            overflow="fold",
        )
    for j, p in enumerate(task.parameters.parameters):
        low, high = estimate.interval[j]
        rows.add_row(
            escape(p.name),
            "-" if p.true is None else f"{p.true:.4g}",
            f"{estimate.initial_theta[j]:.4g}",
            f"{estimate.theta[j]:.5g}",
            f"{estimate.std[j]:.2g}",
            f"{low:.4g} to {high:.4g}",
            *(f"{fit.theta[j]:.5g}" for fit in (weighted, default)),
        )
    rows.add_section()
    fits = (estimate, weighted, default)
    for heading, words in (
        ("χ²", [f"{f.chi2:.6g}" for f in fits]),
        ("seconds", [f"{f.seconds:.2f}" for f in fits]),
    ):
        rows.add_row(heading, "", "", words[0], "", "", *words[1:])
    return rows


def summary(
    exported: Exported, estimate: Estimate, weighted: Fitted, default: Fitted
) -> dict[str, Any]:
    """Contents of comparison.json."""
    task = exported.task
    return {
        "parameters": list(estimate.parameters),
        "units": list(task.system.units),
        "true": [p.true for p in task.parameters.parameters],
        "start": estimate.initial_theta,
        "recordings": [r.name for r in estimate.recordings],
        "dof": estimate.dof,
        "mjfim": {
            "theta": estimate.theta,
            "std": estimate.std,
            "interval": estimate.interval,
            "chi2": estimate.chi2,
            "seconds": estimate.seconds,
            "status": estimate.status,
            "misfit": estimate.misfit,
        },
        "sysid_weighted": _fit(weighted),
        "sysid_default": _fit(default),
        "notes": list(exported.notes),
    }


def _fit(fit: Fitted) -> dict[str, Any]:
    return {"theta": fit.theta, "chi2": fit.chi2, "seconds": fit.seconds, "status": fit.ended}


def run(experiment: Path, recordings: Sequence[Path], folder: Path) -> None:
    """Read, fit three times, print and write. Raises MjfimError."""
    require_extra()
    check_folder(folder)
    task = DesignTask.resolve(mjfim.Experiment.from_file(experiment))
    read = [read_recording(path, task.system.channels) for path in recordings]
    exported = export(task, read)
    estimate = identify_system(task.system, read)
    weighted, default = fitted(exported, weighted=True), fitted(exported, weighted=False)
    page = report(exported, weighted)
    say.print(table(task, estimate, weighted, default))
    for sentence in (*exported.notes, *estimate.warnings):
        told.print(f"warning: {sentence}", style="yellow", markup=False)
    write_json(folder / "comparison.json", summary(exported, estimate, weighted, default))
    with replacing(folder / "sysid_report.html") as temporary:
        temporary.write_text(page, encoding="utf-8")
    say.print(f"wrote {folder}: comparison.json, sysid_report.html", markup=False)


def main(words: Sequence[str] | None = None) -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("experiment", type=Path)
    parser.add_argument("recordings", type=Path, nargs="+", metavar="RECORDING")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="DIR")
    args = parser.parse_args(words)
    try:
        run(args.experiment, args.recordings, args.output)
    except MjfimError as error:
        told.print(f"export_sysid: {error}", markup=False)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
