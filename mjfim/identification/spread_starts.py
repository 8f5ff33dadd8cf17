"""Starts that are spread widely about a guess, and the best one of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.searches import FitSearch
from mjfim.model.parameter_samples import make_physical
from mjfim.model.parameters import ParameterSet
from mjfim.optimize.levenberg_marquardt import SearchSettings

# Number of starts, with the one about which they are spread.
SPREAD_STARTS = 32

# Largest factor between a start and the one about which they are spread.
LARGEST_FACTOR = 10.0

# Number of starts from which a short search is made: those that cost least.
SEARCHED_STARTS = 3

# Iterations of a short search. They show which start leads down.
SHORT_ITERATIONS = 4


def spread_starts(
    parameters: ParameterSet,
    theta: Array,
    held: Sequence[str],
    unphysical: Callable[[Array], Sequence[int]],
    rng: np.random.Generator,
) -> Array:
    """Spread starts about parameters.

    A scalar, such as a mass or a damping, keeps its sign and is multiplied by a factor between 1/10
    and 10, uniform in its logarithm. A component of a vector, whose size is that of the whole
    vector, is moved by up to this size. Together they form a Latin hypercube.

    Args:
        parameters: The parameters.
        theta: (p,) parameters about which the starts are spread [theta-unit].
        held: Names of the parameters that stay where they are.
        unphysical: Gives for a start (p,) the indices of the parameters that determine unphysical
            bodies.
        rng: Source of random numbers.

    Returns:
        (`SPREAD_STARTS`, p) starts; the first one is theta.
    """
    starts = np.tile(theta, (SPREAD_STARTS, 1))
    moved = ~np.isin(parameters.names, held) & ~np.asarray(parameters.outside_model)
    if not moved.any():
        return starts[:1]

    cube = scipy.stats.qmc.LatinHypercube(int(moved.sum()), rng=rng)
    shifts = 2.0 * cube.random(SPREAD_STARTS - 1) - 1.0
    for shift, j in zip(shifts.T, np.flatnonzero(moved).tolist(), strict=True):
        parameter = parameters.parameters[j]
        is_scalar = parameter.size == abs(parameter.guess) and theta[j] != 0.0
        if is_scalar:
            starts[1:, j] *= LARGEST_FACTOR**shift
        else:
            starts[1:, j] += parameters.magnitude[j] * shift

    starts[1:] = np.clip(starts[1:], parameters.lower, parameters.upper)
    for start in starts[1:]:
        make_physical(start, theta, unphysical)
    return starts


def best_spread_start(search: FitSearch, problem: FitProblem, theta: Array) -> Array | None:
    """The parameters to which short searches from the best of many starts lead.

    Args:
        search: The searches of the identification.
        problem: The problem of short segments.
        theta: (p,) parameters about which the starts are spread [theta-unit].

    Returns:
        (p,) parameters; None where the model diverges at all of them.

    Raises:
        InterruptedPassError: A request to stop ended a pass.
    """
    system, settings = problem.system, search.task.settings
    rng = np.random.default_rng(settings.seed)
    starts = spread_starts(system.parameters, theta, settings.hold, system.impossible, rng)
    costs = np.array([problem.cost(problem.begin(start)) for start in starts])

    short = SearchSettings(max_iterations=SHORT_ITERATIONS, relinearise_at_end=False)
    best, least = None, np.inf
    for i in np.argsort(costs)[:SEARCHED_STARTS].tolist():
        if not np.isfinite(costs[i]) or search.interrupted():
            break
        phase = f"start {i + 1} of {len(starts)}"
        found = search.minimise(problem, problem.begin(starts[i]), short, phase)
        if found is not None and found.cost < least:
            best, least = problem.theta(found.unknowns), found.cost
    return best
