"""Pictures of robots by MuJoCo's renderer: ghosts, tints, background and light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from mjfim.arrays import Array

# A picture or a frame: (height, width, 3) bytes.
Image = NDArray[np.uint8]

# Background of models without a sky of their own (0..1).
BACKGROUND = np.array([0.885, 0.905, 0.935, 1.0])

# How much stronger than its colour a thing is that shines by itself. Its colour is divided by this
# number, so that the lights of the model add little.
EMISSION = 10.0

# Distance of the background, as a share of that of the far clipping plane.
BACKGROUND_DISTANCE = 0.7

# Colour of the lines of a floor (0..1), and their number to each side of the camera's target.
FLOOR_COLOUR = np.array([0.70, 0.74, 0.79, 1.0], dtype=np.float32)
FLOOR_LINES = 16

# Radius of the sticks of bodies without geoms, as a share of the model's extent, and their colour
# (0..1).
STICK_RADIUS = 0.015
STICK_COLOUR = np.array([0.55, 0.55, 0.55, 1.0], dtype=np.float32)

# Shift of a ghost towards the camera, as a share of its distance.
GHOST_SHIFT = 0.002

# Width of the lines of a floor as a share of the distance between them, and of other lines as a
# share of the distance of the camera.
FLOOR_WIDTH = 0.02
LINE_WIDTH = 0.0025

# Share of its colour by which the tint of a part is smaller, where this colour is pure.
KEPT_COLOUR = 0.85

# Size of the map of shadows [pixels]; MuJoCo's own takes twice as long without a graphics card.
SHADOW_SIZE = 1024

# Light from the camera, in models without lights and in others (0..1).
HEADLIGHT_ALONE, HEADLIGHT_AMONG_OTHERS = (0.45, 0.45), (0.25, 0.30)

# Groups of geoms that MuJoCo's viewer shows by default.
SHOWN_GROUPS = 3


@dataclass(frozen=True, kw_only=True)
class Quality:
    """How well pictures are drawn.

    Attributes:
        shadows: True for shadows.
        samples: Samples of a pixel, for smooth edges; 0 for one.
    """

    shadows: bool
    samples: int


# From the best to the quickest. Without a graphics card, each takes half as long as the one before.
QUALITIES = (
    Quality(shadows=True, samples=4),
    Quality(shadows=False, samples=4),
    Quality(shadows=False, samples=0),
)


@dataclass(frozen=True, kw_only=True)
class PaintedRobot:
    """How a robot is drawn.

    Attributes:
        colour: (3,) colour of its tint (0..1).
        tint: Share of the colour in moving parts (0..1).
        opacity: Opacity of moving parts (0..1).
    """

    colour: Array
    tint: float
    opacity: float

    @classmethod
    def of(cls, track: dict[str, Any]) -> PaintedRobot:
        """Read the settings of a track.

        Args:
            track: The settings.
        """
        colour = np.array(track["colour"], dtype=np.float64) / 255.0
        return cls(colour=colour, tint=float(track["tint"]), opacity=float(track["opacity"]))

    def paint(self, geom: mujoco.MjvGeom) -> None:
        """Tint a moving part.

        Args:
            geom: The part in the scene.
        """
        own = np.array(geom.rgba[:3], dtype=np.float64)
        purity = float(np.ptp(own)) / max(float(own.max()), 1e-3)
        is_ghost = self.opacity < 1.0
        share = self.tint if is_ghost else self.tint * (1.0 - KEPT_COLOUR * purity)
        geom.rgba[:3] = (1.0 - share) * own + share * self.colour
        geom.rgba[3] *= self.opacity


class Painter:
    """Draws robots with one renderer."""

    def __init__(
        self, model: mujoco.MjModel, job: dict[str, Any], offset: Array, quality: Quality
    ) -> None:
        """Open a context.

        Args:
            model: The model; its visual settings are changed.
            job: Settings of the film.
            offset: (3,) vector from the point at which the camera looks to the camera [m].
            quality: How well to draw.
        """
        width, height = int(job["width"]), int(job["height"])
        self._model = model
        self._data = mujoco.MjData(model)
        self._pert = mujoco.MjvPerturb()
        self._is_moving = model.body_weldid[model.geom_bodyid] != 0
        self._bare_bodies = _bare_bodies(model)
        self._option = _options(model, self._is_moving)
        self._camera = _camera(offset)
        self._towards_camera = GHOST_SHIFT * offset
        self._floor = None if job["floor"] is None else float(job["floor"])
        self._spacing = float(job["spacing"])
        self._line_width = LINE_WIDTH * self._camera.distance
        self._has_sky = bool(np.any(model.tex_type == int(mujoco.mjtTexture.mjTEXTURE_SKYBOX)))

        model.vis.quality.offsamples = quality.samples
        _set_visual(model, width, height, float(job["field_of_view"]))
        self._renderer = mujoco.Renderer(model, height, width)
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = quality.shadows

    def close(self) -> None:
        """Close the context."""
        self._renderer.close()

    def picture(
        self,
        robots: Sequence[PaintedRobot],
        positions: Sequence[Array],
        target: Array,
        trail: Array,
    ) -> Image:
        """Draw robots into one picture.

        Args:
            robots: How they are drawn; those after the first one are ghosts.
            positions: (nq,) positions of each robot.
            target: (3,) point at which the camera looks [m].
            trail: (n, 3) points of a line in the colour of the first robot [m]; may be empty.
        """
        self._camera.lookat[:] = target
        scene = self._renderer.scene
        for k, (robot, qpos) in enumerate(zip(robots, positions, strict=True)):
            self._data.qpos[:] = qpos
            mujoco.mj_fwdPosition(self._model, self._data)

            first = 0
            if k == 0:
                self._renderer.update_scene(self._data, self._camera, self._option)
            else:
                first = scene.ngeom
                dynamic = mujoco.mjtCatBit.mjCAT_DYNAMIC
                mujoco.mjv_addGeoms(
                    self._model, self._data, self._option, self._pert, int(dynamic), scene
                )
            self._paint(scene, first, robot)
            self._add_sticks(scene, robot)

        colour = np.array([*robots[0].colour, 1.0], dtype=np.float32)
        for begin, end in pairwise(trail):
            _add_line(scene, begin, end, self._line_width, colour)
        if self._floor is not None:
            self._add_floor(scene, target, self._floor)
        if not self._has_sky:
            self._add_background(scene)
        return np.asarray(self._renderer.render())

    def _paint(self, scene: mujoco.MjvScene, first: int, robot: PaintedRobot) -> None:
        """Tint the moving parts that were added to the scene from the number `first` on."""
        for k in range(first, scene.ngeom):
            geom = scene.geoms[k]
            is_geom = geom.objtype == int(mujoco.mjtObj.mjOBJ_GEOM)
            if is_geom and 0 <= geom.objid < len(self._is_moving) and self._is_moving[geom.objid]:
                robot.paint(geom)

                # Surfaces at the same place would be drawn as speckles.
                if first:
                    geom.pos[:] += self._towards_camera

    def _add_sticks(self, scene: mujoco.MjvScene, robot: PaintedRobot) -> None:
        """Add a ball and sticks to the children for each moving body without geoms."""
        radius = STICK_RADIUS * float(self._model.stat.extent)
        for body in self._bare_bodies:
            place = self._data.xpos[body]
            ball = scene.geoms[scene.ngeom]
            size = np.full(3, 1.5 * radius)
            sphere = mujoco.mjtGeom.mjGEOM_SPHERE
            mujoco.mjv_initGeom(ball, sphere, size, place, np.eye(3).ravel(), STICK_COLOUR)
            ball.category = int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
            robot.paint(ball)
            scene.ngeom += 1

            for child in np.flatnonzero(self._model.body_parentid == body):
                stick = scene.geoms[scene.ngeom]
                kind = mujoco.mjtGeom.mjGEOM_CAPSULE
                nothing = np.zeros(3)
                mujoco.mjv_initGeom(stick, kind, nothing, nothing, np.eye(3).ravel(), STICK_COLOUR)
                mujoco.mjv_connector(stick, kind, radius, place, self._data.xpos[child])
                stick.category = int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
                robot.paint(stick)
                scene.ngeom += 1

    def _add_floor(self, scene: mujoco.MjvScene, target: Array, height: float) -> None:
        """Add the lines of a floor around the point at which the camera looks."""
        spacing = self._spacing
        centre = spacing * np.round(target[:2] / spacing)
        reach = FLOOR_LINES * spacing
        for k in range(-FLOOR_LINES, FLOOR_LINES + 1):
            for axis in (0, 1):
                begin = np.array([*centre, height])
                begin[axis] += k * spacing
                end = begin.copy()
                begin[1 - axis] -= reach
                end[1 - axis] += reach
                _add_line(scene, begin, end, FLOOR_WIDTH * spacing, FLOOR_COLOUR)

    def _add_background(self, scene: mujoco.MjvScene) -> None:
        """Add a bright wall behind everything, because MuJoCo's background is black."""
        camera = scene.camera[0]
        forward = np.array(camera.forward, dtype=np.float64)
        up = np.array(camera.up, dtype=np.float64)
        far = float(self._model.vis.map.zfar) * float(self._model.stat.extent)
        distance = BACKGROUND_DISTANCE * far

        place = np.array(camera.pos, dtype=np.float64) + distance * forward
        rotation = np.stack([np.cross(forward, up), up, -forward], axis=1)
        size = np.array([2.0 * distance, 2.0 * distance, 1e-3 * distance])
        wall = scene.geoms[scene.ngeom]
        box = mujoco.mjtGeom.mjGEOM_BOX
        mujoco.mjv_initGeom(wall, box, size, place, rotation.ravel(), BACKGROUND)
        _let_shine(wall)
        scene.ngeom += 1


