"""design.csv and reference.csv, and designs on simulated robots that differ from the model."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.stats import binom

import mjfim
from mjfim.errors import (
    ExperimentError,
    NoResultError,
    RecordingError,
    SimulationDivergedError,
)
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System
from mjfim.optimize.lq import regulator
from mjfim.output import archive
from mjfim.output.archive import design_columns, reference_columns, simulate_playback
from mjfim.output.pages.studies import robustness_sentences
from mjfim.recordings.control_table import read_playback
from mjfim.records.studies import RobotConditions, Robustness
from mjfim.records.trajectory import Playback, Recording
from mjfim.studies import robot_bench
from mjfim.studies.robot_bench import RobotBench
from mjfim.studies.robustness import summarize_runs
from tests.support.cli import misused, run
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


@pytest.mark.parametrize("kind", BUILD)
def test_the_table_alone_replays_exactly(kind: str, tmp_path: Path) -> None:
    """A bare mj_step loop on the model file, fed from the CSV, walks through its positions,
    velocities and activations.
    """
    task = BUILD[kind](tmp_path, playback_rate=FINE[kind])
    path, _ = written(task, tmp_path)
    rows = table(path)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    data = mujoco.MjData(model)
    steps = round(1.0 / FINE[kind] / model.opt.timestep)
    qpos, qvel, ctrl = (starting(rows, prefix) for prefix in ("qpos:", "qvel:", "ctrl:"))
    data.qpos[:], data.qvel[:] = qpos[0], qvel[0]
    if model.na:
        data.act[:] = starting(rows, "act:")[0]
    assert len(qpos) == round(task.experiment.horizon * FINE[kind]) + 1
    for k in range(len(ctrl) - 1):
        np.testing.assert_allclose(data.qpos, qpos[k], rtol=0, atol=1e-9)
        np.testing.assert_allclose(data.qvel, qvel[k], rtol=0, atol=1e-9)
        data.ctrl[:] = ctrl[k]
        mujoco.mj_step(model, data, steps)
    np.testing.assert_allclose(data.qpos, qpos[-1], rtol=0, atol=1e-9)
    np.testing.assert_allclose(rows["t"], np.arange(len(qpos)) / FINE[kind], rtol=0, atol=1e-12)
    assert np.isnan(ctrl[-1]).all() and np.isnan(starting(rows, "gain:")[-1]).all()


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
    """On the plan it changes nothing; pushed off it, it is the engine's own loop with the arrays of
    design.npz.
    """
    task = BUILD[kind](tmp_path)
    path, played = written(task, tmp_path)
    nx = task.space.nx
    states, used, plan = closed_loop(path, tmp_path, np.zeros(nx))
    np.testing.assert_allclose(states, plan, rtol=0, atol=1e-9)
    np.testing.assert_allclose(used, task.initial.ctrl, rtol=0, atol=1e-9)
    push = 0.02 * np.random.default_rng(1).standard_normal(nx)
    states, used, _ = closed_loop(path, tmp_path, push)
    model = task.plant.model(task.theta)
    reference = np.array(task.initial.state)
    expected = engine_loop(task, model, task.space.plus(reference[0], push), reference, played.gain)
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


def test_a_table_is_read_as_it_was_written(tmp_path: Path) -> None:
    """All digits of states, controls and gains, whatever the rate."""
    task = BUILD["body"](tmp_path, playback_rate=50.0)
    path, played = written(task, tmp_path)
    found = read_playback(path, BUILD["body"](tmp_path).system.channels)
    for name in ("t", "state", "ctrl", "gain"):
        np.testing.assert_array_equal(getattr(found, name), getattr(played, name))
    assert found.period == pytest.approx(0.02, rel=1e-12)


def change(path: Path, **fields: Any) -> None:
    """Replace columns of a CSV; None takes one away."""
    rows = table(path)
    for name, values in fields.items():
        rows.pop(name)
        if values is not None:
            rows[name] = values
    archive.write_table(path, rows)


@pytest.mark.parametrize(
    ("column", "wrong", "words"),
    [
        ("gain:servo:qvel:hinge", None, "column 'gain:servo:qvel:hinge' is missing"),
        ("act:servo", None, "column 'act:servo' is missing"),
        (
            "ctrl:servo",
            lambda v: np.full_like(v, np.nan),
            "column 'ctrl:servo' holds no finite number in data row 1",
        ),
        (
            "qpos:hinge",
            lambda v: np.where(np.arange(len(v)) == 2, np.nan, v),
            "'qpos:hinge' holds no finite number in data row 3",
        ),
        (
            "t",
            lambda v: v * 1.01,
            "column 't' must begin at 0 and increase by equal periods",
        ),
        ("t", lambda v: v + 0.02, "column 't' must begin at 0"),
    ],
)
def test_a_damaged_table_is_refused(column: str, wrong: Any, words: str, tmp_path: Path) -> None:
    task = BUILD["filtered"](tmp_path)
    path, _ = written(task, tmp_path)
    change(path, **{column: None if wrong is None else wrong(table(path)[column])})
    with pytest.raises(RecordingError, match=words):
        read_playback(path, task.system.channels)


CART = """
<mujoco model="cart_pendulum">
  <option timestep="0.005"><flag contact="disable"/></option>
  <default><geom mass="0" contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="cart">
      <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
      <joint name="slide" type="slide" axis="1 0 0" damping="0.5" stiffness="4"/>
      <body name="bob">
        <joint name="hinge" type="hinge" axis="0 -1 0" damping="0.1" stiffness="1" springref="0.5"/>
        <inertial pos="0 0 -0.5" mass="0.8" diaginertia="0.02 0.02 0.02"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="force" joint="slide" ctrlrange="-10 10"/></actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def cart(tmp_path_factory: pytest.TempPathFactory) -> tuple[mjfim.Experiment, Path]:
    """A cart on a spring with a bob that rests where its mass says, and the table of its initial
    control.
    """
    home = tmp_path_factory.mktemp("cart")
    (home / "cart.xml").write_text(CART, encoding="utf-8")
    model = mujoco.MjModel.from_xml_string(CART)
    data = mujoco.MjData(model)
    for _ in range(20000):
        mujoco.mj_step(model, data)
    text = f"""
model = "cart.xml"
rate = 50.0
playback_rate = 100.0
horizon = 2.0
initial.qpos = {data.qpos.tolist()}
initial.control = {{ kind = "chirp", amplitude = 5.0, frequency = 0.7, frequency_end = 3.0 }}
parameters.mass = {{ target = "body/bob:mass" }}
parameters.damping = {{ target = "joint/hinge:damping" }}
parameters.spring = {{ target = "joint/slide:stiffness" }}
noise.state = 0.004
limits.velocity = {{ slide = 4.0, hinge = 9.0 }}
"""
    (home / "cart.toml").write_text(text, encoding="utf-8")
    experiment = mjfim.Experiment.from_file(home / "cart.toml")
    task = DesignTask.resolve(experiment, threads=1)
    return experiment, written(task, home)[0]


