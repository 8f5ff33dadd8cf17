"""Contents of a video: the motions, their views, the speed, and the camera.

A film holds arrays and words only. `mjfim.output.video.rendering` draws it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np

from mjfim.arrays import Array, evenly_spread_indices
from mjfim.output import vocabulary
from mjfim.output.rerun.scene import BodyPoses, body_poses
from mjfim.output.video.camera import FilmCamera, lowered, place_film_camera
from mjfim.output.video.record import NoVideoError
from mjfim.output.vocabulary import Term
from mjfim.records.design import Design
from mjfim.records.trajectory import Trajectory

# Frames per second of the film, of which a slow computer draws a part. Every second frame is at a
# multiple of 10 ms, as a GIF needs.
FRAME_RATE = 25.0

# Longest and shortest film [s]. A longer motion is played faster or ends early, a shorter one is
# played slower.
LONGEST_FILM, SHORTEST_FILM = 20.0, 3.0

# Largest speed at which a motion is played, in multiples of real time.
FASTEST = 2.0

# Speeds below real time.
SLOW_SPEEDS = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02, 0.01, 0.005, 0.002, 0.001)

# Sizes that a view may have [pixels], all about equally large: that one is taken in which the robot
# is largest. They are even, as the encoder of mp4 needs.
VIEW_SIZES = ((640, 360), (560, 420), (480, 480))

# Distance that a free body travels, as a multiple of the size of the robot, above which the camera
# follows it.
FOLLOWED_TRAVEL = 1.5

# Time over which the motion of a camera that follows a body is averaged [s of the film].
CAMERA_SECONDS = 0.5

# Points of the line along the path of a body that the camera follows.
TRAIL_POINTS = 100

# Share of the colour of its word in the grey parts of a robot, and in a ghost.
TINT, GHOST_TINT = 0.45, 0.9

# Opacity of a ghost.
GHOST_OPACITY = 0.4


@dataclass(frozen=True, eq=False, kw_only=True)
class Track:
    """One robot in a view.

    Attributes:
        word: Word in the title of the view.
        colour: Colour of the word and of the tint (0..255).
        qpos: (F, nq) positions in each frame of the film.
        tint: Share of the colour in the moving parts (0..1). Parts of a robot that have a colour in
            the model nearly keep it, those of a ghost do not.
        opacity: Opacity of the moving parts (0..1).
    """

    word: str
    colour: tuple[int, int, int]
    qpos: Array
    tint: float = TINT
    opacity: float = 1.0


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
class Film:
    """A motion in frames.

    Attributes:
        model: The model.
        t: (F,) time of the motion in each frame [s].
        views: Views side by side.
        camera: The camera in the first frame.
        speed: Speed in multiples of real time.
        follows: True if the camera moves with the robot.
        left_out: Time at the end of the motion that is not shown [s].
    """

    model: mujoco.MjModel = field(repr=False)
    t: Array
    views: tuple[FilmView, ...]
    camera: FilmCamera
    speed: float
    follows: bool
    left_out: float

    @property
    def caption(self) -> str:
        """One or two sentences that describe the film."""
        pictures = [" and ".join(_robot(track) for track in view.tracks) for view in self.views]
        shown = " beside ".join(pictures)
        sentences = [f"{shown[:1].upper()}{shown[1:]}, {speed_text(self.speed)}."]
        if self.left_out > 0.0:
            sentences.append(
                f"Only the first {self.t[-1] - self.t[0]:.3g} s are shown; "
                f"{self.left_out:.3g} s follow."
            )
        return " ".join(sentences)


def speed_text(speed: float) -> str:
    """Say how fast a film is played.

    Args:
        speed: Speed in multiples of real time.
    """
    if speed == 1.0:
        return "in real time"
    if speed > 1.0:
        return f"{speed:g} times faster than real time"
    return f"{1.0 / speed:g} times slower than real time"


def _robot(track: Track) -> str:
    """Name the robot of a track."""
    return f"the {track.word} motion" + (" (transparent)" if track.opacity < 1.0 else "")


# ---- films of results


def film_of_design(model: mujoco.MjModel, design: Design) -> Film:
    """Film the initial beside the designed motion.

    Args:
        model: The model.
        design: The design.
    """
    named = {"initial": design.initial.trajectory, "final": design.final.trajectory}
    return film_of_trajectories(model, named)


def film_of_trajectories(model: mujoco.MjModel, named: dict[str, Trajectory]) -> Film:
    """Film trajectories beside each other.

    Args:
        model: The model.
        named: The trajectories; `initial` and `final` get their words and colours.
    """
    motions = []
    for name, trajectory in named.items():
        term = vocabulary.TRAJECTORY_TERMS.get(name)
        if term is None:
            term = replace(vocabulary.OTHER, word=name)
        motions.append([(term, trajectory)])
    return _film(model, motions)


def film_of_estimate(
    model: mujoco.MjModel,
    identified: Trajectory,
    measured: Trajectory | None,
    recorded: float = 0.0,
) -> Film:
    """Film the measured robot as a ghost over the identified one.

    Args:
        model: The identified model.
        identified: Motion of the identified model.
        measured: Measured motion; None where positions were not measured.
        recorded: Duration of the recording, of which the motions may show a part [s].
    """
    motions = [(vocabulary.IDENTIFIED, identified)]
    if measured is not None:
        motions.append((vocabulary.MEASURED, measured))
    film = _film(model, [motions])

    # Both may end up to one sample apart.
    missing = recorded - float(identified.t[-1] - identified.t[0])
    if missing <= float(identified.t[1] - identified.t[0]):
        return film
    return replace(film, left_out=film.left_out + missing)


def _film(model: mujoco.MjModel, motions: Sequence[Sequence[tuple[Term, Trajectory]]]) -> Film:
    """Film motions: a view for each list, in which the motions after the first are ghosts."""
    if not all(np.isfinite(each.qpos).all() for view in motions for _, each in view):
        raise NoVideoError("the motion has positions that are not finite")

    longest = max((each for view in motions for _, each in view), key=lambda each: each.t[-1])
    begin, end = float(longest.t[0]), float(longest.t[-1])
    speed = film_speed(end - begin)
    shown = min(end - begin, LONGEST_FILM * speed)
    frames = max(2, round(shown / speed * FRAME_RATE) + 1)
    t = begin + np.linspace(0.0, shown, frames)

    tracks = [
        tuple(_track(model, term, each, t, ghost=k > 0) for k, (term, each) in enumerate(view))
        for view in motions
    ]
    poses = [[body_poses(model, t, track.qpos) for track in view] for view in tracks]
    paths = _followed_paths(model, poses)
    shifts = [_smooth(path - path[0]) for path in paths] or [np.zeros((frames, 3))] * len(poses)
    camera = _camera(model, poses, shifts)
    trails = [_thinned(path) for path in paths] or [np.zeros((0, 3))] * len(poses)
    views = tuple(
        FilmView(tracks=view, target=camera.target + shift, trail=trail)
        for view, shift, trail in zip(tracks, shifts, trails, strict=True)
    )

    return Film(
        model=model,
        t=t,
        views=views,
        camera=camera,
        speed=speed,
        follows=bool(paths),
        left_out=end - begin - shown,
    )


def film_speed(seconds: float) -> float:
    """Choose how fast a motion is played, in multiples of real time.

    Args:
        seconds: Duration of the motion [s].
    """
    if seconds > LONGEST_FILM:
        return FASTEST
    return next((speed for speed in SLOW_SPEEDS if seconds >= SHORTEST_FILM * speed), 0.001)


def _track(
    model: mujoco.MjModel, term: Term, trajectory: Trajectory, t: Array, *, ghost: bool
) -> Track:
    """One robot, with its positions in each frame."""
    qpos = positions_at(model, trajectory.t, trajectory.qpos, t)
    if ghost:
        return Track(
            word=term.word, colour=term.rgb, qpos=qpos, tint=GHOST_TINT, opacity=GHOST_OPACITY
        )
    return Track(word=term.word, colour=term.rgb, qpos=qpos)


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


# ---- camera


def _camera(
    model: mujoco.MjModel, poses: Sequence[Sequence[BodyPoses]], shifts: Sequence[Array]
) -> FilmCamera:
    """Place a camera that has every motion in view while it is shifted, (F, 3) in each view [m]."""
    seen = [
        replace(each, positions=each.positions - shift[:, None])
        for view, shift in zip(poses, shifts, strict=True)
        for each in view
    ]
    cameras = [place_film_camera(model, seen, size) for size in VIEW_SIZES]
    camera = max(cameras, key=lambda each: each.scale)
    heights = np.concatenate([shift[:, 2] for shift in shifts])
    return lowered(camera, float(heights.min()), float(heights.max()))


def _followed_paths(model: mujoco.MjModel, poses: Sequence[Sequence[BodyPoses]]) -> list[Array]:
    """Return the (F, 3) path in each view of the free body that the camera follows [m].

    There are none where no free body travels far.
    """
    free = np.flatnonzero(model.jnt_type == int(mujoco.mjtJoint.mjJNT_FREE))
    if not len(free):
        return []

    # The free body that carries most of the mass.
    bodies = model.jnt_bodyid[free]
    body = int(bodies[np.argmax(model.body_subtreemass[bodies])])
    paths = [view[0].positions[:, body] for view in poses]
    travel = max(float(np.ptp(path, axis=0).max()) for path in paths)
    return paths if travel >= FOLLOWED_TRAVEL * _size(model, body) else []


def _size(model: mujoco.MjModel, body: int) -> float:
    """Size of a free body with everything on it [m]."""
    members = np.flatnonzero(model.body_rootid == model.body_rootid[body])
    geoms = np.flatnonzero(np.isin(model.geom_bodyid, members))
    reach = model.geom_rbound[geoms].max(initial=0.0)
    return 2.0 * float(reach) or float(model.stat.extent)


def _smooth(path: Array) -> Array:
    """Moving average of a path (F, 3) over `CAMERA_SECONDS`; the ends continue."""
    window = round(CAMERA_SECONDS * FRAME_RATE)
    before, after = window // 2, window - 1 - window // 2
    wide = np.pad(path, ((before, after), (0, 0)), mode="edge")
    kernel = np.full(window, 1.0 / window)
    return np.stack([np.convolve(column, kernel, mode="valid") for column in wide.T], axis=1)


def _thinned(path: Array) -> Array:
    """Points of a path (F, 3) from which its line is drawn."""
    return path[evenly_spread_indices(len(path), TRAIL_POINTS)]
