"""Reproduce the study of Wilson & Murphey (2014) on MuJoCo: every number of Tables I-III and Figures 2-6.

    python scripts/reproduce_paper.py -o out/paper

The paper's weights are not printed; the experiment file holds ones that reproduce its optimized matrices to a few
percent. Its Monte-Carlo tables are those of 25 Hz measurements, although its text says 100 Hz; both are run here.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import mjfim
from mjfim import plots, rerun_log
from mjfim.archive import study_summary, write_design, write_json
from mjfim.labels import Labels
from mjfim.plant import CENTRAL
from mjfim.setup import Setup
from mjfim.trajectory import Array, Design, Study, Trajectory

EXPERIMENT = Path(__file__).resolve().parents[1] / "models" / "cart_pendulum.toml"


@dataclass(frozen=True)
class Printed:
    """What the paper prints for one trajectory. Matrices: upper triangles (11, 12, 13, 22, 23, 33)."""

    eigenvalues: tuple[float, float, float]
    cost: float
    covariance: tuple[float, ...]
    information: tuple[float, ...]
    bound: tuple[float, ...]


PAPER = {
    "initial": Printed(
        (0.87185, 19.266, 38.170),
        1.1470,
        (1.10e-3, -1.51e-4, 3.54e-4, 3.64e-3, 4.92e-3, 5.95e-2),
        (961, 22.1, -7.26, 482, -30.9, 23.9),
        (1.04e-3, -3.01e-5, 2.78e-4, 2.26e-3, 2.92e-3, 4.57e-2),
    ),
    "final": Printed(
        (101.24, 928.51, 16482.0),
        0.0098775,
        (2.75e-4, 8.68e-5, 1.65e-4, 3.18e-5, 6.21e-5, 1.70e-4),
        (3.16e4, -9.24e4, 2.45e3, 3.84e5, -5.02e4, 2.33e4),
        (2.63e-4, 8.30e-5, 1.51e-4, 2.98e-5, 5.56e-5, 1.47e-4),
    ),
}
TITLES = {"initial": "initial", "final": "optimized"}
UPPER = tuple(zip(*np.triu_indices(3), strict=True))


def information_at(setup: Setup, trajectory: Trajectory, measure_rate: float) -> Array:
    """(p, p) Fisher information of a trajectory sampled at another rate [Hz]."""
    other = Setup(setup.experiment.replace(measure_rate=measure_rate))
    point = other.problem.point(trajectory, CENTRAL)
    assert point.information is not None
    return point.information


def add(table: Table, quantity: str, printed: float, ours: float) -> None:
    """One comparison row."""
    table.add_row(quantity, f"{printed:.5g}", f"{ours:.5g}", f"{100 * (ours / printed - 1):+.1f} %")


def new_table(title: str) -> Table:
    """An empty comparison."""
    table = Table(title=title, title_justify="left")
    table.add_column("quantity")
    for heading in ("paper", "mjfim", "difference"):
        table.add_column(heading, justify="right")
    return table


def table_one(design: Design) -> Table:
    """Eigenvalues and cost. The printed cost leaves the weighted terms out: compared with the criterion 1/lambda_3."""
    table = new_table("Table I: eigenvalues of the information per second, and cost")
    for name, side in (("initial", design.initial), ("final", design.final)):
        for i in (2, 1, 0):
            add(table, f"{TITLES[name]} λ{3 - i}", PAPER[name].eigenvalues[i], float(side.eigenvalues[i]))
        add(table, f"{TITLES[name]} J", PAPER[name].cost, side.criterion)
    return table


def matrix_table(title: str, name: str, printed: tuple[float, ...], ours: Array) -> Table:
    """All six entries of a symmetric matrix."""
    table = new_table(f"{title}, {TITLES[name]}")
    for (i, j), value in zip(UPPER, printed, strict=True):
        add(table, f"{'mlc'[i]}{'mlc'[j]}".replace("l", "ℓ"), value, float(ours[i, j]))
    return table


def efficiency_table(study: Study) -> Table:
    """Observed variances against mjfim's own bound."""
    table = Table(title=f"Monte Carlo at {study.measure_rate:g} Hz against mjfim's own bound", title_justify="left")
    for heading in ("trajectory", "parameter", "variance", "bound", "variance / bound", "failed"):
        table.add_column(heading, justify="right")
    for name, s in study.sets.items():
        for i, parameter in enumerate(study.parameters):
            variance, bound = s.covariance[i, i], s.crlb[i, i]
            row = (TITLES[name], parameter, f"{variance:.3e}", f"{bound:.3e}", f"{variance / bound:.3f}", str(s.failed))
            table.add_row(*row)
    return table


def write_figures(folder: Path, setup: Setup, design: Design, study: Study) -> None:
    """Figures 2-6 and the tables as PNG, and the Rerun file."""
    names = Labels.of(setup)
    plots.save(plots.trajectories(design, names), folder / "figure_2.png")
    plots.save(plots.sensitivity_phase(design, names), folder / "figure_3.png")
    for figure, parameter in ((4, "c"), (5, "m"), (6, "l")):
        index = study.parameters.index(parameter)
        plots.save(plots.histogram(study, index, names), folder / f"figure_{figure}.png")
    plots.save(plots.design_table(design, names), folder / "table_1.png")
    plots.save(plots.study_table(study, names), folder / "table_2_3.png")
    plots.save(plots.convergence(design), folder / "convergence.png")
    rerun_log.log_design(folder / "design.rrd", setup.model_at(setup.theta), design, names)


def main() -> None:
    """Run the study and print every comparison."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/paper"))
    parser.add_argument("--trials", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    console = Console(highlight=False)
    setup = Setup(mjfim.Experiment.from_file(EXPERIMENT))
    design = mjfim.design(setup)
    console.print(table_one(design))
    curves = {"initial": design.initial.trajectory, "final": design.trajectory}
    studies = {
        rate: mjfim.monte_carlo(setup, curves, args.trials, args.seed, measure_rate=rate) for rate in (25.0, 100.0)
    }
    for name, printed in PAPER.items():
        information = information_at(setup, curves[name], 25.0)
        observed = studies[25.0].sets[name].covariance
        console.print(matrix_table("Table II: Monte-Carlo covariance (25 Hz)", name, printed.covariance, observed))
        console.print(matrix_table("Table II: Fisher information (25 Hz)", name, printed.information, information))
        bound = np.asarray(np.linalg.inv(information))
        console.print(matrix_table("Table III: Cramér-Rao bound (25 Hz)", name, printed.bound, bound))
    for study in studies.values():
        console.print(efficiency_table(study))
    args.output.mkdir(parents=True, exist_ok=True)
    write_design(args.output, design, setup)
    write_json(args.output / "montecarlo_25Hz.json", study_summary(studies[25.0]))
    write_json(args.output / "montecarlo_100Hz.json", study_summary(studies[100.0]))
    write_figures(args.output, setup, design, studies[25.0])
    console.print(f"wrote {args.output}/: figures 2-6, tables, design.rrd (mjfim replay {args.output})")


if __name__ == "__main__":
    main()
