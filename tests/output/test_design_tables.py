"""design.csv and reference.csv, replayed in plain MuJoCo."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.errors import ExperimentError
from mjfim.excitation.task import DesignTask
from mjfim.optimize.lq import regulator
from mjfim.output import archive
from mjfim.output.archive import design_columns, reference_columns, simulate_playback
from tests.fuzz.player import Layout, read_rows
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


def starting(rows: dict[str, Array], prefix: str) -> Array:
    """All columns of a kind, side by side."""
    return np.column_stack([values for name, values in rows.items() if name.startswith(prefix)])


@pytest.mark.parametrize("kind", BUILD)
def test_the_table_holds_the_plan_and_the_gains(kind: str, tmp_path: Path) -> None:
    """A bare mj_step loop that knows only the CSV and the model file walks through its states.

    It runs at the rate of the controller. The gains have the names of what they multiply.
    """
    task = BUILD[kind](tmp_path, playback_rate=FINE[kind])
    path, K = tmp_path / "design.csv", gains(task)
    played = simulate_playback(task.system, task.initial, K)
    archive.write_table(path, design_columns(*played, task.system))
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    data, layout, rows = mujoco.MjData(model), Layout(model), read_rows(path)
    times = np.array([row["t"] for row in rows])
    assert_allclose(times, np.arange(len(rows)) / FINE[kind], rtol=0, atol=1e-12)
    assert len(rows) == round(task.experiment.horizon * FINE[kind]) + 1
    repeat = (len(rows) - 1) // len(task.initial.ctrl)
    data.qpos[:], data.qvel[:], data.act[:] = layout.planned(rows[0])
    for k, row in enumerate(rows):
        state = np.concatenate([data.qpos, data.qvel, data.act])
        assert_allclose(state, np.concatenate(layout.planned(row)), rtol=0, atol=1e-9)
        ctrl = np.array([row[f"ctrl:{name}"] for name in layout.drives])
        if k == len(rows) - 1:
            assert np.isnan([*ctrl, *layout.gain(row).ravel()]).all()
            continue
        assert_allclose(ctrl, task.initial.ctrl[k // repeat], rtol=0, atol=1e-9)
        assert_allclose(layout.gain(row), K[k // repeat], rtol=1e-12)
        data.ctrl[:] = ctrl
        mujoco.mj_step(model, data, round(times[1] / model.opt.timestep))


@pytest.mark.parametrize("kind", BUILD)
def test_reference_agrees_with_mujoco(kind: str, tmp_path: Path) -> None:
    """Accelerations are changes of the velocity over the engine step of each row, joint forces
    those of mj_forward; no field is empty.
    """
    task = BUILD[kind](tmp_path, playback_rate=FINE[kind])
    played, _ = simulate_playback(task.system, task.initial, gains(task))
    archive.write_table(tmp_path / "reference.csv", reference_columns(played, task.system))
    rows = table(tmp_path / "reference.csv")
    assert all(np.isfinite(values).all() for values in rows.values())
    kinds = [name.partition(":")[0] for name in rows]
    assert list(dict.fromkeys(kinds)) == ["t", "qpos", "qvel", "qacc", "force"]
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    data = mujoco.MjData(model)
    qacc, force = starting(rows, "qacc:"), starting(rows, "force:")
    nq, nv = task.space.nq, task.space.nv
    steps = round((played.t[1] - played.t[0]) / model.opt.timestep)
    for k in (0, 3, len(qacc) - 1):
        data.qpos[:], data.qvel[:], data.act[:] = task.space.split(played.state[k])
        data.ctrl[:] = played.ctrl[min(k, len(played.ctrl) - 1)]
        mujoco.mj_forward(model, data)
        assert_allclose(force[k], data.qfrc_actuator, rtol=1e-9, atol=1e-12)
        before = played.state[k, nq : nq + nv]
        if k == len(played.ctrl):
            # The last row has the acceleration of the last engine step.
            data.qpos[:], data.qvel[:], data.act[:] = task.space.split(played.state[k - 1])
            mujoco.mj_step(model, data, steps - 1)
            before = data.qvel.copy()
        mujoco.mj_step(model, data)
        change = (data.qvel - before) / model.opt.timestep
        assert_allclose(qacc[k], change, rtol=1e-6, atol=1e-6)
    assert_array_equal(starting(rows, "qpos:"), played.state[:, : task.space.nq])


@pytest.mark.parametrize("rate", [37.0, 75.0, 12.5, 400.0, 150.0])
def test_playback_rate_must_fit(rate: float, tmp_path: Path) -> None:
    """A multiple of rate that divides the engine's; the message lists all of them."""
    with pytest.raises(
        ExperimentError,
        match=r"playback_rate: .* multiple of rate \(50 Hz\).*200 Hz.*valid: 50, 100, 200",
    ):
        filtered_task(tmp_path, rate=50.0, playback_rate=rate)
