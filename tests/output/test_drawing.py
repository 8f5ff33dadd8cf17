"""Pictures that another process draws are those that this one would draw."""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
import time
from concurrent.futures import Future
from typing import Any

import pytest

from mjfim.errors import MjfimError
from mjfim.output import drawing
from mjfim.output.drawing import begin_pictures, drawing_elsewhere, picture_contents
from mjfim.output.picture_format import PictureFormat
from mjfim.output.plots.draw import content
from mjfim.output.plots.pictures import pictures_of
from tests.support import results


def test_without_another_process_nothing_is_begun() -> None:
    record = results.check()
    begin_pictures(record, PictureFormat.PNG)
    assert picture_contents(record) == {}


def test_a_single_processor_starts_no_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mjfim.parallel.cores", lambda: 1)
    with drawing_elsewhere():
        assert drawing._process.get() is None


def test_a_picture_that_cannot_be_drawn_names_its_reason() -> None:
    without_figures: object = object()
    with pytest.raises(MjfimError, match="a object has no figures"):
        drawing._contents(without_figures, PictureFormat.PNG)  # type: ignore[arg-type]


class FaultyPool:
    """A pool that fails at its second task, or whose second task fails."""

    def __init__(self, raised: Exception | None, failed: Exception | None) -> None:
        self._raised = raised
        self._failed = failed
        self._tasks = 0

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


@pytest.mark.parametrize(
    ("raised", "failed"),
    [(OSError("no memory"), None), (None, pickle.PicklingError("record"))],
)
def test_a_process_that_fails_leaves_the_pictures_to_this_one(
    raised: Exception | None,
    failed: Exception | None,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The data of a result are written after its pictures are begun, so nothing is raised."""
    monkeypatch.setattr("mjfim.parallel.cores", lambda: 2)
    monkeypatch.setattr("mjfim.parallel.Pool", lambda count: FaultyPool(raised, failed))
    record = results.check()
    with drawing_elsewhere():
        assert drawing._process.get() is not None
        begin_pictures(record, PictureFormat.PNG)
        with caplog.at_level(logging.INFO, "mjfim.output.drawing"):
            assert picture_contents(record) == {}
    assert ("PicklingError('record')" in caplog.text) == (failed is not None)


@pytest.mark.parametrize("error", [ImportError, NotImplementedError, OSError])
def test_a_computer_that_can_start_no_process_draws_here(
    error: type[Exception], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Some systems have no shared semaphores."""

    def fail(count: int) -> Any:
        raise error("no semaphores")

    monkeypatch.setattr("mjfim.parallel.cores", lambda: 2)
    monkeypatch.setattr("mjfim.parallel.Pool", fail)
    with drawing_elsewhere():
        assert drawing._process.get() is None


@pytest.mark.slow
def test_another_process_draws_the_same_and_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mjfim.parallel.cores", lambda: 2)
    record, format_name = results.check(), PictureFormat.SVG

    # Processes of other tests may still be about to end.
    others = set(multiprocessing.active_children())

    def children() -> set[multiprocessing.process.BaseProcess]:
        """Processes that this test has started."""
        return set(multiprocessing.active_children()) - others

    with drawing_elsewhere():
        begin_pictures(record, format_name)
        assert picture_contents(results.check()) == {}
        found = picture_contents(record)
    here = {name: content(draw(), format_name) for name, draw in pictures_of(record).items()}
    assert found == here

    # A process that is killed leaves the work to this one.
    with drawing_elsewhere():
        (child,) = children()
        assert child.pid is not None
        os.kill(child.pid, signal.SIGTERM if os.name == "nt" else signal.SIGKILL)
        begin_pictures(record, format_name)
        assert picture_contents(record) in ({}, here)

    deadline = time.monotonic() + 60.0
    while children() and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not children()
