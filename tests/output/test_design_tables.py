"""design.csv and reference.csv, replayed in plain MuJoCo."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from mjfim.errors import ExperimentError
from mjfim.excitation.task import DesignTask
from mjfim.optimize.lq import regulator
from mjfim.output import archive
from mjfim.output.archive import design_columns, reference_columns, simulate_playback
from mjfim.records.trajectory import Playback
from tests.support.numerics import Array, body_task, cart_task, filtered_task

COARSE = {"rate": 25.0, "horizon": 0.8}  # of engines at 100 Hz
BUILD: dict[str, Any] = {
    "cart": lambda folder, **tables: cart_task(folder, **{**COARSE, **tables}),
    "body": lambda folder, **tables: body_task(folder, **{**COARSE, **tables}),
    "filtered": lambda folder, **tables: filtered_task(folder, **{"rate": 50.0, **tables}),
}
FINE = {"cart": 100.0, "body": 50.0, "filtered": 100.0}


def gains(task: DesignTask) -> Array:
    """(N, nu, nx) of a regulator about the initial trajectory."""
    A, B, _, _ = task.plant.derivatives.jacobians(task.theta, task.initial)
    return regulator(A, B, np.eye(task.space.nx), np.eye(B.shape[2]), np.eye(task.space.nx))


def table(path: Path) -> dict[str, Array]:
    """Columns of a CSV by Python's own reader; empty fields are NaN."""
    with path.open(newline="", encoding="utf-8") as stream:
        header, *rows = csv.reader(stream)
    values = np.array([[float(field or "nan") for field in row] for row in rows])
    return dict(zip(header, values.T, strict=True))


def written(task: DesignTask, folder: Path) -> tuple[Path, Playback]:
    """design.csv of the initial trajectory, with gains."""
    played = simulate_playback(task.system, task.initial, gains(task))
    archive.write_table(folder / "design.csv", design_columns(played, task.system))
    return folder / "design.csv", played


def starting(rows: dict[str, Array], prefix: str) -> Array:
    """All columns of a kind, side by side."""
    return np.column_stack([values for name, values in rows.items() if name.startswith(prefix)])


def closed_loop(path: Path, folder: Path, push: Array) -> tuple[Array, Array, Array]:
    """States and controls of a loop that knows only the CSV and the model file, and the planned
    ones. push: (nx,) of the start
    """
    rows = table(path)
    model = mujoco.MjModel.from_xml_path(str(folder / "model.xml"))
    data, nv, na = mujoco.MjData(model), model.nv, model.na
    qpos, qvel, ctrl = (starting(rows, prefix) for prefix in ("qpos:", "qvel:", "ctrl:"))
    act = starting(rows, "act:") if na else np.zeros((len(qpos), 0))
    controls = [name.removeprefix("ctrl:") for name in rows if name.startswith("ctrl:")]
    K = np.stack([starting(rows, f"gain:{name}:") for name in controls], axis=1)
    steps = round(float(rows["t"][1]) / model.opt.timestep)
    data.qpos[:], data.qvel[:], data.act[:] = (
        qpos[0],
        qvel[0] + push[nv : 2 * nv],
        act[0] + push[2 * nv :],
    )
    mujoco.mj_integratePos(model, data.qpos, push[:nv], 1.0)
    states, used = [], []
    for k in range(len(qpos)):
        states.append(np.concatenate([data.qpos, data.qvel, data.act]))
        if k < len(qpos) - 1:
            error = np.zeros(nv)
            mujoco.mj_differentiatePos(model, error, 1.0, data.qpos, qpos[k])
            data.ctrl[:] = ctrl[k] + K[k] @ np.concatenate(
                [error, qvel[k] - data.qvel, act[k] - data.act]
            )
            used.append(np.array(data.ctrl))
            mujoco.mj_step(model, data, steps)
    return np.array(states), np.array(used), np.concatenate([qpos, qvel, act], axis=1)


