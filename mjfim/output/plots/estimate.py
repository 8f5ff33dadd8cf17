"""Pictures of an estimate: parameters, accuracy, fits and predictions over time, spectra."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray

from mjfim.arrays import NORMAL_95, Array, evenly_spread_indices, finite_or_nan
from mjfim.errors import first_ones
from mjfim.model.coordinates import split_unit
from mjfim.output.page import DESIGNED, IDENTIFIED, MEASURED, NOMINAL, capitalised
from mjfim.output.panels import (
    Axis,
    Cells,
    Mark,
    Panel,
    Picture,
    area,
    around,
    dots,
    grid,
    hline,
    hspan,
    in_grid,
    intervals,
    line,
    mark,
    range_of_intervals,
    row_axis,
    vline,
)
from mjfim.output.plots.accuracy import Accuracies, accuracy_panel, height_of_rows
from mjfim.output.words import (
    format_number,
    format_with_uncertainty,
    predicted_data,
    relative,
    share_note,
    shorten,
    without_zeros,
)
from mjfim.records.estimate import Estimate, Prediction
from mjfim.records.estimate_parts import MOST, InformationInTime, ResidualForce
from mjfim.records.trajectory import Labels, Recording, with_unit

# Number of segments that are transformed at once.
SEGMENTS_AT_ONCE = 64


def power_density(x: Array, rate: float, length: int) -> tuple[Array, Array]:
    """Average the densities of segments that overlap by half; the mean is not subtracted.

    Args:
        x: (M,) series.
        rate: Its rate [Hz].
        length: Number of values of a segment, at most M.

    Returns:
        Frequencies [Hz], and the one-sided density [unit of x squared / Hz].
    """
    step = length - length // 2
    count = max((len(x) - length) // step + 1, 1)

    # A part begins where the next segment would begin, so that no segment is left out.
    total = np.zeros(length // 2 + 1)
    frequencies = np.zeros(0)
    for first in range(0, count, SEGMENTS_AT_ONCE):
        segments = min(SEGMENTS_AT_ONCE, count - first)
        part = x[first * step : (first + segments - 1) * step + length]
        frequencies, density = scipy.signal.welch(part, rate, nperseg=length, detrend=False)
        total += segments * density
    return frequencies, total / count


# Largest numbers of outputs over time, of outputs with a spectrum, of predicted recordings, of
# parameters over the iterations, and of joints; of more, those that say most are drawn.
MAX_OUTPUTS, MAX_SPECTRA, MAX_PREDICTIONS, MAX_PARAMETERS, MAX_JOINTS = 6, 12, 8, 12, 6

# Largest number of samples of a recording that are drawn, and of segments whose boundaries are.
MAX_SAMPLES, MAX_BOUNDARIES = 4000, 40

# Space above and below curves, and that a panel gains for a nominal model beyond them, over the
# range of what was measured and identified.
MARGIN, NOMINAL_ROOM = 0.08, 0.6

# Characters to which the names of recordings are shortened.
NAME_WIDTH = 60

# Largest and smallest number of residuals in one segment of a smoothed density (Welch's method),
# the number of segments that are aimed at, and the fewest residuals of a recording.
LONGEST_SEGMENT, SHORTEST_SEGMENT, SEGMENTS, FEWEST = 256, 32, 10, 9

# Effective number of independent densities per segment, for Hann windows that overlap by half.
# Source: Welch (1967), correlation 1/6 between neighbours.
INDEPENDENT_SHARE = 1.0 / (1.0 + 2.0 / 36.0)

# Probability below which a p-value is not written as a number.
SMALLEST_WRITTEN_P = 1e-6

# Largest numbers of parameters and recordings with a ribbon of information, of its cells, and of
# marked places of a parameter; height of a ribbon [inch].
MAX_RIBBONS, MAX_RIBBON_LOGS, MAX_CELLS, MAX_MARKED, RIBBON_HEIGHT = 24, 3, 150, 3, 0.25

# Quantile of the shares at which the colours end, shares of priors from which they are written and
# from which the title leaves a parameter out, and size of a marked pull over that by noise.
STRONGEST_COLOUR, RELEVANT_PRIOR, MOSTLY_PRIOR, LARGE_PULL = 0.99, 0.01, 0.5, 3.0

# Quantiles of residual forces between which a panel reaches.
SHOWN_QUANTILES = (0.005, 0.995)


# ---- parameters


def parameter_intervals(estimate: Estimate, labels: Labels) -> Picture:
    """Show estimates and 95 % intervals relative to the guess; hollow where at a bound."""
    count = len(estimate.theta)
    guess = estimate.initial_theta
    percent = np.where(estimate.guess_sizes > 0.0, estimate.guess_sizes, np.nan) / 100.0
    centre = (estimate.theta - guess) / percent
    half = NORMAL_95 * finite_or_nan(estimate.std) / percent
    low, high = ((end - guess) / percent for end in estimate.interval.T)

    left, right = range_of_intervals(centre, low, high)
    published = (labels.published - guess) / percent
    seen = 1.06 * published
    left, right = np.nanmin([left, *seen]), np.nanmax([right, *seen])
    margin = 0.06 * (max(right, 0.0) - min(left, 0.0))
    rows = np.arange(count)
    is_at_bound = np.array([name in estimate.at_bound for name in estimate.parameters])
    look = {"size": 6.5, "front": 3.0}
    marks = [
        vline(0.0, NOMINAL, width=1.6, label=NOMINAL),
        intervals(
            centre - half,
            centre + half,
            rows,
            IDENTIFIED,
            width=5.0,
            opacity=0.3,
            label="formal 95 %",
        ),
        intervals(low, high, rows, IDENTIFIED, width=1.4),
        dots(
            centre[~is_at_bound],
            rows[~is_at_bound],
            IDENTIFIED,
            label=f"{IDENTIFIED}, 95 % interval",
            **look,
        ),
    ]
    if is_at_bound.any():
        at = dots(
            centre[is_at_bound],
            rows[is_at_bound],
            IDENTIFIED,
            symbol="s",
            hollow=True,
            label="at its bound",
            **look,
        )
        marks.append(at)
    if np.isfinite(published).any():
        marks.append(dots(published, rows, MEASURED, symbol="D", front=4.0, label="published"))
    note = (
        "The formal interval is right only if the model and the noise are right. The 95 % interval "
        "also allows for autocorrelated residuals."
    )
    if estimate.misfit:
        note += (
            " Here the residuals are not explained by noise: no interval covers the bias of a "
            "wrong model."
        )
    if not np.array_equal(np.abs(estimate.theta), estimate.sizes):
        note += " The difference of an entry of a vector or tensor is a share of the whole."
    if np.isnan(centre).any():
        note += " For a nominal value of 0 there is no relative difference, only numbers."
    texts = [_interval_text(estimate, j, labels.parameter_units[j]) for j in range(count)]
    panel = Panel(
        marks=marks,
        x=Axis(
            label=f"difference from the {NOMINAL} value [%]",
            limits=(min(left, -margin), max(right, margin)),
        ),
        y=row_axis([labels.parameter(j) for j in range(count)]),
        beside=[("", "text", texts)],
    )
    return Picture(
        title="Estimated parameters",
        panels=[panel],
        note=note,
        heights=[0.6 + (0.42 if count <= MAX_PARAMETERS else 0.27) * count],
    )


def accuracy(estimate: Estimate, labels: Labels) -> Picture:
    """Show predicted, formal and honest σ in percent, and the distance to published values."""
    names = list(map(with_unit, labels.parameters, labels.parameter_units))
    honest = estimate.honest_std
    std = np.where(np.isnan(honest), np.nan, estimate.std)
    sources = [
        Accuracies(estimate.predicted_std, DESIGNED, "predicted σ", size=12.0, hollow=True),
        Accuracies(std, IDENTIFIED, "formal σ", size=8.5, hollow=True),
        Accuracies(honest, IDENTIFIED, "honest σ", size=5.0),
        Accuracies(np.abs(labels.published - estimate.theta), MEASURED, "to published", symbol="D"),
    ]
    shown = [source for source in sources if np.isfinite(source.std).any()]
    # A share of a value or of a nominal value of 0 says nothing.
    known = (estimate.theta != 0.0) & (estimate.initial_theta != 0.0)
    sizes = np.where(known, estimate.sizes, np.nan)
    note = "Honest σ: a quarter of the width of the 95 % interval."
    if np.isfinite(labels.published).any():
        note += " To published: distance of the estimate from the published value."
    return Picture(
        title=capitalised("; ".join(_about_accuracy(estimate, labels, sizes))),
        panels=[accuracy_panel(names, sizes, shown, labels.wanted)],
        note=note,
        heights=[height_of_rows(len(names))],
    )


def _about_accuracy(estimate: Estimate, labels: Labels, sizes: Array) -> Iterator[str]:
    """Compare the honest σ with what was predicted, and the estimates with published values."""
    honest, names = estimate.honest_std, estimate.parameters
    share = honest / sizes
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = honest / estimate.predicted_std
        distance = np.abs(labels.published - estimate.theta) / honest
    if np.isfinite(ratio).any():
        j = int(np.nanargmax(ratio))
        yield f"honest σ at most {format_number(ratio[j], 2)} times the predicted one ({names[j]})"
    elif np.isfinite(share).any():
        j = int(np.nanargmax(share))
        most = relative(honest[j], sizes[j])
        yield f"accuracy of the fit: honest σ is at most {most} ({names[j]})"
    if np.isfinite(distance).any():
        j = int(np.nanargmax(distance))
        distance_text = f"{format_number(distance[j], 2)} honest σ"
        yield f"published values are at most {distance_text} away ({names[j]})"


def _interval_text(estimate: Estimate, j: int, unit: str) -> str:
    """Write guess, estimate and half the width of the interval of parameter j in its unit."""
    half_width = np.inf
    if np.isfinite(estimate.std[j]):
        half_width = 0.5 * float(np.ptp(estimate.interval[j]))
    guess = without_zeros(format_number(estimate.initial_theta[j], 4))
    value = format_with_uncertainty(estimate.theta[j], half_width)
    text = f"{guess} → {value} {unit}".rstrip()
    return f"{text}   (at its bound)" if estimate.parameters[j] in estimate.at_bound else text


# ---- information over time


def deciding_seconds(estimate: Estimate, labels: Labels) -> Picture:
    """Show the share of the information on each parameter per second of the recordings."""
    found = estimate.in_time
    assert found is not None
    seconds = found.seconds_of_most
    is_nuisance = np.isin(found.parameters, estimate.nuisance)
    asked = np.flatnonzero(~is_nuisance | is_nuisance.all())
    rows = np.sort(asked[np.argsort(seconds[asked], kind="stable")[:MAX_RIBBONS]]).tolist()
    logs = np.unique(found.recording).astype(int)
    gathered = [found.shares[found.recording == k].sum() for k in logs]
    recordings = np.sort(logs[np.argsort(gathered)[::-1][:MAX_RIBBON_LOGS]]).tolist()
    ribbons = {k: _ribbon(found, k) for k in recordings}
    rates = np.concatenate([rate[:, rows].ravel() for _, rate, _ in ribbons.values()])
    reach = float(np.quantile(rates, STRONGEST_COLOUR)) or 1.0

    names = [labels.parameter(estimate.parameters.index(found.parameters[j])) for j in rows]
    beside = [(f"{100.0 * MOST:.0f} % in", "text", [f"{seconds[j]:.2g} s" for j in rows])]
    if (found.prior > RELEVANT_PRIOR).any():
        beside.append(("priors", "muted", [f"{100.0 * found.prior[j]:.0f} %" for j in rows]))
    remark = (
        "share of the information per second: white for none, darkest for "
        f"{format_number(reach, 2)} % per s or more"
    )
    panels = []
    for place, (k, (edges, rate, pull)) in enumerate(ribbons.items()):
        panels.append(
            Panel(
                title=_file_name(estimate.recordings[k].name),
                remark=remark if place == 0 else "",
                cells=Cells(values=rate.T[rows], reach=reach, edges=edges),
                marks=[*_pulls(edges, pull[:, rows])],
                x=Axis(label="time [s]" if place == len(ribbons) - 1 else ""),
                y=row_axis(names),
                beside=beside if place == 0 else (),
                place=(place, 0),
            )
        )
    told = [j for j in rows if found.prior[j] < MOSTLY_PRIOR] or rows
    first, last = min(told, key=seconds.__getitem__), max(told, key=seconds.__getitem__)
    total = sum(float(recording.t[-1]) for recording in estimate.recordings)
    note = (
        "The information on a parameter, with all others unknown, adds over all seconds and priors "
        "to 1/σ²."
    )
    if any(panel.marks for panel in panels):
        note += (
            " Triangles: here, residuals that are larger than noise draw the estimate by more than "
            "1 σ; at most three for each parameter and recording."
        )
    span = f"{seconds[first]:.2g} s ({found.parameters[first]})"
    if first != last:
        span += f" to {seconds[last]:.2g} s ({found.parameters[last]})"
    title = (
        f"Which seconds decide: {100.0 * MOST:.0f} % of the information comes from {span} "
        f"of {total:.3g} s"
    )
    which = "parameters, those with the fewest deciding seconds"
    note += share_note(rows, asked, which)
    note += share_note(recordings, logs, "recordings, those with most information")
    heights = [0.4 + RIBBON_HEIGHT * len(rows)] * len(panels)
    heights[-1] += 0.2
    return Picture(title=title, panels=panels, note=note, heights=heights)


def _ribbon(found: InformationInTime, recording: int) -> tuple[Array, Array, Array]:
    """Return the (m+1,) edges of intervals [s], (m, q) shares [%/s] and marked pulls [σ].

    Pulls that are not marked are 0.
    """
    times = found.times[found.recording == recording]
    count, end = min(len(times), MAX_CELLS), float(times.max())
    edges = np.linspace(0.0, end, count + 1)
    share, pull = found.on_grid(recording, edges)
    by_noise = LARGE_PULL * found.scatter * np.sqrt(share)
    size = np.where(np.abs(pull) > np.maximum(by_noise, 1.0), np.abs(pull), 0.0)
    least = np.sort(size, axis=0)[-MAX_MARKED:][:1]
    return edges, 100.0 * share * count / end, np.where(size >= least, np.sign(pull) * size, 0.0)


def _pulls(edges: Array, pull: Array) -> Iterator[Mark]:
    """Yield triangles where residuals draw an estimate up or down."""
    middle = 0.5 * (edges[1:] + edges[:-1])
    for sign, symbol, words in ((1.0, "^", "up"), (-1.0, "v", "down")):
        place, row = np.nonzero(np.sign(pull) == sign)
        label = f"residuals draw it {words}"
        if len(place):
            yield dots(middle[place], row, "text", symbol=symbol, size=5.0, front=3.0, label=label)


# ---- recordings over time


def fit(estimate: Estimate, index: int, labels: Labels) -> Picture:
    """Show measured and predicted outputs of one fitted recording, with their residuals."""
    recording = estimate.recordings[index]
    note = (
        "Residual: measured − identified model. If the model and the noise are right, 4.6 % of the "
        "samples are outside ±2σ."
    )
    if estimate.nominal:
        note += " Both models begin each segment at the fitted initial state."
    else:
        note += f" {estimate.reason_without_nominal}"
    return _over_time(
        recording,
        estimate.predicted[index],
        estimate.nominal[index] if estimate.nominal else None,
        estimate,
        labels,
        title=f"Fit to {_file_name(recording.name)}",
        note=note,
        boundaries=estimate.segments[index][1:] if estimate.segments else (),
    )


def held_out(estimate: Estimate, index: int, labels: Labels) -> Picture:
    """Show a held-out recording beside its predictions by the identified and the nominal model."""
    found = [prediction for prediction in estimate.predictions if prediction.recording is not None]
    prediction = found[index]
    recording = prediction.recording
    assert recording is not None
    note = (
        "Error: measured − predicted. The parameters were fitted without this recording; of it, "
        "only initial states are estimated."
    )
    return _over_time(
        recording,
        prediction.identified_outputs,
        prediction.nominal_outputs,
        estimate,
        labels,
        title=f"Prediction of {_file_name(recording.name)}, held out",
        note=note,
        is_prediction=True,
    )


def _file_name(name: str, width: int = NAME_WIDTH) -> str:
    return shorten(Path(name).name, width)


def _over_time(
    recording: Recording,
    identified: Array,
    nominal: Array | None,
    estimate: Estimate,
    labels: Labels,
    *,
    title: str,
    note: str,
    boundaries: Sequence[float] | Array = (),
    is_prediction: bool = False,
) -> Picture:
    """Show a row per output: the curves over time, and their errors."""
    sigma = np.array([estimate.sigma.get(name, np.nan) for name in recording.outputs])
    measured = [bool(np.isfinite(y).any()) for y in recording.y.T]
    largest = shown_outputs([recording.y], [identified], sigma, MAX_OUTPUTS).tolist()
    has_room = len(measured) <= MAX_OUTPUTS
    columns = [j for j in largest if measured[j] or has_room] or largest
    rows = evenly_spread_indices(len(recording.t), MAX_SAMPLES)
    size = np.clip(900.0 / len(rows), 1.5, 4.0)
    t = recording.t[rows]
    panels = []
    for place, j in enumerate(columns):
        y, model = recording.y[rows, j], identified[rows, j]
        guess = None if nominal is None else nominal[rows, j]
        label = labels.output(recording.outputs[j])
        time = Axis(label="time [s]" if place == len(columns) - 1 else "")
        marks = [
            dots(t, y, MEASURED, symbol=".", size=size, label="measured"),
            line(t, model, IDENTIFIED, width=1.2, label="identified model"),
        ]
        if guess is not None:
            marks.append(line(t, guess, NOMINAL, width=0.8, front=1.5, label="nominal model"))
        if 0 < len(boundaries) <= MAX_BOUNDARIES:
            look = {"width": 0.6, "dash": "--", "opacity": 0.6, "label": "begin of a segment"}
            marks += [vline(begin, "muted", **look) for begin in boundaries]
        shown = Axis(most=4, limits=_visible_range(np.concatenate([y, model]), guess))
        panels.append(Panel(title=label, marks=marks, x=time, y=shown))

        errors, remark = _errors(
            t,
            y - model,
            y - guess if is_prediction and guess is not None else None,
            float(sigma[j]),
            is_prediction=is_prediction,
            size=size,
        )
        unit = Axis(label=f"[{split_unit(label)[1] or '–'}]", most=4)
        message = "" if remark else "not measured"
        panels.append(
            Panel(
                title=remark,
                role="muted",
                marks=errors if remark else (),
                x=time,
                y=unit,
                message=message,
            )
        )
    count = sum(measured)
    if len(columns) < count:
        note += (
            f" Shown: those {len(columns)} of {count} outputs whose residuals over σ are largest."
        )
    if 0 < count < len(measured) and not has_room:
        pairs = zip(recording.outputs, measured, strict=True)
        note += f" Not measured: {first_ones([name for name, is_known in pairs if not is_known])}."
    heights = [1.2] * len(columns)
    heights[-1] += 0.2
    panels = in_grid(panels, 2)
    return Picture(title=title, panels=panels, note=note, heights=heights, widths=[1.4, 1.0])


def _visible_range(values: Array, nominal: Array | None) -> tuple[float, float] | None:
    """Return the range of a panel; a nominal model that is far away does not flatten the curves."""
    finite = values[np.isfinite(values)]
    if not len(finite) or not np.ptp(finite):
        return None
    low, high = float(finite.min()), float(finite.max())
    if nominal is not None:
        room = NOMINAL_ROOM * (high - low)
        low, high = (
            max(min(low, np.nanmin(nominal, initial=np.inf)), low - room),
            min(max(high, np.nanmax(nominal, initial=-np.inf)), high + room),
        )
    margin = MARGIN * (high - low)
    return low - margin, high + margin


def _errors(
    t: Array,
    residual: Array,
    nominal: Array | None,
    sigma: float,
    *,
    is_prediction: bool,
    size: float,
) -> tuple[list[Mark], str]:
    """Return the errors of one output over the band of two sigma, and their rms in words."""
    marks = [hline(0.0, width=0.8)]
    if np.isfinite(sigma):
        marks.append(hspan(-2.0 * sigma, 2.0 * sigma, opacity=0.8, label="±2σ of the noise"))
    role = IDENTIFIED if is_prediction else MEASURED
    marks.append(dots(t, residual, role, symbol=".", size=size, front=2.5))
    if nominal is not None:
        marks.append(dots(t, nominal, NOMINAL, symbol=".", size=0.7 * size))
    shares = residual[np.isfinite(residual)] / sigma
    if not shares.size:
        return marks, ""
    words = "error" if is_prediction else "residual"
    if np.isfinite(sigma):
        rms = np.sqrt(np.mean(shares**2))
        words += f": rms / σ = {rms:.2f},  {100.0 * np.mean(np.abs(shares) > 2.0):.1f} % outside"
    return marks, words


def shown_outputs(
    measured: Sequence[Array], predicted: Sequence[Array], sigma: Array, largest: int
) -> NDArray[np.intp]:
    """Return the outputs to draw: of many, those with the largest residuals over sigma."""
    residual = np.concatenate([y - model for y, model in zip(measured, predicted, strict=True)])
    count = np.maximum(np.isfinite(residual).sum(axis=0), 1)
    mean_square = np.nansum((residual / sigma) ** 2, axis=0) / count
    return np.sort(np.argsort(-mean_square, kind="stable")[:largest])


# ---- spectra of the residuals


def residual_spectra(estimate: Estimate, labels: Labels) -> Picture:
    """Show the smoothed density of the residuals of every output over that of white noise of σ."""
    outputs = estimate.recordings[0].outputs
    sigma = np.array([estimate.sigma[name] for name in outputs])
    measured = [recording.y for recording in estimate.recordings]
    shown = shown_outputs(measured, estimate.predicted, sigma, MAX_SPECTRA).tolist()
    columns = 2 if len(shown) == 4 else min(3, len(shown))
    panels = [_spectrum_panel(estimate, j, split_unit(labels.output(outputs[j]))[0]) for j in shown]
    note = (
        "Smoothed by Welch's method; samples count as evenly spaced. A band above the line at low "
        "frequencies: the model lacks a slow effect. p(white): p-value of a test for white noise."
    )
    return grid("Spectra of the residuals", panels, [1.9] * len(panels), columns, note)


def _spectrum_panel(estimate: Estimate, column: int, name: str) -> Panel:
    """Return the density of one output with a band of 95 %."""
    sigma = estimate.sigma[estimate.recordings[0].outputs[column]]
    remark = ""
    if column < len(estimate.whiteness):
        test = estimate.whiteness[column]
        p = "below 10⁻⁶" if test.p < SMALLEST_WRITTEN_P else format_number(test.p, 2)
        remark = f"lag-1 correlation {test.correlation:+.2f},  p(white) {p}".replace("-0", "−0")
    f, density, freedom = _smoothed_density(estimate, column, sigma)
    if not freedom or not (density > 0.0).any():
        return Panel(title=name, remark=remark, message="not measured")
    # Quantiles of a chi-squared distribution; scipy.stats takes long to import.
    quantiles = 2.0 * scipy.special.gammaincinv(0.5 * freedom, [0.975, 0.025])
    low, high = freedom / quantiles
    return Panel(
        title=name,
        remark=remark,
        marks=[
            line(f, density, MEASURED, label="residual"),
            area(f, low * density, high * density, MEASURED, label="its 95 % confidence band"),
            hline(1.0, width=0.8, label="white noise of the assumed σ"),
        ],
        x=Axis(label="frequency [Hz]", log=True),
        y=Axis(label="density / white noise [–]", log=True),
    )


def _smoothed_density(estimate: Estimate, column: int, sigma: float) -> tuple[Array, Array, float]:
    """Average the densities of all recordings.

    Returns:
        Frequencies [Hz], densities over that of white noise, and their degrees of freedom, which
        are 0 where too little was measured.
    """
    parts, rates = [], []
    for recording, predicted in zip(estimate.recordings, estimate.predicted, strict=True):
        residual = (recording.y[:, column] - predicted[:, column]) / sigma
        measured = np.isfinite(residual)
        if np.count_nonzero(measured) >= FEWEST:
            t = recording.t[measured]
            parts.append(residual[measured])
            rates.append((len(t) - 1) / (t[-1] - t[0]))
    if not parts:
        return np.zeros(0), np.zeros(0), 0.0

    # Welch's segments overlap by half.
    wanted = 2 * sum(map(len, parts)) // (SEGMENTS + 1)
    length = min(int(np.clip(wanted, SHORTEST_SEGMENT, LONGEST_SEGMENT)), *map(len, parts))
    weights = [max(2 * len(part) // length - 1, 1) for part in parts]
    densities = [power_density(part, np.mean(rates), length) for part in parts]
    frequencies = densities[0][0]
    mean = np.average([density for _, density in densities], axis=0, weights=weights)
    count = sum(weights)
    independent = INDEPENDENT_SHARE if count > 1 else 1.0

    # The first and the last frequency have half the density and are left out.
    relative = mean[1:-1] * max(float(frequencies[-1]), 1e-300)
    return frequencies[1:-1], relative, 2.0 * count * independent


# ---- predictions


def predictions(estimate: Estimate, labels: Labels) -> Picture:
    """Show prediction errors of the identified and of the nominal model over the noise."""
    found = sorted(estimate.predictions, key=lambda prediction: not prediction.held_out)
    shown = found[:MAX_PREDICTIONS]
    outputs = shown[0].identified.outputs
    measured = [
        j for j in range(len(outputs)) if any(np.isfinite(p.identified.rms[j]) for p in shown)
    ]
    # With several recordings, the name of an output stands above them.
    names = []
    errors, texts = [], []
    for j in measured[:MAX_SPECTRA]:
        label, unit = split_unit(labels.output(outputs[j]))
        if len(shown) > 1:
            names.append(label)
            errors.append((np.nan, np.nan))
            texts.append("")
        sigma = estimate.sigma.get(outputs[j], np.nan)
        if not sigma > 0.0:
            # Without a known noise, errors are relative to the largest one of the nominal model.
            sigma = max(float(p.nominal.rms[j]) for p in shown) or 1.0
        for prediction in shown:
            nominal, error = float(prediction.nominal.rms[j]), float(prediction.identified.rms[j])
            names.append(_prediction_name(prediction) if len(shown) > 1 else label)
            errors.append((nominal / sigma, error / sigma))
            size = f"{format_number(error)} {unit}".rstrip()
            ratio = error / nominal if nominal > 0.0 else np.nan
            texts.append(f"{size}  (× {format_number(ratio, 2)})")
    nominal, identified = np.array(errors).T
    rows = np.arange(len(names))
    is_row = np.isfinite(nominal)
    panel = Panel(
        marks=[
            mark(
                "intervals",
                nominal[is_row],
                rows[is_row],
                "band",
                other=identified[is_row],
                width=3.0,
            ),
            dots(nominal, rows, NOMINAL, size=6.0, label="nominal model"),
            dots(identified, rows, IDENTIFIED, size=6.0, label="identified model"),
            vline(1.0, MEASURED, width=1.2, dash="--", label="σ of the noise"),
        ],
        x=Axis(
            label="rms prediction error / σ of the noise [–]",
            log=True,
            limits=around(np.append(np.concatenate([nominal, identified]), 1.0)),
        ),
        y=row_axis(names),
        beside=[("", "text", texts)],
    )
    note = (
        "The identified parameters were fitted without the predicted data; of the predicted "
        "recording only the initial state is estimated. On the right: error of the identified "
        "model, and its ratio to that of the nominal model."
    )
    if not all(prediction.held_out for prediction in shown):
        note += " *: also part of the last fit; predicted here by a fit without it."
    if len(shown) < len(found) or len(measured) > MAX_SPECTRA:
        note += (
            f" Shown: {len(shown)} of {len(found)} recordings and "
            f"{min(len(measured), MAX_SPECTRA)} of {len(measured)} outputs."
        )
    title = f"Predictions of {predicted_data(shown)}"
    if len(shown) == 1:
        title += f": {_prediction_name(shown[0])}"
    return Picture(title=title, panels=[panel], note=note, heights=[0.6 + 0.25 * len(names)])


def _prediction_name(prediction: Prediction) -> str:
    """Return the short name of a predicted recording; one that the last fit holds has a star."""
    name = _file_name(prediction.name, 34)
    return name if prediction.held_out else f"{name} *"


# ---- residual forces


def residual_torque(found: Sequence[ResidualForce], *, is_explained: bool = False) -> Picture:
    """Show the force that the model does not explain at each joint, over speed and position.

    Args:
        found: The residual forces.
        is_explained: Whether the model explains the recordings all the same.
    """
    order = sorted(found, key=lambda each: -each.noise_ratio)
    shown = [each for each in found if each in order[:MAX_JOINTS]]
    panels = []
    for each in shown:
        length, noun = ("rad", "angle") if each.unit == "N m" else ("m", "position")
        step, slope = each.friction
        title = "too few points in both directions"
        if np.isfinite(step):
            viscous = _with_unit(slope, f"{each.unit} s/{length}")
            title = f"step {_with_unit(step, each.unit)}, slope {viscous}"
        rms = f"rms {_with_unit(each.rms, each.unit)}{_over_noise(each)}"
        panels += [
            _force_panel(each, each.speed, f"speed [{length}/s]", title),
            _force_panel(each, each.position, f"{noun} [{length}]", rms),
        ]
    worst = order[0]
    title = f"Residual torque: {_with_unit(worst.rms, worst.unit)} rms at {worst.joint}"
    title += _over_noise(worst)
    if np.isfinite(worst.share):
        title += f", {_with_unit(100.0 * worst.share, '%')} of the force of its actuators"
    note = (
        "Force of the actuators, measured or by the model, less the force that the measured "
        "motion needs by the identified model. Over the speed, a step at 0 is dry friction that "
        "the model lacks; a negative one is too much of it. A slope is viscous friction, and a "
        "peak near 0 a Stribeck effect. Over the position, a distance of both medians is friction "
        "or backlash. A slope or a wave is a cable, a spring, gravity or cogging. A few distant "
        "points are not drawn."
    )
    if is_explained:
        # Smoothed motions lag behind joints that answer faster than they are sampled.
        note += " Here the model explains the recordings: these are errors of the smoothed motion."
    note += share_note(shown, found, "joints, those with the largest residuals over the noise")
    heights = [1.75] * len(shown)
    return Picture(
        title=title, panels=in_grid(panels, 2), note=note, heights=heights, widths=[1.0, 1.0]
    )


def _over_noise(each: ResidualForce) -> str:
    if not each.sigma > 0.0:
        return ""
    return f", {format_number(each.noise_ratio, 2)} times the noise"


def _force_panel(each: ResidualForce, along: Array, label: str, title: str) -> Panel:
    """Return the residual forces of a joint over a quantity, with medians by direction."""
    low, high = np.quantile(each.force, SHOWN_QUANTILES)
    low, high = min(low, -2.0 * each.sigma), max(high, 2.0 * each.sigma)
    margin = MARGIN * (high - low)
    limits = (low - margin, high + margin)
    is_inside = (each.force >= limits[0]) & (each.force <= limits[1])

    band = hspan(-2.0 * each.sigma, 2.0 * each.sigma, opacity=0.8, label="±2σ of the noise")
    marks = [hline(0.0, width=0.8)] + ([band] if each.sigma > 0.0 else [])
    look = {
        "symbol": ".",
        "size": float(np.clip(120.0 / np.sqrt(len(along)), 1.5, 4.0)),
        "opacity": 0.35,
    }
    for sign, colour, words in ((1.0, "series0", "forwards"), (-1.0, "series1", "backwards")):
        moves = np.sign(each.speed) == sign
        shown = moves & is_inside
        points = dots(along[shown], each.force[shown], colour, label=f"moves {words}", **look)
        x, y = each.medians(along, moves)
        marks += [
            points,
            line(x, y, "white", width=4.0, front=3.0),
            line(x, y, colour, width=2.2, front=3.1, label=f"median, {words}"),
        ]
    up = Axis(label=with_unit(shorten(each.joint, 18), each.unit), most=4)
    if margin > 0.0:
        up = replace(up, limits=limits)
    return Panel(title=title, marks=marks, x=Axis(label=label), y=up)


def _with_unit(value: float, unit: str) -> str:
    return f"{format_number(value, 2)} {unit}"
