"""Fits on workers: costs, linearisations and estimates of one process, to the last digit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any
from unittest import mock

import numpy as np
import pytest

import mjfim
from mjfim.budget import Budget, StopToken
from mjfim.excitation.task import DesignTask
from mjfim.experiment.simulate import simulate_system
from mjfim.identification import (
    cross_validation,
    fit_workers,
    left_out_parts,
    segment_simulation,
    subsets,
)
from mjfim.identification.fit_orders import BatchOrder
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.fit_workers import FitWorkers
from mjfim.identification.identify import least_squares
from mjfim.identification.task import FitTask
from mjfim.optimize.levenberg_marquardt import SearchSettings, minimise
from mjfim.parallel import dispatch
from tests.support.executors import LosingExecutor, LosingThreads, move_to, processes
from tests.support.paths import MODELS

# Settings of fits: whole recordings, and segments whose initial states are unknown.
WHOLE: dict[str, Any] = {"starts": 2}
SEGMENTS: dict[str, Any] = {"starts": 2, "segments": 0.25, "start": "measured"}


@pytest.fixture(scope="module")
def experiment() -> mjfim.Experiment:
    """The cart-pendulum for a short time."""
    return mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml").replace(horizon=0.5)


@pytest.fixture(scope="module")
def recordings(experiment: mjfim.Experiment) -> list[mjfim.Recording]:
    """Three recordings that differ by their noise."""
    task = DesignTask.resolve(experiment, threads=1)
    return [simulate_system(task.system, task.initial, seed) for seed in range(3)]


@pytest.fixture(autouse=True)
def several_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few segments in a batch, as with much data."""
    monkeypatch.setattr(segment_simulation, "MAX_NUMBERS_AT_ONCE", 2000)


def problem_of(
    experiment: mjfim.Experiment, recordings: Sequence[mjfim.Recording], fit: dict[str, Any]
) -> FitProblem:
    """The problem of a fit."""
    return FitTask.resolve(experiment.replace(fit=fit), recordings, threads=1).problem()


@pytest.mark.parametrize("fit", [WHOLE, SEGMENTS], ids=["whole", "segments"])
def test_cost_and_linearisation_are_the_same_although_tasks_are_lost(
    experiment: mjfim.Experiment, recordings: list[mjfim.Recording], fit: dict[str, Any]
) -> None:
    problem = problem_of(experiment, recordings, fit)
    plant = problem.system.plant
    at = problem.begin(problem.system.parameters.guess)
    begin = plant.engine_steps
    cost, condensed = problem.cost(at), problem.condense(at)
    alone = plant.engine_steps

    with LosingThreads() as threads:
        divided = problem.on_workers(FitWorkers(threads))
        divided_cost, found = divided.cost(at), divided.condense(at)

    assert threads.submitted > 4
    assert divided_cost == cost
    assert condensed is not None
    assert found is not None
    assert np.array_equal(found.blocks, condensed.blocks)

    # The steps of workers count as those of this process.
    assert plant.engine_steps - alone == alone - begin


def test_a_fit_that_diverges_on_workers_has_no_cost(
    experiment: mjfim.Experiment, recordings: list[mjfim.Recording]
) -> None:
    problem = problem_of(experiment, recordings, WHOLE)
    at = problem.begin(np.array([1e-3, 1e-3, -1e6]))
    assert problem.cost(at) == np.inf

    with LosingThreads() as threads:
        divided = problem.on_workers(FitWorkers(threads))

        assert divided.cost(at) == np.inf
        assert divided.condense(at) is None


class StoppingThreads(ThreadPoolExecutor):
    """Threads that ask for a stop when some number of tasks was submitted, and lose no task."""

    def __init__(self, stop: StopToken, after: int) -> None:
        super().__init__(1)
        self._stop = stop
        self._left = after

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        self._left -= 1
        if self._left == 0:
            self._stop.request()
        return super().submit(fn, *args, **kwargs)


class HangingThreads(ThreadPoolExecutor):
    """Threads that take tasks and do nothing; they count the tasks."""

    count = 0

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.count += 1
        return Future()


@pytest.fixture
def in_small_batches(
    experiment: mjfim.Experiment,
    recordings: list[mjfim.Recording],
    monkeypatch: pytest.MonkeyPatch,
) -> FitProblem:
    """A problem with many batches, each of which is a task."""
    monkeypatch.setattr(segment_simulation, "STEPS_OF_BATCH", 25)
    return problem_of(experiment, recordings, SEGMENTS)


