"""Control laws in the loop: their commands, what they remember, and their controls at each tick.

Commands do not depend on the state, so that they are computed for all ticks before a simulation:

    r(t)   = mean of the logged reference over [t - d', t - d' + w]
    r_f,k  = r_f,k-1 + a (r(t_k) - r_f,k-1),     a = 1 - exp(-T / tau)

with the period T of the law and the time constant tau. The latency d' is the stated d, or its whole
ticks as below. The width w is that of a tick, at most a sample. References that are points of a
continuous signal are interpolated linearly, which is w = one sample. A motion profile with the
acceleration a goes to r_f in the shortest time, and takes its place:

    w_k = min(sqrt((a T / 2)^2 + 2 a |e_k|) - a T / 2, |e_k| / T),     e_k = r_f,k - p_k-1
    s_k = s_k-1 + (w_k sgn(e_k) - s_k-1 inside +-a T),     p_k = p_k-1 + T s_k

At a tick k, with the measured position q and velocity v, and the commands of the log,

    I_k = I_k-1 + g ki T (r_k - q),      clipped to the limit of the integral
    u_k = g (kp (r_k - q) + kd (rdot_k - v)) + I_k + f_k

is clipped to the range of the control, then to the largest change since the last tick. The factor g
and the feed-forward f come from the log.

Behind a motion profile, and where commands are held and a tick is at most a sample, a command that
arrives inside a tick acts in the rest of it. So d' is the whole ticks of d. The control is the mean
of u_k with the commands of this tick and with those of the tick before, weighted by their parts of
the tick, and so is r_k in the integral. The mean of the commands alone would let a small part of a
step cause the largest control, so that the motion would not depend on d between ticks.

The measurement is that of the model, late by the latency of the feedback: positions between two
ticks follow the cubic polynomial through their positions and velocities, velocities a straight
line, so that they depend continuously on the latency.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import numpy as np
import scipy

from mjfim.arrays import Array, record
from mjfim.model.control_laws import NUMBERS, ControlLaw, Quantity

# Number of time constants after which a filter has forgotten its beginning to the last digit.
FORGOTTEN_AFTER = 37.0

# Numbers that commands depend on.
DECIDING_NUMBERS = ("latency", "time_constant", "acceleration", "jump")

# Rounding of the share of a sample in a mean.
ROUNDING = 1e-9

# Value of a column `enable` from which on a law is on.
ON = 0.5


@record
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
        acceleration: Acceleration of the motion profile [rad/s² or m/s²]; inf without a profile.
        jump: Change of the reference above which it passes without the profile [rad or m].
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
    acceleration: Array
    jump: Array

    @classmethod
    def of(cls, models: Sequence[Any], laws: Sequence[ControlLaw], count: int) -> LawNumbers:
        """Read the numbers.

        Args:
            models: One model for all simulations, or one for each; successive simulations often
                share one.
            laws: The c laws.
            count: Number m of simulations.
        """
        places = np.add.outer(np.arange(len(NUMBERS)), [law.first for law in laws])
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
    return np.where(filtered, -np.expm1(-ratio), 1.0)


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
        return steps / self.substeps


@record
class LawCommands:
    """Commands of c laws for m curves at K evaluations, of which `before` precede the curves.

    Attributes:
        before: 1; 0 where the inputs show no evaluation before the curves.
        rest: (m, c) parts of a tick by which commands are later than whole ticks.
        reference: (K, m, c) references, filtered and after the motion profile, without `rest`
            [m or rad].
        profile_velocity: (K, m, c) velocities of the motion profiles [m/s or rad/s].
        reference_velocity: (K, m, c) velocities of the references [m/s or rad/s], or None.
        feedforward: (K, m, c) controls that are added [u-unit], or None.
        gain: (K, m, c) factors of the gains, or None.
        enabled: (K, m, c) 1 where the law is on, 0 where it is off, or None.
        lag: (m, c) integral over time, up to the first evaluation, of what latency and filter keep
            back: of the difference between the reference in the log and `reference` [m s or rad s].
        lag_time: (m, c) this integral for a reference at rest, divided by the reference [s].
    """

    before: int
    rest: Array
    reference: Array
    profile_velocity: Array
    reference_velocity: Array | None
    feedforward: Array | None
    gain: Array | None
    enabled: Array | None
    lag: Array
    lag_time: Array

    def velocity_at(self, tick: int) -> Array:
        """(m, c) velocities of the references at a tick, 0 where laws have none."""
        known = self.reference_velocity
        return np.zeros_like(self.rest) if known is None else known[tick]

    @classmethod
    def of(
        cls,
        laws: Sequence[ControlLaw],
        numbers: LawNumbers,
        window: Array,
        lead: int,
        ticks: Ticks,
        memory: LawMemory | None,
    ) -> LawCommands:
        """Compute the commands.

        Args:
            laws: The c laws, which have one period.
            numbers: Their numbers.
            window: (m, W, w) inputs of samples, of which `lead` precede the curves. Before the
                window, the first one is held; after it, the last one.
            lead: Number of samples of the window before the curves.
            ticks: The evaluations.
            memory: What the laws remember at the begin of the curves; None where these begin.
        """
        columns = _Columns(laws=laws, window=window, lead=lead, ticks=ticks)
        latency = numbers.latency / (ticks.substeps * ticks.timestep)
        shares = filter_shares(numbers.time_constant, ticks.seconds)

        has_profile = np.isfinite(numbers.acceleration)
        late_ticks = numbers.latency / ticks.seconds
        rest = np.where(has_profile | columns.are_held, late_ticks % 1.0, 0.0)
        begins = columns.places - (latency - rest * ticks.period / ticks.substeps)
        filtered = _filtered(columns.at("reference", begins), shares)
        reference, slope = filtered, np.broadcast_to(0.0, filtered.shape)
        if has_profile.any():
            jumps = columns.changes("reference", begins) > numbers.jump
            # A command that arrives inside a tick counts in part there, and in full in the next.
            jumps[1:] |= jumps[:-1].copy()
            reference, slope = _profiled(filtered, jumps, numbers, ticks, memory)
        velocity = columns.if_read("reference_velocity", begins)
        if velocity is not None:
            velocity = _filtered(velocity, shares)
        velocity = _with_differences(laws, velocity, reference, ticks.seconds)
        if memory is not None and ticks.before and velocity is not None:
            velocity[ticks.before - 1] = memory.reference_velocity

        # Sums over ticks hold back what the reference was, on average, half a latency before the
        # middle of the latest tick.
        begin = -0.5 * ticks.period / ticks.substeps
        middle = columns.at("reference", lead + begin - 0.5 * latency[None])
        kept_back = ticks.seconds * (1.0 - shares) / shares
        before = filtered[: max(ticks.before, 1)]
        latest = _earlier(before[-2:], rest)[-1]
        behind = _earlier((filtered - reference)[: ticks.before], rest).sum(axis=0)

        # Of earlier evaluations, the laws need the last one.
        needed = slice(max(ticks.before - 1, 0), None)
        enabled = columns.at_once("enable", needed)
        return cls(
            before=min(ticks.before, 1),
            rest=rest,
            reference=reference[needed],
            profile_velocity=slope[needed],
            reference_velocity=None if velocity is None else velocity[needed],
            feedforward=columns.if_read("feedforward", begins[needed]),
            gain=columns.at_once("gain", needed),
            enabled=None if enabled is None else np.where(enabled >= ON, 1.0, 0.0),
            lag=numbers.latency * middle[0] + kept_back * latest + ticks.seconds * behind,
            lag_time=numbers.latency + kept_back,
        )


@record
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

    @property
    def are_held(self) -> np.ndarray:
        """(c,) True for laws whose commands are held for whole ticks."""
        is_short = self.ticks.period <= self.ticks.substeps
        return np.array([is_short and not law.interpolated for law in self.laws])

    def at(self, quantity: Quantity, places: Array) -> Array:
        """(K, m, c) means of a quantity, 0 for laws that do not read it.

        Args:
            quantity: The quantity.
            places: (K, m, c) begin of the means, in samples since the begin of the window.
        """
        sample, share = self._samples(places)
        values = self._values(quantity, sample, 0.0)
        following = self._values(quantity, self._following(sample), 0.0)
        return (1.0 - share) * values + share * following

    def changes(self, quantity: Quantity, places: Array) -> Array:
        """(K, m, c) changes of a quantity since the tick before, in the latest sample of a mean."""
        sample, share = self._samples(places)
        latest = np.where(share > ROUNDING, self._following(sample), sample)
        values = self._values(quantity, latest, 0.0)
        return np.asarray(np.abs(np.diff(values, axis=0, prepend=values[:1])))

    def _samples(self, places: Array) -> tuple[np.ndarray, Array]:
        """Samples in which means begin, and the share of each mean in the following sample."""
        place = np.clip(places, 0.0, self.window.shape[1] - 1.0)
        sample = np.floor(place).astype(np.intp)
        widths = self.widths
        return sample, np.maximum((place - sample) + (widths - 1.0), 0.0) / widths

    def _following(self, sample: np.ndarray) -> np.ndarray:
        return np.asarray(np.minimum(sample + 1, self.window.shape[1] - 1))

    def if_read(self, quantity: Quantity, places: Array) -> Array | None:
        """What `at` returns; None where no law reads the quantity."""
        if not any(quantity in law.columns for law in self.laws):
            return None
        return self.at(quantity, places)

    def at_once(self, quantity: Quantity, ticks: slice) -> Array | None:
        """(k, m, c) quantity at some ticks, without latency, 1 for laws that do not read it.

        None where no law reads it.
        """
        if not any(quantity in law.columns for law in self.laws):
            return None
        last = self.window.shape[1] - 1
        sample = np.clip(np.floor(self.places[ticks]), 0, last).astype(np.intp)
        return self._values(quantity, sample, 1.0)

    def _values(self, quantity: Quantity, sample: np.ndarray, otherwise: float) -> Array:
        """(K, m, c) values of a quantity in samples: (K, m, c) or (K, 1, 1).

        Laws that do not read it have the value `otherwise`.
        """
        curves = np.arange(len(self.window))[:, None]
        columns = np.array([law.columns.get(quantity, 0) for law in self.laws])
        reads = np.array([quantity in law.columns for law in self.laws])
        return np.where(reads, self.window[curves, sample, columns], otherwise)


def lead_time(numbers: LawNumbers, period: float, spans: Array) -> float:
    """Time before a curve whose inputs still have an effect on it [s].

    Args:
        numbers: Numbers of the laws.
        period: Longest period of a law [s].
        spans: (c,) largest distances of two references [m or rad].
    """
    latest = float(numbers.latency.max(initial=0.0))
    filtered = FORGOTTEN_AFTER * float(numbers.time_constant.max(initial=0.0))
    # A profile forgets its beginning when it rests, at the latest after a motion to the other end
    # of the range and back.
    profiled = 4.0 * float(np.sqrt(spans / numbers.acceleration).max(initial=0.0))
    return latest + filtered + profiled + 2.0 * period


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


def _earlier(values: Array, part: Array | float = 1.0) -> Array:
    """Values: (K, m, c) of which a part: (m, c) is that of the tick before."""
    earlier = values.copy()
    earlier[1:] -= part * np.diff(values, axis=0)
    return earlier


def _profiled(
    values: Array,
    jumps: np.ndarray,
    numbers: LawNumbers,
    ticks: Ticks,
    memory: LawMemory | None,
) -> tuple[Array, Array]:
    """References after the motion profiles of laws, and velocities of the profiles.

    Args:
        values: (K, m, c) references at successive ticks.
        jumps: (K, m, c) True where the reference passes without the profile.
        numbers: Numbers of the laws.
        ticks: The ticks.
        memory: Memory at the begin of the curves; None for profiles that begin at rest, with the
            first tick.

    Returns:
        Both are (K, m, c). The velocity is 0 without a profile.
    """
    velocities = np.zeros_like(values)
    chosen = np.isfinite(numbers.acceleration)
    T = ticks.seconds
    x, largest = values[:, chosen], numbers.acceleration[chosen] * T
    jumps = jumps[:, chosen]
    first = 0 if memory is None else ticks.before
    p, v = x[0], np.zeros_like(x[0])
    if memory is not None:
        p, v = memory.reference[chosen], memory.profile_velocity[chosen]
    path, slopes = x.copy(), np.zeros_like(x)
    path[max(first - 1, 0)] = p
    half, square, twice = 0.5 * largest, 0.25 * largest**2, 2.0 * largest / T
    has_jump = np.asarray(jumps.any(axis=1))
    for k in range(first, len(x)):
        error = x[k] - p
        size = np.abs(error)
        fastest = np.minimum(np.sqrt(square + twice * size) - half, size / T)
        v = _clipped(np.copysign(fastest, error), v - largest, v + largest)
        p = p + T * v
        if has_jump[k]:
            p, v = np.where(jumps[k], x[k], p), np.where(jumps[k], 0.0, v)
        path[k], slopes[k] = p, v

    reference = values.copy()
    reference[:, chosen], velocities[:, chosen] = path, slopes
    return reference, velocities


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
    return np.where(differs, slopes, 0.0 if velocity is None else velocity)


@record
class LawMemory:
    """Memory of c laws with one period from one evaluation to the next, for m curves.

    Attributes:
        held: (m, c) controls that the laws hold [u-unit].
        reference: (m, c) references at the latest evaluation [m or rad].
        reference_velocity: (m, c) velocities of the references [m/s or rad/s].
        profile_velocity: (m, c) velocities of the motion profiles [m/s or rad/s].
        integral: (m, c) integrals [u-unit].
        velocity: (m, c) filtered velocities [m/s or rad/s].
        measured: (m, c) measured positions at the latest evaluation [m or rad].
        positions: (D, m, c) positions at the latest D evaluations, the latest one first.
        velocities: (D, m, c) velocities at these evaluations.
    """

    held: Array
    reference: Array
    reference_velocity: Array
    profile_velocity: Array
    integral: Array
    velocity: Array
    measured: Array
    positions: Array
    velocities: Array


PerCurve = TypeVar("PerCurve", LawNumbers, LawCommands, LawMemory)


def of_curves(arrays: PerCurve, curves: Sequence[int]) -> PerCurve:
    """Choose curves, which are the last axis but one of all arrays."""
    values = {each.name: getattr(arrays, each.name) for each in fields(arrays)}
    chosen: dict[str, Any] = {
        name: np.take(value, curves, axis=-2)
        for name, value in values.items()
        if isinstance(value, np.ndarray)
    }
    return replace(arrays, **chosen)


def distinct_curves(
    laws: Sequence[ControlLaw], numbers: LawNumbers, window: Array, memory: LawMemory | None
) -> tuple[list[int], list[int]]:
    """First curve with each kind of commands, and for each curve the place of its kind.

    Args:
        laws: The c laws.
        numbers: Their numbers.
        window: (m, W, w) inputs of samples.
        memory: What the laws remember at the begin of the curves; None where these begin.
    """
    read = sorted({column for law in laws for column in law.columns.values()})
    deciding = [window[:, :, read], *(getattr(numbers, name) for name in DECIDING_NUMBERS)]
    if memory is not None:
        deciding += [memory.reference, memory.reference_velocity, memory.profile_velocity]
    keys = [b"".join(part.tobytes() for part in parts) for parts in zip(*deciding, strict=True)]
    firsts = {key: curve for curve, key in reversed(list(enumerate(keys)))}
    places = {key: place for place, key in enumerate(firsts)}
    return list(firsts.values()), [places[key] for key in keys]


@record
class InputContext:
    """Inputs that a rollout with control laws needs beside those of its samples.

    Attributes:
        before: (m, L, w) inputs of the samples before the curves; none at the begin of recordings.
        after: (m, A, w) inputs of samples after the curves, of which the first one counts; without
            one, the last input of the curves is held.
        samples: (m,) samples from the begin of the recordings to the begin of the curves, which
            show when the laws are evaluated.
        memory: Memory of the laws, grouped by their periods, at the end of rollouts that the curves
            continue; None where they begin.
    """

    before: Array
    after: Array
    samples: np.ndarray
    memory: tuple[LawMemory, ...] | None = None

    @classmethod
    def of_interval(
        cls,
        inputs: Array,
        samples: np.ndarray,
        interval: slice,
        lead: int,
        memory: tuple[LawMemory, ...] | None,
    ) -> InputContext:
        """The context of an interval of curves.

        Args:
            inputs: (m, W, w) inputs of the curves, and of samples before them.
            samples: (m,) samples from the begin of the recordings to the first of these inputs.
            interval: Samples of the interval among these inputs.
            lead: Number of samples before the interval that matter.
            memory: Memory at the end of the interval before it; None for the first interval.
        """
        return cls(
            before=inputs[:, interval.start - lead : interval.start],
            after=inputs[:, interval.stop : interval.stop + 1],
            samples=samples + interval.start,
            memory=memory,
        )

    def repeated(self, count: int) -> InputContext:
        """This context of m curves for `count * m` curves, of which the memory is that already.

        Args:
            count: How often all curves are repeated, one repetition after the other.
        """
        return replace(
            self,
            before=np.tile(self.before, (count, 1, 1)),
            after=np.tile(self.after, (count, 1, 1)),
            samples=np.tile(self.samples, count),
        )


class RunningLaws:
    """C laws with one period, which compute the controls of m curves at successive ticks.

    Attributes:
        held: (m, c) controls that the laws hold now [u-unit].
        is_clipped: (m, c) True where the range or the largest change has clipped them.
        laws: The c laws.
        period: Engine steps from one evaluation to the next.
        controls: (c,) addresses of their controls in ctrl.
        positions: (c,) addresses of the positions that they read in qpos.
        velocities: (c,) addresses of the velocities that they read in qvel.
    """

    def __init__(
        self,
        laws: Sequence[ControlLaw],
        numbers: LawNumbers,
        commands: LawCommands,
        ticks: Ticks,
        memory: LawMemory,
        *,
        begins: bool,
    ) -> None:
        """Prepare the laws.

        Args:
            laws: The c laws.
            numbers: Their numbers.
            commands: Commands of the log at the ticks.
            ticks: The ticks.
            memory: What the laws remember at the begin.
            begins: True where no control was held before the first tick, so that its change is not
                limited.
        """
        self.laws = laws
        self.period = ticks.period
        self.controls = np.array([law.control for law in laws])
        self.positions = np.array([law.q for law in laws])
        self.velocities = np.array([law.v for law in laws])
        self._numbers = numbers
        self._commands = commands

        # (K, m, c) part of the controls that does not depend on the state.
        drive = numbers.kp * commands.reference
        if commands.reference_velocity is not None:
            drive += numbers.kd * commands.reference_velocity
        gain = 1.0 if commands.gain is None else commands.gain
        feedforward = commands.feedforward
        self._drive = gain * drive + (0.0 if feedforward is None else feedforward)
        self._next = commands.before

        seconds = ticks.seconds
        self._seconds = seconds
        self._integral_step = numbers.ki * seconds
        self._largest_change = numbers.slew * seconds
        self._velocity_share = filter_shares(numbers.velocity_time_constant, seconds)
        self._differs = np.array([law.differences for law in laws])
        self._has_differences = bool(self._differs.any())

        # Parts of the law without an effect are left out of the loop.
        self._integrates = bool(numbers.ki.any() or memory.integral.any())
        limits = (numbers.saturation_low, numbers.saturation_high, numbers.slew)
        self._has_limits = any(bool(np.isfinite(limit).any()) for limit in limits)
        self._is_slow = bool(np.isfinite(numbers.slew).any())
        self._filters = bool((self._velocity_share < 1.0).any())
        self._is_late = bool(numbers.feedback_latency.any())
        if self._integrates:
            self._reference = _earlier(commands.reference, commands.rest)
        # Without limits, the mean of two controls is the control of the mean.
        has_rest = bool(commands.rest.any())
        self._mixes = has_rest and self._has_limits
        if has_rest:
            added = 0.0 if feedforward is None else _earlier(feedforward)
            self._drive_before = gain * _earlier(drive) + added
        if has_rest and not self._has_limits:
            self._drive = self._drive + commands.rest * (self._drive_before - self._drive)

        self.held = memory.held
        self.is_clipped = np.zeros(memory.held.shape, dtype=bool)
        self._has_held = not begins
        self._integral = memory.integral
        self._velocity = memory.velocity
        self._measured = memory.measured

        self._positions = memory.positions.copy()
        self._velocities = memory.velocities.copy()
        self._latest = 0
        self._interpolation = _PastInterpolation(numbers.feedback_latency, seconds)

    @property
    def memory(self) -> LawMemory:
        """Present memory of the laws."""
        order = (self._latest + np.arange(len(self._positions))) % len(self._positions)
        latest = max(self._next - 1, 0)
        return LawMemory(
            held=self.held,
            reference=self._commands.reference[latest],
            reference_velocity=self._commands.velocity_at(latest),
            profile_velocity=self._commands.profile_velocity[latest],
            integral=self._integral,
            velocity=self._velocity,
            measured=self._measured,
            positions=self._positions[order],
            velocities=self._velocities[order],
        )

    def evaluate(self, q: Array, v: Array) -> Array:
        """Controls of the next tick, which are held until the one after it.

        Args:
            q: (m, c) positions of the joints now [m or rad].
            v: (m, c) velocities of the joints now [m/s or rad/s].

        Returns:
            (m, c) controls [u-unit].
        """
        tick = self._next
        self._next += 1
        q, v = self._measure(q, v)

        numbers, commands = self._numbers, self._commands
        gain = 1.0 if commands.gain is None else commands.gain[tick]
        kept = -gain * (numbers.kp * q + numbers.kd * v)
        if self._integrates:
            step = gain * (self._integral_step * (self._reference[tick] - q))
            limit = numbers.integral_limit
            self._integral = _clipped(self._integral + step, -limit, limit)
            kept = kept + self._integral
        control, self.is_clipped = self._limited(self._drive[tick] + kept)
        if self._mixes:
            before, is_clipped = self._limited(self._drive_before[tick] + kept)
            control = control + commands.rest * (before - control)
            self.is_clipped = np.where(commands.rest > 0.5, is_clipped, self.is_clipped)

        # A driver that is off forgets its integral.
        if commands.enabled is not None:
            enabled = commands.enabled[tick]
            control *= enabled
            self._integral = self._integral * enabled

        self.held = control
        self._has_held = True
        return control

    def _limited(self, control: Array) -> tuple[Array, np.ndarray]:
        """The control: (m, c) inside its range, near that of the tick before; where it changed."""
        if not self._has_limits:
            return control, self.is_clipped
        limited = _clipped(control, self._numbers.saturation_low, self._numbers.saturation_high)
        if self._is_slow and self._has_held:
            change = self._largest_change
            limited = _clipped(limited, self.held - change, self.held + change)
        return limited, limited != control

    def _measure(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Positions and velocities that the driver uses, from those of the joints now."""
        if self._is_late:
            self._latest = (self._latest - 1) % len(self._positions)
            self._positions[self._latest] = q
            self._velocities[self._latest] = v
            q, v = self._interpolation.past(self._positions, self._velocities, self._latest)

        if self._has_differences:
            v = np.where(self._differs, (q - self._measured) / self._seconds, v)
        self._measured = q

        if self._filters:
            self._velocity = self._velocity + self._velocity_share * (v - self._velocity)
            v = self._velocity
        return q, v


