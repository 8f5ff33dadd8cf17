"""Designs, estimates and trajectories as Rerun recordings: what each file holds and how the viewer lays it out."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mjfim.arrays import evenly_spread_indices
from mjfim.atomic_io import replacing
from mjfim.errors import MjfimError, RecordingError
from mjfim.model.coordinates import output_label
from mjfim.output.labels import Labels
from mjfim.output.rerun.panels import (
    Block,
    Phase,
    dof_positions,
    grid,
    history_bars,
    history_lines,
    log_dots,
    log_history,
    log_line,
    log_steps,
    series_view,
    series_views,
    shown_parameters,
    stack,
)
from mjfim.output.rerun.scene import (
    Camera,
    Route,
    camera,
    entity,
    has_floor,
    log_robot,
    log_trail,
    motion,
)
from mjfim.output.rerun.shapes import Look
from mjfim.output.rerun.text import design_text, estimate_text
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.recording import Recording
from mjfim.records.trajectory import Trajectory

INITIAL = Look((70, 130, 220))
OPTIMIZED = Look((220, 60, 60))
PREDICTED = Look((230, 130, 30))
MEASURED = Look((125, 135, 150), opacity=0.4)
OTHERS = (Look((60, 160, 90)), Look((160, 90, 200)), PREDICTED, Look((20, 160, 170)))
BACKDROP = (214, 219, 226)
MOST = 20_000  # rows of a recording, or of a motion, in a file


SHORT, TALL = 1.35, 0.75  # width over height of the robots' region, with and without text below it


BY_NAME = {"initial": INITIAL, "optimized": OPTIMIZED, "final": OPTIMIZED}


def log_design(
    path: Path, model: mujoco.MjModel, design: Design, names: Labels, summary: str = ""
) -> None:
    """Write design.rrd: both robots, states, controls, information, sensitivities, the optimiser's history and a table.

    summary: Markdown to append to the table;  names: labels of the model's columns, usually `Labels.of_model(model)`
    """
    sides = {"initial": design.initial, "optimized": design.final}
    phases = [Phase.most_sensitive(design, index, model.nv) for index in shown_parameters(design)]
    motions = {key: motion(model, e.trajectory.t, e.trajectory.qpos) for key, e in sides.items()}
    eye = camera(model, list(motions.values()), views=2, aspect=SHORT)
    titles = {
        "initial trajectory (blue)": ("robots", "initial"),
        "optimized trajectory (red)": ("robots", "optimized"),
    }
    panels = _design_panels(design, names, phases)
    with _document(
        path, model, "design", _layout(_robot_views(model, eye, titles), eye, panels)
    ) as rec:
        units = names.parameter_units or ("",) * len(design.parameters)
        _log_text(rec, design_text(design, units, summary))
        log_history(rec, design.history, (OPTIMIZED, INITIAL, *OTHERS))
        for phase in phases:
            phase.log_axes(rec, names)
        for key, side in sides.items():
            look, t = BY_NAME[key], side.trajectory.t
            log_robot(rec, model, ("robots", key), motions[key], look, iteration=True)
            log_trail(rec, model, ("robots", key), motions[key], look)
            _log_states(rec, model, side.trajectory, names, key, look)
            log_line(
                rec,
                ("information", key),
                t,
                np.sqrt(np.maximum(side.min_eigenvalue, 0.0)),
                key,
                look,
            )
            for phase in phases:
                phase.log_curve(rec, t, phase.curve(side.sensitivity, model.nv), key, look)


def _design_panels(design: Design, names: Labels, phases: Sequence[Phase]) -> list[Block]:
    """Signals of a design; the optimiser's history has its own tab, since one timeline at a time is drawn."""
    information = series_view(("information",), "√λ_min of the information so far [√s / θ-unit]")
    phase_grid = grid("sensitivity ψ", [phase.view(names) for phase in phases])
    lines = grid("optimiser (timeline: iteration)", history_lines(design.history), columns=2)
    if not lines:
        return [*_state_blocks(names), Block(information), *phase_grid]
    beside = Block(rrb.Horizontal(information, history_bars(design.history)))
    signals = stack(
        [*_state_blocks(names), beside, *phase_grid], name="trajectories (timeline: sim_time)"
    )
    return [Block(rrb.Tabs(signals, lines[0].content, active_tab=0))]


