"""How often fits find the optimum from starts that are wrong by factors of 3 to 10.

    python -m scripts.benchmarks starts [--runs 20] [--seed 0] [--robots NAME ...]
        [--methods mjfim ...] [-o FILE.json]

Each robot is simulated under a multisine, with the noise of its sensors. Every parameter of the
start is too large or too small by a random factor between 3 and 10. `mjfim.identify` fits the
recording with its default settings. In the time of the processors that it took,
`scipy.optimize.least_squares` fits whole rollouts from the same start, with the same bounds and
weights, and so does `mujoco.sysid` with its own optimiser, where its extra dependencies are
installed. Both scale the parameters by the Jacobian, and a trial that diverges costs much instead
of ending the fit. A fit counts as right where half of the sum of squares exceeds that of the fit
from the true parameters by at most 1/2: it is within one standard deviation of the optimum.
"""

from __future__ import annotations

import io
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from mujoco import sysid
from rich.console import Console
from rich.table import Table

import mjfim
from mjfim.arrays import Array, record
from mjfim.errors import MjfimError
from mjfim.experiment.initial import multisine
from mjfim.experiment.system import System
from mjfim.files import write_json
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import identify_system, least_squares
from mjfim.output.export.sysid import silenced, sysid_problem
from mjfim.parallel import cores
from mjfim.records.trajectory import Recording
from scripts.benchmarks.child import ROOT, in_processes, new_table, options_of

# Factors by which starts are wrong, and bounds of the parameters over their true values.
FACTORS = (3.0, 10.0)
BOUNDS = (1.0 / 30.0, 30.0)

# Excess of half of the sum of squares up to which a fit is at the optimum.
SAME_OPTIMUM = 0.5

# Whitened residuals of a simulation that diverges, for the methods beside.
DIVERGED = 1e6

# Names of the methods.
METHODS = ("mjfim", "scipy", "sysid")

# Wanted share of right fits by mjfim.
WANTED = 0.95

# A carriage on a rail of one axis, with dry friction.
RAIL = """<mujoco model="rail">
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <body name="carriage">
      <inertial pos="0 0 0" mass="2.4" diaginertia="0.01 0.01 0.01"/>
      <joint name="x" type="slide" axis="1 0 0" damping="7.0" frictionloss="5.0"
             stiffness="3.0"/>
      <geom type="box" size="0.1 0.1 0.1" mass="0" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="x" gear="10"/></actuator>
</mujoco>
"""

# A pendulum with a weak motor.
PENDULUM = """<mujoco model="pendulum">
  <option timestep="0.005" integrator="RK4"><flag contact="disable"/></option>
  <worldbody>
    <body name="pole">
      <joint name="hinge" axis="0 1 0" damping="0.05"/>
      <inertial pos="0 0 -0.4" mass="0.6" diaginertia="0.008 0.008 0.0004"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""

# A rotary pendulum of the size of a Quanser Qube.
FURUTA = """<mujoco model="furuta">
  <option timestep="0.002" integrator="implicitfast"><flag contact="disable"/></option>
  <worldbody>
    <body name="arm" pos="0 0 0.13">
      <joint name="theta" axis="0 0 1" damping="2e-4" armature="1e-5"/>
      <inertial pos="0.0425 0 0" mass="0.095" diaginertia="1e-6 5.7e-5 5.7e-5"/>
      <body name="pole" pos="0.085 0 0">
        <joint name="alpha" axis="1 0 0" damping="2e-5"/>
        <inertial pos="0 0 -0.0645" mass="0.024" diaginertia="3.3e-5 3.3e-5 2e-7"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="theta"/></actuator>
