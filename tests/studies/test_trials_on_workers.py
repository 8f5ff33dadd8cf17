"""Trials on workers: their estimates are those of one process, to the last digit."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.parallel.budget import StopToken
from mjfim.records.events import StudyEvent
from mjfim.studies import monte_carlo as studies
from tests.support.cart_pendulum import cart_pendulum
from tests.support.executors import LosingThreads

# Trials of each trajectory, in two chunks.
TRIALS = 6


# A short experiment with little noise, so that all trials converge soon.
SHORT: dict[str, Any] = {"horizon": 0.2, "noise": {"state": 0.0005}}


@pytest.fixture(scope="module")
def experiment() -> mjfim.Experiment:
    """The cart-pendulum for a short time."""
    return cart_pendulum(**SHORT)


@pytest.fixture(scope="module")
def curves(experiment: mjfim.Experiment) -> dict[str, mjfim.Trajectory]:
    """Two trajectories with different controls."""
    task = DesignTask.resolve(experiment, threads=1)
    weaker = task.plant.simulate(task.theta, 0.5 * task.control)
    return {"initial": task.initial, "final": weaker}


@pytest.fixture(autouse=True)
def several_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few trials in a chunk."""
    monkeypatch.setattr(studies, "MIN_CHUNK", 3)


def estimates(
    experiment: mjfim.Experiment, curves: dict[str, mjfim.Trajectory], **options: Any
) -> list[np.ndarray]:
    """Estimates and covariances of both trajectories."""
    study = mjfim.monte_carlo(experiment, curves, trials=TRIALS, seed=3, threads=1, **options)
    return [array for found in study.sets.values() for array in (found.estimates, found.covariance)]


def same(first: list[np.ndarray], second: list[np.ndarray]) -> bool:
    """Whether all numbers are the same to the last digit."""
    return all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_the_estimates_do_not_depend_on_the_executor_nor_on_lost_tasks(
    experiment: mjfim.Experiment, curves: dict[str, mjfim.Trajectory]
) -> None:
    final = {"final": curves["final"]}
    alone = estimates(experiment, final)
    with LosingThreads() as threads:
        assert same(estimates(experiment, final, executor=threads), alone)

    assert threads.submitted == 3


@pytest.mark.slow
def test_a_request_to_stop_keeps_the_trials_of_finished_workers(
    experiment: mjfim.Experiment, curves: dict[str, mjfim.Trajectory]
) -> None:
    token = StopToken()

    def stop_after_the_first_chunk(event: StudyEvent) -> None:
        """Request a stop."""
        token.request()

    with ThreadPoolExecutor(1) as threads:
        study = mjfim.monte_carlo(
            experiment,
            {"final": curves["final"]},
            trials=TRIALS,
            executor=threads,
            callback=stop_after_the_first_chunk,
            stop=token,
        )

    assert 3 <= study.sets["final"].trials <= TRIALS
