"""`mjfim.check`: independent numbers, names of null directions, and wrong derivatives that the
self-test must catch.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.excitation.evaluation import evaluate_task
from mjfim.experiment.system import simulate_system
from mjfim.identification.fit_problem import FitProblem
from mjfim.information.fisher import FisherInformation
from mjfim.plant.plant import Derivatives
from mjfim.records.check import SLOPE_TOLERANCE
from mjfim.studies.check import check_recordings, check_task
from tests.support.dense_residuals import dense_residuals
from tests.support.numerics import CART_PARAMETERS, cart_task, make_task, relative_error

PRODUCT = {
    "gear": {"target": "actuator/force:gear[0]"},
    "gain": {"target": "actuator/force:gainprm[0]"},
}
BLOCK = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="block">
      <joint name="x" type="slide" axis="1 0 0" frictionloss="2"/>
      <geom name="block" type="box" size="0.1 0.1 0.1" mass="1" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="x"/></actuator>
</mujoco>
"""


def test_sigmas_are_those_of_evaluate_also_with_priors_and_nuisance(tmp_path) -> None:
    parameters = {
        **CART_PARAMETERS,
        "gain": {"target": "actuator/force:gainprm[0]", "nuisance": True, "prior": 0.1},
    }
    task = cart_task(
        tmp_path, parameters=parameters, nuisance={"initial": 0.02, "bias": {"qpos:hinge": True}}
    )
    found, told = check_task(task), evaluate_task(task, task.initial)
    wanted = [row.std for row in found.rows if not row.nuisance]
    assert_allclose(wanted, told.std[:3], rtol=1e-6)
    relative = [row.relative for row in found.rows]
    assert_allclose(relative[:3], told.std[:3] / [1.5, 0.8, 0.4], rtol=1e-6)
    covariance = np.linalg.inv(found.information)[:3, :3]
    assert_allclose(found.correlation * np.outer(wanted, wanted), covariance, rtol=1e-6)
    assert found.self_test.passed
    assert found.wanted == ("m", "l", "c")
    assert [row.name for row in found.rows if row.nuisance][:2] == ["gain", "initial qpos:slide"]


def test_factors_of_a_product_are_named_with_their_combination(tmp_path) -> None:
    gear = {"gear": {**PRODUCT["gear"], "guess": 4.0}}
    found = check_task(cart_task(tmp_path, parameters=CART_PARAMETERS | PRODUCT | gear))
    assert not found.verdict.ok
    [group] = found.not_separable
    assert set(group.members) == {"gear", "gain"}
    [ratio] = group.combinations
    # d(gear gain) = gain dgear + gear dgain, gear = 4 and gain = 1
    assert ratio.keys() == {"gear", "gain"}
    assert ratio["gain"] / ratio["gear"] == pytest.approx(4.0, rel=1e-6)
    is_known = np.array([row.name not in ratio for row in found.rows])
    assert np.isfinite([row.std for row in found.rows]).tolist() == is_known.tolist()
    assert np.isnan(found.correlation[~is_known]).all()
    assert any("gear" in sentence and "gain" in sentence for sentence in found.findings)


def test_parameters_that_only_this_control_does_not_excite_are_named_as_such(tmp_path) -> None:
    still = {"kind": "constant", "amplitude": 0.0}
    rest = {"qpos": (0.0, 0.0), "qvel": (0.0, 0.0), "control": still}
    found = check_task(cart_task(tmp_path, initial=rest))
    assert not found.not_separable
    assert {name for group in found.not_excited for name in group.members} == {"m", "l", "c"}
    assert not found.verdict.ok
    assert any("another control would show" in sentence for sentence in found.findings)


def test_repetitions_are_the_least_that_reach_the_wanted_sigma(tmp_path) -> None:
    single = {row.name: row.std for row in check_task(cart_task(tmp_path)).rows}
    wanted = {"m": single["m"] / 3.001, "l": 10.0 * single["l"], "c": single["c"] / 1.5}
    parameters = {name: {**CART_PARAMETERS[name], "wanted": std} for name, std in wanted.items()}
    rows = check_task(cart_task(tmp_path, parameters=parameters)).rows
    assert [row.repetitions for row in rows] == [10, 1, 3]
    assert rows[0].seconds == pytest.approx(10 * 0.5)


