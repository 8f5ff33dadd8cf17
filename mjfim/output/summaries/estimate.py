"""An estimate in words and tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjfim.errors import listed
from mjfim.output.summaries.accuracy import NOT_ALONE
from mjfim.output.summaries.widths import MAX_COLUMNS, shortened
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
    columns,
)
from mjfim.records.estimate import Estimate, Prediction

# Characters to which file names are shortened in tables of predictions.
PREDICTION_NAME_WIDTH = 40


def describe_estimate(estimate: Estimate) -> Summary:
    """Describe estimates with intervals, the fit of every output, and predictions.

    Args:
        estimate: The estimate.
    """
    parts: list[Part] = [_estimate_table(estimate)]

    # Parameters that differ between recordings: the table shows the first value only.
    for name, values in estimate.per_recording.items():
        if len(values) > 1:
            shown = listed([f"{value:.3g}" for value in values])
            parts.append(Paragraph(text=f"{name} of each recording: {shown}"))

    verdict = (
        "not explained by noise: the formal σ underestimates the errors"
        if estimate.misfit
        else "consistent with noise"
    )
    rms = listed([f"{name} {value:.3g}" for name, value in estimate.residual_rms.items()])
    parts.append(
        Paragraph(
            text=(
                f"residuals: χ²/dof = {estimate.chi2 / estimate.dof:.3f} with {estimate.dof:,} "
                f"degrees of freedom, {verdict}; rms: {rms}"
            )
        )
    )
    parts.append(_residual_table(estimate))
    parts.append(Paragraph(text=f"{estimate.iterations} iterations, {estimate.seconds:.1f} s"))
    if estimate.restart is not None:
        parts.append(Paragraph(text=str(estimate.restart)))
    if estimate.predictions:
        parts.append(_prediction_table(estimate.predictions))
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
    return Summary(
        title="Estimated parameters",
        outcome=estimate.status,
        parts=tuple(parts),
        warnings=estimate.warnings,
    )


def _estimate_table(estimate: Estimate) -> SummaryTable:
    """Tabulate estimates, standard deviations and intervals."""
    rows = []
    for j, name in enumerate(estimate.parameters):
        low, high = estimate.interval[j]
        uncertainty: tuple[Cell, ...] = (NOT_ALONE, "-", "-")
        if np.isfinite(estimate.std[j]):
            uncertainty = (
                Quantity(value=float(estimate.std[j]), digits=2),
                Quantity(value=float(0.25 * (high - low)), digits=2),
                f"{low:.5g} … {high:.5g}",
            )
        cells = (
            Name(name=name, unit=estimate.units[j]),
            Quantity(value=float(estimate.initial_theta[j]), digits=5),
            Quantity(value=float(estimate.theta[j]), digits=5),
            *uncertainty,
            "yes" if name in estimate.at_bound else "",
        )
        rows.append(Row(cells=cells))

    headings = ["parameter", "guess", "estimate", "formal σ", "honest σ", "95 % interval"]
    if estimate.at_bound:
        headings.append("at bound")
    else:
        rows = [Row(cells=row.cells[:-1]) for row in rows]
    return SummaryTable(
        key="estimates",
        title="Estimates",
        columns=columns(*headings),
        rows=tuple(rows),
    )


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


def _prediction_table(predictions: Sequence[Prediction]) -> SummaryTable:
    """Tabulate prediction errors of the identified and of the nominal model.

    At most `MAX_COLUMNS` outputs are shown.
    """
    outputs = predictions[0].identified.outputs
    measured = [
        j
        for j in range(len(outputs))
        if any(np.isfinite(prediction.identified.rms[j]) for prediction in predictions)
    ]
    shown = measured[:MAX_COLUMNS]

    rows = []
    for prediction in predictions:
        mark = "" if prediction.held_out else " *"
        errors = [
            f"{prediction.identified.rms[j]:.3g} / {prediction.nominal.rms[j]:.3g}" for j in shown
        ]
        better = prediction.ratio < 1.0
        rows.append(
            Row(
                cells=(
                    shortened(prediction.name, PREDICTION_NAME_WIDTH) + mark,
                    *errors,
                    f"{prediction.ratio:.2f}",
                ),
                emphasis=Emphasis.NORMAL if better else Emphasis.WARNING,
            )
        )

    held_out = all(prediction.held_out for prediction in predictions)
    return SummaryTable(
        key="predictions",
        title=(
            "Prediction of recordings that were not fitted: rms error of the identified / of the "
            "nominal model"
        ),
        columns=columns("recording", *(outputs[j] for j in shown), "ratio"),
        rows=tuple(rows),
        note=""
        if held_out
        else "* predicted by a fit to the other recordings, but part of the final fit; "
        "--held-out keeps a recording out of the final fit",
    )
