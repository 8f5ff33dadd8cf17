"""Limits that plots of states and controls show as lines."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from mjfim.arrays import evenly_spread_indices
from mjfim.model.coordinates import control_names, dof_names
from mjfim.output.rerun.series import NO_LIMITS, Curve, Range, SeriesPlot
from mjfim.records.design import Design, HistoryRow, LimitUsage

# Limits by kind, such as "position", and name of the degree of freedom or the actuator.
LimitsByName = dict[tuple[str, str], Range]

# Largest number of samples of the use of one limit.
MAX_SAMPLES = 5_000

# Colours (0..255) of the uses of limits of one kind, one after the other.
USE_COLOURS = (
    (0, 119, 187),
    (204, 51, 17),
    (0, 153, 136),
    (238, 119, 51),
    (170, 51, 119),
    (138, 109, 59),
    (150, 170, 60),
    (120, 130, 220),
)


def limits_of_model(model: mujoco.MjModel) -> LimitsByName:
    """Return the ranges of joints and actuators that the model states.

    Args:
        model: The model.
    """
    limits = {}
    names = dof_names(model)
    for joint in np.flatnonzero(model.jnt_limited):
        kind = mujoco.mjtJoint(int(model.jnt_type[joint]))
        if kind in (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE):
            lower, upper = model.jnt_range[joint].tolist()
            limits["position", names[model.jnt_dofadr[joint]]] = (lower, upper)

    controls = control_names(model)
    if len(controls) == len(model.actuator_ctrlrange):
        for actuator in np.flatnonzero(model.actuator_ctrllimited):
            lower, upper = model.actuator_ctrlrange[actuator].tolist()
            limits["control", controls[actuator]] = (lower, upper)
    return limits


def limits_of_design(model: mujoco.MjModel, design: Design) -> LimitsByName:
    """Return the limits of a design; the ranges of the model where the design states none.

    Args:
        model: The model.
        design: The design.
    """
    limits = limits_of_model(model)
    for used in design.usage:
        if np.isfinite(used.lower) or np.isfinite(used.upper):
            limits[used.kind, used.name] = (used.lower, used.upper)
    return limits


def limits_in_order(limits: LimitsByName, kind: str, names: Sequence[str]) -> list[Range]:
    """Return the limits of one kind, infinite where there is none.

    Args:
        limits: The limits.
        kind: The kind.
        names: Names of the degrees of freedom or actuators.
    """
    return [limits.get((kind, name), NO_LIMITS) for name in names]


def usage_plots(usage: Sequence[LimitUsage], history: Sequence[HistoryRow]) -> list[SeriesPlot]:
    """Return a plot of the use of the limits of each kind, with lines at the limits.

    Args:
        usage: Position of the designed trajectory between the bounds of every limit.
        history: The iterates, whose worst use of all limits is drawn on the timeline `iteration`.
    """
    plots = []
    for kind in dict.fromkeys(used.kind for used in usage):
        curves = [
            _curve_of_use(used, USE_COLOURS[k % len(USE_COLOURS)])
            for k, used in enumerate(used for used in usage if used.kind == kind)
        ]
        worst = _worst_use(history)
        plot = SeriesPlot(
            parts=("limits", kind),
            title=f"{kind.replace('_', ' ')}: share of the limit [%]",
            curves=[*curves, worst],
            limits=(-np.inf if kind == "clearance" else -100.0, 100.0),
            largest_zoom=np.inf,
        )
        plots.append(plot)
    return plots


def _curve_of_use(used: LimitUsage, colour: tuple[int, int, int]) -> Curve:
    """Use of one limit over time [%]."""
    rows = evenly_spread_indices(len(used.t), MAX_SAMPLES)
    return Curve(name=used.name, t=used.t[rows], values=100.0 * used.share[rows], colour=colour)


def _worst_use(history: Sequence[HistoryRow]) -> Curve:
    """Largest use of any limit by each iterate [%]; NaN where it is unknown."""
    return Curve(
        name="iterates",
        t=np.array([row.iteration for row in history], dtype=np.float64),
        values=np.array([100.0 * (1.0 - row.margin) for row in history]),
        colour=USE_COLOURS[0],
        timeline="iteration",
        legend=("largest share of any limit",),
    )
