"""Camera of a film: as near as the whole motion permits."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.output.rerun.camera import (
    EDGE_ON,
    camera_axes,
    extents,
    moving_points,
    view_direction,
)
from mjfim.output.rerun.scene import BodyPoses, has_floor

# Vertical field of view [rad].
FIELD_OF_VIEW = float(np.radians(40.0))

# Share of the picture that the motion fills.
FILLED = 0.9

# Times that the camera is centred on the picture of the motion, which its distance changes.
CENTRINGS = 4

# Distance between the lines of the floor, as a share of the distance of the camera, or of its
# height above the floor where that is larger.
FLOOR_SPACING = 0.12


@dataclass(frozen=True, eq=False, kw_only=True)
class FilmCamera:
    """Camera of a film.

    Attributes:
        target: (3,) point at which it looks [m].
        offset: (3,) vector from there to the camera [m].
        field_of_view: Vertical field of view [rad].
        floor: Height of a floor that is drawn for models without one [m]; None where it would
            be seen edge-on, and for models with a floor.
        spacing: Distance between the lines of this floor [m].
    """

    target: Array
    offset: Array
    field_of_view: float
    floor: float | None
    spacing: float


def place_film_camera(
    model: mujoco.MjModel, motions: Sequence[BodyPoses], aspect: float
) -> FilmCamera:
    """Place a camera that has all moving geoms of every motion in view.

    Args:
        model: The model.
        motions: Poses along each trajectory.
        aspect: Width of a picture over its height.
    """
    clouds = moving_points(model, motions)
    direction = view_direction(extents(clouds))
    axes = camera_axes(direction)
    points = np.concatenate([cloud.reshape(-1, 3) for cloud in clouds]) @ axes.T
    if not len(points) or not np.any(np.ptp(points, axis=0) > 0.0):
        points = _around_model(model) @ axes.T

    # Half the height and half the width of the picture at distance 1.
    vertical = FILLED * np.tan(FIELD_OF_VIEW / 2.0)
    slopes = np.array([aspect * vertical, vertical])

    target = (points.min(axis=0) + points.max(axis=0)) / 2.0
    for _ in range(CENTRINGS):
        near = points - target
        distance = _distance(near, slopes)

        # Centre the picture: what is nearer to the camera is larger.
        seen = near[:, :2] / (distance - near[:, 2:])
        target[:2] += distance * (seen.min(axis=0) + seen.max(axis=0)) / 2.0
    distance = _distance(points - target, slopes)

    lowest = float((points @ axes)[:, 2].min())
    is_seen = not has_floor(model) and direction[2] >= EDGE_ON
    return FilmCamera(
        target=target @ axes,
        offset=distance * direction,
        field_of_view=FIELD_OF_VIEW,
        floor=lowest if is_seen else None,
        spacing=FLOOR_SPACING * distance,
    )


def lowered(camera: FilmCamera, lowest: float, highest: float) -> FilmCamera:
    """Return a camera that follows a body, with the floor below the whole motion.

    Args:
        camera: The camera, placed relative to the body.
        lowest: Height of the lowest point that the body reaches, relative to its begin [m].
        highest: Height of the highest point that it reaches, relative to its begin [m].
    """
    if camera.floor is None:
        return camera
    height = camera.target[2] + camera.offset[2] + highest - lowest - camera.floor
    spacing = max(camera.spacing, FLOOR_SPACING * float(height))
    return replace(camera, floor=camera.floor + lowest, spacing=spacing)


def _distance(points: Array, slopes: Array) -> float:
    """Smallest distance at which all points are in the picture [m].

    Args:
        points: (n, 3) points relative to the target, along the axes of the camera [m].
        slopes: (2,) half of the width and of the height of the picture at distance 1.
    """
    needed = points[:, 2:] + np.abs(points[:, :2]) / slopes
    return float(needed.max())


def _around_model(model: mujoco.MjModel) -> Array:
    """Return the (8, 3) corners of a cube around the model [m]."""
    signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
    return np.asarray(model.stat.center + 0.5 * float(model.stat.extent) * signs)
