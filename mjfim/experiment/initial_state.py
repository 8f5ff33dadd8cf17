"""The state in which an experiment starts, and the keyframes of a model."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, unknown
from mjfim.experiment.system_tables import Initial
from mjfim.model.coordinates import joint_dofs, joint_names

# A quaternion whose norm is below this number states no rotation.
NO_ROTATION = 1e-6


def keyframe(model: Any, key: str, name: str | None) -> Any:
    """Find a keyframe of a model by its name.

    Args:
        model: MjModel.
        key: Key of the experiment file that states the name, for the message.
        name: Name of the keyframe, or None.

    Returns:
        The keyframe; None without a name.

    Raises:
        ExperimentError: There is no keyframe of this name.
    """
    if name is None:
        return None

    kind = mujoco.mjtObj.mjOBJ_KEY
    names = [mujoco.mj_id2name(model, kind, i) or "" for i in range(model.nkey)]
    if name not in names:
        raise ExperimentError(f"{key}: {unknown('keyframe', name, [n for n in names if n])}")
    return model.key(name)


def initial_state(stated: Initial, model: Any, key: Any) -> Array:
    """The state in which an experiment starts.

    It is that of a keyframe, the stated numbers, or the reference state of the model.

    Args:
        stated: The table `[initial]` of the experiment.
        model: MjModel.
        key: The keyframe that the table names, or None.

    Returns:
        (ns,) state (qpos, qvel, act) with unit quaternions.

    Raises:
        ExperimentError: Stated numbers have the wrong length, or a quaternion is zero.
    """
    parts = {"qpos": model.qpos0, "qvel": np.zeros(model.nv), "act": np.zeros(model.na)}
    if key is not None:
        parts = {"qpos": key.qpos, "qvel": key.qvel, "act": key.act}

    tables = {"qpos": stated.qpos, "qvel": stated.qvel, "act": stated.act}
    for name, numbers in tables.items():
        if numbers is None:
            continue
        if len(numbers) != len(parts[name]):
            raise ExperimentError(
                f"initial.{name}: {len(numbers)} numbers; this model needs {len(parts[name])}"
            )
        parts[name] = np.asarray(numbers, dtype=np.float64)

    qpos = np.array(parts["qpos"], dtype=np.float64)
    _require_rotations(model, qpos)
    mujoco.mj_normalizeQuat(model, qpos)
    return np.concatenate([qpos, parts["qvel"], parts["act"]])


def _require_rotations(model: Any, qpos: Array) -> None:
    """Raise ExperimentError if a quaternion in qpos: (nq,) is zero."""
    for j, name in enumerate(joint_names(model)):
        if joint_dofs(model, j) == 1:
            continue

        # The quaternion of a free joint follows its position.
        is_free = int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_FREE)
        first = int(model.jnt_qposadr[j]) + (3 if is_free else 0)
        if not np.linalg.norm(qpos[first : first + 4]) > NO_ROTATION:
            raise ExperimentError(
                f"initial.qpos: the quaternion of joint {name!r} (numbers {first} to {first + 3}) "
                "is zero; the identity rotation is 1, 0, 0, 0"
            )
