"""States between which the interior-point method can be interrupted, and from which it goes on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import PausedBudget
from mjfim.excitation.interior_problem import InteriorPoint
from mjfim.excitation.run_result import RunResult
from mjfim.excitation.search_slices import SealedState, SearchSlice
from mjfim.excitation.short_steps import ShortSteps
from mjfim.optimize.projection_operator import DescentState
from mjfim.optimize.structured_bfgs import StructuredBFGS
from mjfim.records.design import Status


@dataclass(frozen=True, kw_only=True, eq=False)
class BetweenStages:
    """State of the interior-point method at the beginning of a barrier stage.

    Attributes:
        point: Point with which the stage begins.
        direction: Direction with the curvature pairs of all stages so far.
        number: Number of the stage, from 0.
        first_index: Number of its first iterate.
        tightening: Distance by which limits are moved inwards, relative to half of the range, by
            kind.
        was_feasible: True where all limits hold along any iterate of the stages before.
        infeasible_repeats: Number of repetitions of the last stage whose result violates a limit.
    """

    point: InteriorPoint
    direction: StructuredBFGS
    number: int = 0
    first_index: int = 0
    tightening: Mapping[str, float] = field(default_factory=dict)
    was_feasible: bool = False
    infeasible_repeats: int = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class WithinStage:
    """State of a barrier stage at an iterate.

    Attributes:
        descent: State of Algorithm 1.
        budget: Time of the stage.
        max_iterations: Largest number of iterations of the stage.
        values: Merit of its iterates before this one.
        was_feasible: True where all limits hold along any iterate of the stage before this one.
    """

    descent: DescentState[InteriorPoint]
    budget: PausedBudget
    max_iterations: int
    values: tuple[float, ...] = ()
    was_feasible: bool = False


@dataclass(frozen=True, kw_only=True, eq=False)
class BarrierState:
    """State of the interior-point method at an iterate of a barrier stage. It can be pickled.

    Attributes:
        begun: State at the beginning of the stage.
        within: State of the stage.
        budget: Time and iterations of the whole run.
    """

    begun: BetweenStages
    within: WithinStage
    budget: PausedBudget


@dataclass(frozen=True, kw_only=True, eq=False)
class SearchState:
    """State of a search at an iterate. It can be pickled.

    Attributes:
        barrier: State of the interior-point method.
        best_of_stages: (N, nu) best feasible control of each barrier weight mu so far.
        short_steps: Recognises a descent that is held up.
    """

    barrier: BarrierState
    best_of_stages: dict[float, Array]
    short_steps: ShortSteps


def unfinished(result: RunResult, state: SearchState) -> SearchSlice[SearchState]:
    """Describe a search that goes on later.

    Args:
        result: The result so far.
        state: State from which it goes on.
    """
    earlier = tuple(state.best_of_stages.values())[:-1]
    so_far = replace(result, status=Status.INTERRUPTED, earlier=earlier)
    late = Status.MAX_ITERATIONS if np.isfinite(result.cost) else Status.INFEASIBLE
    return SearchSlice(result=so_far, state=SealedState.of(state), late_status=late)