@pytest.mark.parametrize("kind", BUILD)
def test_the_loop_closed_from_the_table_is_the_projection(kind: str, tmp_path: Path) -> None:
    """On the plan, at the rate of the controller, it changes nothing: a bare mj_step loop on the
    model file walks through the positions, velocities and activations of the table. Pushed off it,
    it is the engine's own loop with the arrays of design.npz.
    """
    task = BUILD[kind](tmp_path, playback_rate=FINE[kind])
    path, _ = written(task, tmp_path)
    nx, rows = task.space.nx, table(path)
    states, used, plan = closed_loop(path, tmp_path, np.zeros(nx))
    np.testing.assert_allclose(states, plan, rtol=0, atol=1e-9)
    assert len(plan) == round(task.experiment.horizon * FINE[kind]) + 1
    times = len(used) // len(task.initial.ctrl)
    np.testing.assert_allclose(used, np.repeat(task.initial.ctrl, times, axis=0), rtol=0, atol=1e-9)
    np.testing.assert_allclose(rows["t"], np.arange(len(plan)) / FINE[kind], rtol=0, atol=1e-12)
    assert np.isnan(starting(rows, "ctrl:")[-1]).all()
    assert np.isnan(starting(rows, "gain:")[-1]).all()

    task = BUILD[kind](tmp_path)
    path, _ = written(task, tmp_path)
    push = 0.02 * np.random.default_rng(1).standard_normal(nx)
    states, used, _ = closed_loop(path, tmp_path, push)
    model = task.plant.model(task.theta)
    reference = np.array(task.initial.state)
    expected = engine_loop(task, model, task.space.plus(reference[0], push), reference, gains(task))
    np.testing.assert_allclose(states, expected, rtol=0, atol=1e-9)
    assert np.abs(used - task.initial.ctrl).max() > 1e-3


def engine_loop(task: DesignTask, model: Any, start: Array, reference: Array, K: Array) -> Array:
    """It agrees with single steps of the batch engine and deviations by `StateSpace.minus`."""
    states = [start]
    for k in range(len(K)):
        u = task.initial.ctrl[k] + K[k] @ task.space.minus(reference[k], states[-1])
        states.append(task.plant.simulator.step([model], states[-1][None], u[None])[0][0])
    return np.array(states)


def assert_last_acceleration(qacc: Array, played: Playback, data: Any) -> None:
    """The last row has the acceleration of the last engine step, (nv,)."""
    model = data.model
    state = np.split(played.state[-2], [model.nq, model.nq + model.nv])
    data.qpos[:], data.qvel[:], data.act[:] = state
    data.ctrl[:] = played.ctrl[-1]
    steps = round((played.t[-1] - played.t[-2]) / model.opt.timestep)
    for _ in range(steps):
        before = data.qvel.copy()
        mujoco.mj_step(model, data)
    wanted = (data.qvel - before) / model.opt.timestep
    np.testing.assert_allclose(qacc, wanted, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("kind", BUILD)
def test_reference_agrees_with_mujoco(kind: str, tmp_path: Path) -> None:
    """Accelerations are changes of the velocity over the engine step of each row, joint forces
    those of mj_forward; no field is empty.
    """
    task = BUILD[kind](tmp_path, playback_rate=FINE[kind])
    played = simulate_playback(task.system, task.initial, gains(task))
    archive.write_table(tmp_path / "reference.csv", reference_columns(played, task.system))
    rows = table(tmp_path / "reference.csv")
    assert all(np.isfinite(values).all() for values in rows.values())
    kinds = [name.partition(":")[0] for name in rows]
    assert list(dict.fromkeys(kinds)) == ["t", "qpos", "qvel", "qacc", "force"]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    data = mujoco.MjData(model)
    qacc, force = starting(rows, "qacc:"), starting(rows, "force:")
    for k in (0, 3, len(qacc) - 1):
        data.qpos[:], data.qvel[:], data.act[:] = task.space.split(played.state[k])
        data.ctrl[:] = played.ctrl[min(k, len(played.ctrl) - 1)]
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(force[k], data.qfrc_actuator, rtol=1e-9, atol=1e-12)
        if k < len(played.ctrl):
            mujoco.mj_step(model, data)
            change = data.qvel - played.state[k, task.space.nq : task.space.nq + task.space.nv]
            wanted = change / model.opt.timestep
            np.testing.assert_allclose(qacc[k], wanted, rtol=1e-9, atol=1e-9)
    assert_last_acceleration(qacc[-1], played, data)
    np.testing.assert_array_equal(starting(rows, "qpos:"), played.state[:, : task.space.nq])


@pytest.mark.parametrize("rate", [37.0, 75.0, 12.5, 400.0, 150.0])
def test_playback_rate_must_fit(rate: float, tmp_path: Path) -> None:
    """A multiple of rate that divides the engine's; the message lists all of them."""
    with pytest.raises(
        ExperimentError,
        match=r"playback_rate: .* multiple of rate \(50 Hz\).*200 Hz.*valid: 50, 100, 200",
    ):
        filtered_task(tmp_path, rate=50.0, playback_rate=rate)
