"""Designs, estimates and trajectories as Rerun recordings: the data that each file holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mjfim.arrays import evenly_spread_indices
from mjfim.model.coordinates import output_label
from mjfim.output import vocabulary
from mjfim.output.rerun.camera import place_camera
from mjfim.output.rerun.history import history_bars, history_lines, log_history
from mjfim.output.rerun.layout import (
    ASPECT_WITH_TEXT,
    ASPECT_WITHOUT_TEXT,
    arrange,
    open_recording,
    recording_page,
    robot_views,
    state_parts,
)
from mjfim.output.rerun.panels import (
    LayoutPart,
    dof_positions,
    grid_parts,
    log_dots,
    log_line,
    log_steps,
    series_view,
    stack_parts,
)
from mjfim.output.rerun.phase_plots import PhasePlot, parameters_with_phase_plot
from mjfim.output.rerun.scene import body_poses, entity_path, log_end_path, log_robot
from mjfim.output.rerun.shapes import RobotStyle
from mjfim.output.rerun.text import design_text, estimate_text
from mjfim.records.design import Design, Evaluation
from mjfim.records.estimate import Estimate
from mjfim.records.labels import Labels
from mjfim.records.trajectory import Trajectory

# Styles of the initial and the designed trajectory, and of a predicted and a measured motion.
INITIAL = RobotStyle(accent=vocabulary.INITIAL.rgb)
DESIGNED = RobotStyle(accent=vocabulary.DESIGNED.rgb)
PREDICTED = RobotStyle(accent=vocabulary.IDENTIFIED.rgb)
MEASURED = RobotStyle(accent=vocabulary.MEASURED.rgb, opacity=0.4)

# Styles of further trajectories and series, one after the other.
FURTHER_STYLES = (
    RobotStyle(accent=(60, 160, 90)),
    RobotStyle(accent=(160, 90, 200)),
    PREDICTED,
    RobotStyle(accent=(20, 160, 170)),
)

# Styles of trajectories with a known name.
STYLES_BY_NAME = {"initial": INITIAL, vocabulary.DESIGNED.word: DESIGNED}

# Largest number of samples of a recording, or of a motion, in a file.
MAX_SAMPLES = 20_000


# ---- designs


def log_design(
    path: Path, model: mujoco.MjModel, design: Design, labels: Labels, *, addition: str = ""
) -> None:
    """Write design.rrd: both robots, their signals, sensitivities, history and a summary.

    Args:
        path: The file.
        model: The model.
        design: The design.
        labels: Labels of the model's columns, usually `labels_of_model(model)`.
        addition: Markdown to append to the summary.
    """
    evaluations = {"initial": design.initial, "designed": design.final}
    poses = {
        name: body_poses(model, evaluation.trajectory.t, evaluation.trajectory.qpos)
        for name, evaluation in evaluations.items()
    }
    camera = place_camera(model, list(poses.values()), views=2, aspect=ASPECT_WITH_TEXT)
    titles = {
        "initial trajectory (blue)": ("robots", "initial"),
        "designed trajectory (red)": ("robots", "designed"),
    }
    plots = [
        PhasePlot.of_most_sensitive(design, j, model.nv) for j in parameters_with_phase_plot(design)
    ]
    views = robot_views(model, camera, titles)
    layout = arrange(views, camera, _design_panels(design, labels, plots))

    units = labels.parameter_units or ("",) * len(design.parameters)
    with open_recording(path, model, "design", layout) as rec:
        _log_text(rec, design_text(design, units, addition))
        log_history(rec, design.history, (DESIGNED, INITIAL, *FURTHER_STYLES))
        for plot in plots:
            plot.log_axes(rec, labels)
        for name, evaluation in evaluations.items():
            root, style = ("robots", name), STYLES_BY_NAME[name]
            log_robot(rec, model, root, poses[name], style, on_iteration=True)
            log_end_path(rec, model, root, poses[name], style)
            _log_states(rec, model, evaluation.trajectory, labels, name=name, style=style)
            _log_information(rec, evaluation, plots, name=name, style=style)


def _log_information(
    rec: rr.RecordingStream,
    evaluation: Evaluation,
    plots: Sequence[PhasePlot],
    *,
    name: str,
    style: RobotStyle,
) -> None:
    """Log the information over time and the sensitivities of one trajectory.

    The information is the root of its smallest eigenvalue.
    """
    t = evaluation.trajectory.t
    root = np.sqrt(np.maximum(evaluation.min_eigenvalue, 0.0))
    log_line(rec, ("information", name), t, root, name=name, style=style)
    for plot in plots:
        plot.log_curve(rec, t, evaluation.sensitivity, name=name, style=style)


def _design_panels(design: Design, labels: Labels, plots: Sequence[PhasePlot]) -> list[LayoutPart]:
    """Return the signals of a design.

    The history has a tab for itself, because the viewer draws one timeline at a time.
    """
    states = state_parts(labels)
    title = "√λ_min of the information up to each time [√s / θ-unit]"
    information = series_view(("information",), title)
    sensitivities = grid_parts("sensitivity ψ", [plot.view(labels) for plot in plots])

    lines = history_lines(design.history)
    if not lines:
        return [*states, LayoutPart(content=information), *sensitivities]

    beside = LayoutPart(content=rrb.Horizontal(information, history_bars(design.history)))
    name = "trajectories (timeline: sim_time)"
    signals = stack_parts([*states, beside, *sensitivities], name=name)
    history = grid_parts("optimiser (timeline: iteration)", lines, columns=2)[0]
    return [LayoutPart(content=rrb.Tabs(signals, history.content, active_tab=0))]


# ---- estimates


def log_estimate(
    path: Path,
    model: mujoco.MjModel,
    estimate: Estimate,
    measured: Trajectory | None,
    predicted: Trajectory,
    labels: Labels,
    *,
    addition: str = "",
) -> None:
    """Write estimate.rrd: predicted and measured robot and outputs, residuals and a summary.

    Args:
        path: The file.
        model: The identified model.
        estimate: The estimate.
        measured: Measured motion, drawn as a transparent robot; None where positions were not
            measured.
        predicted: Predicted motion.
        labels: Labels of the model's columns.
        addition: Markdown to append to the summary.
    """
    trajectories = {"predicted": _thinned(predicted)}
    styles = {"predicted": PREDICTED, "measured": MEASURED}
    title = "identified robot (purple)"
    if measured is not None:
        trajectories["measured"] = _thinned(measured)
        title += " and measured robot (teal, transparent)"

    poses = {
        name: body_poses(model, trajectory.t, trajectory.qpos)
        for name, trajectory in trajectories.items()
    }
    camera = place_camera(model, list(poses.values()), views=1, aspect=ASPECT_WITH_TEXT)
    pages = [recording_page(model, k, recording) for k, recording in enumerate(estimate.recordings)]
    pages.append(stack_parts(state_parts(labels), name="states and controls"))
    signals = LayoutPart(content=rrb.Tabs(*pages, active_tab=0))
    views = robot_views(model, camera, {title: ("robots",)})
    layout = arrange(views, camera, [signals])

    with open_recording(path, model, "estimate", layout) as rec:
        _log_text(rec, estimate_text(estimate, addition))
        log_end_path(rec, model, ("robots", "predicted"), poses["predicted"], PREDICTED)
        for name, trajectory in trajectories.items():
            log_robot(rec, model, ("robots", name), poses[name], styles[name])
            _log_states(rec, model, trajectory, labels, name=name, style=styles[name])
        for k in range(len(estimate.recordings)):
            _log_outputs(rec, model, estimate, k)


def _log_outputs(
    rec: rr.RecordingStream, model: mujoco.MjModel, estimate: Estimate, index: int
) -> None:
    """Log measured and predicted outputs of one recording, and their differences."""
    recording = estimate.recordings[index]
    rows = evenly_spread_indices(len(recording.t), MAX_SAMPLES)
    t = recording.t[rows]
    for column, output in enumerate(recording.outputs):
        parts = (f"recording {index + 1}", output_label(model, output))
        measured = recording.y[rows, column]
        predicted = estimate.predicted[index][rows, column]

        under = ("outputs", *parts)
        log_dots(rec, (*under, "measured"), t, measured, name="measured", style=MEASURED)
        log_line(rec, (*under, "predicted"), t, predicted, name="predicted", style=PREDICTED)
        log_dots(
            rec,
            ("residuals", *parts),
            t,
            measured - predicted,
            name="measured - predicted",
            style=MEASURED,
        )


def _thinned(trajectory: Trajectory) -> Trajectory:
    """Return at most `MAX_SAMPLES` evenly spread samples of a trajectory."""
    rows = evenly_spread_indices(len(trajectory.t), MAX_SAMPLES)
    return Trajectory(
        t=trajectory.t[rows],
        qpos=trajectory.qpos[rows],
        qvel=trajectory.qvel[rows],
        act=trajectory.act[rows],
        ctrl=trajectory.ctrl[rows[:-1]],
    )


# ---- trajectories


def log_trajectories(
    path: Path, model: mujoco.MjModel, trajectories: Mapping[str, Trajectory], labels: Labels
) -> None:
    """Write trajectories: one robot each, states and controls in shared plots.

    Args:
        path: The file.
        model: The model.
        trajectories: The trajectories by name; `final` is shown as `designed`.
        labels: Labels of the model's columns.
    """
    trajectories = {vocabulary.shown_word(name): found for name, found in trajectories.items()}
    styles = _trajectory_styles(list(trajectories))
    poses = {
        name: body_poses(model, trajectory.t, trajectory.qpos)
        for name, trajectory in trajectories.items()
    }
    motions = list(poses.values())
    camera = place_camera(model, motions, views=len(motions), aspect=ASPECT_WITHOUT_TEXT)
    views = robot_views(model, camera, {name: ("robots", name) for name in trajectories})
    layout = arrange(views, camera, state_parts(labels), text=False)

    with open_recording(path, model, "replay", layout) as rec:
        for name, trajectory in trajectories.items():
            root, style = ("robots", name), styles[name]
            log_robot(rec, model, root, poses[name], style)
            log_end_path(rec, model, root, poses[name], style)
            _log_states(rec, model, trajectory, labels, name=name, style=style)


def _trajectory_styles(names: Sequence[str]) -> dict[str, RobotStyle]:
    """Return a style for every name; names without a fixed style take the further ones in turn."""
    styles = {}
    further = 0
    for name in names:
        if name in STYLES_BY_NAME:
            styles[name] = STYLES_BY_NAME[name]
            continue
        styles[name] = FURTHER_STYLES[further % len(FURTHER_STYLES)]
        further += 1
    return styles


# ---- parts of several recordings


def _log_text(rec: rr.RecordingStream, markdown: str) -> None:
    """Log the text of the summary panel."""
    document = rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN)
    rec.log(entity_path(("summary",)), document, static=True, strict=True)


def _log_states(
    rec: rr.RecordingStream,
    model: mujoco.MjModel,
    trajectory: Trajectory,
    labels: Labels,
    *,
    name: str,
    style: RobotStyle,
) -> None:
    """Log positions, velocities and controls as series with the trajectory's name."""
    t = trajectory.t
    positions = dof_positions(model, trajectory.qpos)
    for label, values in zip(labels.positions, positions.T, strict=True):
        log_line(rec, ("positions", label, name), t, values, name=name, style=style)
    for label, values in zip(labels.velocities, trajectory.qvel.T, strict=True):
        log_line(rec, ("velocities", label, name), t, values, name=name, style=style)
    for label, values in zip(labels.controls, trajectory.ctrl.T, strict=True):
        log_steps(rec, ("controls", label, name), t[:-1], values, name=name, style=style)
