"""The tree of joints of a model, as arrays for many states at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array


@dataclass(frozen=True, kw_only=True, eq=False)
class JointTree:
    """Hinges and slides of a model, and the bodies that each of them moves.

    Attributes:
        supports: (nv, nv) 1 where joint j (column) is joint i (row) or lies between it and the
            world, otherwise 0.
        is_hinge: (nv,) True for a hinge, False for a slide.
        bodies: (b,) ids of the bodies that joints move.
        last_joint: (b,) number of the joint nearest to each of these bodies, on its way to the
            world.
    """

    supports: Array
    is_hinge: np.ndarray
    bodies: np.ndarray
    last_joint: np.ndarray

    @property
    def count(self) -> int:
        """Number of joints."""
        return len(self.is_hinge)

    @staticmethod
    def of(model: Any) -> JointTree | None:
        """The tree of a model.

        Args:
            model: Compiled MuJoCo model.

        Returns:
            The tree; None where a joint is neither a hinge nor a slide.
        """
        kinds = np.asarray(model.jnt_type)
        is_hinge = kinds == int(mujoco.mjtJoint.mjJNT_HINGE)
        if not (is_hinge | (kinds == int(mujoco.mjtJoint.mjJNT_SLIDE))).all():
            return None

        # Parents have lower numbers than their children.
        nv = int(model.nv)
        supports = np.eye(nv)
        for i, parent in enumerate(model.dof_parentid.tolist()):
            if parent >= 0:
                supports[i] += supports[parent]

        # A body without a joint of its own moves with its parent.
        last = np.full(model.nbody, -1)
        for body in range(1, model.nbody):
            last[body] = last[model.body_parentid[body]]
            if model.body_dofnum[body]:
                last[body] = model.body_dofadr[body] + model.body_dofnum[body] - 1
        bodies = np.flatnonzero(last >= 0)

        return JointTree(
            supports=supports, is_hinge=is_hinge, bodies=bodies, last_joint=last[bodies]
        )
