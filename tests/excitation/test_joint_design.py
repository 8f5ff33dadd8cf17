"""Joint designs: never worse than separate ones, and they identify more than one experiment."""

from __future__ import annotations

import numpy as np
import pytest

import mjfim
from mjfim.errors import ExperimentError, UnidentifiableError
from mjfim.excitation.design import design_task
from mjfim.excitation.prior_information import EarlierExperiments
from mjfim.excitation.task import DesignTask
from tests.support.numerics import CART_PARAMETERS, cart_task, relative_error

NEAR = {
    "qpos": (0.0, 3.0),
    "qvel": (0.0, 0.0),
    "control": {"kind": "sine", "amplitude": 2.0, "frequency": 0.6},
}
FAR = {
    "qpos": (0.2, 1.5),
    "qvel": (0.3, 0.0),
    "control": {"kind": "sine", "amplitude": 3.0, "frequency": 1.1},
}


def pair(folder, **tables) -> list[mjfim.Experiment]:
    """Two experiments with the cart-pendulum from different initial states, with few iterations."""
    common = {"descent": {"max_iterations": 4}, **tables}
    return [cart_task(folder, initial=start, **common).experiment for start in (NEAR, FAR)]


def data_information(design: mjfim.Design) -> np.ndarray:
    """Information of the data of a design, without its prior."""
    return design.final.information - design.prior


@pytest.mark.slow
def test_the_sum_is_at_least_as_good_as_that_of_separate_designs(tmp_path) -> None:
    """Each design holds the information of all."""
    experiments = pair(tmp_path)
    task = DesignTask.resolve(experiments[0])
    together = mjfim.design_jointly(experiments, rounds=2)
    apart = [mjfim.design(e) for e in experiments]
    phi = [
        task.information.evaluate(sum(data_information(d) for d in designs)).value
        for designs in (together, apart)
    ]
    assert phi[0] <= 1.0001 * phi[1]
    first, second = together
    both = data_information(first) + data_information(second)
    assert relative_error(second.final.information, both) < 1e-6
    assert relative_error(second.prior, data_information(first)) < 1e-6


def test_one_experiment_may_reveal_what_another_cannot(tmp_path) -> None:
    still = {"qpos": (0.0, 0.0), "control": {"kind": "constant", "amplitude": 0.0}}
    blind, seeing = cart_task(tmp_path, initial=still), cart_task(tmp_path, initial=FAR)
    with pytest.raises(UnidentifiableError):
        design_task(blind)
    information = seeing.problem.point(seeing.initial).information
    helped = design_task(
        DesignTask.resolve(
            blind.experiment.replace(descent={"max_iterations": 2}),
            added=EarlierExperiments(information=information),
        )
    )
    assert np.isfinite(helped.final.std).all()


@pytest.mark.slow
def test_nuisance_of_one_experiment_is_not_that_of_the_other(tmp_path) -> None:
    experiments = pair(tmp_path, nuisance={"initial": 0.05})
    together = mjfim.design_jointly(experiments, rounds=1)
    j = together[1].parameters.index("initial qpos:slide")
    assert not together[1].prior[j, :3].any()
    assert together[1].prior[j, j] == pytest.approx(0.05**-2)  # its prior only


def test_other_parameters_are_refused(tmp_path) -> None:
    one = cart_task(tmp_path).experiment
    other = cart_task(tmp_path, parameters={"m": CART_PARAMETERS["m"]}).experiment
    with pytest.raises(ExperimentError, match="same parameters"):
        mjfim.design_jointly([one, other])
    with pytest.raises(ExperimentError, match="two or more"):
        mjfim.design_jointly([one])
