"""Figures of residual spectra, and of predictions of recordings that were not fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from mjfim.arrays import Array
from mjfim.model.coordinates import split_unit
from mjfim.output.distributions import chi_squared_quantiles
from mjfim.output.plots.recording_fit import shown_outputs
from mjfim.output.plots.style import (
    GRID_COLOUR,
    IDENTIFIED_COLOUR,
    MEASURED_COLOUR,
    MUTED_COLOUR,
    NOMINAL_COLOUR,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    fit_text,
    format_axes,
    format_number,
    new_figure,
    own_style,
    panel_width,
    set_plain_log_ticks,
    shorten,
    write_message,
)
from mjfim.output.welch import density_of
from mjfim.records.estimate import Estimate, Prediction
from mjfim.records.labels import Labels

# Largest and smallest number of residuals in one segment of a smoothed density (Welch's method),
# and the number of segments that are aimed at.
LONGEST_SEGMENT, SHORTEST_SEGMENT, SEGMENTS = 256, 32, 10

# Effective number of independent densities per segment, for Hann windows that overlap by half.
# Source: Welch (1967), correlation 1/6 between neighbours.
INDEPENDENT_SHARE = 1.0 / (1.0 + 2.0 / 36.0)

# Largest number of residuals of a recording that is too short for a spectrum.
TOO_SHORT = 8

# Largest number of outputs in a figure, and of panels side by side.
MAX_OUTPUTS, PANEL_COLUMNS = 12, 3

# Largest number of recordings whose predictions are drawn.
MAX_PREDICTIONS = 8

# Characters to which the names of outputs and recordings are shortened.
RECORDING_NAME_WIDTH = 34

# Probability below which a p-value is not written as a number.
SMALLEST_WRITTEN_P = 1e-6


# ---- residual spectra


@own_style
def residual_spectra(estimate: Estimate, labels: Labels) -> Figure:
    """Draw the smoothed density of the residuals of every output, relative to white noise of sigma.

    Args:
        estimate: The estimate.
        labels: Labels of the outputs.
    """
    outputs = estimate.recordings[0].outputs
    sigma = np.array([estimate.sigma[name] for name in outputs])
    measured = [recording.y for recording in estimate.recordings]
    columns = shown_outputs(measured, estimate.predicted, sigma, MAX_OUTPUTS)

    across = min(PANEL_COLUMNS, len(columns))
    if len(columns) == PANEL_COLUMNS + 1:
        across = 2
    rows = -(-len(columns) // across)
    figure = new_figure(1.75 * rows + 1.4)
    grid = figure.add_gridspec(rows, across)
    for k, column in enumerate(columns):
        axes = figure.add_subplot(grid[divmod(k, across)])
        name, _ = split_unit(labels.output(outputs[column]))
        is_lowest = k + across >= len(columns)
        format_axes(
            axes,
            "frequency [Hz]" if is_lowest else "",
            "density / white noise [–]" if k % across == 0 else "",
        )
        _draw_spectrum(axes, estimate, int(column), float(sigma[column]))
        short = fit_text(name, panel_width(across), SMALL_FONT)
        axes.set_title(short, loc="left", fontsize=SMALL_FONT, pad=14)

    handles: list[Line2D | Patch] = [
        Line2D([], [], color=MEASURED_COLOUR, label="residual"),
        Patch(color=MEASURED_COLOUR, alpha=0.25, label="its 95 % confidence band"),
        Line2D([], [], color=TEXT_COLOUR, label="white noise of the assumed σ"),
    ]
    note = (
        "Smoothed by Welch's method; samples count as evenly spaced. A band above the line at low "
        "frequencies: the model lacks a slow effect. p(white): p-value of a test for white noise."
    )
    add_title(figure, "Spectra of the residuals", handles, note)
    return figure


def _scaled_residuals(estimate: Estimate, column: int, sigma: float) -> list[tuple[Array, Array]]:
    """Return times (n,) [s] and residuals over sigma (n,) of one output.

    There is a pair per recording that is long enough.
    """
    parts = []
    for recording, predicted in zip(estimate.recordings, estimate.predicted, strict=True):
        residual = recording.y[:, column] - predicted[:, column]
        measured = np.isfinite(residual)
        if np.count_nonzero(measured) <= TOO_SHORT:
            continue
        t = recording.t[measured]
        scaled = residual[measured] / sigma
        parts.append((t, scaled))
    return parts


def _smoothed_density(parts: list[tuple[Array, Array]]) -> tuple[Array, Array, float]:
    """Average the densities of several recordings.

    Rows count as evenly spaced at each recording's mean rate.

    Args:
        parts: Times (n,) [s] and residuals (n,) of each recording.

    Returns:
        Frequencies [Hz], density [unit²/Hz], and its degrees of freedom.
    """
    frequencies, total, count = np.zeros(0), np.zeros(0), 0.0
    if not parts:
        return frequencies, total, count

    rate = float(np.mean([(len(t) - 1) / (t[-1] - t[0]) for t, _ in parts]))
    samples = sum(len(residual) for _, residual in parts)
    length = int(np.clip(2 * samples // (SEGMENTS + 1), SHORTEST_SEGMENT, LONGEST_SEGMENT))
    length = min(length, min(len(residual) for _, residual in parts))
    for _, residual in parts:
        # Welch's segments overlap by half.
        segments = max(2 * len(residual) // length - 1, 1)
        frequencies, density = density_of(residual, rate, length)
        total = (total if count else np.zeros_like(density)) + segments * density
        count += segments

    independent = INDEPENDENT_SHARE if count > 1 else 1.0
    return frequencies, total / max(count, 1.0), 2.0 * count * independent


def _draw_spectrum(axes: Axes, estimate: Estimate, column: int, sigma: float) -> None:
    """Draw the density of one output over that of white noise, with a band of 95 %.

    Args:
        axes: Axes of the panel.
        estimate: The estimate.
        column: Number of the output.
        sigma: Noise of the output [output's unit].
    """
    parts = _scaled_residuals(estimate, column, sigma)
    frequencies, density, freedom = _smoothed_density(parts)
    if not freedom or not (density > 0.0).any():
        write_message(axes, "not measured")
        return

    # The first and the last frequency have half the density and are left out.
    white_density = 1.0 / max(float(frequencies[-1]), 1e-300)
    f, relative = frequencies[1:-1], density[1:-1] / white_density
    low, high = (freedom / value for value in chi_squared_quantiles((0.975, 0.025), freedom))
    axes.fill_between(
        f, low * relative, high * relative, color=MEASURED_COLOUR, alpha=0.25, linewidth=0.0
    )
    axes.plot(f, relative, color=MEASURED_COLOUR)
    axes.axhline(1.0, color=TEXT_COLOUR, linewidth=0.8)
    axes.set_xscale("log")
    axes.set_yscale("log")
    set_plain_log_ticks(axes.xaxis)
    set_plain_log_ticks(axes.yaxis)

    if column < len(estimate.whiteness):
        test = estimate.whiteness[column]
        p = "below 10⁻⁶" if test.p < SMALLEST_WRITTEN_P else format_number(test.p, 2)
        text = f"lag-1 correlation {test.correlation:+.2f},  p(white) {p}".replace("-0", "−0")
        axes.text(
            0.0,
            1.02,
            text,
            transform=axes.transAxes,
            fontsize=SMALL_FONT - 1.0,
            color=MUTED_COLOUR,
            va="bottom",
        )


# ---- predictions


@dataclass(frozen=True, kw_only=True)
class _ErrorRow:
    """A row of the predictions: the errors of both models in one output of one recording.

    Attributes:
        name: Name of the output, or of the recording below the name of its output.
        nominal: Rms error of the nominal model over sigma; NaN in a heading.
        identified: Rms error of the identified model over sigma; NaN in a heading.
        words: Error in its unit, and its ratio to that of the nominal model.
        heading: True for the name of an output above its recordings.
    """

    name: str
    nominal: float = float("nan")
    identified: float = float("nan")
    words: str = ""
    heading: bool = False


@own_style
def predictions(estimate: Estimate, labels: Labels) -> Figure:
    """Draw prediction errors of the identified and of the nominal model over the noise.

    The predicted recordings were not fitted.

    Args:
        estimate: An estimate with predictions.
        labels: Labels of the outputs.
    """
    found = sorted(estimate.predictions, key=lambda prediction: not prediction.held_out)
    shown = found[:MAX_PREDICTIONS]
    outputs = shown[0].identified.outputs
    measured = [
        j
        for j in range(len(outputs))
        if any(np.isfinite(prediction.identified.rms[j]) for prediction in shown)
    ]
    rows: list[_ErrorRow] = []
    for j in measured[:MAX_OUTPUTS]:
        rows += _error_rows(estimate, shown, labels, j)

    figure = new_figure(2.0 + 0.25 * len(rows))
    axes = figure.subplots()
    _draw_error_rows(axes, rows)

    handles = [
        Line2D([], [], color=NOMINAL_COLOUR, marker="o", linestyle="", label="nominal model"),
        Line2D([], [], color=IDENTIFIED_COLOUR, marker="o", linestyle="", label="identified model"),
        Line2D([], [], color=MEASURED_COLOUR, linestyle="--", label="σ of the noise"),
    ]
    note = (
        "The identified parameters were fitted to all other recordings; of the predicted "
        "recording only the initial state is estimated. On the right: error of the identified "
        "model, and its ratio to that of the nominal model."
    )
    if not all(prediction.held_out for prediction in shown):
        note += " *: also part of the last fit; predicted here by a fit to the other recordings."
    if len(shown) < len(found) or len(measured) > MAX_OUTPUTS:
        note += (
            f" Shown: {_share_in_words(len(shown), len(found), 'recordings')} and "
            f"{_share_in_words(min(len(measured), MAX_OUTPUTS), len(measured), 'outputs')}."
        )
    title = "Predictions of recordings that were not fitted"
    if len(shown) == 1:
        title = f"Prediction of {_recording_name(shown[0])}, which was not fitted"
    add_title(figure, title, handles, note)
    return figure


def _share_in_words(shown: int, count: int, things: str) -> str:
    """Say how many things are shown, such as "8 of 12 outputs" and "all recordings"."""
    return f"{shown} of {count} {things}" if shown < count else f"all {things}"


def _error_rows(
    estimate: Estimate, shown: Sequence[Prediction], labels: Labels, j: int
) -> list[_ErrorRow]:
    """Return the rows of output j; with several recordings, its name stands above them."""
    name = shown[0].identified.outputs[j]
    label, unit = split_unit(labels.output(name))
    sigma = estimate.sigma.get(name, float("nan"))

    # Without a known noise, errors are relative to the largest one of the nominal model.
    if not np.isfinite(sigma) or sigma <= 0.0:
        sigma = max((float(p.nominal.rms[j]) for p in shown), default=1.0) or 1.0

    several = len(shown) > 1
    short = shorten(label, RECORDING_NAME_WIDTH)
    rows = [_ErrorRow(name=short, heading=True)] if several else []
    for prediction in shown:
        error = float(prediction.identified.rms[j])
        words = f"{format_number(error)} {unit}".rstrip()
        ratio = format_number(_error_ratio(prediction, j), 2)
        rows.append(
            _ErrorRow(
                name=_recording_name(prediction) if several else short,
                nominal=float(prediction.nominal.rms[j]) / sigma,
                identified=error / sigma,
                words=f"{words}  (× {ratio})",
            )
        )
    return rows


def _draw_error_rows(axes: Axes, rows: Sequence[_ErrorRow]) -> None:
    """Draw the errors of both models as two dots with a line between them."""
    axes.set_xscale("log")
    places = np.arange(len(rows))
    nominal = np.array([row.nominal for row in rows])
    identified = np.array([row.identified for row in rows])
    axes.hlines(places, identified, nominal, color=GRID_COLOUR, linewidth=3.0)
    axes.plot(nominal, places, "o", color=NOMINAL_COLOUR, markersize=6)
    axes.plot(identified, places, "o", color=IDENTIFIED_COLOUR, markersize=6)
    axes.axvline(1.0, color=MEASURED_COLOUR, linewidth=1.2, linestyle="--", zorder=1)

    values = np.concatenate([nominal, identified, [1.0]])
    usable = values[np.isfinite(values) & (values > 0.0)]
    axes.set_xlim(usable.min() / 1.4, usable.max() * 1.4)
    set_plain_log_ticks(axes.xaxis)
    format_axes(axes, "rms prediction error / σ of the noise [–]")
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.grid(False, axis="y")
    axes.tick_params(axis="y", length=0.0)
    axes.set_yticks(places, [row.name for row in rows])
    for text, row, place in zip(axes.get_yticklabels(), rows, places, strict=True):
        text.set_fontweight("bold" if row.heading else "normal")
        axes.text(
            1.01,
            float(place),
            row.words,
            transform=axes.get_yaxis_transform(),
            va="center",
            fontsize=SMALL_FONT,
        )


def _recording_name(prediction: Prediction) -> str:
    """Return the short name of a predicted recording; one that the last fit holds has a star."""
    file_name = prediction.name.rsplit("/", 1)[-1]
    name = shorten(file_name, RECORDING_NAME_WIDTH)
    return name if prediction.held_out else f"{name} *"


def _error_ratio(prediction: Prediction, j: int) -> float:
    """Return the identified model's error over the nominal model's; NaN if the latter is 0."""
    identified = float(prediction.identified.rms[j])
    nominal = float(prediction.nominal.rms[j])
    return identified / nominal if nominal > 0.0 else float("nan")