class _PastInterpolation:
    """Positions and velocities some time ago, between those at the latest ticks.

    Args:
        latency: (m, c) times ago [s].
        period: Time from one tick to the next [s].
    """

    def __init__(self, latency: Array, period: float) -> None:
        ticks = latency / period
        self._lag = np.floor(ticks).astype(np.intp)
        m, c = latency.shape
        self._curve, self._law = np.arange(m)[:, None], np.arange(c)

        # Weights of Hermite's polynomial on the way s from the earlier tick to the later one.
        s = 1.0 - (ticks - self._lag)
        self._later = s
        self._q_later = s * s * (3.0 - 2.0 * s)
        self._v_later = s * s * (s - 1.0) * period
        self._v_earlier = s * (s - 1.0) ** 2 * period

    def past(self, positions: Array, velocities: Array, latest: int) -> tuple[Array, Array]:
        """(m, c) positions and velocities.

        Args:
            positions: (D, m, c) positions at the latest ticks, in a ring.
            velocities: (D, m, c) velocities at the latest ticks.
            latest: Place of the latest tick in the ring; earlier ones follow.
        """
        later = (latest + self._lag) % len(positions)
        earlier = (later + 1) % len(positions)
        q1, v1 = (each[later, self._curve, self._law] for each in (positions, velocities))
        q0, v0 = (each[earlier, self._curve, self._law] for each in (positions, velocities))

        q = q0 + self._q_later * (q1 - q0) + self._v_later * v1 + self._v_earlier * v0
        return q, v0 + self._later * (v1 - v0)


