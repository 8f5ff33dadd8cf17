"""Change of a model by its parameters: what derivatives in closed form need to know about it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from mjfim.arrays import Array
from mjfim.model.parameters import Parameter
from mjfim.model.targets import InertiaField, ModelField

# Arrays of MjModel that hold the inertia of bodies.
INERTIA_ARRAYS = ("body_mass", "body_ipos", "body_inertia")

# Arrays of MjModel that hold what springs, dampers and actuators do, and the inertia of the joints
# themselves.
FORCE_ARRAYS = (
    "dof_damping",
    "dof_armature",
    "jnt_stiffness",
    "qpos_spring",
    "actuator_gainprm",
    "actuator_biasprm",
)


def is_inertial(parameter: Parameter) -> bool:
    """Whether a parameter changes nothing but the inertia of bodies."""
    fields = [target.field for target in parameter.targets]
    return bool(fields) and all(
        isinstance(field, InertiaField)
        or (isinstance(field, ModelField) and field.array in INERTIA_ARRAYS)
        for field in fields
    )


def acts_on_joints(parameter: Parameter) -> bool:
    """Whether a parameter changes nothing but springs, dampers, gains and armatures."""
    fields = [target.field for target in parameter.targets]
    return bool(fields) and all(
        isinstance(field, ModelField) and {name for name, _, _ in field.numbers} <= {*FORCE_ARRAYS}
        for field in fields
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class ParameterChange:
    """Derivatives of a model by m parameters, or along m directions of them.

    Attributes:
        inertia: (b, 10, m) of the moved bodies' barycentric inertias.
        springs: (nv, 1 + 2 nv + nu, m) of the affine forces of springs and dampers.
        actuators: (actuators, 1 + 2 nv + nu, m) of the affine forces of actuators.
        damping: (nv, m) of the damping of the joints.
        armature: (nv, m) of the inertia that is added to each joint.
    """

    inertia: Array
    springs: Array
    actuators: Array
    damping: Array
    armature: Array

    @property
    def count(self) -> int:
        """Number m of parameters or directions."""
        return int(self.inertia.shape[-1])

    def along(self, directions: Array) -> ParameterChange:
        """Change along directions of the m parameters: (n, m)."""
        names = [field.name for field in fields(self)]
        return ParameterChange(**{name: getattr(self, name) @ directions.T for name in names})

    @staticmethod
    def joined(changes: Sequence[ParameterChange]) -> ParameterChange:
        """Changes by several parameters side by side."""
        names = [field.name for field in fields(ParameterChange)]
        return ParameterChange(
            **{
                name: np.concatenate([getattr(change, name) for change in changes], axis=-1)
                for name in names
            }
        )
