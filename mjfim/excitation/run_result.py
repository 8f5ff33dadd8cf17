"""Result of one optimisation run, and a function that runs it to its end."""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from mjfim.arrays import Array
from mjfim.excitation.objective import DesignPoint
from mjfim.records.design import HistoryRow, StartResult, Status
from mjfim.records.events import DesignEvent

T = TypeVar("T")


@dataclass(frozen=True, kw_only=True, eq=False)
class RunResult:
    """Result of one optimisation run from one initial control.

    Attributes:
        name: Name of the initial control.
        control: (N, nu) best control at the stated sample rate: under hard limits the best feasible
            one, else the last one; None where no iterate could be simulated.
        cost: J of the control; infinite where it is infeasible or unknown.
        status: How the run ended.
        slope: |DJ . zeta| at the last iterate.
        history: Every iterate.
        steps: Engine steps taken on other plants than the stated one.
        point: The control evaluated on the stated plant; None where that was not done.
        is_feasible: False where the control is known to violate a limit on the stated plant.
        earlier: (N, nu) controls each, the best feasible ones of earlier barrier stages. They keep
            larger distances from the limits, and replace the control where that violates a limit
            of the unmodified model.
        left_limits: True where a run without a barrier ended because it left the limits.
        is_held_up: True where a run under hard limits ended because its steps were very short.
    """

    name: str
    control: Array | None = None
    cost: float = np.inf
    status: Status = Status.STALLED
    slope: float = np.inf
    history: tuple[HistoryRow, ...] = ()
    steps: int = 0
    point: DesignPoint | None = None
    is_feasible: bool = True
    earlier: tuple[Array, ...] = ()
    left_limits: bool = False
    is_held_up: bool = False

    @property
    def start_result(self) -> StartResult:
        """The run as a row of the design's table of starts."""
        return StartResult(
            name=self.name,
            cost=self.cost,
            status=self.status,
            iterations=self.history[-1].iteration if self.history else 0,
        )


# Generator of a search with several runs: yields every iterate and returns one result per run.
Runs = Generator[DesignEvent, None, list[RunResult]]


def consume(
    events: Generator[DesignEvent, None, T], callback: Callable[[DesignEvent], None] | None
) -> T:
    """Run an optimisation to its end.

    Args:
        events: Yields every iterate and returns the result.
        callback: Called with every iterate, or None.

    Returns:
        The result.
    """
    try:
        while True:
            try:
                event = next(events)
            except StopIteration as end:
                result: T = end.value
                return result

            if callback is not None:
                callback(event)
    finally:
        # A callback that raises an error ends the search, with all runs in other processes.
        events.close()
