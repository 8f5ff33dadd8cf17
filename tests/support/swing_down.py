"""A pendulum without a motor that is released from an angle, and the theory of its small swings."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from mjfim.experiment.schema import Experiment
from tests.support.numerics import Array

# Length [m], mass [kg] and inertia about the hinge [kg m²] of a slender rod with a hinge at its
# end, its damping [N m s/rad], and gravity [m/s²].
LENGTH, MASS, DAMPING, GRAVITY = 0.6, 0.4, 0.01, 9.81
CENTRE = 0.5 * LENGTH
INERTIA_AT_CENTRE = MASS * LENGTH**2 / 12.0

# Standard deviation of the measured angle [rad].
SIGMA = 0.002

MODEL = """
<mujoco model="swing-down">
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.004" integrator="RK4" gravity="0 0 -{gravity}"/>
  <worldbody>
    <body name="rod">
      <inertial pos="0 0 -{centre}" mass="{mass}" diaginertia="{inertia} {inertia} {inertia}"/>
      <joint name="hinge" type="hinge" axis="0 1 0" {range} damping="{damping}"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -{length}" size="0.01" mass="0"/>
    </body>
  </worldbody>
</mujoco>
"""


def swing_down(
    folder: Path, angle: float = 0.5, joint_range: str = "", **tables: Any
) -> Experiment:
    """Write the model, and return an experiment about its damping and its centre of mass.

    Args:
        folder: Folder of the model.
        angle: Angle from which the pendulum is released at rest [rad].
        joint_range: Attribute `range` of the hinge, or nothing.
        **tables: Further keys and tables of the experiment.
    """
    text = MODEL.format(
        gravity=GRAVITY,
        centre=CENTRE,
        mass=MASS,
        inertia=INERTIA_AT_CENTRE,
        range=joint_range,
        damping=DAMPING,
        length=LENGTH,
    )
    (folder / "swing_down.xml").write_text(text, encoding="utf-8")

    values = {
        "model": "swing_down.xml",
        "rate": 50.0,
        "horizon": 3.0,
        "parameters": {
            "damping": {"target": "joint/hinge:damping", "guess": DAMPING},
            "centre": {"target": "body/rod:ipos[2]", "guess": -CENTRE},
        },
        "noise": {"qpos:hinge": SIGMA},
        **tables,
    }
    initial = {"qpos": (angle,), **values.pop("initial", {})}
    return Experiment(**values, initial=initial, directory=folder, source="swing_down.toml")


def small_swing(t: Array, angle: float, damping: float, centre: float) -> Array:
    """Angle of the pendulum [rad] by the linearised equation of motion.

    Args:
        t: (n,) times [s].
        angle: Angle of the release at rest [rad].
        damping: Damping of the hinge [N m s/rad].
        centre: Height of the centre of mass above the hinge, negative [m].
    """
    inertia = INERTIA_AT_CENTRE + MASS * centre**2
    decay = 0.5 * damping / inertia
    stiffness = -MASS * GRAVITY * centre / inertia
    omega = np.sqrt(stiffness - decay**2)
    phase = omega * t
    return angle * np.exp(-decay * t) * (np.cos(phase) + decay / omega * np.sin(phase))


def small_swing_information(t: Array, angle: float) -> Array:
    """(2, 2) Fisher information of damping and centre of mass from the angle at the times t: (n,).

    The derivatives are central differences of the closed form.
    """
    columns = []
    for step in ((1e-6, 0.0), (0.0, 1e-6)):
        ahead = small_swing(t, angle, DAMPING + step[0], -CENTRE + step[1])
        behind = small_swing(t, angle, DAMPING - step[0], -CENTRE - step[1])
        columns.append((ahead - behind) / 2e-6)
    G = np.stack(columns, axis=1) / SIGMA
    return G.T @ G
