"""Initial controls of a design: stated ones, multisines, Fourier series and earlier designs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.initial import fourier_basis
from mjfim.experiment.packing import opened
from mjfim.recordings.control_table import read_control

# Largest number of harmonics of a Fourier series.
MAX_SERIES_HARMONICS = 15

# Smallest and largest amplitude of a random multisine, relative to that of the initial control.
LEAST_RANDOM_AMPLITUDE = 1.0
MOST_RANDOM_AMPLITUDE = 6.0


# Name of a control from which a caller begins.
GIVEN = "given control"


@dataclass(frozen=True, kw_only=True, eq=False)
class InitialControl:
    """A control from which an optimisation starts.

    Attributes:
        name: Its name in histories and messages.
        control: (N / repeats, nu) control [u-unit].
        basis: (N, M) curves of which the control is a sum in the first round of the optimisation;
            None where the control is free.
        repeats: Number of times that the control is played over the horizon. In the first round of
            the optimisation one repetition is optimised alone.
    """

    name: str
    control: Array
    basis: Array | None = None
    repeats: int = 1

    @property
    def over_horizon(self) -> Array:
        """(N, nu) control over the whole horizon."""
        return np.tile(self.control, (self.repeats, 1))


def initial_controls_of(task: DesignTask, given: Array | None) -> Iterator[InitialControl]:
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
    first = InitialControl(name="initial control", control=task.control)
    if given is not None:
        first = InitialControl(name=GIVEN, control=given)

    found = [first]
    for path in dict.fromkeys(descent.previous):
        control = control_of_earlier_design(task, path)
        found.append(InitialControl(name=f"previous design {path}", control=control))

    # Fourier series and multisines share one source of random numbers, in this order.
    rng = np.random.default_rng(descent.seed)
    frequencies = dict.fromkeys(descent.fourier)
    found.extend(_fourier_series(task, frequency, rng) for frequency in frequencies)
    for count in dict.fromkeys(descent.repeats):
        name = f"{count} times a design of {task.horizon / count:g} s"
        part = _first_part(task, count)
        found.append(InitialControl(name=name, control=part, repeats=count))

    return chain(found, _multisines(task, rng))


def control_of_earlier_design(task: DesignTask, path: str) -> Array:
    """(N, nu) control of the design.csv of an earlier design, repeated where it is shorter."""
    with opened(task.experiment, path) as file:
        return read_control(file, task.t, task.dt, task.controls, repeat=True)


def _multisines(task: DesignTask, rng: np.random.Generator) -> Iterator[InitialControl]:
    """The random multisines; their number is that of `descent.starts` minus the initial one."""
    last = task.experiment.descent.starts - 1
    for i in range(1, last + 1):
        yield InitialControl(name=f"multisine {i} of {last}", control=_multisine(task, rng))


def _multisine(task: DesignTask, rng: np.random.Generator) -> Array:
    """(N, nu) random multisine within the ranges of the controls [u-unit]."""
    return task.random_control(rng, LEAST_RANDOM_AMPLITUDE, MOST_RANDOM_AMPLITUDE)


def _fourier_series(task: DesignTask, frequency: float, rng: np.random.Generator) -> InitialControl:
    """Fit a Fourier series of a frequency [Hz] to a random multisine.

    Raises:
        ExperimentError: The frequency is above the bandwidth.
    """
    experiment = task.experiment
    bandwidth = experiment.limits.bandwidth or 0.5 * experiment.rate
    harmonics = int(min(MAX_SERIES_HARMONICS, bandwidth / frequency))
    if harmonics < 1:
        raise ExperimentError(
            f"{experiment.source}: descent.fourier: {frequency:g} Hz is above the bandwidth of "
            f"{bandwidth:g} Hz"
        )

    wanted = _multisine(task, rng) - task.centre
    starts_at_rest = experiment.boundary.start == "rest"
    ends_at_rest = experiment.boundary.end == "rest"
    basis = fourier_basis(task.t, task.horizon, frequency, harmonics, starts_at_rest, ends_at_rest)
    coefficients = np.linalg.lstsq(basis, wanted)[0]
    control = task.centre + basis @ coefficients
    return InitialControl(name=f"Fourier series of {frequency:g} Hz", control=control, basis=basis)


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
