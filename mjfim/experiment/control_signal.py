"""The control that a `kind = "sine" | "chirp" | ...` table of the experiment file describes."""

from __future__ import annotations

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.experiment.schema import by_name
from mjfim.experiment.signals import multisine
from mjfim.experiment.system_tables import Signal

# Frequencies of successive actuators differ by this fraction of the first actuator's frequency.
FREQUENCY_SPREAD = 0.17

# Last frequency of a chirp over its first one, where the experiment file does not state it.
CHIRP_SPAN = 5.0


def generate(signal: Signal, t: Array, names: tuple[str, ...], rest: Array) -> Array:
    """Generate the control of all actuators.

    Every actuator has a different frequency, so that the movements differ. Sines and chirps begin
    at their offset, without a jump.

    Args:
        signal: Kind of signal, its amplitude, offset and frequencies.
        t: (N,) sample times [s].
        names: nu names of the actuators.
        rest: (nu,) offset that is used if the signal states none [control unit].

    Returns:
        (N, nu) control [control unit].

    Raises:
        ExperimentError: The amplitude or the offset names an unknown actuator.
    """
    amplitude = by_name("initial.control.amplitude", signal.amplitude, names, "actuator")

    offset = np.array(rest)
    if signal.offset is not None:
        offset = by_name("initial.control.offset", signal.offset, names, "actuator")

    return np.asarray(offset + amplitude * _shape(signal, t, len(names)))


def _shape(signal: Signal, t: Array, nu: int) -> Array:
    """(N, nu) waveform of each actuator with amplitude 1 and no offset; ones for a constant."""
    spread = 1.0 + FREQUENCY_SPREAD * np.arange(nu)

    if signal.kind == "sine":
        return np.asarray(np.sin(2 * np.pi * signal.frequency * t[:, None] * spread))

    if signal.kind == "chirp":
        first = signal.frequency
        last = signal.frequency_end or CHIRP_SPAN * first
        sweeps = [scipy.signal.chirp(t, first * s, t[-1], last * s, phi=-90.0) for s in spread]
        return np.stack(sweeps, axis=1)

    if signal.kind == "multisine":
        rng = np.random.default_rng(signal.seed)
        return multisine(t, nu, signal.frequency, signal.harmonics, rng)

    return np.ones((len(t), nu))