def test_workers_that_hang_after_a_request_to_stop_are_waited_for_once(
    in_small_batches: FitProblem, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = in_small_batches
    monkeypatch.setattr(fit_workers, "GRACE", 0.01)
    monkeypatch.setattr(dispatch, "GRACE", 0.01)
    monkeypatch.setattr(dispatch, "POLL_INTERVAL", 0.01)
    begin = problem.begin(problem.system.parameters.guess)
    stop = StopToken()
    stop.request()
    with HangingThreads(1) as threads:
        divided = problem.on_workers(FitWorkers(threads, stop))
        costs = [divided.cost(begin)]
        submitted = threads.count
        costs += [divided.cost(begin) for _ in range(3)]
        assert threads.count == submitted > 0
    assert costs == [problem.cost(begin)] * 4


def test_workers_that_lose_one_task_after_a_request_to_stop_do_the_next_ones(
    in_small_batches: FitProblem,
) -> None:
    problem = in_small_batches
    begin = problem.begin(problem.system.parameters.guess)
    stop = StopToken()
    stop.request()
    lost: list[Any] = []

    def is_first(order: Any, count: int) -> bool:
        """Lose the first order, however often it is submitted."""
        if not lost:
            lost.append(order)
        return order is lost[0]

    executor = LosingExecutor(is_first)
    divided = problem.on_workers(FitWorkers(executor, stop))
    costs = [divided.cost(begin)]
    submitted = executor.count
    costs.append(divided.cost(begin))
    assert executor.count > submitted > 2
    assert costs == [problem.cost(begin)] * 2


def stopped_fit(
    experiment: mjfim.Experiment, recordings: list[mjfim.Recording], after: int
) -> mjfim.Estimate:
    """Estimate of a fit that is asked to stop when some number of tasks was submitted."""
    stop = StopToken()
    with StoppingThreads(stop, after) as threads:
        return mjfim.identify(
            experiment.replace(fit=SEGMENTS), recordings, threads=1, executor=threads, stop=stop
        )


def test_a_request_to_stop_ends_the_pass_that_runs_and_keeps_the_values_of_before(
    in_small_batches: FitProblem,
) -> None:
    problem = in_small_batches
    begin = problem.begin(1.05 * problem.system.parameters.guess)
    stop = StopToken()

    # The first pass for the cost and the first linearisation are complete by then.
    passes = len(list(problem.simulation.batches(derivatives=False)))
    passes += len(list(problem.simulation.batches(derivatives=True)))
    with StoppingThreads(stop, passes + 1) as threads:
        divided = problem.on_workers(FitWorkers(threads, stop))
        found = minimise(divided, begin, SearchSettings(), Budget(stop=stop))

    assert found is not None
    assert found.interrupted
    assert np.array_equal(found.unknowns.theta, begin.theta)


@pytest.mark.slow
@pytest.mark.parametrize("after", [1, 21, 40, 60, 80, 100, 140])
def test_a_request_to_stop_in_any_pass_leaves_an_estimate(
    experiment: mjfim.Experiment,
    recordings: list[mjfim.Recording],
    after: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(subsets, "SUBSET_SAMPLES", 60)
    found = stopped_fit(experiment, recordings, after)

    assert np.isfinite(found.theta).all()
    assert found.interrupted


def test_an_order_holds_the_segments_of_its_batch_alone(
    experiment: mjfim.Experiment, recordings: list[mjfim.Recording]
) -> None:
    problem = problem_of(experiment, recordings, SEGMENTS)
    at = problem.begin(problem.system.parameters.guess)
    batch = next(problem.simulation.batches(derivatives=True))
    assert len(batch.segments) < len(problem.segments)

    with ThreadPoolExecutor(1) as threads:
        part = FitWorkers(threads).part_of(problem, batch.segments, 1)
    order = BatchOrder.of(part, FitProblem.blocks_of_batch, batch, at)

    assert set(part.value.segments) == set(batch.segments)

    # Workers forget it by its size.
    rows = sum(
        problem.segments[i].rows.stop - problem.segments[i].rows.start for i in batch.segments
    )
    assert part.size >= rows * len(problem.system.outputs)
    assert len(order.at.private) == len(batch.segments)
    assert len(part.value.made().segments) == len(problem.segments)


@pytest.mark.parametrize(
    ("largest", "samples"),
    [(2**20, 10**6), (2**20, 100), (0, 10**6)],
    ids=["folds", "folds of a subset", "batches"],
)
def test_each_part_is_predicted_from_the_others_as_in_one_process(
    experiment: mjfim.Experiment,
    recordings: list[mjfim.Recording],
    monkeypatch: pytest.MonkeyPatch,
    largest: int,
    samples: int,
) -> None:
    """A worker does a whole fold, or parts of each pass where the recordings are large.

    It needs only the recordings of a subset, and the names of the parts are those of all.
    """
    monkeypatch.setattr(cross_validation, "LARGEST_SENT_BYTES", largest)
    monkeypatch.setattr(left_out_parts, "MAX_SAMPLES", samples)
    named = [replace(recording, name=f"log {i}") for i, recording in enumerate(recordings)]
    problem = problem_of(experiment, named, WHOLE)
    plant = problem.system.plant
    solution = least_squares(
        problem, problem.system.parameters.guess, SearchSettings(max_iterations=2)
    )
    begin = plant.engine_steps
    alone = cross_validation.predict_unfitted(problem, solution, None, Budget())
    steps = plant.engine_steps

    orders: list[str] = []
    for name in ("_work_on_whole", "_work_on_batch"):
        monkeypatch.setattr(fit_workers, name, noted(getattr(fit_workers, name), name, orders))
    with LosingThreads() as threads:
        divided = problem.on_workers(FitWorkers(threads))
        found = cross_validation.predict_unfitted(divided, solution, None, Budget())

    assert ("_work_on_whole" in orders) == (largest > 0)
    assert [part.name for part in found] == [part.name for part in alone]
    assert [part.name for part in found][:2] == (
        ["log 0", "log 1"] if samples > 100 else ["log 0", "log 2"]
    )
    for here, there in zip(alone, found, strict=True):
        assert np.array_equal(here.identified.rms, there.identified.rms)
        assert np.array_equal(here.nominal.mae, there.nominal.mae)
    assert plant.engine_steps - steps == steps - begin


@pytest.mark.parametrize("largest", [2**20, 0], ids=["small", "large"])
def test_works_that_a_request_to_stop_has_left_do_not_hold_up_what_is_needed(
    experiment: mjfim.Experiment,
    recordings: list[mjfim.Recording],
    monkeypatch: pytest.MonkeyPatch,
    largest: int,
) -> None:
    """This process does passes over small data, while workers still do what nobody waits for."""
    monkeypatch.setattr(dispatch, "GRACE", 0.1)
    monkeypatch.setattr(fit_workers, "GRACE", 0.1)
    monkeypatch.setattr(fit_workers, "LARGEST_SENT_BYTES", largest)
    problem = problem_of(experiment, recordings, WHOLE)
    at = problem.begin(problem.system.parameters.guess)
    alone = problem.condense(at)
    assert alone is not None

    stop, is_over = StopToken(), Event()

    def long_work(problem: FitProblem, budget: Budget) -> bool:
        """A work during which the user presses Ctrl-C, and which goes on for long."""
        stop.request()
        return is_over.wait(20.0)

    with ThreadPoolExecutor(1) as threads:
        submit = mock.Mock(side_effect=threads.submit)
        monkeypatch.setattr(threads, "submit", submit)
        workers = FitWorkers(threads, stop)
        divided = problem.on_workers(workers)
        assert not list(workers.of_whole(divided, [long_work, long_work], Budget(stop=stop)))

        before = submit.call_count
        try:
            found = divided.condense(at)
        finally:
            is_over.set()
        is_submitted = submit.call_count > before
    assert found is not None
    assert np.array_equal(found.blocks, alone.blocks)
    assert is_submitted == (largest == 0)


def noted(work: Callable[[Any], Any], name: str, names: list[str]) -> Callable[[Any], Any]:
    """A work whose name is noted each time that it is done."""

    def done(order: Any) -> Any:
        names.append(name)
        return work(order)

    return done


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["pool", "dask"])
def test_processes_in_another_folder_find_the_same_estimate(
    kind: str,
    tmp_path: Path,
    recordings: list[mjfim.Recording],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The path of the experiment is relative, so that processes elsewhere do not find its files.
    monkeypatch.chdir(MODELS)
    experiment = mjfim.Experiment.from_file("cart_pendulum.toml").replace(fit=SEGMENTS)
    alone = mjfim.identify(experiment, recordings, threads=1)

    with processes(kind) as executor:
        move_to(executor, tmp_path)
        found = mjfim.identify(experiment, recordings, threads=1, executor=executor)

    assert np.array_equal(found.theta, alone.theta)
    assert np.array_equal(found.covariance, alone.covariance)
    assert found.chi2 == alone.chi2
    assert found.steps == alone.steps
    assert len(found.predictions) == len(alone.predictions) > 1
    for here, there in zip(alone.predictions, found.predictions, strict=True):
        assert np.array_equal(here.identified.rms, there.identified.rms)
