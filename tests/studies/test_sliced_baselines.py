"""Baselines in slices on executors: what they find, and what a request to stop costs."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from mjfim.budget import StopToken
from mjfim.parallel import Workers
from mjfim.studies.baselines import evaluator, parts
from mjfim.studies.baselines.evaluator import BaselineSearch, SearchResult
from mjfim.studies.baselines.methods import BaselineSlice, SliceOfBaseline, run_baseline, run_slice
from mjfim.studies.baselines.parts import PartsOfBaseline
from tests.support.baselines import pendulum

# Engine steps of a search.
STEPS = 20_000


@pytest.fixture(autouse=True)
def short_slices(monkeypatch: pytest.MonkeyPatch) -> None:
    """Slices of three checks of the budget."""
    monkeypatch.setattr(evaluator, "CHECKS_OF_SLICE", 3)
    monkeypatch.setattr(parts, "SLICE_SECONDS", 0.0)


def search(method: str, steps: float = STEPS) -> BaselineSearch:
    """A search of one thread whose steps are limited."""
    return BaselineSearch(
        experiment=pendulum(), method=method, seconds=600.0, steps=steps, threads=1
    )


def divided(wanted: BaselineSearch, stop: StopToken | None = None) -> list[SearchResult]:
    """Results of a search on a thread."""
    with ThreadPoolExecutor(1) as threads:
        token = StopToken() if stop is None else stop
        return PartsOfBaseline(Workers(threads), [wanted], token).results()


@pytest.mark.slow
def test_a_random_search_in_slices_is_the_whole_one() -> None:
    whole = run_baseline(search("steps"))
    (sliced,) = divided(search("steps"))

    assert sliced.cost == whole.cost
    assert sliced.control is not None
    assert np.array_equal(sliced.control, whole.control)
    assert sliced.steps == whole.steps


@pytest.mark.slow
def test_series_go_on_in_the_next_slice() -> None:
    wanted = search("fourier5", 60_000)
    order = BaselineSlice(key="one", search=wanted, seconds=0.0)
    found: list[SliceOfBaseline] = []
    while not found or found[-1].state is not None:
        before = found[-1].state if found else None
        found.append(run_slice(replace(order, before=before)))

    # The cost never rises, the first runs come once each, and the steps of all slices count.
    costs = [each.result.cost for each in found]
    assert costs == sorted(costs, reverse=True)
    assert np.isfinite(costs[-1])
    assert 60_000 <= found[-1].result.steps < 80_000

    last = next(each.state for each in reversed(found) if each.state is not None)
    names = [run.name for run in last.method.runs]
    assert names[:2] == ["0.2 Hz", "0.1 Hz"]
    assert len(set(names)) == len(names)


@pytest.mark.slow
def test_a_request_to_stop_keeps_the_best_of_the_slices_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    stop = StopToken()
    slices: list[BaselineSlice] = []

    def stopping(order: BaselineSlice) -> SliceOfBaseline:
        """Run a slice; ask for a stop in the tenth one, which then fails as a killed worker."""
        slices.append(order)
        if len(slices) == 10:
            stop.request()
            raise KeyboardInterrupt
        return run_slice(order)

    monkeypatch.setattr(parts, "run_slice", stopping)
    (found,) = divided(search("steps", np.inf), stop)

    assert len(slices) == 10
    assert slices[-1].before is not None
    assert found.cost == slices[-1].before.best.cost
