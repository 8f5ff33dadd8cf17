"""Coverage of the 95 % intervals of an identification, over many recordings of a simulated robot.

    python -m scripts.benchmarks prove_identification [--study coverage] [--runs 200] [--seed 0]
        [--zoo FOLDER] [-o FILE.json]

The robot is the cart-pendulum under the designed control, stepped at 2 kHz. Its controller has 2 ms
of jitter and logs at the times at which it really acts. The readings are 10 ms late, with noise and
constant biases, and the robot does not start at the stated state. The fit estimates the parameters,
delay, biases, start and the noise. The script counts how often each true value lies inside its 95 %
interval, and how often `misfit` is raised: without a reason, and with dry friction in the slide of
the cart that the model does not have.

`--study power` measures how often the tests of missing terms find a tilt of the base that the model
does not have. It is 4, 6 and 8 of its standard deviations, and theory says how often that is.

`--study clean` counts false alarms in logs that the models explain. The ten robots are those of
`models/` and of a folder of MJCF files. `--runs` is the number of all logs.
"""

from __future__ import annotations

import argparse
import time
import tomllib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import scipy
from rich.console import Console
from rich.table import Table

import mjfim
from mjfim.arrays import NORMAL_95, Array, record
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System, simulate_system
from mjfim.files import write_json
from mjfim.identification.assessment.term_candidates import candidates_of
from mjfim.identification.assessment.term_tests import SIGNIFICANCE, find_missing_terms
from mjfim.identification.identify import identify_system
from mjfim.identification.search import FitSearch, FitTask
from mjfim.parallel import cores
from mjfim.parallel.budget import Budget
from mjfim.records.trajectory import Recording
from mjfim.studies.first_experiment import experiment_text, propose_experiment
from scripts.benchmarks.child import ROOT, in_processes, new_table, options_of

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
    return list(in_processes(run, [(seed, number, friction) for number in range(runs)]))


def coverage_table(names: Sequence[str], found: list[Outcome]) -> Table:
    """Make a table of how often the intervals hold the true values.

    Args:
        names: Names of the unknowns.
        found: Outcomes of all runs.

    Returns:
        Table with one row for each unknown.
    """
    title = f"Truth inside the 95 % interval, {len(found)} recordings (at least 90 % wanted)"
    headings = ("unknown", "interval", "formal interval", "rms error [formal σ]")
    table = new_table(title, *headings)
    inside = 100.0 * np.mean([outcome.inside for outcome in found], axis=0)
    formally = 100.0 * np.mean([outcome.formally for outcome in found], axis=0)
    rms = np.sqrt(np.mean([outcome.error**2 for outcome in found], axis=0))
    for j, name in enumerate(names):
        table.add_row(name, f"{inside[j]:.1f} %", f"{formally[j]:.1f} %", f"{rms[j]:.2f}")

    return table


# ---- power of the tests of missing terms

# Sizes of the tilt [standard deviations], and the duration of a log [s].
DISTANCES = (4.0, 6.0, 8.0)
POWER_HORIZON = 60.0

# Target of the tilt, and a tilt at which its standard deviation is measured [m/s²].
TILT, PROBE = "option:gravity[0]", 0.02

# Largest difference of the power from theory.
MAX_POWER_ERROR = 0.1


@record
class Tilted:
    """The cart-pendulum on a base that is tilted.

    Attributes:
        task: The task without the tilt.
        robot: The system with the tilt as its last parameter.
        tests: Number of terms that are tested.
    """

    task: DesignTask
    robot: System
    tests: int

    @staticmethod
    @cache
    def prepared() -> Tilted:
        """The same one in every job of a process."""
        control = {"kind": "multisine", "amplitude": 4.0, "frequency": 0.4, "harmonics": 6}
        base = mjfim.Experiment.from_file(ROOT / "models" / "cart_pendulum.toml")
        changed = {"initial": {"control": control}, "horizon": POWER_HORIZON}
        stated = base.replace(fit={"segments": "whole", "bootstrap": 0}, **changed)
        tilt = {"tilt": {"target": TILT, "scale": 1.0}}
        task = DesignTask.resolve(stated, threads=1)
        candidates, _ = candidates_of(task.system, np.ones(task.space.nv))
        return Tilted(
            task=task,
            robot=System.resolve(stated.replace(parameters=tilt), threads=1),
            tests=sum(not each.screened for each in candidates),
        )

    def sigmas(self, tilt: float, seed: Sequence[int]) -> tuple[float, bool]:
        """How many standard deviations a tilt is found to be, and whether it is named first.

        Args:
            tilt: The tilt [m/s²].
            seed: Seed of the noise.

        Returns:
            The standard deviations; 0 where the tilt is not found.
        """
        control = self.task.initial.ctrl
        theta = np.append(self.task.parameters.true, tilt)
        y = self.robot.plant.measure(theta[None], control)[0][0]
        y = y + self.robot.noise.sample(len(y), np.random.default_rng(seed))
        times = np.arange(len(y), dtype=np.float64) * self.task.dt
        log = Recording(t=times, ctrl=control, y=y, outputs=self.robot.outputs.names)

        # A fit to the whole log, which begins at the true values.
        fit = FitTask.of(self.task.system, [log], start=theta[:-1])
        problem = fit.problem()
        search = FitSearch(task=fit, budget=Budget())
        _, solution = search.solve(problem, problem.begin(fit.start))
        terms = find_missing_terms(problem, fit.recordings, solution.unknowns).terms
        found = [term.sigmas for term in terms if term.path == TILT]
        return max(found, default=0.0), bool(found) and terms[0].path == TILT


