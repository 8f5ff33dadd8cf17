"""Initial controls far outside the limits: what they violate, and designs that are better."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mjfim.budget import Budget, StopToken
from mjfim.excitation.controls_within_limits import (
    ControlsWithinLimits,
    LimitedCost,
    limited_cost_of,
)
from mjfim.excitation.design import design_task
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.violations import all_violations_of
from mjfim.output.summaries.design import describe_design
from mjfim.output.summary_parts import Paragraph
from mjfim.records.design import Design, Status
from tests.support.stiff_servos import stiff_arm_task


def test_a_force_that_only_a_clamp_limits_is_a_violation_with_its_time(tmp_path: Path) -> None:
    task = stiff_arm_task(tmp_path)
    found = {violation.name: violation for violation in all_violations_of(task, task.initial)}
    assert set(found) == {"shoulder", "elbow"}

    # At the second sample the servo is behind by 0.3 sin(2 pi 0.02) rad, at 1000 N m/rad.
    shoulder = found["shoulder"]
    assert shoulder.clamped
    assert shoulder.since == pytest.approx(0.02, abs=0.005)
    assert shoulder.value > 30.0
    assert "force of shoulder would be" in str(shoulder)
    assert "without its clamp, above 3 (first at 0.02" in str(shoulder)


def test_the_scaled_initial_control_is_the_largest_share_that_keeps_all_limits(
    tmp_path: Path,
) -> None:
    task = stiff_arm_task(tmp_path)
    cost = LimitedCost(level=DescentLevel(task.relaxed(), None))
    inside = ControlsWithinLimits(cost=cost, budget=Budget()).scaled(task.control)
    assert inside is not None
    assert cost(inside.control) == inside.cost
    assert np.isinf(cost(inside.about + 1.06 * inside.deviation))
    assert np.allclose(inside.deviation, inside.share * (task.control - inside.about))


def test_a_known_initial_control_is_not_evaluated_again(tmp_path: Path) -> None:
    task = stiff_arm_task(tmp_path, 0.0005, horizon=0.4)
    stage = DescentLevel(task, None)
    first = stage.problem.point(task.initial)
    cost = limited_cost_of(stage, first)
    assert cost is not None
    assert cost.point(task.control) is first
    assert first.cost == pytest.approx(LimitedCost(level=cost.level)(task.control), rel=1e-6)

    # Another control is evaluated, and one outside limits has no point.
    other = task.centre + 0.9 * (task.control - task.centre)
    assert cost.point(other) is not first
    assert cost.point(task.centre + 1e3 * (task.control - task.centre)) is None


@pytest.mark.slow
def test_a_design_beats_the_scaled_initial_control_by_far_and_says_so(tmp_path: Path) -> None:
    task = stiff_arm_task(tmp_path)
    design = design_task(task)
    assert design.within_limits
    assert design.status is not Status.INFEASIBLE
    assert design.scaled_start is not None
    assert design.final.eigenvalues[0] > 10.0 * design.scaled_start.min_eigenvalue

    parts = describe_design(design, task.system.units).parts
    text = " ".join(part.text for part in parts if isinstance(part, Paragraph))
    assert "force of shoulder would be" in text
    assert "keeps all limits; the design is" in text
    assert design.summary()["scaled_start"]["share"] == design.scaled_start.share

    design.save(tmp_path / "out")
    assert Design.load(tmp_path / "out").scaled_start == design.scaled_start


@pytest.mark.slow
def test_a_design_that_is_stopped_at_once_is_not_outside(tmp_path: Path) -> None:
    """The scaled initial control is kept, however early the search ends."""
    task = stiff_arm_task(tmp_path)
    stop = StopToken()
    events = 0

    def stop_at_first(_: object) -> None:
        nonlocal events
        events += 1
        stop.request()

    design = design_task(task, callback=stop_at_first, budget=Budget(stop=stop))
    assert events >= 1
    assert design.scaled_start is not None
    assert LimitedCost(level=DescentLevel(task.relaxed(), None)).trajectory(design.trajectory.ctrl)
    assert design.final.cost <= design.scaled_start.cost


@pytest.mark.slow
def test_a_given_control_is_not_lost(tmp_path: Path) -> None:
    """A search that finds nothing better returns the control with which it began."""
    task = stiff_arm_task(tmp_path)
    best = design_task(task)
    again = design_task(task, initial_control=best.trajectory.ctrl, budget=Budget(seconds=0.0))
    assert again.final.cost <= best.final.cost * (1.0 + 1e-6)
    assert again.within_limits
