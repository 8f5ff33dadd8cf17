"""A design ends at its time: `seconds = 120` means 120.

The clock of these tests counts the engine steps of all simulations, so that they do not depend on
the speed of the computer.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from mjfim.budget import measured_by
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.plant.batch import StepCount
from mjfim.records.design import Status
from tests.support.limits import cart_inside
from tests.support.stiff_servos import stiff_arm_task

# Speed of the simulation on this clock [engine steps / s].
STEPS_PER_SECOND = 1e5

# A search that only its time ends.
ENDLESS = {"max_iterations": 100_000, "tolerance": 1e-14}


class StepClock:
    """A clock that engine steps move on.

    Attributes:
        steps: Engine steps of all simulators so far.
    """

    def __init__(self) -> None:
        self.steps = 0

    def __call__(self) -> float:
        """Time [s]."""
        return self.steps / STEPS_PER_SECOND


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[StepClock]:
    """The clock of all budgets."""
    clock = StepClock()

    def read(count: Any) -> int:
        return int(count.__dict__.get("counted", 0))

    def write(count: Any, steps: int) -> None:
        clock.steps += steps - read(count)
        count.__dict__["counted"] = steps

    monkeypatch.setattr(StepCount, "steps", property(read, write), raising=False)
    with measured_by(clock):
        yield clock


def weights(folder: Path, descent: dict[str, Any]) -> DesignTask:
    """Without limits."""
    return cart_inside(folder, limits={}, cost={"control": 1e-3}, descent=descent)


def limits(folder: Path, descent: dict[str, Any]) -> DesignTask:
    """Hard limits, on the stated time grid only."""
    return cart_inside(folder, descent={**descent, "coarse": 1})


def starts(folder: Path, descent: dict[str, Any]) -> DesignTask:
    """Hard limits and four initial controls in two rounds, the first one on a coarse level."""
    return cart_inside(folder, descent={**descent, "starts": 4})


def far_outside(folder: Path, descent: dict[str, Any]) -> DesignTask:
    """An initial control far outside its limits, in whose place random ones are tried."""
    return stiff_arm_task(folder, descent=descent)


@pytest.mark.parametrize(
    ("make", "seconds"),
    [
        (weights, 0.2),
        pytest.param(limits, 0.6, marks=pytest.mark.slow),
        pytest.param(starts, 0.6, marks=pytest.mark.slow),
        pytest.param(far_outside, 2.0, marks=pytest.mark.slow),
    ],
)
def test_a_design_uses_its_time_and_not_much_more(
    make: Any, seconds: float, clock: StepClock, tmp_path: Path
) -> None:
    """Beyond its time, it ends the iteration and verifies the result."""
    task = make(tmp_path, {**ENDLESS, "seconds": seconds})
    begun = clock()
    design = design_task(task)
    used = clock() - begun
    assert design.status is Status.MAX_ITERATIONS
    assert 0.9 * seconds < used < 1.2 * seconds
    assert design.sound