def tested(job: tuple[int, int, float]) -> tuple[bool, bool]:
    """Whether a tilt is found, and whether it is named first; a job of the study.

    Args:
        job: Seed of the study, number of the run and size of the tilt [m/s²].
    """
    seed, number, tilt = job
    sigmas, is_first = Tilted.prepared().sigmas(tilt, [seed, number])
    return sigmas > 0.0, is_first


def power_study(runs: int, seed: int) -> dict[str, dict[str, float]]:
    """Share of logs in which the tilt is found, with that of theory, by its size.

    Args:
        runs: Logs of each size.
        seed: Seed of the study.
    """
    robot = Tilted.prepared()
    probed = [robot.sigmas(PROBE, [seed, 0, k])[0] for k in range(3)]
    per_sigma = PROBE / float(np.mean(probed))
    least = -float(scipy.special.ndtri(0.5 * SIGNIFICANCE / robot.tests))
    shares = {}
    for distance in DISTANCES:
        jobs = [(seed, number, distance * per_sigma) for number in range(runs)]
        found = list(in_processes(tested, jobs))
        theory = scipy.special.ndtr(distance - least) + scipy.special.ndtr(-distance - least)
        shares[f"{distance:g}"] = {
            "found": share_of([is_found for is_found, _ in found]),
            "first": share_of([is_first for _, is_first in found]),
            "theory": float(theory),
        }
    return shares


# ---- false alarms

# Experiments of `models/`, and models of the folder for which `mjfim init` writes one.
SHIPPED = ("cart_pendulum", "filtered_drive", "servo_arm", "muscle_arm", "four_bar")
OTHERS = ("dmc_cartpole", "dmc_reacher", "dmc_finger", "arx_l5", "allegro")

# Largest error of the parameters of a robot, as a share of their values.
WRONG = 0.2

# Largest share of false alarms.
MAX_FALSE_ALARMS = 0.01


@record
class CleanLog:
    """What was said about a log that the model explains.

    Attributes:
        robot: Name of the robot.
        misfit: Why the model is said not to explain it; empty where it does.
        poor_data: What is said to be wrong with the data; empty for nothing.
        failure: Why there is no fit, or why the fit is not reliable; empty for a good one.
        seconds: Time of the fit [s].
    """

    robot: str
    misfit: str = ""
    poor_data: str = ""
    failure: str = ""
    seconds: float = 0.0


@cache
def robots_of(zoo: Path) -> dict[str, Path]:
    """The robots by name: experiment files, and models of others."""
    shipped = {name: ROOT / "models" / f"{name}.toml" for name in SHIPPED}
    return shipped | {
        name: zoo / f"{name}.xml" for name in OTHERS if (zoo / f"{name}.xml").exists()
    }


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


def identified(job: tuple[int, int, Path]) -> CleanLog:
    """Fit a clean log of a robot whose parameters differ from the guess; a job of the study.

    Args:
        job: Seed of the study, number of the log, and the folder of models.
    """
    seed, number, zoo = job
    robots = robots_of(zoo)
    name = list(robots)[number % len(robots)]
    clock = time.perf_counter()
    try:
        task = clean_task(robots[name])
        system, rng = task.system, np.random.default_rng([seed, number])
        parameters = system.parameters
        moved = parameters.guess * rng.uniform(1.0 - WRONG, 1.0 + WRONG, len(parameters))
        # A robot outside a stated prior is not one that the experiment describes.
        near = rng.normal(parameters.guess, [each.prior or 0.0 for each in parameters.parameters])
        moved = np.where([each.prior is None for each in parameters.parameters], moved, near)
        moved = np.clip(moved, parameters.lower, parameters.upper).tolist()
        true = dict(zip(parameters.names, moved, strict=True))
        stated = system.experiment
        tables = {key: {"true": true[key]} for key in stated.parameters if key in true}
        made = System.resolve(stated.replace(parameters=tables), threads=1)
        log = simulate_system(made, task.initial, seed=number)
        found = identify_system(system, [log])
    except mjfim.MjfimError as error:
        return CleanLog(robot=name, failure=str(error), seconds=time.perf_counter() - clock)
    poor = [each for each in found.warnings if each.startswith("poor data")]
    return CleanLog(
        robot=name,
        misfit="; ".join(found.reasons) if found.misfit else "",
        poor_data="; ".join(poor),
        failure="" if found.converged else found.status,
        seconds=time.perf_counter() - clock,
    )


