"""A search that is stuck on rough residuals goes on with longer differences."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mjfim.identification import search as search_module
from mjfim.identification import segment_simulation
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.search import FitSearch, first_subset
from mjfim.identification.segment_simulation import SegmentBatch
from mjfim.optimize.condensed_least_squares import Condensed, Step
from mjfim.optimize.levenberg_marquardt import (
    SearchSettings,
    Solution,
    UnknownValues,
    minimise,
)
from mjfim.parallel.budget import Budget
from tests.support.cart_pendulum import cart_pendulum, fit_of
from tests.support.numerics import Array

# Slope of the residuals: the standard deviation of the parameter is 0.01.
SLOPE = 10.0

# Length of the waves on the residuals, which is below the steps.
WAVE_LENGTH = 1.2345e-9


@dataclass(frozen=True, kw_only=True)
class Parts:
    """Residuals of one unbounded parameter: a line for each segment, and short waves on it.

    Attributes:
        segments: Minimum of each segment.
        limit: Parameter from which the segments with the lower minimum diverge.
        wave: Size of the waves.
        step: Step of the differences.
        sample_count: Number of samples that the problem states.
    """

    segments: tuple[float, ...] = (1.0,) * 100
    limit: float = np.inf
    wave: float = 0.0
    step: float = 1e-3
    sample_count: int = 24_800

    lower, upper = np.array([-np.inf]), np.array([np.inf])
    curved_rows = workers = None
    free_starts = False
    noise = SimpleNamespace(sigma=np.ones(1), strides=np.ones(1, dtype=int))
    value_count, unknown_count = 25, 1

    def bounds_at(self, at: UnknownValues) -> tuple[Array, Array]:
        return self.lower, self.upper

    def moved(self, at: UnknownValues, step: Step, fraction: float) -> UnknownValues:
        """The unknowns after a fraction of a step."""
        return replace(at, theta=at.theta + fraction * step.common)

    def common_values(self, at: UnknownValues) -> Array:
        """The parameter."""
        return at.theta

    def residuals(self, theta: float) -> Array:
        """One residual of each segment."""
        phases = np.linspace(0.0, 6.0, len(self.segments))
        waves = np.sin(2.0 * np.pi * theta / WAVE_LENGTH + phases)
        return SLOPE * (theta - np.array(self.segments)) + self.wave * waves

    def cost(self, at: UnknownValues) -> float:
        """Half of the sum of squares."""
        if at.theta[0] > self.limit and min(self.segments) < 3.0:
            return np.inf
        return 0.5 * float(np.sum(self.residuals(at.theta[0]) ** 2))

    def condense(self, at: UnknownValues) -> Condensed:
        """Linearise by two-sided differences."""
        theta, step = at.theta[0], self.step
        slopes = (self.residuals(theta + step) - self.residuals(theta - step)) / (2.0 * step)
        rows = np.column_stack([slopes, self.residuals(theta)])
        return Condensed(
            blocks=np.linalg.qr(rows, mode="r")[None],
            segment_of_block=np.zeros(1, dtype=int),
            private_rows=np.zeros((1, 0, 2)),
            common_rows=np.zeros((0, 2)),
        )

    def with_longer_differences(self, factor: float) -> Parts:
        """The same residuals with longer steps."""
        return replace(self, step=factor * self.step)

    def of_segments(self, indices: np.ndarray) -> Parts:
        """Some segments."""
        return replace(self, segments=tuple(self.segments[i] for i in indices))

    def of_first_parts(self, share: float) -> Parts:
        """The same, because there is no initial state."""
        return self

    def errors_at(self, at: UnknownValues) -> list[Array]:
        """Errors of one output."""
        return [self.residuals(at.theta[0]) + 0.5]

    def with_noise(self, noise: Any) -> Parts:
        """Segments that diverge as soon as their noise changes."""
        return replace(self, limit=-np.inf)


# Residuals whose waves spoil short differences.
ROUGH = Parts(wave=1e-4, step=1e-7, sample_count=100)


def search(method: str = "least_squares", *, noise_is_stated: bool = True) -> Any:
    """The searches of an identification of one parameter."""
    task: Any = SimpleNamespace(
        method=method,
        noise_is_stated=noise_is_stated,
        settings=SimpleNamespace(max_iterations=60, starts=1, loss="linear", seconds=None),
        system=SimpleNamespace(parameters=["slope"], noise=SimpleNamespace(sigma=np.ones(1))),
    )
    return FitSearch(task=task, budget=Budget(), callback=None)


def stuck_at(theta: float) -> Solution:
    """A search that ended at once because no step lowered the cost."""
    ended = minimise(ROUGH, begin_of(theta), SearchSettings(max_iterations=1))
    assert not ended.success
    return replace(ended, stuck=True)


@pytest.mark.parametrize("begin", [0.7, 1.3])
def test_longer_differences_lead_over_waves_to_the_minimum(begin: float) -> None:
    stuck = stuck_at(begin)
    problem, found = search().converged(ROUGH, stuck)
    assert found.success and found.cost < 1e-3 * stuck.cost
    assert problem.step > ROUGH.step
    assert abs(found.unknowns.theta[0] - 1.0) < 1e-3

    # So does a search that ended near its minimum.
    found = search().converged(ROUGH, replace(stuck, stuck=False, rough=True, success=True))[1]
    assert not found.rough and found.cost < 1e-3 * stuck.cost


def test_longer_differences_are_two_sided_also_with_much_data(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    problem = fit_of(cart_pendulum(horizon=0.2), 0).problem()
    linearised: list[SegmentBatch] = []
    monkeypatch.setattr(segment_simulation, "SAMPLES_FOR_ONE_SIDED", 0)
    monkeypatch.setattr(
        FitProblem, "blocks_of_batch", lambda self, at, batch: linearised.append(batch)
    )
    begin = problem.begin(problem.system.parameters.guess)
    problem.condense(begin)
    problem.with_longer_differences(100.0).condense(begin)
    usual, longer = linearised
    assert longer.central and not usual.central
    assert longer.step == pytest.approx(100.0 * problem.difference_step)


def test_much_data_that_are_missed_end_the_first_search_near_its_minimum(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Half of the residuals belong to another minimum, so that no parameter explains the data."""
    problem = Parts(segments=(1.0, 3.0) * 50)
    monkeypatch.setattr(search_module, "SAMPLES_OF_MUCH_DATA", 0)
    begin = begin_of(7.0)
    assert not search().solve(problem, begin)[1].rough
    assert search().solve(problem, begin, is_first=True)[1].rough

    explained = replace(problem, segments=(2.0,) * 100)
    assert not search().solve(explained, begin, is_first=True)[1].rough


