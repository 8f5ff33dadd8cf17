"""Does identification keep its word?

Many recordings of a simulated robot, fitted without knowing what was done to them.

    python -m scripts.benchmarks prove_identification [--runs 200] [--seed 0] [-o FILE.json]

The robot is the cart-pendulum on the designed control, stepped at 2 kHz. Its controller ticks with
2 ms of jitter and logs at its own ticks; what it logs is read 10 ms late, with noise and constant
biases; it starts somewhere else than stated. Fitted are the parameters, delay, biases, start and
the noise itself. Counted is how often each lies inside its 95 % interval, and how often `misfit` is
raised: without a reason, and with dry friction in the cart's slide that the model does not have.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from multiprocessing import get_context
from pathlib import Path

import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

import mjfim
from mjfim.arrays import Array
from mjfim.atomic_io import replacing
from mjfim.excitation.task import DesignTask
from mjfim.identification.identify import identify_system
from mjfim.parallel import cores
from mjfim.records.recording import Recording

ROOT = Path(__file__).resolve().parents[2]
STEP = 0.0005  # [s] of the robot
JITTER, LATE, OFF = (
    0.002,
    0.010,
    0.1,
)  # [s] of ticks, [s] of readings, standard deviation of the start
SIGMA = 0.05
BIAS = {"qvel:hinge": 0.3, "qpos:hinge": -0.1}
FRICTION = 0.5  # [N] in the slide, where the model has none


@dataclass(frozen=True, eq=False)
class Outcome:
    """Of one run. inside, formally: (p,) truth inside the interval, and inside the formal one;
    error: (p,) in formal sigmas

    misfit: it was raised;  named: the friction was named as what is missing
    """

    inside: np.ndarray
    formally: np.ndarray
    error: Array
    misfit: bool
    named: bool


@cache
def prepared() -> tuple[DesignTask, Array]:
    """The experiment as the user states it, and the designed control."""
    base = mjfim.Experiment.from_file(ROOT / "models" / "cart_pendulum.toml")
    control = mjfim.design(base).trajectory.ctrl
    nuisance = {"initial": OFF, "bias": dict.fromkeys(BIAS, True), "delay": True}
    return DesignTask.resolve(
        base.replace(nuisance=nuisance, fit={"noise": "estimated"}), threads=1
    ), control


def robot(
    task: DesignTask, control: Array, friction: float, rng: np.random.Generator
) -> tuple[Array, Recording]:
    """True theta and what the robot logged."""
    p = task.parameters
    theta, names = np.array(p.true), list(p.names)
    starts = [i for i, name in enumerate(names) if name.startswith("initial")]
    theta[starts] = rng.normal(0.0, OFF, len(starts))
    for output, bias in BIAS.items():
        theta[names.index(f"bias {output}")] = bias
    theta[names.index("delay")] = LATE
    model = task.system.model_at(theta)
    model.opt.timestep = STEP
    model.dof_frictionloss[int(model.joint("slide").dofadr[0])] = friction
    N = len(control)
    ticks = np.arange(N + 1) * task.dt
    ticks[1:] += np.clip(rng.normal(0.0, JITTER, N), -0.45 * task.dt, 0.45 * task.dt)
    ticks = np.rint(ticks / STEP) * STEP
    states = stepped(model, task, theta, control, ticks)
    read = np.clip(np.rint((ticks - LATE) / STEP).astype(int), 0, len(states) - 1)
    y = (
        states[read]
        + p.bias_derivative(len(task.system.outputs)) @ theta
        + rng.normal(0.0, SIGMA, (N + 1, len(task.system.outputs)))
    )
    return theta, Recording(
        t=ticks, ctrl=control, y=y, outputs=task.system.outputs.names, name="robot"
    )


def stepped(
    model: mujoco.MjModel, task: DesignTask, theta: Array, control: Array, ticks: Array
) -> Array:
    """States at every step; the control changes at the controller's own ticks."""
    data = mujoco.MjData(model)
    qpos, qvel, _ = task.space.split(task.plant.initial_state(theta))
    data.qpos[:], data.qvel[:] = qpos, qvel
    count = round(ticks[-1] / STEP)
    tick = np.clip(
        np.searchsorted(ticks, np.arange(count) * STEP + 1e-9, side="right") - 1,
        0,
        len(control) - 1,
    )
    states = np.empty((count + 1, len(qpos) + len(qvel)))
    states[0] = [*data.qpos, *data.qvel]
    for i in range(count):
        data.ctrl[:] = control[tick[i]]
        mujoco.mj_step(model, data)
        states[i + 1] = [*data.qpos, *data.qvel]
    return states


