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
from typing import Any

import mujoco
import numpy as np
from rich.console import Console

import mjfim
from mjfim.arrays import Array, record
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.parallel.budget import measured_by
from mjfim.records.trajectory import Recording
from mjfim.studies.compare import METHOD_TITLES, UNLIMITED_ITERATIONS
from scripts.benchmarks.child import (
    ROOT,
    Outcome,
    median,
    options_of,
    percent,
    rms,
    study,
    table_of,
)

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


def true_robot(
    robot: Robot, experiment: Experiment, rng: np.random.Generator
) -> tuple[Array, Callable[[Array], Array]]:
    """Draw a robot with what its model lacks.

    Returns:
        (p,) true parameters, and the function of (N, nu) commands to (N+1, ny) outputs without
        noise, by MuJoCo's own steps.
    """
    share = rng.uniform(*SHARES)
    gaps: dict[str, Any] = {
        f"{joint}_backlash": {"kind": "backlash", "joint": joint, "encoder": robot.encoder}
        for joint in robot.gap
    }
    # The default flanks are as stiff as the time steps of the model resolve. Such elasticity would
    # cause more error than the gap. The shorter steps of the robot resolve stiffer ones.
    resolved = System.resolve(experiment.replace(terms=gaps)).source.terms
    for name, gap in zip(gaps, robot.gap.values(), strict=True):
        gaps[name]["values"] = {
            "gap": share * gap,
            "compliance": resolved[name].value("compliance") / FINER**2,
            "damping": resolved[name].value("damping") * FINER,
        }
    system = System.resolve(experiment.replace(terms=gaps), threads=1)
    guess = system.parameters.guess
    theta = guess * (1.0 + WRONG * rng.uniform(-1.0, 1.0, len(guess)))

    model = system.model_at(theta)
    dofs = np.array([int(model.joint(name).dofadr[0]) for name in robot.friction])
    friction = rng.uniform(*SHARES, len(dofs)) * list(robot.friction.values())
    at_rest = model.dof_frictionloss[dofs] + friction
    peak = friction * rng.uniform(*PEAKS, len(dofs))
    load, delay = (size * rng.uniform(*SHARES) for size in (robot.load, robot.delay))

    def outputs(ctrl: Array) -> Array:
        model = system.model_at(theta)
        model.opt.timestep /= FINER
        model.dof_solimp[dofs, :2] = IMPEDANCE
        data = mujoco.MjData(model)
        start = system.space.split(system.plant.initial_state(theta))
        data.qpos[:], data.qvel[:], data.act[:] = start

        steps = FINER * system.grid.substeps
        late = round(delay / model.opt.timestep)
        found = []
        for i in range((len(ctrl) + 1) * steps):
            sample = min((i - late) // steps, len(ctrl) - 1)
            data.ctrl[:] = system.rest if sample < 0 else ctrl[sample]
            if i % steps == 0:
                mujoco.mj_forward(model, data)
                state = np.concatenate([data.qpos, data.qvel, data.act])
                found.append(
                    [
                        data.sensordata[o.sensor] if o.state is None else state[o.state]
                        for o in system.outputs.outputs
                    ]
                )
            near_rest = np.exp(-((data.qvel[dofs] / robot.speed) ** 2))
            pressed = load * np.abs(data.qfrc_actuator[dofs])
            model.dof_frictionloss[dofs] = at_rest + peak * near_rest + pressed
            mujoco.mj_step(model, data)
        return np.array(found)

    return theta, outputs


def experiments_of(robot: Robot) -> dict[str, Experiment]:
    """The experiment of a robot as its model is, and with nuisance parameters, by name."""
    file = ROOT / "models" / f"{robot.experiment}.toml"
    plain = Experiment.from_file(file).replace(**robot.changes)
    armature = dict.fromkeys(robot.rotors, True)
    nuisance = {"friction": robot.friction, "delay": robot.delay, "armature": armature}
    return {PLAIN: plain, CURED: plain.replace(nuisance=nuisance)}


def search(robot: str, seconds: float) -> dict[str, Array]:
    """Search motions in equal time within equal limits; controls (N, nu) by name."""
    warnings.simplefilter("ignore")
    experiments = experiments_of(ROBOTS[robot])
    methods = [*BASELINES, HELD_OUT]
    descent = {"seconds": seconds, "max_iterations": UNLIMITED_ITERATIONS}
    with measured_by(time.process_time):
        found = mjfim.compare(
            experiments[PLAIN], seconds=seconds, methods=methods, threads=1, progress=False
        )
        cured = mjfim.design(experiments[CURED].replace(descent=descent), threads=1, progress=False)
    motions = {row.method: row.control for row in found.rows if row.control is not None}
    return {**motions, CURED: cured.trajectory.ctrl}


def run(name: str, number: int, motions: dict[str, Array]) -> Sequence[Outcome]:
    """Record, fit and predict all motions of one robot.

    Args:
        name: Name of the robot.
        number: Number of the run, the seed of all that is random.
        motions: (N, nu) controls by name.
    """
    warnings.simplefilter("ignore")
    robot = ROBOTS[name]
    experiments = experiments_of(robot)
    system = System.resolve(experiments[PLAIN], threads=1)
    rng = np.random.default_rng([number, 0])
    theta, outputs = true_robot(robot, experiments[PLAIN], rng)
    wanted = system.parameters.interest
    true = theta[wanted]

    held = motions[HELD_OUT]
    robot_moves = outputs(held)
    found: list[dict[str, Any]] = []
    for motion, ctrl in motions.items():
        if motion == HELD_OUT:
            continue
        y = outputs(ctrl)
        noise = system.noise.sample(len(y), np.random.default_rng([number, 1]))
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
            errors = np.abs(estimate.theta[wanted] - true)
            shares = errors / (0.5 * np.ptp(estimate.interval[wanted], axis=1))
            found.append(
                {
                    "robot": name,
                    "fit": fit,
                    "motion": f"design {CURED}" if motion == CURED else METHOD_TITLES[motion],
                    "baseline": motion in BASELINES,
                    "error": 100.0 * rms(errors / np.abs(true)),
                    "prediction": rms((predicted - robot_moves) / system.noise.sigma),
                    "shares": shares,
                    "inside": shares <= 1.0,
                }
            )
    # Whether a design is at least as good as both baselines.
    for key in ("error", "prediction"):
        for each in found:
            others = [other for other in found if other["baseline"] and other["fit"] == each["fit"]]
            is_least = all(each[key] <= other[key] for other in others)
            each[f"least {key}"] = [] if each["baseline"] else [is_least]
    return found


def main() -> int:
    """Print the medians over the runs."""
    parser = options_of(__doc__, runs=10)
    parser.add_argument(
        "--seconds", type=float, default=20.0, help="processor seconds of each search"
    )
    parser.add_argument("--robots", nargs="+", choices=list(ROBOTS), default=list(ROBOTS))
    args = parser.parse_args()

    orders = [(name, args.seconds) for name in args.robots]
    motions = study(search, orders, args.processes)
    jobs = [
        (name, number, controls)
        for number in range(args.seed, args.seed + args.runs)
        for name, controls in zip(args.robots, motions, strict=True)
    ]
    found = study(run, jobs, args.processes, args.output)
    columns = {
        "error [%]": median("error", ".1f"),
        "least error": percent("least error"),
        "held out [σ]": median("prediction", ".2f"),
        "least held out": percent("least prediction"),
        "error / interval": median("shares", ".2f"),
        "inside": percent("inside"),
    }
    console = Console(width=160)
    title = "Robots with friction, backlash and delay that the model lacks: medians over the robots"
    outcomes = [each for outcomes in found for each in outcomes]
    outcomes.sort(key=lambda each: (each["robot"], each["fit"]))
    console.print(table_of(title, outcomes, ("robot", "fit", "motion"), columns))
    console.print(
        "least: share of the robots on which the design errs at most as both baselines do"
    )
    return 0
