"""Records of a check: which parameters an experiment or recordings can identify, and how well."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from mjfim.arrays import NORMAL_95, Array, finite_or_nan, record
from mjfim.errors import first_ones, shortened
from mjfim.records.base import ParameterResult, ParameterValue, Record, no_array
from mjfim.records.design import LimitViolation
from mjfim.records.rehearsal import FiniteSteps, Rehearsal, Valley
from mjfim.records.worth import Worth

# A coefficient that differs from 1 by less than this number is not written.
UNIT_COEFFICIENT_TOLERANCE = 1e-6


# Longest list of the members of a group in a message [characters].
MEMBERS_TEXT = 120


# Longest text of a combination, and of all combinations of a group, in a message [characters].
COMBINATION_TEXT = 90


COMBINATIONS_TEXT = 180


# Longest text of several groups in a message [characters].
GROUPS_TEXT = 320


# An identifiable linear combination: coefficients by the names of the parameters, the first one 1.
Combination = dict[str, float]


def combination_terms(combination: Combination, name: Callable[[str], str] = str) -> list[str]:
    """The terms of a combination in words, such as `m` and `+ 2 l`.

    Args:
        combination: The combination.
        name: How a name is written.
    """
    terms: list[str] = []
    for member, coefficient in combination.items():
        sign = ("+ " if coefficient > 0 else "- ") if terms else ""
        terms.append(f"{sign}{_factor(abs(coefficient))}{name(member)}")
    return terms


@record
class ParameterGroup(Record):
    """Parameters that are identifiable only together.

    Attributes:
        members: Names of the parameters.
        combinations: The identifiable combinations, fewer than members; empty if no member has an
            effect.
    """

    members: tuple[str, ...]
    combinations: tuple[Combination, ...]

    in_json = ("members", "words", "combinations")
    json_names = {"combinations": "identifiable"}

    def __str__(self) -> str:
        combinations = [" ".join(combination_terms(each)) for each in self.combinations]
        return self._sentence(join_names(self.members), ", ".join(combinations))

    @property
    def short(self) -> str:
        """The group in a message; of many names and terms the first ones are shown."""
        if len(str(self)) <= COMBINATIONS_TEXT:
            return str(self)
        combinations = [
            first_ones(combination_terms(each, shortened), " ", COMBINATION_TEXT)
            for each in self.combinations
        ]
        return self._sentence(self.short_names, first_ones(combinations, longest=COMBINATIONS_TEXT))

    def _sentence(self, names: str, combinations: str) -> str:
        """The group with its names and combinations in words."""
        if not self.combinations:
            return f"{names}: no effect on any measured output"
        return f"{names} only as {combinations}"

    @property
    def short_names(self) -> str:
        """The members in a message; of many members the first ones and the number of the others."""
        names = join_names(self.members)
        return (
            names
            if len(names) <= MEMBERS_TEXT
            else first_ones([shortened(name) for name in self.members], longest=MEMBERS_TEXT)
        )


def combination_matrix(groups: Sequence[ParameterGroup], names: Sequence[str]) -> Array:
    """Return the coefficients of all combinations of several groups as a matrix.

    Args:
        groups: Groups of parameters.
        names: Names of the t parameters, one per column.

    Returns:
        (c, t) coefficients, one row per combination.
    """
    combinations = [c for group in groups for c in group.combinations]
    column_of = {name: j for j, name in enumerate(names)}

    matrix = np.zeros((len(combinations), len(names)))
    for row, combination in zip(matrix, combinations, strict=True):
        row[[column_of[member] for member in combination]] = list(combination.values())
    return matrix


def groups_in_words(groups: Sequence[ParameterGroup]) -> str:
    """Describe groups in a message; of many groups the first ones and the number of the others.

    Args:
        groups: The groups.
    """
    return first_ones([group.short for group in groups], "; ", GROUPS_TEXT)


def join_names(names: Sequence[str]) -> str:
    """Return names as a list in a sentence: `a, b and c`."""
    if len(names) == 1:
        return names[0]
    return f"{', '.join(names[:-1])} and {names[-1]}"


def _factor(coefficient: float) -> str:
    """Return the text of a coefficient in front of a name; empty if the coefficient is 1."""
    if abs(coefficient - 1.0) < UNIT_COEFFICIENT_TOLERANCE:
        return ""
    return f"{coefficient:.4g} "


# Two parameters are confounded if the absolute correlation of their estimates exceeds this number.
CONFOUNDED_CORRELATION = 0.95


# The self-test fails if psi by rollouts and psi by the linear recursion differ by more than this
# number (relative).
RECURSION_TOLERANCE = 1e-3


# The self-test fails if the analytic slope of the cost and finite differences differ by more than
# this number (relative).
SLOPE_TOLERANCE = 1e-2


@record
class ParameterCheck(Record):
    """Predicted accuracy of one parameter.

    Attributes:
        name: Name of the parameter.
        unit: Its unit; may be empty.
        value: Value at which the check was made [unit].
        nuisance: True if this is a nuisance parameter.
        size: Magnitude of its value, or of the whole vector or tensor of which it is a component
            [unit].
        std: Predicted standard deviation [unit]; infinite if it is not identifiable alone.
        relative: `std` over `size`.
        wanted: Target standard deviation [unit], stated in the experiment or 5 % of `size`.
        stated: True if `wanted` is stated in the experiment.
        repetitions: Number of repetitions of this experiment that reach `wanted`; 0 if no number
            does.
        seconds: Duration of these repetitions [s].
        targets: The paths that it sets in the model.
    """

    name: str
    unit: str
    value: float
    nuisance: bool
    size: float
    std: float
    relative: float
    wanted: float
    stated: bool
    repetitions: int
    seconds: float
    targets: tuple[str, ...] = ()

    in_json = (
        "name",
        "unit",
        "value",
        "size",
        "nuisance",
        "std",
        "relative",
        "wanted",
        "repetitions",
        "seconds",
    )


@record
class SelfTest(Record):
    """Test of the derivatives along a trajectory.

    Errors are relative. They are infinite if a perturbed motion diverges, and NaN if the criterion
    is infinite.

    Attributes:
        recursion: Difference between psi by rollouts and psi by `psi_{k+1} = A psi + E`.
        slope: Difference between DJ . zeta and finite differences of J(P(xi + gamma zeta)).
        acting: What acts first along the trajectory, in words, if an error is too large:
            contacts, dry friction or limits, where derivatives differ from differences.
        finished: False where the test was stopped; errors that were not computed are NaN.
    """

    recursion: float
    slope: float
    acting: tuple[str, ...] = ()
    finished: bool = True

    in_json = (
        "passed",
        "finished",
        "recursion",
        "slope",
        "acting",
    )

    @property
    def passed(self) -> bool:
        """True if all derivatives agree, or contacts, friction or limits say why they do not."""
        has_agreed = not self.recursion > RECURSION_TOLERANCE and not self.slope > SLOPE_TOLERANCE
        return self.finished and (has_agreed or bool(self.acting))


@record
class Check(ParameterResult):
    """Result of `mjfim.check`: which parameters can be identified, and how well.

    Attributes:
        source: The motion that was checked: a control, a trajectory or recordings, in words.
        horizon: Its duration [s].
        rows: Predicted accuracy of each parameter.
        wanted: Names of the t parameters that are not nuisance parameters.
        information: (p, p) information with priors, in which deviations of the initial state are
            marginalised [1 / (unit of theta_i times unit of theta_j)].
        eigenvalues: (s,) ascending eigenvalues of the information that the criterion uses.
        correlation: (t, t) correlation of the estimates of `wanted`; NaN where a parameter is not
            identifiable alone.
        not_separable: Groups of parameters that no experiment with these outputs can separate.
        not_excited: Groups of parameters that another control would separate.
        self_test: Test of the derivatives.
        steps: Standard deviations by finite steps along one motion; None where they were not made.
        rehearsal: What the motion does to robots; None for recordings.
        worth: What each sensor tells along one motion; None for recordings.
        valley: Two robots that one motion does not tell apart; None where every parameter is known
            well, and for recordings.
        is_start: Whether the motion is the initial control, at which a design begins.
        findings: What the check found, in sentences, the most serious first.
        combined: The identifiable combinations; their `std_initial` and `std` are equal.
        missing: What was not computed because the check was stopped, in words; empty where it is
            complete.
        refused: Reasons why `mjfim design` refuses the experiment, in its own words.
        violations: Limits that the motion of the initial control violates.
        inflation: (p,) factors by which residuals like those of earlier estimates widen σ; empty
            where σ assumes white noise.
    """

    source: str
    horizon: float
    rows: tuple[ParameterCheck, ...]
    wanted: tuple[str, ...]
    information: Array
    eigenvalues: Array
    correlation: Array
    not_separable: tuple[ParameterGroup, ...]
    not_excited: tuple[ParameterGroup, ...]
    self_test: SelfTest
    findings: tuple[str, ...]
    steps: FiniteSteps | None = None
    rehearsal: Rehearsal | None = None
    worth: Worth | None = None
    valley: Valley | None = None
    is_start: bool = False
    combined: tuple[ParameterValue, ...] = ()
    missing: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    violations: tuple[LimitViolation, ...] = ()
    inflation: Array = no_array()

    file_stem = "check"
    made_by = "`mjfim check EXPERIMENT -o DIR`"
    in_json = (
        "verdict.ok",
        "missing",
        "refused",
        "violations",
        "findings",
        "source",
        "horizon",
        "rows",
        "eigenvalues",
        "condition",
        "information",
        "wanted",
        "correlation",
        "confounded",
        "not_separable",
        "not_excited",
        "self_test",
        "steps",
        "rehearsal",
        "worth",
        "valley",
        "inflation",
    )
    json_names = {
        "findings": "verdict",
        "rows": "parameters",
        "not_separable": "combinations",
    }

    def each(self) -> Iterator[ParameterValue]:
        """Values at which σ is predicted, and the wanted σ."""
        for row in self.rows:
            half = NORMAL_95 * row.std
            yield ParameterValue(
                name=row.name,
                targets=row.targets,
                unit=row.unit,
                value=row.value,
                std=row.std,
                interval=(row.value - half, row.value + half),
                further={"wanted": row.wanted, "repetitions": row.repetitions},
            )

    @property
    def condition(self) -> float:
        """Ratio of the largest to the smallest eigenvalue; infinite if the information is singular.

        The information is singular if its smallest eigenvalue is not positive.
        """
        smallest = self.eigenvalues[0] if len(self.eigenvalues) else 0.0
        return float(self.eigenvalues[-1] / smallest) if smallest > 0.0 else np.inf

    @property
    def covariance(self) -> Array:
        """(t, t) predicted covariance of `wanted`; NaN where one is not identifiable alone."""
        std = np.array([row.std for row in self.rows if not row.nuisance])
        std = finite_or_nan(std)
        return self.correlation * np.outer(std, std)

    @property
    def confounded(self) -> list[tuple[str, str, float]]:
        """Pairs of parameters with strongly correlated estimates, and their correlation."""
        is_strong = np.triu(np.abs(self.correlation) > CONFOUNDED_CORRELATION, k=1)
        pairs = [
            (self.wanted[i], self.wanted[j], float(self.correlation[i, j]))
            for i, j in np.argwhere(is_strong).tolist()
        ]
        return sorted(pairs, key=lambda pair: -abs(pair[2]))

    @property
    def is_dangerous(self) -> bool:
        """True if nobody would play the motion, and, for a start, no limit turns a design away."""
        if self.rehearsal is None:
            return False
        return self.rehearsal.falls if self.is_start else not self.rehearsal.is_safe

    @property
    def reaches_all(self) -> bool:
        """True if every parameter that is asked for reaches its wanted σ, stated or 5 %."""
        return all(row.repetitions == 1 for row in self.rows if not row.nuisance)

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON."""
        combined = [{"words": c.name, "value": c.value, "std": c.std} for c in self.combined]
        return {
            **super().summary(),
            "complete": not self.missing,
            "combined": combined,
            "confounded": [
                {"a": first, "b": second, "correlation": correlation}
                for first, second, correlation in self.confounded
            ],
        }


