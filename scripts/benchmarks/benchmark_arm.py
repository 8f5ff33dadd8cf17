"""Time of an E-optimal iteration by the number of parameters, on a seven-joint arm.

    python -m scripts.benchmarks benchmark_arm [--model panda_nohand_nomesh.xml] [--iterations 10]

The parameters are p = 3, 10, 30 or 70 barycentric coordinates of the inertias of the last links.
The experiment takes 5 s at 100 Hz, with position servos inside the model. The value of J needs psi,
which takes 2p rollouts; its gradient needs one direction for every p.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from mjfim.excitation.design import design_task
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.parallel import cores
from mjfim.plant.mixed_derivatives import FORWARD_DIFFERENCES

# Models that others wrote, beside the repository.
MODELS = Path(__file__).resolve().parents[3] / "shared" / "models"

# Model of the arm.
ARM = MODELS / "menagerie_panda" / "panda_nohand_nomesh.xml"

# Numbers of parameters.
COUNTS = (3, 10, 30, 70)


@dataclass(frozen=True)
class Cost:
    """Times with p parameters.

    Attributes:
        p: Number of parameters.
        identifiable: Number of identifiable combinations.
        value: Time of J [s].
        gradient: Time of the gradient of J, with A and B [s].
        iteration: Time of a whole iteration of the design [s].
    """

    p: int
    identifiable: int
    value: float
    gradient: float
    iteration: float


def experiment(model: Path, p: int, iterations: int) -> Experiment:
    """Make the experiment of the arm.

    Args:
        model: MJCF of the arm.
        p: Number of unknown inertial parameters, counted from the tip of the arm.
        iterations: Number of iterations of the design.

    Returns:
        The experiment.
    """
    unknown: dict[str, Any] = {}
    if p == 3:
        for i in range(3):
            unknown[f"c{i}"] = {"target": f"body/link7:firstmoment[{i}]"}
    else:
        for i in range(8 - p // 10, 8):
            unknown[f"L{i}"] = {"inertial": f"link{i}", "coordinates": "barycentric"}

    noise = {"state": 0.02}
    for i in range(1, 8):
        noise[f"qpos:joint{i}"] = 0.002

    chirp = {"kind": "chirp", "amplitude": 0.2, "frequency": 0.2}
    return Experiment(
        model=str(model),
        rate=100.0,
        horizon=5.0,
        initial={"keyframe": "home", "control": chirp},
        parameters=unknown,
        noise=noise,
        cost={"control": 1.0},
        descent={"max_iterations": iterations, "coarse": 1},
        limits={"enforce": False},
    )


def measured(model: Path, p: int, iterations: int) -> Cost:
    """Run the design for some iterations, then measure its parts.

    Args:
        model: MJCF of the arm.
        p: Number of parameters.
        iterations: Number of iterations.

    Returns:
        Times.
    """
    task = DesignTask.resolve(experiment(model, p, iterations))
    seconds: list[float] = []
    design_task(task, callback=lambda event: seconds.append(event.row.seconds))
    iteration = (seconds[-1] - seconds[0]) / max(len(seconds) - 1, 1)

    curve = task.initial
    sensitivity = task.plant.derivatives.sensitivity(task.theta, curve)
    if sensitivity is None:
        raise SystemExit("the arm diverges")
    basis = task.identifiability_test.along(curve, sensitivity).basis
    problem = DescentLevel(task, basis).problem

    clock = time.perf_counter()
    point = problem.point(curve, FORWARD_DIFFERENCES)
    value = time.perf_counter() - clock

    clock = time.perf_counter()
    problem.expand(point)
    gradient = time.perf_counter() - clock

    identifiable = 0 if point.criterion is None else len(point.criterion.eigenvalues)
    return Cost(
        p=p,
        identifiable=identifiable,
        value=value,
        gradient=gradient,
        iteration=iteration,
    )


def cost_table(costs: list[Cost]) -> Table:
    """Make table (e): one row for each p, with the growth beside the first one and a bar."""
    title = "(e) seconds per E-optimal iteration, seven-joint arm, 5 s at 100 Hz"
    table = Table(title=title, title_justify="left")
    for heading in ("p", "identifiable", "J (psi)", "gradient", "gradient / p = 3", "iteration"):
        table.add_column(heading, justify="right")
    table.add_column("curve")

    longest = max(cost.iteration for cost in costs)
    for cost in costs:
        table.add_row(
            str(cost.p),
            str(cost.identifiable),
            f"{cost.value:.2f} s",
            f"{cost.gradient:.2f} s",
            f"{cost.gradient / costs[0].gradient:.2f}",
            f"{cost.iteration:.2f} s",
            "█" * max(1, round(24 * cost.iteration / longest)),
        )

    return table


def main() -> None:
    """Measure all numbers of parameters and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--model",
        type=Path,
        default=ARM,
        help="MJCF of the arm: bodies link1 to link7, joints joint1 to 7",
    )
    parser.add_argument("--iterations", type=int, default=8)
    args = parser.parse_args()
    if not args.model.is_file():
        raise SystemExit(f"{args.model}: no such model; the arm is not part of this repository")

    console = Console(highlight=False, width=130)
    costs = [measured(args.model, p, args.iterations) for p in COUNTS]
    console.print(cost_table(costs), f"{cores()} cores")
