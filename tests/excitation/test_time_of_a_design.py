"""A design ends at its time: `seconds = 120` means 120.

The clock of these tests counts the engine steps of all simulations, so that they do not depend on
the speed of the computer.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjfim.budget import Budget, measured_by
from mjfim.excitation.controls_within_limits import ControlsWithinLimits, LimitedCost
from mjfim.excitation.design import design_task
from mjfim.excitation.end_correction import EndCorrection
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.run_result import RunResult
from mjfim.excitation.short_budget import allows_few_evaluations
from mjfim.excitation.stated_comparison import LargestShare
from mjfim.excitation.task import DesignTask
from mjfim.plant.batch import StepCount
from mjfim.records.design import Status
from tests.support.limits import ARM, cart_inside
from tests.support.numerics import make_task
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


# ---- time for few evaluations

# An arm that has to come to rest, whose initial control leaves its limits by far.
RESTING_ARM = {
    "horizon": 1.0,
    "rate": 100.0,
    "parameters": {
        "m": {"target": "body/fore:mass"},
        "c": {"target": "joint/elbow:damping"},
        "a": {"target": "joint/shoulder:armature"},
    },
    "noise": {"qpos:shoulder": 0.01, "qpos:elbow": 0.01},
    "boundary": {"end": "rest", "position": 1e-3, "velocity": 1e-2},
    "limits": {
        "position": {"shoulder": (-1.0, 1.0), "elbow": (-1.0, 1.0)},
        "velocity": 6.0,
        "control_rate": 20.0,
    },
    "initial": {
        "control": {
            "kind": "sine",
            "amplitude": {"shoulder": 0.1, "elbow": 0.1},
            "frequency": 1.0,
        }
    },
}


def resting_arm(folder: Path, descent: dict[str, Any]) -> DesignTask:
    """An arm from rest to rest with five engine steps in each sample."""
    return make_task(ARM, folder, **{**RESTING_ARM, "descent": descent})


def small_control(folder: Path, descent: dict[str, Any]) -> DesignTask:
    """A control far within its limits, with a weight."""
    limits = {"position": {"slide": (-1.0, 1.0)}}
    return cart_inside(folder, limits=limits, cost={"control": 1e-5}, descent=descent)


@pytest.mark.parametrize(
    ("make", "evaluations", "bound"), [(resting_arm, 17, 10.0), (small_control, 8, 0.04)]
)
def test_the_time_of_few_evaluations_is_enough_for_a_good_control(
    make: Any, evaluations: int, bound: float, clock: StepClock, tmp_path: Path
) -> None:
    """The coarse level gets most of the time; without that, J of the arm is 51140."""
    task = make(tmp_path, {})
    begun = clock()
    task.problem.point(task.initial)
    evaluation = clock() - begun
    design = design_task(make(tmp_path, {**ENDLESS, "seconds": evaluations * evaluation}))
    assert design.sound
    assert design.final.cost < bound


def test_iterations_alone_never_make_a_design_brief() -> None:
    assert not allows_few_evaluations(Budget(iterations=1), 1e9)
    assert allows_few_evaluations(Budget(seconds=10.0), 1.0)
    assert not allows_few_evaluations(Budget(seconds=10.0), 0.1)


def test_a_control_that_misses_the_end_a_little_keeps_nearly_all_of_its_size(
    tmp_path: Path,
) -> None:
    """Without the correction, no share of the control keeps the tolerances."""
    task = resting_arm(tmp_path, {})
    cost = LimitedCost(level=DescentLevel(task.relaxed(), None))
    missing = task.centre + 0.5 * (task.control - task.centre)
    values = cost.values(missing)
    assert values is not None and cost.constraints.end is not None
    before = cost.constraints.relative_margins(values)["end_velocity"]
    assert before < -1.0

    correction = EndCorrection.along(cost, values)
    assert correction is not None
    corrected = cost.values(correction.corrected(missing, values))
    assert corrected is not None
    assert cost.constraints.relative_margins(corrected)["end_velocity"] > 0.5
    assert cost.constraints.relative_margins(corrected)["end_position"] > 0.5

    found = RunResult(name="x", control=missing, cost=1.0)
    result = LargestShare().judged(cost, found, InitialControl(name="x", control=missing)).result
    centre = task.centre
    plain = ControlsWithinLimits(cost=cost, budget=Budget()).largest(centre, missing - centre)
    assert plain is None
    assert result.control is not None and cost(result.control) == result.cost
    assert np.linalg.norm(result.control - centre) > 0.5 * np.linalg.norm(missing - centre)
