"""Records of a design, its iterates, its information and its limits."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import field, replace
from typing import Any

import numpy as np

from mjfim.arrays import Array, finite_or_nan, record, scaled_pseudo_inverse
from mjfim.errors import MjfimError
from mjfim.records.base import (
    NamedEnum,
    ParameterResult,
    ParameterValue,
    Record,
    SavedRecord,
    ShownRecord,
    listed_values,
    no_array,
)
from mjfim.records.rehearsal import Rehearsal, Valley
from mjfim.records.trajectory import Labels, Trajectory
from mjfim.records.worth import Worth

# Relative difference of two costs J, or of two σ, below which they count as equal.
TIE_TOLERANCE = 2e-2

# Largest number of iterates of one search whose motions are kept, and number of samples of each.
MAX_MOTIONS, MOTION_SAMPLES = 40, 200


# Motion of one iterate at `MOTION_SAMPLES` evenly spread samples: (n,) times [s], (n, nq) positions
# [m or rad; unit quaternions for ball and free joints], and (n, nu) controls, of which the last one
# is repeated at the end [unit of the actuator].
IterateMotion = tuple[Array, Array, Array]


def iterate_motion(trajectory: Trajectory | None) -> IterateMotion | None:
    """Thin the trajectory of an iterate.

    Args:
        trajectory: The trajectory; None for an iterate whose simulation diverged.

    Returns:
        The motion; None without a trajectory, and where it is not finite.
    """
    if trajectory is None or not np.isfinite(trajectory.qpos).all():
        return None

    # A trajectory with fewer samples repeats some, so that all motions have the same size.
    last = trajectory.samples
    rows = np.linspace(0, last, MOTION_SAMPLES).round().astype(np.intp)
    ctrl = trajectory.ctrl[np.minimum(rows, last - 1)]
    return _drawn(trajectory.t[rows]), _drawn(trajectory.qpos[rows]), _drawn(ctrl)


def _drawn(values: Array) -> Array:
    """Values with the digits that a picture needs, so that files are small."""
    # What is too large for this type is drawn nowhere.
    with np.errstate(over="ignore"):
        return values.astype(np.float32).astype(np.float64)


@record
class IterateMotions(Record):
    """Motions of m iterates of a design, with n samples each.

    Attributes:
        iteration: (m,) ascending numbers of the iterates.
        t: (m, n) times [s].
        qpos: (m, n, nq) positions [m or rad; unit quaternions for ball and free joints].
        ctrl: (m, n, nu) controls [unit of the actuator].
    """

    iteration: Array
    t: Array
    qpos: Array
    ctrl: Array

    @classmethod
    def of(cls, motions: Sequence[tuple[int, IterateMotion]]) -> IterateMotions | None:
        """Join motions.

        Args:
            motions: Number and motion of each iterate, ascending.

        Returns:
            The motions; None if there are none.
        """
        if not motions:
            return None
        t, qpos, ctrl = map(np.stack, zip(*(motion for _, motion in motions), strict=True))
        iterations = np.array([iteration for iteration, _ in motions], dtype=np.float64)
        return cls(iteration=iterations, t=t, qpos=qpos, ctrl=ctrl)


# When a controller should use the gains, for design.json and the player.
GAIN_NOTE = (
    "Gains are for u = ctrl + gain (planned state - measured state). Use them where small errors "
    "grow along the motion (torque control without servos; mjfim design warns about it) and the "
    "state is measured with little noise and delay. Leave them out where position servos correct "
    "errors already. Record the control that was really sent in both cases."
)


# Number of iterations at the end of a search over which its improvement is measured.
IMPROVEMENT_WINDOW = 10


# Eigenvalues of an information of unit diagonal below this share of the largest one count as zero.
SMALLEST_EIGENVALUE = 1e-13

# Smallest improvement per iteration that is stated as a number.
LEAST_IMPROVEMENT = 1e-4


# Fields of a trajectory whose names are also names of arrays in design.npz.
TRAJECTORY_ARRAYS = ("t", "qpos", "qvel", "act", "ctrl")


@record
class Evaluation(SavedRecord):
    """A trajectory and the information that it gives about the parameters.

    Attributes:
        trajectory: The trajectory.
        gain: (N, nu, nx) regulator K about the trajectory [u-unit / x-unit].
        sensitivity: (N+1, nx, p) psi [x-unit / theta-unit].
        information: (p, p) Fisher information, summed over the measured samples [1 / (unit of
            theta_i times unit of theta_j)].
        eigenvalues: (s,) ascending eigenvalues of the information per second that the cost uses:
            scaled, with nuisance parameters marginalised, for identifiable combinations only.
        std: (p,) Cramér-Rao standard deviations [theta-unit]; infinite if a parameter is not
            identifiable alone.
        std_over_time: (N+1, p) standard deviations from the prior and the measurements up to each
            sample [theta-unit]; the last row is `std`.
        criterion: phi, the information term of the cost.
        cost: J.
        growth: Largest open-loop amplification of a small deviation along the trajectory; NaN if
            it was not computed.
    """

    trajectory: Trajectory
    gain: Array
    sensitivity: Array
    information: Array
    eigenvalues: Array
    std: Array
    std_over_time: Array
    criterion: float
    cost: float
    growth: float = float("nan")

    file_stem = "evaluation"
    made_by = "Evaluation.save"
    in_json = (
        "cost",
        "criterion",
        "growth",
        "information",
        "eigenvalues",
        "std",
    )


class Status(NamedEnum):
    """Outcome of an optimisation; the value is a sentence for the user."""

    CONVERGED = "converged: the slope fell below tolerance × cost (a local optimum)"
    SMOOTHED = (
        "converged on a smooth λ_min, used because the smallest eigenvalues meet (a local optimum)"
    )
    RELEASE_FOUND = "converged: no release nearby tells more, the best of a search over all ranges"
    STALLED = (
        "stalled: no step along the descent direction lowers the cost any more, "
        "within the accuracy of the finite differences"
    )
    MAX_ITERATIONS = "stopped at its budget (max_iterations or seconds) before convergence"
    BEST_SEEN = (
        "ended without convergence: this is the best trajectory that was found; later ones cost "
        "more or left the limits"
    )
    INFEASIBLE = (
        "found no trajectory that keeps all limits; the margins show which limit is violated: "
        "widen it, or begin with an initial control of smaller amplitude"
    )
    LEFT = "discarded: another start was more promising"
    INTERRUPTED = "interrupted by the user; this is the best trajectory so far"

    @property
    def success(self) -> bool:
        """True if the result is a (local) optimum to the requested tolerance."""
        return self in (Status.CONVERGED, Status.SMOOTHED, Status.RELEASE_FOUND)


@record
class HistoryRow(Record):
    """One iterate of a design.

    Attributes:
        iteration: Number of the iterate, from 0.
        cost: J.
        criterion: phi, the information term of the cost.
        min_eigenvalue: Smallest eigenvalue of the information per second that the cost uses.
        slope: |DJ . zeta|, predicted change of the cost for a full step.
        gamma: Step length that led to this iterate.
        seconds: Wall time since the optimisation began [s].
        steps: MuJoCo steps since the optimisation began.
        rate: Sample rate of the plant of this iterate [Hz]; lower than stated on a coarse plant.
        mu: Weight of the barrier of hard limits; 0 without limits.
        margin: Worst margin divided by half of its range; NaN without limits.
        margins: The same for the limits of each kind, such as "position".
        motion: Thinned motion of the iterate; None where it diverged, or where the search no longer
            keeps it. In a `Design` they stand in `motions` instead.
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
    margins: dict[str, float] = field(default_factory=dict, hash=False)
    motion: IterateMotion | None = field(default=None, compare=False, repr=False)