def run(job: tuple[int, int, float]) -> Outcome:
    """One run: (seed, number, friction)."""
    seed, number, friction = job
    task, control = prepared()
    theta, recording = robot(task, control, friction, np.random.default_rng([seed, number]))
    found = identify_system(task.system, [recording])
    error = (found.theta - theta) / found.std
    inside = (found.interval[:, 0] <= theta) & (theta <= found.interval[:, 1])
    named = bool(found.missing_terms) and found.missing_terms[0].path == "joint/slide:frictionloss"
    return Outcome(inside, np.abs(error) <= 1.96, error, found.misfit, named)


def study(runs: int, seed: int, friction: float) -> list[Outcome]:
    """All runs on all cores."""
    tasks = [(seed, number, friction) for number in range(runs)]
    with ProcessPoolExecutor(cores(), mp_context=get_context("spawn")) as pool:
        return list(pool.map(run, tasks, chunksize=max(runs // (4 * cores()), 1)))


def coverage_table(names: Sequence[str], found: list[Outcome]) -> Table:
    """How often the truth was inside."""
    table = Table(
        title=f"Truth inside the 95 % interval, {len(found)} recordings (at least 90 % wanted)",
        title_justify="left",
    )
    for heading in ("unknown", "interval", "formal interval", "rms error [formal σ]"):
        table.add_column(heading, justify="left" if heading == "unknown" else "right")
    for j, name in enumerate(names):
        shares = [
            100.0 * np.mean([getattr(o, key)[j] for o in found]) for key in ("inside", "formally")
        ]
        rms = float(np.sqrt(np.mean([o.error[j] ** 2 for o in found])))
        table.add_row(name, *(f"{share:.1f} %" for share in shares), f"{rms:.2f}")
    return table


def main() -> int:
    """Run both studies and print; exit code 1 where a promise is not kept."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, help="JSON file with the shares")
    args = parser.parse_args()
    clock, console = time.perf_counter(), Console(width=100)
    names = prepared()[0].parameters.names
    right, wrong = (study(args.runs, args.seed, friction) for friction in (0.0, FRICTION))
    shares = {name: float(np.mean([o.inside[j] for o in right])) for j, name in enumerate(names)}
    false, caught, named = (
        float(np.mean([getattr(o, key) for o in found]))
        for found, key in ((right, "misfit"), (wrong, "misfit"), (wrong, "named"))
    )
    console.print(coverage_table(names, right))
    console.print(f"misfit raised without a reason: {100 * false:.1f} %")
    console.print(
        f"misfit raised with {FRICTION:g} N of dry friction that the model lacks: "
        f"{100 * caught:.1f} % (95 % wanted)"
    )
    console.print(f"  and this friction named first as what is missing: {100 * named:.1f} %")
    console.print(f"{2 * args.runs} fits in {time.perf_counter() - clock:.0f} s on {cores()} cores")
    if args.output is not None:
        told = {
            "runs": args.runs,
            "inside": shares,
            "false_misfit": false,
            "misfit": caught,
            "named": named,
        }
        with replacing(args.output) as temporary:
            temporary.write_text(json.dumps(told, indent=2) + "\n", encoding="utf-8")
    return 0 if min(shares.values()) >= 0.9 and caught >= 0.95 else 1
