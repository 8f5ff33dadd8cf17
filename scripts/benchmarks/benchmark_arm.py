"""Time of an E-optimal iteration by the number of parameters, on a seven-joint arm.

    python -m scripts.benchmarks benchmark_arm [--model panda_nohand_nomesh.xml] [--iterations 10]

The parameters are p = 3, 10, 30 or 70 barycentric coordinates of the inertias of the last links.
The experiment takes 5 s at 100 Hz, with position servos inside the model. The value of J needs psi,
its gradient A, B and mixed derivatives along one direction for every p. Both are computed in closed
form; the last tables show the parts of an iteration, in closed form and by differences of rollouts.
All cores: seconds of the processor in an iteration, which tell more than the time of an iteration
where other programs run.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
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
from mjfim.records.events import DesignEvent
from scripts.benchmarks.iteration_parts import IterationParts, measure, parts_table

# Models that others wrote, beside the repository.
MODELS = Path(__file__).resolve().parents[3] / "shared" / "models"

# Model of the arm.
ARM = MODELS / "menagerie_panda" / "panda_nohand_nomesh.xml"

# Numbers of parameters.
COUNTS = (3, 10, 30, 70)

# Numbers of parameters whose iterations are divided into parts, with the time of an iteration on
# two cores that is aimed at [s].
AIMS = {30: 0.25, 70: 0.35}


@dataclass(frozen=True)
class Cost:
    """Times with p parameters.

    Attributes:
        p: Number of parameters.
        identifiable: Number of identifiable combinations.
        survey: Time of finding what is identifiable [s].
        survey_steps: Engine steps of that.
        all_moved: Time of J where all parameters are moved [s].
        value: Time of J where lumped parameters follow from the others, as in a design [s].
        gradient: Time of the gradient of J, with A and B [s].
        iteration: Time of a whole iteration of the design [s].
        processor: Time of all cores in an iteration of the design [s].
        steps: Engine steps of an iteration of the design.
    """

    p: int
    identifiable: int
    survey: float
    survey_steps: int
    all_moved: float
    value: float
    gradient: float
    iteration: float
    processor: float
    steps: float


def experiment(model: Path, p: int, iterations: int) -> Experiment:
    """Make the experiment of the arm.

    Args:
        model: MJCF of the arm.
        p: Number of unknown inertial parameters, counted from the tip of the arm.
        iterations: Number of iterations of the design.

    Returns:
        The experiment.
    """
    return Experiment(**tables_of(model, p, iterations))


def tables_of(model: Path, p: int, iterations: int) -> dict[str, Any]:
    """Tables of the experiment, see `experiment`."""
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
    return {
        "model": str(model),
        "rate": 100.0,
        "horizon": 5.0,
        "initial": {"keyframe": "home", "control": chirp},
        "parameters": unknown,
        "noise": noise,
        "cost": {"control": 1.0},
        "descent": {"max_iterations": iterations, "coarse": 1},
        "limits": {"enforce": False},
    }


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
    processor: list[float] = []
    steps: list[int] = []

    def note(event: DesignEvent) -> None:
        """Note the time and the engine steps of an iterate."""
        seconds.append(event.row.seconds)
        processor.append(time.process_time())
        steps.append(event.row.steps)

    design_task(task, callback=note)
    count = max(len(seconds) - 1, 1)

    curve = task.initial
    sensitivity = task.plant.derivatives.sensitivity(task.theta, curve)
    if sensitivity is None:
        raise SystemExit("the arm diverges")

    steps_before = task.plant.engine_steps
    clock = time.perf_counter()
    basis = task.identifiability_test.along(curve, sensitivity).basis
    survey = time.perf_counter() - clock
    survey_steps = task.plant.engine_steps - steps_before

    # The models at moved parameters are written before the clock starts, as in a design.
    problem = DescentLevel(task, basis).problem
    without_lumping = replace(problem, lumped=None)
    problem.point(curve, FORWARD_DIFFERENCES)
    without_lumping.point(curve, FORWARD_DIFFERENCES)

    clock = time.perf_counter()
    without_lumping.point(curve, FORWARD_DIFFERENCES)
    all_moved = time.perf_counter() - clock

    clock = time.perf_counter()
    point = problem.point(curve, FORWARD_DIFFERENCES)
    value = time.perf_counter() - clock

    clock = time.perf_counter()
    problem.expand(point)
    gradient = time.perf_counter() - clock

    return Cost(
        p=p,
        identifiable=0 if point.criterion is None else len(point.criterion.eigenvalues),
        survey=survey,
        survey_steps=survey_steps,
        all_moved=all_moved,
        value=value,
        gradient=gradient,
        iteration=(seconds[-1] - seconds[0]) / count,
        processor=(processor[-1] - processor[0]) / count,
        steps=(steps[-1] - steps[0]) / count,
    )


def cost_table(costs: list[Cost]) -> Table:
    """Make table (e): one row for each p, with the growth beside the first one and a bar."""
    title = "(e) seconds per E-optimal iteration, seven-joint arm, 5 s at 100 Hz"
    table = Table(title=title, title_justify="left")
    headings = (
        "p",
        "identifiable",
        "finding what\nis identifiable",
        "steps of\nfinding it",
        "J (all moved)",
        "J (psi)",
        "gradient",
        "gradient\n/ p = 3",
        "iteration",
        "all cores",
        "steps of an\niteration",
    )
    for heading in headings:
        table.add_column(heading, justify="right")
    table.add_column("curve")

    longest = max(cost.iteration for cost in costs)
    for cost in costs:
        table.add_row(
            str(cost.p),
            str(cost.identifiable),
            f"{cost.survey:.2f} s",
            f"{cost.survey_steps:,}",
            f"{cost.all_moved:.2f} s",
            f"{cost.value:.2f} s",
            f"{cost.gradient:.2f} s",
            f"{cost.gradient / costs[0].gradient:.2f}",
            f"{cost.iteration:.2f} s",
            f"{cost.processor:.2f} s",
            f"{cost.steps:,.0f}",
            "█" * max(1, round(24 * cost.iteration / longest)),
        )

    return table


def print_parts(console: Console, model: Path, p: int, iterations: int) -> None:
    """Print the parts of an iteration, in closed form and by differences.

    Args:
        console: Where to print.
        model: MJCF of the arm.
        p: Number of parameters.
        iterations: Number of iterations.
    """

    def parts(closed_form: bool) -> IterationParts:
        """Measure a design of its own."""
        return measure(DesignTask.resolve(experiment(model, p, iterations)), closed_form)

    closed, differences = parts(True), parts(False)
    console.print(parts_table(closed, f"(e2) p = {p}, in closed form"))
    console.print(parts_table(differences, f"(e2) p = {p}, by differences"))
    console.print(
        f"p = {p}: {closed.seconds:.2f} s of the processor in an iteration instead of "
        f"{differences.seconds:.2f} s (aim: {AIMS[p]:.2f} s on two cores)\n"
        f"over the time of the bare engine for the steps of differences: "
        f"{closed.seconds / differences.engine:.2f} in closed form, "
        f"{differences.seconds / differences.engine:.2f} by differences (aim: 1.15)\n"
        f"J of the iterates, in closed form: {_numbers(closed.costs)}\n"
        f"J of the iterates, by differences: {_numbers(differences.costs)}\n"
    )


def _numbers(values: tuple[float, ...]) -> str:
    """Numbers with five digits."""
    return " ".join(f"{value:.5g}" for value in values)


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

    console = Console(highlight=False, width=170)
    costs = [measured(args.model, p, args.iterations) for p in COUNTS]
    console.print(cost_table(costs), f"{cores()} cores")
    for p in AIMS:
        print_parts(console, args.model, p, args.iterations)
