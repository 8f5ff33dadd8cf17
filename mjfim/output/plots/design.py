"""Figures of a design: trajectories, sensitivities, convergence."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.model.coordinates import split_unit
from mjfim.output.labels import Labels
from mjfim.output.plots.style import (
    GRID_COLOUR,
    INITIAL_COLOUR,
    MUTED_COLOUR,
    OPTIMIZED_COLOUR,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    break_before_unit,
    format_axes,
    format_number,
    new_figure,
    quotient_unit,
    shorten,
    trajectory_handles,
    write_message,
)
from mjfim.records.design import Design, Evaluation

MAX_PHASE_PARAMETERS = 6
MAX_PHASE_DOFS = 4
ZOOM = 4.0


def pair(design: Design) -> tuple[tuple[Evaluation, str, float], ...]:
    """Both evaluations with colour and line width."""
    return (design.initial, INITIAL_COLOUR, 1.5), (design.final, OPTIMIZED_COLOUR, 1.7)


def state_panels(design: Design, labels: Labels) -> list[tuple[str, str, int]]:
    """(field, label, column) of every state and control; position and velocity alternate where they pair up."""
    positions = [("qpos", label, i) for i, label in enumerate(labels.qpos)]
    velocities = [("qvel", label, i) for i, label in enumerate(labels.velocities)]
    controls = [("ctrl", label, i) for i, label in enumerate(labels.controls)]
    if len(positions) == len(velocities):
        states = [panel for both in zip(positions, velocities, strict=True) for panel in both]
    else:
        states = positions + velocities
    return states + controls


def draw_state(axes: Axes, design: Design, name: str, column: int) -> None:
    """One coordinate or control of both trajectories over time."""
    for evaluation, colour, width in pair(design):
        curve = evaluation.trajectory
        values = getattr(curve, name)[:, column]
        if name == "ctrl":
            axes.stairs(values, curve.t, baseline=None, color=colour, linewidth=width, snap=False)
        else:
            axes.plot(curve.t, values, color=colour, linewidth=width)


def draw_information(axes: Axes, design: Design) -> None:
    """Root of the smallest eigenvalue accumulated up to each time, with its end value."""
    for evaluation, colour, width in pair(design):
        root = np.sqrt(np.maximum(evaluation.min_eigenvalue, 0.0))
        axes.plot(evaluation.trajectory.t, root, color=colour, linewidth=width)
        axes.annotate(
            format_number(float(root[-1])),
            (float(evaluation.trajectory.t[-1]), float(root[-1])),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            fontsize=SMALL_FONT,
            color=colour,
            annotation_clip=False,
        )


def trajectories(design: Design, labels: Labels) -> Figure:
    """States, controls and the root of the smallest eigenvalue of the information up to time t (paper's figure 2)."""
    curve = design.trajectory
    labels.check(
        qpos=curve.qpos.shape[1], velocities=curve.qvel.shape[1], controls=curve.ctrl.shape[1]
    )
    panels = state_panels(design, labels)
    columns = 2 if len(panels) <= 9 else 4
    rows = len(panels) // columns + 1
    figure = new_figure(3.7 * columns if columns == 2 else 12.0, 1.55 * rows + 0.9)
    grid = figure.add_gridspec(rows, columns)
    first: Axes | None = None
    for k, (name, label, column) in enumerate(panels):
        axes = figure.add_subplot(grid[divmod(k, columns)], sharex=first)
        first = first or axes
        draw_state(axes, design, name, column)
        format_axes(axes, ylabel=break_before_unit(label))
        last = k // columns == rows - 1
        axes.tick_params(labelbottom=last)
        axes.set_xlabel("time [s]" if last else "")
    # The information takes whatever the last row has left.
    axes = figure.add_subplot(grid[rows - 1, len(panels) % columns :], sharex=first)
    draw_information(axes, design)
    format_axes(
        axes, "time [s]", r"$\sqrt{\lambda_{\min}}$  [$\sqrt{\mathrm{s}}$ / unit of $\theta$]"
    )
    note = "λ_min: smallest eigenvalue of the Fisher information per measurement rate, accumulated up to time t."
    add_title(figure, "Trajectories and the information they gather", trajectory_handles(), note)
    return figure


def phase_choice(design: Design, dofs: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Dofs of largest sensitivity and parameters of largest predicted relative std, in their own order."""
    scale = np.where(design.theta == 0.0, 1.0, np.abs(design.theta))
    wanted = np.array(design.wanted, dtype=np.intp)
    known = np.where(np.isfinite(design.final.std), design.final.std, 0.0) / scale
    worst = wanted[np.argsort(-known[wanted], kind="stable")][:MAX_PHASE_PARAMETERS]
    psi = np.abs(design.final.sensitivity[:, :dofs] * scale)
    strongest = np.argsort(-psi.max(axis=(0, 2)), kind="stable")[:MAX_PHASE_DOFS]
    return np.sort(strongest), np.sort(worst)


def draw_phase(axes: Axes, design: Design, dof: int, dofs: int, j: int) -> None:
    """Loop of (dq_i/dtheta_j, dv_i/dtheta_j) for both trajectories; the initial one lies on top, being the smaller."""
    for (evaluation, colour, width), order in zip(pair(design), (3, 2), strict=True):
        psi = evaluation.sensitivity
        axes.plot(
            psi[:, dof, j], psi[:, dofs + dof, j], color=colour, linewidth=width, zorder=order
        )
    axes.plot(0.0, 0.0, "o", color=TEXT_COLOUR, markersize=3.5, zorder=4)


def enlarge_initial(axes: Axes, design: Design, dof: int, dofs: int, j: int) -> None:
    """Where the initial loop is tiny, draw it again in a box above the other one."""
    columns = [dof, dofs + dof]
    small, large = (
        np.ptp(e.sensitivity[:, columns, j], axis=0) for e in (design.initial, design.final)
    )
    if not (ZOOM * small < large).all() or not (small > 0.0).all():
        return
    low, high = axes.get_ylim()
    axes.set_yticks([tick for tick in axes.get_yticks() if low <= tick <= high])
    axes.set_ylim(low, high + 0.62 * (high - low))
    box = axes.inset_axes((0.2, 0.72, 0.6, 0.27))
    box.plot(*design.initial.sensitivity[:, columns, j].T, color=INITIAL_COLOUR, linewidth=1.2)
    box.plot(0.0, 0.0, "o", color=TEXT_COLOUR, markersize=2.5)
    box.tick_params(
        labelsize=SMALL_FONT - 2.5, color=MUTED_COLOUR, labelcolor=MUTED_COLOUR, length=2, pad=1.5
    )
    box.locator_params(nbins=3)
    box.spines[:].set_color(INITIAL_COLOUR)
    box.spines[:].set_linewidth(0.7)


def sensitivity_phase(design: Design, labels: Labels) -> Figure:
    """Phase plots of the sensitivities psi, one row per dof, one column per parameter (paper's figure 3)."""
    dofs = design.trajectory.qvel.shape[1]
    count = len(design.theta)
    labels.check(velocities=dofs, parameters=count)
    rows, columns = phase_choice(design, dofs)
    figure = new_figure(max(2.9 * len(columns), 4.6), 2.6 * len(rows) + 0.9)
    grid = figure.add_gridspec(len(rows), len(columns))
    for a, dof in enumerate(rows):
        name, rate = split_unit(labels.velocities[dof])
        unit = rate[:-2] if rate.endswith("/s") else f"{rate} s"
        if len(labels.positions) == dofs:
            name = split_unit(labels.positions[dof])[0]
        for b, j in enumerate(columns):
            axes = figure.add_subplot(grid[a, b])
            draw_phase(axes, design, int(dof), dofs, int(j))
            enlarge_initial(axes, design, int(dof), dofs, int(j))
            theta, divisor = shorten(labels.parameters[j], 18), labels.parameter_units[j]
            format_axes(
                axes,
                f"∂{name}/∂{theta}\n[{quotient_unit(unit, divisor)}]",
                f"∂{name}′/∂{theta}\n[{quotient_unit(rate, divisor)}]",
            )
    note = "Each loop starts at the dot (time 0, no sensitivity); ′ is the time derivative."
    note += " Blue boxes enlarge the initial loop."
    if len(rows) < dofs or len(columns) < count:
        note += f" Shown: {len(rows)} of {dofs} degrees of freedom (most sensitive), {len(columns)} of {count}"
        note += " parameters (largest predicted relative standard deviation)."
    start = Line2D(
        [], [], color=TEXT_COLOUR, marker="o", markersize=3.5, linestyle="", label="start"
    )
    add_title(
        figure, "Sensitivity of the motion to each parameter", [*trajectory_handles(), start], note
    )
    return figure


def draw_history(
    axes: Axes, iterations: Array, values: Array, relative: Array | None = None
) -> None:
    """One quantity over the iterations on a log axis (linear if it is never positive), ends in the pair's colours."""
    positive = np.where(values > 0.0, values, np.nan)
    usable = np.isfinite(positive)
    if not usable.any():
        if not np.isfinite(values).any():
            write_message(axes, "no iterations recorded")
            return
        positive, usable = values, np.isfinite(values)
    else:
        axes.set_yscale("log")
    axes.plot(iterations, positive, color=MUTED_COLOUR, linewidth=1.3, marker=".", markersize=3)
    if relative is not None:
        axes.plot(
            iterations,
            np.where(relative > 0.0, relative, np.nan),
            color=MUTED_COLOUR,
            linewidth=1.0,
            linestyle=":",
        )
    for k, colour in (
        (np.flatnonzero(usable)[0], INITIAL_COLOUR),
        (np.flatnonzero(usable)[-1], OPTIMIZED_COLOUR),
    ):
        axes.plot(iterations[k], positive[k], "o", color=colour, markersize=6)
    ends = positive[usable]
    text = f"{format_number(float(ends[0]))} → {format_number(float(ends[-1]))}"
    axes.set_title(text, loc="right", fontsize=SMALL_FONT, color=MUTED_COLOUR, pad=4)


def convergence(design: Design) -> Figure:
    """Cost, slope and smallest eigenvalue over the iterations, logarithmic."""
    history = design.history
    iterations = np.array([row.iteration for row in history], dtype=np.float64)
    cost = np.array([row.cost for row in history], dtype=np.float64)
    slope = np.abs(np.array([row.slope for row in history], dtype=np.float64))
    smallest = np.array([row.min_eigenvalue for row in history], dtype=np.float64)
    figure = new_figure(10.0, 3.3)
    top = figure.subplots(1, 3)
    draw_history(top[0], iterations, cost)
    mus = np.array([row.mu for row in history])
    relative = (
        None if mus.any() else slope / np.where(cost == 0.0, np.nan, np.abs(cost))
    )  # of log J it is that already
    draw_history(top[1], iterations, slope, relative)
    draw_history(top[2], iterations, smallest)
    rates = np.array([row.rate for row in history])
    for k in np.flatnonzero(np.diff(rates)):
        for axes in top:
            axes.axvline(iterations[k + 1], color=GRID_COLOUR, linewidth=2.0, zorder=0)
        top[0].annotate(
            f" {rates[k]:g} Hz | {rates[k + 1]:g} Hz",
            (iterations[k + 1], 0.97),
            xycoords=("data", "axes fraction"),
            ha="center",
            va="top",
            fontsize=SMALL_FONT,
            color=MUTED_COLOUR,
        )
    for k in np.flatnonzero(mus[1:] != mus[:-1]):
        for axes in top:
            axes.axvline(
                iterations[k + 1], color=GRID_COLOUR, linewidth=1.0, linestyle="--", zorder=0
            )
    names = ("cost J [–]", "slope |DJ·ζ| [–]", r"$\lambda_{\min}$  [s / (unit of $\theta$)$^2$]")
    for axes, name in zip(top, names, strict=True):
        format_axes(axes, "iteration [–]", name)
        axes.xaxis.get_major_locator().set_params(integer=True)
    dots = [
        Line2D([], [], color=colour, marker="o", linestyle="", label=name)
        for name, colour in (("initial", INITIAL_COLOUR), ("optimized", OPTIMIZED_COLOUR))
    ]
    line = (
        []
        if relative is None
        else [Line2D([], [], color=MUTED_COLOUR, linestyle=":", label="slope / J")]
    )
    told = (
        " Dashed: the barrier of the limits gets sharper; slope and cost are then of log J and barrier."
        if mus.any()
        else ""
    )
    add_title(figure, "Convergence", [*dots, *line], f"{design.status.value}.{told}")
    return figure
