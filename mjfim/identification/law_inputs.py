"""Inputs that control laws read from a recording, on the sample grid."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.experiment.system import System
from mjfim.model.control_laws import MEASURED_SUMS, ControlLaw
from mjfim.plant.laws.law_commands import ON
from mjfim.plant.outputs import outputs_by_state


def inputs_of_laws(system: System, t: Array, rows: Array, held: Array, y: Array) -> Array:
    """Inputs of a simulation with control laws.

    Args:
        system: The system, with laws.
        t: (M,) times of the rows, from 0 [s].
        rows: (M-1, w) columns of the log from each row to the next one.
        held: (N, w) means of these columns over the samples of the grid.
        y: (M, ny) measured values in the order of the outputs.

    Returns:
        (N, w + further) inputs: held columns, or points of those that are interpolated, and for
        every law with an integral the columns `MEASURED_SUMS`.
    """
    assert system.laws is not None
    inputs = np.array(held)
    samples = np.arange(len(held)) * system.dt

    # Beyond the last row with a command, this command is held.
    for column in np.flatnonzero(~system.laws.held):
        inputs[:, column] = np.interp(samples, t[:-1], rows[:, column])

    sums = [_measured_sums(system, law, t, inputs, y) for law in system.laws.integrating]
    return np.concatenate([inputs, *sums], axis=1)


def _measured_sums(system: System, law: ControlLaw, t: Array, inputs: Array, y: Array) -> Array:
    """(N, 4) `MEASURED_SUMS` at the begin of every sample, before its own evaluation of the law.

    They are zero, and the integral is that of the begin of the recording, where the position is not
    measured.
    """
    N = len(inputs)
    unknown = np.zeros((N, len(MEASURED_SUMS)))
    unknown[:, -1] = 1.0
    output = outputs_by_state(system.model, system.outputs).get(law.q)
    measured = np.isfinite(y[:, output]) if output is not None else np.zeros(len(y), dtype=bool)
    if output is None or not measured.any():
        return unknown

    # Errors at all evaluations of the law in the recording.
    substeps, timestep = system.grid.substeps, float(system.model.opt.timestep)
    steps = np.arange(0, N * substeps, law.tick)
    sample = steps // substeps
    q = np.interp(steps * timestep, t[measured], y[measured, output])
    reference = inputs[sample, law.columns["reference"]]
    if law.interpolated:
        points = np.arange(N) * substeps
        reference = np.interp(steps, points, inputs[:, law.columns["reference"]])
    errors = law.tick * timestep * (reference - q)
    if "gain" in law.columns:
        errors = errors * inputs[sample, law.columns["gain"]]

    # The sum begins anew at every evaluation at which the law is off.
    total = np.concatenate([[0.0], np.cumsum(errors)])
    begun = np.zeros(len(steps) + 1, dtype=np.intp)
    if "enable" in law.columns:
        off = inputs[sample, law.columns["enable"]] < ON
        begun[1:] = np.maximum.accumulate(np.where(off, np.arange(1, len(steps) + 1), 0))

    # Number of evaluations before each sample.
    count = -(-(np.arange(N) * substeps) // law.tick)
    since = begun[count]
    place = np.minimum(since, len(steps) - 1)
    first = since == 0
    return np.column_stack(
        [
            total[count] - total[since],
            reference[place],
            q[place],
            np.where(first, 1.0, 0.0),
        ]
    )
