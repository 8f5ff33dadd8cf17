"""Records of a comparison: what each method found, and which of them is the better one."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from mjfim.arrays import Array, freeze

DESIGN = "design"
TIE_TOLERANCE = 1e-3  # relative difference of J that is none


class MethodOutcome(Enum):
    """How a method ended; the value is a verb phrase for the user."""

    INSIDE = "keeps all limits"
    OUTSIDE = "leaves a limit"
    NOTHING = "found nothing that keeps all limits"
    CLAMPED = "rests on clamped forces"
    NONE = "had no time for a single try"


@dataclass(frozen=True, eq=False, kw_only=True)
class MethodResult:
    """What a method found. The control is None, and numbers are NaN, where it has nothing to show.

    method, title: its key, its name;  control: (N, nu);  cost: J;  criterion: phi;  std: (p,) Cramer-Rao
    smallest: eigenvalue of what the criterion sees, per second
    worst: `(lambda_min(S I S))^-1/2`, standard deviation of the worst combination of parameters, relative to their scales S
    seconds, steps: what it took;  margins, shares: worst of each kind of limit, in its unit and over half of its range
    found_by: which of its tries;  note: a word about the result
    """

    method: str
    title: str
    outcome: MethodOutcome
    control: Array | None
    cost: float
    criterion: float
    std: Array
    smallest: float
    worst: float
    seconds: float
    steps: int
    margins: dict[str, float]
    shares: dict[str, float]
    found_by: str = ""
    note: str = ""

    def __post_init__(self) -> None:
        freeze(self, "std", *(() if self.control is None else ("control",)))

    @property
    def sound(self) -> bool:
        """It may be played: inside all limits, and what it promises is no artefact of clamps."""
        return self.outcome is MethodOutcome.INSIDE

    @property
    def tightest(self) -> tuple[str, float]:
        """Kind and share of the worst margin; an empty name where nothing is limited."""
        return min(self.shares.items(), key=lambda item: item[1], default=("", np.inf))


@dataclass(frozen=True, eq=False, kw_only=True)
class Comparison:
    """Methods side by side, each with the same budget, in the order in which they ran.

    criterion: E, A, D or c;  nats: of D-optimality, by which its J is divided to be that of a single parameter, else 0
    parameters, units, scale: of the p parameters;  nuisance: names of those that nobody asks for
    seconds, steps: the budget;  weighted: J has more terms than the criterion
    """

    source: str
    criterion: str
    nats: float
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    scale: Array
    nuisance: tuple[str, ...]
    rows: tuple[MethodResult, ...]
    seconds: float
    steps: float
    seed: int
    weighted: bool
    interrupted: bool = False

    def __post_init__(self) -> None:
        freeze(self, "scale")

    @property
    def wanted(self) -> tuple[int, ...]:
        """Places of the parameters that are no nuisance."""
        return tuple(j for j, name in enumerate(self.parameters) if name not in self.nuisance)

    @property
    def design(self) -> MethodResult | None:
        """The design, if it was reached."""
        return next((row for row in self.rows if row.method == DESIGN), None)

    @property
    def rival(self) -> MethodResult | None:
        """The best baseline that may be played."""
        others = (row for row in self.rows if row.method != DESIGN and row.sound)
        return min(others, key=lambda row: row.cost, default=None)

    @property
    def best(self) -> MethodResult | None:
        """The best of all that may be played."""
        return min((row for row in self.rows if row.sound), key=lambda row: row.cost, default=None)

    @property
    def beating(self) -> tuple[MethodResult, ...]:
        """Baselines that are better than the design, the best first."""
        ours = self.design
        if ours is None:
            return ()
        better = [
            r
            for r in self.rows
            if r.sound and r is not ours and (not ours.sound or self.gain(r, ours) > TIE_TOLERANCE)
        ]
        return tuple(sorted(better, key=lambda row: row.cost))

    def gain(self, row: MethodResult, other: MethodResult) -> float:
        """By what share of the other's J a row's is lower; of D-optimality, its geometric mean of variances."""
        if self.nats:
            return float(-np.expm1((row.cost - other.cost) / self.nats))
        return 1.0 - row.cost / other.cost

    @property
    def ok(self) -> bool:
        """All ran, the design may be played, and nothing beats it."""
        return (
            not self.interrupted
            and self.design is not None
            and self.design.sound
            and not self.beating
        )

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentences, the important one first."""
        return (
            _verdict(self),
            *(("Interrupted: only the methods shown are finished.",) if self.interrupted else ()),
        )


def _verdict(c: Comparison) -> str:
    ours, rival = c.design, c.rival
    if ours is None:
        return "The design was not reached: there is nothing to hold against it."
    if rival is None:
        return f"No baseline found a control that may be played; the design {ours.outcome.value}."
    sigmas = f"worst relative σ {ours.worst:.3g} against {rival.worst:.3g}"
    if not ours.sound:
        return f"The design {ours.outcome.value}; the best that may be played is {rival.title} ({sigmas})."
    if c.beating:
        told = ", ".join(
            f"{row.title} (J {_percent(c.gain(row, ours))} lower)" for row in c.beating
        )
        return f"The design is beaten by {told}: {sigmas}."
    won = c.gain(ours, rival)
    if won <= TIE_TOLERANCE:
        return f"The design is as good as the best baseline, {rival.title}: {sigmas}."
    return f"The design is the best: J {_percent(won)} lower than that of the best baseline, {rival.title}; {sigmas}."


def _percent(share: float) -> str:
    return f"{100.0 * share:.2g} %"
