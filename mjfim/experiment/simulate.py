"""`mjfim.simulate`, which makes a synthetic recording of a trajectory."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, SimulationDivergedError, listed
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.records.trajectory import Recording, Trajectory


def simulate(
    experiment: Experiment,
    trajectory: Trajectory | Array,
    seed: int | np.random.Generator = 0,
    *,
    threads: int | None = None,
) -> Recording:
    """Simulate a recording at the `true` parameter values.

    The trajectory's control is applied open loop, and noise is added to the measured samples. The
    motion begins at the initial state of the experiment, or where a design chooses the release, at
    that of the trajectory.

    Args:
        experiment: The experiment.
        trajectory: The trajectory whose control is applied; or (N, nu) controls, with control laws
            what they read of a log.
        seed: Seed of the noise, or a generator of random numbers.
        threads: Threads for the engine; default: one per core.

    Returns:
        The recording; outputs that are not measured at a sample are NaN.

    Raises:
        SimulationDivergedError: The simulation diverges under this control.
    """
    system = System.resolve(experiment, threads=threads)
    if not isinstance(trajectory, Trajectory):
        inputs = np.asarray(trajectory, dtype=np.float64)
        if inputs.ndim != 2 or inputs.shape[1] != len(system.inputs):
            raise ExperimentError(
                f"{experiment.source}: simulate: controls of shape {inputs.shape}; expected a row "
                f"for each sample with {len(system.inputs)} columns: {listed(system.inputs)}"
            )
        at_rest = np.tile(system.nominal_initial_state, (len(inputs) + 1, 1))
        trajectory = system.plant.trajectory(at_rest, inputs)
    return simulate_system(system, trajectory, seed)


def simulate_system(
    system: System, trajectory: Trajectory, seed: int | np.random.Generator = 0
) -> Recording:
    """Simulate a recording of a resolved system. See `simulate`."""
    system = system.released_as(trajectory.state[0])
    rng = np.random.default_rng(seed)
    true = system.parameters.true
    outputs, finite = system.plant.measure(true[None], trajectory.ctrl)
    if not finite[0]:
        why = system.plant.why_diverged(true, trajectory.ctrl)
        raise SimulationDivergedError(
            f"the simulation diverges at the true parameters under this control: {why}"
        )

    noisy = outputs[0] + system.noise.sample(len(outputs[0]), rng)

    # All outputs are recorded at the first sample, afterwards each output at its rate.
    measured = system.noise.measured(trajectory.samples)
    measured[0] = 1.0
    noisy[measured == 0.0] = np.nan

    return Recording(
        t=np.arange(len(noisy), dtype=np.float64) * system.dt,
        ctrl=trajectory.ctrl,
        y=noisy,
        outputs=system.outputs.names,
        name="simulated",
    )
