"""A design on robots that differ from the model, against loops of plain MuJoCo."""

from __future__ import annotations

import json
import re
import time
import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.arrays import evenly_spread_indices
from mjfim.errors import ExperimentError, RecordingError, SimulationDivergedError
from mjfim.excitation.search.climb import Candidate
from mjfim.excitation.search.search import Search
from mjfim.files import write_json
from mjfim.output.folders import find_experiment_file
from mjfim.output.pages import page_of
from mjfim.output.plots.studies import fan_panels
from mjfim.output.words import format_number
from mjfim.parallel.budget import measured_by
from mjfim.records.base import Level
from mjfim.records.design import Design, keeps_limits
from mjfim.records.rehearsal import FiniteSteps
from tests.support.cli import run
from tests.support.limits import played
from tests.support.paths import MODELS

CART = """
<mujoco model="cart_pendulum">
  <option timestep="0.005"><flag contact="disable"/></option>
  <worldbody>
    <body name="cart">
      <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
      <joint name="slide" type="slide" axis="1 0 0" damping="0.5" stiffness="4"/>
      <body name="bob">
        <joint name="hinge" type="hinge" axis="0 -1 0" damping="0.1" frictionloss="{friction}"/>
        <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.8"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="force" joint="slide" ctrlrange="-10 10"/></actuator>
</mujoco>
"""

TABLES = """
model = "robot.xml"
rate = 50.0
playback_rate = 100.0
horizon = 2.0
initial.control = {{ kind = "chirp", amplitude = 5.0, frequency = 0.7, frequency_end = 3.0 }}
parameters.mass = {{ target = "body/bob:mass" }}
parameters.damping = {{ target = "joint/hinge:damping" }}
parameters.spring = {{ target = "joint/slide:stiffness", prior = 0.3, bounds = [3.9, 9.0] }}
noise.state = {noise}
limits.velocity = {{ slide = {speed}, hinge = 9.0 }}
limits.position = {{ slide = [-{reach}, {reach}] }}
limits.enforce = false
descent.max_iterations = 0
rehearsal.robots = 40
"""


# A design of no iteration is its initial control.
SETTINGS = {"threads": 1, "progress": False}


def stated(folder: Path, model: str, tables: str, **changes: Any) -> mjfim.Experiment:
    """The experiment of a model and its tables."""
    (folder / "robot.xml").write_text(model, encoding="utf-8")
    (folder / "robot.toml").write_text(tables, encoding="utf-8")
    return mjfim.Experiment.from_file(folder / "robot.toml").replace(**changes)


def cart(folder: Path, *, friction: float = 0.0, **numbers: float) -> tuple[Any, Design]:
    """The cart and its design."""
    chosen = {"noise": 0.004, "speed": 4.0, "reach": 3.0, **numbers}
    experiment = stated(folder, CART.format(friction=friction), TABLES.format(**chosen))
    return experiment, mjfim.design(experiment, **SETTINGS)


def rehearsed(experiment: Any, design: Design, **table: Any) -> Any:
    """The rehearsal of a design with other settings."""
    return mjfim.rehearse(experiment.replace(rehearsal=table), design)


def cart_of(theta: np.ndarray, friction: float = 0.0) -> Any:
    """The cart in plain MuJoCo."""
    model = mujoco.MjModel.from_xml_string(CART.format(friction=friction))
    model.body_mass[2], model.dof_damping[1], model.jnt_stiffness[0] = theta
    return model


def looped(theta: np.ndarray, ctrl: np.ndarray, friction: float = 0.0) -> np.ndarray:
    """(n+1, 4) states of the cart under a control that is held for four engine steps."""
    found = played(cart_of(theta, friction), np.zeros((2, 2)), ctrl, 4)
    return np.vstack([np.zeros(4), np.hstack([found["q"], found["v"]])])


Played = tuple[Any, Design, np.ndarray]


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Played:
    """The cart within wide limits, its design, and the states of its robots by plain loops."""
    experiment, design = cart(tmp_path_factory.mktemp("plain"))
    states = [looped(theta, design.trajectory.ctrl) for theta in design.rehearsal.theta]
    return experiment, design, np.array(states)


