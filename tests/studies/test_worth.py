"""`mjfim.worth`: sensors left out, halved and added, against `check` of such an experiment, and the
prices of limits against designs with wider limits.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.errors import ExperimentError
from mjfim.excitation.task import DesignTask
from mjfim.records.worth import PRICED_SHARE
from tests.support.numerics import Array, sensitivity_of
from tests.support.paths import MODELS

CART = MODELS / "cart_pendulum.toml"
NOISE = {"qpos:slide": 0.05, "qpos:hinge": 0.04, "qvel:slide": 0.03, "qvel:hinge": 0.05}


def cart(**tables: Any) -> mjfim.Experiment:
    """The cart-pendulum for 1 s, whose four sensors have noise of their own."""
    values = mjfim.Experiment.from_file(CART).model_dump(exclude_unset=True)
    changed = {**values, "horizon": 1.0, "noise": NOISE, **tables}
    return mjfim.Experiment.from_file(CART).restated(changed)


def checked(experiment: mjfim.Experiment) -> Array:
    """σ by `check`, infinite where a parameter is not identifiable alone."""
    return np.array([row.std for row in mjfim.check(experiment, progress=False).rows])


def sensors(found: mjfim.Worth) -> dict[str, Any]:
    """What each sensor tells, by its name."""
    return {each.name: each for each in found.sensors}


def test_each_sensor_alone_left_out_and_halved_is_a_changed_file() -> None:
    found = mjfim.worth(cart(), progress=False)
    np.testing.assert_allclose(found.std, checked(cart()), rtol=1e-6)
    for name, sigma in NOISE.items():
        others = {key: value for key, value in NOISE.items() if key != name}
        row = sensors(found)[name]
        for std, noise in (
            (row.without, others),
            (row.alone, {name: sigma}),
            (row.halved, {**NOISE, name: sigma / 2.0}),
        ):
            np.testing.assert_allclose(std, checked(cart(noise=noise)), rtol=1e-6)
    velocities = {key: NOISE[key] for key in ("qvel:slide", "qvel:hinge")}
    of_kind = sensors(found)["all velocities"]
    np.testing.assert_allclose(of_kind.alone, checked(cart(noise=velocities)), rtol=1e-6)


def test_correlated_outputs_are_one_sensor() -> None:
    joined = {
        "outputs": ["qpos:slide", "qvel:hinge"],
        "covariance": [[0.0025, 0.001], [0.001, 0.0025]],
    }
    others = {"qpos:hinge": 0.04, "qvel:slide": 0.03}
    found = mjfim.worth(cart(noise=others, correlated=[joined]), progress=False)
    row = sensors(found)["qpos:slide + qvel:hinge"]
    np.testing.assert_allclose(row.without, checked(cart(noise=others)), rtol=1e-6)


def test_a_sensor_whose_bias_is_unknown_and_one_that_measures_seldom_may_be_left_out() -> None:
    slow = {**NOISE, "qvel:hinge": {"sigma": 0.05, "rate": 20.0}}
    unsure = cart(noise=slow, nuisance={"bias": {"qpos:slide": True}})
    found = sensors(mjfim.worth(unsure, progress=False))
    others = {key: value for key, value in slow.items() if key != "qpos:slide"}
    np.testing.assert_allclose(
        found["qpos:slide"].without[:3], checked(cart(noise=others)), rtol=1e-6
    )
    rest = {key: value for key, value in slow.items() if key != "qvel:hinge"}
    expected = checked(cart(noise=rest, nuisance={"bias": {"qpos:slide": True}}))
    np.testing.assert_allclose(found["qvel:hinge"].without[:3], expected[:3], rtol=1e-6)


def test_added_sensors_are_those_of_a_model_that_has_them(tmp_path: Path) -> None:
    text = (MODELS / "cart_pendulum.xml").read_text(encoding="utf-8")
    body = text.index(">", text.index('<body name="bob"')) + 1
    sensor = '<sensor><gyro name="g" site="s"/><force name="f" site="s"/></sensor></mujoco>'
    text = text[:body] + '<site name="s"/>' + text[body:].replace("</mujoco>", sensor)
    (tmp_path / "with.xml").write_text(text, encoding="utf-8")

    add = {"gyro:bob": 0.01, "force:bob": 0.2, "torque": 0.1}
    found = sensors(mjfim.worth(cart(), add=add, progress=False))
    for name, key, sigma in (("gyro of bob", "g", 0.01), ("force of bob", "f", 0.2)):
        with_it = cart(model=str(tmp_path / "with.xml"), noise={**NOISE, key: sigma})
        np.testing.assert_allclose(found[name].present, checked(with_it), rtol=1e-6)
        assert found[name].is_added
        np.testing.assert_allclose(found[name].without, checked(cart()), rtol=1e-6)
    # The motor's force is its control, which tells nothing.
    np.testing.assert_allclose(found["torque of slide"].present, checked(cart()), rtol=1e-6)
    assert np.isinf(found["torque of slide"].alone).all()


def test_a_joint_acceleration_is_the_difference_of_two_velocities() -> None:
    found = sensors(mjfim.worth(cart(), add={"acceleration:hinge": 0.1}, progress=False))
    task = DesignTask.resolve(cart())
    velocity = []
    for j, sign in itertools.product(range(3), (1.0, -1.0)):
        theta = task.theta + sign * 1e-4 * np.eye(3)[j]
        velocity.append(task.plant.simulate(theta, task.control).qvel[:, 1])
    slopes = (np.array(velocity[::2]) - np.array(velocity[1::2])) / 2e-4
    rows = np.diff(slopes, axis=1) / (task.dt * 0.1)
    expected = np.sqrt(np.diag(np.linalg.inv(rows @ rows.T)))
    np.testing.assert_allclose(found["acceleration of hinge"].alone, expected, rtol=1e-4)


def test_the_smallest_set_is_that_of_all_sets() -> None:
    wanted = {"m": 0.2, "l": 0.12, "c": 0.5}
    stated = {name: {"wanted": value} for name, value in wanted.items()}
    experiment = cart().replace(parameters=stated)
    task = DesignTask.resolve(experiment)
    fine = sensitivity_of(task)
    rows = fine.G[1:] / np.array(list(NOISE.values()))[:, None]
    matrices = np.einsum("kyi,kyj->yij", rows, rows)
    names, enough = list(NOISE), []
    for count in range(1, 5):
        for chosen in itertools.combinations(range(4), count):
            std = np.sqrt(np.diag(np.linalg.inv(matrices[list(chosen)].sum(axis=0))))
            if (std <= list(wanted.values())).all():
                enough.append([names[i] for i in chosen])
    found = mjfim.worth(experiment, progress=False)
    assert enough and len(enough[0]) < 4
    assert list(found.fewest) in [each for each in enough if len(each) == len(enough[0])]


def test_an_unknown_sensor_or_place_is_named() -> None:
    for key, fault in (
        ("lidar", "gyro, moment"),
        ("gyro:hand", "bob"),
        ("torque:x", "slide"),
    ):
        with pytest.raises(ExperimentError, match=fault):
            mjfim.worth(cart(), add={key: 0.1}, progress=False)


@pytest.fixture(scope="module")
def limited() -> tuple[mjfim.Experiment, mjfim.Design]:
    """The cart-pendulum with limits for 1 s at 25 Hz, and its design."""
    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum_limits.toml").replace(
        rate=25.0,
        measure_rate=25.0,
        horizon=1.0,
        rehearsal={"robots": 0},
        boundary={"end": "free"},
        limits={"reserve": {}},
        descent={"starts": 1, "seconds": 3600.0},
    )
    return experiment, mjfim.design(experiment, progress=False)


def test_prices_are_those_of_a_design_with_a_wider_limit(
    limited: tuple[mjfim.Experiment, mjfim.Design],
) -> None:
    experiment, design = limited
    found = mjfim.worth(experiment, design, seconds=np.inf, progress=False)
    force, time = found.prices
    assert (force.name, time.name) == ("control of force", "time")

    wider = 5.0 * (1.0 + PRICED_SHARE)
    real = mjfim.design(
        experiment.replace(limits={"control": {"force": [-wider, wider]}}),
        initial_control=design.trajectory.ctrl,
        progress=False,
    )
    change = (design.final.eigenvalues[0] / real.final.eigenvalues[0]) ** 0.5 - 1.0
    assert change < -0.05
    assert force.predicted == pytest.approx(change, rel=0.2)
    assert force.redesigned == pytest.approx(change, rel=0.1)
    # The design did not centre its barrier: its multipliers are a first estimate.
    of_design = {price.name: price.predicted for price in design.worth.prices}
    assert of_design["control of force"] == pytest.approx(change, rel=0.3)
    assert time.redesigned < -0.01


def test_without_time_only_multipliers_are_shown(
    limited: tuple[mjfim.Experiment, mjfim.Design],
) -> None:
    experiment, design = limited
    found = mjfim.worth(experiment, design, progress=False)
    assert [price.predicted for price in found.prices] == [
        price.predicted for price in design.worth.prices
    ]
    assert all(np.isnan(price.redesigned) for price in found.prices)


def test_what_no_sensor_determines_alone_does_not_count() -> None:
    """Any motion shows only the sum of the mass of the cart and the armature of its joint."""
    together = {
        "M": {"target": "body/cart:mass"},
        "a": {"target": "joint/slide:armature", "guess": 0.1},
    }
    found = mjfim.worth(cart().replace(parameters=together), progress=False)
    assert found.parameters == ("m", "l", "c", "M", "a")
    assert np.isfinite(found.target).tolist() == [True] * 3 + [False] * 2
    assert np.isinf(found.std[3:]).all() and np.isfinite(found.ratio(found.std))
    assert found.worst(found.std) in ("m", "l", "c")
