"""Records of a campaign: rounds of design, recording and estimate."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import first_ones
from mjfim.records.base import NamedEnum, Record, ShownRecord
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.trajectory import Recording


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


@record
class EarlierRound(Record):
    """Recordings that existed before this session of a campaign began.

    They belong to a round of an earlier session, or were made without a design.

    Attributes:
        recordings: The recordings.
        theta: (p,) parameters at which the round was designed [theta-unit]; None without a design.
        predicted: (p,) predicted standard deviations [theta-unit]; None without a design.
        control: (N, nu) control of the design [unit of the actuator]; None without a design.
        design: The design, where all of it is known.
    """

    recordings: tuple[Recording, ...]
    theta: Array | None = None
    predicted: Array | None = None
    control: Array | None = None
    design: Design | None = None


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
        design: The design; None where it is not known.
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