def test_robots_agree_with_a_plain_loop(plain: Played) -> None:
    """Margins, peaks, ends and heights of the model and of every robot."""
    _, design, states = plain
    found, peaks = design.rehearsal, np.abs(states).max(axis=1)
    shares = {
        ("position", "slide"): peaks[:, 0] / 3.0,
        ("velocity", "slide"): peaks[:, 2] / 4.0,
        ("velocity", "hinge"): peaks[:, 3] / 9.0,
        ("control", "force"): np.full(41, np.abs(design.trajectory.ctrl).max() / 10.0),
    }
    limits = [(limit.kind, limit.name) for limit in found.limits]
    assert set(limits) == set(shares)
    for value, wanted in (
        (found.speed, peaks[:, 2:]),
        (found.end_speed, np.abs(states[:, -1, 2:])),
        (found.travel, peaks[:, :2]),
        (found.acceleration, np.abs(np.diff(states[..., 2:], axis=1)).max(axis=1) / 0.005),
        (found.margins, 1.0 - np.stack([shares[limit] for limit in limits], axis=1)),
        # The end of the rod has a radius of 2 cm. Nothing states a floor.
        (found.end_height, -0.5 * np.cos(states[:, -1, 1]) - 0.02),
    ):
        assert_allclose(value, wanted, rtol=1e-9, atol=1e-9)
    assert not found.has_floor and not found.passes_floor.any()
    # The slide has a range, the hinge has none.
    assert found.unplaced == ("hinge",) and found.growth == design.final.growth


def test_a_check_rehearses_the_start_as_a_design_does(plain: Played) -> None:
    """A design of no iteration is its start; the gains are those of the design, too."""
    experiment, design, _ = plain
    for feedback in (False, True):
        table = {"feedback": feedback}
        found = mjfim.check(experiment.replace(rehearsal=table)).rehearsal
        again = rehearsed(experiment, design, **table)
        assert found.feedback is feedback
        for name in ("theta", "margins", "speed", "end_speed", "travel", "lowest", "nearest"):
            assert_allclose(getattr(found, name), getattr(again, name), rtol=1e-9, atol=1e-12)
        assert_allclose(found.steps.stated, again.steps.stated, rtol=1e-9)
        assert (found.growth, found.is_safe) == (again.growth, again.is_safe)


# Place of each quantity of the cart in its states.
PLACES = {
    ("position", "slide"): 0,
    ("position", "hinge"): 1,
    ("velocity", "slide"): 2,
    ("velocity", "hinge"): 3,
}


def test_fans_are_quantiles_of_plain_loops(plain: Played) -> None:
    """The band, the model, the robot that comes closest to a limit, and the kept motions."""
    _, design, states = plain
    fans, motions = design.rehearsal.fans, design.rehearsal.motions
    times = design.rehearsal.motion_times
    assert {(fan.limit.kind, fan.limit.name) for fan in fans} == set(PLACES)
    for fan in fans:
        rows = np.rint(fan.t / 0.005).astype(int)
        assert rows[0] == 1 and rows[-1] == states.shape[1] - 1
        paths = states[:, rows, PLACES[fan.limit.kind, fan.limit.name]]
        band = np.quantile(paths[1:], (0.05, 0.95), axis=0)
        worst = paths[1 + np.abs(paths[1:]).max(axis=1).argmax()]
        is_limited = np.isfinite(fan.limit.upper)
        for found, wanted in (
            (fan.model, paths[0]),
            (fan.before, band),
            (fan.worst, worst if is_limited else np.full(len(rows), np.nan)),
        ):
            assert_allclose(found, wanted, rtol=1e-6, atol=1e-6)
        assert fan.spread_before == pytest.approx(0.5 * np.ptp(band, axis=0).max(), rel=1e-5)
    rows = np.rint(times / 0.005).astype(int)
    robots, qpos = list(motions), np.array([*motions.values()])
    assert_allclose(qpos, states[robots][:, rows, :2], rtol=1e-6, atol=1e-7)
    assert len(robots) == 8 and min(robots) > 0


