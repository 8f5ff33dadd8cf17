"""Friction of a joint beyond what MuJoCo's joints offer.

The Stribeck effect and presliding are the bristle of a `dcmotor` without control, which MuJoCo
integrates exactly at the speed of each step. Its internal stiffness is chosen from the inertia of
the joint and from the timestep.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.errors import ExperimentError
from mjfim.model.integrators import is_rk4
from mjfim.model.terms.changes import Attributes, ChangedElement, MjcfChange, NewElement
from mjfim.model.terms.joint_sizes import JointSizes, rounded
from mjfim.model.terms.term import (
    FieldDescription,
    Term,
    TermQuantity,
    TermTable,
    require_free_name,
    resolved_values,
)
from mjfim.model.units import FORCE_UNITS, JOINT_FIELD_UNITS, per_second

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


class _PassiveDevice(Term):
    """A term that is one `dcmotor` without control at a joint.

    Attributes:
        joint: Name of the joint.
    """

    joint: str

    @property
    def _attributes(self) -> Attributes:
        """Attributes of the `dcmotor` besides its name and its joint."""
        raise NotImplementedError

    def _set(self, actuator: Any) -> None:
        """Set the numbers of the actuator in an MjSpec."""
        raise NotImplementedError

    def edit(self, spec: Any) -> None:
        """Add the passive device."""
        actuator = spec.add_actuator(name=self.name)
        actuator.trntype = mujoco.mjtTrn.mjTRN_JOINT
        actuator.target = self.joint
        actuator.gear = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
        actuator.dyntype = mujoco.mjtDyn.mjDYN_DCMOTOR
        actuator.gaintype = mujoco.mjtGain.mjGAIN_DCMOTOR
        actuator.biastype = mujoco.mjtBias.mjBIAS_DCMOTOR
        actuator.ctrlspec = int(mujoco.mjtCtrlInput.mjINPUT_NONE)

        # The motor constant is zero, so that the resistance has no effect.
        for name in ("gainprm", "biasprm", "dynprm"):
            setattr(actuator, name, np.zeros(len(getattr(actuator, name))))
        actuator.gainprm = _with(actuator.gainprm, {0: 1.0})
        actuator.actlimited = mujoco.mjtLimited.mjLIMITED_FALSE
        actuator.actearly = True
        self._set(actuator)

    def changes(self) -> tuple[MjcfChange, ...]:
        """The element in the text."""
        attributes = (
            ("name", self.name),
            ("joint", self.joint),
            ("gear", "1"),
            ("input", "none"),
            ("motorconst", "0"),
            ("resistance", "1"),
            *self._attributes,
        )
        return (NewElement(parent="actuator", tag="dcmotor", attributes=attributes),)


@dataclass(frozen=True, kw_only=True)
class Stribeck(_PassiveDevice):
    """Friction that falls from its static to its Coulomb value with the speed.

    Attributes:
        joint: Name of the joint.
        stiffness: Stiffness of the bristle [N/m or N m/rad].
    """

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

    joint: str
    stiffness: float

    @classmethod
    def of(cls, table: TermTable, model: Any, period: float) -> Stribeck:
        """Resolve the term; RK4 is refused, whose stages would make the bristle unstable."""
        at = JointSizes.of(table, model, period, cls.kind)
        require_free_name(model, "actuator", table.name)
        if is_rk4(model):
            raise ExperimentError(
                "kind: with the integrator RK4, the bristle of 'stribeck' is unstable; use the "
                "kind 'lugre', or the integrator implicitfast in the MJCF"
            )

        values = resolved_values(
            cls.kind, table, {"excess": 0.0, "speed": STRIBECK_SHARE * at.speed}
        )
        place = f"actuator/{table.name}:biasprm"
        quantities = (
            (
                "excess",
                TermQuantity(
                    value=values["excess"],
                    unit=FORCE_UNITS[at.unit],
                    size=at.force,
                    bounds=(0.0, np.inf),
                    numbers=((f"{place}[4]", 1.0),),
                ),
            ),
            ("speed", _stribeck_speed(values["speed"], at, f"{place}[5]")),
        )
        stiffness = rounded(BRISTLE_STIFFNESS * at.inertia / float(model.opt.timestep) ** 2)
        return cls(name=table.name, joint=at.joint, quantities=quantities, stiffness=stiffness)

    @property
    def _attributes(self) -> Attributes:
        """The friction without a Coulomb part and without damping of the bristle."""
        numbers = (self.stiffness, 0.0, 0.0, self.value("excess"), self.value("speed"))
        return (("lugre", numbers),)

    def _set(self, actuator: Any) -> None:
        """Set the numbers of the actuator in an MjSpec."""
        actuator.actdim = 1
        actuator.dynprm = _with(actuator.dynprm, {5: self.stiffness})
        friction = {4: self.value("excess"), 5: self.value("speed")}
        actuator.biasprm = _with(actuator.biasprm, friction)


@dataclass(frozen=True, kw_only=True)
class LuGre(_PassiveDevice):
    """Dynamic friction with a displacement before sliding, in place of the joint's dry friction.

    Attributes:
        joint: Name of the joint.
        has_frictionloss: Whether the stated joint has dry friction, which the term replaces.
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

    joint: str
    has_frictionloss: bool

    @classmethod
    def of(cls, table: TermTable, model: Any, period: float) -> LuGre:
        """Resolve the term."""
        at = JointSizes.of(table, model, period, cls.kind)
        require_free_name(model, "actuator", table.name)

        stiffness, damping = BRISTLE_STIFFNESS, BRISTLE_DAMPING
        if is_rk4(model):
            stiffness, damping = BRISTLE_STIFFNESS_RK4, BRISTLE_DAMPING_RK4
        timestep = float(model.opt.timestep)
        frictionloss = float(model.dof_frictionloss[at.dof])
        defaults = {
            "coulomb": frictionloss,
            "excess": 0.0,
            "speed": STRIBECK_SHARE * at.speed,
            "stiffness": rounded(stiffness * at.inertia / timestep**2),
            "damping": rounded(damping * at.inertia / timestep),
        }
        values = resolved_values(cls.kind, table, defaults)

        actuator = f"actuator/{table.name}"
        positive = (0.0, np.inf)
        quantities = (
            (
                "coulomb",
                TermQuantity(
                    value=values["coulomb"],
                    unit=FORCE_UNITS[at.unit],
                    size=at.force,
                    bounds=positive,
                    numbers=((f"{actuator}:biasprm[3]", 1.0), (f"{actuator}:biasprm[4]", 1.0)),
                ),
            ),
            (
                "excess",
                TermQuantity(
                    value=values["excess"],
                    unit=FORCE_UNITS[at.unit],
                    size=at.force,
                    bounds=positive,
                    numbers=((f"{actuator}:biasprm[4]", 1.0),),
                ),
            ),
            ("speed", _stribeck_speed(values["speed"], at, f"{actuator}:biasprm[5]")),
            (
                "stiffness",
                TermQuantity(
                    value=values["stiffness"],
                    unit=JOINT_FIELD_UNITS["stiffness"][at.unit],
                    size=defaults["stiffness"],
                    # Without stiffness there is no bristle, which MuJoCo decides at the compile.
                    bounds=(LEAST_STRIBECK_SHARE * defaults["stiffness"], np.inf),
                    numbers=((f"{actuator}:dynprm[5]", 1.0),),
                ),
            ),
            (
                "damping",
                TermQuantity(
                    value=values["damping"],
                    unit=JOINT_FIELD_UNITS["damping"][at.unit],
                    size=defaults["damping"],
                    bounds=positive,
                    numbers=((f"{actuator}:dynprm[6]", 1.0),),
                ),
            ),
        )
        return cls(
            name=table.name,
            joint=at.joint,
            quantities=quantities,
            has_frictionloss=frictionloss > 0.0,
        )

    @property
    def is_written_as_a_whole(self) -> bool:
        """MuJoCo keeps the static friction, which is the sum of two fields."""
        return True

    def write(self, model: Any, values: Mapping[str, float]) -> None:
        """Write all fields."""
        row = model.actuator(self.name).id
        model.actuator_biasprm[row, 3] = values["coulomb"]
        model.actuator_biasprm[row, 4] = values["coulomb"] + values["excess"]
        model.actuator_biasprm[row, 5] = values["speed"]
        model.actuator_dynprm[row, 5] = values["stiffness"]
        model.actuator_dynprm[row, 6] = values["damping"]

    def edit(self, spec: Any) -> None:
        """Add the passive device, and take the dry friction from the joint."""
        super().edit(spec)
        if self.has_frictionloss:
            spec.joint(self.joint).frictionloss = 0.0

    def changes(self) -> tuple[MjcfChange, ...]:
        """The element in the text, and the joint without dry friction."""
        added = super().changes()
        if not self.has_frictionloss:
            return added
        joint = ChangedElement(
            kind="joint", name=self.joint, attributes=(("frictionloss", (0.0,)),)
        )
        return (*added, joint)

    @property
    def _attributes(self) -> Attributes:
        """The friction, and a range that keeps its damping explicit."""
        static = self.value("coulomb") + self.value("excess")
        numbers = (
            self.value("stiffness"),
            self.value("damping"),
            self.value("coulomb"),
            static,
            self.value("speed"),
        )
        return (("saturation", (NO_ELECTRICAL_FORCE,)), ("lugre", numbers))

    def _set(self, actuator: Any) -> None:
        """Set the numbers of the actuator in an MjSpec."""
        actuator.actdim = 1
        bristle = {5: self.value("stiffness"), 6: self.value("damping")}
        actuator.dynprm = _with(actuator.dynprm, bristle)
        friction = {
            3: self.value("coulomb"),
            4: self.value("coulomb") + self.value("excess"),
            5: self.value("speed"),
        }
        actuator.biasprm = _with(actuator.biasprm, friction)
        actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
        actuator.forcerange = np.array([-NO_ELECTRICAL_FORCE, NO_ELECTRICAL_FORCE])


