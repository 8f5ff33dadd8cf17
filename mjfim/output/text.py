"""Results as text for a terminal: rich tables, the important thing first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.console import Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from mjfim.recordings.summary import LogSummary
from mjfim.records.check import Check
from mjfim.records.combinations import ParameterGroup
from mjfim.records.comparison import DESIGN, Comparison, MethodResult
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.monte_carlo import MonteCarloStudy

FEW = 7  # parameters up to which each has a column
BEST_CASE = "sigma is the Cramér-Rao bound: a best case, true if model and noise are right."


def design_report(design: Design, units: tuple[str, ...]) -> RenderableType:
    """Predicted standard deviations before and after, then how it ended."""
    table = Table(title="What one experiment will tell", title_justify="left")
    for heading in ("parameter", "value", "σ initial", "σ designed", "relative", "smaller by"):
        table.add_column(heading, justify="left" if heading == "parameter" else "right")
    rows = zip(
        design.parameters, units, design.theta, design.initial.std, design.final.std, strict=True
    )
    for name, unit, value, before, after in rows:
        if name in design.nuisance:
            continue
        alone = np.isfinite(after)
        relative = f"{100 * after / abs(value):.2g} %" if value and alone else "-"
        shown = [f"{std:.3g}" if np.isfinite(std) else "not alone" for std in (before, after)]
        table.add_row(_named(name, unit), f"{value:.4g}", *shown, relative, _ratio(before, after))
    for c in design.combined:
        relative = f"{100 * c.std_final / abs(c.value):.2g} %" if c.value else "-"
        stds = (f"{c.std_initial:.3g}", f"{c.std_final:.3g}")
        table.add_row(
            escape(c.expression),
            f"{c.value:.4g}",
            *stds,
            relative,
            _ratio(c.std_initial, c.std_final),
            style="cyan",
        )
    last = design.history[-1] if design.history else None
    before, after = design.initial.eigenvalues[0], design.final.eigenvalues[0]
    lines = [
        f"λ_min {before:.4g} → {after:.4g} ({after / max(before, 1e-300):.1f} ×), cost J {design.initial.cost:.5g} → "
        f"{design.final.cost:.5g}, found from the {design.found_by}",
        f"{design.status.value}; {last.iteration if last else 0} iterations, {design.seconds:.2f} s, "
        f"{design.steps / 1e6:.2f} million MuJoCo steps",
    ]
    if design.nuisance:
        lines.append(escape(f"nuisance, not designed for: {', '.join(design.nuisance)}"))
    together: list[RenderableType] = []
    if design.combinations:
        together.append("not identifiable alone, so designed for the combinations; see design.json")
    return Group(
        table, *lines, *together, Text(BEST_CASE, style="dim"), *_warnings(design.warnings)
    )


def estimate_report(estimate: Estimate, units: tuple[str, ...]) -> RenderableType:
    """Estimates with intervals that allow for residuals which are no noise, the verdict, predictions of what was not fitted."""
    table = Table(title="Estimated parameters", title_justify="left")
    for heading in ("parameter", "start", "estimate", "formal σ", "honest σ", "95 % interval"):
        table.add_column(heading, justify="left" if heading == "parameter" else "right")
    columns = (
        estimate.parameters,
        units,
        estimate.initial_theta,
        estimate.theta,
        estimate.std,
        estimate.interval,
    )
    for name, unit, start, value, std, (low, high) in zip(*columns, strict=True):
        told = ("not alone", "-", "-")
        if np.isfinite(std):
            told = (f"{std:.2g}", f"{0.25 * (high - low):.2g}", f"{low:.5g} … {high:.5g}")
        table.add_row(_named(name, unit), f"{start:.5g}", f"{value:.5g}", *told)
    rms = ", ".join(f"{escape(name)} {value:.3g}" for name, value in estimate.residual_rms.items())
    each = [
        f"{escape(name)} of each recording: {', '.join(f'{value:.3g}' for value in values)}"
        for name, values in estimate.per_recording.items()
        if len(values) > 1
    ]
    lines = [
        *each,
        f"χ²/dof = {estimate.chi2 / estimate.dof:.3f} with {estimate.dof:,} degrees of freedom; residual rms: {rms}",
        f"{estimate.status} ({estimate.iterations} iterations, {estimate.seconds:.1f} s)",
    ]
    note = (
        "formal σ is accuracy only if model and noise are right; honest σ: a quarter of the interval, which allows for residuals "
        "that are not and for recordings that disagree, but not for what a wrong model does to a parameter."
    )
    told_apart = [_predictions(estimate)] if estimate.predictions else []
    return Group(table, *lines, *told_apart, Text(note, style="dim"), *_warnings(estimate.warnings))


def log_report(summaries: Sequence[LogSummary]) -> RenderableType:
    """What was read: the clock of every log, then the range of its columns."""
    table = Table(title="What was read", title_justify="left")
    for heading in ("log", "rows", "time", "rate", "jitter", "longest gap", "left out"):
        table.add_column(heading, justify="left" if heading == "log" else "right")
    for summary in summaries:
        clock = (
            f"{summary.rate:.5g} Hz",
            f"{1e3 * summary.jitter_std:.2g} ms",
            f"{1e3 * summary.longest_step:.3g} ms",
        )
        left = f"{summary.dropped:,} rows" if summary.dropped else "-"
        table.add_row(
            escape(shortened(summary.file, 34)),
            f"{summary.rows:,}",
            f"{summary.duration:.4g} s",
            *clock,
            left,
        )
    ranges = Table(title="Range of its columns (all logs)", title_justify="left")
    for heading in ("column", "from", "least", "largest", "resolution", "empty"):
        ranges.add_column(heading, justify="left" if heading in ("column", "from") else "right")
    for name in dict.fromkeys(column.name for summary in summaries for column in summary.columns):
        some = [
            column for summary in summaries for column in summary.columns if column.name == name
        ]
        low, high = (
            f([getattr(c, key) for c in some])
            for f, key in ((np.nanmin, "minimum"), (np.nanmax, "maximum"))
        )
        finest = min((c.resolution for c in some if c.resolution > 0.0), default=0.0)
        empty = float(np.mean([c.empty_share for c in some]))
        told = f"{100 * empty:.0f} %" if empty else "-"
        ranges.add_row(
            escape(name), escape(some[0].source), f"{low:.4g}", f"{high:.4g}", f"{finest:.2g}", told
        )
    return Group(table, ranges)


def shortened(path: str, most: int) -> str:
    """The end of a path, which tells files apart."""
    name = path.rsplit("/", 1)[-1]
    return name if len(name) <= most else f"…{name[1 - most :]}"


def _predictions(estimate: Estimate) -> Table:
    """Errors of predictions: identified / nominal."""
    found = estimate.predictions
    outputs = found[0].identified.outputs
    shown = [
        j for j in range(len(outputs)) if any(np.isfinite(p.identified.rms[j]) for p in found)
    ][:FEW]
    title = "Prediction of what was not fitted: rms error of the identified / the nominal model"
    table = Table(title=title, title_justify="left")
    table.add_column("what")
    for j in shown:
        table.add_column(escape(outputs[j]), justify="right")
    table.add_column("ratio", justify="right")
    for p in found:
        cells = (f"{p.identified.rms[j]:.3g} / {p.nominal.rms[j]:.3g}" for j in shown)
        style = "yellow" if not p.ratio < 1.0 else ""
        table.add_row(
            escape(shortened(p.name, 40)) + ("" if p.held_out else " *"),
            *cells,
            f"{p.ratio:.2f}",
            style=style,
        )
    if not all(p.held_out for p in found):
        table.caption = "* by a fit to the rest; --held-out keeps recordings out of the fit"
        table.caption_justify = "left"
    return table


def study_report(study: MonteCarloStudy, units: tuple[str, ...]) -> RenderableType:
    """Observed scatter against the bound."""
    parts: list[RenderableType] = []
    for name, s in study.sets.items():
        table = Table(
            title=f"{name}: {s.trials} trials, {s.failed} failed, {study.measure_rate:g} Hz",
            title_justify="left",
        )
        for heading in (
            "parameter",
            "true",
            "mean",
            "variance",
            "bound",
            "efficiency",
            "95 % interval",
        ):
            table.add_column(heading, justify="left" if heading == "parameter" else "right")
        for i, parameter in enumerate(study.parameters):
            low, high = s.efficiency_interval[i]
            table.add_row(
                _named(parameter, units[i]),
                f"{study.theta[i]:.4g}",
                f"{s.mean[i]:.5g}",
                f"{s.covariance[i, i]:.3e}",
                f"{s.crlb[i, i]:.3e}",
                f"{s.efficiency[i]:.3f}",
                f"{low:.3f} … {high:.3f}",
            )
        parts.append(table)
    note = "efficiency = Cramér-Rao bound / observed variance; 1 means the bound is reached."
    return Group(*parts, Text(note, style="dim"))


def check_report(check: Check) -> RenderableType:
    """Verdict, predicted standard deviations, what is known in combination only."""
    table = Table(title=f"What {check.source} ({check.horizon:g} s) can tell", title_justify="left")
    for heading in ("parameter", "value", "σ", "relative σ", "wanted σ", "repetitions", "time"):
        table.add_column(heading, justify="left" if heading == "parameter" else "right")
    for row in check.rows:
        if row.nuisance:
            table.add_row(
                _named(row.name, row.unit),
                f"{row.value:.4g}",
                "nuisance",
                "",
                "",
                "",
                "",
                style="dim",
            )
            continue
        alone = np.isfinite(row.std)
        relative = f"{100 * row.relative:.3g} %" if alone and np.isfinite(row.relative) else "-"
        table.add_row(
            _named(row.name, row.unit),
            f"{row.value:.4g}",
            f"{row.std:.3g}" if alone else "not alone",
            relative,
            f"{row.wanted:.3g}{'' if row.stated else ' (5 %)'}",
            f"{row.repetitions:,}" if row.repetitions else "-",
            f"{row.seconds:,.0f} s" if row.repetitions else "-",
            style="" if alone else "yellow",
        )
    parts: list[RenderableType] = [table]
    for title, groups in (
        (
            "Identifiable in combination only; neither this control nor random ones from this start tell more",
            check.not_separable,
        ),
        ("Not excited here; another control would show", check.not_excited),
    ):
        if groups:
            parts.append(Text(f"{title}:", style="bold"))
            parts += [Text(line) for group in groups for line in _lines(group, check)]
    few = check.eigenvalues
    shown = ", ".join(
        f"{v:.3g}" for v in (few if len(few) <= 8 else np.concatenate([few[:4], few[-2:]]))
    )
    tested = check.self_test
    parts += [
        f"eigenvalues{' (smallest four, largest two)' if len(few) > 8 else ''}: {shown}; condition {check.condition:.3g}",
        f"derivative self-test {'passed' if tested.passed else 'FAILED'}: psi recursion {tested.recursion:.1e}, slope "
        f"{tested.slope:.1e}, two steps {'agree' if tested.roughness is None else 'disagree'}",
        Text("Verdict", style="bold"),
        *(Text(f"• {sentence}", style="" if check.ok else "yellow") for sentence in check.verdict),
        Text(BEST_CASE, style="dim"),
    ]
    return Group(*parts)


def compare_report(comparison: Comparison) -> RenderableType:
    """What each method found with the same budget, in the order in which they ran; then who won."""
    budget = f"{comparison.seconds:g} s"
    if np.isfinite(comparison.steps):
        budget += f" or {comparison.steps / 1e6:.3g} million MuJoCo steps"
    table = Table(title=f"{comparison.source}: each method with {budget}", title_justify="left")
    headings = [
        "method",
        *(["J"] if comparison.weighted else []),
        f"φ ({comparison.criterion})",
        "J over design's",
        "worst σ",
    ]
    for heading in (*headings, "time", "steps", "worst margin"):
        table.add_column(heading, justify="left" if heading == "method" else "right", no_wrap=True)
    for row in comparison.rows:
        table.add_row(*_compared(comparison, row), style=_style(comparison, row))
    each = [_spreads(comparison)] if len(comparison.wanted) <= FEW else []
    remarks = [
        f"{row.title}: {'; '.join(_remarks(row))}" for row in comparison.rows if _remarks(row)
    ]
    said = "worst σ: of the worst combination of parameters, relative to their scales; worst margin: over half of its range"
    verdict = [
        Text(sentence, style="bold" if comparison.ok else "bold yellow")
        for sentence in comparison.verdict
    ]
    return Group(
        table,
        *each,
        *(Text(line) for line in remarks),
        Text(f"{said}. {BEST_CASE}", style="dim"),
        *verdict,
    )


def _spreads(comparison: Comparison) -> Table:
    """Every method's standard deviations."""
    table = Table(title="σ of each parameter", title_justify="left")
    table.add_column("method", no_wrap=True)
    for j in comparison.wanted:
        table.add_column(_named(comparison.parameters[j], comparison.units[j]), justify="right")
    for row in comparison.rows:
        cells = (_number(row.std[j], 3) for j in comparison.wanted)
        table.add_row(_marked(comparison, row), *cells, style=_style(comparison, row))
    return table


