"""The walk of a newcomer: its judge finds what plain MuJoCo shows, and its table says it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from mjfim.studies import first_experiment
from scripts import newcomer
from scripts.newcomer import Walk, markdown, ranges_of, violations, walk
from tests.fuzz.player import Layout
from tests.support.cli import called_here
from tests.support.limits import full_rows

SERVO = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body name="arm">
      <joint name="hinge" axis="0 1 0" range="-60 60" damping="1"/>
      <geom size="0.1" mass="1" pos="0.5 0 0"/>
    </body>
  </worldbody>
  <actuator>
    <position name="servo" joint="hinge" kp="20" ctrlrange="-2 2" forcerange="-5 5"/>
  </actuator>
</mujoco>
"""


def judged(text: str, ctrl: Any, stated: Any = ()) -> set[str]:
    """Limits that the motion of a model under some controls, by engine steps, exceeds."""
    model = mujoco.MjModel.from_xml_string(text)
    names = [f"ctrl:{name}" for name in Layout(model).drives]
    given = [dict(zip(names, row, strict=True)) for row in [*ctrl, 0.0 * ctrl[0]]]
    rows = full_rows(model, given, model.opt.timestep)
    found = violations(model, rows, ranges_of(model, dict(stated)))
    return {each.split(" is ")[0] for each in found}


def test_the_judge_sees_each_kind_of_limit() -> None:
    """A servo follows one slow wave [rad]."""
    wave = np.sin(0.005 * np.pi * np.arange(400))[:, None]
    assert judged(SERVO, 0.2 * wave) == set()
    assert judged(SERVO, 1.2 * wave) == {"position of hinge"}
    stated = {"velocity": {"hinge": 0.1}, "control": {"servo": [-0.1, 0.3]}}
    assert judged(SERVO, 0.2 * wave, stated) == {"velocity of hinge", "control of servo"}
    # MuJoCo clamps the force; the judge sees what the servo asks for.
    every = {"force of servo", "control of servo", "position of hinge"}
    assert judged(SERVO, 2.5 * wave) == every


BALL = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body><joint name="ball" type="ball" limited="true" range="0 30" damping="1"/>
      <geom size="0.1" mass="1" pos="0.5 0 0"/></body>
    <body pos="3 0 0"><joint name="slide" type="slide" damping="1"/>
      <geom size="0.1" mass="1"/></body>
  </worldbody>
  <tendon><fixed name="rope" limited="true" range="-0.2 0.2" actuatorfrcrange="-0.5 0.5"
    actuatorfrclimited="true"><joint joint="slide" coef="1"/></fixed></tendon>
  <actuator><motor name="turn" joint="ball" gear="0 1 0"/>
    <motor name="pull" tendon="rope" gear="2"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize(
    ("turn", "pull", "kinds"),
    [
        (0.01, 0.01, set()),
        (0.6, 0.01, {"position of ball"}),
        (0.01, 0.2, {"tendon_length of rope"}),
        # The range of a tendon's force is that of its actuators, whatever their gear.
        (0.01, 0.6, {"tendon_length of rope", "tendon_force of rope"}),
    ],
)
def test_the_judge_sees_ball_joints_and_tendons(turn: float, pull: float, kinds: set[str]) -> None:
    assert judged(BALL, np.tile([turn, pull], (300, 1))) == kinds


def test_the_table_has_a_row_for_each_model() -> None:
    done = Walk(
        model="arm",
        codes={"init": 0, "check": 1, "design": 0, "identify": None},
        seconds={"init": 2.0, "check": 3.4, "design": 50.0, "identify": 600.0},
        gain=12.34,
        feasible_start=False,
        claimed=True,
        violations=["force of servo by 3 % of half its range at 1 s"],
        inside=9,
        parameters=10,
    )
    refused = Walk(model="odd", codes={"init": 2}, seconds={"init": 1.0})
    lines = markdown([done, refused]).splitlines()
    assert len(lines) == 4
    assert lines[2].startswith("| arm | 0 | 0 (2 s) | 1 (3 s) | 0 (50 s) | no end (600 s) |")
    assert "12.3 (start breaks limits) | 9 of 10 | no: force of servo" in lines[2]
    assert lines[3] == "| odd | 0 | 2 (1 s) | — | — | — | — | — | — | — | — |"


# Upright, so that the experiment is short.
PENDULUM = """
<mujoco>
  <option timestep="0.02"/>
  <worldbody>
    <body name="rod" pos="0 0 1">
      <joint name="hinge" axis="0 1 0" damping="0.1"/>
      <geom size="0.05" mass="1" pos="0 0 0.5"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-1 1"/></actuator>
</mujoco>
"""


@pytest.mark.slow
@pytest.mark.usefixtures("empty_figures")
def test_a_walk_ends_with_the_parameters_of_the_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(newcomer, "call_verb", called_here)
    monkeypatch.setattr(newcomer, "ROBOTS", 100)
    monkeypatch.setattr(newcomer, "FITS", newcomer.FITS_PART)
    monkeypatch.setattr(first_experiment, "SECONDS", 3.0)
    model = tmp_path / "pendulum.xml"
    model.write_text(PENDULUM, encoding="utf-8")
    found = walk(model, tmp_path / "walk")
    assert found.codes["init"] == found.codes["simulate"] == 0
    assert {found.codes[verb] for verb in ("check", "design", "identify")} <= {0, 1}
    assert found.claimed
    assert not found.violations
    assert found.gain is not None
    # The rehearsal says of robots what they do in plain MuJoCo.
    # Shares of 60 and of 100 robots differ by less than 0.2 in 98 of 100 cases.
    assert found.kept == pytest.approx(found.kept_in_mujoco, abs=0.2)
    assert found.safe is (found.kept > 0.95)
    assert found.inside is not None
    assert found.parameters
