"""Parameter values written into the user's MJCF.

Each value changes only the attributes that state it.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ModelError
from mjfim.model.elements import element_name
from mjfim.model.parameters import ParameterSet, Target
from mjfim.model.paths import MODEL_ARRAYS, POLYNOMIAL_ARRAYS, ParameterPath, resolve
from mjfim.model.targets import (
    InertiaField,
    ModelField,
    OutputBiasField,
    OutputDelayField,
    OutputScaleField,
    RotationField,
    SpecField,
    TargetField,
)
from mjfim.output.mjcf.actuators import ARRAYS, attribute_changes
from mjfim.output.mjcf.document import MjcfDocument, all_digits, nearly_equal
from mjfim.output.mjcf.inertials import write_inertial

# Count of numbers in attributes that MuJoCo accepts only if all of them are stated.
COMPLETE_COUNTS = {"pos": 3, "gravity": 3, "wind": 3}

# Fields of a body that its <inertial> states.
INERTIAL_FIELDS = ("mass", "ipos", "inertia")

# Fields of a geom that the compiled model does not keep.
UNCOMPILED_FIELDS = ("mass", "density")

# Column of a geom's half length in its size, by type of geom; DEFAULT_LENGTH_COLUMN for all others.
LENGTH_COLUMNS = {
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): 1,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): 1,
}
DEFAULT_LENGTH_COLUMN = 2

# Arrays of MjModel that the compiler may derive from other numbers, by kind of object and
# attribute.
DERIVED = {
    "actuator": {"gainprm": "actuator_gainprm", "biasprm": "actuator_biasprm"},
    "joint": {"stiffness": "jnt_stiffness", "damping": "dof_damping"},
    "tendon": {"springlength": "tendon_lengthspring"},
}

# Relative difference above which a derived number must be stated.
DERIVED_TOLERANCE = 1e-12


class ParameterEdits:
    """Edits of an MJCF text, after which it compiles to a wanted model.

    The methods raise ModelError if the text cannot express a change; the message is a clause that
    gives the reason.

    Attributes:
        document: The text.
    """

    def __init__(self, document: MjcfDocument, spec: Any, old: Any, wanted: Any) -> None:
        """Prepare the edits.

        Args:
            document: The text.
            spec: MjSpec of the text.
            old: Model that the text compiles to.
            wanted: Model that the edited text has to compile to.
        """
        self.document = document
        self._spec = spec
        self._old = old
        self._wanted = wanted
        self._new_option: dict[str, str] = {}

    def write_parameters(self, parameters: ParameterSet, theta: Array) -> None:
        """Write parameter values into the text. To be called once.

        Args:
            parameters: The parameters.
            theta: (p,) values with which the wanted model was made.

        Raises:
            ModelError: The text cannot express a value.
        """
        # Whether the inertia matrix of a body is varied as a whole, by name of the body.
        bodies: dict[str, bool] = {}

        for parameter, value in zip(parameters.parameters, theta, strict=True):
            if parameter.function is not None:
                raise ModelError(f"parameters.{parameter.name} is a Python function of the MjSpec")

            for target in parameter.targets:
                # MJCF has no discrete control laws.
                if ParameterPath.parse(target.path).kind == "controller":
                    continue
                for path, target_field in self._numbers_of(target):
                    as_matrix = isinstance(target_field, InertiaField)

                    # All parameters of one body's inertia are written together.
                    if as_matrix or (path.kind == "body" and path.field in INERTIAL_FIELDS):
                        bodies[path.name] = bodies.get(path.name, False) or as_matrix
                    else:
                        written = target.scale * float(value) + target.offset
                        self._write_field(path.kind, path.name, path.field, target_field, written)

        for name, as_matrix in bodies.items():
            write_inertial(self.document, name, self._old, self._wanted, as_matrix=as_matrix)
        if self._new_option:
            self.document.insert_child(0, "option", self._new_option)

        outside = _errors_of_sensors(parameters, theta)
        if outside:
            self.document.insert_comment(0, f"not part of an MJCF: {', '.join(outside)}")

    def _numbers_of(self, target: Target) -> Iterator[tuple[ParameterPath, TargetField]]:
        """The numbers of the model that a target determines, with their paths."""
        for text in target.plain_paths:
            path = ParameterPath.parse(text)
            yield path, target.field if target.term is None else resolve(self._old, text)

    def write_derived(self, compiled: Any) -> list[str]:
        """State numbers that the compiler would derive from the changed ones with another result.

        Args:
            compiled: Model that the edited text compiles to.

        Returns:
            The objects of which a number was stated, as `kind 'name'`.

        Raises:
            ModelError: Such an object has no name.
        """
        self._old = compiled

        stated = []
        for kind, field, array, row, index in _derived_rows(compiled):
            found = np.asarray(getattr(compiled, array)[row])
            wanted = np.asarray(getattr(self._wanted, array)[row])
            if np.allclose(found, wanted, rtol=DERIVED_TOLERANCE, atol=0.0):
                continue

            name = element_name(compiled, kind, index)
            if not name:
                raise ModelError(
                    f"MuJoCo derives the {field} of a {kind} that has no name from changed values"
                )
            self._write_number(kind, name, field, ModelField(array=array, rows=(row,)))
            stated.append(f"{kind} {name!r}")

        return list(dict.fromkeys(stated))

    def _write_field(
        self, kind: str, name: str, field: str, target_field: TargetField, value: float
    ) -> None:
        """Write one target of a parameter. value: in the unit of the MJCF."""
        if isinstance(target_field, SpecField) and field in UNCOMPILED_FIELDS:
            old = float(getattr(self._spec.geom(name), field))
            if not nearly_equal(np.array(old), np.array(value)):
                tag = self.document.element("geom", name)
                self.document.set_numbers(tag, field, old, value)
        elif kind == "geom" and field in ("pos", "size"):
            self._write_geom(name)
        elif isinstance(target_field, RotationField):
            self._write_orientation(kind, name)
        elif isinstance(target_field, ModelField):
            self._write_number(kind, name, field, target_field)

    def _write_number(self, kind: str, name: str, field: str, target_field: ModelField) -> None:
        """Write a number that the text states by the name of its field, or one of an actuator."""
        if target_field.array.removeprefix("actuator_") in ARRAYS:
            self._write_actuator(name)
            return

        old = _numbers(self._old, target_field)
        new = _numbers(self._wanted, target_field)
        if kind == "joint" and field in POLYNOMIAL_ARRAYS:
            # One attribute states all coefficients.
            old, new = (_coefficients(model, field, name) for model in (self._old, self._wanted))
        if nearly_equal(old, new).all():
            return
        if kind == "option":
            self._write_option(field, old, new)
            return

        tag = self.document.element(kind, name)
        min_count = COMPLETE_COUNTS.get(field, 1)
        if field == "pos":
            self._check_coordinates(tag, kind, name)
        elif field == "springref" and self._is_in_degrees(name):
            old, new = np.rad2deg(old), np.rad2deg(new)
        elif field == "springlength":
            # One rest length sets both ends of the range.
            is_single = new[0] == new[1] and len(self.document.written_numbers(tag, field)) < 2
            min_count = 1 if is_single else 2
            old, new = old[:min_count], new[:min_count]

        self.document.set_numbers(tag, field, old, new, min_count=min_count)

    def _is_in_degrees(self, joint: str) -> bool:
        """Return whether the text states the coordinate of a joint in degrees."""
        is_hinge = self._spec.joint(joint).type == mujoco.mjtJoint.mjJNT_HINGE
        return bool(self._spec.compiler.degree and is_hinge)

    def _write_option(self, field: str, old: Array, new: Array) -> None:
        """Write a field of `<option>`.

        The last `<option>` that states the field is changed, else the last one; without any, a new
        one is made.
        """
        options = self.document.top_level("option")
        if not options:
            self._new_option[field] = all_digits(*new)
            return

        # MuJoCo lets a later option override an earlier one.
        stating = [tag for tag in options if self.document.attribute(tag, field) is not None]
        tag = stating[-1] if stating else options[-1]
        min_count = COMPLETE_COUNTS.get(field, 1)
        self.document.set_numbers(tag, field, old, new, min_count=min_count)

    def _write_actuator(self, name: str) -> None:
        """Write gain, bias and dynamics of an actuator by the attributes of its element."""
        actuator = int(self._old.actuator(name).id)
        old, wanted = (
            np.concatenate([getattr(model, f"actuator_{array}")[actuator] for array in ARRAYS])
            for model in (self._old, self._wanted)
        )
        if nearly_equal(old, wanted).all():
            return

        tag = self.document.element("actuator", name)
        element = self.document.tags[tag].name

        # The gain of a <motor> is 1; a <general> is a motor whose gain may differ.
        if element == "motor":
            self.document.rename_element(tag, "general")

        for change in attribute_changes(element, self._old, self._wanted, actuator):
            self.document.set_numbers(
                tag, change.attribute, change.old, change.new, min_count=change.min_count
            )

    def _write_orientation(self, kind: str, name: str) -> None:
        """Write the orientation of a body or site."""
        old = getattr(self._old, kind)(name).quat
        new = getattr(self._wanted, kind)(name).quat
        if nearly_equal(old, new, 1.0).all():
            return

        tag = self.document.element(kind, name)
        self._check_coordinates(tag, kind, name)
        self.document.set_exclusively(tag, "quat", all_digits(*new))

    def _write_geom(self, name: str) -> None:
        """Write position and size of a geom, or its end points if the text states these."""
        old, new = self._old.geom(name), self._wanted.geom(name)
        radius = float(self._old.geom_rbound[old.id])

        same_position = nearly_equal(old.pos, new.pos, radius).all()
        if same_position and nearly_equal(old.size, new.size).all():
            return

        tag = self.document.element("geom", name)
        if not same_position:
            self._check_coordinates(tag, "geom", name)

        stated = self._spec.geom(name)
        if np.isfinite(stated.fromto[0]):
            self._write_end_points(tag, old, new, stated)
            return

        # The compiler adds the offset of a mesh to the stated position.
        before, after = old.pos, new.pos
        if stated.meshname:
            before, after = stated.pos, stated.pos + (new.pos - old.pos)

        self.document.set_numbers(tag, "size", old.size, new.size)
        self.document.set_numbers(tag, "pos", before, after, min_count=3, magnitude=radius)

    def _write_end_points(self, tag: int, old: Any, new: Any, stated: Any) -> None:
        """Write the radius and the end points of a geom whose pose is stated by end points."""
        radius = float(self._old.geom_rbound[old.id])
        column = LENGTH_COLUMNS.get(int(stated.type), DEFAULT_LENGTH_COLUMN)

        ends = np.array(stated.fromto).reshape(2, 3)
        middle = ends.mean(axis=0)
        stretch = new.size[column] / old.size[column]
        moved = middle + (new.pos - old.pos) + (ends - middle) * stretch

        self.document.set_numbers(tag, "size", old.size[:1], new.size[:1])
        self.document.set_numbers(
            tag, "fromto", ends.ravel(), moved.ravel(), min_count=6, magnitude=radius
        )

    def _check_coordinates(self, tag: int, kind: str, name: str) -> None:
        """Refuse an object whose pose in its body is not stated by its `pos` and `quat`."""
        parent = self.document.tags[self.document.tags[tag].parent]
        if parent.name == "frame":
            raise ModelError(f"{kind} {name!r} is inside a <frame>")
        if kind == "site" and np.isfinite(self._spec.site(name).fromto[0]):
            raise ModelError(f"site {name!r} is given by its end points")


def _errors_of_sensors(parameters: ParameterSet, theta: Array) -> list[str]:
    """Values of biases, scales and delays that are not zero, which no element can state."""
    kinds = (OutputBiasField, OutputScaleField, OutputDelayField)
    found = []
    for parameter, value in zip(parameters.parameters, theta, strict=True):
        for target in parameter.targets:
            written = target.scale * float(value) + target.offset
            if isinstance(target.field, kinds) and written != 0.0:
                unit = parameter.unit if target.scale == 1.0 else ""
                found.append(f"{target.path} = {all_digits(written)} {unit}".rstrip())
    return found


def _numbers(model: Any, target_field: ModelField) -> Array:
    """Return the (n,) numbers of the array row that contains a field."""
    if target_field.in_options:
        return np.atleast_1d(getattr(model.opt, target_field.array))
    return np.atleast_1d(getattr(model, target_field.array)[target_field.rows[0]])


def _coefficients(model: Any, field: str, joint: str) -> Array:
    """Return the coefficients of the force of a joint's spring or damper, from the first order."""
    number = model.joint(joint).id
    row = number if field == "stiffness" else int(model.jnt_dofadr[number])
    first = getattr(model, MODEL_ARRAYS["joint"][field])[row]
    return np.array([first, *getattr(model, POLYNOMIAL_ARRAYS[field])[row]])


def _derived_rows(model: Any) -> Iterator[tuple[str, str, str, int, int]]:
    """Yield every number that the compiler may derive: kind, attribute, array, row and index."""
    for kind, fields in DERIVED.items():
        for field, array in fields.items():
            # Arrays of degrees of freedom hold a joint in the row of its first one.
            rows = (
                model.jnt_dofadr if array.startswith("dof_") else range(len(getattr(model, array)))
            )
            for index, row in enumerate(rows):
                yield kind, field, array, int(row), index
