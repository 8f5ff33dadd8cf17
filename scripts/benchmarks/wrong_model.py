"""Is a design still good on robots that have what the model lacks?

    python -m scripts.benchmarks wrong_model [--runs 10] [--seconds 20] [--robots NAME ...]
        [--processes 2] [-o FILE.json]

The simulated robots have dry friction with a Stribeck peak and a part that grows with the torque
of the motor, backlash in the gears, and a delay of the commands. The model has none of these,
or another level of dry friction. Each robot has other true parameters, other sizes of what the
model lacks, and other noise.

It plays motions of equal length, which `mjfim.compare` has searched in equal processor time within
the same limits: a multisine, a Fourier series of five harmonics, and a design. One more design has
dry friction, armature and delay as nuisance parameters, with priors of the size that they may have.
Each recording is fitted with the model as it is, and with these nuisance parameters. The estimate
then predicts random steps within the limits, the same for all motions.

Errors of parameters are relative to their true values, in the root mean square over the wanted
parameters. Predictions are compared with the robot without noise, in units of the noise, in the
root mean square over all outputs.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from rich.console import Console
from rich.table import Table

import mjfim
from mjfim.arrays import Array, record
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.files import write_json
from mjfim.parallel import cores
from mjfim.parallel.budget import measured_by
from mjfim.records.trajectory import Recording
from mjfim.studies.compare import METHOD_TITLES, UNLIMITED_ITERATIONS
from scripts.benchmarks.child import ROOT, in_processes, new_table, options_of

# Baselines, and the motion that is predicted.
BASELINES = ("multisine", "fourier5")
HELD_OUT = "steps"

# Names of the fits: with the model as it is, and with nuisance parameters.
PLAIN, CURED = "as it is", "with nuisances"

# Largest relative deviation of the true parameters from the guess.
WRONG = 0.2

# Sizes of the missing effects of a robot over the largest ones, and of the Stribeck peak over the
# dry friction.
SHARES = (0.3, 1.0)
PEAKS = (0.2, 1.0)

# Engine steps of the robot in one engine step of the model.
FINER = 4

# Impedance with which the dry friction of the robot hardly creeps.
IMPEDANCE = (0.99, 0.99)


@record
class Robot:
    """A robot of the study.

    Attributes:
        experiment: Name of its file in `models`.
        changes: Tables of the experiment that differ from the file.
        friction: Largest dry friction that the model lacks, by joint [N or N m].
        speed: Stribeck speed of these joints [m/s or rad/s].
        load: Largest dry friction over the torque of the motor.
        gap: Largest gap of the driven joints [m or rad], by joint.
        encoder: Side of the gap on which the sensors are.
        rotors: Joints whose armature may be a nuisance beside the parameters.
        delay: Largest delay of the commands [s].
    """

    experiment: str
    changes: dict[str, Any]
    friction: dict[str, float]
    speed: float
    load: float
    gap: dict[str, float]
    encoder: str
    rotors: tuple[str, ...]
    delay: float


ROBOTS = {
    "cart-pendulum": Robot(
        experiment="cart_pendulum_rig",
        changes={"boundary": {"end": "free"}},
        friction={"slide": 0.2, "hinge": 0.1},
        speed=0.1,
        load=0.03,
        gap={"slide": 0.004},
        encoder="link",
        rotors=("slide",),
        delay=0.03,
    ),
    "servo arm": Robot(
        experiment="servo_arm",
        changes={
            "horizon": 4.0,
            "parameters": {
                name: {"guess": 0.4}
                for name in ("yaw_damping", "shoulder_damping", "elbow_damping")
            },
            "cost": {"control": 0.0},
            "limits": {
                "position": {
                    "yaw": [-1.0, 1.0],
                    "shoulder": [0.0, 1.1],
                    "elbow": [0.6, 1.8],
                    "wrist": [-0.4, 1.2],
                },
                "velocity": 3.0,
                "bandwidth": 3.0,
            },
            "boundary": {"start": "rest"},
        },
        friction={"yaw": 0.1, "shoulder": 0.15, "elbow": 0.1, "wrist": 0.03},
        speed=0.1,
        load=0.05,
        gap={"yaw": 0.01, "shoulder": 0.01, "elbow": 0.01},
        encoder="motor",
        rotors=("yaw", "shoulder", "elbow"),
        delay=0.005,
    ),
    # Two of the parameters of the file cannot be identified beside the others.
    "double pendulum": Robot(
        experiment="double_pendulum",
        changes={
            "parameters": {"m1r1": None, "m2": None, "d1": {"guess": 0.05}, "d2": {"guess": 0.05}},
            "cost": {"control": 0.0},
            "limits": {
                "position": {"shoulder": [-1.5, 1.5], "elbow": [-2.0, 2.0]},
                "velocity": 8.0,
                "bandwidth": 4.0,
            },
        },
        friction={"shoulder": 0.03, "elbow": 0.02},
        speed=0.1,
        load=0.03,
        gap={"shoulder": 0.01, "elbow": 0.01},
        encoder="motor",
        # The armature of the shoulder has the effect of the inertia of its link.
        rotors=("elbow",),
        delay=0.005,
    ),
}


@record
class Search:
    """Order to search the motions of a robot.

    Attributes:
        robot: Name of the robot.
        seconds: Time of the search of each motion [s].
    """

    robot: str
    seconds: float


@record
class Job:
    """One robot that plays all motions.

    Attributes:
        robot: Name of the robot.
        number: Number of the run, the seed of all that is random.
        motions: (N, nu) controls by name.
    """

    robot: str
    number: int
    motions: dict[str, Array]


@record
class Truth:
    """A simulated robot with what its model lacks.

    Attributes:
        system: The system with backlash.
        theta: (p,) true parameters.
        dofs: Degrees of freedom with friction.
        friction: Dry friction of these at rest of the motor, without its Stribeck peak [N or N m].
        peak: Height of the peak [N or N m].
        speed: Stribeck speed [m/s or rad/s].
        load: Dry friction over the torque of the motor.
        delay: Delay of the commands [s].
    """

    system: System
    theta: Array
    dofs: np.ndarray
    friction: Array
    peak: Array
    speed: float
    load: float
    delay: float

    @classmethod
    def of(cls, robot: Robot, experiment: Experiment, rng: np.random.Generator) -> Truth:
        """Draw a robot."""
        share = rng.uniform(*SHARES)
        gaps: dict[str, Any] = {
            f"{joint}_backlash": {"kind": "backlash", "joint": joint, "encoder": robot.encoder}
            for joint in robot.gap
        }
        # The default flanks are as stiff as the time steps of the model resolve. Such elasticity
        # would cause more error than the gap. The shorter steps of the robot resolve stiffer ones.
        resolved = System.resolve(experiment.replace(terms=gaps)).source.terms
        for name, gap in zip(gaps, robot.gap.values(), strict=True):
            flanks = resolved[name]
            gaps[name]["values"] = {
                "gap": share * gap,
                "compliance": flanks.value("compliance") / FINER**2,
                "damping": flanks.value("damping") * FINER,
            }
        system = System.resolve(experiment.replace(terms=gaps), threads=1)
        guess = system.parameters.guess
        theta = guess * (1.0 + WRONG * rng.uniform(-1.0, 1.0, len(guess)))

        model = system.model_at(theta)
        dofs = np.array([int(model.joint(name).dofadr[0]) for name in robot.friction])
        friction = rng.uniform(*SHARES, len(dofs)) * list(robot.friction.values())
        return cls(
            system=system,
            theta=theta,
            dofs=dofs,
            friction=model.dof_frictionloss[dofs] + friction,
            peak=friction * rng.uniform(*PEAKS, len(dofs)),
            speed=robot.speed,
            load=robot.load * rng.uniform(*SHARES),
            delay=robot.delay * rng.uniform(*SHARES),
        )

    def outputs(self, ctrl: Array) -> Array:
        """(N+1, ny) outputs without noise under (N, nu) commands, by MuJoCo's own steps."""
        system = self.system
        model = system.model_at(self.theta)
        model.opt.timestep /= FINER
        model.dof_solimp[self.dofs, :2] = IMPEDANCE
        data = mujoco.MjData(model)
        space = system.space
        data.qpos[:], data.qvel[:], data.act[:] = space.split(
            system.plant.initial_state(self.theta)
        )

        steps = FINER * system.grid.substeps
        late = round(self.delay / model.opt.timestep)
        found = []
        for k in range(len(ctrl) + 1):
            for i in range(k * steps, (k + 1) * steps):
                sample = min((i - late) // steps, len(ctrl) - 1)
                data.ctrl[:] = system.rest if sample < 0 else ctrl[sample]
                if i == k * steps:
                    mujoco.mj_forward(model, data)
                    state = np.concatenate([data.qpos, data.qvel, data.act])
                    found.append(
                        [
                            data.sensordata[o.sensor] if o.state is None else state[o.state]
                            for o in system.outputs.outputs
                        ]
                    )
                near_rest = np.exp(-((data.qvel[self.dofs] / self.speed) ** 2))
                pressed = self.load * np.abs(data.qfrc_actuator[self.dofs])
                model.dof_frictionloss[self.dofs] = self.friction + self.peak * near_rest + pressed
                mujoco.mj_step(model, data)
        return np.array(found)


@record
class Outcome:
    """Outcome of one motion of one robot, fitted with one experiment.

    Attributes:
        robot: Name of the robot.
        number: Number of the run.
        fit: Name of the experiment.
        motion: Name of the motion.
        errors: (t,) relative errors of the wanted parameters.
        widths: (t,) half widths of their 95 % intervals, relative to the true values.
        prediction: Error of the prediction of the held-out motion [σ].
    """

    robot: str
    number: int
    fit: str
    motion: str
    errors: Array
    widths: Array
    prediction: float

    @property
    def error(self) -> float:
        """Root mean square of the relative errors."""
        return float(np.sqrt(np.mean(self.errors**2)))

    @property
    def shares(self) -> Array:
        """(t,) errors over the half widths of the intervals."""
        return np.abs(self.errors) / self.widths


def experiments_of(robot: Robot) -> dict[str, Experiment]:
    """The experiment of a robot as its model is, and with nuisance parameters, by name."""
    file = ROOT / "models" / f"{robot.experiment}.toml"
    plain = Experiment.from_file(file).replace(**robot.changes)
    armature = dict.fromkeys(robot.rotors, True)
    nuisance = {"friction": robot.friction, "delay": robot.delay, "armature": armature}
    return {PLAIN: plain, CURED: plain.replace(nuisance=nuisance)}


def search(order: Search) -> dict[str, Array]:
    """Search motions in equal time within equal limits; controls (N, nu) by name."""
    warnings.simplefilter("ignore")
    experiments = experiments_of(ROBOTS[order.robot])
    methods = [*BASELINES, HELD_OUT]
    descent = {"seconds": order.seconds, "max_iterations": UNLIMITED_ITERATIONS}
    with measured_by(time.process_time):
        found = mjfim.compare(
            experiments[PLAIN], seconds=order.seconds, methods=methods, threads=1, progress=False
        )
        cured = mjfim.design(experiments[CURED].replace(descent=descent), threads=1, progress=False)
    motions = {row.method: row.control for row in found.rows if row.control is not None}
    return {**motions, CURED: cured.trajectory.ctrl}


def run(job: Job) -> list[Outcome]:
    """Record, fit and predict all motions of one robot."""
    warnings.simplefilter("ignore")
    robot, motions = ROBOTS[job.robot], dict(job.motions)
    experiments = experiments_of(robot)
    system = System.resolve(experiments[PLAIN], threads=1)
    truth = Truth.of(robot, experiments[PLAIN], np.random.default_rng([job.number, 0]))
    wanted = system.parameters.interest
    true = truth.theta[wanted]

    held = motions.pop(HELD_OUT)
    robot_moves = truth.outputs(held)
    found = []
    for motion, ctrl in motions.items():
        y = truth.outputs(ctrl)
        noise = system.noise.sample(len(y), np.random.default_rng([job.number, 1]))
        t = system.dt * np.arange(len(y), dtype=np.float64)
        names = system.outputs.names
        recording = Recording(t=t, ctrl=ctrl, y=y + noise, outputs=names, name=motion)
        for fit, experiment in experiments.items():
            # Restarts, which a misfit causes, find no other minimum here and take most of the time.
            estimate = mjfim.identify(
                experiment, recording, method="newton", threads=1, progress=False
            )
            fitted = System.resolve(experiment, threads=1)
            predicted = fitted.plant.measure(estimate.theta[None], held)[0][0]
            errors = (predicted - robot_moves) / system.noise.sigma
            found.append(
                Outcome(
                    robot=job.robot,
                    number=job.number,
                    fit=fit,
                    motion=motion,
                    errors=(estimate.theta[wanted] - true) / np.abs(true),
                    widths=0.5 * np.ptp(estimate.interval[wanted], axis=1) / np.abs(true),
                    prediction=float(np.sqrt(np.mean(errors**2))),
                )
            )
    return found


def share_as_good(group: Sequence[Outcome], motion: str, value: Callable[[Outcome], float]) -> str:
    """Share of the robots on which a motion is at least as good as both baselines, in percent."""
    values = {(each.number, each.motion): value(each) for each in group}
    numbers = {each.number for each in group}
    flags = [
        all(values[i, motion] <= values[i, baseline] for baseline in BASELINES) for i in numbers
    ]
    return f"{100.0 * np.mean(flags):.0f} %"


def table_of(outcomes: Sequence[Outcome]) -> Table:
    """Medians over the runs of each robot, fit and motion."""
    table = new_table(
        "Robots with friction, backlash and delay that the model lacks: medians over the robots",
        "robot",
        "fit",
        "motion",
        "error",
        "least error",
        "held out",
        "least held out",
        "error / interval",
        "inside",
        texts=3,
    )
    places = dict.fromkeys((each.robot, each.fit) for each in outcomes)
    for robot, fit in places:
        group = [each for each in outcomes if (each.robot, each.fit) == (robot, fit)]
        for motion in dict.fromkeys(each.motion for each in group):
            rows = [each for each in group if each.motion == motion]
            is_baseline = motion in BASELINES
            shares = np.concatenate([each.shares for each in rows])
            table.add_row(
                robot,
                fit,
                f"design {CURED}" if motion == CURED else METHOD_TITLES[motion],
                f"{100.0 * np.median([each.error for each in rows]):.1f} %",
                "" if is_baseline else share_as_good(group, motion, lambda each: each.error),
                f"{np.median([each.prediction for each in rows]):.2f} σ",
                "" if is_baseline else share_as_good(group, motion, lambda each: each.prediction),
                f"{np.median(shares):.2f}",
                f"{100.0 * np.mean(shares <= 1.0):.0f} %",
            )
    return table


def main() -> int:
    """Print the medians over the runs."""
    parser = options_of(__doc__)
    parser.add_argument("--runs", type=int, default=10, help="robots of each kind")
    parser.add_argument(
        "--seconds", type=float, default=20.0, help="processor seconds of each search"
    )
    parser.add_argument("--robots", nargs="+", choices=list(ROBOTS), default=list(ROBOTS))
    parser.add_argument("--processes", type=int, default=cores())
    parser.add_argument("-o", "--output", type=Path, help="JSON file with all runs")
    args = parser.parse_args()

    clock = time.perf_counter()
    orders = [Search(robot=name, seconds=args.seconds) for name in args.robots]
    motions = list(in_processes(search, orders, args.processes))
    jobs = [
        Job(robot=name, number=number, motions=controls)
        for number in range(args.runs)
        for name, controls in zip(args.robots, motions, strict=True)
    ]
    outcomes: list[Outcome] = []
    for found in in_processes(run, jobs, args.processes):
        outcomes += found
        if args.output is not None:
            write_json(args.output, {"runs": [asdict(each) for each in outcomes]})

    console = Console(width=160)
    console.print(table_of(outcomes))
    console.print(
        "least: share of the robots on which the design errs at most as both baselines do"
    )
    console.print(f"{time.perf_counter() - clock:.0f} s in {args.processes} processes")
    return 0
