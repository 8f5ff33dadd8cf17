"""Records that travel through the package. Arrays are read-only; shapes and units stand in each docstring.

Letters are the paper's: `x` state, `u` control, `theta` parameters, `psi` sensitivity dx/dtheta, `I` Fisher
information. Sizes: N samples, nq/nv/na MuJoCo's, `nx = 2 nv + na` (tangent space), nu controls, ny outputs, p parameters.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def freeze(record: object, *names: str) -> None:
    """Replace each named field of a frozen record by a read-only float64 array."""
    for name in names:
        array = np.array(getattr(record, name), dtype=np.float64)
        array.setflags(write=False)
        object.__setattr__(record, name, array)


def thinned(count: int, most: int) -> NDArray[np.intp]:
    """Indices of at most so many of count rows, evenly spread: what a picture can show."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.intp))


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A feasible curve (x, u) of the plant: `x_{k+1} = F(x_k, u_k, theta)`.

    t: (N+1,) [s]
    qpos: (N+1, nq) [m or rad, unit quaternions for ball and free joints]
    qvel: (N+1, nv) [m/s or rad/s]
    act: (N+1, na) [actuator's own unit]
    ctrl: (N, nu) [actuator's own unit], held over each sample
    """

    t: Array
    qpos: Array
    qvel: Array
    act: Array
    ctrl: Array

    def __post_init__(self) -> None:
        freeze(self, "t", "qpos", "qvel", "act", "ctrl")

    @property
    def samples(self) -> int:
        """N, the number of control samples."""
        return len(self.ctrl)

    @property
    def dt(self) -> float:
        """Sample period [s]."""
        return float(self.t[-1] - self.t[0]) / self.samples

    @property
    def state(self) -> Array:
        """(N+1, nq+nv+na): qpos, qvel and act side by side."""
        return np.concatenate([self.qpos, self.qvel, self.act], axis=1)


@dataclass(frozen=True, eq=False)
class Linearization:
    """First derivatives along a trajectory, in the tangent space of the state.

    A: (N, nx, nx) F_x;  B: (N, nx, nu) F_u [x-unit / u-unit];  E: (N, nx, p) F_theta [x-unit / theta-unit]
    C: (N+1, ny, nx) h_x;  D: (N+1, ny, nu) h_u;  H: (N+1, ny, p) h_theta
    """

    A: Array
    B: Array
    E: Array
    C: Array
    D: Array
    H: Array

    def __post_init__(self) -> None:
        freeze(self, "A", "B", "E", "C", "D", "H")


@dataclass(frozen=True, eq=False)
class Sensitivity:
    """What the parameters do to a trajectory at fixed control.

    psi: (N+1, nx, p) dx/dtheta [x-unit / theta-unit], zero at the start
    G: (N+1, ny, p) dy/dtheta [y-unit / theta-unit], `G_k = C_k psi_k + H_k`
    """

    psi: Array
    G: Array

    def __post_init__(self) -> None:
        freeze(self, "psi", "G")


@dataclass(frozen=True, eq=False)
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
    SMOOTHED = "converged on a smooth λ_min, used because the smallest eigenvalues meet (a local optimum)"
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


@dataclass(frozen=True)
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


@dataclass(frozen=True)
class StartResult:
    """One start of a multi-start design: its name, the cost it reached, how it ended."""

    name: str
    cost: float
    status: Status
    iterations: int


@dataclass(frozen=True)
class Combined:
    """An identifiable combination of parameters that are not so alone: its words, value and standard deviations."""

    words: str
    value: float
    initial: float
    final: float


@dataclass(frozen=True, eq=False)
class Usage:
    """How much of a limit a trajectory uses. kind: of the limit;  name: of the joint, the actuator or the nearest pair

    t: (n,) [s];  share: (n,) -1 at the lower bound, 1 at the upper one; of a clearance, the least one over what there is
    """

    kind: str
    name: str
    t: Array
    share: Array

    def __post_init__(self) -> None:
        freeze(self, "t", "share")


@dataclass(frozen=True, eq=False)
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
    usage: tuple[Usage, ...] = ()
    warnings: tuple[str, ...] = ()
    found_by: str = "initial control"
    starts: tuple[StartResult, ...] = ()
    nuisance: tuple[str, ...] = ()
    combinations: tuple[str, ...] = ()
    combined: tuple[Combined, ...] = ()
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


@dataclass(frozen=True, eq=False)
class Recording:
    """Measured (or simulated) outputs under a known control, at the times at which they were logged.

    t: (M,) [s], increasing, at any intervals;  ctrl: (M-1, nu) held from each row to the next
    y: (M, ny) measured outputs in the order of `outputs`, NaN where an output was not measured at that time
    outputs: ny column names (`qpos:<joint>`, `qvel:<joint>` or a sensor's name);  name: for messages
    """

    t: Array
    ctrl: Array
    y: Array
    outputs: tuple[str, ...]
    name: str = "recording"

    def __post_init__(self) -> None:
        freeze(self, "t", "ctrl", "y")


@dataclass(frozen=True, eq=False)
class TrialSet:
    """Monte-Carlo estimates along one trajectory, against theory.

    estimates: (trials, p), NaN rows for failed trials;  mean: (p,);  covariance, crlb: (p, p)
    efficiency: (p,) CRLB variance over observed variance (1 = the bound is reached)
    efficiency_interval: (p, 2) 95 % confidence interval of each efficiency (chi-square on the variance)
    """

    estimates: Array
    mean: Array
    covariance: Array
    crlb: Array
    efficiency: Array
    efficiency_interval: Array
    trials: int
    failed: int
    seconds: float = 0.0

    def __post_init__(self) -> None:
        freeze(self, "estimates", "mean", "covariance", "crlb", "efficiency", "efficiency_interval")


@dataclass(frozen=True, eq=False)
class Study:
    """Monte-Carlo studies of trajectories by name (`initial`, `final`).

    theta: (p,) the true values; information: (p, p) by the same names
    """

    parameters: tuple[str, ...]
    theta: Array
    measure_rate: float
    sets: dict[str, TrialSet]
    information: dict[str, Array]

    def __post_init__(self) -> None:
        freeze(self, "theta")
