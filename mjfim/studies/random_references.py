"""Random references of control laws, which show whether other references would tell more."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.task import (
    LEAST_PROBE_AMPLITUDE,
    MOST_PROBE_AMPLITUDE,
    RANDOM_HARMONICS,
    DesignTask,
)
from mjfim.experiment.signals import multisine
from mjfim.model.control_laws import ControlLaws
from mjfim.records.trajectory import Trajectory

# Columns of a log that are no signals, but say which law acts.
SWITCHES = ("gain:", "enable:")


def random_references(task: DesignTask, count: int) -> Iterator[Trajectory]:
    """Simulate closed loops under random multisines in place of the inputs of a log.

    They are up to twice as large as the inputs, about their means. Factors of gains and the columns
    that switch laws on stay as they are; velocities of references are the slopes of the references.

    Args:
        task: The task along a recording, with control laws.
        count: Number of motions.

    Yields:
        Motions; those that diverge are left out.
    """
    laws = task.system.laws
    assert laws is not None
    rng = np.random.default_rng(task.experiment.descent.seed)
    logged = task.initial.ctrl
    for _ in range(count):
        share = rng.uniform(LEAST_PROBE_AMPLITUDE, MOST_PROBE_AMPLITUDE)
        try:
            yield task.plant.simulate(task.theta, _random_inputs(laws, logged, task, share, rng))
        except SimulationDivergedError:
            continue


def _random_inputs(
    laws: ControlLaws, logged: Array, task: DesignTask, share: float, rng: np.random.Generator
) -> Array:
    """(N, w) random inputs, with `share` times the amplitudes of logged ones: (N, w)."""
    mean = logged.mean(axis=0)
    peak = np.abs(logged - mean).max(axis=0)
    wave = multisine(task.t, logged.shape[1], 1.0 / task.horizon, RANDOM_HARMONICS, rng)
    inputs = mean + share * peak * wave

    kept = [i for i, name in enumerate(laws.columns) if name.startswith(SWITCHES)]
    inputs[:, kept] = logged[:, kept]
    for law in laws.laws:
        if "reference_velocity" in law.columns:
            reference = inputs[:, law.columns["reference"]]
            inputs[:, law.columns["reference_velocity"]] = np.gradient(reference, task.dt)
    return np.asarray(inputs)
