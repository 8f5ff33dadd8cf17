"""What a coarse level has found is brought inside the limits with few simulations."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjfim.budget import Budget, StopToken, measured_by
from mjfim.excitation.controls_within_limits import ControlsWithinLimits, LimitedCost
from mjfim.excitation.corrected_shares import CorrectedShare, CorrectedShares
from mjfim.excitation.end_correction import EndCorrection
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.limited_searches import LimitedSearches
from mjfim.excitation.multistart import Multistart
from mjfim.excitation.rounds import Entry, Judgement
from mjfim.excitation.run_result import RunResult
from mjfim.excitation.running_rounds import EndedSearch, RunningRounds
from mjfim.excitation.stated_comparison import LargestShare, StatedComparison
from mjfim.excitation.task import DesignTask
from mjfim.plant.derivatives import Derivatives
from tests.support.limits import cart_inside
from tests.support.numerics import make_task
from tests.support.resting_arm import resting_arm


def cost_of(task: DesignTask) -> LimitedCost:
    """Cost of controls that keep all limits of a task."""
    return LimitedCost(level=DescentLevel(task.relaxed(), None))


def found_by(control: Any) -> RunResult:
    """A result of a coarse level."""
    return RunResult(name="x", control=control, cost=1.0)


def start_at(control: Any, **keys: Any) -> InitialControl:
    """A start."""
    return InitialControl(name="x", control=control, **keys)


# ---- corrected ends


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
    result = (
        LargestShare(budget=Budget())
        .judged(cost, found, InitialControl(name="x", control=missing))
        .result
    )
    centre = task.centre
    plain = ControlsWithinLimits(cost=cost, budget=Budget()).largest(centre, missing - centre)
    assert plain is None
    assert result.control is not None and cost(result.control) == result.cost
    assert np.linalg.norm(result.control - centre) > 0.5 * np.linalg.norm(missing - centre)


# A slide behind a filter.
FILTERED_SLIDE = """
<mujoco model="slide">
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint name="slide" type="slide" axis="1 0 0" stiffness="1" damping="0.1"/>
      <geom type="sphere" size="0.05" mass="1"/>
    </body>
  </worldbody>
  <actuator>
    <general name="force" joint="slide" dyntype="filter" dynprm="0.05"/>
  </actuator>