def bench_of(cart: tuple[mjfim.Experiment, Path], **conditions: Any) -> Any:
    return RobotBench(*cart, RobotConditions(**{"latency": 0.015, **conditions}))


@pytest.mark.parametrize("feedback", [False, True])
def test_a_robot_agrees_with_a_plain_simulation_loop(
    cart: tuple[mjfim.Experiment, Path], feedback: bool
) -> None:
    """Wrong parameters written by hand, commands three steps late, limits at every engine step,
    noisy feedback.
    """
    bench = bench_of(cart, feedback=feedback)
    rng = np.random.default_rng(3)
    noise = bench.task.system.noise.sample(len(bench.plan.t), rng)
    stands = ("initial qpos:slide", "initial qpos:hinge") if feedback else ("initial qpos:hinge",)
    assert bench.task.parameters.names == ("mass", "damping", "spring", *stands, "delay")
    theta = np.array([0.8 * 1.2, 0.1 * 0.8, 4.0 * 1.2, *np.zeros(len(stands)), 0.015])
    recording, margins, start = bench.play(theta, noise, bench.conditions.feedback)
    model = mujoco.MjModel.from_xml_string(CART)
    model.body_mass[model.body("bob").id] = theta[0]
    model.dof_damping[1], model.jnt_stiffness[0] = theta[1], theta[2]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start[:2], start[2:]
    mujoco.mj_forward(model, data)
    if not feedback:
        np.testing.assert_allclose(data.qacc, 0.0, atol=1e-7)  # it stands still
    rows = table(cart[1])
    plan, K = starting(rows, "qpos:"), starting(rows, "gain:")
    plan = np.concatenate([plan, starting(rows, "qvel:")], axis=1)
    before = K[0] @ (plan[0] - start) if feedback else 0.0
    sent, fastest = [], np.zeros(2)
    for step in range(400 + 3):
        if step % 2 == 0 and step < 400:
            seen = np.concatenate([data.qpos, data.qvel]) + noise[step // 2]
            if (step // 2) % 2 == 0 and step:
                np.testing.assert_allclose(recording.y[step], seen, rtol=0, atol=1e-9)
            sent.append(
                rows["ctrl:force"][step // 2]
                + (K[step // 2] @ (plan[step // 2] - seen) if feedback else 0.0)
            )
        data.ctrl[0] = before if step < 3 else sent[(step - 3) // 2]
        mujoco.mj_step(model, data)
        fastest = np.maximum(fastest, np.abs(data.qvel))
    np.testing.assert_allclose(recording.ctrl[::2, 0], sent, rtol=0, atol=1e-9)
    assert np.isnan(recording.y[1::2]).all() and np.isnan(recording.y[2::4]).all()
    by_name = {
        (limit.kind, limit.name): margin
        for limit, margin in zip(bench.limits, margins, strict=True)
    }
    assert by_name["velocity", "slide"] == pytest.approx(1.0 - fastest[0] / 4.0, abs=1e-9)
    assert by_name["velocity", "hinge"] == pytest.approx(1.0 - fastest[1] / 9.0, abs=1e-9)
    assert by_name["control", "force"] == pytest.approx(1.0 - np.abs(sent).max() / 10.0, abs=1e-9)


@pytest.mark.parametrize("integrator", ["implicitfast", "RK4"])
def test_margins_of_servo_forces_hold_at_every_engine_step(
    cart: tuple[mjfim.Experiment, Path], tmp_path: Path, integrator: str
) -> None:
    """Forces of a servo change with the state, within samples of several engine steps."""
    servo = CART.replace(
        '<motor name="force" joint="slide" ctrlrange="-10 10"/>',
        '<position name="force" joint="slide" kp="30" kv="2" ctrlrange="-10 10"/>',
    ).replace("<worldbody>", f'<option integrator="{integrator}"/><worldbody>')
    (tmp_path / "cart.xml").write_text(servo, encoding="utf-8")
    experiment = cart[0].replace(
        directory=tmp_path, limits={"force": {"force": 400.0}}, playback_rate=50.0
    )
    path = written(DesignTask.resolve(experiment, threads=1), tmp_path)[0]
    bench = RobotBench(experiment, path, RobotConditions(latency=0.015))

    theta = np.append(bench.task.theta[:-1], 0.015)
    noise = np.zeros((len(bench.plan.t), len(bench.task.system.outputs)))
    recording, margins, start = bench.play(theta, noise, bench.conditions.feedback)

    model = mujoco.MjModel.from_xml_string(servo)
    data = mujoco.MjData(model)
    before, after = mujoco.MjData(model), mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = start[:2], start[2:]
    largest = 0.0
    for step in range(len(recording.ctrl) + 3):
        if step >= 3:
            data.ctrl[:] = recording.ctrl[step - 3]
        mujoco.mj_copyData(before, model, data)
        mujoco.mj_step(model, data)
        mujoco.mj_copyData(after, model, data)
        for at in (before, after):
            mujoco.mj_forward(model, at)
        at_step = [abs(at.actuator_force[0]) for at in (before, data, after)]
        largest = max(largest, *at_step)

    kinds = [limit.kind for limit in bench.limits]
    assert margins[kinds.index("force")] == pytest.approx(1.0 - largest / 400.0, abs=1e-9)


RUNS, FEW = 30, 6


@pytest.fixture(scope="module")
def fits() -> dict[tuple[str, bytes, bytes], Any]:
    """Fits by the experiment without its limits and by what was recorded."""
    return {}


@pytest.fixture
def fitted_once(fits: dict[tuple[str, bytes, bytes], Any], monkeypatch: pytest.MonkeyPatch) -> None:
    """Fit equal recordings of experiments that differ in their limits alone only once."""
    identified = RobotBench._identified

    def fitted(bench: RobotBench, recording: Recording, system: System) -> Any:
        """The fit of a robot, made where no equal recording was fitted."""
        stated = system.experiment.model_dump_json(exclude={"limits"})
        key = (stated, recording.y.tobytes(), recording.ctrl.tobytes())
        if key not in fits:
            fits[key] = identified(bench, recording, system)
        return fits[key]

    monkeypatch.setattr(RobotBench, "_identified", fitted)


def judged(
    cart: tuple[mjfim.Experiment, Path],
    runs: int = RUNS,
    **conditions: Any,
) -> Any:
    bench = bench_of(cart, **conditions)
    return summarize_runs(bench, [bench.run(number) for number in range(runs)])


@pytest.mark.slow
@pytest.mark.usefixtures("fitted_once")
@pytest.mark.parametrize("feedback", [False, True])
def test_intervals_hold_the_true_values(
    cart: tuple[mjfim.Experiment, Path], feedback: bool
) -> None:
    """Intervals and joint regions hold the true values in 95 % of runs; errors are as predicted."""
    found = judged(cart, feedback=feedback)
    least = binom.ppf(1e-3, RUNS, 0.95)
    assert found.inside.min() >= least
    assert min(found.joint) >= least

    # A false alarm is possible: each run tests four outputs and twenty missing terms. There was one
    # in 60 runs of this robot and none in 300 of another; the mean of all squared statistics of the
    # missing terms is 1.1 over 40 runs, where 1 is expected of a complete model.
    assert found.misfits <= 1
    assert not found.troubles
    ratio = found.observed / found.formal
    assert (ratio > 0.6).all() and (ratio < 1.45).all()
    np.testing.assert_allclose(found.formal[:3], found.predicted[:3], rtol=0.35)
    assert found.fit == pytest.approx(1.0, abs=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("fault", ["noise", "delay"])
def test_the_check_can_fail(
    cart: tuple[mjfim.Experiment, Path], fault: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Noise three times as loud as stated, or a latency that is believed to be known: intervals no
    longer hold the truth.
    """
    experiment, path = cart

    # Each further fit takes more than a second. The one that starts next to the true latency of
    # 15 ms is the likeliest to explain the recording.
    assert robot_bench.FURTHER_DELAYS[-1] == pytest.approx(0.015, abs=2e-3)
    monkeypatch.setattr(robot_bench, "FURTHER_DELAYS", robot_bench.FURTHER_DELAYS[-1:])

    if fault == "delay":
        found = judged((experiment.replace(nuisance={"delay": 1e-5}), path), FEW)
    else:
        found = judged(cart, FEW, loudness=3.0)
    assert not found.covered and not found.ok
    assert found.inside.min() < binom.ppf(1e-3, FEW, 0.95)
    assert found.misfits > 0.9 * FEW


@pytest.mark.slow
@pytest.mark.usefixtures("fitted_once")
def test_limits_without_margin_in_the_plan_are_violated(
    cart: tuple[mjfim.Experiment, Path], fits: dict[tuple[str, bytes, bytes], Any]
) -> None:
    """The conclusions name the violation, and the margin that would have been sufficient.

    Limits change neither the recordings nor the fits.
    """
    experiment, path = cart
    plenty = bench_of(cart)
    planned = dict(zip([(i.kind, i.name) for i in plenty.limits], plenty.planned(), strict=True))
    fastest = 9.0 * (1.0 - planned["velocity", "hinge"])
    tight = (
        experiment.replace(limits={"velocity": {"slide": 4.0, "hinge": 1.0001 * fastest}}),
        path,
    )
    found = judged(tight)
    assert found.inside.min() >= binom.ppf(1e-3, RUNS, 0.95) and not found.ok
    assert 0 < found.all_kept < RUNS
    words = " ".join(robustness_sentences(found))
    assert "velocity of hinge is exceeded by up to" in words
    share = found.reserve()["velocity"]
    roomy = (
        experiment.replace(limits={"velocity": {"slide": 4.0, "hinge": fastest / (1.0 - share)}}),
        path,
    )
    known = len(fits)
    assert judged(roomy).all_kept == RUNS
    assert len(fits) == known


def test_an_experiment_that_begins_in_motion_allows_no_latency(tmp_path: Path) -> None:
    """Such a design can be played without a latency only, which the message says."""
    task = BUILD["cart"](tmp_path, playback_rate=50.0)
    path, _ = written(task, tmp_path)
    with pytest.raises(ExperimentError, match=r"no control holds the initial state.*--latency 0"):
        RobotBench(task.experiment, path, RobotConditions(latency=0.01))
    bench = RobotBench(task.experiment, path, RobotConditions(latency=0.0, loudness=0.0))
    run = bench.run(0)
    np.testing.assert_allclose(run.estimate, run.theta, rtol=0, atol=float((1e-3 * run.std).max()))
    with pytest.raises(ExperimentError, match="whole number of timesteps"):
        RobotBench(task.experiment, path, RobotConditions(latency=0.005))


BALL = """<mujoco><option timestep="0.01" integrator="implicitfast"/><worldbody><body name="bob">
<joint name="ball" type="ball" stiffness="20" damping="1"/>
<geom type="sphere" size=".05" pos=".1 0 -.3" mass="1" contype="0" conaffinity="0"/></body>
</worldbody>
<actuator><motor name="x" joint="ball" gear="1 0 0"/><motor name="y" joint="ball" gear="0 1 0"/>
<motor name="z" joint="ball" gear="0 0 1"/></actuator></mujoco>"""


def test_a_start_that_moves_on_a_ball_joint_is_an_unknown_of_the_fit(tmp_path: Path) -> None:
    """Its parts have the names of deviations of the state."""
    (tmp_path / "model.xml").write_text(BALL, encoding="utf-8")
    stated = mjfim.Experiment(
        model="model.xml",
        rate=25.0,
        horizon=0.8,
        initial={"control": {"kind": "chirp", "amplitude": 0.1}},
        parameters={"mass": {"target": "body/bob:mass", "bounds": (0.1, 5.0)}},
        noise={"state": 0.01},
        boundary={"start": "rest"},
        directory=tmp_path,
    )
    path, _ = written(DesignTask.resolve(stated), tmp_path)

    bench = RobotBench(stated, path, RobotConditions(latency=0.01))
    names = bench.task.parameters.names
    assert {name for name in names if "ball" in name} == {"initial qpos:ball.ry"}
    assert np.isfinite(bench.run(0).estimate).all()


@pytest.mark.slow
def test_the_verb_plays_a_folder(cart: tuple[mjfim.Experiment, Path], tmp_path: Path) -> None:
    """Tables and sentences on stdout, JSON and a figure in the folder; robots in processes."""
    experiment, path = cart
    words = ("--runs", 2, "--executor", "local:1", "-o", tmp_path / "out")
    done = run("robustness", experiment.source, path.parent, *words)
    found = json.loads((tmp_path / "out" / "playback.json").read_text(encoding="utf-8"))
    assert done.exit_code == (0 if found["ok"] else 1), done.stderr
    assert (tmp_path / "out" / "playback.png").read_bytes()[:4] == b"\x89PNG"
    assert found["runs"] == 2 and len(found["parameters"]) == 5
    assert found["conditions"]["latency"] == 0.005
    assert {row["kind"] for row in found["limits"]} == {"velocity", "control"}
    assert "Accuracy of 2 robots" in done.stdout

    loaded = Robustness.load(tmp_path / "out")
    assert loaded.summary()["limits"] == found["limits"]


@pytest.mark.slow
def test_a_stopped_study_keeps_the_robots_that_are_done(
    cart: tuple[mjfim.Experiment, Path],
) -> None:
    """A token that is set before the first robot leaves no result; one that is set after it leaves
    that robot.
    """
    stop = mjfim.StopToken()
    options = {"runs": 2}
    result = mjfim.assess_robustness(*cart, callback=lambda _: stop.request(), stop=stop, **options)
    assert result.runs == 1
    with pytest.raises(NoResultError):
        mjfim.assess_robustness(*cart, stop=stop, **options)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--latency", 0.0031], "whole number of timesteps"),
        (["--latency", "nan"], "latency: nan is not a finite number of at least 0"),
        (["--latency", "inf"], "latency: inf is not a finite number of at least 0"),
        (["--latency", "1e300"], "latency: 1e+300 s is longer than the design, which lasts 2 s"),
        (["--latency", 0.0, "--wrong", "inf"], "wrong: inf is not a number from 0 to 10"),
        (["--wrong", "1e300"], "wrong: 1e+300 is not a number from 0 to 10"),
        (["--wrong", "-1"], "wrong: -1 is not a number from 0 to 10"),
    ],
)
def test_misuse_is_one_sentence(
    words: list[object], said: str, cart: tuple[mjfim.Experiment, Path], tmp_path: Path
) -> None:
    experiment, path = cart
    misused(run("robustness", experiment.source, path.parent, *words, "-o", tmp_path), said)


@pytest.mark.filterwarnings("error")
def test_without_an_estimate_the_errors_are_unknown(
    cart: tuple[mjfim.Experiment, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot that diverges leaves no estimate, and the study computes no mean of nothing."""
    bench = bench_of(cart)

    def diverge(*_: object) -> None:
        raise SimulationDivergedError("the robot diverges")

    with monkeypatch.context() as patch:
        patch.setattr(bench, "play", diverge)
        runs = [bench.run(0)]
    result = summarize_runs(bench, runs)

    assert np.isnan(result.observed).all() and np.isnan(result.formal).all()
    assert result.troubles == {"the robot diverges": 1}
    assert not result.ok
