"""Commands of a log as control laws receive them: late, filtered, at the laws' own ticks.

They do not depend on the state, so that they are computed for all ticks before a simulation:

    r(t)   = mean of the logged reference over [t - d, t - d + w]
    r_f,k  = r_f,k-1 + a (r(t_k) - r_f,k-1),     a = 1 - exp(-T / tau)

with the latency d, the period T of the law, and the time constant tau. The width w is that of a
tick, at most a sample: a held command that arrives inside a tick counts for the rest of the tick.
So r depends continuously on d. References that are points of a continuous signal are interpolated
linearly, which is w = one sample.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.model.control_laws import NUMBERS, ControlLaw, Quantity

# Number of time constants after which a filter has forgotten its beginning to the last digit.
FORGOTTEN_AFTER = 37.0

# Value of a column `enable` from which on a law is on.
ON = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class LawNumbers:
    """Numbers of c laws in m simulations, each (m, c), with the unit u of the control.

    Attributes:
        kp: Gain of the position [u/rad or u/m].
        kd: Gain of the velocity [u s/rad or u s/m].
        ki: Gain of the integral of the error of the position [u/(rad s) or u/(m s)].
        integral: Integral at the begin of a recording [u].
        integral_limit: Largest magnitude of the integral [u].
        saturation_low: Smallest control [u].
        saturation_high: Largest control [u].
        slew: Largest change of the control per second [u/s].
        latency: Time from a command in the log to its effect [s].
        time_constant: Time constant of the filter of the reference [s].
        feedback_latency: Time from a measurement to the effect of the control [s].
        velocity_time_constant: Time constant of the filter of the velocity [s].
    """

    kp: Array
    kd: Array
    ki: Array
    integral: Array
    integral_limit: Array
    saturation_low: Array
    saturation_high: Array
    slew: Array
    latency: Array
    time_constant: Array
    feedback_latency: Array
    velocity_time_constant: Array

    @classmethod
    def of(cls, models: Sequence[Any], laws: Sequence[ControlLaw], count: int) -> LawNumbers:
        """Read the numbers.

        Args:
            models: One model for all simulations, or one for each; successive simulations often
                share one.
            laws: The c laws.
            count: Number m of simulations.
        """
        places = np.array([[law.first + i for law in laws] for i in range(len(NUMBERS))])
        rows: list[Array] = []
        for i, model in enumerate(models):
            known = i > 0 and model is models[i - 1]
            rows.append(rows[-1] if known else np.array(model.numeric_data[places]))

        stacked = np.stack(rows, axis=1)
        if len(models) == 1:
            stacked = np.repeat(stacked, count, axis=1)
        return cls(**dict(zip(NUMBERS, stacked, strict=True)))


def filter_shares(time_constant: Array, period: float) -> Array:
    """Share of a new value that a filter of first order takes over in one period.

    Args:
        time_constant: Time constants [s]; 0 for no filter.
        period: The period [s].

    Returns:
        Shares of the same shape, 1 without a filter.
    """
    filtered = time_constant > 0.0
    ratio = period / np.where(filtered, time_constant, 1.0)
    return np.asarray(np.where(filtered, -np.expm1(-ratio), 1.0))


@dataclass(frozen=True, kw_only=True, eq=False)
class Ticks:
    """Times at which laws with one period are evaluated, in engine steps.

    Attributes:
        period: Engine steps from one evaluation to the next.
        before: Number of evaluations before the curve whose commands are needed.
        count: Number of evaluations from the begin of the curve on, the first one at it.
        substeps: Engine steps of a sample.
        timestep: Engine timestep [s].
    """

    period: int
    before: int
    count: int
    substeps: int
    timestep: float

    @property
    def seconds(self) -> float:
        """Time from one evaluation to the next [s]."""
        return self.period * self.timestep

    @property
    def samples(self) -> Array:
        """(before + count,) times of all evaluations, in samples after the begin of a curve."""
        steps = self.period * np.arange(-self.before, self.count)
        return np.asarray(steps / self.substeps)


@dataclass(frozen=True, kw_only=True, eq=False)
class LawCommands:
    """Commands of c laws for m curves at K evaluations, of which `before` precede the curves.

    Attributes:
        before: Number of evaluations before the first one of the curves.
        reference: (K, m, c) filtered references [m or rad].
        reference_velocity: (K, m, c) velocities of the references [m/s or rad/s], or None.
        feedforward: (K, m, c) controls that are added [u-unit], or None.
        gain: (K, m, c) factors of the gains, or None.
        enabled: (K, m, c) 1 where the law is on, 0 where it is off, or None.
        lag: (m, c) integral over time, up to the first evaluation, of what latency and filter keep
            back: of the difference between the reference in the log and `reference` [m s or rad s].
        lag_time: (m, c) this integral for a reference at rest, divided by the reference [s].
    """

    before: int
    reference: Array
    reference_velocity: Array | None
    feedforward: Array | None
    gain: Array | None
    enabled: Array | None
    lag: Array
    lag_time: Array

    @classmethod
    def of(
        cls,
        laws: Sequence[ControlLaw],
        numbers: LawNumbers,
        window: Array,
        lead: int,
        ticks: Ticks,
    ) -> LawCommands:
        """Compute the commands.

        Args:
            laws: The c laws, which have one period.
            numbers: Their numbers.
            window: (m, W, w) inputs of samples, of which `lead` precede the curves. Before the
                window, the first one is held; after it, the last one.
            lead: Number of samples of the window before the curves.
            ticks: The evaluations.
        """
        columns = _Columns(laws=laws, window=window, lead=lead, ticks=ticks)
        latency = numbers.latency / (ticks.substeps * ticks.timestep)
        shares = filter_shares(numbers.time_constant, ticks.seconds)

        received = columns.at("reference", columns.places - latency)
        reference = _filtered(received, shares)
        velocity = columns.late("reference_velocity", latency)
        if velocity is not None:
            velocity = _filtered(velocity, shares)
        velocity = _with_differences(laws, velocity, reference, ticks.seconds)

        # Sums over ticks hold back what the reference was, on average, half a latency before the
        # middle of the latest tick.
        begin = -0.5 * ticks.period / ticks.substeps
        middle = columns.at("reference", lead + begin - 0.5 * latency[None])
        kept_back = ticks.seconds * (1.0 - shares) / shares
        latest = reference[max(ticks.before - 1, 0)]

        enabled = columns.at_once("enable", 1.0)
        return cls(
            before=ticks.before,
            reference=reference,
            reference_velocity=velocity,
            feedforward=columns.late("feedforward", latency),
            gain=columns.at_once("gain", 1.0),
            enabled=None if enabled is None else np.where(enabled >= ON, 1.0, 0.0),
            lag=numbers.latency * middle[0] + kept_back * latest,
            lag_time=numbers.latency + kept_back,
        )

    def drive(self, numbers: LawNumbers) -> Array:
        """(K, m, c) part of the controls that does not depend on the state [u-unit].

        Args:
            numbers: Numbers of the laws.
        """
        drive = numbers.kp * self.reference
        if self.reference_velocity is not None:
            drive += numbers.kd * self.reference_velocity
        if self.gain is not None:
            drive *= self.gain
        if self.feedforward is not None:
            drive += self.feedforward
        return np.asarray(drive)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Columns:
    """Columns of a log that laws read, at any time.

    Attributes:
        laws: The c laws.
        window: (m, W, w) inputs of samples.
        lead: Number of samples of the window before the curves.
        ticks: The evaluations of the laws.
    """

    laws: Sequence[ControlLaw]
    window: Array
    lead: int
    ticks: Ticks

    @property
    def places(self) -> Array:
        """(K, 1, 1) evaluations, in samples since the begin of the window."""
        return (self.lead + self.ticks.samples)[:, None, None]

    @property
    def widths(self) -> Array:
        """(c,) samples over which the mean of each law's commands is taken."""
        tick = min(self.ticks.period / self.ticks.substeps, 1.0)
        return np.array([1.0 if law.interpolated else tick for law in self.laws])

    def at(self, quantity: Quantity, places: Array) -> Array:
        """(K, m, c) means of a quantity, 0 for laws that do not read it.

        Args:
            quantity: The quantity.
            places: (K, m, c) begin of the means, in samples since the begin of the window.
        """
        W = self.window.shape[1]
        place = np.clip(places, 0.0, W - 1.0)
        sample = np.floor(place).astype(np.intp)
        values = self._values(quantity, sample)
        following = self._values(quantity, np.minimum(sample + 1, W - 1))

        # Share of the mean that lies in the following sample.
        widths = self.widths
        share = np.maximum((place - sample) + (widths - 1.0), 0.0) / widths
        return np.asarray((1.0 - share) * values + share * following)

    def late(self, quantity: Quantity, latency: Array) -> Array | None:
        """(K, m, c) quantity at the ticks, late by (m, c) samples; None where no law reads it."""
        if not any(quantity in law.columns for law in self.laws):
            return None
        return self.at(quantity, self.places - latency)

    def at_once(self, quantity: Quantity, otherwise: float) -> Array | None:
        """(K, m, c) quantity of the samples of the ticks, without latency.

        Args:
            quantity: The quantity.
            otherwise: Value for laws that do not read it.

        Returns:
            The values; None where no law reads it.
        """
        if not any(quantity in law.columns for law in self.laws):
            return None
        last = self.window.shape[1] - 1
        sample = np.clip(np.floor(self.places), 0, last).astype(np.intp)
        values = self._values(quantity, np.broadcast_to(sample, (len(sample), *self._shape)))
        reads = np.array([quantity in law.columns for law in self.laws])
        return np.asarray(np.where(reads, values, otherwise))

    @property
    def _shape(self) -> tuple[int, int]:
        """(m, c)."""
        return len(self.window), len(self.laws)

    def _values(self, quantity: Quantity, sample: np.ndarray) -> Array:
        """(K, m, c) values of a quantity in samples (K, m, c), 0 for laws that do not read it."""
        curves = np.arange(len(self.window))[:, None]
        columns = np.array([law.columns.get(quantity, 0) for law in self.laws])
        reads = np.array([quantity in law.columns for law in self.laws])
        found = self.window[curves, sample, columns]
        return np.asarray(np.where(reads, found, 0.0))


