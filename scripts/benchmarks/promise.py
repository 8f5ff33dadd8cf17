"""Does the promised accuracy come true, and do two logs of one robot give one answer?

    python -m scripts.benchmarks promise [--data ../shared/data] [--only NAME] [--logs 3]
    python -m scripts.benchmarks promise --experiment FILE.toml LOG.csv ... [--seconds 12]

Each set of the logs of a robot is fitted, and so are the two halves of each log. For each set of
two logs or more, `check` promises σ by the stated noise at the guess, and from the estimate of all
logs but one, each in turn, which is `earlier`. The fit of the set then has the honest σ.

The simulated robots are plain MuJoCo loops whose dry friction grows with the load and falls with
the speed. The fitted models have constant dry friction. Their encoders have steps, and each log has
other gains of the position law.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import chain, combinations
from pathlib import Path

import mujoco
import numpy as np
from rich.console import Console

import mjfim
from mjfim.arrays import record
from mjfim.experiment.system import System
from mjfim.identification.identify import identify_system
from mjfim.recordings.read import read_recording
from mjfim.records.estimate import Estimate
from scripts.benchmarks.child import ROOT, SHARED, new_table, options_of, overlap
from scripts.benchmarks.measured_data import SERVO_TIMES, SETS, servo_files

# Logs of the measured robots, by the name of their experiment.
LOGS = {
    "dfki_simple_pendulum": ("dircol_measured.csv", "energy_shaping_measured.csv"),
    "dfki_double_pendulum": ("A0_00.csv.gz", "A0_01.csv.gz", "A0_02.csv.gz"),
    "bam_xl330": servo_files(*SERVO_TIMES),
}

# Ratios of the honest σ to the promise that count as kept.
KEPT = (0.5, 2.0)

# Distance of a new guess from a bound, as a share of the stated guess or scale.
GAP = 1e-3


@record
class SimulatedRobot:
    """A robot whose friction its model lacks in part.

    Attributes:
        name: Name of its experiment in `models/`.
        tables: Changes of the experiment, whose motors follow references here.
        static: Static friction above the Coulomb friction, by joint [N m or N].
        load: Friction per force of the motor, by joint.
        amplitude: Amplitude of the references [rad or m].
    """

    name: str
    tables: dict[str, object]
    static: dict[str, float]
    load: dict[str, float]
    amplitude: float


FIT = {"segments": 1.0, "start": "measured"}
SIMULATED = (
    SimulatedRobot(
        name="two_joint_arm",
        tables={
            "rate": 125.0,
            "parameters": {
                "dry1": {"target": "joint/shoulder:frictionloss", "guess": 0.2, "true": 0.3},
                "dry2": {"target": "joint/elbow:frictionloss", "guess": 0.2, "true": 0.15},
            },
            "noise": {"qpos:shoulder": 4e-4, "qpos:elbow": 4e-4},
            "fit": FIT,
        },
        static={"shoulder": 0.2, "elbow": 0.1},
        load={"shoulder": 0.08, "elbow": 0.08},
        amplitude=0.5,
    ),
    SimulatedRobot(
        name="cart_pendulum",
        tables={
            "parameters": {
                "dry": {"target": "joint/slide:frictionloss", "guess": 0.3, "true": 0.4}
            },
            "noise": {"state": 0.002},
            "fit": FIT,
        },
        static={"slide": 0.4},
        load={"slide": 0.1},
        amplitude=0.15,
    ),
)

# Gains of the laws in each log: stiffness over the inertia [1/s²] and damping ratio.
GAINS = ((100.0, 0.7), (400.0, 0.7), (100.0, 1.4), (400.0, 0.35), (200.0, 1.0), (50.0, 0.7))

# Speed at which static friction has fallen to 1/e of its excess, and duration of a log.
STRIBECK_SPEED, SECONDS = 0.3, 6.0


def simulated_log(robot: SimulatedRobot, system: System, number: int) -> mjfim.Recording:
    """Simulate a log in a plain MuJoCo loop.

    Args:
        robot: The robot.
        system: The system of its stated model.
        number: Number of the log, which decides gains and references.
    """
    rng = np.random.default_rng(number)
    model = system.model_at(system.parameters.true)
    data = mujoco.MjData(model)
    data.qpos[:] = system.plant.nominal_initial_state[: model.nq]
    joints = model.actuator_trnid[:, 0]
    dofs, places = model.jnt_dofadr[joints], model.jnt_qposadr[joints]
    names = [model.joint(j).name for j in joints]
    static, load = (np.array([each[k] for k in names]) for each in (robot.static, robot.load))
    coulomb = np.array(model.dof_frictionloss[dofs])
    is_limited = model.actuator_ctrllimited.astype(bool)
    low, high = np.where(is_limited, model.actuator_ctrlrange.T, [[-np.inf], [np.inf]])

    # References are multisines about the start. The stiffness is that over the inertia there.
    mujoco.mj_forward(model, data)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    inertia = np.diag(M)[dofs]
    stiffness, ratio = GAINS[number % len(GAINS)]
    kp, kd = stiffness * inertia, 2.0 * ratio * np.sqrt(stiffness) * inertia
    frequencies = rng.uniform(0.2, 1.5, (3, len(dofs)))
    phases = rng.uniform(0.0, 2.0 * np.pi, (3, len(dofs)))
    center = np.array(data.qpos[places])

    t = np.arange(round(SECONDS / system.dt) + 1, dtype=np.float64) * system.dt
    ctrl, rows = [], [np.concatenate([data.qpos, data.qvel])]
    for k in range(len(t) - 1):
        waves = np.sin(2.0 * np.pi * frequencies * k * system.dt + phases) - np.sin(phases)
        reference = center + robot.amplitude / 3.0 * waves.sum(axis=0)
        force = kp * (reference - data.qpos[places]) - kd * data.qvel[dofs]
        data.ctrl[:] = np.clip(force, low, high)
        ctrl.append(np.array(data.ctrl))
        for _ in range(round(system.dt / model.opt.timestep)):
            speed = data.qvel[dofs] / STRIBECK_SPEED
            excess = static * np.exp(-(speed**2)) + load * np.abs(data.ctrl)
            model.dof_frictionloss[dofs] = coulomb + excess
            mujoco.mj_step(model, data)
        rows.append(np.concatenate([data.qpos, data.qvel]))

    # Encoders and tachometers round to steps, whose error has the stated size.
    y = np.array(rows)[:, [output.state or 0 for output in system.outputs.outputs]]
    step = np.sqrt(12.0) * system.noise.sigma
    return mjfim.Recording(
        t=t,
        ctrl=np.array(ctrl),
        y=step * np.round(y / step),
        outputs=system.outputs.names,
        name=f"log {number}, gains {stiffness:g} and {ratio:g}",
    )


def part_of(recording: mjfim.Recording, rows: slice) -> mjfim.Recording:
    """Some rows of a recording."""
    t = recording.t[rows]
    ctrl = recording.ctrl[rows][: len(t)]
    return replace(recording, t=t - t[0], ctrl=ctrl, y=recording.y[rows])


def agreement(first: Estimate, second: Estimate) -> np.ndarray:
    """Whether intervals overlap, for each parameter that both estimates determine."""
    asked = np.isin(first.parameters, first.nuisance, invert=True)
    asked &= np.isfinite(first.honest_std) & np.isfinite(second.honest_std)
    return overlap(first.interval, second.interval)[asked]


def share(flags: Sequence[bool]) -> str:
    """Share of true values in percent, and their number."""
    return f"{100.0 * float(np.mean(flags)):.0f} % of {len(flags)}" if flags else "-"


def experiment_after(
    before: Estimate, experiment: mjfim.Experiment, system: System
) -> mjfim.Experiment:
    """The experiment at an estimate: its values are guesses, moved off the bounds."""
    tables = {}
    for value, each in zip(before.theta, system.parameters.parameters, strict=True):
        if each.name in experiment.parameters:
            low, high = each.bounds
            gap = min(GAP * max(abs(each.guess), each.scale), 0.25 * (high - low))
            guess = float(np.clip(value, low + gap, high - gap))
            tables[each.name] = {"guess": guess, "scale": each.scale}
    return experiment.replace(parameters=tables)


def row_of(robot: str, experiment: mjfim.Experiment, logs: Sequence[mjfim.Recording]) -> list[str]:
    """Row of the table for one robot."""
    clock = time.process_time()
    system = System.resolve(experiment)
    split = []
    for log in logs:
        middle = len(log.t) // 2
        parts = [part_of(log, rows) for rows in (slice(middle), slice(middle, None))]
        split.append(agreement(*(identify_system(system, [part]) for part in parts)))

    # Fits of every set of logs, and promises before each set and before each further log of a set.
    every = range(len(logs))
    sets = [each for count in every for each in combinations(every, count + 1)]
    found = {each: identify_system(system, [logs[i] for i in each]) for each in sets}
    moved = {text for fit in found.values() for text in fit.warnings if "disagree" in text}
    ratios: tuple[list[float], list[float]] = ([], [])
    for several in sets[len(logs) :]:
        together = [logs[i] for i in several]
        checks = [(0, mjfim.check(experiment, together, progress=False))]
        for last in several:
            before = found[tuple(i for i in several if i != last)]
            later = experiment_after(before, experiment, system)
            with tempfile.TemporaryDirectory() as folder:
                before.save(folder)
                later = later.replace(earlier=(f"{folder}/estimate.json",))
                checks.append((1, mjfim.check(later, [logs[last]], progress=False)))
        # A bound may cut intervals off, but not this covariance.
        honest = np.sqrt(np.diag(found[several].honest_covariance))
        honest[~np.isfinite(found[several].honest_std)] = np.nan
        for kind, check in checks:
            quotients = honest / [np.nan if row.nuisance else row.std for row in check.rows]
            ratios[kind].extend(quotients[np.isfinite(quotients)].tolist())
    pairs = [agreement(found[i,], found[j,]) for i, j in combinations(every, 2)]
    for sentence in sorted(moved):
        print(f"{robot}: {sentence}", flush=True)

    cells = []
    for each in ratios:
        kept = [KEPT[0] <= ratio <= KEPT[1] for ratio in each]
        span = f"{np.median(each):.2g} ({min(each):.2g} to {max(each):.2g})"
        cells += [share(kept), span]
    seconds = f"{(time.process_time() - clock) / 60.0:.1f}"
    overlaps = (share([*chain.from_iterable(each)]) for each in (split, pairs))
    return [robot, *cells, seconds, *overlaps]


def main() -> int:
    """Study every robot and print the table."""
    parser = options_of(__doc__)
    parser.add_argument("--data", type=Path, default=SHARED / "data")
    parser.add_argument("--only", help="name of one experiment")
    parser.add_argument("--logs", type=int, default=3, help="largest number of logs of a robot")
    parser.add_argument("--experiment", type=Path, help="file of one robot, whose logs follow")
    parser.add_argument("files", type=Path, nargs="*", help="its logs")
    parser.add_argument("--seconds", type=float, default=np.inf, help="beginning of its logs")
    args = parser.parse_args()

    headings = "robot | kept, before | median (span), before | kept, with earlier logs"
    headings += " | median (span), with | processor minutes | halves of a log | different motions"
    title = (
        f"Honest σ over the promise, kept from {KEPT[0]:g} to {KEPT[1]:g}; intervals that overlap"
    )
    table = new_table(title, *headings.split(" | "))
    jobs: list[tuple[str, mjfim.Experiment, list[mjfim.Recording]]] = []
    if args.experiment is not None:
        stated = mjfim.Experiment.from_file(args.experiment)
        channels = System.resolve(stated).channels
        read = [read_recording(path, channels) for path in args.files]
        ends = (int(np.searchsorted(each.t - each.t[0], args.seconds)) for each in read)
        logs = [part_of(log, slice(end)) for log, end in zip(read, ends, strict=True)]
        jobs.append((args.experiment.stem, stated, logs))
        args.only = ""  # no other robot
    for measured in {each.name: each for each in SETS}.values():
        if args.only in (None, measured.name) and (args.data / measured.folder).is_dir():
            logs = measured.read(args.data, LOGS[measured.name][: args.logs])
            jobs.append((measured.name, measured.experiment(), logs))
    for robot in SIMULATED:
        if args.only in (None, robot.name):
            stated = mjfim.Experiment.from_file(ROOT / "models" / f"{robot.name}.toml")
            stated = stated.replace(**robot.tables)
            system = System.resolve(stated)
            logs = [simulated_log(robot, system, i) for i in range(args.logs)]
            jobs.append((f"{robot.name}, simulated", stated, logs))

    for job in jobs:
        row = row_of(*job)
        print(" | ".join(row), flush=True)
        table.add_row(*row)
    Console(width=180).print(table)
    return 0
