"""Identification of simulated arms from closed-loop logs: coverage, held-out torques and time.

    python -m scripts.benchmarks arm_logs [--runs 50] [--seconds 12] [--seed 0] [-o FILE.json]

The arms are the Franka Emika Panda (its model lies beside the repository; it is left out where that
is absent) and an arm with the dimensions and masses of a UR5e. Position servos follow Fourier
series at 500 Hz. Angles of joints and torques of motors are logged at 125 Hz, with noise and some
milliseconds late. The true inertias differ from those of the model at random, and so do damping
and dry friction of the joints. The fit knows the servos and the rotors. It estimates ten inertial
parameters of every link, damping and dry friction of every joint, and the delay.

In half of the runs, the robot has friction that the stated model lacks: Stribeck friction and a
Coulomb friction that differs by direction. These are fitted again with a model that has such
friction with unknown sizes at every joint. The script counts how often the 95 % intervals hold

- the base parameters, which are the combinations of inertias that forces depend on,
- the torques that the true robot needs along another trajectory.

It compares the residual torque of the held-out log with that of the true model, and counts how
often `misfit` is raised.
"""

from __future__ import annotations

import copy
import tempfile
import time
from itertools import product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import scipy
from rich.console import Console

import mjfim
from mjfim.arrays import NORMAL_95, Array
from mjfim.experiment.system import System
from mjfim.identification.assessment.residual_tests import misfit_reasons
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import fit_task
from mjfim.identification.linear_coordinates import LinearCoordinates
from mjfim.identification.search import FitSearch, FitTask
from mjfim.model.inertia import INERTIA_PARAMETRISATIONS, barycentric_of, logcholesky_factor
from mjfim.parallel import one_blas_thread
from mjfim.parallel.budget import Budget
from mjfim.records.trajectory import Recording
from scripts.benchmarks.arm_models import TIMESTEP, Arm, panda, ur5e
from scripts.benchmarks.child import (
    median,
    options_of,
    percent,
    rms,
    share,
    study,
    table_of,
)

# Samples of the controller per measurement, and the longest delay of the measurements [samples].
STRIDE = 4
MAX_DELAY = 3

# Standard deviation of the measured angles [rad].
ANGLE_SIGMA = 1e-4

# Standard deviation of the logarithms of the true inertias relative to those of the model.
SPREAD = 0.2

# Kinds of friction that the fitted model lacks, with their fields, and their sizes over the dry
# friction of the joint.
FRICTION = {"stribeck": ("excess", "speed"), "asymmetric_friction": ("offset",)}
STRIBECK = (0.2, 0.5)
OFFSET = (-0.2, 0.2)
STRIBECK_SPEED = 0.1

# Fundamental frequency [Hz] and number of harmonics of the references, and the share of the ranges
# of the joints that they use.
FREQUENCY, HARMONICS = 0.1, 5
RANGE_SHARE = 0.6

# Time in which the arm leaves its rest [s], and duration of the held-out log [s].
RAMP = 1.5
HELD_OUT = 8.0

# Recordings of a run.
RECORDINGS = 3

# Speed below which the sign of dry friction is not certain [rad/s].
SLOW = 0.02

# Random motions from which base parameters are found, and their smallest relative singular value.
MOTIONS = 60
BASE_TOLERANCE = 1e-8

# Wanted coverage, and ratio of residual torques.
WANTED_COVERAGE, WANTED_RATIO = 0.90, 1.1

# Friction of the robot, and friction of the fitted model, in words.
KNOWN, LACKING = "in the model", "partly not in the stated model"
STATED, RICHER = "as stated", "with richer friction"


# ---- robots and logs


def stated(arm: Arm, folder: Path, *, is_richer: bool) -> mjfim.Experiment:
    """The experiment as the user states it.

    Args:
        arm: The arm.
        folder: Where its model is written.
        is_richer: Whether every joint has Stribeck friction and friction that differs by direction,
            of unknown size.
    """
    (folder / "arm.xml").write_text(arm.xml, encoding="utf-8")
    parameters: dict[str, Any] = {link: {"inertial": link} for link in arm.links}
    for joint, typical in zip(arm.joints, arm.friction.tolist(), strict=True):
        for field in ("damping", "frictionloss"):
            target = f"joint/{joint}:{field}"
            table = {"target": target, "guess": 0.3 * typical, "scale": typical}
            parameters[f"{field} {joint}"] = table
    terms: dict[str, Any] = {}
    for joint, kind in product(arm.joints if is_richer else (), FRICTION):
        name = f"{kind} {joint}"
        terms[name] = {"kind": kind, "joint": joint}
        for field in FRICTION[kind]:
            parameters[f"{field} {joint}"] = {"target": f"term/{name}:{field}"}
    noise = {f"qpos:{joint}": ANGLE_SIGMA for joint in arm.joints}
    torques = [f"torque_{joint}" for joint in arm.joints]
    noise |= dict(zip(torques, arm.sigma.tolist(), strict=True))
    return mjfim.Experiment(
        model="arm.xml",
        rate=1.0 / TIMESTEP,
        measure_rate=1.0 / (STRIDE * TIMESTEP),
        initial={"qpos": arm.home.tolist()},
        parameters=parameters,
        terms=terms,
        nuisance={"delay": True},
        noise=noise,
        fit={"start": "inverse_dynamics", "segments": 1.0, "bootstrap": 200},
        directory=folder,
        source="arm.toml",
    )


