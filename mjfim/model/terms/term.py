"""Base class of the physical terms of the library: fields with units and sizes, and elements."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mjfim.errors import ExperimentError, unknown
from mjfim.model.elements import identifier, names_of
from mjfim.model.terms.changes import MjcfChange

# Keys of a table `[terms.<name>]` that name the element on which the term acts.
ELEMENT_KEYS = ("joint", "actuator", "body")


@dataclass(frozen=True, kw_only=True)
class FieldDescription:
    """A field of a kind of term, in words.

    Attributes:
        name: Name of the field in paths `term/<name>:<field>`.
        description: What the number is, with its letter in the equation.
        unit: Its unit, for a hinge where it depends on the joint.
    """

    name: str
    description: str
    unit: str


@dataclass(frozen=True, kw_only=True)
class TermQuantity:
    """A field of one term, resolved against its model.

    Attributes:
        value: Value in the model where no parameter sets it [unit].
        unit: Unit of the number; empty where it has none or where it is not evident.
        size: Natural size with which a change of the number is compared [unit].
        bounds: Smallest and largest physical value [unit].
        numbers: Parameter paths of the numbers in the extended model that it determines, each with
            the factor by which the field is multiplied.
    """

    value: float
    unit: str
    size: float
    bounds: tuple[float, float] = (-np.inf, np.inf)
    numbers: tuple[tuple[str, float], ...]


@dataclass(frozen=True, kw_only=True)
class TermTable:
    """A table `[terms.<name>]` of an experiment.

    Attributes:
        name: Name of the term.
        element: Names of the elements on which it acts, by the keys of `ELEMENT_KEYS`.
        values: Values of fields that the table states [unit of the field].
        encoder: Side of an elastic joint on which the joint's sensors are: `motor` or `link`.
    """

    name: str
    element: tuple[tuple[str, str], ...]
    values: tuple[tuple[str, float], ...] = ()
    encoder: str = "motor"


@dataclass(frozen=True, kw_only=True)
class Term(ABC):
    """A physical term that is added to a model.

    Attributes:
        kind: Name of the kind in the experiment file.
        description: One sentence about the physics.
        equation: The force or torque, in the letters of `fields`.
        elements: MuJoCo's elements of which the term consists.
        acts_on: Key of the table that names the element on which it acts; empty for the base.
        fields: Its fields.
        sources: Publications that describe it.
        name: Name of the term, and of the elements that it adds.
        quantities: Its fields, resolved against the model, by name.
    """

    kind: ClassVar[str]
    description: ClassVar[str]
    equation: ClassVar[str]
    elements: ClassVar[str]
    acts_on: ClassVar[str]
    fields: ClassVar[tuple[FieldDescription, ...]]
    sources: ClassVar[tuple[str, ...]]

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

    @abstractmethod
    def edit(self, spec: Any) -> None:
        """Add the elements of the term to an MjSpec, in place."""

    @abstractmethod
    def changes(self) -> tuple[MjcfChange, ...]:
        """Changes of the MJCF text that add the term, with the values of the model."""

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

        Only terms whose fields are not single numbers of the model need it.

        Args:
            model: The extended model.
            values: Values of all fields [unit of the field].
        """
        raise NotImplementedError(self.kind)

    @property
    def is_written_as_a_whole(self) -> bool:
        """Whether some number of the model depends on several fields."""
        return False


def resolved_values(kind: str, table: TermTable, defaults: Mapping[str, float]) -> dict[str, float]:
    """Values of all fields of a term: those of the table, and defaults.

    Args:
        kind: Kind of the term, for messages.
        table: The table.
        defaults: Default by field.

    Raises:
        ExperimentError: The table states a field that the kind does not have.
    """
    for field, _ in table.values:
        if field not in defaults:
            raise ExperimentError(f"values: {unknown(f'field of {kind!r}', field, list(defaults))}")
    return {**defaults, **dict(table.values)}


def named_element(table: TermTable, key: str, model: Any, kind: str) -> tuple[str, int]:
    """Name and number of the element on which a term acts.

    Args:
        table: The table.
        key: Key that names the element, one of `ELEMENT_KEYS`.
        model: The stated model.
        kind: Kind of the term, for messages.

    Raises:
        ExperimentError: The table does not name the element, names another one besides it, or the
            model has no such element.
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
    """Raise ExperimentError where the model has an element of a kind and a name already.

    Args:
        model: The stated model.
        kind: Kind of the element that a term would add.
        name: Its name.
    """
    if identifier(model, kind, name) >= 0:
        raise ExperimentError(
            f"the model has {'an' if kind == 'actuator' else 'a'} {kind} {name!r} already; give "
            "the term another name"
        )