def log_estimate(
    path: Path,
    model: mujoco.MjModel,
    estimate: Estimate,
    measured: Trajectory | None,
    predicted: Trajectory,
    names: Labels,
    summary: str = "",
) -> None:
    """Write estimate.rrd: predicted against measured robot and outputs, residuals and the estimated parameters.

    measured: as a see-through robot over the simulated one, or None where positions were not measured
    """
    predicted, measured = _thin(predicted), None if measured is None else _thin(measured)
    robots = {"predicted": (predicted, PREDICTED)} | (
        {"measured": (measured, MEASURED)} if measured else {}
    )
    motions = {
        key: motion(model, trajectory.t, trajectory.qpos) for key, (trajectory, _) in robots.items()
    }
    eye = camera(model, list(motions.values()), views=1, aspect=SHORT)
    title = "predicted robot (orange)" + (
        " under the measured one (grey, see-through)" if measured else ""
    )
    pages = [
        _recording_page(model, k, recording) for k, recording in enumerate(estimate.recordings)
    ]
    pages.append(stack(_state_blocks(names), name="states and controls"))
    layout = _layout(
        _robot_views(model, eye, {title: ("robots",)}), eye, [Block(rrb.Tabs(*pages, active_tab=0))]
    )
    with _document(path, model, "estimate", layout) as rec:
        _log_text(rec, estimate_text(estimate, summary))
        log_trail(rec, model, ("robots", "predicted"), motions["predicted"], PREDICTED)
        for key, (trajectory, look) in robots.items():
            log_robot(rec, model, ("robots", key), motions[key], look)
            _log_states(rec, model, trajectory, names, key, look)
        for k, (recording, y) in enumerate(
            zip(estimate.recordings, estimate.predicted, strict=True)
        ):
            rows = evenly_spread_indices(len(recording.t), MOST)
            t = recording.t[rows]
            for column, output in enumerate(recording.outputs):
                root = (f"recording {k + 1}", output_label(model, output))
                observed, told = recording.y[rows, column], y[rows, column]
                log_dots(rec, ("outputs", *root, "measured"), t, observed, "measured", MEASURED)
                log_line(rec, ("outputs", *root, "predicted"), t, told, "predicted", PREDICTED)
                log_dots(
                    rec, ("residuals", *root), t, observed - told, "measured - predicted", MEASURED
                )


