"""Executors of all kinds: designs that are stopped, out of time or lose a worker; fits and trials.

One test for each kind, because the start of its processes takes seconds.
"""

from __future__ import annotations

import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import simulate_system
from mjfim.identification import fit_workers, segment_simulation
from mjfim.parallel import Workers
from mjfim.parallel.budget import Budget, StopToken
from mjfim.records.design import Design, Status
from mjfim.records.events import DesignEvent
from mjfim.studies import monte_carlo
from tests.support.executors import KINDS, processes
from tests.support.limits import cart_inside
from tests.support.paths import MODELS

# Time within which a design ends after a request to stop [s].
SECONDS_TO_END = 10.0


def started(kind: str) -> AbstractContextManager[Any]:
    """Two workers of a kind."""
    return ThreadPoolExecutor(2) if kind == "threads" else processes(kind)


def some_process(workers: Workers) -> int:
    """Start all workers; returns the number of one process."""
    return [future.result() for future in [workers.submit(os.getpid) for _ in range(4)]][-1]


def numbers(design: Design) -> list[Any]:
    """Everything of a design that must not depend on the executor."""
    starts = [(start.name, start.cost, start.status, start.iterations) for start in design.starts]
    return [design.final.cost, design.found_by, design.status, starts]


def fitted(file: Path, **options: Any) -> list[Any]:
    """Everything of a fit and of trials that must not depend on the executor."""
    fit = {"segments": 0.25, "start": "measured"}
    experiment = mjfim.Experiment.from_file(file).replace(horizon=0.5, fit=fit)
    task = DesignTask.resolve(experiment, threads=1)
    recordings = [simulate_system(task.system, task.initial, seed) for seed in range(2)]
    found = mjfim.identify(experiment, recordings, threads=1, **options)
    predicted = [part.identified.rms.tolist() for part in found.predictions]
    assert len(predicted) > 1
    study = mjfim.monte_carlo(experiment, task.initial, trials=4, seed=3, threads=1, **options)
    arrays = [found.theta, found.covariance, *(s.estimates for s in study.sets.values())]
    return [[array.tolist() for array in arrays], found.chi2, found.steps, predicted]


def limited_task(folder: Path, **descent: float) -> DesignTask:
    """The cart-pendulum under limits, which few robots rehearse."""
    return cart_inside(folder, descent=descent, rehearsal={"robots": 2})


def small_task(folder: Path) -> DesignTask:
    """The task of a design from several starts."""
    return limited_task(folder, starts=3, max_iterations=12)


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> tuple[Design, list[Any]]:
    """A design, a fit and trials of one process, with the trials in the same chunks."""
    task = small_task(tmp_path_factory.mktemp("alone"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(monte_carlo, "MIN_CHUNK", 2)
        return design_task(task), fitted(MODELS / "cart_pendulum.toml")


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*KINDS, "threads"])
def test_all_executors_behave_alike(
    kind: str, alone: tuple[Design, list[Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    serial, estimated = alone
    task = small_task(tmp_path)
    with started(kind) as executor:
        workers = Workers.of(executor)
        # Processes in another folder do not find the files of a relative path. Recordings are sent,
        # or found as files.
        some_process(workers)
        monkeypatch.chdir(MODELS)
        monkeypatch.setattr(monte_carlo, "MIN_CHUNK", 2)
        monkeypatch.setattr(segment_simulation, "MAX_NUMBERS_AT_ONCE", 2000)
        if kind != "loky":
            monkeypatch.setattr(fit_workers, "MIN_FILE_BYTES", 0)
        assert fitted(Path("cart_pendulum.toml"), executor=workers) == estimated

        seen = []

        def kill(event: DesignEvent) -> None:
            """End a worker at the first iterate, as the system does where the memory is full."""
            if not seen and kind != "threads":
                os.kill(some_process(workers), signal.SIGKILL)
            seen.append(event)

        # A killed worker does not change the result.
        found = design_task(task, callback=kill, executor=workers)
        assert numbers(found) == numbers(serial)
        assert np.array_equal(found.trajectory.ctrl, serial.trajectory.ctrl)

        # A request to stop ends the design soon with its best result so far.
        long = limited_task(tmp_path, starts=6, max_iterations=10_000)
        stop = StopToken()
        asked = []

        def ask(event: DesignEvent) -> None:
            """Ask for the end after some iterates."""
            asked.append(time.monotonic())
            if len(asked) >= 4:
                stop.request()

        stopped = design_task(long, callback=ask, executor=workers, budget=Budget(stop=stop))
        assert time.monotonic() - asked[-1] < SECONDS_TO_END
        assert stopped.status is Status.INTERRUPTED
        assert stopped.final.cost < stopped.initial.cost

        # The workers can be used again, and the time ends a design.
        short = limited_task(tmp_path, starts=6, seconds=0.4)
        ended = design_task(short, executor=workers)
        assert ended.status is not Status.INTERRUPTED
        assert ended.final.cost <= ended.initial.cost
        assert ended.seconds < SECONDS_TO_END
