"""Designs, estimates and trajectories as Rerun recordings with a summary, and their viewer."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import cycle, islice
from pathlib import Path

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mjfim.arrays import Array, evenly_spread_indices
from mjfim.errors import MjfimError, RecordingError
from mjfim.files import replacing
from mjfim.model.coordinates import split_unit
from mjfim.output.archive import shown_positions
from mjfim.output.live import start_viewer
from mjfim.output.page import (
    DESIGNED,
    IDENTIFIED,
    INITIAL,
    MEASURED,
    NOMINAL,
    TERMS,
    Page,
    Term,
    shown_word,
)
from mjfim.output.pages import page_of
from mjfim.output.panels import ROBOT_ROLES, Panel, line
from mjfim.output.plots.design import (
    accuracy_over_time,
    both_motions,
    convergence,
    largest_share,
    limit_panels,
    motion_panels,
)
from mjfim.output.plots.estimate import deciding_seconds, fit, held_out, residual_torque
from mjfim.output.plots.studies import fan_panels, valley
from mjfim.output.report import template
from mjfim.output.rerun.camera import Camera, place_camera
from mjfim.output.rerun.plots import (
    PLOTS_PER_ROW,
    Plane,
    Tabs,
    answers,
    grid_tabs,
    log_series,
    planes_of,
    series_tabs,
    with_curves,
)
from mjfim.output.rerun.scene import (
    PATH_THICKNESS,
    BodyPoses,
    EntityParts,
    body_parts,
    body_poses,
    drawn_shapes,
    end_point,
    entity_path,
    has_floor,
    log_end_path,
    log_pose,
    log_robot,
    pale_shapes,
    rgb,
    time_column,
)
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.rehearsal import Rehearsal
from mjfim.records.trajectory import Labels, Trajectory

# Roles of trajectories whose name is no word of the vocabulary, one after the other.
FURTHER_ROLES = ("series2", "series5", IDENTIFIED, "series4")

# Largest number of samples of a motion in a file.
MAX_SAMPLES = 20_000

# Colour of the background of the 3D views (0..255); width over height of the region of the robots,
# with text below it and without; heights of robots and text, and widths of the left and the right
# side, relative to each other.
BACKGROUND = (214, 219, 226)
ASPECT_WITH_TEXT, ASPECT_WITHOUT_TEXT = 1.5, 0.75
ROBOTS_TO_TEXT, LEFT_TO_RIGHT = [5, 4], [2, 3]

# Time after which a viewer that still runs counts as started [s].
START_SECONDS = 3.0


def log_design(
    path: Path,
    model: mujoco.MjModel,
    design: Design,
    labels: Labels,
    beside: tuple[Sequence[Sequence[Trajectory]], str] = ((), ""),
) -> None:
    """Write design.rrd: accuracy over time, both robots, their signals, the search and a summary.

    Args:
        path: File to write.
        model: Model with the parameters of the design.
        design: The design.
        labels: Labels of its columns.
        beside: Motions of the two robots beside the initial and beside the designed motion, and
            what they show in words.
    """
    both = both_motions(design)
    learning = accuracy_over_time(design, design.labels)
    motion = motion_panels(labels, both, design.usage)
    asked: Tabs = {"limits": limit_panels(design, labels, rows=False)} if design.usage else {}
    if design.rehearsal is not None and design.rehearsal.fans:
        asked["robots"] = [
            replace(panel, title=f"{panel.title} {panel.y.label}".strip())
            for panel in fan_panels(design.rehearsal)
        ]
    asked["accuracy"] = list(learning.panels)
    if design.valley is not None:
        panels = valley(design.valley, [(f"{term} motion", term) for term in both]).panels
        asked["two robots"] = list(panels[: 2 * len(both)])
    # The positions nearest to their limits, or the first ones.
    near = {use.name: largest_share(use) for use in design.usage if use.kind == "position"}
    nearest = sorted(
        motion["positions"], key=lambda panel: -near.get(split_unit(panel.title)[0], 0.0)
    )
    search = planes_of("optimiser", convergence(design).panels)
    iterates = _iterate_plots(design, labels)
    tabs = [
        answers([*asked.items(), ("positions", nearest[:PLOTS_PER_ROW])]),
        rrb.Tabs(*series_tabs(motion), name="motion", active_tab=0),
    ]
    if search or iterates:
        grids = grid_tabs("optimiser", [plane.view() for plane, _ in search])
        grids += grid_tabs("iterates", [plane.view() for plane, *_ in iterates])
        tabs.append(rrb.Tabs(*grids, name="search", active_tab=0))

    poses = _poses_of(model, both)
    robots = _robots(model, poses, ASPECT_WITH_TEXT)
    text = as_markdown(page_of(design), DESIGN_COLOURS, beside[1])
    with open_recording(path, model, "design", robots, tabs, text) as rec:
        log_series(rec, asked | motion)
        for plane, panel in search:
            plane.log(rec, panel.marks)
        _log_robots(rec, model, poses, {}, [INITIAL])
        for name, pair in zip(poses, beside[0], strict=False):
            for k, (each, role) in enumerate(zip(pair, ROBOT_ROLES, strict=True), start=1):
                ghost = body_poses(model, each.t, each.qpos)
                root = ("robots", name, f"robot {k}")
                log_robot(rec, model, root, ghost, role, is_ghost=True)
        _log_iterates(rec, model, design, iterates)
        if design.rehearsal is not None:
            _log_rehearsed(rec, model, design.rehearsal, poses[DESIGNED])


def log_estimate(
    path: Path,
    model: mujoco.MjModel,
    estimate: Estimate,
    measured: Trajectory | None,
    identified: Trajectory,
    labels: Labels,
) -> None:
    """Write estimate.rrd: identified and measured robot and outputs, residuals and a summary.

    Args:
        path: File to write.
        model: Model with the identified parameters.
        estimate: The estimate.
        measured: Motion of the first recording, where its positions were measured.
        identified: Motion of the identified model.
        labels: Labels of their columns.
    """
    shown: dict[str, Trajectory] = {IDENTIFIED: _thinned(identified)}
    title = f"{IDENTIFIED} robot ({IDENTIFIED.colour_name})"
    if measured is not None:
        term = MEASURED
        shown[term] = _thinned(measured)
        title += f", {term} robot ({term.colour_name} outline)"
    kept = [each.name for each in estimate.predictions if each.recording is not None]
    fits = [fit(estimate, i, labels) for i in range(len(estimate.recordings))]
    held = [held_out(estimate, i, labels) for i in range(len(kept))]
    recordings: Tabs = {
        f"{kind}{k}: {Path(name).name}": _pairs(picture.panels)
        for kind, pictures, names in (
            ("", fits, [each.name for each in estimate.recordings]),
            ("held out ", held, kept),
        )
        for k, (picture, name) in enumerate(zip(pictures, names, strict=True), start=1)
    }
    states: Tabs = motion_panels(labels, shown)
    asked: Tabs = {}
    if estimate.in_time is not None:
        ribbons = deciding_seconds(estimate, estimate.labels).panels
        asked["information [% per s]"] = [with_curves(panel) for panel in ribbons]
    planes = []
    if estimate.residual_forces:
        torques = residual_torque(estimate.residual_forces).panels
        planes = planes_of("residual torque", torques)
    name, panels = next(iter(recordings.items()))
    pairs = panels[: 2 * PLOTS_PER_ROW]
    tabs = [
        answers([*asked.items(), (name, pairs[::2]), (name, pairs[1::2])]),
        rrb.Tabs(*series_tabs(recordings), name="recordings", active_tab=0),
    ]
    poses = _poses_of(model, shown)
    camera = place_camera(model, list(poses.values()), views=1, aspect=ASPECT_WITH_TEXT)
    root = ("robots", IDENTIFIED)
    view = robot_views(model, camera, {title: ("robots",)}, followed=root)[0]
    tabs += grid_tabs("residual torque", [plane.view() for plane, _ in planes])
    tabs.append(rrb.Tabs(*series_tabs(states), name="motion", active_tab=0))
    text = as_markdown(page_of(estimate), ESTIMATE_COLOURS)
    with open_recording(path, model, "estimate", view, tabs, text) as rec:
        log_series(rec, asked | recordings | states)
        for plane, panel in planes:
            plane.log(rec, panel.marks)
        _log_robots(rec, model, poses, {}, [IDENTIFIED])


def _pairs(panels: Sequence[Panel]) -> list[Panel]:
    """Return outputs and residuals that were measured, with titles that differ."""
    found = []
    for curves, errors in zip(panels[::2], panels[1::2], strict=True):
        if not errors.message:
            title = f"{curves.title}: {errors.title.partition(':')[0]}"
            found += [curves, replace(errors, title=title)]
    return found


def log_trajectories(
    path: Path, model: mujoco.MjModel, trajectories: Mapping[str, Trajectory], labels: Labels
) -> None:
    """Write trajectories: one robot each, states and controls in shared plots.

    Args:
        path: File to write.
        model: The model.
        trajectories: Trajectories by name; "initial" and "final" are those of a design.
        labels: Labels of their columns.
    """
    named = {shown_word(name): each for name, each in trajectories.items()}
    poses = _poses_of(model, named)
    further = cycle(FURTHER_ROLES)
    known = (INITIAL, DESIGNED)
    roles = {name: name if name in known else next(further) for name in named}
    states = motion_panels(labels, named, roles=roles)
    robots = _robots(model, poses, ASPECT_WITHOUT_TEXT, roles)
    with open_recording(path, model, "replay", robots, series_tabs(states)) as rec:
        log_series(rec, states)
        _log_robots(rec, model, poses, roles, list(poses))


def _poses_of(model: mujoco.MjModel, motions: Mapping[str, Trajectory]) -> dict[str, BodyPoses]:
    return {name: body_poses(model, each.t, each.qpos) for name, each in motions.items()}


def _thinned(trajectory: Trajectory) -> Trajectory:
    """Return at most `MAX_SAMPLES` evenly spread samples of a trajectory."""
    rows = evenly_spread_indices(len(trajectory.t), MAX_SAMPLES)
    states = {key: getattr(trajectory, key)[rows] for key in ("t", "qpos", "qvel", "act")}
    return Trajectory(**states, ctrl=trajectory.ctrl[rows[:-1]])


# ---- iterates of the search

# A plot of one quantity: its axes, the curve of the initial trajectory, and the curves of the
# iterates, each with its times.
IteratePlot = tuple[Plane, tuple[Array, Array], list[tuple[Array, Array]]]


def _iterate_plots(design: Design, labels: Labels) -> list[IteratePlot]:
    """Return a plot for each position and control of the iterates."""
    motions = design.motions
    if motions is None:
        return []
    initial = design.initial.trajectory
    names, positions = shown_positions(labels, initial.qpos, *motions.qpos)
    plots = []
    for titles, first, values in (
        (names, positions[0], positions[1:]),
        (labels.controls, initial.ctrl, list(motions.ctrl)),
    ):
        for k, title in enumerate(titles):
            start = initial.t[: len(first)], first[:, k]
            curves = [
                (np.asarray(t[: len(each)]), each[:, k])
                for t, each in zip(motions.t, values, strict=True)
            ]
            every = [line(*pair, "text") for pair in (start, *curves)]
            plane = Plane.around(("iterates", title), f"{title} over time [s]", every)
            plots.append((plane, start, curves))
    return plots


def _log_iterates(
    rec: rr.RecordingStream, model: mujoco.MjModel, design: Design, plots: Sequence[IteratePlot]
) -> None:
    """Log on the timeline `iteration` the curves, and the robot in the middle of its motion."""
    for plane, start, _ in plots:
        plane.log(rec)
        still = plane.curve(*start, INITIAL, 0.6)
        rec.log(entity_path((*plane.parts, "initial")), still, static=True, strict=True)
    root = ("robots", DESIGNED)
    middle = design.initial.trajectory.qpos[len(design.initial.trajectory.t) // 2]
    still_poses = body_poses(model, np.zeros(1), middle[None])
    designed = body_poses(model, design.trajectory.t, design.trajectory.qpos)
    end = end_point(model, designed)
    rec.set_time("sim_time", duration=0.0)
    log_end_path(rec, root, designed, end, DESIGNED)
    rec.reset_time()
    motions = design.motions
    if motions is None:
        return
    for i, iteration in enumerate(motions.iteration.tolist()):
        rec.set_time("iteration", sequence=int(iteration))
        qpos = np.asarray(motions.qpos[i], dtype=np.float64)
        poses = body_poses(model, motions.t[i], qpos)
        log_pose(rec, model, root, poses, len(qpos) // 2)
        log_pose(rec, model, ("robots", INITIAL), still_poses, 0)
        log_end_path(rec, root, poses, end, DESIGNED)
        for plane, _, curves in plots:
            curve = plane.curve(*curves[i], DESIGNED)
            rec.log(entity_path((*plane.parts, "iterate")), curve, strict=True)
    rec.reset_time()


def _log_rehearsed(
    rec: rr.RecordingStream, model: mujoco.MjModel, rehearsal: Rehearsal, designed: BodyPoses
) -> None:
    """Log the paths of the ends of robots that play the design, and the ends as moving points."""
    t, motions, end = rehearsal.motion_times, rehearsal.motions, end_point(model, designed)
    if end is None:
        return
    paths = [body_poses(model, t, qpos).world_paths(*end)[:, 0] for qpos in motions.values()]
    unsafe = rehearsal.unsafe[list(motions)]
    for name, colour, chosen in (
        ("robots that leave no limit", rgb(MEASURED), ~unsafe),
        ("robots that leave a limit", rgb(NOMINAL), unsafe),
    ):
        found = [paths[k] for k in np.flatnonzero(chosen)]
        if not found:
            continue
        parts = ("robots", DESIGNED, name)
        thin = rr.Radius.ui_points(0.5 * PATH_THICKNESS)
        lines = rr.LineStrips3D(found, colors=[colour], radii=thin)
        rec.log(entity_path((*parts, "paths")), lines, static=True, strict=True)
        look = rr.Points3D.from_fields(colors=[colour], radii=rr.Radius.ui_points(3.0))
        rec.log(entity_path((*parts, "ends")), look, static=True, strict=True)
        ends = rr.Points3D.columns(positions=np.stack(found, axis=1).reshape(-1, 3))
        rows = ends.partition([len(found)] * len(t))
        rec.send_columns(entity_path((*parts, "ends")), [time_column(t)], rows, strict=True)


# ---- layout


@contextmanager
def open_recording(
    path: Path,
    model: mujoco.MjModel,
    kind: str,
    robots: rrb.Container | rrb.View,
    tabs: Sequence[rrb.Container],
    text: str = "",
) -> Iterator[rr.RecordingStream]:
    """Open a stream into a temporary file, which replaces `path` once it is complete.

    Args:
        path: The file.
        model: The model, whose name the recording has.
        kind: Kind of the recording.
        robots: Views of the robots, on the left.
        tabs: Tabs with signals, on the right.
        text: Summary below the robots, as Markdown; empty for none.

    Yields:
        The stream.
    """
    left = robots
    summary = entity_path(("summary",))
    if text:
        below = rrb.TextDocumentView(origin=summary, name="summary")
        left = rrb.Vertical(robots, below, row_shares=ROBOTS_TO_TEXT)
    layout = rrb.Horizontal(left)
    if tabs:
        right = rrb.Tabs(*tabs, active_tab=0)
        layout = rrb.Horizontal(left, right, column_shares=LEFT_TO_RIGHT)
    time_panel = rrb.TimePanel(
        state="collapsed", timeline="sim_time", play_state="playing", loop_mode="all"
    )
    # The names of a compiled model begin with that of the model. Rerun warns of other characters.
    name = re.sub(r"[^\w -]", "-", model.names.split(b"\0", 1)[0].decode(), flags=re.ASCII)
    with (
        replacing(path) as partial,
        rr.RecordingStream(f"mjfim {kind} {name}".strip()) as rec,
    ):
        rec.set_log_time_enabled(False)
        rec.save(partial, default_blueprint=blueprint_of(layout, time_panel))
        if text:
            document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
            rec.log(summary, document, static=True, strict=True)
        yield rec


def blueprint_of(layout: rrb.Container, time_panel: rrb.TimePanel) -> rrb.Blueprint:
    """Return a blueprint whose other panels are collapsed."""
    return rrb.Blueprint(
        layout,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        time_panel,
        auto_layout=False,
        auto_views=False,
    )


def robot_views(
    model: mujoco.MjModel,
    camera: Camera,
    roots: Mapping[str, EntityParts],
    followed: EntityParts | None = None,
    overrides: Mapping[str, rrb.Visualizer] | None = None,
) -> list[rrb.View]:
    """Return 3D views of robots, all seen from the same camera.

    Args:
        model: The model.
        camera: The camera.
        roots: Entity of the robot of each view, by the title of the view.
        followed: Entity of the robot that the camera follows; default: that of the view.
        overrides: Looks of shapes that replace their own ones.
    """
    grid_helps = not has_floor(model) and not camera.edge_on
    views: list[rrb.View] = []
    for title, root in roots.items():
        tracked = None
        if camera.followed is not None:
            # A camera can follow a shape, but no body, whose entity has no shape of its own.
            parts = body_parts(model, followed or root, camera.followed)
            shapes = drawn_shapes(model, camera.followed, DESIGNED)
            tracked = entity_path((*parts, *(shape.name for shape in islice(shapes, 1))))
        view = rrb.Spatial3DView(
            origin=entity_path(root),
            name=title,
            eye_controls=rrb.EyeControls3D(
                position=camera.position,
                look_target=camera.target,
                eye_up=(0.0, 0.0, 1.0),
                tracking_entity=tracked,
            ),
            line_grid=rrb.LineGrid3D(visible=grid_helps),
            background=BACKGROUND,
            overrides=dict((overrides or {}).items()),
        )
        views.append(view)
    return views


def _robots(
    model: mujoco.MjModel,
    poses: Mapping[str, BodyPoses],
    aspect: float,
    roles: Mapping[str, str] | None = None,
) -> rrb.Container:
    """Return the views of several robots: separate, and in another tab overlaid."""
    motions, names = list(poses.values()), list(poses)
    camera = place_camera(model, motions, views=len(motions), aspect=aspect)
    words: dict[str, str] = {term: f"{term} ({term.colour_name})" for term in TERMS}
    titles = {words.get(name, name): ("robots", name) for name in names}
    arranged = rrb.Vertical if camera.stacked else rrb.Horizontal
    separate = arranged(*robot_views(model, camera, titles), name="separate")
    if len(names) < 2:
        return separate
    # The camera of a view that is opened later, while a body flies, would begin in a wrong place.
    still = place_camera(model, motions, views=1, aspect=aspect, follow=False)
    pale = _pale_robots(model, names[:-1], roles or {})
    (overlay,) = robot_views(model, still, {"overlay": ("robots",)}, overrides=pale)
    return rrb.Tabs(separate, overlay, active_tab=0)


def _pale_robots(
    model: mujoco.MjModel, names: Sequence[str], roles: Mapping[str, str]
) -> dict[str, rrb.Visualizer]:
    """Return the translucent look of robots, by the paths of their shapes."""
    pale: dict[str, rrb.Visualizer] = {}
    for name in names:
        pale |= pale_shapes(model, ("robots", name), roles.get(name, name))
    return pale


def _log_robots(
    rec: rr.RecordingStream,
    model: mujoco.MjModel,
    poses: Mapping[str, BodyPoses],
    roles: Mapping[str, str],
    with_path: Sequence[str],
) -> None:
    """Log robots by their names, some of them with the path of the end."""
    for name, each in poses.items():
        root, role = ("robots", name), roles.get(name, name)
        log_robot(rec, model, root, each, role)
        if name in with_path:
            log_end_path(rec, root, each, end_point(model, each), role, static=True)


# ---- the viewer


def show(path: Path) -> None:
    """Open the native viewer on a recording and return; the viewer stays open.

    Args:
        path: The recording.

    Raises:
        RecordingError: There is no such file.
        MjfimError: The viewer cannot start.
    """
    if not Path(path).is_file():
        raise RecordingError(f"there is no Rerun recording at {str(path)!r}")

    viewer = start_viewer("--new", str(path))
    try:
        code = viewer.wait(timeout=START_SECONDS)
    except subprocess.TimeoutExpired:
        return
    if code:
        raise MjfimError(
            f"the Rerun viewer ended with code {code}; it needs a display; the complete recording "
            f"is in {str(path)!r}"
        )


def as_markdown(page: Page, *further: str) -> str:
    """Write a page: verdict, remarks by their weight, all parts, and further sentences."""
    text = template("summary.md.j2").render(page=page).strip()
    return "\n\n".join([text, *filter(None, further)])


def _colours(*meanings: tuple[Term, str]) -> str:
    return " ".join(f"{term.colour_name.capitalize()}: {meaning}." for term, meaning in meanings)


# Sentences that explain the colours of the recordings.
DESIGN_COLOURS = (
    _colours(
        (INITIAL, "the initial trajectory"),
        (DESIGNED, "the designed trajectory"),
        (MEASURED, "rehearsed robots"),
        (NOMINAL, "rehearsed robots that leave a limit"),
    )
    + " Grey lines: limits. Space bar: play or pause. The timeline `iteration` shows the search: "
    "its iterates in place of the designed trajectory."
)
ESTIMATE_COLOURS = (
    _colours(
        (IDENTIFIED, "the identified model"),
        (MEASURED, "the measurements"),
        (NOMINAL, "the nominal model, for data that were not fitted"),
    )
    + " Grey lines: twice the standard deviation of the noise."
)
