"""Events by which long computations report their progress, by calling `callback(event)`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mjfim.records.design import HistoryRow


@dataclass(frozen=True, kw_only=True)
class DesignEvent:
    """One iterate of a design.

    Attributes:
        start: Name of the initial control from which the iterate comes.
        row: The iterate.
    """

    start: str
    row: HistoryRow


@dataclass(frozen=True, kw_only=True)
class FitEvent:
    """One iterate of an estimation.

    Attributes:
        phase: Data to which the model is fitted: "all data", or a part of the search for an initial
            guess.
        iteration: Number of the iterate in this phase.
        cost: Half of the sum of squared whitened residuals; in a phase "noise estimated" with the
            loss "linear", minus the logarithm of the likelihood, without a constant.
        step: Length of the last step [standard deviations].
    """

    phase: str
    iteration: int
    cost: float
    step: float


@dataclass(frozen=True, kw_only=True)
class StudyEvent:
    """Progress of a study that consists of several parts.

    Attributes:
        study: Name of the study, such as "compare", "monte_carlo" or "campaign".
        part: Name of the part that is running.
        index: Number of the part, from 0.
        count: Number of parts; None if it is not known beforehand.
        share: Completed share of this part, 0 to 1.
        message: One line about the results so far; may be empty.
        result: Result of a complete part, such as the `Round` of a campaign; None while the part
            is running.
    """

    study: str
    part: str
    index: int
    count: int | None
    share: float
    message: str = ""
    result: object = None


Event = DesignEvent | FitEvent | StudyEvent
Callback = Callable[[Event], None]
DesignCallback = Callable[[DesignEvent], None]
