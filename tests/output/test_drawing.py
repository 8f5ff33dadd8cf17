"""Pictures that another process draws are those that this one would draw."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import signal
import time
from concurrent.futures import Future
from typing import Any

import pytest

from mjfim.errors import MjfimError
from mjfim.output.page import PictureFormat
from mjfim.output.plots import pictures
from mjfim.output.plots.draw import content
from mjfim.output.plots.pictures import begin_pictures, drawing_elsewhere, pictures_of
from tests.support import results


def test_a_picture_that_cannot_be_drawn_names_its_reason() -> None:
    without_figures: object = object()
    with pytest.raises(MjfimError, match="a object has no figures"):
        pictures._contents(without_figures, PictureFormat.PNG)  # type: ignore[arg-type]


class FaultyPool:
    """A pool that fails at its second task, or whose second task fails."""

    def __init__(self, raised: Exception | None, failed: Exception | None) -> None:
        self._raised, self._failed, self._tasks = raised, failed, 0

    def submit(self, *_: Any) -> Future[Any]:
        """Submit a task."""
        self._tasks += 1
        if self._tasks > 1 and self._raised is not None:
            raise self._raised
        future: Future[Any] = Future()
        future.set_exception(self._failed)
        return future

    def end_running(self, *, wait: bool = False) -> None:
        """There is nothing to end."""


def without_semaphores(count: int) -> Any:
    """Some systems can start no process."""
    raise OSError("no semaphores")


@pytest.mark.parametrize(
    ("cores", "pool"),
    [
        (1, None),
        (2, without_semaphores),
        (2, lambda _: FaultyPool(OSError("no memory"), None)),
        (2, lambda _: FaultyPool(None, pickle.PicklingError("record"))),
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
