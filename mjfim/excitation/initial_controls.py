"""Where a design may begin: the initial control, random multisines, Fourier series to be optimised first, earlier designs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.excitation.task import DesignTask
from mjfim.recordings.control_table import read_control
from mjfim.signals import fourier_basis

HARMONICS = 10  # of random multisines
SERIES = 15  # harmonics of a Fourier series that is optimised first
SWELL = 0.1  # share of the horizon over which a random start swells from rest and fades to it


@dataclass(frozen=True, eq=False)
class InitialControl:
    """A control to begin with. control: (N, nu);  basis: (N, M) what it is optimised within at first, or None: anything

    repeats: times that the horizon is longer than the control, which is optimised alone at first, then played so many times
    """

    name: str
    control: Array
    basis: Array | None = None
    repeats: int = 1

    @property
    def whole(self) -> Array:
        """(N, nu) over the whole horizon."""
        return np.tile(self.control, (self.repeats, 1))


def initial_controls_of(task: DesignTask, given: Array | None) -> Iterator[InitialControl]:
    """The given or initial control, then what the experiment's [descent] asks for. Raises for what is not there at once."""
    e, d = task.experiment, task.experiment.descent
    found = [
        InitialControl("initial control", task.control)
        if given is None
        else InitialControl("given control", given)
    ]
    found += [
        InitialControl(f"previous design {path}", previous(task, path))
        for path in dict.fromkeys(d.previous)
    ]
    begins, ends = e.boundary.start == "rest", e.boundary.end == "rest"
    rng = np.random.default_rng(d.seed)
    for frequency in dict.fromkeys(d.fourier):
        most = e.limits.bandwidth or 0.5 * e.rate
        harmonics = int(min(SERIES, most / frequency))
        if harmonics < 1:
            raise ExperimentError(
                f"{e.source}: descent.fourier: {frequency:g} Hz is above the bandwidth of {most:g} Hz"
            )
        series = fourier_basis(task.t, task.horizon, frequency, harmonics, begins, ends)
        fitted = series @ np.linalg.lstsq(series, _random(task, rng) - task.centre)[0]
        found.append(
            InitialControl(f"Fourier series of {frequency:g} Hz", task.centre + fitted, series)
        )
    for count in dict.fromkeys(d.repeats):
        found.append(
            InitialControl(
                f"{count} times a design of {task.horizon / count:g} s",
                _part(task, count),
                repeats=count,
            )
        )
    multisines = (
        InitialControl(f"multisine {i} of {d.starts - 1}", _random(task, rng))
        for i in range(1, d.starts)
    )
    return chain(found, multisines)


def previous(task: DesignTask, path: str) -> Array:
    """(N, nu) control of an earlier design's design.csv, repeated where it is shorter."""
    file = task.experiment.directory / path
    return read_control(file, task.t, task.dt, task.controls, repeat=True)


def _part(task: DesignTask, count: int) -> Array:
    """(N / count, nu) first part of the initial control. Raises ExperimentError where it is no part."""
    source = task.experiment.source
    samples = task.samples // count
    if task.samples % count:
        raise ExperimentError(
            f"{source}: descent.repeats: {count} does not divide the {task.samples} samples"
        )
    fewest = max(2, task.system.grid.stride)
    if samples < fewest:
        raise ExperimentError(
            f"{source}: descent.repeats: {count} leaves {samples} of {task.samples} samples; needs {fewest}"
        )
    if not task.is_limited:
        raise ExperimentError(
            f"{source}: descent.repeats needs hard limits; without, start from a shorter design (previous)"
        )
    return np.asarray(task.centre + task.fade(samples) * (task.control[:samples] - task.centre))


def _random(task: DesignTask, rng: np.random.Generator) -> Array:
    """A multisine about the middle of the initial control, up to six times its size, inside the controls' ranges."""
    return task.random_control(rng, 1.0, 6.0)
