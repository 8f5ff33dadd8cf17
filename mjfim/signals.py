"""Basis functions and signals for controls.

They are splines, Fourier series, chirps, multisines and random steps. A parametric excitation maps
parameters in [0, 1] to a curve of every actuator, which allows a search over all excitations of a
kind.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy

from mjfim.arrays import Array

# Degree of the splines.
SPLINE_DEGREE = 3

# Curves are linearly dependent if a singular value is below this fraction of the largest one.
DEPENDENCE_TOLERANCE = 1e-5

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


def spline_basis(
    t: Array,
    horizon: float,
    bandwidth: float,
    starts_at_rest: bool,
    ends_at_rest: bool,
    periodic: bool,
) -> Array:
    """Cubic B-splines with a knot every 1 / (2 bandwidth) seconds.

    Args:
        t: (N,) times [s].
        horizon: Duration of the curves [s].
        bandwidth: Highest frequency that the splines have to represent [Hz].
        starts_at_rest: Whether value and slope are zero at the beginning.
        ends_at_rest: Whether value and slope are zero at the end.
        periodic: Whether value and two derivatives at the end equal those at the beginning.

    Returns:
        (N, M) values of the M splines.
    """
    intervals = max(int(np.ceil(2.0 * bandwidth * horizon)), SPLINE_DEGREE + 1)
    knots = horizon / intervals * np.arange(-SPLINE_DEGREE, intervals + SPLINE_DEGREE + 1)

    # Splines that extend beyond the end of the horizon continue at its beginning.
    if periodic:
        values = scipy.interpolate.BSpline.design_matrix(t, knots, SPLINE_DEGREE).toarray()
        values[:, :SPLINE_DEGREE] += values[:, intervals:]
        return np.asarray(values[:, :intervals])

    # Knots are repeated at both ends. Only the first two splines then have a value or a slope at
    # the beginning, and only the last two at the end.
    knots = np.clip(knots, 0.0, horizon)
    values = scipy.interpolate.BSpline.design_matrix(t, knots, SPLINE_DEGREE).toarray()
    first = 2 if starts_at_rest else 0
    last = values.shape[1] - (2 if ends_at_rest else 0)
    return np.asarray(values[:, first:last])


def fourier_basis(
    t: Array,
    horizon: float,
    frequency: float,
    harmonics: int,
    starts_at_rest: bool,
    ends_at_rest: bool,
) -> Array:
    """Sines and cosines of the multiples of a base frequency, each with amplitude 1.

    If a curve has to begin or end at rest, a polynomial with its value and first two derivatives
    there is subtracted, of the lowest possible degree. With rest at both ends this is a finite
    Fourier series with a quintic polynomial, as in point-to-point excitation of robots.

    Args:
        t: (N,) times [s].
        horizon: Duration of the curves [s].
        frequency: Base frequency [Hz].
        harmonics: Number of multiples of the base frequency.
        starts_at_rest: Whether value and two derivatives are zero at the beginning.
        ends_at_rest: Whether value and two derivatives are zero at the end.

    Returns:
        (N, 2 harmonics) sines, then cosines.
    """
    omega: Array = 2.0 * np.pi * frequency * np.arange(1.0, harmonics + 1.0)
    waves = _wave_derivatives(t, omega, 0)

    times = []
    if starts_at_rest:
        times.append(0.0)
    if ends_at_rest:
        times.append(horizon)
    if not times:
        return waves

    # Value and two derivatives at each end fix the coefficients of the polynomials.
    powers = np.arange(3 * len(times))
    conditions = [(np.array([time]), order) for time in times for order in range(3)]
    polynomials = [_power_derivatives(at, horizon, powers, order) for at, order in conditions]
    values = [_wave_derivatives(at, omega, order) for at, order in conditions]
    coefficients = np.linalg.solve(np.concatenate(polynomials), np.concatenate(values))

    return waves - _power_derivatives(t, horizon, powers, 0) @ coefficients


def _wave_derivatives(t: Array, omega: Array, order: int) -> Array:
    """(N, 2 H) derivatives of sin(omega t) and cos(omega t) with respect to time.

    Args:
        t: (N,) times [s].
        omega: (H,) angular frequencies [rad/s].
        order: Order of the derivative.
    """
    angle = np.outer(t, omega) + 0.5 * np.pi * order
    waves = np.concatenate([np.sin(angle), np.cos(angle)], axis=1)
    return np.asarray(waves * np.tile(omega**order, 2))


def _power_derivatives(t: Array, horizon: float, powers: np.ndarray, order: int) -> Array:
    """(N, K) derivatives of (t / horizon)^k with respect to time.

    Args:
        t: (N,) times [s].
        horizon: Duration of the curves [s].
        powers: (K,) exponents k.
        order: Order of the derivative.
    """
    factors = [
        np.prod(np.arange(k - order + 1, k + 1)) if k >= order else 0.0 for k in powers.tolist()
    ]
    remaining = np.maximum(powers - order, 0)
    return np.asarray(np.array(factors) * (t[:, None] / horizon) ** remaining / horizon**order)


def independent_curves(curves: Array) -> Array:
    """Linearly independent curves that span the space of given curves.

    Curves may be nearly dependent, such as splines with more knots than samples, or waves that
    resemble polynomials.

    Args:
        curves: (N, M) curves.

    Returns:
        The given curves if they are independent. Otherwise (N, K < M) orthogonal curves with root
        mean square 1 / sqrt(2).
    """
    U, sizes, _ = np.linalg.svd(curves, full_matrices=False)
    kept = sizes > DEPENDENCE_TOLERANCE * sizes[0]
    if kept.sum() == curves.shape[1]:
        return curves

    return np.asarray(U[:, kept] * np.sqrt(0.5 * len(curves)))


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


def multisine(
    t: Array, nu: int, frequency: float, harmonics: int, rng: np.random.Generator
) -> Array:
    """Sums of harmonics with random phases and weights, each with a peak of 1.

    Args:
        t: (N,) times [s].
        nu: Number of actuators.
        frequency: Base frequency [Hz].
        harmonics: Number of multiples of the base frequency.
        rng: Source of the phases and weights.

    Returns:
        (N, nu) curves.
    """
    order = np.arange(1, harmonics + 1)
    phases = rng.uniform(0.0, 2 * np.pi, (nu, harmonics))
    weights = rng.uniform(0.2, 1.0, (nu, harmonics))

    waves = np.sin(2 * np.pi * frequency * t[:, None, None] * order + phases) * weights
    total = waves.sum(axis=2)
    return np.asarray(total / np.abs(total).max(axis=0))
