"""Designs under hard limits, verified by a plain loop around mj_step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import mjfim
from mjfim.excitation.design import design_task
from mjfim.excitation.search.levels import bandwidth_basis
from mjfim.excitation.task import DesignTask
from mjfim.experiment.initial import spline_basis
from mjfim.output.pages import page_of
from mjfim.records.design import Design, Status, keeps_limits
from tests.support.cart_pendulum import cart_pendulum
from tests.support.limits import ARM, HARD, cart_inside, distances_of_arm, played
from tests.support.numerics import (
    CART_PARAMETERS,
    CART_PENDULUM,
    Array,
    make_task,
    relative_error,
)
from tests.support.pages import sentences
from tests.support.paths import MODELS

# ---- the requirement


@pytest.mark.slow
def test_the_study_of_the_paper_under_hard_limits_beats_a_general_solver() -> None:
    """At its true values, within 5 N and 1 m, without other weights."""
    experiment = cart_pendulum()
    hard = {"control": {"force": [-5.0, 5.0]}, "position": {"slide": [-1.0, 1.0]}}
    paper = mjfim.design(experiment.replace(cost={"control": 0.0, "tracking": {}}, limits=hard))
    assert paper.status is Status.CONVERGED
    assert paper.status.success and keeps_limits(paper)
    assert paper.warnings == ()

    # Information per second, independent of the package: finite differences of plain loops.
    model = mujoco.MjModel.from_xml_path(str(MODELS / "cart_pendulum.xml"))
    start, ctrl = (model.key("hanging").qpos.copy(), np.zeros(2)), paper.trajectory.ctrl
    bob, columns, h = model.body("bob").id, [], 1e-5
    for array, place in (
        (model.body_mass, bob),
        (model.body_pos, (bob, 2)),
        (model.dof_damping, 1),
    ):
        ends, value = [], float(array[place])
        for moved in (value + h, value - h):
            array[place] = moved
            rows = played(model, start, ctrl, 1)
            ends.append(np.concatenate([rows["q"], rows["v"]], axis=1))
        array[place] = value
        columns.append((ends[0] - ends[1]).reshape(-1) / (2 * h * 0.05))
    G = np.array(columns).T
    eigenvalues = np.linalg.eigvalsh(G.T @ G) / 100.0
    assert eigenvalues[0] >= 399.0
    np.testing.assert_allclose(eigenvalues, paper.final.eigenvalues, rtol=1e-4)

    # No engine step violates a limit. Both ranges are used, and the design says so.
    slide = played(model, start, ctrl, 1)["q"][:, 0]
    margins = {"control": 5.0 - np.abs(ctrl).max(), "position": 1.0 - np.abs(slide).max()}
    assert 0.0 <= min(margins.values()) <= max(margins.values()) < 0.01
    assert paper.limits == pytest.approx(margins, abs=1e-9)

    # The weight of the barrier falls on every level.
    for rate in {row.rate for row in paper.history}:
        weights = [row.mu for row in paper.history if row.rate == rate]
        assert weights == sorted(weights, reverse=True)
    last = paper.history[-1]
    assert last.margin >= 0.0
    assert last.margins.keys() == margins.keys() and min(last.margins.values()) == last.margin


# ---- ways to the inside


def assert_inside(task: DesignTask, ctrl: Array) -> None:
    """Every range of the cart-pendulum holds at every engine step of a plain loop."""
    start = task.space.split(task.plant.nominal_initial_state)[:2]
    rows, places = (
        played(task.system.model, start, ctrl, task.system.grid.substeps),
        {"position": "q", "velocity": "v", "acceleration": "a"},
    )
    for limit in task.limits:
        values = ctrl if limit.kind == "control" else rows[places.get(limit.kind, "f")]
        assert limit.lower <= values[:, limit.index].min(), limit
        assert values[:, limit.index].max() <= limit.upper, limit


def test_a_design_says_what_the_initial_control_violates_and_when(tmp_path: Path) -> None:
    wild = {"kind": "sine", "amplitude": 8.0, "frequency": 1.0}
    task = cart_inside(tmp_path, control=wild, descent={"max_iterations": 1, "coarse": 1})
    design = design_task(task)
    start = task.space.split(task.plant.nominal_initial_state)[:2]
    substeps = task.system.grid.substeps
    rows = played(task.system.model, start, task.control, substeps)
    step = task.dt / substeps

    found = {(v.kind, v.name): v for v in design.initial_violations}
    control = found["control", "force"]
    assert control.value == pytest.approx(np.abs(task.control).max() * np.sign(control.value))
    assert (control.lower, control.upper) == (-5.0, 5.0)
    outside = np.flatnonzero(np.abs(task.control[:, 0]) > 5.0)
    assert control.since == pytest.approx(outside[0] * task.dt)

    slide = found["position", "slide"]
    beyond = np.maximum(rows["q"][:, 0] - 0.5, -0.3 - rows["q"][:, 0])
    worst = int(np.argmax(beyond))
    assert slide.value == pytest.approx(rows["q"][worst, 0], abs=1e-6)
    assert slide.t == pytest.approx((worst + 1) * step)
    assert slide.since == pytest.approx((np.flatnonzero(beyond > 0.0)[0] + 1) * step)

    # The summary and the JSON name joint, value and time.
    text = sentences(page_of(design))
    said = f"position of slide is {slide.value:.4g} m at {slide.t:.4g} s, above 0.5"
    assert said in text
    kinds = [entry["kind"] for entry in design.summary()["limits"]["initial"]]
    assert set(kinds) == {kind for kind, _ in found}
    design.save(tmp_path)
    assert Design.load(tmp_path).initial_violations == design.initial_violations


@pytest.mark.slow
def test_there_is_no_barrier_where_weights_keep_the_limits(tmp_path: Path) -> None:
    """The design equals that without limits.

    A design that leaves the limits continues with a barrier, from its last feasible control.
    """
    heavy = {"horizon": 0.5, "cost": {"control": 0.05}, "descent": {"max_iterations": 20}}
    wide = {"control": {"force": (-30.0, 30.0)}, "position": {"slide": (-3.0, 3.0)}}
    kept = design_task(cart_inside(tmp_path, limits=wide, **heavy))
    free = design_task(cart_inside(tmp_path, limits={}, **heavy))
    assert kept.final.cost == free.final.cost
    assert {row.mu for row in kept.history} == {0.0}
    assert np.isnan(kept.history[-1].margin)
    left = design_task(
        cart_inside(
            tmp_path, **{**heavy, "cost": {"control": 1e-3}, "descent": {"max_iterations": 6}}
        )
    )
    assert left.history[-1].mu > 0.0
    assert left.found_by == "initial control"
    assert min(left.limits.values()) >= 0.0


@pytest.mark.parametrize("weight", [1e-3, {"force": 1e-5}], ids=["one", "named"])
@pytest.mark.slow
def test_a_design_does_not_use_a_clamp(weight: Any, tmp_path: Path) -> None:
    """A force that only a clamp keeps within its range violates its limit."""
    weak = CART_PENDULUM.format(integrator="RK4").replace(
        'joint="slide"/>', 'joint="slide" forcerange="-1.5 1.5"/>'
    )
    control = {"kind": "sine", "amplitude": 1.0, "frequency": 0.9}
    task = make_task(
        weak,
        tmp_path,
        horizon=1.0,
        parameters={"m": {"target": "body/bob:mass"}, "c": {"target": "joint/hinge:damping"}},
        noise={"state": 0.05},
        initial={"qpos": (0.0, 3.0), "control": control},
        cost={"control": weight},
        descent={"max_iterations": 12},
    )
    design = design_task(task)

    start = (np.array([0.0, 3.0]), np.zeros(2))
    rows = played(task.system.model, start, design.trajectory.ctrl, task.system.grid.substeps)
    assert 1.2 < np.abs(rows["f"]).max() < 1.5
    assert 0.0 < design.limits["force"] < 0.3
    assert not any("clamp" in sentence for sentence in design.warnings)


# ---- more iterations


@pytest.mark.slow
def test_more_iterations_never_give_less(tmp_path: Path) -> None:
    """The result is the best feasible iterate of the run, and a larger budget improves on it."""
    costs = {}
    for iterations in (8, 200):
        rows = []
        descent = {"max_iterations": iterations, "coarse": 1}
        task = cart_inside(tmp_path, horizon=0.4, descent=descent)
        design = design_task(task, callback=lambda event, rows=rows: rows.append(event.row))
        seen = min(row.cost for row in rows if row.margin >= 0.0)
        assert design.final.cost <= seen * (1 + 1e-4)
        costs[iterations] = design.final.cost
        reached = Status.MAX_ITERATIONS if iterations == 8 else Status.CONVERGED
        assert design.status is reached
    assert costs[200] < costs[8]


# ---- how a design begins, ends and moves


def arm_design(folder: Path, **tables: Any) -> tuple[DesignTask, Design]:
    """The arm of two servos for half a second, held at rest against gravity, and its design."""
    defaults = {
        "horizon": 0.5,
        "parameters": {"m": {"target": "body/fore:mass"}, "c": {"target": "joint/elbow:damping"}},
        "noise": {"qpos:shoulder": 0.01, "qpos:elbow": 0.01},
        "control": {"kind": "sine", "amplitude": 0.1, "frequency": 2.0},
        "cost": {"control": 0.0},
        "descent": {"max_iterations": 8, "coarse": 1},
    }
    limits = {
        "control": {"shoulder": (-1.0, 1.0), "elbow": (-1.0, 1.0)},
        "control_rate": 6.0,
        **tables.pop("limits", {}),
    }
    task = make_task(ARM, folder, **{**defaults, **tables, "limits": limits})
    return task, design_task(task)


def assert_arm(
    task: DesignTask, design: Design, before: Array | None, after: Array | None
) -> dict[str, Array]:
    """Ranges and rates of the control hold; returns the motion in a plain loop."""
    ctrl, dt = design.trajectory.ctrl, task.dt
    assert np.abs(ctrl).max() <= 1.0
    assert np.abs(np.diff(ctrl, axis=0)).max() / dt <= 6.0
    for end, other in ((ctrl[0], before), (ctrl[-1], after)):
        if other is not None:
            assert np.abs(end - other).max() / dt <= 6.0
    assert design.final.cost < design.initial.cost
    return played(task.system.model, (np.zeros(2), np.zeros(2)), ctrl, task.system.grid.substeps)


def standstill(task: DesignTask) -> Array:
    """Control that holds the arm at zero, by inverse dynamics: (2,)."""
    data = mujoco.MjData(task.system.model)
    mujoco.mj_inverse(task.system.model, data)
    return np.array(data.qfrc_inverse) / np.array([40.0, 25.0])


@pytest.mark.slow
def test_a_design_from_rest_to_rest_begins_and_ends_with_the_holding_control(
    tmp_path: Path,
) -> None:
    tight = {"start": "rest", "end": "rest", "position": 0.005, "velocity": 0.03}
    task, design = arm_design(tmp_path, boundary=tight)
    hold = standstill(task)
    np.testing.assert_allclose(task.initial_hold, hold, rtol=0, atol=1e-6)
    assert np.abs(hold).min() > 0.01
    rows = assert_arm(task, design, hold, hold)
    assert np.abs(rows["q"][-1]).max() <= 0.005
    assert np.abs(rows["v"][-1]).max() <= 0.03
    assert np.abs(rows["q"]).max() > 0.1  # it moved
    assert design.limits["end_position"] == pytest.approx(
        0.005 - np.abs(rows["q"][-1]).max(), abs=1e-8
    )
    assert design.limits["end_velocity"] == pytest.approx(
        0.03 - np.abs(rows["v"][-1]).max(), abs=1e-7
    )


@pytest.mark.slow
def test_a_periodic_design_can_be_repeated(tmp_path: Path) -> None:
    """Its control does not jump between repetitions, and its state returns to the first one."""
    task, design = arm_design(
        tmp_path, boundary={"end": "periodic", "position": 0.005, "velocity": 0.05}
    )
    ctrl = design.trajectory.ctrl
    rows = assert_arm(task, design, None, ctrl[0])
    assert np.abs(rows["q"][-1]).max() <= 0.005
    assert np.abs(rows["v"][-1]).max() <= 0.05
    twice = played(
        task.system.model,
        (np.zeros(2), np.zeros(2)),
        np.concatenate([ctrl, ctrl]),
        task.system.grid.substeps,
    )["q"]
    assert np.abs(twice[len(rows["q"]) :] - rows["q"]).max() < 0.05


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
    np.testing.assert_allclose(ctrl[0], hold, rtol=0, atol=1e-6)
    assert np.abs(ctrl[1] - ctrl[0]).max() < 0.05 * np.ptp(ctrl)
    rows = assert_arm(task, design, hold, hold)
    assert np.abs(rows["q"][-1]).max() <= 0.02
    assert np.abs(rows["v"][-1]).max() <= 0.1
    power = np.abs(np.fft.rfft(swing, axis=0)) ** 2
    f = np.fft.rfftfreq(len(swing), task.dt)
    assert power[f > 18.0].sum() < 1e-2 * power.sum()


@pytest.mark.parametrize("bandwidth", [30.0, 50.0])
@pytest.mark.slow
def test_a_bandwidth_near_that_of_the_samples_works(bandwidth: float, tmp_path: Path) -> None:
    """There are nearly as many splines as samples, and about twice as many on a coarse level."""
    task = cart_inside(
        tmp_path,
        limits={**HARD, "bandwidth": bandwidth},
        descent={"max_iterations": 6, "coarse": 2},
    )
    fine = bandwidth_basis(task, task.t)
    assert fine is not None and fine.shape[1] > 0.6 * task.samples
    design = design_task(task)
    assert design.final.cost < design.initial.cost
    assert_inside(task, design.trajectory.ctrl)


@pytest.mark.slow
def test_clearance_is_kept_at_every_engine_step(tmp_path: Path) -> None:
    """Without the limit the fore-arm comes closer."""
    task, design = arm_design(tmp_path, limits={"clearance": 0.15})
    _, free = arm_design(tmp_path)
    model, substeps, rest = task.system.model, task.system.grid.substeps, (np.zeros(2),) * 2
    distance, nearer = (
        distances_of_arm(model, played(model, rest, each.trajectory.ctrl, substeps)["q"])
        for each in (design, free)
    )
    assert distance >= 0.15 > nearer
    assert design.limits["clearance"] == pytest.approx(distance - 0.15, abs=1e-6)


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
    tmp_path: Path, count: int, tables: dict[str, Any]
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
    assert np.isfinite([start.cost for start in design.starts]).all()


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
def test_every_criterion_improves_within_limits(tmp_path: Path, tables: dict[str, Any]) -> None:
    cost = {"control": 0.0, **tables.get("cost", {})}
    task = cart_inside(tmp_path, **{**tables, "cost": cost, "descent": {"max_iterations": 6}})
    design = design_task(task)
    inside = task.plant.simulate(task.theta, 0.2 * task.control)
    first = task.problem.point(inside).cost
    assert design.final.cost < (first - 1.0 if cost.get("criterion") == "D" else 0.7 * first)
    assert_inside(task, design.trajectory.ctrl)
    assert min(design.limits.values()) >= 0.0
