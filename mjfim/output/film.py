"""A video of motions: what its frames show, and their drawing by MuJoCo's renderer.

A film has motions, views, a speed and a camera. Each frame has its robots side by side, with titles
above and the time below.
"""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field, replace
from importlib import import_module
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import scipy.ndimage
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from mjfim.arrays import Array, evenly_spread_indices, record
from mjfim.errors import NoVideoError
from mjfim.experiment.arguments import checked
from mjfim.experiment.given import check_fits
from mjfim.experiment.schema import ExperimentLike
from mjfim.experiment.system import System
from mjfim.model.elements import model_length
from mjfim.output.page import DESIGNED, IDENTIFIED, INITIAL, MEASURED, NOMINAL, OTHER, Term
from mjfim.output.panels import ROBOT_ROLES, ROLES
from mjfim.output.rerun.camera import (
    EDGE_ON,
    camera_axes,
    fit_in_view,
    followed_body,
    moving_points,
    seen_points,
    view_direction,
)
from mjfim.output.rerun.scene import body_poses, has_floor
from mjfim.output.video import Video, require_format, write_video
from mjfim.records.design import Design, round_share
from mjfim.records.estimate import Estimate
from mjfim.records.rehearsal import Rehearsal
from mjfim.records.trajectory import Trajectory

# What a video can show: a trajectory is a simulated motion.
Filmed = Design | Estimate | Trajectory

# Robots of a rehearsal, which are ghosts behind the design, and their largest number.
REHEARSED = Term("rehearsed", MEASURED.colour, MEASURED.colour_on_dark, MEASURED.colour_name)
UNSAFE = Term("unsafe", NOMINAL.colour, NOMINAL.colour_on_dark, NOMINAL.colour_name)
MAX_GHOSTS = 2

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

# Time over which the motion of a camera that follows a base is averaged [s of the film], and
# points of the line along the path of the body.
CAMERA_SECONDS = 0.5
TRAIL_POINTS = 100

# Vertical field of view [rad], and the share of the picture that the motion fills.
FIELD_OF_VIEW = float(np.radians(40.0))
FILLED = 0.9

# Largest distance between two robots that nobody would see, over the length of the model; and their
# colours, which have no words in the titles.
SEEN_DISTANCE = 0.1
ROBOT_COLOURS = [Term("", ROLES[role], ROLES[role], "") for role in ROBOT_ROLES]

# Distance between the lines of the floor, as a share of the distance of the camera, or of its
# height above the floor where that is larger.
FLOOR_SPACING = 0.12


# One robot in a view: its word with its colour, and its (F, nq) positions in the frames.
Track = tuple[Term, Array]


@record
class Film:
    """A motion in frames, each with V views side by side.

    Attributes:
        model: The model.
        t: (F,) time of the motion in each frame [s].
        tracks: The robots of each view; those after the first one are transparent ghosts behind it.
            A robot without a word is not in the title.
        targets: (V, F, 3) points at which the camera looks [m].
        trails: (n, 3) path of the body that the camera follows in each view [m]; empty for none.
        offset: (3,) vector from the point at which the camera looks to the camera [m].
        floor: Height of a floor that is drawn for models without one, and distance between its
            lines [m]; None where it would be seen edge-on, and for models with a floor.
        size: Width and height of a view [pixels].
        speed: Speed in multiples of real time.
        left_out: Time at the end of the motion that is not shown [s].
        note: Words below the pictures.
    """

    model: mujoco.MjModel = field(repr=False)
    t: Array
    tracks: tuple[tuple[Track, ...], ...]
    targets: Array
    trails: tuple[Array, ...]
    offset: Array
    floor: tuple[float, float] | None
    size: tuple[int, int]
    speed: float
    left_out: float
    note: str = ""

    @property
    def named(self) -> list[dict[Term, bool]]:
        """The words of the robots of each view, and whether they are ghosts."""
        return [{term: k > 0 for k, (term, _) in enumerate(view) if term} for view in self.tracks]

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
        for named in self.named:
            robots = [
                f"the {term} motion{' (transparent)' if is_ghost else ''}"
                for term, is_ghost in named.items()
            ]
            pictures.append(" and ".join(robots))
        shown = " beside ".join(pictures)
        caption = f"{shown[:1].upper()}{shown[1:]}, {self.speed_text}."
        if self.left_out > 0.0:
            seconds = self.t[-1] - self.t[0]
            caption += f" Only the first {seconds:.3g} s are shown; {self.left_out:.3g} s follow."
        return f"{caption} {self.note}".rstrip()


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
            [(INITIAL, result.initial.trajectory)],
            [(DESIGNED, result.final.trajectory)],
        ]
        pairs, note = robots_beside(system, result)
        if not pairs:
            motions[1] += _rehearsed(result.rehearsal)
        for view, pair in zip(motions, pairs, strict=False):
            view += zip(ROBOT_COLOURS, pair, strict=True)
        return replace(film_of_motions(system.model_at(system.theta), motions), note=note)
    if isinstance(result, Trajectory):
        simulated = Term("simulated", OTHER.colour, OTHER.colour_on_dark, OTHER.colour_name)
        return film_of_motions(system.model_at(system.theta), [[(simulated, result)]])

    if result.motion is None:
        raise NoVideoError("the estimate holds no motion of a recording")
    from mjfim.identification.aligned_recording import measured_trajectory

    recording = result.recordings[0]
    measured = measured_trajectory(system, recording, float(result.motion.t[-1]))
    view = [(IDENTIFIED, result.motion)]
    if measured is not None:
        view.append((MEASURED, measured))
    film = film_of_motions(system.model_at(result.theta), [view])

    # The motion may be a part of the recording; both may end up to one sample apart.
    t = result.motion.t
    missing = float(recording.t[-1] - recording.t[0]) - float(t[-1] - t[0])
    return replace(film, left_out=film.left_out + (missing if missing > t[1] - t[0] else 0.0))


