"""The live view of a search: cost and information over the iterates, and the best motion so far.

Searches from several initial controls may run side by side, so that their iterates come mixed. The
robot and the curves over time show the best iterate of all so far, and the text says where it comes
from.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mjfim.arrays import evenly_spread_indices
from mjfim.output import vocabulary
from mjfim.output.progress_text import design_stage, design_text, progress_line
from mjfim.output.rerun.camera import Camera, place_camera
from mjfim.output.rerun.layout import ASPECT_WITH_TEXT, LEFT_TO_RIGHT, robot_views
from mjfim.output.rerun.live_curves import LiveCurves
from mjfim.output.rerun.scene import (
    BodyPoses,
    EntityParts,
    body_parts,
    body_poses,
    end_point,
    entity_path,
    is_moving,
    log_robot,
    rerun_quaternion,
    strip_of_path,
)
from mjfim.output.rerun.shapes import RobotStyle
from mjfim.records.design import HistoryRow, IterateMotion
from mjfim.records.events import DesignEvent, Event, FitEvent, StudyEvent

# Shortest time between two transmissions [s].
UPDATE_SECONDS = 0.3

# Largest number of points of a series in one transmission.
MAX_POINTS = 500

# Samples of a motion from which its path is drawn.
PATH_SAMPLES = 120

# Transmissions in which the robot passes through its motion once.
UPDATES_PER_MOTION = 12

# Longest time to wait at the end for what is still to be transmitted [s].
FLUSH_SECONDS = 3.0

# Timeline of the events, which are counted over all starts and phases.
TIMELINE = "event"

# Entity and style of the robot.
ROBOT: EntityParts = ("robot",)
STYLE = RobotStyle(accent=vocabulary.DESIGNED.rgb)

# Colours of series that share a plot, one after the other.
COLOURS = (
    vocabulary.DESIGNED.rgb,
    vocabulary.INITIAL.rgb,
    *(term.rgb for term in (vocabulary.MEASURED, vocabulary.NOMINAL, vocabulary.IDENTIFIED)),
    vocabulary.OTHER.rgb,
)

# Plots with a curve for each start, and the look of the curves of other starts than the one of the
# best iterate: name in the legend, colour and width.
PLOTS_BY_START = ("cost", "eigenvalue")
OTHER_STARTS, OTHER_COLOUR, OTHER_WIDTH = "other starts", (130, 130, 130), 1.0
BEST_WIDTH = 2.0

# Heights of robot, plots over the events, and text, relative to each other.
LEFT_HEIGHTS = [9, 7, 5]

# Growth of the distance at which the camera has all motions in view above which it steps back, and
# shift of the point at which it looks, as a share of this distance, above which it turns.
STEP_BACK, TURN = 1.25, 0.1

# Corners of the legends: where falling curves and rising curves are not.
FALLING, RISING = rrb.Corner2D.RightTop, rrb.Corner2D.RightBottom

# Titles and legends of the plots by the kind of event.
PLOTS: dict[type[Event], dict[str, tuple[str, rrb.Corner2D]]] = {
    DesignEvent: {
        "cost": ("log10 of the cost J", FALLING),
        "eigenvalue": ("log10 of λ_min", RISING),
    },
    FitEvent: {
        "squares": ("log10 of half the sum of squares", FALLING),
        "step": ("log10 of the step [σ]", FALLING),
    },
    StudyEvent: {"share": ("finished [%]", RISING)},
}

# Text before the first event.
WAITING = "The first result is on its way."


@dataclass(kw_only=True)
class _Series:
    """Points of one curve that are not transmitted yet.

    Attributes:
        parts: Its entity.
        events: Numbers of the events.
        values: Values.
    """

    parts: EntityParts
    events: list[int] = field(default_factory=list)
    values: list[float] = field(default_factory=list)

    def send(self, rec: rr.RecordingStream) -> None:
        """Transmit the points, at most `MAX_POINTS` of them.

        Args:
            rec: The connection.
        """
        if not self.events:
            return
        rows = evenly_spread_indices(len(self.events), MAX_POINTS)
        timeline = rr.TimeColumn(TIMELINE, sequence=np.array(self.events, dtype=np.int64)[rows])
        columns = rr.Scalars.columns(scalars=np.array(self.values)[rows])
        rec.send_columns(entity_path(self.parts), [timeline], columns, strict=True)
        self.events.clear()
        self.values.clear()


class LiveShow:
    """Transmits events to a viewer, a few times a second at most."""

    def __init__(
        self,
        rec: rr.RecordingStream,
        model: mujoco.MjModel,
        now: Callable[[], float] = time.monotonic,
        *,
        wakes: bool = False,
    ) -> None:
        """Show the events of searches on one model.

        Args:
            rec: The connection.
            model: The model.
            now: Clock [s].
            wakes: True to transmit the last events of a burst a moment later, in a thread. Searches
                in other processes deliver all their iterates at once, and then nothing for a while.
        """
        self._wakes = wakes
        self._lock = threading.Lock()
        self._timer: threading.Timer | None = None
        self._failure: Exception | None = None
        self._rec = rec
        self._model = model
        self._now = now
        self._sent = -np.inf
        self._events = self._transmitted = 0
        self._updates = 0
        self._kinds: list[type[Event]] = []
        self._series: dict[EntityParts, _Series] = {}
        self._text = ""
        self._best: DesignEvent | None = None
        self._curves = LiveCurves(model, STYLE.accent)
        self._camera: Camera | None = None
        self._in_view: list[BodyPoses] = []
        self._arranged: tuple[object, ...] = ()

        # The viewer shows something from the beginning. A text without a time would be static and
        # hide those that follow.
        rec.set_log_time_enabled(False)
        self._rec.set_time(TIMELINE, sequence=0)
        self._show_text(WAITING)
        self._rec.reset_time()
        self._arrange()

    @classmethod
    def connected(cls, url: str, model: mujoco.MjModel) -> LiveShow:
        """Connect to a viewer.

        Args:
            url: Where it listens.
            model: The model.
        """
        rec = rr.RecordingStream("mjfim live")
        rec.connect_grpc(url)
        return cls(rec, model, wakes=True)

    def __call__(self, event: Event) -> None:
        """Take an event, and transmit what was taken if the last time was a moment ago.

        Args:
            event: The event.
        """
        self._raise_failure()
        with self._lock:
            is_first = type(event) not in self._kinds
            if is_first:
                self._kinds.append(type(event))
            self._take(event)

            if is_first or self._now() - self._sent >= UPDATE_SECONDS:
                self._transmit()
            elif self._wakes and self._timer is None:
                self._timer = threading.Timer(UPDATE_SECONDS, self._wake)
                self._timer.daemon = True
                self._timer.start()

    def end(self) -> None:
        """Transmit what was taken, and close the connection."""
        self._raise_failure()
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            self._transmit()
        self._rec.flush(timeout_sec=FLUSH_SECONDS)
        self._rec.disconnect()

    def _wake(self) -> None:
        """Transmit the last events of a burst; a failure is raised at the next event."""
        try:
            with self._lock:
                self._timer = None
                self._transmit()
        except Exception as error:
            self._failure = error

    def _raise_failure(self) -> None:
        """Raise the failure of a transmission in the thread."""
        if self._failure is not None:
            raise self._failure

    def _take(self, event: Event) -> None:
        """Keep the numbers of an event."""
        if isinstance(event, DesignEvent):
            self._add("cost", event.start, _logarithm(event.row.cost))
            self._add("eigenvalue", event.start, _logarithm(event.row.min_eigenvalue))
            self._keep_if_best(event)
        elif isinstance(event, FitEvent):
            self._add("squares", event.phase, _logarithm(event.cost))
            self._add("step", event.phase, _logarithm(event.step))
        elif event.count is not None:
            share = (event.index + event.share) / max(event.count, 1)
            self._add("share", event.study, 100.0 * share)
        self._text = _text_of(event, self._best)
        self._events += 1

    def _keep_if_best(self, event: DesignEvent) -> None:
        """Show an iterate from now on if none before was better; mark the curves of its start."""
        if event.row.motion is None:
            return
        best = self._best
        if best is not None and _rank(event.row) < _rank(best.row):
            return

        self._best = event
        if best is None or best.start != event.start:
            for plot, start in [parts for parts in self._series if parts[0] in PLOTS_BY_START]:
                self._log_look(plot, start)

    def _add(self, plot: str, name: str, value: float) -> None:
        """Add a point to a curve; a value that is not finite is left out."""
        if not np.isfinite(value):
            return

        parts = (plot, name)
        if parts not in self._series:
            self._series[parts] = _Series(parts=parts)
            self._log_look(plot, name)

        series = self._series[parts]
        series.events.append(self._events)
        series.values.append(value)

    def _log_look(self, plot: str, name: str) -> None:
        """Log the name and the colour of a curve; of several starts, the best one stands out."""
        names = [known for beside, known in self._series if beside == plot]
        colour, shown, width = COLOURS[names.index(name) % len(COLOURS)], name, BEST_WIDTH
        if plot in PLOTS_BY_START:
            is_best = self._best is None or self._best.start == name
            colour = STYLE.accent if is_best else OTHER_COLOUR
            shown = name if is_best else OTHER_STARTS
            width = BEST_WIDTH if is_best else OTHER_WIDTH

        line = rr.SeriesLines(colors=[colour], names=[shown], widths=[width])
        self._rec.log(entity_path((plot, name)), line, static=True, strict=True)

    # ---- transmission

    def _transmit(self) -> None:
        """Transmit what was taken."""
        self._sent = self._now()
        if self._events == self._transmitted:
            return
        self._transmitted = self._events

        for series in self._series.values():
            series.send(self._rec)

        self._rec.set_time(TIMELINE, sequence=self._events - 1)
        self._show_text(self._text)
        if self._best is not None and self._best.row.motion is not None:
            self._show_motion(self._best.row.motion)
        self._rec.reset_time()
        self._arrange()
        self._updates += 1

    def _show_text(self, text: str) -> None:
        """Show what is done."""
        self._rec.log(entity_path(("progress",)), rr.TextDocument(text), strict=True)

    def _show_motion(self, motion: IterateMotion) -> None:
        """Draw the path of the robot's end, and the robot at one sample of its motion."""
        rows = evenly_spread_indices(len(motion.t), PATH_SAMPLES)
        qpos = np.asarray(motion.qpos, dtype=np.float64)[rows]
        if not np.isfinite(qpos).all():
            return

        poses = body_poses(self._model, np.asarray(motion.t, dtype=np.float64)[rows], qpos)
        self._see(poses)
        self._curves.log(self._rec, motion)

        # With every transmission, the robot moves on.
        share = self._updates % UPDATES_PER_MOTION / UPDATES_PER_MOTION
        sample = round(share * (len(rows) - 1))
        for body in filter(lambda b: is_moving(self._model, b), range(1, self._model.nbody)):
            pose = rr.Transform3D(
                translation=poses.positions[sample, body],
                quaternion=rerun_quaternion(poses.quaternions[sample, body]),
            )
            self._rec.log(entity_path(body_parts(self._model, ROBOT, body)), pose, strict=True)

        end = end_point(self._model, poses)
        if end is not None:
            path = strip_of_path(end.path(poses), STYLE)
            self._rec.log(entity_path((*ROBOT, "path")), path, strict=True)

    def _see(self, poses: BodyPoses) -> None:
        """Place the camera so that a motion is in view; at the first one, log the shapes."""
        # The view begins while the robot moves, from where a camera cannot follow a body.
        motions = [*self._in_view, poses]
        camera = place_camera(self._model, motions, 1, ASPECT_WITH_TEXT, follow=False)
        if self._camera is None:
            first = BodyPoses(
                t=poses.t[:1], positions=poses.positions[:1], quaternions=poses.quaternions[:1]
            )
            log_robot(self._rec, self._model, ROBOT, first, STYLE)
            self._camera, self._in_view = camera, motions
        elif _shows_more(camera, self._camera):
            self._camera, self._in_view = camera, motions

    def _arrange(self) -> None:
        """Lay out the plots of the kinds of events that came, and the robot."""
        content = (tuple(self._kinds), self._camera)
        if content == self._arranged:
            return
        self._arranged = content

        plots: list[rrb.View] = []
        for kind in self._kinds:
            for plot, (title, corner) in PLOTS[kind].items():
                legend = rrb.PlotLegend(corner)
                origin = entity_path((plot,))
                plots.append(rrb.TimeSeriesView(origin=origin, name=title, plot_legend=legend))
        progress = rrb.TextDocumentView(origin=entity_path(("progress",)), name="progress")
        layout: rrb.Container = rrb.Vertical(*plots, progress, row_shares=[3] * len(plots) + [1])
        if self._camera is not None:
            (robot,) = robot_views(self._model, self._camera, {"best iterate so far": ROBOT})
            over_events = rrb.Grid(*plots, grid_columns=2)
            left = rrb.Vertical(robot, over_events, progress, row_shares=LEFT_HEIGHTS)
            over_time = rrb.Tabs(*self._curves.tabs(), active_tab=0)
            layout = rrb.Horizontal(left, over_time, column_shares=LEFT_TO_RIGHT)

        panel = rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following")
        blueprint = rrb.Blueprint(
            layout,
            rrb.BlueprintPanel(state="collapsed"),
            rrb.SelectionPanel(state="collapsed"),
            panel,
            auto_layout=False,
            auto_views=False,
        )
        self._rec.send_blueprint(blueprint, make_active=True, make_default=True)


