"""The plant in discrete time: derivatives against MuJoCo's and plain loops, sensors, projection,
divergence.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.errors import ExperimentError, SimulationDivergedError
from mjfim.excitation.task import DesignTask
from mjfim.model.loading import ModelSource, compile_spec, load_spec
from mjfim.model.variants import PlantModel, unconstrained
from mjfim.optimize.lq import LinearRecursion, TangentCurve, regulator
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES, FORWARD_DIFFERENCES
from mjfim.records.trajectory import Linearization
from tests.support.numerics import (
    CART_PARAMETERS,
    CART_PENDULUM,
    Array,
    Loop,
    body_task,
    cart_task,
    filtered_task,
    make_task,
    relative_error,
    sensitivity_of,
)
from tests.support.specs import write_spec

SENSED = {"angle": 0.01, "rate": 0.05, "acc": 0.3, "drive": 0.1}
SAMPLES = (0, 7, 23, 49)


STILL = pytest.mark.parametrize(
    "make", [cart_task, body_task, filtered_task], ids=["cart", "body", "activation"]
)


def linear(task: DesignTask) -> Linearization:
    """Derivatives along the initial trajectory."""
    return task.plant.derivatives.linearize(task.theta, task.initial)


@pytest.mark.parametrize(
    "make",
    [
        *(
            lambda f, name=name: cart_task(f, name, noise=SENSED)
            for name in ("RK4", "Euler", "implicitfast")
        ),
        body_task,
        lambda f: body_task(f, "implicitfast"),
        lambda f: filtered_task(f, "RK4"),
        filtered_task,
    ],
)
def test_A_B_C_and_D_are_those_of_a_plain_loop_for_any_integrator_and_substeps(
    make, tmp_path
) -> None:
    task = make(tmp_path)
    found, curve = linear(task), task.initial
    rows, address = sensed(task)
    loop = Loop(task.plant.model(task.theta), task.system.grid.substeps)
    for k in SAMPLES:
        A, B, C, D = loop.jacobians(curve.state[k], curve.ctrl[k])
        assert relative_error(found.A[k], A) < 1e-7
        assert relative_error(found.B[k], B) < 1e-6
        if rows:
            assert relative_error(found.C[k][rows], C[address]) < 1e-6
            assert_allclose(found.D[k][rows], D[address], rtol=1e-6, atol=1e-6)


def rebuilt(task: DesignTask, theta: Array) -> Any:
    """The model compiled anew at theta, sensors and solver as in the plant."""
    spec = task.system.source.spec.copy()
    write_spec(spec, task.system.model, task.system.model_at(theta), task.parameters, theta)
    for body in spec.bodies:
        body.simple = 0
    return spec.compile()


def sensed(task: DesignTask) -> tuple[list[int], list[int]]:
    """Rows of the outputs that are sensors, and where those stand in sensordata."""
    found = [
        (i, o.sensor) for i, o in enumerate(task.system.outputs.outputs) if o.sensor is not None
    ]
    return [i for i, _ in found], [s for _, s in found]


@pytest.mark.parametrize(
    "make",
    [
        body_task,
        lambda f: body_task(f, noise={"state": 0.1}),
        filtered_task,
        lambda f: cart_task(f, noise={**SENSED, "state": 0.1}),
    ],
)
def test_sensitivity_by_rollouts_solves_its_recursion(make, tmp_path) -> None:
    task = make(tmp_path)
    L, S = linear(task), sensitivity_of(task)
    psi = [np.zeros((task.space.nx, len(task.theta)))]
    for A, E in zip(L.A, L.E, strict=True):
        psi.append(A @ psi[-1] + E)
    G = np.einsum("kyx,kxp->kyp", L.C, S.psi) + L.H
    for found, wanted in ((S.psi, np.array(psi)), (S.G, G)):
        assert (np.abs(wanted).max(axis=(0, 1)) > 0).all()
        assert found.shape == wanted.shape
        assert (np.abs(found - wanted) / np.abs(wanted).max(axis=(0, 1))).max() < 1e-6


@STILL
def test_mixed_derivatives_are_derivatives_of_the_directional_derivative(make, tmp_path) -> None:
    task = make(tmp_path)
    theta, curve, nx = task.theta, task.initial, task.space.nx
    psi = task.plant.derivatives.sensitivity(theta, curve).psi
    w = np.abs(theta) * np.linspace(1.0, 0.5, len(theta))
    given = (theta, curve, psi, w[None])
    found = task.plant.derivatives.bilinear(*given, CENTRAL_DIFFERENCES)
    quick = task.plant.derivatives.bilinear(*given, FORWARD_DIFFERENCES)
    for name in "ABCD":
        first = getattr(linear(task), name)
        if first.any():
            assert relative_error(getattr(found, name), first) < 1e-5
            assert relative_error(getattr(quick, name), first) < 1e-3
    h = 3e-4
    rows, address = sensed(task)
    plus, minus = (
        Loop(rebuilt(task, theta + s * h * w), task.system.grid.substeps) for s in (1, -1)
    )

    def changes(x: Array, u: Array, push: Array) -> Array:
        """Directional derivatives of F and h."""
        up, down = plus.plus(x, h * push), plus.plus(x, -h * push)
        dF = plus.minus(plus.F(up, u), minus.F(down, u))
        return np.concatenate([dF, (plus.h(up, u) - minus.h(down, u))[address]]) / (2 * h)

    for k in (7, 23):
        x, u, push = curve.state[k], curve.ctrl[k], psi[k] @ w
        ends = [
            [changes(plus.plus(x, e[:nx]), u + e[nx:], push) for e in s * h * np.eye(nx + len(u))]
            for s in (1, -1)
        ]
        wanted = np.subtract(*ends) / (2 * h)
        assert relative_error(found.F_mixed[0, k], wanted[:, :nx]) < 1e-4
        if rows:
            assert relative_error(found.h_mixed[0, k][:, rows], wanted[:, nx:]) < 1e-4


@pytest.mark.parametrize("make", [filtered_task, body_task], ids=["two steps a sample", "one"])
def test_rollout_and_sensors_agree_with_a_plain_loop(make, tmp_path) -> None:
    noise = {"noise": {"angle": 0.1, "torque": 0.1}} if make is filtered_task else {}
    task = make(tmp_path, "RK4", **noise)
    curve, loop = task.initial, Loop(task.plant.model(task.theta), task.system.grid.substeps)
    y, _ = task.plant.measure(task.theta[None], curve.ctrl)
    # The last control is held.
    points = list(zip(curve.state, [*curve.ctrl, curve.ctrl[-1]], strict=True))
    states, sensed = ([each(x, u) for x, u in points] for each in (loop.F, loop.h))
    assert_allclose(curve.state[1:], states[:-1], rtol=0, atol=1e-13)
    assert_allclose(y[0], sensed, rtol=0, atol=1e-11)
    period = task.system.grid.substeps * task.system.model.opt.timestep
    assert curve.t[-1] == pytest.approx(task.samples * period)


def gain(task: DesignTask) -> Array:
    """Regulator with unit weights along the initial trajectory."""
    L, dt = linear(task), task.dt
    nx, nu = task.space.nx, task.plant.nu
    return regulator(L.A, L.B, np.eye(nx) * dt, np.eye(nu) * dt, np.eye(nx))


def tangent(task: DesignTask, K: Array) -> TangentCurve:
    """A smooth tangent vector along the initial trajectory."""
    L, t = linear(task), task.t[:, None]
    c = np.sin(7.0 * t + 1.0 + np.arange(task.plant.nu))
    z = LinearRecursion(L.A - L.B @ K).forward(
        np.zeros(task.space.nx), np.einsum("kiu,ku->ki", L.B, c)
    )
    return TangentCurve(z=z, v=c - np.einsum("kui,ki->ku", K, z[:-1]))


@STILL
def test_projection_is_idempotent_and_feasible(make, tmp_path) -> None:
    task = make(tmp_path)
    K, plant, theta = gain(task), task.plant, task.theta
    zeta = tangent(task, K)
    once = plant.project(theta, task.initial, zeta, 0.5, K)
    moved = plant.difference(once, task.initial)
    assert np.abs(moved.z).max() > 1e-3
    alpha = task.space.plus(task.initial.state, 0.5 * zeta.z)
    error = task.space.minus(alpha, once.state)[:-1]
    law = task.initial.ctrl + 0.5 * zeta.v + np.einsum("kui,ki->ku", K, error)
    assert_allclose(once.ctrl, law, rtol=0, atol=1e-12)
    # The projection is a trajectory, and projected again it stays where it is.
    twice = plant.project(theta, task.initial, moved, 1.0, K)
    for again in (plant.simulate(theta, once.ctrl), twice):
        assert_allclose(again.state, once.state, rtol=0, atol=1e-9)
        assert_allclose(again.ctrl, once.ctrl, rtol=0, atol=1e-9)


def test_a_diverging_control_is_reported_without_messages_of_mujoco(
    tmp_path, monkeypatch, capfd
) -> None:
    monkeypatch.chdir(tmp_path)
    task = cart_task(tmp_path)
    before, K = sorted(p.name for p in tmp_path.iterdir()), gain(task)
    wild = TangentCurve(z=np.zeros((task.samples + 1, 4)), v=np.full((task.samples, 1), 9e9))
    assert task.plant.project(task.theta, task.initial, wild, 1.0, 0.0 * K) is None
    assert task.plant.project(task.theta, task.initial, wild, 1.0, K) is None
    with pytest.raises(SimulationDivergedError, match="diverges"):
        task.plant.simulate(task.theta, wild.v)
    ctrl = task.plant.trajectory(task.initial.state, wild.v)
    assert task.plant.derivatives.sensitivity(task.theta, ctrl) is None
    assert task.plant.derivatives.predict(task.theta, wild.v) is None
    assert capfd.readouterr() == ("", "")
    assert sorted(p.name for p in tmp_path.iterdir()) == before  # no MUJOCO_LOG.TXT


@pytest.mark.parametrize("open_loop", [True, False])
@pytest.mark.parametrize(("sample", "bad"), [(20, np.nan), (20, 1e12), (0, 9e9), (30, 9e9)])
def test_a_control_that_mujoco_rejects_or_that_makes_it_reset_is_noticed(
    sample: int, bad: float, open_loop: bool, tmp_path
) -> None:
    light = (
        CART_PENDULUM.format(integrator="RK4")
        .replace('mass="1"', 'mass="0.01"')
        .replace("1.5", "0.01")
    )
    task = make_task(light, tmp_path, parameters=CART_PARAMETERS, noise={"state": 0.1})
    K, wild = gain(task) * (not open_loop), np.zeros((task.samples, 1))
    wild[sample] = bad
    zeta = TangentCurve(z=np.zeros((task.samples + 1, 4)), v=wild)
    assert task.plant.project(task.theta, task.initial, zeta, 1.0, K) is None


@pytest.mark.parametrize("bad", [np.nan, 1e12])
def test_linearization_where_mujoco_resets_the_state_is_an_error(bad: float, tmp_path) -> None:
    task = cart_task(tmp_path)
    states = np.array(task.initial.state)
    states[20, 2] = bad
    with pytest.raises(SimulationDivergedError, match="linearization"):
        task.plant.derivatives.linearize(
            task.theta, task.plant.trajectory(states, task.initial.ctrl)
        )


def test_batches_of_any_size_in_any_order_give_the_same_curves(tmp_path) -> None:
    task, rng = filtered_task(tmp_path), np.random.default_rng(5)
    thetas = task.theta * rng.uniform(0.8, 1.2, (70, 2))
    alone = np.stack(
        [filtered_task(tmp_path).plant.measure(t[None], task.control)[0][0] for t in thetas[:6]]
    )
    for count in (2, 6, 1, 70, 3, 5):
        y, finite = task.plant.measure(thetas[:count], task.control)
        assert finite.tolist() == [True] * count
        assert_array_equal(y[:6], alone[:count])
    wild = thetas[:4].copy()
    wild[1] *= -1.0  # a negative mass: this one may do as it likes, its neighbours may not
    y, _ = task.plant.measure(wild, task.control)
    assert_array_equal(y[[0, 2, 3]], alone[[0, 2, 3]])
    states, model = task.initial.state, task.plant.model(task.theta)
    for count in (5, 50, 1, 12):
        out, _, _ = task.plant.simulator.step([model], states[:count], task.control[:count])
        assert_array_equal(out, states[1 : count + 1])


@pytest.mark.parametrize("integrator", ["RK4", "Euler", "implicitfast"])
def test_switching_off_solver_and_sensors_of_an_unconstrained_model_changes_no_bit(
    integrator: str, tmp_path
) -> None:
    plain, lean = stated_and_lean(tmp_path, False, loss=0.0, integrator=integrator)
    off = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_SENSOR
    assert (plain.opt.disableflags & off, lean.opt.disableflags & off) == (0, off)
    assert_array_equal(motion_with_reversals(lean), motion_with_reversals(plain))


# One joint with dry friction. The body may be followed by others, and the model by other trees.
BENCH = """
<mujoco>
  <option timestep="0.001" integrator="{integrator}">
    <flag contact="{contact}" {flag}/>
  </option>
  <worldbody>
    <body>
      <joint name="a" type="hinge" axis="0 1 0" damping="0.01" armature="0.001"
        frictionloss="{loss}" {limit}/>
      <inertial pos="0 0 -0.1" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/>
      {child}
    </body>
    {tree}
  </worldbody>
  <actuator><motor joint="a"/></actuator>
  {more}
