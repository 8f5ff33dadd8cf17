"""Coverage of the 95 % intervals of an identification, over many recordings of a simulated robot.

    python -m scripts.benchmarks prove_identification [--study coverage] [--runs 200] [--seed 0]
        [--zoo FOLDER] [-o FILE.json]

The robot is the cart-pendulum under the designed control, stepped at 2 kHz. Its controller has 2 ms
of jitter and logs at the times at which it really acts. The readings are 10 ms late, with noise and
constant biases, and the robot does not start at the stated state. The fit estimates the parameters,
delay, biases, start and the noise. The script counts how often each true value lies inside its 95 %
interval, and how often `misfit` is raised: without a reason, and with dry friction in the slide of
the cart that the model does not have.

`--study clean` counts false alarms in logs that the models explain. The ten robots are those of
`models/` and of a folder of MJCF files. `--runs` is the number of all logs.
"""

from __future__ import annotations

import argparse
import time
import tomllib
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from rich.console import Console

import mjfim
from mjfim.arrays import Array
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System, simulate_system
from mjfim.identification.identify import identify_system
from mjfim.parallel import cores
from mjfim.records.trajectory import Recording
from mjfim.studies.first_experiment import experiment_text, propose_experiment
from scripts.benchmarks.child import (
    ROOT,
    Cell,
    Outcome,
    median,
    new_table,
    options_of,
    share,
    study,
    table_of,
)

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


@cache
def prepared() -> tuple[DesignTask, Array]:
    """Return the task as the user states it, and the designed control (N, 1)."""
    base = mjfim.Experiment.from_file(ROOT / "models" / "cart_pendulum.toml")
    control = mjfim.design(base).trajectory.ctrl

    nuisance = {"initial": START_DEVIATION, "bias": dict.fromkeys(BIAS, True), "delay": True}
    stated = base.replace(nuisance=nuisance, fit={"noise": "estimated"})
    return DesignTask.resolve(stated, threads=1), control


def run(seed: int, number: int, friction: float) -> Outcome:
    """Play and identify one robot with a friction [N]."""
    task, control = prepared()
    rng = np.random.default_rng([seed, number])

    # True values of start, biases and delay.
    names = list(task.parameters.names)
    theta = np.array(task.parameters.true)
    starts = [i for i, name in enumerate(names) if name.startswith("initial")]
    theta[starts] = rng.normal(0.0, START_DEVIATION, len(starts))
    for output, bias in BIAS.items():
        theta[names.index(f"bias {output}")] = bias
    theta[names.index("delay")] = DELAY

    model = task.system.model_at(theta)
    model.opt.timestep = STEP
    model.dof_frictionloss[int(model.joint("slide").dofadr[0])] = friction
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], _ = task.space.split(task.plant.initial_state(theta))

    # Times at which the controller acts, on the grid of the robot's timesteps.
    N = len(control)
    times = np.arange(N + 1) * task.dt
    times[1:] += np.clip(rng.normal(0.0, JITTER, N), -0.45 * task.dt, 0.45 * task.dt)
    ticks = np.rint(times / STEP)

    states = [[*data.qpos, *data.qvel]]
    for ctrl, count in zip(control, np.diff(ticks).astype(int), strict=True):
        data.ctrl[:] = ctrl
        for _ in range(count):
            mujoco.mj_step(model, data)
            states.append([*data.qpos, *data.qvel])

    # Late readings with biases and noise.
    times = ticks * STEP
    rows = np.clip(np.rint((times - DELAY) / STEP).astype(int), 0, len(states) - 1)
    outputs = task.system.outputs
    biases = task.parameters.bias_derivative(len(outputs)) @ theta
    y = np.array(states)[rows] + biases + rng.normal(0.0, SIGMA, (N + 1, len(outputs)))
    log = Recording(t=times, ctrl=control, y=y, outputs=outputs.names, name="robot")
    found = identify_system(task.system, [log])
    low, high = found.interval.T

    # Terms are sorted by how much they explain.
    first = found.missing_terms[0].path if found.missing_terms else ""
    return {
        "inside": ((low <= theta) & (theta <= high)).tolist(),
        "misfit": found.misfit,
        "named": first == "joint/slide:frictionloss",
    }


def coverage(args: argparse.Namespace, console: Console) -> bool:
    """Study the coverage: the model is right in half of the runs and lacks the friction in half."""
    jobs = [(args.seed, i, friction) for friction in (0.0, FRICTION) for i in range(args.runs)]
    found = study(run, jobs, args.processes, args.output)
    right, wrong = found[: args.runs], found[args.runs :]

    title = f"Truth inside the 95 % interval, {args.runs} recordings (at least 90 % wanted)"
    table = new_table(title, "unknown", "interval")
    inside = np.mean([outcome["inside"] for outcome in right], axis=0)
    for name, part in zip(prepared()[0].parameters.names, inside, strict=True):
        table.add_row(name, f"{100.0 * part:.1f} %")
    console.print(table)
    console.print(f"misfit raised without a reason: {100 * share(right, 'misfit'):.1f} %")
    caught = share(wrong, "misfit")
    console.print(
        f"misfit raised with {FRICTION:g} N of dry friction that the model lacks: "
        f"{100 * caught:.1f} % (95 % wanted)"
    )
    named = 100 * share(wrong, "named")
    console.print(f"  and this friction named first as what is missing: {named:.1f} %")
    return bool(inside.min() >= 0.9 and caught >= 0.95)


