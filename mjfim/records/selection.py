"""Records of the selection of terms by which a model is extended."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from enum import Enum
from itertools import pairwise
from math import isfinite, isnan
from typing import Any

from mjfim.arrays import Array, freeze
from mjfim.records.missing_term import AddedTerm, TermParameter, key_of_term


class Decision(Enum):
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


@dataclass(frozen=True, kw_only=True)
class SelectedTerm:
    """A term that was added to a model, which parameters of the experiment stand for.

    Attributes:
        name: Name of its main parameter.
        description: The term in words.
        path: Target of the main parameter.
        unit: Unit of the main parameter; may be empty.
        scale: Size of the term [unit].
        further: Its further parameters by name.
        added: Table of the library of terms that it needs; None for a number of the model.
        more_added: The tables of further joints, where it is one kind of term at several joints.
        joints: Names of these joints, that of the main parameter first; empty for a single term.
        source: Publication that describes the term; may be empty.
    """

    name: str
    description: str
    path: str
    unit: str
    scale: float
    further: dict[str, TermParameter] = field(default_factory=dict)
    added: AddedTerm | None = None
    more_added: tuple[AddedTerm, ...] = ()
    joints: tuple[str, ...] = ()
    source: str = ""

    @property
    def table(self) -> dict[str, object]:
        """The table of the main parameter in an experiment file."""
        return {"target": self.path, "scale": self.scale}

    @property
    def parameters(self) -> dict[str, dict[str, object]]:
        """The tables of all its parameters, by name."""
        further = {name: parameter.table for name, parameter in self.further.items()}
        return {self.name: self.table, **further}

    @property
    def terms(self) -> dict[str, dict[str, object]]:
        """The tables of the library of terms that it needs, by name; empty without one."""
        tables = () if self.added is None else (self.added, *self.more_added)
        return {table.name: table.table for table in tables}


@dataclass(frozen=True, kw_only=True)
class PooledParameter:
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
        table: dict[str, object] = {"targets": targets, "guess": self.guess, "scale": self.scale}
        if self.unit:
            table["unit"] = self.unit
        if isfinite(self.bounds[0]) and isfinite(self.bounds[1]):
            table["bounds"] = list(self.bounds)
        return table


@dataclass(frozen=True, kw_only=True)
class AlternativeTerm:
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


@dataclass(frozen=True, kw_only=True)
class SelectionStep:
    """A step of a selection: a model with one term more or less than the one before.

    Attributes:
        decision: What was done with the term.
        description: The term in words; empty for the stated model.
        path: Target of its parameter; empty for the stated model.
        count: Number of added terms after the step.
        error: Held-out error of the model with the term, or without a removed one [sigma]; NaN
            where no part of the data could be predicted from the others, and where the fit with the
            term is no better than without it.
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


@dataclass(frozen=True, eq=False, kw_only=True)
class HeldOutRefit:
    """Fit of the selected model to the held-out recordings, which took no part in the selection.

    Its intervals do not depend on how the terms were chosen.

    Attributes:
        theta: (p,) estimate [theta-unit].
        interval: (p, 2) 95 % intervals [theta-unit].
        differs: Names of the common parameters that differ from those of the fitted recordings by
            more than both intervals explain; one by chance in 5 % of the cases.
    """

    theta: Array
    interval: Array
    differs: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        freeze(self, "theta", "interval")


@dataclass(frozen=True, kw_only=True)
class Selection:
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

    terms: tuple[SelectedTerm, ...]
    steps: tuple[SelectionStep, ...]
    ending: str
    pooled: tuple[PooledParameter, ...] = ()
    held: tuple[str, ...] = ()
    refit: HeldOutRefit | None = None
    hold: tuple[str, ...] = ()
    segments: float | None = None

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
        return {name: table for term in self.terms for name, table in term.terms.items()}

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
        edges = [0, *begins, len(kept)]
        return tuple(tuple(kept[first:last]) for first, last in pairwise(edges))

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
        return " ".join([added, *self._simplifications, *self._about_errors, self.ending])

    @property
    def _about_errors(self) -> list[str]:
        """Sentence about the errors of left-out data; none where no part was predicted."""
        before, after = self.errors
        if isnan(before):
            return []
        begin = self.phases[-1][0]
        over = f" over {begin.description}" if begin.decision is Decision.SHORTENED else ""
        change = f" → {after:.3g}" if self.is_changed else ""
        return [f"Error of left-out data{over} {before:.3g}{change} σ."]

    @property
    def _simplifications(self) -> list[str]:
        """Sentences about pooled and held parameters."""
        sentences = [
            f"Pooled: {pool.name} in place of {', '.join(pool.members)}." for pool in self.pooled
        ]
        if self.held:
            sentences.append(
                f"Held at the guess: {', '.join(self.held)}; an error of a held guess is in no "
                "interval."
            )
        return sentences

    def summary(self) -> dict[str, Any]:
        """Return the contents of `selection` in estimate.json."""
        return {
            "words": str(self),
            "ending": self.ending,
            "terms": [asdict(term) for term in self.terms],
            "steps": [{**asdict(step), "decision": step.decision.value} for step in self.steps],
            "pooled": [asdict(pool) for pool in self.pooled],
            "held": list(self.held),
            "hold": list(self.hold),
            "segments": self.segments,
            "held_out_refit": None if self.refit is None else asdict(self.refit),
        }
