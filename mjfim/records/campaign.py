"""Records of a campaign: rounds of design, recording and estimate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np

from mjfim.arrays import Array, freeze
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.recording import Recording


class CampaignStatus(Enum):
    """How a campaign ended; the value is a sentence for the user."""

    REACHED = "reached: every parameter is known as well as wanted"
    DOUBTFUL = "every wanted σ is reached formally, but the fit is in doubt (see warnings): formal σ is not accuracy"
    EXHAUSTED = "the rounds are used up before every parameter is known as well as wanted"
    WAITING = "the next round is designed and waits for its recording"
    INFEASIBLE = "no design keeps the limits at the estimate; nothing more was recorded"
    INTERRUPTED = "interrupted by the user; the rounds so far are complete"


@dataclass(frozen=True, eq=False, kw_only=True)
class EarlierRound:
    """Recordings that are there already: of an earlier session's round, or made without a design.

    theta: (p,) where the round was designed;  predicted: (p,) σ that was promised;  control: (N, nu) of the design
    """

    recordings: tuple[Recording, ...]
    theta: Array | None = None
    predicted: Array | None = None
    control: Array | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class Round:
    """One round. number: from 1;  theta: (p,) where it was designed;  control: (N, nu) of the design

    predicted: (p,) σ after the round as promised before it, NaN where there was no design;  design: None where it was played
    earlier;  recordings: of this round;  estimate: from all recordings up to this round;  warnings: sentences for the user
    """

    number: int
    theta: Array
    predicted: Array
    control: Array
    recordings: tuple[Recording, ...]
    estimate: Estimate
    design: Design | None = None
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        freeze(self, "theta", "predicted", "control")

    @property
    def attained(self) -> Array:
        """(p,) formal σ of the estimate."""
        return self.estimate.std


@dataclass(frozen=True, eq=False, kw_only=True)
class Campaign:
    """All rounds. wanted: (p,) σ aimed at, infinite where none is

    pending: a design that is not recorded yet, or None;  warnings: those of all rounds, each with its round
    """

    parameters: tuple[str, ...]
    wanted: Array
    rounds: tuple[Round, ...]
    status: CampaignStatus
    pending: Design | None = None
    warnings: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        freeze(self, "wanted")

    @property
    def reached(self) -> bool:
        """Every parameter is known as well as wanted, and nothing speaks against the fit."""
        return self.status is CampaignStatus.REACHED

    @property
    def estimate(self) -> Estimate | None:
        """The last one, from all recordings."""
        return self.rounds[-1].estimate if self.rounds else None

    @property
    def estimates(self) -> tuple[Estimate, ...]:
        """One a round."""
        return tuple(r.estimate for r in self.rounds)

    @property
    def designs(self) -> tuple[Design, ...]:
        """Those made in this session."""
        return tuple(r.design for r in self.rounds if r.design is not None)

    @property
    def short(self) -> str:
        """Parameters that are not known as well as wanted, in words; empty where all are."""
        last = self.estimate
        return "" if last is None else missed_targets(self.parameters, last.std, self.wanted)

    def __str__(self) -> str:
        return f"{self.status.value}{f': {self.short}' if self.short else ''}; {len(self.rounds)} rounds"


def missed_targets(names: Sequence[str], std: Array, wanted: Array) -> str:
    """The parameters that are not known as well as wanted, the worst first: `m (σ 0.012, wanted 0.01)`."""
    order = sorted(np.flatnonzero(~(std <= wanted)).tolist(), key=lambda j: -std[j] / wanted[j])
    return ", ".join(f"{names[j]} (σ {std[j]:.3g}, wanted {wanted[j]:.3g})" for j in order)
