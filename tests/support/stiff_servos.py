"""An arm with stiff servos and weak motors, as small robot arms have, and experiments with it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment

# Two joints whose servos reach their largest force at a distance of 3 mrad.
STIFF_ARM = """
<mujoco model="stiff_arm">
  <option timestep="0.004" integrator="implicitfast"/>
  <worldbody>
    <body name="upper" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="0.6" armature="0.03"/>
      <geom name="upper" type="capsule" size="0.02" fromto="0 0 0 0.2 0 0" mass="0.2" contype="0"
            conaffinity="0"/>
      <body name="fore" pos="0.2 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.6" armature="0.03"/>
        <geom name="fore" type="capsule" size="0.02" fromto="0 0 0 0.2 0 0" mass="0.1" contype="0"
              conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <position name="shoulder" joint="shoulder" kp="1000" kv="3" forcerange="-3 3"
              ctrlrange="-3 3"/>
    <position name="elbow" joint="elbow" kp="1000" kv="3" forcerange="-3 3" ctrlrange="-3 3"/>
  </actuator>
</mujoco>
"""

# Angles at which the arm starts [rad].
START = (0.8, -1.2)


def stiff_arm_experiment(folder: Path, amplitude: float = 0.3, **tables: Any) -> Experiment:
    """An arm whose joints swing about the start.

    Args:
        folder: Folder for the model.
        amplitude: Amplitude of the swing [rad]; the motors are too weak for more than some mrad.
        **tables: Further tables of the experiment.
    """
    (folder / "stiff_arm.xml").write_text(STIFF_ARM, encoding="utf-8")
    swing = {
        "kind": "sine",
        "amplitude": amplitude,
        "frequency": 1.0,
        "offset": {"shoulder": START[0], "elbow": START[1]},
    }
    stated = {
        "model": "stiff_arm.xml",
        "rate": 50.0,
        "horizon": 1.0,
        "initial": {"qpos": START, "control": swing},
        "parameters": {
            "mass": "body/fore:mass",
            "damping": "joint/shoulder:damping",
        },
        "noise": {"state": 0.01},
        "cost": {"control": 0.0},
        "descent": {"max_iterations": 30},
    }
    return Experiment(**{**stated, **tables}, directory=folder)


def dry_arm_experiment(folder: Path, **tables: Any) -> Experiment:
    """The same arm with dry friction, which hides gentle swings: derivatives hardly hold.

    Args:
        folder: Folder for the model.
        **tables: Tables of the experiment that replace those of `stiff_arm_experiment`.
    """
    parameters = {
        "mass": "body/fore:mass",
        "damping": "joint/shoulder:damping",
        "friction": "joint/shoulder:frictionloss",
    }
    experiment = stiff_arm_experiment(folder, 0.0005, **{"parameters": parameters, **tables})
    dry = STIFF_ARM.replace('damping="0.6"', 'damping="0.6" frictionloss="0.05"')
    (folder / "stiff_arm.xml").write_text(dry, encoding="utf-8")
    return experiment


def stiff_arm_task(folder: Path, amplitude: float = 0.3, **tables: Any) -> DesignTask:
    """The task of `stiff_arm_experiment`."""
    return DesignTask.resolve(stiff_arm_experiment(folder, amplitude, **tables), threads=1)
