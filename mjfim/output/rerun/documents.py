"""Designs, estimates and trajectories as Rerun recordings: the data that each file holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mjfim.arrays import evenly_spread_indices
from mjfim.output import vocabulary
from mjfim.output.rerun.camera import place_camera
from mjfim.output.rerun.history import HistoryPlot, history_plots
from mjfim.output.rerun.iterates import (
    IterateCurves,
    IteratePlot,
    iterate_plots,
    log_poses_of_iterates,
)
from mjfim.output.rerun.layout import (
    ASPECT_WITH_TEXT,
    ASPECT_WITHOUT_TEXT,
    arrange,
    open_recording,
    robot_views,
    separate_and_overlaid,
)
from mjfim.output.rerun.limits import limits_of_design, limits_of_model, usage_plots
from mjfim.output.rerun.outputs import held_out_plots, output_plots, recording_tabs
from mjfim.output.rerun.panels import grid_tabs, pages_of
from mjfim.output.rerun.phase_plots import PhasePlot, parameters_with_phase_plot
from mjfim.output.rerun.scene import (
    BodyPoses,
    body_poses,
    end_point,
    entity_path,
    log_end_path,
    log_robot,
    pale_shapes,
)
from mjfim.output.rerun.series import Curve, SeriesPlot, views_of
from mjfim.output.rerun.shapes import RobotStyle
from mjfim.output.rerun.states import ShownTrajectory, StatePlots, state_plots
from mjfim.output.rerun.text import design_text, estimate_text
from mjfim.records.design import Design, Evaluation
from mjfim.records.estimate import Estimate
from mjfim.records.labels import Labels
from mjfim.records.trajectory import Trajectory

# Styles of the initial and the designed trajectory, and of the identified and the measured motion.
INITIAL = RobotStyle(accent=vocabulary.INITIAL.rgb)
DESIGNED = RobotStyle(accent=vocabulary.DESIGNED.rgb)
IDENTIFIED = RobotStyle(accent=vocabulary.IDENTIFIED.rgb)
MEASURED = RobotStyle(accent=vocabulary.MEASURED.rgb, outline=True)

# Styles of further trajectories and series, one after the other.
FURTHER_STYLES = (
    RobotStyle(accent=(60, 160, 90)),
    RobotStyle(accent=(160, 90, 200)),
    IDENTIFIED,
    RobotStyle(accent=(20, 160, 170)),
)

# Styles of trajectories with a known name.
STYLES_BY_NAME = {vocabulary.INITIAL.word: INITIAL, vocabulary.DESIGNED.word: DESIGNED}

# Entities of the robots of a design, and styles of the plots over the iterations.
INITIAL_ROOT = ("robots", vocabulary.INITIAL.word)
DESIGNED_ROOT = ("robots", vocabulary.DESIGNED.word)
HISTORY_STYLES = (DESIGNED,) * 4

# Colours of the curves over time on the timeline `iteration`.
LEGEND_OF_ITERATES = {vocabulary.INITIAL.word: INITIAL.accent, "iterate": DESIGNED.accent}

# Title of the view with several robots.
OVERLAY = "overlay"

# Largest number of samples of a motion in a file.
MAX_SAMPLES = 20_000


# ---- designs


def log_design(
    path: Path, model: mujoco.MjModel, design: Design, labels: Labels, *, addition: str = ""
) -> None:
    """Write design.rrd: both robots, their signals, sensitivities, the search and a summary.

    Args:
        path: The file.
        model: The model.
        design: The design.
        labels: Labels of the model's columns, usually `labels_of_model(model)`.
        addition: Markdown to append to the summary.
    """
    content = _DesignContent.of(model, design, labels)
    titles = {
        f"{term.word} ({term.colour_name})": ("robots", term.word)
        for term in (vocabulary.INITIAL, vocabulary.DESIGNED)
    }
    poses = list(content.poses.values())
    robots = _robots(model, poses, titles, (INITIAL, DESIGNED), ASPECT_WITH_TEXT)
    layout = arrange(robots, content.tabs(labels))

    with open_recording(path, model, "design", layout) as rec:
        _log_text(rec, design_text(design, addition))
        content.log(rec, labels)


@dataclass(frozen=True, kw_only=True, eq=False)
class _DesignContent:
    """Everything that design.rrd shows of a design, computed once for the layout and for the data.

    Attributes:
        model: The model.
        evaluations: Both trajectories with their information, by name.
        poses: Poses of the bodies along both trajectories.
        states: Plots of states and controls.
        series: Plots of the use of limits and of the information, by the name of their tab.
        phase_plots: Phase plots of the sensitivities.
        iterates: Motions of the iterates; None without any.
        iterate_plots: Their curves.
        history_plots: Plots over the iterations.
    """

    model: mujoco.MjModel
    evaluations: Mapping[str, Evaluation]
    poses: Mapping[str, BodyPoses]
    states: StatePlots
    series: Mapping[str, Sequence[SeriesPlot]]
    phase_plots: Sequence[PhasePlot]
    iterates: IterateCurves | None
    iterate_plots: Sequence[IteratePlot]
    history_plots: Sequence[HistoryPlot]

    @classmethod
    def of(cls, model: mujoco.MjModel, design: Design, labels: Labels) -> _DesignContent:
        """Compute what is shown.

        Args:
            model: The model.
            design: The design.
            labels: Labels of the model's columns.
        """
        evaluations = {
            vocabulary.INITIAL.word: design.initial,
            vocabulary.DESIGNED.word: design.final,
        }
        shown = [
            ShownTrajectory(name=name, trajectory=evaluation.trajectory, style=STYLES_BY_NAME[name])
            for name, evaluation in evaluations.items()
        ]
        limits = limits_of_design(model, design)
        iterates = IterateCurves.of(model, design)
        states = state_plots(model, labels, shown, limits, iterates)
        drawn: list[IteratePlot] = []
        if iterates is not None:
            drawn = iterate_plots(
                iterates,
                design.initial.trajectory,
                states.titles_and_limits("positions"),
                states.titles_and_limits("controls"),
            )

        return cls(
            model=model,
            evaluations=evaluations,
            poses={
                name: body_poses(model, evaluation.trajectory.t, evaluation.trajectory.qpos)
                for name, evaluation in evaluations.items()
            },
            states=states,
            series={
                "limits": usage_plots(design, iterates),
                "information": [_information_plot(design, evaluations)],
            },
            phase_plots=[
                PhasePlot.of_most_sensitive(design, j, model.nv)
                for j in parameters_with_phase_plot(design)
            ],
            iterates=iterates,
            iterate_plots=drawn,
            history_plots=history_plots(design.history, HISTORY_STYLES, design.found_by),
        )

    def tabs(self, labels: Labels) -> list[rrb.Container]:
        """Return the tabs of all signals.

        Args:
            labels: Labels of the model's columns.
        """
        tabs = self.states.tabs()
        for name, plots in self.series.items():
            tabs += grid_tabs(name, views_of(plots))
        tabs += grid_tabs("sensitivities ψ", [plot.view(labels) for plot in self.phase_plots])
        tabs += grid_tabs("optimiser", [shown.plot.view() for shown in self.history_plots])
        return tabs + grid_tabs("iterates", [shown.plot.view() for shown in self.iterate_plots])

    def log(self, rec: rr.RecordingStream, labels: Labels) -> None:
        """Log all data.

        Args:
            rec: The recording.
            labels: Labels of the model's columns.
        """
        for series in (self.states.plots, *self.series.values()):
            for plot in series:
                plot.log(rec)
        for history in self.history_plots:
            history.log(rec)

        for phase in self.phase_plots:
            phase.log_axes(rec, labels)
            for name, evaluation in self.evaluations.items():
                style = STYLES_BY_NAME[name]
                t = evaluation.trajectory.t
                phase.log_curve(rec, t, evaluation.sensitivity, name=name, style=style)

        for name, poses in self.poses.items():
            style = STYLES_BY_NAME[name]
            log_robot(rec, self.model, ("robots", name), poses, style)
        self._log_iterates(rec)

    def _log_iterates(self, rec: rr.RecordingStream) -> None:
        """Log the paths of both robots and the motions of the iterates."""
        initial, designed = self.poses.values()
        log_end_path(rec, self.model, INITIAL_ROOT, initial, INITIAL)
        if self.iterates is None:
            log_end_path(rec, self.model, DESIGNED_ROOT, designed, DESIGNED)
            return

        end = end_point(self.model, designed)
        path = None if end is None else end.path(designed)
        log_poses_of_iterates(rec, DESIGNED_ROOT, self.iterates, DESIGNED, end, path)
        trajectory = self.evaluations[vocabulary.INITIAL.word].trajectory
        still = IterateCurves.of_one(self.model, trajectory)
        log_poses_of_iterates(rec, INITIAL_ROOT, still, INITIAL, None)
        first = {page.start for page in pages_of(len(self.iterate_plots))}
        for k, plot in enumerate(self.iterate_plots):
            plot.log(rec, self.iterates.iterations, INITIAL, DESIGNED)
            if k in first:
                plot.plot.log_legend(rec, LEGEND_OF_ITERATES)


def _information_plot(design: Design, evaluations: Mapping[str, Evaluation]) -> SeriesPlot:
    """Root of the smallest eigenvalue of the information up to each time.

    On the timeline `iteration`, it is that of the whole motion of each iterate.
    """
    curves = []
    for name, evaluation in evaluations.items():
        root = np.sqrt(np.maximum(evaluation.min_eigenvalue, 0.0))
        colour = STYLES_BY_NAME[name].accent
        curves.append(Curve(name=name, t=evaluation.trajectory.t, values=root, colour=colour))

    eigenvalues = np.array([row.min_eigenvalue for row in design.history])
    over_search = Curve(
        name="iterates",
        t=np.array([row.iteration for row in design.history], dtype=np.float64),
        values=np.sqrt(np.maximum(eigenvalues, 0.0)),
        colour=DESIGNED.accent,
        timeline="iteration",
    )
    title = "√λ_min of the information up to each time [√s / θ-unit]"
    return SeriesPlot(parts=("information",), title=title, curves=[*curves, over_search])


# ---- estimates


def log_estimate(
    path: Path,
    model: mujoco.MjModel,
    estimate: Estimate,
    measured: Trajectory | None,
    identified: Trajectory,
    labels: Labels,
    *,
    addition: str = "",
) -> None:
    """Write estimate.rrd: identified and measured robot and outputs, residuals and a summary.

    Args:
        path: The file.
        model: The identified model.
        estimate: The estimate.
        measured: Measured motion, drawn as an outline; None where positions were not measured.
        identified: Motion of the identified model.
        labels: Labels of the model's columns.
        addition: Markdown to append to the summary.
    """
    term = vocabulary.IDENTIFIED
    shown = [ShownTrajectory(name=term.word, trajectory=_thinned(identified), style=IDENTIFIED)]
    title = f"{term.word} robot ({term.colour_name})"
    if measured is not None:
        term = vocabulary.MEASURED
        shown.append(ShownTrajectory(name=term.word, trajectory=_thinned(measured), style=MEASURED))
        title += f", {term.word} robot ({term.colour_name} outline)"

    poses = {
        each.name: body_poses(model, each.trajectory.t, each.trajectory.qpos) for each in shown
    }
    camera = place_camera(model, list(poses.values()), views=1, aspect=ASPECT_WITH_TEXT)
    fitted, held_out = output_plots(model, estimate), held_out_plots(model, estimate)
    states = state_plots(model, labels, shown, limits_of_model(model))
    tabs = recording_tabs(fitted, held_out, list(states.groups))
    followed = ("robots", vocabulary.IDENTIFIED.word)
    view = robot_views(model, camera, {title: ("robots",)}, followed=followed)[0]
    layout = arrange(view, [*tabs, *states.tabs()])

    with open_recording(path, model, "estimate", layout) as rec:
        _log_text(rec, estimate_text(estimate, addition))
        outputs = (recording.plots for recording in (*fitted, *held_out))
        for plot in chain(states.plots, *outputs):
            plot.log(rec)
        for each in shown:
            log_robot(rec, model, ("robots", each.name), poses[each.name], each.style)
        root = ("robots", vocabulary.IDENTIFIED.word)
        log_end_path(rec, model, root, poses[vocabulary.IDENTIFIED.word], IDENTIFIED)


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
    shown = [
        ShownTrajectory(name=name, trajectory=trajectory, style=styles[name])
        for name, trajectory in trajectories.items()
    ]
    states = state_plots(model, labels, shown, limits_of_model(model))
    titles = {name: ("robots", name) for name in trajectories}
    shown_styles = [styles[name] for name in trajectories]
    robots = _robots(model, list(poses.values()), titles, shown_styles, ASPECT_WITHOUT_TEXT)
    layout = arrange(robots, states.tabs(), text=False)

    with open_recording(path, model, "replay", layout) as rec:
        for plot in states.plots:
            plot.log(rec)
        for name in trajectories:
            log_robot(rec, model, ("robots", name), poses[name], styles[name])
            log_end_path(rec, model, ("robots", name), poses[name], styles[name])


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


def _robots(
    model: mujoco.MjModel,
    motions: Sequence[BodyPoses],
    titles: Mapping[str, tuple[str, ...]],
    styles: Sequence[RobotStyle],
    aspect: float,
) -> rrb.Container:
    """Return the views of several robots: separate, and in another tab overlaid.

    Where they are overlaid, all but the last one are translucent, so that it is seen among them.

    Args:
        model: The model.
        motions: Poses along each trajectory.
        titles: Entity of each robot, by the title of its view.
        styles: Style of each robot.
        aspect: Width over height of the region of the robots.
    """
    camera = place_camera(model, motions, views=len(motions), aspect=aspect)
    views = robot_views(model, camera, titles)

    # The camera of a view that is opened later, while a body flies, would begin in a wrong place.
    still = place_camera(model, motions, views=1, aspect=aspect, follow=False)
    pale: dict[str, rrb.Visualizer] = {}
    for root, style in list(zip(titles.values(), styles, strict=True))[:-1]:
        pale |= pale_shapes(model, root, style)
    overlay = robot_views(model, still, {OVERLAY: ("robots",)}, overrides=pale)[0]
    return separate_and_overlaid(views, camera, overlay)


def _log_text(rec: rr.RecordingStream, markdown: str) -> None:
    """Log the text of the summary panel."""
    document = rr.TextDocument(markdown, media_type=rr.MediaType.MARKDOWN)
    rec.log(entity_path(("summary",)), document, static=True, strict=True)
