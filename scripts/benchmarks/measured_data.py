"""Identification of measured data of other groups, with and without the selection of terms.

    python -m scripts.benchmarks measured_data [--data ../shared/data] [--only NAME]

Each set is fitted from some of its recordings and predicts the others, as the experiment in
`models/` states it and with terms that `identify --select` adds. The guess is what the authors of
the data published. The script prints the chosen terms, the error of the prediction over that of the
published parameters, the mean half width of the 95 % intervals, the reasons of a misfit, and the
seconds. The recordings are not part of the repository.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import field
from pathlib import Path

import numpy as np
from rich.console import Console

import mjfim
from mjfim.arrays import record
from mjfim.experiment.system import System
from mjfim.recordings.read import read_recording
from scripts.benchmarks.child import ROOT, SHARED, new_table, options_of

# Constants of the servo as published: kt [N m/A], R [Ohm].
SERVO_KT = 0.32321
SERVO_R = 4.76365


@record
class MeasuredSet:
    """Recordings of one robot.

    Attributes:
        name: Name of the set, and of its experiment in `models/`.
        folder: Folder of the recordings below that of all data.
        fitted: Files that are fitted.
        held_out: Files that are predicted.
        published: Published values of parameters [theta-unit].
    """

    name: str
    folder: str
    fitted: tuple[str, ...]
    held_out: tuple[str, ...]
    published: dict[str, float] = field(default_factory=dict)

    def experiment(self) -> mjfim.Experiment:
        """The experiment of `models/`, whose guess is what was published."""
        guesses = {name: {"guess": value} for name, value in self.published.items()}
        file = ROOT / "models" / f"{self.name}.toml"
        return mjfim.Experiment.from_file(file).replace(parameters=guesses)

    def read(self, data: Path, names: Sequence[str]) -> list[mjfim.Recording]:
        """Read some recordings below the folder of all data."""
        channels = System.resolve(self.experiment()).channels
        return [read_recording(data / self.folder / name, channels) for name in names]


# Times of the logs of the servo, in their order.
SERVO_TIMES = ("28m10", "28m17", "28m24", "28m32", "28m42", "28m49", "28m57", "29m04")


def servo_files(*times: str) -> tuple[str, ...]:
    """Names of the servo's files."""
    return tuple(f"2026-01-15_10h{each}.json" for each in times)


SETS = (
    # The Coulomb friction of the publication follows atan(100 qd), which levels off at pi/2.
    MeasuredSet(
        name="dfki_simple_pendulum",
        folder="dfki_simple_pendulum",
        fitted=("dircol_measured.csv",),
        held_out=("energy_shaping_measured.csv",),
        published={"J": 0.06259, "mc": 0.1022, "damping": 0.04707, "coulomb": 0.1839 * np.pi / 2},
    ),
    # The model in models/ has the published parameters.
    MeasuredSet(
        name="dfki_double_pendulum",
        folder="dfki_double_pendulum",
        fitted=("A0_00.csv.gz", "A0_01.csv.gz"),
        held_out=("A0_02.csv.gz",),
    ),
    MeasuredSet(
        name="dfki_double_pendulum",
        folder="dfki_double_pendulum",
        fitted=("A0_01.csv.gz",),
        held_out=("A0_00.csv.gz", "A0_02.csv.gz"),
    ),
    MeasuredSet(
        name="bam_xl330",
        folder="bam_xl330/raw",
        fitted=servo_files("28m10", "28m17", "28m57", "29m04"),
        held_out=servo_files("28m24", "28m32", "28m42", "28m49"),
        published={
            "gain": SERVO_KT / SERVO_R,
            "brake": SERVO_KT**2 / SERVO_R,
            "damping": 0.0104948,
            "coulomb": 0.00696597,
            "armature": 0.00164322,
            "mounting": 0.0179525,
        },
    ),
)


def main() -> int:
    """Identify every set with and without selection, and print what was found."""
    parser = options_of(__doc__)
    parser.add_argument("--data", type=Path, default=SHARED / "data")
    parser.add_argument("--only", choices=sorted({each.name for each in SETS}), help="one robot")
    args = parser.parse_args()

    headings = "set, identified, what changed, held-out / published, median interval, misfit"
    headings = f"{headings}, seconds"
    table = new_table("Measured data of other groups", *headings.split(", "), texts=3)
    for measured in SETS:
        if args.only not in (None, measured.name):
            continue
        if not (args.data / measured.folder).is_dir():
            print(f"skipped: {args.data / measured.folder} is not there", file=sys.stderr)
            continue
        for is_selecting in (False, True):
            fit = mjfim.select_terms if is_selecting else mjfim.identify
            names = (measured.fitted, measured.held_out)
            fitted, held_out = (measured.read(args.data, each) for each in names)
            begun = time.perf_counter()
            found = fit(measured.experiment(), fitted, held_out=held_out)
            seconds = time.perf_counter() - begun

            changes = []
            selection = found.selection
            if selection is not None:
                print(measured.name, selection, flush=True)
                changes = [term.description for term in selection.terms]
                changes += [f"one {pool.name}" for pool in selection.pooled]
                changes += [f"{name} held at its guess" for name in selection.held]

            # A parameter that is held at its guess has no interval.
            halves = 0.5 * np.ptp(found.interval, axis=1) / np.maximum(np.abs(found.theta), 1e-300)
            halves = halves[[name not in found.held for name in found.parameters]]
            ratios = [prediction.ratio for prediction in found.predictions if prediction.held_out]
            logs = f"{measured.name}, {len(fitted)} fitted, {len(held_out)} predicted"
            row = [
                logs if not is_selecting else "",
                "--select" if is_selecting else "as stated",
                ", ".join(changes) or "–",
                ", ".join(f"{ratio:.3g}" for ratio in ratios),
                f"{100.0 * float(np.median(halves)):.1f} %",
                "; ".join(found.reasons) if found.misfit else "none",
                f"{seconds:.0f}",
            ]
            table.add_row(*row)

            # Each row is shown at once as well, because all of them take minutes.
            print(" | ".join(row), file=sys.stderr)

    Console(width=200).print(table)
    return 0
