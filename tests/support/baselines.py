"""An experiment under limits for the baselines, and a simulation by a plain loop."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from tests.support import limits
from tests.support.cart_pendulum import cart_pendulum
from tests.support.numerics import Array


def pendulum(bandwidth: float | None = None, **tables: Any) -> Experiment:
    """Return the cart-pendulum over two seconds under hard limits, without weights.

    Args:
        bandwidth: Limit of the bandwidth [Hz].
        **tables: Further tables of the experiment.
    """
    hard = {
        "horizon": 2.0,
        "limits": {
            "control": {"force": (-5.0, 5.0)},
            "position": {"slide": (-0.5, 0.5)},
            "bandwidth": bandwidth,
        },
        "cost": {"control": 0.0, "tracking": {}},
    }
    return cart_pendulum(**{**hard, **tables})


def played(experiment: Experiment, control: Array) -> tuple[Array, Array, Array]:
    """Simulate a control on the model of the user by a plain loop around `mj_step`.

    Args:
        experiment: The experiment.
        control: (N, nu) control.

    Returns:
        Positions (n+1, nq), velocities (n+1, nv) and controls (n, nu) at all n engine steps.
    """
    task = DesignTask.resolve(experiment)
    model, substeps = task.system.model_at(task.theta), task.system.grid.substeps
    start = model.key(experiment.initial.keyframe)
    found = limits.played(model, (start.qpos, start.qvel), control, substeps)
    qpos, qvel = np.vstack([start.qpos, found["q"]]), np.vstack([start.qvel, found["v"]])
    return qpos, qvel, np.repeat(control, substeps, axis=0)
