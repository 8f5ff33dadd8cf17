"""Warnings, errors and starts of designs."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.errors import ExperimentError, ModelError, UnidentifiableError
from mjfim.excitation.design import design_task
from mjfim.excitation.evaluation import evaluate_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.records.design import Status, keeps_limits
from tests.support.cart_pendulum import cart_pendulum
from tests.support.numerics import CART_PARAMETERS, cart_task
from tests.support.paths import MODELS


@pytest.fixture(scope="module")
def experiment() -> Experiment:
    return cart_pendulum()


@pytest.fixture(scope="module")
def short(experiment: Experiment) -> Experiment:
    """A short horizon and a loose tolerance."""
    return experiment.replace(horizon=1.0, descent={"tolerance": 0.1}, rehearsal={"robots": 4})


@pytest.fixture(scope="module")
def design_of_short(short: Experiment) -> mjfim.Design:
    """The design of the short experiment."""
    return mjfim.design(short)


def test_scale_does_not_change_the_predicted_deviation(experiment: Experiment) -> None:
    stds = []
    for scale in ("guess", 1e4):
        tables = {name: {"scale": scale} for name in "mlc"}
        task = DesignTask.resolve(experiment.replace(parameters=tables))
        stds.append(evaluate_task(task, task.initial).std)
    assert_allclose(stds[0], stds[1], rtol=1e-9)


MOTOR = '<motor name="force" joint="slide"'


def altered(folder: Path, experiment: Experiment, attributes: str) -> Experiment:
    """The cart-pendulum with further attributes of its motor."""
    text = (MODELS / "cart_pendulum.xml").read_text()
    assert MOTOR in text
    (folder / "cart_pendulum.xml").write_text(text.replace(MOTOR, f"{MOTOR} {attributes}"))
    shutil.copy(MODELS / "cart_pendulum.csv", folder)
    return Experiment(**experiment.model_dump(exclude_unset=True), directory=folder)


def test_actuator_delays_are_refused(experiment: Experiment, tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="delays"):
        DesignTask.resolve(altered(tmp_path, experiment, 'delay="0.05" nsample="8"'))


def test_saturation_is_reported(
    short: Experiment, design_of_short: mjfim.Design, tmp_path: Path
) -> None:
    """Enforced limits keep a design off the clamp: it acts only where they are not enforced."""
    limits = {"control": {"force": [-1.0, 1.0]}, "enforce": False}
    checked = short.replace(descent={"max_iterations": 8}, limits=limits)
    weak = altered(tmp_path, checked, 'forcelimited="true" forcerange="-1.5 1.5"')
    design = mjfim.design(weak)
    assert design.limits["control"] < 0.0 and not keeps_limits(design)
    for words in ("forcerange clamps force", "control limits are exceeded"):
        assert any(words in sentence for sentence in design.warnings)
        assert not any(words in sentence for sentence in design_of_short.warnings)


def test_a_given_initial_control_is_checked_and_is_the_start(
    experiment: Experiment, short: Experiment
) -> None:
    with pytest.raises(ExperimentError, match=r"\(400, 1\)"):
        mjfim.design(experiment, initial_control=np.zeros(400))
    with pytest.raises(UnidentifiableError, match="does not excite"):
        mjfim.design(experiment, initial_control=np.zeros((400, 1)))
    given = np.sin(0.05 * np.arange(100))[:, None]
    design = mjfim.design(short.replace(descent={"max_iterations": 0}), initial_control=given)
    assert design.found_by == "given control"
    assert_allclose(design.trajectory.ctrl, given, atol=1e-12)


@pytest.mark.slow
def test_callback_sees_levels_and_growing_numbers(experiment: Experiment) -> None:
    rows = []
    loose = experiment.replace(descent={"tolerance": 0.1}, rehearsal={"robots": 4})
    design = mjfim.design(loose, callback=lambda event: rows.append(event.row))
    assert [row.iteration for row in rows] == list(range(len(rows)))
    assert [row.rate for row in rows] == sorted(row.rate for row in rows)
    assert {row.rate for row in rows} == {12.5, 100.0}
    assert rows[-1].steps <= design.steps


@pytest.mark.slow
def test_the_criterion_becomes_smooth_where_the_smallest_eigenvalues_meet(tmp_path: Path) -> None:
    task = cart_task(tmp_path, horizon=1.0, cost={"control": 1e-4})
    made = design_task(task)
    assert made.status is Status.SMOOTHED
    assert made.status.success and keeps_limits(made)
    first, second = made.final.eigenvalues[:2]
    assert second < 1.2 * first
    # the reported cost is that of the exact criterion, the best of all iterates
    assert made.final.criterion == pytest.approx(1.0 / first, rel=1e-9)
    running = task.problem.running.value(made.trajectory)
    assert made.final.cost == pytest.approx(1.0 / first + running, rel=1e-9)
    fine = [row.cost for row in made.history if row.rate == 100.0]
    assert made.final.cost == pytest.approx(min(fine), rel=1e-12)


@pytest.mark.slow
def test_a_design_that_knows_its_nuisance_parameters_beats_one_that_does_not(
    tmp_path: Path,
) -> None:
    shared = {"horizon": 1.0, "cost": {"control": 1e-3}}
    unsure = cart_task(tmp_path, **shared, nuisance={"initial": True, "bias": 0.2})
    aware, naive = design_task(unsure), design_task(cart_task(tmp_path, **shared))
    assert naive.nuisance == ()
    assert aware.nuisance[0] == "initial qpos:slide"
    assert len(aware.nuisance) == 8
    assert aware.final.eigenvalues.shape == (3,)
    there = evaluate_task(unsure, naive.trajectory)
    assert aware.final.cost < 0.95 * there.cost
    # The criterion uses the block of the full inverse that belongs to the wanted parameters.
    theta = unsure.theta[:3]
    block = np.linalg.inv(aware.final.information)[:3, :3] / np.outer(theta, theta)
    seen = np.sort(1.0 / np.linalg.eigvalsh(block)) / unsure.system.measure_rate
    assert_allclose(aware.final.eigenvalues, seen, rtol=1e-6)


@pytest.mark.slow
def test_a_design_for_one_combination_determines_it_better_than_one_for_all(tmp_path: Path) -> None:
    wanted = {"criterion": "c", "combination": {"m": 1.0, "l": -1.0}, "control": 1e-3}
    task = cart_task(tmp_path, horizon=1.0, cost=wanted)
    made, general = design_task(task), design_task(cart_task(tmp_path, horizon=1.0))
    assert made.final.cost < 0.9 * evaluate_task(task, general.trajectory).cost
    c = np.array([1.0, -1.0, 0.0])
    variance = c @ np.linalg.inv(made.final.information) @ c
    assert made.final.criterion == pytest.approx(variance * task.system.measure_rate, rel=1e-9)


RATED = {"state": 0.05, "qpos:hinge": {"sigma": 0.01, "rate": 20.0}}
LEVELS = {
    "plain": {},
    "sensors at their own rates": {"noise": RATED},
    "nuisances": {"nuisance": {"initial": 0.1, "bias": 0.05, "delay": 0.01}},
    "priors": {
        "parameters": {name: {**target, "prior": 0.01} for name, target in CART_PARAMETERS.items()}
    },
    "slow": {"measure_rate": 20.0, "noise": {"state": 0.05}},
}


@pytest.mark.parametrize("case", LEVELS)
def test_a_coarser_level_costs_about_the_same(case: str, tmp_path: Path) -> None:
    task = cart_task(tmp_path, horizon=4.0, **LEVELS[case])
    fine, coarse = (s.problem.point(s.initial) for s in (task, task.coarser(4)))
    assert coarse.criterion.value == pytest.approx(fine.criterion.value, rel=0.03)
    assert coarse.cost == pytest.approx(fine.cost, rel=0.03)


def test_the_choice_of_a_group_needs_no_error_where_members_are_invisible(tmp_path: Path) -> None:
    parameters = {"bob": {"inertial": "bob", "coordinates": "barycentric"}}
    made = design_task(cart_task(tmp_path, parameters=parameters, descent={"max_iterations": 3}))
    # a planar pendulum reveals its mass, two first moments and the inertia about the hinge
    assert made.combinations[-1].endswith("no effect on any measured output")
    assert len(made.final.eigenvalues) < 10
    assert np.isinf(made.final.std).sum() >= 10 - len(made.final.eigenvalues)
    assert made.final.cost < made.initial.cost


def test_a_coarse_factor_that_does_not_divide_the_samples_is_refused(tmp_path: Path) -> None:
    """The default factor is left out without an error."""
    tables = {"horizon": 4.06, "descent": {"max_iterations": 1}}
    design_task(cart_task(tmp_path, **tables))
    tables["descent"]["coarse"] = 4
    message = r"descent\.coarse: 4 divides neither the .* nor the 406 samples; .*: 1, 2, 7, 14$"
    with pytest.raises(ExperimentError, match=message):
        design_task(cart_task(tmp_path, **tables))