def extended(history: tuple[HistoryRow, ...], rows: Iterable[HistoryRow]) -> tuple[HistoryRow, ...]:
    """Append iterates to a history, of which at most `MAX_MOTIONS` keep their motions."""
    joined = [*history, *rows]
    moving = [place for place, row in enumerate(joined) if row.motion is not None]
    while len(moving) > MAX_MOTIONS:
        # The iterate between the nearest neighbours goes; the first and the last one stay.
        numbers = np.array([joined[place].iteration for place in moving])
        place = moving.pop(1 + np.argmin(numbers[2:] - numbers[:-2]))
        joined[place] = replace(joined[place], motion=None)
    return tuple(joined)


def without_motions(
    history: Iterable[HistoryRow],
) -> tuple[tuple[HistoryRow, ...], IterateMotions | None]:
    """Separate the motions from a history.

    Returns:
        The iterates without motions, and the motions of those that had one; None without any.
    """
    rows = extended((), history)
    motions = [(row.iteration, row.motion) for row in rows if row.motion is not None]
    return tuple(replace(row, motion=None) for row in rows), IterateMotions.of(motions)


def improvement_per_iteration(history: Sequence[HistoryRow], size: float) -> float:
    """Share by which the last iterations of a search lowered the cost, per iteration.

    Args:
        history: Iterates of the search. Those outside the limits, and of other samples than the
            last one, do not count.
        size: Size of the last cost, above zero.

    Returns:
        The share, 0 or more; NaN where it cannot be measured.
    """
    counted = [
        row
        for row in history
        if row.rate == history[-1].rate and np.isfinite(row.cost) and not row.margin < 0.0
    ]
    if len(counted) < 2 or not 0.0 < size < np.inf:
        return float("nan")
    # The best iterate before the window; the first one where the search was shorter.
    end = counted[-1].iteration
    before = [row for row in counted if row.iteration <= end - IMPROVEMENT_WINDOW] or counted[:1]
    # A new stage of the barrier begins with the last iterate of the stage before.
    iterations = end - before[-1].iteration
    if iterations == 0:
        return float("nan")
    fall = min(row.cost for row in before) - min(row.cost for row in counted)
    return float(1.0 - (1.0 + fall / size) ** (-1.0 / iterations))


