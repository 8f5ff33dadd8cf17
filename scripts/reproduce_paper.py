"""Reproduce the study of Wilson & Murphey (2014): the numbers of Tables I-III and Figures 2-6.

    python -m scripts.reproduce_paper -o out/paper

The paper does not print its weights. The experiment file holds weights that reproduce its optimized
matrices to a few percent. Its Monte-Carlo tables are those of measurements at 25 Hz, although its
text says 100 Hz.
"""

from __future__ import annotations

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from rich.console import Console
from rich.table import Table

import mjfim
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import labels_of_system
from mjfim.files import write_json
from mjfim.model.coordinates import split_unit
from mjfim.output import rerun as rerun_log
from mjfim.output.archive import write_data
from mjfim.output.plots.pictures import draw
from mjfim.records.studies import MonteCarloStudy
from scripts.benchmarks.child import ROOT, new_table, options_of

# Experiment of the study.
EXPERIMENT = ROOT / "models" / "cart_pendulum.toml"


# Numbers that the paper prints for each trajectory: the eigenvalues of the information and the cost
# without weighted terms; then covariance of the Monte-Carlo estimates, Fisher information and
# Cramer-Rao bound by their upper triangles, in the order (11, 12, 13, 22, 23, 33).
PAPER = {
    "initial": (
        (38.170, 19.266, 0.87185, 1.1470),
        (1.10e-3, -1.51e-4, 3.54e-4, 3.64e-3, 4.92e-3, 5.95e-2),
        (961, 22.1, -7.26, 482, -30.9, 23.9),
        (1.04e-3, -3.01e-5, 2.78e-4, 2.26e-3, 2.92e-3, 4.57e-2),
    ),
    "final": (
        (16482.0, 928.51, 101.24, 0.0098775),
        (2.75e-4, 8.68e-5, 1.65e-4, 3.18e-5, 6.21e-5, 1.70e-4),
        (3.16e4, -9.24e4, 2.45e3, 3.84e5, -5.02e4, 2.33e4),
        (2.63e-4, 8.30e-5, 1.51e-4, 2.98e-5, 5.56e-5, 1.47e-4),
    ),
}
# Remark under the tables.
NOTE = (
    "The paper prints neither its initial control nor its weights; the ones here agree with its "
    "eigenvalues and diagonals. Small off-diagonal entries of the initial trajectory depend on "
    "details of the control. The printed covariance of the initial trajectory is 1.3 to 1.6 times "
    "its own bound in ℓ and c; an efficient estimator stays closer."
)

# Names of the two trajectories in the tables.
TITLES = {"initial": "initial", "final": "designed"}

# Numbers of the figures that mjfim draws, by the names of its pictures.
FIGURES = {
    "trajectories": "figure_2",
    "convergence": "convergence",
    "histogram_c": "figure_4",
    "histogram_m": "figure_5",
    "histogram_l": "figure_6",
}

# Places of the entries of a symmetric matrix: its upper triangle.
UPPER = tuple(zip(*np.triu_indices(3), strict=True))


def difference(printed: float, ours: float) -> str:
    """Return the relative difference in percent."""
    return f"{100 * (ours / printed - 1):+.1f} %"


def matrix_table(name: str, study: MonteCarloStudy) -> Table:
    """Compare all six entries of each symmetric matrix for one trajectory, Tables II and III."""
    found = study.sets[name]
    title = (
        f"Tables II and III, {TITLES[name]} trajectory, 25 Hz: covariance ({found.trials} trials), "
        "Fisher information, bound"
    )
    headings = ["entry"]
    for quantity in ("cov.", "inf.", "bound"):
        headings += [f"paper {quantity}", "mjfim", "diff."]
    table = new_table(title, *headings)

    computed = (found.covariance, study.information[name], found.crlb)
    for k, (i, j) in enumerate(UPPER):
        cells = [f"{'mℓc'[i]}{'mℓc'[j]}"]
        for theirs, ours in zip(PAPER[name][1:], computed, strict=True):
            value = float(ours[i, j])
            cells += [f"{theirs[k]:.3g}", f"{value:.3g}", difference(theirs[k], value)]
        table.add_row(*cells)

    return table


def main() -> None:
    """Run the study and print every comparison."""
    parser = options_of(__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/paper"))
    parser.add_argument("--trials", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    console = Console(highlight=False, width=125)

    # Table I. The printed cost does not contain the weighted terms; it is compared with the
    # criterion 1/lambda_3.
    task = DesignTask.resolve(mjfim.Experiment.from_file(EXPERIMENT))
    design = design_task(task)
    title = "Table I: eigenvalues of the information, and cost"
    table = new_table(title, "quantity", "paper", "mjfim", "difference")

    for name, side in (("initial", design.initial), ("final", design.final)):
        computed = [*side.eigenvalues[::-1].tolist(), side.criterion]
        quantities = ("λ1", "λ2", "λ3", "J")
        for quantity, theirs, ours in zip(quantities, PAPER[name][0], computed, strict=True):
            numbers = (f"{theirs:.5g}", f"{ours:.5g}", difference(theirs, ours))
            table.add_row(f"{TITLES[name]} {quantity}", *numbers)
    console.print(table)

    # Tables II and III.
    curves = {"initial": design.initial.trajectory, "final": design.trajectory}
    study = mjfim.monte_carlo(
        task.experiment, curves, trials=args.trials, seed=args.seed, measure_rate=25.0
    )
    for name in PAPER:
        console.print(matrix_table(name, study))
    console.print(NOTE)

    # Files.
    folder, labels = args.output, labels_of_system(task.system)
    folder.mkdir(parents=True, exist_ok=True)
    write_data(folder, design, task.system)
    write_json(folder / "montecarlo_25Hz.json", study.summary())
    for name, file in FIGURES.items():
        draw(study if name.startswith("histogram") else design, name, folder / f"{file}.png")

    # Phase plots of the sensitivities to each parameter, of the coordinate whose velocity it
    # changes most (figure 3). Each curve starts at time 0 without sensitivity.
    nv = design.trajectory.qvel.shape[1]
    fastest = np.abs(design.trajectory.qvel).max(axis=0)
    figure, axes = plt.subplots(1, len(design.theta), figsize=(9.0, 3.2), layout="constrained")
    for j, axis in enumerate(axes):
        change = np.abs(design.final.sensitivity[:, nv : 2 * nv, j]).max(axis=0)
        dof = int(np.argmax(change / fastest))
        for each, colour, title in (
            (design.initial, "C0", "initial"),
            (design.final, "C3", "design"),
        ):
            axis.plot(*each.sensitivity[:, [dof, nv + dof], j].T, colour, lw=1.6, label=title)
        axis.plot(0.0, 0.0, "ko", ms=3.5, label="start")
        axis.locator_params(nbins=4)
        name, unit = split_unit(labels.positions[dof])
        of = f"∂{labels.parameters[j]}"
        per = f" / ({labels.parameter_units[j]})"
        axis.set(xlabel=f"∂{name}/{of} [{unit}{per}]", ylabel=f"∂{name}′/{of} [{unit}/s{per}]")
    handles = axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=3)
    figure.savefig(folder / "figure_3.png", dpi=110)
    plt.close(figure)
    rerun_log.log_design(folder / "design.rrd", task.system.model_at(task.theta), design, labels)
    console.print(f"wrote {folder}/: figures 2-6, design.rrd (mjfim replay {folder})")


if __name__ == "__main__":
    main()
