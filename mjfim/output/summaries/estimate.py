"""An estimate in words and tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjfim.errors import listed
from mjfim.output.summaries.accuracy import NOT_ALONE
from mjfim.output.summaries.horizons import describe_horizons
from mjfim.output.summaries.inverse_dynamics import equation_parts
from mjfim.output.summaries.recording_comparison import describe_recordings
from mjfim.output.summaries.samples import describe_samples
from mjfim.output.summaries.selection import describe_selection
from mjfim.output.summary_parts import (
    Cell,
    Emphasis,
    Name,
    Paragraph,
    Part,
    Quantity,
    Row,
    Summary,
    SummaryTable,
    capitalised,
    columns,
)
from mjfim.output.vocabulary import IDENTIFIED, NOMINAL
from mjfim.records.estimate import Estimate, Prediction

# Largest number of digits of an estimate.
MAX_DIGITS = 9

# Heading of the standard deviation that is right if the model and the noise are.
FORMAL = "formal σ"

# Heading of the standard deviation that allows for residuals that are not white.
HONEST = "honest σ"

# Heading of the column that marks estimates at a bound.
AT_BOUND = "at bound"

# Mark of recordings that are part of the last fit, and its meaning.
FITTED_MARK = " *"
FITTED_NOTE = (
    "* predicted by a fit to the other recordings, but part of the last fit; --held-out keeps a "
    "recording out of it"
)


def describe_estimate(estimate: Estimate) -> Summary:
    """Describe estimates with intervals, the fit of every output, and predictions.

    Args:
        estimate: The estimate.
    """
    fit = Paragraph(text=capitalised(_fit_sentence(estimate)))
    parts: list[Part] = [_estimate_table(estimate), fit, *_payload_parts(estimate)]
    remarks = (estimate.restart, estimate.prior_directions)
    parts += [Paragraph(text=str(remark)) for remark in remarks if remark is not None]
    if estimate.selection is not None:
        parts += describe_selection(estimate.selection)
    if estimate.horizons is not None:
        parts += describe_horizons(estimate.horizons)
    if estimate.inverse_dynamics is not None:
        parts += equation_parts(estimate.inverse_dynamics)
    if estimate.tested_data is not None and not estimate.tested_data.is_complete:
        parts.append(Paragraph(text=str(estimate.tested_data)))
    parts += describe_recordings(estimate)
    parts += describe_samples(estimate)
    if estimate.predictions:
        parts.append(Paragraph(text=_prediction_sentence(estimate.predictions)))
    parts.append(
        Paragraph(
            text=(
                "The formal σ is the true accuracy only if the model and the noise are right. The "
                "honest σ is a quarter of the width of the 95 % interval, which allows for "
                "residuals that are not white noise and for recordings that disagree, but not "
                "for the bias of a wrong model."
            ),
            emphasis=Emphasis.WEAK,
        )
    )

    for law in estimate.controllers:
        parts.append(Paragraph(text=str(law)))
        parts.append(Paragraph(text=f"In the experiment file: {law.toml}", detail=True))

    # Parameters that differ between recordings: the table shows the first value only.
    for name, values in estimate.per_recording.items():
        if len(values) > 1:
            shown = listed([f"{value:.3g}" for value in values])
            parts.append(Paragraph(text=f"{name} of each recording: {shown}", detail=True))

    parts.append(_residual_table(estimate))
    if estimate.predictions:
        parts.append(_prediction_table(estimate.predictions))
        parts.append(_prediction_details(estimate.predictions))
    count = estimate.iterations
    iterations = "1 iteration" if count == 1 else f"{count} iterations"
    parts.append(Paragraph(text=f"{iterations}, {estimate.seconds:.1f} s", detail=True))
    return Summary(
        title="Estimated parameters",
        outcome=estimate.status,
        parts=tuple(parts),
        warnings=estimate.warnings,
    )


def _payload_parts(estimate: Estimate) -> list[Part]:
    """Sentences about a payload that was looked for, beside those of the verdict."""
    payload = estimate.payload
    return [] if payload is None else [Paragraph(text=text) for text in payload.sentences]


def _fit_sentence(estimate: Estimate) -> str:
    """Return whether the residuals are those of the stated noise."""
    verdict = (
        "not explained by noise: the formal σ underestimates the errors"
        if estimate.misfit
        else "consistent with noise"
    )
    return f"residuals {verdict} (χ²/dof = {estimate.chi2 / estimate.dof:.3f})"


def _estimate_table(estimate: Estimate) -> SummaryTable:
    """Tabulate estimates, standard deviations and intervals."""
    rows = []
    for j, name in enumerate(estimate.parameters):
        low, high = estimate.interval[j]
        uncertainty: tuple[Cell, ...] = (NOT_ALONE, "-", "-", "-")
        if name in estimate.held:
            uncertainty = ("held", "-", "-", "-")
        elif np.isfinite(estimate.std[j]):
            uncertainty = (
                Quantity(value=float(estimate.std[j]), digits=2),
                Quantity(value=float(0.25 * (high - low)), digits=2),
                _as_accurate(low, estimate.std[j]),
                _as_accurate(high, estimate.std[j]),
            )
        cells = (
            Name(name=name, unit=estimate.units[j]),
            Quantity(value=float(estimate.initial_theta[j]), digits=4),
            _as_accurate(estimate.theta[j], estimate.std[j]),
            *uncertainty,
            "yes" if name in estimate.at_bound else "",
        )
        emphasis = Emphasis.WARNING if name in estimate.at_bound else Emphasis.NORMAL
        rows.append(Row(cells=cells, emphasis=emphasis))

    headings = ["parameter", NOMINAL.word, IDENTIFIED.word, FORMAL, HONEST, "95 % low", "high"]
    if estimate.at_bound:
        headings.append(AT_BOUND)
    else:
        rows = [Row(cells=row.cells[:-1]) for row in rows]
    return SummaryTable(
        key="estimates",
        title="Estimates with their 95 % intervals",
        columns=columns(*headings, details=[FORMAL, AT_BOUND], optional=[NOMINAL.word, HONEST]),
        rows=tuple(rows),
    )


def _as_accurate(value: float, std: float) -> Quantity:
    """Return a value with as many digits as its standard deviation justifies, and one more."""
    if not (np.isfinite(std) and std > 0.0 and value):
        return Quantity(value=float(value), digits=5)

    places = np.floor(np.log10(abs(value))) - np.floor(np.log10(std))
    return Quantity(value=float(value), digits=int(np.clip(places + 2, 2, MAX_DIGITS)))


def _residual_table(estimate: Estimate) -> SummaryTable:
    """Tabulate the residuals of every output."""
    rows = tuple(
        Row(cells=(name, Quantity(value=value))) for name, value in estimate.residual_rms.items()
    )
    return SummaryTable(
        key="residuals",
        title="Fit of every output",
        columns=columns("output", "residual rms"),
        rows=rows,
        detail=True,
    )


def _prediction_sentence(predictions: Sequence[Prediction]) -> str:
    """Return how much better than the nominal model the identified model predicts."""
    ratios = [prediction.ratio for prediction in predictions if np.isfinite(prediction.ratio)]
    if not ratios:
        return "No prediction of data that were not fitted could be compared"

    low, high = f"{100.0 * min(ratios):.3g} %", f"{100.0 * max(ratios):.3g} %"
    share = low if low == high else f"{low} to {high}"
    return f"Prediction of data that were not fitted: the error is {share} of the nominal model's"


def _prediction_table(predictions: Sequence[Prediction]) -> SummaryTable:
    """Tabulate how much better than the nominal model the identified model predicts."""
    rows = tuple(
        Row(
            cells=(_marked(prediction), Quantity(value=prediction.ratio, digits=2)),
            emphasis=_prediction_emphasis(prediction),
        )
        for prediction in predictions
    )
    return SummaryTable(
        key="predictions",
        title="Prediction of recordings that were not fitted: rms error, identified / nominal",
        columns=columns("recording", "ratio"),
        rows=rows,
        note=_prediction_note(predictions),
        detail=True,
    )


def _prediction_details(predictions: Sequence[Prediction]) -> SummaryTable:
    """Tabulate the prediction errors of both models, output by output."""
    rows = []
    for prediction in predictions:
        identified, nominal = prediction.identified, prediction.nominal
        for j, output in enumerate(identified.outputs):
            if not np.isfinite(identified.rms[j]):
                continue
            # Logs of a simulation without noise may be predicted without any error.
            ratio = identified.rms[j] / nominal.rms[j] if nominal.rms[j] > 0.0 else np.nan
            errors = (identified.rms[j], nominal.rms[j], ratio)
            quantities = (Quantity(value=float(error)) for error in errors)
            rows.append(Row(cells=(_marked(prediction), output, *quantities)))

    return SummaryTable(
        key="prediction details",
        title="Prediction errors of every output: root mean square [unit of the output]",
        columns=columns(
            "recording", "output", IDENTIFIED.word, NOMINAL.word, "ratio", left=["output"]
        ),
        rows=tuple(rows),
        note=_prediction_note(predictions),
        detail=True,
    )


def _marked(prediction: Prediction) -> str:
    """Return the name of a recording, with a mark if it is part of the last fit."""
    return prediction.name + ("" if prediction.held_out else FITTED_MARK)


def _prediction_note(predictions: Sequence[Prediction]) -> str:
    """Return the meaning of the mark; empty where no recording has it."""
    return "" if all(prediction.held_out for prediction in predictions) else FITTED_NOTE


def _prediction_emphasis(prediction: Prediction) -> Emphasis:
    """Return a warning where the identified model predicts no better than the nominal one."""
    return Emphasis.NORMAL if prediction.ratio < 1.0 else Emphasis.WARNING