def round_share(share: float) -> float:
    """Smallest 1, 2 or 5 times a power of ten that is not below a share."""
    power = 10.0 ** np.floor(np.log10(share))
    rounded = (factor * power for factor in (1.0, 2.0, 5.0, 10.0))
    return float(next(each for each in rounded if each >= share))


@record
class StartResult(Record):
    """Result of one initial control of a multistart design.

    Attributes:
        name: Name of the initial control.
        cost: J at the end of the optimisation from it.
        status: How this optimisation ended.
        iterations: Number of iterations.
    """

    name: str
    cost: float
    status: Status
    iterations: int


@record
class LimitUsage(Record):
    """Position of a trajectory between the two bounds of one limit.

    Attributes:
        kind: Kind of the limit: "position", "velocity", "control", "clearance", ...
        name: Name of the joint, of the actuator or of the nearest pair of geoms.
        t: (n,) times [s].
        share: (n,) relative position between the bounds: -1 at the lower bound, 1 at the upper one.
            For a clearance: the required distance over the distance.
        lower: Lower bound; -inf where there is none, or where it is unknown [unit of the kind].
        upper: Upper bound, likewise inf.
    """

    kind: str
    name: str
    t: Array
    share: Array
    lower: float = -np.inf
    upper: float = np.inf


@record
class LimitViolation(Record):
    """A limit that a trajectory violates.

    Attributes:
        kind: Kind of the limit: "position", "velocity", "control", "end_position", ...
        name: Name of the joint, the actuator or the nearest pair of geoms; "final state" for the
            tolerances of the boundary.
        since: Time at which it is violated first [s].
        t: Time at which the violation is largest [s].
        value: The limited quantity at this time [unit of the kind]; for the final state, the
            largest deviation.
        lower: Lower bound, or None [unit of the kind].
        upper: Upper bound, or None [unit of the kind].
        unit: Unit of the limited quantity; empty where it is unknown.
        clamped: True for a force that the model clamps at its limit; the value is that without the
            clamp.
    """

    kind: str
    name: str
    since: float
    t: float
    value: float
    lower: float | None
    upper: float | None
    unit: str = ""
    clamped: bool = False

    def __str__(self) -> str:
        is_above = self.upper is not None and self.value > self.upper
        side, bound = ("above", self.upper) if is_above else ("below", self.lower)
        quantity = " ".join([f"{self.value:.4g}", *([self.unit] if self.unit else [])])
        limit = "its limit" if bound is None else f"{bound:.4g}"
        verb, clamp = ("would be", " without its clamp") if self.clamped else ("is", "")
        return (
            f"{self.kind.replace('_', ' ')} of {self.name} {verb} {quantity} at {self.t:.4g} s"
            f"{clamp}, {side} {limit} (first at {self.since:.4g} s)"
        )


