"""Fits of single pieces of an inertia end at a body that MuJoCo accepts."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import mjfim
from mjfim.experiment.system import System
from mjfim.output.archive import write_recording
from tests.support.cli import run

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


# Unknowns of a body, and a body whose moments they cannot have: the fit ends at one that is.
UNKNOWNS = {
    "ten barycentric numbers": """
[parameters.body]
inertial = "pendulum"
coordinates = "barycentric"
""",
    "mass with centre": """
[parameters.mass]
target = "body/pendulum:mass"
bounds = [0.01, 10.0]
[parameters.centre]
target = "body/pendulum:ipos[2]"
bounds = [-1.0, 0.0]
[parameters.moment]
target = "body/pendulum:inertia[1]"
bounds = [0.0, 1.0]
""",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", UNKNOWNS)
def test_the_identified_file_is_accepted_by_mujoco(tmp_path: Path, name: str) -> None:
    """A and B are at least C; the parameters share no prior, and the log is noisy and short."""
    text = EXPERIMENT.partition("[parameters.piece]")[0] + UNKNOWNS[name]
    noise = "\n[noise]\nstate = 0.05\n\n[fit]\nbootstrap = 0\n"
    file, log_file = tmp_path / "pendulum.toml", tmp_path / "log.csv"
    file.write_text(text + noise, encoding="utf-8")
    (tmp_path / "pendulum.xml").write_text(PENDULUM.format(xx=0.01, zz=5e-4), encoding="utf-8")
    control = 1.5 * np.sin(0.02 * np.arange(300))[:, None]
    system = System.resolve(mjfim.Experiment.from_file(file))

    # The robot is a point mass at the tip of a rod, with a moment at the centre of almost nothing.
    robot = PENDULUM.format(xx=2e-6, zz=2e-6).replace(" 0.01 ", " 1e-6 ")
    (tmp_path / "pendulum.xml").write_text(robot, encoding="utf-8")
    log = mjfim.simulate(mjfim.Experiment.from_file(file), control, 3)
    write_recording(log_file, log, system)
    (tmp_path / "pendulum.xml").write_text(PENDULUM.format(xx=0.01, zz=5e-4), encoding="utf-8")
    run("identify", file, log_file, "-o", tmp_path / "fit")

    model = mujoco.MjModel.from_xml_path(str(tmp_path / "fit" / "identified.xml"))
    moments = np.sort(model.body_inertia[model.body("pendulum").id])
    assert model.body_mass[model.body("pendulum").id] > 0.0
    assert moments[0] >= 0.0 and moments[0] + moments[1] >= moments[2] * (1.0 - 1e-6)
