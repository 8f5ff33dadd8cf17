"""A real Go2 that hangs: each half of a log is fitted and predicts the other half, leg by leg.

    python -m scripts.benchmarks go2 DATA/iit_go2 MODEL/go2_nomesh.xml out/go2

The log holds position references and angles of 12 joints, and no torques. The base is held, so that
the legs move independently, and each leg has an experiment of its own. The script writes models,
experiment files and logs into the folder of the output. It prints parameters with their intervals,
joints whose left and right sides differ, and errors of predictions, open loop from the references.
"""

from __future__ import annotations

import time
from pathlib import Path

import matplotlib.pyplot as plt
import mujoco
import numpy as np
from rich.console import Console

import mjfim
from mjfim.arrays import Array
from mjfim.experiment.system import System
from mjfim.recordings.read import read_recording
from scripts.benchmarks.child import new_table, options_of, overlap, rms, with_paths, write_log

LEGS = ("FL", "FR", "RL", "RR")
KINDS = ("hip", "thigh", "calf")

# Mean period of the rows [s].
PERIOD = 0.005001064

# Rows of the halves of the log. The references are triangles whose frequency grows to 1 Hz,
# so that each half has slow and fast rows.
HALVES = {
    "0 to 6, 12 to 18 s": (slice(0, 1175), slice(2349, 3524)),
    "6 to 12, 18 to 23 s": (slice(1175, 2349), slice(3524, 4698)),
}

# Gains of the law that the authors' repository states [N m/rad, N m s/rad].
STATED_KP, STATED_KD = 20.0, 1.5

# Angles of the knee [rad] at which a part of its dry friction vanishes. It grows with the sine of
# the distance from them, as the moment arm of a tendon does. The other end of the tendon is FAR
# away [m].
KNOTS = (-1.4, -2.0)
FAR = 1000.0

# One row of the log is one step of the engine and of the law. Dry friction makes the cost rough, so
# that later iterations gain nothing.
LEG = f"""model = "LEG.xml"
rate = {1.0 / PERIOD!r}
recording.time = "time"
fit = {{ segments = 2.0, start = "measured", max_iterations = 25 }}
"""
# Readings and references have different zeros.
OUTPUT = """noise."qpos:JOINT" = 0.002
nuisance.bias."qpos:JOINT" = 0.05
"""
# Damping of the joint acts as kd does, so that kd stands for both.
JOINT = f"""
[controllers.JOINT]
kp = {STATED_KP}
kd = {STATED_KD}
latency = 0.01
feedback_latency = 0.008
[parameters."kp JOINT"]
target = "controller/JOINT:kp"
bounds = [2.0, 100.0]
[parameters."kd JOINT"]
target = "controller/JOINT:kd"
bounds = [0.0, 10.0]
[parameters."latency JOINT"]
target = "controller/JOINT:latency"
bounds = [0.0, 0.06]
[parameters."armature JOINT"]
target = "joint/JOINT:armature"
bounds = [1e-5, 0.3]
[parameters."friction JOINT"]
target = "joint/JOINT:frictionloss"
bounds = [0.0, 5.0]
"""
# The drives of a leg measure equally late.
FEEDBACK = """[parameters.feedback]
targets = [
  { path = "controller/LEG_hip:feedback_latency" },
  { path = "controller/LEG_thigh:feedback_latency" },
  { path = "controller/LEG_calf:feedback_latency" },
]
bounds = [0.0, 0.03]
"""
KNOT = """[parameters."friction_KNOT JOINT"]
target = "tendon/JOINT_KNOT:frictionloss"
guess = 0.2
bounds = [0.0, 5.0]
"""


def hanging(path: Path) -> mujoco.MjSpec:
    """Return the model with a fixed base and without what does not act on its legs."""
    spec = mujoco.MjSpec.from_file(str(path))
    spec.delete(spec.body("base").joints[0])
    for each in [*spec.keys, *spec.geoms, *spec.sensors]:
        spec.delete(each)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    return spec


