"""The report of an estimate."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import PurePath

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import first_ones
from mjfim.model.coordinates import split_unit
from mjfim.output.labels import complete_labels
from mjfim.output.report.correlations import correlation_of_covariance
from mjfim.output.report.curves import (
    axis,
    band,
    correlation_panel,
    curve,
    dots,
    error_bars,
    level,
    log_axis,
    row_axis,
    rows_height,
    rows_of_bars,
    thinned,
)
from mjfim.output.report.horizons import horizons_section
from mjfim.output.report.inverse_dynamics import inverse_dynamics_section
from mjfim.output.report.page import Key, Page, Panel, PlotGroup, Plotly, Section
from mjfim.output.report.recording_comparison import recordings_section
from mjfim.output.report.residual_curves import Residuals
from mjfim.output.report.samples import samples_section
from mjfim.output.report.selection import selection_section
from mjfim.output.summaries.estimate import FITTED_MARK, FITTED_NOTE, describe_estimate
from mjfim.output.summaries.horizons import describe_horizons
from mjfim.output.summaries.recording_comparison import describe_recordings
from mjfim.output.summaries.samples import describe_samples
from mjfim.output.summaries.selection import describe_selection
from mjfim.output.summaries.verdicts import next_steps, verdict_of
from mjfim.output.summary_parts import Listing, Part, Quantity, Summary
from mjfim.output.vocabulary import IDENTIFIED, MEASURED, NOMINAL
from mjfim.records.estimate import Estimate, Prediction
from mjfim.records.labels import Labels, with_unit
from mjfim.records.trajectory import Recording

# Largest number of outputs that are drawn; of more, those whose residuals over sigma are largest.
MAX_OUTPUTS = 12

# Largest number of recordings whose signals are drawn.
MAX_RECORDINGS = 8

# Largest number of predicted recordings with a plot each; of more, there is a plot for each output.
MAX_PREDICTION_PLOTS = 3

# Name of the identified parameters in the legend.
WITH_INTERVAL = f"{IDENTIFIED.word}, 95 % interval"

# Ratio of the largest to the smallest prediction error above which their axis is logarithmic.
MOST_LINEAR = 20.0

# Decades of a logarithmic axis of prediction errors before the smallest and behind the largest one.
NOISE_ROOM = (0.5, 0.05)

# Number of residuals above which a plot holds fewer of them; a page shows still fewer.
MAX_RESIDUALS = 100_000

# Largest number of segments whose beginnings are drawn as lines.
MAX_SEGMENTS = 20

# Entries of the legend of tests of the residuals.
RESIDUAL_KEYS = (Key(name="residual", role=MEASURED.word), Key(name="95 %", role="band"))


def estimate_page(estimate: Estimate) -> Page:
    """Return the report of an estimate.

    Args:
        estimate: The estimate.
    """
    labels = complete_labels(estimate)
    summary = describe_estimate(estimate)
    columns = _shown_outputs(estimate)

    sections = [Section(title="Parameters", parts=list(_parameter_parts(estimate, summary)))]
    if estimate.selection is not None:
        sections.append(selection_section(estimate.selection))
    if estimate.horizons is not None:
        sections.append(horizons_section(estimate.horizons))
    if estimate.inverse_dynamics is not None:
        sections.append(inverse_dynamics_section(estimate.inverse_dynamics))
    if estimate.recording_comparison is not None:
        sections.append(recordings_section(estimate))
    if estimate.draws is not None:
        sections.append(samples_section(estimate))
    if estimate.predictions:
        found: list[Part | PlotGroup] = [summary.table("predictions")]
        found += [summary.table("prediction details"), _prediction_plots(estimate, labels)]
        found += _held_out_plots(estimate, labels, columns)
        sections.append(Section(title="Predictions", parts=found))
    if len(columns):
        fit = list(_fit_plots(estimate, labels, columns))
        sections.append(Section(title="Signals", parts=fit))
        tests = list(_residual_plots(estimate, labels, columns))
        sections.append(Section(title="Residuals", parts=[summary.table("residuals"), *tests]))
    trace = _trace_plots(estimate)
    if trace is not None:
        sections.append(Section(title="Search", parts=[trace]))
    if estimate.missing_terms:
        sections.append(Section(title="Missing terms", parts=[_missing_terms(estimate)]))

    names = [PurePath(recording.name).name for recording in estimate.recordings]
    facts = {
        "recordings": str(len(names)),
        "χ²/dof": f"{estimate.chi2 / max(estimate.dof, 1):.3f}",
        "degrees of freedom": f"{estimate.dof:,}",
        "iterations": str(estimate.iterations),
        "time of the fit": f"{estimate.seconds:.3g} s",
    }
    return Page(
        kind="Identification from recordings",
        verdict=verdict_of(estimate),
        next_steps=next_steps(estimate),
        warnings=estimate.warnings,
        facts=facts,
        sections=sections,
    )


# ---- parameters


def _parameter_parts(estimate: Estimate, summary: Summary) -> Iterator[Part | PlotGroup]:
    """Yield the table of the estimates, their plots, and the sentences of the summary."""
    elsewhere = {"predictions", "prediction details", "residuals", "equations"}
    table = summary.table("estimates")
    yield table

    names = list(estimate.parameters)
    shares = np.flatnonzero(estimate.guess_sizes > 0.0).tolist()
    panels = [_interval_panel(estimate, shares)] if shares else []
    correlation = correlation_of_covariance(estimate.covariance)
    if len(names) > 1 and np.isfinite(correlation).any():
        panels.append(correlation_panel(correlation, names, "correlation of the estimates [–]"))
    keys = [
        Key(name=NOMINAL.word, role=NOMINAL.word),
        Key(name=WITH_INTERVAL, role=IDENTIFIED.word),
    ]
    note = (
        "The interval allows for residuals that are not white noise and for recordings that "
        "disagree. The difference of an entry of a vector or tensor is a share of the magnitude of "
        "the whole."
    )
    absent = [name for j, name in enumerate(names) if j not in shares]
    if absent:
        note += f" Nominal values of 0 have no relative difference: {first_ones(absent)}."
    if panels:
        yield PlotGroup(title="", panels=panels, keys=keys if shares else (), note=note)
    in_own_section = [*describe_recordings(estimate), *describe_samples(estimate)]
    if estimate.selection is not None:
        in_own_section += describe_selection(estimate.selection)
    if estimate.horizons is not None:
        in_own_section += describe_horizons(estimate.horizons)
    for part in summary.parts:
        if part in in_own_section:
            continue
        if part is not table and getattr(part, "key", "") not in elsewhere:
            yield part


def _interval_panel(estimate: Estimate, shown: Sequence[int]) -> Panel:
    """Return the plot of estimates with their intervals, relative to sizes beside 0."""
    chosen = list(shown)
    guess, percent = estimate.initial_theta[chosen], estimate.guess_sizes[chosen] / 100.0
    centre = (estimate.theta[chosen] - guess) / percent
    low, high = (estimate.interval[chosen].T - guess) / percent
    rows = np.arange(len(chosen), dtype=np.float64)
    known = np.isfinite(estimate.std[chosen])

    texts = []
    for row, j in enumerate(chosen):
        left, right = estimate.interval[j]
        value = Quantity(value=float(estimate.theta[j]), digits=5)
        text = f"{estimate.parameters[j]}: {value} {estimate.units[j]}"
        texts.append(f"{text} (95 %: {left:.4g} to {right:.4g})" if known[row] else text)

    estimates = dots(centre, rows, WITH_INTERVAL, IDENTIFIED.word, size=9, texts=texts)
    above, below = (np.where(known, reach, np.nan) for reach in (high - centre, centre - low))
    estimates["error_x"] = error_bars(IDENTIFIED.word, above, below, width=6)
    zero = dots(
        np.zeros(len(rows)), rows, NOMINAL.word, NOMINAL.word, size=12, symbol="line-ns-open"
    )
    zero["hoverinfo"] = "skip"
    return Panel(
        title="difference from the nominal value, with 95 % interval [%]",
        traces=[zero, estimates],
        layout={
            "xaxis": axis("difference from the nominal value [%]"),
            "yaxis": row_axis([estimate.parameters[j] for j in chosen]),
            "shapes": [level(0.0, NOMINAL.word, across="y", dash="solid", layer="below")],
            "hovermode": "closest",
        },
        height=rows_height(len(chosen), 44),
    )


# ---- predictions


def _prediction_plots(estimate: Estimate, labels: Labels) -> PlotGroup:
    """Return a plot of the prediction errors for every output."""
    found = estimate.predictions
    outputs = found[0].identified.outputs
    known = [
        j
        for j in range(len(outputs))
        if any(np.isfinite(prediction.identified.rms[j]) for prediction in found)
    ]
    over_noise = len(found) <= MAX_PREDICTION_PLOTS and all(
        estimate.sigma.get(outputs[j], 0.0) > 0.0 for j in known
    )
    if over_noise:
        panels = [_noise_panel(estimate, prediction, known, labels) for prediction in found]
    else:
        panels = [_prediction_panel(found, j, labels.output(outputs[j])) for j in known]

    keys = [
        Key(name=NOMINAL.word, role=NOMINAL.word, shape="bar"),
        Key(name=IDENTIFIED.word, role=IDENTIFIED.word, shape="bar"),
    ]
    notes = ["Of a predicted recording, only the initial state is estimated."]
    if over_noise:
        notes.append("Dashed line: the noise that the fit assumes.")
    if not all(prediction.held_out for prediction in found):
        notes.append(f"{FITTED_NOTE}.")
    return PlotGroup(
        title="Errors on recordings that were not fitted",
        panels=panels[:MAX_OUTPUTS],
        keys=keys,
        note=" ".join(notes),
    )


def _noise_panel(
    estimate: Estimate, prediction: Prediction, columns: Sequence[int], labels: Labels
) -> Panel:
    """Return the plot of the errors of all outputs in one recording, relative to the noise."""
    outputs = prediction.identified.outputs
    sigma = np.array([estimate.sigma[outputs[j]] for j in columns])
    names, units = zip(*(split_unit(labels.output(outputs[j])) for j in columns), strict=True)
    traces, shares = [], np.ones(1)
    for term, errors in ((NOMINAL, prediction.nominal), (IDENTIFIED, prediction.identified)):
        rms = errors.rms[list(columns)]
        texts = [
            f"{Quantity(value=float(error))} {unit}".rstrip()
            for error, unit in zip(rms, units, strict=True)
        ]
        # The line of the noise would cross texts beside the bars; they are seen at the pointer.
        bars = rows_of_bars(rms / sigma, term.word, term.word, texts=texts, outside=False)
        traces.append(bars)
        shares = np.append(shares, rms / sigma)

    # A nominal model far away would hide the errors of the identified one on a linear axis.
    title, known = "rms error / σ of the noise [–]", shares[np.isfinite(shares) & (shares > 0.0)]
    horizontal = axis(title, range=[0.0, 1.05 * float(known.max())])
    if known.max() > MOST_LINEAR * known.min():
        horizontal = log_axis(title, known, room=NOISE_ROOM)
    return Panel(
        title=f"{_prediction_name(prediction)}: rms error of the prediction / σ of the noise [–]",
        traces=traces,
        layout={
            "xaxis": horizontal,
            "yaxis": row_axis(names),
            "shapes": [level(1.0, "text", across="y")],
            "bargap": 0.25,
        },
        height=rows_height(len(names), 40),
    )


def _prediction_name(prediction: Prediction) -> str:
    """Return the name of a predicted recording, with a mark where it is part of the last fit."""
    return PurePath(prediction.name).name + ("" if prediction.held_out else FITTED_MARK)


def _prediction_panel(found: Sequence[Prediction], j: int, label: str) -> Panel:
    """Return the plot of the errors of output j in every recording."""
    name, unit = split_unit(label)
    traces = []
    for term in (NOMINAL, IDENTIFIED):
        of_term = [p.identified if term is IDENTIFIED else p.nominal for p in found]
        errors = np.array([errors.rms[j] for errors in of_term])
        texts = [str(Quantity(value=float(error))) for error in errors]
        traces.append(rows_of_bars(errors, term.word, term.word, texts=texts))
    names = [_prediction_name(prediction) for prediction in found]
    return Panel(
        title=f"{name}: rms error of the prediction [{unit or '–'}]",
        traces=traces,
        layout={
            "xaxis": axis(f"rms error [{unit or '–'}]"),
            "yaxis": row_axis(names),
            "margin": {"r": 50},
        },
        height=rows_height(len(names), 44),
    )


def _held_out_plots(
    estimate: Estimate, labels: Labels, columns: Sequence[int]
) -> Iterator[PlotGroup]:
    """Yield measured, identified and nominal signals of the held-out recordings."""
    shown = [p for p in estimate.predictions if p.recording is not None][:MAX_RECORDINGS]
    for k, prediction in enumerate(shown):
        recording = prediction.recording
        if recording is None or len(prediction.identified_outputs) != len(recording.t):
            continue
        signals = _Signals(
            recording=recording,
            identified=prediction.identified_outputs,
            nominal=prediction.nominal_outputs,
        )
        name = PurePath(prediction.name).name
        panels = [
            _signal_panel(signals, j, labels, f"held out {k}")
            for j in columns
            if j < len(recording.outputs)
        ]
        yield PlotGroup(
            title=f"Prediction of {name}, which was not fitted",
            panels=panels,
            keys=_signal_keys(signals),
            folded=k > 0,
        )


# ---- signals


@dataclass(frozen=True, eq=False, kw_only=True)
class _Signals:
    """Measured and simulated outputs of one recording.

    Attributes:
        recording: The recording.
        identified: (M, ny) outputs of the identified model [unit of the output].
        nominal: (M, ny) outputs of the nominal model; empty where they are not known.
        begins: Times at which segments begin, which the fit joins [s].
    """

    recording: Recording
    identified: Array
    nominal: Array
    begins: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def has_nominal(self) -> bool:
        """True where the outputs of the nominal model are known."""
        return len(self.nominal) == len(self.recording.t)


def _signal_keys(signals: _Signals) -> list[Key]:
    """Return the entries of the legend of measured and simulated signals."""
    keys = [
        Key(name=MEASURED.word, role=MEASURED.word, shape="dot"),
        Key(name=IDENTIFIED.word, role=IDENTIFIED.word),
    ]
    if signals.has_nominal:
        keys.append(Key(name=NOMINAL.word, role=NOMINAL.word))
    return keys


def _signal_panel(signals: _Signals, j: int, labels: Labels, linked: str) -> Panel:
    """Return the plot of one output of a recording; the nominal model lies at the back."""
    t, recording = signals.recording.t, signals.recording
    traces = []
    if signals.has_nominal:
        values = signals.nominal[:, j]
        traces.append(curve(t, values, NOMINAL.word, NOMINAL.word, width=1.1))
    traces += [
        _measured_dots(t, recording.y[:, j]),
        curve(t, signals.identified[:, j], IDENTIFIED.word, IDENTIFIED.word),
    ]

    # With many segments, lines would hide the curves.
    begins = signals.begins[1:] if len(signals.begins) <= MAX_SEGMENTS else ()
    shapes = [level(float(begin), "muted", across="y", dash="dot") for begin in begins]
    layout = {"xaxis": axis("time [s]"), "shapes": shapes, **_vertical_range(signals, j)}
    title = labels.output(recording.outputs[j])
    return Panel(title=title, traces=traces, layout=layout, linked=linked)


def _shown_outputs(estimate: Estimate) -> list[int]:
    """Return the numbers of the outputs to draw: of many, those with the largest residuals."""
    sizes: dict[int, float] = {}
    for j, (name, rms) in enumerate(estimate.residual_rms.items()):
        # An output that was not measured has no residuals.
        if np.isfinite(rms):
            sigma = estimate.sigma.get(name, 1.0)
            sizes[j] = rms / max(sigma, np.finfo(float).tiny)

    largest_first = sorted(sizes, key=lambda j: -sizes[j])
    return sorted(largest_first[:MAX_OUTPUTS])


def _vertical_range(signals: _Signals, j: int) -> Plotly:
    """Return the axis of one output where a nominal model far away would flatten the others."""
    if not signals.has_nominal:
        return {}

    near = np.concatenate([signals.recording.y[:, j], signals.identified[:, j]])
    near, far = near[np.isfinite(near)], signals.nominal[:, j]
    if not near.size or not np.isfinite(far).any():
        return {}

    low, high = float(near.min()), float(near.max())
    room = 0.5 * (high - low)
    if np.nanmin(far) >= low - room and np.nanmax(far) <= high + room:
        return {}
    return {"yaxis": axis(range=[low - room, high + room])}


def _fit_plots(estimate: Estimate, labels: Labels, columns: Sequence[int]) -> Iterator[PlotGroup]:
    """Yield the measured and the identified signals of every recording, and their residuals."""
    shown = estimate.recordings[:MAX_RECORDINGS]
    outputs = estimate.recordings[0].outputs
    nominal, segments = estimate.nominal, estimate.segments
    for i, recording in enumerate(shown):
        signals = _Signals(
            recording=recording,
            identified=estimate.predicted[i],
            nominal=nominal[i] if i < len(nominal) else np.zeros((0, 0)),
            begins=segments[i] if i < len(segments) else np.zeros(0),
        )
        panels, residuals = [], []
        for j in columns:
            panels.append(_signal_panel(signals, j, labels, f"time {i}"))
            residual = recording.y[:, j] - estimate.predicted[i][:, j]
            sigma = estimate.sigma.get(outputs[j], float("nan"))
            label = labels.output(outputs[j])
            residuals.append(_residual_panel(recording.t, residual, sigma, label, i))

        name = PurePath(recording.name).name
        yield PlotGroup(
            title=f"Fit to {name}",
            panels=panels,
            keys=_signal_keys(signals),
            note=_signal_note(estimate, len(columns), signals),
            folded=i > 0,
        )
        yield PlotGroup(
            title=f"Residuals of {name} over time",
            panels=residuals,
            note="Residual: measured − identified; the band is ± 2 σ of the noise.",
            folded=True,
        )


def _measured_dots(t: Array, values: Array) -> Plotly:
    """Return the measured values of one output as small dots."""
    return dots(t, values, MEASURED.word, MEASURED.word, size=3.0)


def _signal_note(estimate: Estimate, drawn: int, signals: _Signals) -> str:
    """Explain dotted lines, and name what the plots leave out."""
    parts = []
    if 1 < len(signals.begins) <= MAX_SEGMENTS:
        parts.append("Dotted lines: segments of the fit, each with an initial state of its own.")
    if estimate.reason_without_nominal:
        parts.append(estimate.reason_without_nominal)
    outputs = len(estimate.recordings[0].outputs)
    if drawn < outputs:
        parts.append(
            f"{drawn} of {outputs} outputs are drawn, those with the largest residuals over σ."
        )
    if len(estimate.recordings) > MAX_RECORDINGS:
        parts.append(
            f"The first {MAX_RECORDINGS} of {len(estimate.recordings)} recordings are drawn."
        )
    return " ".join(parts)


def _residual_panel(t: Array, residual: Array, sigma: float, label: str, i: int) -> Panel:
    """Return the plot of the residuals of one output in one recording over time."""
    name, unit = split_unit(label)
    known = residual[np.isfinite(residual)]
    outside = 100.0 * float(np.mean(np.abs(known) > 2.0 * sigma)) if known.size else float("nan")

    # The page shows fewer points than that, so that memory need not hold all of them.
    kept = thinned(residual, MAX_RESIDUALS)
    return Panel(
        title=f"{name}: residual [{unit or '–'}]",
        traces=[dots(t[kept], residual[kept], "residual", MEASURED.word)],
        layout={"xaxis": axis("time [s]"), "shapes": [band(-2.0 * sigma, 2.0 * sigma)]},
        remark=f"{outside:.1f} % outside ± 2 σ (noise: 4.6 %)",
        linked=f"time {i}",
    )


# ---- tests of the residuals


def _residual_plots(
    estimate: Estimate, labels: Labels, columns: Sequence[int]
) -> Iterator[PlotGroup]:
    """Yield autocorrelations and spectra of the residuals."""
    autocorrelations, spectra = [], []
    for j in columns:
        residuals = Residuals.of(estimate, j)
        if not residuals.parts:
            continue
        name, _ = split_unit(labels.output(estimate.recordings[0].outputs[j]))
        autocorrelations.append(_autocorrelation_panel(estimate, residuals, j, name))
        spectra.append(_spectrum_panel(residuals, name))

    if autocorrelations:
        yield PlotGroup(
            title="Autocorrelation of the residuals",
            panels=autocorrelations,
            keys=RESIDUAL_KEYS,
            note=(
                "White noise stays in the band for 95 % of the lags. Slowly falling values mean "
                "that the model lacks an effect."
            ),
        )
        yield PlotGroup(
            title="Spectrum of the residuals",
            panels=spectra,
            keys=RESIDUAL_KEYS,
            note=(
                "Power relative to white noise of the assumed σ, which is 1 at all frequencies. "
                "Power above the band at low frequencies: the model lacks a slow effect. Rows "
                "count as evenly spaced."
            ),
        )


def _autocorrelation_panel(estimate: Estimate, residuals: Residuals, j: int, name: str) -> Panel:
    """Return the plot of the autocorrelation of one output."""
    lags, values, bound = residuals.autocorrelation()
    trace: Plotly = curve(lags, values, "residual", MEASURED.word)
    remark = ""
    if j < len(estimate.whiteness):
        p = estimate.whiteness[j].p
        remark = f"p(white) {'below 10⁻⁶' if p < 1e-6 else format(p, '.2g')}"
    reach = 1.1 * max(float(np.abs(values).max(initial=0.0)), 2.0 * bound)
    return Panel(
        title=f"{name}: autocorrelation [–]",
        traces=[trace],
        layout={
            "xaxis": axis("lag [rows]"),
            "yaxis": axis(range=[-reach, reach]),
            "shapes": [band(-bound, bound), level(0.0, "muted", dash="solid", layer="below")],
        },
        remark=remark,
        linked="lag",
    )


def _spectrum_panel(residuals: Residuals, name: str) -> Panel:
    """Return the plot of the spectrum of one output."""
    frequencies, power, (low, high) = residuals.spectrum()
    trace = curve(frequencies, np.where(power > 0.0, power, np.nan), "residual", MEASURED.word)
    return Panel(
        title=f"{name}: power / white noise [–]",
        traces=[trace],
        layout={
            "xaxis": log_axis("frequency [Hz]", frequencies),
            "yaxis": log_axis("", np.append(power, [low, high]), room=(0.1, 0.1)),
            "shapes": [band(low, high), level(1.0, "muted", dash="solid", layer="below")],
        },
        linked="frequency",
    )


# ---- search


def _trace_plots(estimate: Estimate) -> PlotGroup | None:
    """Return the parameters over the iterations of the fit; None where they are not known."""
    trace = estimate.trace
    if len(trace) < 2:
        return None

    iterations = np.arange(float(len(trace)))
    panels = []
    for j, name in enumerate(estimate.parameters[:MAX_OUTPUTS]):
        line = curve(iterations, trace[:, j], IDENTIFIED.word, IDENTIFIED.word)
        line["mode"] = "lines+markers"
        line["marker"] = {"size": 4, "color": f"role:{IDENTIFIED.word}"}
        guess = float(estimate.initial_theta[j])
        panels.append(
            Panel(
                title=with_unit(name, estimate.units[j]),
                traces=[line],
                layout={
                    "xaxis": axis("iteration [–]"),
                    "shapes": [level(guess, NOMINAL.word)],
                },
                remark=f"{Quantity(value=guess)} → {Quantity(value=float(estimate.theta[j]))}",
                linked="iteration",
            )
        )
    keys = [Key(name=IDENTIFIED.word, role=IDENTIFIED.word)]
    note = "The dashed line is the nominal value."
    if len(estimate.parameters) > MAX_OUTPUTS:
        note += f" The first {MAX_OUTPUTS} of {len(estimate.parameters)} parameters are drawn."
    return PlotGroup(
        title="Parameters over the iterations of the fit", panels=panels, keys=keys, note=note
    )


# ---- missing terms


def _missing_terms(estimate: Estimate) -> Listing:
    """Return the terms that the model may lack."""
    items = tuple(str(term) for term in estimate.missing_terms)
    tested = estimate.tested_data
    data = "" if tested is None or tested.is_complete else f" ({tested.amount})"
    return Listing(title=f"Terms that would explain a part of the residuals{data}", items=items)
