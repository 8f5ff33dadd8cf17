"""Identification of simulated arms from closed-loop logs: coverage, held-out torques and time.

    python -m scripts.benchmarks arm_logs [--runs 50] [--seconds 18] [--selected 4] [--laws 12]
    [--seed 0] [-o FILE.json]

The arms are the Franka Emika Panda (its model lies beside the repository; it is left out where that
is absent) and an arm with the dimensions and masses of a UR5e. Position servos follow Fourier
series at 500 Hz. Angles of joints and torques of motors are logged at 125 Hz, with noise and some
milliseconds late. The true inertias differ from those of the model at random, and so do damping
and dry friction of the joints. The fit knows the servos and the rotors. It estimates ten inertial
parameters of every link, damping and dry friction of every joint, and the delay.

In further runs, the UR5e has motors that take torques, and the logged references move it by
discrete PD laws, of which the fit knows the rate and has to estimate the gains.

In half of the runs, the robot has friction that the stated model lacks: Stribeck friction and a
Coulomb friction that differs by direction. These are fitted again with a model that has such
friction with unknown sizes at every joint, and some of them by `select_terms`, which has to find
it. The script counts how often the 95 % intervals hold

- the base parameters, which are the combinations of inertias that forces depend on,
- the torques that the true robot needs along another trajectory,
- the measured torques of a held-out log (parameters and residuals together).

It compares the residual torque of the held-out log with that of the true model, and counts how
often `misfit` is raised.
"""

from __future__ import annotations

import copy
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from enum import Enum
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import scipy
from rich.console import Console

import mjfim
from mjfim.arrays import NORMAL_95, Array, record
from mjfim.experiment.system import System
from mjfim.files import write_json
from mjfim.identification.assessment.residual_tests import misfit_reasons
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import fit_task
from mjfim.identification.linear_coordinates import LinearCoordinates
from mjfim.identification.search import FitSearch, FitTask
from mjfim.model.inertia import INERTIA_PARAMETRISATIONS, barycentric_of, logcholesky_factor
from mjfim.parallel import cores, one_blas_thread
from mjfim.parallel.budget import Budget
from mjfim.records.estimate import Estimate
from mjfim.records.trajectory import Recording
from scripts.benchmarks.arm_models import LAWS, TIMESTEP, Arm, panda, ur5e
from scripts.benchmarks.child import in_processes, options_of

# Samples of the controller per measurement, and the longest delay of the measurements [samples].
STRIDE = 4
MAX_DELAY = 3

# Standard deviation of the measured angles [rad].
ANGLE_SIGMA = 1e-4

# Standard deviation of the logarithms of the true inertias relative to those of the model.
SPREAD = 0.2

# Sizes of the friction that the fitted model lacks, over the dry friction of the joint.
STRIBECK = (0.2, 0.5)
OFFSET = (-0.2, 0.2)
STRIBECK_SPEED = 0.1

# True gains of discrete laws over those of the guess.
GAINS = (0.75, 1.3)

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

# Wanted coverage, ratio of residual torques, and time of a fit [s].
WANTED_COVERAGE, WANTED_RATIO = 0.90, 1.1


class Fit(Enum):
    """How a run is identified."""

    STATED = "as stated"
    RICHER = "with richer friction"
    SELECTED = "--select"


@record
class Job:
    """One run of the study.

    Attributes:
        arm: Name of the arm.
        seed: Seed of the study.
        number: Number of the run.
        lacks: Whether the stated model lacks friction.
        fit: How it is identified.
        seconds: Duration of the data [s].
    """

    arm: str
    seed: int
    number: int
    lacks: bool
    fit: Fit
    seconds: float


@record
class Outcome:
    """Outcome of one run; shares are from 0 to 1.

    Attributes:
        arm: Name of the arm.
        lacks: Whether the stated model lacks friction.
        fit: How it is identified.
        base: Share of the base parameters inside their intervals.
        base_formal: Share inside the formal intervals.
        torque: Share of the torques along another trajectory inside their intervals.
        measured: Share of the measured held-out torques inside their intervals.
        ratio: Residual held-out torque over that of the true model, root mean square over joints.
        ratio_equations: The same for the fit to the equation of motion.
        misfit: Whether a misfit is raised.
        success: Whether the search converged.
        passes: Simulations of all data.
        seconds: Wall time [s].
        cpu: Time of all processors [s].
        base_count: Number of base parameters.
        terms: Terms that a selection added, in words.
    """

    arm: str
    lacks: bool
    fit: str
    base: float
    base_formal: float
    torque: float
    measured: float
    ratio: float
    ratio_equations: float
    misfit: bool
    success: bool
    passes: float
    seconds: float
    cpu: float
    base_count: int
    terms: tuple[str, ...]


