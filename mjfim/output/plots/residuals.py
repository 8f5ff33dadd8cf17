"""Figures of what a fit leaves: residual spectra, and predictions of what was not fitted."""

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
from mjfim.output.labels import Labels
from mjfim.output.plots.estimates import shown_outputs
from mjfim.output.plots.style import (
    GRID_COLOUR,
    INITIAL_COLOUR,
    MEASURED_COLOUR,
    MUTED_COLOUR,
    OPTIMIZED_COLOUR,
    SMALL_FONT,
    TEXT_COLOUR,
    add_title,
    break_before_unit,
    format_axes,
    format_number,
    new_figure,
    shorten,
    write_message,
)
from mjfim.records.estimate import Estimate, Prediction

SEGMENT = 256  # residuals of a periodogram that is averaged


def spectrum(parts: list[tuple[Array, Array]]) -> tuple[Array, Array, float]:
    """Frequencies [Hz], averaged periodogram [unit²/Hz] of residuals (t, r) of several recordings, and their number.

    Rows count as evenly spaced at each recording's mean rate.
    """
    total, freq, count = np.zeros(0), np.zeros(0), 0.0
    rates = [(len(t) - 1) / (t[-1] - t[0]) for t, r in parts if len(r) > 8]
    if not rates:
        return freq, total, 0.0
    n = min(SEGMENT, min(len(r) for _, r in parts if len(r) > 8))
    for _, r in parts:
        if len(r) >= n:
            pieces = max(2 * len(r) // n - 1, 1)
            freq, power = welch(r, float(np.mean(rates)), nperseg=n, detrend=False)
            total = (total if count else np.zeros_like(power)) + pieces * power
            count += pieces
    return freq, total / max(count, 1.0), count


def draw_spectrum(axes: Axes, estimate: Estimate, column: int, sigma: float) -> None:
    """One output: its spectrum over that of white noise of the same sigma, with the band that noise keeps within."""
    parts = []
    for recording, predicted in zip(estimate.recordings, estimate.predicted, strict=True):
        r = recording.y[:, column] - predicted[:, column]
        seen = np.isfinite(r)
        parts.append((recording.t[seen], r[seen] / sigma))
    freq, power, count = spectrum([(t, r) for t, r in parts if len(t) > 8])
    if not count or not (power > 0.0).any():
        write_message(axes, "not measured")
        return
    level = 1.0 / max(float(freq[-1]), 1e-300)  # one-sided density of unit white noise
    low, high = chi2.ppf([0.025, 0.975], 2.0 * count) / (2.0 * count)
    axes.axhspan(low, high, color=GRID_COLOUR, alpha=0.8, linewidth=0)
    axes.axhline(1.0, color=TEXT_COLOUR, linewidth=0.8)
    axes.plot(
        freq[1:-1], power[1:-1] / level, color=MEASURED_COLOUR, linewidth=1.1
    )  # the two ends have half the power
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.yaxis.set_minor_formatter(NullFormatter())
    own = estimate.whiteness[column] if column < len(estimate.whiteness) else None
    if own is not None:
        chance = "below 10⁻⁶" if own.p < 1e-6 else format_number(own.p, 2)
        text = f"one to the next {own.correlation:+.2f},  p(white) {chance}"
        axes.set_title(text, loc="right", fontsize=SMALL_FONT, color=MUTED_COLOUR, pad=3)


def residual_spectra(estimate: Estimate, labels: Labels) -> Figure:
    """Spectra of the residuals of every output, relative to white noise of the sigma that was stated or estimated."""
    outputs = estimate.recordings[0].outputs
    sigma = np.array([estimate.sigma[name] for name in outputs])
    left = np.concatenate(
        [r.y - y for r, y in zip(estimate.recordings, estimate.predicted, strict=True)]
    )
    columns = shown_outputs(left, sigma)
    rows = -(-len(columns) // 2)
    wide = min(2, len(columns))
    figure = new_figure(10.0, 2.2 * rows + 1.2)
    grid = figure.subplots(rows, wide, squeeze=False)
    for axes in grid.ravel()[len(columns) :]:
        axes.set_visible(False)
    for axes, column in zip(grid.ravel(), columns, strict=False):
        format_axes(
            axes,
            ylabel=f"{break_before_unit(split_unit(labels.output(outputs[column]))[0])}\nover white noise [–]",
        )
        draw_spectrum(axes, estimate, int(column), float(sigma[column]))
    for axes in grid[-1]:
        axes.set_xlabel("frequency [Hz]")
    handles = [
        Line2D([], [], color=MEASURED_COLOUR, label="residual"),
        Line2D([], [], color=TEXT_COLOUR, label="white noise of σ"),
        Patch(color=GRID_COLOUR, label="95 % of white noise"),
    ]
    note = "Above the band at low frequencies: the model misses something slow. Rows count as evenly spaced."
    add_title(figure, "Spectra of the residuals", handles, note)
    return figure


def _share(prediction: Prediction, j: int) -> float:
    own, plain = float(prediction.identified.rms[j]), float(prediction.nominal.rms[j])
    return own / plain if plain > 0.0 else float("nan")


def predictions(estimate: Estimate, labels: Labels) -> Figure:
    """Errors of predictions of what was not fitted: identified against nominal model, every output on its own axis."""
    found = estimate.predictions
    names_of = found[0].identified.outputs
    outputs = [
        j for j in range(len(names_of)) if any(np.isfinite(p.identified.rms[j]) for p in found)
    ][:12]
    figure = new_figure(10.0, 1.5 + len(outputs) * (0.5 + 0.32 * len(found)))
    grid = figure.subplots(len(outputs), 1, squeeze=False)[:, 0]
    names = [shorten(p.name.rsplit("/", 1)[-1], 34) + ("" if p.held_out else " *") for p in found]
    for axes, j in zip(grid, outputs, strict=True):
        format_axes(axes, ylabel=break_before_unit(split_unit(labels.output(names_of[j]))[0]))
        place = np.arange(len(found))
        axes.barh(
            place - 0.19, [p.nominal.rms[j] for p in found], 0.34, color=INITIAL_COLOUR, alpha=0.75
        )
        axes.barh(
            place + 0.19,
            [p.identified.rms[j] for p in found],
            0.34,
            color=OPTIMIZED_COLOUR,
            alpha=0.85,
        )
        axes.set_yticks(place, names)
        axes.set_ylim(len(found) - 0.5, -0.5)
        axes.grid(False, axis="y")
        for k, p in enumerate(found):
            text = (
                f"{format_number(float(p.identified.rms[j]))}  (× {format_number(_share(p, j), 2)})"
            )
            where = {"transform": axes.get_yaxis_transform(), "va": "center"}
            axes.text(1.01, k, text, fontsize=SMALL_FONT, color=TEXT_COLOUR, **where)
        axes.set_xlabel(
            f"rms prediction error [{split_unit(labels.output(names_of[j]))[1] or '–'}]"
        )
    handles = [
        Patch(color=INITIAL_COLOUR, label="nominal model"),
        Patch(color=OPTIMIZED_COLOUR, label="identified model"),
    ]
    note = "The identified parameters were fitted to everything but what is predicted; only its start is found from it."
    if not all(p.held_out for p in found):
        note += " *: fitted in the end; predicted here by a fit to the rest."
    add_title(figure, "Predictions of what was not fitted", handles, note)
    return figure
