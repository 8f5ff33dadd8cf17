"""Baselines that a design is compared with.

Chirps, multisines and random steps are searched at random over their numbers, each as large as the
limits allow. Fourier series and B-splines of several base frequencies are optimised with the
derivatives and the barrier of a design, so that only the form of the excitation differs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import scipy.signal

from mjfim.arrays import Array, record
from mjfim.excitation.design import consume
from mjfim.excitation.initial_controls import series_of
from mjfim.excitation.prior_information import EarlierExperiments
from mjfim.excitation.search.inside import largest_share
from mjfim.excitation.search.levels import DescentLevel
from mjfim.excitation.search.search import Search
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.parallel import one_blas_thread, pool_stop_token
from mjfim.parallel.budget import Budget, StopToken
from mjfim.records.events import DesignEvent
from mjfim.records.studies import MethodResult

# Largest number of harmonics of a parametric multisine.
MAX_HARMONICS = 30

# Largest number of levels of parametric random steps.
MAX_LEVELS = 24

# Smallest amplitude of an actuator, relative to the actuator with the largest amplitude.
MIN_RELATIVE_AMPLITUDE = 0.05

# Largest power of the frequency with which the amplitudes of a parametric multisine fall.
MAX_ROLL_OFF = 2.0

# Duration of the shortest transition between two levels, as a fraction of the duration of a level;
# it avoids a division by zero.
SHORTEST_TRANSITION = 1e-9


@record
class ExcitationSettings:
    """Settings of all parametric excitations of an experiment.

    Attributes:
        t: (N,) sample times [s].
        horizon: Duration [s].
        nu: Number of actuators.
        min_frequency: Lowest frequency [Hz].
        max_frequency: Highest frequency [Hz].
        may_jump: Whether controls may jump from one sample to the next.
    """

    t: Array
    horizon: float
    nu: int
    min_frequency: float
    max_frequency: float
    may_jump: bool

    def frequency(self, z: Array) -> Array:
        """Map parameters in [0, 1] to frequencies on a logarithmic scale.

        Args:
            z: (...) parameters in [0, 1].

        Returns:
            (...) frequencies [Hz].
        """
        return self.min_frequency * (self.max_frequency / self.min_frequency) ** z


def relative_amplitudes(z: Array) -> Array:
    """Amplitudes of several actuators; the largest one is 1.

    Args:
        z: (nu,) parameters in [0, 1].

    Returns:
        (nu,) amplitudes.
    """
    amplitude = MIN_RELATIVE_AMPLITUDE ** (1.0 - z)
    return np.asarray(amplitude / amplitude.max())


def chirp(settings: ExcitationSettings, z: Array) -> Array:
    """A linear frequency sweep of every actuator.

    Args:
        settings: Settings of all excitations.
        z: (5 nu,) amplitude, first frequency, last frequency, phase and offset of every actuator,
            from 0 to 1.

    Returns:
        (N, nu) curves about zero with a peak of about 1.
    """
    amplitude, first, last, phase, offset = z.reshape(5, settings.nu)

    first_frequency = settings.frequency(first).tolist()
    last_frequency = settings.frequency(last).tolist()
    degrees = (360.0 * phase).tolist()
    sweeps = [
        scipy.signal.chirp(settings.t, f0, settings.horizon, f1, phi=phi)
        for f0, f1, phi in zip(first_frequency, last_frequency, degrees, strict=True)
    ]

    centred = np.stack(sweeps, axis=1) + (offset - 0.5)
    return relative_amplitudes(amplitude) * centred


def schroeder_phases(power: Array) -> Array:
    """Phases with which the sum of harmonics has a low peak (Schroeder 1970).

    Args:
        power: (K,) power of every harmonic.

    Returns:
        (K,) phases [rad].
    """
    return -2.0 * np.pi * np.concatenate([[0.0], np.cumsum(np.cumsum(power / power.sum()))[:-1]])


def harmonic_orders(highest: float, share: float) -> np.ndarray:
    """Orders of a share of the harmonics up to a highest order; at least two of several."""
    most = min(MAX_HARMONICS, max(int(highest), 1))
    return np.arange(1, 1 + max(round(most * share), min(2, most)))


def multisine(settings: ExcitationSettings, z: Array) -> Array:
    """A sum of harmonics with Schroeder phases for every actuator.

    Args:
        settings: Settings of all excitations.
        z: (3 + 2 nu,) base frequency, number of harmonics and their roll-off, then amplitude and
            delay of every actuator, from 0 to 1.

    Returns:
        (N, nu) curves about zero with a peak of about 1.
    """
    # The base frequency allows for two harmonics if the frequency range does.
    base, highest = settings.min_frequency, settings.max_frequency
    if highest > 2.0 * base:
        base *= (0.5 * highest / base) ** z[0]
    amplitude, delay = z[3:].reshape(2, settings.nu)

    order = harmonic_orders(settings.max_frequency / base, z[1])
    power = order ** (-2.0 * MAX_ROLL_OFF * z[2])

    delayed = settings.t[:, None, None] - (delay / base)[:, None]
    angle = 2.0 * np.pi * base * order * delayed
    waves = np.sqrt(power) * np.cos(angle + schroeder_phases(power))
    curve = waves.sum(axis=2)
    return np.asarray(relative_amplitudes(amplitude) * curve / np.abs(curve).max(axis=0))


def random_steps(settings: ExcitationSettings, z: Array) -> Array:
    """Random levels of every actuator, each of which is held for some time.

    Args:
        settings: Settings of all excitations.
        z: (2 + MAX_LEVELS nu,) duration of a level, the fraction of it that is a smooth transition
            (unused if jumps are allowed), and the levels of every actuator, from 0 to 1.

    Returns:
        (N, nu) curves about zero with a peak of about 1.
    """
    held = settings.horizon / (3.0 * (MAX_LEVELS / 3.0) ** z[0])
    index = np.minimum((settings.t / held).astype(int), MAX_LEVELS - 1)

    levels = 2.0 * z[2:].reshape(MAX_LEVELS, settings.nu) - 1.0
    levels = np.concatenate([np.zeros((1, settings.nu)), levels])

    # Progress of the transition from the previous level to the present one, 0 to 1.
    progress = (settings.t / held - index) / max(float(z[1]), SHORTEST_TRANSITION)
    smooth = 0.5 - 0.5 * np.cos(np.pi * np.clip(progress, 0.0, 1.0))
    share = np.where(settings.may_jump, 1.0, smooth)[:, None]
    return np.asarray((1.0 - share) * levels[index] + share * levels[index + 1])


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


@record
class BaselineSearch:
    """Order for one search by a baseline. It can be pickled.

    Attributes:
        experiment: The experiment.
        method: Key of the baseline.
        seconds: Time of the search [s].
        seed: Seed of its random numbers.
        part: Number of this search among those of one baseline, and how many there are.
        combinations: Basis of the identifiable combinations; None where all are identifiable.
        added: What other experiments tell, besides the stated `earlier` files.
        threads: Number of threads; None for all.
    """

    experiment: Experiment
    method: str
    seconds: float
    seed: int = 0
    part: tuple[int, int] = (0, 1)
    combinations: Array | None = None
    added: EarlierExperiments | None = None
    threads: int | None = None

    def generator(self) -> np.random.Generator:
        """Random generator of this search."""
        return np.random.default_rng((self.seed, *self.part))

    def task(self, **tables: Any) -> DesignTask:
        """The task of the experiment with changed tables."""
        return DesignTask.resolve(
            self.experiment.replace(**tables),
            threads=self.threads,
            added=self.added,
        )


@one_blas_thread()
def run_baseline(
    search: BaselineSearch, callback: SearchCallback | None = None, stop: StopToken | None = None
) -> MethodResult:
    """Run a baseline until its time is over. An executor can call this in a worker process.

    Args:
        search: The order.
        callback: Called whenever the search has made progress, or not for a while.
        stop: Ends the search early; None for the request of the pool of this process.
    """
    budget = Budget(seconds=search.seconds, stop=stop or pool_stop_token())
    task = search.task()
    found = METHODS[search.method](search, task, budget, callback or (lambda cost: None))
    return replace(found, seconds=budget.seconds_used)


# ---- random search


def _search_at_random(
    search: BaselineSearch,
    stated: DesignTask,
    budget: Budget,
    show: SearchCallback,
    *,
    wave: Callable[[ExcitationSettings, Array], Array],
    counts: tuple[int, int],
) -> MethodResult:
    """Search over the numbers of an excitation, about the best ones or everywhere.

    counts: Numbers that all actuators share, and those of each actuator.
    """
    task = stated.relaxed() if stated.is_limited else stated
    level = DescentLevel(task, search.combinations)
    rng = search.generator()
    settings = _settings(level)
    count = 1 + counts[0] + counts[1] * settings.nu
    basis, window = task.bandwidth_basis(task.t), task.fade(task.samples)
    bounds = level.constraints.control.bounds
    is_bounded = bool(np.isfinite(bounds.lower).all())
    largest = LARGEST_BOUNDED_SCALE if is_bounded else LARGEST_UNBOUNDED_SCALE
    has_weights = bool(task.control_weight.any() or task.tracking.any()) or not task.is_limited

    best, spread = np.zeros(0), FIRST_SPREAD
    found = MethodResult(method=search.method, cost=np.inf)
    while budget.exhausted is None:
        show(found.cost)
        # The first number is the size, which matters where weights in the cost decide about it.
        numbers = rng.random(count)
        is_local = len(best) > 0 and rng.random() > GLOBAL_SHARE
        if is_local:
            changed = rng.random(len(numbers)) < max(CHANGED_SHARE, MIN_CHANGED / len(numbers))
            numbers = reflected(best + spread * changed * rng.normal(size=len(numbers)))

        deviation = largest * window * wave(settings, numbers[1:]) * bounds.scale
        if basis is not None:
            deviation = basis @ np.linalg.lstsq(basis, deviation)[0]
        scale: float | None = 1.0
        if task.is_limited:
            scale = largest_share(partial(_keeps_share, level, deviation), budget)
        if scale is None:
            continue
        if has_weights:
            scale *= SMALLEST_WEIGHTED_SCALE ** (1.0 - numbers[0])
        control = task.centre + scale * deviation
        values = level.values(control)
        is_inside = values is not None and level.constraints.is_feasible(values)
        point = level.point_along(values) if is_inside or not task.is_limited else None
        J = np.inf if point is None else point.cost

        # Widen the local search after a success, narrow it after a failure.
        if is_local:
            factor = SPREAD_AFTER_SUCCESS if found.cost > J else SPREAD_AFTER_FAILURE
            spread = np.clip(spread * factor, *SPREAD_RANGE)
        if found.cost > J:
            best, found = numbers, replace(found, control=control, cost=J)
    return replace(found, steps=task.plant.engine_steps)


def _keeps_share(level: DescentLevel, deviation: Array, share: float) -> bool:
    """Check whether a share of a deviation from the centre keeps the limits."""
    return level.nearly_keeps(level.task.centre + share * deviation)


def _settings(level: DescentLevel) -> ExcitationSettings:
    """Settings of the excitations of an experiment."""
    task = level.task
    experiment = task.experiment
    bandwidth = experiment.limits.bandwidth
    fastest = min(bandwidth or np.inf, 0.25 * experiment.rate, MAX_CYCLES / task.horizon)
    is_smooth = level.constraints.rate is not None or bandwidth is not None
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
    return 1.0 - np.abs(1.0 - np.abs(numbers) % 2.0)


# ---- optimised series


def _optimise(
    search: BaselineSearch,
    stated: DesignTask,
    budget: Budget,
    show: SearchCallback,
    *,
    harmonics: int | None,
) -> MethodResult:
    """Optimise Fourier series of some harmonics, or B-splines where `harmonics` is None."""
    level = DescentLevel(stated, search.combinations)
    optimiser = Search(
        stage=level,
        first=level.problem.point(stated.initial),
        budget=budget,
        keeps_curves=True,
    )
    best = np.inf

    def watch(event: DesignEvent) -> None:
        nonlocal best
        if not event.row.margin < 0.0:
            best = min(best, event.row.cost)
        show(best)

    part, parts = search.part
    starts = list(series_of(stated, search.generator(), harmonics))[part::parts]
    results = consume(optimiser.run(starts), watch)
    nothing = MethodResult(method=search.method, cost=np.inf, steps=optimiser.steps)
    found = min(results, key=lambda each: (each.cost, each.rank), default=None)
    if found is None:
        return nothing
    control = found.over_horizon if found.best is None else found.best
    return replace(nothing, control=control, cost=found.cost, found_by=found.name)


Method = Callable[[BaselineSearch, DesignTask, Budget, SearchCallback], MethodResult]

# The baselines by their keys.
METHODS: dict[str, Method] = {
    "chirp": partial(_search_at_random, wave=chirp, counts=(0, 5)),
    "multisine": partial(_search_at_random, wave=multisine, counts=(3, 2)),
    "steps": partial(_search_at_random, wave=random_steps, counts=(2, MAX_LEVELS)),
    "fourier5": partial(_optimise, harmonics=5),
    "fourier15": partial(_optimise, harmonics=15),
    "splines": partial(_optimise, harmonics=None),
}

# Their names for the user.
TITLES = {
    "chirp": "chirp",
    "multisine": "multisine (Schroeder)",
    "steps": "random steps",
    "fourier5": "Fourier 5",
    "fourier15": "Fourier 15",
    "splines": "B-splines",
}
