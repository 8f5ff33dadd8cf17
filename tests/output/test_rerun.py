"""Rerun files are read back and compared with the records and with MuJoCo."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

pytest.importorskip("rerun")
from rerun.chunk import RrdReader

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
from mjfim.records.estimate_parts import InformationInTime, ResidualForce
from mjfim.records.rehearsal import RobotMotions
from mjfim.records.trajectory import Trajectory
from tests.support import results
from tests.support.made_motions import designed, estimated, load, simulated


def entities(path: Path) -> set[str]:
    """Every entity path in a recording."""
    return {str(chunk.entity_path) for chunk in RrdReader(path).stream().to_chunks()}


def column(
    path: Path, at: tuple[str, ...] | str, timeline: str | None, component: str
) -> tuple[Any, Array]:
    """Times and values of one component of one entity; without a timeline, those of static data."""
    times: list[int] = []
    values: list[Any] = []
    content = at if isinstance(at, str) else entity_path(at)
    for chunk in RrdReader(path).stream().filter(content=content).to_chunks():
        batch = chunk.to_record_batch()
        if component in batch.schema.names and (
            timeline in batch.schema.names or (timeline is None and chunk.is_static)
        ):
            values += batch.column(component).to_pylist()
            times += batch.column(timeline).cast("int64").to_pylist() if timeline else []
    order = np.argsort(times, kind="stable") if timeline else slice(None)
    return np.array(times)[order], np.array(values)[order]


def scalars(path: Path, at: tuple[str, ...] | str) -> tuple[Array, Array]:
    """Times [s] and values of a curve."""
    times, values = column(path, at, "sim_time", "Scalars:scalars")
    return 1e-9 * times, np.ravel(values)


def logged(folder: Path, model: mujoco.MjModel, design: Design, *beside: tuple[Any, str]) -> Path:
    """The recording of a design, whose views all show something."""
    path = folder / "design.rrd"
    log_design(path, model, design, labels_of_model(model), *beside)
    assert empty_views(path) == []
    return path


def blueprint_column(path: Path, component: str) -> dict[str, Any]:
    reader = RrdReader(path)
    found = {}
    for chunk in reader.stream(store=reader.blueprints()[0]).to_chunks():
        batch = chunk.to_record_batch()
        if component in batch.schema.names:
            found[str(chunk.entity_path)] = batch.column(component).to_pylist()[0]
    return found


def opened_rows(path: Path) -> list[list[str]]:
    """Origins of the views in each row of the tab that is opened on the right."""
    parts, origins, opened = (
        blueprint_column(path, component)
        for component in (
            "ContainerBlueprint:contents",
            "ViewBlueprint:space_origin",
            "ContainerBlueprint:active_tab",
        )
    )
    every = {tab[0]: parts[name] for name, tab in opened.items()}
    names = blueprint_column(path, "ContainerBlueprint:display_name")
    (tab,) = [tab for tab in every if names.get(f"/{tab}") == ["answers"]]
    assert every[tab][0] == tab
    return [[origins[f"/{view}"][0] for view in parts[f"/{row}"]] for row in parts[f"/{tab}"]]


def empty_views(path: Path) -> list[str]:
    """Origins of views below which there is nothing."""
    found = [f"{name}/" for name in entities(path)]
    origins = blueprint_column(path, "ViewBlueprint:space_origin").values()
    return [at for (at,) in origins if not any(name.startswith(f"{at}/") for name in found)]


def text_of(path: Path) -> str:
    """The summary."""
    return str(column(path, ("summary",), None, "TextDocument:text")[1][0, 0])


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
def file(cart: mujoco.MjModel, design: Design, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Its recording."""
    return logged(tmp_path_factory.mktemp("rerun"), cart, design)


# ---- designs


def test_a_design_has_all_containers_and_nothing_warns(file: Path) -> None:
    assert not any("warning" in name for name in entities(file))
    assert len(RrdReader(file).blueprints()) == 1
    names = blueprint_column(file, "ContainerBlueprint:display_name").values()
    assert {name[0] for name in names} >= {
        "separate", "answers", "motion", "positions", "controls", "search", "optimiser", "iterates"
    }  # fmt: skip


