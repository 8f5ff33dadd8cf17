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
    fit_in_view,
    moving_points,
    seen_points,
    view_direction,
)
from mjfim.output.rerun.scene import BodyPoses, has_floor

# Vertical field of view [rad].
FIELD_OF_VIEW = float(np.radians(40.0))

# Share of the picture that the motion fills.
FILLED = 0.9

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
        size: Width and height of the picture [pixels].
    """

    target: Array
    offset: Array
    field_of_view: float
    floor: float | None
    spacing: float
    size: tuple[int, int]

    @property
    def scale(self) -> float:
        """Pixels per metre [1/m] at the point to which the camera looks."""
        distance = float(np.linalg.norm(self.offset))
        return self.size[1] / (2.0 * distance * float(np.tan(self.field_of_view / 2.0)))


def place_film_camera(
    model: mujoco.MjModel, motions: Sequence[BodyPoses], size: tuple[int, int]
) -> FilmCamera:
    """Place a camera that has all moving geoms of every motion in view.

    Args:
        model: The model.
        motions: Poses along each trajectory.
        size: Width and height of the picture [pixels].
    """
    clouds = moving_points(model, motions)
    direction = view_direction(extents(clouds))
    axes = camera_axes(direction)
    points = seen_points(model, clouds) @ axes.T
    slope = FILLED * float(np.tan(FIELD_OF_VIEW / 2.0))
    view = fit_in_view(points, slope, size[0] / size[1])

    lowest = float((points @ axes)[:, 2].min())
    is_seen = not has_floor(model) and direction[2] >= EDGE_ON
    return FilmCamera(
        target=view.target @ axes,
        offset=view.distance * direction,
        field_of_view=FIELD_OF_VIEW,
        floor=lowest if is_seen else None,
        spacing=FLOOR_SPACING * view.distance,
        size=size,
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