@pytest.mark.slow
def test_the_band_after_the_experiment_follows_from_plain_loops(
    plain: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To first order, from finite differences of the motion and the covariance of the design."""
    experiment, design, _ = plain
    monkeypatch.setattr("mjfim.excitation.rehearsal.MAX_AFTER", 400)
    found = rehearsed(experiment, design, robots=400)
    slopes = []
    for step in np.diag(1e-5 * design.theta):
        up, down = (looped(design.theta + s * step, design.trajectory.ctrl) for s in (1.0, -1.0))
        slopes.append((up - down) / (2.0 * step.sum()))
    covariance = np.linalg.inv(design.final.information)
    spread = np.sqrt(np.einsum("itk,ij,jtk->tk", slopes, covariance, slopes))
    for fan in found.fans:
        rows = np.rint(fan.t / 0.005).astype(int)
        std = spread[rows, PLACES[fan.limit.kind, fan.limit.name]]
        half = 0.5 * np.ptp(fan.after, axis=0)
        moved = std > 0.1 * std.max()
        assert_allclose(half[moved] / std[moved], 1.645, rtol=0.2)
        assert fan.spread_after < 0.5 * fan.spread_before


def test_curves_are_chosen_by_joint_with_the_same_numbers_everywhere(tmp_path: Path) -> None:
    """Of each joint the quantity that robots bring closest to its limit comes first."""
    found = cart(tmp_path, reach=0.6, speed=40.0)[1].rehearsal
    shown = [(fan.limit.kind, fan.limit.name) for fan in found.fans]
    assert {name for _, name in shown[:2]} == {"slide", "hinge"}
    assert shown.index(("position", "slide")) < shown.index(("velocity", "slide"))
    page, numbers = page_of(found), found.summary()["fans"]
    (table,) = [
        part for part in page.every_part if getattr(part, "columns", ())[:1] == ("quantity",)
    ]
    for fan, row, told, panel in zip(
        found.fans, table.rows, numbers, fan_panels(found), strict=True
    ):
        spreads = [0.5 * np.ptp(each, axis=0).max() for each in (fan.before, fan.after)]
        assert [told["spread_before"], told["spread_after"]] == pytest.approx(spreads)
        assert list(row.cells[1:]) == [f"{each:.3g}" for each in spreads]
        before, after = (format_number(each, 2) for each in spreads)
        assert panel.remark == f"spread ±{before}, after the experiment ±{after}"


WALLED = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <geom name="wall" type="box" size="0.05 0.2 0.05" pos="{wall} 0 -0.36"/>
    <body name="arm">
      <joint name="hinge" axis="0 -1 0" damping="0.2" range="-40 90" limited="true"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.8"/>
    </body>
  </worldbody>
  <actuator><motor name="torque" joint="hinge" ctrlrange="-5 5"/></actuator>
</mujoco>
"""

WALLED_TABLES = """
model = "robot.xml"
rate = 50.0
horizon = 2.0
initial.control = { kind = "chirp", amplitude = 3.0, frequency = 0.7, frequency_end = 2.0 }
parameters.mass = { target = "body/arm:mass" }
noise.state = 0.004
limits.enforce = false
descent.max_iterations = 0
rehearsal.robots = 5
"""


@pytest.mark.parametrize("wall", [0.36, 0.6])
def test_distances_contacts_and_stops_agree_with_a_plain_loop(wall: float, tmp_path: Path) -> None:
    """An arm that hits its stop, and a wall that is near, at 64 instants of every robot."""
    model = mujoco.MjModel.from_xml_string(WALLED.format(wall=wall))
    design = mjfim.design(stated(tmp_path, WALLED.format(wall=wall), WALLED_TABLES), **SETTINGS)
    found = design.rehearsal
    for i, theta in enumerate(found.theta[:, 0].tolist()):
        model.body_mass[1] = theta
        data = mujoco.MjData(model)
        motion = played(model, np.zeros((2, 1)), design.trajectory.ctrl, 4)
        states = [(0.0, 0.0), *zip(motion["q"], motion["v"], strict=True)]
        rows = evenly_spread_indices(len(states), 64)
        touches, stops, nearest = [], [], np.inf
        for row in rows.tolist():
            data.qpos[:], data.qvel[:] = states[row]
            mujoco.mj_forward(model, data)
            touches.append(any(contact.dist < 0.0 for contact in data.contact))
            stops.append(int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT) in data.efc_type)
            distance = mujoco.mj_geomDistance(model, data, 0, 1, 1.0, None)
            nearest = min(nearest, distance)
        # A contact amplifies differences of round-off, which may move it by an instant.
        assert found.in_contact[i] == pytest.approx(np.mean(touches), abs=1.01 / 64)
        assert found.at_stop[i] == pytest.approx(np.mean(stops), abs=1.01 / 64)
        # Depths of a penetration depend on the direction in which they are measured.
        assert max(found.nearest[i], 0.0) == pytest.approx(max(nearest, 0.0), abs=1e-4)
    is_near = wall < 0.5
    assert bool(found.in_contact.max() > 0.02) is is_near and found.at_stop.max() > 0.02
    assert bool(found.nearest.min() > 0.1) is not is_near