def findings_of_check(check: Check) -> Iterator[str]:
    """Yield what a check found, the most serious first."""
    for reason in check.refused:
        yield f"`mjfim design` refuses this experiment: {reason}"
    if check.violations:
        broken = first_ones([str(violation) for violation in check.violations], "; ")
        yield (
            f"the initial control violates limits: {broken}; σ is that of a motion outside the "
            "limits. A design looks for a motion inside"
        )
    if check.missing:
        yield f"interrupted, so this check is incomplete; it lacks {join_names(check.missing)}"
    yield from _about_derivatives(check)
    yield from _about_identifiability(check)

    identifiable = [row for row in check.rows if not row.nuisance and np.isfinite(row.std)]
    if not identifiable:
        yield f"no parameter can be identified individually from {check.source}"
        return
    yield from _about_accuracy(check, identifiable)
    if check.confounded:
        pairs = [
            f"{shortened(first)} / {shortened(second)} ({correlation:+.3f})"
            for first, second, correlation in check.confounded
        ]
        yield (
            f"confounded pairs (correlation of the estimates): {first_ones(pairs)}; "
            "fixing one parameter of a pair makes the other more accurate"
        )


def _about_derivatives(check: Check) -> Iterator[str]:
    """Reason why the numbers of the check cannot be trusted, where the self-test failed."""
    tested = check.self_test
    if tested.finished and not tested.passed:
        yield (
            f"the derivatives do not agree (psi recursion {tested.recursion:.1e}, slope "
            f"{tested.slope:.1e}); the motion may be too unstable, or a component switches (muscle "
            "activation). Shorten horizon or timestep before you trust these numbers"
        )
    if check.steps is not None and str(check.steps):
        yield str(check.steps)


