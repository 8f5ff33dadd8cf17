"""Robots that move: bodies flat under a root with world poses, geoms as their static children; and the camera."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.output.rerun.shapes import (
    DEFAULT_RGBA,
    GeomType,
    Look,
    drawn_geoms,
    geom_rgba,
    shape,
    sticks,
)

Route = tuple[str, ...]
FIELD_OF_VIEW = np.radians(50.0)  # a little less than the viewer's own, which leaves a margin


@dataclass(frozen=True, eq=False)
class Motion:
    """World poses along a trajectory.

    t: (N+1,) [s];  pos: (N+1, nbody, 3) [m];  quat: (N+1, nbody, 4) wxyz
    """

    t: Array
    pos: Array
    quat: Array

    def world(self, bodies: NDArray[np.intp], points: Array, every: int = 1) -> Array:
        """(rows, n, 3) world path [m] of points fixed to bodies. bodies: (n,), points: (n, 3) in the bodies' frames."""
        w, v = self.quat[::every, bodies, :1], self.quat[::every, bodies, 1:]
        return np.asarray(
            self.pos[::every, bodies] + points + 2.0 * np.cross(v, np.cross(v, points) + w * points)
        )


def motion(model: mujoco.MjModel, t: Array, qpos: Array) -> Motion:
    """Forward kinematics of each row. t: (N+1,) [s], qpos: (N+1, nq)."""
    data = mujoco.MjData(model)
    pos, quat = np.empty((len(qpos), model.nbody, 3)), np.empty((len(qpos), model.nbody, 4))
    for k, q in enumerate(qpos):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        pos[k], quat[k] = data.xpos, data.xquat
    return Motion(np.asarray(t), pos, quat)


def time_column(t: Array) -> rr.TimeColumn:
    """Simulated time on `sim_time`, rounded to whole nanoseconds. t: (n,) [s]."""
    return rr.TimeColumn(
        "sim_time", duration=np.rint(np.asarray(t) * 1e9).astype("timedelta64[ns]")
    )


def entity(path: Route) -> str:
    """Entity path with each part escaped."""
    return rr.new_entity_path(list(path))


def body_path(model: mujoco.MjModel, root: Route, body: int) -> Route:
    """Where a body of the robot under `root` lives; unnamed bodies are numbered."""
    return (*root, "bodies", model.body(body).name or f"body{body}")


def is_moving(model: mujoco.MjModel, body: int) -> bool:
    """True for bodies that some joint moves."""
    return int(model.body_weldid[body]) != 0


def log_robot(
    rec: rr.RecordingStream,
    model: mujoco.MjModel,
    root: Route,
    poses: Motion,
    look: Look,
    iteration: bool = False,
) -> None:
    """One robot: shapes and poses on `sim_time`.

    iteration: log the start pose on the timeline `iteration` too, so that the robot shows there
    """
    for body in range(model.nbody):
        path = body_path(model, root, body)
        log_shapes(rec, model, path, body, look)
        if body:
            log_pose(rec, model, entity(path), poses, body, iteration)


def log_trail(
    rec: rr.RecordingStream, model: mujoco.MjModel, root: Route, poses: Motion, look: Look
) -> None:
    """Path of a robot's end as a line."""
    line = trail(model, poses)
    if len(line):
        strips = rr.LineStrips3D(
            [line], colors=[[*look.accent, 255]], radii=rr.Radius.ui_points(1.0)
        )
        rec.log(entity((*root, "path")), strips, static=True, strict=True)


def log_pose(
    rec: rr.RecordingStream,
    model: mujoco.MjModel,
    path: str,
    poses: Motion,
    body: int,
    iteration: bool,
) -> None:
    """World pose of a body: static where nothing moves it, else a row per sample (static data would win over it)."""
    xyz, xyzw = poses.pos[:, body], np.roll(poses.quat[:, body], -1, axis=1)
    if not is_moving(model, body):
        pose = rr.Transform3D(translation=xyz[0], quaternion=rr.Quaternion(xyzw=xyzw[0]))
        rec.log(path, pose, static=True, strict=True)
        return
    rec.send_columns(
        path,
        [time_column(poses.t)],
        rr.Transform3D.columns(translation=xyz, quaternion=xyzw),
        strict=True,
    )
    if iteration:
        first = rr.Transform3D.columns(translation=xyz[:1], quaternion=xyzw[:1])
        rec.send_columns(path, [rr.TimeColumn("iteration", sequence=[0])], first, strict=True)


def log_shapes(
    rec: rr.RecordingStream, model: mujoco.MjModel, path: Route, body: int, look: Look
) -> None:
    """The geoms of one body in its frame; a stick figure where a moving body has none."""
    moving = is_moving(model, body)
    geoms = drawn_geoms(model, body)
    for geom in geoms:
        drawn = shape(model, geom, look.paint(geom_rgba(model, geom), moving))
        if drawn is not None:
            x, y, z, w = np.roll(model.geom_quat[geom], -1)
            pose = rr.Transform3D(
                translation=model.geom_pos[geom], quaternion=rr.Quaternion(xyzw=[x, y, z, w])
            )
            name = model.geom(geom).name or f"geom{geom}"
            rec.log(entity((*path, name)), pose, drawn, static=True, strict=True)
    if moving and not geoms:
        rec.log(
            entity((*path, "sticks")),
            *sticks(model, body, look.paint(DEFAULT_RGBA, True)),
            static=True,
            strict=True,
        )


