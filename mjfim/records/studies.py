"""Records of studies: methods of design, many trials of the estimator, and campaigns of rounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field
from typing import Any

import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import first_ones
from mjfim.records.base import NamedEnum, Record, ShownRecord, no_array
from mjfim.records.design import TIE_TOLERANCE, Design
from mjfim.records.estimate import Estimate
from mjfim.records.trajectory import Labels, Recording

# Key of mjfim's own design among the methods.
DESIGN = "design"


class MethodOutcome(NamedEnum):
    """Outcome of a method; the value is a verb phrase for the user."""

    INSIDE = "keeps all limits"
    OUTSIDE = "violates a limit"
    NOTHING = "found no control that keeps all limits"
    CLAMPED = "relies on saturated actuators"
    NONE = "had no time for a single evaluation"


@record
class MethodResult(Record):
    """The best control that one method found. All numbers are NaN if it found none.

    The search of a baseline states the method, the control, its cost and how it was found.

    Attributes:
        method: Key of the method.
        title: Name of the method in reports.
        outcome: Outcome of the method.
        control: (N, nu) control, or None [unit of the actuator].
        cost: J.
        criterion: phi, the information term of the cost.
        std: (p,) Cramér-Rao standard deviations [theta-unit].
        min_eigenvalue: Smallest eigenvalue of the information per second that the criterion uses.
        worst_relative_std: `(lambda_min(S I S))^-1/2`: standard deviation of the worst combination
            of parameters, relative to their scales S.
        seconds: Wall time [s].
        steps: MuJoCo steps taken.
        margins: Worst margin of each kind of limit [unit of the limit].
        relative_margins: These margins divided by half of the limits' ranges.
        found_by: Name of the attempt that led to the control.
        note: Remark about the result; may be empty.
    """

    method: str
    title: str = ""
    outcome: MethodOutcome = MethodOutcome.NONE
    control: Array | None = None
    cost: float = np.nan
    criterion: float = np.nan
    std: Array = no_array()
    min_eigenvalue: float = np.nan
    worst_relative_std: float = np.nan
    seconds: float = 0.0
    steps: int = 0
    margins: dict[str, float] = field(default_factory=dict)
    relative_margins: dict[str, float] = field(default_factory=dict)
    found_by: str = ""
    note: str = ""

    in_json = (
        "method",
        "title",
        "outcome",
        "outcome.value",
        "cost",
        "criterion",
        "min_eigenvalue",
        "worst_relative_std",
        "std",
        "seconds",
        "steps",
        "found_by",
        "note",
    )
    json_names = {
        "outcome.value": "message",
        "min_eigenvalue": "smallest_eigenvalue",
        "worst_relative_std": "worst_relative_sigma",
    }

    @property
    def sound(self) -> bool:
        """True if the control keeps all limits without relying on saturated actuators."""
        return self.outcome is MethodOutcome.INSIDE

    @property
    def tightest(self) -> tuple[str, float]:
        """Kind and relative size of the smallest margin; an empty kind without limits."""
        return min(self.relative_margins.items(), key=lambda item: item[1], default=("", np.inf))

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON."""
        return {
            **super().summary(),
            "limits": {"margins": self.margins, "shares": self.relative_margins},
        }