def test_a_design_opens_on_limits_information_and_the_motion_nearest_to_its_limits(
    file: Path, design: Design, cart: mujoco.MjModel, tmp_path: Path
) -> None:
    limits, accuracy, positions = opened_rows(file)
    assert [name.split("/")[1] for name in (*limits, *accuracy)] == ["limits", "accuracy"]
    assert positions == [entity_path(("positions", name)) for name in ("slide [m]", "hinge [rad]")]

    (usage,) = design.usage
    other = replace(usage, name="hinge", share=2.0 * usage.share)
    path = logged(tmp_path, cart, replace(design, usage=(usage, other)))
    assert opened_rows(path)[2] == positions[::-1]

    rows = opened_rows(logged(tmp_path, cart, replace(design, usage=())))
    assert [row[0].split("/")[1] for row in rows] == ["accuracy", "positions"]


def test_accuracy_over_time_is_that_of_the_picture(file: Path, design: Design) -> None:
    panel = accuracy_over_time(design, design.labels).panels[0]
    curves = [(k, mark) for k, mark in enumerate(panel.marks) if mark.kind == "line" and mark.label]
    assert len(curves) == 2
    for j, (k, mark) in enumerate(curves):
        path = ("accuracy", panel.title, f"{k} {mark.label}")
        times, values = scalars(file, path)
        percent = 100.0 * design.std_over_time[:, j] / design.sizes[j]
        shown = np.isfinite(mark.y)
        assert_allclose(values, percent[shown])
        assert_allclose(times, design.trajectory.t[shown], atol=1e-9)


def test_series_are_exact(file: Path, design: Design) -> None:
    for name, evaluation in (("0 initial", design.initial), ("1 designed", design.final)):
        trajectory = evaluation.trajectory
        for at, expected in (
            (("positions", "hinge [rad]", name), trajectory.qpos[:, 1]),
            (("velocities", "slide [m/s]", name), trajectory.qvel[:, 0]),
            (("controls", "force [N]", name), trajectory.ctrl[:, 0]),
        ):
            times, values = scalars(file, at)
            assert_allclose(values, expected)
            assert_allclose(times, trajectory.t[: len(expected)], atol=1e-9)


def test_limits_that_are_near_are_lines(file: Path) -> None:
    shares = [name for name in entities(file) if name.startswith("/limits/position")]
    levels = [scalars(file, name)[1][0] for name in shares if "hline" in name]
    assert sorted(levels) == [-100.0, 100.0]


def test_poses_are_those_of_mujoco(file: Path, cart: mujoco.MjModel, design: Design) -> None:
    bob, path = cart.body("bob").id, ("robots", "designed", "bodies", "bob")
    positions, orientations, _ = plain_poses(cart, design.trajectory.qpos)
    _, translation = column(file, path, "sim_time", "Transform3D:translation")
    _, quaternion = column(file, path, "sim_time", "Transform3D:quaternion")
    assert_allclose(translation[:, 0], positions[:, bob], atol=1e-6)
    assert_allclose(np.roll(quaternion[:, 0], 1, axis=1), orientations[:, bob], atol=1e-6)


def test_the_search_is_on_the_timeline_of_iterations(file: Path) -> None:
    """The robots have no static poses, which would hide those of the timelines."""
    for name in ("initial", "designed"):
        path = ("robots", name, "bodies", "cart")
        assert len(column(file, path, None, "Transform3D:translation")[1]) == 0
        iterations, _ = column(file, path, "iteration", "Transform3D:translation")
        assert list(iterations) == [0, 1, 2]

    path = ("robots", "designed", "path")
    _, strips = column(file, path, "iteration", "LineStrips3D:strips")
    lengths = [np.ptp(np.array(strip[0]), axis=0).max() for strip in strips]
    assert lengths[0] < 0.5 * lengths[2]
    assert len(column(file, path, "sim_time", "LineStrips3D:strips")[1]) == 1

    curve = ("iterates", "slide [m]", "iterate")
    _, strips = column(file, curve, "iteration", "LineStrips2D:strips")
    heights = [np.ptp(np.array(strip[0])[:, 1]) for strip in strips]
    assert heights[0] < 0.5 * heights[2]


