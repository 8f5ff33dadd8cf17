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
from mjfim.experiment.schema import Experiment
from mjfim.output.pages import page_of
from mjfim.records.design import Design, Status
from tests.support.limits import ARM, HARD, cart_inside
from tests.support.numerics import (
    CART_PARAMETERS,
    CART_PENDULUM,
    Array,
    make_task,
    relative_error,
)
from tests.support.pages import sentences
from tests.support.paths import MODELS


def played(model: Any, start: tuple[Array, Array], ctrl: Array, substeps: int) -> dict[str, Array]:
    """Positions, velocities, accelerations and actuator forces at every step of a plain loop."""
    data, rows = mujoco.MjData(model), {key: [] for key in ("q", "v", "a", "f")}
    data.qpos[:], data.qvel[:] = start
    for held in ctrl:
        data.ctrl[:] = held
        for _ in range(substeps):
            before = data.qvel.copy()
            mujoco.mj_step(model, data)
            now = (
                data.qpos,
                data.qvel,
                (data.qvel - before) / model.opt.timestep,
                data.actuator_force,
            )
            for key, value in zip(rows, now, strict=True):
                rows[key].append(np.array(value))
    return {key: np.array(value) for key, value in rows.items()}


# ---- the requirement


@pytest.fixture(scope="module")
def paper() -> Design:
    """The study of the paper at its true values, within 5 N and 1 m, without other weights."""
    experiment = Experiment.from_file(MODELS / "cart_pendulum.toml")
    hard = {"control": {"force": [-5.0, 5.0]}, "position": {"slide": [-1.0, 1.0]}}
    return mjfim.design(experiment.replace(cost={"control": 0.0, "tracking": {}}, limits=hard))


@pytest.mark.slow
def test_the_study_of_the_paper_under_hard_limits_beats_a_general_solver(
    paper: Design,
) -> None:
    assert paper.status is Status.CONVERGED
    assert paper.success
    assert paper.final.eigenvalues[0] >= 399.0
    assert paper.warnings == ()
    # independent of the package: finite differences of plain loops
    model, ctrl, sigma, h = (
        mujoco.MjModel.from_xml_path(str(MODELS / "cart_pendulum.xml")),
        paper.trajectory.ctrl,
        0.05,
        1e-5,
    )
    start = (model.key("hanging").qpos.copy(), np.zeros(2))
    bob, columns = model.body("bob").id, []
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
        columns.append((ends[0] - ends[1]).reshape(-1) / (2 * h * sigma))
    G = np.array(columns).T
    eigenvalues = np.linalg.eigvalsh(G.T @ G) / 100.0  # per second
    assert eigenvalues[0] >= 399.0
    np.testing.assert_allclose(eigenvalues, paper.final.eigenvalues, rtol=1e-4)


@pytest.mark.slow
def test_no_engine_step_of_the_study_violates_a_limit(paper: Design) -> None:
    model = mujoco.MjModel.from_xml_path(str(MODELS / "cart_pendulum.xml"))
    rows = played(model, (model.key("hanging").qpos.copy(), np.zeros(2)), paper.trajectory.ctrl, 1)
    assert np.abs(paper.trajectory.ctrl).max() <= 5.0
    assert np.abs(rows["q"][:, 0]).max() <= 1.0
    # both ranges are used up to the bounds, and the design says so
    margins = {
        "control": 5.0 - np.abs(paper.trajectory.ctrl).max(),
        "position": 1.0 - np.abs(rows["q"][:, 0]).max(),
    }
    assert paper.limits == pytest.approx(margins, abs=1e-9)
    assert max(margins.values()) < 0.01
    # the weight of the barrier falls on every level
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


@pytest.mark.parametrize(
    "weight", [1e-3, pytest.param({"force": 1e-5}, marks=pytest.mark.slow)], ids=["one", "named"]
)
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
    for iterations in (8, 200, 800):
        rows = []
        descent = {"max_iterations": iterations, "coarse": 1}
        task = cart_inside(tmp_path, horizon=0.4, descent=descent)
        design = design_task(task, callback=lambda event, rows=rows: rows.append(event.row))
        seen = min(row.cost for row in rows if row.margin >= 0.0)
        assert design.final.cost <= seen * (1 + 1e-4)
        costs[iterations] = design.final.cost
        reached = Status.MAX_ITERATIONS if iterations == 8 else Status.CONVERGED
        assert design.status is reached
    assert costs[800] <= costs[200] * (1 + 1e-9)
    assert costs[200] < costs[8]


# ---- several starts


# ---- how a design begins, ends and moves


def arm_task(folder: Path, **tables: Any) -> DesignTask:
    """The arm of two servos for half a second; it starts at rest, held against gravity."""
    defaults = {
        "horizon": 0.5,
        "parameters": {"m": {"target": "body/fore:mass"}, "c": {"target": "joint/elbow:damping"}},
        "noise": {"qpos:shoulder": 0.01, "qpos:elbow": 0.01},
        "control": {"kind": "sine", "amplitude": 0.1, "frequency": 2.0},
        "cost": {"control": 0.0},
        "descent": {"max_iterations": 12, "coarse": 1},
    }
    limits = {
        "control": {"shoulder": (-1.0, 1.0), "elbow": (-1.0, 1.0)},
        "control_rate": 6.0,
        **tables.pop("limits", {}),
    }
    return make_task(ARM, folder, **{**defaults, **tables, "limits": limits})