</mujoco>
"""


def slide_to_rest(folder: Path, horizon: float = 0.5, **tables: Any) -> DesignTask:
    """A slide that has to end at rest, and whose actuator has an activation."""
    defaults: dict[str, Any] = {
        "horizon": horizon,
        "rate": 100.0,
        "parameters": {"c": {"target": "joint/slide:damping"}},
        "noise": {"qpos:slide": 0.01},
        "boundary": {"end": "rest", "position": 1e-3, "velocity": 1e-2},
        "limits": {"control": {"force": (-5.0, 5.0)}},
        "initial": {"control": {"kind": "sine", "amplitude": 1.0, "frequency": 1.0}},
    }
    return make_task(FILTERED_SLIDE, folder, **{**defaults, **tables})


def test_a_corrected_control_keeps_its_bandwidth(tmp_path: Path) -> None:
    limits = {"control": {"force": (-5.0, 5.0)}, "bandwidth": 8.0}
    task = slide_to_rest(tmp_path, limits=limits)
    cost = cost_of(task)
    trials = ControlsWithinLimits(cost=cost, budget=Budget())
    values = cost.values(task.centre + trials.fitted(task.control - task.centre))
    assert values is not None
    correction = EndCorrection.along(cost, values)
    assert correction is not None

    deviation = correction.corrected(values.trajectory.ctrl, values) - task.centre
    assert trials.fitted(deviation) == pytest.approx(deviation, abs=1e-9)
    corrected = cost.values(task.centre + deviation)
    assert corrected is not None
    assert cost.constraints.relative_margins(values)["end_velocity"] < 0.0
    assert cost.constraints.relative_margins(corrected)["end_velocity"] > 0.5


def test_activations_at_the_end_are_free(tmp_path: Path) -> None:
    task = slide_to_rest(tmp_path)
    cost = cost_of(task)
    values = cost.values(task.control)
    assert values is not None and task.space.na == 1
    correction = EndCorrection.along(cost, values)
    assert correction is not None and correction.change.shape == (50, 1, 2)
    assert correction.corrected(task.control, values).shape == (50, 1)


def test_an_unstable_motion_whose_derivatives_overflow_has_no_correction(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cost = cost_of(slide_to_rest(tmp_path, 2.0))
    values = cost.values(cost.level.task.control)
    assert values is not None
    stable = Derivatives.observation_jacobians

    def unstable(*args: Any) -> Any:
        """Derivatives along a motion whose deviations grow by a factor of 100 in each sample."""
        A, B, observed = stable(*args)
        return 100.0 * A, B, observed

    monkeypatch.setattr(Derivatives, "observation_jacobians", unstable)
    assert EndCorrection.along(cost, values) is None


# ---- shares


def test_the_largest_corrected_share_is_found_to_a_ratio(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The shares that are tried first are 0.72 and 0.55."""

    def corrected(shares: CorrectedShares, share: float) -> CorrectedShare | None:
        """Shares up to 0.7 keep the limits."""
        control = np.zeros((1, 1))
        return CorrectedShare(share=share, control=control) if share <= 0.7 else None

    monkeypatch.setattr(CorrectedShares, "_corrected", corrected)
    task = slide_to_rest(tmp_path)
    found = list(CorrectedShares(cost_of(task), task.control, StopToken()).largest())
    assert 0.7 / 1.05 <= found[0].share <= 0.7
    assert [each.share for each in found] == sorted((each.share for each in found), reverse=True)


def test_without_an_end_the_share_is_bisected_alone(tmp_path: Path) -> None:
    task = cart_inside(tmp_path)
    cost, control = cost_of(task), 3.0 * task.control
    judge = LargestShare(budget=Budget(), compares_begin=False)
    result = judge.judged(cost, found_by(control), start_at(task.control)).result
    trials = ControlsWithinLimits(cost=cost, budget=Budget())
    largest = trials.largest(task.centre, control - task.centre)
    assert largest is not None
    assert np.array_equal(result.control, largest.control)


def test_a_cheaper_initial_control_of_a_further_start_is_kept(tmp_path: Path) -> None:
    """An earlier design, for example, may cost less; here the smaller control does."""
    task = cart_inside(tmp_path)
    cost = cost_of(task)
    begun, found = start_at(0.1 * task.control), found_by(0.2 * task.control)
    judgement = LargestShare(budget=Budget()).judged(cost, found, begun)
    assert np.array_equal(judgement.result.control, begun.control)
    assert judgement.following is not None
    assert np.array_equal(judgement.following.control, begun.control)
    assert judgement.cost == judgement.result.cost == cost(begun.control)

    # The control of the coarse level stays where it costs less, or where nothing is compared.
    swapped = LargestShare(budget=Budget()).judged(
        cost, found_by(begun.control), start_at(found.control)
    )
    assert swapped.result.control == pytest.approx(begun.control)
    alone = LargestShare(budget=Budget(), compares_begin=False).judged(cost, found, begun)
    assert alone.result.control == pytest.approx(found.control)


def test_jumps_of_longer_samples_are_smoothed_where_rates_are_limited(tmp_path: Path) -> None:
    curve = np.sin(2.0 * np.pi * np.arange(100) / 100.0)
    task = cart_inside(tmp_path, limits={"control": {"force": (-5.0, 5.0)}, "control_rate": 0.5})
    stairs = 0.06 * np.repeat(curve[2::5], 5)[:, None]
    cost = cost_of(task)
    assert len(stairs) == task.samples

    sizes = []
    for factor in (1, 5):
        judge = LargestShare(budget=Budget(), sample_factor=factor, compares_begin=False)
        result = judge.judged(cost, found_by(task.centre + stairs), start_at(task.control)).result
        assert np.isfinite(result.cost)
        sizes.append(np.abs(result.control - task.centre).max())
    assert sizes[1] > 2.0 * sizes[0]


