"""Curves that a control may follow: linear combinations of a few functions of time. Arrays only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import BSpline
from scipy.signal import chirp

from mjfim.arrays import Array

DEGREE = 3
FAINT = 1e-5  # size of a combination of curves, over the largest


def spline_basis(
    t: Array, horizon: float, bandwidth: float, begins: bool, ends: bool, periodic: bool
) -> Array:
    """(N, M) cubic B-splines at times t: (N,) [s] with a knot every 1/(2 bandwidth) s.

    begins, ends: value and slope are zero there;  periodic: the curve and two derivatives meet at the ends
    """
    pieces = max(int(np.ceil(2.0 * bandwidth * horizon)), DEGREE + 1)
    knots = horizon / pieces * np.arange(-DEGREE, pieces + DEGREE + 1)
    if periodic:
        values = BSpline.design_matrix(t, knots, DEGREE).toarray()
        values[:, :DEGREE] += values[:, pieces:]
        return np.asarray(values[:, :pieces])
    knots = np.clip(knots, 0.0, horizon)
    values = BSpline.design_matrix(t, knots, DEGREE).toarray()
    return np.asarray(values[:, 2 * begins : values.shape[1] - 2 * ends])


def fourier_basis(
    t: Array, horizon: float, frequency: float, harmonics: int, begins: bool, ends: bool
) -> Array:
    """(N, 2 harmonics) sines and cosines of multiples of a base frequency [Hz], each of size 1.

    Where the curve has to begin or end at rest, the polynomial of least degree that has the same value and first two
    derivatives there is taken off (a finite Fourier series with a quintic, as for point-to-point excitation).
    """
    omega = 2.0 * np.pi * frequency * np.arange(1, harmonics + 1)

    def waves(times: Array, order: int) -> Array:
        angle = np.outer(times, omega) + 0.5 * np.pi * order
        return np.asarray(
            np.concatenate([np.sin(angle), np.cos(angle)], axis=1) * np.tile(omega**order, 2)
        )

    places = [*([0.0] if begins else []), *([horizon] if ends else [])]
    conditions = [(place, order) for place in places for order in range(3)]
    if not conditions:
        return waves(t, 0)
    powers = np.arange(len(conditions))

    def polynomials(times: Array, order: int) -> Array:
        factor = np.array(
            [np.prod(np.arange(k - order + 1, k + 1)) if k >= order else 0.0 for k in powers]
        )
        return np.asarray(
            factor * (times[:, None] / horizon) ** np.maximum(powers - order, 0) / horizon**order
        )

    system = np.concatenate([polynomials(np.array([place]), order) for place, order in conditions])
    wanted = np.concatenate([waves(np.array([place]), order) for place, order in conditions])
    return waves(t, 0) - polynomials(t, 0) @ np.linalg.solve(system, wanted)


def independent(curves: Array) -> Array:
    """(N, M) curves, or fewer that span the same but for what is faint: splines finer than samples, waves like polynomials."""
    U, sizes, _ = np.linalg.svd(curves, full_matrices=False)
    kept = sizes > FAINT * sizes[0]
    if kept.sum() == curves.shape[1]:
        return curves
    return np.asarray(U[:, kept] * np.sqrt(0.5 * len(curves)))


HARMONICS = 30  # of a multisine at most
LEVELS = 24  # of random steps at most
FAINTEST = 0.05  # amplitude of one actuator over that of another, at least
STEEPEST = 2.0  # amplitudes of a multisine fall with this power of the frequency at most


@dataclass(frozen=True, eq=False)
class Frame:
    """What all excitations of an experiment have in common.

    t: (N,) sample times, horizon [s];  nu: actuators;  slowest, fastest: [Hz]
    jumps: whether controls may jump from one sample to the next
    """

    t: Array
    horizon: float
    nu: int
    slowest: float
    fastest: float
    jumps: bool

    def pitch(self, z: Array) -> Array:
        """Frequencies [Hz] from numbers."""
        return np.asarray(self.slowest * (self.fastest / self.slowest) ** z)


class Excitation(Protocol):
    """numbers: how many it is made of"""

    @property
    def numbers(self) -> int:
        """How many."""
        ...

    def wave(self, z: Array) -> Array:
        """(N, nu) about zero, of size 1 at most or little more."""
        ...


def amplitudes(z: Array) -> Array:
    """Amplitudes from numbers, the largest one 1."""
    size = FAINTEST ** (1.0 - z)
    return np.asarray(size / size.max())


@dataclass(frozen=True)
class Chirp:
    """A linear sweep of each actuator: amplitude, first and last frequency, phase, offset."""

    frame: Frame

    @property
    def numbers(self) -> int:
        """Five of each actuator."""
        return 5 * self.frame.nu

    def wave(self, z: Array) -> Array:
        """(N, nu)."""
        f = self.frame
        size, first, last, phase, offset = z.reshape(5, f.nu)
        ends = zip(
            f.pitch(first).tolist(), f.pitch(last).tolist(), (360.0 * phase).tolist(), strict=True
        )
        sweeps = np.stack([chirp(f.t, a, f.horizon, b, phi=p) for a, b, p in ends], axis=1)
        return np.asarray(amplitudes(size) * (sweeps + (offset - 0.5)))


def schroeder(power: Array) -> Array:
    """(K,) phases of harmonics with powers (K,) that sum up to a signal of low peak (Schroeder 1970)."""
    share = power / power.sum()
    return np.asarray(-2.0 * np.pi * np.concatenate([[0.0], np.cumsum(np.cumsum(share))[:-1]]))


@dataclass(frozen=True)
class Multisine:
    """Harmonics with Schroeder phases: base frequency, their number, how they fall; amplitude and delay of each actuator."""

    frame: Frame

    @property
    def numbers(self) -> int:
        """Three in common and two of each actuator."""
        return 3 + 2 * self.frame.nu

    def wave(self, z: Array) -> Array:
        """(N, nu)."""
        f = self.frame
        base = (
            f.slowest * (0.5 * f.fastest / f.slowest) ** z[0]
            if f.fastest > 2.0 * f.slowest
            else f.slowest
        )
        most = min(HARMONICS, max(int(f.fastest / base), 1))
        order = np.arange(1, 1 + max(round(most * float(z[1])), min(2, most)))
        power = order ** (-2.0 * STEEPEST * z[2])
        size, delay = z[3:].reshape(2, f.nu)
        angle = 2.0 * np.pi * base * order * (f.t[:, None, None] - (delay / base)[:, None])
        wave = (np.sqrt(power) * np.cos(angle + schroeder(power))).sum(axis=2)
        return np.asarray(amplitudes(size) * wave / np.abs(wave).max(axis=0))


@dataclass(frozen=True)
class Steps:
    """Random levels, each held for a while: how long, how much of it is a smooth passage (none where jumps are allowed)."""

    frame: Frame

    @property
    def numbers(self) -> int:
        """Two in common and the levels of each actuator."""
        return 2 + LEVELS * self.frame.nu

    def wave(self, z: Array) -> Array:
        """(N, nu)."""
        f = self.frame
        held = f.horizon / (3.0 * (LEVELS / 3.0) ** z[0])
        place = np.minimum((f.t / held).astype(int), LEVELS - 1)
        levels = np.concatenate([np.zeros((1, f.nu)), 2.0 * z[2:].reshape(LEVELS, f.nu) - 1.0])
        share = (f.t / held - place) / max(float(z[1]), 1e-9)
        passed = np.where(f.jumps, 1.0, 0.5 - 0.5 * np.cos(np.pi * np.clip(share, 0.0, 1.0)))[
            :, None
        ]
        return np.asarray((1.0 - passed) * levels[place] + passed * levels[place + 1])


def multisine(
    t: Array, nu: int, frequency: float, harmonics: int, rng: np.random.Generator
) -> Array:
    """(N, nu) sums of harmonics of a base frequency [Hz] with random phases and weights, peak 1."""
    order = np.arange(1, harmonics + 1)
    phases = rng.uniform(0.0, 2 * np.pi, (nu, harmonics))
    weights = rng.uniform(0.2, 1.0, (nu, harmonics))
    waves = np.sin(2 * np.pi * frequency * t[:, None, None] * order + phases) * weights
    total = waves.sum(axis=2)
    return np.asarray(total / np.abs(total).max(axis=0))
