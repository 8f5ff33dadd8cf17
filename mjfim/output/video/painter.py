"""Frames of a film by MuJoCo's renderer: robots side by side, with titles above and time below."""

from __future__ import annotations

import os
import platform
from importlib import import_module
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from mjfim.arrays import Array
from mjfim.output.video.film import FIELD_OF_VIEW, Film, FilmView, Track
from mjfim.output.video.video import NoVideoError

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
# less, and in a ghost; opacity of a ghost, and its shift towards the camera as a share of its
# distance, without which surfaces at the same place would be drawn as speckles.
TINT, KEPT_COLOUR = 0.45, 0.85
GHOST_TINT, GHOST_OPACITY, GHOST_SHIFT = 0.9, 0.4, 0.002

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

# Sizes of the letters of titles and foot [pixels], and the distance from the edge.
TITLE_SIZE, FOOT_SIZE, MARGIN = 21, 17, 14

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
        count, (width, height) = len(film.views), film.camera.size
        self.width = count * width + (count - 1) * GAP
        self.height = TITLE_HEIGHT + height + FOOT_HEIGHT
        self._film = film
        self._data = mujoco.MjData(model)
        self._is_moving = model.body_weldid[model.geom_bodyid] != 0
        self._has_sky = bool(np.any(model.tex_type == int(mujoco.mjtTexture.mjTEXTURE_SKYBOX)))
        self._camera = _camera(film.camera.offset)
        self._option = mujoco.MjvOption()
        if not np.any(model.geom_group[self._is_moving] < SHOWN_GROUPS):
            self._option.geomgroup[:] = 1
        if not self._is_moving.any():
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
        for i, view in enumerate(self._film.views):
            left = i * (self._film.camera.size[0] + GAP)
            frame.paste(Image.fromarray(self._picture(view, k)), (left, TITLE_HEIGHT))

        text = ImageDraw.Draw(frame)
        place = (MARGIN, self.height - FOOT_HEIGHT // 2)
        text.text(place, f"t = {self._film.t[k]:.2f} s", INK, self._font, anchor="lm")
        return np.asarray(frame)

    def _titled_paper(self) -> Image.Image:
        """What is equal in all frames: the titles and the speed."""
        paper = Image.new("RGB", (self.width, self.height), PAPER)
        text = ImageDraw.Draw(paper)
        bold, plain = _font("DejaVuSans-Bold.ttf", TITLE_SIZE), _font("DejaVuSans.ttf", TITLE_SIZE)
        for k, view in enumerate(self._film.views):
            x = float(k * (self._film.camera.size[0] + GAP) + MARGIN)
            for j, track in enumerate(view.tracks):
                words = [(" and " if j else "", FAINT_INK, plain)]
                words.append((track.term.word, track.term.rgb, bold))
                words.append((" (transparent)" if track.is_ghost else "", FAINT_INK, plain))
                for word, colour, font in words:
                    text.text((x, TITLE_HEIGHT // 2), word, colour, font, anchor="lm")
                    x += font.getlength(word)

        place = (self.width - MARGIN, self.height - FOOT_HEIGHT // 2)
        text.text(place, self._film.speed_text, FAINT_INK, self._font, anchor="rm")
        return paper

    # ---- the scene

    def _picture(self, view: FilmView, k: int) -> NDArray[np.uint8]:
        """Draw a view of a frame."""
        model, data, scene = self._film.model, self._data, self._renderer.scene
        self._camera.lookat[:] = view.target[k]
        for track in view.tracks:
            data.qpos[:] = track.qpos[k]
            mujoco.mj_fwdPosition(model, data)
            first = scene.ngeom if track.is_ghost else 0
            if track.is_ghost:
                dynamic = int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
                nothing = mujoco.MjvPerturb()
                mujoco.mjv_addGeoms(model, data, self._option, nothing, dynamic, scene)
            else:
                self._renderer.update_scene(data, self._camera, self._option)
            self._paint(track, first)

        colour = (*(np.array(view.tracks[0].term.rgb) / 255.0), 1.0)
        for begin, end in pairwise(view.trail):
            _add_line(scene, begin, end, LINE_WIDTH * self._camera.distance, colour)
        self._add_floor(view.target[k])
        if not self._has_sky:
            self._add_background()
        return np.asarray(self._renderer.render())

    def _paint(self, track: Track, first: int) -> None:
        """Tint the moving parts that were added to the scene from the number `first` on."""
        for geom in self._renderer.scene.geoms[first : self._renderer.scene.ngeom]:
            is_geom = geom.objtype == int(mujoco.mjtObj.mjOBJ_GEOM)
            if is_geom and 0 <= geom.objid < len(self._is_moving) and self._is_moving[geom.objid]:
                _tint(geom, track)
                if track.is_ghost:
                    geom.pos[:] += GHOST_SHIFT * self._film.camera.offset

    def _add_floor(self, target: Array) -> None:
        """Add the lines of a floor around the point at which the camera looks."""
        camera = self._film.camera
        if camera.floor is None:
            return
        middle = camera.spacing * np.round(target[:2] / camera.spacing)
        reach = FLOOR_LINES * camera.spacing
        for shift in camera.spacing * np.arange(-FLOOR_LINES, FLOOR_LINES + 1):
            for along in (0, 1):
                begin = np.array([*middle, camera.floor])
                begin[1 - along] += shift
                end = begin.copy()
                begin[along] -= reach
                end[along] += reach
                width = FLOOR_WIDTH * camera.spacing
                _add_line(self._renderer.scene, begin, end, width, FLOOR_COLOUR)

    def _add_background(self) -> None:
        """Add a bright wall behind everything, because MuJoCo's background is black."""
        scene, model = self._renderer.scene, self._film.model
        eye = scene.camera[0]
        position, forward, up = (np.array(each) for each in (eye.pos, eye.forward, eye.up))
        distance = BACKGROUND_DISTANCE * float(model.vis.map.zfar) * float(model.stat.extent)
        turn = np.stack([np.cross(forward, up), up, -forward], axis=1)
        size = distance * np.array([2.0, 2.0, 1e-3])
        _add_box(scene, size, position + distance * forward, turn, BACKGROUND)


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


def _tint(geom: Any, track: Track) -> None:
    """Give a moving part a share of the colour of its robot; parts with a colour nearly keep it."""
    own = np.array(geom.rgba[:3], dtype=np.float64)
    purity = float(np.ptp(own)) / max(float(own.max()), 1e-3)
    share = GHOST_TINT if track.is_ghost else TINT * (1.0 - KEPT_COLOUR * purity)
    geom.rgba[:3] = (1.0 - share) * own + share * np.array(track.term.rgb) / 255.0
    geom.rgba[3] *= GHOST_OPACITY if track.is_ghost else 1.0


def _camera(offset: Array) -> Any:
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
