"""Where the time goes, as ratios inside one run: mjfim against the engine, against CasADi, against
its own metric descent.

    python -m scripts.benchmarks benchmark                  # all tables, some minutes
    python -m scripts.benchmarks benchmark --quick          # case a only, few trials
    python -m scripts.benchmarks benchmark --markdown FILE  # the same tables for the README

(a) wall time of a design over MuJoCo steps taken x time of one `mj_step` in C / threads
(b) time until J is within 1e-6 (relative) of the best J of all solvers, beside CasADi on the
hand-derived model (c) iterations and time beside the paper's metric descent, to the same J
(d) 1500 Monte-Carlo trials at 100 Hz
(e) seconds per iteration by number of parameters on a seven-joint arm, where its model is at hand
(benchmark_arm) (f) the hard-limited design beside CasADi + IPOPT with many starts, the same seconds
for both (benchmark_limits) (g) an hour of two joints at 1 kHz read and fitted, over bare engine
time (benchmark_hour)
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
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
from scripts.benchmarks import benchmark_arm, benchmark_hour, benchmark_limits
from scripts.benchmarks.run_in_subprocess import run_in_subprocess

ROOT = Path(__file__).resolve().parents[2]
EXPERIMENT = ROOT / "models" / "cart_pendulum.toml"
PEERS = """
from scripts.benchmarks import casadi_peer as p
found = []
for use_c in (True, False):
    built = p.problem(use_c)
    if use_c and not built.compiled: continue
    for case in sys.argv[2]:
        for solve in (p.ipopt, p.lbfgs):
            r = min((solve(p.CASES[case], use_c) for _ in range(int(sys.argv[1]))), key=lambda r: r.seconds)
            found.append(dict(case=case, solver=r.name + ("" if use_c else " (VM)"), cost=r.J, seconds=r.seconds,
                iterations=r.iterations, task=r.setup_seconds + built.build_seconds, history=r.history))
"""
CLOSE = 1e-6
CASES: dict[str, dict[str, Any]] = {
    "a": {"control": 6e-3, "tracking": {}},
    "b": {"control": 1e-3, "tracking": {"slide": 0.05}},
    "c": {"control": 1e-4, "tracking": {}},
    "f": {"control": 1e-6, "tracking": {}},
}


@dataclass(frozen=True)
class Run:
    """One solver on one case. history: (seconds, J) of every iterate; task: seconds before the
    first of them.
    """

    case: str
    solver: str
    cost: float
    iterations: int
    seconds: float
    task: float
    history: tuple[tuple[float, float], ...]

    def time_to(self, cost: float) -> float:
        """Seconds until J <= cost, infinite if never."""
        return next((t for t, J in self.history if cost >= J), np.inf)

    def iterations_to(self, cost: float) -> float:
        """Iterates until J <= cost, infinite if never."""
        return next((float(i) for i, (_, J) in enumerate(self.history) if cost >= J), np.inf)


def experiment(case: str, **descent: Any) -> Experiment:
    """The cart-pendulum at a case's weights."""
    return Experiment.from_file(EXPERIMENT).replace(cost=CASES[case], descent=descent)


def step_seconds(task: DesignTask, trajectory: mjfim.Trajectory) -> float:
    """Seconds of one `mj_step` in C: the user's model, stepped many times per call along the
    designed motion.
    """
    model, data = task.system.model_at(task.theta), mujoco.MjData(task.system.model)
    best = np.inf
    for k in range(0, trajectory.samples, 20):
        data.qpos[:], data.qvel[:], data.ctrl[:] = (
            trajectory.qpos[k],
            trajectory.qvel[k],
            trajectory.ctrl[k],
        )
        clock = time.perf_counter()
        mujoco.mj_step(model, data, 500)
        best = min(best, (time.perf_counter() - clock) / 500)
    return float(best)


def fastest(repeats: int, case: str, name: str, **descent: Any) -> tuple[Run, Design]:
    """The quickest of several identical designs."""
    return min(
        (mjfim_run(case, name, **descent) for _ in range(repeats)), key=lambda pair: pair[0].seconds
    )


def mjfim_run(case: str, name: str, **descent: Any) -> tuple[Run, Design]:
    """One design."""
    clock = time.perf_counter()
    task = DesignTask.resolve(experiment(case, **descent))
    prepared = time.perf_counter() - clock
    design = design_task(task)
    fine = design.history[-1].rate
    history = tuple(
        (row.seconds, row.cost if row.rate == fine else np.inf) for row in design.history
    )
    run = Run(
        case,
        name,
        design.final.cost,
        design.history[-1].iteration,
        design.seconds,
        prepared,
        history,
    )
    return run, design


