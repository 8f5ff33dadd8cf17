"""Duration of checks and of Monte-Carlo studies, estimated before they begin."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np

from mjfim.arrays import Array
from mjfim.duration import estimated_seconds
from mjfim.errors import MjfimError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System
from mjfim.records.trajectory import Trajectory
from mjfim.studies.check import evaluate_and_test
from mjfim.studies.trials import SHARED_STEPS

# Gauss-Newton steps with the Jacobian of each trial that most trials need.
USUAL_STEPS = 3

# Trials with which the estimate of the duration begins.
FIRST_TRIALS = 1


def check_seconds(system: System, control: Array, negligible: float = 0.0) -> float | None:
    """Estimate the time of a check along a control, by a check over a few samples.

    Args:
        system: The system.
        control: (N, nu) control [unit of the actuator].
        negligible: Duration that need not be known accurately [s].

    Returns:
        The time [s]; None where the first samples cannot be evaluated.
    """
    try:
        return estimated_seconds(
            lambda samples: evaluate_and_test(DesignTask.along(system, control[:samples])),
            len(control),
            negligible=negligible,
        )
    except (MjfimError, ValueError):
        # The check itself says what is wrong.
        return None


def trials_seconds(system: System, trajectories: Mapping[str, Trajectory], trials: int) -> float:
    """Estimate the time of the trials of a Monte-Carlo study, by simulations of a few of them.

    Args:
        system: The system.
        trajectories: Trajectories by name.
        trials: Number of repetitions of each.

    Returns:
        The time [s].
    """
    theta = system.parameters.true
    simulations = SHARED_STEPS - 1 + USUAL_STEPS * (1 + len(theta))

    def simulate(count: int, control: Array) -> None:
        """Simulate some trials of one trajectory."""
        system.plant.measure(np.tile(theta, (count, 1)), control)

    seconds = [
        estimated_seconds(partial(simulate, control=curve.ctrl), trials, first=FIRST_TRIALS)
        for curve in trajectories.values()
    ]
    return simulations * sum(seconds)
