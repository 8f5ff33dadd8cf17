"""Friction of a joint beyond what MuJoCo's joints offer.

The Stribeck effect and presliding are the bristle of a `dcmotor` without control, which MuJoCo
integrates exactly at the speed of each step. Its internal stiffness is chosen from the inertia of
the joint and from the timestep.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import mujoco
import numpy as np

from mjfim.errors import ExperimentError
from mjfim.model.elements import is_rk4
from mjfim.model.terms.term import (
    FieldDescription,
    JointSizes,
    Shape,
    Term,
    TermQuantity,
    TermTable,
    require_free_name,
    rounded,
    stated_quantities,
)
from mjfim.model.units import FORCE_UNITS, JOINT_FIELD_UNITS, per_second

# Stribeck speeds that a test tries, over the root mean square of the speed of the joint.
TRIED_SHARES = (0.03, 0.1, 0.3)

# Stiffness of the bristle times the timestep squared over the inertia of the joint. The larger it
# is, the shorter the displacement before sliding; above 1, an explicit step overshoots.
BRISTLE_STIFFNESS = 0.2

# The same for the four stages of RK4, which integrate the bristle explicitly in between.
BRISTLE_STIFFNESS_RK4 = 0.1

# Damping of the bristle of the dynamic model times the timestep over the inertia of the joint.
BRISTLE_DAMPING = 0.2
BRISTLE_DAMPING_RK4 = 0.1

# Stribeck speed where none is stated, and the smallest one, over the natural speed of the joint.
STRIBECK_SHARE = 0.1
LEAST_STRIBECK_SHARE = 1e-3

# Phase of a cogging torque that does not depend on the angle, so that it is its amplitude [rad].
CONSTANT_PHASE = float(np.pi / 2.0)

# Force range of a passive device, so small that MuJoCo's implicit integrators do not take the
# damping of the bristle for damping of the joint, which would act like an inertia [N or N m]. It
# bounds the electrical force, which is zero.
NO_ELECTRICAL_FORCE = float(mujoco.mjMINVAL)

DE_WIT_1995 = (
    "C. Canudas de Wit, H. Olsson, K. J. Åström and P. Lischinsky, A new model for control of "
    "systems with friction, IEEE Transactions on Automatic Control 40, 1995"
)
ARMSTRONG_1994 = (
    "B. Armstrong-Hélouvry, P. Dupont and C. Canudas de Wit, A survey of models, analysis tools "
    "and compensation methods for the control of machines with friction, Automatica 30, 1994"
)
OLSSON_1998 = (
    "H. Olsson, K. J. Åström, C. Canudas de Wit, M. Gäfvert and P. Lischinsky, Friction models and "
    "friction compensation, European Journal of Control 4, 1998"
)


# Numbers of a passive device that each field is part of, as `<array>[<place>]`.
Places = dict[str, tuple[str, ...]]


@dataclass(frozen=True, kw_only=True)
class _PassiveDevice(Term):
    """A term that is one `dcmotor` without control at a joint.

    Attributes:
        places: Numbers of the actuator that each field is part of, by the name of the field.
        joint: Name of the joint.
        fixed: Further numbers of the actuator that are not zero.
        replaces_friction: Whether it takes the place of the dry friction of the joint.
    """

    places: ClassVar[Places]

    joint: str
    fixed: tuple[tuple[str, float], ...]
    replaces_friction: bool

    @classmethod
    def of(cls, table: TermTable, model: Any, period: float) -> Self:
        """Resolve the term."""
        at = JointSizes.of(table, model, period, cls.kind)
        require_free_name(model, "actuator", table.name)
        defaults = {
            field: replace(
                quantity,
                numbers=tuple((f"actuator/{table.name}:{n}", 1.0) for n in cls.places[field]),
            )
            for field, quantity in cls._defaults(at, model).items()
        }
        return cls(
            name=table.name,
            joint=at.joint,
            quantities=stated_quantities(cls.kind, table, defaults),
            fixed=cls._fixed(at, model),
            replaces_friction="coulomb" in defaults and float(model.dof_frictionloss[at.dof]) > 0.0,
        )

    @classmethod
    def shapes(cls, model: Any, element: str, speed: float) -> list[Shape]:
        """Some Stribeck speeds, where the friction has one; none for a joint that stands still."""
        if "speed" not in cls.places:
            return [({}, ())]
        return [({"speed": share * speed}, ("speed",)) for share in TRIED_SHARES if speed > 0.0]

    @classmethod
    @abstractmethod
    def _defaults(cls, at: JointSizes, model: Any) -> dict[str, TermQuantity]:
        """Fields where the table states nothing, without their numbers."""

    @classmethod
    @abstractmethod
    def _fixed(cls, at: JointSizes, model: Any) -> tuple[tuple[str, float], ...]:
        """Further numbers of the actuator."""

    def _numbers(self, values: Mapping[str, float]) -> dict[str, dict[int, float]]:
        """Numbers of the actuator at values of the fields, by array and place."""
        found: dict[str, dict[int, float]] = {"biasprm": {}, "dynprm": {}}
        of_fields = [(place, values[field]) for field in values for place in self.places[field]]
        for place, value in (*self.fixed, *of_fields):
            array, _, index = place.rstrip("]").partition("[")
            found[array][int(index)] = found[array].get(int(index), 0.0) + value
        return found

    def write(self, model: Any, values: Mapping[str, float]) -> None:
        """Write all numbers of the actuator."""
        row = model.actuator(self.name).id
        for array, numbers in self._numbers(values).items():
            getattr(model, f"actuator_{array}")[row, list(numbers)] = list(numbers.values())

    def edit(self, spec: Any) -> None:
        """Add the passive device, and take the dry friction from the joint where it replaces it."""
        actuator = spec.add_actuator(name=self.name)
        actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
        actuator.target = self.joint
        actuator.gear = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        actuator.dyntype = mujoco.mjtDyn.mjDYN_DCMOTOR
        actuator.gaintype = mujoco.mjtGain.mjGAIN_DCMOTOR
        actuator.biastype = mujoco.mjtBias.mjBIAS_DCMOTOR
        actuator.ctrlspec = int(mujoco.mjtCtrlInput.mjINPUT_NONE)

        # The motor constant is zero, so that the resistance has no effect.
        numbers = {"gainprm": {0: 1.0}, **self._numbers(self.values)}
        for array, stated in numbers.items():
            values = np.zeros(len(getattr(actuator, array)))
            values[list(stated)] = list(stated.values())
            setattr(actuator, array, values)
        actuator.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
        actuator.actearly = True
        if numbers["dynprm"]:
            actuator.actdim = 1
        if "damping" in self.places:
            actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            actuator.forcerange = np.array([-NO_ELECTRICAL_FORCE, NO_ELECTRICAL_FORCE])
        if self.replaces_friction:
            spec.joint(self.joint).frictionloss = 0.0


@dataclass(frozen=True, kw_only=True)
class Stribeck(_PassiveDevice):
    """Friction that falls from its static to its Coulomb value with the speed."""

    kind = "stribeck"
    description = (
        "Static friction above Coulomb friction, which vanishes with the speed (Stribeck effect); "
        "the Coulomb friction itself is the joint's `frictionloss`."
    )
    equation = "F(v) = -(frictionloss + excess · exp(-(v/speed)²)) sgn(v)"
    elements = 'actuator/dcmotor with input="none" and lugre, beside the joint\'s frictionloss'
    acts_on = "joint"
    fields = (
        FieldDescription(
            name="excess", description="static friction minus Coulomb friction", unit="N m"
        ),
        FieldDescription(name="speed", description="Stribeck speed", unit="rad/s"),
    )
    sources = (DE_WIT_1995, ARMSTRONG_1994)
    places: ClassVar[Places] = {"excess": ("biasprm[4]",), "speed": ("biasprm[5]",)}
    words = "Stribeck friction of {}"
    size = "excess"
    beside = "frictionloss"

    @classmethod
    def _defaults(cls, at: JointSizes, model: Any) -> dict[str, TermQuantity]:
        """Refuse RK4, whose stages would make the bristle unstable."""
        if is_rk4(model):
            raise ExperimentError(
                "kind: with the integrator RK4, the bristle of 'stribeck' is unstable; use the "
                "kind 'lugre', or the integrator implicitfast in the MJCF"
            )
        return {"excess": _friction(at, 0.0), "speed": _stribeck_speed(at)}

    @classmethod
    def _fixed(cls, at: JointSizes, model: Any) -> tuple[tuple[str, float], ...]:
        """The stiffness of the bristle."""
        stiffness = BRISTLE_STIFFNESS * at.inertia / float(model.opt.timestep) ** 2
        return (("dynprm[5]", rounded(stiffness)),)


@dataclass(frozen=True, kw_only=True)
class LuGre(_PassiveDevice):
    """Dynamic friction with a displacement before sliding, in place of the joint's dry friction.

    MuJoCo keeps the static friction, which is the sum of two fields.
    """

    kind = "lugre"
    description = (
        "Dynamic friction with elastic displacement before sliding and the Stribeck effect; it "
        "replaces the joint's `frictionloss`."
    )
    equation = (
        "F = -(stiffness z + damping ż), ż = v - stiffness |v| z / g(v), "
        "g(v) = coulomb + excess · exp(-(v/speed)²)"
    )
    elements = 'actuator/dcmotor with input="none" and lugre'
    acts_on = "joint"
    fields = (
        FieldDescription(name="coulomb", description="Coulomb friction", unit="N m"),
        FieldDescription(
            name="excess", description="static friction minus Coulomb friction", unit="N m"
        ),
        FieldDescription(name="speed", description="Stribeck speed", unit="rad/s"),
        FieldDescription(name="stiffness", description="stiffness of the bristle", unit="N m/rad"),
        FieldDescription(name="damping", description="damping of the bristle", unit="N m s/rad"),
    )
    sources = (DE_WIT_1995, OLSSON_1998)
    is_written_as_a_whole = True
    places: ClassVar[Places] = {
        "coulomb": ("biasprm[3]", "biasprm[4]"),
        "excess": ("biasprm[4]",),
        "speed": ("biasprm[5]",),
        "stiffness": ("dynprm[5]",),
        "damping": ("dynprm[6]",),
    }

    @classmethod
    def _defaults(cls, at: JointSizes, model: Any) -> dict[str, TermQuantity]:
        """Fields where the table states nothing."""
        stiffness, damping = BRISTLE_STIFFNESS, BRISTLE_DAMPING
        if is_rk4(model):
            stiffness, damping = BRISTLE_STIFFNESS_RK4, BRISTLE_DAMPING_RK4
        timestep = float(model.opt.timestep)
        stiffness = rounded(stiffness * at.inertia / timestep**2)
        damping = rounded(damping * at.inertia / timestep)
        return {
            "coulomb": _friction(at, float(model.dof_frictionloss[at.dof])),
            "excess": _friction(at, 0.0),
            "speed": _stribeck_speed(at),
            # Without stiffness there is no bristle, which MuJoCo decides at the compile.
            "stiffness": TermQuantity(
                value=stiffness,
                unit=JOINT_FIELD_UNITS["stiffness"][at.unit],
                size=stiffness,
                bounds=(LEAST_STRIBECK_SHARE * stiffness, np.inf),
            ),
            "damping": TermQuantity(
                value=damping,
                unit=JOINT_FIELD_UNITS["damping"][at.unit],
                size=damping,
                bounds=(0.0, np.inf),
            ),
        }

    @classmethod
    def _fixed(cls, at: JointSizes, model: Any) -> tuple[tuple[str, float], ...]:
        """No further numbers."""
        return ()


@dataclass(frozen=True, kw_only=True)
class AsymmetricFriction(_PassiveDevice):
    """A constant force beside the joint's dry friction, which then differs by direction."""

    kind = "asymmetric_friction"
    description = (
        "Coulomb friction that differs by direction: the joint's `frictionloss` together with a "
        "constant force."
    )
    equation = "F = -frictionloss · sgn(v) + offset"
    elements = 'actuator/dcmotor with input="none" and cogging without poles'
    acts_on = "joint"
    fields = (
        FieldDescription(
            name="offset",
            description="half of the friction backwards minus that forwards",
            unit="N m",
        ),
    )
    sources = (ARMSTRONG_1994,)
    places: ClassVar[Places] = {"offset": ("biasprm[0]",)}
    words = "friction of {} that differs by direction"
    size = "offset"
    beside = "frictionloss"

    @classmethod
    def _defaults(cls, at: JointSizes, model: Any) -> dict[str, TermQuantity]:
        """Fields where the table states nothing."""
        return {"offset": replace(_friction(at, 0.0), bounds=(-np.inf, np.inf))}

    @classmethod
    def _fixed(cls, at: JointSizes, model: Any) -> tuple[tuple[str, float], ...]:
        """The phase of the cogging torque."""
        return (("biasprm[2]", CONSTANT_PHASE),)


def _friction(at: JointSizes, value: float) -> TermQuantity:
    """A force of dry friction as a field."""
    return TermQuantity(value=value, unit=FORCE_UNITS[at.unit], size=at.force, bounds=(0.0, np.inf))


def _stribeck_speed(at: JointSizes) -> TermQuantity:
    """The Stribeck speed of a joint as a field; it is never zero."""
    return TermQuantity(
        value=STRIBECK_SHARE * at.speed,
        unit=per_second(at.unit),
        size=STRIBECK_SHARE * at.speed,
        bounds=(LEAST_STRIBECK_SHARE * at.speed, np.inf),
    )
