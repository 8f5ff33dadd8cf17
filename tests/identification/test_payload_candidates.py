"""Payloads that a model lacks: where they are tested, and that a selection finds one."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import mjfim
from mjfim.experiment.initial import multisine
from mjfim.experiment.system import System
from mjfim.identification.assessment.term_candidates import Candidate, candidates_of
from tests.support.closed_loop import ARM

DAMPINGS: dict[str, Any] = {
    "d1": {"target": "joint/shoulder:damping", "guess": 0.6},
    "d2": {"target": "joint/elbow:damping", "guess": 0.2},
}
NOISE = {"qpos:shoulder": 1e-3, "qpos:elbow": 1e-3}

# A hand that is welded to a wrist with two hinges, whose frame is turned and whose base is free.
SPATIAL = """<mujoco><worldbody><body name="base"><freejoint/><geom size="0.1"/>
  <body name="fore" pos="0 0 0.3"><joint name="roll" axis="0 0 1"/><geom size="0.05"/>
    <body name="wrist" pos="0.2 0 0" euler="0 90 0"><joint name="pitch" axis="0 1 0"/>
      <inertial pos="0 0.01 0.05" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/>
      <body name="hand" pos="0 0 0.1"><geom size="0.03" mass="0.1"/></body>
    </body>
  </body>
  <body name="other" pos="0 0 -0.3"><joint name="swing" axis="1 0 0"/>
    <geom size="0.05" pos="0 0 -0.2"/></body>
</body></worldbody></mujoco>"""

# A slide: its direction never changes, so that the place of a load has no effect.
SLIDE = """<mujoco><worldbody><body name="cart"><joint name="slide" type="slide" axis="1 0 0"/>
  <geom size="0.1"/></body></worldbody>
  <actuator><motor name="push" joint="slide"/></actuator></mujoco>"""


def planar_arm(**tables: Any) -> mjfim.Experiment:
    """The planar arm with two hinges."""
    stated: dict[str, Any] = {
        "model": str(ARM),
        "rate": 200.0,
        "initial": {"keyframe": "hanging"},
        "noise": NOISE,
        "parameters": DAMPINGS,
    }
    return mjfim.Experiment(**{**stated, **tables})


def payloads(experiment: mjfim.Experiment) -> list[Candidate]:
    """Payloads that a model may lack."""
    system = System.resolve(experiment)
    found, _ = candidates_of(system, np.ones(system.space.nv))
    return [each for each in found if each.alone == "payload"]


def candidates(folder: Path, text: str, target: str) -> list[Candidate]:
    """Payloads that a model may lack."""
    (folder / "robot.xml").write_text(text, encoding="utf-8")
    experiment = mjfim.Experiment(
        model=str(folder / "robot.xml"),
        rate=100.0,
        noise={"state": 1e-3},
        parameters={"p": {"target": target, "scale": 1.0}},
    )
    return payloads(experiment)


def axes(candidate: Candidate) -> str:
    """Axes along which a fit moves the payload."""
    return "".join(each.path[-1] for each in candidate.further)


# Friction that grows with the torque of a motor is a contact with a ball.
WORM = {
    "terms": {"worm": {"kind": "load_dependent_friction", "actuator": "elbow"}},
    "parameters": {**DAMPINGS, "worm": {"target": "term/worm:coefficient", "guess": 0.05}},
}


@pytest.mark.parametrize("tables", [{}, WORM], ids=["arm", "body of a term"])
def test_a_planar_robot_does_not_show_the_place_along_its_hinges(tables: dict[str, Any]) -> None:
    """Two places are tested at the last body: its centre of mass, and twice as far."""
    found = payloads(planar_arm(**tables))
    assert [each.description for each in found] == ["a payload at fore"] * 2
    assert [axes(each) for each in found] == ["xz", "xz"]
    assert [each.further[-1].value for each in found] == pytest.approx([-0.15, -0.3])


def test_a_planar_robot_whose_frame_is_turned_has_two_places_to_find(tmp_path: Path) -> None:
    """No axis of the last body is that of the hinges, along which the place has no effect."""
    text = """<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size="0.1"/>
      <body name="fore" pos="0 0 -0.3" euler="30 0 20"><joint name="b" axis="{axis}"/>
      <geom size="0.05" pos="0 0 -0.2"/></body></body></worldbody></mujoco>"""
    turned = np.zeros(4)
    mujoco.mju_euler2Quat(turned, np.radians([30.0, 0.0, 20.0]), "xyz")
    axis = np.zeros(3)
    mujoco.mju_negQuat(turned, turned)
    mujoco.mju_rotVecQuat(axis, np.array([0.0, 1.0, 0.0]), turned)
    found = candidates(tmp_path, text.format(axis=" ".join(map(str, axis))), "joint/b:damping")
    assert {len(axes(each)) for each in found} == {2}


def test_payloads_are_tested_at_every_last_body(tmp_path: Path) -> None:
    """A welded hand is a part of the wrist, whose centre of mass contains it."""
    found = candidates(tmp_path, SPATIAL, "joint/pitch:damping")
    assert [each.description for each in found] == [
        *["a payload at wrist"] * 2,
        *["a payload at other"] * 2,
    ]
    assert {axes(each) for each in found} == {"xyz"}
    centre = (0.5 * np.array([0.0, 0.01, 0.05]) + 0.1 * np.array([0.0, 0.0, 0.1])) / 0.6
    assert [each.value for each in found[0].further] == pytest.approx(centre.tolist())


def test_a_slide_shows_the_mass_of_a_payload_alone(tmp_path: Path) -> None:
    found = candidates(tmp_path, SLIDE, "joint/slide:damping")
    assert [axes(each) for each in found] == [""]


@pytest.mark.parametrize(
    "tables",
    [
        {"terms": {"load": {"kind": "payload", "body": "fore"}}},
        {"parameters": {**DAMPINGS, "fore": {"inertial": "fore"}}},
    ],
)
def test_a_body_whose_inertia_is_unknown_needs_no_payload(tables: dict[str, Any]) -> None:
    assert not payloads(planar_arm(**tables))


@pytest.mark.slow
@pytest.mark.parametrize("mass", [0.5, 0.0])
def test_a_selection_finds_a_payload_and_its_place(mass: float) -> None:
    """Half a kilogram in a gripper; without it, no term is added."""
    values = {"mass": mass, "x": 0.04, "z": -0.27}
    robot = planar_arm(
        terms={"load": {"kind": "payload", "body": "fore", "values": values}},
        parameters={name: {"target": table["target"]} for name, table in DAMPINGS.items()},
    )
    t = np.arange(400) / 200.0
    logs = []
    for seed in (1, 2):
        torque = multisine(t, 2, 0.4, 6, np.random.default_rng(seed)) * np.array([3.0, 1.2])
        logs.append(mjfim.simulate(robot, torque, seed))

    found = mjfim.select_terms(planar_arm(), logs, progress=False)

    assert not found.misfit
    assert found.selection is not None
    names = ("fore_payload_mass", "fore_payload_x", "fore_payload_z")
    assert found.parameters == ("d1", "d2", *(names if mass else ()))
    true = np.array([0.8, 0.3, *(values.values() if mass else ())])
    assert (np.abs(found.theta - true) < 4.0 * found.std).all()