def test_other_ends_of_a_search_stay() -> None:
    stuck = stuck_at(0.7)
    ended = replace(stuck, stuck=False)
    assert search().converged(ROUGH, ended) == (ROUGH, ended)
    assert search("newton").converged(ROUGH, stuck) == (ROUGH, stuck)


def of_segments(samples: int, count: int) -> Any:
    """A problem of which only the sizes count."""
    return SimpleNamespace(segments=[None] * count, sample_count=samples)


@pytest.mark.parametrize(
    ("samples", "count", "wanted"),
    [
        (24_800, 25, 6),
        (24_800, 4, 4),
        (4_000, 100, 100),
        (4_000_000, 1000, 10),
    ],
    ids=["a quarter", "too few segments", "too few samples", "much data"],
)
def test_a_search_begins_on_a_part_that_is_large_enough(
    samples: int, count: int, wanted: int
) -> None:
    chosen = first_subset(of_segments(samples, count))
    assert len(chosen) == wanted

    # One of each of equal stretches of the data.
    stretch = np.arange(wanted) * count / wanted
    assert (chosen >= np.floor(stretch)).all() and (chosen < stretch + count / wanted).all()


def test_a_part_of_recordings_that_repeat_in_turn_holds_different_ones() -> None:
    """Five joints are recorded in turn; every fourth or fifth recording would be of one joint."""
    for count in (20, 21, 22, 25, 40):
        chosen = first_subset(of_segments(1_000 * count, count))
        assert len(chosen) < count / 3
        assert len(set((chosen % 5).tolist())) >= 3


def parts(seen: float, others: float, limit: float = np.inf) -> Parts:
    """25 segments with a minimum of those that the first search sees, and one of the others."""
    minima = np.full(25, others)
    minima[first_subset(of_segments(24_800, 25))] = seen
    return Parts(segments=tuple(minima.tolist()), limit=limit)


def begin_of(theta: float) -> UnknownValues:
    """A parameter, without private unknowns."""
    return UnknownValues(theta=np.array([theta]), private=np.zeros((25, 0)))


@pytest.mark.parametrize(
    ("minimum", "limit", "expected"),
    [
        (3.0, np.inf, 3.0),
        (1.0, np.inf, 1.1),
        (2.9, 2.0, 1.1),
    ],
    ids=["the part is like the rest", "the rest costs more", "the rest diverges"],
)
def test_the_search_over_all_data_begins_where_all_data_cost_less(
    minimum: float, limit: float, expected: float
) -> None:
    problem = parts(3.0, minimum, limit)
    found = search().best_start(problem, begin_of(1.1))
    assert found.theta[0] == pytest.approx(expected, abs=0.1)
    assert np.isfinite(problem.cost(found))


@pytest.mark.parametrize(("beaten", "expected"), [(2.0, 3.0), (3.0, None), (2.99, 3.0)])
def test_another_start_is_improved_on_a_part_where_it_beats_the_first_one(
    beaten: float, expected: float | None
) -> None:
    problem = parts(3.0, 2.9)
    found = search().better_start(problem, begin_of(1.1), begin_of(beaten))
    assert (None if found is None else round(float(found.theta[0]), 3)) == expected


def test_a_search_that_ends_next_to_divergence_is_kept_where_the_noise_is_estimated() -> None:
    """The first search leads to its minimum, and differences there diverge with other noise."""
    problem = Parts(segments=(2.5,) * 25)
    kept, found = search(noise_is_stated=False).solve(problem, begin_of(1.1))
    assert kept is problem
    assert not found.success and "diverges next to the estimate" in found.status
    assert found.unknowns.theta[0] == pytest.approx(2.5, abs=0.1)
