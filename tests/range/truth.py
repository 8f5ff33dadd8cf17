"""Simulation and derivatives by plain MuJoCo, with nothing of the package."""

from __future__ import annotations

import copy
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np

Array = np.ndarray

# Relative difference steps that are tried; the derivative with the smallest error counts.
STEPS = tuple(10.0 ** np.linspace(-2.0, -6.0, 9))

# MjModel array of every field of a parameter path.
ARRAYS = {
    ("body", "mass"): "body_mass",
    ("body", "inertia"): "body_inertia",
    ("body", "ipos"): "body_ipos",
    ("joint", "damping"): "dof_damping",
    ("joint", "armature"): "dof_armature",
    ("joint", "stiffness"): "jnt_stiffness",
}

# Warnings of MuJoCo about a diverging simulation.
BAD = [int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}")) for name in ("QPOS", "QVEL", "QACC")]


def play(model: Any, start: Any, ctrl: Array, substeps: int) -> Array:
    """(N+1, nq+nv) states, or NaN where the simulation diverges.

    Args:
        model: The model.
        start: qpos at the begin, or None for the reference pose.
        ctrl: (N, nu) controls.
        substeps: Engine steps per sample.
    """
    data = mujoco.MjData(model)
    if start is not None:
        data.qpos[:] = start
    level = mujoco.MjLogConfig.get()
    level.logto_console = level.logto_file = False
    mujoco.MjLogConfig.set(level)

    states = [np.concatenate([data.qpos, data.qvel])]
    for u in ctrl:
        data.ctrl[:] = u
        mujoco.mj_step(model, data, substeps)
        states.append(np.concatenate([data.qpos, data.qvel]))
    if any(data.warning[kind].number for kind in BAD):
        return np.full((len(states), len(states[0])), np.nan)
    return np.array(states)


def changed(model: Any, target: str, factor: float) -> Any:
    """A copy of a model with one parameter multiplied by a factor."""
    other = copy.copy(model)
    path, _, field = target.partition(":")
    kind, _, name = path.partition("/")
    field, _, index = field.partition("[")
    place: Any = getattr(model, kind)(name).id
    if field in ("damping", "armature"):
        place = model.jnt_dofadr[place]
    if index:
        place = (place, int(index[:-1]))
    getattr(other, ARRAYS[kind, field])[place] *= factor
    mujoco.mj_setConst(other, mujoco.MjData(other))
    return other


def information(
    xml: str, tables: dict[str, Any], ctrl: Array, substeps: int
) -> tuple[Array, float]:
    """Fisher information about the relative parameters at their true values.

    Args:
        xml: The MJCF at the true parameters.
        tables: Tables of the experiment.
        ctrl: (N, nu) controls.
        substeps: Engine steps per sample.

    Returns:
        (p, p) information, and its relative error from the difference of two steps; where the
        simulation diverges, the information is NaN and the error is infinite.
    """
    model = mujoco.MjModel.from_xml_string(xml)
    start = tables["initial"].get("qpos")

    # The quaternion of a free body turns by half of the angle that its noise states.
    sigma = np.full(model.nq + model.nv, tables["noise"]["state"])
    sigma[3 : 3 + 4 * (model.nq - model.nv)] *= 0.5

    matrices = []
    for step in STEPS:
        G = []
        for entry in tables["parameters"].values():
            above, below = (
                play(changed(model, entry["target"], 1.0 + sign * step), start, ctrl, substeps)
                for sign in (1.0, -1.0)
            )
            G.append(((above - below) / (2.0 * step * sigma)).ravel())
        matrices.append(np.array(G) @ np.array(G).T)

    # The step with the least disagreement to its neighbour.
    best, error = np.full_like(matrices[0], np.nan), np.inf
    for one, two in pairwise(matrices):
        change = relative_change(one, two)
        if change < error:
            best, error = two, change
    return best, error


def relative_change(one: Array, two: Array) -> float:
    """Largest relative difference of two information matrices, along all directions."""
    scale = np.sqrt(np.diag(two))
    if not (np.isfinite(one).all() and (scale > 0.0).all()):
        return np.inf
    return float(np.abs((one - two) / np.outer(scale, scale)).max())