# ---- robots and logs


@cache
def arm_of(name: str) -> Arm:
    """The arm with a name.

    Raises:
        ValueError: Its model is absent.
    """
    arm = panda() if name == "Panda" else ur5e(has_laws=name == LAWS)
    if arm is None:
        raise ValueError(f"the model of {name} is absent")
    return arm


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
    for joint, typical in zip(arm.joints, arm.friction, strict=True):
        for field in ("damping", "frictionloss"):
            parameters[f"{field} {joint}"] = {
                "target": f"joint/{joint}:{field}",
                "guess": 0.3 * float(typical),
                "scale": float(typical),
            }
    terms: dict[str, Any] = {}
    for joint in arm.joints if is_richer else ():
        terms[f"stribeck {joint}"] = {"kind": "stribeck", "joint": joint}
        terms[f"offset {joint}"] = {"kind": "asymmetric_friction", "joint": joint}
        parameters[f"excess {joint}"] = {"target": f"term/stribeck {joint}:excess"}
        parameters[f"speed {joint}"] = {"target": f"term/stribeck {joint}:speed"}
        parameters[f"offset {joint}"] = {"target": f"term/offset {joint}:offset"}
    controllers: dict[str, Any] = {}
    if arm.gains is not None:
        for joint, (kp, kd) in zip(arm.joints, arm.gains.tolist(), strict=True):
            controllers[joint] = {"kp": kp, "kd": kd, "rate": 1.0 / TIMESTEP}
            for field in ("kp", "kd"):
                target = f"controller/{joint}:{field}"
                parameters[f"{field} {joint}"] = {"target": target, "nuisance": True}
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
        controllers=controllers,
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
        step = rng.normal(0.0, SPREAD, 10)
        theta[body.columns] = _moved_by_logarithm(body.reference, step)
    for joint, typical in zip(arm.joints, arm.friction.tolist(), strict=True):
        theta[names.index(f"damping {joint}")] = typical * rng.uniform(0.5, 2.0)
        theta[names.index(f"frictionloss {joint}")] = typical * rng.uniform(0.5, 1.5)
    for j, name in enumerate(names):
        if name.startswith(("kp ", "kd ")):
            theta[j] *= rng.uniform(*GAINS)
    theta[names.index("delay")] = TIMESTEP * int(rng.integers(1, MAX_DELAY + 1))
    if not lacks:
        return system, theta

    terms: dict[str, Any] = {}
    for joint, typical in zip(arm.joints, arm.friction.tolist(), strict=True):
        excess, offset = typical * rng.uniform(*STRIBECK), typical * rng.uniform(*OFFSET)
        terms[f"stribeck {joint}"] = {
            "kind": "stribeck",
            "joint": joint,
            "values": {"excess": excess, "speed": STRIBECK_SPEED},
        }
        terms[f"offset {joint}"] = {
            "kind": "asymmetric_friction",
            "joint": joint,
            "values": {"offset": offset},
        }
    extended = system.experiment.replace(terms=terms)
    return System.resolve(extended, threads=system.threads), theta


def _moved_by_logarithm(reference: Array, step: Array) -> Array:
    """(10,) log-Cholesky coordinates of `V exp(A) V'` with the entries (10,) of A."""
    A = np.zeros((4, 4))
    A[np.triu_indices(4)] = step
    factor = logcholesky_factor(reference)
    moved = factor @ scipy.linalg.expm(0.5 * (A + A.T)) @ factor.T
    inertia = INERTIA_PARAMETRISATIONS["barycentric"].inertia(barycentric_of(moved))
    return INERTIA_PARAMETRISATIONS["logcholesky"].coordinates(inertia)