# ---- false alarms

# Experiments of `models/`, and models of the folder for which `mjfim init` writes one.
SHIPPED = ("cart_pendulum", "filtered_drive", "servo_arm", "muscle_arm", "four_bar")
OTHERS = ("dmc_cartpole", "dmc_reacher", "dmc_finger", "arx_l5", "allegro")

# Largest error of the parameters of a robot, as a share of their values.
WRONG = 0.2

# Largest share of false alarms, and what is counted.
MAX_FALSE_ALARMS = 0.01
ALARMS = {"misfit": "misfit", "poor_data": "poor data", "failure": "not fitted"}


@cache
def clean_task(file: Path) -> DesignTask:
    """The task of an experiment file, or of that which `mjfim init` writes for a model."""
    if file.suffix == ".toml":
        experiment = mjfim.Experiment.from_file(file)
    else:
        text = experiment_text(propose_experiment(file, file.parent))
        tables = tomllib.loads(text)
        experiment = mjfim.Experiment(**tables, directory=file.parent, source=file.name)
    return DesignTask.resolve(experiment.replace(fit={"bootstrap": 0}), threads=1)


def identified(seed: int, number: int, file: Path) -> Outcome:
    """Fit a clean log of a robot whose parameters differ from the guess; texts say what is wrong.

    Args:
        seed: Seed of the study.
        number: Number of the log.
        file: Experiment file or model of the robot.
    """
    outcome = {"robot": file.stem, **dict.fromkeys(ALARMS, "")}
    clock = time.perf_counter()
    try:
        task = clean_task(file)
        rng, parameters = np.random.default_rng([seed, number]), task.system.parameters
        moved = parameters.guess * rng.uniform(1.0 - WRONG, 1.0 + WRONG, len(parameters))
        # A robot outside a stated prior is not one that the experiment describes.
        near = rng.normal(parameters.guess, [each.prior or 0.0 for each in parameters.parameters])
        moved = np.where([each.prior is None for each in parameters.parameters], moved, near)
        moved = np.clip(moved, parameters.lower, parameters.upper).tolist()
        true = dict(zip(parameters.names, moved, strict=True))
        stated = task.system.experiment
        tables = {key: {"true": true[key]} for key in stated.parameters if key in true}
        made = System.resolve(stated.replace(parameters=tables), threads=1)
        log = simulate_system(made, task.initial, seed=number)
        found = identify_system(task.system, [log])
    except mjfim.MjfimError as error:
        outcome["failure"] = str(error)
    else:
        poor = [each for each in found.warnings if each.startswith("poor data")]
        outcome["misfit"] = "; ".join(found.reasons) if found.misfit else ""
        outcome["poor_data"] = "; ".join(poor)
        outcome["failure"] = "" if found.converged else found.status
    return {**outcome, "seconds": time.perf_counter() - clock}


def clean(args: argparse.Namespace, console: Console) -> bool:
    """Study the false alarms, of one robot after another."""
    robots = [ROOT / "models" / f"{name}.toml" for name in SHIPPED]
    robots += [file for name in OTHERS if (file := args.zoo / f"{name}.xml").exists()]
    jobs = [(args.seed, number, robots[number % len(robots)]) for number in range(args.runs)]
    found = study(identified, jobs, args.processes, args.output)

    def count(key: str) -> Cell:
        return lambda group: str(sum(bool(each[key]) for each in group))

    columns = {words: count(key) for key, words in ALARMS.items()} | {"seconds": median("seconds")}
    console.print(table_of(f"False alarms in {len(found)} clean logs", found, ["robot"], columns))
    for each in found:
        for said in filter(None, (each[key] for key in ALARMS)):
            console.print(f"{each['robot']}: {said}")
    misfit, poor, _ = (np.mean([bool(each[key]) for each in found]) for key in ALARMS)
    console.print(
        f"misfit {100 * misfit:.1f} %, poor data {100 * poor:.1f} % "
        f"(at most {100 * MAX_FALSE_ALARMS:g} % wanted)"
    )
    return bool(max(misfit, poor) <= MAX_FALSE_ALARMS)


def main() -> int:
    """Run a study and print its shares; return 1 where one is not as it should be."""
    parser = options_of(__doc__, runs=200)
    parser.add_argument("--study", choices=("coverage", "clean"), default="coverage")
    zoo = ROOT.parent / "zoo"
    parser.add_argument("--zoo", type=Path, default=zoo, help="folder of MJCF files")
    args = parser.parse_args()
    clock = time.perf_counter()
    chosen = {"coverage": coverage, "clean": clean}[args.study]
    is_good = chosen(args, Console(width=100))
    print(f"{time.perf_counter() - clock:.0f} s on {cores()} cores")
    return 0 if is_good else 1
