"""When a design knows each parameter: targets, times, and the sentence about them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.excitation.design import design_task
from mjfim.output.words import when_learnt
from mjfim.records.design import round_share
from tests.support import results
from tests.support.made_records import make_design, make_labels
from tests.support.numerics import CART_PARAMETERS, cart_task

WANTED = replace(make_labels(2, 3), wanted=np.array([0.12, 0.09, np.inf]))


def test_the_last_row_is_the_stated_accuracy(tmp_path) -> None:
    """With priors and a nuisance parameter; the first row is what the priors say."""
    prior = {name: {**table, "prior": 0.5} for name, table in CART_PARAMETERS.items()}
    prior["c"]["nuisance"] = True
    task = cart_task(tmp_path, parameters=prior, descent={"max_iterations": 1, "starts": 1})
    design = design_task(task)
    assert_allclose(design.std_over_time[-1], design.stated_std, rtol=1e-9)
    assert_allclose(design.final.std_over_time[-1], design.final.std, rtol=1e-9)
    assert_allclose(design.final.std_over_time[0], 0.5, rtol=1e-9)


def test_finite_steps_scale_the_whole_curve() -> None:
    design = results.design()
    steps = replace(results.rehearsal().steps, std=2.0 * design.final.std)
    odd = replace(design, rehearsal=replace(results.rehearsal(), steps=steps))
    assert_allclose(odd.std_over_time[-1], odd.stated_std)
    ratio = odd.stated_std / design.final.std
    assert_allclose(odd.std_over_time[1:], design.final.std_over_time[1:] * ratio)


def test_times_are_those_of_a_plain_loop() -> None:
    design = replace(make_design(), labels=WANTED)
    assert design.targets.tolist() == WANTED.wanted.tolist()
    t, expected = design.trajectory.t, {}
    for j, name in enumerate(design.parameters[:2]):
        k = 0
        while not design.final.std_over_time[k, j] <= WANTED.wanted[j]:
            k += 1
        expected[name] = {"std": WANTED.wanted[j], "seconds": pytest.approx(t[k] - t[0])}
    assert design.summary()["reached"] == expected
    assert np.isinf(design.seconds_to(0.01 * design.targets)[:2]).all()


@pytest.mark.parametrize(
    ("share", "rounded"), [(0.006, 0.01), (0.01, 0.01), (0.011, 0.02), (0.3, 0.5), (0.7, 1.0)]
)
def test_without_wanted_accuracies_the_target_is_round(share: float, rounded: float) -> None:
    assert round_share(share) == pytest.approx(rounded)
    design = make_design()
    design = replace(design, final=replace(design.final, std=share * design.sizes))
    assert_allclose(design.targets, rounded * design.sizes)
    ignored = replace(design, nuisance=design.parameters[:1])
    assert np.isinf(ignored.targets).tolist() == [True, False, False]


def test_a_sentence_says_when_each_parameter_is_known() -> None:
    design = replace(make_design(), labels=WANTED)
    first, second = design.seconds_to(design.targets)[:2].tolist()
    end = max(first, second)
    sentence = when_learnt(design)
    assert sentence.startswith(f"Every wanted σ is reached after {end:.3g} s (")
    assert f"the last {2.0 - end:.3g} s are not needed for it." in sentence
    hard = replace(WANTED, wanted=np.array([1e-9, 0.09, np.inf]))
    missed = f"does not reach the wanted σ for {design.parameters[0]}."
    assert when_learnt(replace(design, labels=hard)).endswith(missed)


def test_a_sentence_says_how_long_the_initial_motion_tells_more() -> None:
    design = make_design()
    late = np.array(design.final.std_over_time)
    late[:30] = np.inf
    slow = replace(design, final=replace(design.final, std_over_time=late))
    assert "Until 1.2 s the initial motion tells more." in when_learnt(slow)
    assert "initial" not in when_learnt(design)
    assert when_learnt(design).startswith("Every parameter reaches a σ of 10 % after ")
