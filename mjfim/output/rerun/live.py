"""The live view of a search: cost and information over the iterates, and the best motion so far."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mjfim.arrays import Array, evenly_spread_indices
from mjfim.experiment.arguments import checked
from mjfim.experiment.schema import ExperimentLike
from mjfim.experiment.system import System, labels_of_model
from mjfim.output.archive import shown_positions
from mjfim.output.live import design_stage, design_text, live_system, progress_line
from mjfim.output.page import DESIGNED, IDENTIFIED, INITIAL, MEASURED, NOMINAL, OTHER
from mjfim.output.panels import line
from mjfim.output.rerun.camera import Camera, place_camera
from mjfim.output.rerun.documents import (
    ASPECT_WITH_TEXT,
    LEFT_TO_RIGHT,
    blueprint_of,
    robot_views,
)
from mjfim.output.rerun.plots import Plane, grid_tabs
from mjfim.output.rerun.scene import (
    BodyPoses,
    body_poses,
    end_point,
    entity_path,
    log_end_path,
    log_pose,
    log_robot,
    rgb,
)
from mjfim.records.design import HistoryRow
from mjfim.records.events import Callback, DesignEvent, Event, FitEvent, StudyEvent
from mjfim.records.worth import Watch

# Shortest time between two motions that are shown [s], samples of a motion, and motions in which
# the robot passes through its motion once.
UPDATE_SECONDS, MOTION_SAMPLES, UPDATES_PER_MOTION = 0.3, 120, 12

# Longest time to wait at the end for what is still to be transmitted [s].
FLUSH_SECONDS = 3.0

# Timeline of the events, which are counted over all starts and phases, that of a stream, and entity
# of the robot.
TIMELINE, STREAM_TIMELINE, ROBOT = "event", "time", ("robot",)

# Roles of curves that share a plot.
ROLES_IN_TURN = (DESIGNED, INITIAL, MEASURED, NOMINAL, IDENTIFIED, OTHER)

# Name, colour and width of the curves of other starts than the one of the best iterate.
OTHER_STARTS, OTHER_COLOUR, OTHER_WIDTH, BEST_WIDTH = "other starts", (130, 130, 130), 1.0, 2.0

# Name of the line that the accuracy of a stream shall reach.
WANTED = "wanted"

# Heights of robot, plots over the events, and text, relative to each other.
LEFT_HEIGHTS = [9, 7, 5]

# Titles of the plots by the kind of event, and plots with a curve for each start.
PLOTS: dict[type[Event | Watch], dict[str, str]] = {
    DesignEvent: {"cost": "log10 of the cost J", "eigenvalue": "log10 of λ_min"},
    FitEvent: {"squares": "log10 of half the sum of squares", "step": "log10 of the step [σ]"},
    StudyEvent: {"share": "finished [%]"},
    Watch: {"accuracy": "log10 of σ over the wanted σ"},
}
PLOTS_BY_START = tuple(PLOTS[DesignEvent])


class LiveShow:
    """Transmits events to a viewer."""

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
            rec: Stream to the viewer.
            model: The model.
            now: A clock [s].
            wakes: Whether the end of a burst of events is shown without a further event.
        """
        self._wakes, self._lock = wakes, threading.Lock()
        self._timer: threading.Timer | None = None
        self._rec, self._model, self._now = rec, model, now
        self._events = self._updates = 0
        self._sent = -np.inf
        self._kinds: list[type[Event | Watch]] = []
        self._curves: list[tuple[str, str]] = []
        self._best: DesignEvent | None = None
        self._is_shown = True
        self._camera: Camera | None = None
        self._planes: dict[str, list[Plane]] = {}

        # The viewer shows something from the beginning.
        rec.set_log_time_enabled(False)
        self._show_text("The first result is on its way.")
        self._arrange()

    @classmethod
    def connected(cls, url: str, model: mujoco.MjModel) -> LiveShow:
        """Connect to a viewer.

        Args:
            url: URL of the viewer.
            model: The model.
        """
        rec = rr.RecordingStream("mjfim live")
        rec.connect_grpc(url)
        return cls(rec, model, wakes=True)

    def __call__(self, event: Event) -> None:
        """Show an event; the best motion if the last one was shown a moment ago.

        Args:
            event: The event.
        """
        with self._lock:
            self._take(event)
            if self._now() - self._sent >= UPDATE_SECONDS:
                self._show_best()
            elif self._wakes and self._timer is None:
                self._timer = threading.Timer(UPDATE_SECONDS, self._wake)
                self._timer.daemon = True
                self._timer.start()

    def _wake(self) -> None:
        """Show the best motion of a burst; the next event raises a fault again."""
        with self._lock, suppress(Exception):
            self._timer = None
            self._show_best()

    def _take(self, event: Event) -> None:
        self._rec.set_time(TIMELINE, sequence=self._events)
        self._events += 1
        result = event.result if isinstance(event, StudyEvent) else None
        kind = Watch if isinstance(result, Watch) else type(event)
        if kind not in self._kinds:
            self._kinds.append(kind)
            self._arrange()
        if isinstance(event, DesignEvent):
            self._add("cost", event.start, _logarithm(event.row.cost))
            self._add("eigenvalue", event.start, _logarithm(event.row.min_eigenvalue))
            self._keep_if_best(event)
        elif isinstance(event, FitEvent):
            self._add("squares", event.phase, _logarithm(event.cost))
            self._add("step", event.phase, _logarithm(event.step))
        elif isinstance(result, Watch):
            self._add_accuracy(result)
        elif event.count:
            share = (event.index + event.share) / event.count
            self._add("share", event.study, 100.0 * share)
        self._show_text(_text_of(event, self._best))

    def _add_accuracy(self, watch: Watch) -> None:
        """Add σ over its wanted value of each parameter, on the timeline of the stream."""
        self._rec.set_time(STREAM_TIMELINE, duration=watch.seconds)
        self._add("accuracy", WANTED, 0.0)
        for j in watch.asked.tolist():
            share = float(watch.std[j] / watch.wanted[j])
            self._add("accuracy", watch.parameters[j], _logarithm(share))

    def end(self) -> None:
        """Show the best motion, and close the connection."""
        with self._lock:
            if self._timer is not None:
                self._timer.cancel()
            self._show_best()
        self._rec.flush(timeout_sec=FLUSH_SECONDS)
        self._rec.disconnect()

    def _keep_if_best(self, event: DesignEvent) -> None:
        """Show an iterate from now on if none before was better; mark the curves of its start."""
        if event.row.motion is None:
            return
        before, self._is_shown = self._best, False
        if before is not None and _rank(event.row) < _rank(before.row):
            return
        self._best = event
        if before is None or before.start != event.start:
            for plot, start in self._curves:
                if plot in PLOTS_BY_START:
                    self._log_look(plot, start)

    def _add(self, plot: str, name: str, value: float) -> None:
        """Add a point to a curve; a value that is not finite is left out."""
        if not np.isfinite(value):
            return
        if (plot, name) not in self._curves:
            self._curves.append((plot, name))
            self._log_look(plot, name)
        self._rec.log(entity_path((plot, name)), rr.Scalars(value), strict=True)

    def _log_look(self, plot: str, name: str) -> None:
        """Log the name and the colour of a curve; of several starts, the best one stands out."""
        place = [known for beside, known in self._curves if beside == plot].index(name)
        colour, shown, width = rgb(ROLES_IN_TURN[place % len(ROLES_IN_TURN)]), name, BEST_WIDTH
        if plot in PLOTS_BY_START:
            colour = rgb(DESIGNED)
            if self._best is not None and self._best.start != name:
                colour, shown, width = OTHER_COLOUR, OTHER_STARTS, OTHER_WIDTH
        if name == WANTED:
            colour = OTHER_COLOUR
        look = rr.SeriesLines(colors=[colour], names=[shown], widths=[width])
        self._rec.log(entity_path((plot, name)), look, static=True, strict=True)

    def _show_text(self, text: str) -> None:
        # A text without a time would be static and hide those that follow.
        self._rec.set_time(TIMELINE, sequence=max(self._events - 1, 0))
        self._rec.log(entity_path(("progress",)), rr.TextDocument(text), strict=True)

    # ---- the best motion

    def _show_best(self) -> None:
        """Show the path of the best motion, the robot at one sample, and the curves over time."""
        self._sent = self._now()
        best = self._best
        if self._is_shown or best is None or best.row.motion is None:
            return
        self._is_shown = True
        self._rec.set_time(TIMELINE, sequence=self._events - 1)
        t, qpos, ctrl = best.row.motion
        rows = evenly_spread_indices(len(t), MOTION_SAMPLES)
        if not np.isfinite(qpos[rows]).all():
            return
        poses = body_poses(self._model, t[rows], qpos[rows])
        if self._camera is None:
            self._begin(poses)

        # With every transmission, the robot moves on.
        share = self._updates % UPDATES_PER_MOTION / UPDATES_PER_MOTION
        self._updates += 1
        log_pose(self._rec, self._model, ROBOT, poses, round(share * (len(rows) - 1)))
        log_end_path(self._rec, ROBOT, poses, end_point(self._model, poses), DESIGNED)
        _, (positions,) = shown_positions(labels_of_model(self._model), qpos)
        for group, values in (("positions", positions), ("controls", ctrl)):
            for k, (plane, y) in enumerate(zip(self._planes[group], values.T, strict=True)):
                self._planes[group][k] = self._log_curve(plane, t[: len(y)], y)

    def _begin(self, poses: BodyPoses) -> None:
        """Log the shapes and the first axes, and place the camera around the first motion."""
        first = BodyPoses(
            t=poses.t[:1], positions=poses.positions[:1], quaternions=poses.quaternions[:1]
        )
        log_robot(self._rec, self._model, ROBOT, first, DESIGNED)
        self._camera = place_camera(self._model, [poses], 1, ASPECT_WITH_TEXT, follow=False)
        labels = labels_of_model(self._model)
        self._planes = {
            group: [Plane.around((group, title), f"{title} over time [s]", []) for title in titles]
            for group, titles in (("positions", labels.positions), ("controls", labels.controls))
        }
        self._arrange()

    def _log_curve(self, plane: Plane, t: Array, y: Array) -> Plane:
        """Log a curve with axes that hold all curves before it; return the axes."""
        seen = [line(t, y, "text")]
        if self._updates > 1:
            seen.append(line([t[0], t[0]], plane.y, "text"))
        grown = Plane.around(plane.parts, plane.title, seen)
        grown.log(self._rec, static=False)
        curve = grown.curve(t, y, DESIGNED)
        self._rec.log(entity_path((*plane.parts, "iterate")), curve, strict=True)
        return grown

    def _arrange(self) -> None:
        """Lay out the plots of the kinds of events that came, and the robot."""
        plots: list[rrb.View] = [
            rrb.TimeSeriesView(origin=entity_path((plot,)), name=title)
            for kind in self._kinds
            for plot, title in PLOTS[kind].items()
        ]
        progress = rrb.TextDocumentView(origin=entity_path(("progress",)), name="progress")
        layout: rrb.Container = rrb.Vertical(*plots, progress, row_shares=[3] * len(plots) + [1])
        if self._camera is not None:
            (robot,) = robot_views(self._model, self._camera, {"best iterate so far": ROBOT})
            over_events = rrb.Grid(*plots, grid_columns=2)
            left = rrb.Vertical(robot, over_events, progress, row_shares=LEFT_HEIGHTS)
            layout = rrb.Horizontal(left, self._curves_of_best(), column_shares=LEFT_TO_RIGHT)
        timeline = STREAM_TIMELINE if Watch in self._kinds else TIMELINE
        panel = rrb.TimePanel(state="collapsed", timeline=timeline, play_state="following")
        self._rec.send_blueprint(blueprint_of(layout, panel), make_active=True, make_default=True)

    def _curves_of_best(self) -> rrb.Tabs:
        """Return tabs with the positions and the controls of the best motion."""
        tabs = [
            tab
            for group, planes in self._planes.items()
            for tab in grid_tabs(group, [plane.view() for plane in planes])
        ]
        return rrb.Tabs(*tabs, active_tab=0)