def arm_design(folder: Path, **tables: Any) -> tuple[DesignTask, Design]:
    """The task of the arm and its design."""
    task = arm_task(folder, **tables)
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
        descent={"max_iterations": 12, "coarse": coarse},
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


def nearest(task: DesignTask, ctrl: Array) -> float:
    """Smallest distance of the arm to post and floor at any engine step of a plain loop [m]."""
    model = task.system.model
    data = mujoco.MjData(model)
    geoms = [model.geom(name).id for name in ("fore", "post", "floor", "upper")]
    near = []
    for qpos in played(model, (np.zeros(2), np.zeros(2)), ctrl, task.system.grid.substeps)["q"]:
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        pairs = ((0, 1), (0, 2), (3, 1), (3, 2))
        near += [
            mujoco.mj_geomDistance(model, data, geoms[a], geoms[b], 1.0, None) for a, b in pairs
        ]
    return min(near)


@pytest.mark.slow
def test_clearance_is_kept_at_every_engine_step(tmp_path: Path) -> None:
    """Without the limit the fore-arm comes closer."""
    task, design = arm_design(tmp_path, limits={"clearance": 0.15})
    free = arm_design(tmp_path, descent={"max_iterations": 8, "coarse": 1})[1]
    distance = nearest(task, design.trajectory.ctrl)
    assert distance >= 0.15 > nearest(task, free.trajectory.ctrl)
    assert design.limits["clearance"] == pytest.approx(distance - 0.15, abs=1e-6)


@pytest.mark.slow
def test_a_shorter_design_played_twice_is_a_start(tmp_path: Path) -> None:
    """Half of the horizon has about as much information per second; costs hold for all of it."""
    rest = {"start": "rest", "end": "rest"}
    descent = {"repeats": (2,), "max_iterations": 80}
    hanging = {"qpos": (0.0, np.pi), "qvel": (0.0, 0.0)}
    control = {"kind": "sine", "amplitude": 2.0, "frequency": 0.9}
    limits = {**HARD, "control_rate": 200.0}
    task = cart_inside(
        tmp_path,
        horizon=2.0,
        boundary=rest,
        descent=descent,
        limits=limits,
        initial={**hanging, "control": control},
    )
    design = design_task(task)
    assert [start.name for start in design.starts] == ["initial control", "2 times a design of 1 s"]
    assert min(start.iterations for start in design.starts) > 0
    assert len(design.trajectory.ctrl) == task.samples
    assert min(design.limits.values()) >= 0.0
    assert np.isfinite(design.final.cost)
    assert design.final.cost == min(start.cost for start in design.starts)


@pytest.mark.parametrize(
    ("count", "tables"), [(2, {"cost": {"control": 1e-3}}), (4, {"rate": 100.0})]
)
def test_repeated_designs_work_with_weights_and_with_odd_samples(
    tmp_path: Path, count: int, tables: dict[str, Any]
) -> None:
    wide = {"control": {"force": (-50.0, 50.0)}, "position": {"slide": (-9.0, 9.0)}}
    descent = {"repeats": (count,), "max_iterations": 4}
    design = design_task(cart_inside(tmp_path, limits=wide, descent=descent, **tables))
    assert design.final.cost < design.initial.cost
    assert len(design.starts) == 2
    assert np.isfinite([start.cost for start in design.starts]).all()


@pytest.mark.parametrize(
    "tables",
    [
        pytest.param({"cost": {"control": 0.0, "criterion": "A"}}, marks=pytest.mark.slow),
        {"cost": {"control": 0.0, "criterion": "D"}},
        {"cost": {"control": 0.0, "criterion": "c", "combination": {"m": 1.0, "c": -0.5}}},
        pytest.param(
            {
                "cost": {"control": 0.0},
                "robust": {"samples": 3},
                "parameters": {"m": {"prior": 0.3}},
            },
            marks=pytest.mark.slow,
        ),
    ],
    ids=["A", "D", "c", "robust"],
)
@pytest.mark.slow
def test_every_criterion_improves_within_limits(tmp_path: Path, tables: dict[str, Any]) -> None:
    known = {
        name: {**stated, **tables.get("parameters", {}).get(name, {})}
        for name, stated in CART_PARAMETERS.items()
    }
    descent = {"max_iterations": 10}
    task = cart_inside(tmp_path, descent=descent, **{**tables, "parameters": known})
    design = design_task(task)
    first = task.problem.point(
        task.plant.simulate(task.theta, 0.2 * task.control)
    ).cost  # inside as well
    assert design.final.cost < (
        first - 1.0 if tables["cost"].get("criterion") == "D" else 0.7 * first
    )
    assert_inside(task, design.trajectory.ctrl)
    assert min(design.limits.values()) >= 0.0
