"""Robots that move in Rerun.

All bodies are directly under one entity with their world poses; geoms are their static children.
"""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.output.rerun.shapes import GeomType, RobotStyle, drawn_shapes, translucent

# Parts of the path of an entity, not escaped.
EntityParts = tuple[str, ...]

# Thickness of the path of a robot's end [points].
PATH_THICKNESS = 1.0


# ---- poses


@dataclass(frozen=True, eq=False, kw_only=True)
class BodyPoses:
    """World poses of all bodies along a trajectory.

    Attributes:
        t: (N+1,) times [s].
        positions: (N+1, nbody, 3) origins of the bodies [m].
        quaternions: (N+1, nbody, 4) orientations, wxyz.
    """

    t: Array
    positions: Array
    quaternions: Array

    def world_paths(self, bodies: NDArray[np.intp], points: Array, every: int = 1) -> Array:
        """Return the paths of points that are fixed to bodies.

        Args:
            bodies: (n,) body of each point.
            points: (n, 3) points in the frames of their bodies [m].
            every: Step between the samples that are used.

        Returns:
            (samples, n, 3) world paths [m].
        """
        w = self.quaternions[::every, bodies, :1]
        v = self.quaternions[::every, bodies, 1:]
        shifts = 2.0 * np.cross(v, np.cross(v, points) + w * points)
        return np.asarray(self.positions[::every, bodies] + points + shifts)


def body_poses(model: mujoco.MjModel, t: Array, qpos: Array) -> BodyPoses:
    """Compute the forward kinematics of each sample.

    Args:
        model: The model.
        t: (N+1,) times [s].
        qpos: (N+1, nq) positions.
    """
    data = mujoco.MjData(model)
    positions = np.empty((len(qpos), model.nbody, 3))
    quaternions = np.empty((len(qpos), model.nbody, 4))
    for k, q in enumerate(qpos):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        positions[k] = data.xpos
        quaternions[k] = data.xquat
    return BodyPoses(t=np.asarray(t), positions=positions, quaternions=quaternions)


def is_moving(model: mujoco.MjModel, body: int) -> bool:
    """Return True for a body that some joint moves.

    Args:
        model: The model.
        body: Number of the body.
    """
    return int(model.body_weldid[body]) != 0


def has_floor(model: mujoco.MjModel) -> bool:
    """Return True for a model with a ground plane, so that a view needs no grid.

    Args:
        model: The model.
    """
    return bool(np.any(model.geom_type == int(GeomType.mjGEOM_PLANE)))


# ---- entities and times


def entity_path(parts: EntityParts) -> str:
    """Return the path of an entity with each part escaped.

    Args:
        parts: Parts of the path.
    """
    return rr.new_entity_path(list(parts))


def time_column(t: Array) -> rr.TimeColumn:
    """Return simulated times on the timeline `sim_time`, rounded to whole nanoseconds.

    Args:
        t: (n,) times [s].
    """
    nanoseconds = np.rint(np.asarray(t) * 1e9).astype("timedelta64[ns]")
    return rr.TimeColumn("sim_time", duration=nanoseconds)


def rerun_quaternion(wxyz: Array) -> rr.Quaternion:
    """Return a quaternion of MuJoCo in the order of Rerun, xyzw.

    Args:
        wxyz: (4,) quaternion in the order of MuJoCo.
    """
    return rr.Quaternion(xyzw=np.roll(wxyz, -1))


def body_parts(model: mujoco.MjModel, root: EntityParts, body: int) -> EntityParts:
    """Return the parts of the path of a body; unnamed bodies are numbered.

    Args:
        model: The model.
        root: Entity of the robot.
        body: Number of the body.
    """
    name = model.body(body).name or f"body{body}"
    return (*root, "bodies", name)


def first_shape_parts(model: mujoco.MjModel, root: EntityParts, body: int) -> EntityParts:
    """Return the parts of the path of the first shape of a body.

    A camera can follow a shape; it cannot follow a body, whose entity has no shape of its own.

    Args:
        model: The model.
        root: Entity of the robot.
        body: Number of the body.
    """
    style = RobotStyle(accent=(0, 0, 0))
    parts = body_parts(model, root, body)
    shape = next(drawn_shapes(model, body, style), None)
    return parts if shape is None else (*parts, shape.name)


# ---- robots


def log_robot(
    rec: rr.RecordingStream,
    model: mujoco.MjModel,
    root: EntityParts,
    poses: BodyPoses,
    style: RobotStyle,
) -> None:
    """Log the shapes of one robot, and its poses on `sim_time`.

    Args:
        rec: The recording.
        model: The model.
        root: Entity of the robot.
        poses: Poses of its bodies.
        style: Style in which it is drawn.
    """
    for body in range(model.nbody):
        parts = body_parts(model, root, body)
        _log_shapes(rec, model, parts, body, style)

        # Body 0 is the world, which stays at the origin.
        if body == 0:
            continue
        if is_moving(model, body):
            _log_motion(rec, entity_path(parts), poses, body)
        else:
            _log_fixed_pose(rec, entity_path(parts), poses, body)


def pale_shapes(
    model: mujoco.MjModel, root: EntityParts, style: RobotStyle
) -> dict[str, rrb.Visualizer]:
    """Return translucent shapes of the moving bodies of a robot, for a view with several robots.

    Args:
        model: The model.
        root: Entity of the robot.
        style: Style in which it is drawn.

    Returns:
        The appearance of each shape, by the path of its entity.
    """
    pale = {}
    for body in filter(lambda b: is_moving(model, b), range(1, model.nbody)):
        parts = body_parts(model, root, body)
        for shape in drawn_shapes(model, body, style):
            found = translucent(shape)
            pale[entity_path((*parts, shape.name))] = found
    return pale