def reference(arm: Arm, seconds: float, rng: np.random.Generator) -> Array:
    """(N, n) references of the servos: Fourier series about the home position [rad]."""
    t = np.arange(0.0, seconds, TIMESTEP)
    q = np.zeros((len(t), len(arm.joints)))
    for j, size in enumerate((RANGE_SHARE * arm.range).tolist()):
        for k in range(1, HARMONICS + 1):
            phase = 2.0 * np.pi * k * FREQUENCY * t
            a, b = rng.normal(size=2) / k
            q[:, j] += a * np.sin(phase) + b * np.cos(phase)
        q[:, j] *= size / np.abs(q[:, j]).max()
    ramp = np.clip(t / RAMP, 0.0, 1.0)
    return np.asarray(arm.home + q * (ramp**2 * (3.0 - 2.0 * ramp))[:, None])


@record
class Log:
    """A log and what the robot really did.

    Attributes:
        recording: The recording.
        states: (N+1, ns) true states.
        noise: (N+1, n) noise of the measured torques, where they are measured [N m].
    """

    recording: Recording
    states: Array
    noise: Array


def log_of(
    arm: Arm, system: System, theta: Array, seconds: float, name: str, rng: np.random.Generator
) -> Log:
    """Play a random reference on the robot.

    Args:
        arm: The arm.
        system: The system of the robot.
        theta: (p,) its parameters.
        seconds: Duration [s].
        name: Name of the log.
        rng: Source of random numbers.
    """
    control = reference(arm, seconds, rng)
    start = system.plant.initial_state(theta)
    models = [system.plant.model(theta)]
    out = system.plant.simulator.rollout(models, start[None], control[None, :-1])
    assert out.sensors is not None
    exact = system.plant.outputs(out.states[0], out.sensors[0])

    # Measurements are late, and those of a part of the samples are logged.
    late = round(float(theta[list(system.parameters.names).index("delay")]) / TIMESTEP)
    y = np.concatenate([np.repeat(exact[:1], late, axis=0), exact[: len(exact) - late]])
    noise = rng.normal(size=y.shape) * system.noise.sigma
    y = y + noise
    y[np.arange(len(y)) % STRIDE != 0] = np.nan
    t = np.arange(len(y), dtype=np.float64) * TIMESTEP
    recording = Recording(t=t, ctrl=control[:-1], y=y, outputs=system.outputs.names, name=name)
    count = len(arm.joints)
    return Log(recording=recording, states=out.states[0], noise=noise[:, count:])


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
    for k, (q, v, a) in enumerate(motion):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
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
    motion = np.stack(
        [
            arm.home + arm.range * rng.uniform(-1.0, 1.0, shape),
            rng.normal(0.0, 2.0, shape),
            rng.normal(0.0, 5.0, shape),
        ],
        axis=1,
    )
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
    sizes = np.concatenate([body.linear_sizes for body in coordinates.bodies])
    _, R, pivot = scipy.linalg.qr(slopes * sizes, mode="economic", pivoting=True)
    count = int((np.abs(np.diag(R)) > BASE_TOLERANCE * abs(R[0, 0])).sum())
    lumped = scipy.linalg.solve_triangular(R[:count, :count], R[:count, count:])
    combined = np.zeros((count, len(x)))
    combined[:, columns[pivot[:count]]] = np.eye(count)
    combined[:, columns[pivot[count:]]] = lumped
    scale = np.ones(len(x))
    scale[columns] = sizes
    return np.asarray(combined / scale)


def torques_along(system: System, theta: Array, motion: Array) -> Array:
    """(K, n) torques of the motors by a model, with all friction, along motions.

    Args:
        system: The system.
        theta: (p,) its parameters.
        motion: (K, 3, n) angles, speeds and accelerations.
    """
    model = system.plant.model(theta)
    dry = np.array(model.dof_frictionloss)
    v = motion[:, 1]
    found = inverse_torques(model, motion) + dry * np.sign(v)

    # Friction of the library acts as passive devices, which are no part of the inverse dynamics.
    targets = [parameter.targets[0].path for parameter in system.parameters.parameters]
    values = dict(zip(targets, theta.tolist(), strict=True))
    for name, term in system.source.terms.items():
        table = system.experiment.terms[name]
        dof = int(model.joint(table.joint).dofadr[0])

        def value(field: str, name: str = name, term: Any = term) -> float:
            """Value of a field: that of a parameter, or the stated one."""
            return float(values.get(f"term/{name}:{field}", term.value(field)))

        if table.kind == "stribeck":
            falling = np.exp(-((v[:, dof] / value("speed")) ** 2))
            found[:, dof] += value("excess") * falling * np.sign(v[:, dof])
        elif table.kind == "asymmetric_friction":
            found[:, dof] -= value("offset")
        else:
            raise ValueError(f"the torque of a term of kind {table.kind!r} is not known here")
    return np.asarray(found)


