"""Contents of a video: the motions, their views, the speed, and the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np
import scipy.ndimage

from mjfim.arrays import Array, evenly_spread_indices
from mjfim.experiment.system import System
from mjfim.output import vocabulary
from mjfim.output.rerun.camera import (
    EDGE_ON,
    camera_axes,
    extents,
    fit_in_view,
    moving_points,
    seen_points,
    view_direction,
)
from mjfim.output.rerun.scene import BodyPoses, body_poses, has_floor
from mjfim.output.video.video import NoVideoError
from mjfim.output.vocabulary import Term
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.trajectory import Trajectory

# What a video can show: a trajectory is a simulated motion.
Filmed = Design | Estimate | Trajectory

# Frames per second of the film, of which a slow computer draws a part. Every second frame is at a
# multiple of 10 ms, as a GIF needs.
FRAME_RATE = 25.0

# Longest and shortest film [s]. A longer motion is played at the largest speed, in multiples of
# real time, or ends early; a shorter one is played at a smaller speed.
LONGEST_FILM, SHORTEST_FILM = 20.0, 3.0
FASTEST = 2.0
SLOW_SPEEDS = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)

# Sizes that a view may have [pixels], all about equally large: that one is taken in which the robot
# is largest. They are even, as the encoder of mp4 needs.
VIEW_SIZES = ((640, 360), (560, 420), (480, 480))

# Distance that a free body travels, as a multiple of the size of the robot, above which the camera
# follows it; time over which the motion of this camera is averaged [s of the film]; and points of
# the line along the path of the body.
FOLLOWED_TRAVEL = 1.5
CAMERA_SECONDS = 0.5
TRAIL_POINTS = 100

# Vertical field of view [rad], and the share of the picture that the motion fills.
FIELD_OF_VIEW = float(np.radians(40.0))
FILLED = 0.9

# Distance between the lines of the floor, as a share of the distance of the camera, or of its
# height above the floor where that is larger.
FLOOR_SPACING = 0.12


@dataclass(frozen=True, eq=False, kw_only=True)
class Track:
    """One robot in a view.

    Attributes:
        term: Its word and its colour.
        qpos: (F, nq) positions in each frame of the film.
        is_ghost: Whether it is transparent.
    """

    term: Term
    qpos: Array
    is_ghost: bool


@dataclass(frozen=True, eq=False, kw_only=True)
class FilmView:
    """One picture of a frame.

    Attributes:
        tracks: Its robots; those after the first one are ghosts over it.
        target: (F, 3) point at which the camera looks in each frame [m].
        trail: (n, 3) path of the body that the camera follows [m]; empty where it follows none.
    """

    tracks: tuple[Track, ...]
    target: Array
    trail: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class FilmCamera:
    """Camera of all views.

    Attributes:
        target: (3,) point at which it looks in the first frame [m].
        offset: (3,) vector from there to the camera [m].
        floor: Height of a floor that is drawn for models without one [m]; None where it would
            be seen edge-on, and for models with a floor.
        spacing: Distance between the lines of this floor [m].
        size: Width and height of the picture [pixels].
    """

    target: Array
    offset: Array
    floor: float | None
    spacing: float
    size: tuple[int, int]


@dataclass(frozen=True, eq=False, kw_only=True)
class Film:
    """A motion in frames.

    Attributes:
        model: The model.
        t: (F,) time of the motion in each frame [s].
        views: Views side by side.
        camera: The camera.
        speed: Speed in multiples of real time.
        left_out: Time at the end of the motion that is not shown [s].
    """

    model: mujoco.MjModel = field(repr=False)
    t: Array
    views: tuple[FilmView, ...]
    camera: FilmCamera
    speed: float
    left_out: float

    @property
    def speed_text(self) -> str:
        """How fast the film is played."""
        if self.speed == 1.0:
            return "in real time"
        if self.speed > 1.0:
            return f"{self.speed:g} times faster than real time"
        return f"{1.0 / self.speed:g} times slower than real time"

    @property
    def caption(self) -> str:
        """One or two sentences that describe the film."""
        pictures = []
        for view in self.views:
            robots = [
                f"the {track.term.word} motion{' (transparent)' if track.is_ghost else ''}"
                for track in view.tracks
            ]
            pictures.append(" and ".join(robots))
        shown = " beside ".join(pictures)
        caption = f"{shown[:1].upper()}{shown[1:]}, {self.speed_text}."
        if self.left_out > 0.0:
            seconds = self.t[-1] - self.t[0]
            caption += f" Only the first {seconds:.3g} s are shown; {self.left_out:.3g} s follow."
        return caption


def film_of(system: System, result: Filmed) -> Film:
    """Film a result: a design beside its initial motion, an estimate under the measured robot.

    Args:
        system: The experiment, resolved.
        result: The result.

    Raises:
        NoVideoError: The result holds no motion, or one that diverged.
    """
    if isinstance(result, Design):
        motions = [
            [(vocabulary.INITIAL, result.initial.trajectory)],
            [(vocabulary.DESIGNED, result.final.trajectory)],
        ]
        return film_of_motions(system.model_at(system.theta), motions)
    if isinstance(result, Trajectory):
        simulated = replace(vocabulary.OTHER, word="simulated")
        return film_of_motions(system.model_at(system.theta), [[(simulated, result)]])

    if result.motion is None:
        raise NoVideoError("the estimate holds no motion of a recording")
    from mjfim.identification.aligned_recording import measured_trajectory

    recording = result.recordings[0]
    measured = measured_trajectory(system, recording, float(result.motion.t[-1]))
    view = [(vocabulary.IDENTIFIED, result.motion)]
    if measured is not None:
        view.append((vocabulary.MEASURED, measured))
    film = film_of_motions(system.model_at(result.theta), [view])

    # The motion may be a part of the recording; both may end up to one sample apart.
    t = result.motion.t
    missing = float(recording.t[-1] - recording.t[0]) - float(t[-1] - t[0])
    return replace(film, left_out=film.left_out + (missing if missing > t[1] - t[0] else 0.0))


def film_of_motions(
    model: mujoco.MjModel, motions: Sequence[Sequence[tuple[Term, Trajectory]]]
) -> Film:
    """Film motions.

    Args:
        model: The model.
        motions: The motions of each view; those after the first one are ghosts.

    Raises:
        NoVideoError: A motion has positions that are not finite.
    """
    every = [each for view in motions for _, each in view]
    if not all(np.isfinite(each.qpos).all() for each in every):
        raise NoVideoError("the motion has positions that are not finite")

    longest = max(every, key=lambda each: float(each.t[-1]))
    begin, end = float(longest.t[0]), float(longest.t[-1])
    speed = film_speed(end - begin)
    shown = min(end - begin, LONGEST_FILM * speed)
    frames = max(2, round(shown / speed * FRAME_RATE) + 1)
    t = begin + np.linspace(0.0, shown, frames)

    tracks = [
        tuple(
            Track(term=term, qpos=positions_at(model, each.t, each.qpos, t), is_ghost=k > 0)
            for k, (term, each) in enumerate(view)
        )
        for view in motions
    ]
    poses = [[body_poses(model, t, track.qpos) for track in view] for view in tracks]
    nothing, points = np.zeros((0, 3)), evenly_spread_indices(frames, TRAIL_POINTS)
    paths = _followed_paths(model, poses)
    shifts = [_smooth(path - path[0]) for path in paths] or [np.zeros((frames, 3))] * len(poses)
    camera = _camera(model, poses, shifts)
    views = []
    for k, view in enumerate(tracks):
        trail = paths[k][points] if paths else nothing
        views.append(FilmView(tracks=view, target=camera.target + shifts[k], trail=trail))
    return Film(
        model=model,
        t=t,
        views=tuple(views),
        camera=camera,
        speed=speed,
        left_out=end - begin - shown,
    )


def film_speed(seconds: float) -> float:
    """How fast a motion of some seconds is played, in multiples of real time."""
    if seconds > LONGEST_FILM:
        return FASTEST
    fitting = [speed for speed in SLOW_SPEEDS if seconds >= SHORTEST_FILM * speed]
    return fitting[0] if fitting else SLOW_SPEEDS[-1]


def positions_at(model: mujoco.MjModel, t: Array, qpos: Array, times: Array) -> Array:
    """Interpolate positions; rotations along the shortest way.

    Args:
        model: The model.
        t: (N+1,) ascending times of the positions [s].
        qpos: (N+1, nq) positions.
        times: (F,) times, before and after which the first and the last position hold [s].

    Returns:
        (F, nq) positions.
    """
    last = len(t) - 1
    before = np.clip(np.searchsorted(t, times, side="right") - 1, 0, max(last - 1, 0))
    after = np.minimum(before + 1, last)
    span = np.maximum(t[after] - t[before], np.finfo(np.float64).tiny)
    share = np.clip((times - t[before]) / span, 0.0, 1.0)

    found = qpos[before].copy()
    step = np.empty(model.nv)
    for k, position in enumerate(found):
        mujoco.mj_differentiatePos(model, step, 1.0, position, qpos[after[k]])
        mujoco.mj_integratePos(model, position, step, share[k])
    return found


def _camera(
    model: mujoco.MjModel, poses: Sequence[Sequence[BodyPoses]], shifts: Sequence[Array]
) -> FilmCamera:
    """Place a camera that has every motion in view while it is shifted, (F, 3) in each view [m]."""
    seen = [
        replace(each, positions=each.positions - shift[:, None])
        for view, shift in zip(poses, shifts, strict=True)
        for each in view
    ]
    clouds = moving_points(model, seen)
    direction = view_direction(extents(clouds))
    axes = camera_axes(direction)
    points = seen_points(model, clouds) @ axes.T

    # The size of the picture in which a metre has the most pixels.
    slope = FILLED * float(np.tan(FIELD_OF_VIEW / 2.0))
    fits = [(size, fit_in_view(points, slope, size[0] / size[1])) for size in VIEW_SIZES]
    size, (middle, distance) = max(fits, key=lambda each: each[0][1] / each[1][1])
    target = middle @ axes
    if has_floor(model) or direction[2] < EDGE_ON:
        return FilmCamera(
            target=target, offset=distance * direction, floor=None, spacing=0.0, size=size
        )

    # The floor is below the whole motion.
    heights = np.concatenate([shift[:, 2] for shift in shifts])
    lowest = float((points @ axes)[:, 2].min())
    height = float(target[2] + distance * direction[2] + np.ptp(heights)) - lowest
    return FilmCamera(
        target=target,
        offset=distance * direction,
        floor=lowest + float(heights.min()),
        spacing=FLOOR_SPACING * max(distance, height),
        size=size,
    )


def _followed_paths(model: mujoco.MjModel, poses: Sequence[Sequence[BodyPoses]]) -> list[Array]:
    """The (F, 3) path in each view of the free body that the camera follows [m].

    There are none where no free body travels far.
    """
    free = np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE))
    if not len(free):
        return []

    # The free body that carries most of the mass, and its size with everything on it.
    bodies = model.jnt_bodyid[free]
    body = int(bodies[np.argmax(model.body_subtreemass[bodies])])
    members = np.flatnonzero(model.body_rootid == model.body_rootid[body])
    reach = model.geom_rbound[np.isin(model.geom_bodyid, members)].max(initial=0.0)
    size = 2.0 * float(reach) or float(model.stat.extent)

    paths = [view[0].positions[:, body] for view in poses]
    travel = max(float(np.ptp(path, axis=0).max()) for path in paths)
    return paths if travel >= FOLLOWED_TRAVEL * size else []


def _smooth(path: Array) -> Array:
    """Moving average of a path (F, 3) over `CAMERA_SECONDS`; the ends continue."""
    window = round(CAMERA_SECONDS * FRAME_RATE)
    return np.asarray(scipy.ndimage.uniform_filter1d(path, window, axis=0, mode="nearest"))
