"""Integrators of MuJoCo, and what follows from them."""

from __future__ import annotations

from typing import Any

import mujoco


def is_rk4(model: Any) -> bool:
    """Whether a model is integrated with RK4, which computes forces at four stages of a step.

    Args:
        model: The compiled model (`mujoco.MjModel`).
    """
    return int(model.opt.integrator) == int(mujoco.mjtIntegrator.mjINT_RK4)
