"""Estimates of the duration of work from small parts of it."""

from __future__ import annotations

import pytest

from mjfim.duration import estimated_seconds, in_words


class Clock:
    """A clock that goes on only while work is done."""

    def __init__(self, per_item: float, overhead: float = 0.0) -> None:
        self.now = 0.0
        self.parts: list[int] = []
        self._per_item = per_item
        self._overhead = overhead

    def work(self, count: int) -> None:
        """Work on `count` items."""
        self.parts.append(count)
        self.now += self._overhead + self._per_item * count


@pytest.mark.parametrize("per_item", [1e-6, 1e-3, 0.1])
def test_the_duration_is_proportional_to_the_items(per_item: float) -> None:
    """The part grows until it can be measured; a first call is not measured."""
    clock = Clock(per_item)
    found = estimated_seconds(clock.work, 10_000_000, clock=lambda: clock.now)
    assert found == pytest.approx(per_item * 1e7)
    assert clock.parts[0] == clock.parts[1]
    assert clock.now <= max(3.0, 3 * 16 * per_item)


def test_long_work_is_done_once() -> None:
    """The model of a dog takes half a minute for the first samples; the message does not wait."""
    clock = Clock(2.0)
    assert estimated_seconds(clock.work, 100, clock=lambda: clock.now) == pytest.approx(200.0)
    assert clock.parts == [16]


def test_overhead_counts_little() -> None:
    """A constant overhead of 20 ms, a tenth of what is measured, is taken for work at most once."""
    clock = Clock(1e-4, overhead=0.02)
    found = estimated_seconds(clock.work, 100_000, clock=lambda: clock.now)
    assert 10.0 < found < 12.0


def test_a_disturbance_does_not_count() -> None:
    """Another process stops the first measured part for a second; the estimate remains."""
    clock = Clock(1e-5)

    def disturbed(count: int) -> None:
        """Work, and be stopped once."""
        clock.work(count)
        clock.now += 1.0 if len(clock.parts) == 2 else 0.0

    found = estimated_seconds(disturbed, 1_000_000, clock=lambda: clock.now)
    assert found == pytest.approx(10.0)


def test_the_part_is_never_larger_than_the_whole() -> None:
    clock = Clock(1e-9)
    assert estimated_seconds(clock.work, 50, clock=lambda: clock.now) == pytest.approx(5e-8)
    assert max(clock.parts) == 50


def test_negligible_work_is_not_measured_further() -> None:
    clock = Clock(1e-6)
    estimated_seconds(clock.work, 100_000, negligible=1.0, clock=lambda: clock.now)
    assert clock.parts == [16, 16, 16]


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.123, "0.12 s"),
        (5.0, "5 s"),
        (110.0, "110 s"),
        (150.0, "2.5 minutes"),
        (2400.0, "40 minutes"),
        (10_000.0, "2.8 hours"),
        (1e6, "12 days"),
        (1e12, "> 999 days"),
    ],
)
def test_durations_in_words(seconds: float, words: str) -> None:
    assert in_words(seconds) == words