@record
class Comparison(ShownRecord):
    """Result of `mjfim.compare`: methods in the order in which they ran, all with equal budgets.

    Attributes:
        source: Name of the experiment.
        criterion: "E", "A", "D" or "c".
        nats: For D-optimality, the number by which differences of J are divided to obtain the
            change per parameter; 0 for other criteria.
        parameters: Names of the p parameters.
        units: Units of the parameters.
        scale: (p,) scales of the parameters [theta-unit].
        nuisance: Names of the nuisance parameters.
        rows: Result of each method.
        seconds: Time that each method had [s].
        seed: Seed of the random numbers.
        weighted: True if J has further terms besides the criterion.
        interrupted: True if the user interrupted the comparison.
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
    seed: int
    weighted: bool
    interrupted: bool = False

    file_stem = "compare"
    made_by = "`mjfim compare EXPERIMENT -o DIR`"
    in_json = (
        "verdict.ok",
        "findings",
        "interrupted",
        "criterion",
        "seed",
        "parameters",
        "units",
        "scale",
        "nuisance",
        "rows",
    )
    json_names = {"findings": "verdict", "rows": "methods"}

    @property
    def wanted(self) -> tuple[int, ...]:
        """Indices of the parameters that are not nuisance parameters."""
        return tuple(j for j, name in enumerate(self.parameters) if name not in self.nuisance)

    @property
    def design(self) -> MethodResult | None:
        """Result of mjfim's own design; None if the comparison ended before it."""
        return next((row for row in self.rows if row.method == DESIGN), None)

    @property
    def rival(self) -> MethodResult | None:
        """The best sound result of a baseline; None if there is none."""
        baselines = (row for row in self.rows if row.method != DESIGN and row.sound)
        return min(baselines, key=lambda row: row.cost, default=None)

    @property
    def best(self) -> MethodResult | None:
        """The best sound result of all methods, including the design; None if there is none."""
        return min((row for row in self.rows if row.sound), key=lambda row: row.cost, default=None)

    @property
    def beating(self) -> tuple[MethodResult, ...]:
        """Baselines with sound results that are better than the design, the best first."""
        design = self.design
        if design is None:
            return ()

        better = [
            row
            for row in self.rows
            if row is not design
            and row.sound
            and (not design.sound or self.gain(row, design) > TIE_TOLERANCE)
        ]
        return tuple(sorted(better, key=lambda row: row.cost))

    def gain(self, row: MethodResult, other: MethodResult) -> float:
        """Return the fraction by which the J of one result is lower than that of another.

        Args:
            row: The result with the lower J.
            other: The result with which it is compared.

        Returns:
            Fraction of the J of `other`. For D-optimality, fraction of the geometric mean of its
            variances.
        """
        if self.nats:
            return float(-np.expm1((row.cost - other.cost) / self.nats))
        return 1.0 - row.cost / other.cost

    @property
    def findings(self) -> tuple[str, ...]:
        """What was found, in sentences, the most important one first."""
        sentences = [_is_best(self)]
        if self.interrupted:
            sentences.append(
                "Interrupted: methods are missing, or have not used their whole budget."
            )
        return tuple(sentences)

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON."""
        return {
            **super().summary(),
            "budget": {"seconds": self.seconds},
            "best": None if self.best is None else self.best.method,
            "beating": [row.method for row in self.beating],
        }


def _is_best(comparison: Comparison) -> str:
    """Return a sentence that says whether the design is the best."""
    design = comparison.design
    rival = comparison.rival

    # Without a design, or without a sound baseline, there is nothing to compare.
    if design is None:
        return "The design was not run, so there is nothing to compare the baselines with."
    if rival is None:
        return (
            f"No baseline found a control that keeps all limits; the design {design.outcome.value}."
        )

    sigmas = (
        f"worst relative σ {design.worst_relative_std:.3g} against {rival.worst_relative_std:.3g}"
    )
    if not design.sound:
        return (
            f"The design {design.outcome.value}; the best control that may be used is from "
            f"{rival.title} ({sigmas})."
        )

    if comparison.beating:
        better = ", ".join(
            f"{row.title} (J {_percent(comparison.gain(row, design))} lower)"
            for row in comparison.beating
        )
        return f"The design is beaten by {better}: {sigmas}."

    gain = comparison.gain(design, rival)
    if gain <= TIE_TOLERANCE:
        return f"The design is as good as the best baseline, {rival.title}: {sigmas}."
    return (
        f"The design is the best: J {_percent(gain)} lower than that of the best baseline, "
        f"{rival.title}; {sigmas}."
    )


def _percent(fraction: float) -> str:
    return f"{100.0 * fraction:.2g} %"


@record
class TrialStatistics(Record):
    """Estimates from simulated recordings of one trajectory, and the Cramér-Rao bound.

    Attributes:
        estimates: (trials, p) estimated parameters; rows of NaN for failed trials.
        mean: (p,) mean of the estimates.
        covariance: (p, p) sample covariance of the estimates.
        crlb: (p, p) Cramér-Rao lower bound of the covariance.
        efficiency: (p,) ratio of the bound to the observed variance; 1 if the bound is reached.
        efficiency_interval: (p, 2) 95 % confidence interval of each efficiency, from the
            chi-squared distribution of the sample variance.
        trials: Number of trials.
        failed: Number of trials whose fit failed.
        seconds: Wall time [s].
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

    in_json = (
        "mean",
        "covariance",
        "crlb",
        "efficiency",
        "efficiency_interval",
        "trials",
        "failed",
        "seconds",
    )


