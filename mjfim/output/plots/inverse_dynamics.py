"""Figure of a fit to the equation of motion: measured forces and those that the motion needs."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from mjfim.output.plots import style
from mjfim.records.inverse_dynamics import EquationFit, InverseDynamicsFit
from mjfim.records.labels import with_unit

# Largest number of equations that are drawn; of more, those with the largest residuals.
MAX_EQUATIONS = 10

# Height of a panel, and of all else [inch].
PANEL_HEIGHT, FIXED_HEIGHT = 1.05, 1.5

# Characters to which names are shortened.
NAME_WIDTH = 30

# Largest number of intervals between the ticks of a panel.
MAX_TICKS = 3

# Times between averages above this multiple of the usual one are gaps.
GAP = 2.5


@style.own_style
def inverse_dynamics_figure(fit: InverseDynamicsFit) -> Figure:
    """Draw the forces of the actuators and those that the measured motion needs.

    Args:
        fit: The fit.
    """
    order = sorted(fit.equations, key=lambda each: -np.nan_to_num(each.share))
    shown = [each for each in fit.equations if each in order[:MAX_EQUATIONS]]

    figure = style.new_figure(FIXED_HEIGHT + PANEL_HEIGHT * len(shown))
    panels = figure.subplots(len(shown), 1, sharex=True, squeeze=False)[:, 0]
    for axes, each in zip(panels, shown, strict=True):
        _draw(axes, each)
    style.format_axes(panels[-1], "time [s]")

    handles = [
        Line2D([], [], color=style.MEASURED_COLOUR, label="measured, or by the model"),
        Line2D([], [], color=style.IDENTIFIED_COLOUR, label="needed by the measured motion"),
    ]
    note = (
        f"Forces in {style.shorten(fit.recording, 60)}, averaged over short windows; the share is "
        "the root mean square residual over the force. Gaps: too little was measured, or unknown "
        "forces act. An equation without actuators has no measured force."
    )
    if len(shown) < len(fit.equations):
        note += f" {len(fit.equations) - len(shown)} equations with smaller residuals are left out."
    style.add_title(figure, _title(fit), handles, note)
    return figure


def _draw(axes: Axes, each: EquationFit) -> None:
    """Draw one equation."""
    label = style.shorten(each.name, NAME_WIDTH)
    style.format_axes(axes)
    t, measured, explained = _with_gaps(each)
    axes.plot(t, measured, color=style.MEASURED_COLOUR, linewidth=1.8)
    axes.plot(t, explained, color=style.IDENTIFIED_COLOUR, linewidth=0.9)
    axes.yaxis.set_major_locator(MaxNLocator(MAX_TICKS))
    share = f"{100.0 * each.share:.2g} %" if np.isfinite(each.share) else "no force"
    axes.set_title(
        f"{with_unit(label, each.unit)}: residual {share}", loc="left", fontsize=style.SMALL_FONT
    )


def _with_gaps(each: EquationFit) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times and forces, with NaN where averages are missing."""
    t, measured, explained = each.t, each.measured, each.explained
    if len(t) < 3:
        return t, measured, explained
    steps = np.diff(t)
    places = np.flatnonzero(steps > GAP * np.median(steps)) + 1
    return (
        np.insert(t, places, t[places]),
        np.insert(measured, places, np.nan),
        np.insert(explained, places, np.nan),
    )


def _title(fit: InverseDynamicsFit) -> str:
    """Return the result in a sentence."""
    shares = [each.share for each in fit.equations if np.isfinite(each.share)]
    if not shares:
        return "Equation of motion: no equation has a force"
    low, high = 100.0 * min(shares), 100.0 * max(shares)
    span = f"{high:.2g} %" if len(shares) == 1 else f"{low:.2g} to {high:.2g} %"
    return f"Equation of motion: residuals are {span} of the forces"
