"""Fits of single pieces of an inertia end at a body that MuJoCo accepts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.experiment.system import System

PENDULUM = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="pendulum">
      <inertial pos="0 0 -0.4" mass="0.7" diaginertia="{xx} 0.01 {zz}"/>
      <joint name="pivot" type="hinge" axis="0 -1 0" damping="0.05"/>
    </body>
  </worldbody>
  <actuator><motor name="torque" joint="pivot"/></actuator>
</mujoco>
"""

EXPERIMENT = """
model = "pendulum.xml"
rate = 200.0

[parameters.piece]
target = "{piece}"
guess = {guess}
true = {true}

[parameters.damping]
target = "joint/pivot:damping"
bounds = [0.0, 1.0]

[noise]
state = 0.005
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("piece", "guess", "true"),
    [
        ("body/pendulum:inertia[1]", 0.01, 0.03),
        ("body/pendulum:origininertia[1]", 0.122, 0.142),
    ],
)
def test_an_identified_inertia_is_physical(
    tmp_path: Path, piece: str, guess: float, true: float
) -> None:
    """The log is that of a body whose other moments are larger than those of the model."""
    text = EXPERIMENT.format(piece=piece, guess=guess, true=true)
    file = tmp_path / "pendulum.toml"
    file.write_text(text, encoding="utf-8")
    control = 1.5 * np.sin(0.02 * np.arange(600))[:, None]
    (tmp_path / "pendulum.xml").write_text(PENDULUM.format(xx=0.02, zz=0.02), encoding="utf-8")
    log = mjfim.simulate(mjfim.Experiment.from_file(file), control)

    (tmp_path / "pendulum.xml").write_text(PENDULUM.format(xx=0.01, zz=5e-4), encoding="utf-8")
    file.write_text(text.replace(f"true = {true}\n", ""), encoding="utf-8")
    experiment = mjfim.Experiment.from_file(file)
    found = mjfim.identify(experiment, [log], progress=False)
    assert not System.resolve(experiment).impossible(found.theta)
    assert "piece" in found.at_bound
