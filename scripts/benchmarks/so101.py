"""A real SO-101 arm: five motions are fitted in part, all are predicted beside published sets.

    python -m scripts.benchmarks so101 DATA/sage_so101 MODEL/so101_nomesh.xml out/so101
    python -m scripts.benchmarks so101 DATA/sage_so101 MODEL/so101_nomesh.xml out/so101 --select

The folder of the data holds one folder for each motion, with position references and measured
angles. The script writes model, experiment file and logs into the folder of the output, and prints
the rms error of every motion, open loop from the references. Published sets have the best delay of
0 to 60 ms and no contacts, and in a second table the best zero of each joint in each motion.

With `--select`, the model lacks the gain kd and the drag. Terms are selected from five whole
motions, and the other five are predicted.
"""

from __future__ import annotations

import gzip
import json
import re
import time
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import mujoco
import numpy as np
from rich.console import Console

import mjfim
from mjfim.arrays import Array
from mjfim.experiment.system import System
from mjfim.recordings.read import read_recording
from scripts.benchmarks.child import new_table, options_of, rms, with_paths, write_log

JOINTS = ["shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper"]

# Period of the logs [s].
PERIOD = 0.02006

# Motions, with the first and the last row that is fitted.
FITTED = {
    "multisine": (0, 600),
    "prbs_excitation": (1500, 2100),
    "friction_gravity": (1000, 1600),
    "backlash_detection": (500, 900),
    "single_joint_elbow": (900, 1600),
}
HELD_OUT = "chirp_sweep step_response hold_under_gravity random_waypoints slow_precision"

# Joints and rows of two predictions that are drawn.
SHOWN = {
    "chirp_sweep": (("wrist_roll", "gripper"), 5800, 5980),
    "slow_precision": (("shoulder_lift", "elbow_flex"), 200, 1200),
}

# Quantities that are compared by their ratio to kp: unit of the ratio, and its scale.
QUANTITIES = {"damping": ("ms", 1e3), "friction": ("mrad", 1e3), "armature": ("ms²", 1e6)}

# Published sets: rows of kp, -kp, -kd, armature, dry friction and viscous friction.
PUBLISHED = {
    "so101_new_calib": "998.22 | -998.22 | -2.731 | 0.028 | 0.052 | 0.60",
    "joints_properties": "17.8 | -17.8 | 0 | 0.028 | 0.052 | 0.60",
    "gtc_berlin": "48.9 51.3 18.6 43.0 47.1 50.8 | -48.9 -51.3 -18.6 -43.0 -47.1 -50.8 |"
    "-2.31 -2.78 -0.53 -2.72 -1.79 -2.35 | 0.058 0.044 0.055 0.051 0.051 0.043 |"
    "0.22 0.32 0.40 0.30 0.28 0.31 | 1.07 0.88 0.49 0.52 0.45 1.14",
    "k-scale": "17.8 | -17.8 | 0 | 0.040 | 0.162 | 1.23",
}

