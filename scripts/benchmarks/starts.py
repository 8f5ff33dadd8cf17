"""How often fits find the optimum from starts that are wrong by factors of 3 to 10.

    python -m scripts.benchmarks starts [--runs 20] [--seed 0] [--robots NAME ...] [-o FILE.json]

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

import contextlib
import io
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import scipy
from mujoco import sysid
from rich.console import Console

import mjfim
from mjfim.arrays import Array
from mjfim.errors import MjfimError
from mjfim.experiment.initial import multisine
from mjfim.experiment.system import System
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import identify_system, least_squares
from mjfim.output.export.sysid import silenced, sysid_problem
from mjfim.records.trajectory import Recording
from scripts.benchmarks.child import (
    ROOT,
    Outcome,
    options_of,
    percent,
    share,
    study,
    table_of,
)

# Factors by which starts are wrong, and bounds of the parameters over their true values.
FACTORS = (3.0, 10.0)
BOUNDS = (1.0 / 30.0, 30.0)

# Excess of half of the sum of squares up to which a fit is at the optimum.
SAME_OPTIMUM = 0.5

# Whitened residuals of a simulation that diverges, for the methods beside.
DIVERGED = 1e6

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


# Targets of the parameters of these models.
PENDULUM_TARGETS = {
    "mass": {"target": "body/pole:mass"},
    "com": {"targets": [{"path": "body/pole:ipos[2]", "scale": -1.0}]},
    "damping": {"target": "joint/hinge:damping"},
}
FURUTA_TARGETS = {
    "arm_damping": {"target": "joint/theta:damping"},
    "pole_damping": {"target": "joint/alpha:damping"},
    "arm_armature": {"target": "joint/theta:armature"},
    "pole_mass": {"target": "body/pole:mass"},
    "gain": {"target": "actuator/motor:gainprm[0]"},
}
RAIL_TARGETS = {
    "mass": {"target": "body/carriage:mass"},
    "damping": {"target": "joint/x:damping"},
    "friction": {"target": "joint/x:frictionloss"},
    "stiffness": {"target": "joint/x:stiffness"},
}
SERVO_NOISE = {f"{joint}_angle": 0.002 for joint in ("yaw", "shoulder", "elbow", "wrist")}

# Without the motion of the cart, no equation of motion can be fitted.
UNSEEN = {"qpos:hinge": 0.05, "qvel:hinge": 0.05}

# Robots with the duration of the recording [s], amplitude and offset of each control, and tables of
# their experiments: a model above, or an experiment file of the repository.
ROBOTS: dict[str, tuple[float, Any, Any, dict[str, Any]]] = {
    "pendulum": (
        8.0,
        1.2,
        0.0,
        {
            "model": PENDULUM,
            "rate": 100.0,
            "parameters": PENDULUM_TARGETS,
            "noise": {"qpos:hinge": 0.01},
        },
    ),
    "cart_pendulum": (6.0, 4.0, 0.0, {"noise": {"state": 0.05}}),
    "cart_unseen": (6.0, 4.0, 0.0, {"file": "cart_pendulum", "noise": UNSEEN}),
    "furuta": (
        6.0,
        0.006,
        0.0,
        {
            "model": FURUTA,
            "rate": 100.0,
            "parameters": FURUTA_TARGETS,
            "noise": {"qpos:theta": 0.002, "qpos:alpha": 0.002},
        },
    ),
    "rail": (
        4.0,
        2.5,
        0.0,
        {
            "model": RAIL,
            "rate": 1000.0,
            "parameters": RAIL_TARGETS,
            "noise": {"qpos:x": 1e-4, "qvel:x": 5e-3},
        },
    ),
    "servo_arm": (4.0, (0.4, 0.35, 0.4, 0.4), (0.0, 0.5, 1.2, 0.4), {"noise": SERVO_NOISE}),
    "two_joint_arm": (4.0, (4.0, 1.5), 0.0, {"rate": 500.0}),
}


class OutOfTimeError(Exception):
    """The time of a method is over."""


def resolved(name: str, folder: Path) -> System:
    """The system of a robot whose guess is true, with wide bounds.

    Args:
        name: Name of the robot.
        folder: Folder for its model.
    """
    tables = dict(ROBOTS[name][3])
    if "model" in tables:
        (folder / "model.xml").write_text(tables["model"], encoding="utf-8")
        tables["model"] = str(folder / "model.xml")
    else:
        file = ROOT / "models" / f"{tables.pop('file', name)}.toml"
        stated = mjfim.Experiment.from_file(file)
        parameters = {}
        for key, spec in stated.parameters.items():
            kept = {"target", "targets", "unit", "scale"}
            parameters[key] = spec.model_dump(exclude_none=True, include=kept)
            if spec.true is not None:
                parameters[key]["guess"] = spec.true
        tables = {
            "model": str(file.parent / stated.model),
            "rate": stated.rate,
            "parameters": parameters,
            "noise": dict(stated.noise),
            "initial": {"keyframe": stated.initial.keyframe},
            **tables,
        }
    found = System.resolve(mjfim.Experiment(**tables), threads=1)
    values = zip(found.parameters.names, found.parameters.guess.tolist(), strict=True)
    bounds = {key: {"bounds": [factor * value for factor in BOUNDS]} for key, value in values}
    experiment = found.experiment.replace(parameters=bounds, fit={"bootstrap": 0})
    return System.resolve(experiment, threads=1)


def best_in_time(
    seconds: float,
    residuals: Callable[[Array], list[Array]],
    fit: Callable[[Callable[[Array], list[Array]]], Any],
) -> Array | None:
    """The best point that a fit has seen in its time; None where it has seen none.

    Args:
        seconds: Time of the processors that it may take [s].
        residuals: Residuals at x: (p,), or at several points as columns.
        fit: Minimises the sum of their squares.
    """
    end = time.process_time() + seconds
    best, least = None, np.inf

    def timed(x: Array) -> list[Array]:
        nonlocal best, least
        if time.process_time() > end:
            raise OutOfTimeError
        found = residuals(x)
        if x.ndim == 1 or x.shape[1] == 1:
            cost = sum(float(np.sum(part**2)) for part in found)
            if cost < least:
                best, least = np.array(x).ravel(), cost
        return found

    ends = OutOfTimeError, ValueError, RuntimeError, np.linalg.LinAlgError
    with contextlib.suppress(*ends):
        fit(timed)
    return best


def by_scipy(problem: FitProblem, start: Array, seconds: float) -> Array | None:
    """Parameters of a fit to whole rollouts by scipy, from a start: (p,)."""
    sizes = problem.system.parameters.magnitude

    def residuals(x: Array) -> list[Array]:
        errors = problem.errors_at(problem.begin(x * sizes))
        if errors is None:
            return [np.full(problem.value_count, DIVERGED)]
        return [e / s for e, s in zip(errors, problem.noise.sigma, strict=True)]

    bounds = problem.lower / sizes, problem.upper / sizes
    begin = np.clip(start / sizes, *bounds)
    best = best_in_time(
        seconds,
        residuals,
        lambda timed: scipy.optimize.least_squares(
            lambda x: np.concatenate(timed(x)), begin, bounds=bounds, x_scale="jac"
        ),
    )
    return None if best is None else best * sizes


def by_sysid(problem: FitProblem, recording: Recording, start: Array, seconds: float) -> Any:
    """Parameters of a fit by mujoco.sysid, from a start: (p,); None where it failed."""
    exported = sysid_problem(problem.system, [recording])
    parameters = exported.parameters.copy()
    at_true = exported.residual(problem.system.parameters.guess, parameters)[0]
    parameters.update_from_vector(np.clip(start, *parameters.get_bounds()))

    def residuals(x: Array) -> list[Array]:
        """Points may diverge one by one."""
        try:
            return list(exported.residual(x, parameters)[0])
        except ValueError:
            if x.ndim == 1 or x.shape[1] == 1:
                return [np.full((len(part), *x.shape[1:]), DIVERGED) for part in at_true]
        columns = [residuals(x[:, [j]]) for j in range(x.shape[1])]
        return [np.concatenate(parts, axis=1) for parts in zip(*columns, strict=True)]

    options = {"x_scale": "jac", "verbose": False, "max_iters": 200, "output": io.StringIO()}
    with silenced():
        return best_in_time(
            seconds,
            residuals,
            lambda timed: sysid.optimize(
                parameters, lambda x, _: (timed(x), None, None), **options
            ),
        )


def run(name: str, seed: int, number: int) -> Outcome:
    """Fit one recording of a robot from one start by all methods."""
    duration, amplitude, offset, _ = ROBOTS[name]
    rng = np.random.default_rng([seed, number])
    warnings.simplefilter("ignore")
    with tempfile.TemporaryDirectory() as folder:
        system = resolved(name, Path(folder))
        true = np.array(system.parameters.guess)
        t = np.arange(round(duration / system.dt) + 1, dtype=np.float64) * system.dt
        ctrl = offset + amplitude * multisine(t[:-1], np.size(amplitude), 0.4, 6, rng)
        y = system.plant.measure(true[None], ctrl)[0][0]
        y = y + system.noise.sigma * rng.standard_normal(y.shape)
        recording = Recording(t=t, ctrl=ctrl, y=y, outputs=system.outputs.names, name=name)

        problem = FitProblem.of(system, [recording])
        least = least_squares(problem, true).cost

        factors = np.exp(rng.uniform(np.log(FACTORS[0]), np.log(FACTORS[1]), len(true)))
        factors **= rng.choice([-1.0, 1.0], len(true))
        start = true * factors
        begun = time.process_time()
        try:
            estimate = identify_system(system, [recording], start=start)
        except MjfimError:
            estimate = None
        seconds = time.process_time() - begun

        found = {
            "mjfim": None if estimate is None else estimate.theta,
            "scipy": by_scipy(problem, start, seconds),
        }
        if hasattr(sysid, "optimize"):
            found["mujoco.sysid"] = by_sysid(problem, recording, start, seconds)
        is_right = {
            method: x is not None and problem.cost(problem.begin(x)) - least <= SAME_OPTIMUM
            for method, x in found.items()
        }
    return {
        "robot": name,
        "mujoco.sysid": [],
        **is_right,
        "seconds": seconds,
        "restarted": estimate is not None and estimate.restart is not None,
    }


def main() -> int:
    """Print the table; return 1 where mjfim finds the optimum too rarely."""
    parser = options_of(__doc__, runs=20)
    parser.add_argument("--robots", nargs="*", choices=list(ROBOTS), default=list(ROBOTS))
    args = parser.parse_args()

    jobs = [(name, args.seed, number) for number in range(args.runs) for name in args.robots]
    outcomes = study(run, jobs, args.processes, args.output)
    columns = {
        **{method: percent(method) for method in ("mjfim", "scipy", "mujoco.sysid")},
        "restarted": percent("restarted"),
        "seconds": lambda group: f"{share(group, 'seconds'):.1f}",
    }
    title = "Fits at the optimum, from starts wrong by factors of 3 to 10 in every parameter"
    Console(width=100).print(table_of(title, outcomes, ("robot",), columns, has_all=True))
    return 0 if share(outcomes, "mjfim") >= WANTED else 1