def _add_line(
    scene: mujoco.MjvScene,
    begin: Array,
    end: Array,
    width: float,
    colour: NDArray[np.float32],
) -> None:
    """Add a line as a thin box between two points (3,), of a width [m] and a colour (4,).

    MuJoCo's own lines have other colours under other lights.
    """
    length = float(np.linalg.norm(end - begin))
    if length == 0.0:
        return

    quaternion, rotation = np.empty(4), np.empty(9)
    mujoco.mju_quatZ2Vec(quaternion, (end - begin) / length)
    mujoco.mju_quat2Mat(rotation, quaternion)
    size = np.array([width / 2.0, width / 2.0, length / 2.0])
    line = scene.geoms[scene.ngeom]
    box = mujoco.mjtGeom.mjGEOM_BOX
    mujoco.mjv_initGeom(line, box, size, (begin + end) / 2.0, rotation, colour)
    _let_shine(line)
    scene.ngeom += 1


def _let_shine(geom: mujoco.MjvGeom) -> None:
    """Give a geom its own colour whatever the lights are, and no shadow."""
    geom.category = int(mujoco.mjtCatBit.mjCAT_DECOR)
    geom.rgba[:3] /= EMISSION
    geom.emission, geom.specular, geom.shininess = EMISSION, 0.0, 0.0


