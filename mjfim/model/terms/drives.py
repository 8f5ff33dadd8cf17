"""Effects of a drive that its ideal actuator lacks: back-EMF, a lag of its force, and elasticity.

The motor side and the link side of an elastic joint, or of one with backlash, are two coordinates:
one is the joint of the model, the other the deflection, which is zero at rest. Where the encoder is
on the motor, the joint of the model is the motor, and the deflection is a second joint of the same
body. Where it is on the link, the joint of the model is the link; the rotor is the inertia of a
tendon over the joint and the deflection, and the actuators act on this tendon.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Self

import mujoco
import numpy as np

from mjfim.arrays import record
from mjfim.errors import ExperimentError
from mjfim.model.elements import (
    LEAST_MOVE_PER_SAMPLE,
    control_size,
    element_name,
    is_rk4,
    model_length,
    position_sizes,
)
from mjfim.model.terms.term import (
    NEGLIGIBLE,
    NON_NEGATIVE,
    Field,
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
    named_element,
    require_free_name,
    rounded,
    stated_quantities,
    with_first,
)
from mjfim.model.units import (
    ANGLE,
    FORCE_UNITS,
    JOINT_FIELD_UNITS,
    LENGTH,
    actuator_gear,
    force_unit,
)

# Types of gain for which an activation may take the place of the control.
PLAIN_GAINS = (mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtGain.mjGAIN_AFFINE)

# Types of bias that such an actuator may have.
PLAIN_BIASES = (mujoco.mjtBias.mjBIAS_NONE, mujoco.mjtBias.mjBIAS_AFFINE)

# Time constant over the timestep where none is stated. It delays by less than a timestep, and yet
# the motion depends on it: a shorter lag has no effect at all, so that no fit could begin there.
SHORT_LAG = 0.5

# Smallest time constant over the timestep. The stages of RK4 need a longer one.
LEAST_LAG = 0.25
LEAST_LAG_RK4 = 0.5

KRAUSE_2013 = (
    "P. Krause, O. Wasynczuk, S. Sudhoff and S. Pekarek, Analysis of Electric Machinery and Drive "
    "Systems, 3rd edition, IEEE Press, 2013"
)
MUJOCO_DCMOTOR = "MuJoCo DC Motor Model, technical note of MuJoCo 4.0"

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


@record
class ActuatorLag(Term):
    """First-order lag between the control of an actuator and its effect.

    Attributes:
        actuator: Name of the actuator.
    """

    kind = "actuator_lag"
    description = (
        "First-order lag of an actuator, such as that of a current controller: an activation "
        "follows the control and acts in its place."
    )
    equation = "force = gain · a + bias, ȧ = (control - a)/time_constant"
    elements = "dyntype filterexact and actearly of the actuator; with RK4 dyntype filter"
    acts_on = "actuator"
    fields = (("time_constant", "time constant of the lag", "s"),)
    sources = (KRAUSE_2013,)
    words = "a lag of {}"
    size = "time_constant"

    actuator: str

    @classmethod
    def of(cls, table: TermTable, model: Any, period: float) -> ActuatorLag:
        """Resolve the term for an actuator without dynamics."""
        name, number = named_element(table, "actuator", model, cls.kind)
        _require_plain(model, name, number, cls.kind)

        # With `actearly` the actuator acts within the same step, so that a vanishing lag would be
        # the actuator without it. RK4 takes the activation through its stages.
        timestep = model.opt.timestep
        least = (LEAST_LAG_RK4 if is_rk4(model) else LEAST_LAG) * timestep
        lag = TermQuantity(
            value=SHORT_LAG * timestep,
            unit="s",
            size=period,
            bounds=(least, np.inf),
            numbers=((f"actuator/{name}:dynprm[0]", 1.0),),
        )
        quantities = stated_quantities(cls.kind, table, {"time_constant": lag})
        (_, stated), *_ = quantities
        if stated.value < least:
            raise ExperimentError(
                f"values.time_constant: {stated.value:g} s is too short to have an effect; state "
                f"at least {least:g} s"
            )
        return cls(name=table.name, actuator=name, quantities=quantities)

    def edit(self, spec: Any) -> None:
        """Give the actuator an activation."""
        actuator = spec.actuator(self.actuator)
        # RK4 takes the lag through its stages.
        is_explicit = spec.option.integrator == mujoco.mjtIntegrator.mjINT_RK4
        filters = (mujoco.mjtDyn.mjDYN_FILTEREXACT, mujoco.mjtDyn.mjDYN_FILTER)
        actuator.dyntype = filters[is_explicit]
        actuator.actearly = not is_explicit

        dynamics = np.array(actuator.dynprm)
        dynamics[0] = self.value("time_constant")
        actuator.dynprm = dynamics


@record
class BackEmf(Term):
    """Back-EMF of a motor whose control is a voltage.

    Attributes:
        actuator: Name of the actuator.
    """

    kind = "back_emf"
    description = (
        "Back-EMF of a motor that is driven by a voltage: its force falls with the speed. The "
        "gain of the actuator is K/R; K is the motor constant, R the resistance."
    )
    equation = "force = gain · (control - constant · actuator velocity)"
    elements = "biastype affine of the actuator, biasprm[2] = -gain · constant"
    acts_on = "actuator"
    fields = (("constant", "back-EMF constant K [control · s/rad]", "V s/rad"),)
    sources = (KRAUSE_2013, MUJOCO_DCMOTOR)
    # The damping depends on the gain, which may be a parameter as well.
    is_written_as_a_whole = True

    actuator: str

    @classmethod
    def of(cls, table: TermTable, model: Any, period: float) -> BackEmf:
        """Resolve the term for a direct drive."""
        name, number = named_element(table, "actuator", model, cls.kind)
        _require_plain(model, name, number, cls.kind)
        has_gain = model.actuator_gaintype[number] == mujoco.mjtGain.mjGAIN_FIXED
        if not has_gain or model.actuator_biastype[number] != mujoco.mjtBias.mjBIAS_NONE:
            raise ExperimentError(
                f"actuator: {name!r} is no direct drive (constant gain, no bias); a servo has its "
                "own damping, `actuator/<name>:kv`"
            )

        time = period / LEAST_MOVE_PER_SAMPLE
        control = control_size(model, number, model.actuator_ctrladr[number], time)
        slides = force_unit(model, number) == FORCE_UNITS[LENGTH]
        length = model_length(model) if slides else 1.0
        size = control * time / (length * (abs(actuator_gear(model, number)) or 1.0))
        quantity = TermQuantity(
            value=0.0,
            unit="",
            size=size,
            bounds=NON_NEGATIVE,
            numbers=((f"actuator/{name}:biasprm[2]", 1.0),),
        )
        quantities = stated_quantities(cls.kind, table, {"constant": quantity})
        return cls(name=table.name, actuator=name, quantities=quantities)

    def write(self, model: Any, values: Mapping[str, float]) -> None:
        """Write the damping that belongs to the gain in the model."""
        row = model.actuator(self.actuator).id
        gain = model.actuator_gainprm[row, 0]
        model.actuator_biasprm[row, 2] = -gain * values["constant"]

    def edit(self, spec: Any) -> None:
        """Give the actuator a bias that is proportional to the velocity."""
        actuator = spec.actuator(self.actuator)
        actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
        bias = np.zeros(len(actuator.biasprm))
        bias[2] = -float(actuator.gainprm[0]) * self.value("constant")
        actuator.biasprm = bias


def _require_plain(model: Any, name: str, number: int, kind: str) -> None:
    """Raise ExperimentError for an actuator with dynamics, or with a gain of another type."""
    has_dynamics = model.actuator_dyntype[number] != mujoco.mjtDyn.mjDYN_NONE
    is_plain = int(model.actuator_gaintype[number]) in PLAIN_GAINS
    has_bias = int(model.actuator_biastype[number]) in PLAIN_BIASES
    if has_dynamics or not (is_plain and has_bias) or model.actuator_ctrlnum[number] != 1:
        raise ExperimentError(
            f"actuator: {name!r} has dynamics or a gain of its own; a term of kind {kind!r} needs "
            "an actuator without dynamics, such as <motor>, <position> or <velocity>"
        )


@record
class JointElasticity(Term):
    """A spring between the motor and the link of a joint.

    Attributes:
        damping_ratio: Damping ratio of the motor against the link where no damping is stated.
        spring: Kind and name of the element that is the spring, as in a parameter path, with `{}`
            for the name of the term.
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
    fields: ClassVar[tuple[Field, ...]] = (
        ("compliance", "deflection per torque, 1/K", "rad/(N m)"),
        ("damping", "damping of the deflection", "N m s/rad"),
    )
    sources = (SPONG_1987,)
    words = "elasticity of {}"
    size = "compliance"
    beside = "armature"
    screened = True
    estimated: ClassVar[tuple[str, ...]] = ("damping",)
    # MuJoCo keeps the stiffness, the inverse of the compliance.
    is_written_as_a_whole = True
    damping_ratio = 0.1
    spring = "joint/{}"

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
        return [({}, cls.estimated)] if motors_at(model, model.joint(element).id) else []

    @classmethod
    def of(cls, table: TermTable, model: Any, period: float) -> Self:
        """Resolve the term at the last joint of a body."""
        at = JointSizes.of(table, model, period, cls.kind)
        body = model.jnt_bodyid[at.number]
        last = model.body_jntadr[body] + model.body_jntnum[body] - 1
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
        frequency = STIFFEST / model.opt.timestep
        stiffness = rounded(reduced * frequency**2)
        damping = rounded(2.0 * reduced * frequency)
        spring = cls.spring.format(table.name)
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
                bounds=NON_NEGATIVE,
                numbers=((f"{spring}:damping", 1.0),),
            ),
        }

    def write(self, model: Any, values: Mapping[str, float]) -> None:
        """Write the spring and the damper."""
        joint = model.joint(self.name).id
        model.jnt_stiffness[joint] = 1.0 / values["compliance"]
        model.dof_damping[model.jnt_dofadr[joint]] = values["damping"]

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
        ("gap", "width of the gap", "rad"),
        ("compliance", "deflection of the flanks per torque", "rad/(N m)"),
        ("damping", "damping between motor and link", "N m s/rad"),
    )
    sources = (NORDIN_2002,)
    words = "backlash of {}"
    size = "gap"
    estimated = ()
    damping_ratio = 0.05
    spring = "tendon/{}_gap"

    @classmethod
    def _defaults(
        cls, at: JointSizes, table: TermTable, model: Any, reduced: float
    ) -> dict[str, TermQuantity]:
        """Fields where the table states nothing."""
        require_free_name(model, "tendon", f"{table.name}_gap")
        spring = cls.spring.format(table.name)
        gap = TermQuantity(
            value=0.0,
            unit=at.unit,
            size=LEAST_MOVE_PER_SAMPLE * float(position_sizes(model)[at.dof]),
            bounds=NON_NEGATIVE,
            numbers=((f"{spring}:springlength[0]", -0.5), (f"{spring}:springlength[1]", 0.5)),
        )
        return {"gap": gap, **super()._defaults(at, table, model, reduced)}

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
