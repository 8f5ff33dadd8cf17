"""Friction that is proportional to the torque of a motor, by a contact that the motor presses.

The motor acts on a fixed tendon over its joint and over a slide along the axis of the joint. Its
torque is the torque of the joint, as before, and presses a ball on the slide against one of two
plates with a force in proportion to it. The ball turns with the link and the plates do not, so that
the torsional friction of the contact is a dry friction of the joint in proportion to the torque.

The slide has an armature and no mass to speak of. Its armature is so small that the slip of the
ball, which loosens MuJoCo's soft contacts, does not matter: simulations agree with the equation to
some tenths of a per cent.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import scipy

from mjfim.errors import ExperimentError
from mjfim.model.elements import element_name
from mjfim.model.sizes import model_length
from mjfim.model.terms.changes import Attributes, ChangedElement, MjcfChange, NewElement
from mjfim.model.terms.joint_sizes import rounded
from mjfim.model.terms.term import (
    FieldDescription,
    Term,
    TermQuantity,
    TermTable,
    named_element,
    require_free_name,
    resolved_values,
)

# Radius of the ball over the length of the model.
BALL_SHARE = 0.3

# Armature of the slide, as an inertia on the side of the joint, over the inertia of the joint.
ARMATURE_SHARE = 1e-3

# Mass and inertia of the ball over those of the link.
NEGLIGIBLE = 1e-6

# Time constant of the contacts over the timestep, the shortest that MuJoCo follows.
CONTACT_TIME = 2.0

# Impedance of the contacts: nearly hard, however deep they are.
IMPEDANCE = (0.95, 0.99, 0.001, 0.5, 2.0)

# Column of the torsional coefficient in the friction of a pair of geoms.
TORSIONAL = 2

# Group of geoms that viewers hide.
HIDDEN_GROUP = 5

# Coefficient where none is stated.
SMALL_COEFFICIENT = 1e-3

# Smallest torsional coefficient over MuJoCo's own minimum, below which it has no effect [m].
LEAST_TORSIONAL = 1.5

WORLD = "world"

DUCLAUSAUD_2025 = (
    "M. Duclusaud, G. Passault, V. Padois and O. Ly, Extended friction models for the physics "
    "simulation of servo actuators, IEEE International Conference on Robotics and Automation, 2025"
)
GARCIA_2002 = (
    "E. Garcia, P. Gonzalez de Santos and C. Canudas de Wit, Velocity dependence in the cyclic "
    "friction arising with gears, International Journal of Robotics Research 21, 2002"
)


@dataclass(frozen=True, kw_only=True)
class LoadDependentFriction(Term):
    """Dry friction in proportion to the torque of a motor.

    Attributes:
        motors: Names of the actuators at the joint, which press the ball.
        joint: Name of the joint.
        link: Name of its body.
        base: Name of the parent of that body.
        axis: Axis of the joint in the frame of the link.
        place: Anchor of the joint in the frame of the link [m].
        plates: Places of the two plates in the frame of the base [m].
        quat: Orientation of the plates in the frame of the base (w, x, y, z).
        radius: Radius of the ball [m].
        armature: Armature of the slide [kg].
        carrier: Mass [kg] and inertia [kg m²] of the ball.
        contact_time: Time constant of the contacts [s].
        enables_contacts: Whether the model disables contacts, which this term needs.
    """

    kind = "load_dependent_friction"
    description = (
        "Dry friction in proportion to the torque of a motor, as gears have it; it comes on top of "
        "the joint's `frictionloss`."
    )
    equation = "F = -coefficient · |torque of the motors| · sgn(v)"
    elements = (
        "the motors act on a tendon/fixed over the joint and a slide, which presses a sphere "
        "against two plates; contact/pair with torsional friction"
    )
    acts_on = "actuator"
    fields = (
        FieldDescription(
            name="coefficient", description="friction per torque of the motor", unit=""
        ),
    )
    sources = (DUCLAUSAUD_2025, GARCIA_2002)

    motors: tuple[str, ...]
    joint: str
    link: str
    base: str
    axis: tuple[float, ...]
    place: tuple[float, ...]
    plates: tuple[tuple[float, ...], tuple[float, ...]]
    quat: tuple[float, ...]
    radius: float
    armature: float
    carrier: tuple[float, float]
    contact_time: float
    enables_contacts: bool

    @classmethod
    def of(cls, table: TermTable, model: Any, period: float) -> LoadDependentFriction:
        """Resolve the term for a direct drive at a hinge."""
        name, number = named_element(table, "actuator", model, cls.kind)
        joint = _driven_hinge(model, name, number)
        for kind, suffix in (("joint", ""), ("body", ""), ("tendon", ""), ("geom", "_ball")):
            require_free_name(model, kind, f"{table.name}{suffix}")

        body = int(model.jnt_bodyid[joint])
        parent = int(model.body_parentid[body])
        link, base = (element_name(model, "body", each) for each in (body, parent))
        if not (link and base) or int(model.body_jntnum[body]) != 1:
            raise ExperimentError(
                f"actuator: the body of the joint of {name!r} and its parent need names, and the "
                "body no other joint"
            )

        dof = int(model.jnt_dofadr[joint])
        weight = float(model.dof_invweight0[dof])
        inertia = 1.0 / weight if weight > 0.0 else 1.0
        radius = rounded(BALL_SHARE * model_length(model))
        axis, place = np.array(model.jnt_axis[joint]), np.array(model.jnt_pos[joint])
        turn = scipy.spatial.transform.Rotation.from_quat(model.body_quat[body], scalar_first=True)
        centre = model.body_pos[body] + turn.apply(place)
        direction = turn.apply(axis)

        # MuJoCo replaces coefficients below its minimum, so that no fit could begin there.
        least = LEAST_TORSIONAL * float(mujoco.mjMINMU) / radius
        default = max(SMALL_COEFFICIENT, 2.0 * least)
        values = resolved_values(cls.kind, table, {"coefficient": default})
        pairs = [f"pair/{table.name}_{side}:friction[{TORSIONAL}]" for side in ("up", "down")]
        quantity = TermQuantity(
            value=values["coefficient"],
            unit="",
            size=1.0,
            bounds=(least, np.inf),
            numbers=tuple((path, radius) for path in pairs),
        )
        mass = float(model.body_mass[body]) or float(model.body_subtreemass[body])
        return cls(
            name=table.name,
            motors=_motors(model, joint),
            joint=element_name(model, "joint", joint),
            link=link,
            base=base,
            axis=tuple(axis.tolist()),
            place=tuple(place.tolist()),
            plates=(
                tuple((centre + 2.0 * radius * direction).tolist()),
                tuple((centre - 2.0 * radius * direction).tolist()),
            ),
            quat=_towards(direction),
            radius=radius,
            armature=rounded(ARMATURE_SHARE * inertia / radius**2),
            carrier=(rounded(NEGLIGIBLE * mass), rounded(NEGLIGIBLE * inertia)),
            contact_time=CONTACT_TIME * float(model.opt.timestep),
            enables_contacts=_enables_contacts(model),
            quantities=(("coefficient", quantity),),
        )

    def edit(self, spec: Any) -> None:
        """Add the ball, the plates, their contacts and the tendon."""
        if self.enables_contacts:
            spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)

        base = spec.worldbody if self.base == WORLD else spec.body(self.base)
        for side, place in zip(("up", "down"), self.plates, strict=True):
            plate = self._add_geom(base, side, mujoco.mjtGeom.mjGEOM_BOX)
            plate.size = np.full(3, self.radius)
            plate.pos = place
            plate.quat = self.quat

        ball = spec.body(self.link).add_body(name=self.name)
        ball.pos = self.place
        ball.mass = self.carrier[0]
        ball.inertia = np.full(3, self.carrier[1])
        ball.explicitinertial = True
        geom = self._add_geom(ball, "ball", mujoco.mjtGeom.mjGEOM_SPHERE)
        geom.size = [self.radius, 0.0, 0.0]
        self._add_slide(ball)

        for side in ("up", "down"):
            pair = spec.add_pair(name=f"{self.name}_{side}")
            pair.geomname1, pair.geomname2 = f"{self.name}_ball", f"{self.name}_{side}"
            pair.condim = 4
            pair.friction = [0.0, 0.0, self.radius * self.value("coefficient"), 0.0, 0.0]
            pair.solref = [self.contact_time, 1.0]
            pair.solimp = IMPEDANCE

        tendon = spec.add_tendon(name=self.name)
        tendon.wrap_joint(self.joint, 1.0)
        tendon.wrap_joint(self.name, 1.0 / self.radius)
        for name in self.motors:
            actuator = spec.actuator(name)
            actuator.trntype = mujoco.mjtTrn.mjTRN_TENDON
            actuator.target = self.name

    def _add_geom(self, body: Any, suffix: str, kind: Any) -> Any:
        """Add a geom without mass that touches nothing but its pair."""
        geom = body.add_geom(name=f"{self.name}_{suffix}", type=kind)
        geom.contype, geom.conaffinity, geom.mass = 0, 0, 0.0
        geom.group = HIDDEN_GROUP
        geom.rgba = np.zeros(4)
        return geom

    def _add_slide(self, ball: Any) -> None:
        """Add the slide of the ball, on which nothing else acts."""
        slide = ball.add_joint(
            name=self.name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=self.axis, armature=self.armature
        )
        slide.stiffness, slide.damping = np.zeros(3), np.zeros(3)
        slide.frictionloss, slide.ref, slide.springref = 0.0, 0.0, 0.0
        slide.limited = mujoco.mjtLimited.mjLIMITED_FALSE
        slide.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE

    def changes(self) -> tuple[MjcfChange, ...]:
        """The elements in the text."""
        changes: list[MjcfChange] = [self._plate(side) for side in (0, 1)]
        if self.enables_contacts:
            enabled: Attributes = (("contact", "enable"),)
            changes.append(ChangedElement(kind="flag", name="", attributes=enabled))

        slide: Attributes = (
            ("name", self.name),
            ("type", "slide"),
            ("axis", self.axis),
            ("armature", (self.armature,)),
            *((name, "0") for name in ("stiffness", "damping", "frictionloss", "ref")),
            ("springref", "0"),
            ("limited", "false"),
            ("actuatorfrclimited", "false"),
        )
        inertial: Attributes = (
            ("pos", "0 0 0"),
            ("mass", (self.carrier[0],)),
            ("diaginertia", 3 * (self.carrier[1],)),
        )
        ball = self._geom("ball", (("type", "sphere"), ("size", (self.radius,))))
        changes.append(
            NewElement(
                parent_kind="body",
                parent=self.link,
                tag="body",
                attributes=(("name", self.name), ("pos", self.place)),
                children=(("inertial", inertial), ("joint", slide), ("geom", ball)),
            )
        )
        changes += [self._pair(side) for side in ("up", "down")]

        over = (
            ("joint", (("joint", self.joint), ("coef", "1"))),
            ("joint", (("joint", self.name), ("coef", (1.0 / self.radius,)))),
        )
        name: Attributes = (("name", self.name),)
        changes.append(NewElement(parent="tendon", tag="fixed", attributes=name, children=over))
        for motor in self.motors:
            on_tendon: Attributes = (("tendon", self.name),)
            changes.append(
                ChangedElement(
                    kind="actuator", name=motor, attributes=on_tendon, removed=("joint",)
                )
            )
        return tuple(changes)

    def _geom(self, suffix: str, shape: Attributes) -> Attributes:
        """Attributes of a geom without mass that touches nothing but its pair."""
        return (
            ("name", f"{self.name}_{suffix}"),
            *shape,
            ("contype", "0"),
            ("conaffinity", "0"),
            ("mass", "0"),
            ("group", str(HIDDEN_GROUP)),
            ("rgba", "0 0 0 0"),
        )

    def _plate(self, side: int) -> NewElement:
        """One of the plates in the text."""
        shape: Attributes = (
            ("type", "box"),
            ("size", 3 * (self.radius,)),
            ("pos", self.plates[side]),
            ("quat", self.quat),
        )
        in_world = self.base == WORLD
        return NewElement(
            parent_kind="" if in_world else "body",
            parent="worldbody" if in_world else self.base,
            tag="geom",
            attributes=self._geom(("up", "down")[side], shape),
        )

    def _pair(self, side: str) -> NewElement:
        """One of the contacts in the text."""
        friction = (0.0, 0.0, self.radius * self.value("coefficient"), 0.0, 0.0)
        attributes: Attributes = (
            ("name", f"{self.name}_{side}"),
            ("geom1", f"{self.name}_ball"),
            ("geom2", f"{self.name}_{side}"),
            ("condim", "4"),
            ("friction", friction),
            ("solref", (self.contact_time, 1.0)),
            ("solimp", IMPEDANCE),
        )
        return NewElement(parent="contact", tag="pair", attributes=attributes)


def _driven_hinge(model: Any, name: str, actuator: int) -> int:
    """Number of the hinge that a direct drive acts on; ExperimentError for other actuators."""
    is_at_joint = int(model.actuator_trntype[actuator]) == int(mujoco.mjtTrn.mjTRN_JOINT)
    joint = int(model.actuator_trnid[actuator, 0])
    is_hinge = is_at_joint and int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_HINGE)
    has_bias = int(model.actuator_biastype[actuator]) != int(mujoco.mjtBias.mjBIAS_NONE)
    if not is_hinge or has_bias or not element_name(model, "joint", joint):
        raise ExperimentError(
            f"actuator: {name!r} is no direct drive at a hinge with a name; the feedback of a "
            "servo would contain the position of the contact"
        )
    return joint


def _motors(model: Any, joint: int) -> tuple[str, ...]:
    """Names of the direct drives at a joint; ExperimentError for other actuators there."""
    found = []
    for actuator in range(model.nactuator):
        is_here = int(model.actuator_trntype[actuator]) == int(mujoco.mjtTrn.mjTRN_JOINT)
        if not is_here or int(model.actuator_trnid[actuator, 0]) != joint:
            continue
        name = element_name(model, "actuator", actuator)
        if model.actuator_ctrlnum[actuator] and name:
            _driven_hinge(model, name, actuator)
            found.append(name)
    return tuple(found)


def _towards(direction: Any) -> tuple[float, ...]:
    """Quaternion that turns the z axis towards a direction: (3,)."""
    turn, _ = scipy.spatial.transform.Rotation.align_vectors([direction], [[0.0, 0.0, 1.0]])
    return tuple(turn.as_quat(scalar_first=True).tolist())


def _enables_contacts(model: Any) -> bool:
    """Whether contacts are disabled; ExperimentError where geoms would then begin to collide."""
    if not model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT):
        return False
    collide = np.any(model.geom_contype) and np.any(model.geom_conaffinity)
    if collide or model.npair:
        raise ExperimentError(
            "kind: the term needs contacts, which the MJCF disables although its geoms would "
            'collide; state contype="0" conaffinity="0" for them'
        )
    return True