def _set_visual(model: mujoco.MjModel, width: int, height: int, field_of_view: float) -> None:
    """Set size, quality, camera and light for drawing without a graphics card."""
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    model.vis.global_.fovy = np.degrees(field_of_view)
    model.vis.quality.shadowsize = SHADOW_SIZE

    ambient, diffuse = HEADLIGHT_AMONG_OTHERS if model.nlight else HEADLIGHT_ALONE
    model.vis.headlight.ambient[:] = np.maximum(model.vis.headlight.ambient, ambient)
    model.vis.headlight.diffuse[:] = diffuse
    model.vis.headlight.specular[:] = 0.1


def _options(model: mujoco.MjModel, is_moving: NDArray[np.bool_]) -> mujoco.MjvOption:
    """Show what MuJoCo's viewer shows; where no moving part is among it, hidden groups as well."""
    option = mujoco.MjvOption()
    if not np.any(model.geom_group[is_moving] < SHOWN_GROUPS):
        option.geomgroup[:] = 1
    return option


def _bare_bodies(model: mujoco.MjModel) -> list[int]:
    """Moving bodies without geoms."""
    is_bare = (model.body_geomnum == 0) & (model.body_weldid != 0)
    return np.flatnonzero(is_bare).tolist()


def _camera(offset: Array) -> mujoco.MjvCamera:
    """A camera that stands at an offset (3,) from the point at which it looks [m]."""
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.distance = float(np.linalg.norm(offset))
    forward = -offset / camera.distance
    camera.azimuth = float(np.degrees(np.arctan2(forward[1], forward[0])))
    camera.elevation = float(np.degrees(np.arcsin(forward[2])))
    return camera