def test_a_wanted_sigma_below_what_nuisance_allows_is_never_reached(tmp_path) -> None:
    parameters = {
        "m": {**CART_PARAMETERS["m"], "wanted": 1e-4},
        "gravity": {"target": "option:gravity[2]", "nuisance": True, "prior": 0.1},
        **PRODUCT,
    }
    rows = {row.name: row for row in check_task(cart_task(tmp_path, parameters=parameters)).rows}
    assert rows["gear"].repetitions == 0  # only the product shows, however often
    assert rows["m"].repetitions > 1


def test_information_of_recordings_adds_up_without_missing_values(tmp_path) -> None:
    task = cart_task(tmp_path)
    whole = simulate_system(task.system, task.initial, seed=1)
    thinned = np.array(whole.y)
    thinned[::2] = np.nan
    part = replace(whole, y=thinned, name="half")
    two = check_recordings(task.system, [whole, part])
    fit = FitProblem.of(task.system, [whole, part], data_only=True)
    J = dense_residuals(fit, fit.begin(task.theta)).J
    assert relative_error(two.information, J.T @ J) < 1e-6
    alone = check_recordings(task.system, [whole])
    assert relative_error(alone.information, check_task(task).information) < 1e-6
    ratio = np.diag(two.information) / np.diag(alone.information)
    assert 1.3 < ratio.min() <= ratio.max() < 1.7
    assert two.source == "2 recordings"
    assert two.horizon == pytest.approx(2 * alone.horizon)


def test_segments_of_a_recording_have_its_bias_in_common(tmp_path) -> None:
    """A bias that each recording has for itself is as well known as the bias of a single one."""
    stds = []
    for per_recording in (False, True):
        nuisance = {"bias": {"qpos:hinge": 0.05}, "per_recording": per_recording}
        fit = {"segments": 0.1, "start": "measured"}
        task = cart_task(tmp_path, nuisance=nuisance, fit=fit)
        log = simulate_system(task.system, task.initial, seed=1)
        found = check_recordings(task.system, [log])
        stds.append([row.std for row in found.rows[:3]])
        # Finite steps along the whole motion say nothing about segments.
        assert found.steps is None
    assert_allclose(stds[1], stds[0], rtol=1e-6)


def test_dry_friction_says_why_the_derivatives_do_not_agree(tmp_path) -> None:
    parameters = {
        "mass": {"target": "body/block:mass"},
        "friction": {"target": "joint/x:frictionloss"},
    }
    sine = {"kind": "sine", "amplitude": 4.0, "frequency": 1.0}
    task = make_task(
        BLOCK, tmp_path, parameters=parameters, control=sine, noise={"state": 0.01}, horizon=2.0
    )
    tested = check_task(task).self_test
    assert tested.passed and "dry friction of x" in tested.acting
    assert tested.slope > SLOPE_TOLERANCE


def test_wrong_derivatives_are_caught(tmp_path, monkeypatch) -> None:
    """A sensitivity by the recursion, a gradient by the slope."""
    task = cart_task(tmp_path)
    sensitivity, gradient = Derivatives.sensitivity, FisherInformation.gradient

    def wrong_sensitivity(*arguments, **options):
        found = sensitivity(*arguments, **options)
        return replace(found, psi=found.psi * 1.01)

    def wrong_gradient(*arguments):
        return tuple(1.05 * part for part in gradient(*arguments))

    with monkeypatch.context() as patch:
        patch.setattr(Derivatives, "sensitivity", wrong_sensitivity)
        tested = check_task(task).self_test
    assert tested.recursion == pytest.approx(0.01, rel=0.05)
    assert not tested.passed

    monkeypatch.setattr(FisherInformation, "gradient", wrong_gradient)
    tested = check_task(task).self_test
    assert 0.02 < tested.slope < 0.1
    assert not tested.passed