def leg_alone(path: Path, leg: str) -> str:
    """Return the MJCF of one leg, in which dry friction does not creep."""
    spec = hanging(path)
    for each in LEGS:
        if each != leg:
            spec.delete(spec.body(f"{each}_hip"))
    for actuator in spec.actuators:
        if not actuator.name.startswith(leg):
            spec.delete(actuator)
    spec.option.timestep = PERIOD
    holding = {"solimp_friction": [0.9999, 0.9999, 0.001, 0.5, 2.0]}
    holding["solref_friction"] = [2.2 * PERIOD, 1.0]
    for joint in spec.joints:
        joint.damping[:] = 0.0
        for name, values in holding.items():
            setattr(joint, name, values)

    thigh, calf = spec.body(f"{leg}_thigh"), spec.body(f"{leg}_calf")
    for i, angle in enumerate(KNOTS):
        far = calf.pos + FAR * np.array([np.sin(angle), 0.0, np.cos(angle)])
        thigh.add_site(name=f"far_{i}", pos=far)
        calf.add_site(name=f"near_{i}", pos=[0.0, 0.0, 1.0])
        tendon = spec.add_tendon(name=f"{leg}_calf_{i}", **holding)
        tendon.wrap_site(f"near_{i}")
        tendon.wrap_site(f"far_{i}")
    spec.compile()
    return str(spec.to_xml()).replace("_joint", "")


def write_leg(path: Path, leg: str, output: Path) -> None:
    """Write the model and the experiment file of a leg into a folder."""
    (output / f"{leg}.xml").write_text(leg_alone(path, leg), encoding="utf-8")
    joints = [f"{leg}_{kind}" for kind in KINDS]
    tables = [text.replace("JOINT", each) for text in (OUTPUT, JOINT) for each in joints]
    knots = [KNOT.replace("KNOT", str(i)) for i in range(len(KNOTS))]
    text = "".join([LEG, *tables, FEEDBACK, *knots]).replace("LEG", leg)
    text = text.replace("JOINT", f"{leg}_calf")
    (output / f"{leg}.toml").write_text(text, encoding="utf-8")


def as_it_comes(path: Path, references: Array, angles: Array) -> Array:
    """Return the angles of the model with the stated gains, in a plain loop: (M, 12)."""
    model = hanging(path).compile()
    substeps = 4
    model.opt.timestep = PERIOD / substeps
    data, found = mujoco.MjData(model), np.empty_like(angles)
    data.qpos[:], data.qvel[:] = angles[0], (angles[1] - angles[0]) / PERIOD
    for row, reference in enumerate(references):
        found[row] = data.qpos
        for _ in range(substeps):
            data.ctrl[:] = STATED_KP * (reference - data.qpos) - STATED_KD * data.qvel
            mujoco.mj_step(model, data)
    return found


def open_loop(system: System, theta: Array, references: Array, angles: Array) -> Array:
    """Return the readings of a fitted leg over whole rows, from its first angles: (M, 3)."""
    bias = theta[[system.parameters.names.index(f"bias {name}") for name in system.outputs.names]]
    state = np.concatenate([angles[0] - bias, (angles[1] - angles[0]) / PERIOD])
    plant = system.plant.with_initial_state(state)
    return np.asarray(plant.simulate(theta, references[:-1]).state[:, :3] + bias)


