"""The option `--executor`: how many processes the starts of a design get."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from mjfim.cli import design
from mjfim.parallel.stated import StatedExecutor


@pytest.mark.parametrize(
    ("place", "tasks"), [("local", 1), ("local:2", 2), ("local:3", 1), ("dask://host:8786", 1)]
)
def test_a_stated_number_of_processes_is_used_where_there_are_as_many_starts(
    place: str, tasks: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two starts without limits on four cores, which otherwise run one after the other."""
    found = []

    @contextmanager
    def started(stated: StatedExecutor, count: int, threads: int) -> Iterator[None]:
        """Note the number of tasks."""
        found.append(count)
        yield

    monkeypatch.setattr(design, "started_executor", started)
    simulator = SimpleNamespace(threads=4)
    descent = SimpleNamespace(starts=2, previous=(), fourier=(), repeats=())
    task: Any = SimpleNamespace(
        plant=SimpleNamespace(simulator=simulator),
        is_limited=False,
        experiment=SimpleNamespace(descent=descent),
    )
    with design.several(task, StatedExecutor.parse(place)):
        assert found == [tasks]
