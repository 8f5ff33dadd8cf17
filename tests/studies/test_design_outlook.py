"""A check says what a design would refuse, in the same words, and what the start violates."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjfim.cli import announcements
from mjfim.errors import ExperimentError, MjfimError
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.studies import derivative_test
from mjfim.studies.check import check_task
from tests.support.stiff_servos import stiff_arm_experiment, stiff_arm_task

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
}


@pytest.mark.parametrize("name", REFUSED)
def test_a_check_refuses_what_a_design_refuses_in_the_same_words(name: str, tmp_path: Path) -> None:
    tables, fragment = REFUSED[name]
    task = stiff_arm_task(tmp_path, amplitude=1e-3, **tables)
    with pytest.raises(MjfimError) as error:
        design_task(task)
    assert fragment in str(error.value)

    found = check_task(task)
    assert str(error.value) in found.refused
    assert not found.ok
    assert any(str(error.value) in sentence for sentence in found.verdict)
    assert found.summary()["refused"] == list(found.refused)


def test_a_check_says_which_limits_the_start_violates_and_when(tmp_path: Path) -> None:
    task = stiff_arm_task(tmp_path)
    found = check_task(task)
    assert {violation.name for violation in found.violations} == {"shoulder", "elbow"}
    assert not found.refused
    assert any("the initial control violates limits: force of" in text for text in found.verdict)

    quiet = check_task(stiff_arm_task(tmp_path, amplitude=1e-3))
    assert not quiet.violations
    assert not quiet.refused


def test_a_motion_without_a_regulator_fails_the_self_test_without_a_traceback(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unstable(*_: object) -> float:
        raise np.linalg.LinAlgError("the Riccati recursion lost positive definiteness")

    monkeypatch.setattr(derivative_test, "slope_error", unstable)
    found = check_task(stiff_arm_task(tmp_path, amplitude=1e-3))
    assert np.isinf(found.self_test.slope)
    assert not found.self_test.passed
    assert not found.ok


def test_a_check_refuses_iterations_of_hours_in_the_words_of_a_design(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = DesignTask.resolve(stiff_arm_experiment(tmp_path), threads=1).system
    assert announcements.refusal_of_design(system) is None

    monkeypatch.setattr(announcements, "iteration_seconds", lambda *_, **__: 7200.0)
    refused = announcements.refusal_of_design(system)
    with pytest.raises(ExperimentError, match="one iteration would take about 2 hours") as error:
        announcements.announce_design(system, is_default=True)
    assert str(error.value) == refused
