"""An elastic joint or one with backlash between the motor and the link.

The motor side and the link side are two coordinates: one is the joint of the model, the other the
deflection, which is zero at rest. Where the encoder is on the motor, the joint of the model is the
motor, and the deflection is a second joint of the same body. Where it is on the link, the joint of
the model is the link; the rotor is the inertia of a tendon over the joint and the deflection, and
the actuators act on this tendon.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from mjfim.errors import ExperimentError
from mjfim.model.elements import element_name
from mjfim.model.sizes import LEAST_MOVE_PER_SAMPLE, position_sizes
from mjfim.model.terms.term import (
    NEGLIGIBLE,
    FieldDescription,
    JointSizes,
    Shape,
    Term,
    TermQuantity,
    TermTable,
    add_body,
    add_plain_joint,
    light_body,
    motors_at,
    move_to_tendon,
    require_free_name,
    rounded,
    stated_quantities,
    with_first,
)
from mjfim.model.units import ANGLE, JOINT_FIELD_UNITS, LENGTH

# Natural frequency of the motor against the link, times the timestep, where no compliance is
# stated. An explicit step follows it to a per cent.
STIFFEST = 0.3

# The same at the smallest compliance that a fit may try.
STIFFEST_OF_FIT = 1.0


# Inertia of the rotor over that of the joint, where the model states no armature.
ROTOR_SHARE = 0.05


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


@dataclass(frozen=True, kw_only=True)
class JointElasticity(Term):
    """A spring between the motor and the link of a joint.

    Attributes:
        damping_ratio: Damping ratio of the motor against the link where no damping is stated.
        joint: Name of the joint that becomes motor and link.
        body: Name of its body.
        slides: Whether it slides.
        axis: Axis in the frame of the body.
        place: Anchor in the frame of the body [m].
        rotor: Inertia of the rotor [kg or kg m²].
        carrier: Mass [kg] and inertia [kg m²] of the body that carries the deflection.
        motors: Names of the actuators at the joint that have a control.
        encoder: Side of the joint on which its sensors are, `motor` or `link`.
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
    fields: ClassVar[tuple[FieldDescription, ...]] = (
        FieldDescription(
            name="compliance", description="deflection per torque, 1/K", unit="rad/(N m)"
        ),
        FieldDescription(name="damping", description="damping of the deflection", unit="N m s/rad"),
    )
    sources = (SPONG_1987,)
    words = "elasticity of {}"
    size = "compliance"
    beside = "armature"
    screened = True
    estimated: ClassVar[tuple[str, ...]] = ("damping",)
    # MuJoCo keeps the stiffness, the inverse of the compliance.
    is_written_as_a_whole = True
    damping_ratio: ClassVar[float] = 0.1

    joint: str
    body: str
    slides: bool
    axis: tuple[float, ...]
    place: tuple[float, ...]
    rotor: float
    carrier: tuple[float, float]
    motors: tuple[str, ...]
    encoder: str

    @classmethod
    def shapes(cls, model: Any, element: str, speed: float) -> list[Shape]:
        """A joint that a motor drives may be elastic."""
        return [({}, cls.estimated)] if motors_at(model, int(model.joint(element).id)) else []

    @classmethod
    def of(cls, table: TermTable, model: Any, period: float) -> Self:
        """Resolve the term at the last joint of a body."""
        at = JointSizes.of(table, model, period, cls.kind)
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

        armature = float(model.dof_armature[at.dof])
        rotor = armature if armature > 0.0 else rounded(ROTOR_SHARE * at.inertia)
        link = max(at.inertia - armature, NEGLIGIBLE * at.inertia)
        reduced = rotor * link / (rotor + link)
        return cls(
            name=table.name,
            joint=at.joint,
            body=name,
            slides=at.unit == LENGTH,
            axis=tuple(model.jnt_axis[at.number].tolist()),
            place=tuple(model.jnt_pos[at.number].tolist()),
            rotor=rotor,
            carrier=light_body(model, body, link),
            motors=tuple(motors_at(model, at.number)),
            encoder="link" if table.encoder == "link" else "motor",
            quantities=stated_quantities(cls.kind, table, cls._defaults(at, table, model, reduced)),
        )

    @classmethod
    def _defaults(
        cls, at: JointSizes, table: TermTable, model: Any, reduced: float
    ) -> dict[str, TermQuantity]:
        """Fields where the table states nothing. reduced: inertia of motor against link."""
        # Largest stiffness that the timestep resolves, and the damping at damping ratio 1.
        frequency = STIFFEST / float(model.opt.timestep)
        stiffness = rounded(reduced * frequency**2)
        damping = rounded(2.0 * reduced * frequency)
        spring = cls._spring(table.name)
        return {
            "compliance": TermQuantity(
                value=1.0 / stiffness,
                unit=COMPLIANCE_UNITS[at.unit],
                size=1.0 / stiffness,
                bounds=((STIFFEST / STIFFEST_OF_FIT) ** 2 / stiffness, np.inf),
                numbers=((f"{spring}:stiffness", 1.0),),
            ),
            "damping": TermQuantity(
                value=rounded(cls.damping_ratio * damping),
                unit=JOINT_FIELD_UNITS["damping"][at.unit],
                size=damping,
                bounds=(0.0, np.inf),
                numbers=((f"{spring}:damping", 1.0),),
            ),
        }

    @classmethod
    def _spring(cls, name: str) -> str:
        """Kind and name of the element that is the spring, as in a parameter path."""
        return f"joint/{name}"

    def write(self, model: Any, values: Mapping[str, float]) -> None:
        """Write the spring and the damper."""
        joint = model.joint(self.name).id
        model.jnt_stiffness[joint] = 1.0 / values["compliance"]
        model.dof_damping[int(model.jnt_dofadr[joint])] = values["damping"]

    def edit(self, spec: Any) -> None:
        """Add the deflection and, for an encoder on the link, the rotor."""
        link, joint = spec.body(self.body), spec.joint(self.joint)
        if self.encoder == "motor":
            joint.armature = self.rotor
        else:
            link = add_body(link, self.name, *self.carrier, self.place)
            joint.armature = 0.0
            # A tendon over joint and deflection has the inertia of the rotor.
            rotor = spec.add_tendon(name=self.name)
            rotor.wrap_joint(self.joint, 1.0)
            rotor.wrap_joint(self.name, 1.0)
            rotor.armature = self.rotor
            move_to_tendon(spec, self.motors, self.name)
        deflection = add_plain_joint(link, self.name, self.axis, self.place, slides=self.slides)
        self._add_spring(spec, deflection)

    def _add_spring(self, spec: Any, deflection: Any) -> None:
        """Add spring and damper to the joint of the deflection."""
        self._set_spring(deflection)

    def _set_spring(self, element: Any) -> None:
        """Set stiffness and damping of a joint or a tendon of an MjSpec."""
        element.stiffness = with_first(element.stiffness, 1.0 / self.value("compliance"))
        element.damping = with_first(element.damping, self.value("damping"))


