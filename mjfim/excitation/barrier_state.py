"""States between which the interior-point method can be interrupted, and from which it goes on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from mjfim.budget import PausedBudget
from mjfim.excitation.interior_problem import InteriorPoint
from mjfim.optimize.projection_operator import DescentState
from mjfim.optimize.structured_bfgs import StructuredBFGS


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
