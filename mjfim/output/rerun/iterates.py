"""Motions of the iterates of a search in Rerun, on the timeline `iteration`.

At each iterate the robot is drawn in several poses of the motion, with the path of its end, and
each position and control as a 2D curve over time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np
import rerun as rr

from mjfim.arrays import Array
from mjfim.output.rerun.panels import dof_positions, plot_size
from mjfim.output.rerun.scene import (
    CAPSULES,
    BodyPoses,
    EndPoint,
    EntityParts,
    body_parts,
    body_poses,
    entity_path,
    is_moving,
    strip_of_path,
)
from mjfim.output.rerun.series import Curve, Range, range_with_limits
from mjfim.output.rerun.shapes import SOLID, DrawnShape, RobotStyle, drawn_shapes
from mjfim.output.rerun.strips import StripPlot
from mjfim.plant.state_space import quaternion_product
from mjfim.records.design import Design, IterateMotion, IterateMotions
from mjfim.records.trajectory import Trajectory

# Number of poses in which the robot is drawn at an iterate, evenly spread over its motion.
POSES = 4

# A plot reaches to the limits if its range is then at most this many times as large: less than in
# plots that show no change of the curves.
LARGEST_ZOOM = 3.0

# What turns a unit quaternion, wxyz, into its inverse.
CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])

# Thickness of the curve of the initial trajectory relative to that of an iterate.
INITIAL_WIDTH = 0.6


@dataclass(frozen=True, kw_only=True, eq=False)
class IterateCurves:
    """Motions of m iterates as curves over n times.

    Attributes:
        model: The model.
        motions: The motions.
    """

    model: mujoco.MjModel
    motions: IterateMotions

    @classmethod
    def of(cls, model: mujoco.MjModel, design: Design) -> IterateCurves | None:
        """Return the motions of a design.

        A design without motions of its iterates has those with which the search began and ended.

        Args:
            model: The model.
            design: The design.

        Returns:
            The motions; None for a design without iterates.
        """
        if not design.history:
            return None
        if design.motions is not None:
            return cls(model=model, motions=design.motions)
        ends = {0: design.initial.trajectory, max(design.iterations, 1): design.final.trajectory}
        return cls(model=model, motions=_joined(ends))

    @classmethod
    def of_one(cls, model: mujoco.MjModel, trajectory: Trajectory) -> IterateCurves:
        """Return a trajectory as the only iterate, whose number is 0.

        Args:
            model: The model.
            trajectory: The trajectory.
        """
        return cls(model=model, motions=_joined({0: trajectory}))

    @property
    def iterations(self) -> Array:
        """(m,) numbers of the iterates."""
        return np.asarray(self.motions.iteration, dtype=np.float64)

    @cached_property
    def positions(self) -> Array:
        """(m, n, nv) positions by degree of freedom [m or rad]."""
        qpos = np.asarray(self.motions.qpos, dtype=np.float64)
        return np.stack([dof_positions(self.model, each) for each in qpos])

    @property
    def controls(self) -> Array:
        """(m, n, nu) controls [unit of the actuator]."""
        return np.asarray(self.motions.ctrl, dtype=np.float64)

    @cached_property
    def velocities(self) -> Array:
        """(m, n-1, nv) mean velocities between samples [m/s or rad/s]."""
        t = np.asarray(self.motions.t, dtype=np.float64)
        qpos = np.asarray(self.motions.qpos, dtype=np.float64)
        velocities = np.full((len(qpos), qpos.shape[1] - 1, self.model.nv), np.nan)
        for i, k in np.ndindex(velocities.shape[:2]):
            dt = t[i, k + 1] - t[i, k]

            # A short motion repeats samples.
            if dt > 0.0:
                mujoco.mj_differentiatePos(
                    self.model, velocities[i, k], dt, qpos[i, k], qpos[i, k + 1]
                )
        return velocities

    @cached_property
    def poses(self) -> BodyPoses:
        """Poses of all bodies at all m * n samples."""
        qpos = np.asarray(self.motions.qpos, dtype=np.float64).reshape(-1, self.model.nq)
        return body_poses(self.model, np.zeros(len(qpos)), qpos)

    def extremes(self, values: Array, colour: tuple[int, int, int]) -> Curve:
        """Return the lowest and the highest value of each iterate as a curve.

        Args:
            values: (m, n) values.
            colour: Colour (0..255).
        """
        lowest, highest = np.nanmin(values, axis=1), np.nanmax(values, axis=1)
        return Curve(
            name="iterates",
            t=self.iterations,
            values=np.column_stack([lowest, highest]),
            colour=colour,
            timeline="iteration",
            legend=("lowest of the iterate", "highest of the iterate"),
        )


def _joined(trajectories: dict[int, Trajectory]) -> IterateMotions:
    """Join trajectories by the number of their iterate."""
    thinned = [(k, IterateMotion.of(trajectory)) for k, trajectory in trajectories.items()]
    joined = IterateMotions.of([(k, motion) for k, motion in thinned if motion is not None])
    if joined is None:
        raise ValueError("there is no trajectory to join")
    return joined


# ---- the robot


def log_poses_of_iterates(
    rec: rr.RecordingStream,
    root: EntityParts,
    curves: IterateCurves,
    style: RobotStyle,
    end: EndPoint | None,
    now: Array | None = None,
) -> None:
    """Log the robot on the timeline `iteration`: several poses, and the path of its end.

    The robot itself has to be logged, too: its shapes are repeated, not copied.

    Args:
        rec: The recording.
        root: Entity of the robot.
        curves: The motions.
        style: Style of the robot.
        end: The end of the robot; None where nothing moves.
        now: (N+1, 3) path of the end that is drawn on `sim_time` [m]; None for that of the last
            iterate.
    """
    model, poses = curves.model, curves.poses
    m, n = curves.motions.t.shape
    iterations = rr.TimeColumn("iteration", sequence=curves.iterations.astype(np.int64))

    # (m, POSES) rows of `poses` at which the robot is drawn.
    rows = n * np.arange(m)[:, None] + np.linspace(0, n - 1, POSES).round().astype(np.intp)
    for body in filter(lambda b: is_moving(model, b), range(1, model.nbody)):
        parts = body_parts(model, root, body)
        place = poses.positions[:, body]
        turn = poses.quaternions[:, body]
        first = rows[:, 0]
        columns = rr.Transform3D.columns(translation=place[first], quaternion=_xyzw(turn[first]))
        rec.send_columns(entity_path(parts), [iterations], columns, strict=True)

        for shape in drawn_shapes(model, body, style):
            translations, quaternions = _repeated(
                place, turn, shape.position, shape.quaternion, rows
            )
            _send_instances(rec, parts, shape, iterations, translations, quaternions)

    if end is not None:
        _log_paths(rec, root, end.path(poses).reshape(m, n, 3), curves.iterations, style, now)


def _send_instances(
    rec: rr.RecordingStream,
    parts: EntityParts,
    shape: DrawnShape,
    iterations: rr.TimeColumn,
    translations: Array,
    quaternions: Array,
) -> None:
    """Log poses of a shape in its own frame, `POSES` of them for each iteration."""
    count = len(translations)
    path = entity_path((*parts, shape.name))
    if not isinstance(shape.archetype, rr.Capsules3D):
        instances = rr.InstancePoses3D.columns(translations=translations, quaternions=quaternions)
        partition = instances.partition([POSES] * (count // POSES))
        rec.send_columns(path, [iterations], partition, strict=True)
        return

    # The viewer does not repeat capsules at instance poses, so that there are several of them.
    path = f"{path}/{entity_path((CAPSULES,)).lstrip('/')}"
    still = rr.Capsules3D.from_fields(colors=[shape.rgba], fill_mode=SOLID)
    rec.log(path, still, static=True, strict=True)
    columns = rr.Capsules3D.columns(
        lengths=[shape.length] * count,
        radii=[shape.radius] * count,
        translations=translations,
        quaternions=quaternions,
    )
    partition = columns.partition([POSES] * (count // POSES))
    rec.send_columns(path, [iterations], partition, strict=True)


def _repeated(
    place: Array, turn: Array, position: Array, offset: Array, rows: Array
) -> tuple[Array, Array]:
    """Poses of a shape at several samples, in its own frame at the first of them.

    Args:
        place: (samples, 3) origins of the body [m].
        turn: (samples, 4) its orientations, wxyz.
        position: (3,) origin of the shape in the frame of the body [m].
        offset: (4,) its orientation there, wxyz.
        rows: (m, POSES) samples.

    Returns:
        (m * POSES, 3) translations [m] and (m * POSES, 4) quaternions, xyzw.
    """
    at, first = rows.ravel(), np.repeat(rows[:, 0], rows.shape[1])
    origins = place + _turned(position, turn)
    turns = quaternion_product(turn, offset)
    back = turns[first] * CONJUGATE
    return _turned(origins[at] - origins[first], back), _xyzw(quaternion_product(back, turns[at]))


def _turned(points: Array, turns: Array) -> Array:
    """Turn points (..., 3) by unit quaternions (..., 4), wxyz."""
    real, vector = turns[..., :1], turns[..., 1:]
    return points + 2.0 * np.cross(vector, np.cross(vector, points) + real * points)


def _xyzw(quaternions: Array) -> Array:
    """Order quaternions (..., 4), wxyz, as Rerun does."""
    return np.roll(quaternions, -1, axis=-1)


def _log_paths(
    rec: rr.RecordingStream,
    root: EntityParts,
    paths: Array,
    iterations: Array,
    style: RobotStyle,
    now: Array | None,
) -> None:
    """Log the path of the end of each iterate, (m, n, 3), and on `sim_time` the designed one."""
    path = entity_path((*root, "path"))
    for iteration, points in zip(iterations.astype(int).tolist(), paths, strict=True):
        rec.set_time("iteration", sequence=iteration)
        rec.log(path, strip_of_path(points, style), strict=True)
    rec.reset_time()

    rec.set_time("sim_time", duration=0.0)
    rec.log(path, strip_of_path(paths[-1] if now is None else now, style), strict=True)
    rec.reset_time()


# ---- curves over time


@dataclass(frozen=True, kw_only=True, eq=False)
class IteratePlot:
    """Plot of one quantity over time, for the initial trajectory and the iterate that is shown.

    Attributes:
        plot: The axes.
        limits: Lower and upper limit of the quantity, infinite without one.
        initial: Times [s] and values of the initial trajectory.
        times: (m, n) times of the iterates [s].
        values: (m, n) values of the iterates.
    """

    plot: StripPlot
    limits: Range
    initial: tuple[Array, Array]
    times: Array
    values: Array

    def log(
        self, rec: rr.RecordingStream, iterations: Array, initial: RobotStyle, style: RobotStyle
    ) -> None:
        """Log the curves; without the timeline `iteration`, the last iterate is shown.

        Args:
            rec: The recording.
            iterations: (m,) numbers of the iterates.
            initial: Style of the initial trajectory.
            style: Style of the iterates.
        """
        self.plot.log_axes(rec, self.limits)
        still = self.plot.curve(*self.initial, initial.accent, INITIAL_WIDTH)
        rec.log(entity_path((*self.plot.parts, "initial")), still, static=True, strict=True)

        path = entity_path((*self.plot.parts, "iterate"))
        rows = list(zip(self.times, self.values, strict=True))
        for iteration, (t, values) in zip(iterations.astype(int).tolist(), rows, strict=True):
            rec.set_time("iteration", sequence=iteration)
            rec.log(path, self.plot.curve(t, values, style.accent), strict=True)
        rec.reset_time()

        rec.set_time("sim_time", duration=0.0)
        rec.log(path, self.plot.curve(*rows[-1], style.accent), strict=True)
        rec.reset_time()


def iterate_plots(
    curves: IterateCurves,
    initial: Trajectory,
    positions: Sequence[tuple[str, Range]],
    controls: Sequence[tuple[str, Range]],
) -> list[IteratePlot]:
    """Return a plot of each position and each control.

    Args:
        curves: The motions of the iterates.
        initial: The initial trajectory.
        positions: Label and limits of each position.
        controls: Label and limits of each control.
    """
    start = dof_positions(curves.model, initial.qpos)
    times = np.asarray(curves.motions.t, dtype=np.float64)
    ctrl = curves.controls

    count = len(positions) + len(controls)
    plots = []
    for i, (label, limits) in enumerate(positions):
        known = (initial.t, start[:, i])
        values = curves.positions[:, :, i]
        size = plot_size(count, i)
        plots.append(_iterate_plot(label, limits, known, times, values, size))
    for i, (label, limits) in enumerate(controls):
        known, values = (initial.t[:-1], initial.ctrl[:, i]), ctrl[:, :, i]
        size = plot_size(count, len(positions) + i)
        title = _control_title(label)
        plots.append(_iterate_plot(title, limits, known, times, values, size))
    return plots


def _control_title(label: str) -> str:
    """Title of the plot of a control, whose label may be that of a position."""
    return label if "(control)" in label else f"control {label}"


def _iterate_plot(
    label: str,
    limits: Range,
    initial: tuple[Array, Array],
    times: Array,
    values: Array,
    size: tuple[float, float],
) -> IteratePlot:
    """The plot of one quantity, with the same axes for all iterates."""
    low = min(float(np.min(initial[1])), float(values.min()))
    high = max(float(np.max(initial[1])), float(values.max()))
    plot = StripPlot(
        parts=("iterates", label),
        title=f"{label} over time [s]",
        x=(0.0, float(times.max())),
        y=range_with_limits(low, high, limits, LARGEST_ZOOM),
        size=size,
    )
    return IteratePlot(plot=plot, limits=limits, initial=initial, times=times, values=values)