@dataclass(frozen=True, kw_only=True)
class Backlash(JointElasticity):
    """A gap between the motor and the link of a joint, with stiff flanks.

    The joint of the deflection is free; a tendon with a gap acts on it.
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
    words = "backlash of {}"
    size = "gap"
    estimated: ClassVar[tuple[str, ...]] = ()
    damping_ratio = 0.05

    @classmethod
    def _defaults(
        cls, at: JointSizes, table: TermTable, model: Any, reduced: float
    ) -> dict[str, TermQuantity]:
        """Fields where the table states nothing."""
        require_free_name(model, "tendon", f"{table.name}_gap")
        spring = cls._spring(table.name)
        gap = TermQuantity(
            value=0.0,
            unit=at.unit,
            size=LEAST_MOVE_PER_SAMPLE * float(position_sizes(model)[at.dof]),
            bounds=(0.0, np.inf),
            numbers=((f"{spring}:springlength[0]", -0.5), (f"{spring}:springlength[1]", 0.5)),
        )
        return {"gap": gap, **super()._defaults(at, table, model, reduced)}

    @classmethod
    def _spring(cls, name: str) -> str:
        """Kind and name of the tendon with the gap."""
        return f"tendon/{name}_gap"

    def write(self, model: Any, values: Mapping[str, float]) -> None:
        """Write the gap, its flanks and the damper."""
        tendon = model.tendon(f"{self.name}_gap").id
        half = 0.5 * values["gap"]
        model.tendon_lengthspring[tendon] = (-half, half)
        model.tendon_stiffness[tendon] = 1.0 / values["compliance"]
        model.tendon_damping[tendon] = values["damping"]

    def _add_spring(self, spec: Any, deflection: Any) -> None:
        """Add the tendon with the gap over the joint of the deflection."""
        spring = spec.add_tendon(name=f"{self.name}_gap")
        spring.wrap_joint(self.name, 1.0)
        self._set_spring(spring)
        half = 0.5 * self.value("gap")
        spring.springlength = [-half, half]