def robot(arm: Arm, system: System, lacks: bool, rng: np.random.Generator) -> tuple[System, Array]:
    """The true robot: its system, which may have friction that is not stated, and theta: (p,).

    Args:
        arm: The arm.
        system: The system as it is stated, without richer friction.
        lacks: Whether the robot has friction that this system lacks.
        rng: Source of random numbers.
    """
    theta = np.array(system.parameters.guess)
    names = list(system.parameters.names)
    for body in LinearCoordinates.of(system.parameters, theta).bodies:
        # The pseudo-inertia V V' becomes V exp(A) V'.
        A = np.zeros((4, 4))
        A[np.triu_indices(4)] = rng.normal(0.0, SPREAD, 10)
        factor = logcholesky_factor(body.reference)
        moved = factor @ scipy.linalg.expm(0.5 * (A + A.T)) @ factor.T
        inertia = INERTIA_PARAMETRISATIONS["barycentric"].inertia(barycentric_of(moved))
        theta[body.columns] = INERTIA_PARAMETRISATIONS["logcholesky"].coordinates(inertia)
    friction = list(zip(arm.joints, arm.friction.tolist(), strict=True))
    for joint, typical in friction:
        theta[names.index(f"damping {joint}")] = typical * rng.uniform(0.5, 2.0)
        theta[names.index(f"frictionloss {joint}")] = typical * rng.uniform(0.5, 1.5)
    theta[names.index("delay")] = TIMESTEP * int(rng.integers(1, MAX_DELAY + 1))
    if not lacks:
        return system, theta

    terms: dict[str, Any] = {}
    for joint, typical in friction:
        excess, offset = typical * rng.uniform(*STRIBECK), typical * rng.uniform(*OFFSET)
        for kind, sizes in zip(FRICTION, ((excess, STRIBECK_SPEED), (offset,)), strict=True):
            values = dict(zip(FRICTION[kind], sizes, strict=True))
            terms[f"{kind} {joint}"] = {"kind": kind, "joint": joint, "values": values}
    extended = system.experiment.replace(terms=terms)
    return System.resolve(extended, threads=system.threads), theta


def log_of(
    arm: Arm, system: System, theta: Array, seconds: float, rng: np.random.Generator
) -> tuple[Recording, Array, Array]:
    """Play Fourier series about the home position on the robot.

    Args:
        arm: The arm.
        system: The system of the robot.
        theta: (p,) its parameters.
        seconds: Duration [s].
        rng: Source of random numbers.

    Returns:
        The recording, the true states (N+1, ns), and the noise of the torques (N+1, n) [N m].
    """
    t = np.arange(0.0, seconds, TIMESTEP)
    q = np.zeros((len(t), len(arm.joints)))
    for j, size in enumerate((RANGE_SHARE * arm.range).tolist()):
        for k in range(1, HARMONICS + 1):
            phase = 2.0 * np.pi * k * FREQUENCY * t
            a, b = rng.normal(size=2) / k
            q[:, j] += a * np.sin(phase) + b * np.cos(phase)
        q[:, j] *= size / np.abs(q[:, j]).max()
    ramp = np.clip(t / RAMP, 0.0, 1.0)
    ctrl = (arm.home + q * (ramp**2 * (3.0 - 2.0 * ramp))[:, None])[:-1]

    start = system.plant.initial_state(theta)
    out = system.plant.simulator.rollout([system.plant.model(theta)], start[None], ctrl[None])
    assert out.sensors is not None
    exact = system.plant.outputs(out.states[0], out.sensors[0])

    # Measurements are late, and those of a part of the samples are logged.
    late = round(float(theta[list(system.parameters.names).index("delay")]) / TIMESTEP)
    y = np.concatenate([np.repeat(exact[:1], late, axis=0), exact[: len(exact) - late]])
    noise = rng.normal(size=y.shape) * system.noise.sigma
    y = y + noise
    y[np.arange(len(y)) % STRIDE != 0] = np.nan
    recording = Recording(t=t, ctrl=ctrl, y=y, outputs=system.outputs.names)
    return recording, out.states[0], noise[:, len(arm.joints) :]


