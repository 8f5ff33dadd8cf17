"""Messages about simulations that diverge: MuJoCo's warning, the place, and what helps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.errors import SimulationDivergedError
from mjfim.records.trajectory import Recording

# A spring of 50 Hz: explicit integration diverges for timesteps above 1 / (50 pi) s = 6.4 ms.
STIFF = """
<mujoco>
  <option timestep="{timestep}" integrator="{integrator}"/>
  <worldbody>
    <body name="soft"><joint name="soft" type="slide" axis="0 1 0" stiffness="1"/>
      <geom size=".1" mass="1"/></body>
    <body name="block" pos="0 0 1"><joint name="stiff" type="slide" axis="1 0 0" stiffness="98696"/>
      <geom size=".1" mass="1"/></body>
  </worldbody>
  <actuator><motor name="pull" joint="soft"/><motor name="push" joint="stiff"/></actuator>
</mujoco>
"""


def stiff(
    folder: Path, timestep: float, integrator: str, amplitude: float = 1.0, **more: Any
) -> Any:
    """An experiment with the stiff spring, with a sample of 0.1 s."""
    text = STIFF.format(timestep=timestep, integrator=integrator)
    (folder / "stiff.xml").write_text(text, encoding="utf-8")
    return mjfim.Experiment(
        model="stiff.xml",
        rate=10.0,
        horizon=2.0,
        parameters={"stiffness": {"target": "joint/stiff:stiffness"}},
        noise={"state": 0.1},
        initial={"control": {"kind": "sine", "amplitude": amplitude, "frequency": 1.0}},
        directory=folder,
        source="stiff.toml",
        **more,
    )


@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicit", "implicitfast"])
def test_a_timestep_that_is_too_long_is_named(integrator: str, tmp_path: Path) -> None:
    with pytest.raises(SimulationDivergedError) as refused:
        mjfim.check(stiff(tmp_path, 0.05, integrator), threads=1)

    text = str(refused.value)
    assert "MuJoCo warns BADQ" in text
    assert "at joint stiff at t = " in text
    assert "because the timestep 0.05 s of the MJCF is too long" in text

    # The timestep that the message recommends works indeed.
    timestep = float(text.split("with ")[-1].split(" s ")[0])
    assert 0.001 < timestep < 0.01
    mjfim.check(stiff(tmp_path, timestep, integrator), threads=1)


def test_a_fit_that_diverges_at_its_start_says_why(tmp_path: Path) -> None:
    experiment = stiff(tmp_path, 0.05, "Euler")
    recording = Recording(
        t=0.1 * np.arange(21),
        ctrl=np.ones((21, 2)),
        y=np.zeros((21, 4)),
        outputs=("qpos:soft", "qpos:stiff", "qvel:soft", "qvel:stiff"),
        name="log",
    )
    with pytest.raises(SimulationDivergedError, match=r"at joint stiff .* 0.05 s of the MJCF"):
        mjfim.identify(experiment, [recording], threads=1)


def test_a_control_that_mujoco_rejects_is_named(tmp_path: Path) -> None:
    """The model is sound there: a smaller timestep would not help."""
    experiment = stiff(tmp_path, 0.001, "Euler", amplitude=3e10)
    with pytest.raises(SimulationDivergedError, match=r"control of actuator p.*BADCTRL.*gear"):
        mjfim.check(experiment, threads=1)