@dataclass(frozen=True, kw_only=True)
class AsymmetricFriction(_PassiveDevice):
    """A constant force beside the joint's dry friction, which then differs by direction.

    Attributes:
        joint: Name of the joint.
    """

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

    joint: str

    @classmethod
    def of(cls, table: TermTable, model: Any, period: float) -> AsymmetricFriction:
        """Resolve the term."""
        at = JointSizes.of(table, model, period, cls.kind)
        require_free_name(model, "actuator", table.name)
        values = resolved_values(cls.kind, table, {"offset": 0.0})
        offset = TermQuantity(
            value=values["offset"],
            unit=FORCE_UNITS[at.unit],
            size=at.force,
            numbers=((f"actuator/{table.name}:biasprm[0]", 1.0),),
        )
        return cls(name=table.name, joint=at.joint, quantities=(("offset", offset),))

    @property
    def _attributes(self) -> Attributes:
        """The constant force."""
        return (("cogging", (self.value("offset"), 0.0, CONSTANT_PHASE)),)

    def _set(self, actuator: Any) -> None:
        """Set the numbers of the actuator in an MjSpec."""
        constant = {0: self.value("offset"), 2: CONSTANT_PHASE}
        actuator.biasprm = _with(actuator.biasprm, constant)


def _stribeck_speed(value: float, at: JointSizes, path: str) -> TermQuantity:
    """The Stribeck speed of a joint as a field; it is never zero."""
    return TermQuantity(
        value=value,
        unit=per_second(at.unit),
        size=STRIBECK_SHARE * at.speed,
        bounds=(LEAST_STRIBECK_SHARE * at.speed, np.inf),
        numbers=((path, 1.0),),
    )


def _with(numbers: Any, changed: Mapping[int, float]) -> np.ndarray:
    """A copy of some numbers, of which those at given places are replaced."""
    copied = np.array(numbers, dtype=np.float64)
    for place, value in changed.items():
        copied[place] = value
    return copied