</mujoco>
"""


def bench(folder: Path, **parts: Any) -> tuple[Any, Path]:
    """Spec and path of a test bench with some further parts."""
    defaults = dict.fromkeys(("flag", "limit", "child", "tree", "more"), "")
    values = {"integrator": "implicitfast", "contact": "disable", "loss": 0.05, **parts}
    path = folder / "model.xml"
    path.write_text(BENCH.format(**{**defaults, **values}), encoding="utf-8")
    return load_spec(path), path


def stated_and_lean(folder: Path, friction: bool = True, **parts: Any) -> tuple[Any, Any]:
    """A test bench as it is stated, solved exactly, and the copy of it that a plant steps."""
    spec, path = bench(folder, **parts)
    plain = compile_spec(spec, path)
    plain.opt.tolerance = 1e-14
    plain.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_WARMSTART)
    source = ModelSource(path, spec)
    lean = PlantModel(source, moved_bodies=frozenset(), sensors=False, friction=friction)
    return plain, lean.model


def motion_with_reversals(model: Any) -> Array:
    """(300, nq + nv) states of a motion in which the joint reverses and sticks."""
    data, rows = mujoco.MjData(model), []
    for k in range(300):
        data.ctrl[:] = 0.6 * np.sin(0.05 * k)
        mujoco.mj_step(model, data, 10)
        rows.append(np.concatenate([data.qpos, data.qvel]))
    return np.array(rows)


@pytest.mark.parametrize("loss", [1e-6, 0.05, 0.4, 100.0])
def test_one_row_of_friction_has_the_same_force_by_the_quicker_solver(
    loss: float, tmp_path
) -> None:
    plain, lean = stated_and_lean(tmp_path, loss=loss)
    assert (plain.opt.solver, lean.opt.solver) == (
        mujoco.mjtSolver.mjSOL_NEWTON,
        mujoco.mjtSolver.mjSOL_PGS,
    )
    assert_allclose(motion_with_reversals(lean), motion_with_reversals(plain), rtol=0.0, atol=1e-9)


LINK = (
    '<body pos="0 0 -0.2"><joint type="hinge" axis="0 1 0" frictionloss="0.02"/>'
    '<inertial pos="0 0 -0.1" mass="0.3" diaginertia="1e-3 1e-3 1e-3"/>{}</body>'
)
TENDON = '<tendon><fixed {}><joint joint="a" coef="1"/></fixed></tendon>'
GEOMS = '<geom size="1 1 1" type="plane" pos="0 0 -2"/>' + LINK.format('<geom size="0.1"/>')


@pytest.mark.parametrize(
    ("parts", "has_islands"),
    [
        ({"child": LINK.format("")}, False),
        ({"tree": LINK.format("")}, True),
        ({"tree": GEOMS, "contact": "enable"}, True),
        ({"limit": 'limited="true" range="-1 1"'}, False),
        ({"more": TENDON.format('frictionloss="1"')}, False),
        ({"more": TENDON.format('limited="true" range="-1 1"')}, False),
        ({"more": '<equality><joint joint1="a"/></equality>'}, False),
    ],
)
def test_the_stated_solver_stays_where_there_may_be_more_rows(
    parts: dict[str, str], has_islands: bool, tmp_path
) -> None:
    plain, lean = stated_and_lean(tmp_path, **parts)
    assert not unconstrained(plain)
    assert lean.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON
    islands = lean.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    assert bool(islands) is not has_islands
    assert_array_equal(motion_with_reversals(lean), motion_with_reversals(plain))


@pytest.mark.parametrize("solver", ["CG", "Newton"])
def test_a_design_is_verified_with_the_stated_solver(solver: str, tmp_path) -> None:
    _, path = bench(tmp_path, more=f'<option solver="{solver}"/>')
    parameters = {"damping": {"target": "joint/a:damping"}}
    system = make_task(path, tmp_path, parameters=parameters, noise={"state": 0.01}).system
    theta = system.parameters.guess
    assert system.model_at(theta).opt.solver == mujoco.mjtSolver.mjSOL_PGS
    found = system.model_with_stated_solver(theta).opt
    assert found.solver == getattr(mujoco.mjtSolver, f"mjSOL_{solver.upper()}")
    assert found.disableflags == system.model.opt.disableflags


def test_an_unknown_initial_orientation_moves_in_its_tangent_space(tmp_path) -> None:
    nuisance = {"initial": {"qpos:ball.rz": True, "qvel:float.ry": True}}
    task = body_task(tmp_path, noise={"state": 0.1, "acc": 0.1}, nuisance=nuisance)
    S = sensitivity_of(task)
    assert_allclose(S.psi[0][:, 4:], np.eye(18)[:, [8, 13]], rtol=0, atol=1e-9)
    slopes = measured_slopes(task)
    errors = np.abs(S.G - slopes).max(axis=(0, 1))
    assert (errors < 1e-6 * np.abs(slopes).max(axis=(0, 1))).all()


def measured_slopes(task: DesignTask) -> Array:
    """(N+1, ny, p) differences of what is measured at moved parameters."""
    steps = 1e-5 * np.eye(len(task.theta))
    moved = np.concatenate([task.theta + steps, task.theta - steps])
    up, down = np.split(task.plant.measure(moved, task.control)[0], 2)
    return np.moveaxis(up - down, 0, 2) / 2e-5


def test_start_biases_and_scales_change_what_is_measured(tmp_path) -> None:
    scales = {
        "angle": {"target": "output/angle:scale", "guess": 0.1},
        "acc": {"target": "output/acc[2]:scale"},
    }
    nuisance = {
        "initial": {"qpos:hinge": True, "qvel:slide": True},
        "bias": {"angle": True, "acc[2]": 0.1},
    }
    noise = {"state": 0.05, **SENSED}
    task = cart_task(
        tmp_path, noise=noise, parameters={**CART_PARAMETERS, **scales}, nuisance=nuisance
    )
    derivatives, theta = task.plant.derivatives, task.theta
    columns = [task.system.outputs.names.index(name) for name in ("angle", "acc[2]")]

    # y = (1 + s) h + b
    values = np.tile(theta, (2, 1))
    values[:, [3, 4, 7, 8]] = [[0.0] * 4, [0.1, 0.3, 0.7, -0.2]]
    (wanted, y), _ = task.plant.measure(values, task.control)
    wanted[:, columns] = wanted[:, columns] * [1.1, 1.3] + [0.7, -0.2]
    assert_allclose(y, wanted, rtol=0, atol=1e-12)

    # All ways to the derivatives agree, and they are those of what is measured.
    slopes, S, L = measured_slopes(task), sensitivity_of(task), linear(task)
    recursion = np.einsum("kyx,kxp->kyp", L.C, S.psi) + L.H
    for G in (derivatives.predict(theta, task.control)[1], S.G, recursion):
        errors = np.abs(G - slopes).max(axis=(0, 1))
        assert (errors < 1e-6 * np.abs(slopes).max(axis=(0, 1))).all()

    # (dq, dv): the angle of the hinge, the speed of the slide
    assert_allclose(S.psi[0][:, 5:7], np.eye(4)[:, [1, 2]], rtol=0, atol=1e-9)


def test_parameters_of_little_effect_get_longer_difference_steps_and_others_keep_theirs(
    tmp_path,
) -> None:
    faint = {"tiny": {"target": "body/bob:inertia[1]"}, **CART_PARAMETERS}
    task = cart_task(tmp_path, parameters=faint)
    relative = task.plant.derivatives.parameter_scale / task.parameters.magnitude
    assert relative[0] > 5.0
    assert (relative >= 1.0).all() and (relative <= 100.0).all()
    assert_array_equal(relative[1:3], 1.0)
    # A longer step reduces round-off and leaves the derivative unchanged.
    S = sensitivity_of(task).psi[..., 0]
    far = task.plant.derivatives.sensitivity(task.theta, task.initial, 1e-4).psi[..., 0]
    assert relative_error(S, far) < 1e-6


def test_one_step_effects_are_E_and_H_in_natural_units(tmp_path) -> None:
    task = body_task(tmp_path)
    picked, L = [3, 20, 41], linear(task)
    derivatives, nx, p = task.plant.derivatives, task.space.nx, len(task.theta)
    found = derivatives.one_step(task.theta, task.initial, np.array(picked), 1e-5)
    sizes = task.dt * derivatives.difference_sizes(task.initial)[:nx]
    states = found[: 3 * nx].reshape(3, nx, p) * sizes[:, None]
    assert relative_error(states, L.E[picked]) < 1e-6
    H = L.H[picked] * task.parameters.magnitude
    size = np.abs(H).max(axis=(0, 2))
    moving = size > 1e-6
    assert moving.sum() >= 3
    sensors = found[3 * nx :].reshape(H.shape) * task.parameters.magnitude
    assert relative_error(sensors[:, moving], H[:, moving] / size[moving, None]) < 1e-5


# A cart that hangs on two mocap bodies: on one by a spring, on the other by an equality, whose
# constants MuJoCo derives from where they compile.
CARRIED = """
<mujoco>
  <option timestep="0.01" gravity="0 0 0"/>
  <worldbody>
    <body name="near" mocap="true" pos="0.1 0 0"><site name="near"/></body>
    <body name="cart">
      <joint name="x" type="slide" axis="1 0 0" damping="1"/>
      <joint name="turn" axis="0 0 1" damping="0.1"/>
      <geom size=".1" mass="1" contype="0" conaffinity="0"/><site name="cart"/>
    </body>
    <body name="far" mocap="true" pos="0 1 0"><site name="far" pos="0 0.1 0"/></body>
  </worldbody>
  <tendon><spatial name="t" stiffness="20"><site site="cart"/><site site="near"/></spatial></tendon>
  <equality><weld body1="cart" body2="far" solref="0.3 1"/></equality>
  <actuator><motor name="m" joint="x"/></actuator>
  <sensor><framepos name="far" objtype="site" objname="far" noise="0.1"/></sensor>
  <keyframe>
    <key name="moved" mpos="0.6 0 0  0.2 1.1 0" mquat="1 0 0 0  0.9 0 0 0.4" qpos="0.1 0.05"/>
  </keyframe>
