"""The search for the smallest feasible number of samples, on known laws of the ratio."""

from __future__ import annotations

import numpy as np
import pytest

from mjfim.excitation.shortest_horizon import SampleGrid, smallest_feasible

LAWS = {
    "square root": lambda n: (173 / n) ** 0.5,
    "steep": lambda n: (173 / n) ** 4,
    "knee": lambda n: max((173 / n) ** 0.5, (150 / n) ** 6),
    "nothing when short": lambda n: np.inf if n < 173 else 0.4,
    "step": lambda n: 1.3 if n < 173 else 0.99,
    "hardly falling": lambda n: 1.0 + 1e-3 * (173 - n) / 173,
}


@pytest.mark.parametrize("first", [60, 172, 173, 174, 500])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(
    "grid",
    [
        SampleGrid(unit=1, first_multiple=0),
        SampleGrid(unit=4, first_multiple=0, minimum=4),
        SampleGrid(unit=4, first_multiple=120),
    ],
)
def test_the_search_finds_the_smallest_feasible_number(
    first: int, law: str, grid: SampleGrid
) -> None:
    asked = []

    def ratio(n: int) -> float:
        asked.append(n)
        return LAWS[law](n)

    def slack(n: int) -> int:
        return max(n // 50, n - grid.round_down(n - 1))

    high, low = smallest_feasible(ratio, grid.round_up(first), grid.round_down(700), grid, slack)
    assert high is not None and low is not None
    assert LAWS[law](high) <= 1.0 < LAWS[law](low)
    assert 0 < high - low <= slack(high)
    assert len(asked) == len(set(asked)) <= 20
    assert all(grid.round_up(n) == n for n in asked)
    if law == "square root":
        assert len(asked) <= 5, "the secant does not help"


def test_the_search_ends_at_the_smallest_and_largest_allowed_number() -> None:
    grid = SampleGrid(unit=1, first_multiple=0, minimum=3)
    assert smallest_feasible(lambda n: 0.5, 40, 100, grid, lambda n: 1) == (3, None)
    assert smallest_feasible(lambda n: 2.0, 40, 100, grid, lambda n: 1) == (None, 100)


def test_a_stopped_search_returns_the_bracket_so_far() -> None:
    """An evaluation gives no ratio where the user stops it."""
    grid = SampleGrid(unit=1, first_multiple=0)

    def given_up(n: int) -> float | None:
        return LAWS["square root"](n) if n == 400 else None

    assert smallest_feasible(given_up, 400, 700, grid, lambda n: 1) == (400, None)
    assert smallest_feasible(given_up, 300, 700, grid, lambda n: 1) == (None, None)
