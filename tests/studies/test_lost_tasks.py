"""Studies on workers that lose tasks: the same results as in one process, to the last digit."""

from __future__ import annotations

import pytest
from numpy.testing import assert_array_equal

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.studies import monte_carlo
from mjfim.studies.check import check_task
from tests.support.cart_pendulum import cart_pendulum
from tests.support.executors import LosingThreads


def test_trials_do_not_depend_on_lost_tasks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two chunks of three trials, with little noise, so that all converge soon."""
    monkeypatch.setattr(monte_carlo, "MIN_CHUNK", 3)
    experiment = cart_pendulum(horizon=0.2, noise={"state": 0.0005})
    initial = DesignTask.resolve(experiment, threads=1).initial
    numbers = {"trials": 6, "seed": 3, "threads": 1}
    alone = mjfim.monte_carlo(experiment, initial, **numbers).sets["final"]
    with LosingThreads() as threads:
        study = mjfim.monte_carlo(experiment, initial, executor=threads, **numbers)
    assert threads.submitted == 3
    assert_array_equal(study.sets["final"].estimates, alone.estimates)
    assert_array_equal(study.sets["final"].covariance, alone.covariance)


def test_random_motions_of_a_check_do_not_depend_on_lost_tasks() -> None:
    """Nothing moves along the initial control; the random motions show everything."""
    still = {"control": {"kind": "constant", "amplitude": 0.0}}
    task = DesignTask.resolve(cart_pendulum(horizon=0.2, initial=still), threads=1)
    alone = check_task(task)
    with LosingThreads() as threads:
        found = check_task(task, executor=threads)
    assert threads.submitted > 3
    assert alone.not_excited and not alone.not_separable
    assert found.findings == alone.findings
