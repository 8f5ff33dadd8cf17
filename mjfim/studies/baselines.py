"""Baselines that a design is compared with.

Chirps, multisines and random steps are searched at random over their numbers, each as large as the
limits allow. Fourier series and B-splines of several base frequencies are optimised with the
derivatives and the barrier of a design, so that only the form of the excitation differs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from mjfim.arrays import Array
from mjfim.excitation.design import consume
from mjfim.excitation.search.climb import Candidate
from mjfim.excitation.search.inside import LimitedCost, largest_share
from mjfim.excitation.search.levels import DescentLevel, bandwidth_basis, boundary_splines
from mjfim.excitation.search.search import Search
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.experiment.signals import fourier_basis, independent_curves
from mjfim.parallel import one_blas_thread, pool_stop_token
from mjfim.parallel.budget import Budget, StopToken
from mjfim.records.events import DesignEvent
from mjfim.studies.signals import Chirp, Excitation, ExcitationSettings, Multisine, RandomSteps

# Base frequencies of the first Fourier series, and bandwidths of the first B-splines [Hz].
FOURIER_FREQUENCIES = (0.2, 0.1, 0.4, 0.8, 0.15)
SPLINE_BANDWIDTHS = (1.0, 2.0)

# Number of further series and splines at random frequencies.
RANDOM_SERIES = 15

# Smallest and largest number of periods of the first harmonic within the horizon, and smallest
# number of harmonics, for Fourier series at random base frequencies.
RANDOM_PERIODS = (0.4, 5.0)
MIN_RANDOM_HARMONICS = 5

# Random bandwidths lie between these multiples of the smallest and of the largest usual one.
RANDOM_BANDWIDTH_FACTORS = (0.5, 2.0)

# Largest number of periods of a wave within the horizon.
MAX_CYCLES = 40.0

# Largest deviation of a control without a range, divided by the size of the initial control, and of
# a control with a range, divided by half of the range.
LARGEST_UNBOUNDED_SCALE = 6.0
LARGEST_BOUNDED_SCALE = 2.0

# Smallest deviation, divided by the largest feasible one, where weights in the cost may make a
# small control the best.
SMALLEST_WEIGHTED_SCALE = 0.03

# Share of the trials of the random search that are drawn from the whole range, instead of about the
# best trial; the share of the numbers that a trial about the best one changes, and the smallest
# number of them.
GLOBAL_SHARE = 0.3
CHANGED_SHARE = 0.3
MIN_CHANGED = 2.0

# Standard deviation of changes about the best trial at the beginning, its range, and its factors
# after a success and after a failure.
FIRST_SPREAD = 0.3
SPREAD_RANGE = (0.01, 0.5)
SPREAD_AFTER_SUCCESS = 1.5
SPREAD_AFTER_FAILURE = 0.93

# Called during a search with the lowest J so far.
SearchCallback = Callable[[float], None]


@dataclass(frozen=True, eq=False, kw_only=True)
class BaselineSearch:
    """Order for one search by a baseline. It can be pickled.

    Attributes:
        experiment: The experiment.
        method: Key of the baseline.
        seconds: Time of the search [s].
        seed: Seed of its random numbers.
        part: Number of this search among those of one baseline, and how many there are.
        combinations: Basis of the identifiable combinations; None where all are identifiable.
        added_information: (p, p) information of other experiments.
        threads: Number of threads; None for all.
    """

    experiment: Experiment
    method: str
    seconds: float
    seed: int = 0
    part: tuple[int, int] = (0, 1)
    combinations: Array | None = None
    added_information: Array | None = None
    threads: int | None = None


@dataclass(frozen=True, eq=False, kw_only=True)
class SearchResult:
    """The best control that a search has found.

    Attributes:
        control: (N, nu) control [u-unit]; None without one.
        cost: J of the control; infinite where it violates a limit.
        found_by: Name of the series.
        seconds: Time of the search [s].
        steps: MuJoCo steps of the search.
    """

    control: Array | None = None
    cost: float = np.inf
    found_by: str = ""
    seconds: float = 0.0
    steps: int = 0


@one_blas_thread()
def run_baseline(
    search: BaselineSearch, callback: SearchCallback | None = None, stop: StopToken | None = None
) -> SearchResult:
    """Run a baseline until its time is over. An executor can call this in a worker process.

    Args:
        search: The order.
        callback: Called whenever the search has made progress, or not for a while.
        stop: Ends the search early; None for the request of the pool of this process.
    """
    budget = Budget(seconds=search.seconds, stop=stop or pool_stop_token())
    task = DesignTask.resolve(
        search.experiment, threads=search.threads, added_information=search.added_information
    )
    show = callback or (lambda cost: None)
    found, steps = METHODS[search.method](search, task, budget, show)
    return replace(found, seconds=budget.seconds_used, steps=steps)


# ---- random search


def _search_at_random(
    search: BaselineSearch,
    stated: DesignTask,
    budget: Budget,
    show: SearchCallback,
    *,
    kind: Callable[[ExcitationSettings], Excitation],
) -> tuple[SearchResult, int]:
    """Search over the numbers of an excitation, about the best ones or everywhere."""
    task = stated.relaxed() if stated.is_limited else stated
    cost = LimitedCost(level=DescentLevel(task, search.combinations))
    rng = np.random.default_rng((search.seed, *search.part))
    excitation = kind(_settings(cost))
    basis, window = bandwidth_basis(task, task.t), task.fade(task.samples)
    bounds = cost.constraints.control.bounds
    is_bounded = bool(np.isfinite(bounds.lower).all())
    largest = LARGEST_BOUNDED_SCALE if is_bounded else LARGEST_UNBOUNDED_SCALE
    has_weights = bool(task.control_weight.any() or task.tracking.any()) or not task.is_limited

    best, found, spread = np.zeros(0), SearchResult(), FIRST_SPREAD
    while budget.exhausted is None:
        show(found.cost)
        # The first number is the size, which matters where weights in the cost decide about it.
        numbers = rng.random(1 + excitation.parameter_count)
        is_local = len(best) > 0 and rng.random() > GLOBAL_SHARE
        if is_local:
            share = max(CHANGED_SHARE, MIN_CHANGED / len(numbers))
            changed = rng.random(len(numbers)) < share
            numbers = reflected(best + spread * changed * rng.normal(size=len(numbers)))

        deviation = largest * window * excitation.curve(numbers[1:]) * bounds.scale
        if basis is not None:
            deviation = basis @ np.linalg.lstsq(basis, deviation)[0]
        scale: float | None = 1.0
        if task.is_limited:
            scale = largest_share(partial(_keeps_share, cost, deviation), budget)
        if scale is None:
            continue
        if has_weights:
            scale *= SMALLEST_WEIGHTED_SCALE ** (1.0 - numbers[0])
        control = np.asarray(task.centre + scale * deviation)
        values = cost.values(control)
        is_inside = values is not None and cost.constraints.is_feasible(values)
        point = cost.point_along(values) if is_inside or not task.is_limited else None
        J = np.inf if point is None else point.cost

        # Widen the local search after a success, narrow it after a failure.
        if is_local:
            factor = SPREAD_AFTER_SUCCESS if found.cost > J else SPREAD_AFTER_FAILURE
            spread = float(np.clip(spread * factor, *SPREAD_RANGE))
        if found.cost > J:
            best, found = numbers, SearchResult(control=control, cost=J)
    return found, task.plant.engine_steps


def _keeps_share(cost: LimitedCost, deviation: Array, share: float) -> bool:
    """Check whether a share of a deviation from the centre keeps the limits."""
    task = cost.level.task
    return not task.is_limited or cost.nearly_keeps(task.centre + share * deviation)


def _settings(cost: LimitedCost) -> ExcitationSettings:
    """Settings of the excitations of an experiment."""
    task = cost.level.task
    experiment = task.experiment
    bandwidth = experiment.limits.bandwidth
    fastest = min(bandwidth or np.inf, 0.25 * experiment.rate, MAX_CYCLES / task.horizon)
    is_smooth = cost.constraints.rate is not None or bandwidth is not None
    return ExcitationSettings(
        t=task.t,
        horizon=task.horizon,
        nu=len(task.controls),
        min_frequency=min(0.5 / task.horizon, fastest),
        max_frequency=fastest,
        may_jump=not is_smooth and experiment.boundary.start != "rest",
    )


def reflected(numbers: Array) -> Array:
    """Bring numbers, (n,), back between 0 and 1 by reflection at these ends."""
    return np.asarray(1.0 - np.abs(1.0 - np.abs(numbers) % 2.0))


# ---- optimised series


def _optimise(
    search: BaselineSearch,
    stated: DesignTask,
    budget: Budget,
    show: SearchCallback,
    *,
    harmonics: int | None,
) -> tuple[SearchResult, int]:
    """Optimise Fourier series of some harmonics, or B-splines where `harmonics` is None."""
    level = DescentLevel(stated, search.combinations)
    first = level.problem.point(stated.initial)
    optimiser = Search(stage=level, first=first, budget=budget, keeps_curves=True)
    best = np.inf

    def watch(event: DesignEvent) -> None:
        """Report the lowest J within the limits."""
        nonlocal best
        if not event.row.margin < 0.0:
            best = min(best, event.row.cost)
        show(best)

    rng = np.random.default_rng((search.seed, *search.part))
    part, parts = search.part
    candidates = list(_series(stated, harmonics, rng))[part::parts]
    results = consume(optimiser.run(candidates), watch)
    steps = optimiser.steps
    found = min(results, key=lambda each: (each.cost, each.rank), default=None)
    if found is None:
        return SearchResult(), steps
    control = found.over_horizon if found.best is None else found.best
    return SearchResult(control=control, cost=found.cost, found_by=found.name), steps


def _series(
    task: DesignTask, harmonics: int | None, rng: np.random.Generator
) -> Iterator[Candidate]:
    """Series at usual frequencies, and then at random ones."""
    experiment = task.experiment
    fastest = experiment.limits.bandwidth or 0.5 * experiment.rate
    from_rest = experiment.boundary.start == "rest"
    to_rest = experiment.boundary.end == "rest"

    def basis_of(frequency: float) -> Array:
        """(N, M) curves of a base frequency or of a bandwidth [Hz]."""
        if harmonics is None:
            return independent_curves(boundary_splines(task, task.t, frequency))
        count = max(min(harmonics, int(fastest / frequency + 1e-9)), 1)
        curves = fourier_basis(task.t, task.horizon, frequency, count, from_rest, to_rest)
        return independent_curves(curves)

    if harmonics is None:
        usual: tuple[float, ...] = SPLINE_BANDWIDTHS
        ends = np.multiply(RANDOM_BANDWIDTH_FACTORS, (usual[0], usual[-1]))
        ends = np.minimum(ends, fastest)
    else:
        usual = FOURIER_FREQUENCIES
        highest = fastest / min(harmonics, MIN_RANDOM_HARMONICS)
        ends = np.minimum(np.divide(RANDOM_PERIODS, task.horizon), highest)

    centre = task.centre
    for frequency in (each for each in usual if each <= fastest):
        basis = basis_of(frequency)
        nearest = basis @ np.linalg.lstsq(basis, task.control - centre)[0]
        name = f"{frequency:.3g} Hz"
        yield Candidate(name=name, control=centre + nearest, curves=basis)
    for number in range(1, RANDOM_SERIES + 1):
        frequency = float(np.exp(rng.uniform(*np.log(ends))))
        basis = basis_of(frequency)
        coefficients = rng.normal(size=(basis.shape[1], len(centre)))
        deviation = basis @ coefficients * task.plant.sizes.control / np.sqrt(basis.shape[1])
        name = f"{frequency:.3g} Hz, at random ({number})"
        yield Candidate(name=name, control=centre + deviation, curves=basis)


Method = Callable[[BaselineSearch, DesignTask, Budget, SearchCallback], tuple[SearchResult, int]]

# The baselines by their keys; `TITLES` has their names for the user, in the same order.
METHODS: dict[str, Method] = {
    "chirp": partial(_search_at_random, kind=Chirp),
    "multisine": partial(_search_at_random, kind=Multisine),
    "steps": partial(_search_at_random, kind=RandomSteps),
    "fourier5": partial(_optimise, harmonics=5),
    "fourier15": partial(_optimise, harmonics=15),
    "splines": partial(_optimise, harmonics=None),
}