def _rank(row: HistoryRow) -> tuple[float, bool, float]:
    """Order of the iterates, the best one last.

    A finer time grid comes first, because costs on different grids cannot be compared, then the
    limits, then the cost.
    """
    return row.rate, not row.margin < 0.0, -row.cost


def _text_of(event: Event, best: DesignEvent | None) -> str:
    """Describe the newest event, and from where the iterate comes that is shown."""
    if not isinstance(event, DesignEvent):
        return progress_line(event).text

    lines = [f"newest: {event.start}, {design_stage(event)}", design_text(event)]
    if best is not None:
        lines += [f"best so far, shown: {best.start}", design_text(best)]
    return "\n".join(lines)


def _logarithm(value: float) -> float:
    """Logarithm to base 10; NaN where there is none."""
    return float(np.log10(value)) if value > 0.0 else float("nan")


def _shows_more(camera: Camera, before: Camera) -> bool:
    """Whether a camera has to be moved to the place of another one to have all motions in view."""
    turned = float(np.linalg.norm(np.subtract(camera.target, before.target)))
    distance = _distance(before)
    return _distance(camera) > STEP_BACK * distance or turned > TURN * distance


def _distance(camera: Camera) -> float:
    """Distance of a camera from the point at which it looks [m]."""
    return float(np.linalg.norm(np.subtract(camera.position, camera.target)))
