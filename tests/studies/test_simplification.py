"""Poorly known parameters are pooled or held where left-out data are predicted as well."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System, simulate_system
from mjfim.model.parameters import ParameterSet
from mjfim.records.terms import Decision, PooledParameter
from mjfim.records.trajectory import Recording
from mjfim.studies.selected_models import possible_pools, selected_experiment, simplified_experiment
from tests.support.cart_pendulum import cart_pendulum
from tests.support.paths import MODELS

JOINTS = ("shoulder", "elbow")


def arm(first: float, second: float) -> mjfim.Experiment:
    """The double pendulum, of which the damping of both joints is unknown."""
    base = mjfim.Experiment.from_file(MODELS / "double_pendulum.toml")
    kept = base.model_dump(include={"model", "rate", "noise"}, exclude_unset=True)
    tables = {
        name: {"target": f"joint/{name}:damping", "guess": guess}
        for name, guess in zip(JOINTS, (first, second), strict=True)
    }
    control = {"kind": "multisine", "amplitude": 1.0, "frequency": 0.5}
    further = {"horizon": 2.0, "initial": {"control": control}, "fit": {"bootstrap": 0}}
    return base.restated({**kept, **further, "parameters": tables})


def recorded(experiment: mjfim.Experiment, count: int) -> list[Recording]:
    """Recordings of the true robot."""
    task = DesignTask.resolve(experiment, threads=1)
    return [simulate_system(task.system, task.initial, seed) for seed in range(count)]


def test_parameters_of_one_field_are_pooled_by_a_factor_on_their_guesses() -> None:
    experiment = arm(0.2, 0.05)
    system = System.resolve(experiment)
    (pool,) = possible_pools(system.parameters, set(JOINTS))
    assert pool.members == JOINTS
    assert pool.scales == (0.2, 0.05)
    assert pool.guess == 1.0

    # The pooled parameter sets both dampings of the model.
    pooled = System.resolve(simplified_experiment(experiment, [pool], ()))
    assert pooled.parameters.names == ("joint_damping",)
    model = pooled.model_at(np.array([3.0]))
    assert_allclose(model.dof_damping[:2], [0.6, 0.15])

    # Equal guesses give one value, and one name alone nothing.
    (same,) = possible_pools(System.resolve(arm(0.1, 0.1)).parameters, set(JOINTS))
    assert same.scales == (1.0, 1.0)
    assert same.guess == pytest.approx(0.1)
    assert possible_pools(system.parameters, {JOINTS[0]}) == []


def test_parameters_are_pooled_within_the_bounds_of_all_members() -> None:
    resolved = System.resolve(arm(0.1, 0.1)).parameters

    def pools(*stated: tuple[float, float, float]) -> list[PooledParameter]:
        """The pools of both dampings with a guess and bounds each."""
        changed = [
            replace(parameter, guess=guess, bounds=(low, high))
            for parameter, (guess, low, high) in zip(resolved.parameters, stated, strict=True)
        ]
        return possible_pools(ParameterSet(tuple(changed)), JOINTS)

    # Guesses of one sign give a factor, which has common bounds, and others a common value.
    (factor,) = pools((0.1, 0.0, 0.2), (0.6, 0.3, 0.9))
    assert factor.bounds == pytest.approx((0.5, 1.5))
    (common,) = pools((0.0, -0.2, 0.2), (0.8, 0.1, 0.9))
    assert common.bounds == (0.1, 0.2)
    assert common.guess == 0.2

    # No value lies within the bounds of both.
    assert pools((0.0, -0.2, 0.2), (0.8, 0.3, 0.9)) == []


def test_held_parameters_are_added_to_those_that_the_user_holds() -> None:
    experiment = arm(0.2, 0.05).replace(fit={"hold": JOINTS[:1]})
    held = simplified_experiment(experiment, (), JOINTS[1:])
    assert held.fit.hold == JOINTS
    assert simplified_experiment(experiment, (), ()) is experiment


CONTROL = {"kind": "multisine", "amplitude": 4.0, "frequency": 0.4, "harmonics": 6}
MOVED = {"horizon": 2.0, "initial": {"control": CONTROL}, "fit": {"bootstrap": 0}}


@pytest.mark.slow
def test_a_selection_holds_what_the_recordings_hardly_determine(tmp_path: Path) -> None:
    """The damping of the hinge is determined; that of a slow slide is not."""
    slide = {"target": "joint/slide:damping", "guess": 0.02, "scale": 0.1}
    experiment = cart_pendulum(**MOVED, parameters={"slide": slide})
    logs = recorded(experiment, 3)
    plain = mjfim.identify(experiment, logs)
    assert "slide" in plain.sloppy
    found = mjfim.select_terms(experiment, logs)
    selection = found.selection
    assert not selection.terms
    assert selection.held == ("slide",)
    assert selection.steps[-1].decision is Decision.HELD
    assert found.theta[found.parameters.index("slide")] == 0.02

    # The selected experiment says the same, and the record is saved.
    again = selected_experiment(experiment, selection)
    assert again.fit.hold == ("slide",)
    assert_allclose(mjfim.identify(again, logs).theta, found.theta, rtol=1e-3)
    found.save(tmp_path)
    assert mjfim.Estimate.load(tmp_path).selection == selection


@pytest.mark.slow
def test_the_selected_model_is_fitted_to_held_out_recordings() -> None:
    stated = cart_pendulum(**MOVED)
    friction = {"f": {"target": "joint/slide:frictionloss", "guess": 0.6, "scale": 1.0}}
    robot = stated.replace(parameters=friction)
    *logs, kept = recorded(robot, 3)
    found = mjfim.select_terms(stated, logs, held_out=[kept])
    theta, interval, differs = found.selection.refit
    assert differs == ()
    assert theta.shape == found.theta.shape
    assert (interval[:, 0] < interval[:, 1]).all()

    # Held-out recordings of another robot contradict the others, and widen the intervals.
    heavier = robot.replace(parameters={"m": {"true": 2.6}})
    task = DesignTask.resolve(heavier.replace(cost={"linearize_at": "true"}), threads=1)
    other = simulate_system(task.system, task.initial, 9)
    odd = mjfim.select_terms(stated, logs, held_out=[other])
    assert "m" in odd.selection.refit[2]
    j = odd.parameters.index("m")
    assert odd.interval[j, 1] > found.interval[j, 1] + 0.1
