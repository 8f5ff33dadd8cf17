"""Figures over time: the fit to a recording, and the prediction of a held-out recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
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
    IDENTIFIED_COLOUR,
    MEASURED_COLOUR,
    MUTED_COLOUR,
    NOMINAL_COLOUR,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    format_axes,
    new_figure,
    own_style,
    shorten,
    shorten_label,
    write_message,
)
from mjfim.records.estimate import Estimate
from mjfim.records.labels import Labels
from mjfim.records.trajectory import Recording

# Largest number of outputs in a figure; of more, the worst ones are shown.
MAX_OUTPUTS = 8

# Largest number of samples of a recording that are drawn.
MAX_SAMPLES = 4000

# Largest number of segments whose boundaries are lines; of more, they are marks at the lower edge.
MAX_BOUNDARY_LINES = 40

# Space above and below the curves, as a share of the range of what was measured and identified.
MARGIN = 0.08

# Space that a panel gains for a nominal model beyond this range, as a share of the range.
NOMINAL_ROOM = 0.6

# Characters to which the names of outputs and of recordings are shortened.
OUTPUT_NAME_WIDTH, RECORDING_NAME_WIDTH = 40, 60

# Largest number of intervals between the ticks of a panel.
MAX_TICKS = 4


@dataclass(frozen=True, kw_only=True, eq=False)
class _Curves:
    """Everything that is drawn of one recording.

    Attributes:
        recording: The recording.
        identified: (M, ny) outputs of the identified model [unit of the output].
        nominal: (M, ny) outputs of the nominal model, or None.
        noise: (ny,) noise of each output [unit of the output].
        boundaries: Times at which segments begin, without the first one [s].
        nominal_errors: True where the errors of the nominal model are drawn, too.
    """

    recording: Recording
    identified: Array
    nominal: Array | None
    noise: Array
    boundaries: Array
    nominal_errors: bool = False


@own_style
def fit(estimate: Estimate, index: int, labels: Labels, sigma: Sequence[float] | Array) -> Figure:
    """Draw measured and predicted outputs of one fitted recording, with their residuals.

    Args:
        estimate: The estimate.
        index: Number of the recording.
        labels: Labels of the outputs.
        sigma: (ny,) stated noise of each output [output's unit].

    Raises:
        MjfimError: There is no such recording, or sigma does not fit its outputs.
    """
    noise = _checked_noise(estimate, index, sigma)
    curves = _Curves(
        recording=estimate.recordings[index],
        identified=estimate.predicted[index],
        nominal=estimate.nominal[index] if estimate.nominal else None,
        noise=noise,
        boundaries=estimate.segments[index][1:] if estimate.segments else np.zeros(0),
    )
    note = (
        "Residual: measured − identified model. If the model and the noise are right, 4.6 % of the "
        "samples are outside ±2σ."
    )
    if curves.nominal is not None:
        note += " Both models begin each segment at the fitted initial state."
    else:
        note += f" {estimate.reason_without_nominal}"
    return _draw(curves, labels, f"Fit to {_file_name(curves.recording)}", note)


@own_style
def held_out(estimate: Estimate, index: int, labels: Labels) -> Figure:
    """Draw a held-out recording beside its predictions by the identified and the nominal model.

    Args:
        estimate: The estimate.
        index: Number of the held-out recording.
        labels: Labels of the outputs.

    Raises:
        MjfimError: There is no such recording.
    """
    found = [prediction for prediction in estimate.predictions if prediction.recording is not None]
    if not 0 <= index < len(found):
        raise MjfimError(
            f"the estimate has no held-out recording {index}; valid: 0 to {len(found) - 1}"
        )
    prediction = found[index]
    recording = prediction.recording
    assert recording is not None
    sigma = [estimate.sigma.get(name, np.nan) for name in recording.outputs]
    curves = _Curves(
        recording=recording,
        identified=prediction.identified_outputs,
        nominal=prediction.nominal_outputs,
        noise=np.array(sigma),
        boundaries=np.zeros(0),
        nominal_errors=True,
    )
    note = (
        "Error: measured − predicted. The parameters were fitted to other recordings; of this "
        "one, only initial states are estimated."
    )
    return _draw(curves, labels, f"Prediction of {_file_name(recording)}, held out", note)


def _file_name(recording: Recording) -> str:
    """Return the short name of a recording."""
    return shorten(Path(recording.name).name, RECORDING_NAME_WIDTH)


def _draw(curves: _Curves, labels: Labels, title: str, note: str) -> Figure:
    """Draw a row per output: the curves over time, and their errors."""
    recording = curves.recording
    columns = shown_outputs([recording.y], [curves.identified], curves.noise)

    figure = new_figure(1.2 * len(columns) + 1.5)
    grid = figure.subplots(len(columns), 2, squeeze=False, sharex=True, width_ratios=(1.4, 1.0))
    for (left, right), column in zip(grid, columns, strict=True):
        label = labels.output(recording.outputs[column])
        _draw_outputs(left, curves, int(column))
        _draw_errors(right, curves, int(column))
        format_axes(left)
        format_axes(right, ylabel=f"[{split_unit(label)[1] or '–'}]")
        left.set_title(
            shorten_label(label, OUTPUT_NAME_WIDTH), loc="left", fontsize=SMALL_FONT, pad=3
        )
        for axes in (left, right):
            axes.locator_params(axis="y", nbins=MAX_TICKS)
            axes.tick_params(labelbottom=True)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")

    if len(columns) < len(recording.outputs):
        note += (
            f" Shown: those {len(columns)} of {len(recording.outputs)} outputs "
            "whose residuals over σ are largest."
        )
    add_title(figure, title, _handles(curves), note)
    return figure


def _handles(curves: _Curves) -> list[Line2D | Patch]:
    """Return the entries of the legend."""
    handles: list[Line2D | Patch] = [
        Line2D([], [], color=MEASURED_COLOUR, marker=".", linestyle="", label="measured"),
        Line2D([], [], color=IDENTIFIED_COLOUR, label="identified model"),
    ]
    if curves.nominal is not None:
        handles.append(Line2D([], [], color=NOMINAL_COLOUR, linewidth=0.8, label="nominal model"))
    if np.isfinite(curves.noise).any():
        handles.append(Patch(color=GRID_COLOUR, label="±2σ of the noise"))
    if len(curves.boundaries):
        handles.append(
            Line2D(
                [],
                [],
                color=MUTED_COLOUR,
                linestyle="--" if len(curves.boundaries) <= MAX_BOUNDARY_LINES else "",
                marker="" if len(curves.boundaries) <= MAX_BOUNDARY_LINES else "|",
                linewidth=0.7,
                label="begin of a segment",
            )
        )
    return handles


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


def shown_outputs(
    measured: Sequence[Array],
    predicted: Sequence[Array],
    sigma: Array,
    largest: int = MAX_OUTPUTS,
) -> NDArray[np.intp]:
    """Return the outputs to draw: of many, those with the largest residuals over sigma.

    Args:
        measured: (M, ny) values of every recording, NaN where nothing was measured [output's unit].
        predicted: (M, ny) predictions of every recording [output's unit].
        sigma: (ny,) noise of each output [output's unit].
        largest: Largest number of outputs.
    """
    squares = np.zeros(len(sigma))
    count = np.zeros(len(sigma))
    for y, identified in zip(measured, predicted, strict=True):
        for j in range(len(sigma)):
            residual = y[:, j] - identified[:, j]
            known = residual[np.isfinite(residual)]
            squares[j] += known @ known
            count[j] += len(known)
    relative_mean_square = squares / np.maximum(count, 1.0) / sigma**2

    worst_first = np.argsort(-relative_mean_square, kind="stable")
    return np.sort(worst_first[:largest])


def _drawn_samples(count: int) -> tuple[NDArray[np.intp], float]:
    """Return which of `count` samples are drawn, and the size of their dots [points]."""
    rows = evenly_spread_indices(count, MAX_SAMPLES)
    size = float(np.clip(900.0 / len(rows), 1.5, 4.0))
    return rows, size


def _draw_outputs(axes: Axes, curves: _Curves, column: int) -> None:
    """Draw one output: measured samples as dots, both models as lines."""
    rows, size = _drawn_samples(len(curves.recording.t))
    t = curves.recording.t[rows]
    y = curves.recording.y[rows, column]
    identified = curves.identified[rows, column]

    axes.plot(t, y, ".", color=MEASURED_COLOUR, markersize=size)
    axes.plot(t, identified, color=IDENTIFIED_COLOUR, linewidth=1.2)

    # A nominal model that is far away does not make the other curves flat.
    values = np.concatenate([y, identified])
    finite = values[np.isfinite(values)]
    low, high = finite.min(initial=np.inf), finite.max(initial=-np.inf)
    if curves.nominal is not None:
        nominal = curves.nominal[rows, column]
        axes.plot(t, nominal, color=NOMINAL_COLOUR, linewidth=0.8, zorder=1.5)
        room = NOMINAL_ROOM * (high - low)
        low = max(min(low, np.nanmin(nominal, initial=np.inf)), low - room)
        high = min(max(high, np.nanmax(nominal, initial=-np.inf)), high + room)
    if high > low:
        margin = MARGIN * float(high - low)
        axes.set_ylim(float(low) - margin, float(high) + margin)
    _mark_segments(axes, curves.boundaries)


def _mark_segments(axes: Axes, boundaries: Array) -> None:
    """Mark the times at which segments begin; many have short marks at the lower edge."""
    if not len(boundaries):
        return

    height = 1.0 if len(boundaries) <= MAX_BOUNDARY_LINES else 0.06
    axes.vlines(
        boundaries,
        0.0,
        height,
        transform=axes.get_xaxis_transform(),
        color=MUTED_COLOUR,
        linewidth=0.6,
        linestyle="--" if height == 1.0 else "-",
        alpha=0.6,
    )


def _draw_errors(axes: Axes, curves: _Curves, column: int) -> None:
    """Draw the errors of one output over the band of two sigma, with their rms in words."""
    sigma = float(curves.noise[column])
    if np.isfinite(sigma):
        axes.axhspan(-2.0 * sigma, 2.0 * sigma, color=GRID_COLOUR, alpha=0.8, linewidth=0)
    axes.axhline(0.0, color=TEXT_COLOUR, linewidth=0.8)

    t, y = curves.recording.t, curves.recording.y[:, column]
    rows, size = _drawn_samples(len(t))
    residual = y - curves.identified[:, column]
    colour = IDENTIFIED_COLOUR if curves.nominal_errors else MEASURED_COLOUR
    axes.plot(t[rows], residual[rows], ".", color=colour, markersize=size, zorder=2.5)
    if curves.nominal_errors and curves.nominal is not None:
        error = y - curves.nominal[:, column]
        axes.plot(t[rows], error[rows], ".", color=NOMINAL_COLOUR, markersize=0.7 * size)

    known = residual[np.isfinite(residual)]
    if not known.size:
        write_message(axes, "not measured")
        return

    words = "error" if curves.nominal_errors else "residual"
    if np.isfinite(sigma):
        relative_rms = float(np.sqrt(np.mean(known**2))) / sigma
        outside = 100.0 * float(np.mean(np.abs(known) > 2.0 * sigma))
        words += f": rms / σ = {relative_rms:.2f},  {outside:.1f} % outside"
    axes.set_title(words, loc="left", fontsize=SMALL_FONT, color=MUTED_COLOUR, pad=3)