def test_robots_beside_both_motions_are_outlines_without_static_shapes(
    cart: mujoco.MjModel, design: Design, tmp_path: Path
) -> None:
    plans = design.initial.trajectory, design.final.trajectory
    beside = [[replace(plan, qpos=plan.qpos + shift) for shift in (0.1, -0.2)] for plan in plans]
    path = logged(tmp_path, cart, design, (beside, "Pale: two robots."))
    for name, pair in zip(("initial", "designed"), beside, strict=True):
        for number, motion in enumerate(pair, start=1):
            root = ("robots", name, f"robot {number}", "bodies")
            _, places = column(path, (*root, "bob"), "sim_time", "Transform3D:translation")
            expected = plain_poses(cart, motion.qpos)[0]
            assert_allclose(places[:, 0], expected[:, cart.body("bob").id], atol=1e-6)
            # On the timeline of the iterations they would stand still in a wrong place.
            shape = (*root, "bob", "bob")
            assert not len(column(path, shape, None, "Ellipsoids3D:half_sizes")[1])
            _, fill = column(path, shape, "sim_time", "Ellipsoids3D:fill_mode")
            assert fill[0, 0] == OUTLINE.value
    assert not any("robot 1/bodies/world" in name for name in entities(path))
    assert "Pale: two robots." in text_of(path)


def test_ends_of_rehearsed_robots_are_those_of_mujoco(
    cart: mujoco.MjModel, design: Design, tmp_path: Path
) -> None:
    """Two robots, of which one leaves a limit; the bands are series."""
    t = np.linspace(0.0, 2.0, 30)
    swing = np.column_stack([np.sin(t), np.cos(t)])
    motions = RobotMotions(robots=(7, 2), t=t, qpos=np.stack([0.3 * swing, 0.6 * swing]))
    std = np.array([0.1, 0.2])
    steps = replace(results.finite_steps(predicted=std), names=design.parameters)
    kept = results.rehearsal(steps=steps)
    margins = kept.margins.copy()
    margins[7] = -0.1
    rehearsal = replace(kept, margins=margins, motions=motions)
    path = logged(tmp_path, cart, replace(design, rehearsal=rehearsal))
    for positions, name in zip(motions.qpos, ("a limit", "no limit"), strict=True):
        expected = plain_poses(cart, positions)[2][:, -1]
        at = ("robots", "designed", f"robots that leave {name}")
        _, (strips,) = column(path, (*at, "paths"), None, "LineStrips3D:strips")
        assert_allclose(strips[0], expected, atol=1e-6)
        times, ends = column(path, (*at, "ends"), "sim_time", "Points3D:positions")
        assert_allclose(ends[:, 0], expected, atol=1e-6)
        assert_allclose(1e-9 * times, t, atol=1e-9)
    fan = rehearsal.fans[0]
    below = [name for name in entities(path) if name.startswith("/robots/position")]
    edges = [scalars(path, name)[1] for name in below if "of" in name.rpartition("/")[2]]
    assert_allclose(sorted(edges, key=np.sum), fan.before)


def test_in_the_view_of_both_robots_the_initial_one_is_translucent(file: Path) -> None:
    looks = blueprint_column(file, "Ellipsoids3D:colors")
    (path,) = [entity for entity in looks if "/initial/bodies/bob/bob/" in entity]
    bob = ("robots", "initial", "bodies", "bob", "bob")
    _, (colours,) = column(file, bob, None, "Ellipsoids3D:colors")
    assert 0 < int(looks[path][0]) & 255 < int(colours[0]) & 255
    assert not [entity for entity in looks if "designed" in entity]


def test_the_summary_holds_outcome_warnings_and_colours(file: Path) -> None:
    text = text_of(file)
    assert "it violates limits (position)" in text
    assert "the two parameters are nearly confounded" in text
    assert text.rstrip().endswith("in place of the designed trajectory.")


def test_a_design_without_history_motions_or_information_is_logged(
    cart: mujoco.MjModel, design: Design, tmp_path: Path
) -> None:
    blind = replace(design.initial, std_over_time=np.full((41, 2), np.inf))
    logged(tmp_path, cart, replace(design, initial=blind, history=(), motions=None, usage=()))


