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

import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
from rich.console import Console

from mjfim.arrays import record
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.parallel import cores
from mjfim.records.design import Design
from scripts.benchmarks.child import ROOT, new_table, options_of

# Experiment of the study.
EXPERIMENT = ROOT / "models" / "cart_pendulum.toml"

# Code of the process that runs the peers, in which BLAS has one thread from the start: the number
# of repeats, then the letters of the cases.
PEERS = """
import json
import sys
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
                iterations=run.iterations,
                prepared=run.prepared + built.build_seconds,
                history=run.history,
            ))
print(json.dumps(found))
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


@record
class Run:
    """One solver on one case.

    Attributes:
        case: Letter of the case.
        solver: Name of the solver.
        cost: J of the solution.
        iterations: Number of iterations.
        prepared: Time before the first iterate [s].
        history: Time [s] and J of every iterate.
    """

    case: str
    solver: str
    cost: float
    iterations: int
    prepared: float
    history: list[tuple[float, float]]

    def reached(self, others: list[Run]) -> tuple[int, float]:
        """Iterations and time until J is near the best of some runs, infinite if it never is."""
        goal = min(run.cost for run in others) * (1 + CLOSE)
        found = ((i, t) for i, (t, J) in enumerate(self.history) if goal >= J)
        return next(found, (0, np.inf))


def mjfim_run(repeats: int, case: str, name: str, **descent: Any) -> tuple[Run, Design]:
    """The fastest of several identical designs.

    Args:
        repeats: Number of designs.
        case: Letter of the case.
        name: Name of the solver in the tables.
        **descent: Settings of the descent.
    """
    experiment = Experiment.from_file(EXPERIMENT).replace(cost=CASES[case], descent=descent)
    found = []
    for _ in range(repeats):
        clock = time.perf_counter()
        task = DesignTask.resolve(experiment)
        prepared = time.perf_counter() - clock
        found.append((design_task(task), prepared))
    design, prepared = min(found, key=lambda pair: pair[0].seconds)

    # The cost of a coarse level cannot be compared with that of the stated samples.
    last = design.history[-1]
    rows = [(r.seconds, r.cost if r.rate == last.rate else np.inf) for r in design.history]
    cost = design.final.cost
    return Run(
        case=case,
        solver=name,
        cost=cost,
        iterations=last.iteration,
        prepared=prepared,
        history=rows,
    ), design


def main() -> None:
    """Run all comparisons and print their tables."""
    parser = options_of(__doc__)
    parser.add_argument("--quick", action="store_true", help="case a only, one repeat")
    args = parser.parse_args()

    console = Console(highlight=False, width=130)
    cases, repeats = ("a", 1) if args.quick else ("".join(CASES), 3)

    # (a), after a first design that is not measured.
    mjfim_run(1, cases[0], "warm-up")
    default = [mjfim_run(repeats, case, "mjfim") for case in cases]
    flat = [mjfim_run(repeats, case, "mjfim, one level", coarse=1) for case in cases]
    headings = ("case", "descent", "steps", "mj_step", "engine", "wall", "ratio")
    table = new_table("(a) design over bare engine time (target 1.3)", *headings, texts=2)
    for run, design in [*default, *flat]:
        # The model of the user is stepped many times in each call, from states of the motion.
        task = DesignTask.resolve(Experiment.from_file(EXPERIMENT).replace(cost=CASES[run.case]))
        model, data = task.system.model_at(task.theta), mujoco.MjData(task.system.model)
        motion, step = design.trajectory, np.inf
        for k in range(0, motion.samples, 20):
            data.qpos[:], data.qvel[:] = motion.qpos[k], motion.qvel[k]
            data.ctrl[:] = motion.ctrl[k]
            clock = time.perf_counter()
            mujoco.mj_step(model, data, 500)
            step = min(step, (time.perf_counter() - clock) / 500)
        engine = design.steps * step / cores()
        cells = (run.case, run.solver, f"{design.steps:,}", f"{1e6 * step:.2f} µs")
        ratio = f"{design.seconds / engine:.2f}"
        table.add_row(*cells, f"{engine:.3f} s", f"{design.seconds:.3f} s", ratio)
    console.print(table)

    # (b)
    title = "(b) seconds until J is within 1e-6 of the best J found from this start"
    others = ("J", "iterations", "to 1e-6", "before the first iterate")
    table = new_table(title, "case", "solver", *others, texts=2)
    peers = subprocess.run(
        [sys.executable, "-c", PEERS, str(repeats), cases],
        capture_output=True,
        text=True,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)},
        check=False,
    )
    runs = [run for run, _ in default]
    if peers.returncode:
        print(f"left out: {peers.stderr.strip().splitlines()[-1]}", file=sys.stderr)
    else:
        runs += [Run(**row) for row in json.loads(peers.stdout.splitlines()[-1])]
    for run in sorted(runs, key=lambda run: run.case):
        seconds = run.reached([each for each in runs if each.case == run.case])[1]
        cells = (run.case, run.solver, f"{run.cost:.9g}", str(run.iterations))
        time_to = f"{seconds:.3f} s" if np.isfinite(seconds) else "never"
        table.add_row(*cells, time_to, f"{run.prepared:.2f} s")
    console.print(table)

    # (c)
    title = "(c) beside the paper's metric descent, to the same J"
    table = new_table(title, "case", "descent", "iterations", "seconds", "J", texts=2)
    for own, design in flat:
        settings = {"method": "metric", "max_iterations": 400}
        metric, other = mjfim_run(1, own.case, "metric (the paper's)", **settings)
        mine = replace(own, solver="L-BFGS on the manifold")
        for run, whole in ((mine, design), (metric, other)):
            count, seconds = run.reached([mine, metric])
            told = ("never", f"> {whole.seconds:.1f} s")
            if np.isfinite(seconds):
                told = (f"{count:.0f}", f"{seconds:.2f} s")
            table.add_row(run.case, run.solver, *told, f"{run.cost:.9g}")
    console.print(table)