# Five engine steps of 4.012 ms are a period of the logs.
ARM = """model = "so101.xml"
rate = 49.850448654037886
initial.qpos = [0.0, 0.0, 0.5, 0.0, 0.0, 0.5]
recording.time = "time"
fit = { segments = "whole", start = "measured" }
"""
# Readings and references have different zeros.
OUTPUT = """noise."qpos:JOINT" = 0.004
nuisance.bias."qpos:JOINT" = 0.02
"""
# Servos are alike, so that they share four numbers. Gravity at the lift and the elbow determines
# the gain from an angle to a torque. The gain kd acts on the change of the error: without it, jumps
# come too early. The gripper's largest duty is its own.
SHARED = """
[parameters.kp]
targets = [KPS]
guess = 10.0
bounds = [0.3, 200.0]
[parameters.kd]
targets = [KDS]
guess = 0.1
bounds = [0.0, 5.0]
[parameters.armature]
targets = [ARMATURES]
guess = 0.005
bounds = [1e-4, 0.3]
[parameters.limit]
targets = [
    { path = "controller/shoulder_pan:saturation" },
    { path = "controller/shoulder_lift:saturation" },
    { path = "controller/elbow_flex:saturation" },
    { path = "controller/wrist_flex:saturation" },
    { path = "controller/wrist_roll:saturation" },
]
guess = 2.0
bounds = [0.1, 30.0]
[parameters.limit_gripper]
target = "controller/gripper:saturation"
guess = 1.0
bounds = [0.1, 30.0]
"""
# What all joints have, by its mark above.
SHARED_PATHS = {
    "[KPS]": "controller/JOINT:kp",
    "[KDS]": "controller/JOINT:kd",
    "[ARMATURES]": "joint/JOINT:armature",
}
# The profile has the acceleration of the register: 254 times 100 steps/s^2 of 2 pi / 4096 rad. The
# gripper moves as if it had 20 rad/s^2. Only the chirp shows that, which is not fitted. Jumps of
# 0.24 rad in one log pass faster than such a profile; all other changes are below 0.08.
JOINT = """
[controllers.JOINT]
kp = 10.0
kd = 0.1
reference_velocity = "difference"
rate = 249.25224327018943
latency = 0.012
acceleration = ACCELERATION
jump = 0.1
saturation = [-2.0, 2.0]            # the largest duty of the servo
[parameters.latency_JOINT]
target = "controller/JOINT:latency"
guess = 0.012
bounds = [0.0, 0.06]
[parameters.damping_JOINT]
target = "joint/JOINT:damping"
guess = 0.5
bounds = [0.0, 10.0]
[parameters.friction_JOINT]
target = "joint/JOINT:frictionloss"
guess = 0.15
bounds = [0.0, 2.0]
[parameters.drag_JOINT]
target = "joint/JOINT:damping[1]"
guess = 0.1
bounds = [0.0, 5.0]
"""

# A motion of 4 s for the armature, with the knowledge and the residuals of the fit. Its references
# are held, so that joint and servo brake together, and the gripper rests.
DESIGN = """model = "fit/identified.xml"
earlier = ["fit/estimate.json"]
rate = 49.850448654037886
horizon = 4.012
cost = { criterion = "c", subset = ["armature"], control = 0.0 }
nuisance.delay = 0.01
limits = { velocity = 5.0, clearance = 0.005, bandwidth = 8.0 }
boundary = { start = "rest", end = "rest" }
descent.seconds = 60.0
OUTPUTS[initial]
qpos = [0.0, 0.0, 0.5, 0.0, 0.0, 0.5]
[initial.control]
kind = "multisine"
fade = 1.5
offset = { elbow_flex = 0.5, gripper = 0.5 }
[initial.control.amplitude]
shoulder_pan = 0.3
shoulder_lift = 0.1
elbow_flex = 0.1
wrist_flex = 0.3
wrist_roll = 0.3
gripper = 0.0
[parameters.kp]
targets = [KPS]
[parameters.armature]
targets = [ARMATURES]
"""
FRICTION = """
[parameters.damping_JOINT]
target = "joint/JOINT:damping"
scale = 0.1
[parameters.friction_JOINT]
target = "joint/JOINT:frictionloss"
[parameters.drag_JOINT]
target = "joint/JOINT:damping[1]"
scale = 0.1
"""

# Changes of the model: what touches the table, and no creep in dry friction, which is 1 to 2 mrad/s
# with the defaults of MuJoCo.
TOUCHING = 'contype="1" conaffinity="1" friction="0.2"'
CHANGES = {
    "<worldbody>": '<option timestep="0.004012" integrator="implicitfast"/><worldbody>'
    f'<geom type="plane" size="1 1 1" pos="0 0 -0.0125" {TOUCHING}/>',
    '<site group="3" name="gripperframe"': '<geom size="0.034" pos="0.024 0 -0.03" mass="0" '
    f'{TOUCHING}/><site group="3" name="gripperframe"',
    '<joint damping="0.60"': '<joint solimpfriction="0.9999 0.9999 0.001" '
    'solreffriction="0.009 1" damping="0.60"',
}


