"""Inputs of control laws that an experiment states, to simulate a recording of its closed loop."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.excitation.task_parts import require_horizon_and_control, sample_count
from mjfim.experiment.control_signal import generate
from mjfim.experiment.packing import opened
from mjfim.experiment.system import System
from mjfim.experiment.system_tables import Signal
from mjfim.model.control_laws import ControlLaws
from mjfim.recordings.control_table import read_control
from mjfim.records.trajectory import Trajectory


def stated_motion(system: System) -> Trajectory:
    """Motion of a closed loop under the references that `initial.control` states.

    Args:
        system: The system, with control laws.

    Returns:
        The motion at theta.

    Raises:
        ExperimentError: The horizon, the signal or the file cannot be used.
        SimulationDivergedError: The simulation diverges.
    """
    require_horizon_and_control(system, "simulate without a design")
    try:
        inputs = stated_inputs(system)
    except ExperimentError as error:
        raise ExperimentError(f"{system.experiment.source}: {error}") from None
    return system.plant.simulate(system.theta, inputs)


def stated_inputs(system: System) -> Array:
    """Inputs of control laws over the stated horizon.

    A table holds a column for each input. A generated signal is the reference of actuators with a
    law, about the initial position of their joints, and the control of the others; the velocity of
    the reference is its slope, there is no feed-forward, and all laws are on.

    Args:
        system: The system, with control laws.

    Returns:
        (N, w) inputs [unit of the input].

    Raises:
        ExperimentError: The horizon, the signal or the file cannot be used.
    """
    experiment, laws = system.experiment, system.laws
    assert laws is not None
    dt = system.stated_grid.dt
    t = np.arange(sample_count(experiment, system.stated_grid.stride), dtype=np.float64) * dt

    source = experiment.initial.control
    if not isinstance(source, Signal):
        names = tuple(name.removeprefix("ctrl:") for name in laws.columns)
        with opened(experiment, str(source)) as file:
            return read_control(file, t, dt, names)

    rest = np.array(system.rest)
    for law in laws.laws:
        rest[law.control] = system.nominal_initial_state[law.q]
    return _of_signal(laws, generate(source, t, system.controls, rest), dt)


def _of_signal(laws: ControlLaws, signal: Array, dt: float) -> Array:
    """(N, w) inputs from one signal for each actuator: (N, nu)."""
    inputs = np.zeros((len(signal), len(laws.inputs)))
    places, controls = laws.direct
    inputs[:, places] = signal[:, controls]

    for law in laws.laws:
        reference = signal[:, law.control]
        values = {
            "reference": reference,
            "reference_velocity": np.gradient(reference, dt),
            "gain": np.ones(len(signal)),
            "enable": np.ones(len(signal)),
        }
        for quantity, column in law.columns.items():
            inputs[:, column] = values.get(quantity, 0.0)
    return inputs