def robots_beside(
    system: System, design: Design
) -> tuple[list[tuple[Trajectory, Trajectory]], str]:
    """Move the two robots that the initial motion of a design does not tell apart.

    Their differences from the model are magnified where nobody would see them.

    Args:
        system: The experiment, resolved.
        design: The design.

    Returns:
        The positions of both robots in the initial and in the designed motion, and what they show
        in words; nothing where the design has no such robots, or they move alike.
    """
    if design.valley is None:
        return [], ""
    model, theta = system.model_at(system.theta), design.valley.theta
    planned = [each.trajectory for each in (design.initial, design.final)]
    found = [
        [system.released_as(plan.state[0]).plant.simulate(row, plan.ctrl) for row in theta]
        for plan in planned
    ]
    first, second = moving_points(
        model, [body_poses(model, each.t, each.qpos) for each in found[1]]
    )
    apart = float(np.linalg.norm(first - second, axis=2).max(initial=0.0))
    if apart == 0.0:
        return [], ""
    factor = round_share(max(SEEN_DISTANCE * float(model_length(model)) / apart, 1.0))
    pairs = []
    for plan, pair in zip(planned, found, strict=True):
        for each in pair:
            qpos, move = plan.qpos.copy(), np.empty(model.nv)
            for position, own in zip(qpos, each.qpos, strict=True):
                mujoco.mj_differentiatePos(model, move, 1.0, position, own)
                mujoco.mj_integratePos(model, position, move, factor)
            pairs.append(replace(each, qpos=qpos))
    magnified = f", differences × {factor:g}" if factor > 1.0 else ""
    note = f"Pale: two robots alike in the initial motion{magnified}."
    return [(pairs[0], pairs[1]), (pairs[2], pairs[3])], note


