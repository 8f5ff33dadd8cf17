"""Where a design may begin: the initial control, random multisines, Fourier series to be optimised first, earlier designs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, SimulationDivergedError
from mjfim.experiment.system import Setup
from mjfim.recordings.control_table import read_control
from mjfim.records.trajectory import Trajectory
from mjfim.signals import fourier_basis, multisine

HARMONICS = 10  # of random multisines
SERIES = 15  # harmonics of a Fourier series that is optimised first
SWELL = 0.1  # share of the horizon over which a random start swells from rest and fades to it


@dataclass(frozen=True, eq=False)
class Start:
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


def starts_of(setup: Setup, given: Array | None) -> Iterator[Start]:
    """The given or initial control, then what the experiment's [descent] asks for. Raises for what is not there at once."""
    e, d = setup.experiment, setup.experiment.descent
    found = [
        Start("initial control", setup.control) if given is None else Start("given control", given)
    ]
    found += [
        Start(f"previous design {path}", previous(setup, path))
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
        series = fourier_basis(setup.t, e.horizon, frequency, harmonics, begins, ends)
        fitted = series @ np.linalg.lstsq(series, _random(setup, rng) - setup.centre)[0]
        found.append(Start(f"Fourier series of {frequency:g} Hz", setup.centre + fitted, series))
    for count in dict.fromkeys(d.repeats):
        found.append(
            Start(
                f"{count} times a design of {e.horizon / count:g} s",
                _part(setup, count),
                repeats=count,
            )
        )
    multisines = (
        Start(f"multisine {i} of {d.starts - 1}", _random(setup, rng)) for i in range(1, d.starts)
    )
    return chain(found, multisines)


def previous(setup: Setup, path: str) -> Array:
    """(N, nu) control of an earlier design's design.csv, repeated where it is shorter."""
    file = setup.experiment.directory / path
    return read_control(file, setup.t, setup.dt, setup.controls, repeat=True)


def _part(setup: Setup, count: int) -> Array:
    """(N / count, nu) first part of the initial control. Raises ExperimentError where it is no part."""
    source = setup.experiment.source
    samples = setup.samples // count
    if setup.samples % count:
        raise ExperimentError(
            f"{source}: descent.repeats: {count} does not divide the {setup.samples} samples"
        )
    if samples < max(2, setup.stride):
        raise ExperimentError(
            f"{source}: descent.repeats: {count} leaves {samples} of {setup.samples} samples; needs {max(2, setup.stride)}"
        )
    if not setup.enforced:
        raise ExperimentError(
            f"{source}: descent.repeats needs hard limits; without, start from a shorter design (previous)"
        )
    return np.asarray(
        setup.centre + swell(setup, samples) * (setup.control[:samples] - setup.centre)
    )


def _random(setup: Setup, rng: np.random.Generator) -> Array:
    """A multisine about the middle of the initial control, up to six times its size, inside the controls' ranges."""
    return random_control(setup, rng, 1.0, 6.0)


def random_control(setup: Setup, rng: np.random.Generator, least: float, most: float) -> Array:
    """(N, nu) multisine about the initial control's mean, of `least` to `most` times its size, within the controls' ranges.

    It swells from what holds the start, and fades, where the experiment begins and ends at rest.
    """
    mean = setup.control.mean(axis=0)
    peak = np.abs(setup.control - mean).max(axis=0)
    peak = np.where(peak > 0.0, peak, 1.0)
    wave = multisine(setup.t, len(setup.controls), 1.0 / setup.experiment.horizon, HARMONICS, rng)
    swing = peak * rng.uniform(least, most) * wave
    control = (setup.hold if setup.experiment.boundary.start == "rest" else mean) + swell(
        setup
    ) * swing
    for limit in setup.limits:
        if limit.kind == "control":
            control[:, limit.index] = np.clip(control[:, limit.index], limit.lower, limit.upper)
    return np.asarray(control)


def swell(setup: Setup, samples: int | None = None) -> Array:
    """(N, 1) by which a swing about the hold rises from rest and fades to it, where the experiment begins and ends so.

    samples: N, default: all
    """
    boundary, N = setup.experiment.boundary, setup.samples if samples is None else samples
    share = np.arange(N)[:, None] / N
    window = np.ones_like(share)
    if boundary.start == "rest":
        window = window * np.clip(share / SWELL, 0.0, 1.0)
    if boundary.end == "rest":
        window = window * np.clip((1.0 - share) / SWELL - 1.0, 0.0, 1.0)
    return np.asarray(window)


def probes(setup: Setup, count: int) -> Iterator[Trajectory]:
    """Trajectories of random controls, one or two times the size of the initial one; those that diverge are left out."""
    rng = np.random.default_rng(setup.experiment.descent.seed)
    for _ in range(count):
        try:
            yield setup.plant.simulate(setup.theta, random_control(setup, rng, 1.0, 2.0))
        except SimulationDivergedError:
            continue
