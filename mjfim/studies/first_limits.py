"""Limits within which a person would play a first motion: speeds, distances and bandwidth."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.excitation.limits.limits import SOFT_KINDS, SOFT_SHARE, limits_of_model
from mjfim.model.clearance import PLANE, GeomDistances, find_geom_pairs, with_floor
from mjfim.model.coordinates import joint_dofs, joint_names
from mjfim.model.elements import translations, unique_names
from mjfim.model.floor import find_floor
from mjfim.model.limited_elements import tilt_weights
from mjfim.model.loading import ModelSource
from mjfim.studies.first_candidates import rounded
from mjfim.studies.first_motion import Start, TimeScale, has_gravity

# Derived limit of a speed, relative to the largest speed of the motion at rest, where that is
# larger than the natural speed: a robot that sinks or falls keeps its limits.
SPEED_ROOM = 2.0

# Half of the width of the box of a free body or of a slide without a range, relative to the robot's
# length, and largest tilt of a free body [rad].
BOX = 2.0
TILT = 0.8

# Room of a range that is exceeded at rest, relative to the excess.
SOFT_ROOM = 4.0

# Clearance, relative to the length of the robot. Pairs of bodies that are nearer than twice this
# at rest are ignored.
CLEARANCE_SHARE = 0.02

# Height of a floor that is written as zero, relative to the clearance.
ZERO_HEIGHT = 1e-3

# Bandwidth of the control in characteristic periods of the motion, and fewest periods of it within
# the horizon.
BANDWIDTH = 6.0
FEWEST_PERIODS = 4.0

# Largest number of configurations at rest whose distances are measured.
MOST_CONFIGURATIONS = 20


def played(
    model: Any, start: Start, controls: Array, moved: Array | None = None
) -> tuple[Array, Array, Array]:
    """The motion in plain MuJoCo.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        start: Initial state.
        controls: (n, nu) controls of the engine steps.
        moved: (nv,) change of the initial positions; None without one.

    Returns:
        (n+1, nq) positions, (n+1, nv) velocities and (n+1, ntendon) lengths of tendons; fewer rows
        where the simulation diverges.
    """
    data = mujoco.MjData(model)
    data.qpos[:], data.act[:] = start.qpos, start.act
    if moved is not None:
        mujoco.mj_integratePos(model, data.qpos, moved, 1.0)
    mujoco.mj_forward(model, data)
    watched = (data.qpos, data.qvel, data.ten_length)
    seen = [[each.copy()] for each in watched]
    for control in controls:
        data.ctrl[:] = control
        mujoco.mj_step(model, data)
        if data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
            break
        for rows, each in zip(seen, watched, strict=True):
            rows.append(each.copy())
    positions, velocities, lengths = map(np.stack, seen)
    return positions, velocities, lengths


def playable_limits(
    source: ModelSource, start: Start, times: TimeScale, length: float, stated: Mapping[str, float]
) -> dict[str, Any]:
    """Limits that the MJCF does not state, such that the robot at rest keeps them.

    Speeds are those of a pendulum of the robot's length. What is not fixed and has no range gets a
    box about its start, and a free body a tilt.

    Args:
        source: The model.
        start: Initial state and resting control.
        times: Rate, horizon and period of the motion.
        length: Length of the robot [m].
        stated: Velocity limits that a URDF states by joint [m/s or rad/s].

    Returns:
        Keys of the table `[limits]`, without those that nothing in the model can have.
    """
    model = source.model
    resting = np.tile(start.control, (round(times.horizon / model.opt.timestep), 1))
    positions, velocities, lengths = played(model, start, resting)
    sizes = np.where(translations(model), length, 1.0)
    limits = _of_joints(model, positions, velocities, sizes, 2.0 * np.pi / times.period)
    limits["velocity"] |= stated
    for kind, found in _widened(model, positions, lengths).items():
        limits.setdefault(kind, {}).update(found)
    limits = {kind: found for kind, found in limits.items() if found}

    # One number holds for all joints.
    speeds = list(limits["velocity"].values())
    if len(speeds) == model.njnt and len(set(speeds)) == 1:
        limits["velocity"] = speeds[0]
    step = -(-len(positions) // MOST_CONFIGURATIONS)
    limits |= _clearance(source, positions[::step], rounded(CLEARANCE_SHARE * length, 1))
    bandwidth = max(BANDWIDTH / times.period, FEWEST_PERIODS / times.horizon)
    if bandwidth < 0.5 * times.rate:
        limits["bandwidth"] = rounded(bandwidth)
    return limits


def _of_joints(
    model: Any, positions: Array, velocities: Array, sizes: Array, natural: float
) -> dict[str, Any]:
    """Speeds of all joints, and a box and a tilt of what has no range and can go anywhere.

    Args:
        model: The compiled model.
        positions: (n, nq) positions at rest.
        velocities: (n, nv) velocities at rest.
        sizes: (nv,) length of the robot, or one radian [m or rad].
        natural: Speed of a pendulum of the robot's length [rad/s].
    """
    found: dict[str, Any] = {"velocity": {}, "angular_velocity": {}, "position": {}, "tilt": {}}
    for joint, name in enumerate(joint_names(model)):
        q, dof, count = model.jnt_qposadr[joint], model.jnt_dofadr[joint], joint_dofs(model, joint)
        is_free, moved = count == 6, min(count, 3)
        parts = {"velocity": dof, "angular_velocity": dof + 3} if is_free else {"velocity": dof}
        for kind, first in parts.items():
            fastest = np.linalg.norm(velocities[:, first : first + moved], axis=1).max()
            speed = max(natural * sizes[first], SPEED_ROOM * fastest)
            found[kind][name] = rounded(speed)

        if translations(model)[dof] and not model.jnt_limited[joint]:
            path = positions[:, q : q + moved]
            width = BOX * sizes[dof] + SPEED_ROOM * np.abs(path - path[0]).max(axis=0)
            ends = np.stack([path[0] - width, path[0] + width], axis=1)
            box = [[rounded(low, 3), rounded(high, 3)] for low, high in ends.tolist()]
            found["position"][name] = box if is_free else box[0]
        if is_free and has_gravity(model):
            turned = positions[:, q + 3 : q + 7] @ tilt_weights(model, joint).T
            tilt = 2.0 * np.arcsin(np.clip(np.linalg.norm(turned, axis=1), 0.0, 1.0)).max()
            if TILT + SPEED_ROOM * tilt < np.pi:
                found["tilt"][name] = rounded(TILT + SPEED_ROOM * tilt)
    return found


def _widened(model: Any, positions: Array, lengths: Array) -> dict[str, Any]:
    """Ranges of joints and tendons that (n, nq) positions and (n, ntendon) lengths at rest exceed.

    A stop is soft: where the start is outside, the range is widened by some times the excess.
    """
    found: dict[str, Any] = {}
    for limit in limits_of_model(model):
        if limit.kind not in SOFT_KINDS or limit.is_magnitude:
            continue
        values = (positions if limit.kind == "position" else lengths)[:, limit.index]
        ends = np.array([limit.lower, limit.upper])
        excess = np.array([min(values.min() - ends[0], 0.0), max(values.max() - ends[1], 0.0)])
        most = SOFT_SHARE * (ends[1] - ends[0])
        if not limit.lower <= values[0] <= limit.upper and (np.abs(excess) < most).all():
            wider = ends + np.clip(SOFT_ROOM * excess, -most, most)
            found.setdefault(limit.kind, {})[limit.name] = [rounded(end, 6) for end in wider]
    return found


def _clearance(source: ModelSource, positions: Array, least: float) -> dict[str, Any]:
    """The least distance [m], the floor, and the pairs of bodies that are nearer at rest.

    The floor is stated where the MJCF has none, or where it does not collide with every body.

    Args:
        source: The model.
        positions: (n, nq) positions at rest.
        least: The least distance [m].
    """
    model, stated = source.model, {"clearance": least}
    height, _, _ = find_floor(model, positions[0])
    height = rounded(height, 6) if abs(height) > ZERO_HEIGHT * least else 0.0
    # A stated floor is a height over z, and that of the rehearsal one against gravity.
    is_upright = model.opt.gravity[2] <= 0.0 and not model.opt.gravity[:2].any()
    if is_upright and np.isfinite(height) and not _collides_with_planes(model):
        stated["floor"] = height
        model = with_floor(source, height).model
    try:
        pairs = find_geom_pairs(model, ())
        distances = GeomDistances(model, pairs, 2.0 * least)
    except ExperimentError:
        return {}

    nearest = distances(positions, slopes=False)[0].min(axis=0)
    near = {name for name, d in zip(distances.columns, nearest, strict=True) if d < 2.0 * least}
    if len(near) == len(nearest):
        return {}
    names = np.array(unique_names(model, "body"))[model.geom_bodyid]
    ends = dict.fromkeys((str(names[first]), str(names[second])) for first, second, _ in pairs)
    ignored = [[*each] for each in ends if " - ".join(each) in near]
    return stated | ({"ignored": ignored} if near else {})


def _collides_with_planes(model: Any) -> bool:
    """Whether every moving body that has a geom can collide with a plane of the world."""
    moving = set(model.geom_bodyid[model.body_weldid[model.geom_bodyid] > 0].tolist())
    with suppress(ExperimentError):
        pairs = find_geom_pairs(model, ())
        moving -= {
            model.geom_bodyid[first]
            for first, second, _ in pairs
            if model.geom_type[second] == PLANE
        }
    return not moving