def motion_of(log: Log, count: int) -> Array:
    """(K, 3, n) angles, speeds and accelerations of samples at which no joint is slow."""
    q, v = log.states[:, :count], log.states[:, count : 2 * count]
    a = np.gradient(v, TIMESTEP, axis=0)
    is_fast = (np.abs(v) > SLOW).all(axis=1)
    rows = np.flatnonzero(is_fast)[:: STRIDE * 4]
    return np.stack([q[rows], v[rows], a[rows]], axis=1)


# ---- runs


@record
class Fitted:
    """Estimate of one fit, with its uncertainty and judgement.

    Attributes:
        system: The fitted system, with the terms that a selection added.
        theta: (p,) estimate.
        formal: (p, p) formal covariance.
        covering: (p, p) covariance that allows for residuals that are not white. It is zero for
            parameters that a selection held.
        rms: (n,) residual torques [N m].
        equations: (p,) the fit to the equation of motion; None where it is not asked for.
        misfit: Whether a misfit is raised.
        success: Whether the search converged.
        terms: Terms that a selection added, in words.
    """

    system: System
    theta: Array
    formal: Array
    covering: Array
    rms: Array
    equations: Array | None
    misfit: bool
    success: bool
    terms: tuple[str, ...] = ()


@one_blas_thread()
def fitted(arm: Arm, system: System, recordings: list[Recording], job: Job) -> Fitted:
    """Identify a robot without the parts of the report that search for more."""
    torques = [f"torque_{joint}" for joint in arm.joints]
    if job.fit is Fit.SELECTED:
        found = mjfim.select_terms(system.experiment, recordings, threads=system.threads)
        assert found.selection is not None
        selected = mjfim.selected_experiment(system.experiment, found.selection)
        return _of_estimate(System.resolve(selected, threads=system.threads), found, torques)

    task = FitTask.of(system, recordings)
    result = fit_task(FitSearch(task=task, budget=Budget(), callback=None))
    quality, accuracy = result.quality, result.accuracy
    assert accuracy.robust is not None and result.inverse_dynamics is not None
    reasons = misfit_reasons(quality.chi2, quality.dof, True, quality.whiteness, missing=())
    return Fitted(
        system=system,
        theta=result.theta,
        formal=accuracy.covariance,
        covering=accuracy.robust.covariance,
        rms=np.array([quality.rms[name] for name in torques]),
        equations=result.inverse_dynamics.theta,
        misfit=bool(reasons),
        success=result.solution.success,
    )


def _of_estimate(system: System, estimate: Estimate, torques: Sequence[str]) -> Fitted:
    """What a whole report says.

    Args:
        system: The system that was fitted.
        estimate: The estimate.
        torques: Names of the measured torques.
    """
    added = () if estimate.selection is None else estimate.selection.terms
    by_equation = estimate.inverse_dynamics
    return Fitted(
        system=system,
        theta=estimate.theta,
        formal=estimate.covariance,
        covering=estimate.honest_covariance,
        rms=np.array([estimate.residual_rms[name] for name in torques]),
        equations=None if by_equation is None else by_equation.theta,
        misfit=estimate.misfit,
        success=estimate.converged,
        terms=tuple(term.description for term in added),
    )