def log_trajectories(
    path: Path, model: mujoco.MjModel, trajectories: Mapping[str, Trajectory], names: Labels
) -> None:
    """Write trajectories by name: one robot each, states and controls together."""
    spare = iter(OTHERS * (1 + len(trajectories) // len(OTHERS)))
    looks = {key: BY_NAME.get(key) or next(spare) for key in trajectories}
    motions = {
        key: motion(model, trajectory.t, trajectory.qpos)
        for key, trajectory in trajectories.items()
    }
    eye = camera(model, list(motions.values()), views=len(motions), aspect=TALL)
    views = _robot_views(model, eye, {key: ("robots", key) for key in trajectories})
    layout = _layout(views, eye, _state_blocks(names), text=False)
    with _document(path, model, "replay", layout) as rec:
        for key, trajectory in trajectories.items():
            log_robot(rec, model, ("robots", key), motions[key], looks[key])
            log_trail(rec, model, ("robots", key), motions[key], looks[key])
            _log_states(rec, model, trajectory, names, key, looks[key])


def show(path: Path) -> None:
    """Open the native viewer on a recording and return; the viewer stays open."""
    if not Path(path).is_file():
        raise RecordingError(f"there is no Rerun recording at {str(path)!r}")
    viewer = subprocess.Popen(
        [sys.executable, "-m", "rerun", "--new", str(path)], start_new_session=True
    )
    try:
        code = viewer.wait(timeout=3.0)
    except subprocess.TimeoutExpired:
        return
    if code:
        raise MjfimError(
            f"the Rerun viewer ended with code {code}; it needs a display, the file {str(path)!r} does not"
        )


def _thin(trajectory: Trajectory) -> Trajectory:
    """At most so many rows, evenly spread."""
    rows = evenly_spread_indices(len(trajectory.t), MOST)
    ctrl = trajectory.ctrl[rows[:-1]]
    return Trajectory(
        t=trajectory.t[rows],
        qpos=trajectory.qpos[rows],
        qvel=trajectory.qvel[rows],
        act=trajectory.act[rows],
        ctrl=ctrl,
    )


def _log_text(rec: rr.RecordingStream, text: str) -> None:
    """Markdown of the summary panel."""
    document = rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
    rec.log(entity(("summary",)), document, static=True, strict=True)


# Parts shared by the documents


@contextmanager
def _document(
    path: Path, model: mujoco.MjModel, kind: str, layout: rrb.Container
) -> Iterator[rr.RecordingStream]:
    """A stream into a temporary file beside `path`, which replaces `path` once it is complete.

    The application id carries the model's name, so that the viewer keeps the layouts of different models apart.
    """
    name = model.names.split(b"\0", 1)[0].decode()
    time = rrb.TimePanel(
        state="collapsed", timeline="sim_time", play_state="playing", loop_mode="all"
    )
    panels = (rrb.BlueprintPanel(state="collapsed"), rrb.SelectionPanel(state="collapsed"), time)
    blueprint = rrb.Blueprint(layout, *panels, auto_layout=False, auto_views=False)
    with replacing(path) as partial, rr.RecordingStream(f"mjfim {kind} {name}".strip()) as rec:
        rec.set_log_time_enabled(False)
        rec.save(partial, default_blueprint=blueprint)
        yield rec


def _layout(
    views: Sequence[rrb.View], eye: Camera, panels: Sequence[Block], text: bool = True
) -> rrb.Horizontal:
    """Robots and text on the left, signals on the right."""
    robots = rrb.Vertical(*views) if eye.stacked else rrb.Horizontal(*views)
    document = rrb.TextDocumentView(origin=entity(("summary",)), name="summary")
    left = rrb.Vertical(robots, document, row_shares=[3, 2]) if text else robots
    return (
        rrb.Horizontal(left, stack(panels), column_shares=[2, 3])
        if panels
        else rrb.Horizontal(left)
    )


def _robot_views(model: mujoco.MjModel, eye: Camera, roots: Mapping[str, Route]) -> list[rrb.View]:
    """One 3D view per title, all seen from the same camera."""
    ground = rrb.LineGrid3D(visible=not (has_floor(model) or eye.sideways))
    return [
        rrb.Spatial3DView(
            origin=entity(root),
            name=title,
            eye_controls=eye.controls(),
            line_grid=ground,
            background=BACKDROP,
        )
        for title, root in roots.items()
    ]


def _state_blocks(names: Labels) -> list[Block]:
    """Positions, velocities and controls: all visible for small models, in tabs for large ones."""
    blocks = [
        *grid("positions", series_views(("positions",), names.positions, legend=True)),
        *grid("velocities", series_views(("velocities",), names.velocities)),
        *grid("controls", series_views(("controls",), names.controls)),
    ]
    if not blocks or max(len(names.positions), len(names.controls)) <= 3:
        return blocks
    return [Block(rrb.Tabs(*(part.content for part in blocks), active_tab=0), blocks[0].rows)]


def _log_states(
    rec: rr.RecordingStream,
    model: mujoco.MjModel,
    trajectory: Trajectory,
    names: Labels,
    key: str,
    look: Look,
) -> None:
    """Every position, velocity and control of a trajectory, as the series called `key`."""
    for name, column in zip(names.positions, dof_positions(model, trajectory.qpos).T, strict=True):
        log_line(rec, ("positions", name, key), trajectory.t, column, key, look)
    for name, column in zip(names.velocities, trajectory.qvel.T, strict=True):
        log_line(rec, ("velocities", name, key), trajectory.t, column, key, look)
    for name, column in zip(names.controls, trajectory.ctrl.T, strict=True):
        log_steps(rec, ("controls", name, key), trajectory.t[:-1], column, key, look)


def _recording_page(model: mujoco.MjModel, index: int, recording: Recording) -> rrb.Vertical:
    """Outputs over residuals of one recording."""
    name = f"recording {index + 1}"
    titles = [output_label(model, output) for output in recording.outputs]
    outputs = series_views(("outputs", name), titles, legend=True)
    residuals = [
        series_view(("residuals", name, title), f"residual of {title}", legend=False)
        for title in titles
    ]
    parts = grid("outputs", outputs, 2, 6) + grid("residuals", residuals, 2, 6)
    return stack(parts, name=f"{name}: {Path(recording.name).name}")
