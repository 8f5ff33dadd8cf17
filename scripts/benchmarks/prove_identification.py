"""Coverage of the 95 % intervals of an identification, over many recordings of a simulated robot.

    python -m scripts.benchmarks prove_identification [--runs 200] [--seed 0] [-o FILE.json]

The robot is the cart-pendulum under the designed control, stepped at 2 kHz. Its controller has 2 ms
of jitter and logs at the times at which it really acts. The readings are 10 ms late, with noise and
constant biases, and the robot does not start at the stated state. The fit estimates the parameters,
delay, biases, start and the noise. The script counts how often each true value lies inside its 95 %
interval, and how often `misfit` is raised: without a reason, and with dry friction in the slide of
the cart that the model does not have.
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
from mjfim.arrays import NORMAL_95, Array
from mjfim.excitation.task import DesignTask
from mjfim.files import replacing
from mjfim.identification.identify import identify_system
from mjfim.parallel import cores
from mjfim.records.trajectory import Recording

# Top folder of the repository.
ROOT = Path(__file__).resolve().parents[2]

# Timestep of the robot [s].
STEP = 0.0005

# Standard deviation of the times of the controller [s].
JITTER = 0.002

# Delay of the readings [s].
DELAY = 0.010

# Standard deviation of the initial state from the stated one.
START_DEVIATION = 0.1

# Standard deviation of the noise.
SIGMA = 0.05

# Constant errors of the readings [rad/s, rad].
BIAS = {"qvel:hinge": 0.3, "qpos:hinge": -0.1}

# Dry friction in the slide [N], which the model does not have.
FRICTION = 0.5


@dataclass(frozen=True, eq=False)
class Outcome:
    """Outcome of one run.

    Attributes:
        inside: (p,) whether the interval holds the true value.
        formally: (p,) whether the formal interval, from the standard deviation, holds it.
        error: (p,) error in formal standard deviations.
        misfit: Whether a misfit was raised.
        named: Whether the friction was named as the first missing term.
    """

    inside: np.ndarray
    formally: np.ndarray
    error: Array
    misfit: bool
    named: bool


@cache
def prepared() -> tuple[DesignTask, Array]:
    """Return the task as the user states it, and the designed control (N, 1)."""
    base = mjfim.Experiment.from_file(ROOT / "models" / "cart_pendulum.toml")
    control = mjfim.design(base).trajectory.ctrl

    nuisance = {"initial": START_DEVIATION, "bias": dict.fromkeys(BIAS, True), "delay": True}
    stated = base.replace(nuisance=nuisance, fit={"noise": "estimated"})
    return DesignTask.resolve(stated, threads=1), control


def robot(
    task: DesignTask, control: Array, friction: float, rng: np.random.Generator
) -> tuple[Array, Recording]:
    """Play the control on the robot.

    Args:
        task: The task as the user states it.
        control: (N, nu) control.
        friction: Dry friction in the slide [N].
        rng: Source of random numbers.

    Returns:
        (p,) true values of all unknowns, and the recording.
    """
    p = task.parameters
    theta = np.array(p.true)
    names = list(p.names)

    # True values of start, biases and delay.
    starts = [i for i, name in enumerate(names) if name.startswith("initial")]
    theta[starts] = rng.normal(0.0, START_DEVIATION, len(starts))
    for output, bias in BIAS.items():
        theta[names.index(f"bias {output}")] = bias
    theta[names.index("delay")] = DELAY

    model = task.system.model_at(theta)
    model.opt.timestep = STEP
    model.dof_frictionloss[int(model.joint("slide").dofadr[0])] = friction

    # Times at which the controller acts, on the grid of the robot's timesteps.
    N = len(control)
    times = np.arange(N + 1) * task.dt
    times[1:] += np.clip(rng.normal(0.0, JITTER, N), -0.45 * task.dt, 0.45 * task.dt)
    times = np.rint(times / STEP) * STEP

    # Late readings with biases and noise.
    states = stepped(model, task, theta, control, times)
    rows = np.rint((times - DELAY) / STEP).astype(int)
    rows = np.clip(rows, 0, len(states) - 1)
    outputs = task.system.outputs
    biases = p.bias_derivative(len(outputs)) @ theta
    noise = rng.normal(0.0, SIGMA, (N + 1, len(outputs)))
    y = states[rows] + biases + noise

    recording = Recording(t=times, ctrl=control, y=y, outputs=outputs.names, name="robot")
    return theta, recording


def stepped(
    model: mujoco.MjModel, task: DesignTask, theta: Array, control: Array, times: Array
) -> Array:
    """Simulate the robot.

    Args:
        model: Model of the robot.
        task: The task as the user states it.
        theta: (p,) true values.
        control: (N, nu) control.
        times: (N+1,) times at which the controller acts [s].

    Returns:
        (n+1, nx) states at every engine step.
    """
    data = mujoco.MjData(model)
    qpos, qvel, _ = task.space.split(task.plant.initial_state(theta))
    data.qpos[:] = qpos
    data.qvel[:] = qvel

    # Sample of the control that acts at each step.
    count = round(times[-1] / STEP)
    clock = np.arange(count) * STEP + 1e-9
    sample = np.searchsorted(times, clock, side="right") - 1
    sample = np.clip(sample, 0, len(control) - 1)

    states = np.empty((count + 1, len(qpos) + len(qvel)))
    states[0] = [*data.qpos, *data.qvel]
    for i in range(count):
        data.ctrl[:] = control[sample[i]]
        mujoco.mj_step(model, data)
        states[i + 1] = [*data.qpos, *data.qvel]

    return states


def run(job: tuple[int, int, float]) -> Outcome:
    """Play and identify one robot.

    Args:
        job: Seed of the study, number of the run and friction [N].

    Returns:
        Outcome of the run.
    """
    seed, number, friction = job
    task, control = prepared()
    rng = np.random.default_rng([seed, number])
    theta, recording = robot(task, control, friction, rng)

    found = identify_system(task.system, [recording])
    error = (found.theta - theta) / found.std
    low, high = found.interval.T

    # Terms are sorted by how much they explain.
    first = found.missing_terms[0].path if found.missing_terms else ""
    return Outcome(
        inside=(low <= theta) & (theta <= high),
        formally=np.abs(error) <= NORMAL_95,
        error=error,
        misfit=found.misfit,
        named=first == "joint/slide:frictionloss",
    )


def study(runs: int, seed: int, friction: float) -> list[Outcome]:
    """Run many robots on all cores.

    Args:
        runs: Number of runs.
        seed: Seed of the study.
        friction: Dry friction in the slide [N].

    Returns:
        Outcomes of all runs.
    """
    tasks = [(seed, number, friction) for number in range(runs)]
    chunk = max(runs // (4 * cores()), 1)
    context = get_context("spawn")
    with ProcessPoolExecutor(cores(), mp_context=context) as pool:
        return list(pool.map(run, tasks, chunksize=chunk))


def coverage_table(names: Sequence[str], found: list[Outcome]) -> Table:
    """Make a table of how often the intervals hold the true values.

    Args:
        names: Names of the unknowns.
        found: Outcomes of all runs.

    Returns:
        Table with one row for each unknown.
    """
    title = f"Truth inside the 95 % interval, {len(found)} recordings (at least 90 % wanted)"
    table = Table(title=title, title_justify="left")
    table.add_column("unknown")
    for heading in ("interval", "formal interval", "rms error [formal σ]"):
        table.add_column(heading, justify="right")

    inside = 100.0 * np.mean([outcome.inside for outcome in found], axis=0)
    formally = 100.0 * np.mean([outcome.formally for outcome in found], axis=0)
    rms = np.sqrt(np.mean([outcome.error**2 for outcome in found], axis=0))
    for j, name in enumerate(names):
        table.add_row(name, f"{inside[j]:.1f} %", f"{formally[j]:.1f} %", f"{rms[j]:.2f}")

    return table


def share_of(flags: list[bool]) -> float:
    """Return the share of true values."""
    return float(np.mean(flags))


def main() -> int:
    """Run both studies and print the shares; return 1 where a share is too small."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, help="JSON file with the shares")
    args = parser.parse_args()

    # The model is right in the first study and lacks the friction in the second.
    clock = time.perf_counter()
    names = prepared()[0].parameters.names
    right = study(args.runs, args.seed, 0.0)
    wrong = study(args.runs, args.seed, FRICTION)

    inside = np.mean([outcome.inside for outcome in right], axis=0)
    shares = dict(zip(names, inside.tolist(), strict=True))
    false = share_of([outcome.misfit for outcome in right])
    caught = share_of([outcome.misfit for outcome in wrong])
    named = share_of([outcome.named for outcome in wrong])

    console = Console(width=100)
    console.print(coverage_table(names, right))
    console.print(f"misfit raised without a reason: {100 * false:.1f} %")
    console.print(
        f"misfit raised with {FRICTION:g} N of dry friction that the model lacks: "
        f"{100 * caught:.1f} % (95 % wanted)"
    )
    console.print(f"  and this friction named first as what is missing: {100 * named:.1f} %")
    console.print(f"{2 * args.runs} fits in {time.perf_counter() - clock:.0f} s on {cores()} cores")

    if args.output is not None:
        summary = {
            "runs": args.runs,
            "inside": shares,
            "false_misfit": false,
            "misfit": caught,
            "named": named,
        }
        with replacing(args.output) as temporary:
            temporary.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")

    return 0 if min(shares.values()) >= 0.9 and caught >= 0.95 else 1