def clean_study(runs: int, seed: int, zoo: Path) -> list[CleanLog]:
    """What is said about clean logs, those of one robot after those of another.

    Args:
        runs: Number of logs of all robots together.
        seed: Seed of the study.
        zoo: Folder of MJCF files.
    """
    return list(in_processes(identified, [(seed, number, zoo) for number in range(runs)]))


def clean_table(found: Sequence[CleanLog]) -> Table:
    """Make a table of the false alarms of each robot."""
    headings = ("robot", "logs", "misfit", "poor data", "not fitted", "seconds")
    table = new_table(f"False alarms in {len(found)} clean logs", *headings)
    for robot in dict.fromkeys(each.robot for each in found):
        logs = [each for each in found if each.robot == robot]
        counts = [
            sum(bool(getattr(each, kind)) for each in logs)
            for kind in ("misfit", "poor_data", "failure")
        ]
        seconds = float(np.median([each.seconds for each in logs]))
        table.add_row(robot, str(len(logs)), *map(str, counts), f"{seconds:.0f}")
    return table


# ---- all studies


def share_of(flags: list[bool]) -> float:
    """Return the share of true values."""
    return float(np.mean(flags))


def main() -> int:
    """Run a study and print its shares; return 1 where one is not as it should be."""
    parser = options_of(__doc__)
    parser.add_argument("--study", choices=("coverage", "power", "clean"), default="coverage")
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--zoo", type=Path, default=Path("/work/zoo"), help="folder of MJCF files")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, help="JSON file with the shares")
    args = parser.parse_args()
    clock = time.perf_counter()
    studies = {"coverage": coverage, "power": power, "clean": clean}
    summary, is_good = studies[args.study](args, Console(width=100))
    print(f"{time.perf_counter() - clock:.0f} s on {cores()} cores")
    if args.output is not None:
        write_json(args.output, summary)
    return 0 if is_good else 1


def power(args: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Run the study of the power, and print it."""
    found = power_study(args.runs, args.seed)
    for distance, shares in found.items():
        of_found, of_first, of_theory = (f"{100 * share:.0f} %" for share in shares.values())
        console.print(
            f"a tilt of {distance} σ: found in {of_found} of {args.runs} logs (theory: "
            f"{of_theory}), named first in {of_first}"
        )
    errors = [abs(shares["found"] - shares["theory"]) for shares in found.values()]
    return {"runs": args.runs, "power": found}, max(errors) <= MAX_POWER_ERROR


def clean(args: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Run the study of false alarms, and print it."""
    found = clean_study(args.runs, args.seed, args.zoo)
    console.print(clean_table(found))
    kinds = ("misfit", "poor_data", "failure")
    for each in found:
        for said in filter(None, (getattr(each, kind) for kind in kinds)):
            console.print(f"{each.robot}: {said}")
    shares = {kind: share_of([bool(getattr(each, kind)) for each in found]) for kind in kinds}
    console.print(
        f"misfit {100 * shares['misfit']:.1f} %, poor data {100 * shares['poor_data']:.1f} % "
        f"(at most {100 * MAX_FALSE_ALARMS:g} % wanted)"
    )
    is_good = max(shares["misfit"], shares["poor_data"]) <= MAX_FALSE_ALARMS
    return {"runs": args.runs, "logs": [asdict(each) for each in found], **shares}, is_good


def coverage(args: argparse.Namespace, console: Console) -> tuple[dict[str, Any], bool]:
    """Run the studies of the coverage, and print them.

    The model is right in the first study and lacks the friction in the second.
    """
    names = prepared()[0].parameters.names
    right = study(args.runs, args.seed, 0.0)
    wrong = study(args.runs, args.seed, FRICTION)

    inside = np.mean([outcome.inside for outcome in right], axis=0)
    shares = dict(zip(names, inside.tolist(), strict=True))
    false = share_of([outcome.misfit for outcome in right])
    caught = share_of([outcome.misfit for outcome in wrong])
    named = share_of([outcome.named for outcome in wrong])

    console.print(coverage_table(names, right))
    console.print(f"misfit raised without a reason: {100 * false:.1f} %")
    console.print(
        f"misfit raised with {FRICTION:g} N of dry friction that the model lacks: "
        f"{100 * caught:.1f} % (95 % wanted)"
    )
    console.print(f"  and this friction named first as what is missing: {100 * named:.1f} %")
    summary = {
        "runs": args.runs,
        "inside": shares,
        "false_misfit": false,
        "misfit": caught,
        "named": named,
    }
    return summary, min(shares.values()) >= 0.9 and caught >= 0.95
