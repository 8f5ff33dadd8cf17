"""Record of what `check` found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array, freeze
from mjfim.records.combinations import ParameterGroup
from mjfim.records.design import CombinationAccuracy

CONFOUNDED_CORRELATION = 0.95


@dataclass(frozen=True, kw_only=True)
class ParameterCheck:
    """One parameter. std: predicted standard deviation, infinite where it cannot be told alone;  relative: to its size

    size: its magnitude, of its value or, for components of vectors and tensors, of the whole
    wanted: standard deviation aimed at, stated or 5 % of the parameter's size;  stated: which of the two
    repetitions: of this experiment that reach it, 0 where none do;  seconds: the same as time
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


@dataclass(frozen=True, kw_only=True)
class ConfoundedPair:
    """Two parameters that the data hardly tell apart."""

    first: str
    second: str
    correlation: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Check:
    """What can be identified.

    source: what was looked at;  horizon: its duration [s];  rows: one per parameter
    information: (p, p), priors included, deviations of each start marginalised
    eigenvalues: ascending, of what the criterion sees;  correlation: (t, t) of the wanted parameters,
    NaN where one cannot be told alone;  wanted: their names
    combined: what is identifiable of groups, with its standard deviation (`initial` and `final` alike)
    never: groups that no experiment with these outputs tells apart;  not_here: those that another control would
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

    def __post_init__(self) -> None:
        freeze(self, "information", "eigenvalues", "correlation")

    @property
    def condition(self) -> float:
        """Largest over smallest eigenvalue."""
        low = self.eigenvalues[0] if len(self.eigenvalues) else 0.0
        return float(self.eigenvalues[-1] / low) if low > 0.0 else np.inf

    @property
    def ok(self) -> bool:
        """Derivatives hold, every parameter can be told (if only by its prior), one repetition reaches what was stated."""
        reached = all(row.repetitions == 1 for row in self.rows if row.stated and not row.nuisance)
        known = {row.name for row in self.rows if np.isfinite(row.std)}
        apart = all(set(group.members) <= known for group in self.not_separable)
        return self.self_test.passed and apart and not self.not_excited and reached


@dataclass(frozen=True, kw_only=True)
class Roughness:
    """Disagreement of dy/dtheta by two difference steps.

    error: largest relative disagreement;  parameter: whose;  sample, time [s]: where it first shows;  causes: what acts there
    """

    error: float
    parameter: str
    sample: int
    time: float
    causes: tuple[str, ...]

    def __str__(self) -> str:
        cause = (
            ", ".join(self.causes)
            or "no contact, friction or limit acts there: the motion may be chaotic"
        )
        size = f"{100 * self.error:.2g} %" if np.isfinite(self.error) else "without bound"
        return (
            f"not smooth: derivatives by two difference steps disagree by {size} for {self.parameter}, first at sample "
            f"{self.sample} (t = {self.time:.4g} s; {cause}); sigma and design rest on derivatives that hardly exist there"
        )


RECURSION_TOLERANCE = 1e-3
SLOPE_TOLERANCE = 1e-2


@dataclass(frozen=True, kw_only=True)
class SelfTest:
    """Relative errors; infinite where a perturbed motion diverges, NaN where the criterion itself is infinite.

    rough: disagreement of two difference steps that is too large, or None
    suspect: where to look when another test fails, in words
    recursion: psi by rollouts against `psi_{k+1} = A psi + E`;  slope: DJ.zeta against differences of J(P(xi + gamma zeta))
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