def unknown_groups(check: Check) -> list[ParameterGroup]:
    """Inseparable groups that priors do not resolve either."""
    known = {row.name for row in check.rows if np.isfinite(row.std)}
    return [group for group in check.not_separable if not set(group.members) <= known]


def _about_identifiability(check: Check) -> Iterator[str]:
    """Combinations that cannot be identified, and advice for the user."""
    unknown = unknown_groups(check)
    resolved = [group for group in check.not_separable if group not in unknown]
    if unknown:
        yield (
            "not identifiable separately from this initial state, with any tested control: "
            f"{groups_in_words(unknown)}. Remove or fix one parameter of each group, give it "
            "a prior, or measure another output; a design uses the identifiable combinations"
        )
    if resolved:
        names = first_ones([group.short_names for group in resolved], "; ")
        yield f"separated by priors only, not by data: {names}"
    if check.not_excited:
        yield (
            f"not excited by {check.source}, but another control would show: "
            f"{groups_in_words(check.not_excited)}. Move those joints more"
        )


def _fault(missed: Sequence[ParameterCheck]) -> str:
    """What is wrong with the σ of parameters, which all state a wanted one, or none of them."""
    few = len(missed) == 1
    if missed[0].stated:
        return f"{'misses' if few else 'miss'} the wanted σ"
    return f"{'has' if few else 'have'} a σ of more than 5 % of {'its' if few else 'their'} size"