def _rehearsed(rehearsal: Rehearsal | None) -> Iterator[tuple[Term, Trajectory]]:
    """Return motions of some robots, from the one closest to its limits to the safest."""
    if rehearsal is None:
        return
    t, motions = rehearsal.motion_times, list(rehearsal.motions.items())
    nothing = np.zeros((len(t), 0))
    for k in evenly_spread_indices(len(motions), MAX_GHOSTS).tolist():
        robot, qpos = motions[k]
        term = UNSAFE if rehearsal.unsafe[robot] else REHEARSED
        yield term, Trajectory(t=t, qpos=qpos, qvel=nothing, act=nothing, ctrl=nothing[1:])


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

    longest = max(every, key=lambda each: each.t[-1])
    begin, end = float(longest.t[0]), float(longest.t[-1])
    speed = film_speed(end - begin)
    shown = min(end - begin, LONGEST_FILM * speed)
    frames = max(2, round(shown / speed * FRAME_RATE) + 1)
    t = begin + np.linspace(0.0, shown, frames)

    tracks = [
        tuple((term, positions_at(model, each.t, each.qpos, t)) for term, each in view)
        for view in motions
    ]
    poses = [[body_poses(model, t, qpos) for _, qpos in view] for view in tracks]
    nothing, points = np.zeros((0, 3)), evenly_spread_indices(frames, TRAIL_POINTS)
    followed = followed_body(model, [view[0] for view in poses])
    paths = [] if followed is None else [view[0].positions[:, followed] for view in poses]
    # A moving average, at whose ends the path continues.
    window = round(CAMERA_SECONDS * FRAME_RATE)
    shifts = [
        scipy.ndimage.uniform_filter1d(path - path[0], window, axis=0, mode="nearest")
        for path in paths
    ] or [np.zeros((frames, 3))] * len(poses)
    seen = [
        replace(each, positions=each.positions - shift[:, None])
        for view, shift in zip(poses, shifts, strict=True)
        for each in view
    ]
    clouds = moving_points(model, seen)
    target, offset, size = _camera(model, clouds)
    return Film(
        model=model,
        t=t,
        tracks=tuple(tracks),
        targets=target + np.array(shifts),
        trails=tuple(path[points] for path in paths) or (nothing,) * len(tracks),
        offset=offset,
        floor=_floor(model, clouds, target, offset, np.array(shifts)[..., 2]),
        size=size,
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


def _camera(model: mujoco.MjModel, clouds: Sequence[Array]) -> tuple[Array, Array, tuple[int, int]]:
    """Place a camera that has every motion in view: see `targets`, `offset` and `size` of `Film`.

    Args:
        model: The model.
        clouds: (samples, n, 3) paths of the corners of all moving geoms, by motion, without the
            motion of the camera [m].
    """
    direction = view_direction(clouds)
    axes = camera_axes(direction)
    points = seen_points(model, clouds) @ axes.T

    # The size of the picture in which a metre has the most pixels.
    slope = FILLED * float(np.tan(FIELD_OF_VIEW / 2.0))
    fits = [(size, fit_in_view(points, slope, size[0] / size[1])) for size in VIEW_SIZES]
    size, (middle, distance) = max(fits, key=lambda each: each[0][1] / each[1][1])
    return middle @ axes, distance * direction, size


def _floor(
    model: mujoco.MjModel, clouds: Sequence[Array], target: Array, offset: Array, shifts: Array
) -> tuple[float, float] | None:
    """The floor of a model without one, which is below the whole motion; see `floor` of `Film`.

    Args:
        model: The model.
        clouds: As for `_camera`.
        target: (3,) point at which the camera looks before it is shifted [m].
        offset: (3,) vector from there to the camera [m].
        shifts: Vertical shifts of the camera [m].
    """
    distance = float(np.linalg.norm(offset))
    if has_floor(model) or offset[2] < EDGE_ON * distance:
        return None
    lowest = float(seen_points(model, clouds)[:, 2].min())
    height = float(target[2] + offset[2] + np.ptp(shifts)) - lowest
    return lowest + float(shifts.min()), FLOOR_SPACING * max(distance, height)


# Kinds of OpenGL contexts by system, in the order in which they are tried: without a display first.
BACK_ENDS = {"Linux": ("egl", "osmesa", "glfw"), "Darwin": ("cgl", "glfw")}
OTHER_BACK_ENDS = ("glfw",)

# Values of the variable MUJOCO_GL that turn drawing off.
TURNED_OFF = ("disable", "disabled", "off", "false", "0")

# Background of models without a sky of their own, and lines of a floor (0..1).
BACKGROUND = (0.885, 0.905, 0.935, 1.0)
FLOOR_COLOUR = (0.70, 0.74, 0.79, 1.0)

# Number of lines of a floor to each side of the camera's target; width of these lines as a share of
# their distance, and of other lines as a share of the distance of the camera.
FLOOR_LINES = 16
FLOOR_WIDTH = 0.02
LINE_WIDTH = 0.0025

# Share of the colour of its word in the grey parts of a robot, by which a part of a pure colour has
# less, and in a ghost; opacity of a ghost, and its shift away from the camera as a share of
# its distance, without which surfaces at the same place would be drawn as speckles.
TINT, KEPT_COLOUR = 0.45, 0.85
GHOST_TINT, GHOST_OPACITY, GHOST_SHIFT = 0.9, 0.4, 0.002

# What is drawn of a ghost: bodies without geoms are decoration, which shows their inertia.
GHOST_PARTS = int(mujoco.mjtCatBit.mjCAT_DYNAMIC | mujoco.mjtCatBit.mjCAT_DECOR)

# How much stronger than its colour a thing is that shines by itself, so that lights add little; and
# the distance of the background, as a share of that of the far clipping plane.
EMISSION = 10.0
BACKGROUND_DISTANCE = 0.7

# Size of the map of shadows [pixels]; MuJoCo's own takes twice as long without a graphics card.
SHADOW_SIZE = 1024

# Light from the camera in models without lights and in others, ambient and diffuse (0..1).
HEADLIGHT_ALONE, HEADLIGHT_AMONG_OTHERS = (0.45, 0.45), (0.25, 0.30)

# Groups of geoms that MuJoCo's viewer shows by default.
SHOWN_GROUPS = 3

# Heights of the strips above and below the pictures, and the gap between pictures [pixels]. All are
# even, as the encoder of mp4 needs.
TITLE_HEIGHT, FOOT_HEIGHT, GAP = 36, 32, 4

# Sizes of the letters of titles and foot, and distances of texts and of the note from the edge
# [pixels].
TITLE_SIZE, FOOT_SIZE, MARGIN, NOTE_PLACE = 21, 17, 14, 130

# Colours of the strips and of the text in the foot (0..255).
PAPER, INK, FAINT_INK = (255, 255, 255), (40, 44, 52), (110, 116, 126)


class Painter:
    """Draws the frames of a film.

    Attributes:
        width: Width of a frame [pixels].
        height: Height of a frame [pixels].
    """

    def __init__(self, film: Film, shadows: bool, samples: int) -> None:
        """Open a context.

        Args:
            film: The film; the visual settings of its model are changed.
            shadows: Whether shadows are drawn.
            samples: Samples of a pixel, for smooth edges; 0 for one.

        Raises:
            NoVideoError: There is no usable OpenGL.
        """
        model = film.model
        count = len(film.tracks)
        width, height = film.size
        self.width = count * width + (count - 1) * GAP
        self.height = TITLE_HEIGHT + height + FOOT_HEIGHT
        self._film = film
        self._data = mujoco.MjData(model)
        moves = model.body_weldid[model.geom_bodyid] != 0
        self._is_moving = {
            int(mujoco.mjtObj.mjOBJ_GEOM): moves,
            int(mujoco.mjtObj.mjOBJ_BODY): model.body_weldid != 0,
        }
        self._has_sky = bool(np.any(model.tex_type == int(mujoco.mjtTexture.mjTEXTURE_SKYBOX)))
        self._camera = _free_camera(film.offset)
        self._option = mujoco.MjvOption()
        if not np.any(model.geom_group[moves] < SHOWN_GROUPS):
            self._option.geomgroup[:] = 1
        if not moves.any():
            self._option.flags[mujoco.mjtVisFlag.mjVIS_INERTIA] = True

        model.vis.global_.offwidth, model.vis.global_.offheight = width, height
        model.vis.global_.fovy = np.degrees(FIELD_OF_VIEW)
        model.vis.quality.shadowsize, model.vis.quality.offsamples = SHADOW_SIZE, samples
        ambient, diffuse = HEADLIGHT_AMONG_OTHERS if model.nlight else HEADLIGHT_ALONE
        headlight = model.vis.headlight
        headlight.ambient[:] = np.maximum(headlight.ambient, ambient)
        headlight.diffuse[:], headlight.specular[:] = diffuse, 0.1

        self._renderer = _renderer(model, width, height)
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        self._font = _font("DejaVuSans.ttf", FOOT_SIZE)
        self._paper = self._titled_paper()

    def close(self) -> None:
        """Close the context."""
        self._renderer.close()

    def frame(self, k: int) -> NDArray[np.uint8]:
        """Draw a frame by its number: (height, width, 3) bytes."""
        frame = self._paper.copy()
        for view in range(len(self._film.tracks)):
            left = view * (self._film.size[0] + GAP)
            frame.paste(Image.fromarray(self._picture(view, k)), (left, TITLE_HEIGHT))

        text = ImageDraw.Draw(frame)
        place = (MARGIN, self.height - FOOT_HEIGHT // 2)
        text.text(place, f"t = {self._film.t[k]:.2f} s", INK, self._font, anchor="lm")
        return np.asarray(frame)

    def _titled_paper(self) -> Image.Image:
        """What is equal in all frames: the titles and the speed."""
        paper = Image.new("RGB", (self.width, self.height), PAPER)
        text = ImageDraw.Draw(paper)
        for k, named in enumerate(self._film.named):
            _write_title(text, float(k * (self._film.size[0] + GAP) + MARGIN), named)

        place = (self.width - MARGIN, self.height - FOOT_HEIGHT // 2)
        text.text(place, self._film.speed_text, FAINT_INK, self._font, anchor="rm")
        place = (NOTE_PLACE, self.height - FOOT_HEIGHT // 2)
        text.text(place, self._film.note, FAINT_INK, self._font, anchor="lm")
        return paper

    # ---- the scene

    def _picture(self, view: int, k: int) -> NDArray[np.uint8]:
        """The robots of a view in a frame."""
        film = self._film
        target = film.targets[view, k]
        self._camera.lookat[:] = target
        for layer, (term, qpos) in enumerate(film.tracks[view]):
            self._add_robot(term, qpos[k], layer)

        lead, _ = film.tracks[view][0]
        colour = (*(np.array(lead.rgb) / 255.0), 1.0)
        width = LINE_WIDTH * self._camera.distance
        for begin, end in pairwise(film.trails[view]):
            _add_line(self._renderer.scene, begin, end, width, colour)
        self._add_floor(target)
        if not self._has_sky:
            self._add_background()
        return np.asarray(self._renderer.render())

    def _add_robot(self, term: Term, qpos: Array, layer: int) -> None:
        """Add a robot at qpos: (nq,) to the scene, which the first one begins anew."""
        model, data, scene = self._film.model, self._data, self._renderer.scene
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, data)
        if not layer:
            self._renderer.update_scene(data, self._camera, self._option)
            self._paint(term, 0, layer)
            return
        first = scene.ngeom
        mujoco.mjv_addGeoms(model, data, self._option, mujoco.MjvPerturb(), GHOST_PARTS, scene)
        self._paint(term, first, layer)

    def _paint(self, term: Term, first: int, layer: int) -> None:
        """Tint the moving parts that were added to the scene from the number `first` on.

        Layers behind the first one are ghosts, each behind the robots before it, so that it shows
        where it differs.
        """
        for geom in self._renderer.scene.geoms[first : self._renderer.scene.ngeom]:
            is_moving = self._is_moving.get(geom.objtype, ())
            if 0 <= geom.objid < len(is_moving) and is_moving[geom.objid]:
                # Parts with a colour nearly keep it.
                own = np.array(geom.rgba[:3], dtype=np.float64)
                purity = float(np.ptp(own)) / max(float(own.max()), 1e-3)
                share = GHOST_TINT if layer else TINT * (1.0 - KEPT_COLOUR * purity)
                geom.rgba[:3] = (1.0 - share) * own + share * np.array(term.rgb) / 255.0
                geom.rgba[3] *= GHOST_OPACITY if layer else 1.0
                if layer:
                    geom.pos[:] -= layer * GHOST_SHIFT * self._film.offset

    def _add_floor(self, target: Array) -> None:
        """Add the lines of a floor around the point at which the camera looks."""
        if self._film.floor is None:
            return
        height, spacing = self._film.floor
        middle = spacing * np.round(target[:2] / spacing)
        reach = FLOOR_LINES * spacing
        for shift in spacing * np.arange(-FLOOR_LINES, FLOOR_LINES + 1):
            for along in (0, 1):
                begin = np.array([*middle, height])
                begin[1 - along] += shift
                end = begin.copy()
                begin[along] -= reach
                end[along] += reach
                width = FLOOR_WIDTH * spacing
                _add_line(self._renderer.scene, begin, end, width, FLOOR_COLOUR)

    def _add_background(self) -> None:
        """Add a bright wall behind everything, because MuJoCo's background is black."""
        scene, model = self._renderer.scene, self._film.model
        eye = scene.camera[0]
        position, forward, up = (np.array(each) for each in (eye.pos, eye.forward, eye.up))
        distance = BACKGROUND_DISTANCE * model.vis.map.zfar * model.stat.extent
        turn = np.stack([np.cross(forward, up), up, -forward], axis=1)
        size = distance * np.array([2.0, 2.0, 1e-3])
        _add_box(scene, size, position + distance * forward, turn, BACKGROUND)


def _write_title(text: ImageDraw.ImageDraw, x: float, named: Mapping[Term, bool]) -> None:
    """Write the words of the robots of a view from a place on, and which robots are ghosts."""
    bold, plain = _font("DejaVuSans-Bold.ttf", TITLE_SIZE), _font("DejaVuSans.ttf", TITLE_SIZE)
    for j, (term, is_ghost) in enumerate(named.items()):
        words = [(" and " if j else "", FAINT_INK, plain), (term, term.rgb, bold)]
        # Of three words, there is no room for more.
        is_told = is_ghost and len(named) == 2
        words.append((" (transparent)" if is_told else "", FAINT_INK, plain))
        for word, colour, font in words:
            text.text((x, TITLE_HEIGHT // 2), word, colour, font, anchor="lm")
            x += font.getlength(word)


# Red, green, blue and opacity (0..1).
Colour = tuple[float, float, float, float]


def _add_box(scene: Any, size: Array, place: Array, turn: Array, colour: Colour) -> None:
    """Add a box that has its own colour whatever the lights are, and casts no shadow."""
    geom = scene.geoms[scene.ngeom]
    box = mujoco.mjtGeom.mjGEOM_BOX
    mujoco.mjv_initGeom(geom, box, size, place, turn.ravel(), np.array(colour, np.float32))
    geom.category = int(mujoco.mjtCatBit.mjCAT_DECOR)
    geom.rgba[:3] /= EMISSION
    geom.emission, geom.specular, geom.shininess = EMISSION, 0.0, 0.0
    scene.ngeom += 1


def _add_line(scene: Any, begin: Array, end: Array, width: float, colour: Colour) -> None:
    """Add a line as a thin box; MuJoCo's own lines have other colours under other lights."""
    length = float(np.linalg.norm(end - begin))
    if length > 0.0:
        quaternion, turn = np.empty(4), np.empty(9)
        mujoco.mju_quatZ2Vec(quaternion, (end - begin) / length)
        mujoco.mju_quat2Mat(turn, quaternion)
        size = np.array([width, width, length]) / 2.0
        _add_box(scene, size, (begin + end) / 2.0, turn, colour)


def _free_camera(offset: Array) -> Any:
    """A camera that stands at an offset (3,) from the point at which it looks [m]."""
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.distance = float(np.linalg.norm(offset))
    forward = -offset / camera.distance
    camera.azimuth = float(np.degrees(np.arctan2(forward[1], forward[0])))
    camera.elevation = float(np.degrees(np.arcsin(forward[2])))
    return camera


def _renderer(model: Any, width: int, height: int) -> Any:
    """MuJoCo's renderer with the first kind of context that works here.

    MuJoCo itself decides by MUJOCO_GL when it is imported, which would need a display.
    """
    stated = os.environ.get("MUJOCO_GL", "").lower().strip()
    if stated in TURNED_OFF:
        raise NoVideoError("the variable MUJOCO_GL turns drawing off")
    for back_end in (stated,) if stated else BACK_ENDS.get(platform.system(), OTHER_BACK_ENDS):
        try:
            module = import_module("mujoco.rendering.classic.renderer")
            module.gl_context.GLContext = import_module(f"mujoco.{back_end}").GLContext
            return module.Renderer(model, height, width)
        except Exception:  # each driver fails in its own way
            continue

    if stated:
        raise NoVideoError(f"MuJoCo can draw nothing with the variable MUJOCO_GL={stated}")
    hint = "; the packages libegl1 and libgl1-mesa-dri are enough"
    raise NoVideoError(
        "MuJoCo can draw nothing on this computer, because it has no usable OpenGL"
        + (hint if platform.system() == "Linux" else "")
    )


def _font(name: str, size: int) -> ImageFont.FreeTypeFont:
    """A font that comes with matplotlib, so that it is the same on every computer."""
    # The package is only looked for, because its import takes longer than a second of film.
    spec = find_spec("matplotlib")
    assert spec is not None and spec.origin is not None
    fonts = Path(spec.origin).parent / "mpl-data" / "fonts" / "ttf"
    return ImageFont.truetype(fonts / name, size)


@checked
def save_video(experiment: ExperimentLike, result: Filmed, path: str | Path) -> Video:
    """Write a video of the robot, drawn by MuJoCo without a display.

    A design is shown as the initial motion beside the designed one, an estimate as the measured
    robot as a ghost behind the identified one.

    Args:
        experiment: The experiment of the result.
        result: A design, an estimate, or a trajectory.
        path: The file, which ends in .mp4 or .gif.

    Returns:
        The video, with a caption that says how fast it is played.

    Raises:
        NoVideoError: Nothing can be drawn on this computer, or a package is missing.
        RecordingError: The ending of the file is another one, or the result is of another model.
    """
    require_format(Path(path))
    system = System.resolve(experiment)
    motion = result.trajectory if isinstance(result, Design) else result
    if isinstance(motion, Trajectory):
        check_fits("the motion of the video", motion, system)
    return write_video(Path(path), system, result)