def log_end_path(
    rec: rr.RecordingStream,
    model: mujoco.MjModel,
    root: EntityParts,
    poses: BodyPoses,
    style: RobotStyle,
) -> None:
    """Log the path of a robot's end as a line, on all timelines.

    Args:
        rec: The recording.
        model: The model.
        root: Entity of the robot.
        poses: Poses of its bodies.
        style: Style in which it is drawn.
    """
    point = end_point(model, poses)
    if point is not None:
        path = strip_of_path(point.path(poses), style)
        rec.log(entity_path((*root, "path")), path, static=True, strict=True)


def strip_of_path(path: Array, style: RobotStyle) -> rr.LineStrips3D:
    """Return a path in the world as a line.

    Args:
        path: (n, 3) points [m].
        style: Style with the colour.
    """
    radius = rr.Radius.ui_points(PATH_THICKNESS)
    return rr.LineStrips3D([path], colors=[[*style.accent, 255]], radii=radius)


def _log_fixed_pose(rec: rr.RecordingStream, path: str, poses: BodyPoses, body: int) -> None:
    """Log the pose of a body that nothing moves, as static data."""
    position = poses.positions[0, body]
    quaternion = rerun_quaternion(poses.quaternions[0, body])
    pose = rr.Transform3D(translation=position, quaternion=quaternion)
    rec.log(path, pose, static=True, strict=True)


def _log_motion(rec: rr.RecordingStream, path: str, poses: BodyPoses, body: int) -> None:
    """Log the poses of a moving body, a row per sample.

    No pose is static, because static data would override the others.
    """
    xyz = poses.positions[:, body]
    xyzw = np.roll(poses.quaternions[:, body], -1, axis=1)
    rows = rr.Transform3D.columns(translation=xyz, quaternion=xyzw)
    rec.send_columns(path, [time_column(poses.t)], rows, strict=True)


def log_pose(
    rec: rr.RecordingStream,
    model: mujoco.MjModel,
    root: EntityParts,
    poses: BodyPoses,
    sample: int,
) -> None:
    """Log the pose of a robot at one sample of a motion, at the time that is set."""
    for body in filter(lambda b: is_moving(model, b), range(1, model.nbody)):
        pose = rr.Transform3D(
            translation=poses.positions[sample, body],
            quaternion=rerun_quaternion(poses.quaternions[sample, body]),
        )
        rec.log(entity_path(body_parts(model, root, body)), pose, strict=True)


def _log_shapes(
    rec: rr.RecordingStream,
    model: mujoco.MjModel,
    parts: EntityParts,
    body: int,
    style: RobotStyle,
) -> None:
    """Log the shapes of one body in its frame."""
    for shape in drawn_shapes(model, body, style):
        pose = rr.Transform3D(
            translation=shape.position, quaternion=rerun_quaternion(shape.quaternion)
        )
        path = entity_path((*parts, shape.name))
        rec.log(path, pose, shape.archetype, static=True, strict=True)


# ---- points of moving bodies


def moving_geoms(model: mujoco.MjModel) -> NDArray[np.intp]:
    """Return the geoms of moving bodies.

    Args:
        model: The model.
    """
    return np.flatnonzero(model.body_weldid[model.geom_bodyid])


def _moving_centres(model: mujoco.MjModel) -> tuple[NDArray[np.intp], Array]:
    """Return the origins of moving bodies and the centres of their geoms.

    Returns:
        bodies: (n,) body of each point.
        points: (n, 3) points in the frames of their bodies [m].
    """
    moving = np.flatnonzero(model.body_weldid)
    geoms = moving_geoms(model)

    origins = np.zeros((len(moving), 3))
    points = np.concatenate([origins, model.geom_pos[geoms]])
    bodies = np.concatenate([moving, model.geom_bodyid[geoms]])
    return bodies.astype(np.intp), points


@dataclass(frozen=True, kw_only=True, eq=False)
class EndPoint:
    """The end of a robot, whose path is drawn.

    Attributes:
        body: Number of its body.
        point: (3,) the point in the frame of the body [m].
    """

    body: int
    point: Array

    def path(self, poses: BodyPoses) -> Array:
        """Return the (N+1, 3) path in the world [m].

        Args:
            poses: Poses of the bodies.
        """
        return poses.world_paths(np.array([self.body]), self.point[None])[:, 0]


def end_point(model: mujoco.MjModel, poses: BodyPoses) -> EndPoint | None:
    """Return the end of a robot.

    Of the points deepest in the tree, it is the one that travels farthest.

    Args:
        model: The model.
        poses: Poses of its bodies.

    Returns:
        The end; None where nothing moves.
    """
    bodies, points = _moving_centres(model)
    if not len(bodies):
        return None

    depth = np.zeros(model.nbody, dtype=np.intp)
    for body in range(1, model.nbody):
        depth[body] = depth[model.body_parentid[body]] + 1
    deepest = depth[bodies] == depth[bodies].max()

    paths = poses.world_paths(bodies[deepest], points[deepest])
    steps = np.linalg.norm(np.diff(paths, axis=0), axis=2)
    farthest = int(np.argmax(steps.sum(axis=0)))
    return EndPoint(body=int(bodies[deepest][farthest]), point=points[deepest][farthest])
