"""Where a design may begin: the initial control, random multisines, Fourier series to be optimised first, earlier designs."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mjfim.basis import fourier_basis
from mjfim.errors import ExperimentError, SimulationDiverged
from mjfim.setup import Setup
from mjfim.signals import multisine, read_control
from mjfim.trajectory import Array, Trajectory

HARMONICS = 10  # of random multisines
SERIES = 15  # harmonics of a Fourier series that is optimised first
SWELL = 0.1  # share of the horizon over which a random start swells from rest and fades to it


@dataclass(frozen=True, eq=False)
class Start:
    """A control to begin with. control: (N, nu);  basis: (N, M) what it is optimised within at first, or None: anything"""

    name: str
    control: Array
    basis: Array | None = None


def starts_of(setup: Setup, given: Array | None) -> Iterator[Start]:
    """The given or initial control, then what the experiment's [descent] asks for."""
    e, d = setup.experiment, setup.experiment.descent
    yield Start("initial control", setup.control) if given is None else Start("given control", given)
    for path in d.previous:
        yield Start(f"previous design {path}", previous(setup, path))
    begins, ends = e.boundary.start == "rest", e.boundary.end == "rest"
    rng = np.random.default_rng(d.seed)
    for frequency in d.fourier:
        most = e.limits.bandwidth or 0.5 * e.rate
        harmonics = int(min(SERIES, most / frequency))
        if harmonics < 1:
            raise ExperimentError(
                f"{e.source}: descent.fourier: {frequency:g} Hz is above the bandwidth of {most:g} Hz"
            )
        series = fourier_basis(setup.t, e.horizon, frequency, harmonics, begins, ends)
        yield Start(f"Fourier series of {frequency:g} Hz", _random(setup, rng), series)
    for i in range(1, d.starts):
        yield Start(f"multisine {i} of {d.starts - 1}", _random(setup, rng))


def previous(setup: Setup, path: str) -> Array:
    """(N, nu) control of an earlier design's design.csv, repeated where it is shorter."""
    file = setup.experiment.directory / path
    return read_control(file, setup.t, setup.dt, setup.controls, repeat=True)


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
    control = (setup.hold if setup.experiment.boundary.start == "rest" else mean) + swell(setup) * swing
    for limit in setup.limits:
        if limit.kind == "control":
            control[:, limit.index] = np.clip(control[:, limit.index], limit.lower, limit.upper)
    return np.asarray(control)


def swell(setup: Setup) -> Array:
    """(N, 1) by which a swing about the hold rises from rest and fades to it, where the experiment begins and ends so."""
    boundary, share = setup.experiment.boundary, setup.t[:, None] / setup.experiment.horizon
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
        except SimulationDiverged:
            continue