@pytest.mark.parametrize("name", ["acrobot", "panda", "panda without geoms", "zoo", "release"])
def test_a_design_of_any_model_is_logged(name: str, tmp_path: Path) -> None:
    model = load(name)
    path = logged(tmp_path, model, replace(designed(model), usage=()))
    positions = {entity.split("/")[2] for entity in entities(path) if "/positions/" in entity}
    assert len(positions) == model.nv


# ---- cameras


def moving(name: str) -> tuple[mujoco.MjModel, Any]:
    """A model by its short name, and its poses in a motion."""
    model = load(name)
    trajectory = simulated(model, 1.0)
    return model, body_poses(model, trajectory.t, trajectory.qpos)


def logged_flight(path: Path, axis: int, way: float) -> None:
    """Log the quadrotor that stays, as the initial motion, beside one that flies along an axis."""
    model = load("quadrotor")
    still = simulated(model, 0.5, samples=100)
    qpos = np.array(still.qpos)
    qpos[:, axis] += np.linspace(0.0, way, len(qpos))
    motions = {"initial": still, "final": replace(still, qpos=qpos)}
    log_trajectories(path, model, motions, labels_of_model(model))


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
    path = tmp_path / "replay.rrd"
    logged_flight(path, 0, 20.0)
    tracked = blueprint_column(path, "EyeControls3D:tracking_entity")
    followed = {names[0] for names in tracked.values()}
    assert len(followed) == 2
    assert followed <= entities(path)
    places = blueprint_column(path, "EyeControls3D:position")
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
    path = tmp_path / "replay.rrd"
    logged_flight(path, 2, -4.0)
    for name, is_translucent in (("initial", False), ("designed", True)):
        floor = ("robots", name, "bodies", "world", "floor")
        _, colours = column(path, floor, None, "Mesh3D:albedo_factor")
        assert (len(colours) == 1 and int(colours[0, 0]) & 255 < 255) == is_translucent


# ---- shapes


