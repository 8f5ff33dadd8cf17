"""Where the time of a design goes: mjfim beside the engine, CasADi and its own metric descent.

    python -m scripts.benchmarks benchmark                  # all tables, some minutes
    python -m scripts.benchmarks benchmark --quick          # case a only

All comparisons are made within one run:

(a) wall time of a design, divided by the time that the engine needs for its MuJoCo steps
(b) time until J is within 1e-6 (relative) of the best J of all solvers, beside CasADi on the
    hand-derived model
(c) iterations and time to an equal J, beside the metric descent of the paper
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

import mjfim
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.parallel import cores
from mjfim.records.design import Design
from scripts.benchmarks.child import ROOT, new_table, options_of, run_code

# Experiment of the study.
EXPERIMENT = ROOT / "models" / "cart_pendulum.toml"

# Code of the process that runs the peers: the number of repeats, then the letters of the cases.
PEERS = """
from scripts.benchmarks import casadi_peer as p
repeats, cases = int(sys.argv[1]), sys.argv[2]
found = []
for use_c in (True, False):
    built = p.problem(use_c)
    if use_c and not built.compiled:
        continue
    for case in cases:
        for solve in (p.ipopt, p.lbfgs):
            runs = [solve(p.CASES[case], use_c) for _ in range(repeats)]
            run = min(runs, key=lambda run: run.seconds)
            found.append(dict(
                case=case,
                solver=run.name + ("" if use_c else " (VM)"),
                cost=run.J,
                seconds=run.seconds,
                iterations=run.iterations,
                prepared=run.setup_seconds + built.build_seconds,
                history=run.history,
            ))
