"""What is measured: columns of any joint, rates, covariances; and every wrong table named."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.errors import ExperimentError
from mjfim.excitation.task import DesignTask
from mjfim.model.coordinates import (
    control_names,
    joint_names,
    measurable_columns,
    scalar_joints,
)
from tests.support.numerics import (
    Loop,
    body_task,
    cart_task,
    make_task,
    sensitivity_of,
)

FREE = [f"qpos:float.{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
BALL = [f"qpos:ball.q{part}" for part in "wxyz"]
RATES = [f"qvel:float.{part}" for part in ("x", "y", "z", "rx", "ry", "rz")] + [
    f"qvel:ball.r{a}" for a in "xyz"
]


ACC = [f"acc[{i}]" for i in range(3)]
STATE = ["qpos:slide", "qpos:hinge", "qvel:slide", "qvel:hinge"]


def sigmas(task: DesignTask) -> dict[str, float]:
    """Standard deviation of every output."""
    return dict(zip(task.system.outputs.names, task.system.noise.sigma.tolist(), strict=True))


def test_every_component_of_any_joint_has_a_column(tmp_path: Path) -> None:
    """In the order of qpos and qvel, with its unit; quaternions by half the stated angle."""
    task = body_task(tmp_path, noise={"state": 0.02})
    outputs = task.system.outputs
    assert outputs.names == (*FREE, *BALL, *RATES)
    assert [o.state for o in outputs.outputs] == list(range(11 + 9))
    units = [*["m"] * 3, *[""] * 8, *["m/s"] * 3, *["rad/s"] * 6]
    assert [o.unit for o in outputs.outputs] == units
    angles = {*FREE[3:], *BALL}
    assert sigmas(task) == {n: 0.01 if n in angles else 0.02 for n in outputs.names}
    sensors = [f"{sensor}[{i}]" for sensor in ("gyro", "acc", "tip") for i in range(3)]
    assert list(measurable_columns(task.system.model)) == [*outputs.names, *sensors]


def test_information_about_parameters_is_that_of_the_rotation_vector(tmp_path: Path) -> None:
    """Through the whole chain: from measured quaternions, against psi in the tangent space over
    sigma.
    """
    task = body_task(tmp_path, noise={"qpos:ball": 0.05})
    found = sensitivity_of(task)
    psi = found.psi[1:, 6:9] / 0.05
    wanted = np.einsum("kip,kiq->pq", psi, psi)
    assert_allclose(
        task.information.matrix(found), wanted, rtol=1e-8, atol=1e-8 * np.abs(wanted).max()
    )
    assert np.linalg.eigvalsh(wanted)[-1] > 1.0


def test_an_unnamed_joint_does_not_take_the_name_of_another(tmp_path: Path) -> None:
    xml = """<mujoco><worldbody><body><joint type="slide"/><geom size="1"/>
      <body><joint name="joint0"/><geom size="1"/></body></body></worldbody>
      <actuator><motor joint="joint0"/><motor name="actuator0" joint="joint0"/></actuator></mujoco>
      """
    model = mujoco.MjModel.from_xml_string(xml)
    assert joint_names(model) == ("joint0_", "joint0")
    assert [c.name for c in scalar_joints(model)] == ["joint0_", "joint0"]
    assert control_names(model) == ("actuator0_", "actuator0")
    parameters = {"d": {"target": "joint/joint0:damping", "guess": 0.1}}
    task = make_task(xml, tmp_path, parameters=parameters, noise={"state": 0.1})
    assert task.system.outputs.names == (
        "qpos:joint0_",
        "qpos:joint0",
        "qvel:joint0_",
        "qvel:joint0",
    )


def test_every_output_has_its_rate(tmp_path: Path) -> None:
    noise = {
        "state": 0.1,
        "qpos:hinge": {"sigma": 0.05, "rate": 100.0},
        "acc": {"sigma": 0.3, "rate": 10.0},
    }
    task = cart_task(tmp_path, measure_rate=50.0, noise=noise)
    assert task.system.outputs.names == (*STATE, *ACC)
    assert task.system.noise.strides.tolist() == [2, 1, 2, 2, 10, 10, 10]
    assert task.system.noise.sigma.tolist() == [0.1, 0.05, 0.1, 0.1, 0.3, 0.3, 0.3]


def test_components_of_a_sensor_have_their_own_sigmas(tmp_path: Path) -> None:
    noise = {"acc": {"sigma": [0.1, 0.2, 0.3]}, "qpos:slide": {"sigma": [0.4]}}
    found = sigmas(cart_task(tmp_path, noise=noise))
    assert found == pytest.approx(
        {"qpos:slide": 0.4, **dict(zip(ACC, (0.1, 0.2, 0.3), strict=True))}
    )


BLOCK = np.array([[0.09, 0.03, 0.0], [0.03, 0.16, -0.02], [0.0, -0.02, 0.04]])
ALL = (0.01 * (np.eye(4) + 0.3)).tolist()


MIXED = ["acc[2]", "qpos:hinge", "drive"]
COVARIANCE = {"covariance": BLOCK.tolist()}


@pytest.mark.parametrize(
    ("tables", "names", "further"),
    [
        ({"noise": {"state": 0.1, "acc": COVARIANCE}}, ACC, STATE),
        # The order is that of the block; outputs are measured also where no other key names them.
        ({"noise": {"state": 0.1}, "correlated": [{"outputs": MIXED, **COVARIANCE}]}, MIXED, STATE),
        # The key of one column overrules the covariance of all.
        (
            {"noise": {"acc": COVARIANCE, "qpos:hinge": 0.1, "state": {"covariance": ALL}}},
            ACC,
            ["qpos:hinge"],
        ),
    ],
)
def test_a_covariance_stands_in_the_rows_of_its_outputs(
    tables: dict[str, Any], names: list[str], further: list[str], tmp_path: Path
) -> None:
    """It is correlated with no other output."""
    task = cart_task(tmp_path, **tables)
    found = list(task.system.outputs.names)
    at = [found.index(name) for name in names]
    covariance = task.system.noise.covariance
    assert_allclose(covariance[np.ix_(at, at)], BLOCK, rtol=1e-15)
    assert not np.delete(covariance[at], at, axis=1).any()
    for name in {*further} - {*names}:
        assert sigmas(task)[name] == pytest.approx(0.1)
        assert np.count_nonzero(covariance[found.index(name)]) == 1


def square(n: int, value: float = 1.0) -> list[list[float]]:
    """A diagonal covariance."""
    return (value * np.eye(n)).tolist()


def pair(*names: str, key: str = "covariance") -> list[dict[str, Any]]:
    """One correlated block."""
    return [{"outputs": list(names), key: square(len(names))}]


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "unknown": (
        {"noise": {"accel": 0.1}},
        r"noise: unknown sensor 'accel'.*'acc'.*valid: .*qpos:hinge.*state",
    ),
    "too few sigmas": (
        {"noise": {"acc": {"sigma": [1.0, 2.0]}}},
        r"noise\.acc\.sigma: 2 numbers; .* each of 3",
    ),
    "rate": (
        {"noise": {"acc": {"sigma": 1.0, "rate": 30.0}}},
        r"noise\.acc\.rate: 30 Hz does not divide rate 100 Hz",
    ),
    "rate above": (
        {"noise": {"acc": {"sigma": 1.0, "rate": 200.0}}},
        r"noise\.acc\.rate: 200 Hz .*100, 50, 25",
    ),
    "rate too slow": (
        {"noise": {"acc": {"sigma": 1.0, "rate": 1.0}}},
        r"noise\.acc\.rate: 1 Hz gives no measurement within",
    ),
    "covariance size": (
        {"noise": {"acc": {"covariance": square(2)}}},
        r"noise\.acc\.covariance: expected 3 rows of 3",
    ),
    "covariance skew": (
        {"noise": {"acc": {"covariance": [[1.0, 0.5, 0.0], [0.2, 1.0, 0.0], [0.0, 0.0, 1.0]]}}},
        r"noise\.acc\.covariance: not symmetric",
    ),
    "covariance indefinite": (
        {"noise": {"acc": {"covariance": [[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]}}},
        r"noise\.acc\.covariance: not positive definite",
    ),
    "both": (
        {"noise": {"acc": {"sigma": 1.0, "covariance": square(3)}}},
        r"noise\.acc: .*exactly one of sigma and cov",
    ),
    "neither": (
        {"noise": {"acc": {"rate": 10.0}}},
        r"noise\.acc: .*exactly one of sigma and covariance",
    ),
    "sigma zero in a list": (
        {"noise": {"acc": {"sigma": [1.0, 0.0, 1.0]}}},
        r"noise\.acc\.sigma\.1: .*greater than 0",
    ),
    "correlated unknown": (
        {"correlated": pair("acc", "rate")},
        r"correlated\.outputs: unknown output 'acc'.*acc\[0\]",
    ),
    "correlated twice": (
        {"correlated": pair("rate", "rate")},
        r"correlated\.outputs: an output is listed twice",
    ),
    "correlated alone": (
        {"correlated": pair("rate")},
        r"correlated\.0\.outputs: needs 2 or more entries",
    ),
    "correlated rates": (
        {
            "noise": {"rate": 0.1, "angle": {"sigma": 0.1, "rate": 10.0}},
            "correlated": pair("rate", "angle"),
        },
        r"correlated\.outputs: these outputs are measured at different rates",
    ),
    "correlated outside": (
        {"noise": {"acc": {"covariance": BLOCK.tolist()}}, "correlated": pair("acc[0]", "rate")},
        r"correlated\.outputs: one of them is already correlated with an output that is not listed",
    ),
    "correlated key": (
        {"correlated": pair("rate", "angle", key="matrix")},
        r"correlated\.0\.matrix: unknown key .*valid: covariance, outputs",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_messages_about_wrong_tables(name: str, tmp_path: Path) -> None:
    tables, message = WRONG[name]
    with pytest.raises(ExperimentError, match=rf"experiment: {message}"):
        cart_task(tmp_path, **tables)


@pytest.mark.parametrize(
    ("written", "message"),
    [
        ("qpos:float[4]", "noise: 'qpos:float[4]' is now written 'qpos:float.qx'"),
        ("qpos:ball.rx", "the orientation is a quaternion here; valid: qpos:ball.qw, qpos:ball.qx"),
    ],
)
def test_another_spelling_of_a_column_is_refused_with_its_name(
    written: str, message: str, tmp_path: Path
) -> None:
    """Columns of the state hold quaternions, by part and not by index."""
    with pytest.raises(ExperimentError, match=re.escape(message)):
        body_task(tmp_path, noise={written: 0.1})


@pytest.mark.parametrize(("key", "size"), [("qpos:ball", 4), ("qpos:float", 7), ("state", 20)])
def test_a_covariance_of_an_orientation_is_refused(key: str, size: int, tmp_path: Path) -> None:
    """Its four components are one rotation."""
    said = rf"noise\.{key}: an orientation takes one sigma \[rad\] and no covariance"
    with pytest.raises(ExperimentError, match=said):
        body_task(tmp_path, noise={key: {"covariance": square(size)}})
    found = body_task(tmp_path, noise={"qvel:ball": {"covariance": square(3, 0.25)}})
    assert set(sigmas(found).values()) == {0.5}


def test_a_model_without_joints_has_no_state_to_measure(tmp_path: Path) -> None:
    xml = '<mujoco><worldbody><site name="s"/></worldbody></mujoco>'
    tables = {"parameters": {"m": {"target": "option:gravity[2]"}}, "noise": {"state": 0.1}}
    with pytest.raises(ExperimentError, match=r"noise\.state: the model has no joint to measure"):
        make_task(xml, tmp_path, **tables)


def test_sensors_read_by_the_plant_are_those_of_mujoco(tmp_path: Path) -> None:
    task = body_task(tmp_path, noise={"tip": 0.1, "gyro": 0.2, "qpos:float.pos": 0.3})
    y, _ = task.plant.measure(task.theta[None], task.control)
    state = task.initial.state[20]
    sensed = Loop(task.system.model, 1).h(state, task.control[20])
    wanted = np.concatenate([state[:3], sensed[:3], sensed[6:9]])
    assert_allclose(y[0, 20], wanted, rtol=0, atol=1e-9)
