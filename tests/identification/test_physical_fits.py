"""Fits of single pieces of an inertia end at a body that MuJoCo accepts."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import mjfim
from mjfim.experiment.system import System
from mjfim.output.export.mjcf import write_identified
from tests.support.terms import recorded

PENDULUM = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="pendulum">
      <inertial pos="0 0 -0.4" mass="0.7" diaginertia="{inertia}"/>
      <joint name="pivot" type="hinge" axis="0 -1 0" damping="0.05"/>
    </body>
  </worldbody>
  <actuator><motor name="torque" joint="pivot"/></actuator>
</mujoco>
"""

MASS = {"target": "body/pendulum:mass", "bounds": (0.01, 10.0)}
CENTRE = {"target": "body/pendulum:ipos[2]", "bounds": (-1.0, 0.0)}
MOMENT = {"target": "body/pendulum:inertia[1]", "bounds": (0.0, 1.0)}
ABOUT_PIVOT = {"target": "body/pendulum:origininertia[1]"}
DAMPING = {"target": "joint/pivot:damping", "bounds": (0.0, 1.0)}

# Moments of the robots. The unknowns of the model cannot have those of the first one: its other
# moments are larger. The second one is nearly a point mass at the tip of a rod.
LARGE, POINT = "0.02 0.03 0.02", "2e-6 1e-6 2e-6"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parameters", "robot", "sigma"),
    [
        ({"piece": {"target": MOMENT["target"]}, "damping": DAMPING}, LARGE, 0.005),
        ({"piece": ABOUT_PIVOT, "damping": DAMPING}, LARGE, 0.005),
        ({"body": {"inertial": "pendulum", "coordinates": "barycentric"}}, POINT, 0.05),
        ({"mass": MASS, "centre": CENTRE, "moment": MOMENT}, POINT, 0.05),
    ],
    ids=["moment", "moment about the pivot", "barycentric", "mass with centre"],
)
def test_an_identified_inertia_is_physical(
    tmp_path: Path, parameters: dict[str, Any], robot: str, sigma: float
) -> None:
    """The file with identified values is one that MuJoCo accepts."""
    file = tmp_path / "pendulum.xml"

    def experiment(inertia: str) -> mjfim.Experiment:
        """The experiment with a model of these moments."""
        file.write_text(PENDULUM.format(inertia=inertia), encoding="utf-8")
        return mjfim.Experiment(
            model=str(file), rate=200.0, parameters=parameters, noise={"state": sigma}
        )

    control = 1.5 * np.sin(0.02 * np.arange(300))[:, None]
    log = recorded(System.resolve(experiment(robot)), control, 3)
    stated = experiment("0.01 0.01 5e-4")
    found = mjfim.identify(stated, [log])
    system = System.resolve(stated)
    assert not system.impossible(found.theta)
    assert ("piece" in found.at_bound) == ("piece" in parameters)

    write_identified(tmp_path / "identified.xml", system, found.theta)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "identified.xml"))
    moments = np.sort(model.body_inertia[1])
    assert model.body_mass[1] > 0.0
    assert moments[0] >= 0.0 and moments[0] + moments[1] >= moments[2] * (1.0 - 1e-6)
