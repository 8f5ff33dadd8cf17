"""A model without actuators: what its motion from a release tells, compared with theory."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.errors import ExperimentError
from mjfim.excitation.task import DesignTask
from tests.support.swing_down import (
    CENTRE,
    DAMPING,
    small_swing,
    small_swing_information,
    swing_down,
)

SMALL = 0.02


def test_a_check_predicts_the_standard_deviations_of_the_closed_form(tmp_path: Path) -> None:
    experiment = swing_down(tmp_path, SMALL)
    task = DesignTask.resolve(experiment)
    assert task.controls == ()
    assert task.initial.ctrl.shape == (150, 0)
    t = task.initial.t
    expected = small_swing(t, SMALL, DAMPING, -CENTRE)
    assert np.abs(task.initial.qpos[:, 0] - expected).max() < 1e-3 * SMALL

    found = mjfim.check(experiment)
    theory = small_swing_information(t[1:], SMALL)
    size = np.sqrt(np.outer(np.diag(theory), np.diag(theory)))
    assert_allclose(found.information / size, theory / size, atol=1e-3)
    predicted = [row.std for row in found.rows]
    assert_allclose(predicted, np.sqrt(np.diag(np.linalg.inv(theory))), rtol=2e-3)
    assert found.self_test.passed
    assert found.source == "the initial state"


def test_a_control_for_no_actuators_is_an_error(tmp_path: Path) -> None:
    experiment = swing_down(tmp_path, initial={"control": {"kind": "sine"}})
    with pytest.raises(ExperimentError, match=r"initial\.control: the model has no actuators"):
        DesignTask.resolve(experiment)
    with pytest.raises(ExperimentError, match="no control to design"):
        mjfim.design(swing_down(tmp_path))