def memory_at_begin(
    numbers: LawNumbers,
    commands: LawCommands,
    ticks: Ticks,
    state: tuple[Array, Array],
    sums: Array | None,
) -> LawMemory:
    """Memory of laws where a curve begins.

    Before it, the joints count as moving with their velocity at the begin.

    Args:
        numbers: Their numbers.
        commands: Commands of the log at the ticks.
        ticks: The ticks.
        state: (m, c) positions and velocities of the joints at the begin.
        sums: (m, c, 4) `MEASURED_SUMS` of each law at the begin; NaN, or None for all curves, where
            the integral is that of the begin of a recording.
    """
    q, v = state
    latency, period = numbers.feedback_latency, ticks.seconds
    size = int(np.floor(latency.max(initial=0.0) / period)) + 2
    times = -period * np.arange(1, size + 1)
    integral = numbers.integral
    if sums is not None:
        # The log holds neither the late reference nor the late measurement, whose effects on the
        # sum are known: latency and filter keep back an integral of the reference, and a late
        # measurement one of the position. They are accurate to the second order of the latency,
        # where the reference was at rest at the begin of the sum; a step of it between two ticks
        # counts with an error of up to half a period.
        errors, reference, position, share = np.moveaxis(sums, -1, 0)
        kept_back = commands.lag - commands.lag_time * reference
        measured_late = latency * (q - 0.5 * (latency + period) * v - position)
        late = numbers.ki * (measured_late - kept_back)
        if commands.gain is not None:
            late = late * commands.gain[commands.before]
        total = share * integral + numbers.ki * errors + late
        limited = _clipped(total, -numbers.integral_limit, numbers.integral_limit)
        integral = np.where(np.isnan(share), integral, limited)
    latest = max(commands.before - 1, 0)
    return LawMemory(
        held=np.zeros_like(q),
        reference=commands.reference[latest],
        reference_velocity=commands.velocity_at(latest),
        profile_velocity=commands.profile_velocity[latest],
        integral=integral,
        velocity=v,
        measured=q - v * (period + latency),
        positions=q + v * times[:, None, None],
        velocities=np.repeat(v[None], size, axis=0),
    )


def _clipped(values: Array, low: Array, high: Array) -> Array:
    """Values inside ranges of the same shape."""
    return np.minimum(np.maximum(values, low), high)