@pytest.mark.slow
def test_robots_are_drawn_as_stated(plain: Played) -> None:
    """From the prior, within the bounds, and within the share of the size."""
    experiment, design, _ = plain
    mass, damping, spring = rehearsed(experiment, design, robots=300, wrong=0.3).theta[1:].T
    for share in (mass / 0.8 - 1.0, damping / 0.1 - 1.0):
        assert -0.3 <= share.min() < -0.27 and 0.27 < share.max() <= 0.3
    assert spring.min() == 3.9
    # A normal distribution that is cut off a third of its standard deviation below its mean.
    assert np.isclose((spring == 3.9).mean(), 0.369, atol=0.08)
    assert np.isclose(np.sqrt(((spring[spring > 4.0] - 4.0) ** 2).mean()), 0.3, rtol=0.15)


@pytest.mark.slow
def test_a_limit_that_the_model_keeps_by_a_hair_is_broken_by_half_of_the_robots(
    plain: Played, tmp_path: Path
) -> None:
    """The verdict counts them, and its cure is a reserve."""
    exact = plain[1].rehearsal.speed[0, 0] * (1.0 + 1e-6)
    experiment, design = cart(tmp_path, speed=exact)
    page = page_of(design, experiment="robot.toml", design=tmp_path)
    assert "leave the limit on velocity of slide" in page.verdict.sentence
    assert page.verdict.level is Level.BAD and not design.rehearsal.is_safe
    wide = rehearsed(experiment, design, robots=120, seed=1)
    states = [looped(theta, design.trajectory.ctrl) for theta in wide.theta[1:]]
    broken = sum(bool((np.abs(each[1:, 2]) > exact).any()) for each in states)
    assert broken > 20 and 120 - broken == wide.all_kept
    cure = next(step for step in page.next_steps if "velocity" in step)
    assert "`[limits] reserve = { velocity = 0." in cure
    assert "DESIGN_FOLDER" not in " ".join(page.next_steps)


# A short descent within limits on a velocity that are smaller than the model would choose.
ENFORCED = {"descent": {"max_iterations": 8}, "rehearsal": {"robots": 30}}


def cart_with(folder: Path, reserve: Any) -> Any:
    """The cart, whose speed has a limit."""
    experiment, _ = cart(folder, reach=1.0, speed=0.21)
    return experiment.replace(limits={"enforce": True, "reserve": reserve}, **ENFORCED)


@pytest.mark.slow
def test_an_automatic_reserve_keeps_robots_inside(tmp_path: Path) -> None:
    """The design without it leaves the limit of its speed; with it, plain robots do not."""
    bare, found = (
        mjfim.design(cart_with(tmp_path, reserve), **SETTINGS) for reserve in ({}, "auto")
    )
    assert not bare.rehearsal.is_safe and bare.reserve == {}
    assert found.rehearsal.is_safe and 0.0 < found.reserve["velocity"] < 0.6
    assert found.found_by == bare.found_by and found.steps > bare.steps

    states = [looped(theta, found.trajectory.ctrl) for theta in found.rehearsal.theta]
    speeds = np.array([np.abs(each[:, 2]).max() for each in states])
    assert (speeds <= 0.21).all() and speeds[0] <= 0.21 * (1.0 - found.reserve["velocity"]) + 1e-9
    # The same reserve, stated, gives a design that keeps it as well.
    again = mjfim.design(cart_with(tmp_path, found.reserve), **SETTINGS)
    assert again.rehearsal.margins[0].min() > 0.0
    assert again.reserve == found.reserve


