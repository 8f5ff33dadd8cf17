"""Camera of the 3D views of a Rerun recording, shared by all robots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from mjfim.arrays import Array, record
from mjfim.output.rerun.scene import BodyPoses, moving_geoms

# Vertical field of view that holds the scene [rad]; a little less than that of the viewer, which
# leaves a margin.
FIELD_OF_VIEW = np.radians(50.0)

# Times that a camera is centred on the picture of the motion, which its distance changes.
CENTRINGS = 4

# Samples of a motion from which the camera is placed.
CAMERA_SAMPLES = 200

# Ratio of the horizontal extents of a motion below which it counts as planar.
PLANAR_RATIO = 0.2

# Height of the unit vector towards the camera below which the ground is seen edge-on.
EDGE_ON = 0.3

# A base is followed if it travels as far as this multiple of the size of the robot around it; the
# followed robot is then seen with free space around it, as a multiple of its size.
FOLLOWED_TRAVEL, FOLLOW_ROOM = 1.5, 1.5

# The (8, 3) corners of a cube from -1 to 1.
CORNERS = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3)

# Vectors from the scene towards the camera: for a motion in the x-z plane, in the y-z plane, and in
# space.
TOWARDS_CAMERA_XZ = np.array([0.0, -1.0, 0.15])
TOWARDS_CAMERA_YZ = np.array([1.0, 0.0, 0.15])
TOWARDS_CAMERA_SPATIAL = np.array([1.0, -1.0, 0.6])


@record
class Camera:
    """Camera that is shared by all robots, so that they can be compared.

    Attributes:
        position: Position in the world [m].
        target: Point that it looks at [m].
        stacked: True where several views show the scene larger if they are above each other.
        edge_on: True where the ground is seen edge-on.
        followed: Number of the body that it follows; None where it stands still.
    """

    position: tuple[float, ...]
    target: tuple[float, ...]
    stacked: bool
    edge_on: bool
    followed: int | None = None


def place_camera(
    model: mujoco.MjModel,
    motions: Sequence[BodyPoses],
    views: int,
    aspect: float,
    *,
    follow: bool = True,
) -> Camera:
    """Place a camera that has all moving geoms of every motion in view.

    If nothing moves, the whole model is in view. A base that travels far may be followed.

    Args:
        model: The model.
        motions: Poses along each trajectory.
        views: Number of views that share a region of the layout.
        aspect: Width of that region over its height.
        follow: False for a camera that never follows a body.
    """
    clouds = moving_points(model, motions)
    towards_camera = view_direction(clouds)
    axes = camera_axes(towards_camera)
    followed = followed_body(model, motions) if follow else None
    if followed is not None:
        # The body stays where the first motion begins.
        begin = motions[0].positions[0, followed]
        around = [
            replace(each, positions=each.positions - each.positions[:, followed, None] + begin)
            for each in motions
        ]
        clouds = moving_points(model, around)

    points = seen_points(model, clouds) @ axes.T
    if followed is not None:
        middle = (points.min(axis=0) + points.max(axis=0)) / 2.0
        points = middle + FOLLOW_ROOM * (points - middle)

    # Views are stacked if this draws the scene larger.
    slope = float(np.tan(FIELD_OF_VIEW / 2.0))
    beside = fit_in_view(points, slope, aspect / views)
    above = fit_in_view(points, slope, aspect * views)
    stacked = views > 1 and above[1] * views < beside[1]
    middle, distance = above if stacked else beside
    target = middle @ axes
    position = target + distance * towards_camera
    return Camera(
        position=tuple(map(float, position)),
        target=tuple(map(float, target)),
        stacked=stacked,
        edge_on=bool(towards_camera[2] < EDGE_ON),
        followed=followed,
    )


def followed_body(model: mujoco.MjModel, motions: Sequence[BodyPoses]) -> int | None:
    """Return the moving base that a camera follows; None where none travels far.

    Args:
        model: The model.
        motions: Poses along each trajectory.
    """
    # Bases are moving bodies that something at rest carries. The one with most mass counts.
    parents, welds = model.body_parentid, model.body_weldid
    bases = np.flatnonzero((welds == np.arange(model.nbody)) & (welds[parents] == 0))[1:]
    if not len(bases):
        return None
    body = int(bases[np.argmax(model.body_subtreemass[bases])])
    tree = model.body_treeid == model.body_treeid[body]

    # Each slide of a base may have a body of its own.
    slides = model.jnt_bodyid[model.jnt_type == int(mujoco.mjtJoint.mjJNT_SLIDE)]
    while len(carried := slides[parents[slides] == body]):
        body = int(carried[0])

    geoms = np.flatnonzero(tree[model.geom_bodyid])
    own = np.linalg.norm(model.geom_pos[geoms], axis=1) + model.geom_rbound[geoms]
    size, travel = 0.0, 0.0
    for poses in motions:
        around = poses.positions[:, model.geom_bodyid[geoms]] - poses.positions[:, [body]]
        reach = np.linalg.norm(around, axis=2) + own
        size = max(size, 2.0 * float(reach.max(initial=0.0)))
        travel = max(travel, float(np.ptp(poses.positions[:, body], axis=0).max()))
    return body if travel >= FOLLOWED_TRAVEL * (size or model.stat.extent) else None


def moving_points(model: mujoco.MjModel, motions: Sequence[BodyPoses]) -> list[Array]:
    """Return (samples, n, 3) world paths of the corners of all moving geoms [m].

    There is an array for each motion.

    Args:
        model: The model.
        motions: Poses along each trajectory.
    """
    # The origins of moving bodies, and the corners of the bounding boxes of their geoms.
    moving = np.flatnonzero(model.body_weldid)
    bodies, points = [moving], [np.zeros((len(moving), 3))]
    for geom in moving_geoms(model):
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        corners = model.geom_aabb[geom, :3] + CORNERS * model.geom_aabb[geom, 3:]
        points.append(model.geom_pos[geom] + corners @ rotation.reshape(3, 3).T)
        bodies.append(np.full(len(CORNERS), model.geom_bodyid[geom]))
    every_body, every_point = np.concatenate(bodies), np.concatenate(points)
    return [
        poses.world_paths(every_body, every_point, max(1, len(poses.t) // CAMERA_SAMPLES))
        for poses in motions
    ]


def view_direction(clouds: Sequence[Array]) -> Array:
    """Return the (3,) unit vector towards the camera.

    It is along the normal of a planar motion, else from the front right.

    Args:
        clouds: (samples, n, 3) world paths of each motion [m].
    """
    # The largest distance that any point travels along each world axis.
    travelled = [np.ptp(cloud, axis=0).max(axis=0, initial=0.0) for cloud in clouds]
    x, y, _ = np.max(travelled, axis=0)
    direction = TOWARDS_CAMERA_SPATIAL
    if y < PLANAR_RATIO * x:
        direction = TOWARDS_CAMERA_XZ
    elif x < PLANAR_RATIO * y:
        direction = TOWARDS_CAMERA_YZ
    return np.asarray(direction / np.linalg.norm(direction))


def camera_axes(towards_camera: Array) -> Array:
    """Return the (3, 3) axes of the camera as rows: right, up, and towards the camera.

    Args:
        towards_camera: (3,) unit vector from the scene towards the camera.
    """
    right = np.cross((0.0, 0.0, 1.0), towards_camera) / np.linalg.norm(towards_camera[:2])
    up = np.cross(towards_camera, right)
    return np.stack([right, up, towards_camera])


def seen_points(model: mujoco.MjModel, clouds: Sequence[Array]) -> Array:
    """Return the (n, 3) points that a camera has in view [m]: a cube around what does not move.

    Args:
        model: The model.
        clouds: (samples, n, 3) world paths of the corners of all moving geoms, by motion [m].
    """
    points = np.concatenate([cloud.reshape(-1, 3) for cloud in clouds])
    if len(points) and np.any(np.ptp(points, axis=0) > 0.0):
        return points

    return np.asarray(model.stat.center + 0.5 * model.stat.extent * CORNERS)


def fit_in_view(points: Array, slope: float, aspect: float) -> tuple[Array, float]:
    """Return where a camera looks that has points in view, and its smallest distance from there.

    Args:
        points: (n, 3) points in the axes of the camera [m].
        slope: Tangent of half the vertical field of view.
        aspect: Width over height of the picture.
    """
    slopes = slope * np.array([aspect, 1.0])
    target = (points.min(axis=0) + points.max(axis=0)) / 2.0
    for _ in range(CENTRINGS):
        near = points - target
        distance = _distance(near, slopes)
        # Centre the picture: what is nearer to the camera is larger.
        seen = near[:, :2] / (distance - near[:, 2:])
        target[:2] += distance * (seen.min(axis=0) + seen.max(axis=0)) / 2.0
    return target, _distance(points - target, slopes)


def _distance(points: Array, slopes: Array) -> float:
    """Smallest distance from the origin at which all points are in the picture [m]."""
    return float((points[:, 2:] + np.abs(points[:, :2]) / slopes).max())
