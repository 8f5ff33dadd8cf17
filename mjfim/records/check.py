"""Records of a check: which parameters an experiment or recordings can identify, and how well."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mjfim.arrays import Array, freeze
from mjfim.errors import first_ones
from mjfim.records.combinations import ParameterGroup
from mjfim.records.design import CombinationAccuracy, LimitViolation
from mjfim.records.shown import ShownRecord

# Two parameters are confounded if the absolute correlation of their estimates exceeds this number.
CONFOUNDED_CORRELATION = 0.95

# The self-test fails if psi by rollouts and psi by the linear recursion differ by more than this
# number (relative).
RECURSION_TOLERANCE = 1e-3

# The self-test fails if the analytic slope of the cost and finite differences differ by more than
# this number (relative).
SLOPE_TOLERANCE = 1e-2


@dataclass(frozen=True, kw_only=True)
class ParameterCheck:
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

    def summary(self) -> dict[str, Any]:
        """Return the contents of one entry of `parameters` in check.json."""
        return {
            "name": self.name,
            "unit": self.unit,
            "value": self.value,
            "size": self.size,
            "nuisance": self.nuisance,
            "std": self.std,
            "relative": self.relative,
            "wanted": self.wanted,
            "repetitions": self.repetitions,
            "seconds": self.seconds,
        }


@dataclass(frozen=True, kw_only=True)
class ConfoundedPair:
    """Two parameters whose estimates are strongly correlated.

    Attributes:
        first: Name of one parameter.
        second: Name of the other one.
        correlation: Correlation of their estimates, -1 to 1.
    """

    first: str
    second: str
    correlation: float


@dataclass(frozen=True, kw_only=True)
class Roughness:
    """Disagreement of dy/dtheta between two difference steps, because the motion is not smooth.

    Attributes:
        error: Largest relative disagreement.
        parameter: Name of the parameter with this disagreement.
        sample: First sample with a disagreement.
        time: Time of this sample [s].
        causes: Contacts, dry friction or active limits at this sample, in words.
    """

    error: float
    parameter: str
    sample: int
    time: float
    causes: tuple[str, ...]

    def __str__(self) -> str:
        """Return a sentence of size, place and cause; short forms keep the part with the cause."""
        # Two digits, and no power of ten for some hundred percent.
        size = "an unlimited amount"
        if np.isfinite(self.error):
            size = f"{float(f'{100.0 * self.error:.2g}'):g} %"

        where, remark = f"with {first_ones(_grouped(self.causes))}", ""
        if not self.causes:
            where = "though no contact, friction or limit acts"
            remark = "; the motion may be chaotic, or depend too strongly on this parameter"

        return (
            f"not smooth at t = {self.time:.4g} s, {where}: derivatives with two different "
            f"difference steps disagree by {size} for {self.parameter}, first at sample "
            f"{self.sample}{remark}; σ and the design are unreliable, because they depend on these "
            "derivatives"
        )

    def summary(self) -> dict[str, Any]:
        """Return the contents of `rough` in check.json."""
        return {
            "error": self.error,
            "parameter": self.parameter,
            "sample": self.sample,
            "time": self.time,
            "causes": list(self.causes),
        }


def _grouped(causes: Iterable[str]) -> list[str]:
    """Return causes such as `dry friction of Jaw`, each kind once with all of its names."""
    names: dict[str, list[str]] = {}
    for cause in causes:
        kind, of, name = cause.partition(" of ")
        names.setdefault(kind + of, []).append(name)
    return [kind + first_ones(found) for kind, found in names.items()]


@dataclass(frozen=True, kw_only=True)
class SelfTest:
    """Test of the derivatives along a trajectory.

    Errors are relative. They are infinite if a perturbed motion diverges, and NaN if the criterion
    is infinite.

    Attributes:
        roughness: Disagreement between two difference steps if it is too large, otherwise None.
        recursion: Difference between psi by rollouts and psi by `psi_{k+1} = A psi + E`.
        slope: Difference between DJ . zeta and finite differences of J(P(xi + gamma zeta)).
        likely_cause: Likely cause, in words, if `recursion` or `slope` is too large; else empty.
        finished: False where the test was stopped; errors that were not computed are NaN.
    """

    roughness: Roughness | None
    recursion: float
    slope: float
    likely_cause: str = ""
    finished: bool = True

    @property
    def passed(self) -> bool:
        """True if all derivatives agree."""
        return (
            self.finished
            and self.roughness is None
            and not self.recursion > RECURSION_TOLERANCE
            and not self.slope > SLOPE_TOLERANCE
        )

    def summary(self) -> dict[str, Any]:
        """Return the contents of `self_test` in check.json."""
        return {
            "passed": self.passed,
            "finished": self.finished,
            "recursion": self.recursion,
            "slope": self.slope,
            "suspect": self.likely_cause,
            "rough": None if self.roughness is None else self.roughness.summary(),
        }


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Check(ShownRecord):
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
        confounded: Pairs of parameters with strongly correlated estimates.
        not_separable: Groups of parameters that no experiment with these outputs can separate.
        not_excited: Groups of parameters that another control would separate.
        self_test: Test of the derivatives.
        verdict: Sentences for the user.
        combined: Accuracies of the identifiable combinations; their `std_initial` and `std_final`
            are equal.
        missing: What was not computed because the check was stopped, in words; empty where it is
            complete.
        refused: Reasons why `mjfim design` refuses the experiment, in its own words.
        violations: Limits that the motion of the initial control violates.
    """

    source: str
    horizon: float
    rows: tuple[ParameterCheck, ...]
    wanted: tuple[str, ...]
    information: Array
    eigenvalues: Array
    correlation: Array
    confounded: tuple[ConfoundedPair, ...]
    not_separable: tuple[ParameterGroup, ...]
    not_excited: tuple[ParameterGroup, ...]
    self_test: SelfTest
    verdict: tuple[str, ...]
    combined: tuple[CombinationAccuracy, ...] = ()
    missing: tuple[str, ...] = ()
    refused: tuple[str, ...] = ()
    violations: tuple[LimitViolation, ...] = ()

    file_stem: ClassVar[str] = "check"
    made_by: ClassVar[str] = "`mjfim check EXPERIMENT -o DIR`"
    renamed_fields: ClassVar[Mapping[str, str]] = {
        "never": "not_separable",
        "not_here": "not_excited",
    }

    def __post_init__(self) -> None:
        freeze(self, "information", "eigenvalues", "correlation")

    @property
    def condition(self) -> float:
        """Ratio of the largest to the smallest eigenvalue; infinite if the information is singular.

        The information is singular if its smallest eigenvalue is not positive.
        """
        smallest = self.eigenvalues[0] if len(self.eigenvalues) else 0.0
        return float(self.eigenvalues[-1] / smallest) if smallest > 0.0 else np.inf

    @property
    def ok(self) -> bool:
        """True if the check found no fault.

        The derivatives agree, all parameters are identifiable, one repetition reaches every stated
        accuracy, and a design would not refuse the experiment. Limits that the initial control
        violates are no fault, because a design looks for a motion inside.
        """
        known = {row.name for row in self.rows if np.isfinite(row.std)}

        # A prior may separate parameters that the data cannot separate.
        separable = all(set(group.members) <= known for group in self.not_separable)

        stated = [row for row in self.rows if row.stated and not row.nuisance]
        reached = all(row.repetitions == 1 for row in stated)
        passed = self.self_test.passed and not self.missing and not self.refused
        return passed and separable and not self.not_excited and reached

    def summary(self) -> dict[str, Any]:
        """Return the contents of check.json."""
        confounded = [
            {"a": pair.first, "b": pair.second, "correlation": pair.correlation}
            for pair in self.confounded
        ]
        combined = [
            {"words": c.expression, "value": c.value, "std": c.std_final} for c in self.combined
        ]
        return {
            "ok": self.ok,
            "complete": not self.missing,
            "missing": list(self.missing),
            "refused": list(self.refused),
            "violations": [violation.summary() for violation in self.violations],
            "verdict": list(self.verdict),
            "source": self.source,
            "horizon": self.horizon,
            "parameters": [row.summary() for row in self.rows],
            "eigenvalues": self.eigenvalues,
            "condition": self.condition,
            "information": self.information,
            "wanted": list(self.wanted),
            "correlation": self.correlation,
            "confounded": confounded,
            "combinations": [group.summary() for group in self.not_separable],
            "combined": combined,
            "not_excited": [group.summary() for group in self.not_excited],
            "self_test": self.self_test.summary(),
        }
