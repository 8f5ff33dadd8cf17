"""Control laws on the command line: a simulated closed loop, its fit, and refusals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

import mjfim
from tests.support.cli import done
from tests.support.closed_loop import ARM, PlainLaw, simulate
from tests.support.numerics import require_found

EXPERIMENT = """
model = "{model}"
rate = 250.0
horizon = 1.2
[initial]
keyframe = "hanging"
control = {{ kind = "multisine", amplitude = 0.4, frequency = 1.0 }}
[parameters.mass]
target = "body/fore:mass"
true = 1.3
[parameters.kp]
target = "controller/shoulder:kp"
true = 60.0
nuisance = true
[controllers.shoulder]
kp = 50.0
kd = 4.0
latency = "4 ms"
[controllers.elbow]
kp = 30.0
kd = 1.5
[noise]
"qpos:shoulder" = 1e-3
"qpos:elbow" = 1e-3
[fit]
bootstrap = 0
"""


@pytest.fixture
def folder(here: Path) -> Path:
    """The current folder, with an experiment with laws."""
    (here / "arm.toml").write_text(EXPERIMENT.format(model=ARM.as_posix()))
    return here


# Numbers of two equal servos and of their joints.
TRUE = {
    "kp": 30.0,
    "shoulder_friction": 0.2,
    "elbow_friction": 0.1,
    "shoulder_latency": 0.011,
    "elbow_latency": 0.018,
    "kd": 0.5,
    "shoulder_damping": 0.8,
    "elbow_damping": 0.4,
    "shoulder_drag": 0.2,
    "elbow_drag": 0.1,
    "duty": 9.0,
    "armature": 0.03,
    "bias qpos:shoulder": 0.01,
    "bias qpos:elbow": -0.02,
}


@pytest.mark.slow
@pytest.mark.usefixtures("empty_figures")
def test_the_laws_of_servos_are_proposed_and_found(here: Path) -> None:
    """A plain loop with motors makes the log; the MJCF has servos with other numbers."""
    text = ARM.read_text("utf-8").replace('timestep="0.001"', 'timestep="0.004"')
    servo = '<position kp="60" kv="2" forcerange="-9 9"/>'
    text = text.replace('<motor ctrlrange="-20 20"/>', servo)
    (here / "arm.xml").write_text(text.replace("<motor", "<position"), "utf-8")
    model, joints = mujoco.MjModel.from_xml_string(text), ("shoulder", "elbow")
    model.dof_armature[:] = TRUE["armature"]
    model.dof_damping[:] = [TRUE[f"{joint}_damping"] for joint in joints]
    model.dof_dampingpoly[:, 0] = [TRUE[f"{joint}_drag"] for joint in joints]
    model.dof_frictionloss[:] = [TRUE[f"{joint}_friction"] for joint in joints]
    rng = np.random.default_rng(0)
    t = 0.02 * np.arange(200)[:, None]
    steps = rng.uniform(-0.5, 0.5, (10, 2)).repeat(20, axis=0)
    goals = steps + 0.3 * np.sin(2.0 * np.pi * t * [0.9, 1.3])
    law = PlainLaw("", 1, TRUE["kp"], TRUE["kd"], low=-9.0, high=9.0, reference_difference=True)
    laws = {
        i: replace(law, joint=joint, latency=TRUE[f"{joint}_latency"])
        for i, joint in enumerate(joints)
    }
    columns = {i: {"reference": goals[:, i]} for i in laws}
    states, _ = simulate(model, laws, columns, 0.02, 200, np.zeros(4))
    angles = states[:-1, :2] + 1e-3 * rng.standard_normal((200, 2)) + [*TRUE.values()][-2:]
    header = "t,goal_shoulder,goal_elbow,pos_shoulder,pos_elbow"
    rows = np.hstack([t, goals, angles])
    np.savetxt("log.csv", rows, delimiter=",", header=header, comments="")
    rows[-1, 0] = np.nan
    np.savetxt("cut_off.csv", rows, delimiter=",", header=header, comments="")

    done("init arm.xml --log cut_off.csv --parameters servos")
    said = " ".join(done("validate arm.toml").output.split())
    assert "laws in place of 2 position servos" in said
    done("identify arm.toml log.csv -o out")
    found = mjfim.Estimate.load("out")
    assert found.parameters == tuple(TRUE)
    require_found(found, np.array([*TRUE.values()]))
    written = mujoco.MjModel.from_xml_path("out/identified.xml")
    assert written.actuator("elbow").biasprm[1] == pytest.approx(-found["kp"].value)
    assert written.actuator("elbow").forcerange[1] == pytest.approx(found["duty"].value)


@pytest.mark.usefixtures("folder")
def test_verbs_say_what_a_file_with_laws_serves() -> None:
    shown = done("validate arm.toml --verbose").output
    assert "It serves `identify` and `simulate`, not `design`" in " ".join(shown.split())
    assert "Control laws in the loop" in shown
