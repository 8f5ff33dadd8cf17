"""A light arm of seven hinges under hard limits, on which Fourier series do well.

The arm has the proportions of the usual arms of this kind: shoulder, elbow and wrist with axes that
cross, 0.36 m to the shoulder, 0.42 m and 0.40 m to elbow and wrist, and 0.13 m to the flange. Each
joint has a position servo. Its masses, gains and limits are round numbers of that size, not those
of a robot. Unlike the arms of `arms`, it needs no file of others.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.experiment.schema import Experiment
from scripts.benchmarks.arms import CENTRE_SCALE, start_control, write_control

# Axes of the hinges, lengths to the next one [m], and masses [kg].
AXES = ("0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
LENGTHS = (0.36, 0.21, 0.21, 0.20, 0.20, 0.07, 0.06)
MASSES = (5.0, 5.0, 4.0, 3.5, 3.0, 2.0, 1.0)

# Largest torques of the joints [N m] and speeds [rad/s], and their ranges [rad].
TORQUES = (300.0, 300.0, 170.0, 170.0, 100.0, 40.0, 40.0)
SPEEDS = (1.5, 1.5, 1.7, 1.3, 2.2, 2.3, 2.3)
RANGES = (2.9, 2.0, 2.9, 2.0, 2.9, 2.0, 3.0)

# Gains of the servos: stiffness [N m/rad] and damping [N m s/rad].
STIFFNESS, DAMPING = 2000.0, 200.0

# Pose at rest [rad].
HOME = (0.0, 0.6, 0.0, -1.4, 0.0, 1.0, 0.0)

# Amplitude of the starting motion [rad].
AMPLITUDE = 0.15

# Standard deviations of encoders [rad] and of their filtered derivatives [rad/s].
NOISE = {"qpos": 1e-3, "qvel": 1e-2}

JOINTS = tuple(f"joint{i}" for i in range(1, 8))


def model_text() -> str:
    """The MJCF of the arm, with a payload of 2 kg at the flange."""
    bodies, ends, servos = [], [], []
    height = 0.0
    for i, joint in enumerate(JOINTS):
        length, reach = LENGTHS[i], RANGES[i]
        bodies.append(
            f'<body name="link{i + 1}" pos="0 0 {height:g}">'
            f'<joint name="{joint}" axis="{AXES[i]}" range="-{reach:g} {reach:g}" '
            f'damping="1" armature="0.1"/>'
            f'<geom type="capsule" fromto="0 0 0 0.01 0 {length:g}" size="0.06" '
            f'mass="{MASSES[i]:g}" contype="0" conaffinity="0"/>'
        )
        ends.append("</body>")
        servos.append(
            f'<position name="{joint}" joint="{joint}" kp="{STIFFNESS:g}" kv="{DAMPING:g}" '
            f'ctrlrange="-{reach:g} {reach:g}" forcerange="-{TORQUES[i]:g} {TORQUES[i]:g}"/>'
        )
        height = length

    payload = (
        f'<body name="payload" pos="0 0 {height:g}">'
        '<inertial mass="2" pos="0.03 -0.02 0.06" diaginertia="4e-3 3e-3 2e-3"/></body>'
    )
    home = " ".join(f"{angle:g}" for angle in HOME)
    return (
        '<mujoco model="seven_hinges"><compiler angle="radian" autolimits="true"/>'
        '<option timestep="0.002" integrator="implicitfast"/>'
        f"<worldbody>{''.join(bodies)}{payload}{''.join(ends)}</worldbody>"
        f"<actuator>{''.join(servos)}</actuator>"
        f'<keyframe><key name="home" qpos="{home}" ctrl="{home}"/></keyframe></mujoco>'
    )


def experiment(horizon: float, folder: Path) -> Experiment:
    """Make the experiment: from home, rest to rest, under limits of positions, speeds and forces.

    The unknowns are the damping of every joint, and mass and centre of mass of the payload.

    Args:
        horizon: Duration [s].
        folder: Folder that receives the model and the starting control.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "seven_hinges.xml"
    path.write_text(model_text(), encoding="utf-8")

    # The servos hold the pose with a small deflection.
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[:] = HOME
    mujoco.mj_forward(model, data)
    hold = np.array(HOME) + data.qfrc_bias / STIFFNESS
    control = folder / f"seven_hinges_{horizon:g}s.csv"
    write_control(control, JOINTS, start_control(hold, horizon, AMPLITUDE))

    parameters: dict[str, dict[str, Any]] = {
        f"{joint}_damping": {"target": f"joint/{joint}:damping"} for joint in JOINTS
    }
    parameters["payload_mass"] = {"target": "body/payload:mass"}
    for i, axis in enumerate("xyz"):
        target = {"target": f"body/payload:ipos[{i}]", "scale": CENTRE_SCALE}
        parameters[f"payload_{axis}"] = target

    speeds = dict(zip(JOINTS, SPEEDS, strict=True))
    return Experiment(
        model=path.name,
        directory=folder,
        source=path.stem,
        rate=100.0,
        measure_rate=50.0,
        horizon=horizon,
        initial={"keyframe": "home", "control": control.name},
        parameters=parameters,
        noise={f"{kind}:{joint}": sigma for kind, sigma in NOISE.items() for joint in JOINTS},
        cost={"criterion": "E", "control": 0.0},
        limits={"velocity": speeds, "control_rate": speeds},
        boundary={"start": "rest", "end": "rest"},
    )
