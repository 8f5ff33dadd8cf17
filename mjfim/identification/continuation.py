"""Restart of a fit from fits over short segments: continuation in the length of the segments.

A simulation over a whole recording accumulates the effect of wrong parameters until it is out of
step with the measured motion. The cost has then many local minima, and a search from a guess that
is a few percent wrong may end in one of them. Over short segments, whose initial states are free,
the simulation stays close to the measured motion, and the search finds the neighbourhood of the
true parameters from far away. Longer and longer segments then lead to the minimum of the whole
recordings, which is the most accurate one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

from mjfim.errors import SimulationDivergedError
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.fit_quality import FitQuality, fit_quality
from mjfim.identification.residual_tests import is_larger_than_noise, misfit_reasons
from mjfim.identification.searches import (
    CLEAR_ROUGH_SHARE,
    JUDGED_ROUGH_SHARE,
    FitSearch,
)
from mjfim.identification.segment_fits import SegmentFits, start_from_segments
from mjfim.identification.task import FitTask
from mjfim.information.null_space import NullSpace
from mjfim.optimize.levenberg_marquardt import (
    InterruptedPassError,
    Solution,
    UnknownValues,
    completed,
)
from mjfim.records.estimate import Restart
from mjfim.records.inverse_dynamics import InverseDynamicsFit

# Iterations of the fit over whole recordings after those over segments, unless it has found a lower
# cost by then. They bound the time of a restart.
RESTART_ITERATIONS = 25

# Difference of two costs that is not relevant. A step to the minimum that is 0.14 standard
# deviations long lowers the cost by this much.
SAME_COST = 1e-2

# Share by which the squared residuals of a fit near its minimum may still fall: twice the largest
# decrease that its last step was predicted to bring.
LEFT_SHARE = 2.0 * CLEAR_ROUGH_SHARE


@dataclass(frozen=True, kw_only=True, eq=False)
class WholeFit:
    """A fit over whole recordings.

    Attributes:
        problem: The least-squares problem with the noise of the fit.
        solution: Its solution.
        quality: Quality of the fit.
        restart: How it was repeated from fits over segments; None where it was not.
        inverse_dynamics: The fit to the equation of motion at which these began, or None.
    """

    problem: FitProblem
    solution: Solution
    quality: FitQuality
    restart: Restart | None = None
    inverse_dynamics: InverseDynamicsFit | None = None


def continued_fit(
    search: FitSearch,
    problem: FitProblem,
    first: tuple[FitProblem, Solution],
    null_space: NullSpace,
) -> WholeFit:
    """Repeat a doubtful fit from fits over segments, and keep the result with the lower cost.

    A search that then is stuck, because the residuals are rough, goes on with longer differences.

    A fit is doubtful if it does not explain the recordings, or, where this cannot be tested because
    the noise is estimated, if it ended without convergence. Nothing is repeated where the user
    states the length of the segments, and with the method `newton`.

    Args:
        search: The searches of the identification.
        problem: The problem before its noise was estimated.
        first: The problem with the noise of the first fit, and its solution.
        null_space: Combinations of parameters that the fit holds.

    Returns:
        The better one of the two fits.

    Raises:
        SimulationDivergedError: The simulation diverges at the solution of the first fit.
    """
    kept = _better_of_two(search, problem, first, null_space)

    # The first fit was judged before it has converged.
    found = search.converged(kept.problem, kept.solution)
    found = search.over_roughness(*found)
    if found[1] is kept.solution:
        return kept
    restart = kept.restart
    if restart is not None:
        restart = _gone_on(restart, first[0], *found)
    quality = fit_quality(*found)
    return replace(kept, problem=found[0], solution=found[1], quality=quality, restart=restart)


def _gone_on(
    restart: Restart, first: FitProblem, problem: FitProblem, solution: Solution
) -> Restart:
    """The costs of a restart after the search for the kept fit went on.

    Args:
        restart: The restart with the costs of the compared fits.
        first: The problem with the noise of the first fit.
        problem: The problem of the kept fit.
        solution: Where its search ended.
    """
    cost = _cost_with_noise_of(first, problem, solution)

    # Where the first fit stands, it is this one that went on.
    stands = not restart.cost < restart.cost_before
    return replace(restart, cost=cost, cost_before=cost if stands else restart.cost_before)


def _cost_with_noise_of(first: FitProblem, problem: FitProblem, solution: Solution) -> float:
    """Cost of the solution of a problem, with the noise of the first fit."""
    if problem.noise is first.noise:
        return solution.cost
    return completed(partial(first.cost, solution.unknowns))


def _better_of_two(
    search: FitSearch,
    problem: FitProblem,
    first: tuple[FitProblem, Solution],
    null_space: NullSpace,
) -> WholeFit:
    """The first fit, or its repetition from fits over segments if that costs less."""
    task = search.task
    begun = _assessed(*first)
    if not may_be_repeated(task) or search.interrupted():
        return begun

    # A fit that is near its minimum is enough where it clearly misses the data.
    if begun.solution.rough and not _clearly_misses(task, begun):
        begun = _assessed(*search.nearer(begun.problem, begun.solution))
    if search.interrupted() or not is_doubtful(task, begun):
        return begun

    segments = start_from_segments(search, problem, null_space)
    if not segments.lengths:
        return begun
    kept = _with_restart(search, problem, begun, segments)

    # Where most of the motion is still unexplained, the search goes on from many other starts.
    if not kept.quality.unexplained or search.interrupted():
        return kept
    spread = start_from_segments(search, problem, null_space, spread=True)
    other = _with_restart(search, problem, kept, spread)
    if kept.restart is None or other.restart is None:
        return kept
    if other.restart.cost == other.restart.cost_before:
        restart = kept.restart
        if other.solution is not kept.solution:
            restart = _gone_on(restart, begun.problem, other.problem, other.solution)
        return replace(other, restart=restart, inverse_dynamics=kept.inverse_dynamics)

    # The first fit counts as it was compared with the first repetition.
    cost = _cost_with_noise_of(begun.problem, other.problem, other.solution)
    costs = replace(other.restart, cost_before=kept.restart.cost_before, cost=cost)
    return replace(other, restart=costs)


def _with_restart(
    search: FitSearch, problem: FitProblem, first: WholeFit, segments: SegmentFits
) -> WholeFit:
    """The better one of a fit and its repetition from fits over segments."""
    start = segments.start
    again = None if start is None else _repeated(search, problem, start, first)

    if again is not None:
        first = _as_near_as_needed(search, first, again)
    return _better(first, again, segments)


def _as_near_as_needed(search: FitSearch, first: WholeFit, again: WholeFit) -> WholeFit:
    """The first fit, so near to its minimum that another fit costs clearly less, or does not."""
    cost = _cost(first, again.solution)
    nearer = ((CLEAR_ROUGH_SHARE, search.nearer), (JUDGED_ROUGH_SHARE, search.converged))
    for share, go_on in nearer:
        # The next decrease of a search near its minimum is smaller than the last one.
        least = (1.0 - share) * first.solution.cost
        if first.solution.rough and least < cost < first.solution.cost:
            first = _assessed(*go_on(first.problem, first.solution))
    return first


def _assessed(problem: FitProblem, solution: Solution) -> WholeFit:
    """A fit over whole recordings, with the quality of its residuals."""
    return WholeFit(problem=problem, solution=solution, quality=fit_quality(problem, solution))


def _clearly_misses(task: FitTask, fit: WholeFit) -> bool:
    """Whether residuals are larger than the stated noise, also at the minimum near the fit."""
    left = (1.0 - LEFT_SHARE) * fit.quality.chi2
    return task.noise_is_stated and is_larger_than_noise(left, fit.quality.dof)


def may_be_repeated(task: FitTask) -> bool:
    """Whether a doubtful fit is repeated: by Gauss-Newton steps over whole recordings.

    Args:
        task: The task of the fit.
    """
    return task.settings.segment_length is None and task.method != "newton"


def is_doubtful(task: FitTask, fit: WholeFit) -> bool:
    """Whether a fit may have ended in a local minimum, or before a minimum.

    Residuals that agree with the stated noise leave no lower minimum that matters.

    Args:
        task: The task of the fit.
        fit: The fit.
    """
    quality = fit.quality
    untested = not fit.solution.success and not task.noise_is_stated
    if untested or quality.unexplained:
        return True

    reasons = misfit_reasons(
        quality.chi2, quality.dof, task.noise_is_stated, quality.whiteness, missing=()
    )
    return bool(reasons)


def _repeated(
    search: FitSearch, problem: FitProblem, start: UnknownValues, first: WholeFit
) -> WholeFit | None:
    """A fit over whole recordings from a start; None where it diverges, or is stopped at its begin.

    It goes on beyond some iterations only if its cost is lower than that of the first fit by then.
    """
    try:
        begin: UnknownValues | None = start
        if search.task.noise_is_stated:
            begin = search.improved_on_part(problem, start, first.solution.unknowns)
        if begin is None:
            return None

        placed = search.with_begun_states(problem, begin)
        found = search.solve(
            problem,
            placed,
            "again all data",
            RESTART_ITERATIONS,
            cost_to_beat=first.solution.cost,
        )
        solution = found[1]
        ends_early = solution.success or solution.iterations < RESTART_ITERATIONS
        if not ends_early and _cost(first, solution) < first.solution.cost:
            found = search.solve(problem, found[1].unknowns, "again all data")
        return WholeFit(problem=found[0], solution=found[1], quality=fit_quality(*found))
    except (SimulationDivergedError, InterruptedPassError):
        return None


def _cost(first: WholeFit, solution: Solution) -> float:
    """Cost of a solution with the noise of the first fit, so that it can be compared with it."""
    return first.problem.cost(solution.unknowns)


def _better(first: WholeFit, again: WholeFit | None, segments: SegmentFits) -> WholeFit:
    """The fit with the lower cost, and of two equal ones that which has converged."""
    restart = Restart(
        lengths=segments.lengths,
        cost_before=first.solution.cost,
        cost=first.solution.cost,
        by_dynamics=segments.inverse_dynamics is not None,
        starts=segments.starts,
    )
    first = replace(first, inverse_dynamics=segments.inverse_dynamics)
    if again is None:
        return replace(first, restart=restart)

    cost = _cost(first, again.solution)
    fall = first.solution.cost - cost
    converges = again.solution.success and not first.solution.success
    if fall > SAME_COST or (converges and fall > -SAME_COST):
        again = replace(again, inverse_dynamics=segments.inverse_dynamics)
        return replace(again, restart=replace(restart, cost=cost))
    return replace(first, restart=restart)
