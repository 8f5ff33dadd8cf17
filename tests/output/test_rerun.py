"""Rerun files are read back and compared with the records and with MuJoCo."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from tests.support.made_records import make_row
from tests.support.paths import ROOT, SHARED_MODELS

pytest.importorskip("rerun")
import rerun.blueprint as rrb
from rerun.chunk import RrdReader

from mjfim.arrays import Array
from mjfim.errors import MjfimError, RecordingError
from mjfim.experiment.labels import labels_of_model
from mjfim.model.coordinates import output_label
from mjfim.output.rerun import log_design, log_estimate, log_trajectories, show
from mjfim.output.rerun.camera import (
    FIELD_OF_VIEW,
    camera_axes,
    moving_points,
    place_camera,
    seen_points,
)
from mjfim.output.rerun.history import history_series
from mjfim.output.rerun.iterates import POSES, IterateCurves
from mjfim.output.rerun.limits import usage_plots
from mjfim.output.rerun.outputs import output_plots, recording_tabs
from mjfim.output.rerun.panels import dof_positions, fit_in_a_row, grid_tabs, plot_size
from mjfim.output.rerun.scene import body_poses, entity_path
from mjfim.output.rerun.series import (
    LARGEST_ZOOM,
    NUMBERS_BESIDE,
    ROOM,
    TIME_ROOM,
    Curve,
    SeriesPlot,
    padded,
    with_room_for_legends,
    with_two_numbers,
)
from mjfim.output.rerun.shapes import INFINITE_REACH, OUTLINE, SOLID
from mjfim.output.rerun.strips import round_logarithms, round_numbers
from mjfim.records.design import (
    MOTION_SAMPLES,
    Design,
    Evaluation,
    HistoryRow,
    IterateMotion,
    IterateMotions,
    LimitUsage,
    StartResult,
    Status,
)
from mjfim.records.estimate import Estimate, Prediction, PredictionErrors
from mjfim.records.trajectory import Recording, Trajectory

MODELS = {
    "cart": ROOT / "models" / "cart_pendulum.xml",
    "quadrotor": ROOT / "models" / "quadrotor.xml",
    "release": ROOT / "models" / "free_pendulum.xml",
    "acrobot": SHARED_MODELS / "dmc_acrobot" / "acrobot.xml",
    "panda": SHARED_MODELS / "menagerie_panda" / "panda_nomesh.xml",
    "panda without geoms": SHARED_MODELS / "menagerie_panda" / "panda_nohand_nomesh.xml",
}

ZOO = """
<mujoco model="zoo">
  <asset>
    <mesh name="tetrahedron" vertex="0 0 0  .4 0 0  0 .4 0  0 0 .4"/>
    <hfield name="hills" nrow="3" ncol="4" size=".6 .4 .3 .05"
      elevation="0 0 0 0  0 1 0 0  0 0 0 .5"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="0 0 .1" pos="0 0 -1"/>
    <geom name="hills" type="hfield" hfield="hills" pos="0 1 0"/>
    <body name="floating"><freejoint name="float"/><geom type="box" size=".1 .2 .3"/></body>
    <body name="a/b c" pos="1 0 0">
      <joint name="ball" type="ball"/>
      <geom name="limb" type="capsule" fromto="0 0 0 .3 0 .4" size=".05"/>
      <geom name="egg" type="ellipsoid" size=".1 .2 .05"/>
      <body pos=".3 0 .4"><joint axis="0 1 0"/><geom type="cylinder" size=".1 .2"/></body>
    </body>
    <body name="rock" pos="2 0 0">
      <joint type="slide"/><geom name="rock" type="mesh" mesh="tetrahedron"/>
    </body>
    <body name="bare" pos="3 0 0">
      <joint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <body name="tip" pos="0 .3 .5"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/></body>
    </body>
    <body name="fixed" pos="0 -1 0"><geom type="sphere" size=".1"/></body>
  </worldbody>
