"""Records of a check: which parameters an experiment or recordings can identify, and how well."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mjfim.arrays import Array, freeze
from mjfim.records.combinations import ParameterGroup
from mjfim.records.design import CombinationAccuracy
from mjfim.records.serialization import SavedRecord

# Correlation of two estimates (absolute value) above which the parameters count as confounded.
CONFOUNDED_CORRELATION = 0.95

# Largest relative difference between psi by rollouts and psi by the linear recursion that passes
# the self-test.
RECURSION_TOLERANCE = 1e-3

# Largest relative difference between the analytic slope of the cost and finite differences that
# passes the self-test.
SLOPE_TOLERANCE = 1e-2


@dataclass(frozen=True, kw_only=True)
class ParameterCheck:
    """Predicted accuracy of one parameter.

    Attributes:
        name: Name of the parameter.
        unit: Its unit; may be empty.
        value: Value at which the check was made [unit].
        nuisance: True where the experiment does not aim at this parameter.
        size: Magnitude of its value, or of the whole vector or tensor of which it is a component
            [unit].
        std: Predicted standard deviation [unit]; infinite where it is not identifiable alone.
        relative: `std` over `size`.
        wanted: Standard deviation aimed at [unit]: stated, or 5 % of `size`.
        stated: True where `wanted` was stated in the experiment.
        repetitions: Repetitions of this experiment that reach `wanted`; 0 where no number of
            repetitions does.
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
    """Disagreement of dy/dtheta by two difference steps, a sign that the motion is not smooth.

    Attributes:
        error: Largest relative disagreement.
        parameter: Name of the parameter where it occurs.
        sample: Sample at which it first shows.
        time: Time of this sample [s].
        causes: Contacts, dry friction or active limits at this sample, in words.
    """

    error: float
    parameter: str
    sample: int
    time: float
    causes: tuple[str, ...]

    def __str__(self) -> str:
        cause = ", ".join(self.causes)
        if not cause:
            cause = "no contact, friction or limit acts there: the motion may be chaotic"
        size = f"{100 * self.error:.2g} %" if np.isfinite(self.error) else "an unlimited amount"

        return (
            f"not smooth: derivatives by two difference steps disagree by {size} for "
            f"{self.parameter}, first at sample {self.sample} (t = {self.time:.4g} s; {cause}); σ "
            "and the design are unreliable, because they use these derivatives"
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


@dataclass(frozen=True, kw_only=True)
class SelfTest:
    """Test of the derivatives along a trajectory.

    Errors are relative; infinite where a perturbed motion diverges, NaN where the criterion itself
    is infinite.

    Attributes:
        roughness: Disagreement of two difference steps that is too large, or None.
        recursion: Error of psi by rollouts against `psi_{k+1} = A psi + E`.
        slope: Error of DJ . zeta against differences of J(P(xi + gamma zeta)).
        likely_cause: Likely cause of a failure of the last two, in words; may be empty.
    """

    roughness: Roughness | None
    recursion: float
    slope: float
    likely_cause: str = ""

    @property
    def passed(self) -> bool:
        """True where all derivatives agree."""
        return (
            self.roughness is None
            and not self.recursion > RECURSION_TOLERANCE
            and not self.slope > SLOPE_TOLERANCE
        )

    def summary(self) -> dict[str, Any]:
        """Return the contents of `self_test` in check.json."""
        return {
            "passed": self.passed,
            "recursion": self.recursion,
            "slope": self.slope,
            "suspect": self.likely_cause,
            "rough": None if self.roughness is None else self.roughness.summary(),
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class Check(SavedRecord):
    """Result of `mjfim.check`: which parameters can be identified, and how well.

    Attributes:
        source: The motion that was checked: a control, a trajectory or recordings, in words.
        horizon: Its duration [s].
        rows: Predicted accuracy of each parameter.
        wanted: Names of the t parameters that are no nuisance.
        information: (p, p) information, priors included, initial-state deviations marginalised
            [1 / (unit of theta_i times unit of theta_j)].
        eigenvalues: (s,) ascending, of the information that the criterion sees.
        correlation: (t, t) correlation of the estimates of `wanted`; NaN where one is not
            identifiable alone.
        confounded: Pairs of parameters with strongly correlated estimates.
        not_separable: Groups of parameters that no experiment with these outputs can separate.
        not_excited: Groups that another control would separate.
        self_test: Test of the derivatives.
        verdict: Sentences for the user.
        combined: Accuracies of the identifiable combinations (`std_initial` and `std_final` are
            equal).
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
        """Largest over smallest eigenvalue; infinite where the smallest is not positive."""
        smallest = self.eigenvalues[0] if len(self.eigenvalues) else 0.0
        return float(self.eigenvalues[-1] / smallest) if smallest > 0.0 else np.inf

    @property
    def ok(self) -> bool:
        """True where derivatives agree, every parameter is identifiable and one repetition reaches every stated accuracy."""
        known = {row.name for row in self.rows if np.isfinite(row.std)}
        # A prior can separate parameters that the data cannot separate; such a group is then no
        # fault.
        separable = all(set(group.members) <= known for group in self.not_separable)

        stated = [row for row in self.rows if row.stated and not row.nuisance]
        reached = all(row.repetitions == 1 for row in stated)
        return self.self_test.passed and separable and not self.not_excited and reached

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
