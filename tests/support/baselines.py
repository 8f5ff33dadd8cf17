"""An experiment under limits for the baselines, and a simulation by a plain loop."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
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
    model = task.system.model_at(task.theta)
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key(experiment.initial.keyframe).id)

    qpos = [data.qpos.copy()]
    qvel = [data.qvel.copy()]
    ctrl = []
    for u in np.repeat(control, task.system.grid.substeps, axis=0):
        data.ctrl[:] = u
        mujoco.mj_step(model, data)
        qpos.append(data.qpos.copy())
        qvel.append(data.qvel.copy())
        ctrl.append(u)

    return np.array(qpos), np.array(qvel), np.array(ctrl)
