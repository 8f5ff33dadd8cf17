"""Figures of residual spectra, and of predictions of recordings that were not fitted."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import NullFormatter
from scipy.signal import welch
from scipy.stats import chi2

from mjfim.arrays import Array
from mjfim.model.coordinates import split_unit
from mjfim.output.plots.recording_fit import MAX_OUTPUTS, shown_outputs
from mjfim.output.plots.style import (
    GRID_COLOUR,
    IDENTIFIED_COLOUR,
    MEASURED_COLOUR,
    MUTED_COLOUR,
    NOMINAL_COLOUR,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    break_before_unit,
    format_axes,
    format_number,
    new_figure,
    own_style,
    shorten,
    write_message,
)
from mjfim.records.estimate import Estimate, Prediction
from mjfim.records.labels import Labels

# Largest number of residuals in one segment of an averaged periodogram (Welch's method).
SEGMENT_LENGTH = 256

# Largest number of residuals of a recording that is too short for a spectrum.
TOO_SHORT = 8

# Characters to which the names of recordings are shortened.
RECORDING_NAME_WIDTH = 34

# Height of a bar, and distance of the two bars of a row from its middle, as shares of the height of
# a row.
BAR_HEIGHT, BAR_OFFSET = 0.34, 0.19

# Probability below which a p-value is not written as a number.
SMALLEST_WRITTEN_P = 1e-6


# ---- residual spectra


@own_style
def residual_spectra(estimate: Estimate, labels: Labels) -> Figure:
    """Draw the spectrum of the residuals of every output, relative to white noise of sigma.

    Args:
        estimate: The estimate.
        labels: Labels of the outputs.
    """
    outputs = estimate.recordings[0].outputs
    sigma = np.array([estimate.sigma[name] for name in outputs])
    residuals = [
        recording.y - predicted
        for recording, predicted in zip(estimate.recordings, estimate.predicted, strict=True)
    ]
    columns = shown_outputs(np.concatenate(residuals), sigma)

    rows = -(-len(columns) // 2)
    figure = new_figure(2.2 * rows + 1.2)
    grid = figure.subplots(rows, min(2, len(columns)), squeeze=False)
    for axes in grid.ravel()[len(columns) :]:
        axes.set_visible(False)
    for axes, column in zip(grid.ravel(), columns, strict=False):
        name, _ = split_unit(labels.output(outputs[column]))
        format_axes(axes, ylabel=f"{break_before_unit(name)}\npower / white noise [–]")
        _draw_spectrum(axes, estimate, int(column), float(sigma[column]))
    for axes in grid[-1]:
        axes.set_xlabel("frequency [Hz]")

    handles = [
        Line2D([], [], color=MEASURED_COLOUR, label="residual"),
        Line2D([], [], color=TEXT_COLOUR, label="white noise of the assumed σ"),
        Patch(color=GRID_COLOUR, label="95 % range of white noise"),
    ]
    note = (
        "Power above the band at low frequencies: the model lacks a slow effect. "
        "p(white): p-value of a test for white noise. Samples count as evenly spaced."
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


def _averaged_periodogram(parts: list[tuple[Array, Array]]) -> tuple[Array, Array, float]:
    """Average the periodograms of several recordings.

    Rows count as evenly spaced at each recording's mean rate.

    Args:
        parts: Times (n,) [s] and residuals (n,) of each recording.

    Returns:
        Frequencies [Hz], power [unit²/Hz], and the number of segments that were averaged.
    """
    frequencies, total, count = np.zeros(0), np.zeros(0), 0.0
    if not parts:
        return frequencies, total, count

    rate = float(np.mean([(len(t) - 1) / (t[-1] - t[0]) for t, _ in parts]))
    length = min(SEGMENT_LENGTH, min(len(residual) for _, residual in parts))
    for _, residual in parts:
        # Welch's segments overlap by half.
        segments = max(2 * len(residual) // length - 1, 1)
        frequencies, power = welch(residual, rate, nperseg=length, detrend=False)
        total = (total if count else np.zeros_like(power)) + segments * power
        count += segments
    return frequencies, total / max(count, 1.0), count


def _draw_spectrum(axes: Axes, estimate: Estimate, column: int, sigma: float) -> None:
    """Draw the spectrum of one output over that of white noise, with a band of 95 %.

    Args:
        axes: Axes of the panel.
        estimate: The estimate.
        column: Number of the output.
        sigma: Noise of the output [output's unit].
    """
    parts = _scaled_residuals(estimate, column, sigma)
    frequencies, power, count = _averaged_periodogram(parts)
    if not count or not (power > 0.0).any():
        write_message(axes, "not measured")
        return

    # An average of periodograms of white noise is chi-squared with two degrees of freedom per
    # segment.
    low, high = chi2.ppf([0.025, 0.975], 2.0 * count) / (2.0 * count)
    axes.axhspan(low, high, color=GRID_COLOUR, alpha=0.8, linewidth=0)
    axes.axhline(1.0, color=TEXT_COLOUR, linewidth=0.8)

    # The first and the last frequency have half the power and are left out.
    white_density = 1.0 / max(float(frequencies[-1]), 1e-300)
    relative_power = power[1:-1] / white_density
    axes.plot(frequencies[1:-1], relative_power, color=MEASURED_COLOUR, linewidth=1.1)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.yaxis.set_minor_formatter(NullFormatter())

    if column < len(estimate.whiteness):
        test = estimate.whiteness[column]
        p = "below 10⁻⁶" if test.p < SMALLEST_WRITTEN_P else format_number(test.p, 2)
        text = f"lag-1 correlation {test.correlation:+.2f},  p(white) {p}".replace("-0", "−0")
        axes.set_title(text, loc="right", fontsize=SMALL_FONT, color=MUTED_COLOUR, pad=3)


# ---- predictions


@own_style
def predictions(estimate: Estimate, labels: Labels) -> Figure:
    """Draw prediction errors of the identified and of the nominal model.

    The predicted recordings were not fitted.

    Args:
        estimate: An estimate with predictions.
        labels: Labels of the outputs.
    """
    found = estimate.predictions
    outputs = found[0].identified.outputs
    measured = [
        j
        for j in range(len(outputs))
        if any(np.isfinite(prediction.identified.rms[j]) for prediction in found)
    ]
    shown = measured[:MAX_OUTPUTS]

    figure = new_figure(1.5 + len(shown) * (0.5 + 0.32 * len(found)))
    grid = figure.subplots(len(shown), 1, squeeze=False)[:, 0]
    for axes, j in zip(grid, shown, strict=True):
        name, unit = split_unit(labels.output(outputs[j]))
        format_axes(axes, ylabel=break_before_unit(name))
        _draw_errors(axes, found, j)
        axes.set_xlabel(f"rms prediction error [{unit or '–'}]")

    handles = [
        Patch(color=NOMINAL_COLOUR, label="nominal model"),
        Patch(color=IDENTIFIED_COLOUR, label="identified model"),
    ]
    note = (
        "The identified parameters were fitted to all other recordings; "
        "of the predicted recording only the initial state is estimated. On the right: error of "
        "the identified model, and its ratio to that of the nominal model."
    )
    if not all(prediction.held_out for prediction in found):
        note += " *: also part of the last fit; predicted here by a fit to the other recordings."
    add_title(figure, "Predictions of recordings that were not fitted", handles, note)
    return figure


def _draw_errors(axes: Axes, found: tuple[Prediction, ...], j: int) -> None:
    """Draw the errors of output j in every recording as bars, with their values beside them."""
    places = np.arange(len(found))
    nominal = [prediction.nominal.rms[j] for prediction in found]
    identified = [prediction.identified.rms[j] for prediction in found]
    axes.barh(places - BAR_OFFSET, nominal, BAR_HEIGHT, color=NOMINAL_COLOUR, alpha=0.75)
    axes.barh(places + BAR_OFFSET, identified, BAR_HEIGHT, color=IDENTIFIED_COLOUR, alpha=0.85)

    axes.set_yticks(places, [_recording_name(prediction) for prediction in found])
    axes.set_ylim(len(found) - 0.5, -0.5)
    axes.grid(False, axis="y")
    for place, prediction in enumerate(found):
        error = format_number(float(prediction.identified.rms[j]))
        ratio = format_number(_error_ratio(prediction, j), 2)
        axes.text(
            1.01,
            place,
            f"{error}  (× {ratio})",
            transform=axes.get_yaxis_transform(),
            va="center",
            fontsize=SMALL_FONT,
            color=TEXT_COLOUR,
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
