"""The control that a `kind = "sine" | "chirp" | ...` table of the experiment file describes."""

from __future__ import annotations

import numpy as np
from scipy.signal import chirp

from mjfim.arrays import Array
from mjfim.experiment.schema import by_name
from mjfim.experiment.system_tables import Signal
from mjfim.signals import multisine

# Each actuator's frequency exceeds that of the one before by this share of the first frequency.
FREQUENCY_SPREAD = 0.17

# Last frequency of a chirp over its first one, where the experiment file does not state it.
CHIRP_SPAN = 5.0


def generate(signal: Signal, t: Array, names: tuple[str, ...], rest: Array) -> Array:
    """Generate the control of all actuators; every actuator has a frequency different from the others.

    Sines and chirps begin at their offset, without a jump.

    Args:
        signal: Kind of signal, its amplitude, offset and frequencies.
        t: (N,) sample times [s].
        names: nu names of the actuators.
        rest: (nu,) offset where the signal states none [control unit].

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
    """(N, nu) curve of each actuator, with amplitude 1 about zero."""
    spread = 1.0 + FREQUENCY_SPREAD * np.arange(nu)

    if signal.kind == "sine":
        return np.asarray(np.sin(2 * np.pi * signal.frequency * t[:, None] * spread))

    if signal.kind == "chirp":
        first = signal.frequency
        last = signal.frequency_end or CHIRP_SPAN * first
        sweeps = [chirp(t, first * s, t[-1], last * s, phi=-90.0) for s in spread]
        return np.stack(sweeps, axis=1)

    if signal.kind == "multisine":
        rng = np.random.default_rng(signal.seed)
        return multisine(t, nu, signal.frequency, signal.harmonics, rng)

    return np.ones((len(t), nu))