</mujoco>
"""


@pytest.mark.parametrize("function", [False, True])
def test_mocap_bodies_stand_where_the_keyframe_puts_them(function: bool, tmp_path) -> None:
    """Every kind of simulation agrees with plain MuJoCo from `mj_resetDataKeyframe`."""
    damped: dict[str, Any] = {"target": "joint/x:damping"}
    if function:
        damped = {
            "function": lambda spec, v: setattr(spec.joint("x"), "damping", [v, 0.0, 0.0]),
            "guess": 1.0,
        }
    initial = {"keyframe": "moved", "control": {"kind": "sine", "amplitude": 2.0}}
    task = make_task(CARRIED, tmp_path, initial=initial, parameters={"d": damped})
    plain = task.system.model
    data = mujoco.MjData(plain)
    mujoco.mj_resetDataKeyframe(plain, data, 0)
    states, sensed = [], []
    for u in [*task.control, task.control[-1]]:
        states.append(np.concatenate([data.qpos, data.qvel]))
        data.ctrl[:] = u
        mujoco.mj_step(plain, data)
        sensed.append(np.array(data.sensordata))
    wanted = np.array(states)
    assert np.abs(wanted[-1] - wanted[0]).max() > 0.05

    for theta in (task.theta, task.theta + 0.5, task.theta):  # models are written anew
        y, _ = task.plant.measure(theta[None], task.control)
    model, K = task.plant.model(task.theta), np.zeros((task.samples, 1, 4))
    closed, _, _ = task.plant.simulator.closed_loop(model, task.initial.state, task.control, K)
    stepped, _, _ = task.plant.simulator.step([model], wanted[:-1], task.control)
    # The model is stepped to a tighter solver tolerance.
    for found, expected in (
        (task.initial.state, wanted),
        (y[0], sensed),
        (closed, wanted),
        (stepped, wanted[1:]),
    ):
        assert_allclose(found, expected, rtol=0.0, atol=1e-6)
    whole = task.system.model_at(task.theta)
    assert_allclose(whole.eq_data, plain.eq_data, atol=1e-12)
    assert_array_equal(mujoco.MjData(whole).mocap_pos, [[0.6, 0, 0], [0.2, 1.1, 0]])
    compiled = task.system.model_at(task.theta, at_keyframe=False)
    assert_array_equal(compiled.body_pos, plain.body_pos)


def test_parameters_move_mocap_bodies_without_a_keyframe(tmp_path) -> None:
    place = {"x": {"target": "body/near:pos[0]", "scale": 1.0}}
    task = make_task(CARRIED, tmp_path, parameters=place)
    found = sensitivity_of(task)
    ends = [task.plant.simulate(task.theta + h, task.control).state[-1] for h in (1e-4, -1e-4)]
    slope = (ends[0] - ends[1]) / 2e-4
    assert np.abs(slope).max() > 0.1
    assert_allclose(found.psi[-1, :, 0], slope, rtol=1e-4, atol=1e-6)
    initial = {"keyframe": "moved", "control": {"kind": "sine"}}
    with pytest.raises(
        ExperimentError, match=r"parameters\.x: the keyframe states the pose of mocap body 'near'"
    ):
        make_task(CARRIED, tmp_path, parameters=place, initial=initial)


def test_clock_sensors_begin_at_zero(tmp_path) -> None:
    xml = CART_PENDULUM.format(integrator="RK4").replace(
        "<sensor>", '<sensor><clock name="clock" noise="0.1"/>'
    )
    parameters = {"c": {"target": "joint/hinge:damping"}}
    task = make_task(xml, tmp_path, rate=50.0, parameters=parameters, noise={"clock": 0.1})
    y, _ = task.plant.measure(task.theta[None], task.control)
    assert_allclose(y[0, :, 0], np.arange(task.samples + 1) * task.dt, atol=1e-12)
    model = task.plant.model(task.theta)
    _, sensed, _ = task.plant.simulator.step([model], task.initial.state[:1], task.control[:1])
    assert sensed[0, model.sensor("clock").adr[0]] == 0.0


def test_quaternions_of_the_initial_state_are_normalised_or_refused(tmp_path) -> None:
    def start(*qpos: float) -> Array:
        return body_task(
            tmp_path, initial={"qpos": qpos, "control": {"kind": "sine"}}
        ).plant.nominal_initial_state

    unit = start(1, 2, 3, 0.6, 0, 0.8, 0, 0, 0, 1, 0)
    assert_array_equal(unit[:11], [1, 2, 3, 0.6, 0, 0.8, 0, 0, 0, 1, 0])
    assert_allclose(start(1, 2, 3, 1.2, 0, 1.6, 0, 0, 0, 5, 0), unit, atol=1e-15)
    with pytest.raises(
        ExperimentError,
        match=r"initial\.qpos: the quaternion of joint 'ball' \(numbers 7 to 10\) is zero",
    ):
        start(1, 2, 3, 0.6, 0, 0.8, 0, 0, 0, 0, 1e-9)
    with pytest.raises(ExperimentError, match=r"joint 'float' \(numbers 3 to 6\)"):
        start(*[0.0] * 11)
