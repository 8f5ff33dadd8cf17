"""Natural sizes at a slide or hinge joint, from which terms choose their numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco

from mjfim.errors import ExperimentError
from mjfim.model.sizes import LEAST_MOVE_PER_SAMPLE, force_sizes, position_sizes
from mjfim.model.terms.term import TermTable, named_element
from mjfim.model.units import joint_unit

# Significant digits of numbers that the library chooses.
CHOSEN_DIGITS = 3


@dataclass(frozen=True, kw_only=True)
class JointSizes:
    """Natural sizes at a slide or hinge joint.

    Attributes:
        joint: Name of the joint.
        number: Number of the joint.
        dof: Its degree of freedom.
        unit: Unit of its coordinate, m or rad.
        inertia: Inertia that its force feels in the reference position [kg or kg m²].
        force: Force that moves it by its natural size in the natural time [N or N m].
        speed: Its natural size over the natural time [m/s or rad/s].
    """

    joint: str
    number: int
    dof: int
    unit: str
    inertia: float
    force: float
    speed: float

    @staticmethod
    def of(table: TermTable, model: Any, period: float, kind: str) -> JointSizes:
        """Sizes at the joint that a table names; ExperimentError for ball and free joints."""
        name, number = named_element(table, "joint", model, kind)
        scalar = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))
        if int(model.jnt_type[number]) not in scalar:
            raise ExperimentError(
                f"joint: {name!r} is a ball or free joint; a term of kind {kind!r} acts on slides "
                "and hinges"
            )

        time = period / LEAST_MOVE_PER_SAMPLE
        dof = int(model.jnt_dofadr[number])
        weight = float(model.dof_invweight0[dof])
        return JointSizes(
            joint=name,
            number=number,
            dof=dof,
            unit=joint_unit(model, number),
            inertia=1.0 / weight if weight > 0.0 else 1.0,
            force=float(force_sizes(model, time)[dof]),
            speed=float(position_sizes(model)[dof]) / time,
        )


def rounded(number: float) -> float:
    """A number that the library chooses, with as many digits as matter."""
    return float(f"{number:.{CHOSEN_DIGITS}g}")
