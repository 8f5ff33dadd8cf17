"""The page of an estimate; its further studies stand in `estimate_parts`."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from mjfim.errors import first_ones, listed
from mjfim.output.page import (
    Emphasis,
    Level,
    Listing,
    Page,
    Part,
    Plot,
    Section,
    Table,
    Text,
    Verdict,
    capitalised,
    named,
    number,
    numbers,
    tabulated,
    warned,
)
from mjfim.output.pages.accuracy import NOT_ALONE, relative
from mjfim.output.pages.equation import equation_parts
from mjfim.output.pages.estimate_parts import (
    horizon_parts,
    recording_parts,
    sample_parts,
    selection_parts,
)
from mjfim.output.vocabulary import IDENTIFIED, NOMINAL
from mjfim.records.estimate import Estimate, Prediction

# Largest number of digits of an estimate.
MAX_DIGITS = 9

# Largest number of parameters with a table of correlations.
MAX_CORRELATIONS = 12

# Mark of recordings that are part of the last fit, and its meaning.
FITTED_MARK = " *"
FITTED_NOTE = (
    "* predicted by a fit to the other recordings, but part of the last fit; --held-out keeps a "
    "recording out of it"
)

# The meaning of the standard deviations.
ABOUT_STD = (
    "The formal σ is the true accuracy only if the model and the noise are right. The honest σ is "
    "a quarter of the width of the 95 % interval, which allows for residuals that are not white "
    "noise and for recordings that disagree, but not for the bias of a wrong model."
)


def estimate_page(estimate: Estimate) -> Page:
    """Describe estimates with intervals, the fit of every output, and predictions."""
    equation = estimate.inverse_dynamics
    parts: dict[str, Sequence[Part]] = {
        "Parameters": [*_parameter_parts(estimate), *_correlation_tables(estimate)],
        "Added terms": [] if estimate.selection is None else selection_parts(estimate.selection),
        "Length of the segments": horizon_parts(estimate.horizons),
        "Equation of motion": [] if equation is None else list(equation_parts(equation)),
        "Recordings": recording_parts(estimate),
        "Drawn robots": list(sample_parts(estimate)),
        "Predictions": _prediction_parts(estimate.predictions),
        "Signals": [Plot("fit")] if estimate.recordings else [],
        "Residuals": [_residual_table(estimate), Plot("spectra")],
        "Search": [Plot("trace")] if len(estimate.trace) > 1 else [],
        "Missing terms": list(_missing_terms(estimate)),
    }
    return Page(
        kind="Identification from recordings",
        verdict=_verdict(estimate),
        next_steps=tuple(_next_steps(estimate)),
        warnings=estimate.warnings,
        facts={
            "recordings": str(len(estimate.recordings)),
            "χ²/dof": f"{estimate.chi2 / max(estimate.dof, 1):.3f}",
            "degrees of freedom": f"{estimate.dof:,}",
            "iterations": str(estimate.iterations),
            "time of the fit": f"{estimate.seconds:.3g} s",
        },
        sections=[Section(title, found) for title, found in parts.items() if found],
    )


# ---- verdict


def _verdict(estimate: Estimate) -> Verdict:
    """The verdict, with the payload first where one was looked for."""
    fit = _verdict_on_fit(estimate)
    if estimate.payload is None or fit.level is Level.BAD:
        return fit
    return Verdict(f"{estimate.payload}. {fit.text}", fit.level)


def _verdict_on_fit(estimate: Estimate) -> Verdict:
    ratio = float(np.sqrt(estimate.chi2 / max(estimate.dof, 1)))
    if not estimate.success:
        why = estimate.status.removesuffix(".")
        if estimate.combinations:
            why = "the recordings determine some parameters in combination only"
        return Verdict(f"These estimates are not reliable: {why}.", Level.BAD)
    # A search that is stopped early has not tried all that may explain the recordings.
    if estimate.interrupted:
        text = (
            "Interrupted: the estimates are the best ones that were found until then, and the "
            f"residuals are {ratio:.2f} times the noise."
        )
        return Verdict(text, Level.DOUBTFUL)
    model = "The model"
    if estimate.selection is not None and estimate.selection.terms:
        terms = first_ones([term.description for term in estimate.selection.terms])
        model = f"With {terms} added, the model"
    if estimate.misfit:
        text = (
            f"{model} does not explain the recordings: the residuals are {ratio:.2f} times the "
            "noise or are no white noise, so the true errors may exceed the intervals."
        )
        return Verdict(text, Level.DOUBTFUL)
    text = f"{model} explains the recordings: the residuals are {ratio:.2f} times the noise"
    return Verdict(f"{text}{_worst_estimate(estimate)}.", Level.GOOD)


def _worst_estimate(estimate: Estimate) -> str:
    """The parameter whose interval is widest compared with its size, in words."""
    half_widths = 0.5 * (estimate.interval[:, 1] - estimate.interval[:, 0])
    sizes = estimate.sizes
    shares = half_widths / np.where(sizes > 0.0, sizes, np.nan)
    # A share of a value that may be zero says nothing.
    known = np.isfinite(shares) & (shares < 1.0)
    if not known.any():
        return ""
    uncertain = [estimate.parameters[j] for j in np.flatnonzero(~known).tolist()]
    worst = int(np.argmax(np.where(known, shares, -np.inf)))
    share = relative(float(half_widths[worst]), float(sizes[worst]))
    others = f" except {first_ones(uncertain)}, whose interval holds zero," if uncertain else ""
    return (
        f", and every parameter{others} is known to ± {share} or better (95 % interval, widest for "
        f"{estimate.parameters[worst]})"
    )


def _next_steps(estimate: Estimate) -> Iterator[str]:
    for term in estimate.missing_terms[:1]:
        yield (
            f"Add the term that explains most of the residuals, {term.description}: "
            f"`{term.recipe}`."
        )
    if estimate.misfit and estimate.worst_residual is not None:
        yield f"Look where the model fails: {estimate.worst_residual}."
    if estimate.combinations:
        yield "Remove or fix one parameter of each group, give it a prior, or record other motions."
    if estimate.sloppy:
        names = first_ones(estimate.sloppy)
        yield f"Design an experiment that tells more about {names}: `mjfim design EXPERIMENT`."
    if not any(prediction.held_out for prediction in estimate.predictions):
        yield (
            "Keep a recording out of the fit with `--held-out FILE`: a prediction of new data is "
            "the best test of a model."
        )
    if estimate.success and not estimate.misfit:
        yield "Use `identified.xml`, the model with the estimated parameters."


# ---- parameters


def _parameter_parts(estimate: Estimate) -> Iterator[Part]:
    if estimate.status.lower().rstrip(".") not in _verdict(estimate).text.lower():
        yield Text(capitalised(estimate.status))
    yield _estimate_table(estimate)
    yield Plot("parameters")
    noise = "consistent with noise"
    if estimate.misfit:
        noise = "not explained by noise: the formal σ underestimates the errors"
    yield Text(f"Residuals {noise} (χ²/dof = {estimate.chi2 / estimate.dof:.3f})")
    if estimate.payload is not None:
        yield from (Text(sentence) for sentence in estimate.payload.sentences)
    for remark in (estimate.restart, estimate.prior_directions):
        if remark is not None:
            yield Text(str(remark))
    if estimate.tested_data is not None and not estimate.tested_data.is_complete:
        yield Text(str(estimate.tested_data))
    yield Text(ABOUT_STD, Emphasis.WEAK)
    for law in estimate.controllers:
        yield Text(str(law))
        yield Text(f"In the experiment file: {law.toml}", detail=True)
    # Parameters that differ between recordings: the table shows the first value only.
    for name, values in estimate.per_recording.items():
        if len(values) > 1:
            shown = listed([f"{value:.3g}" for value in values])
            yield Text(f"{name} of each recording: {shown}", detail=True)
    iterations = "1 iteration" if estimate.iterations == 1 else f"{estimate.iterations} iterations"
    yield Text(f"{iterations}, {estimate.seconds:.1f} s", detail=True)


def _estimate_table(estimate: Estimate) -> Table:
    """Tabulate estimates, standard deviations and intervals."""
    names, std = estimate.parameters, estimate.std
    low, high = estimate.interval.T
    is_held = [name in estimate.held for name in names]
    known = np.isfinite(std) & ~np.array(is_held)
    formal = [
        "held" if held else number(value, 2, infinite=NOT_ALONE)
        for held, value in zip(is_held, std, strict=True)
    ]
    at_bound = [name in estimate.at_bound for name in names]
    columns = {
        "parameter": list(map(named, names, estimate.units)),
        NOMINAL.word: numbers(estimate.initial_theta, 4),
        IDENTIFIED.word: list(map(_as_accurate, estimate.theta, std)),
        "formal σ": formal,
        "honest σ": numbers(np.where(known, 0.25 * (high - low), np.nan), 2),
        "95 % low": list(map(_as_accurate, np.where(known, low, np.nan), std)),
        "high": list(map(_as_accurate, np.where(known, high, np.nan), std)),
    }
    if any(at_bound):
        columns["at bound"] = ["yes" if is_at_bound else "" for is_at_bound in at_bound]
    return tabulated(
        "Estimates with their 95 % intervals",
        columns,
        warned(at_bound),
        spare=(NOMINAL.word, "honest σ", "at bound", "formal σ"),
    )


def _as_accurate(value: float, std: float) -> str:
    """Write a value with as many digits as its standard deviation justifies, and one more."""
    if not (np.isfinite(std) and std > 0.0 and np.isfinite(value) and value):
        return number(value, 5)
    places = np.floor(np.log10(abs(value))) - np.floor(np.log10(std))
    return number(value, int(np.clip(places + 2, 2, MAX_DIGITS)))


def _correlation_tables(estimate: Estimate) -> Iterator[Table]:
    """Tabulate the correlations of the estimates, if they are few."""
    names = estimate.parameters
    if not 1 < len(names) <= MAX_CORRELATIONS:
        return
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = np.sqrt(np.diag(estimate.covariance))
        correlation = estimate.covariance / np.outer(spread, spread)
    cells = [
        [f"{value:+.2f}" if np.isfinite(value) else "-" for value in row] for row in correlation
    ]
    columns = {"parameter": names, **dict(zip(names, cells, strict=True))}
    yield tabulated("Correlation of the estimates", columns, detail=True)


def _residual_table(estimate: Estimate) -> Table:
    """Tabulate the residuals of every output."""
    rms = estimate.residual_rms
    columns = {"output": [*rms], "residual rms": numbers(rms.values())}
    return tabulated("Fit of every output", columns, detail=True)


def _missing_terms(estimate: Estimate) -> Iterator[Part]:
    """The terms that the model may lack."""
    tested = estimate.tested_data
    data = "" if tested is None or tested.is_complete else f" ({tested.amount})"
    if estimate.missing_terms:
        yield Listing(
            f"Terms that would explain a part of the residuals{data}",
            tuple(str(term) for term in estimate.missing_terms),
            detail=True,
        )


# ---- predictions


def _prediction_parts(predictions: Sequence[Prediction]) -> Sequence[Part]:
    """How much better than the nominal model the identified model predicts."""
    if not predictions:
        return ()
    note = "" if all(prediction.held_out for prediction in predictions) else FITTED_NOTE
    names = [
        prediction.name + ("" if prediction.held_out else FITTED_MARK) for prediction in predictions
    ]
    ratios = tabulated(
        "Prediction of recordings that were not fitted: rms error, identified / nominal",
        {"recording": names, "ratio": numbers([each.ratio for each in predictions], 2)},
        warned(not prediction.ratio < 1.0 for prediction in predictions),
        note=note,
        detail=True,
    )
    # Outputs that were not measured have no error.
    shown = [
        (name, prediction, j)
        for name, prediction in zip(names, predictions, strict=True)
        for j in np.flatnonzero(np.isfinite(prediction.identified.rms))
    ]
    identified = np.array([prediction.identified.rms[j] for _, prediction, j in shown])
    nominal = np.array([prediction.nominal.rms[j] for _, prediction, j in shown])
    # Logs of a simulation without noise may be predicted without any error.
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(nominal > 0.0, identified / nominal, np.nan)
    errors = tabulated(
        "Prediction errors of every output: root mean square [unit of the output]",
        {
            "recording": [name for name, _, _ in shown],
            "output": [prediction.identified.outputs[j] for _, prediction, j in shown],
            IDENTIFIED.word: numbers(identified),
            NOMINAL.word: numbers(nominal),
            "ratio": numbers(ratio),
        },
        note=note,
        detail=True,
    )
    return (Text(_about(predictions)), ratios, errors, Plot("predictions"), Plot("held_out"))


def _about(predictions: Sequence[Prediction]) -> str:
    """Say how much better than the nominal model the identified model predicts."""
    ratios = [prediction.ratio for prediction in predictions if np.isfinite(prediction.ratio)]
    if not ratios:
        return "No prediction of data that were not fitted could be compared"
    low, high = f"{100.0 * min(ratios):.3g} %", f"{100.0 * max(ratios):.3g} %"
    share = low if low == high else f"{low} to {high}"
    return f"Prediction of data that were not fitted: the error is {share} of the nominal model's"
