"""Designs from several starts on executors of all kinds: stopped, out of time, workers killed."""

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

from mjfim.excitation.design import design_task
from mjfim.parallel import Workers
from mjfim.parallel.budget import Budget, StopToken
from mjfim.records.design import Design, Status
from mjfim.records.events import DesignEvent
from tests.support.executors import KINDS, processes
from tests.support.limits import cart_inside

# Time within which a design ends after a request to stop [s].
SECONDS_TO_END = 10.0


def started(kind: str) -> AbstractContextManager[Any]:
    """Two workers of a kind."""
    return ThreadPoolExecutor(2) if kind == "threads" else processes(kind)


def kill_one_worker(workers: Workers) -> None:
    """End a worker process as the system does where the memory is full."""
    for future in [workers.submit(os.getpid) for _ in range(4)]:
        process = future.result()
    os.kill(process, signal.SIGKILL)


def numbers(design: Design) -> list[Any]:
    """Everything of a design that must not depend on the executor."""
    starts = [(start.name, start.cost, start.status, start.iterations) for start in design.starts]
    return [design.final.cost, design.found_by, design.status, starts]


@pytest.mark.slow
@pytest.mark.parametrize("kind", [*KINDS, "threads"])
def test_all_executors_behave_alike(kind: str, tmp_path: Path) -> None:
    descent = {"starts": 3, "max_iterations": 12}
    task = cart_inside(tmp_path, descent=descent)
    serial = design_task(task)

    with started(kind) as executor:
        workers = Workers.of(executor)
        seen: list[DesignEvent] = []

        def kill(event: DesignEvent) -> None:
            """Kill a worker at the first iterate."""
            if not seen and kind != "threads":
                kill_one_worker(workers)
            seen.append(event)

        # A killed worker does not change the result.
        found = design_task(task, callback=kill, executor=workers)
        assert numbers(found) == numbers(serial)
        assert np.array_equal(found.trajectory.ctrl, serial.trajectory.ctrl)

        # A request to stop ends the design soon with its best result so far.
        long = cart_inside(tmp_path, descent={"starts": 40, "max_iterations": 10_000})
        stop = StopToken()
        asked: list[float] = []

        def ask(event: DesignEvent) -> None:
            """Ask for the end after some iterates."""
            asked.append(time.monotonic())
            if len(asked) >= 12:
                stop.request()

        stopped = design_task(long, callback=ask, executor=workers, budget=Budget(stop=stop))
        assert time.monotonic() - asked[-1] < SECONDS_TO_END
        assert stopped.status is Status.INTERRUPTED
        assert stopped.final.cost < stopped.initial.cost

        # The workers can be used again, and the time ends a design.
        short = cart_inside(tmp_path, descent={"starts": 40, "seconds": 1.0})
        ended = design_task(short, executor=workers)
        assert ended.status is not Status.INTERRUPTED
        assert ended.final.cost <= ended.initial.cost
        assert ended.seconds < SECONDS_TO_END
