"""`mjfim.simulate`: a synthetic recording of a trajectory."""

from __future__ import annotations

import numpy as np

from mjfim.errors import SimulationDivergedError
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import Setup
from mjfim.records.recording import Recording
from mjfim.records.trajectory import Trajectory


def simulate(
    experiment: Experiment | Setup, trajectory: Trajectory, seed: int | np.random.Generator = 0
) -> Recording:
    """A synthetic recording at the `true` values: the trajectory's control played open loop, noise on measured samples."""
    setup = experiment if isinstance(experiment, Setup) else Setup(experiment)
    rng = np.random.default_rng(seed)
    y, finite = setup.plant.measure(setup.parameters.true[None], trajectory.ctrl)
    if not finite[0]:
        raise SimulationDivergedError(
            "the simulation diverges at the true parameters under this control"
        )
    noisy = y[0] + setup.noise.sample(len(y[0]), rng)
    measured = setup.noise.measured(trajectory.samples)
    measured[0] = 1.0
    noisy[measured == 0.0] = np.nan
    return Recording(
        t=np.arange(len(noisy), dtype=np.float64) * setup.dt,
        ctrl=trajectory.ctrl,
        y=noisy,
        outputs=setup.outputs.names,
        name="simulated",
    )
