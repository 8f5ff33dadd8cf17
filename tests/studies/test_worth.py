"""`mjfim.worth`: sensors left out, halved and added, against `check` of such an experiment, and the
prices of limits against designs with wider limits.
"""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.errors import ExperimentError
from mjfim.excitation.task import DesignTask
from mjfim.records.worth import PRICED_SHARE
from tests.support.numerics import Array, sensitivity_of
from tests.support.paths import MODELS

NOISE = {"qpos:slide": 0.05, "qpos:hinge": 0.04, "qvel:slide": 0.03, "qvel:hinge": 0.05}


CART = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml")


def cart(**tables: Any) -> mjfim.Experiment:
    """The cart-pendulum for 1 s, whose four sensors have noise of their own."""
    values = CART.model_dump(exclude_unset=True)
    return CART.restated({**values, "horizon": 1.0, "noise": NOISE, **tables})


def without(noise: dict[str, Any], name: str) -> dict[str, Any]:
    """The noise of the other sensors."""
    return {key: value for key, value in noise.items() if key != name}


def sensors(experiment: mjfim.Experiment, **options: Any) -> dict[str, Any]:
    """What each sensor tells, by its name."""
    found = mjfim.worth(experiment, progress=False, **options)
    return {each.name: each for each in found.sensors}


def assert_tells(std: Array, experiment: mjfim.Experiment) -> None:
    """σ of the wanted parameters are those of a check, infinite where they are not identifiable."""
    rows = mjfim.check(experiment, progress=False).rows
    assert_allclose(std[:3], [row.std for row in rows[:3]], rtol=1e-6)


def test_each_sensor_alone_left_out_and_halved_is_a_changed_file() -> None:
    found = sensors(cart())
    assert_tells(found["qpos:slide"].present, cart())
    for name, sigma in NOISE.items():
        assert_tells(found[name].without, cart(noise=without(NOISE, name)))
        assert_tells(found[name].alone, cart(noise={name: sigma}))
        assert_tells(found[name].halved, cart(noise={**NOISE, name: sigma / 2.0}))
    velocities = {key: NOISE[key] for key in ("qvel:slide", "qvel:hinge")}
    assert_tells(found["all velocities"].alone, cart(noise=velocities))


def test_correlated_outputs_are_one_sensor() -> None:
    joined = {
        "outputs": ["qpos:slide", "qvel:hinge"],
        "covariance": [[0.0025, 0.001], [0.001, 0.0025]],
    }
    others = {"qpos:hinge": 0.04, "qvel:slide": 0.03}
    found = sensors(cart(noise=others, correlated=[joined]))
    assert_tells(found["qpos:slide + qvel:hinge"].without, cart(noise=others))


def test_a_sensor_whose_bias_is_unknown_and_one_that_measures_seldom_may_be_left_out() -> None:
    slow = {**NOISE, "qvel:hinge": {"sigma": 0.05, "rate": 20.0}}
    unsure = {"nuisance": {"bias": {"qpos:slide": True}}}
    found = sensors(cart(noise=slow, **unsure))
    assert_tells(found["qpos:slide"].without, cart(noise=without(slow, "qpos:slide")))
    rest = cart(noise=without(slow, "qvel:hinge"), **unsure)
    assert_tells(found["qvel:hinge"].without, rest)


def test_added_sensors_are_those_of_a_model_that_has_them(tmp_path: Path) -> None:
    text = (MODELS / "cart_pendulum.xml").read_text(encoding="utf-8")
    body = text.index(">", text.index('<body name="bob"')) + 1
    sensor = '<sensor><gyro name="g" site="s"/><force name="f" site="s"/></sensor></mujoco>'
    text = text[:body] + '<site name="s"/>' + text[body:].replace("</mujoco>", sensor)
    (tmp_path / "with.xml").write_text(text, encoding="utf-8")

    add = {"gyro:bob": 0.01, "force:bob": 0.2, "torque": 0.1}
    found = sensors(cart(), add=add)
    for name, key, sigma in (("gyro of bob", "g", 0.01), ("force of bob", "f", 0.2)):
        with_it = cart(model=str(tmp_path / "with.xml"), noise={**NOISE, key: sigma})
        assert_tells(found[name].present, with_it)
        assert found[name].is_added
    assert_tells(found["gyro of bob"].without, cart())

    # The motor's force is its control, which tells nothing.
    assert_tells(found["torque of slide"].present, cart())
    assert np.isinf(found["torque of slide"].alone).all()


def test_a_joint_acceleration_is_the_difference_of_two_velocities() -> None:
    found = sensors(cart(), add={"acceleration:hinge": 0.1})["acceleration of hinge"]
    task, slopes = DesignTask.resolve(cart()), []
    for step in 1e-4 * np.eye(3):
        ends = [task.plant.simulate(task.theta + s * step, task.control).qvel for s in (1, -1)]
        slopes.append((ends[0] - ends[1])[:, 1] / 2e-4)
    rows = np.diff(slopes, axis=1) / (task.dt * 0.1)
    expected = np.sqrt(np.diag(np.linalg.inv(rows @ rows.T)))
    assert_allclose(found.alone, expected, rtol=1e-4)


def test_the_smallest_set_is_that_of_all_sets() -> None:
    wanted = {"m": 0.2, "l": 0.12, "c": 0.5}
    stated = {name: {"wanted": value} for name, value in wanted.items()}
    experiment = cart().replace(parameters=stated)
    rows = (
        sensitivity_of(DesignTask.resolve(experiment)).G[1:] / np.array([*NOISE.values()])[:, None]
    )
    matrices = dict(zip(NOISE, np.einsum("kyi,kyj->yij", rows, rows), strict=True))

    def is_enough(names: tuple[str, ...]) -> bool:
        told = np.sum([matrices[name] for name in names], axis=0)
        return bool((np.sqrt(np.diag(np.linalg.inv(told))) <= [*wanted.values()]).all())

    by_size = (itertools.combinations(NOISE, count) for count in range(1, 4))
    enough = next(filter(None, ([*filter(is_enough, sets)] for sets in by_size)))
    assert mjfim.worth(experiment, progress=False).fewest in enough


def test_an_unknown_sensor_or_place_is_named() -> None:
    for key, fault in (("lidar", "gyro, moment"), ("gyro:hand", "bob"), ("torque:x", "slide")):
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
    prices = mjfim.worth(experiment, design, progress=False).prices
    of_design = [price.predicted for price in design.worth.prices]
    assert [price.predicted for price in prices] == of_design
    assert all(np.isnan(price.redesigned) for price in prices)


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