def draw(path: Path, half: str, joints: list[str], curves: dict[str, Array]) -> None:
    """Draw angles of some joints in seconds that are not fitted, and errors of all seconds."""
    figure, axes = plt.subplots(len(joints), 2, figsize=(13, 8), sharex="col", layout="constrained")
    styles = {"reference": "C7", "as it comes": "C1", "identified": "C0", "measured": "k:"}
    shown = next(rows[-1] for other, rows in HALVES.items() if other != half)
    seconds = PERIOD * np.arange(len(curves["measured"]))
    for row, (joint, (left, right)) in enumerate(zip(joints, axes, strict=True)):
        for name, style in styles.items():
            left.plot(seconds[shown], curves[name][shown, row], style, label=name)
        for name in ("as it comes", "identified"):
            error = 1e3 * (curves[name] - curves["measured"])[:, row]
            right.plot(seconds, error, styles[name], lw=1.0)
        for rows in HALVES[half]:
            right.axvspan(*seconds[rows][[0, -1]], color="0.92")
        left.set_ylabel(f"{joint} [rad]")
        right.set_ylabel("error [mrad]")
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    axes[0, 0].set_title("seconds that are not fitted, open loop from the references")
    axes[0, 1].set_title("predicted minus measured; grey seconds are fitted")
    for axis in axes[-1]:
        axis.set_xlabel("time [s]")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def relative_widths(estimate: mjfim.Estimate, joint: str) -> list[float]:
    """Return half widths of 95 % [%] of kp, kd, friction, and their ratios to kp."""
    places = [estimate.parameters.index(f"{name} {joint}") for name in ("kp", "kd", "friction")]
    values = np.maximum(estimate.theta[places], 1e-9)
    covariance = estimate.honest_covariance[np.ix_(places, places)] / np.outer(values, values)
    weights = np.vstack([np.eye(3), [[-1.0, 1.0, 0.0], [-1.0, 0.0, 1.0]]])
    # The variance of what is not determined is infinite; other weights are zero.
    parts = [covariance[np.ix_(row != 0.0, row != 0.0)] for row in weights]
    rows = (row[row != 0.0] for row in weights)
    return [196.0 * float(np.sqrt(w @ C @ w)) for w, C in zip(rows, parts, strict=True)]


def quantities_of(estimate: mjfim.Estimate, joint: str) -> dict[str, tuple[float, Array]]:
    """Return values and 95 % intervals of a joint, and of the delay that its leg shares."""
    rows = zip(estimate.parameters, estimate.theta, estimate.interval, strict=True)
    return {
        name.split()[0]: (value, interval)
        for name, value, interval in rows
        if name.partition(" ")[2] in ("", joint)
    }


def apart(*found: dict[str, tuple[float, Array]]) -> str:
    """Return the quantities of two joints whose intervals do not overlap."""
    names = [name for name in found[0] if not overlap(*(each[name][1] for each in found))]
    return str([name for name in names if name != "feedback"] or "nothing")


