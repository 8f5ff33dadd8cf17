"""Friction that is proportional to the torque of a motor, by a contact that the motor presses.

The motor acts on a fixed tendon over its joint and over a slide along the axis of the joint. Its
torque is the torque of the joint, as before, and presses a ball on the slide against one of two
buffers with a force in proportion to it. The ball turns with the link and the buffers do not, so
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
from mjfim.model.terms.term import (
    FieldDescription,
    Term,
    TermQuantity,
    TermTable,
    add_body,
    add_plain_joint,
    joint_inertia,
    light_body,
    motors_at,
    move_to_tendon,
    named_element,
    require_free_name,
    rounded,
    stated_quantities,
)

# Radius of the ball over the length of the model.
BALL_SHARE = 0.3

# Armature of the slide, as an inertia on the side of the joint, over the inertia of the joint.
ARMATURE_SHARE = 1e-3

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
# Names of the two buffers.
SIDES = ("up", "down")

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
        buffers: Places of the two buffers in the frame of the base [m].
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
        "against two buffers; contact/pair with torsional friction"
    )
    acts_on = "actuator"
    fields = (
        FieldDescription(
            name="coefficient", description="friction per torque of the motor", unit=""
        ),
    )
    sources = (DUCLAUSAUD_2025, GARCIA_2002)
    words = "friction that grows with the torque of {}"
    size = "coefficient"
    beside = "frictionloss"
    # Its contacts would slow down all simulations of the others.
    alone = True
    words = "friction that grows with the torque of {}"
    size = "coefficient"
    beside = "frictionloss"
    # Its contacts would slow down all simulations of the others.
    alone = True

    motors: tuple[str, ...]
    joint: str
    link: str
    base: str
    axis: tuple[float, ...]
    place: tuple[float, ...]
    buffers: tuple[tuple[float, ...], tuple[float, ...]]
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

        motors = motors_at(model, joint)
        for other, actuator in motors.items():
            _driven_hinge(model, other, actuator)

        # With a power of two, the ball touches the buffers exactly, and its gear has few digits.
        radius = 2.0 ** round(np.log2(BALL_SHARE * model_length(model)))
        inertia = joint_inertia(model, joint)
        axis, place = np.array(model.jnt_axis[joint]), np.array(model.jnt_pos[joint])
        turn = scipy.spatial.transform.Rotation.from_quat(model.body_quat[body], scalar_first=True)
        centre = model.body_pos[body] + turn.apply(place)
        direction = turn.apply(axis)

        # MuJoCo replaces coefficients below its minimum, so that no fit could begin there.
        least = LEAST_TORSIONAL * float(mujoco.mjMINMU) / radius
        default = max(SMALL_COEFFICIENT, 2.0 * least)
        pairs = [f"pair/{table.name}_{side}:friction[{TORSIONAL}]" for side in SIDES]
        quantity = TermQuantity(
            value=default,
            unit="",
            size=1.0,
            bounds=(least, np.inf),
            numbers=tuple((path, radius) for path in pairs),
        )
        return cls(
            name=table.name,
            motors=tuple(motors),
            joint=element_name(model, "joint", joint),
            link=link,
            base=base,
            axis=tuple(axis.tolist()),
            place=tuple(place.tolist()),
            buffers=(
                tuple((centre + 2.0 * radius * direction).tolist()),
                tuple((centre - 2.0 * radius * direction).tolist()),
            ),
            radius=radius,
            armature=rounded(ARMATURE_SHARE * inertia / radius**2),
            carrier=light_body(model, body, inertia),
            contact_time=CONTACT_TIME * float(model.opt.timestep),
            enables_contacts=_enables_contacts(model),
            quantities=stated_quantities(cls.kind, table, {"coefficient": quantity}),
        )

    def edit(self, spec: Any) -> None:
        """Add the ball, the buffers, their contacts and the tendon."""
        if self.enables_contacts:
            spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        ball = add_body(spec.body(self.link), self.name, *self.carrier, np.zeros(3))
        ball.pos = self.place
        slide = add_plain_joint(ball, self.name, self.axis, np.zeros(3), slides=True)
        slide.armature = self.armature
        self._add_sphere(ball, "ball")
        base = spec.worldbody if self.base == WORLD else spec.body(self.base)
        for side, place in zip(SIDES, self.buffers, strict=True):
            self._add_sphere(base, side).pos = place
            pair = spec.add_pair(name=f"{self.name}_{side}")
            pair.geomname1, pair.geomname2 = f"{self.name}_ball", f"{self.name}_{side}"
            pair.condim = 4
            pair.friction = [0.0, 0.0, self.radius * self.value("coefficient"), 0.0, 0.0]
            pair.solref = [self.contact_time, 1.0]
            pair.solimp = IMPEDANCE

        tendon = spec.add_tendon(name=self.name)
        tendon.wrap_joint(self.joint, 1.0)
        tendon.wrap_joint(self.name, 1.0 / self.radius)
        move_to_tendon(spec, self.motors, self.name)

    def _add_sphere(self, body: Any, suffix: str) -> Any:
        """Add a sphere without mass that touches nothing but its pair."""
        geom = body.add_geom(name=f"{self.name}_{suffix}", type=mujoco.mjtGeom.mjGEOM_SPHERE)
        geom.size = [self.radius, 0.0, 0.0]
        geom.contype, geom.conaffinity, geom.mass = 0, 0, 0.0
        geom.group = HIDDEN_GROUP
        geom.rgba = np.zeros(4)
        return geom


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