</mujoco>
"""


@record
class Robot:
    """A robot of the study.

    Attributes:
        name: Its name.
        model: MJCF as text, or its path.
        rate: Samples per second.
        seconds: Duration of the recording [s].
        amplitude: Amplitude of each control [u-unit].
        offset: Constant that is added to each control [u-unit].
        parameters: Tables of the parameters, without bounds.
        noise: Standard deviations of the outputs.
        initial: The initial state.
    """

    name: str
    model: str | Path
    rate: float
    seconds: float
    amplitude: tuple[float, ...]
    parameters: dict[str, Any]
    noise: dict[str, float]
    initial: dict[str, Any]
    offset: tuple[float, ...] = (0.0,)


def of_file(file: str, seconds: float, amplitude: tuple[float, ...], **changes: Any) -> Robot:
    """A robot of an experiment file of the repository.

    Args:
        file: Name of the file.
        seconds: Duration of the recording [s].
        amplitude: Amplitude of each control.
        **changes: Attributes with other values.
    """
    experiment = mjfim.Experiment.from_file(ROOT / "models" / f"{file}.toml")
    parameters = {}
    for key, spec in experiment.parameters.items():
        stated = spec.model_dump(exclude_none=True, include={"target", "targets", "unit", "scale"})
        if spec.true is not None:
            stated["guess"] = spec.true
        parameters[key] = stated
    keyframe = experiment.initial.keyframe
    values: dict[str, Any] = {
        "name": file,
        "model": ROOT / "models" / experiment.model,
        "rate": experiment.rate,
        "seconds": seconds,
        "amplitude": amplitude,
        "parameters": parameters,
        "noise": dict(experiment.noise),
        "initial": {} if keyframe is None else {"keyframe": keyframe},
    }
    return Robot(**{**values, **changes})


def robots() -> tuple[Robot, ...]:
    """The robots of the study."""
    angle = {"qpos:hinge": 0.05, "qvel:hinge": 0.05}
    furuta = {
        "arm_damping": {"target": "joint/theta:damping"},
        "pole_damping": {"target": "joint/alpha:damping"},
        "arm_armature": {"target": "joint/theta:armature"},
        "pole_mass": {"target": "body/pole:mass"},
        "gain": {"target": "actuator/motor:gainprm[0]"},
    }
    servo = {
        "yaw_angle": 0.002,
        "shoulder_angle": 0.002,
        "elbow_angle": 0.002,
        "wrist_angle": 0.002,
    }
    return (
        Robot(
            name="pendulum",
            model=PENDULUM,
            rate=100.0,
            seconds=8.0,
            amplitude=(1.2,),
            parameters={
                "mass": {"target": "body/pole:mass"},
                "com": {"targets": [{"path": "body/pole:ipos[2]", "scale": -1.0}]},
                "damping": {"target": "joint/hinge:damping"},
            },
            noise={"qpos:hinge": 0.01},
            initial={},
        ),
        of_file("cart_pendulum", 6.0, (4.0,), noise={"state": 0.05}),
        # Without the motion of the cart, no equation of motion can be fitted.
        of_file("cart_pendulum", 6.0, (4.0,), name="cart_unseen", noise=angle),
        Robot(
            name="furuta",
            model=FURUTA,
            rate=100.0,
            seconds=6.0,
            amplitude=(0.006,),
            parameters=furuta,
            noise={"qpos:theta": 0.002, "qpos:alpha": 0.002},
            initial={},
        ),
        Robot(
            name="rail",
            model=RAIL,
            rate=1000.0,
            seconds=4.0,
            amplitude=(2.5,),
            parameters={
                "mass": {"target": "body/carriage:mass"},
                "damping": {"target": "joint/x:damping"},
                "friction": {"target": "joint/x:frictionloss"},
                "stiffness": {"target": "joint/x:stiffness"},
            },
            noise={"qpos:x": 1e-4, "qvel:x": 5e-3},
            initial={},
        ),
        of_file(
            "servo_arm",
            4.0,
            (0.4, 0.35, 0.4, 0.4),
            noise=servo,
            offset=(0.0, 0.5, 1.2, 0.4),
        ),
        of_file("two_joint_arm", 4.0, (4.0, 1.5), rate=500.0),
    )


@record
class Outcome:
    """Outcome of one run.

    Attributes:
        robot: Name of the robot.
        start: Factors of the start.
        excess: Excess of half of the sum of squares over the optimum, by method; infinite where a
            method failed, NaN where it is not installed or was not asked for.
        seconds: Time of the processors that mjfim took [s].
        restarted: Whether mjfim restarted its fit.
        by_dynamics: Whether the restart began at a fit to the equation of motion.
    """

    robot: str
    start: tuple[float, ...]
    excess: dict[str, float]
    seconds: float
    restarted: bool
    by_dynamics: bool


class OutOfTimeError(Exception):
    """The time of a method is over."""


class Timed:
    """Residuals that end with an exception when the time is over, and remember the best point."""

    def __init__(self, residuals: Callable[[Array], Any], seconds: float) -> None:
        self.residuals = residuals
        self.end = time.process_time() + seconds
        self.best: Array | None = None
        self.cost = np.inf

    def __call__(self, x: Array) -> Any:
        """Residuals at x: (p,), or at several points as columns."""
        if time.process_time() > self.end:
            raise OutOfTimeError
        found = self.residuals(x)
        if x.ndim == 1 or x.shape[1] == 1:
            parts = found if isinstance(found, list) else [found]
            cost = 0.5 * sum(float(np.sum(part**2)) for part in parts)
            if cost < self.cost:
                self.best, self.cost = np.array(x).ravel(), cost
        return found


@record
class Job:
    """One run of the study.

    Attributes:
        robot: Name of the robot.
        seed: Seed of the study.
        number: Number of the run.
        methods: Names of the methods.
    """

    robot: str
    seed: int
    number: int
    methods: tuple[str, ...]


def run(job: Job) -> Outcome:
    """Fit one recording from one start by the methods of a job.

    Args:
        job: The run.
    """
    name = job.robot
    robot = next(each for each in robots() if each.name == name)
    rng = np.random.default_rng([job.seed, job.number])
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        system = resolved(robot, Path(folder))
        true = np.array(system.parameters.guess)
        recording = simulated(system, robot, rng)

        problem = FitProblem.of(system, [recording])
        least = least_squares(problem, true).cost

        factors = np.exp(rng.uniform(np.log(FACTORS[0]), np.log(FACTORS[1]), len(true)))
        factors **= rng.choice([-1.0, 1.0], len(true))
        start = true * factors
        begun = time.process_time()
        try:
            estimate = identify_system(system, [recording], start=start)
            theta: Array | None = estimate.theta
            restart = estimate.restart
        except MjfimError:
            theta, restart = None, None
        seconds = time.process_time() - begun

        found: dict[str, Array | None] = {"mjfim": theta}
        if "scipy" in job.methods:
            found["scipy"] = by_scipy(problem, start, seconds)
        if "sysid" in job.methods and hasattr(sysid, "optimize"):
            found["sysid"] = by_sysid(system, recording, start, seconds)
        excess = dict.fromkeys(METHODS, np.nan)
        for method, x in found.items():
            excess[method] = np.inf if x is None else problem.cost(problem.begin(x)) - least
    return Outcome(
        robot=name,
        start=tuple(factors.tolist()),
        excess=excess,
        seconds=seconds,
        restarted=restart is not None,
        by_dynamics=restart is not None and restart.by_dynamics,
    )


def resolved(robot: Robot, folder: Path) -> System:
    """The system of a robot whose guess is true, with wide bounds.

    Args:
        robot: The robot.
        folder: Folder for its model.
    """
    model = robot.model
    if isinstance(model, str):
        model = folder / "model.xml"
        model.write_text(str(robot.model), encoding="utf-8")
    tables: dict[str, Any] = {
        "model": str(model),
        "rate": robot.rate,
        "noise": robot.noise,
        "initial": robot.initial,
    }
    guesses = System.resolve(mjfim.Experiment(parameters=robot.parameters, **tables), threads=1)
    values = zip(guesses.parameters.names, guesses.parameters.guess.tolist(), strict=True)
    bounds = {name: [factor * value for factor in BOUNDS] for name, value in values}
    parameters = {
        name: {**table, "bounds": bounds[name]} for name, table in robot.parameters.items()
    }
    experiment = mjfim.Experiment(parameters=parameters, fit={"bootstrap": 0}, **tables)
    return System.resolve(experiment, threads=1)


def simulated(system: System, robot: Robot, rng: np.random.Generator) -> Recording:
    """A recording of the robot with noise.

    Args:
        system: The system at its true parameters.
        robot: The robot.
        rng: Source of random numbers.
    """
    count = round(robot.seconds * robot.rate)
    t: Array = np.arange(count + 1, dtype=np.float64) * system.dt
    shape = multisine(t[:-1], len(robot.amplitude), 0.4, 6, rng)
    ctrl = np.array(robot.offset) + np.array(robot.amplitude) * shape
    y = system.plant.measure(system.parameters.guess[None], ctrl)[0][0]
    y = y + system.noise.sigma * rng.standard_normal(y.shape)
    return Recording(t=t, ctrl=ctrl, y=y, outputs=system.outputs.names, name=robot.name)


def by_scipy(problem: FitProblem, start: Array, seconds: float) -> Array | None:
    """Parameters of a fit to whole rollouts by scipy; None where it failed.

    Args:
        problem: Simulates the recording.
        start: (p,) parameters at which it starts.
        seconds: Time of the processors that it may take [s].
    """
    sizes = problem.system.parameters.magnitude
    sigma = problem.noise.sigma

    def residuals(x: Array) -> Array:
        """Whitened residuals of all outputs."""
        errors = problem.errors_at(problem.begin(x * sizes))
        if errors is None:
            return np.full(problem.value_count, DIVERGED)
        return np.concatenate([e / s for e, s in zip(errors, sigma, strict=True)])

    timed = Timed(residuals, seconds)
    lower, upper = problem.lower / sizes, problem.upper / sizes
    try:
        scipy.optimize.least_squares(
            timed, np.clip(start / sizes, lower, upper), bounds=(lower, upper), x_scale="jac"
        )
    except OutOfTimeError:
        pass
    except (ValueError, np.linalg.LinAlgError):
        return None
    return None if timed.best is None else timed.best * sizes


def by_sysid(system: System, recording: Recording, start: Array, seconds: float) -> Array | None:
    """Parameters of a fit by mujoco.sysid; None where it failed.

    Args:
        system: The system, whose guess is true.
        recording: The recording.
        start: (p,) parameters at which it starts.
        seconds: Time of the processors that it may take [s].
    """
    exported = sysid_problem(system, [recording])
    parameters = exported.parameters.copy()
    residual = exported.residual
    sizes = [len(part) for part in residual(system.parameters.guess, parameters)[0]]
    lower, upper = parameters.get_bounds()
    parameters.update_from_vector(np.clip(start, lower, upper))

    def residuals(x: Array) -> list[Array]:
        """Residuals at x: (p,), or at several points as columns, which may diverge one by one."""
        try:
            return list(residual(x, parameters)[0])
        except ValueError:
            if x.ndim == 1:
                return [np.full(size, DIVERGED) for size in sizes]
            if x.shape[1] == 1:
                return [np.full((size, 1), DIVERGED) for size in sizes]
        columns = [residuals(x[:, [j]]) for j in range(x.shape[1])]
        return [np.concatenate(parts, axis=1) for parts in zip(*columns, strict=True)]

    timed = Timed(residuals, seconds)
    options = {"x_scale": "jac", "verbose": False, "max_iters": 200, "output": io.StringIO()}
    with silenced():
        try:
            sysid.optimize(parameters, lambda x, _: (timed(x), None, None), **options)
        except OutOfTimeError:
            pass
        except (ValueError, RuntimeError, np.linalg.LinAlgError):
            return timed.best
    return timed.best


def table_of(outcomes: Sequence[Outcome]) -> Table:
    """Share of right fits, by robot and method."""
    title = "Fits at the optimum, from starts wrong by factors of 3 to 10 in every parameter"
    headings = ("robot", "runs", "mjfim", "scipy", "mujoco.sysid", "restarted", "seconds")
    table = new_table(title, *headings)
    names = dict.fromkeys(outcome.robot for outcome in outcomes)
    for name in [*names, "all"]:
        chosen = [outcome for outcome in outcomes if name in (outcome.robot, "all")]
        shares = [share_of(chosen, method) for method in METHODS]
        restarted = sum(outcome.restarted for outcome in chosen)
        by_dynamics = sum(outcome.by_dynamics for outcome in chosen)
        table.add_row(
            name,
            str(len(chosen)),
            *("-" if np.isnan(share) else f"{100.0 * share:.0f} %" for share in shares),
            f"{restarted} ({by_dynamics})",
            f"{np.mean([outcome.seconds for outcome in chosen]):.1f}",
        )
    return table


def share_of(outcomes: Sequence[Outcome], method: str) -> float:
    """Share of right fits by a method; NaN where it is not installed."""
    excess = np.array([outcome.excess[method] for outcome in outcomes])
    return float("nan") if np.isnan(excess).any() else float(np.mean(excess <= SAME_OPTIMUM))


def main() -> int:
    """Print the table; return 1 where mjfim finds the optimum too rarely."""
    parser = options_of(__doc__)
    known = [robot.name for robot in robots()]
    parser.add_argument("--runs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robots", nargs="*", choices=known, default=known)
    parser.add_argument("--methods", nargs="*", choices=METHODS, default=METHODS)
    parser.add_argument("--workers", type=int, default=cores())
    parser.add_argument("-o", "--output", type=Path, help="JSON file with all runs")
    args = parser.parse_args()

    methods = tuple(args.methods)
    jobs = [
        Job(robot=name, seed=args.seed, number=number, methods=methods)
        for number in range(args.runs)
        for name in args.robots
    ]
    outcomes = []
    for outcome in in_processes(run, jobs, args.workers):
        outcomes.append(outcome)
        if args.output is not None:
            write_json(args.output, {"runs": [asdict(each) for each in outcomes]})

    console = Console(width=100)
    console.print(table_of(outcomes))
    console.print("restarted: fits that mjfim repeated (of these, from the equation of motion)")
    return 0 if share_of(outcomes, "mjfim") >= WANTED else 1
