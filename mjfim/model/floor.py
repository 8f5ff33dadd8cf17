"""The floor under a robot, and the lowest points of its bodies."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.model.clearance import PLANE, PRIMITIVES, farthest_points
from mjfim.model.elements import model_length

# Height below the floor that counts as passing through it, over the length of the model. Soft
# contacts give way by less.
PASSED_SHARE = 0.02

# Cosine of the largest angle between a floor and the horizontal plane.
LEVEL_FLOOR = 0.99

# Places of the bodies and of the geoms, and frames of the geoms.
Pose = tuple[Array, Array, Array]


def pose_of(data: Any) -> Pose:
    """Copies of the centres of mass of bodies, and of places and frames of geoms (MjData)."""
    return data.xipos.copy(), data.geom_xpos.copy(), data.geom_xmat.copy()


def _upwards(model: Any) -> Array:
    """(3,) unit vector against gravity; z without gravity."""
    gravity = np.array(model.opt.gravity)
    strength = float(np.linalg.norm(gravity))
    return -gravity / strength if strength > 0.0 else np.array([0.0, 0.0, 1.0])


def _moving_geoms(model: Any) -> NDArray[np.intp]:
    """Numbers of the geoms of moving bodies that have a lowest point."""
    return np.flatnonzero(_has_shape(model) & (model.body_weldid[model.geom_bodyid] > 0))


def _has_shape(model: Any) -> NDArray[np.bool_]:
    return np.isin(model.geom_type, (*PRIMITIVES, int(mujoco.mjtGeom.mjGEOM_MESH)))


def moving_heights(model: Any, poses: Sequence[Pose]) -> Array:
    """(n,) heights of the lowest point of the bodies that move, in n poses [m].

    Args:
        model: The model (`mujoco.MjModel`).
        poses: The poses.
    """
    centres = np.array([bodies for bodies, _, _ in poses])[:, model.body_weldid > 0]
    lowest = (centres @ _upwards(model)).min(axis=1, initial=np.inf)
    of_geoms = _geom_heights(model, poses, _moving_geoms(model))
    return np.asarray(np.minimum(lowest, of_geoms))


def _geom_heights(model: Any, poses: Sequence[Pose], geoms: NDArray[np.intp]) -> Array:
    """(n,) heights of the lowest point of some geoms in n poses [m]; infinite without a geom."""
    up, lowest = _upwards(model), np.full(len(poses), np.inf)
    places = np.array([each[geoms] for _, each, _ in poses])
    frames = np.array([each[geoms] for _, _, each in poses])
    along = np.einsum("ngij,i->ngj", frames.reshape(len(poses), len(geoms), 3, 3), up)
    centre, half = np.split(model.geom_aabb[geoms], 2, axis=1)
    height = places @ up
    bound = height + (along * centre - np.abs(along) * half).sum(axis=2)
    # The boxes about the geoms are lower bounds; geoms are measured where these are lower.
    for i in np.argsort(bound.min(axis=0)).tolist():
        below = np.flatnonzero(bound[:, i] < lowest)
        geom, down = int(geoms[i]), -along[below, i]
        kind, mesh = int(model.geom_type[geom]), int(model.geom_dataid[geom])
        if not len(below):
            continue
        if kind in PRIMITIVES:
            points = farthest_points(kind, model.geom_size[geom], down)
            reach = (points * down).sum(axis=1)
        else:
            first = int(model.mesh_vertadr[mesh])
            points = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])]
            reach = (points @ down.T).max(axis=0)
        lowest[below] = np.minimum(lowest[below], height[below, i] - reach)
    return lowest


def find_floor(model: Any, qpos: Array, stated: float | None = None) -> tuple[float, bool, float]:
    """Find the floor under a robot in its start, or the floor that it most likely has.

    A plane of the model below the robot is its floor. Without one, the lower end of a base that
    does not move is taken, above which an arm stands. The floor of a robot that hangs from its
    base, or has none, is at height 0 if the robot is above it. What falls has a floor anyway.

    Args:
        model: The model (`mujoco.MjModel`).
        qpos: (nq,) positions of the start.
        stated: Height of the floor where it is known [m].

    Returns:
        Its height against gravity [m], minus infinity without a floor; whether the model has it as
        a plane, or its height is stated; and the height below it that counts as passing through it
        [m].
    """
    data, up = mujoco.MjData(model), _upwards(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    poses, depth = [pose_of(data)], PASSED_SHARE * float(model_length(model))
    lowest, moving = float(moving_heights(model, poses)[0]), _moving_geoms(model)
    is_fixed = model.body_weldid == 0
    of_fixed = is_fixed[model.geom_bodyid]

    normals = data.geom_xmat[:, 2::3] @ up
    planes = np.flatnonzero((model.geom_type == PLANE) & of_fixed & (normals > LEVEL_FLOOR))
    heights = data.geom_xpos[planes] @ up
    below = heights[heights <= lowest + depth] if stated is None else np.array([stated])
    if len(below):
        # What touches a plane sinks in as far as its contact is soft, but not by half of itself.
        types, affinities = model.geom_contype, model.geom_conaffinity
        touch = types[moving, None] & affinities[planes] | affinities[moving, None] & types[planes]
        halves = model.geom_aabb[moving[touch.any(axis=1)], 3:]
        depth = max(depth, float(halves.min())) if halves.size else depth
        height = float(below.max())
        return height, bool(np.isfinite(height)), depth

    base = np.flatnonzero(_has_shape(model) & of_fixed & (model.geom_bodyid > 0))
    foot = float(_geom_heights(model, poses, base)[0])
    if not len(base):
        # The frame of a base without a geom stands for its lower end.
        parents = np.setdiff1d(model.body_parentid[~is_fixed], [0, *np.flatnonzero(~is_fixed)])
        foot = float((data.xpos[parents] @ up).min(initial=np.inf))
    is_free = bool((model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any())
    is_above = model.opt.gravity.any() if is_free else lowest >= 0.0
    height = -np.inf
    # The lowest point of an arm without geoms is not known.
    if foot <= lowest + depth and (is_free or len(moving)):
        height = min(foot, lowest)
    elif is_above and (is_free or len(moving)):
        height = min(0.0, lowest)
    return height, False, depth
