"""An elastic joint or one with backlash between the motor and the link.

The motor side and the link side are two coordinates: one is the joint of the model, the other the
deflection, which is zero at rest. Where the encoder is on the motor, the joint of the model is the
motor, and the deflection is a second joint of the same body. Where it is on the link, the joint of
the model is the link; the rotor is the inertia of a tendon over the joint and the deflection, and
the actuators act on this tendon.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np

from mjfim.errors import ExperimentError
from mjfim.model.elements import element_name
from mjfim.model.sizes import LEAST_MOVE_PER_SAMPLE, position_sizes
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
from mjfim.model.units import ANGLE, JOINT_FIELD_UNITS, LENGTH

# Natural frequency of the motor against the link, times the timestep, where no compliance is
# stated. An explicit step follows it to a per cent.
STIFFEST = 0.3

# The same at the smallest compliance that a fit may try.
STIFFEST_OF_FIT = 1.0

# Damping ratio of this motion where no damping is stated.
DAMPING_RATIO = 0.1
DAMPING_RATIO_OF_BACKLASH = 0.05

# Inertia of the rotor over that of the joint, where the model states no armature.
ROTOR_SHARE = 0.05

# Mass and inertia of the body that carries the deflection, over those of the link.
NEGLIGIBLE = 1e-6

# Units of the compliance by the unit of the joint.
COMPLIANCE_UNITS = {LENGTH: "m/N", ANGLE: "rad/(N m)"}

SPONG_1987 = (
    "M. W. Spong, Modeling and control of elastic joint robots, Journal of Dynamic Systems, "
    "Measurement, and Control 109, 1987"
)
NORDIN_2002 = (
    "M. Nordin and P.-O. Gutman, Controlling mechanical systems with backlash - a survey, "
    "Automatica 38, 2002"
)

Encoder = Literal["motor", "link"]


@dataclass(frozen=True, kw_only=True)
class _Transmission:
    """The joint of a model that becomes motor and link.

    Attributes:
        joint: Name of the joint.
        body: Name of its body.
        slides: Whether it slides.
        axis: Axis in the frame of the body.
        place: Anchor in the frame of the body [m].
        rotor: Inertia of the rotor [kg or kg m²].
        has_armature: Whether the model states the inertia of the rotor.
        carrier: Mass [kg] and inertia [kg m²] of the body that carries the deflection.
        motors: Names and gears of the actuators at the joint that have a control.
        encoder: Side of the joint on which its sensors are.
        stiffness: Largest stiffness that the timestep resolves [N/m or N m/rad].
        damping: Damping of the deflection, by damping ratio 1 [N s/m or N m s/rad].
    """

    joint: str
    body: str
    slides: bool
    axis: tuple[float, ...]
    place: tuple[float, ...]
    rotor: float
    has_armature: bool
    carrier: tuple[float, float]
    motors: tuple[str, ...]
    encoder: Encoder
    stiffness: float
    damping: float

    @staticmethod
    def of(at: JointSizes, table: TermTable, model: Any) -> _Transmission:
        """The transmission at a joint.

        Raises:
            ExperimentError: The joint is not the last one of its body, an actuator cannot be moved,
                or a name is taken.
        """
        body = int(model.jnt_bodyid[at.number])
        last = int(model.body_jntadr[body]) + int(model.body_jntnum[body]) - 1
        if at.number != last:
            raise ExperimentError(
                f"joint: {at.joint!r} is not the last joint of its body, so that no second joint "
                "can follow it; put it into a body of its own"
            )
        name = element_name(model, "body", body)
        if not name:
            raise ExperimentError(f"joint: the body of {at.joint!r} has no name; give it one")
        for kind in ("joint", "body", "tendon"):
            require_free_name(model, kind, table.name)

        encoder: Encoder = "link" if table.encoder == "link" else "motor"
        armature = float(model.dof_armature[at.dof])
        rotor = armature if armature > 0.0 else rounded(ROTOR_SHARE * at.inertia)
        link = max(at.inertia - armature, NEGLIGIBLE * at.inertia)
        reduced = rotor * link / (rotor + link)
        frequency = STIFFEST / float(model.opt.timestep)
        return _Transmission(
            joint=at.joint,
            body=name,
            slides=at.unit == LENGTH,
            axis=tuple(model.jnt_axis[at.number].tolist()),
            place=tuple(model.jnt_pos[at.number].tolist()),
            rotor=rotor,
            has_armature=armature > 0.0,
            carrier=_carrier(model, body, link),
            motors=_motors(model, at.number),
            encoder=encoder,
            stiffness=rounded(reduced * frequency**2),
            damping=rounded(2.0 * reduced * frequency),
        )


class _ElasticTerm(Term):
    """A term that adds a deflection to a joint.

    Attributes:
        at: The joint.
    """

    at: _Transmission

    @property
    @abstractmethod
    def _joint_spring(self) -> tuple[float, float]:
        """Stiffness and damping of the joint of the deflection."""

    def _tendon(self) -> tuple[float, float, float] | None:
        """Stiffness, damping and half of the gap of a tendon at the deflection; None for none."""
        return None

    # ---- MjSpec

    def edit(self, spec: Any) -> None:
        """Add the deflection and, for an encoder on the link, the rotor."""
        at = self.at
        link = spec.body(at.body)
        joint = spec.joint(at.joint)
        if at.encoder == "motor":
            self._add_joint(link)
            joint.armature = at.rotor
        else:
            self._add_joint(self._add_carrier(link))
            joint.armature = 0.0
            self._add_rotor(spec)

        tendon = self._tendon()
        if tendon is not None:
            stiffness, damping, half = tendon
            spring = spec.add_tendon(name=self.gap_name)
            spring.wrap_joint(self.name, 1.0)
            spring.stiffness = _first(spring.stiffness, stiffness)
            spring.damping = _first(spring.damping, damping)
            spring.springlength = [-half, half]

    @property
    def gap_name(self) -> str:
        """Name of the tendon with the gap."""
        return f"{self.name}_gap"

    def _add_joint(self, body: Any) -> None:
        """Add the joint of the deflection to a body."""
        at = self.at
        kinds = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
        joint = body.add_joint(name=self.name, type=kinds[at.slides], axis=at.axis, pos=at.place)
        stiffness, damping = self._joint_spring
        joint.stiffness = _first(joint.stiffness, stiffness)
        joint.damping = _first(joint.damping, damping)
        joint.armature, joint.frictionloss = 0.0, 0.0
        joint.ref, joint.springref = 0.0, 0.0
        joint.springdamper = np.zeros(2)
        joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE

    def _add_carrier(self, link: Any) -> Any:
        """Add the body that carries the deflection, with negligible inertia."""
        mass, inertia = self.at.carrier
        body = link.add_body(name=self.name)
        body.mass = mass
        body.ipos = np.array(self.at.place)
        body.inertia = np.full(3, inertia)
        body.explicitinertial = True
        return body

    def _add_rotor(self, spec: Any) -> None:
        """Add the tendon over joint and deflection, which has the inertia of the rotor."""
        rotor = spec.add_tendon(name=self.name)
        rotor.wrap_joint(self.at.joint, 1.0)
        rotor.wrap_joint(self.name, 1.0)
        rotor.armature = self.at.rotor
        for name in self.at.motors:
            actuator = spec.actuator(name)
            actuator.trntype = mujoco.mjtTrn.mjTRN_TENDON
            actuator.target = self.name

    # ---- text

    def changes(self) -> tuple[MjcfChange, ...]:
        """The deflection in the text and, for an encoder on the link, the rotor."""
        at, stated = self.at, self._joint_attributes()
        rotor: Attributes = (("armature", (at.rotor,)),)
        changes: list[MjcfChange] = []
        if at.encoder == "motor":
            changes.append(
                NewElement(parent_kind="body", parent=at.body, tag="joint", attributes=stated)
            )
            if not at.has_armature:
                changes.append(ChangedElement(kind="joint", name=at.joint, attributes=rotor))
        else:
            changes += self._rotor_changes(stated, rotor)

        tendon = self._tendon()
        if tendon is not None:
            stiffness, damping, half = tendon
            gap: Attributes = (
                ("name", self.gap_name),
                ("stiffness", (stiffness,)),
                ("damping", (damping,)),
                ("springlength", (-half, half)),
            )
            changes.append(_fixed_tendon(gap, (self.name,)))
        return tuple(changes)

    def _joint_attributes(self) -> Attributes:
        """Attributes of the joint of the deflection."""
        at = self.at
        stiffness, damping = self._joint_spring
        return (
            ("name", self.name),
            ("type", "slide" if at.slides else "hinge"),
            ("axis", at.axis),
            ("pos", at.place),
            ("stiffness", (stiffness,)),
            ("damping", (damping,)),
            ("armature", "0"),
            ("frictionloss", "0"),
            ("ref", "0"),
            ("springref", "0"),
            ("limited", "false"),
            ("actuatorfrclimited", "false"),
        )

    def _rotor_changes(self, joint: Attributes, rotor: Attributes) -> list[MjcfChange]:
        """The carrier of the deflection, the rotor, and its motors in the text."""
        at = self.at
        mass, inertia = at.carrier
        inertial: Attributes = (
            ("pos", at.place),
            ("mass", (mass,)),
            ("diaginertia", 3 * (inertia,)),
        )
        carrier = NewElement(
            parent_kind="body",
            parent=at.body,
            tag="body",
            attributes=(("name", self.name),),
            children=(("inertial", inertial), ("joint", joint)),
        )
        changes: list[MjcfChange] = [
            carrier,
            _fixed_tendon((("name", self.name), *rotor), (at.joint, self.name)),
        ]
        if at.has_armature:
            without: Attributes = (("armature", (0.0,)),)
            changes.append(ChangedElement(kind="joint", name=at.joint, attributes=without))
        for name in at.motors:
            on_tendon: Attributes = (("tendon", self.name),)
            changes.append(
                ChangedElement(kind="actuator", name=name, attributes=on_tendon, removed=("joint",))
            )
        return changes


@dataclass(frozen=True, kw_only=True)
class JointElasticity(_ElasticTerm):
    """A spring between the motor and the link of a joint.

    Attributes:
        at: The joint.
    """

    kind = "joint_elasticity"
    description = (
        "A spring between the motor and the link of a joint, as in harmonic drives and belts; the "
        "`armature` is the inertia of the rotor."
    )
    equation = (
        "B θ̈ = τ - (θ - q)/compliance - damping (θ̇ - q̇), "
        "M q̈ + n = (θ - q)/compliance + damping (θ̇ - q̇)"
    )
    elements = (
        "a second joint with stiffness on the same body; with the encoder on the link, a joint on "
        "a child body and a fixed tendon with armature, on which the motors act"
    )
    acts_on = "joint"
    fields = (
        FieldDescription(
            name="compliance", description="deflection per torque, 1/K", unit="rad/(N m)"
        ),
        FieldDescription(name="damping", description="damping of the deflection", unit="N m s/rad"),
    )
    sources = (SPONG_1987,)

    at: _Transmission

    @classmethod
    def of(cls, table: TermTable, model: Any, period: float) -> JointElasticity:
        """Resolve the term."""
        sizes = JointSizes.of(table, model, period, cls.kind)
        at = _Transmission.of(sizes, table, model)
        defaults = {
            "compliance": 1.0 / at.stiffness,
            "damping": rounded(DAMPING_RATIO * at.damping),
        }
        values = resolved_values(cls.kind, table, defaults)
        dof = f"joint/{table.name}"
        quantities = (
            ("compliance", _compliance(values["compliance"], at, sizes, f"{dof}:stiffness")),
            ("damping", _damping(values["damping"], at, sizes, f"{dof}:damping")),
        )
        return cls(name=table.name, at=at, quantities=quantities)

    @property
    def is_written_as_a_whole(self) -> bool:
        """MuJoCo keeps the stiffness, the inverse of the compliance."""
        return True

    def write(self, model: Any, values: Mapping[str, float]) -> None:
        """Write the spring and the damper."""
        joint = model.joint(self.name).id
        model.jnt_stiffness[joint] = 1.0 / values["compliance"]
        model.dof_damping[int(model.jnt_dofadr[joint])] = values["damping"]

    @property
    def _joint_spring(self) -> tuple[float, float]:
        """Stiffness and damping of the joint of the deflection."""
        return 1.0 / self.value("compliance"), self.value("damping")


@dataclass(frozen=True, kw_only=True)
class Backlash(_ElasticTerm):
    """A gap between the motor and the link of a joint, with stiff flanks.

    Attributes:
        at: The joint.
    """

    kind = "backlash"
    description = (
        "A gap between the motor and the link of a joint with elastic flanks, as in gears; the "
        "`armature` is the inertia of the rotor."
    )
    equation = (
        "torque on the link = ψ(θ - q)/compliance + damping (θ̇ - q̇), ψ(δ) = 0 for |δ| < gap/2, "
        "δ - sgn(δ) gap/2 beyond"
    )
    elements = (
        "a second joint on the same body, and a fixed tendon with springlength -gap/2 gap/2 over it"
    )
    acts_on = "joint"
    fields = (
        FieldDescription(name="gap", description="width of the gap", unit="rad"),
        FieldDescription(
            name="compliance", description="deflection of the flanks per torque", unit="rad/(N m)"
        ),
        FieldDescription(
            name="damping", description="damping between motor and link", unit="N m s/rad"
        ),
    )
    sources = (NORDIN_2002,)

    at: _Transmission

    @classmethod
    def of(cls, table: TermTable, model: Any, period: float) -> Backlash:
        """Resolve the term."""
        sizes = JointSizes.of(table, model, period, cls.kind)
        at = _Transmission.of(sizes, table, model)
        require_free_name(model, "tendon", f"{table.name}_gap")
        defaults = {
            "gap": 0.0,
            "compliance": 1.0 / at.stiffness,
            "damping": rounded(DAMPING_RATIO_OF_BACKLASH * at.damping),
        }
        values = resolved_values(cls.kind, table, defaults)
        tendon = f"tendon/{table.name}_gap"
        width = LEAST_MOVE_PER_SAMPLE * float(position_sizes(model)[sizes.dof])
        gap = TermQuantity(
            value=values["gap"],
            unit=sizes.unit,
            size=width,
            bounds=(0.0, np.inf),
            numbers=((f"{tendon}:springlength[0]", -0.5), (f"{tendon}:springlength[1]", 0.5)),
        )
        quantities = (
            ("gap", gap),
            ("compliance", _compliance(values["compliance"], at, sizes, f"{tendon}:stiffness")),
            ("damping", _damping(values["damping"], at, sizes, f"{tendon}:damping")),
        )
        return cls(name=table.name, at=at, quantities=quantities)

    @property
    def is_written_as_a_whole(self) -> bool:
        """MuJoCo keeps the stiffness, the inverse of the compliance."""
        return True

    def write(self, model: Any, values: Mapping[str, float]) -> None:
        """Write the gap, its flanks and the damper."""
        tendon = model.tendon(self.gap_name).id
        half = 0.5 * values["gap"]
        model.tendon_lengthspring[tendon] = (-half, half)
        model.tendon_stiffness[tendon] = 1.0 / values["compliance"]
        model.tendon_damping[tendon] = values["damping"]

    @property
    def _joint_spring(self) -> tuple[float, float]:
        """The joint of the deflection is free; the tendon acts on it."""
        return 0.0, 0.0

    def _tendon(self) -> tuple[float, float, float] | None:
        """Stiffness, damping and half of the gap."""
        return 1.0 / self.value("compliance"), self.value("damping"), 0.5 * self.value("gap")


def _compliance(value: float, at: _Transmission, sizes: JointSizes, path: str) -> TermQuantity:
    """The compliance as a field; its inverse is the stiffness in the model."""
    stiffest = at.stiffness * (STIFFEST_OF_FIT / STIFFEST) ** 2
    return TermQuantity(
        value=value,
        unit=COMPLIANCE_UNITS[sizes.unit],
        size=1.0 / at.stiffness,
        bounds=(1.0 / stiffest, np.inf),
        numbers=((path, 1.0),),
    )


def _damping(value: float, at: _Transmission, sizes: JointSizes, path: str) -> TermQuantity:
    """The damping of the deflection as a field."""
    return TermQuantity(
        value=value,
        unit=JOINT_FIELD_UNITS["damping"][sizes.unit],
        size=at.damping,
        bounds=(0.0, np.inf),
        numbers=((path, 1.0),),
    )


def _carrier(model: Any, body: int, link: float) -> tuple[float, float]:
    """Mass and inertia of a body so light that its own motion does not matter."""
    mass = float(model.body_mass[body]) or float(model.body_subtreemass[body])
    return rounded(NEGLIGIBLE * mass), rounded(NEGLIGIBLE * link)


def _motors(model: Any, joint: int) -> tuple[str, ...]:
    """Names of the actuators with a control at a joint; ExperimentError for one without a name."""
    at_joint = int(mujoco.mjtTrn.mjTRN_JOINT)
    found = []
    for actuator in range(model.nactuator):
        is_here = int(model.actuator_trntype[actuator]) == at_joint
        if not is_here or int(model.actuator_trnid[actuator, 0]) != joint:
            continue
        if not model.actuator_ctrlnum[actuator]:
            continue
        name = element_name(model, "actuator", actuator)
        if not name:
            raise ExperimentError("joint: an actuator at the joint has no name; give it one")
        found.append(name)
    return tuple(found)


def _fixed_tendon(attributes: Attributes, joints: tuple[str, ...]) -> NewElement:
    """A tendon that is the sum of some joints."""
    children = tuple(("joint", (("joint", joint), ("coef", "1"))) for joint in joints)
    return NewElement(parent="tendon", tag="fixed", attributes=attributes, children=children)


def _first(polynomial: Any, value: float) -> np.ndarray:
    """Coefficients of a polynomial force of which only the first one is not zero."""
    numbers = np.zeros(len(np.atleast_1d(polynomial)))
    numbers[0] = value
    return numbers