def lead_time(numbers: LawNumbers, period: float) -> float:
    """Time before a curve whose inputs still have an effect on it [s].

    Args:
        numbers: Numbers of the laws.
        period: Longest period of a law [s].
    """
    latest = float(numbers.latency.max(initial=0.0))
    filtered = FORGOTTEN_AFTER * float(numbers.time_constant.max(initial=0.0))
    return latest + filtered + 2.0 * period


def _filtered(values: Array, shares: Array) -> Array:
    """Filters of first order, which begin settled.

    Args:
        values: (K, m, c) values at successive ticks.
        shares: (m, c) share of a new value that each filter takes over.

    Returns:
        (K, m, c) filtered values.
    """
    if (shares == 1.0).all():
        return values

    filtered = np.empty_like(values)
    for share in np.unique(shares):
        chosen = shares == share
        x = values[:, chosen]
        numerator, denominator = [share], [1.0, share - 1.0]
        settled = (1.0 - share) * x[:1]
        filtered[:, chosen], _ = scipy.signal.lfilter(numerator, denominator, x, axis=0, zi=settled)
    return filtered


def _with_differences(
    laws: Sequence[ControlLaw], velocity: Array | None, reference: Array, period: float
) -> Array | None:
    """Velocities of references, taken from differences where a law does so.

    Args:
        laws: The c laws.
        velocity: (K, m, c) velocities in the log, or None.
        reference: (K, m, c) filtered references.
        period: Time from one tick to the next [s].
    """
    differs = np.array([law.reference_differences for law in laws])
    if not differs.any():
        return velocity

    slopes = np.diff(reference, axis=0, prepend=reference[:1]) / period
    return np.asarray(np.where(differs, slopes, 0.0 if velocity is None else velocity))