def test_a_request_to_stop_ends_the_trials_of_shares(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = slide_to_rest(tmp_path)
    cost = cost_of(task)
    budget, simulate, calls = Budget(), LimitedCost.values, []

    def stopping(self: LimitedCost, control: Any) -> Any:
        """Simulate, and press Ctrl-C."""
        calls.append(control)
        budget.stop.request()
        return simulate(self, control)

    monkeypatch.setattr(LimitedCost, "values", stopping)
    judgement = LargestShare(budget=budget).judged(
        cost, found_by(100.0 * task.control), start_at(task.control)
    )
    assert len(calls) <= 3
    assert np.isinf(judgement.result.cost) and judgement.result.control is not None


# ---- rounds


def plan_of(
    task: DesignTask, coarse: DesignTask | None, seconds: float, *starts: InitialControl
) -> Multistart:
    """Rounds of a design whose time allows few evaluations."""
    return Multistart(
        searches=LimitedSearches(
            stated=DescentLevel(task.relaxed(), None),
            executor=None,
            budget=Budget(seconds=seconds),
        ),
        starts=starts,
        coarse=None if coarse is None else DescentLevel(coarse.relaxed(), None),
        is_brief=True,
    )


def test_only_a_quicker_level_gets_most_of_the_time(tmp_path: Path) -> None:
    task = resting_arm(tmp_path, {})
    starts = [start_at(task.control), start_at(0.5 * task.control)]
    entries = [Entry(number=i, index=i, round=0, start=start) for i, start in enumerate(starts)]

    smoother = plan_of(task, task.smoothed(), 100.0, *starts)
    assert isinstance(smoother.judge(entries[0]), StatedComparison)
    quicker = plan_of(task, task.stretched(5), 100.0, *starts)
    judges = [quicker.judge(entry) for entry in entries]

    # The control of the first start is compared with the design in the end.
    assert all(isinstance(judge, LargestShare) for judge in judges)
    assert [judge.compares_begin for judge in judges] == [False, True]
    assert pickle.loads(pickle.dumps(judges[1])).compares_begin
    longer = plan_of(task, task.coarser(2), 100.0, *starts).judge(entries[0])
    assert isinstance(longer, LargestShare) and longer.sample_factor == 2


def test_a_second_round_leaves_the_reserved_time(tmp_path: Path) -> None:
    task = resting_arm(tmp_path, {"seconds": 100.0})
    start = start_at(task.control)
    with measured_by(lambda: 0.0):
        plan = plan_of(task, task.stretched(5), 100.0, start)
    steps = task.samples * task.system.grid.substeps
    for iteration, may_begin in ((47.0, True), (48.0, False)):
        each = iteration / steps
        entry = Entry(number=0, index=0, round=1, start=start, seconds_per_step=each)
        assert plan.may_begin(entry, has_feasible=True) is may_begin


def test_the_time_of_an_iteration_of_a_repeated_part_is_that_of_one_repetition(
    tmp_path: Path,
) -> None:
    task = resting_arm(tmp_path, {})
    coarse = task.stretched(5)
    part = start_at(task.control[: task.samples // 2], repeats=2)
    rounds = RunningRounds(plan_of(task, coarse, np.inf, part), [part])
    entry = rounds.next_entry()
    assert entry is not None
    rounds.settle(
        EndedSearch(entry=entry, result=found_by(part.over_horizon), seconds=3.0),
        Judgement(
            result=found_by(part.over_horizon), following=start_at(part.over_horizon), cost=1.0
        ),
    )
    following = rounds.next_entry()
    assert following is not None
    steps = coarse.samples * coarse.system.grid.substeps
    assert following.seconds_per_step == pytest.approx(3.0 / (steps / 2))
