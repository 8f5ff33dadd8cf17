"""Designs under hard limits, verified by a plain loop around mj_step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.initial import spline_basis
from mjfim.output.pages import page_of
from mjfim.records.design import Design, Status, keeps_limits
from tests.support.cart_pendulum import cart_pendulum
from tests.support.limits import HARD, arm_task, cart_inside, excess_of, of_kind, played
from tests.support.numerics import (
    CART_PARAMETERS,
    Array,
    relative_error,
)
from tests.support.pages import sentences

# ---- the requirement


@pytest.mark.slow
def test_the_study_of_the_paper_under_hard_limits_beats_a_general_solver() -> None:
    """At its true values, within 5 N and 1 m, without other weights."""
    experiment = cart_pendulum()
    hard = {"control": {"force": [-5.0, 5.0]}, "position": {"slide": [-1.0, 1.0]}}
    limited = experiment.replace(cost={"control": 0.0, "tracking": {}}, limits=hard)
    paper = mjfim.design(limited)
    assert paper.status is Status.CONVERGED
    assert paper.status.success and keeps_limits(paper)
    assert paper.warnings == ()

    assert paper.final.eigenvalues[0] >= 399.0
    ctrl = paper.trajectory.ctrl

    # No engine step violates a limit. Both ranges are used, and the design says so.
    excess = excess_of(DesignTask.resolve(limited), ctrl)
    margins = {
        "control": -5.0 * of_kind(excess, "control"),
        "position": -of_kind(excess, "position"),
    }
    assert 0.0 <= min(margins.values()) <= max(margins.values()) < 0.01
    assert paper.limits == pytest.approx(margins, abs=1e-9)

    # The weight of the barrier falls on every level.
    for rate in {row.rate for row in paper.history}:
        weights = [row.mu for row in paper.history if row.rate == rate]
        assert weights == sorted(weights, reverse=True)


# ---- ways to the inside


def positions(task: DesignTask, ctrl: Array) -> Array:
    """Positions at every engine step of a plain loop."""
    start = task.space.split(task.plant.nominal_initial_state)[:2]
    return played(task.system.model, start, ctrl, task.system.grid.substeps)["q"]


def test_a_design_says_what_the_initial_control_violates_and_when(tmp_path: Path) -> None:
    wild = {"kind": "sine", "amplitude": 8.0, "frequency": 1.0}
    task = cart_inside(tmp_path, control=wild, descent={"max_iterations": 1, "coarse": 1})
    design = design_task(task)
    position = positions(task, task.control)[:, 0]
    beyond = np.maximum(position - 0.5, -0.3 - position)
    worst, first = int(np.argmax(beyond)), np.flatnonzero(beyond > 0.0)[0]
    found = {v.kind: v for v in design.initial_violations}
    slide, step = found["position"], task.dt / task.system.grid.substeps
    assert slide.value == pytest.approx(position[worst], abs=1e-6)
    assert (slide.t, slide.since) == pytest.approx(((worst + 1) * step, (first + 1) * step))

    first = np.flatnonzero(np.abs(task.control[:, 0]) > 5.0)[0]
    assert abs(found["control"].value) == pytest.approx(np.abs(task.control).max())
    assert found["control"].since == pytest.approx(first * task.dt)

    # The summary and the JSON name joint, value and time.
    said = f"position of slide is {slide.value:.4g} m at {slide.t:.4g} s, above 0.5"
    assert said in sentences(page_of(design))
    kinds = {entry["kind"] for entry in design.summary()["limits"]["initial"]}
    assert kinds == found.keys()


# ---- more iterations


@pytest.mark.slow
def test_more_iterations_never_give_less(tmp_path: Path) -> None:
    """The result is the best feasible iterate of the run, and a larger budget improves on it."""
    costs = []
    for iterations, reached in ((8, Status.MAX_ITERATIONS), (200, Status.CONVERGED)):
        rows, descent = [], {"max_iterations": iterations, "coarse": 1}
        task = cart_inside(tmp_path, horizon=0.4, descent=descent)
        design = design_task(task, callback=lambda event, rows=rows: rows.append(event.row))
        seen = min(row.cost for row in rows if row.margin >= 0.0)
        assert design.final.cost <= seen * (1 + 1e-4)
        assert design.status is reached
        costs.append(design.final.cost)
    assert costs[1] < costs[0]


# ---- how a design begins, ends and moves


def arm_design(folder: Path, **tables: Any) -> tuple[DesignTask, Design]:
    """The arm of two servos for half a second, held at rest against gravity, and its design."""
    bound = (-1.0, 1.0)
    limits = {
        "control": {"shoulder": bound, "elbow": bound},
        "control_rate": 6.0,
        **tables.pop("limits", {}),
    }
    defaults = {
        "control": {"kind": "sine", "amplitude": 0.1, "frequency": 2.0},
        "cost": {"control": 0.0},
        "descent": {"max_iterations": 8, "coarse": 1},
    }
    task = arm_task(folder, **{**defaults, **tables, "limits": limits})
    return task, design_task(task)


def assert_arm(task: DesignTask, design: Design, ends: tuple[Array, Array]) -> None:
    """Ranges and rates of the control hold, and the arm moves and ends at rest.

    The control continues the first of the ends and is continued by the second.
    """
    ctrl = design.trajectory.ctrl
    assert max(excess_of(task, ctrl).values()) <= 0.0
    assert np.abs(np.diff([ends[0], *ctrl, ends[1]], axis=0)).max() / task.dt <= 6.0
    assert design.final.cost < design.initial.cost
    assert np.abs(design.trajectory.qpos).max() > 0.1


def standstill(task: DesignTask) -> Array:
    """Control that holds the arm at zero, by inverse dynamics: (2,)."""
    data = mujoco.MjData(task.system.model)
    mujoco.mj_inverse(task.system.model, data)
    return np.array(data.qfrc_inverse) / np.array([40.0, 25.0])


@pytest.mark.slow
def test_a_periodic_design_can_be_repeated(tmp_path: Path) -> None:
    """Its control does not jump between repetitions, and its state returns to the first one."""
    task, design = arm_design(
        tmp_path, boundary={"end": "periodic", "position": 0.005, "velocity": 0.05}
    )
    ctrl = design.trajectory.ctrl
    assert_arm(task, design, (ctrl[0], ctrl[0]))
    twice = positions(task, np.concatenate([ctrl, ctrl]))
    assert np.abs(np.diff(np.split(twice, 2), axis=0)).max() < 0.05


@pytest.mark.parametrize("coarse", [pytest.param(1, marks=pytest.mark.slow), "auto"])
def test_a_design_of_limited_bandwidth_is_made_of_its_splines(coarse: Any, tmp_path: Path) -> None:
    """It is so on the stated samples, also when the design began on the coarse level.

    From rest, its first control holds the initial state, and its slope is zero there.
    """
    boundary = {"start": "rest", "end": "rest", "position": 0.02, "velocity": 0.1}
    task, design = arm_design(
        tmp_path,
        boundary=boundary,
        limits={"bandwidth": 9.0},
        descent={"max_iterations": 8, "coarse": coarse},
    )
    hold, ctrl = standstill(task), design.trajectory.ctrl
    basis = spline_basis(task.t, 0.5, 9.0, True, True, False)
    assert basis.shape[1] == 8
    swing = ctrl - task.initial_hold
    assert relative_error(basis @ np.linalg.lstsq(basis, swing)[0], swing) < 1e-9
    assert_allclose(ctrl[0], hold, rtol=0, atol=1e-6)
    assert np.abs(ctrl[1] - ctrl[0]).max() < 0.05 * np.ptp(ctrl)
    assert_arm(task, design, (hold, hold))


WIDE = {"control": {"force": (-50.0, 50.0)}, "position": {"slide": (-9.0, 9.0)}}
RESTING = {
    "boundary": {"start": "rest", "end": "rest"},
    "limits": {**HARD, "control_rate": 200.0},
    "initial": {
        "qpos": (0.0, np.pi),
        "control": {"kind": "sine", "amplitude": 2.0, "frequency": 0.9},
    },
}


@pytest.mark.parametrize(
    ("count", "tables"),
    [
        (2, {"limits": WIDE, "cost": {"control": 1e-3}}),
        (4, {"limits": WIDE, "rate": 100.0}),
        pytest.param(2, RESTING, marks=pytest.mark.slow),
    ],
    ids=["weights", "odd samples", "rest to rest"],
)
def test_a_shorter_design_played_several_times_is_a_start(
    tmp_path: Path, count: int, tables: Any
) -> None:
    """A part of the horizon has about as much information per second; costs hold for all of it."""
    descent = {"repeats": (count,), "max_iterations": 4}
    task = cart_inside(tmp_path, descent=descent, **tables)
    design = design_task(task)
    shorter = f"{count} times a design of {1.0 / count:g} s"
    assert [start.name for start in design.starts] == ["initial control", shorter]
    assert min(start.iterations for start in design.starts) > 0
    assert len(design.trajectory.ctrl) == task.samples
    assert min(design.limits.values()) >= 0.0
    assert design.final.cost == min(start.cost for start in design.starts)
    assert tables is RESTING or design.final.cost < design.initial.cost


ROBUST = {
    "robust": {"samples": 2},
    "parameters": {**CART_PARAMETERS, "m": {**CART_PARAMETERS["m"], "prior": 0.3}},
}
COMBINATION = {"criterion": "c", "combination": {"m": 1.0, "c": -0.5}}


@pytest.mark.parametrize(
    "tables",
    [{"cost": {"criterion": "A"}}, {"cost": {"criterion": "D"}}, {"cost": COMBINATION}, ROBUST],
    ids=["A", "D", "c", "robust"],
)
@pytest.mark.slow
def test_every_criterion_improves_within_limits(tmp_path: Path, tables: Any) -> None:
    cost = {"control": 0.0, **tables.get("cost", {})}
    task = cart_inside(tmp_path, **{**tables, "cost": cost, "descent": {"max_iterations": 6}})
    design = design_task(task)
    inside = task.plant.simulate(task.theta, 0.2 * task.control)
    first = task.problem.point(inside).cost
    assert design.final.cost < (first - 1.0 if cost.get("criterion") == "D" else 0.7 * first)
    assert max(excess_of(task, design.trajectory.ctrl).values()) <= 0.0
    assert min(design.limits.values()) >= 0.0
