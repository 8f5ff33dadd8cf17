"""Fits on workers: costs, linearisations and estimates of one process, to the last digit."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.experiment.system import System
from mjfim.identification import (
    left_out,
    segment_simulation,
)
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.fit_workers import FitWorkers
from mjfim.identification.identify import least_squares
from mjfim.identification.search import FitTask
from mjfim.optimize.levenberg_marquardt import SearchSettings, UnknownValues
from mjfim.parallel.budget import Budget, StopToken
from tests.support.cart_pendulum import cart_pendulum, logs_of
from tests.support.closed_loop import arm_experiment
from tests.support.executors import LosingThreads

# Settings of fits: whole recordings, and segments whose initial states are unknown.
WHOLE: dict[str, Any] = {"starts": 2}
SEGMENTS: dict[str, Any] = {"starts": 2, "segments": 0.25, "start": "measured"}


@pytest.fixture(scope="module")
def experiment() -> mjfim.Experiment:
    """The cart-pendulum for a short time."""
    return cart_pendulum(horizon=0.5)


@pytest.fixture(scope="module")
def recordings(experiment: mjfim.Experiment) -> list[mjfim.Recording]:
    """Three recordings that differ by their noise."""
    return logs_of(experiment, 0, 1, 2)


@pytest.fixture(autouse=True)
def several_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few segments in a batch, as with much data."""
    monkeypatch.setattr(segment_simulation, "MAX_NUMBERS_AT_ONCE", 2000)


def problem_of(
    experiment: mjfim.Experiment, recordings: Sequence[mjfim.Recording], fit: dict[str, Any]
) -> FitProblem:
    """The problem of a fit."""
    return FitTask.of(System.resolve(experiment.replace(fit=fit), threads=1), recordings).problem()


def closed_loop(fit: dict[str, Any]) -> FitProblem:
    """A fit to logs of the two-joint arm, whose laws have an integral and a late command."""
    law = {"kp": 50.0, "kd": 3.0, "ki": 20.0, "rate": 250.0}
    late = {"target": "controller/elbow:latency", "true": 0.006, "guess": 0.003}
    laws = {"shoulder": {**law, "time_constant": 0.01}, "elbow": {"kp": 25.0, "kd": 1.0}}
    arm = arm_experiment(laws, parameters={"latency": late}, noise={"state": 1e-3})
    references = 0.3 * np.sin(0.02 * np.arange(200))[:, None] * [1.0, -1.0]
    return problem_of(arm, [mjfim.simulate(arm, references, seed) for seed in range(3)], fit)


@pytest.mark.parametrize("in_closed_loop", [False, True])
@pytest.mark.parametrize("fit", [WHOLE, SEGMENTS], ids=["whole", "segments"])
def test_cost_and_linearisation_are_the_same_although_tasks_are_lost(
    experiment: mjfim.Experiment,
    recordings: list[mjfim.Recording],
    fit: dict[str, Any],
    in_closed_loop: bool,
) -> None:
    problem = closed_loop(fit) if in_closed_loop else problem_of(experiment, recordings, fit)
    plant = problem.system.plant
    at = problem.begin(problem.system.parameters.guess)
    begin = plant.engine_steps
    cost, condensed = problem.cost(at), problem.condense(at)
    alone = plant.engine_steps

    with LosingThreads() as threads:
        divided = replace(problem, workers=FitWorkers(threads))
        assert divided.cost(at) == cost
        assert np.array_equal(divided.condense(at).blocks, condensed.blocks)
    assert threads.submitted > 4

    # The steps of workers count as those of this process.
    assert plant.engine_steps - alone == alone - begin


def test_a_fit_that_diverges_on_workers_has_no_cost(
    experiment: mjfim.Experiment, recordings: list[mjfim.Recording]
) -> None:
    problem = problem_of(experiment, recordings, WHOLE)
    at = problem.begin(np.array([1e-3, 1e-3, -1e6]))
    with LosingThreads() as threads:
        divided = replace(problem, workers=FitWorkers(threads))
        assert problem.cost(at) == divided.cost(at) == np.inf
        assert divided.condense(at) is None


def test_a_request_to_stop_ends_waiting_works_and_later_passes_are_done_here(
    experiment: mjfim.Experiment,
    recordings: list[mjfim.Recording],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Threads, which lose no task, ask for a stop when the first task is submitted."""
    problem = problem_of(experiment, recordings, SEGMENTS)
    at = problem.begin(problem.system.parameters.guess)
    stop = StopToken()
    with ThreadPoolExecutor(1) as threads:
        submit = threads.submit

        def stopping(*work: Any) -> Future[Any]:
            """Ask for a stop, and submit as always."""
            stop.request()
            return submit(*work)

        monkeypatch.setattr(threads, "submit", stopping)
        divided = replace(problem, workers=FitWorkers(threads))
        works = [partial(cost_at, at=at)] * 4
        assert len(list(divided.of_whole(works, Budget(stop=stop)))) < 4
        assert divided.cost(at) == problem.cost(at)


def cost_at(problem: FitProblem, budget: Budget, *, at: UnknownValues) -> float:
    """Cost of a problem, which a worker may compute."""
    return problem.cost(at)


@pytest.mark.parametrize("samples", [10**6, 100], ids=["folds", "folds of a subset"])
def test_each_part_is_predicted_from_the_others_as_in_one_process(
    experiment: mjfim.Experiment,
    recordings: list[mjfim.Recording],
    monkeypatch: pytest.MonkeyPatch,
    samples: int,
) -> None:
    monkeypatch.setattr(left_out, "MAX_SAMPLES", samples)
    problem = problem_of(experiment, recordings, WHOLE)
    guess, few = problem.system.parameters.guess, SearchSettings(max_iterations=2)
    solution = least_squares(problem, guess, few)
    steps, found = [problem.system.plant.engine_steps], []
    with LosingThreads() as threads:
        for used in (problem, replace(problem, workers=FitWorkers(threads))):
            found.append(left_out.predict_unfitted(used, solution, None, Budget()))
            steps.append(problem.system.plant.engine_steps)

    assert len(found[0]) == (3 if samples > 100 else 2)
    for here, there in zip(*found, strict=True):
        assert here.name == there.name
        assert np.array_equal(here.identified.rms, there.identified.rms)
        assert np.array_equal(here.nominal.mae, there.nominal.mae)
    assert np.ptp(np.diff(steps)) == 0

    # The fit to all recordings has other errors.
    predicted, *_ = problem.predict(solution.unknowns)
    fitted = np.sqrt(np.mean((predicted - recordings[0].y)[1:] ** 2, axis=0))
    assert not np.isclose(found[0][0].identified.rms, fitted, rtol=1e-6).any()
