"""Records of physical terms that a model lacks, and of the selection that adds them."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import field
from itertools import pairwise
from math import isfinite, isnan
from typing import Any

from mjfim.arrays import Array, record
from mjfim.errors import first_ones, listed
from mjfim.records.base import NamedEnum, Record


@record
class TermNumber(Record):
    """A number of a term, for which a parameter of the experiment stands.

    Attributes:
        path: Target of the parameter.
        value: Where a fit begins; of a number that a test has estimated, its estimated change
            [unit].
        unit: Its unit; may be empty.
        scale: Size with which the parameter is compared [unit].
        is_size: Whether a test has estimated it.
        name: Name of the parameter.
    """

    path: str
    value: float
    unit: str
    scale: float
    is_size: bool = False
    name: str = ""

    @property
    def table(self) -> dict[str, object]:
        """The table of the parameter in an experiment file."""
        return {"target": self.path, "scale": self.scale}


@record
class Term(Record):
    """A physical term that a model lacks or to which it was added.

    Attributes:
        description: The term in words.
        numbers: Its numbers; the first one is its size.
        tables: Tables `[terms.<name>]` of the library that it needs, by name.
        sigmas: Its size in standard deviations by the score test.
        share: Share of the sum of squared residuals that it explains, 0 to 1.
        joints: Names of the joints of one kind of term at several joints, that of the first number
            first; empty for a single term.
        source: Publication that describes the term; may be empty.
    """

    description: str
    numbers: tuple[TermNumber, ...]
    tables: dict[str, dict[str, str | dict[str, float]]] = field(default_factory=dict)
    sigmas: float = 0.0
    share: float = 0.0
    joints: tuple[str, ...] = ()
    source: str = ""

    @property
    def main(self) -> TermNumber:
        """The number that is the size of the term."""
        return self.numbers[0]

    @property
    def path(self) -> str:
        """Target of the main parameter."""
        return self.main.path

    @property
    def key(self) -> str:
        """Key of the term; see `key_of_term`."""
        return key_of_term(self.path, self.description, self.joints)

    @property
    def parameters(self) -> dict[str, dict[str, object]]:
        """The tables of its parameters in an experiment file, by name."""
        return {number.name: number.table for number in self.numbers}

    def contains(self, other: Term) -> bool:
        """Whether this is a term at several joints, and another one is that of one of them.

        Args:
            other: The other term.
        """
        sizes = {number.path for number in self.numbers if number.is_size}
        return bool(self.joints) and not other.joints and other.path in sizes

    @property
    def recipe(self) -> str:
        """Lines of TOML that estimate the term, to be added at the end of the experiment file.

        Of a term at several joints, those of the first one.
        """
        element = self.path.partition(":")[0]
        numbers = [
            each
            for each in self.numbers
            if not self.joints or each.path.partition(":")[0] == element
        ]
        terms = [as_toml(table, "terms", name) for name, table in self.tables.items()][:1]
        parameters = [as_toml(each.table, "parameters", each.name) for each in numbers]
        others = [f"# The same for {listed(self.joints[1:])}."] if self.joints else []
        return "\n".join([*terms, *parameters, *others])

    def __str__(self) -> str:
        amount = f"{self.main.value:.2g} {self.main.unit}".strip()
        share = f"{100 * self.share:.2g} % of the sum of squares"
        return f"{self.description}, about {amount} ({self.sigmas:.0f} σ, {share})"

    def summary(self) -> dict[str, Any]:
        """Return the term in estimate.json, as a suspect or with the names of its parameters."""
        main, *further = self.numbers
        found: dict[str, Any] = {
            "words": self.description,
            "path": main.path,
            "value": main.value,
            "unit": main.unit,
            "sigmas": self.sigmas,
            "share": self.share,
            "name": main.name,
            "scale": main.scale,
            "parameters": self.parameters,
        }
        if further:
            found["further"] = {each.path: each.value for each in further}
        if self.tables:
            found["terms"] = self.tables
        if self.joints:
            found["joints"] = list(self.joints)
        return found


@record
class TermTestData(Record):
    """The data on which terms were tested that a model may lack.

    Attributes:
        share: Share of the samples of all fitted recordings, 0 to 1.
        recordings: Number of recordings with tested samples.
        count: Number of all fitted recordings.
        untested: Terms in words that could not be tested, because the model cannot have them or the
            simulation diverges with them.
        impossible: Terms in words, each with the reason, that a model of this kind cannot have.
        unseen: By parameter, the largest move by a term that the tests may miss, as a share of the
            size of the parameter, and the term in words.
    """

    share: float
    recordings: int
    count: int
    untested: tuple[str, ...] = ()
    impossible: tuple[str, ...] = ()
    unseen: tuple[tuple[str, tuple[float, str]], ...] = ()

    in_json = (
        "share",
        "recordings",
        "count",
        "words",
        "untested",
        "impossible",
        "unseen",
    )
    json_names = {"count": "of_recordings"}

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
    def unseen_sentence(self) -> str:
        """Sentence about parameters that a missing term could move unseen; empty for none."""
        if not self.unseen:
            return ""
        moves = [f"{name} by {100 * share:.2g} % ({term})" for name, (share, term) in self.unseen]
        return f"A missing term that is too small for the tests could move {first_ones(moves)}."

    @property
    def impossible_sentence(self) -> str:
        """Sentence about terms that this model cannot have; empty for none."""
        if not self.impossible:
            return ""
        return f"Not tested in this model: {first_ones(self.impossible)}."

    def __str__(self) -> str:
        return f"Terms that the model may lack were tested on {self.amount}."


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


def as_toml(table: Mapping[str, object], *name: str, remark: str = "") -> str:
    """Write a table of an experiment file, with a line for each key.

    Args:
        table: The table.
        name: The parts of its name.
        remark: Comment below its name; empty for none.
    """
    lines = [f"[{'.'.join(map(_key, name))}]", *([f"# {remark}"] if remark else [])]
    lines += [f"{_key(key)} = {_value(value)}" for key, value in table.items()]
    return "\n".join(lines)


def _key(name: str) -> str:
    """A key in TOML, in quotation marks where it needs them."""
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else json.dumps(name, ensure_ascii=False)


def _value(value: object) -> str:
    """A value in TOML; tables in one line, and lists of them with a line for each."""
    if isinstance(value, Mapping):
        entries = ", ".join(f"{_key(key)} = {_value(entry)}" for key, entry in value.items())
        return f"{{ {entries} }}"
    if isinstance(value, list) and value and isinstance(value[0], Mapping):
        entries = "".join(f"    {_value(entry)},\n" for entry in value)
        return f"[\n{entries}]"
    return json.dumps(value, ensure_ascii=False)


class Decision(NamedEnum):
    """Decision on the model that a step of a selection tried."""

    BEGUN = "begun"
    ADDED = "added"
    REJECTED = "rejected"
    UNHELPFUL = "no better fit"
    REMOVED = "removed"
    POOLED = "pooled"
    HELD = "held"
    KEPT = "kept apart"
    SHORTENED = "predicted over segments"

    @property
    def in_json(self) -> str:
        """The decision in JSON."""
        return str(self.value)


@record
class PooledParameter(Record):
    """One parameter in place of several that the recordings hardly determine.

    Attributes:
        name: Name of the parameter.
        members: Names of the parameters in whose place it is.
        paths: Targets of the members.
        scales: Value of each member over that of the parameter.
        guess: Guess of the parameter.
        unit: Its unit; empty for a factor on the guesses of the members.
        scale: Its natural size.
        bounds: Bounds that all members allow.
    """

    name: str
    members: tuple[str, ...]
    paths: tuple[str, ...]
    scales: tuple[float, ...]
    guess: float
    unit: str
    scale: float
    bounds: tuple[float, float]

    @property
    def table(self) -> dict[str, object]:
        """The table of the parameter in an experiment file."""
        targets = [
            {"path": path, "scale": scale}
            for path, scale in zip(self.paths, self.scales, strict=True)
        ]
        table = {"targets": targets, "guess": self.guess, "scale": self.scale}
        if self.unit:
            table["unit"] = self.unit
        if isfinite(self.bounds[0]) and isfinite(self.bounds[1]):
            table["bounds"] = list(self.bounds)
        return table


@record
class AlternativeTerm(Record):
    """A term with which a model predicts as well as with the one that was added.

    Attributes:
        description: The term in words.
        path: Target of its parameter.
        values: Values that the parameters of the experiment would have with it instead
            [theta-unit].
    """

    description: str
    path: str
    values: dict[str, float]


@record
class SelectionStep(Record):
    """A step of a selection: a model with one term more or less than the one before.

    Attributes:
        decision: What was done with the term.
        description: The term in words; empty for the stated model.
        path: Target of its parameter; empty for the stated model.
        count: Number of added terms after the step.
        error: Held-out error of the model with the term, or without a removed one [sigma]; its
            least value where the first parts show that the term is of no use; NaN where no part of
            the data could be predicted from the others, and where the fit with the term is no
            better than without it.
        reduction: Reduction of the mean held-out loss by the term [sigma^2].
        standard_error: Standard error of the reduction [sigma^2].
        sigmas: Size of the term in standard deviations by the score test; 0 where none was made.
        share: Share of the sum of squared residuals that the score test promised, 0 to 1.
        alternatives: Other terms with which the prediction is as good: by at most one standard
            error worse.
        joints: Names of the joints of one kind of term at several joints, that of the target first;
            empty for a single term.
    """

    decision: Decision
    description: str = ""
    path: str = ""
    count: int = 0
    error: float
    reduction: float = 0.0
    standard_error: float = 0.0
    sigmas: float = 0.0
    share: float = 0.0
    alternatives: tuple[AlternativeTerm, ...] = ()
    joints: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """Key of the term; see `key_of_term`."""
        return key_of_term(self.path, self.description, self.joints)

    @property
    def is_kept(self) -> bool:
        """Whether the selection continued with the model of this step."""
        return self.decision not in (Decision.REJECTED, Decision.UNHELPFUL, Decision.KEPT)

    @property
    def is_refuted(self) -> bool:
        """Whether the term was tried, and fits the data or predicts left-out data no better."""
        if self.decision is Decision.UNHELPFUL:
            return True
        return self.decision is Decision.REJECTED and self.reduction <= 0.0


# Fit of the selected model to the held-out recordings, which took no part in the selection, so that
# its intervals do not depend on how the terms were chosen: (p,) estimate and (p, 2) 95 % intervals
# [theta-unit], and names of the common parameters that differ from those of the fitted recordings
# by more than both intervals explain; one by chance in 5 % of the cases.
HeldOutRefit = tuple[Array, Array, tuple[str, ...]]


@record
class Selection(Record):
    """The terms by which a model was extended, and the steps that led to them.

    Attributes:
        terms: The terms of the final model.
        steps: The steps, beginning with the stated model.
        ending: Why the selection ended, in words.
        pooled: Parameters in place of several that the recordings hardly determine.
        held: Names of parameters that keep their guess, for the same reason.
        refit: The selected model fitted to the held-out recordings; None without any.
        hold: All names of `fit.hold` of the selected model: those that the user states, and `held`.
        segments: Length of the segments that was chosen for the selected model [s]; None where the
            stated experiment decides on it.
    """

    terms: tuple[Term, ...]
    steps: tuple[SelectionStep, ...]
    ending: str
    pooled: tuple[PooledParameter, ...] = ()
    held: tuple[str, ...] = ()
    refit: HeldOutRefit | None = None
    hold: tuple[str, ...] = ()
    segments: float | None = None

    in_json = (
        "words",
        "ending",
        "terms",
        "steps",
        "pooled",
        "held",
        "hold",
        "segments",
    )

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON."""
        keys = ("theta", "interval", "differs")
        refit = None if self.refit is None else dict(zip(keys, self.refit, strict=True))
        return {**super().summary(), "held_out_refit": refit}

    @property
    def is_changed(self) -> bool:
        """Whether the selected model differs from the stated one."""
        return bool(self.terms or self.pooled or self.held)

    @property
    def refuted(self) -> frozenset[str]:
        """Keys of terms that are not missing, by the last attempt to add them.

        With them, left-out data are predicted no better: they explain residuals of the data to
        which they are fitted, but not those of other data. Or the fit itself is no better, although
        a test found them significant. See `key_of_term` for the keys.
        """
        # Only steps that tried to add a term are attempts.
        attempts = (Decision.ADDED, Decision.REJECTED, Decision.UNHELPFUL)
        last = {step.key: step for step in self.steps if step.path and step.decision in attempts}
        return frozenset(key for key, step in last.items() if step.is_refuted)

    @property
    def parameters(self) -> dict[str, dict[str, object]]:
        """Tables of the parameters of the terms, for `experiment.replace(parameters=...)`."""
        return {name: table for term in self.terms for name, table in term.parameters.items()}

    @property
    def library_terms(self) -> dict[str, dict[str, object]]:
        """Tables of the library that the terms need, for `experiment.replace(terms=...)`."""
        return {name: {**table} for term in self.terms for name, table in term.tables.items()}

    @property
    def tables(self) -> dict[str, dict[str, dict[str, object]]]:
        """All tables of the terms: `experiment.replace(**selection.tables)` has them."""
        return {"parameters": self.parameters, "terms": self.library_terms}

    @property
    def fit_table(self) -> dict[str, object]:
        """Keys of the table `[fit]` that the selection changes."""
        table: dict[str, object] = {}
        if self.held:
            table["hold"] = list(self.hold or self.held)
        if self.segments is not None:
            table["segments"] = self.segments
        return table

    @property
    def phases(self) -> tuple[tuple[SelectionStep, ...], ...]:
        """Kept steps in groups of comparable errors: whole recordings, then segments, if any."""
        kept = [step for step in self.steps if step.is_kept]
        begins = [i for i, step in enumerate(kept) if step.decision is Decision.SHORTENED]
        return tuple(tuple(kept[first:last]) for first, last in pairwise([0, *begins, len(kept)]))

    @property
    def errors(self) -> tuple[float, float]:
        """Held-out error of the first and of the last model with comparable errors [sigma].

        The first one is the stated model, or where recordings were cut into segments in the end,
        the model that was chosen by whole recordings.
        """
        last = self.phases[-1]
        return last[0].error, last[-1].error

    def __str__(self) -> str:
        words = ", ".join(term.description for term in self.terms)
        added = f"Added: {words}." if self.terms else "No term was added."
        sentences = [added]
        sentences += [
            f"Pooled: {pool.name} in place of {', '.join(pool.members)}." for pool in self.pooled
        ]
        if self.held:
            sentences.append(
                f"Held at the guess: {', '.join(self.held)}; an error of a held guess is in no "
                "interval."
            )
        # There is no error where no part was predicted.
        before, after = self.errors
        if not isnan(before):
            begin = self.phases[-1][0]
            over = f" over {begin.description}" if begin.decision is Decision.SHORTENED else ""
            change = f" → {after:.3g}" if self.is_changed else ""
            sentences.append(f"Error of left-out data{over} {before:.3g}{change} σ.")
        return " ".join([*sentences, self.ending])
