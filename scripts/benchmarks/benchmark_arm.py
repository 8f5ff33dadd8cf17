"""How the cost of an E-optimal iteration grows with the number of parameters, on a seven-joint arm.

    python -m scripts.benchmarks benchmark_arm [--model panda_nohand_nomesh.xml] [--iterations 10]

p = 3, 10, 30, 70 parameters of the last links' inertias (barycentric), 5 s at 100 Hz, position
servos inside the model. The value of J needs psi, 2p rollouts; its gradient needs one direction,
whatever p is.
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

ARM = (
    Path(__file__).resolve().parents[3]
    / "shared"
    / "models"
    / "menagerie_panda"
    / "panda_nohand_nomesh.xml"
)
COUNTS = (3, 10, 30, 70)


@dataclass(frozen=True)
class Cost:
    """Seconds at p parameters, s of whose combinations are identifiable.

    value: J;  gradient: its gradient, A and B;  iteration: of the design, all in
    """

    p: int
    identifiable: int
    value: float
    gradient: float
    iteration: float


def experiment(model: Path, p: int, iterations: int) -> Experiment:
    """The arm with p unknown inertial parameters, counted from its tip."""
    if p == 3:
        unknown: dict[str, Any] = {
            f"c{i}": {"target": f"body/link7:firstmoment[{i}]"} for i in range(3)
        }
    else:
        links = range(8 - p // 10, 8)
        unknown = {f"L{i}": {"inertial": f"link{i}", "coordinates": "barycentric"} for i in links}
    noise = {"state": 0.02, **{f"qpos:joint{i}": 0.002 for i in range(1, 8)}}
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
    """Run the design for some iterations, then time its parts."""
    task = DesignTask.resolve(experiment(model, p, iterations))
    seconds: list[float] = []
    design_task(task, callback=lambda event: seconds.append(event.row.seconds))
    curve = task.initial
    sensitivity = task.plant.derivatives.sensitivity(task.theta, curve)
    if sensitivity is None:
        raise SystemExit("the arm diverges")
    problem = DescentLevel(task, task.identifiability_test.along(curve, sensitivity).basis).problem
    clock = time.perf_counter()
    point = problem.point(curve, FORWARD_DIFFERENCES)
    value = time.perf_counter() - clock
    clock = time.perf_counter()
    problem.expand(point)
    gradient = time.perf_counter() - clock
    seen = 0 if point.criterion is None else len(point.criterion.eigenvalues)
    return Cost(p, seen, value, gradient, (seconds[-1] - seconds[0]) / max(len(seconds) - 1, 1))


def cost_table(costs: list[Cost]) -> Table:
    """One row per p, the growth beside p = 3, and a bar."""
    rows = Table(
        title="(e) seconds per E-optimal iteration, seven-joint arm, 5 s at 100 Hz",
        title_justify="left",
    )
    for heading in (
        "p",
        "identifiable",
        "J (psi)",
        "gradient",
        "gradient / p = 3",
        "iteration",
        "curve",
    ):
        rows.add_column(heading, justify="left" if heading == "curve" else "right")
    longest = max(cost.iteration for cost in costs)
    for cost in costs:
        rows.add_row(
            str(cost.p),
            str(cost.identifiable),
            f"{cost.value:.2f} s",
            f"{cost.gradient:.2f} s",
            f"{cost.gradient / costs[0].gradient:.2f}",
            f"{cost.iteration:.2f} s",
            "█" * max(1, round(24 * cost.iteration / longest)),
        )
    return rows


def main() -> None:
    """Run and print."""
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
