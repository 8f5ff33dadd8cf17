"""The sensitivity of recordings, condensed batch by batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.identification import segment_simulation
from mjfim.identification.fit_problem import FitProblem, sensitivity_rows
from mjfim.identification.identify import _unseen_directions
from mjfim.identification.search import FitTask
from mjfim.identification.segment_simulation import SegmentBatch
from tests.support.cart_pendulum import cart_pendulum, fit_of


def test_the_recordings_of_the_batch_that_diverges_are_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(segment_simulation, "MAX_NUMBERS_AT_ONCE", 2000)
    task = fit_of(cart_pendulum(horizon=0.5), 0, 1, 2)
    logs = [replace(log, name=f"log{seed}") for seed, log in enumerate(task.recordings)]
    problem = FitTask.of(task.system, logs).problem()
    last: list[str] = []

    def diverging(_: FitProblem, work: Any, batches: Sequence[SegmentBatch], at: Any) -> Any:
        *before, diverges = batches
        last.extend(f"log{problem.segments[i].recording}" for i in diverges.segments)
        return iter([*({} for _ in before), None])

    monkeypatch.setattr(FitProblem, "of_batches", diverging)
    at = problem.begin(problem.system.parameters.guess)
    with pytest.raises(SimulationDivergedError) as caught:
        sensitivity_rows(problem, at)
    assert "log0" not in last
    assert str(caught.value).startswith(" or ".join(sorted(set(last))) + ": the simulation")


def test_an_effect_that_may_be_round_off_is_tested_with_its_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    task = fit_of(cart_pendulum(horizon=0.5), 0)
    count = len(task.start)

    def rows(
        problem: FitProblem, at: Any, *, with_error: bool, wanted: Any
    ) -> list[tuple[Array, Array]]:
        """The last parameter has an effect of the size of its error."""
        J = 1e3 * np.eye(count) / task.system.parameters.magnitude
        J[-1] *= 1e-8
        return [(J, 0.5 * J * (np.arange(count) == count - 1) * with_error)]

    monkeypatch.setattr("mjfim.identification.identify.sensitivity_rows", rows)
    assert _unseen_directions(task, task.problem(), task.start).silent == (count - 1,)


def test_rows_without_error_are_those_of_one_sided_differences() -> None:
    problem = fit_of(cart_pendulum(horizon=0.5), 0, 1).problem()
    at = problem.begin(problem.system.parameters.guess)
    full, fast = (sensitivity_rows(problem, at, with_error=each) for each in (True, False))
    for (J, change), (other, none) in zip(full, fast, strict=True):
        assert_allclose(other.T @ other, J.T @ J, rtol=1e-5)
        assert change.any() and not none.any()
