"""Results as text for a terminal: rich tables, the important thing first."""

from __future__ import annotations

import numpy as np
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from mjfim.trajectory import Design, Estimate, Study

BEST_CASE = "sigma is the Cramér-Rao bound: a best case, true if model and noise are right."


def design_report(design: Design, units: tuple[str, ...]) -> RenderableType:
    """Predicted standard deviations before and after, then how it ended."""
    table = Table(title="What one experiment will tell", title_justify="left")
    for heading in ("parameter", "value", "σ initial", "σ designed", "relative", "smaller by"):
        table.add_column(heading, justify="left" if heading == "parameter" else "right")
    rows = zip(design.parameters, units, design.theta, design.initial.std, design.final.std, strict=True)
    for name, unit, value, before, after in rows:
        relative = f"{100 * after / abs(value):.2g} %" if value else "-"
        gain = _ratio(before, after)
        table.add_row(_named(name, unit), f"{value:.4g}", f"{before:.3g}", f"{after:.3g}", relative, gain)
    last = design.history[-1] if design.history else None
    before, after = design.initial.eigenvalues[0], design.final.eigenvalues[0]
    lines = [
        f"λ_min {before:.4g} → {after:.4g} ({after / max(before, 1e-300):.1f} ×), cost J {design.initial.cost:.5g} → "
        f"{design.final.cost:.5g}, found from the {design.found_by}",
        f"{design.status.value}; {last.iteration if last else 0} iterations, {design.seconds:.2f} s, "
        f"{design.steps / 1e6:.2f} million MuJoCo steps",
    ]
    return Group(table, *lines, Text(BEST_CASE, style="dim"), *_warnings(design.warnings))


def estimate_report(estimate: Estimate, units: tuple[str, ...]) -> RenderableType:
    """Estimates with 95 % intervals, residuals against the stated noise."""
    table = Table(title="Estimated parameters", title_justify="left")
    for heading in ("parameter", "start", "estimate", "formal σ", "95 % interval"):
        table.add_column(heading, justify="left" if heading == "parameter" else "right")
    rows = zip(estimate.parameters, units, estimate.initial_theta, estimate.theta, estimate.std, strict=True)
    for name, unit, start, value, std in rows:
        low, high = value - 1.96 * std, value + 1.96 * std
        table.add_row(_named(name, unit), f"{start:.5g}", f"{value:.5g}", f"{std:.2g}", f"{low:.5g} … {high:.5g}")
    rms = ", ".join(f"{name} {value:.3g}" for name, value in estimate.residual_rms.items())
    lines = [
        f"χ²/dof = {estimate.chi2 / estimate.dof:.3f} with {estimate.dof} degrees of freedom; residual rms: {rms}",
        f"{estimate.status} ({estimate.iterations} iterations)",
    ]
    note = "formal σ is accuracy only if the model and the stated noise are right."
    return Group(table, *lines, Text(note, style="dim"), *_warnings(estimate.warnings))


def study_report(study: Study, units: tuple[str, ...]) -> RenderableType:
    """Observed scatter against the bound."""
    parts: list[RenderableType] = []
    for name, s in study.sets.items():
        table = Table(
            title=f"{name}: {s.trials} trials, {s.failed} failed, {study.measure_rate:g} Hz", title_justify="left"
        )
        for heading in ("parameter", "true", "mean", "variance", "bound", "efficiency", "95 % interval"):
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


def _ratio(before: float, after: float) -> str:
    """How much smaller a standard deviation became."""
    if not (np.isfinite(before) and np.isfinite(after) and after > 0 and before > 0):
        return "-"
    return f"{before / after:.1f} ×" if before >= after else f"{after / before:.1f} × larger"


def _named(name: str, unit: str) -> str:
    return f"{name} ({unit})" if unit else name


def _warnings(sentences: tuple[str, ...]) -> list[RenderableType]:
    return [Text(f"warning: {sentence}", style="yellow") for sentence in sentences]