# ---- what forces depend on


def inverse_torques(model: mujoco.MjModel, motion: Array) -> Array:
    """(K, n) torques of the motors without dry friction along motions.

    Args:
        model: The model; its dry friction is left out.
        motion: (K, 3, n) angles, speeds and accelerations.
    """
    model = copy.copy(model)
    model.dof_frictionloss[:] = 0.0
    data = mujoco.MjData(model)
    found = np.zeros((len(motion), model.nv))
    for k, (data.qpos[:], data.qvel[:], data.qacc[:]) in enumerate(motion):
        mujoco.mj_inverse(model, data)
        found[k] = data.qfrc_inverse
    return found


def base_parameters(arm: Arm, system: System) -> Array:
    """(b, p) map from linear coordinates to base parameters.

    They are those inertial parameters on which the torques along random motions depend linearly
    independently, each with the parameters that are lumped into it (Gautier 1991).
    """
    rng = np.random.default_rng(1)
    shape = (MOTIONS, len(arm.joints))
    angles = arm.home + arm.range * rng.uniform(-1.0, 1.0, shape)
    rates = (rng.normal(0.0, size, shape) for size in (2.0, 5.0))
    motion = np.stack([angles, *rates], axis=1)
    guess = np.array(system.parameters.guess)
    coordinates = LinearCoordinates.of(system.parameters, guess)
    columns = np.concatenate([body.columns for body in coordinates.bodies])
    x = coordinates.linear(guess)
    at_guess = inverse_torques(system.plant.model(guess), motion).ravel()
    differences, moves = np.zeros((at_guess.size, len(x))), np.eye(len(x))
    for body in coordinates.bodies:
        for column, size in zip(body.columns.tolist(), body.sizes.tolist(), strict=True):
            theta = np.array(guess)
            theta[column] += 0.1 * size
            torques = inverse_torques(system.plant.model(theta), motion).ravel()
            differences[:, column] = torques - at_guess
            moves[:, column] = coordinates.linear(theta) - x
    slopes = coordinates.slopes(differences, moves)[:, columns]

    # Columns are scaled by the sizes of the coordinates, so that their units do not matter.
    sizes = coordinates.sizes[columns]
    _, R, pivot = scipy.linalg.qr(slopes * sizes, mode="economic", pivoting=True)
    count = int((np.abs(np.diag(R)) > BASE_TOLERANCE * abs(R[0, 0])).sum())
    lumped = scipy.linalg.solve_triangular(R[:count, :count], R[:count, count:])
    combined = np.zeros((count, len(x)))
    combined[:, columns[pivot]] = np.hstack([np.eye(count), lumped])
    combined[:, columns] /= sizes
    return combined


def torques_along(system: System, theta: Array, motion: Array) -> Array:
    """(K, n) torques of the motors by a model, with all friction, along motions.

    Args:
        system: The system.
        theta: (p,) its parameters.
        motion: (K, 3, n) angles, speeds and accelerations.
    """
    model = system.plant.model(theta)
    v = motion[:, 1]
    found = inverse_torques(model, motion) + np.array(model.dof_frictionloss) * np.sign(v)

    # Friction of the library acts as passive devices, which are no part of the inverse dynamics.
    targets = [parameter.targets[0].path for parameter in system.parameters.parameters]
    values = dict(zip(targets, theta.tolist(), strict=True))
    for name, term in system.source.terms.items():
        table = system.experiment.terms[name]
        dof = int(model.joint(table.joint).dofadr[0])
        fields = [
            values.get(f"term/{name}:{field}", term.value(field)) for field in FRICTION[table.kind]
        ]
        if table.kind == "stribeck":
            excess, speed = fields
            falling = np.exp(-((v[:, dof] / speed) ** 2))
            found[:, dof] += excess * falling * np.sign(v[:, dof])
        else:
            found[:, dof] -= fields[0]
    return np.asarray(found)


# ---- runs


