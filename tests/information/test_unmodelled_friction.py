"""Dry friction that the model may lack, as a nuisance: names, information, and intervals."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.excitation.evaluation import evaluate_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System
from mjfim.records.trajectory import Recording

SLIDE = """
<mujoco>
  <option timestep="0.005" gravity="0 0 0"/>
  <worldbody>
    <body name="cart">
      <inertial pos="0 0 0" mass="{mass}" diaginertia="1 1 1"/>
      <joint name="x" type="slide" axis="1 0 0" damping="{damping}"
             frictionloss="{friction}"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="x"/></actuator>
  <sensor><jointpos name="place" joint="x"/></sensor>
</mujoco>
"""

PARAMETERS = {"mass": {"target": "body/cart:mass"}, "damping": {"target": "joint/x:damping"}}
MODELS = Path(__file__).resolve().parents[2] / "models"
SIGMA = 1e-3
N = 300


def experiment(folder: Path, friction: float = 0.0, **tables: object) -> mjfim.Experiment:
    """A cart under a chirp, whose model has some dry friction."""
    path = folder / f"cart_{friction}.xml"
    path.write_text(SLIDE.format(mass=2.0, damping=1.5, friction=friction), encoding="utf-8")
    control = {"kind": "chirp", "amplitude": 3.0, "frequency": 0.5, "frequency_end": 2.0}
    base = {
        "model": str(path),
        "rate": 100.0,
        "horizon": N / 100.0,
        "initial": {"control": control},
        "parameters": PARAMETERS,
        "noise": {"place": SIGMA},
        "limits": {"control": {"push": [-4.0, 4.0]}},
        "cost": {"control": 0.0},
    }
    return mjfim.Experiment(**{**base, **tables})


def played(ctrl: np.ndarray, mass: float, damping: float, friction: float) -> np.ndarray:
    """(N+1,) places of the cart by MuJoCo's own steps."""
    text = SLIDE.format(mass=mass, damping=damping, friction=friction)
    model = mujoco.MjModel.from_xml_string(text)
    data, found = mujoco.MjData(model), [0.0]
    for u in ctrl[:, 0]:
        data.ctrl[0] = u
        mujoco.mj_step(model, data, 2)
        found.append(float(data.qpos[0]))
    return np.array(found)


def test_friction_of_all_joints_beside_that_of_parameters(tmp_path: Path) -> None:
    """`true` stands for all joints whose friction no parameter sets; a number has the prior."""
    cart = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml")
    known = {"dry": {"target": "joint/slide:frictionloss", "guess": 0.1}}
    system = System.resolve(cart.replace(parameters=known, nuisance={"friction": True}))
    assert system.parameters.names[-2:] == ("dry", "dry friction hinge")

    stated = cart.replace(nuisance={"friction": {"slide": "200 mN"}})
    found = System.resolve(stated).parameters.parameters[-1]
    assert (found.name, found.nuisance, found.prior, found.unit) == (
        "dry friction slide",
        True,
        pytest.approx(0.2),
        "N",
    )
    assert found.bounds[0] == 0.0
    assert 0.0 < found.guess < 0.1

    rotor = cart.replace(nuisance={"armature": {"slide": "100 g"}})
    armature = System.resolve(rotor).parameters.parameters[-1]
    assert (armature.name, armature.nuisance, armature.unit) == ("armature slide", True, "kg")
    assert armature.prior == pytest.approx(0.1)


@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_sigma_beside_unknown_friction_is_that_of_the_whole_inverse(
    friction: float, tmp_path: Path
) -> None:
    """Against differences of plain MuJoCo."""
    task = DesignTask.resolve(experiment(tmp_path, friction, nuisance={"friction": True}))
    ctrl = task.control

    assert task.theta[2] == friction if friction else 0.0 < task.theta[2] < 0.1
    columns = []
    for step in np.diag([1e-4, 1e-4, 1e-5]):
        ahead, behind = played(ctrl, *(task.theta + step)), played(ctrl, *(task.theta - step))
        columns.append((ahead - behind)[1:] / (2.0 * step.max() * SIGMA))
    J = np.array(columns).T
    expected = np.sqrt(np.diag(np.linalg.inv(J.T @ J)))

    std = evaluate_task(task, task.initial).std
    assert_allclose(std, expected, rtol=0.02)

    # The friction takes a part of what the motion tells about the damping.
    plain = DesignTask.resolve(experiment(tmp_path, friction))
    alone = evaluate_task(plain, plain.initial).std
    assert_allclose(alone, np.sqrt(np.diag(np.linalg.inv(J[:, :2].T @ J[:, :2]))), rtol=0.02)
    assert std[1] > 1.5 * alone[1]


def test_intervals_hold_where_the_friction_of_a_robot_is_a_nuisance(tmp_path: Path) -> None:
    """A robot with dry friction and late commands, which the model lacks."""
    stated = experiment(tmp_path)
    ctrl = DesignTask.resolve(stated).control
    late = np.concatenate([np.zeros((1, 1)), ctrl[:-1]])
    rng = np.random.default_rng(0)
    y = played(late, 2.2, 1.2, 0.25)[:, None] + SIGMA * rng.standard_normal((N + 1, 1))
    t = 0.01 * np.arange(N + 1, dtype=np.float64)
    recording = Recording(t=t, ctrl=ctrl, y=y, outputs=("place",))

    true = np.array([2.2, 1.2, 0.01, 0.25])
    shares = []
    for nuisance in ({}, {"friction": True, "delay": True}):
        found = mjfim.identify(
            stated.replace(nuisance=nuisance, fit={"bootstrap": 0}),
            recording,
            method="newton",
            progress=False,
        )
        shares.append(np.max(np.abs(found.theta[:2] / true[:2] - 1.0)))
    low, high = found.interval.T
    assert ((low <= true) & (true <= high)).all()
    assert shares[1] < 0.1 * shares[0]
