"""Classical excitations, each made of a few numbers between 0 and 1: chirp, Schroeder multisine, random steps. Arrays only."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.signal import chirp

from mjfim.trajectory import Array

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
        ends = zip(f.pitch(first).tolist(), f.pitch(last).tolist(), (360.0 * phase).tolist(), strict=True)
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
        base = f.slowest * (0.5 * f.fastest / f.slowest) ** z[0] if f.fastest > 2.0 * f.slowest else f.slowest
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
        passed = np.where(f.jumps, 1.0, 0.5 - 0.5 * np.cos(np.pi * np.clip(share, 0.0, 1.0)))[:, None]
        return np.asarray((1.0 - passed) * levels[place] + passed * levels[place + 1])
