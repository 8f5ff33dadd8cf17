"""Reproduce the study of Wilson & Murphey (2014): the numbers of Tables I-III and Figures 2-6.

    python -m scripts.reproduce_paper -o out/paper

The paper does not print its weights. The experiment file holds weights that reproduce its optimized
matrices to a few percent. Its Monte-Carlo tables are those of measurements at 25 Hz, although its
text says 100 Hz; both rates are run here.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

import mjfim
from mjfim.arrays import Array
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import labels_of_system
from mjfim.files import write_json
from mjfim.model.coordinates import split_unit
from mjfim.model.units import per_second
from mjfim.output import rerun as rerun_log
from mjfim.output.archive import write_data
from mjfim.output.page import DESIGNED, INITIAL
from mjfim.output.panels import Axis, Panel, Picture, dots, grid, line
from mjfim.output.plots.draw import save
from mjfim.output.plots.pictures import draw
from mjfim.output.words import quotient_unit
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from mjfim.records.design import Design
from mjfim.records.studies import MonteCarloStudy
from mjfim.records.trajectory import Labels, Trajectory
from scripts.benchmarks.child import new_table, options_of

# Experiment of the study.
EXPERIMENT = Path(__file__).resolve().parents[1] / "models" / "cart_pendulum.toml"


@dataclass(frozen=True)
class Printed:
    """Numbers that the paper prints for one trajectory.

    Matrices are given by their upper triangles, in the order (11, 12, 13, 22, 23, 33).

    Attributes:
        eigenvalues: Eigenvalues of the information, ascending.
        cost: Cost without weighted terms.
        covariance: Covariance of the Monte-Carlo estimates.
        information: Fisher information.
        bound: Cramer-Rao bound.
    """

    eigenvalues: tuple[float, float, float]
    cost: float
    covariance: tuple[float, ...]
    information: tuple[float, ...]
    bound: tuple[float, ...]


# Numbers of the paper.
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
# Remark under the tables.
NOTE = (
    "The paper prints neither its initial control nor its weights; the ones here agree with its "
    "eigenvalues and diagonals. Small off-diagonal entries of the initial trajectory depend on "
    "details of the control. The printed covariance of the initial trajectory is 1.3 to 1.6 times "
    "its own bound in ℓ and c; an efficient estimator stays closer."
)

# Names of the two trajectories in the tables.
TITLES = {"initial": "initial", "final": "designed"}

# Places of the entries of a symmetric matrix: its upper triangle.
UPPER = tuple(zip(*np.triu_indices(3), strict=True))


def information_at(task: DesignTask, trajectory: Trajectory, measure_rate: float) -> Array:
    """Compute the Fisher information of a trajectory at another measurement rate.

    Args:
        task: The design task.
        trajectory: The trajectory.
        measure_rate: Measurement rate [Hz].

    Returns:
        (p, p) information.
    """
    other = DesignTask.resolve(task.experiment.replace(measure_rate=measure_rate))
    point = other.problem.point(trajectory, CENTRAL_DIFFERENCES)
    assert point.information is not None
    return point.information


def difference(printed: float, ours: float) -> str:
    """Return the relative difference in percent."""
    return f"{100 * (ours / printed - 1):+.1f} %"


def table_one(design: Design) -> Table:
    """Compare eigenvalues and cost.

    The printed cost does not contain the weighted terms; it is compared with the criterion
    1/lambda_3.
    """
    title = "Table I: eigenvalues of the information, and cost"
    table = new_table(title, "quantity", "paper", "mjfim", "difference")

    for name, side in (("initial", design.initial), ("final", design.final)):
        computed = [*side.eigenvalues[::-1], side.criterion]
        printed = [*PAPER[name].eigenvalues[::-1], PAPER[name].cost]
        quantities = ("λ1", "λ2", "λ3", "J")

        for quantity, theirs, value in zip(quantities, printed, computed, strict=True):
            table.add_row(
                f"{TITLES[name]} {quantity}",
                f"{theirs:.5g}",
                f"{value:.5g}",
                difference(theirs, float(value)),
            )

    return table


def matrix_table(name: str, trials: int, covariance: Array, information: Array) -> Table:
    """Compare all six entries of each symmetric matrix for one trajectory, Tables II and III.

    Args:
        name: Key of `PAPER`.
        trials: Number of Monte-Carlo trials.
        covariance: (p, p) covariance of the estimates at 25 Hz.
        information: (p, p) Fisher information at 25 Hz.

    Returns:
        Table with one row for each entry.
    """
    printed = PAPER[name]
    bound = np.asarray(np.linalg.inv(information))

    title = (
        f"Tables II and III, {TITLES[name]} trajectory, 25 Hz: covariance ({trials} trials), "
        "Fisher information, bound"
    )
    headings = ["entry"]
    for quantity in ("cov.", "inf.", "bound"):
        headings += [f"paper {quantity}", "mjfim", "diff."]
    table = new_table(title, *headings)

    for k, (i, j) in enumerate(UPPER):
        pairs = (
            (printed.covariance[k], covariance[i, j]),
            (printed.information[k], information[i, j]),
            (printed.bound[k], bound[i, j]),
        )
        cells = [f"{'mℓc'[i]}{'mℓc'[j]}"]
        for theirs, computed in pairs:
            cells += [f"{theirs:.3g}", f"{computed:.3g}", difference(theirs, float(computed))]
        table.add_row(*cells)

    return table


def sensitivity_phase(design: Design, labels: Labels) -> Picture:
    """Phase plots of the sensitivities ψ of the angle to each parameter (the paper's figure 3).

    Args:
        design: The design.
        labels: Names and units of its columns.
    """
    panels = [_phase_plot(design, labels, j) for j in range(len(design.theta))]
    note = "Each curve starts at the dot (time 0, no sensitivity); ′ is the time derivative."
    title = "Sensitivity of the motion to each parameter"
    return grid(title, panels, [2.75] * len(panels), len(panels), note)


def _phase_plot(design: Design, labels: Labels, j: int) -> Panel:
    """Sensitivity to one parameter of the coordinate whose velocity it changes most."""
    nv = design.trajectory.qvel.shape[1]
    change = np.abs(design.final.sensitivity[:, nv : 2 * nv, j]).max(axis=0)
    dof = int(np.argmax(change / np.abs(design.trajectory.qvel).max(axis=0)))
    marks = []
    for evaluation, term, front in ((design.initial, INITIAL, 3.0), (design.final, DESIGNED, 2.0)):
        position, velocity = evaluation.sensitivity[:, [dof, nv + dof], j].T
        marks.append(line(position, velocity, term, label=term, width=1.6, front=front))
    name, unit = split_unit(labels.positions[dof])
    x, y = (
        Axis(label=f"∂{name}{prime}/∂{labels.parameters[j]}\n[{shown}]", most=3)
        for prime, shown in (
            ("", quotient_unit(unit, labels.parameter_units[j])),
            ("′", quotient_unit(per_second(unit), labels.parameter_units[j])),
        )
    )
    start = dots([0.0], [0.0], "text", size=3.5, label="start", front=4.0)
    return Panel(marks=[*marks, start], x=x, y=y)


def write_figures(folder: Path, task: DesignTask, design: Design, study: MonteCarloStudy) -> None:
    """Write Figures 2-6 as PNG and the Rerun file.

    Args:
        folder: Folder that receives the files.
        task: The design task.
        design: Its design.
        study: Monte-Carlo study at 25 Hz.
    """
    names = labels_of_system(task.system)
    drawn = {
        "figure_2": (design, "trajectories"),
        "convergence": (design, "convergence"),
        **{
            f"figure_{number}": (study, f"histogram_{parameter}")
            for number, parameter in ((4, "c"), (5, "m"), (6, "l"))
        },
    }

    for name, (record, picture) in drawn.items():
        draw(record, picture, folder / f"{name}.png")
    save(sensitivity_phase(design, names), folder / "figure_3.png")
    rerun_log.log_design(folder / "design.rrd", task.system.model_at(task.theta), design, names)


def main() -> None:
    """Run the study and print every comparison."""
    parser = options_of(__doc__)
    parser.add_argument("-o", "--output", type=Path, default=Path("out/paper"))
    parser.add_argument("--trials", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    console = Console(highlight=False, width=125)

    # Table I.
    task = DesignTask.resolve(mjfim.Experiment.from_file(EXPERIMENT))
    design = design_task(task)
    console.print(table_one(design))

    # Tables II and III.
    curves = {"initial": design.initial.trajectory, "final": design.trajectory}
    studies = {}
    for rate in (25.0, 100.0):
        studies[rate] = mjfim.monte_carlo(
            task.experiment, curves, trials=args.trials, seed=args.seed, measure_rate=rate
        )

    for name in PAPER:
        information = information_at(task, curves[name], 25.0)
        covariance = studies[25.0].sets[name].covariance
        console.print(matrix_table(name, args.trials, covariance, information))
    console.print(NOTE)

    # Files.
    args.output.mkdir(parents=True, exist_ok=True)
    write_data(args.output, design, task.system)
    write_json(args.output / "montecarlo_25Hz.json", studies[25.0].summary())
    write_json(args.output / "montecarlo_100Hz.json", studies[100.0].summary())
    write_figures(args.output, task, design, studies[25.0])
    console.print(f"wrote {args.output}/: figures 2-6, design.rrd (mjfim replay {args.output})")


if __name__ == "__main__":
    main()
