"""Figures of a design: trajectories, sensitivities of the motion."""

from __future__ import annotations

from collections.abc import Sequence
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
    INITIAL_COLOUR,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    fit_label,
    format_axes,
    format_number,
    new_figure,
    own_style,
    panel_width,
    quotient_unit,
    scale_axis,
    shorten,
    text_width,
    trajectory_handles,
    write_message,
)
from mjfim.output.positions import shown_positions
from mjfim.records.design import Design
from mjfim.records.labels import Labels

# Number of panels of the trajectories side by side.
PANEL_COLUMNS = 4

# Largest number of intervals between the ticks of a panel.
MAX_TIME_TICKS, MAX_PANEL_TICKS = 5, 4

# Widths of the lines of the initial and of the designed trajectory [points].
LINE_WIDTHS = (1.1, 1.6)

# Background of the panels of controls.
CONTROL_BACKGROUND = "#f1f2f3"

# Largest number of phase plots, and of those side by side.
MAX_PHASE_PLOTS, PHASE_COLUMNS = 6, 3

# Largest number of intervals between the ticks of a phase plot, which has one tick more at most.
MAX_PHASE_TICKS = 3

# Width that the label of an axis of a phase plot may have [inch].
PHASE_LABEL_WIDTH = 2.2

# Share of the largest sensitivity below which a sensitivity is a rounding error.
NEGLIGIBLE_SENSITIVITY = 1e-6

# Ratio of the designed to the initial loop of sensitivities above which the initial one is drawn
# enlarged.
ENLARGING_RATIO = 4.0

# Height that a panel gains for the enlarged loop, as a share of the height without it.
ENLARGED_LOOP_HEIGHT = 0.62


# ---- trajectories