def moving_centres(model: mujoco.MjModel) -> tuple[NDArray[np.intp], Array]:
    """Origins of moving bodies and centres of their geoms: bodies (n,), points (n, 3) in the bodies' frames [m]."""
    bodies = np.flatnonzero(model.body_weldid)
    geoms = np.flatnonzero(model.body_weldid[model.geom_bodyid])
    points = np.concatenate([np.zeros((len(bodies), 3)), model.geom_pos[geoms]])
    return np.concatenate([bodies, model.geom_bodyid[geoms]]).astype(np.intp), points


def moving_corners(model: mujoco.MjModel) -> tuple[NDArray[np.intp], Array]:
    """As `moving_centres`, with the eight corners of each geom's bounding box instead of its centre."""
    bodies, points = (
        [*np.flatnonzero(model.body_weldid)],
        [*np.zeros((np.count_nonzero(model.body_weldid), 3))],
    )
    signs = np.stack(np.meshgrid(*[(-1.0, 1.0)] * 3), axis=-1).reshape(-1, 3)
    for geom in np.flatnonzero(model.body_weldid[model.geom_bodyid]):
        rotation = np.empty(9)
        mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
        corners = model.geom_aabb[geom, :3] + signs * model.geom_aabb[geom, 3:]
        points += [*(model.geom_pos[geom] + corners @ rotation.reshape(3, 3).T)]
        bodies += [int(model.geom_bodyid[geom])] * len(signs)
    return np.array(bodies, dtype=np.intp), np.array(points).reshape(-1, 3)


def trail(model: mujoco.MjModel, poses: Motion) -> Array:
    """(N+1, 3) world path [m] of the robot's end: of the points deepest in the tree, the one that travels farthest."""
    bodies, points = moving_centres(model)
    if not len(bodies):
        return np.empty((0, 3))
    depth = np.zeros(model.nbody, dtype=np.intp)
    for body in range(1, model.nbody):
        depth[body] = depth[model.body_parentid[body]] + 1
    ends = depth[bodies] == depth[bodies].max()
    paths = poses.world(bodies[ends], points[ends])
    length = np.linalg.norm(np.diff(paths, axis=0), axis=2).sum(axis=0)
    return np.asarray(paths[:, int(np.argmax(length))])


def view_direction(spread: Array) -> Array:
    """Unit vector from scene to camera: along the horizontal axis of a planar motion, else from the front right."""
    x, y = spread[0], spread[1]
    if y < 0.2 * x:
        out = np.array([0.0, -1.0, 0.15])
    elif x < 0.2 * y:
        out = np.array([1.0, 0.0, 0.15])
    else:
        out = np.array([1.0, -1.0, 0.6])
    return np.asarray(out / np.linalg.norm(out))


@dataclass(frozen=True)
class Camera:
    """Where to look from, the same for every robot.

    position, target: world [m];  stacked: views look best above each other;  sideways: the ground is seen edge-on
    """

    position: tuple[float, ...]
    target: tuple[float, ...]
    stacked: bool
    sideways: bool

    def controls(self) -> rrb.EyeControls3D:
        """For a 3D view's blueprint."""
        return rrb.EyeControls3D(
            position=self.position, look_target=self.target, eye_up=(0.0, 0.0, 1.0)
        )


def camera(model: mujoco.MjModel, motions: Sequence[Motion], views: int, aspect: float) -> Camera:
    """Camera that holds all that moves, in every motion, in view; the whole model where nothing moves.

    views: how many share a region of the given width over height
    """
    bodies, points = moving_corners(model)
    clouds = [poses.world(bodies, points, every=max(1, len(poses.t) // 200)) for poses in motions]
    spread = np.max([np.ptp(cloud, axis=0).max(axis=0, initial=0.0) for cloud in clouds], axis=0)
    back = view_direction(spread)
    right = np.cross((0.0, 0.0, 1.0), back) / np.linalg.norm(back[:2])
    axes = np.stack([right, np.cross(back, right), back])
    seen = np.concatenate([(cloud @ axes.T).reshape(-1, 3) for cloud in clouds])
    low, high = (seen.min(axis=0), seen.max(axis=0)) if len(seen) else (np.zeros(3), np.zeros(3))
    if not np.any(high > low):
        middle, reach = axes @ model.stat.center, float(model.stat.extent)
        low, high = middle - reach, middle + reach
    width, height, depth = np.maximum(high - low, 1e-6)
    stacked = min(1.0 / (views * height), aspect / width) > min(
        1.0 / height, aspect / (views * width)
    )
    frame = max(height, width / (aspect * views if stacked else aspect / views))
    distance = 0.56 * frame / np.tan(FIELD_OF_VIEW / 2.0) + depth / 2.0
    target = (low + high) / 2.0 @ axes
    return Camera(
        tuple(map(float, target + distance * back)),
        tuple(map(float, target)),
        bool(stacked),
        bool(back[2] < 0.3),
    )


def has_floor(model: mujoco.MjModel) -> bool:
    """True where the model brings its own ground, so that a view needs no grid."""
    return bool(np.any(model.geom_type == int(GeomType.mjGEOM_PLANE)))
