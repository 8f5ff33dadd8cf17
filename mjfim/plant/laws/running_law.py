"""Control laws in the loop: what they remember, and their controls from one evaluation to the next.

At a tick k, with the measured position q and velocity v, and the commands of the log,

    I_k = I_k-1 + g ki T (r_k - q),      clipped to the limit of the integral
    u_k = g (kp (r_k - q) + kd (rdot_k - v)) + I_k + f_k

is clipped to the range of the control, then to the largest change since the last tick. The factor g
and the feed-forward f come from the log. The measurement is that of the model, late by the latency
of the feedback: positions between two ticks follow the cubic polynomial through their positions and
velocities, velocities a straight line, so that they depend continuously on the latency.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.model.control_laws import ControlLaw
from mjfim.plant.laws.law_commands import LawCommands, LawNumbers, Ticks, filter_shares


@dataclass(frozen=True, kw_only=True, eq=False)
class LawMemory:
    """Memory of c laws with one period from one evaluation to the next, for m curves.

    Attributes:
        held: (m, c) controls that the laws hold [u-unit].
        integral: (m, c) integrals [u-unit].
        velocity: (m, c) filtered velocities [m/s or rad/s].
        measured: (m, c) measured positions at the latest evaluation [m or rad].
        positions: (D, m, c) positions at the latest D evaluations, the latest one first.
        velocities: (D, m, c) velocities at these evaluations.
    """

    held: Array
    integral: Array
    velocity: Array
    measured: Array
    positions: Array
    velocities: Array


@dataclass(frozen=True, kw_only=True, eq=False)
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
    def none(cls, inputs: Array) -> InputContext:
        """The context of curves at the begin of recordings.

        Args:
            inputs: (m, N, w) inputs of the curves.
        """
        nothing = inputs[:, :0]
        begin = np.zeros(len(inputs), dtype=np.intp)
        return cls(before=nothing, after=nothing, samples=begin)

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


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopTrace:
    """Record of control laws along m curves of N samples.

    Attributes:
        controls: (m, N, nu) controls at the begin of every sample [u-unit].
        is_clipped: (m, N, laws) True where the range or the largest change of a control has clipped
            it.
        memory: Memory at the end of the curves, grouped by the periods of the laws.
    """

    controls: Array
    is_clipped: np.ndarray
    memory: tuple[LawMemory, ...]


class RunningLaws:
    """C laws with one period, which compute the controls of m curves at successive ticks.

    Attributes:
        held: (m, c) controls that the laws hold now [u-unit].
        is_clipped: (m, c) True where the range or the largest change has clipped them.
        has_limits: True where something may clip them.
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
        self._numbers = numbers
        self._commands = commands
        self._drive = commands.drive(numbers)
        self._next = ticks.before

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
        self.has_limits = any(bool(np.isfinite(limit).any()) for limit in limits)
        self._is_slow = bool(np.isfinite(numbers.slew).any())
        self._filters = bool((self._velocity_share < 1.0).any())
        self._is_late = bool(numbers.feedback_latency.any())

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
        return LawMemory(
            held=self.held,
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
        control: Array = self._drive[tick] - gain * (numbers.kp * q + numbers.kd * v)
        if self._integrates:
            step = gain * (self._integral_step * (commands.reference[tick] - q))
            limit = numbers.integral_limit
            self._integral = _clipped(self._integral + step, -limit, limit)
            control += self._integral
        if self.has_limits:
            limited = _clipped(control, numbers.saturation_low, numbers.saturation_high)
            if self._is_slow and self._has_held:
                change = self._largest_change
                limited = _clipped(limited, self.held - change, self.held + change)
            self.is_clipped = limited != control
            control = limited

        # A driver that is off forgets its integral.
        if commands.enabled is not None:
            enabled = commands.enabled[tick]
            control *= enabled
            self._integral = self._integral * enabled

        self.held = control
        self._has_held = True
        return control

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

    return LawMemory(
        held=np.zeros_like(q),
        integral=_integral_at_begin(numbers, commands, state, sums, period),
        velocity=v,
        measured=q - v * (period + latency),
        positions=q + v * times[:, None, None],
        velocities=np.repeat(v[None], size, axis=0),
    )


def _integral_at_begin(
    numbers: LawNumbers,
    commands: LawCommands,
    state: tuple[Array, Array],
    sums: Array | None,
    period: float,
) -> Array:
    """(m, c) integrals before the first tick, from the errors that were measured before it.

    The log holds neither the late reference nor the late measurement, whose effects on the sum are
    known: latency and filter keep back an integral of the reference, and a late measurement one of
    the position. They are accurate to the second order of the latency, where the reference was at
    rest at the begin of the sum; a step of it between two ticks counts with an error of up to half
    a period.
    """
    if sums is None:
        return numbers.integral

    q, v = state
    errors, reference, position, share = np.moveaxis(sums, -1, 0)
    latency = numbers.feedback_latency
    kept_back = commands.lag - commands.lag_time * reference
    measured_late = latency * (q - 0.5 * (latency + period) * v - position)

    late = numbers.ki * (measured_late - kept_back)
    if commands.gain is not None:
        late = late * commands.gain[commands.before]
    integral = share * numbers.integral + numbers.ki * errors + late
    limited = _clipped(integral, -numbers.integral_limit, numbers.integral_limit)
    return np.asarray(np.where(np.isnan(share), numbers.integral, limited))


def _clipped(values: Array, low: Array, high: Array) -> Array:
    """Values inside ranges of the same shape."""
    return np.asarray(np.minimum(np.maximum(values, low), high))