def peer_runs(cases: Iterable[str], repeats: int) -> list[Run]:
    """CasADi's; none where it is missing."""
    rows = run_in_subprocess(PEERS, repeats, "".join(cases))
    return [
        Run(**{**row, "history": tuple((t, J) for t, J in row["history"])}) for row in rows or ()
    ]


def table(title: str, *headings: str) -> Table:
    """An empty table."""
    new = Table(title=title, title_justify="left")
    for i, heading in enumerate(headings):
        new.add_column(heading, justify="left" if i < 2 else "right")
    return new


def engine_table(designs: list[tuple[Run, Design]], threads: int) -> Table:
    """(a)"""
    rows = table(
        "(a) design over bare engine time (target 1.3)",
        "case",
        "descent",
        "steps",
        "mj_step",
        "engine",
        "wall",
        "ratio",
    )
    for run, design in designs:
        step = step_seconds(DesignTask.resolve(experiment(run.case)), design.trajectory)
        engine = design.steps * step / threads
        rows.add_row(
            run.case,
            run.solver,
            f"{design.steps:,}",
            f"{1e6 * step:.2f} µs",
            f"{engine:.3f} s",
            f"{run.seconds:.3f} s",
            f"{run.seconds / engine:.2f}",
        )
    return rows


def peer_table(runs: list[Run]) -> Table:
    """(b)"""
    rows = table(
        "(b) seconds until J is within 1e-6 of the best J found from this start",
        "case",
        "solver",
        "J",
        "iterations",
        "to 1e-6",
        "mjfim is",
        "before the first iterate",
    )
    for case in dict.fromkeys(run.case for run in runs):
        own = [run for run in runs if run.case == case]
        goal = min(run.cost for run in own) * (1 + CLOSE)
        mine = next(run for run in own if run.solver == "mjfim").time_to(goal)
        for run in own:
            taken = run.time_to(goal)
            ratio = "" if run.solver == "mjfim" else comparison(mine, taken)
            seconds = f"{taken:.3f} s" if np.isfinite(taken) else "never"
            rows.add_row(
                case,
                run.solver,
                f"{run.cost:.9g}",
                str(run.iterations),
                seconds,
                ratio,
                f"{run.task:.2f} s",
            )
    return rows


def comparison(mine: float, theirs: float) -> str:
    """How mine compares."""
    if not np.isfinite(mine):
        return "never there"
    return f"{theirs / mine:.1f} × faster" if theirs >= mine else f"{mine / theirs:.1f} × slower"


def metric_table(pairs: list[tuple[Run, Run]]) -> Table:
    """(c)"""
    rows = table(
        "(c) beside the paper's metric descent, to the same J",
        "case",
        "descent",
        "iterations",
        "seconds",
        "J",
    )
    for mine, metric in pairs:
        goal = min(mine.cost, metric.cost) * (1 + CLOSE)
        for run in (mine, metric):
            count, seconds = run.iterations_to(goal), run.time_to(goal)
            text = (
                (f"{count:.0f}", f"{seconds:.2f} s")
                if np.isfinite(count)
                else ("never", f"> {run.seconds:.1f} s")
            )
            rows.add_row(run.case, run.solver, *text, f"{run.cost:.9g}")
    return rows


def monte_carlo_table(design: Design, trials: int) -> Table:
    """(d)"""
    rows = table(
        f"(d) {trials} Monte-Carlo trials at 100 Hz (target 15 s)",
        "trajectory",
        "failed",
        "seconds",
    )
    curves = {"initial": design.initial.trajectory, "final": design.trajectory}
    study = mjfim.monte_carlo(experiment("b"), curves, trials=trials, seed=0)
    for name, s in study.sets.items():
        rows.add_row(name, str(s.failed), f"{s.seconds:.1f} s")
    return rows


def engine_verdict(designs: list[tuple[Run, Design]], threads: int) -> str:
    """What (a) comes to."""
    ratios: dict[str, list[float]] = {}
    for run, design in designs:
        step = step_seconds(DesignTask.resolve(experiment(run.case)), design.trajectory)
        ratios.setdefault(run.solver, []).append(run.seconds * threads / (design.steps * step))
    told = [
        f"{name} {min(r):.2f} to {max(r):.2f}, {judged(max(r), 1.3)}" for name, r in ratios.items()
    ]
    return (
        f"Ratios: {'; '.join(told)}. What is over 1: the projection runs on one thread; Riccati "
        "and L-BFGS run in Python; a coarse level has few steps to spread that over."
    )


