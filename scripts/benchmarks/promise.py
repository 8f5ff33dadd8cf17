"""Does the promised accuracy come true, and do two logs of one robot give one answer?

    python -m scripts.benchmarks promise [--data ../shared/data] [--only NAME] [--logs 4]
    python -m scripts.benchmarks promise --experiment FILE.toml LOG.csv ... [--seconds 12]

Each log of a robot is fitted alone, and so are its two halves. From the second log on, `check`
promises σ after all logs so far: by the stated noise at the guess, and with the estimate of the
logs before as `earlier`. A fit of all logs so far then has the honest σ.

The simulated robots are plain MuJoCo loops whose dry friction grows with the load and falls with
the speed. The fitted models have constant dry friction. Their encoders have steps, and each log has
other gains of the position law.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
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
from scripts.benchmarks.child import ROOT, new_table, options_of
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
    mujoco.mj_resetData(model, data)
    state = system.plant.nominal_initial_state
    data.qpos[:] = state[: model.nq]
    dofs = model.jnt_dofadr[model.actuator_trnid[:, 0]]
    places = model.jnt_qposadr[model.actuator_trnid[:, 0]]
    names = [model.joint(j).name for j in model.actuator_trnid[:, 0]]
    static = np.array([robot.static[name] for name in names])
    load = np.array([robot.load[name] for name in names])
    coulomb = np.array(model.dof_frictionloss[dofs])

    # References are multisines about the start. The stiffness is that over the inertia there.
    mujoco.mj_forward(model, data)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    stiffness, ratio = GAINS[number % len(GAINS)]
    kp = stiffness * np.diag(M)[dofs]
    kd = 2.0 * ratio * np.sqrt(stiffness) * np.diag(M)[dofs]
    frequencies = rng.uniform(0.2, 1.5, (3, len(dofs)))
    phases = rng.uniform(0.0, 2.0 * np.pi, (3, len(dofs)))
    center = np.array(data.qpos[places])

    sigma = system.noise.sigma
    steps = round(system.dt / model.opt.timestep)
    count = round(SECONDS / system.dt)
    ctrl, rows = np.zeros((count, model.nu)), np.zeros((count + 1, model.nq + model.nv))
    for k in range(count + 1):
        rows[k] = np.concatenate([data.qpos, data.qvel])
        if k == count:
            break
        waves = np.sin(2.0 * np.pi * frequencies * k * system.dt + phases) - np.sin(phases)
        reference = center + robot.amplitude / 3.0 * waves.sum(axis=0)
        force = kp * (reference - data.qpos[places]) - kd * data.qvel[dofs]
        low, high = model.actuator_ctrlrange.T
        limited = model.actuator_ctrllimited.astype(bool)
        ctrl[k] = np.where(limited, np.clip(force, low, high), force)
        data.ctrl[:] = ctrl[k]
        for _ in range(steps):
            speed = data.qvel[dofs] / STRIBECK_SPEED
            excess = static * np.exp(-(speed**2)) + load * np.abs(ctrl[k])
            model.dof_frictionloss[dofs] = coulomb + excess
            mujoco.mj_step(model, data)

    # Encoders and tachometers round to steps, whose error has the stated size.
    y = rows[:, [output.state or 0 for output in system.outputs.outputs]]
    step = np.sqrt(12.0) * sigma
    return mjfim.Recording(
        t=np.arange(count + 1, dtype=np.float64) * system.dt,
        ctrl=ctrl,
        y=step * np.round(y / step),
        outputs=system.outputs.names,
        name=f"log {number}, gains {stiffness:g} and {ratio:g}",
    )


def part_of(recording: mjfim.Recording, rows: slice, name: str) -> mjfim.Recording:
    """Some rows of a recording."""
    t = recording.t[rows]
    return replace(
        recording, t=t - t[0], ctrl=recording.ctrl[rows][: len(t)], y=recording.y[rows], name=name
    )


def halves(recording: mjfim.Recording) -> Iterator[mjfim.Recording]:
    """The two halves of a recording."""
    middle = len(recording.t) // 2
    yield part_of(recording, slice(None, middle), f"{recording.name}, first half")
    yield part_of(recording, slice(middle, None), f"{recording.name}, second half")


def restated(experiment: mjfim.Experiment, found: Estimate, folder: Path) -> mjfim.Experiment:
    """The experiment at an estimate, which counts as `earlier`."""
    found.save(folder)
    system = System.resolve(experiment)
    tables = {}
    for name, value, own in zip(
        found.parameters, found.theta, system.parameters.parameters, strict=True
    ):
        if name in experiment.parameters:
            low, high = own.bounds
            gap = min(GAP * max(abs(own.guess), own.scale), 0.25 * (high - low))
            guess = float(np.clip(value, low + gap, high - gap))
            tables[name] = {"guess": guess, "scale": own.scale}
    earlier = (str(folder / "estimate.json"),)
    return experiment.replace(parameters=tables, earlier=earlier)


def overlap(first: Estimate, second: Estimate) -> np.ndarray:
    """Whether intervals overlap, for each parameter that both estimates determine."""
    asked = np.isin(first.parameters, first.nuisance, invert=True)
    asked &= np.isfinite(first.honest_std) & np.isfinite(second.honest_std)
    low = np.maximum(first.interval[:, 0], second.interval[:, 0])
    return np.asarray(low <= np.minimum(first.interval[:, 1], second.interval[:, 1]))[asked]


def promised(experiment: mjfim.Experiment, recordings: Sequence[mjfim.Recording]) -> np.ndarray:
    """(p,) standard deviations that `check` promises for recordings [theta-unit]."""
    checked = mjfim.check(experiment, recordings, progress=False)
    return np.array([row.std if not row.nuisance else np.nan for row in checked.rows])


def share(flags: Sequence[bool]) -> str:
    """Share of true values in percent, and their number."""
    return f"{100.0 * float(np.mean(flags)):.0f} % of {len(flags)}" if flags else "-"


def rows_of(
    name: str, experiment: mjfim.Experiment, logs: Sequence[mjfim.Recording]
) -> tuple[list[str], list[str]]:
    """Rows of both tables for one robot."""
    clock = time.process_time()
    system = System.resolve(experiment)
    alone = [identify_system(system, [log]) for log in logs]
    split = [[identify_system(system, [half]) for half in halves(log)] for log in logs]
    pairs = [overlap(a, b) for i, a in enumerate(alone) for b in alone[i + 1 :]]
    moved: set[str] = set()

    ratios: dict[bool, list[float]] = {False: [], True: []}
    found = alone[0]
    for count in range(2, len(logs) + 1):
        with tempfile.TemporaryDirectory() as folder:
            later = restated(experiment, found, Path(folder))
            promises = promised(experiment, logs[:count]), promised(later, logs[count - 1 : count])
        found = identify_system(system, logs[:count])
        moved |= {sentence for sentence in found.warnings if "disagree" in sentence}
        for has_earlier, promise in zip(ratios, promises, strict=True):
            quotients = found.honest_std / promise
            ratios[has_earlier] += quotients[np.isfinite(quotients)].tolist()
    for sentence in sorted(moved):
        print(f"{name}: {sentence}", flush=True)

    cells = []
    for each in ratios.values():
        kept = [KEPT[0] <= ratio <= KEPT[1] for ratio in each]
        span = f"{np.median(each):.2g} ({min(each):.2g} to {max(each):.2g})"
        cells += [share(kept), span]
    seconds = f"{(time.process_time() - clock) / 60.0:.1f}"
    agreed = [flag for each in pairs for flag in each.tolist()]
    of_halves = [flag for a, b in split for flag in overlap(a, b).tolist()]
    return [name, *cells, seconds], [name, share(of_halves), share(agreed)]


def main() -> int:
    """Study every robot and print both tables."""
    parser = options_of(__doc__)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    parser.add_argument("--only", help="name of one experiment")
    parser.add_argument("--logs", type=int, default=4, help="largest number of logs of a robot")
    parser.add_argument("--experiment", type=Path, help="file of one robot, whose logs follow")
    parser.add_argument("files", type=Path, nargs="*", help="its logs")
    parser.add_argument("--seconds", type=float, default=np.inf, help="beginning of its logs")
    args = parser.parse_args()

    kept = new_table(
        f"Honest σ over the promise; kept: {KEPT[0]:g} to {KEPT[1]:g}",
        *("robot", "kept, before", "median (span), before"),
        *("kept, with earlier logs", "median (span), with", "processor minutes"),
    )
    agree = new_table("Intervals that overlap", "robot", "halves of a log", "different motions")
    jobs = []
    if args.experiment is not None:
        stated = mjfim.Experiment.from_file(args.experiment)
        channels = System.resolve(stated).channels
        read = [read_recording(path, channels) for path in args.files]
        rows = [slice(int(np.searchsorted(each.t - each.t[0], args.seconds))) for each in read]
        logs = [part_of(log, cut, log.name) for log, cut in zip(read, rows, strict=True)]
        jobs.append((args.experiment.stem, stated, logs))
        args.only = args.experiment.stem
    for measured in {each.name: each for each in SETS}.values():
        stated = mjfim.Experiment.from_file(ROOT / "models" / f"{measured.name}.toml").replace(
            parameters={name: {"guess": value} for name, value in measured.published.items()}
        )
        if args.only in (None, measured.name) and (args.data / measured.folder).is_dir():
            channels = System.resolve(stated).channels
            names = LOGS[measured.name][: args.logs]
            paths = [args.data / measured.folder / name for name in names]
            jobs.append((measured.name, stated, [read_recording(p, channels) for p in paths]))
    for robot in SIMULATED:
        if args.only in (None, robot.name):
            stated = mjfim.Experiment.from_file(ROOT / "models" / f"{robot.name}.toml")
            stated = stated.replace(**robot.tables)
            system = System.resolve(stated)
            logs = [simulated_log(robot, system, i) for i in range(args.logs)]
            jobs.append((f"{robot.name}, simulated", stated, logs))

    for job in jobs:
        first, second = rows_of(*job)
        print(" | ".join(first), "||", " | ".join(second), flush=True)
        kept.add_row(*first)
        agree.add_row(*second)
    Console(width=180).print(kept, agree)
    return 0
