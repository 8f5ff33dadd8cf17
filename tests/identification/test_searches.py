"""A search that is stuck on rough residuals goes on with longer differences."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mjfim.budget import Budget
from mjfim.identification.searches import FitSearch, first_subset
from mjfim.optimize.condensed_least_squares import Condensed, Step
from mjfim.optimize.levenberg_marquardt import (
    SearchSettings,
    Solution,
    UnknownValues,
    minimise,
)
from tests.support.numerics import Array

# Slope of the residuals: the standard deviation of the parameter is 0.01.
SLOPE = 10.0
COUNT = 100

# Size of the waves on the residuals, and their length, which is below the steps.
WAVE = 1e-4
WAVE_LENGTH = 1.2345e-9


@dataclass(frozen=True, kw_only=True)
class Rough:
    """Residuals of one parameter, a line with short waves, whose minimum is near 1.

    Attributes:
        step: Step of the differences.
    """

    step: float = 1e-7
    lower = np.array([-np.inf])
    upper = np.array([np.inf])
    sample_count = COUNT

    def residuals(self, theta: float) -> Array:
        """(COUNT,) residuals."""
        phases = np.linspace(0.0, 6.0, COUNT)
        waves = np.sin(2.0 * np.pi * theta / WAVE_LENGTH + phases)
        return np.asarray(SLOPE * (theta - 1.0) + WAVE * waves)

    def cost(self, at: UnknownValues) -> float:
        """Half of the sum of squares."""
        return 0.5 * float(np.sum(self.residuals(at.theta[0]) ** 2))

    def condense(self, at: UnknownValues) -> Condensed:
        """Linearise by two-sided differences."""
        theta = at.theta[0]
        rise = self.residuals(theta + self.step) - self.residuals(theta - self.step)
        rows = np.column_stack([rise / (2.0 * self.step), self.residuals(theta)])
        return Condensed(
            blocks=np.linalg.qr(rows, mode="r")[None],
            segment_of_block=np.zeros(1, dtype=int),
            private_rows=np.zeros((1, 0, 2)),
            common_rows=np.zeros((0, 2)),
        )

    def moved(self, at: UnknownValues, step: Step, fraction: float) -> UnknownValues:
        """The unknowns after a fraction of a step."""
        return replace(at, theta=at.theta + fraction * step.common)

    def common_values(self, at: UnknownValues) -> Array:
        """The parameter."""
        return at.theta

    def with_longer_differences(self, factor: float) -> Rough:
        """The same residuals with longer steps."""
        return Rough(step=factor * self.step)


def search(method: str = "least_squares") -> Any:
    """The searches of an identification of one parameter."""
    task: Any = SimpleNamespace(
        method=method,
        settings=SimpleNamespace(max_iterations=60),
        system=SimpleNamespace(parameters=["slope"]),
    )
    return FitSearch(task=task, budget=Budget(), callback=None)


def stuck_at(theta: float) -> Solution:
    """A search that ended at once because no step lowered the cost."""
    start = UnknownValues(theta=np.array([theta]), private=np.zeros((1, 0)))
    ended = minimise(Rough(), start, SearchSettings(max_iterations=1))
    assert ended is not None and not ended.success
    return replace(ended, stuck=True)


@pytest.mark.parametrize("begin", [0.7, 1.3])
def test_longer_differences_lead_over_waves_to_the_minimum(begin: float) -> None:
    stuck = stuck_at(begin)
    problem, found = search().over_roughness(Rough(), stuck)
    assert found.success and found.cost < 1e-3 * stuck.cost
    assert problem.step > Rough().step
    assert abs(found.unknowns.theta[0] - 1.0) < 1e-3


def test_other_ends_of_a_search_stay() -> None:
    rough, stuck = Rough(), stuck_at(0.7)
    ended = replace(stuck, stuck=False)
    assert search().over_roughness(rough, ended) == (rough, ended)
    assert search("newton").over_roughness(rough, stuck) == (rough, stuck)


def of_segments(samples: int, count: int) -> Any:
    """A problem of which only the sizes count."""
    return SimpleNamespace(segments=[None] * count, sample_count=samples)


@pytest.mark.parametrize(
    ("samples", "count", "wanted"),
    [
        pytest.param(24_800, 25, 6, id="a quarter"),
        pytest.param(24_800, 4, 4, id="too few segments"),
        pytest.param(10_000, 100, 100, id="too few samples"),
        pytest.param(4_000_000, 1000, 10, id="much data"),
    ],
)
def test_a_search_begins_on_a_part_that_is_large_enough(
    samples: int, count: int, wanted: int
) -> None:
    chosen = first_subset(of_segments(samples, count))
    assert len(chosen) == wanted
    assert np.diff(chosen).max() - np.diff(chosen).min() <= 1