def run(job: Job) -> Outcome:
    """Log and identify one robot."""
    arm = arm_of(job.arm)
    rng = np.random.default_rng([job.seed, job.number, job.lacks])
    with tempfile.TemporaryDirectory() as folder:
        plain = stated(arm, Path(folder), is_richer=False)
        system = System.resolve(plain, threads=1)
        true_system, theta = robot(arm, system, job.lacks, rng)
        seconds = job.seconds / RECORDINGS
        logs = [
            log_of(arm, true_system, theta, seconds, f"log {k}", rng) for k in range(RECORDINGS)
        ]
        other = log_of(arm, true_system, theta, HELD_OUT, "held out", rng)
        recordings = [log.recording for log in logs]

        begun = system
        if job.fit is Fit.RICHER:
            richer = stated(arm, Path(folder), is_richer=True)
            begun = System.resolve(richer, threads=1)
        clock, cpu = time.perf_counter(), time.process_time()
        steps = begun.plant.engine_steps
        found = fitted(arm, begun, recordings, job)
        seconds, used = time.perf_counter() - clock, time.process_time() - cpu
        samples = sum(len(recording.t) for recording in recordings)
        passes = (begun.plant.engine_steps - steps) / samples

        # Base parameters do not depend on what the recordings cannot show. Those of a model with
        # more terms are the same.
        names, of_found = system.parameters.names, found.system.parameters.names
        inertial = np.concatenate(
            [body.columns for body in LinearCoordinates.of(system.parameters, theta).bodies]
        )
        places = [of_found.index(names[j]) for j in inertial.tolist()]
        estimate = np.array(theta)
        estimate[inertial] = found.theta[places]
        coordinates = LinearCoordinates.of(system.parameters, theta)
        base = base_parameters(arm, system)
        derivative = np.linalg.inv(coordinates.derivative(coordinates.linear(estimate)))
        by_theta = (base @ derivative)[:, inertial]
        error = base @ (coordinates.linear(estimate) - coordinates.linear(theta))
        covering, formal = (
            matrix[np.ix_(places, places)] for matrix in (found.covering, found.formal)
        )

        # Torques along the motion of the held-out log.
        motion = motion_of(other, len(arm.joints))
        predicted = torques_along(found.system, found.theta, motion)
        true = torques_along(true_system, theta, motion)
        gradient = torque_gradient(found.system, found.theta, motion)
        variance = np.einsum("knp,pq,knq->kn", gradient, found.covering, gradient)

        # The measured torques scatter by the residuals as well.
        residual = held_out_residual(found.system, other, found.theta)
        count = len(arm.joints)
        of_truth = np.where(np.isnan(residual[:, count:]), np.nan, other.noise)
        scatter = np.sqrt(variance.mean(axis=0) + found.rms**2)
        is_measured = ~np.isnan(residual[:, count:])
        within = np.abs(residual[:, count:]) <= NORMAL_95 * scatter
        ratio_equations = np.nan
        if found.equations is not None and len(found.equations) == len(found.theta):
            of_equations = held_out_residual(found.system, other, found.equations)
            ratio_equations = _ratio(of_equations[:, count:], of_truth)
        return Outcome(
            arm=job.arm,
            lacks=job.lacks,
            fit=job.fit.value,
            base=_inside(error, by_theta @ covering @ by_theta.T),
            base_formal=_inside(error, by_theta @ formal @ by_theta.T),
            torque=float((np.abs(predicted - true) <= NORMAL_95 * np.sqrt(variance)).mean()),
            measured=float(within[is_measured].mean()),
            ratio=_ratio(residual[:, count:], of_truth),
            ratio_equations=ratio_equations,
            misfit=found.misfit,
            success=found.success,
            passes=passes,
            seconds=seconds,
            cpu=used,
            base_count=len(base),
            terms=found.terms,
        )


def torque_gradient(system: System, theta: Array, motion: Array) -> Array:
    """(K, n, p) derivatives of `torques_along` by the parameters."""
    at_theta = torques_along(system, theta, motion)
    found = np.zeros((*at_theta.shape, len(theta)))
    for j, size in enumerate(system.parameters.magnitude.tolist()):
        moved = np.array(theta)
        moved[j] += 1e-5 * size
        found[..., j] = (torques_along(system, moved, motion) - at_theta) / (1e-5 * size)
    return found


def held_out_residual(system: System, log: Log, theta: Array) -> Array:
    """(M, ny) predicted minus measured outputs of a log, from its own initial states."""
    problem = FitProblem.of(system, [log.recording])
    task = FitTask.of(system, [log.recording])
    search = FitSearch(task=task, budget=Budget(), callback=None)
    at = search.with_initial_states(problem, problem.begin(theta))
    predicted = problem.predict(at)
    assert predicted is not None
    return np.where(problem.masks[0], predicted[0] - problem.recordings[0].y, np.nan)


def _inside(error: Array, covariance: Array) -> float:
    """Share of errors: (b,) inside the 95 % intervals of a covariance: (b, b)."""
    return float((np.abs(error) <= NORMAL_95 * np.sqrt(np.diag(covariance))).mean())


def _ratio(residual: Array, of_truth: Array) -> float:
    """Root mean square, over the joints, of the ratios of residual torques: (M, n) both."""
    squares = np.nanmean(residual**2, axis=0) / np.nanmean(of_truth**2, axis=0)
    return float(np.sqrt(squares.mean()))


# ---- the study


