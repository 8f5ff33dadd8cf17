"""Figures of a design: trajectories, sensitivities of the motion, convergence."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.model.coordinates import split_unit
from mjfim.model.units import per_second
from mjfim.output.plots.style import (
    DESIGNED_COLOUR,
    GRID_COLOUR,
    INITIAL_COLOUR,
    MUTED_COLOUR,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    as_sentence,
    break_before_unit,
    format_axes,
    format_number,
    new_figure,
    own_style,
    quotient_unit,
    shorten,
    trajectory_handles,
    write_message,
)
from mjfim.records.design import Design, Evaluation
from mjfim.records.labels import Labels

# Largest number of panels of the trajectories that stand in two columns; more stand in four.
MAX_PANELS_IN_TWO_COLUMNS = 9

# Largest number of parameters and of degrees of freedom in the phase plots of the sensitivities.
MAX_PHASE_PARAMETERS, MAX_PHASE_DOFS = 6, 4

# Largest number of intervals between the ticks of the horizontal axis of a phase plot.
MAX_PHASE_TICKS = 5

# Characters to which the names of parameters are shortened in the phase plots.
PARAMETER_NAME_WIDTH = 18

# Share of the largest sensitivity to a parameter below which a sensitivity is a rounding error.
NEGLIGIBLE_SENSITIVITY = 1e-7

# Ratio of the designed to the initial loop of sensitivities above which the initial one is drawn
# enlarged.
ENLARGING_RATIO = 4.0

# Height that a panel gains for the enlarged loop, as a share of the height without it.
ENLARGED_LOOP_HEIGHT = 0.62


# ---- trajectories


@dataclass(frozen=True, kw_only=True)
class _Panel:
    """One panel of the trajectories.

    Attributes:
        quantity: Field of the trajectory: "qpos", "qvel" or "ctrl".
        column: Column of that field.
        label: Label `name [unit]`.
    """

    quantity: str
    column: int
    label: str


@own_style
def trajectories(design: Design, labels: Labels) -> Figure:
    """Draw states, controls and the information gathered up to each time (the paper's figure 2).

    The information is the square root of the smallest eigenvalue of the Fisher information.

    Args:
        design: The design.
        labels: Labels of the model's columns.

    Raises:
        MjfimError: The labels do not fit the design.
    """
    trajectory = design.trajectory
    labels.check(
        qpos=trajectory.qpos.shape[1],
        velocities=trajectory.qvel.shape[1],
        controls=trajectory.ctrl.shape[1],
    )
    panels = _state_panels(labels)
    columns = 2 if len(panels) <= MAX_PANELS_IN_TWO_COLUMNS else 4
    rows = len(panels) // columns + 1

    figure = new_figure(1.55 * rows + 0.9)
    grid = figure.add_gridspec(rows, columns)
    first: Axes | None = None
    for k, panel in enumerate(panels):
        axes = figure.add_subplot(grid[divmod(k, columns)], sharex=first)
        first = first or axes
        _draw_state(axes, design, panel)

        in_last_row = k // columns == rows - 1
        format_axes(axes, ylabel=break_before_unit(panel.label))
        axes.tick_params(labelbottom=in_last_row)
        axes.set_xlabel("time [s]" if in_last_row else "")

    # The information takes the rest of the last row.
    axes = figure.add_subplot(grid[rows - 1, len(panels) % columns :], sharex=first)
    _draw_information(axes, design)
    format_axes(
        axes, "time [s]", r"$\sqrt{\lambda_{\min}}$  [$\sqrt{\mathrm{s}}$ / unit of $\theta$]"
    )

    note = (
        "λ_min: smallest eigenvalue of the Fisher information up to time t, divided by the "
        "measurement rate."
    )
    add_title(
        figure, "Trajectories and the information that they gather", trajectory_handles(), note
    )
    return figure


def _state_panels(labels: Labels) -> list[_Panel]:
    """Return a panel for every state and control.

    Positions and velocities alternate if there are equally many.
    """
    positions = _panels("qpos", labels.qpos)
    velocities = _panels("qvel", labels.velocities)
    controls = _panels("ctrl", labels.controls)

    if len(positions) != len(velocities):
        return [*positions, *velocities, *controls]
    states = []
    for position, velocity in zip(positions, velocities, strict=True):
        states += [position, velocity]
    return [*states, *controls]


def _panels(quantity: str, labels: tuple[str, ...]) -> list[_Panel]:
    """Return a panel for every column of a field of the trajectory."""
    return [_Panel(quantity=quantity, column=i, label=label) for i, label in enumerate(labels)]


def _styled_evaluations(design: Design) -> tuple[tuple[Evaluation, str, float], ...]:
    """Return both evaluations of a design, each with its colour and its line width [points]."""
    return (design.initial, INITIAL_COLOUR, 1.5), (design.final, DESIGNED_COLOUR, 1.7)


def _draw_state(axes: Axes, design: Design, panel: _Panel) -> None:
    """Draw one coordinate or control of both trajectories over time."""
    for evaluation, colour, width in _styled_evaluations(design):
        trajectory = evaluation.trajectory
        values = getattr(trajectory, panel.quantity)[:, panel.column]

        # A control is held from each sample to the next.
        if panel.quantity == "ctrl":
            axes.stairs(
                values, trajectory.t, baseline=None, color=colour, linewidth=width, snap=False
            )
        else:
            axes.plot(trajectory.t, values, color=colour, linewidth=width)


def _draw_information(axes: Axes, design: Design) -> None:
    """Draw the root of the smallest eigenvalue up to each time, with its last value."""
    for evaluation, colour, width in _styled_evaluations(design):
        t = evaluation.trajectory.t
        root = np.sqrt(np.maximum(evaluation.min_eigenvalue, 0.0))
        axes.plot(t, root, color=colour, linewidth=width)
        axes.annotate(
            format_number(float(root[-1])),
            (float(t[-1]), float(root[-1])),
            xytext=(4, 0),
            textcoords="offset points",
            va="center",
            fontsize=SMALL_FONT,
            color=colour,
            annotation_clip=False,
        )


# ---- sensitivities


@own_style
def sensitivity_phase(design: Design, labels: Labels) -> Figure:
    """Draw phase plots of the sensitivities psi (the paper's figure 3).

    There is a row per degree of freedom and a column per parameter.

    Args:
        design: The design.
        labels: Labels of the model's columns and of the parameters.

    Raises:
        MjfimError: The labels do not fit the design.
    """
    nv = design.trajectory.qvel.shape[1]
    count = len(design.theta)
    labels.check(positions=nv, velocities=nv, parameters=count)
    dofs = _most_sensitive_dofs(design, nv)
    parameters = _least_known_parameters(design)

    figure = new_figure(2.6 * len(dofs) + 0.9)
    grid = figure.add_gridspec(len(dofs), len(parameters))
    for row, dof in enumerate(dofs):
        for column, j in enumerate(parameters):
            axes = figure.add_subplot(grid[row, column])
            _label_phase_axes(axes, labels, int(dof), int(j))
            if _is_insensitive(design, int(dof), int(j)):
                write_message(axes, "no sensitivity")
                axes.set(xticks=[], yticks=[])
                continue

            loops = _loops(design, int(dof), int(j))
            _draw_loops(axes, loops)
            _enlarge_initial_loop(axes, loops)

    note = (
        "Each curve starts at the dot (time 0, no sensitivity); ′ is the time derivative. "
        "A blue box shows the initial curve enlarged."
    )
    if len(dofs) < nv or len(parameters) < count:
        note += (
            f" Shown: {len(dofs)} of {nv} degrees of freedom (most sensitive), "
            f"{len(parameters)} of {count} parameters (largest predicted relative standard "
            "deviation)."
        )
    start = Line2D(
        [], [], color=TEXT_COLOUR, marker="o", markersize=3.5, linestyle="", label="start"
    )
    handles = [*trajectory_handles(), start]
    add_title(figure, "Sensitivity of the motion to each parameter", handles, note)
    return figure


def _least_known_parameters(design: Design) -> NDArray[np.intp]:
    """Return the wanted parameters with the largest predicted relative standard deviations.

    Their numbers are in ascending order.
    """
    wanted = np.array(design.wanted, dtype=np.intp)

    # A parameter that the design does not determine has nothing to show.
    std = design.final.std
    sizes = np.where(design.sizes > 0.0, design.sizes, np.inf)
    relative_std = np.where(np.isfinite(std), std, 0.0) / sizes

    descending = np.argsort(-relative_std[wanted], kind="stable")
    return np.sort(wanted[descending][:MAX_PHASE_PARAMETERS])


def _most_sensitive_dofs(design: Design, nv: int) -> NDArray[np.intp]:
    """Return the degrees of freedom that react most to relative changes of the parameters.

    Their numbers are in ascending order.
    """
    psi = design.final.sensitivity[:, :nv]
    relative_psi = np.abs(psi * design.sizes)

    largest = relative_psi.max(axis=(0, 2))
    descending = np.argsort(-largest, kind="stable")
    return np.sort(descending[:MAX_PHASE_DOFS])


def _loops(design: Design, dof: int, j: int) -> tuple[Array, Array]:
    """Return the sensitivities of position and velocity of a degree of freedom to parameter j.

    Returns:
        (N+1, 2) of the initial and of the designed trajectory [x-unit / theta-unit].
    """
    nv = design.trajectory.qvel.shape[1]
    columns = [dof, nv + dof]
    return design.initial.sensitivity[:, columns, j], design.final.sensitivity[:, columns, j]


def _is_insensitive(design: Design, dof: int, j: int) -> bool:
    """Return whether a degree of freedom reacts to parameter j by rounding errors only."""
    largest = max(
        np.abs(evaluation.sensitivity[..., j]).max()
        for evaluation in (design.initial, design.final)
    )
    of_dof = max(np.abs(loop).max() for loop in _loops(design, dof, j))
    return bool(of_dof <= NEGLIGIBLE_SENSITIVITY * largest)


def _draw_loops(axes: Axes, loops: tuple[Array, Array]) -> None:
    """Draw both loops; the initial one lies on top, because it is the smaller one."""
    initial, designed = loops
    axes.plot(*initial.T, color=INITIAL_COLOUR, linewidth=1.5, zorder=3)
    axes.plot(*designed.T, color=DESIGNED_COLOUR, linewidth=1.7, zorder=2)
    axes.plot(0.0, 0.0, "o", color=TEXT_COLOUR, markersize=3.5, zorder=4)
    axes.locator_params(axis="x", nbins=MAX_PHASE_TICKS)


def _enlarge_initial_loop(axes: Axes, loops: tuple[Array, Array]) -> None:
    """Draw a tiny initial loop once more, enlarged, in a box above the other one."""
    initial, designed = loops
    initial_extent = np.ptp(initial, axis=0)
    designed_extent = np.ptp(designed, axis=0)
    tiny = (ENLARGING_RATIO * initial_extent < designed_extent).all()
    if not tiny or not (initial_extent > 0.0).all():
        return

    # The axes grow upwards, but keep their ticks.
    low, high = axes.get_ylim()
    axes.set_yticks([tick for tick in axes.get_yticks() if low <= tick <= high])
    axes.set_ylim(low, high + ENLARGED_LOOP_HEIGHT * (high - low))

    box = axes.inset_axes((0.2, 0.72, 0.6, 0.27))
    box.plot(*initial.T, color=INITIAL_COLOUR, linewidth=1.2)
    box.plot(0.0, 0.0, "o", color=TEXT_COLOUR, markersize=2.5)
    box.tick_params(
        labelsize=SMALL_FONT - 2.5,
        color=MUTED_COLOUR,
        labelcolor=MUTED_COLOUR,
        length=2,
        pad=1.5,
    )
    box.locator_params(nbins=3)
    box.spines[:].set_color(INITIAL_COLOUR)
    box.spines[:].set_linewidth(0.7)


def _label_phase_axes(axes: Axes, labels: Labels, dof: int, j: int) -> None:
    """Label the axes with the derivatives of position and velocity with respect to parameter j."""
    name, unit = split_unit(labels.positions[dof])
    parameter = shorten(labels.parameters[j], PARAMETER_NAME_WIDTH)
    divisor = labels.parameter_units[j]
    format_axes(
        axes,
        f"∂{name}/∂{parameter}\n[{quotient_unit(unit, divisor)}]",
        f"∂{name}′/∂{parameter}\n[{quotient_unit(per_second(unit), divisor)}]",
    )


# ---- convergence


@own_style
def convergence(design: Design) -> Figure:
    """Draw cost, slope and smallest eigenvalue over the iterations, logarithmically.

    Args:
        design: The design.
    """
    history = design.history
    iterations = np.array([row.iteration for row in history], dtype=np.float64)
    cost = np.array([row.cost for row in history], dtype=np.float64)
    slope = np.abs(np.array([row.slope for row in history], dtype=np.float64))
    eigenvalue = np.array([row.min_eigenvalue for row in history], dtype=np.float64)

    # With a barrier the slope is that of log J, which is relative already. The search for a release
    # has no slope.
    has_barrier = any(row.mu for row in history)
    has_slope = not history or bool(np.isfinite(slope).any())
    relative_slope = None
    if has_slope and not has_barrier:
        relative_slope = slope / np.where(cost == 0.0, np.nan, np.abs(cost))

    figure = new_figure(3.3)
    panels = figure.subplots(1, 3 if has_slope else 2)
    _draw_history(panels[0], iterations, cost)
    if has_slope:
        _draw_history(panels[1], iterations, slope, relative_slope)
    _draw_history(panels[-1], iterations, eigenvalue)
    _mark_rates(panels, design, iterations)
    _mark_barrier_stages(panels, design, iterations)

    names = ["cost J [–]", "slope |DJ·ζ| [–]", r"$\lambda_{\min}$  [s / (unit of $\theta$)$^2$]"]
    if not has_slope:
        names.pop(1)
    for axes, name in zip(panels, names, strict=True):
        format_axes(axes, "iteration [–]", name)
        axes.xaxis.get_major_locator().set_params(integer=True)

    handles = [
        Line2D(
            [],
            [],
            color=INITIAL_COLOUR,
            marker="o",
            linestyle="",
            label=_start_label(design),
        ),
        Line2D([], [], color=DESIGNED_COLOUR, marker="o", linestyle="", label="designed"),
    ]
    if relative_slope is not None:
        handles.append(Line2D([], [], color=MUTED_COLOUR, linestyle=":", label="slope / J"))
    note = as_sentence(design.status.value)
    if has_barrier:
        note += (
            " Dashed lines: a new barrier stage begins; with limits, the slope is that of log J "
            "plus the barrier."
        )
    add_title(figure, "Convergence", handles, note)
    return figure


def _start_label(design: Design) -> str:
    """Return the name of the first iterate, which is not the initial trajectory in every search."""
    costs = [row.cost for row in design.history[:1]]
    if not costs or np.isclose(costs[0], design.initial.cost, rtol=1e-9, atol=0.0):
        return "initial"
    return f"start: {design.found_by}"


def _draw_history(
    axes: Axes, iterations: Array, values: Array, relative: Array | None = None
) -> None:
    """Draw one quantity over the iterations; dots mark its first and its last value.

    Args:
        axes: Axes of the panel; they become logarithmic unless no value is positive.
        iterations: (n,) numbers of the iterations.
        values: (n,) values; of a logarithmic axis, the positive ones are shown.
        relative: (n,) values of a second, dotted curve.
    """
    if not np.isfinite(values).any():
        write_message(axes, "no iterations recorded")
        return

    shown = np.where(values > 0.0, values, np.nan)
    if np.isfinite(shown).any():
        axes.set_yscale("log")
    else:
        shown = values
    axes.plot(iterations, shown, color=MUTED_COLOUR, linewidth=1.3, marker=".", markersize=3)
    if relative is not None:
        positive = np.where(relative > 0.0, relative, np.nan)
        axes.plot(iterations, positive, color=MUTED_COLOUR, linewidth=1.0, linestyle=":")

    usable = np.flatnonzero(np.isfinite(shown))
    first, last = usable[0], usable[-1]
    axes.plot(iterations[first], shown[first], "o", color=INITIAL_COLOUR, markersize=6)
    axes.plot(iterations[last], shown[last], "o", color=DESIGNED_COLOUR, markersize=6)
    text = f"{format_number(float(shown[first]))} → {format_number(float(shown[last]))}"
    axes.set_title(text, loc="right", fontsize=SMALL_FONT, color=MUTED_COLOUR, pad=4)


def _mark_rates(panels: NDArray[np.object_], design: Design, iterations: Array) -> None:
    """Mark the iterations at which the time grid becomes finer, with both rates [Hz]."""
    rates = np.array([row.rate for row in design.history])
    for k in np.flatnonzero(np.diff(rates)):
        for axes in panels:
            axes.axvline(iterations[k + 1], color=GRID_COLOUR, linewidth=2.0, zorder=0)
        panels[0].annotate(
            f" {rates[k]:g} Hz | {rates[k + 1]:g} Hz",
            (iterations[k + 1], 0.97),
            xycoords=("data", "axes fraction"),
            ha="center",
            va="top",
            fontsize=SMALL_FONT,
            color=MUTED_COLOUR,
        )


def _mark_barrier_stages(panels: NDArray[np.object_], design: Design, iterations: Array) -> None:
    """Mark the iterations at which a new barrier stage begins."""
    mu = np.array([row.mu for row in design.history])
    for k in np.flatnonzero(mu[1:] != mu[:-1]):
        for axes in panels:
            axes.axvline(
                iterations[k + 1], color=GRID_COLOUR, linewidth=1.0, linestyle="--", zorder=0
            )
