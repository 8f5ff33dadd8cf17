"""Records of a design: its iterates, its information before and after, its limits."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from mjfim.arrays import Array, freeze
from mjfim.records.trajectory import Trajectory


@dataclass(frozen=True, eq=False, kw_only=True)
class Evaluation:
    """A trajectory and what it tells about the parameters.

    gain: (N, nu, nx) regulator K about the trajectory
    sensitivity: psi, (N+1, nx, p)
    information: (p, p) Fisher information, summed over the measured samples [1 / (theta_i theta_j unit)]
    eigenvalues: (s,) ascending, of the information per second that the cost sees (scaled, nuisance removed, identifiable
    combinations only)
    std: (p,) Cramer-Rao standard deviations, infinite where a parameter cannot be told alone
    min_eigenvalue: (N+1,) smallest eigenvalue of the information (per second) accumulated up to each sample
    criterion: phi, the information term of the cost;  cost: J
    growth: largest open-loop amplification of a small deviation along the trajectory (NaN: not computed)
    """

    trajectory: Trajectory
    gain: Array
    sensitivity: Array
    information: Array
    eigenvalues: Array
    std: Array
    min_eigenvalue: Array
    criterion: float
    cost: float
    growth: float = float("nan")

    def __post_init__(self) -> None:
        freeze(self, "gain", "sensitivity", "information", "eigenvalues", "std", "min_eigenvalue")


class Status(Enum):
    """How an optimisation ended; the value is a sentence for the user."""

    CONVERGED = "converged: the slope fell below tolerance × cost (a local optimum)"
    SMOOTHED = (
        "converged on a smooth λ_min, used because the smallest eigenvalues meet (a local optimum)"
    )
    ROUGH = "ended where derivatives hardly exist (contact, dry friction or clamps): the numbers are indications, see warnings"
    STALLED = "stalled: no step along the descent lowers the cost any more, at the accuracy of the differences"
    MAX_ITERATIONS = "stopped at max_iterations or seconds before convergence; raise them, or start from the result"
    INFEASIBLE = "found nothing that keeps all limits; the margins say which is missed: widen it, or start more gently"
    LEFT = "left behind for a start that promised more"
    INTERRUPTED = "interrupted by the user; this is the best trajectory so far"

    @property
    def success(self) -> bool:
        """True where the result is a (local) optimum to the wanted tolerance."""
        return self in (Status.CONVERGED, Status.SMOOTHED)


@dataclass(frozen=True, kw_only=True)
class HistoryRow:
    """One iterate of a design: cost J, criterion phi, smallest eigenvalue, slope |DJ.zeta|, step length gamma.

    seconds, steps: wall time and MuJoCo steps since the start;  rate: sample rate of this level [Hz] (coarse-to-fine)
    mu: weight of the barrier of hard limits, 0 without;  margin: the worst one over half of its range, NaN without
    """

    iteration: int
    cost: float
    criterion: float
    min_eigenvalue: float
    slope: float
    gamma: float
    seconds: float
    steps: int
    rate: float = 0.0
    mu: float = 0.0
    margin: float = float("nan")


@dataclass(frozen=True, kw_only=True)
class StartResult:
    """One start of a multi-start design: its name, the cost it reached, how it ended."""

    name: str
    cost: float
    status: Status
    iterations: int


@dataclass(frozen=True, kw_only=True)
class CombinationAccuracy:
    """An identifiable combination of parameters that are not so alone: its words, value and standard deviations."""

    expression: str
    value: float
    std_initial: float
    std_final: float


@dataclass(frozen=True, eq=False, kw_only=True)
class LimitUsage:
    """How much of a limit a trajectory uses. kind: of the limit;  name: of the joint, the actuator or the nearest pair

    t: (n,) [s];  share: (n,) -1 at the lower bound, 1 at the upper one; of a clearance, the least one over what there is
    """

    kind: str
    name: str
    t: Array
    share: Array

    def __post_init__(self) -> None:
        freeze(self, "t", "share")


@dataclass(frozen=True, eq=False, kw_only=True)
class Design:
    """Result of `mjfim.design`: the designed trajectory beside the one it started from.

    parameters: p names;  theta: (p,) where the design was made
    slope: last |DJ.zeta|;  steps: MuJoCo steps taken;  seconds: wall time
    limits: worst margin per kind of limit (positive = inside), by kind;  usage: of every limit at every engine step
    warnings: sentences for the user
    found_by: name of the start that led here;  starts: all of them
    nuisance: names of the parameters that the design did not look at
    combinations: groups of parameters that are not identifiable alone, in words;  combined: what is identifiable of them
    prior: (p, p) information put in;  data: (p, p) information of this experiment alone, its private nuisance marginalised
    """

    status: Status
    parameters: tuple[str, ...]
    theta: Array
    initial: Evaluation
    final: Evaluation
    history: tuple[HistoryRow, ...]
    slope: float
    steps: int
    seconds: float
    limits: dict[str, float] = field(default_factory=dict)
    usage: tuple[LimitUsage, ...] = ()
    warnings: tuple[str, ...] = ()
    found_by: str = "initial control"
    starts: tuple[StartResult, ...] = ()
    nuisance: tuple[str, ...] = ()
    combinations: tuple[str, ...] = ()
    combined: tuple[CombinationAccuracy, ...] = ()
    prior: Array = field(default_factory=lambda: np.zeros((0, 0)))
    data: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        freeze(self, "theta", "prior", "data")

    @property
    def wanted(self) -> tuple[int, ...]:
        """Places of the parameters that are no nuisance."""
        return tuple(j for j, name in enumerate(self.parameters) if name not in self.nuisance)

    @property
    def success(self) -> bool:
        """Converged and inside all limits."""
        return self.status.success and all(margin >= 0.0 for margin in self.limits.values())

    @property
    def trajectory(self) -> Trajectory:
        """The designed trajectory."""
        return self.final.trajectory
