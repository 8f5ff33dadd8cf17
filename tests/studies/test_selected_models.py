"""Intervals and warnings of a model whose terms were selected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scipy

import mjfim
from mjfim.arrays import Array
from mjfim.experiment.system import System
from mjfim.identification.left_out import HeldOutLosses
from mjfim.model.parameters import ParameterSet
from mjfim.records.terms import Decision, Selection, SelectionStep
from mjfim.studies.selected_models import NOT_WIDENED, different, with_selection
from tests.support.paths import ROOT
from tests.support.results import SLIDE_FRICTION
from tests.support.results import estimate as make_estimate

THETA = np.array([2.0, 1.0, 1.0])


def cart_pendulum() -> mjfim.Experiment:
    """The cart-pendulum, whose parameters are m, l and c."""
    return mjfim.Experiment.from_file(ROOT / "models" / "cart_pendulum.toml")


def made_estimate() -> mjfim.Estimate:
    """An estimate of the three parameters, with intervals of 0.02 to both sides."""
    return make_estimate(
        "identified",
        parameters=("m", "l", "c"),
        theta=THETA,
        interval=THETA[:, None] + np.array([-0.02, 0.02]),
    )


def losses_without(estimates: Array) -> HeldOutLosses:
    """Losses with estimates without each part of the data: (K, 3)."""
    K = len(estimates)
    return HeldOutLosses(
        losses=np.ones(K), counts=np.ones(K), parts=np.arange(K), estimates=estimates
    )


def selection_with(**changes: object) -> Selection:
    """A selection with one step."""
    steps = (SelectionStep(decision=Decision.BEGUN, error=1.0),)
    fields = {"terms": (), "steps": steps, "ending": "No further term.", **changes}
    return Selection(**fields)  # type: ignore[arg-type]


@pytest.mark.parametrize("changes", [{"terms": (SLIDE_FRICTION,)}, {"held": ("c",)}])
def test_intervals_are_widened_to_the_scatter_between_parts(changes: dict[str, object]) -> None:
    # The first parameter scatters, the others are the same without each part.
    estimates = np.tile(THETA, (5, 1))
    estimates[:, 0] += [-0.1, -0.05, 0.0, 0.05, 0.1]
    losses = losses_without(estimates)
    system = System.resolve(cart_pendulum())
    found = with_selection(made_estimate(), selection_with(**changes), losses, system)

    half = scipy.stats.t.ppf(0.975, 4) * np.sqrt(4 / 5 * 0.025)
    np.testing.assert_allclose(found.interval[0], [2.0 - half, 2.0 + half])
    np.testing.assert_array_equal(found.interval[1:], made_estimate().interval[1:])
    assert NOT_WIDENED not in found.warnings

    # What the others assume is said.
    assert ("an error of a held guess is in no interval" in str(found.selection)) == (
        "held" in changes
    )

    # Nothing was chosen with the data where the model stays as it is.
    plain = with_selection(made_estimate(), selection_with(), losses, system)
    np.testing.assert_array_equal(plain.interval, made_estimate().interval)


def test_a_warning_says_that_no_interval_contains_the_choice_of_terms() -> None:
    losses = losses_without(THETA[None])
    system = System.resolve(cart_pendulum())
    found = with_selection(made_estimate(), selection_with(terms=(SLIDE_FRICTION,)), losses, system)
    assert found.warnings[-1] == NOT_WIDENED
    np.testing.assert_array_equal(found.interval, made_estimate().interval)
    assert with_selection(made_estimate(), selection_with(), losses, system).warnings == ()


def test_parameters_of_each_recording_differ_by_nature() -> None:
    parameters = System.resolve(cart_pendulum()).parameters
    other = THETA + 0.05
    interval = other[:, None] + np.array([-0.02, 0.02])
    assert different(made_estimate(), other, interval, parameters) == ("m", "l", "c")

    own = tuple(replace(each, per_recording=each.name == "l") for each in parameters.parameters)
    assert different(made_estimate(), other, interval, ParameterSet(own)) == ("m", "c")


def test_one_of_several_parameters_differs_by_chance_in_a_twentieth_of_the_cases() -> None:
    parameters = System.resolve(cart_pendulum()).parameters
    estimate = made_estimate()
    std = 0.02 / 1.96
    rng = np.random.default_rng(0)
    trials = 1000
    count = 0
    for _ in range(trials):
        # Both estimates have errors.
        other = THETA + np.sqrt(2.0) * std * rng.normal(size=3)
        interval = other[:, None] + np.array([-0.02, 0.02])
        count += bool(different(estimate, other, interval, parameters))
    assert count / trials == pytest.approx(0.05, abs=0.02)