def main() -> int:
    """Fit and predict all legs, and print what was found."""
    data, model, output = with_paths(options_of(__doc__)).paths
    log = np.genfromtxt(data / "traj_0.csv.gz", delimiter=",", names=True)
    every = [f"{leg}_{kind}" for leg in LEGS for kind in KINDS]
    angles, references = (
        np.column_stack([log[f"{what}_{joint}"] for joint in every]) for what in ("q", "ref")
    )
    stated = as_it_comes(model, references, angles)

    console = Console(width=200)
    found: dict[tuple[str, str], mjfim.Estimate] = {}
    predicted = {half: np.empty_like(angles) for half in HALVES}
    for number, leg in enumerate(LEGS):
        begun = time.process_time()
        joints, columns = every[3 * number :][:3], slice(3 * number, 3 * number + 3)
        write_leg(model, leg, output)
        experiment = mjfim.Experiment.from_file(output / f"{leg}.toml")
        system = System.resolve(experiment)

        header = ["time", *(f"{what}:{each}" for what in ("reference", "qpos") for each in joints)]
        logs: dict[str, list[mjfim.Recording]] = {half: [] for half in HALVES}
        for half, part in ((half, part) for half, parts in HALVES.items() for part in parts):
            path = output / f"{leg}_from_row_{part.start}.csv"
            asked, moved = references[part, columns], angles[part, columns]
            write_log(path, header, PERIOD * np.arange(len(moved)), asked, moved, form="%.7f")
            logs[half].append(read_recording(path, system.channels))
        for half, others in zip(HALVES, reversed(HALVES), strict=True):
            fitted = mjfim.identify(experiment, logs[half], held_out=logs[others])
            found[leg, half] = fitted
            console.print(f"{leg}, {half}: {'; '.join(fitted.reasons) or 'no misfit'}")
            predicted[half][:, columns] = open_loop(
                system, fitted.theta, references[:, columns], angles[:, columns]
            )
        console.print(f"{leg}: {(time.process_time() - begun) / 60.0:.1f} minutes of a processor")

    ratios = ("kp", "kd", "friction", "kd / kp", "friction / kp")
    by_kind = [f"{leg}_{kind}" for kind in KINDS for leg in LEGS]
    ranges = {
        half: {joint: quantities_of(found[joint[:2], half], joint) for joint in by_kind}
        for half in HALVES
    }
    for half, of_joints in ranges.items():
        quantities = of_joints[by_kind[-1]]
        table = new_table(f"Fitted to {half}, with half widths of 95 %", "joint", *quantities)
        for joint, values in of_joints.items():
            cells = [
                f"{value:.4g} ± {0.5 * np.ptp(interval):.2g}" for value, interval in values.values()
            ]
            table.add_row(joint, *cells)
        console.print(table)
        table = new_table("Half widths of 95 % [%], median of four legs", "joints", *ratios)
        for kind in KINDS:
            widths = [relative_widths(found[leg, half], f"{leg}_{kind}") for leg in LEGS]
            table.add_row(kind, *(f"{each:.1f}" for each in np.median(widths, axis=0)))
        console.print(table)
        for left, right in zip(by_kind[::2], by_kind[1::2], strict=True):
            difference = apart(of_joints[left], of_joints[right])
            console.print(f"{left} and {right} differ in: {difference}")
    for joint in every:
        difference = apart(*(of_joints[joint] for of_joints in ranges.values()))
        console.print(f"halves of {joint} differ in: {difference}")

    table = new_table("rms error in mrad of seconds that are not fitted", "fitted", "all", *every)
    kinds = ("all", "of angle and direction", "below 0.1 rad/s", "above 1 rad/s", "90 % below")
    for half, others in zip(HALVES, reversed(HALVES), strict=True):
        rows = np.concatenate([np.arange(len(angles))[part] for part in HALVES[others]])
        errors = [(each - angles)[rows] for each in (predicted[half], stated)]
        ours, theirs = (1e3 * np.array([rms(each), *rms(each, 0)]) for each in errors)
        for name, numbers in (("", ours), (" as it comes", theirs), (" factor", theirs / ours)):
            table.add_row(f"{half}{name}", *(f"{number:.1f}" for number in numbers))
        left_over = new_table(f"What is left in {others}, rms in mrad", "joint", *kinds)
        # A mean over bins of 20 mrad for each direction is what depends on both.
        speeds = np.gradient(angles[rows], PERIOD, axis=0)
        for joint, error, angle, speed in zip(
            every, errors[0].T, angles[rows].T, speeds.T, strict=True
        ):
            bins = 2 * np.floor((angle - angle.min()) / 0.02).astype(int) + (speed > 0.0)
            means = np.bincount(bins, error) / np.maximum(np.bincount(bins), 1)
            power = np.cumsum(np.abs(np.fft.rfft(error)) ** 2)
            highest = np.searchsorted(power, 0.9 * power[-1]) / (PERIOD * len(error))
            parts = (error, means[bins], error[np.abs(speed) < 0.1], error[np.abs(speed) > 1.0])
            sizes = (f"{1e3 * rms(each) if len(each) else np.nan:.1f}" for each in parts)
            left_over.add_row(joint, *sizes, f"{highest:.1f} Hz")
        console.print(left_over)

        shown = [every.index(f"{LEGS[0]}_{kind}") for kind in KINDS]
        motions = {"reference": references, "as it comes": stated, "measured": angles}
        motions["identified"] = predicted[half]
        curves = {name: each[:, shown] for name, each in motions.items()}
        picture = output / f"predicted_from_row_{HALVES[others][0].start}.png"
        draw(picture, half, [every[i] for i in shown], curves)
    console.print(table)
    return 0