def arm_with(folder: Path, reserve: dict[str, float]) -> Any:
    """The arm without its wall, whose speed has a limit."""
    limits = {"enforce": True, "reserve": reserve, "velocity": {"hinge": 1.0}}
    return stated(folder, WALLED.format(wall=9.0), WALLED_TABLES, limits=limits, **ENFORCED)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("make", "reserve"),
    [
        (cart_with, {}),
        (arm_with, {"velocity": 0.02}),
    ],
)
def test_the_first_cure_keeps_other_robots_safe(make: Any, reserve: Any, tmp_path: Path) -> None:
    """120 robots of another seed are played after what the advice says is really done."""
    experiment = make(tmp_path, reserve)
    design = mjfim.design(experiment, **SETTINGS)
    assert not design.rehearsal.is_safe and design.rehearsal.kept_reserve == reserve
    cure = page_of(design, experiment="arm.toml", design=tmp_path).next_steps[0]
    robots = {"robots": 120, "seed": 5}
    if found := re.search(r"reserve = (\{.*\})", cure):
        advised = tomllib.loads(f"it = {found[1]}")["it"]
        assert all(advised[kind] > share for kind, share in reserve.items())
        experiment = experiment.replace(limits={"reserve": advised})
        design = mjfim.design(experiment, **SETTINGS)
    else:
        assert "--feedback" in cure
        robots["feedback"] = True
    tried = rehearsed(experiment, design, **robots)
    assert tried.robots == 120 and tried.is_safe, (cure, tried.all_kept)


@pytest.mark.slow
def test_a_reserve_leaves_room_for_the_initial_state(tmp_path: Path) -> None:
    """A start at a tenth of half of the range from its stop keeps a twentieth."""
    experiment, _ = cart(tmp_path, reach=1.0)
    limits = {"enforce": True, "reserve": {"position": 0.3}}
    found = mjfim.design(
        experiment.replace(initial={"qpos": [0.9, 0.0]}, limits=limits, **ENFORCED), **SETTINGS
    )
    assert keeps_limits(found)
    assert found.rehearsal.margins[0].min() >= 0.05 - 1e-9


FALLING = """
<mujoco>
  <worldbody>
    {floor}
    <body name="drone" pos="0 0 1">
      <freejoint name="base"/>
      <geom name="hull" type="box" size="0.1 0.1 0.05" mass="1" contype="0" conaffinity="0"/>
      <site name="rotor"/>
    </body>
  </worldbody>
  <actuator><motor name="thrust" site="rotor" gear="0 0 1 0 0 0" ctrlrange="0 20"/></actuator>
</mujoco>
"""


