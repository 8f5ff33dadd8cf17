"""Base class of the physical terms that an experiment can add to a model, such as friction.

`friction`, `drives` and `library` define the kinds. `mjfim.model.loading` adds the terms of an
experiment to the MjSpec of its model, and extends its keyframes and its state.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import mujoco
import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError, unknown
from mjfim.model.elements import (
    LEAST_MOVE_PER_SAMPLE,
    element_name,
    force_sizes,
    identifier,
    names_of,
    position_sizes,
)
from mjfim.model.units import SCALAR_JOINTS, actuator_gear, commanded_joint, joint_unit

# Significant digits of numbers that the library chooses.
CHOSEN_DIGITS = 3

# Mass and inertia, relative to those of the link, of a body that matters only by its position.
NEGLIGIBLE = 1e-6

# Keys of a table `[terms.<name>]` that name the element on which the term acts.
ELEMENT_KEYS = ("joint", "actuator", "body")

# Values of some fields with which a test looks for a term, and the names of those that it fits.
Shape = tuple[dict[str, float], tuple[str, ...]]

# Range of a number that cannot be negative in physics.
NON_NEGATIVE = (0.0, np.inf)

# Types of dynamics whose activation follows the control, so that it equals the control at rest.
FILTERS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))


# A field of a kind of term: its name in paths `term/<name>:<field>`, what the number is, and its
# unit, which is that at a hinge where it depends on the joint.
Field = tuple[str, str, str]


@record
class TermQuantity:
    """A field of one term, resolved against its model.

    Attributes:
        value: Value in the model where no parameter sets it [unit].
        unit: Unit of the number; empty where it has none or where it is not known.
        size: Natural size with which a change of the number is compared [unit].
        bounds: Smallest and largest physical value [unit].
        numbers: Parameter paths of the numbers in the extended model that it determines, each with
            the factor by which the field is multiplied.
    """

    value: float
    unit: str
    size: float
    bounds: tuple[float, float] = (-np.inf, np.inf)
    numbers: tuple[tuple[str, float], ...] = ()


@record
class TermTable:
    """A table `[terms.<name>]` of an experiment.

    Attributes:
        name: Name of the term.
        element: Keys of `ELEMENT_KEYS`, each with the name of the element on which the term acts.
        values: Values of fields that the table states [unit of the field].
        encoder: Side of an elastic joint on which the joint's sensors are: `motor` or `link`.
    """

    name: str
    element: tuple[tuple[str, str], ...]
    values: tuple[tuple[str, float], ...] = ()
    encoder: str = "motor"


@record
class Term(ABC):
    """A physical term that is added to a model.

    Attributes:
        kind: Name of the kind in the experiment file.
        description: One sentence about the physics.
        equation: The force or torque, in the letters of `fields`.
        elements: MuJoCo's elements of which the term consists.
        acts_on: Key of the table that names its element; empty for a term of the base.
        fields: Its fields.
        sources: Publications that describe it.
        is_written_as_a_whole: Whether some number of the model depends on several fields.
        words: What a model without it lacks, with `{}` for the element; empty if nothing tests it.
        size: Field that is zero, or almost zero, without the term.
        beside: Field of the joint without which no test looks for the term; empty for none.
        alone: Whether it would disturb tests of other terms, so that they leave it out.
        screened: Whether simulations with some sizes look for it instead of a linear test.
        name: Name of the term, and of the elements that it adds.
        quantities: Its fields, resolved against the model, by name.
    """

    kind: ClassVar[str]
    description: ClassVar[str]
    equation: ClassVar[str]
    elements: ClassVar[str]
    acts_on: ClassVar[str]
    fields: ClassVar[tuple[Field, ...]]
    sources: ClassVar[tuple[str, ...]]
    is_written_as_a_whole: ClassVar[bool] = False
    words: ClassVar[str] = ""
    size: ClassVar[str] = ""
    beside: ClassVar[str] = ""
    alone: ClassVar[bool] = False
    screened: ClassVar[bool] = False

    name: str
    quantities: tuple[tuple[str, TermQuantity], ...]

    @classmethod
    @abstractmethod
    def of(cls, table: TermTable, model: Any, period: float) -> Term:
        """Resolve a term against the stated model.

        Args:
            table: The table of the experiment.
            model: The stated model without terms (`mujoco.MjModel`).
            period: Sample period of the experiment [s].

        Raises:
            ExperimentError: The table does not fit the model; the message is a clause.
        """

    @classmethod
    def shapes(cls, model: Any, element: str, speed: float) -> list[Shape]:
        """Values of other fields with which a test looks for the term at an element.

        Args:
            model: The stated model without terms.
            element: Name of the element.
            speed: Typical speed of its joint [m/s or rad/s].

        Returns:
            Pairs of values of some fields, and the names of the fields that a fit estimates besides
            the size; none where the term has no effect.
        """
        return [({}, ())]

    @property
    def held_joints(self) -> tuple[str, ...]:
        """Joints that it adds and that contacts hold, whose impacts have no derivative."""
        return ()

    @abstractmethod
    def edit(self, spec: Any) -> None:
        """Add the elements of the term to an MjSpec, in place."""

    def quantity(self, field: str) -> TermQuantity:
        """A field of the term.

        Raises:
            ExperimentError: The kind has no such field; the message is a clause.
        """
        found = dict(self.quantities)
        if field not in found:
            raise ExperimentError(unknown(f"field of a term {self.kind!r}", field, list(found)))
        return found[field]

    def value(self, field: str) -> float:
        """Value of a field in the model where no parameter sets it."""
        return self.quantity(field).value

    @property
    def values(self) -> dict[str, float]:
        """Values of all fields in the model where no parameter sets them."""
        return {field: quantity.value for field, quantity in self.quantities}

    def write(self, model: Any, values: Mapping[str, float]) -> None:
        """Write all fields into a model that the caller owns, in place.

        Only terms with `is_written_as_a_whole` need it.

        Args:
            model: The extended model.
            values: Values of all fields [unit of the field].
        """
        raise NotImplementedError(self.kind)


def stated_quantities(
    kind: str, table: TermTable, defaults: dict[str, TermQuantity]
) -> tuple[tuple[str, TermQuantity], ...]:
    """Fields of a term by name, with the values that a table states in place of the defaults.

    Raises:
        ExperimentError: The table states a field that the kind does not have.
    """
    stated = dict(table.values)
    for field in stated:
        if field not in defaults:
            raise ExperimentError(f"values: {unknown(f'field of {kind!r}', field, list(defaults))}")
    return tuple(
        (field, replace(quantity, value=stated.get(field, quantity.value)))
        for field, quantity in defaults.items()
    )


def named_element(table: TermTable, key: str, model: Any, kind: str) -> tuple[str, int]:
    """Name and number of the element on which a term acts.

    Args:
        table: The table.
        key: Key that names the element, one of `ELEMENT_KEYS`.
        model: The stated model.
        kind: Kind of the term, for messages.

    Raises:
        ExperimentError: The table does not name the element, the model does not have it, or the
            table names an element by another key.
    """
    stated = dict(table.element)
    for other in stated:
        if other != key:
            raise ExperimentError(f"{other}: a term of kind {kind!r} takes {key!r}, not {other!r}")
    if key not in stated:
        valid = ", ".join(names_of(model, key)) or "none has a name"
        raise ExperimentError(f"a term of kind {kind!r} needs {key!r}; valid: {valid}")

    name = stated[key]
    number = identifier(model, key, name)
    if number < 0:
        raise ExperimentError(f"{key}: {unknown(key, name, names_of(model, key))}")
    return name, number


def require_free_name(model: Any, kind: str, name: str) -> None:
    """Raise ExperimentError where the model already has an element of this kind and name."""
    if identifier(model, kind, name) >= 0:
        raise ExperimentError(
            f"the model has {'an' if kind == 'actuator' else 'a'} {kind} {name!r} already; give "
            "the term another name"
        )


@record
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
        """Sizes at the joint that a table names; ExperimentError at ball and free joints."""
        name, number = named_element(table, "joint", model, kind)
        if int(model.jnt_type[number]) not in SCALAR_JOINTS:
            raise ExperimentError(
                f"joint: {name!r} is a ball or free joint; a term of kind {kind!r} acts on slides "
                "and hinges"
            )

        time = period / LEAST_MOVE_PER_SAMPLE
        dof = int(model.jnt_dofadr[number])
        return JointSizes(
            joint=name,
            number=number,
            dof=dof,
            unit=joint_unit(model, number),
            inertia=joint_inertia(model, number),
            force=float(force_sizes(model, time)[dof]),
            speed=float(position_sizes(model)[dof]) / time,
        )


def rounded(number: float) -> float:
    """A number that the library chooses, with `CHOSEN_DIGITS` digits."""
    return float(f"{number:.{CHOSEN_DIGITS}g}")


def joint_inertia(model: Any, joint: int) -> float:
    """Inertia that the force of a joint feels in the reference position [kg or kg m²]."""
    weight = model.dof_invweight0[model.jnt_dofadr[joint]]
    return 1.0 / weight if weight > 0.0 else 1.0


def motors_at(model: Any, joint: int) -> dict[str, int]:
    """Names and numbers of the actuators at a joint, without those that have no control.

    Raises:
        ExperimentError: One of them has no name; the message is a clause.
    """
    at_joint = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    here = at_joint & (model.actuator_trnid[:, 0] == joint) & (model.actuator_ctrlnum > 0)
    found = {element_name(model, "actuator", i): i for i in np.flatnonzero(here).tolist()}
    if "" in found:
        raise ExperimentError("joint: an actuator at the joint has no name; give it one")
    return found


def move_to_tendon(spec: Any, motors: Iterable[str], tendon: str) -> None:
    """Let actuators of an MjSpec act on a tendon instead of their joint."""
    for name in motors:
        actuator = spec.actuator(name)
        actuator.trntype = mujoco.mjtTrn.mjTRN_TENDON
        actuator.target = tendon


def light_body(model: Any, body: int, inertia: float) -> tuple[float, float]:
    """Mass and inertia of a body so light that its own motion does not matter.

    Args:
        model: The stated model.
        body: The link behind which the body is.
        inertia: Inertia that the joint of the link feels [kg m²].

    Returns:
        Mass [kg] and inertia [kg m²].
    """
    mass = model.body_mass[body] or model.body_subtreemass[body]
    return rounded(NEGLIGIBLE * mass), rounded(NEGLIGIBLE * inertia)


def add_body(parent: Any, name: str, mass: float, inertia: float, com: Any) -> Any:
    """Add a body with equal inertia about all axes to another body of an MjSpec."""
    body = parent.add_body(name=name)
    body.mass = mass
    body.ipos = np.array(com)
    body.inertia = np.full(3, inertia)
    body.explicitinertial = True
    return body


def add_plain_joint(body: Any, name: str, axis: Any, place: Any, *, slides: bool) -> Any:
    """Add a slide or hinge without forces to a body of an MjSpec, whatever its default class."""
    kind = mujoco.mjtJoint.mjJNT_SLIDE if slides else mujoco.mjtJoint.mjJNT_HINGE
    joint = body.add_joint(name=name, type=kind, axis=axis, pos=place)
    joint.stiffness = np.zeros(np.size(joint.stiffness))
    joint.damping = np.zeros(np.size(joint.damping))
    joint.armature, joint.frictionloss = 0.0, 0.0
    joint.ref, joint.springref = 0.0, 0.0
    joint.springdamper = np.zeros(2)
    joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
    joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
    return joint


def with_first(polynomial: Any, value: float) -> np.ndarray:
    """Coefficients of a polynomial force of which only the first one is not zero."""
    numbers = np.zeros(np.size(polynomial))
    numbers[0] = value
    return numbers


@dataclass(frozen=True, kw_only=True, eq=False)
class StateLayout:
    """Addresses of the stated model's state in the state of the extended model.

    Attributes:
        qpos: (nq,) addresses of the stated positions in the extended ones.
        qvel: (nv,) addresses of the stated velocities.
        act: (na,) addresses of the stated activations.
        model: The extended model (`mujoco.MjModel`).
    """

    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    model: Any

    @classmethod
    def between(
        cls, stated: Any, extended: Any, joints: Sequence[int], actuators: Sequence[int]
    ) -> StateLayout:
        """The layout of an extended model.

        Args:
            stated: The stated model.
            extended: The extended model.
            joints: Number in the extended model of each joint of the stated one.
            actuators: Number in the extended model of each actuator of the stated one.
        """
        qpos = _moved_addresses(stated.jnt_qposadr, extended.jnt_qposadr, joints, stated.nq)
        qvel = _moved_addresses(stated.jnt_dofadr, extended.jnt_dofadr, joints, stated.nv)
        act = np.zeros(stated.na, dtype=np.intp)
        for old, new in enumerate(actuators):
            count = stated.actuator_actnum[old]
            first = stated.actuator_actadr[old]
            act[first : first + count] = extended.actuator_actadr[new] + np.arange(count)
        return cls(qpos=qpos, qvel=qvel, act=act, model=extended)

    @property
    def added(self) -> frozenset[int]:
        """Addresses in (qpos, qvel) of the extended model that the stated one does not have."""
        size = self.model.nq + self.model.nv
        stated = {*self.qpos.tolist(), *(self.model.nq + self.qvel).tolist()}
        return frozenset(range(size)) - stated

    def positions(self, stated: Any) -> Array:
        """(nq,) extended positions; added joints are at their references."""
        positions = np.array(self.model.qpos0)
        positions[self.qpos] = stated
        return positions

    def velocities(self, stated: Any) -> Array:
        """(nv,) extended velocities; zero for added joints."""
        velocities = np.zeros(self.model.nv)
        velocities[self.qvel] = stated
        return velocities

    def activations(self, stated: Any, qpos: Array, ctrl: Array | None) -> Array:
        """(na,) extended activations; those that terms add are at rest.

        Args:
            stated: (na,) activations of the stated model.
            qpos: (nq,) positions of the extended model.
            ctrl: (nu,) control at rest. Without one, position servos hold their joints, and other
                controls are zero.
        """
        activations = np.zeros(self.model.na)
        added = np.setdiff1d(np.arange(self.model.na), self.act)
        for actuator in range(self.model.nactuator):
            first = self.model.actuator_actadr[actuator]
            if first in added and self.model.actuator_dyntype[actuator] in FILTERS:
                activations[first] = self._resting_control(actuator, qpos, ctrl)

        activations[self.act] = stated
        return activations

    def _resting_control(self, actuator: int, qpos: Array, ctrl: Array | None) -> float:
        """Control at rest of an actuator that has one control."""
        if ctrl is not None:
            return float(ctrl[self.model.actuator_ctrladr[actuator]])
        joint = commanded_joint(self.model, actuator)
        if joint is None:
            return 0.0
        position = float(qpos[self.model.jnt_qposadr[joint]])
        return position * actuator_gear(self.model, actuator)


def extended_spec(
    spec: Any, stated: Any, terms: Sequence[Term], compiled: Callable[[Any], Any]
) -> tuple[Any, StateLayout]:
    """A copy of an MjSpec with terms, and the layout of its state.

    Args:
        spec: The spec of the stated model, which is not changed.
        stated: The stated model that it compiles to.
        terms: The terms.
        compiled: Compiles a spec.

    Raises:
        ModelError: The extended spec does not compile.
    """
    extended = spec.copy()
    joints, actuators = list(extended.joints), list(extended.actuators)
    for term in terms:
        term.edit(extended)

    # Terms may change the size of the state. The spec compiles only if its keyframes have that size
    # or are empty.
    numbers = [
        [np.array(each) for each in (key.qpos, key.qvel, key.act, key.ctrl)]
        for key in extended.keys
    ]
    for key in extended.keys:
        key.qpos, key.qvel, key.act = [], [], []
    model = compiled(extended)

    layout = StateLayout.between(
        stated,
        model,
        [int(joint.id) for joint in joints],
        [int(actuator.id) for actuator in actuators],
    )
    for key, stated_numbers in zip(extended.keys, numbers, strict=True):
        _write_key(key, stated_numbers, layout)
    return extended, layout


def _write_key(key: Any, numbers: Sequence[Array], layout: StateLayout) -> None:
    """Write the numbers of the extended state into a keyframe of an MjSpec.

    Args:
        key: The keyframe.
        numbers: Positions, velocities, activations and control in the keyframe of the stated model;
            each is empty where the keyframe does not state it.
        layout: The layout of the extended state.
    """
    positions, velocities, activations, ctrl = numbers
    qpos = np.array(layout.model.qpos0)
    if len(positions):
        qpos = layout.positions(positions)
        key.qpos = qpos
    if len(velocities):
        key.qvel = layout.velocities(velocities)
    if len(activations) or layout.model.na > len(layout.act):
        stated = activations if len(activations) else np.zeros(len(layout.act))
        key.act = layout.activations(stated, qpos, ctrl if len(ctrl) else None)


def _moved_addresses(
    stated: np.ndarray, extended: np.ndarray, joints: Sequence[int], size: int
) -> np.ndarray:
    """(size,) extended addresses of the stated numbers of joints.

    Args:
        stated: First address of each joint in the stated model.
        extended: First address of each joint in the extended model.
        joints: Number in the extended model of each joint of the stated one.
        size: Number of stated addresses.
    """
    counts = np.diff(stated, append=size)
    return np.asarray(np.arange(size) + np.repeat(extended[list(joints)] - stated, counts))