def _needed(missed: Sequence[ParameterCheck]) -> str:
    """Repetitions that the least accurate parameter needs."""
    worst = max(missed, key=lambda row: row.std / row.wanted)
    needed = "no number of repetitions reaches"
    if worst.repetitions:
        needed = f"{worst.repetitions:,} repetitions ({worst.seconds:,.0f} s) reach"
    return f"the worst is {worst.name}: {needed} {worst.wanted:.3g} {worst.unit}".rstrip()


def _about_accuracy(check: Check, identifiable: Sequence[ParameterCheck]) -> Iterator[str]:
    """Comparison of the predicted standard deviations with the wanted ones."""
    missed = [row for row in identifiable if row.repetitions != 1]
    if missed:
        # Nobody wants 5 %, but it shows how many repetitions a usual accuracy needs.
        missed = [row for row in missed if row.stated] or missed
        yield (
            f"{len(missed)} of {len(identifiable)} parameters {_fault(missed)} with "
            f"{check.source} alone; {_needed(missed)}. A designed excitation (`mjfim design`) "
            "needs fewer"
        )
        return
    is_certain = check.self_test.passed and not check.missing
    if is_certain and not unknown_groups(check) and not check.not_excited:
        reached = "its wanted σ" if any(row.stated for row in identifiable) else "a σ of 5 %"
        # A start has to become a motion that a robot can play.
        end = "" if check.is_start else ": nothing more is needed"
        yield f"every identifiable parameter reaches {reached} with {check.source}{end}"