@pytest.mark.slow
@pytest.mark.parametrize("floor", ["", '<geom type="plane" size="1 1 1" pos="0 0 0.2"/>'])
@pytest.mark.parametrize(("thrust", "is_safe"), [(9.0, False), (9.81, True)])
def test_what_falls_below_the_floor_is_not_played(
    floor: str, thrust: float, is_safe: bool, tmp_path: Path
) -> None:
    """With a floor in the model, and without one, where the ground is at zero."""
    (tmp_path / "drone.xml").write_text(FALLING.format(floor=floor), encoding="utf-8")
    still = {"kind": "sine", "amplitude": 1e-6, "frequency": 0.5, "offset": thrust}
    experiment = mjfim.Experiment(
        model="drone.xml",
        directory=tmp_path,
        rate=50.0,
        horizon=2.0,
        initial={"control": still},
        parameters={"mass": "body/drone:mass"},
        noise={"qpos:base.z": 0.01},
        descent={"max_iterations": 0},
        rehearsal={"robots": 4, "wrong": 0.001},
    )
    design = mjfim.design(experiment, **SETTINGS)
    found = design.rehearsal
    assert found.has_floor is bool(floor)
    level = 0.2 if floor else 0.0
    assert found.floor == pytest.approx(level, abs=1e-12)
    fallen = 0.5 * (9.81 - thrust) * 2.0**2
    assert found.lowest[0] == pytest.approx(0.95 - fallen - level, abs=0.02)
    assert found.is_safe is is_safe
    assert ("pass through" in page_of(design).verdict.sentence) is not is_safe
    assert rehearsed(experiment, design, floor="none").is_safe

    # A check says the same of the start, unless a limit turns designs away from the floor.
    checked = mjfim.check(experiment, progress=False)
    page = page_of(checked, experiment="drone.toml")
    assert (page.verdict.level is Level.BAD) is not is_safe and checked.is_dangerous is not is_safe
    assert not checked.verdict.ok or is_safe
    assert ("4 pass through" in page.verdict.sentence) is not is_safe
    assert ("floor" in page.next_steps[0]) is not is_safe
    if not is_safe:
        box = {"position": {"base": [[-1.0, 1.0], [-1.0, 1.0], [0.5, 2.0]]}}
        checked = mjfim.check(experiment.replace(limits=box), progress=False)
        assert not checked.is_dangerous and checked.violations
        warning = page_of(checked).warnings[0]
        assert warning.startswith("Do not play the initial control. Of 4 robots")


@pytest.mark.slow
@pytest.mark.parametrize("room", [1e-4, 2.0])
def test_an_end_that_no_control_can_brake_is_not_played(
    room: float, plain: Played, tmp_path: Path
) -> None:
    """Held at its strongest brake after the end, the cart of plain MuJoCo leaves the limit."""
    states = plain[2]
    reach = np.abs(states[..., 0]).max() + room
    found = cart(tmp_path, reach=reach)[1].rehearsal
    assert found.all_kept == 40
    left = 0
    for theta, each in zip(found.theta[1:], states[1:], strict=True):
        model = cart_of(theta)
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = np.split(each[-1], 2)
        direction = np.sign(data.qvel[0])
        data.ctrl[:] = -10.0 * direction
        while data.qvel[0] * direction > 0.0:
            mujoco.mj_step(model, data)
        left += bool(abs(data.qpos[0]) > reach)
    assert found.unbraked.get("slide", 0) == left
    assert found.is_safe is (left < 2)


