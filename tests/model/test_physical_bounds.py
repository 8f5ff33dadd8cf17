"""Bounds that physics sets to parameters."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mjfim.errors import ExperimentError
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.model.parameters import ParameterSet
from tests.support.paths import MODELS


def parameters(**specs: dict[str, Any]) -> ParameterSet:
    """Parameters of the cart-pendulum."""
    experiment = Experiment(
        model="cart_pendulum.xml",
        rate=100.0,
        parameters=specs,
        noise={"state": 0.1},
        directory=MODELS,
    )
    return System.resolve(experiment).parameters


def test_numbers_that_cannot_be_negative_have_a_bound_and_others_have_none() -> None:
    found = parameters(
        damping={"target": "joint/hinge:damping"},
        armature={"target": "joint/slide:armature", "scale": 1.0},
        friction={"target": "joint/slide:frictionloss", "scale": 1.0},
        stiffness={"target": "joint/slide:stiffness", "scale": 1.0},
        place={"target": "body/bob:pos[2]"},
    )
    assert found.lower.tolist() == [0.0, 0.0, 0.0, 0.0, -np.inf]
    assert found.upper.tolist() == [np.inf] * 5


def test_scale_and_offset_move_and_turn_the_bound() -> None:
    found = parameters(
        load={
            "targets": [{"path": "joint/slide:damping", "offset": 2.0}],
            "guess": 0.0,
            "scale": 1.0,
        },
        turned={"targets": [{"path": "joint/hinge:damping", "scale": -2.0, "offset": 6.0}]},
    )
    assert found.lower.tolist() == [-2.0, -np.inf]
    assert found.upper.tolist() == [np.inf, 3.0]


@pytest.mark.parametrize("key", ["guess", "true"])
def test_a_value_outside_is_an_error_unless_bounds_contain_it(key: str) -> None:
    spec = {"target": "joint/hinge:damping", key: -0.5}
    with pytest.raises(ExperimentError, match=rf"parameters\.c\.{key}: -0\.5 makes .* negative"):
        parameters(c=spec)
    assert parameters(c={**spec, "bounds": [-1.0, 5.0]}).lower[0] == -1.0
