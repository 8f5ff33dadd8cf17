"""Two robots that a motion does not tell apart, compared with plain simulations of MuJoCo."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

import mjfim
from mjfim.arrays import NORMAL_95, Array
from mjfim.experiment.system import System
from mjfim.output.film import film_of
from mjfim.output.page import Table
from mjfim.output.pages import page_of
from mjfim.output.plots.pictures import pictures_of
from mjfim.records.rehearsal import Separation, Valley
from mjfim.records.trajectory import Trajectory
from tests.support.numerics import Loop, make_task
from tests.support.paths import MODELS

# The measurements of the paper are so accurate that the initial motion determines every parameter.
SIGMA = 0.2

# Only the ratio of the gear and the mass accelerates it.
PUSHED_CART = """
<mujoco>
  <option timestep="0.01"/>
  <worldbody>
    <body name="cart"><joint name="slide" type="slide"/><geom size=".1" mass="2"/></body>
  </worldbody>
  <actuator><motor name="push" joint="slide" gear="3"/></actuator>
</mujoco>
"""


def noisy_cart_pendulum() -> mjfim.Experiment:
    """The cart-pendulum with measurements that hardly show its friction."""
    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum_guess.toml")
    return experiment.replace(
        noise={"state": SIGMA}, descent={"max_iterations": 3, "starts": 1}, rehearsal={"robots": 4}
    )


def outputs(theta: Array, ctrl: Array) -> Array:
    """(N+1, 4) positions and velocities of the cart-pendulum in a plain loop of MuJoCo."""
    model = mujoco.MjModel.from_xml_path(str(MODELS / "cart_pendulum.xml"))
    bob, hinge = model.body("bob").id, model.joint("hinge").dofadr[0]
    model.body_mass[bob], model.body_pos[bob, 2], model.dof_damping[hinge] = theta
    loop, rows = Loop(model, 1), [np.append(model.key_qpos[0], model.key_qvel[0])]
    for u in ctrl:
        rows.append(loop.F(rows[-1], u))
    return np.array(rows)


def distance(pair: Array, ctrl: Array) -> Array:
    """(N+1,) distance of two cart-pendulums by the measurements up to each time [σ of noise]."""
    difference = (outputs(pair[0], ctrl) - outputs(pair[1], ctrl)) / SIGMA
    return np.sqrt(np.cumsum((difference**2).sum(axis=1)))


@pytest.fixture(scope="module")
def design() -> mjfim.Design:
    """A design that tells the two robots apart."""
    return mjfim.design(noisy_cart_pendulum())


@pytest.fixture(scope="module")
def valley(design: mjfim.Design) -> Valley:
    """Its robots."""
    return design.valley


def motions(design: mjfim.Design) -> list[tuple[Separation, Trajectory]]:
    """Both motions, and what they tell of the robots."""
    plans = design.initial.trajectory, design.final.trajectory
    return list(zip((design.valley.motion, design.valley.designed), plans, strict=True))


def test_the_distance_is_that_of_a_plain_simulation(design: mjfim.Design, valley: Valley) -> None:
    for along, plan in motions(design):
        assert np.allclose(along.distance, distance(valley.theta, plan.ctrl), rtol=1e-6, atol=1e-9)
        y = np.array([outputs(theta, plan.ctrl) for theta in valley.theta])[:, :, 3]
        assert valley.output == "qvel:hinge [rad/s]"
        assert np.allclose(along.y, y, atol=1e-9)
        assert along.largest == pytest.approx(np.abs(y[0] - y[1]).max())
        assert along.t[np.argmax(np.abs(y[0] - y[1]))] == along.at


def test_the_initial_motion_tells_nothing_and_the_designed_one_tells_them_apart(
    design: mjfim.Design, valley: Valley
) -> None:
    (before, plan), (after, _) = motions(design)
    assert before.total <= NORMAL_95 < after.total
    assert np.isinf(before.seen_after)
    assert distance(valley.theta, plan.ctrl)[-1] <= NORMAL_95
    # A step that is 2 % longer would be seen.
    longer = valley.nominal + 1.02 * (valley.theta - valley.nominal)
    assert distance(longer, plan.ctrl)[-1] > NORMAL_95
    k = int(np.searchsorted(after.t, after.seen_after))
    assert after.distance[k] > NORMAL_95 >= after.distance[k - 1]


def test_other_parameters_hide_the_one_that_is_known_worst(
    design: mjfim.Design, valley: Valley
) -> None:
    """A change of any other direction with the same change of the friction is seen better."""
    ctrl = design.initial.trajectory.ctrl
    gap = np.diff(valley.theta, axis=0)[0]
    rng = np.random.default_rng(0)
    others = [[0.0, 0.0], *(1.0 + 0.2 * rng.standard_normal((20, 2)))]
    totals = [
        distance(valley.nominal + np.outer((-0.5, 0.5), gap * [*other, 1.0]), ctrl)[-1]
        for other in others
    ]
    assert min(totals) > 0.999 * valley.motion.total
    # Without the help of the others, it would be seen.
    assert totals[0] > NORMAL_95 > valley.motion.total


def test_robots_with_an_equal_ratio_move_exactly_alike(tmp_path: Path) -> None:
    experiment = make_task(
        PUSHED_CART,
        tmp_path,
        horizon=1.0,
        parameters={
            "mass": {"target": "body/cart:mass"},
            "gear": {"target": "actuator/push:gear[0]"},
        },
        noise={"state": 0.01},
    ).experiment
    found = mjfim.check(experiment).valley
    assert found.designed is None
    assert found.motion.total < 1e-6
    ratio = found.theta[:, 1] / found.theta[:, 0]
    assert ratio == pytest.approx(1.5, rel=1e-9)
    # Nothing but the largest change of a parameter ends the search.
    assert np.allclose(np.sort(found.percent, axis=0), [[-50.0, -50.0], [50.0, 50.0]])


def test_a_bound_holds_one_robot_back() -> None:
    stated = noisy_cart_pendulum().replace(parameters={"c": {"bounds": [1.3, 10.0], "true": 1.4}})
    low, high = np.sort(mjfim.check(stated).valley.theta[:, 2])
    assert low >= 1.3 and high - 1.4 > 1.4 - low


def test_nothing_is_shown_where_everything_is_determined() -> None:
    found = mjfim.check(mjfim.Experiment.from_file(MODELS / "cart_pendulum_guess.toml"))
    assert found.valley is None and found.summary()["valley"] is None
    assert "valley" not in found.pictures
    assert "Two robots" not in page_of(found).sections


def test_a_film_shows_both_robots_as_ghosts_whose_differences_are_magnified(
    design: mjfim.Design, valley: Valley
) -> None:
    film = film_of(System.resolve(noisy_cart_pendulum(), threads=1), design)
    factor = float(film.note.rpartition(" ")[2].rstrip("."))
    assert film.caption.startswith("The initial motion beside the designed motion, in real time.")
    assert film.note.startswith("Pale: two robots alike in the initial motion")
    for tracks, (_, plan) in zip(film.tracks, motions(design), strict=True):
        (_, model), *ghosts = tracks
        assert len(ghosts) == 2
        # Every frame of a film of 25 Hz is a sample of a motion of 100 Hz.
        for (_, ghost), theta in zip(ghosts, valley.theta, strict=True):
            own = outputs(theta, plan.ctrl)[::4, :2]
            assert np.allclose(ghost, model + factor * (own - model), atol=1e-9)


def test_sentence_table_picture_and_json_agree(design: mjfim.Design, tmp_path: Path) -> None:
    design.save(tmp_path)
    stored = json.loads((tmp_path / "design.json").read_text(encoding="utf-8"))["valley"]
    sentence = str(mjfim.Design.load(tmp_path).valley)
    motion, designed = stored["motion"], stored["designed"]
    for number in (
        f"are apart by {motion['distance']:.3g} σ of the noise",
        f"are apart by {designed['distance']:.3g} σ, most in qvel:hinge",
        f"({designed['largest_difference']:.2g} rad/s at {designed['time']:.3g} s)",
    ):
        assert number in sentence

    picture = pictures_of(design)["valley"]()
    assert sentence.startswith(picture.title)
    (table,) = (part for part in page_of(design).sections["Two robots"] if isinstance(part, Table))
    columns = [stored["parameters"].index(row.cells[0].partition(" (")[0]) for row in table.rows]
    shown = np.array([[float(cell) for cell in row.cells[1:3]] for row in table.rows]).T
    assert np.allclose(shown, np.array(stored["theta"])[:, columns], rtol=1e-3)
    drawn = [mark.x for mark in picture.panels[-1].marks if mark.kind == "dots"]
    assert np.allclose(drawn, np.array(stored["percent"])[:, columns])