def summary(outcomes: list[Outcome]) -> str:
    """Markdown table with a row for each arm and half of the runs."""
    head = (
        "arm",
        "friction",
        "fitted",
        "runs",
        "base parameters inside",
        "with formal intervals",
        "torques inside",
        "measured torques inside",
        "residual torque over the true model's",
        "of the equation of motion alone",
        "misfit",
        "converged",
        "passes",
        "seconds of a processor",
    )
    lines = [f"| {' | '.join(head)} |", "|" + "---|" * len(head)]
    for name in dict.fromkeys(outcome.arm for outcome in outcomes):
        for lacks, fit in product((False, True), Fit):
            key = (name, lacks, fit.value)
            rows = [each for each in outcomes if (each.arm, each.lacks, each.fit) == key]
            if not rows:
                continue
            cells = (
                f"{name} ({rows[0].base_count} base parameters)",
                "partly not in the stated model" if lacks else "in the model",
                fit.value,
                str(len(rows)),
                *(_percent(rows, key) for key in ("base", "base_formal", "torque", "measured")),
                *(f"{_median(rows, key):.3f}" for key in ("ratio", "ratio_equations")),
                *(_percent(rows, key) for key in ("misfit", "success")),
                f"{_median(rows, 'passes'):.0f}",
                f"{_median(rows, 'cpu'):.0f}",
            )
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _percent(rows: list[Outcome], key: str) -> str:
    """Mean of a share over runs."""
    return f"{100 * np.mean([getattr(each, key) for each in rows]):.0f} %"


def _median(rows: list[Outcome], key: str) -> float:
    """Median of a number over runs."""
    return float(np.median([getattr(each, key) for each in rows]))


def main() -> int:
    """Run the study and print its tables; return 1 where a wanted number is missed."""
    parser = options_of(__doc__)
    parser.add_argument("--runs", type=int, default=50, help="runs in all")
    parser.add_argument("--seconds", type=float, default=18.0, help="data of a run [s]")
    parser.add_argument("--selected", type=int, default=4, help="runs by a selection of terms")
    parser.add_argument("--laws", type=int, default=12, help="further runs under discrete laws")
    parser.add_argument("--processes", type=int, default=cores(), help="runs side by side")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--output", type=Path, help="JSON file with all outcomes")
    args = parser.parse_args()

    console = Console(width=200)
    arms = ["UR5e"] if panda() is None else ["Panda", "UR5e"]
    if len(arms) == 1:
        console.print("The model of the Panda is absent (../shared/models): it is left out.")

    # Halves of the runs of each arm lack friction in the model.
    first = Job(
        arm=arms[0],
        seed=args.seed,
        number=0,
        lacks=False,
        fit=Fit.STATED,
        seconds=args.seconds,
    )
    jobs = [
        replace(
            first,
            arm=arms[number % len(arms)],
            number=number,
            lacks=bool(number // len(arms) % 2),
        )
        for number in range(args.runs)
    ]
    jobs += [
        replace(first, arm=LAWS, number=number, lacks=bool(number % 2))
        for number in range(args.laws)
    ]
    lacking = [job for job in jobs if job.lacks]
    jobs += [replace(job, fit=Fit.RICHER) for job in lacking]
    jobs += [replace(job, fit=Fit.SELECTED) for job in lacking[: args.selected]]
    outcomes: list[Outcome] = []
    for outcome in in_processes(run, jobs, args.processes):
        outcomes.append(outcome)
        if args.output is not None:
            write_json(args.output, {"runs": [asdict(each) for each in outcomes]})
    if outcomes:
        console.print(summary(outcomes), soft_wrap=True)

    return 0 if _is_good(outcomes) else 1


def _is_good(outcomes: list[Outcome]) -> bool:
    """Whether all wanted numbers are reached.

    Torques of a model that lacks friction are not those of the robot, which `misfit` says. So they
    count where the fitted model has the friction of the robot.
    """
    groups = [
        [each for each in outcomes if (each.lacks, each.fit) == (lacks, fit.value)]
        for lacks, fit in product((False, True), Fit)
    ]
    covered = all(
        np.mean([each.base for each in group]) >= WANTED_COVERAGE for group in groups if group
    )
    whole = [each for each in outcomes if not each.lacks or each.fit != Fit.STATED.value]
    near = all(each.ratio <= WANTED_RATIO for each in whole)
    inside = not whole or np.mean([each.torque for each in whole]) >= WANTED_COVERAGE
    return bool(covered and near and inside)
