"""The state in which an experiment starts, and the keyframes of a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, unknown
from mjfim.experiment.system_tables import Initial
from mjfim.model.coordinates import joint_dofs, joint_names
from mjfim.model.terms.extension import StateLayout

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


def initial_state(stated: Initial, model: Any, key: Any, layout: StateLayout | None) -> Array:
    """The state in which an experiment starts.

    It is that of a keyframe, the stated numbers, or the reference state of the model. Numbers may
    be stated for the MJCF alone: coordinates that physical terms add are then at rest.

    Args:
        stated: The table `[initial]` of the experiment.
        model: MjModel.
        key: The keyframe that the table names, or None.
        layout: Where the state of the MJCF is in that of the model; None without terms.

    Returns:
        (ns,) state (qpos, qvel, act) with unit quaternions.

    Raises:
        ExperimentError: Stated numbers have the wrong length, or a quaternion is zero.
    """
    if key is not None:
        qpos, qvel, act = np.array(key.qpos), np.array(key.qvel), np.array(key.act)
    else:
        sizes = _Sizes(model, layout)
        qpos = sizes.positions(stated.qpos)
        qvel = sizes.velocities(stated.qvel)
        act = sizes.activations(stated.act, qpos)

    _require_rotations(model, qpos)
    mujoco.mj_normalizeQuat(model, qpos)
    return np.concatenate([qpos, qvel, act])


@dataclass(frozen=True, eq=False)
class _Sizes:
    """Sizes of the stated parts of a state: those of the model, or of the MJCF without terms.

    Attributes:
        model: MjModel.
        layout: Where the state of the MJCF is in that of the model; None without terms.
    """

    model: Any
    layout: StateLayout | None

    def positions(self, stated: Sequence[float] | None) -> Array:
        """(nq,) positions."""
        if stated is None:
            return np.array(self.model.qpos0, dtype=np.float64)
        numbers = np.array(stated, dtype=np.float64)
        if self.layout is not None and len(numbers) == len(self.layout.qpos):
            return self.layout.positions(numbers)
        return self._whole("qpos", numbers, self.model.nq)

    def velocities(self, stated: Sequence[float] | None) -> Array:
        """(nv,) velocities."""
        if stated is None:
            return np.zeros(self.model.nv)
        numbers = np.array(stated, dtype=np.float64)
        if self.layout is not None and len(numbers) == len(self.layout.qvel):
            return self.layout.velocities(numbers)
        return self._whole("qvel", numbers, self.model.nv)

    def activations(self, stated: Sequence[float] | None, qpos: Array) -> Array:
        """(na,) activations at the positions qpos: (nq,)."""
        if self.layout is None:
            numbers = np.zeros(self.model.na) if stated is None else np.array(stated)
            return self._whole("act", numbers, self.model.na)

        count = len(self.layout.act)
        numbers = np.zeros(count) if stated is None else np.array(stated)
        if len(numbers) == count:
            return self.layout.activations(numbers, qpos, None)
        return self._whole("act", numbers, self.model.na)

    def _whole(self, name: str, numbers: Array, count: int) -> Array:
        """The numbers, of which there must be as many as the model has; ExperimentError if not."""
        if len(numbers) != count:
            raise ExperimentError(
                f"initial.{name}: {len(numbers)} numbers; this model needs {count}"
            )
        return np.asarray(numbers, dtype=np.float64)


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