def read_motion(folder: Path) -> Array:
    """Read references and angles [rad] of a motion: (M, 12)."""
    columns = []
    for name in ("control", "state_motor"):
        text = gzip.decompress((folder / f"{name}.csv.gz").read_bytes()).decode()
        columns.append([json.loads(line.split('"')[1]) for line in text.splitlines()[1:]])
    return np.hstack(columns)


def published_rms(path: Path, numbers: str, motion: Array) -> Array:
    """Return the errors [mrad] of a published set at its best delay: (2,), as it is, with zeros."""
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.timestep, model.opt.integrator = 0.004012, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    law = (model.actuator_gainprm[:, 0], *model.actuator_biasprm.T[1:3])
    fields = (*law, model.dof_armature, model.dof_frictionloss, model.dof_damping)
    for field, row in zip(fields, numbers.split("|"), strict=True):
        field[:] = numbers_of(row)
    data, found = mujoco.MjData(model), np.empty((len(motion), 6))
    data.qpos[:] = motion[0, 6:]
    for step, data.ctrl[:] in enumerate(motion[:, :6]):
        found[step] = data.qpos
        mujoco.mj_step(model, data, 5)
    late = [1e3 * (found[: len(found) - rows] - motion[rows:, 6:]) for rows in range(4)]
    errors = min(late, key=rms)
    return np.array([rms(errors), rms(errors - errors.mean(axis=0))])


def numbers_of(row: str) -> Array:
    """Numbers of six joints in a row of `PUBLISHED`."""
    return np.broadcast_to([float(number) for number in row.split()], 6)


def of_joints(text: str, joints: Sequence[str] = JOINTS) -> str:
    """A text for each joint."""
    return "".join(text.replace("JOINT", joint) for joint in joints)


