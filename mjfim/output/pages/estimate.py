"""The page of an estimate, with its studies: terms, segments, recordings, and drawn robots."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator, Sequence
from itertools import chain

import numpy as np

from mjfim.arrays import NORMAL_95, POORLY_KNOWN_SHARE, UNDETERMINED_SHARE, finite_or_nan
from mjfim.errors import first_ones, listed
from mjfim.identification.assessment.residual_tests import is_larger_than_noise
from mjfim.output.page import (
    IDENTIFIED,
    NOMINAL,
    Emphasis,
    Listing,
    Page,
    Part,
    Plot,
    Row,
    Table,
    Text,
    capitalised,
    number,
    numbers,
    parameter_names,
    tabulated,
    warned,
)
from mjfim.output.pages.studies import residual_parts
from mjfim.output.words import NOT_ALONE, predicted_data, relative, share_note
from mjfim.records.base import Level, Verdict
from mjfim.records.estimate import Estimate, HorizonStudy, ParameterDraws, Prediction
from mjfim.records.estimate_parts import MOST, InformationInTime
from mjfim.records.robots import RecordingComparison, p_text
from mjfim.records.terms import Decision, Selection, SelectionStep, as_toml

# Largest number of digits of an estimate.
MAX_DIGITS = 9

# Largest number of parameters with a table of correlations.
MAX_CORRELATIONS = 12

# Mark of recordings that are part of the last fit, and its meaning.
FITTED_MARK = " *"
FITTED_NOTE = (
    "* predicted by a fit without it, but part of the last fit; --held-out keeps a "
    "recording out of it"
)

# The meaning of the standard deviations.
ABOUT_STD = (
    "The formal σ is the true accuracy only if the model and the noise are right. The honest σ is "
    "a quarter of the width of the 95 % interval. It allows for residuals that are not white noise "
    "and for recordings that disagree. It does not allow for the bias of a wrong model."
)


def estimate_page(estimate: Estimate) -> Page:
    """Describe estimates with intervals, the fit of every output, and predictions."""
    rms = estimate.residual_rms
    residuals = {"output": [*rms], "residual rms": numbers(rms.values())}
    causes = estimate.causes
    details = estimate.details
    return Page(
        kind="Identification from recordings",
        verdict=_verdict(estimate),
        next_steps=tuple(_with_files(step, estimate) for step in _next_steps(estimate)),
        causes=tuple(_with_files(cause, estimate) for cause in causes),
        warnings=tuple(each for each in estimate.warnings if each not in (*causes, *details)),
        details=details,
        facts=_facts(estimate),
        sections={
            "Parameters": [*_parameter_parts(estimate), *_correlation_tables(estimate)],
            "Which seconds decide": _seconds_parts(estimate.in_time),
            "Added terms": selection_parts(estimate.selection),
            "Length of the segments": horizon_parts(estimate.horizons),
            "Recordings": recording_parts(estimate),
            "Drawn robots": sample_parts(estimate),
            "Predictions": _prediction_parts(estimate.predictions),
            "Signals": [Plot("fit")] if estimate.recordings else (),
            "Residual torque": residual_parts(estimate.residual_forces),
            "Residuals": [
                tabulated("Fit of every output", residuals, detail=True),
                Plot("spectra", detail=True),
            ],
        },
    )


def _facts(estimate: Estimate) -> dict[str, str]:
    return {
        "recordings": str(len(estimate.recordings)),
        "χ²/dof": f"{estimate.chi2 / max(estimate.dof, 1):.3f}",
        "degrees of freedom": f"{estimate.dof:,}",
        "iterations": str(estimate.iterations),
        "time of the fit": f"{estimate.seconds:.3g} s",
    }


def _with_files(sentence: str, estimate: Estimate) -> str:
    """A sentence with the fitted and the held-out recordings as arguments of its command."""
    held_out = [("--held-out", each.name) for each in estimate.predictions if each.held_out]
    files = shlex.join([*(each.name for each in estimate.recordings), *chain(*held_out)])
    return sentence.replace(" RECORDING ", f" {files} ")


# ---- verdict


def _verdict(estimate: Estimate) -> Verdict:
    """The verdict, with the payload first where one was looked for."""
    fit = _verdict_on_fit(estimate)
    if estimate.payload is None or fit.level is Level.BAD:
        return fit
    ok = fit.ok and estimate.payload.is_seen
    return Verdict(f"{estimate.payload}. {fit.sentence}", fit.level, ok)


def _verdict_on_fit(estimate: Estimate) -> Verdict:
    ratio = np.sqrt(estimate.chi2 / max(estimate.dof, 1))
    if not estimate.converged:
        why = estimate.status.removesuffix(".")
        if estimate.combinations:
            why = "the recordings determine some parameters in combination only"
        return Verdict(f"These estimates are not reliable: {why}.", Level.BAD)
    # A search that is stopped early has not tried all that may explain the recordings.
    if estimate.interrupted:
        return Verdict(
            "Interrupted: the estimates are the best ones that were found until then, and the "
            f"residuals are {ratio:.2f} times the noise.",
            Level.DOUBTFUL,
        )
    model = "The model"
    if estimate.selection is not None and estimate.selection.terms:
        terms = first_ones([term.description for term in estimate.selection.terms])
        model = f"With {terms} added, the model"
    if estimate.misfit:
        size = f"the residuals are {ratio:.2f} times the noise"
        return Verdict(
            f"{model} does not explain the recordings: {'; '.join(estimate.reasons) or size}. "
            "The true errors may exceed the intervals.",
            Level.DOUBTFUL,
        )
    text = f"{model} explains the recordings: the residuals are {ratio:.2f} times the noise"
    if is_larger_than_noise(estimate.chi2, estimate.dof):
        text = (
            f"{model} explains the recordings: the noise is {ratio:.2f} times what you stated, "
            "which the intervals use"
        )
    accuracy, level = _accuracy(estimate)
    return Verdict(f"{text}{accuracy}.", level, ok=True)


def _accuracy(estimate: Estimate) -> tuple[str, Level]:
    """The parameter whose interval is widest compared with its size, in words; the level."""
    half_widths = 0.5 * (estimate.interval[:, 1] - estimate.interval[:, 0])
    sizes = estimate.sizes
    shares = half_widths / np.where(sizes > 0.0, sizes, np.nan)
    # A share of a value that may be zero says nothing.
    is_asked = ~np.isin(estimate.parameters, estimate.nuisance)
    known = is_asked & (shares < UNDETERMINED_SHARE)
    uncertain = [estimate.parameters[j] for j in np.flatnonzero(is_asked & ~known).tolist()]
    level = Level.DOUBTFUL if uncertain else Level.GOOD
    if not known.any():
        return ", but the recordings determine no parameter" if uncertain else "", level
    worst = int(np.argmax(np.where(known, shares, -np.inf)))
    share = relative(half_widths[worst], sizes[worst])
    others = f" except {first_ones(uncertain)} (not determined)" if uncertain else ""
    return (
        f", and every parameter{others} is known to ± {share} or better (95 % interval, widest for "
        f"{estimate.parameters[worst]})"
    ), level


def _next_steps(estimate: Estimate) -> Iterator[str]:
    # More data do not help a model that lacks something.
    commands = re.findall(r"`mjfim [^`]*`", "".join(estimate.causes[:1]))
    if estimate.misfit and commands:
        yield f"Decide what the model lacks: {commands[0]}."
    elif estimate.sloppy and not estimate.misfit:
        names = first_ones(estimate.sloppy)
        yield (
            f"Design an experiment that tells more about {names}: "
            "`mjfim design EXPERIMENT -o FOLDER`."
        )
    if not any(prediction.held_out for prediction in estimate.predictions):
        yield (
            "Keep a recording out of the fit with `--held-out FILE`: a prediction of new data is "
            "the best test of a model."
        )
    if estimate.converged and not estimate.misfit:
        yield "Use `identified.xml`, the model with the estimated parameters."


# ---- parameters


def _parameter_parts(estimate: Estimate) -> Iterator[Part]:
    if estimate.status.lower().rstrip(".") not in _verdict(estimate).sentence.lower():
        yield Text(capitalised(estimate.status))
    yield _estimate_table(estimate)
    yield Plot("accuracy")
    yield Plot("parameters")
    yield Plot("pairs", detail=True)
    if estimate.payload is not None:
        yield from (Text(sentence) for sentence in estimate.payload.sentences)
    for remark in (estimate.restart, estimate.prior_directions):
        if remark is not None:
            yield Text(str(remark))
    if estimate.tested_data is not None and not estimate.tested_data.is_complete:
        yield Text(str(estimate.tested_data))
    if estimate.tested_data is not None and estimate.tested_data.unseen:
        yield Text(estimate.tested_data.unseen_sentence, Emphasis.WEAK, detail=True)
    yield Text(ABOUT_STD, Emphasis.WEAK)
    yield from _fit_parts(estimate)


def _fit_parts(estimate: Estimate) -> Iterator[Part]:
    """The control laws in the loop, values of single recordings, and the effort of the fit."""
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
        "parameter": parameter_names(estimate),
        NOMINAL: numbers(estimate.initial_theta, 4),
        IDENTIFIED: list(map(_as_accurate, estimate.theta, std)),
        "formal σ": formal,
        "honest σ": numbers(estimate.honest_std, 2),
        "95 % low": list(map(_as_accurate, np.where(known, low, np.nan), std)),
        "high": list(map(_as_accurate, np.where(known, high, np.nan), std)),
    }
    published = estimate.labels.published
    for name, values in (("predicted σ", estimate.predicted_std), ("published", published)):
        if np.isfinite(values).any():
            columns[name] = numbers(values, 4 if name == "published" else 2)
    if any(at_bound):
        columns["at bound"] = ["yes" if is_at_bound else "" for is_at_bound in at_bound]
    return tabulated(
        "Estimates with their 95 % intervals",
        columns,
        warned(at_bound),
        spare=(NOMINAL, "honest σ", "at bound", "formal σ"),
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


def _seconds_parts(found: InformationInTime | None) -> Sequence[Part]:
    """The few seconds that hold most of the information on each parameter."""
    if found is None:
        return ()
    columns = {
        "parameter": found.parameters,
        f"{100.0 * MOST:.0f} % of the information in": numbers(found.seconds_of_most, 2, " s"),
        "of the priors": numbers(100.0 * found.prior, 2, " %"),
    }
    title = "Shortest time that holds most of the information of the recordings"
    return (tabulated(title, columns, detail=True), Plot("deciding_seconds"))


# ---- predictions


def _prediction_parts(predictions: Sequence[Prediction]) -> Sequence[Part]:
    """Predictions of the identified model beside those of the nominal one."""
    if not predictions:
        return ()
    note = "" if all(prediction.held_out for prediction in predictions) else FITTED_NOTE
    names = [
        prediction.name + ("" if prediction.held_out else FITTED_MARK) for prediction in predictions
    ]
    ratios = tabulated(
        f"Prediction of {predicted_data(predictions)}: rms error, identified / nominal",
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
            IDENTIFIED: numbers(identified),
            NOMINAL: numbers(nominal),
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
        return f"No prediction of {predicted_data(predictions)} could be compared"
    low, high = f"{100.0 * min(ratios):.3g} %", f"{100.0 * max(ratios):.3g} %"
    share = low if low == high else f"{low} to {high}"
    data = predicted_data(predictions)
    return f"Prediction of {data}: the error is {share} of the nominal model's"


# What each decision is called in the table.
WORDS = {
    Decision.BEGUN: "stated model",
    Decision.ADDED: "added",
    Decision.REJECTED: "not better",
    Decision.UNHELPFUL: "no better fit",
    Decision.REMOVED: "not needed",
    Decision.POOLED: "pooled",
    Decision.HELD: "held at the guess",
    Decision.KEPT: "kept apart",
    Decision.SHORTENED: "predicted over segments",
}


def selection_parts(selection: Selection | None) -> Sequence[Part]:
    """Terms that were added, the steps that led to them, and what they depend on."""
    if selection is None:
        return ()
    steps = Table(
        title="Terms that were tried: error of data that were left out of the fit",
        columns=("term", "decision", "terms", "error [σ]", "reduction [σ²]", "± standard error"),
        rows=tuple(_row(step) for step in selection.steps),
        spare=("terms",),
    )
    parts: list[Part] = [Text(str(selection)), steps]
    kept = {term.path for term in selection.terms}
    parts += [
        Text(_about_alternatives(step), Emphasis.WARNING)
        for step in selection.steps
        if step.alternatives and step.path in kept
    ]
    if selection.refit is not None:
        differs = selection.refit[2]
        same = "the same parameters within the intervals."
        other = (
            f"other values of {listed(differs)}, by more than both intervals explain; the "
            "intervals are widened to hold both."
        )
        text = (
            "The held-out recordings took no part in the selection. Fitted to them alone, the "
            f"selected model has {other if differs else same}"
        )
        parts.append(Text(text, Emphasis.WARNING if differs else Emphasis.NORMAL))
    tables = tuple(_tables_to_keep(selection))
    if tables:
        title = "To keep this model, put these tables into the experiment file"
        parts.append(Listing(title, tables, Emphasis.WEAK, code=True))
    return (*parts, Plot("selection"))


def _about_alternatives(step: SelectionStep) -> str:
    """Say which terms the data do not tell apart, and what the parameters would be with each."""
    names = listed([alternative.description for alternative in step.alternatives])
    text = (
        f"The recordings do not tell {step.description} apart from {names}: "
        "the prediction is as good with either."
    )
    for alternative in step.alternatives:
        values = listed([f"{name} = {value:.4g}" for name, value in alternative.values.items()])
        text += f" With {alternative.description}, {values}."
    return text


def _row(step: SelectionStep) -> Row:
    is_begin = step.decision in (Decision.BEGUN, Decision.SHORTENED)
    is_compared = not is_begin and step.decision is not Decision.UNHELPFUL
    is_change = step.is_kept and not is_begin
    is_other = step.decision is Decision.REJECTED and step.reduction > step.standard_error
    return Row(
        (
            step.description or "as stated",
            "another is better" if is_other else WORDS[step.decision],
            str(step.count),
            number(step.error, 4),
            number(step.reduction, 2) if is_compared else "",
            number(step.standard_error, 2) if is_compared else "",
        ),
        Emphasis.STRONG if is_change else Emphasis.NORMAL,
    )


# ---- tables of the experiment file


def _tables_to_keep(selection: Selection) -> Iterator[str]:
    """Yield the tables of the experiment file that state the selected model, as TOML."""
    for name, table in selection.library_terms.items():
        yield as_toml(table, "terms", name)
    for name, table in selection.parameters.items():
        yield as_toml(table, "parameters", name)
    for pool in selection.pooled:
        members = listed([f"[parameters.{member}]" for member in pool.members])
        yield as_toml(pool.table, "parameters", pool.name, remark=f"in place of {members}")
    if selection.fit_table:
        yield as_toml(selection.fit_table, "fit", remark="beside the other keys of this table")


# Largest number of rows of the table with the values of single recordings.
MAX_VALUES = 60


# ---- lengths of segments


def horizon_parts(study: HorizonStudy | None) -> Sequence[Part]:
    """The chosen length of segments, and the estimates that depend on it."""
    if study is None:
        return ()
    cautions = study.findings if study.is_used else (study.about_use, *study.findings)
    names = [study.name_of(i) for i in range(len(study.errors))]
    names[study.chosen] += " (chosen)" if study.is_used else " (chosen, but not used)"
    errors = {
        f"over {length:.2g} s": numbers(errors)
        for length, errors in zip(study.lengths, np.transpose(study.errors), strict=True)
    }
    title = "Error of data that were left out of the fit [σ], by the time that is predicted"
    table = tabulated(title, {"fit over": names, **errors}, detail=True)
    return (
        Text(f"{study.about_choice} {study.about_growth}"),
        *(Text(caution, Emphasis.WARNING) for caution in cautions),
        table,
        Plot("horizons", detail=True),
    )


# ---- recordings


def recording_parts(estimate: Estimate) -> Sequence[Part]:
    """Whether recordings agree, their scatter, and what each of them suggests."""
    comparison = estimate.recording_comparison
    if comparison is None:
        return ()
    # An odd recording is a warning already.
    differs = bool(comparison.odd or comparison.apart)
    emphasis = Emphasis.WARNING if differs else Emphasis.NORMAL
    in_short_form = differs and not comparison.odd
    about = Text(str(comparison), emphasis, detail=not in_short_form)
    return (about, _scatter_table(comparison), _value_table(comparison), Plot("recordings"))


def _scatter_table(comparison: RecordingComparison) -> Table:
    """Tabulate means over the recordings, and the scatter between them."""
    low, high = comparison.interval.T
    new = finite_or_nan(comparison.prediction).T
    p = [
        "stated" if is_stated else p_text(p).removeprefix("p = ")
        for is_stated, p in zip(comparison.is_stated, comparison.p, strict=True)
    ]
    return tabulated(
        "Means over the recordings, and another recording",
        {
            "parameter": parameter_names(comparison),
            "mean": numbers(comparison.mean, 4),
            "95 % low": numbers(low, 4),
            "high": numbers(high, 4),
            "σ between": numbers(comparison.tau, 2),
            "I²": numbers(100.0 * comparison.share, 2, " %"),
            "new low": numbers(new[0], 4),
            "new high": numbers(new[1], 4),
            "p": p,
        },
        warned(j in comparison.apart for j in range(len(p))),
        spare=("95 % low", "high", "I²", "new low", "new high"),
        note=(
            "σ between: standard deviation between recordings beyond their noise; I²: its share of "
            "the scatter; new: 95 % interval of what another recording would suggest; p: "
            "probability of a scatter as large if all recordings had the same value, corrected for "
            "the number of parameters."
        ),
        detail=True,
    )


def _value_table(comparison: RecordingComparison) -> Table:
    """Tabulate what each recording suggests alone; of many, the parameters that differ most."""
    count = len(comparison.recordings)
    shown = comparison.order[: max(MAX_VALUES // count, 1)]
    odd = {recording.index for recording in comparison.odd}
    pairs = [(j, k) for j in shown for k in range(count)]
    note = "Each value is one Gauss-Newton step away from the estimate of all recordings."
    note += share_note(shown, comparison.parameters, "parameters, those that differ most")
    return tabulated(
        "What each recording suggests alone",
        {
            "recording": [
                comparison.recordings[k] + (" (odd)" if k in odd else "") for _, k in pairs
            ],
            "parameter": parameter_names(comparison, (j for j, _ in pairs)),
            "value": numbers([comparison.values[k, j] for j, k in pairs], 4),
            "σ": numbers([comparison.std[k, j] for j, k in pairs], 2, infinite="-"),
        },
        warned(k in odd for _, k in pairs),
        note=note,
        detail=True,
    )


# ---- drawn robots


def sample_parts(estimate: Estimate) -> Iterator[Part]:
    """Robots that were drawn, where they are, and what they do not cover."""
    draws = estimate.draws
    if draws is None:
        return
    yield Text(f"{draws}.")
    low, middle, high = np.quantile(draws.values, (0.0, 0.5, 1.0), axis=0)
    yield tabulated(
        "Parameters of the drawn robots",
        {
            "parameter": parameter_names(draws),
            "centre": numbers(draws.centre, 4),
            "σ": numbers(draws.std, 2),
            "smallest": numbers(low, 4),
            "median": numbers(middle, 4),
            "largest": numbers(high, 4),
        },
        spare=("median",),
        note=(
            "σ is that of the 95 % intervals, before the bounds cut the distribution off; a bound "
            "shifts the median. It is smaller where combinations of inertias stay at the estimate."
        ),
        detail=True,
    )
    yield from (Text(caution, Emphasis.WARNING) for caution in _not_covered(estimate, draws))
    yield Plot("samples")


def _not_covered(estimate: Estimate, draws: ParameterDraws) -> Iterator[str]:
    """Sentences about what the drawn robots do not cover."""
    if estimate.misfit:
        yield (
            "The drawn robots do not cover the error of a model that does not explain the "
            "recordings; find the missing term first (--select), or randomise more widely."
        )
    wide = [
        name
        for name in estimate.sloppy
        if name in draws.parameters
        and NORMAL_95 * float(draws.std[draws.parameters.index(name)])
        > POORLY_KNOWN_SHARE * float(estimate.sizes[estimate.parameters.index(name)])
    ]
    if wide:
        yield (
            f"The drawn robots differ widely in {first_ones(wide)}, which the recordings hardly "
            "determine."
        )
    directions = estimate.prior_directions
    if draws.held_combinations and directions is not None:
        yield (
            f"The drawn robots differ in {directions.determined} of {directions.count} "
            f"combinations of the inertial parameters of {first_ones(directions.bodies)}. The "
            f"recordings do not determine the other {draws.held_combinations}, which are those of "
            "the estimate in all robots; what is wrong in them is not covered."
        )
    held = [name for name in estimate.held if name in draws.parameters]
    if held:
        yield (
            f"The drawn robots do not differ in {first_ones(held)}, which the fit held at the "
            "guess; its error is not covered."
        )
