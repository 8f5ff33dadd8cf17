"""Executors that are stated in words: their forms, and what is said where one cannot be had."""

from __future__ import annotations

import sys
import threading
from pathlib import Path
from types import SimpleNamespace

import pytest

from mjfim.errors import ExperimentError, MjfimError
from mjfim.parallel.workers import StatedExecutor

FACTORY = """
from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import mjfim


@dataclass
class Settings:
    count: int = 3


def make():
    return ThreadPoolExecutor(Settings().count)


def make_stated():
    return mjfim.Workers(ThreadPoolExecutor(3), count=16, threads=4)
"""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cluster", "has no known form; state local"),
        ("dask", "states no scheduler"),
        ("local:", "has no known form"),
        ("local:0", "not a number of processes"),
        ("local:many", "not a number of processes"),
        (f"local:{'9' * 5000}", "not a number of processes"),
        ("python:cluster", "names no function"),
        ("python:cluster.py:", "names no function"),
    ],
)
def test_a_wrong_form_is_refused_with_the_right_ones(text: str, message: str) -> None:
    with pytest.raises(ExperimentError, match=message):
        StatedExecutor.parse(text)


@pytest.fixture
def factory(tmp_path: Path) -> Path:
    """A file with functions that make executors."""
    path = tmp_path / "cluster.py"
    path.write_text(FACTORY, encoding="utf-8")
    return path


def test_an_executor_of_a_file_is_made_by_its_function(factory: Path) -> None:
    with StatedExecutor.parse(f"python:{factory}:make").started() as workers:
        assert workers.count == 3
        assert workers.submit(len, "four").result() == 4

    with pytest.raises(RuntimeError, match="shutdown"):
        workers.submit(len, "ended")


def test_the_end_does_not_wait_for_tasks_that_nobody_needs(factory: Path) -> None:
    go_on = threading.Event()
    with StatedExecutor.parse(f"python:{factory}:make").started() as workers:
        task = workers.submit(go_on.wait, 20.0)
    assert not task.done()
    go_on.set()
    assert task.result(timeout=20.0)


def test_workers_of_a_file_keep_their_stated_numbers(factory: Path) -> None:
    with StatedExecutor.parse(f"python:{factory}:make_stated").started() as workers:
        assert (workers.count, workers.threads_for(2)) == (16, 4)
    assert "cluster" not in sys.modules


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("python:not_there.py:make", "FileNotFoundError"),
        ("python:no_such_module:make", "No module named 'no_such_module'.*state a function"),
        ("python:.a:make", "TypeError.*state a function"),
        ("python:..:make", "TypeError.*state a function"),
        ("python:json:make", "cannot call make .*KeyError"),
        ("python:json:loads", "cannot call loads .*missing 1 required positional argument"),
        ("python:{file}:make", "not callable"),
        ("dask:not_there.json", "no such file; `dask scheduler"),
        ("dask:{file}", "not a JSON file"),
        ("dask:{scheduler}", r"no scheduler answers there .*missing port number"),
        ("dask://[::1", r"no scheduler answers there .*invalid address '\[::1'"),
    ],
)
def test_what_is_missing_is_named(place: str, message: str, tmp_path: Path) -> None:
    """One message, and no client of Dask that waits when the process ends."""
    files = {"file": tmp_path / "cluster.py", "scheduler": tmp_path / "scheduler.json"}
    files["file"].write_text("make = 3", encoding="utf-8")
    files["scheduler"].write_text('{"address": "nowhere"}', encoding="utf-8")
    text = place.format(**files)
    before = threading.active_count()
    with pytest.raises(MjfimError, match=message) as raised, StatedExecutor.parse(text).started():
        pass
    assert len(str(raised.value)) < 600
    assert threading.active_count() == before


def test_a_missing_dask_is_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    place = StatedExecutor.parse("dask://host:8786")
    with pytest.raises(ExperimentError, match=r"pip install 'mjfim\[dask\]'"), place.started():
        pass


def test_missing_certificates_are_explained(monkeypatch: pytest.MonkeyPatch) -> None:
    def client(**settings: object) -> None:
        """As the client of Dask for a tls:// address where no certificates are configured."""
        raise TypeError("TLS expects a `ssl_context` argument of type ssl.SSLContext")

    comm = SimpleNamespace(resolve_address=str)
    monkeypatch.setitem(sys.modules, "distributed", SimpleNamespace(Client=client))
    monkeypatch.setitem(sys.modules, "distributed.comm", comm)
    place = StatedExecutor.parse("dask:tls://host:8786")
    with pytest.raises(ExperimentError, match=r"distributed\.comm\.tls"), place.started():
        pass