def main() -> int:
    """Fit, predict, and print the errors of all motions."""
    parser = options_of(__doc__)
    parser.add_argument("--select", action="store_true", help="select terms from whole motions")
    args = with_paths(parser)
    data, model, output = args.paths
    text = model.read_text(encoding="utf-8")
    for change in CHANGES.items():
        text = text.replace(*change)
    (output / "so101.xml").write_text(text, encoding="utf-8")
    outputs = of_joints(OUTPUT)
    # The gripper is the last joint.
    laws = of_joints(JOINT).replace("ACCELERATION", "38.96", 5).replace("ACCELERATION", "20.0")
    tables = ARM + outputs + SHARED + laws
    design = DESIGN.replace("OUTPUTS", outputs) + of_joints(FRICTION, JOINTS[:-1])
    for mark, path in SHARED_PATHS.items():
        paths = of_joints(f'{{ path = "{path}" }}, ')
        tables, design = (each.replace(mark, f"[{paths}]") for each in (tables, design))
    # A design needs servos without laws.
    design = design.replace("controller", "actuator")
    (output / "design.toml").write_text(design, encoding="utf-8")
    if args.select:
        tables = re.sub(r"\[parameters\.(kd|drag_\w+)\]\n(\w.*\n)*", "", tables)
        tables = re.sub(r"(?m)^(kd|reference_velocity) = .*\n", "", tables)
    (output / "so101.toml").write_text(tables, encoding="utf-8")
    experiment = mjfim.Experiment.from_file(output / "so101.toml")

    header = ["time", *(f"{kind}:{joint}" for kind in ("reference", "qpos") for joint in JOINTS)]
    motions = {name: read_motion(data / name) for name in [*FITTED, *HELD_OUT.split()]}
    channels = System.resolve(experiment).channels

    def recording(name: str, rows: slice) -> mjfim.Recording:
        """Write rows of a motion as a log, and read it."""
        log, part = output / f"{name}.csv", motions[name][rows]
        write_log(log, header, PERIOD * np.arange(len(part)), part)
        return read_recording(log, channels)

    begun = time.perf_counter()
    console = Console(width=200)
    whole, identify = slice(None), mjfim.select_terms if args.select else mjfim.identify
    fitted = [
        recording(name, whole if args.select else slice(*rows)) for name, rows in FITTED.items()
    ]
    if args.select:
        motions = {name: motions[name] for name in HELD_OUT.split()}
    found = identify(experiment, fitted, held_out=[recording(name, whole) for name in motions])
    console.print(f"{found.selection or ''}", *found.warnings, sep="\n")
    found.plot("residual_torque", file=output / "residual_torque.png")
    found.save(output / "fit")
    found.save_model(output / "fit" / "identified.xml")
    values = np.column_stack([found.theta, found.interval]).round(5).tolist()
    console.print(dict(zip(found.parameters, values, strict=True)))
    console.print(f"{(time.perf_counter() - begun) / 60.0:.1f} minutes")

    table = new_table("rms error (mrad)", "motion", "all", *JOINTS, *PUBLISHED)
    zeros = new_table("rms error with the best zeros (mrad)", "motion", *PUBLISHED)
    own = [each.identified_outputs for each in found.predictions[-len(motions) :]]
    predicted = dict(zip(motions, own, strict=True))
    for name, motion in motions.items():
        errors = 1e3 * (predicted[name] - motion[:, 6:])
        theirs, best = np.transpose(
            [published_rms(model, each, motion) for each in PUBLISHED.values()]
        )
        table.add_row(name, *(f"{each:.1f}" for each in (rms(errors), *rms(errors, 0), *theirs)))
        zeros.add_row(name, *(f"{each:.1f}" for each in best))
    console.print(table, zeros)
    if args.select:
        return 0

    # Ratios that the motions determine. Torques have no scale without a load, so that sets with
    # other gains may move alike. Intervals are those of the numerators.
    heads = [f"{name} / kp ({unit})" for name, (unit, _) in QUANTITIES.items()]
    ratios = new_table(f"estimate | {', '.join(PUBLISHED)}", "joint", *heads)
    places = {name: i for i, name in enumerate(found.parameters)}
    published = [[numbers_of(row) for row in text.split("|")] for text in PUBLISHED.values()]
    for number, joint in enumerate(JOINTS):
        cells = []
        for name, (_, scale) in QUANTITIES.items():
            place = places.get(f"{name}_{joint}", places.get(name))
            value, (low, high) = found.theta[place], found.interval[place]
            others = []
            for gain, _, kd, armature, friction, damping in published:
                top = {"damping": damping - kd, "friction": friction, "armature": armature}[name]
                others.append(f"{scale * top[number] / gain[number]:.3g}")
            # Both the joint and the servo brake.
            braking = found.theta[places["kd"]] if name == "damping" else 0.0
            value, low, high = np.array([value, low, high]) + braking
            value, low, high = scale * np.array([value, low, high]) / found.theta[places["kp"]]
            ours = f"{value:.3g} ({low:.2g} to {high:.2g})"
            cells.append(f"{ours} | {', '.join(others)}")
        ratios.add_row(joint, *cells)
    console.print(ratios)

    # What one motion shows by itself, as half the width of a 95 % interval.
    place = places["armature"]
    before, after = found.honest_std[place], mjfim.design(output / "design.toml").final.std[1]
    alone = 1.96 / found.theta[place] / np.sqrt(after**-2 - before**-2)
    console.print(f"armature: ±{alone:.0%} by 4 s, ±10 % in {6.7 * alone**2:.1f} minutes")

    # The parts of `SHOWN`: measured angles, their references, and their predictions.
    figure, grid = plt.subplots(
        2, len(SHOWN), figsize=(13.0, 6.5), layout="constrained", squeeze=False
    )
    for axes, (name, (joints, first, last)) in zip(grid.T, SHOWN.items(), strict=True):
        t, motion = PERIOD * np.arange(first, last), motions[name][first:last]
        for axis, joint in zip(axes, joints, strict=True):
            j = JOINTS.index(joint)
            axis.plot(t, motion[:, j], color="0.5", lw=0.8, label="reference")
            axis.plot(t, predicted[name][first:last, j], color="C0", lw=1.6, label="predicted")
            axis.plot(t, motion[:, 6 + j], "k:", lw=1.4, label="measured")
            axis.set_ylabel(f"{joint} [rad]")
        axes[0].set_title(f"{name}, not fitted")
        axes[-1].set_xlabel("time [s]")
    grid[0, 0].legend(loc="upper right", ncols=3)
    figure.savefig(output / "predictions.png")
    return 0