def _rank(row: HistoryRow) -> tuple[float, bool, float]:
    """Order of the iterates, the best one last.

    Costs on different time grids cannot be compared: a finer one counts more. Within one, an
    iterate within the limits counts more than one outside of them.
    """
    return row.rate, not row.margin < 0.0, -row.cost


def _text_of(event: Event, best: DesignEvent | None) -> str:
    """Describe the newest event, and from where the iterate comes that is shown."""
    if not isinstance(event, DesignEvent):
        return progress_line(event)[0]
    lines = [f"newest: {event.start}, {design_stage(event)}", design_text(event)]
    if best is not None:
        lines += [f"best so far, shown: {best.start}", design_text(best)]
    return "\n".join(lines)


def _logarithm(value: float) -> float:
    """Logarithm to base 10; NaN where there is none."""
    return float(np.log10(value)) if value > 0.0 else float("nan")


@checked
@contextmanager
def live(
    experiment: ExperimentLike,
    address: str | None = None,
    *,
    say: Callable[[str], object] | None = None,
) -> Iterator[Callback]:
    """Show in a Rerun viewer how a search proceeds; a context around the verb.

    What it yields is the `callback` of `design`, `identify`, `monte_carlo` and the other verbs:

        with mjfim.live(experiment) as show:
            design = mjfim.design(experiment, callback=show)

    The viewer shows the cost and the smallest eigenvalue of the information over the iterates, and
    the motion of the best one so far: the robot, and its positions and controls over time. The
    result is the same with and without it. Where there is no viewer, one sentence says so, and the
    work goes on.

    Args:
        experiment: The experiment, whose model is shown.
        address: Where a viewer listens, `HOST:PORT` or a URL `rerun+http://HOST:PORT/proxy`.
            Default: the viewer of this computer, which is opened if there is none.
        say: Takes the sentence; default: it is printed to stderr.

    Yields:
        The function that takes the events.

    Raises:
        ExperimentError: The address has another form.
    """
    with live_system(System.resolve(experiment), address, say=say) as show:
        yield show