@dataclass(frozen=True, kw_only=True, eq=False)
class _Group:
    """Panels of one kind of quantity; they stand in rows of their own.

    Attributes:
        name: Name of the kind.
        labels: Label `name [unit]` of every column.
        initial: (n, columns) values along the initial trajectory.
        designed: (n, columns) values along the designed trajectory.
        held: True for values that are held from each sample to the next.
    """

    name: str
    labels: tuple[str, ...]
    initial: Array
    designed: Array
    held: bool = False

    def rows(self, columns: int) -> int:
        """Return the number of rows of panels, for a number of columns."""
        return -(-len(self.labels) // columns)


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
    groups = [group for group in _groups(design, labels) if group.labels]
    columns = panel_columns([len(group.labels) for group in groups])
    rows = sum(group.rows(columns) for group in groups) + 1
    figure = new_figure(1.15 * rows + 1.7)
    grid = figure.add_gridspec(rows, columns, height_ratios=[1.0] * (rows - 1) + [1.6])

    row = 0
    for group in groups:
        for k in range(len(group.labels)):
            down, column = divmod(k, columns)
            axes = figure.add_subplot(grid[row + down, column])
            _draw_panel(axes, design, group, k, columns)
            format_axes(axes, ylabel=group.name if column == 0 else "")
            axes.yaxis.label.set_fontweight("bold")
        row += group.rows(columns)

    # The information has the last row.
    axes = figure.add_subplot(grid[rows - 1, :])
    _draw_information(axes, design)
    format_axes(axes, "time [s]", "information")
    axes.yaxis.label.set_fontweight("bold")
    root = r"$\sqrt{\lambda_{\min}}$ up to each time"
    axes.set_title(root + r"  [$\sqrt{\mathrm{s}}$ / unit of $\theta$]", loc="left")

    note = (
        "λ_min: smallest eigenvalue of the Fisher information up to time t, divided by the "
        "measurement rate. All horizontal axes: time [s]."
    )
    if any(group.held for group in groups):
        note += " Grey background: controls."
    title = "Trajectories and the information that they gather"
    add_title(figure, title, trajectory_handles(), note)
    return figure


def _groups(design: Design, labels: Labels) -> list[_Group]:
    """Return the panels of positions, velocities and controls."""
    initial, designed = design.initial.trajectory, design.final.trajectory
    names, both = shown_positions(labels, initial.qpos, designed.qpos)
    velocities = tuple(label.replace(" velocity [", " [") for label in labels.velocities)
    controls = tuple(label.replace(" (control)", " [model unit]") for label in labels.controls)
    return [
        _Group(name="positions", labels=names, initial=both[0], designed=both[1]),
        _Group(name="velocities", labels=velocities, initial=initial.qvel, designed=designed.qvel),
        _Group(
            name="controls",
            labels=controls,
            initial=initial.ctrl,
            designed=designed.ctrl,
            held=True,
        ),
    ]


def panel_columns(counts: Sequence[int]) -> int:
    """Return the number of panels side by side that leaves the fewest places empty.

    Args:
        counts: Number of panels of each group; every group begins in a row of its own.
    """
    widest = min(PANEL_COLUMNS, max(counts))
    narrowest = min(PANEL_COLUMNS - 1, widest)
    empty = {
        columns: sum(-count % columns for count in counts)
        for columns in range(widest, narrowest - 1, -1)
    }
    return min(empty, key=lambda columns: (empty[columns], -columns))


def _draw_panel(axes: Axes, design: Design, group: _Group, k: int, columns: int) -> None:
    """Draw quantity k of a group along both trajectories, as one of several panels in a row."""
    times = design.initial.trajectory.t, design.final.trajectory.t
    both = group.initial, group.designed
    colours = (INITIAL_COLOUR, DESIGNED_COLOUR)
    for t, values, colour, width in zip(times, both, colours, LINE_WIDTHS, strict=True):
        if group.held:
            axes.stairs(values[:, k], t, baseline=None, color=colour, linewidth=width, snap=False)
        else:
            axes.plot(t, values[:, k], color=colour, linewidth=width)

    label = fit_label(group.labels[k], panel_width(columns), SMALL_FONT)
    axes.set_title(label, loc="left", fontsize=SMALL_FONT, pad=3)
    axes.locator_params(axis="x", nbins=MAX_TIME_TICKS)
    axes.locator_params(axis="y", nbins=MAX_PANEL_TICKS)
    if group.held:
        axes.set_facecolor(CONTROL_BACKGROUND)


def _draw_information(axes: Axes, design: Design) -> None:
    """Draw the root of the smallest eigenvalue up to each time, with its last value."""
    evaluations = (design.initial, design.final)
    colours = (INITIAL_COLOUR, DESIGNED_COLOUR)
    for evaluation, colour, width in zip(evaluations, colours, LINE_WIDTHS, strict=True):
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


@dataclass(frozen=True, kw_only=True)
class _Loop:
    """A phase plot: the sensitivity of one degree of freedom to one parameter.

    Attributes:
        dof: Number of the degree of freedom.
        parameter: Number of the parameter.
    """

    dof: int
    parameter: int


@own_style
def sensitivity_phase(design: Design, labels: Labels) -> Figure:
    """Draw phase plots of the largest sensitivities psi (the paper's figure 3).

    Args:
        design: The design.
        labels: Labels of the model's columns and of the parameters.

    Raises:
        MjfimError: The labels do not fit the design.
    """
    nv = design.trajectory.qvel.shape[1]
    count = len(design.theta)
    labels.check(positions=nv, velocities=nv, parameters=count)
    relative = _relative_sensitivities(design)
    loops = _shown_loops(design, relative)

    columns = min(max(len(loops), 1), PHASE_COLUMNS)
    rows = max(-(-len(loops) // columns), 1)
    figure = new_figure(2.75 * rows + 1.0)
    grid = figure.add_gridspec(rows, columns)
    for k, loop in enumerate(loops):
        axes = figure.add_subplot(grid[divmod(k, columns)])
        curves = _curves(design, loop)
        _draw_loops(axes, curves)
        _label_phase_axes(axes, labels, loop, curves)
        _enlarge_initial_loop(axes, curves)
    if not loops:
        write_message(figure.add_subplot(grid[0, 0]), "the motion depends on no parameter")

    total = int(np.count_nonzero(relative > NEGLIGIBLE_SENSITIVITY * relative.max(initial=0.0)))
    note = "Each curve starts at the dot (time 0, no sensitivity); ′ is the time derivative."
    if any(axes.child_axes for axes in figure.axes):
        note += " A blue box shows the initial curve enlarged."
    if len(loops) < total:
        note += (
            f" Shown: {len(loops)} of {total} pairs of a degree of freedom and a parameter: the "
            "parameters with the largest predicted relative standard deviations, and what moves "
            "most with them."
        )
    start = Line2D(
        [], [], color=TEXT_COLOUR, marker="o", markersize=3.5, linestyle="", label="start"
    )
    handles = [*trajectory_handles(), start]
    add_title(figure, "Sensitivity of the motion to each parameter", handles, note)
    return figure


def _relative_sensitivities(design: Design) -> Array:
    """Return how much each degree of freedom reacts to relative changes of each parameter.

    Changes of velocities are relative to the largest velocity, so that units do not matter.

    Returns:
        (nv, p) largest changes over time [1].
    """
    nv = design.trajectory.qvel.shape[1]
    change = np.abs(design.final.sensitivity[:, nv : 2 * nv] * design.sizes).max(axis=0)
    speed = np.abs(design.trajectory.qvel).max(axis=0)
    relative = change / np.where(speed > 0.0, speed, np.inf)[:, None]
    return np.asarray(relative, dtype=np.float64)


def _shown_loops(design: Design, relative: Array) -> list[_Loop]:
    """Return the phase plots to draw, by parameter; those of rounding errors are left out.

    Args:
        design: The design.
        relative: (nv, p) relative sensitivities.
    """
    parameters = [int(j) for j in _least_known_parameters(design)]
    negligible = NEGLIGIBLE_SENSITIVITY * relative.max(initial=0.0)
    most_sensitive = {j: np.argsort(-relative[:, j], kind="stable") for j in parameters}

    # The most sensitive degree of freedom of each parameter, then the second one, and so on.
    chosen = []
    for rank in range(len(relative)):
        for j in parameters:
            dof = int(most_sensitive[j][rank])
            if relative[dof, j] > negligible:
                chosen.append(_Loop(dof=dof, parameter=j))
    return sorted(chosen[:MAX_PHASE_PLOTS], key=lambda loop: (loop.parameter, loop.dof))


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
    return np.sort(wanted[descending][:MAX_PHASE_PLOTS])


def _curves(design: Design, loop: _Loop) -> tuple[Array, Array]:
    """Return the sensitivities of position and velocity along both trajectories.

    Returns:
        (N+1, 2) of the initial and of the designed trajectory [x-unit / theta-unit].
    """
    nv = design.trajectory.qvel.shape[1]
    columns = [loop.dof, nv + loop.dof]
    initial, designed = design.initial.sensitivity, design.final.sensitivity
    return initial[:, columns, loop.parameter], designed[:, columns, loop.parameter]


def _draw_loops(axes: Axes, curves: tuple[Array, Array]) -> None:
    """Draw both loops; the initial one lies on top, because it is the smaller one."""
    initial, designed = curves
    axes.plot(*initial.T, color=INITIAL_COLOUR, linewidth=1.5, zorder=3)
    axes.plot(*designed.T, color=DESIGNED_COLOUR, linewidth=1.7, zorder=2)
    axes.plot(0.0, 0.0, "o", color=TEXT_COLOUR, markersize=3.5, zorder=4)
    axes.locator_params(nbins=MAX_PHASE_TICKS)


def _enlarge_initial_loop(axes: Axes, curves: tuple[Array, Array]) -> None:
    """Draw a tiny initial loop once more, enlarged, in a box above the other one."""
    initial, designed = curves
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
    box.set(xticks=[], yticks=[])
    box.spines[:].set(visible=True, color=INITIAL_COLOUR, linewidth=0.7)
    times = format_number(float((designed_extent / initial_extent).min()), 2)
    box.set_title(
        f"initial: 1/{times} of the size", fontsize=SMALL_FONT - 1.5, color=INITIAL_COLOUR, pad=2
    )


def _fitting_names(name: str, parameter: str) -> tuple[str, str]:
    """Shorten the names of a coordinate and a parameter until their derivative fits."""
    width = max(len(name), len(parameter))
    while text_width(f"∂{shorten(name, width)}′/∂{shorten(parameter, width)}") > PHASE_LABEL_WIDTH:
        width -= 1
    return shorten(name, width), shorten(parameter, width)


def _label_phase_axes(axes: Axes, labels: Labels, loop: _Loop, curves: tuple[Array, Array]) -> None:
    """Label the axes with the derivatives of position and velocity; units have a power of ten."""
    name, unit = split_unit(labels.positions[loop.dof])
    divisor = labels.parameter_units[loop.parameter]
    name, parameter = _fitting_names(name, labels.parameters[loop.parameter])
    units = quotient_unit(unit, divisor), quotient_unit(per_second(unit), divisor)

    texts = []
    for axis, mark, quotient, column in zip(
        (axes.xaxis, axes.yaxis), ("", "′"), units, (0, 1), strict=True
    ):
        largest = max(float(np.abs(curve[:, column]).max(initial=0.0)) for curve in curves)
        power = scale_axis(axis, largest)
        texts.append(f"∂{name}{mark}/∂{parameter}\n[{power}{quotient}]")
    format_axes(axes, *texts)