def _marked(comparison: Comparison, row: MethodResult) -> str:
    """A method's title, the best one's with an arrow."""
    return ("▶ " if row is comparison.best else "  ") + escape(row.title)


def _compared(comparison: Comparison, row: MethodResult) -> list[str]:
    """Cells of one method."""
    ours, (kind, share) = comparison.design, row.tightest
    against = (
        ""
        if ours is None or row is ours or np.isnan(row.cost)
        else f"{-100 * comparison.gain(row, ours):+.3g} %"
    )
    first = [*([row.cost] if comparison.weighted else []), row.criterion]
    cells = [*(_number(n, 4) for n in first), against, _number(row.worst_relative_std, 3)]
    margin = (
        f"{100.0 * share:.2g} % {kind.replace('_', ' ')}" if kind and np.isfinite(share) else "-"
    )
    return [
        _marked(comparison, row),
        *cells,
        f"{row.seconds:.1f} s",
        f"{row.steps / 1e6:.2f} M",
        margin,
    ]


def _number(value: float, digits: int) -> str:
    return "-" if np.isnan(value) else f"{value:.{digits}g}"


def _remarks(row: MethodResult) -> list[str]:
    return [*([] if row.sound else [row.outcome.value]), *([row.note] if row.note else [])]


def _style(comparison: Comparison, row: MethodResult) -> str:
    """The design stands out, so does what beats it; what may not be played steps back."""
    if not row.sound:
        return "dim"
    return "bold" if row.method == DESIGN else "yellow" if row in comparison.beating else ""


def _lines(group: ParameterGroup, check: Check) -> list[str]:
    """A group of parameters: its members, then one combination a line, with its value and standard deviation."""
    if not group.combinations:
        return [f"  {group}"]
    known = {c.expression: f" = {c.value:.4g} ± {c.std_final:.2g}" for c in check.combined}
    return [
        f"  {', '.join(group.members)} only as",
        *(f"    {c}{known.get(str(c), '')}" for c in group.combinations),
    ]


def _ratio(before: float, after: float) -> str:
    """How much smaller a standard deviation became."""
    if not (np.isfinite(before) and np.isfinite(after) and after > 0 and before > 0):
        return "-"
    return f"{before / after:.1f} ×" if before >= after else f"{after / before:.1f} × larger"


def _named(name: str, unit: str) -> str:
    return escape(f"{name} ({unit})" if unit else name)


def _warnings(sentences: tuple[str, ...]) -> list[RenderableType]:
    return [Text(f"warning: {sentence}", style="yellow") for sentence in sentences]
