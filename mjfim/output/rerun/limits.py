"""Limits that plots of states and controls show as lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np

from mjfim.arrays import Array, evenly_spread_indices
from mjfim.model.coordinates import control_names, dof_names
from mjfim.output import vocabulary
from mjfim.output.limit_curves import (
    closest_to_bounds,
    envelope,
    largest_share,
    whole_percent,
    would_be_solid,
)
from mjfim.output.rerun.iterates import IterateCurves
from mjfim.output.rerun.series import (
    NO_LIMITS,
    Curve,
    Range,
    SeriesPlot,
    with_room_for_legends,
)
from mjfim.records.design import Design, HistoryRow, LimitUsage

# Limits by kind, such as "position", and name of the degree of freedom or the actuator.
LimitsByName = dict[tuple[str, str], Range]

# Largest number of samples of the use of one limit.
MAX_SAMPLES = 5_000

# Colours (0..255) of joints, actuators and pairs of geoms; each has the same one in all plots.
USE_COLOURS = (
    (0, 119, 187),
    (204, 51, 17),
    (0, 153, 136),
    (238, 119, 51),
    (170, 51, 119),
    (190, 170, 60),
    (120, 130, 220),
    (102, 204, 238),
    (230, 110, 140),
    (60, 150, 60),
    (150, 105, 70),
    (180, 180, 180),
)

# Number of curves of a plot that are named, those closest to a bound; the others are thin and share
# a name and a colour (0..255).
NAMED_CURVES, OTHERS, THIN, OTHERS_COLOUR = 3, "others", 0.5, (120, 120, 120)

# Kinds of limits whose use by an iterate can be read from its thinned motion.
KINDS_OF_MOTIONS = ("position", "control")


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


def usage_plots(design: Design, iterates: IterateCurves | None) -> list[SeriesPlot]:
    """Return a plot of the use of the limits of each kind, with lines at the limits.

    Over time it is that of the designed trajectory; on the timeline `iteration`, the largest one of
    each iterate.

    Args:
        design: The design.
        iterates: Motions of the iterates; None without any.
    """
    names = closest_to_bounds(design.usage)
    colours = {name: USE_COLOURS[k % len(USE_COLOURS)] for k, name in enumerate(names)}
    plots = []
    for kind in dict.fromkeys(used.kind for used in design.usage):
        uses = [used for used in design.usage if used.kind == kind]
        named = closest_to_bounds(uses)
        if len(named) > NAMED_CURVES + 1:
            named = named[:NAMED_CURVES]
        curves = [_curve_of_use(used, colours[used.name], used.name in named) for used in uses]
        worst = _worst_use(kind, uses, design.history)
        if not worst.finite.any() and iterates is not None and kind in KINDS_OF_MOTIONS:
            worst = _worst_of_motions(kind, uses, iterates)
        if not worst.finite.any():
            worst = _worst_of_design(uses, design.history)

        plot = SeriesPlot(
            parts=("limits", kind),
            title=f"{kind.replace('_', ' ')}: share of the limit [%]",
            curves=[*curves, worst],
            limits=(-np.inf if kind == "clearance" else -100.0, 100.0),
            largest_zoom=np.inf,
            own_legend=True,
        )
        plots.append(plot)
    return with_room_for_legends([plot for plot in plots if not plot.is_empty])


def _curve_of_use(used: LimitUsage, colour: tuple[int, int, int], is_named: bool) -> Curve:
    """Use of one limit over time [%]; of a curve that would be an area, its peaks."""
    label = f"{used.name}, {whole_percent(largest_share(used))}"
    if would_be_solid(used):
        t, low, high = envelope(used)
        values = np.where(np.abs(low) > np.abs(high), low, high)
    else:
        rows = evenly_spread_indices(len(used.t), MAX_SAMPLES)
        t, values = used.t[rows], 100.0 * used.share[rows]

    return Curve(
        name=used.name,
        t=t,
        values=values,
        colour=colour if is_named else OTHERS_COLOUR,
        legend=(label if is_named else OTHERS,),
        width=1.0 if is_named else THIN,
    )


# ---- use by the iterates


def _worst_use(kind: str, uses: Sequence[LimitUsage], history: Sequence[HistoryRow]) -> Curve:
    """Largest use of any limit of a kind by each iterate [%]; NaN where it is unknown."""
    margins = np.array([row.margins.get(kind, np.nan) for row in history])
    shares = 1.0 - margins
    if kind == "clearance" and all(used.lower > 0.0 for used in uses):
        # A margin is relative to the required distance; the share is that of the distance.
        distances = np.where(margins > -1.0, 1.0 + margins, np.nan)
        shares = 1.0 / distances
    return _over_iterations(np.array([row.iteration for row in history]), shares)


def _worst_of_motions(kind: str, uses: Sequence[LimitUsage], iterates: IterateCurves) -> Curve:
    """Largest use of any limit of positions or controls by the motion of each iterate [%]."""
    model = iterates.model
    names = dof_names(model) if kind == "position" else control_names(model)
    values = iterates.positions if kind == "position" else iterates.controls

    shares = np.full(len(values), np.nan)
    for used in uses:
        half = 0.5 * (used.upper - used.lower)
        if used.name in names and np.isfinite(half) and half > 0.0:
            column = values[:, :, names.index(used.name)]
            share = np.abs(column - used.lower - half).max(axis=1) / half
            shares = np.fmax(shares, share)
    return _over_iterations(iterates.iterations, shares)


def _worst_of_design(uses: Sequence[LimitUsage], history: Sequence[HistoryRow]) -> Curve:
    """Largest use by the designed trajectory [%], where that of the iterates is unknown."""
    iterations = np.array([row.iteration for row in history])
    level = max(largest_share(used) for used in uses)
    found = _over_iterations(iterations, np.full(len(iterations), level))
    return replace(found, legend=("largest of the designed trajectory",))


def _over_iterations(iterations: Array, shares: Array) -> Curve:
    """Curve on the timeline `iteration` of the largest share of a limit [%].

    The first iterates may be far outside the limits, so that they do not set the range.
    """
    return Curve(
        name="iterates",
        t=np.asarray(iterations, dtype=np.float64),
        values=100.0 * shares,
        colour=vocabulary.DESIGNED.rgb,
        timeline="iteration",
        legend=("largest of the iterate",),
        sets_range=False,
    )