@record
class MonteCarloStudy(ShownRecord):
    """Result of `mjfim.monte_carlo`: statistics of estimates along one or more trajectories.

    Attributes:
        parameters: Names of the p parameters.
        theta: (p,) true values.
        measure_rate: Rate of the measurements [Hz].
        sets: Statistics by name of the trajectory (`initial`, `final`).
        information: (p, p) Fisher information of each trajectory, with the keys of `sets`.
        labels: Names and units for figures and tables.
    """

    parameters: tuple[str, ...]
    theta: Array
    measure_rate: float
    sets: dict[str, TrialStatistics]
    information: dict[str, Array]
    labels: Labels

    file_stem = "montecarlo"
    made_by = "`mjfim montecarlo EXPERIMENT DESIGN.npz -o DIR`"
    in_json = ("parameters", "theta", "measure_rate")

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON; each trajectory has its name as a key."""
        sets = {
            name: {**trials.summary(), "information": self.information[name]}
            for name, trials in self.sets.items()
        }
        return {**super().summary(), **sets}


class CampaignStatus(NamedEnum):
    """Outcome of a campaign; the value is a sentence for the user."""

    REACHED = "reached: every parameter is known as accurately as wanted"
    DOUBTFUL = (
        "every formal σ reaches its target, but the fit is in doubt (see warnings), so the true "
        "errors may be larger"
    )
    EXHAUSTED = "all rounds are used up before every parameter is known as accurately as wanted"
    WAITING = "the next round is designed and waits for its recording"
    INFEASIBLE = "no design keeps the limits at the estimate; no further round was recorded"
    INTERRUPTED = "interrupted by the user; the rounds so far are complete"


# The design of a round that is recorded, None for recordings that were made without one, and its
# recordings.
RecordedRound = tuple[Design | None, tuple[Recording, ...]]


@record
class Round(Record):
    """One round of a campaign.

    Attributes:
        number: Number of the round, from 1.
        theta: (p,) parameters at which it was designed [theta-unit].
        predicted: (p,) standard deviations predicted for the estimate after it [theta-unit]; NaN
            without a design.
        control: (N, nu) control of the design [unit of the actuator].
        recordings: Recordings of this round.
        estimate: Estimate from all recordings up to this round.
        design: The design; None for recordings that were made without one.
        warnings: Sentences for the user.
    """

    number: int
    theta: Array
    predicted: Array
    control: Array
    recordings: tuple[Recording, ...]
    estimate: Estimate
    design: Design | None = None
    warnings: tuple[str, ...] = ()

    in_json = (
        "number",
        "theta",
        "predicted",
        "estimate.theta",
        "attained",
        "estimate.chi2",
        "estimate.dof",
        "estimate.misfit",
        "warnings",
    )
    json_names = {"theta": "designed_at", "attained": "std"}

    @property
    def attained(self) -> Array:
        """(p,) formal standard deviations of the estimate [theta-unit]."""
        return self.estimate.std

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON."""
        return {
            **super().summary(),
            "recordings": len(self.recordings),
        }


@record
class Campaign(ShownRecord):
    """Result of a campaign: all rounds.

    Attributes:
        parameters: Names of the p parameters.
        wanted: (p,) target standard deviations [theta-unit]; infinite if the experiment states
            none.
        rounds: The rounds.
        status: How the campaign ended.
        pending: Design that is not recorded yet, or None.
        warnings: Warnings of all rounds, each with its round.
    """

    parameters: tuple[str, ...]
    wanted: Array
    rounds: tuple[Round, ...]
    status: CampaignStatus
    pending: Design | None = None
    warnings: tuple[str, ...] = ()

    file_stem = "campaign"
    made_by = "`mjfim campaign EXPERIMENT -o DIR`"
    in_json = (
        "status",
        "words",
        "reached",
        "parameters",
        "wanted",
        "rounds",
        "warnings",
    )
    json_names = {"words": "message"}

    @property
    def reached(self) -> bool:
        """True if all parameters reach their target accuracies and the fit is not in doubt."""
        return self.status is CampaignStatus.REACHED

    @property
    def estimate(self) -> Estimate | None:
        """The last estimate, from all recordings."""
        return self.rounds[-1].estimate if self.rounds else None

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """The estimates after each round."""
        return tuple(r.estimate for r in self.rounds)

    @property
    def interest(self) -> list[int]:
        """Indices of the parameters that are no nuisance; a campaign with rounds knows them."""
        nuisance = self.rounds[-1].estimate.nuisance
        return [j for j, name in enumerate(self.parameters) if name not in nuisance]

    @property
    def designs(self) -> tuple[Design, ...]:
        """The designs of the rounds, where they are known."""
        return tuple(r.design for r in self.rounds if r.design is not None)

    @property
    def short(self) -> str:
        """Parameters that miss their target accuracies, in words; empty if none does."""
        last = self.estimate
        return "" if last is None else missed_targets(self.parameters, last.std, self.wanted)

    @property
    def words(self) -> str:
        """The end of the campaign in a clause."""
        missed = f": {self.short}" if self.short else ""
        if not self.rounds:
            return f"{self.status.value}{missed}"

        count = len(self.rounds)
        rounds = "1 round" if count == 1 else f"{count} rounds"
        return f"{self.status.value}{missed}; {rounds}"


def missed_targets(names: Sequence[str], std: Array, wanted: Array) -> str:
    """Return the parameters that miss their target accuracies in words, the worst first.

    Args:
        names: Names of the p parameters.
        std: (p,) standard deviations [theta-unit].
        wanted: (p,) target standard deviations [theta-unit].

    Returns:
        Text such as `m (σ 0.012, wanted 0.01)`; of many parameters the worst ones and the number of
        the others; empty if no parameter misses its target.
    """
    missed = np.flatnonzero(~(std <= wanted)).tolist()
    worst_first = sorted(missed, key=lambda j: -std[j] / wanted[j])
    return (
        first_ones([f"{names[j]} (σ {std[j]:.3g}, wanted {wanted[j]:.3g})" for j in worst_first])
        if worst_first
        else ""
    )
