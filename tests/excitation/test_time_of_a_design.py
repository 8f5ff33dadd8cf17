"""A design ends at its time: `seconds = 120` means 120.

The clock of these tests counts the engine steps of all simulations, so that they do not depend on
the speed of the computer.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.parallel.budget import Budget, StopToken, measured_by
from mjfim.plant import batch
from mjfim.records.design import Status, is_playable, keeps_limits
from mjfim.records.events import DesignEvent
from tests.support.limits import arm_task, cart_inside
from tests.support.stiff_servos import dry_arm_experiment, stiff_arm_task

# Speed of the simulation on this clock [engine steps / s].
STEPS_PER_SECOND = 1e5

# A search that only its time ends.
ENDLESS = {"max_iterations": 100_000, "tolerance": 1e-14}


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """The clock of all budgets, which engine steps move on."""
    made = []

    def counter(**fields: int) -> SimpleNamespace:
        """The counter of one plant."""
        made.append(SimpleNamespace(**fields))
        return made[-1]

    def now() -> float:
        """Time [s]."""
        return sum(each.steps for each in made) / STEPS_PER_SECOND

    monkeypatch.setattr(batch, "SimpleNamespace", counter)
    with measured_by(now):
        yield now


def weights(folder: Path, descent: Any) -> DesignTask:
    """Without limits."""
    return cart_inside(folder, limits={}, cost={"control": 1e-3}, descent=descent)


def limits(folder: Path, descent: Any) -> DesignTask:
    """Hard limits, on the stated time grid only."""
    return cart_inside(folder, descent={**descent, "coarse": 1})


def starts(folder: Path, descent: Any) -> DesignTask:
    """Hard limits and four initial controls in two rounds, the first one on a coarse level."""
    return cart_inside(folder, descent={**descent, "starts": 4})


def far_outside(folder: Path, descent: Any) -> DesignTask:
    """An initial control far outside its limits, in whose place random ones are tried."""
    return stiff_arm_task(folder, descent=descent)


@pytest.mark.parametrize(
    ("make", "seconds"),
    [
        (weights, 0.3),
        pytest.param(limits, 0.6, marks=pytest.mark.slow),
        pytest.param(starts, 0.4, marks=pytest.mark.slow),
        pytest.param(far_outside, 2.0, marks=pytest.mark.slow),
    ],
)
def test_a_design_uses_its_time_and_not_much_more(
    make: Any, seconds: float, clock: Any, tmp_path: Path
) -> None:
    """Beyond its time, it ends the iteration and verifies the result."""
    task = make(tmp_path, {**ENDLESS, "seconds": seconds})
    # The rehearsal comes after the time of the search.
    task = task.restated(task.experiment.replace(rehearsal={"robots": 0}))
    begun = clock()
    design = design_task(task)
    # What sensors tell and finite steps come after it as well: the sensitivities with two longer
    # difference steps.
    sensing = 4 * len(task.theta) * task.samples * task.system.grid.substeps
    used = clock() - begun - sensing / STEPS_PER_SECOND
    assert design.status is Status.MAX_ITERATIONS
    assert 0.9 * seconds < used < 1.2 * seconds
    assert is_playable(design)


# ---- time for few evaluations


def resting_arm(folder: Path, descent: Any) -> DesignTask:
    """An arm that has to come to rest, whose initial control leaves its limits by far."""
    bound = (-1.0, 1.0)
    return arm_task(
        folder,
        horizon=1.0,
        parameters={
            "m": "body/fore:mass",
            "c": "joint/elbow:damping",
            "a": "joint/shoulder:armature",
        },
        boundary={"end": "rest", "position": 1e-3, "velocity": 1e-2},
        limits={
            "position": {"shoulder": bound, "elbow": bound},
            "velocity": 6.0,
            "control_rate": 20.0,
        },
        control={"kind": "sine", "amplitude": 0.1, "frequency": 1.0},
        descent=descent,
    )


def small_control(folder: Path, descent: Any) -> DesignTask:
    """A control far within its limits, with a weight."""
    limits = {"position": {"slide": (-1.0, 1.0)}}
    return cart_inside(folder, limits=limits, cost={"control": 1e-5}, descent=descent)


@pytest.mark.parametrize(
    ("make", "evaluations", "bound"), [(resting_arm, 17, 10.0), (small_control, 8, 0.04)]
)
def test_the_time_of_few_evaluations_is_enough_for_a_good_control(
    make: Any, evaluations: int, bound: float, clock: Any, tmp_path: Path
) -> None:
    """The coarse level gets most of the time; without that, J of the arm is 51140."""
    task = make(tmp_path, {})
    begun = clock()
    task.problem.point(task.initial)
    evaluation = clock() - begun
    design = design_task(make(tmp_path, {**ENDLESS, "seconds": evaluations * evaluation}))
    assert is_playable(design)
    assert design.final.cost < bound


@pytest.mark.slow
def test_a_stop_during_the_descent_leaves_the_best_random_control(tmp_path: Path) -> None:
    """A descent begins from the initial control; what was found before must not be lost."""
    stop = StopToken()
    costs = []

    def stop_at_the_descent(event: DesignEvent) -> None:
        """Stop at the first iterate with a barrier."""
        if event.row.mu > 0.0:
            stop.request()
        else:
            costs.append(event.row.cost)

    task = DesignTask.resolve(dry_arm_experiment(tmp_path), threads=1)
    design = design_task(task, callback=stop_at_the_descent, budget=Budget(stop=stop))
    assert design.status is Status.INTERRUPTED
    assert min(costs) < 0.3 * design.initial.cost
    assert design.final.cost == pytest.approx(min(costs), rel=1e-6)
    assert keeps_limits(design)
