"""Friction of a joint beyond what MuJoCo's joints offer.

The Stribeck effect and presliding are the bristle of a `dcmotor` without control, which MuJoCo
integrates exactly at the speed of each step. Its internal stiffness is chosen from the inertia of
the joint and from the timestep.

Friction that is proportional to the torque of a motor is a contact that the motor presses. The
motor acts on a fixed tendon over its joint and over a slide along the axis of the joint. Its torque
is the torque of the joint, as before, and presses a ball on the slide against one of two buffers
with a force in proportion to it. The ball turns with the link and the buffers do not, so the
torsional friction of the contact is a dry friction of the joint in proportion to the torque.

The slide has an armature and no mass to speak of. Its armature is so small that the slip of the
ball, which loosens MuJoCo's soft contacts, does not matter: simulations agree with the equation to
some tenths of a per cent.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, Self

import mujoco
import numpy as np
import scipy

from mjfim.arrays import record
from mjfim.errors import ExperimentError
from mjfim.model.elements import element_name, is_rk4, model_length
from mjfim.model.terms.term import (
    NON_NEGATIVE,
    JointSizes,
    Shape,
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
CONSTANT_PHASE = np.pi / 2.0

# Force range of a passive device, so small that MuJoCo's implicit integrators do not take the
# damping of the bristle for damping of the joint, which would act like an inertia [N or N m]. It
# bounds the electrical force, which is zero.
NO_ELECTRICAL_FORCE = mujoco.mjMINVAL

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

# Numbers of the actuator that no field sets, each by its array and place.
Fixed = tuple[tuple[str, float], ...]


@record
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
    fixed: Fixed
    replaces_friction: bool

    @classmethod
    def of(cls, table: TermTable, model: Any, period: float) -> Self:
        """Resolve the term."""
        at = JointSizes.of(table, model, period, cls.kind)
        require_free_name(model, "actuator", table.name)
        found, fixed = cls._defaults(at, model)
        defaults = {
            field: replace(
                quantity,
                numbers=tuple((f"actuator/{table.name}:{n}", 1.0) for n in cls.places[field]),
            )
            for field, quantity in found.items()
        }
        return cls(
            name=table.name,
            joint=at.joint,
            quantities=stated_quantities(cls.kind, table, defaults),
            fixed=fixed,
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
    def _defaults(cls, at: JointSizes, model: Any) -> tuple[dict[str, TermQuantity], Fixed]:
        """Fields where the table states nothing, without their numbers; and `fixed`."""

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
        actuator = spec.add_actuator(
            name=self.name,
            trntype=mujoco.mjtTrn.mjTRN_JOINT,
            target=self.joint,
            gear=[1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
            dyntype=mujoco.mjtDyn.mjDYN_DCMOTOR,
            gaintype=mujoco.mjtGain.mjGAIN_DCMOTOR,
            biastype=mujoco.mjtBias.mjBIAS_DCMOTOR,
            ctrlspec=mujoco.mjtCtrlInput.mjINPUT_NONE,
            actlimited=mujoco.mjtLimited.mjLIMITED_FALSE,
            actearly=True,
        )
        # The motor constant is zero, so that the resistance has no effect.
        numbers = {"gainprm": {0: 1.0}, **self._numbers(self.values)}
        for array, stated in numbers.items():
            values = np.zeros(len(getattr(actuator, array)))
            values[list(stated)] = list(stated.values())
            setattr(actuator, array, values)
        if numbers["dynprm"]:
            actuator.actdim = 1
        if "damping" in self.places:
            actuator.forcelimited = mujoco.mjtLimited.mjLIMITED_TRUE
            actuator.forcerange = np.array([-NO_ELECTRICAL_FORCE, NO_ELECTRICAL_FORCE])
        if self.replaces_friction:
            spec.joint(self.joint).frictionloss = 0.0


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
        ("excess", "static friction minus Coulomb friction", "N m"),
        ("speed", "Stribeck speed", "rad/s"),
    )
    sources = (DE_WIT_1995, ARMSTRONG_1994)
    places: ClassVar[Places] = {"excess": ("biasprm[4]",), "speed": ("biasprm[5]",)}
    words = "Stribeck friction of {}"
    size = "excess"
    beside = "frictionloss"

    @classmethod
    def _defaults(cls, at: JointSizes, model: Any) -> tuple[dict[str, TermQuantity], Fixed]:
        """Refuse RK4, whose stages would make the bristle unstable."""
        if is_rk4(model):
            raise ExperimentError(
                "kind: with the integrator RK4, the bristle of 'stribeck' is unstable; use the "
                "kind 'lugre', or the integrator implicitfast in the MJCF"
            )
        stiffness = BRISTLE_STIFFNESS * at.inertia / model.opt.timestep**2
        fields = {"excess": _friction(at, 0.0), "speed": _stribeck_speed(at)}
        return fields, (("dynprm[5]", rounded(stiffness)),)


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
        ("coulomb", "Coulomb friction", "N m"),
        ("excess", "static friction minus Coulomb friction", "N m"),
        ("speed", "Stribeck speed", "rad/s"),
        ("stiffness", "stiffness of the bristle", "N m/rad"),
        ("damping", "damping of the bristle", "N m s/rad"),
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
    def _defaults(cls, at: JointSizes, model: Any) -> tuple[dict[str, TermQuantity], Fixed]:
        """Fields where the table states nothing."""
        stiffness, damping = BRISTLE_STIFFNESS, BRISTLE_DAMPING
        if is_rk4(model):
            stiffness, damping = BRISTLE_STIFFNESS_RK4, BRISTLE_DAMPING_RK4
        timestep = model.opt.timestep
        stiffness = rounded(stiffness * at.inertia / timestep**2)
        damping = rounded(damping * at.inertia / timestep)
        fields = {
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
                bounds=NON_NEGATIVE,
            ),
        }
        return fields, ()


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
    fields = (("offset", "half of the friction backwards minus that forwards", "N m"),)
    sources = (ARMSTRONG_1994,)
    places: ClassVar[Places] = {"offset": ("biasprm[0]",)}
    words = "friction of {} that differs by direction"
    size = "offset"
    beside = "frictionloss"

    @classmethod
    def _defaults(cls, at: JointSizes, model: Any) -> tuple[dict[str, TermQuantity], Fixed]:
        """The field, and the phase of the cogging torque."""
        offset = replace(_friction(at, 0.0), bounds=(-np.inf, np.inf))
        return {"offset": offset}, (("biasprm[2]", CONSTANT_PHASE),)


def _friction(at: JointSizes, value: float) -> TermQuantity:
    """A force of dry friction as a field."""
    return TermQuantity(value=value, unit=FORCE_UNITS[at.unit], size=at.force, bounds=NON_NEGATIVE)


def _stribeck_speed(at: JointSizes) -> TermQuantity:
    """The Stribeck speed of a joint as a field; it is never zero."""
    return TermQuantity(
        value=STRIBECK_SHARE * at.speed,
        unit=per_second(at.unit),
        size=STRIBECK_SHARE * at.speed,
        bounds=(LEAST_STRIBECK_SHARE * at.speed, np.inf),
    )


@record
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
    fields = (("coefficient", "friction per torque of the motor", ""),)
    sources = (DUCLAUSAUD_2025, GARCIA_2002)
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
    buffers: tuple[tuple[float, ...], ...]
    radius: float
    armature: float
    carrier: tuple[float, float]

    @classmethod
    def of(cls, table: TermTable, model: Any, period: float) -> LoadDependentFriction:
        """Resolve the term for a direct drive at a hinge."""
        name, number = named_element(table, "actuator", model, cls.kind)
        joint = _driven_hinge(model, name, number)

        for kind, suffix in (("joint", ""), ("body", ""), ("tendon", ""), ("geom", "_ball")):
            require_free_name(model, kind, f"{table.name}{suffix}")

        body = model.jnt_bodyid[joint]
        parent = model.body_parentid[body]
        link, base = (element_name(model, "body", each) for each in (body, parent))
        if not (link and base) or model.body_jntnum[body] != 1:
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
        least = LEAST_TORSIONAL * mujoco.mjMINMU / radius
        default = max(SMALL_COEFFICIENT, 2.0 * least)
        pairs = [f"pair/{table.name}_{side}:friction[{TORSIONAL}]" for side in SIDES]
        quantity = TermQuantity(
            value=default,
            unit="",
            size=1.0,
            bounds=(least, np.inf),
            numbers=tuple((path, radius) for path in pairs),
        )
        _require_contacts(model)
        return cls(
            name=table.name,
            motors=tuple(motors),
            joint=element_name(model, "joint", joint),
            link=link,
            base=base,
            axis=tuple(axis.tolist()),
            place=tuple(place.tolist()),
            buffers=tuple(
                tuple((centre + way * direction).tolist()) for way in (2.0 * radius, -2.0 * radius)
            ),
            radius=radius,
            armature=rounded(ARMATURE_SHARE * inertia / radius**2),
            carrier=light_body(model, body, inertia),
            quantities=stated_quantities(cls.kind, table, {"coefficient": quantity}),
        )

    @property
    def held_joints(self) -> tuple[str, ...]:
        """The slide of the ball."""
        return (self.name,)

    def edit(self, spec: Any) -> None:
        """Add the ball, the buffers, their contacts and the tendon."""
        spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        ball = add_body(spec.body(self.link), self.name, *self.carrier, np.zeros(3))
        ball.pos = self.place
        slide = add_plain_joint(ball, self.name, self.axis, np.zeros(3), slides=True)
        slide.armature = self.armature
        self._add_sphere(ball, "ball")
        base = spec.worldbody if self.base == WORLD else spec.body(self.base)
        for side, place in zip(SIDES, self.buffers, strict=True):
            self._add_sphere(base, side).pos = place
            self._add_contact(spec, side)

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

    def _add_contact(self, spec: Any, side: str) -> None:
        """Add the contact of the ball with a buffer, whose torsional friction is the term."""
        spec.add_pair(
            name=f"{self.name}_{side}",
            geomname1=f"{self.name}_ball",
            geomname2=f"{self.name}_{side}",
            condim=4,
            friction=[0.0, 0.0, self.radius * self.value("coefficient"), 0.0, 0.0],
            solref=[CONTACT_TIME * spec.option.timestep, 1.0],
            solimp=IMPEDANCE,
        )


def _driven_hinge(model: Any, name: str, actuator: int) -> int:
    """Number of the hinge that a direct drive acts on; ExperimentError for other actuators."""
    is_at_joint = model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT
    joint = int(model.actuator_trnid[actuator, 0])
    is_hinge = is_at_joint and model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE
    has_bias = model.actuator_biastype[actuator] != mujoco.mjtBias.mjBIAS_NONE
    if not is_hinge or has_bias or not element_name(model, "joint", joint):
        raise ExperimentError(
            f"actuator: {name!r} is no direct drive at a hinge with a name; the feedback of a "
            "servo would contain the position of the contact"
        )
    return joint


def _require_contacts(model: Any) -> None:
    """Raise ExperimentError where contacts are disabled and geoms would begin to collide."""
    is_disabled = model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    collide = np.any(model.geom_contype) and np.any(model.geom_conaffinity)
    if is_disabled and (collide or model.npair):
        raise ExperimentError(
            "kind: the term needs contacts, which the MJCF disables although its geoms would "
            'collide; state contype="0" conaffinity="0" for them'
        )
