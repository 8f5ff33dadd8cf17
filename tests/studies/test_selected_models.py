"""Intervals and warnings of a model whose terms were selected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy
from numpy.testing import assert_allclose, assert_array_equal

import mjfim
from mjfim.arrays import Array
from mjfim.experiment.system import System
from mjfim.identification.left_out import HeldOutLosses
from mjfim.model.parameters import ParameterSet
from mjfim.records.terms import Decision, Selection, SelectionStep
from mjfim.studies.selected_models import NOT_WIDENED, different, with_selection
from tests.support.cart_pendulum import cart_pendulum
from tests.support.results import SLIDE_FRICTION
from tests.support.results import estimate as make_estimate

THETA = np.array([2.0, 1.0, 1.0])


SYSTEM = System.resolve(cart_pendulum())


def made_estimate() -> mjfim.Estimate:
    """An estimate of the three parameters, with intervals of 0.02 to both sides."""
    return make_estimate(
        "identified", parameters=("m", "l", "c"), theta=THETA, interval=around(THETA)
    )


def around(theta: Array) -> Array:
    """Intervals of 0.02 to both sides."""
    return theta[:, None] + np.array([-0.02, 0.02])


def selected(estimates: Array, **changes: object) -> mjfim.Estimate:
    """An estimate after a selection with one step.

    Args:
        estimates: (K, 3) estimates without each part of the data.
        **changes: Fields of the selection.
    """
    ones = np.ones(len(estimates))
    losses = HeldOutLosses(
        losses=ones, counts=ones, parts=np.arange(len(estimates)), estimates=estimates
    )
    steps = (SelectionStep(decision=Decision.BEGUN, error=1.0),)
    fields = {"terms": (), "steps": steps, "ending": "No further term.", **changes}
    return with_selection(made_estimate(), Selection(**fields), losses, SYSTEM)


@pytest.mark.parametrize("changes", [{"terms": (SLIDE_FRICTION,)}, {"held": ("c",)}])
def test_intervals_are_widened_to_the_scatter_between_parts(changes: dict[str, object]) -> None:
    # The first parameter scatters, the others are the same without each part.
    estimates = np.tile(THETA, (5, 1))
    estimates[:, 0] += [-0.1, -0.05, 0.0, 0.05, 0.1]
    found = selected(estimates, **changes)
    half = scipy.stats.t.ppf(0.975, 4) * np.sqrt(4 / 5 * 0.025)
    assert_allclose(found.interval[0], [2.0 - half, 2.0 + half])
    assert_array_equal(found.interval[1:], around(THETA)[1:])
    assert NOT_WIDENED not in found.warnings

    # What the others assume is said.
    assumes = "an error of a held guess is in no interval" in str(found.selection)
    assert assumes == ("held" in changes)

    # Nothing was chosen with the data where the model stays as it is.
    assert_array_equal(selected(estimates).interval, around(THETA))


def test_a_warning_says_that_no_interval_contains_the_choice_of_terms() -> None:
    found = selected(THETA[None], terms=(SLIDE_FRICTION,))
    assert found.warnings[-1] == NOT_WIDENED
    assert_array_equal(found.interval, around(THETA))
    assert selected(THETA[None]).warnings == ()


def test_parameters_of_each_recording_differ_by_nature() -> None:
    parameters, other = SYSTEM.parameters, THETA + 0.05
    assert different(made_estimate(), other, around(other), parameters) == ("m", "l", "c")
    own = tuple(replace(each, per_recording=each.name == "l") for each in parameters.parameters)
    assert different(made_estimate(), other, around(other), ParameterSet(own)) == ("m", "c")


def test_one_of_several_parameters_differs_by_chance_in_a_twentieth_of_the_cases() -> None:
    """Both estimates have errors."""
    errors = np.sqrt(2.0) * 0.02 / 1.96 * np.random.default_rng(0).normal(size=(1000, 3))
    others = THETA + errors
    found = [different(made_estimate(), each, around(each), SYSTEM.parameters) for each in others]
    assert np.mean([bool(names) for names in found]) == pytest.approx(0.05, abs=0.02)
