"""Parameter paths `kind/name:field[index]`, and the fields of a model that they lead to.

The names of the fields are MuJoCo's.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import record
from mjfim.errors import ExperimentError, shortened, unknown
from mjfim.model.control_laws import FIELDS as LAW_FIELDS
from mjfim.model.control_laws import controllers_of, law_field, law_unit
from mjfim.model.coordinates import (
    joint_dofs,
    tangent_components,
    tangent_parts,
    unknown_coordinate,
)
from mjfim.model.elements import identifier, names_of, unnamed_count
from mjfim.model.inertia import INERTIA_PARAMETRISATIONS
from mjfim.model.targets import (
    InertiaField,
    InitialStateField,
    ModelField,
    OutputBiasField,
    OutputDelayField,
    OutputScaleField,
    RotationField,
    SpecField,
    TargetField,
    TermField,
)
from mjfim.model.terms.term import Term, TermQuantity
from mjfim.model.units import ANGLE, FIELD_UNITS, LENGTH, gain_unit, joint_field_unit, servo_kind

# A parameter path: the kind, the name (absent for options and the delay), the field, and
# optionally an index or the part of a joint.
PATH_PATTERN = re.compile(
    r"^(?P<kind>\w+)(?:/(?P<name>.+))?:(?P<field>\w+)(?:\[(?P<index>\d+)\]|\.(?P<part>\w+))?$"
)

# Kind -> field of a path -> array of MjModel. A field that exists for every degree of freedom is
# written to all degrees of freedom of a joint.
MODEL_ARRAYS: dict[str, dict[str, str]] = {
    "body": {
        "mass": "body_mass",
        "pos": "body_pos",
        "ipos": "body_ipos",
        "inertia": "body_inertia",
        "gravcomp": "body_gravcomp",
    },
    "joint": {
        "damping": "dof_damping",
        "frictionloss": "dof_frictionloss",
        "armature": "dof_armature",
        "stiffness": "jnt_stiffness",
        "springref": "qpos_spring",
    },
    "actuator": {
        "gear": "actuator_gear",
        "gainprm": "actuator_gainprm",
        "biasprm": "actuator_biasprm",
        "dynprm": "actuator_dynprm",
    },
    "geom": {"friction": "geom_friction", "solref": "geom_solref"},
    "pair": {"friction": "pair_friction", "solref": "pair_solref"},
    "site": {"pos": "site_pos"},
    "tendon": {
        "stiffness": "tendon_stiffness",
        "damping": "tendon_damping",
        "frictionloss": "tendon_frictionloss",
        "armature": "tendon_armature",
        "springlength": "tendon_lengthspring",
    },
    "option": {
        "gravity": "gravity",
        "wind": "wind",
        "density": "density",
        "viscosity": "viscosity",
    },
}

# Fields of a joint whose force is a polynomial, and the arrays of its coefficients of higher order.
# MuJoCo applies `-(b[0] v + b[1] v |v| + b[2] v^3)` for the damping b and the velocity v, and the
# like for the stiffness and the displacement from the spring's reference.
POLYNOMIAL_ARRAYS = {"damping": "dof_dampingpoly", "stiffness": "jnt_stiffnesspoly"}

# Field of a body -> (parametrisation of its inertia, place of the first coordinate, their number).
INERTIAL_FIELDS = {
    "fullinertia": ("central", 4, 6),
    "firstmoment": ("barycentric", 1, 3),
    "origininertia": ("barycentric", 4, 6),
    "logcholesky": ("logcholesky", 0, 10),
}

# Fields of a geom from which the compiler derives others, so that a change needs a compile.
COMPILED_FIELDS = ("size", "pos", "mass", "density")

# Name of the body that does not move and has no parameters.
WORLD = "world"

# Kinds of elements that parameter paths name, in the order of the list.
NAMED_KINDS = ("body", "joint", "actuator", "geom", "pair", "site", "tendon")

# Fields of an actuator with many entries of which most are unused; entries that are 0 are left out.
SPARSE_FIELDS = ("gear", "gainprm", "biasprm", "dynprm")

# Number of entries of the fields that are not arrays of MjModel.
FURTHER_WIDTHS = {
    **{field: width for field, (_, _, width) in INERTIAL_FIELDS.items()},
    "rot": 3,
    "size": 3,
    "pos": 3,
}

# Stands for any text in a pattern of paths.
WILDCARD = "*"

# Fields of an actuator that stand for the gains of a position or velocity servo.
SERVO_FIELDS = ("kp", "kv")

# Fields of the initial state.
INITIAL_STATE_FIELDS = ("qpos", "qvel", "act")

# Fields of the measurement.
OUTPUT_FIELDS = ("bias", "scale", "delay")

# All kinds of paths.
KINDS = (*MODEL_ARRAYS, "controller", "term", "initial", "output")

# A model without terms.
NO_TERMS: Mapping[str, Term] = MappingProxyType({})


@record
class ParameterPath:
    """A parsed parameter path.

    Attributes:
        text: The path.
        kind: Kind of the element: `body`, `joint`, `actuator`, `geom`, `pair`, `site`, `tendon`,
            `option`, `controller`, `term`, `initial`, `output`.
        name: Name of the element; empty where the path has none.
        field: Field of the element.
        index: Index of the component; None where the path has none.
        part: Part of a ball or free joint, such as `rx`; empty where the path has none.
    """

    text: str
    kind: str
    name: str
    field: str
    index: int | None
    part: str

    @classmethod
    def parse(cls, text: str) -> ParameterPath:
        """Parse a path.

        Raises:
            ExperimentError: The text is not of the form of a path.
        """
        match = PATH_PATTERN.match(text)
        if match is None:
            raise ExperimentError(
                f"parameter path {shortened(repr(text))} is not of the form kind/name:field[index]"
            )
        return cls(
            text=text,
            kind=match["kind"],
            name=match["name"] or "",
            field=match["field"],
            index=None if match["index"] is None else int(match["index"]),
            part=match["part"] or "",
        )

    @property
    def component(self) -> int:
        """Index of the component, 0 where the path has none."""
        return self.index or 0

    def component_of(self, width: int) -> int:
        """Index of the component among `width` ones.

        Raises:
            ExperimentError: The index is out of range.
        """
        if self.component >= width:
            raise self.error(f"index {self.component} is out of range; valid: 0 to {width - 1}")
        return self.component

    def error(self, fault: str) -> ExperimentError:
        """Exception that names the path and says what is wrong with it."""
        hint = f'; a pattern with * stands in a list, parameters = ["{self.text}"]'
        path = f"in parameter path {shortened(repr(self.text))}"
        return ExperimentError(f"{path}: {fault}{hint if WILDCARD in self.text else ''}")


def fields_of(kind: str) -> list[str]:
    """Fields that a path of this kind may name."""
    further: dict[str, Iterable[str]] = {
        "body": (*INERTIAL_FIELDS, "rot"),
        "site": ("rot",),
        "geom": COMPILED_FIELDS,
        "actuator": SERVO_FIELDS,
        "controller": LAW_FIELDS,
        "initial": INITIAL_STATE_FIELDS,
        "output": OUTPUT_FIELDS,
    }
    return [*MODEL_ARRAYS.get(kind, ()), *further.get(kind, ())]


def resolve(
    model: Any,
    text: str,
    outputs: Sequence[str] = (),
    decoration: Collection[str] = frozenset(),
    terms: Mapping[str, Term] = NO_TERMS,
) -> TargetField:
    """The field that a parameter path leads to.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        text: The path.
        outputs: Names of the measured columns, which `output/<name>:bias` and `:scale` may name.
        decoration: Names of geoms that neither collide nor give their body its inertia, whose place
            and size can be changed without a compile.
        terms: Physical terms by which the model is extended, which `term/<name>:...` may name.

    Raises:
        ExperimentError: The path names nothing in the model; the message lists the valid kinds,
            names, fields or indices.
    """
    path = ParameterPath.parse(text)
    kind = path.kind
    if kind not in KINDS:
        raise path.error(unknown("kind", kind, KINDS))
    if kind == "term":
        return _term_field(model, path, terms)
    if path.field not in fields_of(kind):
        raise path.error(unknown(f"{kind} field", path.field, fields_of(kind)))
    if path.part and kind != "initial":
        raise path.error(
            "only the initial state of a ball or free joint has parts such as '.rx', not "
            f"{kind} {path.field}; write {path.field}[index]"
        )

    if kind == "option":
        return _option_field(model, path)
    if kind == "output":
        return _output_field(path, outputs)
    if kind == "controller":
        return _law_field(model, path)
    if kind == "initial":
        return _initial_state_field(model, path)
    return _element_field(model, path, decoration)


def paths_of(
    model: Any, decoration: Collection[str] = frozenset()
) -> Iterator[tuple[str, float | None]]:
    """Yield the paths of all numbers of a model that a parameter can set, with their values.

    The value is None where the model has none. Unused entries of actuators are left out.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        decoration: As for `resolve`.
    """
    for kind in (*NAMED_KINDS, "option"):
        entries = list(_entries(model, kind))
        for name in [""] if kind == "option" else names_of(model, kind):
            for field, entry in entries if (kind, name) != ("body", WORLD) else ():
                path = f"{kind}/{name}:{entry}" if name else f"{kind}:{entry}"
                with suppress(ExperimentError):
                    target, value = resolve(model, path, (), decoration), None
                    with suppress(ExperimentError):
                        value = target.read(model)
                    if value != 0.0 or field not in SPARSE_FIELDS:
                        yield path, value


def matches(
    patterns: Iterable[str], model: Any, decoration: Collection[str] = frozenset()
) -> list[str]:
    """List the paths of a model that match patterns, in which `*` stands for any text.

    Args:
        patterns: The patterns. One without `*` is a path, which need not be one of this model.
        model: The compiled model (`mujoco.MjModel`).
        decoration: As for `resolve`.

    Raises:
        ExperimentError: No path matches a pattern.
    """
    paths: list[str] = []
    found: list[str] = []
    for pattern in patterns:
        if WILDCARD not in pattern:
            found.append(pattern)
            continue
        paths = paths or [path for path, _ in paths_of(model, decoration)]
        wanted = re.compile(re.escape(pattern).replace(r"\*", ".*"))
        matching = [path for path in paths if wanted.fullmatch(path)]
        if not matching:
            raise ExperimentError(unknown("parameter path", pattern, paths))
        found += matching
    return found


def _entries(model: Any, kind: str) -> Iterator[tuple[str, str]]:
    """The fields of a kind of elements, each with the end of the path of each of its entries."""
    for field in fields_of(kind):
        width = FURTHER_WIDTHS.get(field, 1)
        array = MODEL_ARRAYS[kind].get(field)
        if array is not None:
            holder = getattr(model.opt if kind == "option" else model, array)
            has_entries = np.ndim(holder) == (1 if kind == "option" else 2)
            width = int(np.shape(holder)[-1]) if has_entries else 1
        yield from ((field, field if width == 1 else f"{field}[{i}]") for i in range(width))


def unit_of(model: Any, text: str, terms: Mapping[str, Term] = NO_TERMS) -> str:
    """Unit of the number that a valid path names.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        text: The path.
        terms: Physical terms by which the model is extended.

    Returns:
        The unit; empty where the number has none, or where it is not evident from the model
        (entries of gains, tendons).
    """
    path = ParameterPath.parse(text)
    field = path.field
    if path.kind == "term":
        return term_quantity(path, terms).unit

    if field in INERTIAL_FIELDS:
        parametrisation, first, _ = INERTIAL_FIELDS[field]
        return INERTIA_PARAMETRISATIONS[parametrisation].units[first + path.component]

    if path.kind == "initial":
        # Coordinates with one component may have the index [0].
        plain = text.removesuffix("[0]")
        return next((c.unit for c in tangent_components(model) if c.path == plain), "")

    if path.kind == "controller":
        return law_unit(model, path.name, field)

    if path.kind == "joint":
        joint = identifier(model, "joint", path.name)
        # One number holds for all coordinates of a ball or free joint; it gets the unit for a
        # rotation.
        slides = model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_SLIDE
        return joint_field_unit(field, LENGTH if slides else ANGLE, path.component)

    if field in SERVO_FIELDS:
        return gain_unit(model, identifier(model, "actuator", path.name), field)
    return FIELD_UNITS.get(field, "")


def term_quantity(path: ParameterPath, terms: Mapping[str, Term]) -> TermQuantity:
    """The field of a physical term that a path names.

    Args:
        path: A path of the kind `term`.
        terms: Physical terms by which the model is extended.

    Raises:
        ExperimentError: There is no such term, or it has no such field.
    """
    if path.name not in terms:
        raise path.error(unknown("term", path.name, list(terms)))
    if path.part or path.index is not None:
        raise path.error("a field of a term is a single number; write it without an index")
    try:
        return terms[path.name].quantity(path.field)
    except ExperimentError as error:
        raise path.error(str(error)) from None


def _term_field(model: Any, path: ParameterPath, terms: Mapping[str, Term]) -> TargetField:
    """A field of a physical term: a number of the extended model, or one with the whole term."""
    quantity, term = term_quantity(path, terms), terms[path.name]
    if term.is_written_as_a_whole:
        return TermField(term, path.field)

    (first, factor), *others = quantity.numbers
    field = resolve(model, first)
    followers = []
    for text, other_factor in others:
        other = resolve(model, text)
        assert isinstance(other, ModelField)
        followers.append((other.array, other.rows[0], other.column or 0, other_factor))
    assert isinstance(field, ModelField)
    return replace(field, factor=factor * field.factor, followers=tuple(followers))


def _output_field(path: ParameterPath, outputs: Sequence[str]) -> TargetField:
    """Bias or scale of one output, or the delay of all. outputs: names of the measured columns."""
    if path.field == "delay":
        if path.name:
            raise path.error("one delay lags all outputs; write 'output:delay'")
        return OutputDelayField()

    if path.name not in outputs:
        raise path.error(unknown("output", path.name, list(outputs)))
    output = list(outputs).index(path.name)
    return OutputBiasField(output) if path.field == "bias" else OutputScaleField(output)


def _law_field(model: Any, path: ParameterPath) -> TargetField:
    """Number of the control law of an actuator."""
    laws = controllers_of(model)
    if path.name not in laws:
        hint = "" if laws else "; the experiment file states no law in [controllers]"
        raise path.error(f"{unknown('controller', path.name, laws)}{hint}")

    path.component_of(len(LAW_FIELDS[path.field]))
    try:
        return law_field(model, path.name, path.field, path.index)
    except ExperimentError as error:
        raise path.error(str(error)) from None


def _initial_state_field(model: Any, path: ParameterPath) -> InitialStateField:
    """Deviation of a coordinate, velocity or activation of the initial state."""
    if path.field == "act":
        return _initial_activation_field(model, path)

    joint = identifier(model, "joint", path.name)
    if joint < 0:
        raise path.error(unknown("joint", path.name, names_of(model, "joint")))

    parts = tangent_parts(model, joint)
    if parts:
        written = [f"initial/{path.name}:{path.field}.{part}" for part in parts]
        if path.text not in written:
            raise path.error(unknown_coordinate("coordinate", path.text, written))
        k = written.index(path.text)
    elif path.part:
        raise path.error(
            f"a slide or hinge joint has no parts; write 'initial/{path.name}:{path.field}'"
        )
    else:
        k = path.component_of(1)

    first = int(model.jnt_dofadr[joint])
    return InitialStateField(first + k + (model.nv if path.field == "qvel" else 0))


def _initial_activation_field(model: Any, path: ParameterPath) -> InitialStateField:
    """Deviation of an activation of the initial state."""
    actuator = identifier(model, "actuator", path.name)
    count = model.actuator_actnum[actuator] if actuator >= 0 else 0
    if count == 0:
        with_state = [
            name
            for name in names_of(model, "actuator")
            if model.actuator_actnum[model.actuator(name).id]
        ]
        raise path.error(unknown("actuator with a state", path.name, with_state))
    if path.part:
        raise path.error("an activation has no parts; write act[index]")

    first = 2 * model.nv + int(model.actuator_actadr[actuator])
    return InitialStateField(first + path.component_of(count))


def _option_field(model: Any, path: ParameterPath) -> ModelField:
    """A number of the options of the model."""
    array = MODEL_ARRAYS["option"][path.field]
    width = int(np.size(getattr(model.opt, array)))
    return ModelField(array=array, rows=(path.component_of(width),), in_options=True)


def _element_field(model: Any, path: ParameterPath, decoration: Collection[str]) -> TargetField:
    """A number of an element of the model."""
    field = path.field
    number = identifier(model, path.kind, path.name)
    if number < 0:
        fault = unknown(path.kind, path.name, names_of(model, path.kind))
        unnamed = unnamed_count(model, path.kind)
        hint = f"; {unnamed} more have no name: give them one in the MJCF" if unnamed else ""
        raise path.error(f"{fault}{hint}")

    if field in INERTIAL_FIELDS:
        parametrisation, first, width = INERTIAL_FIELDS[field]
        if not model.body_mass[number] > 0.0:
            raise path.error(f"body {path.name!r} has no mass")
        return InertiaField(number, parametrisation, first + path.component_of(width))

    if field == "rot":
        return RotationField(f"{path.kind}_quat", number, path.component_of(3))

    if path.kind == "geom" and field in COMPILED_FIELDS:
        # Place, size, mass or density of a geom need a compile unless the geom is decoration.
        index = path.component_of(3 if field in ("size", "pos") else 1)
        if field == "size" and model.geom_dataid[number] >= 0:
            raise path.error("the size of a mesh or height field is not a number of the geom")
        if field in ("size", "pos") and path.name in decoration:
            return ModelField(array=f"geom_{field}", rows=(number,), column=index)
        return SpecField(path.name, field, index)

    if path.kind == "actuator" and field in SERVO_FIELDS:
        return _servo_field(model, path, number)

    return _array_field(model, path, number)


def _servo_field(model: Any, path: ParameterPath, actuator: int) -> ModelField:
    """Gain of a position or velocity servo, with the entries of its bias that follow the gain.

    kp sets gainprm[0] and biasprm[1]. kv sets biasprm[2], and gainprm[0] of a velocity servo.
    """
    rows = (actuator,)
    column = {"kp": 1, "kv": 2}[path.field]
    kind = servo_kind(model, actuator)
    # The gain of a PID actuator is its integral gain; kp and kv are entries of its bias.
    is_pid = model.actuator_gaintype[actuator] == mujoco.mjtGain.mjGAIN_PID
    if is_pid or (path.field == "kv" and kind == "position"):
        return ModelField(array="actuator_biasprm", rows=rows, column=column, factor=-1.0)

    has_gain = model.actuator_gainprm[actuator, 0] != 0.0
    if has_gain and kind == {"kp": "position", "kv": "velocity"}[path.field]:
        follower = ("actuator_biasprm", actuator, column, -1.0)
        return ModelField(array="actuator_gainprm", rows=rows, column=0, followers=(follower,))
    wanted = "position" if path.field == "kp" else "position or velocity"
    raise path.error(
        f"the actuator is no {wanted} servo; use gainprm[i] and biasprm[i], or the numbers of the "
        "law that takes its place"
    )


def _array_field(model: Any, path: ParameterPath, number: int) -> ModelField:
    """A number of an array of MjModel."""
    array = MODEL_ARRAYS[path.kind][path.field]
    holder = getattr(model, array)

    column = None
    if path.kind == "joint" and path.field in POLYNOMIAL_ARRAYS and path.component > 0:
        array = POLYNOMIAL_ARRAYS[path.field]
        column = path.component_of(1 + getattr(model, array).shape[1]) - 1
    elif holder.ndim == 2:
        column = path.component_of(holder.shape[1])
    else:
        path.component_of(1)

    # A rest length without an index sets both ends of the range where these are equal.
    one_length = path.field == "springlength" and holder[number, 0] == holder[number, 1]
    if one_length and path.index is None:
        follower = (array, number, 1, 1.0)
        return ModelField(array=array, rows=(number,), column=0, followers=(follower,))

    return ModelField(array=array, rows=_rows(model, array, number, path), column=column)


def _rows(model: Any, array: str, number: int, path: ParameterPath) -> tuple[int, ...]:
    """Rows of an array that belong to an element.

    There are several for a joint with several degrees of freedom and for an actuator with several
    force outputs.
    """
    if array.startswith("dof_"):
        first = int(model.jnt_dofadr[number])
        return tuple(range(first, first + joint_dofs(model, number)))

    if array == "qpos_spring":
        if joint_dofs(model, number) > 1:
            raise path.error("springref exists on slide and hinge joints only")
        return (int(model.jnt_qposadr[number]),)

    if array == "actuator_gear":
        first = int(model.actuator_outadr[number])
        return tuple(range(first, first + int(model.actuator_outnum[number])))

    return (number,)
