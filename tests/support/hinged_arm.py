"""An arm of several hinges under its own small controller, logged with noise."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.experiment.initial import multisine
from mjfim.experiment.schema import Experiment
from mjfim.records.trajectory import Recording
from tests.support.numerics import Array

# Axes of the hinges, lengths to the next one [m], masses [kg], sizes of torques, and the mean pose.
AXES = ("0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
LENGTHS = (0.36, 0.21, 0.21, 0.20, 0.20, 0.07, 0.06)
MASSES = (5.0, 5.0, 4.0, 3.5, 3.0, 2.0, 1.0)
TORQUES = (3.0, 3.0, 1.7, 1.7, 1.0, 0.4, 0.4)
POSE = (0.0, 0.6, 0.0, -1.4, 0.0, 1.0, 0.0)


def arm_text(joints: int, *, friction: bool = False) -> str:
    """MJCF of the arm, with motors and sensors of their torques."""
    bodies, height = "", 0.0
    links = zip(AXES, LENGTHS, MASSES, TORQUES, strict=True)
    for i, (axis, length, m, torque) in enumerate(itertools.islice(links, joints)):
        across, along = m * (length**2 / 12 + 9e-4), m * 1.8e-3
        bodies += (
            f'<body name="link{i + 1}" pos="0 0 {height:g}">'
            f'<joint name="joint{i + 1}" axis="{axis}" damping="{0.5 * torque:g}" '
            f'armature="0.05" frictionloss="{0.3 * torque * friction:g}"/>'
            f'<inertial mass="{m:g}" pos="{0.01 + 0.004 * i:g} {0.005 * (i % 3):g} {length / 2:g}" '
            f'fullinertia="{across:g} {1.05 * across:g} {along:g} '
            f'{1e-4 * (i - 3):g} {2e-4 * (i % 2):g} {1e-4 * (i % 3 - 1):g}"/>'
        )
        height = length
    names = [f"joint{i + 1}" for i in range(joints)]
    motors = "".join(f'<motor name="{name}" joint="{name}"/>' for name in names)
    sensors = "".join(
        f'<jointactuatorfrc name="torque{name[5:]}" joint="{name}"/>' for name in names
    )
    return (
        '<mujoco><option timestep="0.0005" integrator="implicitfast">'
        '<flag contact="disable"/></option>'
        f"<worldbody>{bodies}{'</body>' * joints}</worldbody>"
        f"<actuator>{motors}</actuator><sensor>{sensors}</sensor></mujoco>"
    )


def arm_parameters(joints: int, *, friction: bool = False, **of_inertia: Any) -> dict[str, Any]:
    """Inertias of all links, and damping, armature and dry friction of all joints."""
    tables = {}
    for i in range(1, joints + 1):
        tables[f"link{i}"] = {"inertial": f"link{i}", **of_inertia}
        tables[f"damping{i}"] = f"joint/joint{i}:damping"
        tables[f"armature{i}"] = f"joint/joint{i}:armature"
        if friction:
            tables[f"friction{i}"] = f"joint/joint{i}:frictionloss"
    return tables


def arm_experiment(
    folder: Path, joints: int, *, friction: bool = False, **tables: Any
) -> Experiment:
    """Experiment of the arm in a folder, at 500 Hz, positions measured."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "arm.xml").write_text(arm_text(joints, friction=friction), encoding="utf-8")
    defaults = {
        "parameters": arm_parameters(joints, friction=friction),
        "noise": {f"qpos:joint{i}": 1e-4 for i in range(1, joints + 1)},
    }
    return Experiment(
        model="arm.xml", directory=folder, source="arm", rate=500.0, **{**defaults, **tables}
    )


def arm_log(
    joints: int,
    seconds: float,
    rng: np.random.Generator,
    *,
    sigma: float = 0.0,
    torque_sigma: float = 0.0,
) -> tuple[Recording, Array]:
    """Play a multisine with a controller, and log positions and torques.

    Returns:
        The recording with the columns `qpos:joint<i>` and `torque<i>`, and (M, joints) velocities.
    """
    model = mujoco.MjModel.from_xml_string(arm_text(joints))
    data = mujoco.MjData(model)
    t = np.arange(round(500.0 * seconds) + 1) / 500.0
    size = np.array(TORQUES[:joints])
    reference = np.array(POSE[:joints]) + 0.5 * multisine(t, joints, 0.2, 5, rng)
    speed = np.gradient(reference, t, axis=0)

    q, v, u = np.zeros((3, len(t), joints))
    data.qpos[:], data.qvel[:] = reference[0], speed[0]
    for k in range(len(t)):
        q[k], v[k] = data.qpos, data.qvel
        u[k] = 60.0 * size * (reference[k] - q[k]) + 6.0 * size * (speed[k] - v[k])
        data.ctrl[:] = u[k]
        mujoco.mj_step(model, data, 4)

    q_noise, u_noise = sigma * rng.standard_normal(q.shape), rng.standard_normal(u.shape)
    y = np.hstack([q + q_noise, u + torque_sigma * size * u_noise])
    names = [f"{kind}{i}" for kind in ("qpos:joint", "torque") for i in range(1, joints + 1)]
    return Recording(t=t, ctrl=u[:-1], y=y, outputs=tuple(names), name="arm"), v
