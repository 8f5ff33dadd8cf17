"""Initial controls of a design: stated ones, multisines, Fourier series and earlier designs."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.excitation.search.climb import Candidate
from mjfim.excitation.task import DesignTask
from mjfim.experiment.initial import fourier_basis, independent_curves
from mjfim.experiment.packing import opened
from mjfim.recordings.delimited import read_control

# Largest number of harmonics of a Fourier series.
MAX_SERIES_HARMONICS = 15

# Periods within the horizon of the first harmonic of the first Fourier series, and of the bandwidth
# of the first B-splines.
FOURIER_PERIODS = (0.5, 0.25, 1.0, 2.0)
SPLINE_PERIODS = (3.0, 6.0)

# Number of further series and splines at random frequencies.
RANDOM_SERIES = 15

# Smallest and largest number of periods of the first harmonic within the horizon, and smallest
# number of harmonics, for Fourier series at random base frequencies.
RANDOM_PERIODS = (0.4, 5.0)
MIN_RANDOM_HARMONICS = 5

# Random bandwidths lie between these multiples of the smallest and of the largest usual one.
RANDOM_BANDWIDTH_FACTORS = (0.5, 2.0)

# Smallest and largest amplitude of a random multisine, relative to that of the initial control.
LEAST_RANDOM_AMPLITUDE = 1.0
MOST_RANDOM_AMPLITUDE = 6.0


# Name of a control from which a caller begins.
GIVEN = "given control"


def _previous_designs(task: DesignTask) -> Iterator[Candidate]:
    """The controls of earlier designs that `[descent]` states."""
    for path in dict.fromkeys(task.experiment.descent.previous):
        # A shorter design is repeated.
        with opened(task.experiment, path) as file:
            control = read_control(file, task.t, task.dt, task.controls, repeat=True)
        yield Candidate(name=f"previous design {path}", control=control)


def initial_controls_of(task: DesignTask, given: Array | None) -> Iterator[Candidate]:
    """Collect the controls from which a design starts.

    Args:
        task: The task.
        given: (N, nu) control that replaces the initial one, or None.

    Returns:
        The given or the initial control, then those that `[descent]` states: earlier designs,
        Fourier series, repeated parts, random multisines. The multisines are made when they are
        needed.

    Raises:
        ExperimentError: A file, a frequency or a number of repeats cannot be used.
    """
    descent = task.experiment.descent
    first = Candidate(name="initial control", control=task.control)
    if given is not None:
        first = Candidate(name=GIVEN, control=given)

    found = [first, *_previous_designs(task)]

    # Fourier series and multisines share one source of random numbers, in this order.
    rng = np.random.default_rng(descent.seed)
    frequencies = dict.fromkeys(descent.fourier)
    found.extend(_fourier_series(task, frequency, rng) for frequency in frequencies)
    for count in dict.fromkeys(descent.repeats):
        name = f"{count} times a design of {task.horizon / count:g} s"
        part = _first_part(task, count)
        found.append(Candidate(name=name, control=part, repeats=count))

    last = descent.starts - 1
    multisines = (
        Candidate(name=f"multisine {i} of {last}", control=_multisine(task, rng))
        for i in range(1, last + 1)
    )
    return chain(found, multisines)


def _multisine(task: DesignTask, rng: np.random.Generator) -> Array:
    """(N, nu) random multisine within the ranges of the controls [u-unit]."""
    return task.random_control(rng, LEAST_RANDOM_AMPLITUDE, MOST_RANDOM_AMPLITUDE)


def _fourier_series(task: DesignTask, frequency: float, rng: np.random.Generator) -> Candidate:
    """Fit a Fourier series of a frequency [Hz] to a random multisine.

    Raises:
        ExperimentError: The frequency is above the bandwidth.
    """
    bandwidth = _fastest(task)
    if frequency > bandwidth:
        raise ExperimentError(
            f"{task.experiment.source}: descent.fourier: {frequency:g} Hz is above the bandwidth "
            f"of {bandwidth:g} Hz"
        )
    wanted = _multisine(task, rng)
    return _in_curves(f"Fourier series of {frequency:g} Hz", task, wanted, _waves(task, frequency))


def _fastest(task: DesignTask) -> float:
    """The stated bandwidth, or half of the sample rate [Hz]."""
    return task.experiment.limits.bandwidth or 0.5 * task.experiment.rate


def _waves(task: DesignTask, frequency: float, harmonics: int = MAX_SERIES_HARMONICS) -> Array:
    """(N, M) waves of a base frequency [Hz] within the bandwidth that keep the boundary."""
    count = max(min(harmonics, int(_fastest(task) / frequency + 1e-9)), 1)
    boundary = task.experiment.boundary
    from_rest, to_rest = boundary.start == "rest", boundary.end == "rest"
    waves = fourier_basis(task.t, task.horizon, frequency, count, from_rest, to_rest)
    return independent_curves(waves)


def _in_curves(name: str, task: DesignTask, control: Array, curves: Array) -> Candidate:
    """The sum of curves, (N, M), that is nearest to a control."""
    coefficients = np.linalg.lstsq(curves, control - task.centre)[0]
    return Candidate(name=name, control=task.centre + curves @ coefficients, curves=curves)


def series_of(
    task: DesignTask, rng: np.random.Generator, harmonics: int | None = MAX_SERIES_HARMONICS
) -> Iterator[Candidate]:
    """Make series that are near the initial control, and then random ones.

    Args:
        task: The task.
        rng: Source of random numbers.
        harmonics: Largest number of harmonics of Fourier series; None for B-splines.

    Yields:
        Series at usual frequencies, and then at random ones.
    """
    fastest = _fastest(task)

    def curves_of(frequency: float) -> Array:
        """(N, M) curves of a base frequency or of a bandwidth [Hz]."""
        if harmonics is None:
            return independent_curves(task.boundary_splines(task.t, frequency))
        return _waves(task, frequency, harmonics)

    if harmonics is None:
        periods: tuple[float, ...] = SPLINE_PERIODS
        ends = np.multiply(RANDOM_BANDWIDTH_FACTORS, (periods[0], periods[-1]))
        highest = fastest
    else:
        periods = FOURIER_PERIODS
        ends = np.array(RANDOM_PERIODS)
        highest = fastest / min(harmonics, MIN_RANDOM_HARMONICS)
    usual = np.divide(periods, task.horizon)
    ends = np.minimum(ends / task.horizon, highest)

    kind = "B-splines" if harmonics is None else "Fourier series"
    for frequency in (each for each in usual if each <= fastest):
        yield _in_curves(f"{kind} of {frequency:.3g} Hz", task, task.control, curves_of(frequency))
    for number in range(1, RANDOM_SERIES + 1):
        frequency = float(np.exp(rng.uniform(*np.log(ends))))
        basis = curves_of(frequency)
        coefficients = rng.normal(size=(basis.shape[1], len(task.centre)))
        deviation = basis @ coefficients * task.plant.sizes.control / np.sqrt(basis.shape[1])
        name = f"{kind} of {frequency:.3g} Hz, at random ({number})"
        yield Candidate(name=name, control=task.centre + deviation, curves=basis)


def _first_part(task: DesignTask, count: int) -> Array:
    """First part of the initial control, faded where it has to begin or end at rest.

    Args:
        task: The task with N samples.
        count: Number of equal parts of the horizon.

    Returns:
        (N / count, nu) control [u-unit].

    Raises:
        ExperimentError: The horizon cannot be divided into this number of parts.
    """
    source = task.experiment.source
    samples = task.samples // count
    if task.samples % count:
        raise ExperimentError(
            f"{source}: descent.repeats: {count} does not divide the {task.samples} samples"
        )

    fewest = max(2, task.system.grid.stride)
    if samples < fewest:
        raise ExperimentError(
            f"{source}: descent.repeats: {count} leaves {samples} of {task.samples} samples; needs "
            f"{fewest}"
        )
    if not task.is_limited:
        raise ExperimentError(
            f"{source}: descent.repeats needs hard limits; without them, begin with a shorter "
            "design: descent.previous"
        )

    deviation = task.control[:samples] - task.centre
    return np.asarray(task.centre + task.fade(samples) * deviation)
