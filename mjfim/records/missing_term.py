"""Records of physical terms that a model lacks: what a test promises, and how to add them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from mjfim.errors import first_ones, listed


@dataclass(frozen=True, kw_only=True)
class TermParameter:
    """A parameter that a term needs.

    Attributes:
        path: Target of the parameter.
        value: Value where a search begins [unit].
        unit: Its unit; may be empty.
        scale: Size of the parameter, larger than 0 [unit].
        is_size: Whether it is one of the sizes of the term that its test has estimated.
    """

    path: str
    value: float
    unit: str
    scale: float
    is_size: bool = False

    @property
    def table(self) -> dict[str, object]:
        """The table of the parameter in an experiment file."""
        return {"target": self.path, "scale": self.scale}


@dataclass(frozen=True, kw_only=True)
class AddedTerm:
    """A table `[terms.<name>]` that a term needs.

    Attributes:
        name: Name of the term.
        kind: Its kind.
        element: Key of the element on which it acts, such as `joint`; empty for the base.
        element_name: Name of this element.
        values: Values of fields that no parameter sets [unit of the field].
    """

    name: str
    kind: str
    element: str
    element_name: str
    values: dict[str, float] = field(default_factory=dict)

    @property
    def table(self) -> dict[str, object]:
        """The table in an experiment file."""
        acts_on = {self.element: self.element_name} if self.element else {}
        values = {"values": dict(self.values)} if self.values else {}
        return {"kind": self.kind, **acts_on, **values}


@dataclass(frozen=True, kw_only=True)
class MissingTerm:
    """A physical term that the model lacks and that would explain part of the residuals.

    Attributes:
        description: The term in words.
        path: Target of a parameter that would add it.
        value: Estimated value of that parameter [unit].
        unit: Its unit; may be empty.
        sigmas: `value` divided by its standard deviation; for a term with several parameters, the
            size of the deviation of a normal variable with the same probability. For an elastic
            joint or backlash, the root of the reduction of the sum of squares by the best of a few
            values, which is no probability.
        share: Fraction of the sum of squared residuals that the term explains, 0 to 1.
        further: Further parameters that belong to the term.
        added: Table of the library of terms that it needs; None for a number of the model.
        more_added: The tables of further joints, where it is one kind of term at several joints.
        joints: Names of these joints, that of the main parameter first; empty for a single term.
        source: Publication that describes the term; may be empty.
    """

    description: str
    path: str
    value: float
    unit: str
    sigmas: float
    share: float
    further: tuple[TermParameter, ...] = ()
    added: AddedTerm | None = None
    more_added: tuple[AddedTerm, ...] = ()
    joints: tuple[str, ...] = ()
    source: str = ""

    @property
    def key(self) -> str:
        """Key of the term; see `key_of_term`."""
        return key_of_term(self.path, self.description, self.joints)

    def contains(self, other: MissingTerm) -> bool:
        """Whether this is a term at several joints, and another one is that of one of them.

        Args:
            other: The other term.
        """
        sizes = {self.path, *(each.path for each in self.further if each.is_size)}
        return bool(self.joints) and not other.joints and other.path in sizes

    @property
    def recipe(self) -> str:
        """Lines of TOML to add to the experiment file, with a semicolon between them.

        Of a term at several joints, the lines of the first joint stand for those of the others.
        """
        tables = [] if self.added is None else [_toml_line("terms", self.added)]
        element = self.path.partition(":")[0]
        own = [each.path for each in self.further if each.path.partition(":")[0] == element]
        targets = [self.path, *(own if self.joints else (each.path for each in self.further))]
        others = [f"the same for {listed(self.joints[1:])}"] if self.joints else []
        return "; ".join([*tables, *(f'target = "{path}"' for path in targets), *others])

    def __str__(self) -> str:
        amount = f"{self.value:.2g} {self.unit}".strip()
        share = f"{100 * self.share:.2g} % of the sum of squares"
        evidence = f"about {amount} ({self.sigmas:.0f} σ, {share})"
        return f"{self.description}, {evidence}; to estimate it, add: {self.recipe}"

    def summary(self) -> dict[str, Any]:
        """Return the contents of one entry of `suspects` in estimate.json."""
        found = {
            "words": self.description,
            "path": self.path,
            "value": self.value,
            "unit": self.unit,
            "sigmas": self.sigmas,
            "share": self.share,
        }
        if self.further:
            found["further"] = {each.path: each.value for each in self.further}
        if self.added is not None:
            tables = (self.added, *self.more_added)
            found["terms"] = {table.name: table.table for table in tables}
        if self.joints:
            found["joints"] = list(self.joints)
        return found


@dataclass(frozen=True, kw_only=True)
class TermTestData:
    """The data on which terms were tested that a model may lack.

    Attributes:
        share: Share of the samples of all fitted recordings, 0 to 1.
        recordings: Number of recordings with tested samples.
        count: Number of all fitted recordings.
        untested: Terms in words that could not be tested, because the model cannot have them or the
            simulation diverges with them.
        impossible: Terms in words, each with the reason, that a model of this kind cannot have.
    """

    share: float
    recordings: int
    count: int
    untested: tuple[str, ...] = ()
    impossible: tuple[str, ...] = ()

    @property
    def is_complete(self) -> bool:
        """Whether the terms were tested on all data."""
        return self.share >= 1.0

    @property
    def amount(self) -> str:
        """The data in words."""
        if self.is_complete:
            return "all data"
        share = f"{100 * self.share:.2g} % of the data"
        if self.count == 1:
            return f"{share}, the first part of the recording"
        if self.recordings == self.count:
            return f"{share}, from all {self.count} recordings"
        return f"{share}, from {self.recordings} of {self.count} recordings"

    @property
    def untested_sentence(self) -> str:
        """Sentence about terms that could not be tested; empty for none."""
        if not self.untested:
            return ""
        pronoun = "it" if len(self.untested) == 1 else "them"
        return (
            f"Not tested, because the simulation with {pronoun} diverges or the model cannot have "
            f"{pronoun}: {first_ones(self.untested)}."
        )

    @property
    def impossible_sentence(self) -> str:
        """Sentence about terms that this model cannot have; empty for none."""
        if not self.impossible:
            return ""
        return f"Not tested in this model: {first_ones(self.impossible)}."

    def __str__(self) -> str:
        return f"Terms that the model may lack were tested on {self.amount}."

    def summary(self) -> dict[str, Any]:
        """Return the contents of `suspects_tested` in estimate.json."""
        return {
            "share": self.share,
            "recordings": self.recordings,
            "of_recordings": self.count,
            "words": str(self),
            "untested": list(self.untested),
            "impossible": list(self.impossible),
        }


def key_of_term(path: str, description: str, joints: Sequence[str]) -> str:
    """Key that identifies a term among those of one model.

    A term at several joints has the path of the term of its first joint, so that its path alone
    does not identify it. Which joint is the first one depends on the data.

    Args:
        path: Target of the main parameter.
        description: The term in words.
        joints: Names of the joints of one kind of term at several joints; empty for a single term.

    Returns:
        The path of a single term; the kind and all joints of one at several joints.
    """
    return f"{description}: {', '.join(sorted(joints))}" if joints else path


def _toml_line(section: str, added: AddedTerm) -> str:
    """A table in one line of TOML, such as `terms.x = { kind = "stribeck", joint = "pivot" }`.

    Args:
        section: Name of the table of tables.
        added: The table.
    """
    return f"{section}.{added.name} = {_value(added.table)}"


def _entries(table: Mapping[str, object]) -> str:
    """Entries of a table in one line."""
    return ", ".join(f"{key} = {_value(value)}" for key, value in table.items())


def _value(value: object) -> str:
    """A value in TOML; numbers with two digits."""
    if isinstance(value, Mapping):
        return f"{{ {_entries(value)} }}"
    return f"{value:.2g}" if isinstance(value, float) else f'"{value}"'
