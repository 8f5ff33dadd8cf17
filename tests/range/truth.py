"""Simulation and derivatives by plain MuJoCo, with nothing of the package."""

from __future__ import annotations

import copy
from dataclasses import dataclass
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


@dataclass(frozen=True, kw_only=True)
class Information:
    """Fisher information by plain MuJoCo.

    Attributes:
        matrix: (p, p) information about relative parameters; NaN where it diverges.
        error: Its relative error, from the difference of two steps.
        warning: Name of MuJoCo's warning if the simulation diverges; else empty.
    """

    matrix: Array
    error: float
    warning: str


def divergence(data: Any) -> str:
    """Name of MuJoCo's warning about a diverging simulation; empty without one."""
    for name in ("BADQPOS", "BADQVEL", "BADQACC", "BADCTRL"):
        kind = getattr(mujoco.mjtWarning, f"mjWARN_{name}")
        if data.warning[int(kind)].number:
            return name
    return ""


def play(model: Any, start: Any, ctrl: Array, substeps: int) -> tuple[Array, Array, str]:
    """Play a control.

    Args:
        model: The model.
        start: qpos at the begin, or None for the reference pose.
        ctrl: (N, nu) controls.
        substeps: Engine steps per sample.

    Returns:
        (N+1, nq+nv) states, (N+1, nsensordata) sensor data, and the name of MuJoCo's warning.
    """
    data = mujoco.MjData(model)
    if start is not None:
        data.qpos[:] = start
    states, sensors = [], []
    level = mujoco.MjLogConfig.get()
    level.logto_console = level.logto_file = False
    mujoco.MjLogConfig.set(level)
    for u in [*ctrl, ctrl[-1]]:
        states.append(np.concatenate([data.qpos, data.qvel]))
        data.ctrl[:] = u
        if model.nsensordata:
            mujoco.mj_forward(model, data)
            sensors.append(np.array(data.sensordata))
        mujoco.mj_step(model, data, substeps)
        # The last step belongs to no sample.
        if len(states) <= len(ctrl) and divergence(data):
            break
    return np.array(states), np.array(sensors), divergence(data)


def changed(model: Any, targets: list[str], factors: Array) -> Any:
    """A copy of a model with every parameter multiplied by a factor."""
    other = copy.copy(model)
    for target, factor in zip(targets, factors, strict=True):
        path, _, field = target.partition(":")
        kind, _, name = path.partition("/")
        field, _, index = field.partition("[")
        values = getattr(other, ARRAYS[kind, field])
        row = mujoco.mj_name2id(
            model,
            mujoco.mjtObj.mjOBJ_BODY if kind == "body" else mujoco.mjtObj.mjOBJ_JOINT,
            name,
        )
        if field in ("damping", "armature"):
            row = model.jnt_dofadr[row]
        if index:
            values[row, int(index[:-1])] *= factor
        else:
            values[row] *= factor
    mujoco.mj_setConst(other, mujoco.MjData(other))
    return other


def information(xml: str, tables: dict[str, Any], ctrl: Array, substeps: int) -> Information:
    """Fisher information about the relative parameters at their true values.

    Args:
        xml: The MJCF at the true parameters.
        tables: Tables of the experiment.
        ctrl: (N, nu) controls.
        substeps: Engine steps per sample.
    """
    model = mujoco.MjModel.from_xml_string(xml)
    targets = [entry["target"] for entry in tables["parameters"].values()]
    start = tables["initial"].get("qpos")
    p = len(targets)
    _, _, warning = play(model, start, ctrl, substeps)
    if warning:
        return Information(matrix=np.full((p, p), np.nan), error=np.inf, warning=warning)

    matrices = []
    for step in STEPS:
        G = []
        for j in range(p):
            ends = []
            for sign in (1.0, -1.0):
                factors = np.ones(p)
                factors[j] += sign * step
                states, sensors, bad = play(changed(model, targets, factors), start, ctrl, substeps)
                y = _outputs(model, tables, states, sensors)
                ends.append(np.full((len(ctrl) + 1, y.shape[1]), np.nan) if bad else y)
            G.append((ends[0] - ends[1]) / (2.0 * step) / 0.01)
        rows = np.array(G).reshape(p, -1)
        matrices.append(rows @ rows.T)

    # The step with the least disagreement to its neighbour.
    best, error = matrices[0], np.inf
    for one, two in pairwise(matrices):
        change = relative_change(one, two)
        if change < error:
            best, error = two, change
    return Information(matrix=best, error=error, warning="")


def relative_change(one: Array, two: Array) -> float:
    """Largest relative difference of two information matrices, along all directions."""
    if not (np.isfinite(one).all() and np.isfinite(two).all()):
        return float("inf")
    scale = np.sqrt(np.diag(two))
    if not one.any() and not two.any():
        return 0.0
    if not (scale > 0.0).all():
        return float("inf")
    return float(np.abs((one - two) / np.outer(scale, scale)).max())


def _outputs(model: Any, tables: dict[str, Any], states: Array, sensors: Array) -> Array:
    """(N+1, ny) outputs: the state, or all sensors."""
    return states if "state" in tables["noise"] else sensors