"""

# Relative distance to the best J within which a solver has reached it.
CLOSE = 1e-6

# Tables `cost` of the cases of the study.
CASES: dict[str, dict[str, Any]] = {
    "a": {"control": 6e-3, "tracking": {}},
    "b": {"control": 1e-3, "tracking": {"slide": 0.05}},
    "c": {"control": 1e-4, "tracking": {}},
    "f": {"control": 1e-6, "tracking": {}},
}


@dataclass(frozen=True)
class Run:
    """One solver on one case.

    Attributes:
        case: Letter of the case.
        solver: Name of the solver.
        cost: J of the solution.
        iterations: Number of iterations.
        seconds: Time of the solver [s].
        prepared: Time before the first iterate [s].
        history: Time [s] and J of every iterate.
    """

    case: str
    solver: str
    cost: float
    iterations: int
    seconds: float
    prepared: float
    history: tuple[tuple[float, float], ...]

    def time_to(self, cost: float) -> float:
        """Return the time until J is at most a cost [s], infinite if it never is."""
        times = [t for t, J in self.history if cost >= J]
        return times[0] if times else np.inf

    def iterations_to(self, cost: float) -> float:
        """Return the number of iterations until J is at most a cost, infinite if it never is."""
        numbers = [i for i, (_, J) in enumerate(self.history) if cost >= J]
        return float(numbers[0]) if numbers else np.inf


def experiment(case: str, **descent: Any) -> Experiment:
    """Return the cart-pendulum with the weights of a case and settings of the descent."""
    return Experiment.from_file(EXPERIMENT).replace(cost=CASES[case], descent=descent)


def step_seconds(task: DesignTask, trajectory: mjfim.Trajectory) -> float:
    """Measure the time of one engine step in C.

    The model of the user is stepped many times in each call, from states of the designed motion.

    Args:
        task: The design task.
        trajectory: The designed motion.

    Returns:
        Seconds per step, the fastest of all measurements.
    """
    model = task.system.model_at(task.theta)
    data = mujoco.MjData(task.system.model)
    best = np.inf

    for k in range(0, trajectory.samples, 20):
        data.qpos[:] = trajectory.qpos[k]
        data.qvel[:] = trajectory.qvel[k]
        data.ctrl[:] = trajectory.ctrl[k]
        clock = time.perf_counter()
        mujoco.mj_step(model, data, 500)
        best = min(best, (time.perf_counter() - clock) / 500)

    return float(best)


def fastest(repeats: int, case: str, name: str, **descent: Any) -> tuple[Run, Design]:
    """Return the fastest of several identical designs.

    Args:
        repeats: Number of designs.
        case: Letter of the case.
        name: Name of the solver in the tables.
        **descent: Settings of the descent.

    Returns:
        The run and its design.
    """
    runs = [mjfim_run(case, name, **descent) for _ in range(repeats)]
    return min(runs, key=lambda pair: pair[0].seconds)


def mjfim_run(case: str, name: str, **descent: Any) -> tuple[Run, Design]:
    """Run one design; the arguments are those of `fastest`."""
    clock = time.perf_counter()
    task = DesignTask.resolve(experiment(case, **descent))
    prepared = time.perf_counter() - clock
    design = design_task(task)

    # The cost of a coarse level cannot be compared with that of the stated samples.
    fine = design.history[-1].rate
    history = []
    for row in design.history:
        cost = row.cost if row.rate == fine else np.inf
        history.append((row.seconds, cost))

    run = Run(
        case=case,
        solver=name,
        cost=design.final.cost,
        iterations=design.history[-1].iteration,
        seconds=design.seconds,
        prepared=prepared,
        history=tuple(history),
    )
    return run, design


def peer_runs(cases: Iterable[str], repeats: int) -> list[Run]:
    """Run the solvers of CasADi; the list is empty where CasADi is not installed.

    Args:
        cases: Letters of the cases.
        repeats: Number of identical runs, of which the fastest counts.

    Returns:
        One run for each solver and case.
    """
    rows = run_code(PEERS, repeats, "".join(cases))
    runs = []
    for row in rows or ():
        history = tuple((t, J) for t, J in row.pop("history"))
        runs.append(Run(history=history, **row))
    return runs


def engine_table(designs: list[tuple[Run, Design]], threads: int) -> Table:
    """Compare designs with the time of the engine, table (a).

    Args:
        designs: Runs with their designs.
        threads: Number of threads of the engine.

    Returns:
        Table with one row for each run.
    """
    title = "(a) design over bare engine time (target 1.3)"
    table = new_table(
        title, "case", "descent", "steps", "mj_step", "engine", "wall", "ratio", texts=2
    )

    for run, design in designs:
        step = step_seconds(DesignTask.resolve(experiment(run.case)), design.trajectory)
        engine = design.steps * step / threads
        table.add_row(
            run.case,
            run.solver,
            f"{design.steps:,}",
            f"{1e6 * step:.2f} µs",
            f"{engine:.3f} s",
            f"{run.seconds:.3f} s",
            f"{run.seconds / engine:.2f}",
        )

    return table


def best_cost(runs: list[Run]) -> float:
    """Return the cost that counts as the best J of some runs."""
    return min(run.cost for run in runs) * (1 + CLOSE)


def by_case(runs: list[Run]) -> dict[str, list[Run]]:
    """Return the runs of each case."""
    found: dict[str, list[Run]] = {}
    for run in runs:
        found.setdefault(run.case, []).append(run)
    return found


def peer_table(runs: list[Run]) -> Table:
    """Compare mjfim with the peers, table (b)."""
    table = new_table(
        "(b) seconds until J is within 1e-6 of the best J found from this start",
        "case",
        "solver",
        "J",
        "iterations",
        "to 1e-6",
        "before the first iterate",
        texts=2,
    )

    for case, group in by_case(runs).items():
        goal = best_cost(group)

        for run in group:
            seconds = run.time_to(goal)
            table.add_row(
                case,
                run.solver,
                f"{run.cost:.9g}",
                str(run.iterations),
                f"{seconds:.3f} s" if np.isfinite(seconds) else "never",
                f"{run.prepared:.2f} s",
            )

    return table


def metric_table(pairs: list[tuple[Run, Run]]) -> Table:
    """Compare the descent of mjfim with that of the paper, table (c).

    Args:
        pairs: Runs of mjfim and of the metric descent on the same case.

    Returns:
        Table with two rows for each case.
    """
    title = "(c) beside the paper's metric descent, to the same J"
    table = new_table(title, "case", "descent", "iterations", "seconds", "J", texts=2)

    for pair in pairs:
        goal = best_cost(list(pair))
        for run in pair:
            count = run.iterations_to(goal)
            iterations, seconds = "never", f"> {run.seconds:.1f} s"
            if np.isfinite(count):
                iterations, seconds = f"{count:.0f}", f"{run.time_to(goal):.2f} s"
            table.add_row(run.case, run.solver, iterations, seconds, f"{run.cost:.9g}")

    return table


def compare_descents(cases: list[str], flat: list[tuple[Run, Design]]) -> Table:
    """Run the metric descent of the paper and compare it with designs on one level, table (c).

    Args:
        cases: Letters of the cases.
        flat: Designs of these cases without a coarse level.

    Returns:
        The table.
    """
    pairs = []
    for case, (run, _) in zip(cases, flat, strict=True):
        mine = dataclasses.replace(run, solver="L-BFGS on the manifold")
        name = "metric (the paper's)"
        metric, _ = mjfim_run(case, name, method="metric", max_iterations=400)
        pairs.append((mine, metric))
    return metric_table(pairs)


def main() -> None:
    """Run all comparisons and print their tables."""
    parser = options_of(__doc__)
    parser.add_argument("--quick", action="store_true", help="case a only, one repeat")
    args = parser.parse_args()

    console = Console(highlight=False, width=130)
    cases, repeats = (["a"], 1) if args.quick else (list(CASES), 3)

    # (a), after a first design that is not measured.
    mjfim_run(cases[0], "warm-up")
    default = [fastest(repeats, case, "mjfim") for case in cases]
    flat = [fastest(repeats, case, "mjfim, one level", coarse=1) for case in cases]
    console.print(engine_table([*default, *flat], cores()))

    # (b)
    runs = [run for run, _ in default]
    console.print(peer_table([*runs, *peer_runs(cases, repeats)]))

    # (c)
    console.print(compare_descents(cases, flat))


if __name__ == "__main__":
    main()