@pytest.mark.slow
def test_feedback_keeps_robots_near_the_plan(tmp_path: Path) -> None:
    """With little noise the robots follow the plan, late as stated."""
    experiment, design = cart(tmp_path, noise=1e-6)
    spread = [
        np.ptp(rehearsed(experiment, design, **table).end_speed[:, 1])
        for table in ({}, {"feedback": True, "latency": 0.0})
    ]
    assert spread[1] < 0.7 * spread[0]
    # The noise of what the controller reads acts under feedback only.
    for feedback in (False, True):
        ends = [
            rehearsed(
                experiment.replace(noise={"state": noise}), design, feedback=feedback, robots=2
            ).end_speed
            for noise in (1e-6, 0.01)
        ]
        assert np.array_equal(*ends) is not feedback
    late = rehearsed(experiment, design, feedback=True, latency=0.007, robots=2)
    assert late.latency == pytest.approx(0.01, abs=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize(("friction", "noise"), [(0.0, 0.004), (0.0, 0.4), (0.3, 0.05)])
def test_finite_steps_agree_with_plain_loops(friction: float, noise: float, tmp_path: Path) -> None:
    """Along the principal axes of the covariance; for little noise the derivatives hold."""
    _, design = cart(tmp_path, friction=friction, noise=noise)
    steps, information = design.rehearsal.steps, design.final.information
    prior = np.diag([0.0, 0.0, 0.3**-2])
    size = np.sqrt(np.diag(information))
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    weight = np.full(3, np.nan)
    for d, axis in enumerate((vectors / size[:, None]).T):
        length, of_data = steps.length[d], axis @ (information - prior) @ axis
        step = length * axis / np.sqrt(values[d])
        if (design.theta > np.abs(step)).all() and length >= 2.0:
            up, down = (
                looped(design.theta + sign * step, design.trajectory.ctrl, friction)
                for sign in (1.0, -1.0)
            )
            expected = 2.0 * length * np.sqrt(of_data / values[d])
            ratio = np.linalg.norm((up - down)[4::4] / noise) / expected
            assert steps.ratio[d] == pytest.approx(ratio, rel=3e-3)
            weight[d] = axis @ prior @ axis + ratio**2 * of_data
    if np.isfinite(weight).all():
        std = np.sqrt(((vectors / size[:, None]) ** 2 / weight).sum(axis=1))
        assert_allclose(steps.std, std, rtol=1e-2)
    if noise == 0.004:
        assert_allclose(steps.ratio, 1.0, atol=0.02)
        assert str(steps) == "" and (steps.stated == steps.predicted).all()


@pytest.mark.parametrize("causes", [(), ("dry friction of hinge",)])
@pytest.mark.parametrize(
    ("change", "is_confirmed"),
    [(1 / 1.401, False), (1 / 1.399, True), (1 / 0.701, True), (1 / 0.699, False)],
)
def test_ratios_from_0_7_to_1_4_confirm_a_standard_deviation(
    change: float, is_confirmed: bool, causes: Any
) -> None:
    """A finite step whose effect is `ratio` times the predicted one has σ / ratio. It is stated
    with its cause where it differs; a confirmed one stays.
    """
    found = np.array([1.1, change])
    steps = FiniteSteps(
        names=("mass", "friction"),
        predicted=np.array([0.1, 0.05]),
        std=np.array([0.1, 0.05]) * found,
        length=np.full(2, 2.0),
        ratio=1.0 / found,
        causes=causes,
    )
    assert steps.confirmed.tolist() == [True, is_confirmed]
    assert_allclose(steps.stated, [0.1, 0.05 * (1.0 if is_confirmed else change)])
    # Where neither contacts nor friction act, the outputs are curved.
    why = "of hinge makes it approximate" if causes else "in a strongly curved way"
    for words in (why, f"friction {0.05 * change:.2g} in place of 0.05"):
        assert (words in str(steps)) is not is_confirmed


@pytest.mark.slow
def test_the_verb_plays_a_folder(tmp_path: Path) -> None:
    """It finds the experiment by itself, and agrees with the rehearsal of the design."""
    cart(tmp_path)
    made, out, file = tmp_path / "made", tmp_path / "out", tmp_path / "robot.toml"
    assert "keep all limits" in run("design", file, "-o", made).stdout
    done = run("rehearse", made, "-o", out, "--robots", "7", "--seed", "3")
    assert done.exit_code == 0 and "7 of 7 robots" in done.stdout
    checked = run("check", file, "--design", made)
    for each in (done, checked):
        assert f"mjfim export {made} --to player" in " ".join(each.stdout.split())
    alone = run("rehearse", made, "--robots", "2").stdout
    assert ".." not in alone and "-o FOLDER" not in alone
    told = json.loads((out / "rehearsal.json").read_text(encoding="utf-8"))
    assert told["safe"] and told["robots"] == 7 and len(told["limits"]) == 4
    assert (out / "rehearsal.png").stat().st_size > 10_000


def test_the_experiment_of_a_design_is_named_as_a_person_would(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the current folder where the file is in it, else from the root; never with `..`."""
    (tmp_path / "made").mkdir()
    write_json(tmp_path / "made" / "design.json", {"experiment": "../cart.toml"})
    monkeypatch.chdir(tmp_path)
    assert find_experiment_file(Path("made/design.npz")) == Path("cart.toml")
    monkeypatch.chdir(tmp_path / "made")
    assert find_experiment_file(Path("design.npz")) == tmp_path.resolve() / "cart.toml"


def test_a_search_whose_motions_diverge_says_what_when_and_what_helps(
    plain: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The start leaves a limit, and all that the search finds is too large for MuJoCo."""
    experiment, design, _ = plain
    experiment = experiment.replace(limits={"enforce": True, "position": {"slide": [-0.01, 0.01]}})
    wild = Candidate(name="chirp", control=np.full(design.trajectory.ctrl.shape, 1e11))

    def found(*_: Any) -> Any:
        """A search without iterates."""
        yield from ()
        return [wild]

    monkeypatch.setattr(Search, "run", found)
    with pytest.raises(SimulationDivergedError) as caught:
        mjfim.design(experiment, **SETTINGS)
    for words in (
        "robot.toml: no initial control leads to a motion within the limits",
        "from the best one, chirp",
        "control of actuator force is 1e+11",
        "a larger gear of the actuator needs smaller controls",
    ):
        assert words in str(caught.value)


def test_misuse_is_one_sentence(plain: Played) -> None:
    experiment, design, _ = plain
    with pytest.raises(RecordingError, match="the design: sampled at"):
        mjfim.rehearse(experiment.replace(rate=100.0), design)
    tables = {**experiment.model_dump(exclude_unset=True), "noise": {"x": 1.0}}
    with pytest.raises(ExperimentError):
        rehearsed(experiment.restated(tables), design, feedback=True)


def test_a_model_alone_is_enough(plain: Played) -> None:
    experiment, design, _ = plain
    alone = rehearsed(experiment, design, robots=0)
    assert alone.robots == 0 and alone.is_safe
    assert not replace(alone, margins=-alone.margins).is_safe


@pytest.mark.slow
@pytest.mark.parametrize("file", ["cart_pendulum_limits.toml", "quadrotor.toml"])
def test_shipped_designs_are_safe_because_of_what_their_files_state(file: str) -> None:
    """Without the reserve, the box and the end at rest nobody would play them."""
    experiment = mjfim.Experiment.from_file(MODELS / file).replace(
        descent={"starts": 1, "seconds": 2.0}, rehearsal={"robots": 30}
    )
    with measured_by(time.process_time):
        design = mjfim.design(experiment, progress=False)
    assert design.rehearsal.is_safe and keeps_limits(design)
    tables = experiment.model_dump(exclude_unset=True)
    del tables["boundary"]
    tables["limits"].pop("reserve")
    tables["limits"].pop("tilt", None)
    if file == "quadrotor.toml":
        del tables["limits"]
    with measured_by(time.process_time):
        bare = mjfim.design(experiment.restated(tables), progress=False)
    assert not bare.rehearsal.is_safe
    assert page_of(bare).verdict.level is Level.BAD


BOX_ON_GROUND = """<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <geom type="plane" size="0 0 1"/>
    <body name="box" pos="0 0 0.1">
      <joint name="x" type="slide" axis="1 0 0"/>
      <joint name="z" type="slide" axis="0 0 1"/>
      <joint name="tilt" axis="0 1 0"/>
      <geom type="box" size="0.2 0.1 0.1" mass="5"/>
      <body name="arm" pos="0 0 0.15">
        <joint name="swing" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" fromto="0 0 0 0 0 0.2" size="0.02" mass="0.3"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="swing" ctrlrange="-2 2"/></actuator>
</mujoco>"""


def test_a_robot_on_the_ground_begins_where_it_stands(tmp_path: Path) -> None:
    """It rests at every place of the ground, so that its equilibrium is the nearest one."""
    path = tmp_path / "box.xml"
    path.write_text(BOX_ON_GROUND, encoding="utf-8")
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos[3] = np.pi
    mujoco.mj_step(model, data, 4000)
    experiment = mjfim.Experiment(
        model=str(path),
        rate=50.0,
        horizon=1.0,
        noise={"state": 0.01},
        parameters={
            "mass": "body/box:mass",
            "damping": "joint/swing:damping",
        },
        initial={
            "qpos": data.qpos.tolist(),
            "control": {"kind": "sine", "amplitude": 0.05, "frequency": 1.0},
        },
        limits={"position": {"x": [-0.05, 0.05]}},
        boundary={"start": "rest"},
        rehearsal={"robots": 20},
    )
    found = mjfim.check(experiment).rehearsal
    assert found.all_kept == 20
    assert found.travel[:, 0].max() < 1e-3
