"""Excitations of a few parameters in [0, 1]: chirps, multisines and random steps."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy.signal

from mjfim.arrays import Array

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


@dataclass(frozen=True, kw_only=True, eq=False)
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
        return np.asarray(self.min_frequency * (self.max_frequency / self.min_frequency) ** z)


class Excitation(Protocol):
    """Excitation that is a function of parameters in [0, 1]."""

    @property
    def parameter_count(self) -> int:
        """Number of parameters."""
        ...

    def curve(self, z: Array) -> Array:
        """(N, nu) curves about zero with a peak of about 1, from z: (parameter_count,)."""
        ...


def relative_amplitudes(z: Array) -> Array:
    """Amplitudes of several actuators; the largest one is 1.

    Args:
        z: (nu,) parameters in [0, 1].

    Returns:
        (nu,) amplitudes.
    """
    amplitude = MIN_RELATIVE_AMPLITUDE ** (1.0 - z)
    return np.asarray(amplitude / amplitude.max())


@dataclass(frozen=True)
class Chirp:
    """A linear frequency sweep of every actuator.

    Its parameters are amplitude, first frequency, last frequency, phase and offset of every
    actuator.

    Attributes:
        settings: Settings of all excitations.
    """

    settings: ExcitationSettings

    @property
    def parameter_count(self) -> int:
        """Number of parameters: five of each actuator."""
        return 5 * self.settings.nu

    def curve(self, z: Array) -> Array:
        """(N, nu) sweeps, from z: (5 nu,)."""
        settings = self.settings
        amplitude, first, last, phase, offset = z.reshape(5, settings.nu)

        first_frequency = settings.frequency(first).tolist()
        last_frequency = settings.frequency(last).tolist()
        degrees = (360.0 * phase).tolist()
        sweeps = [
            scipy.signal.chirp(settings.t, f0, settings.horizon, f1, phi=phi)
            for f0, f1, phi in zip(first_frequency, last_frequency, degrees, strict=True)
        ]

        centred = np.stack(sweeps, axis=1) + (offset - 0.5)
        return np.asarray(relative_amplitudes(amplitude) * centred)


def schroeder_phases(power: Array) -> Array:
    """Phases with which the sum of harmonics has a low peak (Schroeder 1970).

    Args:
        power: (K,) power of every harmonic.

    Returns:
        (K,) phases [rad].
    """
    share = power / power.sum()
    return np.asarray(-2.0 * np.pi * np.concatenate([[0.0], np.cumsum(np.cumsum(share))[:-1]]))


@dataclass(frozen=True)
class Multisine:
    """A sum of harmonics with Schroeder phases for every actuator.

    Its parameters are the base frequency, the number of harmonics and their roll-off, followed by
    the amplitude and the delay of every actuator.

    Attributes:
        settings: Settings of all excitations.
    """

    settings: ExcitationSettings

    @property
    def parameter_count(self) -> int:
        """Number of parameters: three in common and two of each actuator."""
        return 3 + 2 * self.settings.nu

    def curve(self, z: Array) -> Array:
        """(N, nu) multisines, from z: (3 + 2 nu,)."""
        settings = self.settings
        base = self._base_frequency(float(z[0]))
        amplitude, delay = z[3:].reshape(2, settings.nu)

        most = min(MAX_HARMONICS, max(int(settings.max_frequency / base), 1))
        count = max(round(most * float(z[1])), min(2, most))
        order = np.arange(1, 1 + count)
        power = order ** (-2.0 * MAX_ROLL_OFF * z[2])

        delayed = settings.t[:, None, None] - (delay / base)[:, None]
        angle = 2.0 * np.pi * base * order * delayed
        waves = np.sqrt(power) * np.cos(angle + schroeder_phases(power))
        curve = waves.sum(axis=2)
        return np.asarray(relative_amplitudes(amplitude) * curve / np.abs(curve).max(axis=0))

    def _base_frequency(self, z: float) -> float:
        """Base frequency [Hz], low enough for two harmonics if the frequency range allows it."""
        lowest = self.settings.min_frequency
        highest = self.settings.max_frequency
        if highest <= 2.0 * lowest:
            return lowest

        return float(lowest * (0.5 * highest / lowest) ** z)


@dataclass(frozen=True)
class RandomSteps:
    """Random levels of every actuator, each of which is held for some time.

    Its parameters are the duration of a level and the fraction of it that is a smooth transition
    (unused if jumps are allowed), followed by the levels of every actuator.

    Attributes:
        settings: Settings of all excitations.
    """

    settings: ExcitationSettings

    @property
    def parameter_count(self) -> int:
        """Number of parameters: two in common and the levels of each actuator."""
        return 2 + MAX_LEVELS * self.settings.nu

    def curve(self, z: Array) -> Array:
        """(N, nu) steps, from z: (2 + MAX_LEVELS nu,)."""
        settings = self.settings
        held = settings.horizon / (3.0 * (MAX_LEVELS / 3.0) ** z[0])
        index = np.minimum((settings.t / held).astype(int), MAX_LEVELS - 1)

        levels = 2.0 * z[2:].reshape(MAX_LEVELS, settings.nu) - 1.0
        levels = np.concatenate([np.zeros((1, settings.nu)), levels])

        # Progress of the transition from the previous level to the present one, 0 to 1.
        duration = max(float(z[1]), SHORTEST_TRANSITION)
        progress = (settings.t / held - index) / duration
        smooth = 0.5 - 0.5 * np.cos(np.pi * np.clip(progress, 0.0, 1.0))
        share = np.where(settings.may_jump, 1.0, smooth)[:, None]
        return np.asarray((1.0 - share) * levels[index] + share * levels[index + 1])
