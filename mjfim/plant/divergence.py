"""Reasons why a simulation diverges: MuJoCo's warning, where and when it occurs, and what helps.

The simulation is stepped again, one sample after the other, until MuJoCo warns.
"""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.model.loading import silence_mujoco_log
from mjfim.plant.batch import MAX_CONTROL, state_space

# Names of MuJoCo's warnings about numbers that are not finite or huge.
WARNINGS = ("BADQPOS", "BADQVEL", "BADQACC")

# Numbers by which the timestep is divided to find one with which the simulation does not diverge.
DIVISORS = (2, 4, 8, 16, 32)

# Advice where MuJoCo gives no warning or no smaller timestep helps.
NO_WARNING = "a smaller amplitude or timestep may help"

# Largest number of engine steps that one of these simulations takes.
MAX_STEPS = 200_000


def explain_divergence(model: Any, start: Array, ctrl: Array, substeps: int) -> str:
    """Explain why a simulation diverges, and say what may help.

    Args:
        model: The model.
        start: (ns,) initial state.
        ctrl: (N, nu) controls, each held over its sample.
        substeps: `mj_step` calls per sample.

    Returns:
        A clause for a message.
    """
    rejected = np.argwhere(~(np.abs(ctrl) <= MAX_CONTROL))
    if len(rejected):
        sample, actuator = rejected[0].tolist()
        return (
            f"the control of actuator {model.actuator(actuator).name or actuator} is "
            f"{ctrl[sample, actuator]:.3g}, and MuJoCo rejects controls above {MAX_CONTROL:.0e} "
            "(BADCTRL); a larger gear of the actuator needs smaller controls"
        )

    found = find_divergence(model, start, ctrl, substeps)
    if found is None:
        return NO_WARNING

    stable = _stable_timestep(model, start, ctrl, substeps)
    timestep = float(model.opt.timestep)
    if stable is None:
        return f"{found}; {NO_WARNING}"
    return (
        f"{found}, because the timestep {timestep:g} s of the MJCF is too long for its integrator: "
        f"with {stable:g} s the simulation does not diverge"
    )


def find_divergence(model: Any, start: Array, ctrl: Array, substeps: int) -> str | None:
    """Step a simulation until MuJoCo warns.

    Args:
        model: The model.
        start: (ns,) initial state.
        ctrl: (N, nu) controls, each held over its sample.
        substeps: `mj_step` calls per sample.

    Returns:
        The first warning, its joint and time in words; None without one.
    """
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:] = state_space(model).split(start)

    duration = substeps * float(model.opt.timestep)
    for k, u in enumerate(ctrl):
        data.ctrl[:] = u
        with silence_mujoco_log():
            mujoco.mj_step(model, data, substeps)
        for name in WARNINGS:
            warning = data.warning[int(getattr(mujoco.mjtWarning, f"mjWARN_{name}"))]
            if warning.number:
                # An address in qpos (BADQPOS) or qvel belongs to a joint.
                addresses = model.jnt_qposadr if name == "BADQPOS" else model.jnt_dofadr
                joint = np.searchsorted(addresses, int(warning.lastinfo), side="right") - 1
                named = model.joint(int(joint)).name
                where = f" at joint {named}" if named else ""
                return f"MuJoCo warns {name}{where} at t = {(k + 1) * duration:.4g} s"
    return None


def _stable_timestep(model: Any, start: Array, ctrl: Array, substeps: int) -> float | None:
    """Longest of some smaller timesteps with which a simulation does not diverge [s].

    The arguments are those of `find_divergence`. None if there is no such timestep.
    """
    refined = copy.copy(model)
    for divisor in DIVISORS:
        if len(ctrl) * substeps * divisor > MAX_STEPS:
            return None

        timestep = float(model.opt.timestep) / divisor
        refined.opt.timestep = timestep
        if find_divergence(refined, start, ctrl, substeps * divisor) is None:
            return timestep
    return None
