"""Figure of the fit to a recording: measured and predicted outputs, and their residuals."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from mjfim.arrays import Array, evenly_spread_indices
from mjfim.errors import MjfimError, listed
from mjfim.model.coordinates import split_unit
from mjfim.output.plots.style import (
    GRID_COLOUR,
    MEASURED_COLOUR,
    MUTED_COLOUR,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    break_before_unit,
    format_axes,
    new_figure,
    own_style,
    write_message,
)
from mjfim.records.estimate import Estimate
from mjfim.records.labels import Labels
from mjfim.records.recording import Recording

# Largest number of outputs in a figure; of more, the worst ones are shown.
MAX_OUTPUTS = 12

# Largest number of samples of a recording that are drawn.
MAX_SAMPLES = 6000


@own_style
def fit(estimate: Estimate, index: int, labels: Labels, sigma: Sequence[float] | Array) -> Figure:
    """Draw measured and predicted outputs of one recording, with their residuals.

    Args:
        estimate: The estimate.
        index: Number of the recording.
        labels: Labels of the outputs.
        sigma: (ny,) stated noise of each output [output's unit].

    Raises:
        MjfimError: There is no such recording, or sigma does not fit its outputs.
    """
    noise = _checked_noise(estimate, index, sigma)
    recording, predicted = estimate.recordings[index], estimate.predicted[index]
    residual = recording.y - predicted
    columns = shown_outputs(residual, noise)

    figure = new_figure(1.45 * len(columns) + 1.1)
    grid = figure.subplots(len(columns), 2, squeeze=False, sharex=True, width_ratios=(1.5, 1.0))
    for (left, right), column in zip(grid, columns, strict=True):
        label = labels.output(recording.outputs[column])
        _draw_outputs(left, recording, predicted, int(column))
        _draw_residual(right, recording.t, residual[:, column], float(noise[column]))
        format_axes(left, ylabel=break_before_unit(label))
        format_axes(right, ylabel=f"residual [{split_unit(label)[1]}]")
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")

    handles = [
        Line2D([], [], color=MEASURED_COLOUR, marker=".", linestyle="", label="measured"),
        Line2D([], [], color=TEXT_COLOUR, label="predicted"),
        Patch(color=GRID_COLOUR, label="±2σ of the noise"),
    ]
    note = (
        "Residual: measured − predicted. If the model and the noise are right, 4.6 % of the "
        "samples are outside ±2σ."
    )
    if len(columns) < len(recording.outputs):
        note += (
            f" Shown: those {len(columns)} of {len(recording.outputs)} outputs "
            "whose residuals over σ are largest."
        )
    add_title(figure, f"Fit to {Path(recording.name).name}", handles, note)
    return figure


def _checked_noise(estimate: Estimate, index: int, sigma: Sequence[float] | Array) -> Array:
    """Return sigma as an array (ny,), after a check.

    Raises MjfimError if the recording does not exist or sigma does not fit its outputs.
    """
    count = len(estimate.recordings)
    if not 0 <= index < count:
        raise MjfimError(f"the estimate has no recording {index}; valid: 0 to {count - 1}")

    outputs = estimate.recordings[index].outputs
    noise = np.asarray(sigma, dtype=np.float64)
    if noise.shape != (len(outputs),) or not (noise > 0.0).all():
        raise MjfimError(f"sigma must hold one positive number for each of {listed(outputs)}")
    return noise


def shown_outputs(residual: Array, sigma: Array) -> NDArray[np.intp]:
    """Return the outputs to draw: of many, those with the largest residuals over sigma.

    Args:
        residual: (n, ny) residuals, NaN where nothing was measured [output's unit].
        sigma: (ny,) noise of each output [output's unit].
    """
    measured = np.isfinite(residual)
    squares = np.where(measured, residual, 0.0) ** 2
    count = np.maximum(measured.sum(axis=0), 1)
    relative_mean_square = squares.sum(axis=0) / count / sigma**2

    worst_first = np.argsort(-relative_mean_square, kind="stable")
    return np.sort(worst_first[:MAX_OUTPUTS])


def _drawn_samples(count: int) -> tuple[NDArray[np.intp], float]:
    """Return which of `count` samples are drawn, and the size of their dots [points]."""
    rows = evenly_spread_indices(count, MAX_SAMPLES)
    size = float(np.clip(900.0 / len(rows), 1.5, 4.0))
    return rows, size


def _draw_outputs(axes: Axes, recording: Recording, predicted: Array, column: int) -> None:
    """Draw one output: measured samples as dots, `predicted` (n, ny) as a line."""
    rows, size = _drawn_samples(len(recording.t))
    t = recording.t[rows]
    y = recording.y[rows, column]
    y_predicted = predicted[rows, column]

    axes.plot(t, y, ".", color=MEASURED_COLOUR, markersize=size)
    axes.plot(t, y_predicted, color=TEXT_COLOUR, linewidth=1.2)


def _draw_residual(axes: Axes, t: Array, residual: Array, sigma: float) -> None:
    """Draw the residual of one output over the band of two sigma, with its rms in words.

    Args:
        axes: Axes of the panel.
        t: (n,) times [s].
        residual: (n,) measured minus predicted, NaN where nothing was measured [output's unit].
        sigma: Noise of the output [output's unit].
    """
    axes.axhspan(-2.0 * sigma, 2.0 * sigma, color=GRID_COLOUR, alpha=0.8, linewidth=0)
    axes.axhline(0.0, color=TEXT_COLOUR, linewidth=0.8)
    rows, size = _drawn_samples(len(t))
    axes.plot(t[rows], residual[rows], ".", color=MEASURED_COLOUR, markersize=size)

    known = residual[np.isfinite(residual)]
    if not known.size:
        write_message(axes, "not measured")
        return

    relative_rms = np.sqrt(np.mean(known**2)) / sigma
    outside = 100.0 * float(np.mean(np.abs(known) > 2.0 * sigma))
    text = f"rms / σ = {relative_rms:.2f},  {outside:.1f} % outside"
    axes.set_title(text, loc="right", fontsize=SMALL_FONT, color=MUTED_COLOUR, pad=3)
