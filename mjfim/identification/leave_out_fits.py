"""Fits without one part of the data, which begin at the fit to all of them.

Such a fit ends close to the fit to all data. The linearisation there consists of blocks of rows.
Those of the part can be left out, and one Gauss-Newton step leads to the other fit without a
linearisation of its own (approximate cross-validation; Giordano et al., A Swiss Army infinitesimal
jackknife, 2019). One simulation of the other data shows whether this step was good enough; where
it was not, the search goes on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.left_out_parts import SEARCH, LeftOutPart, with_initial_states
from mjfim.optimize.condensed_least_squares import Condensed
from mjfim.optimize.levenberg_marquardt import (
    WEAK_DAMPING,
    Solution,
    UnknownValues,
    minimise,
)

# Share of the predicted decrease of the cost that a step to the fit without a part may miss. The
# errors of predictions hardly change with what is left of it.
ALLOWED_SHARE = 0.1

# Dampings of the steps that are tried in turn. A step without damping is long in directions that
# the data hardly determine, in which the linearisation does not hold so far.
DAMPINGS = (WEAK_DAMPING, 1e-4, 1e-3, 1e-2)

# Largest decrease of the cost, as a share of it, that the last step of a search may bring. A
# linearisation that does not hold may promise any decrease.
LARGEST_ROUGH_SHARE = 5e-3

# Share of what a step may miss that an iteration has to bring. Two iterations in turn with less end
# a search: the iterations that are left seldom bring much more than what a step may miss.
SLOW_SHARE = 0.25

# Smallest cost in a denominator.
SMALLEST_COST = 1e-300

# Share of the decrease by the step without damping that a damped one has to predict.
ENOUGH_SHARE = 0.7


@dataclass(frozen=True, kw_only=True, eq=False)
class LeaveOutStep:
    """Step of a fit to the fit without one part of the data.

    Attributes:
        part: The part that is left out.
        begin: Unknowns of the fit.
        ends: Unknowns at the end of steps with more and more damping, and the decrease of the cost
            that the linearisation predicts for each.
    """

    part: LeftOutPart
    begin: UnknownValues
    ends: tuple[tuple[UnknownValues, float], ...]


def leave_out_steps(
    problem: FitProblem, solution: Solution, parts: Sequence[LeftOutPart]
) -> list[LeaveOutStep]:
    """Make the steps of a fit to the fits without each of some parts of the data."""
    return [_step_without(problem, solution, part) for part in parts]


@dataclass(frozen=True, kw_only=True, eq=False)
class OtherFit:
    """Fit to all data but one part.

    Attributes:
        unknowns: Unknowns of all segments. Where `has_initial_states` is false, the private ones
            are those of the fit to all data.
        has_initial_states: Whether the private unknowns of the part belong to the new theta.
    """

    unknowns: UnknownValues
    has_initial_states: bool


def fit_to_others(problem: FitProblem, step: LeaveOutStep, budget: Budget) -> OtherFit | None:
    """Fit theta to all data but one part.

    Args:
        problem: Problem of all parts.
        step: Step of the fit to all data to the fit without the part.
        budget: Ends the fit early.

    Returns:
        The fit; None where there are no other data, where the simulation diverges, and after a
        request to stop.
    """
    others = problem.masked([~mask for mask in step.part.masks(problem)])
    segments = others.segments_with_values
    if not len(segments):
        return None

    others = others.of_segments(segments)
    begin = _of_segments(step.begin, segments)
    cost = others.cost(begin)

    # The data that are left out may have led the estimate to a minimum that the others lack. The
    # fit to the others then begins at the guess.
    guess = others.begin(problem.system.parameters.guess)
    cost_at_guess = others.cost(guess)

    # A step is the fit if it lowers the cost nearly as far as the linearisation predicts.
    starts = [(cost, begin), (cost_at_guess, guess)]
    most = step.ends[0][1]
    for unknowns, decrease in step.ends:
        if decrease < ENOUGH_SHARE * most:
            break
        end = _of_segments(unknowns, segments)
        cost_at_end = others.cost(end)
        if budget.exhausted is not None:
            return None
        missed = cost_at_end - (cost - decrease)
        allowed = max(ALLOWED_SHARE * decrease, SEARCH.rough_share * cost)
        if missed <= allowed and cost_at_end <= cost_at_guess:
            has_states = not len(problem.layout.per_recording)
            return OtherFit(unknowns=unknowns, has_initial_states=has_states)
        starts.append((cost_at_end, end))

    least, at = min(starts, key=lambda start: start[0])
    settings = replace(SEARCH, lengthens=problem.loss.kind != "linear")
    if at is not guess:
        # The search ends as near to the fit as a step that counts as the fit.
        share = ALLOWED_SHARE * most / max(least, SMALLEST_COST)
        near = min(max(settings.rough_share, share), LARGEST_ROUGH_SHARE)
        settings = replace(settings, rough_share=near, stagnant_share=SLOW_SHARE * near)
    found = minimise(others, at, settings, budget)
    if found is None or budget.exhausted is not None:
        return None
    return OtherFit(
        unknowns=replace(found.unknowns, private=step.begin.private), has_initial_states=False
    )


def predicted_part(
    problem: FitProblem, fit: OtherFit, masks: Sequence[np.ndarray], budget: Budget
) -> tuple[FitProblem, UnknownValues]:
    """The segments of a part, and their unknowns at a fit to the other data.

    Args:
        problem: Problem of all parts.
        fit: The fit to the others.
        masks: (M, ny) for every recording, True for the values of the part.
        budget: Ends the search for initial states early.
    """
    if not fit.has_initial_states:
        return with_initial_states(problem, fit.unknowns.theta, masks, budget)

    segments = problem.masked(masks).segments_with_values
    return problem.of_segments(segments), _of_segments(fit.unknowns, segments)


def _of_segments(at: UnknownValues, segments: np.ndarray) -> UnknownValues:
    """The unknowns of some segments."""
    return replace(at, private=at.private[segments])


def _step_without(problem: FitProblem, solution: Solution, part: LeftOutPart) -> LeaveOutStep:
    """Step to the fit without a part."""
    at = solution.unknowns
    condensed = solution.condensed
    masks = part.masks(problem)
    others = condensed.without_blocks(problem.blocks.containing(masks))

    # Bounds hold as in every step of the search.
    values = problem.common_values(at)
    lower, upper = problem.lower - values, problem.upper - values
    is_left_out = ~np.isin(
        np.arange(len(problem.segments)),
        problem.masked([~mask for mask in masks]).segments_with_values,
    )
    ends = []
    for damping in DAMPINGS:
        step = others.step(damping, condensed.column_norms, lower, upper)
        end = problem.moved(at, step, 1.0)
        unknowns = _with_states_of_part(at, end, condensed, step.common, is_left_out)
        ends.append((unknowns, step.predicted_decrease))
    return LeaveOutStep(part=part, begin=at, ends=tuple(ends))


def _with_states_of_part(
    begin: UnknownValues, end: UnknownValues, condensed: Condensed, common: Array, part: np.ndarray
) -> UnknownValues:
    """The end of a step, at which initial states of the segments in a part fit that part.

    Args:
        begin: Unknowns at the begin of the step.
        end: Unknowns at its end.
        condensed: Linearisation of all data at the begin.
        common: (c,) step of the common unknowns.
        part: (P,) True for the segments of the part.
    """
    private = np.array(end.private)
    private[part] = begin.private[part] + condensed.private_step(common)[part]
    return replace(end, private=private)
