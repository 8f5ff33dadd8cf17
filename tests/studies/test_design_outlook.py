"""A check says what a design would refuse, in the same words, and what the start violates."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

import mjfim
from mjfim.errors import MjfimError, SimulationDivergedError
from mjfim.excitation import evaluation
from mjfim.excitation.design import design_task
from mjfim.studies import check as study_check
from mjfim.studies.check import check_task
from tests.support import stiff_servos
from tests.support.numerics import cart_task
from tests.support.stiff_servos import stiff_arm_experiment, stiff_arm_task

# Whole jobs: these tests run in `.ci/run` only.
pytestmark = pytest.mark.slow

# Changes of the experiment that a design refuses, and a part of its message.
REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "start outside": (
        {"limits": {"position": {"elbow": (-1.0, 1.0)}}},
        "limits.position.elbow: the initial state is at -1.2",
    ),
    "start cannot be held": (
        {"limits": {"force": {"shoulder": 0.1}}, "boundary": {"start": "rest"}},
        "boundary.start: standing still requires shoulder = ",
    ),
    "parameter without effect": (
        {"parameters": {"m": {"target": "body/fore:mass"}, "s": {"target": "geom/fore:friction"}}},
        "parameters.s changes nothing",
    ),
    "start too close": (
        {"limits": {"clearance": 0.3}},
        "limits.clearance: the initial state is too close: fore - wall",
    ),
    "frequency of a further start": (
        {"limits": {"bandwidth": 5.0}, "descent": {"fourier": [7.0]}},
        "descent.fourier: 7 Hz is above the bandwidth of 5 Hz",
    ),
    "parts of a further start": (
        {"descent": {"repeats": [7]}},
        "descent.repeats: 7 does not divide the 50 samples",
    ),
    "coarse level": (
        {"descent": {"coarse": 7}},
        "descent.coarse: 7 divides neither the 5 engine steps of a sample nor the 50 samples",
    ),
}

# A ball below the elbow, which matters where a clearance is stated.
WALL = '<geom name="wall" type="sphere" size="0.02" pos="0.3 0 0.8"/><body name="upper"'


@pytest.fixture
def walled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put a ball near the arm."""
    contacts = stiff_servos.STIFF_ARM.replace('contype="0"', "").replace('conaffinity="0"', "")
    model = contacts.replace('<body name="upper"', WALL)
    monkeypatch.setattr(stiff_servos, "STIFF_ARM", model)


@pytest.mark.usefixtures("walled")
@pytest.mark.parametrize("name", REFUSED)
def test_a_check_refuses_what_a_design_refuses_in_the_same_words(name: str, tmp_path: Path) -> None:
    tables, fragment = REFUSED[name]
    task = stiff_arm_task(tmp_path, amplitude=1e-3, **tables)
    with pytest.raises(MjfimError, match=re.escape(fragment)) as error:
        design_task(task)
    found = check_task(task)
    assert str(error.value) in found.refused
    assert not found.verdict.ok
    assert any(str(error.value) in sentence for sentence in found.findings)
    assert found.summary()["refused"] == list(found.refused)


def test_a_start_that_diverges_is_refused_in_the_same_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = stiff_servos.STIFF_ARM.replace('forcerange="-3 3"', "")
    shaken = free.replace('kp="1000"', 'kp="1e7"').replace("implicitfast", "Euler")
    monkeypatch.setattr(stiff_servos, "STIFF_ARM", shaken)
    said = []
    for work in (mjfim.design, mjfim.check):
        with pytest.raises(SimulationDivergedError, match="diverges under this control") as error:
            work(stiff_arm_experiment(tmp_path, amplitude=1e-3))
        said.append(str(error.value))
    assert said[0] == said[1]


def test_parameters_that_do_the_same_are_named_by_both(tmp_path: Path) -> None:
    parameters = {
        "a": {"target": "joint/shoulder:damping"},
        "b": {"target": "actuator/shoulder:biasprm[2]"},
        "mass": {"target": "body/fore:mass"},
    }
    task = stiff_arm_task(
        tmp_path, amplitude=1e-3, parameters=parameters, descent={"max_iterations": 1}
    )
    found, design = check_task(task), design_task(task)
    assert not found.refused
    assert not found.verdict.ok and not design.verdict.ok
    assert any("a and b" in text for text in design.combinations)
    for text in design.combinations:
        assert any(text in sentence for sentence in found.findings)


def test_a_check_says_which_limits_the_start_violates_and_when(tmp_path: Path) -> None:
    task = stiff_arm_task(tmp_path)
    found = check_task(task)
    assert {violation.name for violation in found.violations} == {"shoulder", "elbow"}
    assert not found.refused
    assert any("the initial control violates limits: force of" in text for text in found.findings)

    quiet = check_task(stiff_arm_task(tmp_path, amplitude=1e-3))
    assert not quiet.violations
    assert not quiet.refused


def test_a_motion_without_a_regulator_fails_the_self_test_without_a_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(study_check, "LBFGS", Mock(side_effect=np.linalg.LinAlgError))
    found = check_task(stiff_arm_task(tmp_path, amplitude=1e-3))
    assert np.isinf(found.self_test.slope)
    assert not found.self_test.passed
    assert not found.verdict.ok


@pytest.mark.parametrize(
    ("angle", "factor", "grows"), [(0.0, 1.0, True), (3.0, 1.0, False), (3.0, 1e9, False)]
)
def test_a_check_warns_of_growing_disturbances_in_the_words_of_a_design(
    angle: float, factor: float, grows: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A pendulum that begins upright; near hanging, small disturbances do not grow.

    Derivatives at a contact may be wrong by a factor.
    """
    name, right = "largest_amplification", evaluation.largest_amplification
    monkeypatch.setattr(evaluation, name, lambda *given: factor * right(*given))
    control = {"kind": "sine", "amplitude": 0.01, "frequency": 1.0}
    task = cart_task(
        tmp_path,
        rate=50.0,
        horizon=2.5,
        initial={"qpos": (0.0, angle), "control": control},
        descent={"max_iterations": 0, "coarse": 1},
    )
    found, design = check_task(task), design_task(task)
    said = [text for text in found.findings if "a small disturbance grows up to" in text]
    assert len(said) == grows
    assert said == [text for text in design.warnings if "a small disturbance grows" in text]