@record
class ScaledStart(Record):
    """The largest share of an initial control outside limits that keeps all of them.

    The initial control is scaled about a control that holds the start, or nearly does.

    Attributes:
        share: The share, between 0 and 1.
        cost: J along the scaled control.
        min_eigenvalue: Smallest eigenvalue of its information per second that the cost uses.
    """

    share: float
    cost: float
    min_eigenvalue: float


def _npz_names() -> dict[str, str]:
    """Return the short names of arrays in design.npz, by path in the record."""
    paths = (*(f"trajectory.{name}" for name in TRAJECTORY_ARRAYS), "gain", "sensitivity")
    return {
        f"{evaluation}.{path}": prefix + path.rpartition(".")[2]
        for evaluation, prefix in (("final", ""), ("initial", "initial_"))
        for path in paths
    }


@record
class Design(ParameterResult):
    """Result of `mjfim.design`: the designed trajectory and the initial one.

    It is saved as design.json and design.npz, and `Design.load` reads design.npz. The arrays of the
    designed trajectory are named t, qpos, qvel, act, ctrl, gain and sensitivity in design.npz;
    those of the initial trajectory have the prefix `initial_`.

    Attributes:
        status: How the optimisation ended.
        parameters: Names of the p parameters.
        theta: (p,) parameters at which the design was made [theta-unit].
        initial: The initial trajectory and its information.
        final: The designed trajectory and its information.
        history: The iterates.
        slope: Last |DJ . zeta|.
        steps: MuJoCo steps taken.
        seconds: Wall time [s].
        limits: Worst margin per kind of limit, positive inside [unit of the limit].
        usage: Position between the bounds of every limit, at every engine step.
        initial_violations: Limits that the initial trajectory violates.
        scaled_start: The largest share of the initial control that keeps all limits with the
            reserve, where the initial control does not; None where it does, or where no share does.
        warnings: Sentences for the user.
        found_by: Name of the initial control that led to the design.
        starts: Results of all initial controls.
        nuisance: Names of the nuisance parameters.
        combinations: Groups of parameters that are not identifiable alone, in words.
        combined: The identifiable combinations of these groups, such as `m + 2 l`, with σ after
            the designed experiment, and σ after the initial one as `std_initial`.
        prior: (p, p) information known before this experiment [1 / (unit of theta_i times unit of
            theta_j)].
        data: (p, p) information of this experiment alone, in which nuisance parameters that
            belong to a single experiment are marginalised.
        labels: Names and units for figures and tables.
        sizes: (p,) sizes of which standard deviations are a share: magnitudes of the values, or of
            the whole vectors or tensors of which they are entries [theta-unit]. Default: the
            magnitudes of the values.
        motions: Thinned motions of at most `MAX_MOTIONS` iterates; None if none was kept.
        improvement: Share by which each of the last iterations lowered the cost; for D-optimality
            relative to one nat per parameter. NaN where it is unknown.
        rehearsal: What the design does to the model and to simulated robots; None where it was
            interrupted before.
        worth: What each sensor tells along the designed trajectory, and what each limit costs;
            None where the search was interrupted.
        valley: Two robots that the initial motion does not tell apart, in both motions; None where
            the initial motion determines well what the designed one determines.
        inflation: (p,) factors by which residuals like those of earlier estimates widen σ; empty
            where σ assumes white noise.
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
    initial_violations: tuple[LimitViolation, ...] = ()
    scaled_start: ScaledStart | None = None
    warnings: tuple[str, ...] = ()
    found_by: str = "initial control"
    starts: tuple[StartResult, ...] = ()
    nuisance: tuple[str, ...] = ()
    combinations: tuple[str, ...] = ()
    combined: tuple[ParameterValue, ...] = ()
    prior: Array = no_array(0, 0)
    data: Array = no_array(0, 0)
    labels: Labels
    sizes: Array = no_array()
    motions: IterateMotions | None = None
    improvement: float = float("nan")
    rehearsal: Rehearsal | None = None
    worth: Worth | None = None
    valley: Valley | None = None
    inflation: Array = no_array()

    file_stem = "design"
    made_by = "`mjfim design EXPERIMENT -o DIR`"
    array_names = _npz_names()
    in_json = (
        "status",
        "outcome",
        "improvement",
        "iterations",
        "seconds",
        "slope",
        "steps",
        "parameters",
        "theta",
        "sizes",
        "initial",
        "final",
        "scaled_start",
        "found_by",
        "starts",
        "warnings",
        "nuisance",
        "combinations",
        "combined",
        "prior",
        "data",
        "rehearsal",
        "worth",
        "valley",
        "inflation",
        "reserve",
    )
    json_names = {"outcome": "message"}

    def __post_init__(self) -> None:
        if not len(self.sizes):
            object.__setattr__(self, "sizes", np.abs(self.theta))
        super().__post_init__()

    @property
    def reserve(self) -> dict[str, float]:
        """Key `limits.reserve` that the search kept, also where it was found automatically."""
        kept = None if self.rehearsal is None else self.rehearsal.kept_reserve
        return kept or {}

    @property
    def wanted(self) -> tuple[int, ...]:
        """Indices of the parameters that are not nuisance parameters."""
        return tuple(j for j, name in enumerate(self.parameters) if name not in self.nuisance)

    @property
    def outcome(self) -> str:
        """The end of the optimisation in a sentence; at its budget, with the last improvement."""
        sentence = self.status.value
        if self.status is not Status.MAX_ITERATIONS or not np.isfinite(self.improvement):
            return sentence

        share = f"still improving by {min(100.0 * self.improvement, 99.0):.2g} % per iteration"
        if self.improvement < LEAST_IMPROVEMENT:
            share = "hardly improving any more"
        return sentence.replace(" before convergence", f", {share}")

    @property
    def is_start(self) -> bool:
        """True if the cost and σ are, within 2 %, those of a start that keeps all limits."""
        start = self.scaled_start
        if start is not None:
            # What keeps them, with the reserve, is the scaled initial control.
            before = [start.cost, start.min_eigenvalue**0.5]
            after = [self.final.cost, float(self.final.eigenvalues[0]) ** 0.5]
            return np.allclose(before, after, rtol=TIE_TOLERANCE, atol=0.0)
        if self.initial_violations:
            return False

        wanted = list(self.wanted)
        before = [self.initial.cost, *self.initial.std[wanted]]
        after = [self.final.cost, *self.final.std[wanted]]
        before += [each.further["std_initial"] for each in self.combined]
        after += [each.std for each in self.combined]
        return np.allclose(before, after, rtol=TIE_TOLERANCE, atol=0.0)

    @property
    def stated_std(self) -> Array:
        """(p,) standard deviations to state: by finite steps where derivatives are wrong."""
        return self.final.std if self.rehearsal is None else self.rehearsal.steps.stated

    @property
    def std_over_time(self) -> Array:
        """(N+1, p) standard deviations to state, by the measurements up to each sample."""
        std = self.final.std
        ratio = np.divide(self.stated_std, std, out=np.ones(len(std)), where=np.isfinite(std))
        return self.final.std_over_time * ratio

    @property
    def covariance(self) -> Array:
        """(p, p) predicted covariance; NaN where a parameter is not identifiable alone."""
        inverse = scaled_pseudo_inverse(self.final.information, SMALLEST_EIGENVALUE)
        spread = np.sqrt(np.maximum(np.diag(inverse), np.finfo(float).tiny))
        std = finite_or_nan(self.stated_std) / spread
        return inverse * np.outer(std, std)

    @property
    def shares(self) -> Array:
        """(p,) what is one hundred percent: the sizes; NaN where the value is 0."""
        return np.where(self.theta == 0.0, np.nan, self.sizes)

    @property
    def targets(self) -> Array:
        """(p,) standard deviations to reach: the wanted ones [theta-unit].

        Where none is stated, the smallest share 1, 2 or 5 times a power of ten that all parameters
        reach which are determined. Infinite for parameters that are not asked for.
        """
        wanted = self.labels.wanted
        if np.isfinite(wanted).any():
            return wanted
        is_asked = np.isin(self.parameters, self.nuisance, invert=True)
        sizes = np.where(is_asked, self.shares, np.nan)
        share = self.stated_std / sizes
        if not (share < 1.0).any():
            return wanted
        return np.nan_to_num(round_share(share[share < 1.0].max()) * sizes, nan=np.inf)

    def seconds_to(self, targets: Array) -> Array:
        """Return the time after which each parameter is known as well as a target.

        Args:
            targets: (p,) standard deviations [theta-unit].

        Returns:
            (p,) times from the beginning [s]; infinite where the design does not reach a target.
        """
        is_reached = self.std_over_time <= targets
        t = self.trajectory.t - self.trajectory.t[0]
        return np.where(is_reached.any(axis=0), t[np.argmax(is_reached, axis=0)], np.inf)

    def compare(self, other: Design) -> DesignComparison:
        """Compare σ of this design with σ of another one, by the names of the parameters.

        Raises:
            MjfimError: The other one is no design, or has none of the parameters.
        """
        if not isinstance(other, Design):
            raise MjfimError(f"compare takes another Design, not a {type(other).__name__}")
        if not set(self.parameters) & set(other.parameters):
            raise MjfimError("the two designs have no parameter in common")
        return DesignComparison(design=self, other=other)

    def each(self) -> Iterator[ParameterValue]:
        """Values at which σ is predicted, with σ of the initial and of the designed motion."""
        return listed_values(
            self.parameters,
            self.labels.parameter_units,
            self.theta,
            self.stated_std,
            self.labels.targets,
            std_initial=self.initial.std,
        )

    @property
    def rows(self) -> list[ParameterValue]:
        """The wanted parameters and the combinations of others, with σ of both motions."""
        every = list(self.each())
        return [*(every[j] for j in self.wanted), *self.combined]

    @property
    def iterations(self) -> int:
        """Number of the last iterate; 0 if there is none."""
        return self.history[-1].iteration if self.history else 0

    @property
    def trajectory(self) -> Trajectory:
        """The designed trajectory."""
        return self.final.trajectory

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON."""
        targets = self.targets
        seconds = self.seconds_to(targets).tolist()
        return {
            **super().summary(),
            "reached": {
                self.parameters[j]: {"std": float(targets[j]), "seconds": seconds[j]}
                for j in np.flatnonzero(np.isfinite(targets)).tolist()
            },
            "gains": GAIN_NOTE,
            "combined": [
                {
                    "words": each.name,
                    "value": each.value,
                    "std_initial": each.further["std_initial"],
                    "std_final": each.std,
                }
                for each in self.combined
            ],
            "limits": {
                "margins": self.limits,
                "satisfied": keeps_limits(self),
                "initial": [violation.summary() for violation in self.initial_violations],
            },
        }


@record
class DesignComparison(ShownRecord):
    """Result of `Design.compare`: the accuracy that two designs predict.

    Attributes:
        design: The design that was asked.
        other: The design with which it is compared.
    """

    design: Design
    other: Design

    file_stem = "designs"
    made_by = "`Design.compare`"


def is_playable(design: Design) -> bool:
    """Whether a person would play a design on a robot, by which a search chooses among several.

    The optimisation converged, or it found a trajectory other than the initial one. The trajectory
    keeps all limits, and the rehearsal found no danger to robots that differ from the model.
    """
    is_safe = design.rehearsal is None or design.rehearsal.is_safe
    is_useful = design.status.success or not design.is_start
    is_finished = design.status is not Status.INTERRUPTED
    return is_finished and keeps_limits(design) and is_safe and is_useful


def keeps_limits(design: Design) -> bool:
    """Whether no margin of a design is negative."""
    return all(margin >= 0.0 for margin in design.limits.values())