@one_blas_thread()
def run(arm: Arm, seed: int, number: int, lacks: bool, fit: str, duration: float) -> Any:
    """Log and identify one robot; shares are from 0 to 1."""
    rng = np.random.default_rng([seed, number, lacks])
    with tempfile.TemporaryDirectory() as folder:
        system = System.resolve(stated(arm, Path(folder), is_richer=False), threads=1)
        true_system, theta = robot(arm, system, lacks, rng)
        lengths = [duration / RECORDINGS] * RECORDINGS + [HELD_OUT]
        logs = [log_of(arm, true_system, theta, seconds, rng) for seconds in lengths]
        *recordings, held_out = [log[0] for log in logs]
        _, states, noise = logs[-1]

        fitted = system
        if fit == RICHER:
            fitted = System.resolve(stated(arm, Path(folder), is_richer=True), threads=1)

        # The parts of a report that search for more are left out.
        used = time.process_time()
        task = FitTask.of(fitted, recordings)
        found = fit_task(FitSearch(task=task, budget=Budget()))
        used = time.process_time() - used
        quality, robust = found.quality, found.accuracy.robust
        assert robust is not None
        covering = robust.covariance
        reasons = misfit_reasons(quality.chi2, quality.dof, True, quality.whiteness, missing=())

        # Base parameters do not depend on what the recordings cannot show. Those of a model with
        # more terms are the same.
        coordinates = LinearCoordinates.of(system.parameters, theta)
        inertial = np.concatenate([body.columns for body in coordinates.bodies])
        of_fitted = fitted.parameters.names
        places = [of_fitted.index(system.parameters.names[j]) for j in inertial.tolist()]
        estimate = np.array(theta)
        estimate[inertial] = found.theta[places]
        x = coordinates.linear(estimate)
        base = base_parameters(arm, system)
        error = base @ (x - coordinates.linear(theta))
        by_theta = (base @ np.linalg.inv(coordinates.derivative(x)))[:, inertial]
        of_base = np.diag(by_theta @ covering[np.ix_(places, places)] @ by_theta.T)

        # Torques along the motion of the held-out log, at samples at which no joint is slow.
        count = len(arm.joints)
        q, v = states[:, :count], states[:, count : 2 * count]
        a = np.gradient(v, TIMESTEP, axis=0)
        rows = np.flatnonzero((np.abs(v) > SLOW).all(axis=1))[:: STRIDE * 4]
        motion = np.stack([q[rows], v[rows], a[rows]], axis=1)
        true = torques_along(true_system, theta, motion)
        predicted = torques_along(fitted, found.theta, motion)
        steps = 1e-5 * np.diag(fitted.parameters.magnitude)
        moved = np.array([torques_along(fitted, found.theta + step, motion) for step in steps])
        slopes = (moved - predicted) / np.diag(steps)[:, None, None]
        variance = np.einsum("pkn,pq,qkn->kn", slopes, covering, slopes)

        # Residuals of the held-out log, from its own initial state.
        problem = FitProblem.of(fitted, [held_out])
        search = FitSearch(task=FitTask.of(fitted, [held_out]), budget=Budget())
        simulated = problem.predict(search.with_initial_states(problem, problem.begin(found.theta)))
        assert simulated is not None
        is_logged = problem.masks[0][:, count:].all(axis=1)
        residual = (simulated[0] - problem.recordings[0].y)[is_logged, count:]
        ratios = rms(residual, 0) / rms(noise[is_logged], 0)
    return {
        "arm": f"{arm.name} ({len(base)} base parameters)",
        "friction": LACKING if lacks else KNOWN,
        "fitted": fit,
        "base": np.mean(np.abs(error) <= NORMAL_95 * np.sqrt(of_base)),
        "torque": np.mean(np.abs(predicted - true) <= NORMAL_95 * np.sqrt(variance)),
        "ratio": rms(ratios),
        "misfit": bool(reasons),
        "success": found.solution.success,
        "seconds": used,
    }


def main() -> int:
    """Run the study and print its table; return 1 where a wanted number is missed.

    Torques of a model that lacks friction are not those of the robot, which `misfit` says. So they
    count where the fitted model has the friction of the robot.
    """
    parser = options_of(__doc__, runs=50)
    parser.add_argument("--seconds", type=float, default=12.0, help="data of a run [s]")
    args = parser.parse_args()

    console = Console(width=200)
    arms = [arm for arm in (panda(), ur5e()) if arm is not None]
    if len(arms) == 1:
        console.print("The model of the Panda is absent (../shared/models): it is left out.")

    # Halves of the runs of each arm lack friction in the model.
    lacks = [bool(number // len(arms) % 2) for number in range(args.runs)]
    jobs = [
        (arms[i % len(arms)], args.seed, i, lacks[i], fit, args.seconds)
        for fit in (STATED, RICHER)
        for i in range(args.runs)
        if lacks[i] or fit == STATED
    ]
    outcomes = study(run, jobs, args.processes, args.output)
    columns = {
        "base parameters inside": percent("base"),
        "torques inside": percent("torque"),
        "residual torque over the true model's": median("ratio", ".3f"),
        "misfit": percent("misfit"),
        "converged": percent("success"),
        "seconds of a processor": median("seconds"),
    }
    console.print(table_of("Arms", outcomes, ("arm", "friction", "fitted"), columns))

    whole = [each for each in outcomes if (each["friction"], each["fitted"]) != (LACKING, STATED)]
    shares = [share(outcomes, "base"), share(whole, "torque")]
    is_near = all(each["ratio"] <= WANTED_RATIO for each in whole)
    return 0 if is_near and min(shares) >= WANTED_COVERAGE else 1