</mujoco>
"""

# Ends of the paths of entities that show nothing by themselves.
BESIDE = (f"/{ROOM}", "/lower\\ limit", "/upper\\ limit", "/band")


def load(name: str) -> mujoco.MjModel:
    """Load a model by its short name; skip the test if the shared models are absent."""
    if name == "zoo":
        return mujoco.MjModel.from_xml_string(ZOO)
    if not MODELS[name].is_file():
        pytest.skip(f"{MODELS[name].name} is not in this checkout's neighbourhood")
    return mujoco.MjModel.from_xml_path(str(MODELS[name]))


def simulated(model: mujoco.MjModel, amplitude: float, samples: int = 40) -> Trajectory:
    """Simulate sine controls from the first keyframe, one engine step per sample."""
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    t = np.arange(samples + 1) * model.opt.timestep
    ctrl = data.ctrl + amplitude * np.sin(2.0 * t[:-1, None] * np.ones(model.nu))
    rows = [(data.qpos.copy(), data.qvel.copy(), data.act.copy())]
    for u in ctrl:
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
        rows.append((data.qpos.copy(), data.qvel.copy(), data.act.copy()))
    qpos, qvel, act = (np.array(column) for column in zip(*rows, strict=True))
    return Trajectory(t=t, qpos=qpos, qvel=qvel, act=act, ctrl=ctrl)


def evaluated(model: mujoco.MjModel, trajectory: Trajectory, gain: float) -> Evaluation:
    """Make an evaluation of two parameters with smooth sensitivities and growing information."""
    nx, t = 2 * model.nv + model.na, trajectory.t
    psi = gain * np.sin(t)[:, None, None] * np.arange(1.0, 2 * nx + 1).reshape(1, nx, 2)
    return Evaluation(
        trajectory=trajectory,
        gain=np.zeros((trajectory.samples, model.nu, nx)),
        sensitivity=psi,
        information=gain * np.eye(2),
        eigenvalues=gain * np.ones(2),
        std=np.array([0.5, 0.25]) / gain,
        min_eigenvalue=gain * t**2,
        criterion=1.0 / gain,
        cost=2.0 / gain,
    )


def designed(model: mujoco.MjModel) -> Design:
    """Make a design by hand: a small and a large control, three iterations."""
    history = tuple(
        make_row(
            iteration=k,
            cost=2.0 / 4**k,
            min_eigenvalue=4.0**k,
            slope=0.1**k,
            gamma=0.5,
            seconds=0.1 * k,
            steps=100 * k,
        )
        for k in range(3)
    )
    initial, final = simulated(model, 0.5), simulated(model, 2.0)
    iterates = [(k, IterateMotion.of(simulated(model, 0.5 + 0.75 * k))) for k in range(3)]
    return Design(
        motions=IterateMotions.of([(k, motion) for k, motion in iterates if motion]),
        usage=(
            LimitUsage(
                kind="position",
                name="slide",
                t=final.t,
                share=final.qpos[:, 0] / 1.5,
                lower=-1.5,
                upper=1.5,
            ),
        ),
        status=Status.MAX_ITERATIONS,
        parameters=("mass", "gear/ratio"),
        theta=np.array([2.0, 1.0]),
        initial=evaluated(model, initial, 1.0),
        final=evaluated(model, final, 16.0),
        history=history,
        slope=0.01,
        steps=200,
        seconds=0.2,
        limits={"position": -0.1, "control": 2.0},
        warnings=("the two parameters are nearly confounded",),
        found_by="multisine 2",
        starts=(
            StartResult(name="initial", cost=9.0, status=Status.STALLED, iterations=5),
            StartResult(name="multisine 2", cost=0.125, status=Status.CONVERGED, iterations=3),
        ),
    )


def estimated(model: mujoco.MjModel, trajectory: Trajectory) -> Estimate:
    """Make an estimate from two recordings by hand; one sample of one output is missing."""
    outputs = ("qpos:slide", "hinge_angle")
    predicted = trajectory.qpos[:, :2]
    y = predicted + 0.01
    y[3, 0] = np.nan
    recordings = tuple(
        Recording(t=trajectory.t, ctrl=trajectory.ctrl, y=y, outputs=outputs, name=f"run {k}")
        for k in range(2)
    )
    return Estimate(
        parameters=("mass", "gear/ratio"),
        theta=np.array([2.0, 1.0]),
        std=np.array([0.1, 0.2]),
        covariance=np.diag([0.01, 0.04]),
        initial_theta=np.array([2.5, 1.4]),
        chi2=500.0,
        dof=80,
        status="the residuals no longer fall",
        success=True,
        misfit=True,
        iterations=4,
        residual_rms={"qpos:slide": 0.01, "hinge_angle": 0.01},
        at_bound=("mass",),
        predicted=(predicted, predicted),
        recordings=recordings,
    )


def entities(path: Path) -> set[str]:
    """Return every entity path in a recording."""
    return {str(chunk.entity_path) for chunk in RrdReader(path).stream().to_chunks()}


def column(
    path: Path, at: tuple[str, ...], timeline: str | None, component: str
) -> tuple[Any, Array]:
    """Return times and values of one component of one entity; without a timeline, those of static
    data.
    """
    times: list[int] = []
    values: list[Any] = []
    for chunk in RrdReader(path).stream().filter(content=entity_path(at)).to_chunks():
        batch = chunk.to_record_batch()
        if component in batch.schema.names and (
            timeline in batch.schema.names or (timeline is None and chunk.is_static)
        ):
            values += batch.column(component).to_pylist()
            times += batch.column(timeline).cast("int64").to_pylist() if timeline else []
    order = np.argsort(times, kind="stable") if timeline else slice(None)
    return np.array(times)[order], np.array(values)[order]


def blueprint_column(path: Path, component: str) -> dict[str, Any]:
    """Return one component of the blueprint by entity."""
    reader = RrdReader(path)
    found = {}
    for chunk in reader.stream(store=reader.blueprints()[0]).to_chunks():
        batch = chunk.to_record_batch()
        if component in batch.schema.names:
            found[str(chunk.entity_path)] = batch.column(component).to_pylist()[0]
    return found


def origins_of_views(path: Path) -> list[tuple[str, str]]:
    """Return the class and the origin of each view."""
    origins = blueprint_column(path, "ViewBlueprint:space_origin")
    classes = blueprint_column(path, "ViewBlueprint:class_identifier")
    return [(classes[view][0], origin[0]) for view, origin in origins.items()]


def ranges_of_views(path: Path) -> dict[str, tuple[float, float]]:
    """Return the range of values of each plot of series, by its origin."""
    origins = blueprint_column(path, "ViewBlueprint:space_origin")
    ranges = blueprint_column(path, "ScalarAxis:range")
    return {
        origins[axis.removesuffix("/ScalarAxis")][0]: tuple(limits[0])
        for axis, limits in ranges.items()
    }


def shown_on_timelines(path: Path) -> dict[str, set[str]]:
    """Return the timelines on which each entity has data that can be drawn, or "static".

    Limits, the edges of bands and the room behind the last sample are nothing by themselves.
    """
    drawn = ("Scalars:scalars", "LineStrips", "Points2D:positions", "half_sizes", "Mesh3D")
    shown: dict[str, set[str]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        names = chunk.to_record_batch().schema.names
        if str(chunk.entity_path).endswith(BESIDE):
            continue
        if any(word in name for word in drawn for name in names) or "TextDocument:text" in names:
            timelines = {"static"} if chunk.is_static else {"sim_time", "iteration"} & set(names)
            shown.setdefault(str(chunk.entity_path), set()).update(timelines)
    return shown


def panels_without_data(path: Path, timelines: tuple[str, ...]) -> list[tuple[str, str, str]]:
    """Return class, origin and timeline of each view that would be empty on a timeline."""
    shown = shown_on_timelines(path)
    empty = []
    for view, origin in origins_of_views(path):
        for timeline in timelines:
            permitted = {timeline} if view == "TimeSeries" else {timeline, "static"}
            if not any(
                permitted & found
                for entity, found in shown.items()
                if entity == origin or entity.startswith(f"{origin}/")
            ):
                empty.append((view, origin, timeline))
    return empty


def series_of(path: Path) -> dict[str, Array]:
    """Return the values of every series on `sim_time`, by entity.

    Behind the last sample of each plot there are two without a value, for the numbers of the axis.
    """
    series: dict[str, list[Any]] = {}
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        if {"Scalars:scalars", "sim_time"} <= set(batch.schema.names):
            rows = batch.column("Scalars:scalars").to_pylist()
            series.setdefault(str(chunk.entity_path), []).extend(rows)
    found = {entity: np.array(rows) for entity, rows in series.items()}
    rooms = {entity for entity in found if entity.endswith(f"/{ROOM}")}
    assert all(np.isnan(found[entity]).all() and len(found[entity]) == 2 for entity in rooms)
    return {entity: values for entity, values in found.items() if entity not in rooms}


def assert_series_show(path: Path, sources: dict[tuple[str, ...], Array]) -> None:
    """Check that each logged series is finite and varies where its source does.

    Args:
        path: The recording.
        sources: (n,) values of the sources by entity; a source without finite values has no series.
    """
    logged = series_of(path)
    assert logged
    for entity, values in logged.items():
        assert np.isfinite(values).all(), entity

    for parts, source in sources.items():
        known = source[np.isfinite(source)]
        found = logged.get(entity_path(parts))
        if not len(known):
            assert found is None, parts
            continue
        assert found is not None, parts
        assert (np.ptp(found) > 0.0) == (np.ptp(known) > 0.0), parts
        assert (found.min(), found.max()) == (known.min(), known.max()), parts


def state_sources(
    model: mujoco.MjModel, name: str, trajectory: Trajectory
) -> dict[tuple[str, ...], Array]:
    """Return the columns of a trajectory by the entities of its series."""
    labels = labels_of_model(model)
    columns = {
        "positions": (labels.positions, dof_positions(model, trajectory.qpos)),
        "velocities": (labels.velocities, trajectory.qvel),
        "controls": (labels.controls, trajectory.ctrl),
    }
    return {
        (group, label, name): values[:, k]
        for group, (titles, values) in columns.items()
        for k, label in enumerate(titles)
    }


@pytest.fixture(scope="module")
def cart() -> mujoco.MjModel:
    """The paper's model."""
    return load("cart")


