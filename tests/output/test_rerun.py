"""Rerun files are read back and compared with the records and with MuJoCo."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

pytest.importorskip("rerun")

from mjfim.arrays import Array
from mjfim.errors import MjfimError, RecordingError
from mjfim.experiment.system import labels_of_model
from mjfim.output.plots.design import accuracy_over_time
from mjfim.output.rerun import log_design, log_estimate, log_trajectories, show
from mjfim.output.rerun.camera import (
    FIELD_OF_VIEW,
    camera_axes,
    moving_points,
    place_camera,
    seen_points,
)
from mjfim.output.rerun.scene import INFINITE_REACH, OUTLINE, SOLID, body_poses, entity_path
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate, Prediction, PredictionErrors
from tests.support import results
from tests.support.made_motions import designed, estimated, load, simulated
from tests.support.rrd import Recorded


def logged(
    folder: Path, model: mujoco.MjModel, design: Design, *beside: tuple[Any, str]
) -> Recorded:
    """The recording of a design, whose views all show something."""
    path = folder / "design.rrd"
    log_design(path, model, design, labels_of_model(model), *beside)
    return checked(path)


def checked(path: Path) -> Recorded:
    """A recording without warnings and empty views."""
    made = Recorded(path)
    found = [f"{name}/" for name in made.entities]
    for (at,) in made.blueprint("ViewBlueprint:space_origin").values():
        assert any(name.startswith(f"{at}/") for name in found), at
    return made


def opened_rows(made: Recorded) -> list[list[str]]:
    """Origins of the views in each row of the tab that is opened on the right."""
    parts = made.blueprint("ContainerBlueprint:contents")
    origins = made.blueprint("ViewBlueprint:space_origin")
    names = made.blueprint("ContainerBlueprint:display_name")
    opened = made.blueprint("ContainerBlueprint:active_tab")
    every = {tab: parts[name] for name, (tab,) in opened.items()}
    (tab,) = [tab for tab in every if names.get(f"/{tab}") == ["answers"]]
    assert every[tab][0] == tab
    return [[origins[f"/{view}"][0] for view in parts[f"/{row}"]] for row in parts[f"/{tab}"]]


def plain_poses(model: mujoco.MjModel, qpos: Array) -> tuple[Array, Array, Array]:
    """Positions and orientations of the bodies, and positions of the geoms, by plain MuJoCo."""
    data, rows = mujoco.MjData(model), []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        rows.append((data.xpos.copy(), data.xquat.copy(), data.geom_xpos.copy()))
    xpos, xquat, geom_xpos = (np.array(each) for each in zip(*rows, strict=True))
    return xpos, xquat, geom_xpos


@pytest.fixture(scope="module")
def cart() -> mujoco.MjModel:
    """The cart-pendulum."""
    return load("cart")


@pytest.fixture(scope="module")
def design(cart: mujoco.MjModel) -> Design:
    """A hand-made design."""
    return designed(cart)


@pytest.fixture(scope="module")
def made(
    cart: mujoco.MjModel, design: Design, tmp_path_factory: pytest.TempPathFactory
) -> Recorded:
    """Its recording."""
    return logged(tmp_path_factory.mktemp("rerun"), cart, design)


# ---- designs


def test_a_design_has_all_containers_lines_of_near_limits_and_a_summary(made: Recorded) -> None:
    names = made.blueprint("ContainerBlueprint:display_name").values()
    assert {name[0] for name in names} >= {
        "separate", "answers", "motion", "positions", "controls", "search", "optimiser", "iterates"
    }  # fmt: skip
    shares = [name for name in made.entities if name.startswith("/limits/position")]
    levels = [made.scalars(name)[1][0] for name in shares if "hline" in name]
    assert sorted(levels) == [-100.0, 100.0]
    text = text_of(made)
    assert "it violates limits (position)" in text
    assert "the two parameters are nearly confounded" in text
    assert text.rstrip().endswith("in place of the designed trajectory.")


def text_of(made: Recorded) -> str:
    """The summary."""
    return str(made.static(("summary",), "TextDocument:text")[0][0])


def test_a_design_opens_on_limits_information_and_the_motion_nearest_to_its_limits(
    made: Recorded, design: Design, cart: mujoco.MjModel, tmp_path: Path
) -> None:
    limits, accuracy, positions = opened_rows(made)
    assert [name.split("/")[1] for name in (*limits, *accuracy)] == ["limits", "accuracy"]
    assert positions == [entity_path(("positions", name)) for name in ("slide [m]", "hinge [rad]")]

    (usage,) = design.usage
    other = replace(usage, name="hinge", share=2.0 * usage.share)
    both = logged(tmp_path, cart, replace(design, usage=(usage, other)))
    assert opened_rows(both)[2] == positions[::-1]

    rows = opened_rows(logged(tmp_path, cart, replace(design, usage=())))
    assert [row[0].split("/")[1] for row in rows] == ["accuracy", "positions"]


def test_accuracy_over_time_is_that_of_the_picture(made: Recorded, design: Design) -> None:
    panel = accuracy_over_time(design, design.labels).panels[0]
    curves = [(k, mark) for k, mark in enumerate(panel.marks) if mark.kind == "line" and mark.label]
    assert len(curves) == 2
    for j, (k, mark) in enumerate(curves):
        times, values = made.scalars(("accuracy", panel.title, f"{k} {mark.label}"))
        shown = np.isfinite(mark.y)
        assert_allclose(values, (100.0 * design.std_over_time[:, j] / design.sizes[j])[shown])
        assert_allclose(times, design.trajectory.t[shown], atol=1e-9)


def test_series_are_exact_and_poses_those_of_mujoco(
    made: Recorded, cart: mujoco.MjModel, design: Design
) -> None:
    for name, evaluation in (("0 initial", design.initial), ("1 designed", design.final)):
        trajectory = evaluation.trajectory
        for at, expected in (
            (("positions", "hinge [rad]", name), trajectory.qpos[:, 1]),
            (("velocities", "slide [m/s]", name), trajectory.qvel[:, 0]),
            (("controls", "force [N]", name), trajectory.ctrl[:, 0]),
        ):
            times, values = made.scalars(at)
            assert_allclose(values, expected)
            assert_allclose(times, trajectory.t[: len(expected)], atol=1e-9)

    bob, path = cart.body("bob").id, ("robots", "designed", "bodies", "bob")
    positions, orientations, _ = plain_poses(cart, design.trajectory.qpos)
    _, translation = made.rows(path, "Transform3D:translation")
    _, quaternion = made.rows(path, "Transform3D:quaternion")
    assert_allclose(np.squeeze(translation), positions[:, bob], atol=1e-6)
    assert_allclose(np.roll(np.squeeze(quaternion), 1, axis=1), orientations[:, bob], atol=1e-6)


def test_the_search_is_on_the_timeline_of_iterations(made: Recorded) -> None:
    """The robots have no static poses, which would hide those of the timelines."""
    for name in ("initial", "designed"):
        path = ("robots", name, "bodies", "cart")
        assert not made.static(path, "Transform3D:translation")
        iterations, _ = made.rows(path, "Transform3D:translation", "iteration")
        assert list(iterations) == [0, 1, 2]

    path = ("robots", "designed", "path")
    _, strips = made.rows(path, "LineStrips3D:strips", "iteration")
    lengths = [np.ptp(np.array(strip[0]), axis=0).max() for strip in strips]
    assert lengths[0] < 0.5 * lengths[2]
    assert len(made.rows(path, "LineStrips3D:strips")[1]) == 1

    curve = ("iterates", "slide [m]", "iterate")
    _, strips = made.rows(curve, "LineStrips2D:strips", "iteration")
    heights = [np.ptp(np.array(strip[0])[:, 1]) for strip in strips]
    assert heights[0] < 0.5 * heights[2]


def test_robots_beside_both_motions_are_outlines_without_static_shapes(
    cart: mujoco.MjModel, design: Design, tmp_path: Path
) -> None:
    plans = design.initial.trajectory, design.final.trajectory
    beside = [[replace(plan, qpos=plan.qpos + shift) for shift in (0.1, -0.2)] for plan in plans]
    made = logged(tmp_path, cart, design, (beside, "Pale: two robots."))
    for name, pair in zip(("initial", "designed"), beside, strict=True):
        for number, motion in enumerate(pair, start=1):
            root = ("robots", name, f"robot {number}", "bodies")
            _, places = made.rows((*root, "bob"), "Transform3D:translation")
            expected = plain_poses(cart, motion.qpos)[0]
            assert_allclose(np.squeeze(places), expected[:, cart.body("bob").id], atol=1e-6)
            # On the timeline of the iterations they would stand still in a wrong place.
            shape = (*root, "bob", "bob")
            assert not made.static(shape, "Ellipsoids3D:half_sizes")
            _, fill = made.rows(shape, "Ellipsoids3D:fill_mode")
            assert fill[0][0] == OUTLINE.value
    assert not any("robot 1/bodies/world" in name for name in made.entities)
    assert "Pale: two robots." in text_of(made)


def test_ends_of_rehearsed_robots_are_those_of_mujoco(
    cart: mujoco.MjModel, design: Design, tmp_path: Path
) -> None:
    """Two robots, of which one leaves a limit; the bands are series."""
    t = np.linspace(0.0, 2.0, 30)
    swing = np.column_stack([np.sin(t), np.cos(t)])
    motions = {7: 0.3 * swing, 2: 0.6 * swing}
    std = np.array([0.1, 0.2])
    steps = replace(results.finite_steps(predicted=std), names=design.parameters)
    kept = results.rehearsal(steps=steps)
    margins = kept.margins.copy()
    margins[7] = -0.1
    rehearsal = replace(kept, margins=margins, motion_times=t, motions=motions)
    made = logged(tmp_path, cart, replace(design, rehearsal=rehearsal))
    for positions, name in zip(motions.values(), ("a limit", "no limit"), strict=True):
        expected = plain_poses(cart, positions)[2][:, -1]
        at = ("robots", "designed", f"robots that leave {name}")
        (strips,) = made.static((*at, "paths"), "LineStrips3D:strips")
        assert_allclose(strips[0], expected, atol=1e-6)
        times, ends = made.rows((*at, "ends"), "Points3D:positions")
        assert_allclose(np.squeeze(ends), expected, atol=1e-6)
        assert_allclose(1e-9 * times, t, atol=1e-9)
    fan = rehearsal.fans[0]
    below = [name for name in made.entities if name.startswith("/robots/position")]
    edges = [made.scalars(name)[1] for name in below if "of" in name.rpartition("/")[2]]
    assert_allclose(sorted(edges, key=np.sum), fan.before)


def test_in_the_view_of_both_robots_the_initial_one_is_translucent(made: Recorded) -> None:
    looks = made.blueprint("Ellipsoids3D:colors")
    (path,) = [entity for entity in looks if "/initial/bodies/bob/bob/" in entity]
    bob = ("robots", "initial", "bodies", "bob", "bob")
    (colours,) = made.static(bob, "Ellipsoids3D:colors")
    assert 0 < int(looks[path][0]) & 255 < int(colours[0]) & 255
    assert not [entity for entity in looks if "designed" in entity]


@pytest.mark.parametrize(
    "name", ["cart", "acrobot", "panda", "panda without geoms", "zoo", "release"]
)
def test_a_design_of_any_model_is_logged(name: str, tmp_path: Path) -> None:
    """Also without a history, motions of iterates, information and limits."""
    model = load(name)
    design = designed(model)
    if name == "cart":
        blind = replace(design.initial, std_over_time=np.full((41, 2), np.inf))
        design = replace(design, initial=blind, history=(), motions=None)
    logged_design = logged(tmp_path, model, replace(design, usage=()))
    shown = {name.split("/")[2] for name in logged_design.entities if "/positions/" in name}
    assert len(shown) == model.nv


# ---- cameras


def moving(name: str) -> tuple[mujoco.MjModel, Any]:
    """A model by its short name, and its poses in a motion."""
    model = load(name)
    trajectory = simulated(model, 1.0)
    return model, body_poses(model, trajectory.t, trajectory.qpos)


def logged_flight(folder: Path, axis: int, way: float) -> Recorded:
    """The quadrotor that stays, as the initial motion, beside one that flies along an axis."""
    model = load("quadrotor")
    still = simulated(model, 0.5, samples=100)
    qpos = np.array(still.qpos)
    qpos[:, axis] += np.linspace(0.0, way, len(qpos))
    motions = {"initial": still, "final": replace(still, qpos=qpos)}
    path = folder / "replay.rrd"
    log_trajectories(path, model, motions, labels_of_model(model))
    return Recorded(path)


@pytest.mark.parametrize("name", ["acrobot", "panda", "panda without geoms", "zoo", "release"])
def test_the_camera_is_as_near_as_the_motion_permits(name: str) -> None:
    """Something moving is at an edge of the picture, and nothing is beyond it."""
    model, poses = moving(name)
    eye = place_camera(model, [poses], views=1, aspect=1.3, follow=False)
    towards = np.subtract(eye.position, eye.target)
    distance = np.linalg.norm(towards)
    points = seen_points(model, moving_points(model, [poses]))
    seen = (points - eye.target) @ camera_axes(towards / distance).T
    slope = np.tan(FIELD_OF_VIEW / 2.0)
    places = np.abs(seen[:, :2] / (distance - seen[:, 2:]) / slope / [1.3, 1.0])
    assert places.max() == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(("name", "edge_on"), [("cart", True), ("panda", False)])
def test_only_a_motion_in_an_upright_plane_is_seen_with_the_ground_edge_on(
    name: str, edge_on: bool
) -> None:
    model, poses = moving(name)
    assert place_camera(model, [poses], views=1, aspect=1.3).edge_on == edge_on


def test_the_camera_follows_a_body_that_flies_away_except_in_the_common_view(
    tmp_path: Path,
) -> None:
    """A view that is opened while a body flies would begin in a wrong place."""
    made = logged_flight(tmp_path, 0, 20.0)
    tracked = made.blueprint("EyeControls3D:tracking_entity")
    followed = {names[0] for names in tracked.values()}
    assert len(followed) == 2
    assert followed <= made.entities
    places = made.blueprint("EyeControls3D:position")
    assert len(places) == 3
    assert len(set(places) - set(tracked)) == 1


def test_the_camera_follows_a_base_on_slides_that_drives_far() -> None:
    """A cart that stays near its rail is seen from where it is."""
    model = load("cart")
    ways = (np.column_stack([np.linspace(0.0, way, 50), np.ones(50)]) for way in (1.0, 40.0))
    poses = [body_poses(model, np.arange(50.0), qpos) for qpos in ways]
    near, far = (place_camera(model, [each], views=1, aspect=1.3) for each in poses)
    assert (near.followed, far.followed) == (None, model.body("cart").id)

    # The nested slides of a mobile base: the camera follows the last one.
    slide = "<joint type='slide' axis='{}'/><inertial pos='0 0 0' mass='1' diaginertia='1 1 1'/>"
    nested = (
        f"<body name='along'>{slide.format('1 0 0')}<body name='across'>{slide.format('0 1 0')}"
        "<body name='arm'><joint/><geom size='.1' pos='.2 0 0'/></body></body></body>"
    )
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{nested}</worldbody></mujoco>")
    qpos = np.column_stack([np.linspace(0.0, 9.0, 50)] * 2 + [np.zeros(50)])
    camera = place_camera(model, [body_poses(model, np.arange(50.0), qpos)], views=1, aspect=1.3)
    assert camera.followed == model.body("across").id


def test_a_robot_below_the_floor_is_seen_through_it(tmp_path: Path) -> None:
    """The floor between it and the camera is translucent; above it, the floor is as it was."""
    made = logged_flight(tmp_path, 2, -4.0)
    for name, is_translucent in (("initial", False), ("designed", True)):
        floor = ("robots", name, "bodies", "world", "floor")
        colours = made.static(floor, "Mesh3D:albedo_factor")
        assert (len(colours) == 1 and int(colours[0][0]) & 255 < 255) == is_translucent


# ---- shapes


# A static component of a body or geom, by its name.
Shown = Callable[..., Array]


@pytest.fixture(scope="module")
def zoo() -> mujoco.MjModel:
    """The model with every type of geom."""
    return load("zoo")


@pytest.fixture(scope="module")
def static(zoo: mujoco.MjModel, tmp_path_factory: pytest.TempPathFactory) -> Shown:
    """Its replay."""
    path = tmp_path_factory.mktemp("zoo") / "zoo.rrd"
    log_trajectories(path, zoo, {"initial": simulated(zoo, 0.0)}, labels_of_model(zoo))
    made = Recorded(path)
    return lambda part, *at: np.array(made.static(("robots", "initial", "bodies", *at), part)[0])


def test_a_mesh_and_a_height_field_are_those_of_mujoco(zoo: mujoco.MjModel, static: Shown) -> None:
    """A mesh keeps the compiled vertices and flat normals; rays meet the heights."""
    vertices = static("Mesh3D:vertex_positions", "rock", "rock")
    triangles = static("Mesh3D:triangle_indices", "rock", "rock").reshape(-1, 3)
    assert triangles.shape == (4, 3)
    assert len(vertices) == len(np.unique(triangles))
    expected = zoo.mesh_vert[np.lexsort(zoo.mesh_vert.T)]
    assert_allclose(vertices[np.lexsort(vertices.T)], expected, atol=1e-6)

    data = mujoco.MjData(zoo)
    mujoco.mj_kinematics(zoo, data)
    for x, y, z in static("Mesh3D:vertex_positions", "world", "hills"):
        start, down = np.array([0.99 * x, 1.0 + 0.99 * y, 2.0]), np.array([0.0, 0.0, -1.0])
        hit = mujoco.mj_ray(zoo, data, start, down, None, 1, -1, np.zeros(1, np.int32))
        assert 2.0 - hit == pytest.approx(z, abs=0.02)


def test_capsules_sticks_fixed_bodies_and_planes(zoo: mujoco.MjModel, static: Shown) -> None:
    limb = zoo.geom("limb").id
    assert static("Capsules3D:lengths", "a/b c", "limb")[0] == pytest.approx(0.5)

    # The capsule of Rerun begins at its origin and runs along z.
    to_middle = np.empty(3)
    mujoco.mju_rotVecQuat(to_middle, np.array([0.0, 0.0, 0.25]), zoo.geom_quat[limb])
    begin = static("Transform3D:translation", "a/b c", "limb")[0]
    assert_allclose(begin + to_middle, zoo.geom_pos[limb], atol=1e-7)

    stick = static("Capsules3D:lengths", "bare", "stick 6")[0]
    assert stick == pytest.approx(np.hypot(0.3, 0.5))
    assert_allclose(static("Transform3D:translation", "fixed")[0], [0, -1, 0])
    board = static("Mesh3D:vertex_positions", "world", "floor")
    assert np.abs(board).max() == pytest.approx(INFINITE_REACH * zoo.stat.extent, rel=1e-6)


# ---- estimates


def logged_estimate(
    folder: Path, model: mujoco.MjModel, *, is_measured: bool = True, **changes: Any
) -> tuple[Recorded, Estimate]:
    """The recording of a hand-made estimate with a held-out recording."""
    trajectory, outputs = simulated(model, 1.0), ("qpos:slide", "hinge_angle")
    made = estimated(model, trajectory)
    errors = PredictionErrors(name="held.csv", outputs=outputs, rms=np.ones(2), mae=np.ones(2))
    held = Prediction(
        name="held.csv",
        identified=errors,
        nominal=errors,
        held_out=True,
        recording=made.recordings[0],
        identified_outputs=made.predicted[0],
        nominal_outputs=1.1 * made.predicted[0],
    )
    sigma = dict.fromkeys(outputs, 0.01)
    estimate = replace(made, sigma=sigma, predictions=(held,), **changes)
    path, measured = folder / "estimate.rrd", trajectory if is_measured else None
    log_estimate(path, model, estimate, measured, trajectory, labels_of_model(model))
    return checked(path), estimate


def test_outputs_and_residuals_of_every_recording(cart: mujoco.MjModel, tmp_path: Path) -> None:
    """Without measured positions there is no measured robot."""
    made, estimate = logged_estimate(tmp_path, cart)
    y = estimate.recordings[0].y[:, 0]
    for tab in ("1: run 0", "2: run 1", "held out 1: held.csv"):
        (measured,) = (
            name
            for name in made.entities
            if name.startswith(entity_path((tab,))) and "slide" in name and "/0\\ measured" in name
        )
        assert_allclose(made.scalars(measured)[1], y[np.isfinite(y)])

    for name, style in (("measured", OUTLINE), ("identified", SOLID)):
        bob = ("robots", name, "bodies", "bob", "bob")
        assert made.static(bob, "Ellipsoids3D:fill_mode")[0][0] == style.value
    without, _ = logged_estimate(tmp_path, cart, is_measured=False)
    assert not any(name.startswith("/robots/measured") for name in without.entities)


def test_ribbons_are_curves_over_time_and_residual_torques_are_planes(
    cart: mujoco.MjModel, tmp_path: Path
) -> None:
    made = estimated(cart, simulated(cart, 1.0))
    end = float(made.recordings[0].t[-1])
    in_time = results.information_in_time(made.parameters, end)
    shown, _ = logged_estimate(
        tmp_path, cart, in_time=in_time, residual_forces=results.residual_forces("slide")
    )
    information, outputs, residuals = opened_rows(shown)
    assert information == [entity_path(("information [% per s]", "run 0"))]
    assert [f"{name}:" in other for name, other in zip(outputs, residuals, strict=True)]

    first = entity_path(("information [% per s]", "run 0")) + "/0"
    (curve,) = (name for name in shown.entities if name.startswith(first))
    times, values = shown.scalars(curve)
    assert_allclose(values, 90.0 / end)
    assert_allclose(times, in_time.times[:, 0], atol=1e-6)
    plane = entity_path(("residual torque", "slide [N m] over speed [rad/s]"))
    assert any(name.startswith(plane) for name in shown.entities)


# ---- numbers and the viewer


def test_the_viewer_is_opened_or_says_why_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "shown.rrd"
    with pytest.raises(RecordingError, match="there is no Rerun recording"):
        show(file)
    file.touch()
    expired = Mock(side_effect=subprocess.TimeoutExpired("rerun", 1.0))
    viewer = Mock(return_value=Mock(wait=expired))
    monkeypatch.setattr(subprocess, "Popen", viewer)
    show(file)
    # Python does not search for the viewer in the current folder.
    command = viewer.call_args.args[0]
    assert "-P" in command[: command.index("-m")]
    viewer.return_value.wait = Mock(return_value=1)
    with pytest.raises(MjfimError, match="ended with code 1"):
        show(file)