@pytest.fixture(scope="module")
def zoo_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Replay of the model with every type of geom."""
    model = load("zoo")
    path = tmp_path_factory.mktemp("zoo") / "zoo.rrd"
    log_trajectories(path, model, {"initial": simulated(model, 0.0)}, labels_of_model(model))
    return path


def static(path: Path, component: str, *parts: str) -> Array:
    """First row of a static component of a body or geom."""
    return np.array(column(path, ("robots", "initial", "bodies", *parts), None, component)[1][0])


def test_a_mesh_keeps_the_compiled_vertices_and_flat_normals(zoo_file: Path) -> None:
    model = load("zoo")
    vertices = static(zoo_file, "Mesh3D:vertex_positions", "rock", "rock")
    triangles = static(zoo_file, "Mesh3D:triangle_indices", "rock", "rock").reshape(-1, 3)
    assert triangles.shape == (4, 3)
    assert len(vertices) == len(np.unique(triangles))
    expected = model.mesh_vert[np.lexsort(model.mesh_vert.T)]
    assert_allclose(vertices[np.lexsort(vertices.T)], expected, atol=1e-6)


def test_a_height_field_has_heights_where_mujoco_has_them(zoo_file: Path) -> None:
    vertices = static(zoo_file, "Mesh3D:vertex_positions", "world", "hills")
    model = load("zoo")
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for x, y, z in vertices:
        start, down = np.array([0.99 * x, 1.0 + 0.99 * y, 2.0]), np.array([0.0, 0.0, -1.0])
        hit = mujoco.mj_ray(model, data, start, down, None, 1, -1, np.zeros(1, np.int32))
        assert 2.0 - hit == pytest.approx(z, abs=0.02)


def test_capsules_sticks_fixed_bodies_and_planes(zoo_file: Path) -> None:
    model = load("zoo")
    limb = model.geom("limb").id
    assert static(zoo_file, "Capsules3D:lengths", "a/b c", "limb")[0] == pytest.approx(0.5)

    # The capsule of Rerun begins at its origin and runs along z.
    to_middle = np.empty(3)
    mujoco.mju_rotVecQuat(to_middle, np.array([0.0, 0.0, 0.25]), model.geom_quat[limb])
    begin = static(zoo_file, "Transform3D:translation", "a/b c", "limb")[0]
    assert_allclose(begin + to_middle, model.geom_pos[limb], atol=1e-7)

    stick = static(zoo_file, "Capsules3D:lengths", "bare", "stick 6")[0]
    assert stick == pytest.approx(np.hypot(0.3, 0.5))
    fixed = static(zoo_file, "Transform3D:translation", "fixed")[0]
    assert_allclose(fixed, [0, -1, 0])
    board = static(zoo_file, "Mesh3D:vertex_positions", "world", "floor")
    assert np.abs(board).max() == pytest.approx(INFINITE_REACH * model.stat.extent, rel=1e-6)


# ---- estimates


def estimate_of(model: mujoco.MjModel, trajectory: Trajectory) -> Estimate:
    """A hand-made estimate with a held-out recording."""
    made, outputs = estimated(model, trajectory), ("qpos:slide", "hinge_angle")
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
    return replace(made, sigma=dict.fromkeys(outputs, 0.01), predictions=(held,))


def logged_estimate(
    folder: Path, model: mujoco.MjModel, *, is_measured: bool = True, **changes: Any
) -> tuple[Path, Estimate]:
    """The recording of an estimate, whose views all show something."""
    trajectory, path = simulated(model, 1.0), folder / "estimate.rrd"
    estimate = replace(estimate_of(model, trajectory), **changes)
    measured = trajectory if is_measured else None
    log_estimate(path, model, estimate, measured, trajectory, labels_of_model(model))
    assert empty_views(path) == []
    return path, estimate


def test_outputs_and_residuals_of_every_recording(cart: mujoco.MjModel, tmp_path: Path) -> None:
    path, estimate = logged_estimate(tmp_path, cart)
    for tab in ("1: run 0", "2: run 1", "held out 1: held.csv"):
        (measured,) = (
            name
            for name in entities(path)
            if name.startswith(entity_path((tab,))) and "slide" in name and "/0\\ measured" in name
        )
        values = scalars(path, measured)[1]
        y = estimate.recordings[0].y[:, 0]
        assert_allclose(values, y[np.isfinite(y)])

    fills = [
        column(path, ("robots", name, "bodies", "bob", "bob"), None, "Ellipsoids3D:fill_mode")[1][
            0, 0
        ]
        for name in ("measured", "identified")
    ]
    assert fills == [OUTLINE.value, SOLID.value]


def test_without_measured_positions_there_is_no_measured_robot(
    cart: mujoco.MjModel, tmp_path: Path
) -> None:
    path, _ = logged_estimate(tmp_path, cart, is_measured=False)
    assert not any(name.startswith("/robots/measured") for name in entities(path))


def test_ribbons_are_curves_over_time_and_residual_torques_are_planes(
    cart: mujoco.MjModel, tmp_path: Path
) -> None:
    made = estimated(cart, simulated(cart, 1.0))
    speed, end = np.sin(np.arange(100.0)), float(made.recordings[0].t[-1])
    in_time = InformationInTime(
        parameters=made.parameters,
        recording=np.zeros(2),
        times=0.5 * end * np.array([[0.0, 1.0], [1.0, 2.0]]),
        shares=np.tile([[0.25], [0.75]], 2),
        pulls=np.zeros((2, 2)),
        scatter=1.0,
    )
    residual = ResidualForce(
        joint="slide", unit="N", position=speed, speed=speed, force=speed, sigma=0.1, size=1.0
    )
    path, _ = logged_estimate(tmp_path, cart, in_time=in_time, residual_forces=(residual,))
    information, outputs, residuals = opened_rows(path)
    assert information == [entity_path(("information [% per s]", "run 0"))]
    assert [f"{name}:" in other for name, other in zip(outputs, residuals, strict=True)]

    first = entity_path(("information [% per s]", "run 0")) + "/0"
    (curve,) = (name for name in entities(path) if name.startswith(first))
    times, values = scalars(path, curve)
    assert_allclose(values, np.array([25.0, 75.0]) * 2.0 / end)
    assert_allclose(times, [0.0, 0.5 * end], atol=1e-6)
    plane = entity_path(("residual torque", "slide [N] over speed [m/s]"))
    assert any(name.startswith(plane) for name in entities(path))


# ---- numbers and the viewer


def test_the_viewer_is_opened_or_says_why_not(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(RecordingError, match="there is no Rerun recording"):
        show(tmp_path / "none.rrd")
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