@pytest.fixture(scope="module")
def design(cart: mujoco.MjModel) -> Design:
    """A hand-made design on the paper's model."""
    return designed(cart)


@pytest.fixture(scope="module")
def file(cart: mujoco.MjModel, design: Design, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recording of the design, in a folder that does not exist yet."""
    path = tmp_path_factory.mktemp("rerun") / "new" / "design.rrd"
    log_design(path, cart, design, labels_of_model(cart), addition="| a caller's | table |")
    return path


class TestDesign:
    """Contents of design.rrd."""

    def test_file_holds_both_robots_and_every_panel(self, file: Path) -> None:
        expected = [
            ("summary",),
            ("phase", "gear/ratio", "axes"),
            ("history", "log10 cost", "curve"),
            ("history", "step length", "now"),
            ("iterates", "slide [m]", "iterate"),
            ("limits", "position", "slide"),
        ]
        for key in ("initial", "designed"):
            expected += [
                ("robots", key, "bodies", "bob"),
                ("robots", key, "bodies", "bob", "bob"),
                ("robots", key, "path"),
            ]
            expected += [
                ("positions", "slide [m]", key),
                ("velocities", "hinge velocity [rad/s]", key),
            ]
            expected += [
                ("controls", "force [N]", key),
                ("information", key),
                ("phase", "mass", key, "now"),
            ]
        assert {entity_path(path) for path in expected} <= entities(file)

    def test_file_has_no_warnings_and_one_blueprint(self, file: Path) -> None:
        assert not [path for path in entities(file) if "__warnings" in path]
        assert len(RrdReader(file).recordings()) == 1
        assert len(RrdReader(file).blueprints()) == 1

    def test_every_view_shows_an_entity_with_data(self, file: Path) -> None:
        origins = {origin for _, origin in origins_of_views(file)}
        logged = entities(file)
        assert len(origins) >= 16
        for origin in origins:
            assert any(path == origin or path.startswith(f"{origin}/") for path in logged), origin

    @pytest.mark.parametrize("key", ["initial", "designed"])
    def test_series_are_exact(self, file: Path, design: Design, key: str) -> None:
        side = design.initial if key == "initial" else design.final
        nanoseconds = np.rint(side.trajectory.t * 1e9).astype(np.int64)
        columns = {
            ("positions", "hinge [rad]"): side.trajectory.qpos[:, 1],
            ("velocities", "slide velocity [m/s]"): side.trajectory.qvel[:, 0],
            ("controls", "force [N]"): side.trajectory.ctrl[:, 0],
            ("information",): np.sqrt(side.min_eigenvalue),
        }
        for path, expected in columns.items():
            times, values = column(file, (*path, key), "sim_time", "Scalars:scalars")
            np.testing.assert_array_equal(times, nanoseconds[: len(expected)])
            np.testing.assert_array_equal(values[:, 0], expected)

    def test_poses_are_those_of_mujoco(
        self, file: Path, cart: mujoco.MjModel, design: Design
    ) -> None:
        data = mujoco.MjData(cart)
        path = ("robots", "designed", "bodies", "bob")
        times, translation = column(file, path, "sim_time", "Transform3D:translation")
        _, quaternion = column(file, path, "sim_time", "Transform3D:quaternion")
        assert len(times) == len(design.trajectory.t)
        for k, q in enumerate(design.trajectory.qpos):
            data.qpos[:] = q
            mujoco.mj_forward(cart, data)
            np.testing.assert_allclose(translation[k, 0], data.body("bob").xpos, atol=1e-6)
            np.testing.assert_allclose(
                np.roll(quaternion[k, 0], 1), data.body("bob").xquat, atol=1e-6
            )

    def test_line_is_the_path_of_the_bob(self, file: Path) -> None:
        _, translation = column(
            file, ("robots", "initial", "bodies", "bob"), "sim_time", "Transform3D:translation"
        )
        strip = column(file, ("robots", "initial", "path"), None, "LineStrips3D:strips")[1][0, 0]
        np.testing.assert_allclose(strip, translation[:, 0], atol=1e-6)

    def test_moving_bodies_have_no_static_pose_and_show_on_both_timelines(
        self, file: Path, design: Design
    ) -> None:
        for name, iterations in (("initial", [0]), ("designed", [0, 1, 2])):
            path = ("robots", name, "bodies", "cart")
            assert len(column(file, path, None, "Transform3D:translation")[1]) == 0
            shown, _ = column(file, path, "iteration", "Transform3D:translation")
            assert list(shown) == iterations

    def test_iterates_repeat_the_robot_along_their_motion(
        self, file: Path, cart: mujoco.MjModel, design: Design
    ) -> None:
        """Poses of the bob at each iterate, in its frame at the begin of the motion."""
        assert design.motions is not None
        bob = ("robots", "designed", "bodies", "bob")
        _, begin = column(file, bob, "iteration", "Transform3D:translation")
        _, turned = column(file, bob, "iteration", "Transform3D:quaternion")
        at = (*bob, "bob")
        _, place = column(file, at, None, "Transform3D:translation")
        iterations, shifts = column(file, at, "iteration", "InstancePoses3D:translations")
        assert list(iterations) == [0, 1, 2]
        assert shifts.shape[1] == POSES

        data = mujoco.MjData(cart)
        geom = cart.geom("bob").id
        rows = np.linspace(0, MOTION_SAMPLES - 1, POSES).round().astype(int)
        for k in range(3):
            for shift, q in zip(shifts[k], design.motions.qpos[k, rows], strict=True):
                data.qpos[:] = q
                mujoco.mj_kinematics(cart, data)
                end = np.empty(3)
                wxyz = np.roll(turned[k, 0], 1).astype(np.float64)
                mujoco.mju_rotVecQuat(end, np.asarray(place[0, 0] + shift, dtype=float), wxyz)
                np.testing.assert_allclose(begin[k, 0] + end, data.geom_xpos[geom], atol=1e-5)

    def test_path_and_curves_morph_with_the_iteration(self, file: Path) -> None:
        path = ("robots", "designed", "path")
        iterations, strips = column(file, path, "iteration", "LineStrips3D:strips")
        assert list(iterations) == [0, 1, 2]
        lengths = [np.ptp(np.array(strip[0]), axis=0).max() for strip in strips]
        assert lengths[0] < 0.5 * lengths[2]

        curve = ("iterates", "slide [m]", "iterate")
        heights = [
            np.ptp(np.array(strip[0])[:, 1])
            for strip in column(file, curve, "iteration", "LineStrips2D:strips")[1]
        ]
        assert heights[0] < 0.5 * heights[2]

        # On the other timeline, the last iterate is drawn.
        shown = column(file, curve, "sim_time", "LineStrips2D:strips")[1]
        assert np.ptp(np.array(shown[0][0])[:, 1]) == pytest.approx(heights[2])

    def test_history_is_static_with_a_line_at_the_iteration(
        self, file: Path, design: Design
    ) -> None:
        at = ("history", "log10 cost")
        curve = np.array(column(file, (*at, "curve"), None, "LineStrips2D:strips")[1][0, 0])
        costs = np.log10([row.cost for row in design.history])
        shares = (curve[:, 1] - curve[0, 1]) / (curve[-1, 1] - curve[0, 1])
        expected = (costs - costs[0]) / (costs[-1] - costs[0])
        np.testing.assert_allclose(shares, expected, atol=1e-6)

        _, texts = column(file, (*at, "numbers"), None, "Points2D:labels")
        _, places = column(file, (*at, "numbers"), None, "Points2D:positions")
        below = np.array(places[0])[:, 0] >= 0.0
        assert list(np.array(texts[0])[below]) == ["0", "1", "2"]

        iterations, lines = column(file, (*at, "now"), "iteration", "LineStrips2D:strips")
        assert list(iterations) == [0, 1, 2]
        assert [np.array(line[0])[0, 0] for line in lines] == pytest.approx(curve[:, 0].tolist())

    def test_limits_are_lines_on_both_timelines(self, file: Path) -> None:
        for timeline in ("sim_time", "iteration"):
            at = ("positions", "slide [m]", "upper limit")
            values = column(file, at, timeline, "Scalars:scalars")[1]
            np.testing.assert_array_equal(values[:, 0], [1.5, 1.5])
        at = ("controls", "force [N]", "lower limit")
        assert entity_path(at) not in entities(file)

    def test_every_panel_has_something_to_show_on_each_timeline(self, file: Path) -> None:
        assert not panels_without_data(file, ("sim_time", "iteration"))

    def test_limits_of_each_kind_have_their_own_curve_over_the_iterations(
        self, cart: mujoco.MjModel, design: Design
    ) -> None:
        (position,) = design.usage
        force = replace(position, kind="force", name="motor")
        usage = (position, force, replace(force, kind="clearance", lower=0.1))
        margins = [{"position": 0.5, "force": 0.1 * k, "clearance": 1.0} for k in range(3)]
        rows = [
            replace(row, margins=each) for row, each in zip(design.history, margins, strict=True)
        ]
        iterates = IterateCurves.of(cart, design)
        plots = usage_plots(replace(design, usage=usage, history=tuple(rows)), iterates)
        shares = [plot.curves[-1].values for plot in plots]
        np.testing.assert_allclose(shares, [[50.0] * 3, [100.0, 90.0, 80.0], [50.0] * 3])

        # Without margins, that of a position is read from the motions; a force is not in them.
        plots = usage_plots(replace(design, usage=usage[:2]), iterates)
        assert design.motions is not None
        slide = np.abs(design.motions.qpos[:, :, 0]).max(axis=1) / 1.5
        np.testing.assert_allclose(plots[0].curves[-1].values, 100.0 * slide, rtol=1e-6)
        assert np.ptp(plots[1].curves[-1].values) == 0.0
        assert plots[1].curves[-1].legend == ("largest of the designed trajectory",)

    def test_limits_name_the_curves_that_are_closest_to_a_bound(
        self, cart: mujoco.MjModel, design: Design
    ) -> None:
        (used,) = design.usage
        uses = tuple(
            replace(used, name=f"joint{k}", share=np.full(len(used.t), 0.1 * k)) for k in range(9)
        )
        (plot,) = usage_plots(replace(design, usage=uses), None)
        named = {name for curve in plot.curves[:-1] for name in curve.names}
        assert named == {"others", "joint6, 60 %", "joint7, 70 %", "joint8, 80 %"}

    def test_in_the_view_of_both_robots_the_initial_one_is_translucent(self, file: Path) -> None:
        looks = blueprint_column(file, "Ellipsoids3D:colors")
        (path,) = [entity for entity in looks if "/initial/bodies/bob/bob/" in entity]
        opacity = int(looks[path][0]) & 255
        _, (colours,) = column(
            file, ("robots", "initial", "bodies", "bob", "bob"), None, "Ellipsoids3D:colors"
        )
        assert 0 < opacity < int(colours[0]) & 255
        assert not [entity for entity in looks if "designed" in entity]

    def test_the_last_number_of_the_time_has_room(self, file: Path, design: Design) -> None:
        times, values = column(
            file, ("positions", "hinge [rad]", ROOM), "sim_time", "Scalars:scalars"
        )
        end = design.trajectory.t[-1]
        np.testing.assert_allclose(times * 1e-9, [end, (1.0 + TIME_ROOM) * end], rtol=1e-9)
        assert np.isnan(values).all()

    @pytest.mark.parametrize("kept", [("motions",), ("history",), ()])
    def test_panels_have_data_without_motions_or_history(
        self, cart: mujoco.MjModel, design: Design, tmp_path: Path, kept: tuple[str, ...]
    ) -> None:
        motions = design.motions if "motions" in kept else None
        history = design.history if "history" in kept else ()
        path = tmp_path / "design.rrd"
        shown = replace(design, motions=motions, history=history)
        log_design(path, cart, shown, labels_of_model(cart))
        timelines = ("sim_time", "iteration") if history else ("sim_time",)
        assert not panels_without_data(path, timelines)

    def test_every_plot_of_series_has_a_range(self, file: Path, design: Design) -> None:
        ranges = ranges_of_views(file)
        assert len(ranges) >= 7
        low, high = ranges[entity_path(("positions", "hinge [rad]"))]
        for evaluation in (design.initial, design.final):
            assert low < evaluation.trajectory.qpos[:, 1].min()
            assert high > evaluation.trajectory.qpos[:, 1].max()

    def test_summary_holds_outcome_accuracy_warnings_and_starts(self, file: Path) -> None:
        text = str(column(file, ("summary",), None, "TextDocument:text")[1][0, 0])
        assert "Stopped at its budget (max_iterations" in text
        assert "| mass | 2 | 0.5 | 25 % | 0.0312 | 1.6 % | ÷ 16.0 |" in text
        assert "it violates limits (position)" in text
        assert "nearly confounded" in text
        assert "the best one: multisine 2" in text
        assert "a caller's" in text

    def test_phase_plots_share_one_scale(self, file: Path) -> None:
        peak = {}
        for key in ("initial", "designed"):
            values = column(file, ("phase", "mass", key, "now"), "sim_time", "Points2D:positions")[
                1
            ]
            peak[key] = np.abs(values[:, 0]).max(axis=0)
        np.testing.assert_allclose(peak["designed"], [1.5, 1.0], rtol=1e-6)
        np.testing.assert_allclose(peak["initial"], [1.5 / 16, 1.0 / 16], rtol=1e-6)

    def test_file_is_replaced_only_when_the_new_one_is_complete(
        self, cart: mujoco.MjModel, design: Design, tmp_path: Path
    ) -> None:
        path = tmp_path / "design.rrd"
        path.write_text("old")

        class FailingHistory(tuple[HistoryRow, ...]):
            """A history that cannot be read."""

            def __iter__(self) -> Iterator[HistoryRow]:
                raise RuntimeError("disk full")

        failing = replace(design, history=FailingHistory(design.history))
        with pytest.raises(RuntimeError, match="disk full"):
            log_design(path, cart, failing, labels_of_model(cart))
        assert path.read_text() == "old"
        assert list(tmp_path.iterdir()) == [path]

    def test_design_without_history_and_with_infinite_sigma_is_logged(
        self, cart: mujoco.MjModel, design: Design, tmp_path: Path
    ) -> None:
        blind = replace(design.initial, std=np.array([np.inf, 0.1]), min_eigenvalue=np.zeros(41))
        path = tmp_path / "design.rrd"
        log_design(path, cart, replace(design, initial=blind, history=()), labels_of_model(cart))
        assert entity_path(("information", "initial")) in entities(path)


def flight(model: mujoco.MjModel) -> Trajectory:
    """Simulate a quadrotor that moves 20 m besides."""
    trajectory = simulated(model, 0.5, samples=100)
    qpos = np.array(trajectory.qpos)
    qpos[:, 0] += np.linspace(0.0, 20.0, len(qpos))
    return replace(trajectory, qpos=qpos)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> tuple[mujoco.MjModel, Path]:
    """Replay of the flight of a quadrotor."""
    model = load("quadrotor")
    path = tmp_path_factory.mktemp("free") / "replay.rrd"
    still = simulated(model, 0.5, samples=100)
    trajectories = {"initial": still, "final": flight(model)}
    log_trajectories(path, model, trajectories, labels_of_model(model))
    return model, path


class TestFreeBody:
    """A body that flies away."""

    def test_series_vary_where_their_sources_do(self, flown: tuple[mujoco.MjModel, Path]) -> None:
        model, path = flown
        assert_series_show(path, state_sources(model, "designed", flight(model)))

    def test_the_camera_follows_a_shape_of_the_body(
        self, flown: tuple[mujoco.MjModel, Path]
    ) -> None:
        _, path = flown
        tracked = blueprint_column(path, "EyeControls3D:tracking_entity")
        followed = {names[0] for names in tracked.values()}
        assert len(followed) == len(tracked) == 2
        for name in ("initial", "designed"):
            body = entity_path(("robots", name, "bodies", "quadrotor"))
            (shape,) = (entity for entity in followed if entity.startswith(f"{body}/"))
            assert shape in entities(path)

    def test_the_view_of_both_robots_stands_still(self, flown: tuple[mujoco.MjModel, Path]) -> None:
        """A view that is opened while a body flies would begin in a wrong place."""
        _, path = flown
        places = blueprint_column(path, "EyeControls3D:position")
        tracked = blueprint_column(path, "EyeControls3D:tracking_entity")
        assert len(places) == 3 and len(set(places) - set(tracked)) == 1


@pytest.mark.parametrize("name", ["acrobot", "panda", "panda without geoms", "zoo", "release"])
class TestAnyModel:
    """Recordings of other models than the paper's, two of them without actuators."""

    def test_design_of_any_model_is_logged(self, name: str, tmp_path: Path) -> None:
        model = load(name)
        path = tmp_path / "design.rrd"
        log_design(path, model, designed(model), labels_of_model(model))
        logged = entities(path)
        assert not panels_without_data(path, ("sim_time", "iteration"))
        assert not [entry for entry in logged if "__warnings" in entry]
        for key in ("initial", "designed"):
            bodies = [model.body(b).name or f"body{b}" for b in range(1, model.nbody)]
            assert {entity_path(("robots", key, "bodies", body)) for body in bodies} <= logged

    def test_labels_count_degrees_of_freedom(self, name: str, tmp_path: Path) -> None:
        model = load(name)
        names = labels_of_model(model)
        assert (len(names.positions), len(names.velocities), len(names.controls)) == (
            model.nv,
            model.nv,
            model.nu,
        )
        assert len(set(names.positions)) == model.nv

    def test_camera_sees_every_moving_body(self, name: str, tmp_path: Path) -> None:
        model = load(name)
        trajectory = simulated(model, 1.0)
        poses = body_poses(model, trajectory.t, trajectory.qpos)
        eye = place_camera(model, [poses], views=1, aspect=1.3)
        towards = np.subtract(eye.target, eye.position)
        moving = np.flatnonzero(model.body_weldid)
        ray = poses.positions[:, moving] - np.array(eye.position)
        cosine = ray @ towards / np.linalg.norm(towards) / np.linalg.norm(ray, axis=2)
        assert np.degrees(np.arccos(cosine.min())) < 40.0

    def test_camera_is_as_near_as_the_motion_permits(self, name: str) -> None:
        """Something moving is at an edge of the picture, and nothing is beyond it."""
        model = load(name)
        trajectory = simulated(model, 1.0)
        poses = body_poses(model, trajectory.t, trajectory.qpos)
        eye = place_camera(model, [poses], views=1, aspect=1.3, follow=False)
        towards = np.subtract(eye.position, eye.target)
        distance = np.linalg.norm(towards)
        points = seen_points(model, moving_points(model, [poses]))
        seen = (points - eye.target) @ camera_axes(towards / distance).T
        slope = np.tan(FIELD_OF_VIEW / 2.0)
        places = np.abs(seen[:, :2] / (distance - seen[:, 2:]) / slope / [1.3, 1.0])
        assert places.max() == pytest.approx(1.0, abs=1e-6)


@pytest.fixture(scope="module")
def zoo_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Replay of the model with every type of geom."""
    model = load("zoo")
    path = tmp_path_factory.mktemp("zoo") / "zoo.rrd"
    log_trajectories(path, model, {"initial": simulated(model, 0.0)}, labels_of_model(model))
    return path


class TestShapes:
    """Archetypes of geoms of every type."""

    def geom(self, path: Path, body: str, geom: str, component: str) -> Array:
        """First row of a static component of a geom."""
        return np.array(
            column(path, ("robots", "initial", "bodies", body, geom), None, component)[1][0]
        )

    def test_mesh_keeps_the_compiled_vertices_and_flat_normals(self, zoo_file: Path) -> None:
        model = load("zoo")
        vertices = self.geom(zoo_file, "rock", "rock", "Mesh3D:vertex_positions")
        triangles = self.geom(zoo_file, "rock", "rock", "Mesh3D:triangle_indices").reshape(-1, 3)
        assert triangles.shape == (4, 3)
        assert len(vertices) == len(np.unique(triangles))
        corners = {tuple(np.round(v, 6)) for v in vertices}
        assert corners == {tuple(np.round(v, 6)) for v in model.mesh_vert.astype(float)}

    def test_height_field_has_heights_where_mujoco_has_them(self, zoo_file: Path) -> None:
        vertices = self.geom(zoo_file, "world", "hills", "Mesh3D:vertex_positions")
        model, data = load("zoo"), mujoco.MjData(load("zoo"))
        mujoco.mj_kinematics(model, data)
        for x, y, z in vertices:
            start = np.array([0.99 * x, 1.0 + 0.99 * y, 2.0])
            hit = mujoco.mj_ray(
                model, data, start, np.array([0.0, 0.0, -1.0]), None, 1, -1, np.zeros(1, np.int32)
            )
            assert 2.0 - hit == pytest.approx(z, abs=0.02)

    def test_capsule_is_centred_on_its_frame(self, zoo_file: Path) -> None:
        assert self.geom(zoo_file, "a/b c", "limb", "Capsules3D:lengths")[0] == pytest.approx(0.5)
        model = load("zoo")
        limb = model.geom("limb").id

        # The capsule of Rerun begins at its origin and runs along z.
        to_middle = np.empty(3)
        mujoco.mju_rotVecQuat(to_middle, np.array([0.0, 0.0, 0.25]), model.geom_quat[limb])
        begin = self.geom(zoo_file, "a/b c", "limb", "Transform3D:translation")[0]
        np.testing.assert_allclose(begin + to_middle, model.geom_pos[limb], atol=1e-7)

    def test_bodies_without_geoms_become_sticks(self, zoo_file: Path) -> None:
        assert self.geom(zoo_file, "bare", "stick 6", "Capsules3D:lengths")[0] == pytest.approx(
            np.hypot(0.3, 0.5)
        )

    def test_fixed_bodies_have_one_static_pose(self, zoo_file: Path) -> None:
        path = ("robots", "initial", "bodies", "fixed")
        np.testing.assert_allclose(
            column(zoo_file, path, None, "Transform3D:translation")[1][0, 0], [0, -1, 0]
        )

    def test_planes_are_large_boards(self, zoo_file: Path) -> None:
        vertices = self.geom(zoo_file, "world", "floor", "Mesh3D:vertex_positions")
        extent = load("zoo").stat.extent
        assert np.abs(vertices).max() == pytest.approx(INFINITE_REACH * extent, rel=1e-6)


class TestEstimate:
    """Contents of estimate.rrd."""

    def test_measured_and_predicted_outputs_and_their_difference(
        self, cart: mujoco.MjModel, tmp_path: Path
    ) -> None:
        path, trajectory = tmp_path / "estimate.rrd", simulated(cart, 2.0)
        estimate = estimated(cart, trajectory)
        log_estimate(path, cart, estimate, trajectory, trajectory, labels_of_model(cart))
        at = ("recording 1", "qpos:slide [m]")
        times, values = column(path, ("outputs", *at, "measured"), "sim_time", "Scalars:scalars")
        kept = np.isfinite(estimate.recordings[0].y[:, 0])
        assert len(times) == 40
        np.testing.assert_array_equal(values[:, 0], estimate.recordings[0].y[kept, 0])
        residual = column(path, ("residuals", *at, "difference"), "sim_time", "Scalars:scalars")[1][
            :, 0
        ]
        np.testing.assert_allclose(residual, 0.01, atol=1e-12)
        assert entity_path(
            ("outputs", "recording 2", "hinge_angle [rad]", "identified")
        ) in entities(path)

    def test_a_velocity_that_was_not_measured_has_no_series(
        self, cart: mujoco.MjModel, tmp_path: Path
    ) -> None:
        path, predicted = tmp_path / "estimate.rrd", simulated(cart, 2.0)
        qvel = np.array(predicted.qvel)
        qvel[:, 0] = np.nan
        measured = replace(predicted, qvel=qvel)
        estimate = estimated(cart, predicted)
        labels = labels_of_model(cart)
        log_estimate(path, cart, estimate, measured, predicted, labels)

        slide, hinge = (("velocities", label) for label in labels.velocities)
        assert entity_path((*slide, "measured")) not in entities(path)
        assert entity_path((*slide, "identified")) in entities(path)
        _, values = column(path, (*hinge, "measured"), "sim_time", "Scalars:scalars")
        np.testing.assert_array_equal(values[:, 0], qvel[:, 1])

    def test_measured_robot_is_an_outline(self, cart: mujoco.MjModel, tmp_path: Path) -> None:
        path, trajectory = tmp_path / "estimate.rrd", simulated(cart, 2.0)
        log_estimate(
            path, cart, estimated(cart, trajectory), trajectory, trajectory, labels_of_model(cart)
        )
        fill = {}
        for key in ("measured", "identified"):
            at = ("robots", key, "bodies", "bob", "bob")
            fill[key] = int(column(path, at, None, "Ellipsoids3D:fill_mode")[1][0, 0])
        assert fill["measured"] == OUTLINE.value
        assert fill["identified"] == SOLID.value

    def test_held_out_recordings_and_the_band_of_the_noise_are_shown(
        self, cart: mujoco.MjModel, tmp_path: Path
    ) -> None:
        path, trajectory = tmp_path / "estimate.rrd", simulated(cart, 2.0)
        estimate = estimated(cart, trajectory)
        recording = replace(estimate.recordings[1], name="apart/run 7")
        errors = PredictionErrors(
            name=recording.name, outputs=recording.outputs, rms=np.ones(2), mae=np.ones(2)
        )
        prediction = Prediction(
            name=recording.name,
            identified=errors,
            nominal=errors,
            held_out=True,
            recording=recording,
            identified_outputs=estimate.predicted[1] + 0.001,
            nominal_outputs=1.5 * estimate.predicted[1],
        )
        shown = replace(estimate, predictions=(prediction,), sigma={"qpos:slide": 0.02})
        log_estimate(path, cart, shown, None, trajectory, labels_of_model(cart))

        sources = {}
        for column_of, output in enumerate(("qpos:slide [m]", "hinge_angle [rad]")):
            at = ("outputs", "held out 1", output)
            sources[*at, "measured"] = recording.y[:, column_of]
            sources[*at, "identified"] = prediction.identified_outputs[:, column_of]
            sources[*at, "nominal"] = prediction.nominal_outputs[:, column_of]
        assert_series_show(path, sources)

        band = series_of(path)[entity_path(("outputs", "held out 1", "qpos:slide [m]", "band"))]
        expected = prediction.identified_outputs[:, :1] + [[-0.04, 0.04]]
        np.testing.assert_allclose(band, expected, rtol=0, atol=1e-12)
        assert not [entry for entry in entities(path) if "hinge_angle" in entry and "band" in entry]
        names = blueprint_column(path, "ContainerBlueprint:display_name")
        assert ["held out: run 7"] in names.values()
        assert not panels_without_data(path, ("sim_time",))

    def test_a_band_that_would_cover_the_curves_is_drawn_beside_the_residuals_only(
        self, cart: mujoco.MjModel
    ) -> None:
        trajectory = simulated(cart, 2.0)
        estimate = replace(estimated(cart, trajectory), sigma={"qpos:slide": 1e-4})
        shown, residual = output_plots(cart, estimate)[0].pairs[0]
        drawn = [{c.name for c in p.curves if c.finite.any()} for p in (shown, residual)]
        assert "band" not in drawn[0] and "band" in drawn[1]

    def test_many_recordings_share_two_tabs(self, cart: mujoco.MjModel) -> None:
        recordings = output_plots(cart, estimated(cart, simulated(cart, 2.0)))
        others = ["positions", "velocities", "controls"]
        assert len(recording_tabs(recordings, [], others)) == 2
        many = recording_tabs(4 * recordings, recordings, others)
        assert [tab.name for tab in many] == ["recordings", "held out"]

    @pytest.mark.parametrize("speed", ["measured", "partly measured", "not measured"])
    def test_series_vary_where_their_sources_do(
        self, cart: mujoco.MjModel, tmp_path: Path, speed: str
    ) -> None:
        path, identified = tmp_path / "estimate.rrd", simulated(cart, 2.0)
        qvel = np.array(identified.qvel)
        qvel[:, {"measured": [], "partly measured": [0], "not measured": [0, 1]}[speed]] = np.nan
        measured = replace(identified, qvel=qvel)
        labels = labels_of_model(cart)
        log_estimate(path, cart, estimated(cart, identified), measured, identified, labels)
        assert not panels_without_data(path, ("sim_time",))
        sources = {
            **state_sources(cart, "identified", identified),
            **state_sources(cart, "measured", measured),
        }
        assert_series_show(path, sources)

    def test_without_measured_positions_there_is_no_measured_robot(
        self, cart: mujoco.MjModel, tmp_path: Path
    ) -> None:
        path, trajectory = tmp_path / "estimate.rrd", simulated(cart, 2.0)
        log_estimate(
            path,
            cart,
            estimated(cart, trajectory),
            None,
            trajectory,
            labels_of_model(cart),
            addition="see the report",
        )
        assert not [entry for entry in entities(path) if entry.startswith("/robots/measured")]
        assert not panels_without_data(path, ("sim_time",))
        text = str(column(path, ("summary",), None, "TextDocument:text")[1][0, 0])
        assert "not explained by noise: the formal σ underestimates the errors" in text
        assert "see the report" in text


class TestLabels:
    """Labels with names and units, and the series of a history."""

    def test_units_follow_joints_and_plain_actuators(self, cart: mujoco.MjModel) -> None:
        names = labels_of_model(cart)
        assert names.positions == ("slide [m]", "hinge [rad]")
        assert names.velocities == ("slide velocity [m/s]", "hinge velocity [rad/s]")
        assert names.controls == ("force [N]",)

    def test_labels_of_outputs_have_units(self, cart: mujoco.MjModel) -> None:
        assert output_label(cart, "qvel:hinge") == "qvel:hinge [rad/s]"
        assert output_label(cart, "slide_velocity") == "slide_velocity [m/s]"
        assert output_label(cart, "something else") == "something else"

    def test_a_constant_and_a_limit_have_a_range(self) -> None:
        assert padded(2.0, 2.0) == (1.0, 3.0)
        assert padded(0.0, 0.0) == (-1.0, 1.0)
        assert padded(np.inf, -np.inf) == (-1.0, 1.0)
        low, high = padded(0.0, 1e-12)
        assert low < 0.0 and 1e-12 < high < 2e-12

    def test_a_limit_far_away_stands_in_the_title(self) -> None:
        curve = Curve(
            name="slide", t=np.array([0.0, 1.0]), values=np.array([0.0, 1.0]), colour=(0, 0, 0)
        )
        far = 2.0 * LARGEST_ZOOM
        plots = [
            SeriesPlot(parts=("a",), title="slide [m]", curves=[curve], limits=(-np.inf, limit))
            for limit in (2.0, far)
        ]
        assert plots[0].range[1] > 2.0 and plots[0].full_title == "slide [m]"
        assert plots[1].range[1] < 2.0 and plots[1].full_title == f"slide [m], limits {far:.3g}"

    def test_every_range_has_at_least_two_and_at_most_the_permitted_numbers(self) -> None:
        rng = np.random.default_rng(0)
        for _ in range(200):
            low = rng.normal() * 10.0 ** rng.uniform(-3.0, 3.0)
            high = low + 10.0 ** rng.uniform(-6.0, 6.0)
            most = int(rng.integers(4, 9))
            assert 2 <= len(round_numbers(low, high, most)) <= most
        assert len(round_numbers(-0.41, 0.41, 4)) == 3

    def test_a_low_plot_has_two_numbers_beside_its_axis(self) -> None:
        """The viewer writes multiples of a power of ten that are far enough from each other."""
        assert with_two_numbers(-0.3, 8.2, 100.0) == (-0.3, pytest.approx(10.0, abs=0.5))
        assert with_two_numbers(11.0, 19.0, 100.0) == pytest.approx((10.0, 20.0), abs=0.5)
        for height in (170.0, 280.0):
            assert with_two_numbers(-0.3, 0.25, height) == (-0.3, 0.25)
        assert with_two_numbers(-4.9, 4.9, 100.0) == (-4.9, 4.9), "it would be too low then"

    def test_the_legend_stands_where_it_covers_least(self) -> None:
        t = np.linspace(0.0, 1.0, 50)
        for values, corner in (
            (1.0 - t, rrb.Corner2D.RightTop),
            (t, rrb.Corner2D.LeftTop),
            (1.0 - 0.2 * np.abs(t - 0.5), rrb.Corner2D.LeftBottom),
        ):
            curves = [
                Curve(name="a", t=t, values=values, colour=(0, 0, 0)),
                Curve(name="low", t=t, values=np.where(t == t[-1], -1.0, np.nan), colour=(0, 0, 0)),
            ]
            plot = SeriesPlot(parts=("a",), title="a", curves=curves)
            assert plot.emptiest_corner == corner

    def test_legends_of_limits_stand_behind_the_curves(self) -> None:
        """The plots of the limits keep one axis of time."""
        t = np.linspace(0.0, 2.0, 50)
        plots = [
            SeriesPlot(
                parts=(name,),
                title=name,
                curves=[Curve(name=name, t=t, values=np.sin(9.0 * t), colour=(0, 0, 0))],
                own_legend=True,
            )
            for name in ("elbow", "shoulder_pitch")
        ]
        roomy = with_room_for_legends(plots)
        (room,) = {plot.room for plot in roomy}
        legend, width = roomy[1].legend_width, plot_size(2)[0] - NUMBERS_BESIDE
        assert width * room / (1.0 + room) == pytest.approx(legend)
        assert legend > roomy[0].legend_width

    def test_names_of_tabs_fit_beside_each_other(self) -> None:
        views: list[rrb.View] = [rrb.TimeSeriesView(origin=f"/{k}") for k in range(20)]
        (tab,) = grid_tabs("positions", views)
        assert tab.name == "positions"
        assert [page.name for page in tab.contents] == [
            "1 to 5 of 20",
            "6 to 10 of 20",
            "11 to 15 of 20",
            "16 to 20 of 20",
        ]
        assert grid_tabs("positions", []) == []
        groups = ["positions", "velocities", "controls", "limits", "information"]
        assert fit_in_a_row([*groups, "sensitivities ψ", "optimiser", "iterates"])

    def test_numbers_beside_axes_are_round(self) -> None:
        np.testing.assert_allclose(round_numbers(-0.1, 4.2, 4), [0.0, 2.0, 4.0])
        np.testing.assert_allclose(round_numbers(2.41, 2.63, 4), [2.45, 2.5, 2.55, 2.6])
        np.testing.assert_allclose(10.0 ** round_logarithms(-0.1, 1.1, 4), [1.0, 2.0, 5.0, 10.0])
        np.testing.assert_allclose(10.0 ** round_logarithms(-5.2, 0.1, 4), [1e-4, 1e-2, 1.0])

    def test_rotations_become_rotation_vectors(self) -> None:
        model = load("zoo")
        qpos = np.array([model.qpos0])
        turn = np.array([0.3, -0.2, 0.1])
        mujoco.mju_axisAngle2Quat(
            qpos[0, 7:11], turn / np.linalg.norm(turn), float(np.linalg.norm(turn))
        )
        out = dof_positions(model, qpos)
        np.testing.assert_allclose(out[0, 6:9], turn, atol=1e-12)
        np.testing.assert_array_equal(out[0, :3], qpos[0, :3])

    def test_costs_that_change_sign_are_not_logarithmic(self) -> None:
        rows = [
            make_row(iteration=k, cost=1.0 - k, criterion=0.0, slope=0.0, gamma=float("nan"))
            for k in range(3)
        ]
        series = history_series(rows)
        assert list(series["cost"][1]) == [1.0, 0.0, -1.0]
        assert len(series["slope"][0]) == 0
        assert len(series["step length"][0]) == 0


class FakeViewer:
    """A process that takes the place of the viewer."""

    code: int | None = None
    command: tuple[str, ...] = ()

    def __init__(self, command: list[str], **_: object) -> None:
        FakeViewer.command = tuple(command)

    def wait(self, timeout: float) -> int:
        """End with `code`, or keep running if it is None."""
        if FakeViewer.code is None:
            raise subprocess.TimeoutExpired(FakeViewer.command, timeout)
        return FakeViewer.code


class TestShow:
    """The process of the viewer."""

    def test_missing_file_is_reported(self, tmp_path: Path) -> None:
        with pytest.raises(RecordingError, match=r"nothing\.rrd"):
            show(tmp_path / "nothing.rrd")

    def test_viewer_stays_open(self, file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr(subprocess, "Popen", FakeViewer)
        monkeypatch.setattr(FakeViewer, "code", None)
        show(file)
        assert FakeViewer.command[-1] == str(file)

    def test_viewer_that_cannot_start_is_reported(
        self, file: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(subprocess, "Popen", FakeViewer)
        monkeypatch.setattr(FakeViewer, "code", 1)
        with pytest.raises(MjfimError, match="display"):
            show(file)