def judged(worst: float, target: float) -> str:
    """Whether the worst case meets a target, and by how much it misses."""
    return (
        f"target {target:g} met"
        if worst <= target
        else f"target {target:g} missed by a factor {worst / target:.2g}"
    )


def peer_verdict(runs: list[Run]) -> str:
    """What (b) comes to."""
    worst: dict[str, list[float]] = {}
    for case in dict.fromkeys(run.case for run in runs):
        own = [run for run in runs if run.case == case]
        goal = min(run.cost for run in own) * (1 + CLOSE)
        mine = next(run for run in own if run.solver == "mjfim").time_to(goal)
        for run in own:
            if run.solver != "mjfim":
                worst.setdefault(run.solver, []).append(mine / run.time_to(goal))
    told = [
        f"{name} {min(r):.2g} to {max(r):.2g}, {judged(max(r), 5.0 if 'L-BFGS' in name else 1.0)}"
        for name, r in worst.items()
    ]
    return (
        f"mjfim's time over theirs: {'; '.join(told)}. The limit is the engine: a general mj_step "
        "takes microseconds where a step of the hand-derived model, compiled for this one plant, "
        "takes a fraction of one."
    )


def markdown(tables: list[Table], verdicts: dict[int, str], threads: int) -> str:
    """The tables for the README; the machine is named by its cores alone."""
    parts = [f"Measured on {threads} cores."]
    for k, t in enumerate(tables):
        cells = [list(column.cells) for column in t.columns]
        header = " | ".join(str(column.header) for column in t.columns)
        lines = [f"**{t.title}**", "", f"| {header} |", "|" + "---|" * len(t.columns)]
        lines += ["| " + " | ".join(str(c[i]) for c in cells) + " |" for i in range(t.row_count)]
        parts.append("\n".join(lines))
        parts += [verdicts[k]] if k in verdicts else []
    return "\n\n".join(parts) + "\n"


def main() -> None:
    """Run and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="case a only, 100 trials, one repeat")
    parser.add_argument("--markdown", type=Path, help="also write the tables as Markdown")
    args = parser.parse_args()
    console, threads = Console(highlight=False, width=130), cores()
    cases, repeats, trials = (["a"], 1, 100) if args.quick else (list(CASES), 3, 1500)
    mjfim_run(cases[0], "warm-up")
    default = [fastest(repeats, case, "mjfim") for case in cases]
    flat = [fastest(repeats, case, "mjfim, one level", coarse=1) for case in cases]
    tables = [engine_table([*default, *flat], threads)]
    verdicts = {0: engine_verdict([*default, *flat], threads)}
    console.print(tables[-1], verdicts[0])
    runs = [*(run for run, _ in default), *peer_runs(cases, repeats)]
    tables.append(peer_table(runs))
    verdicts[1] = peer_verdict(runs)
    console.print(tables[-1], verdicts[1])
    metric = [
        mjfim_run(case, "metric (the paper's)", method="metric", max_iterations=400)[0]
        for case in cases
    ]
    named = [dataclasses.replace(run, solver="L-BFGS on the manifold") for run, _ in flat]
    tables.append(metric_table(list(zip(named, metric, strict=True))))
    console.print(tables[-1])
    tables.append(monte_carlo_table(default[-1][1] if args.quick else default[1][1], trials))
    console.print(tables[-1])
    if benchmark_arm.ARM.is_file() and not args.quick:
        tables.append(
            benchmark_arm.cost_table(
                [benchmark_arm.measured(benchmark_arm.ARM, p, 8) for p in (3, 10, 30, 70)]
            )
        )
        console.print(tables[-1])
    seconds = 10.0 if args.quick else 60.0
    tables.append(benchmark_limits.limits_table(benchmark_limits.run_both(seconds, 0), seconds))
    console.print(tables[-1])
    tables.append(
        benchmark_hour.hour_table(benchmark_hour.measured(0.01 if args.quick else 1.0, 0))
    )
    console.print(tables[-1])
    if args.markdown:
        args.markdown.write_text(markdown(tables, verdicts, threads), encoding="utf-8")
