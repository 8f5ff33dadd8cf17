"""Pictures that another process draws are those that this one would draw."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import time
from concurrent.futures import Future
from typing import Any
from unittest.mock import Mock

import pytest

from mjfim.output.page import PictureFormat
from mjfim.output.plots.draw import content
from mjfim.output.plots.pictures import begin_pictures, drawing_elsewhere, pictures_of
from tests.support import results


def failing(error: Exception) -> Future[Any]:
    """A task that failed."""
    future: Future[Any] = Future()
    future.set_exception(error)
    return future


def faulty(*answers: Any) -> Mock:
    """A pool, of which the first task and the second one have these answers."""
    return Mock(return_value=Mock(submit=Mock(side_effect=answers)))


@pytest.mark.parametrize(
    ("cores", "pool"),
    [
        (1, None),
        # Some systems can start no process.
        (2, Mock(side_effect=OSError("no semaphores"))),
        (2, faulty(Future(), OSError("no memory"))),
        (2, faulty(Future(), failing(pickle.PicklingError("record")))),
    ],
)
def test_without_another_process_or_if_it_fails_this_one_draws(
    cores: int, pool: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The data of a result are written after its pictures are begun, so nothing is raised."""
    monkeypatch.setattr("mjfim.parallel.cores", lambda: cores)
    monkeypatch.setattr("mjfim.parallel.Pool", pool)
    with drawing_elsewhere():
        assert begin_pictures(results.check(), PictureFormat.PNG)() == {}


@pytest.mark.slow
def test_another_process_draws_the_same_and_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mjfim.parallel.cores", lambda: 2)
    record, format_name = results.check(), PictureFormat.SVG
    # Processes of other tests may still be about to end.
    others = set(multiprocessing.active_children())
    with drawing_elsewhere():
        found = begin_pictures(record, format_name)()
    here = {name: content(draw(), format_name) for name, draw in pictures_of(record).items()}
    assert found == here
    # A process that is killed leaves the work to this one.
    with drawing_elsewhere():
        (child,) = set(multiprocessing.active_children()) - others
        assert child.pid is not None
        os.kill(child.pid, signal.SIGTERM if os.name == "nt" else signal.SIGKILL)
        assert begin_pictures(record, format_name)() in ({}, here)

    deadline = time.monotonic() + 60.0
    while set(multiprocessing.active_children()) - others and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not set(multiprocessing.active_children()) - others
