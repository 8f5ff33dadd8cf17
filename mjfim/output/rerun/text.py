"""What Rerun recordings say in words: the tables of designs and estimates, in Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from mjfim.records.design import Design
from mjfim.records.estimate import Estimate


def design_text(design: Design, summary: str = "") -> str:
    """Markdown: outcome, predicted standard deviations before and after, limits, warnings."""
    first, last = design.initial, design.final
    rows = [
        (name, f"{theta:.4g}", f"{a:.3g}", f"{b:.3g}", f"{a / b:.3g}×" if 0.0 < b < np.inf else "")
        for name, theta, a, b in zip(
            design.parameters, design.theta, first.std, last.std, strict=True
        )
        if name not in design.nuisance
    ]
    low, high = float(first.eigenvalues[0]), float(last.eigenvalues[0])
    ratio = f" (×{high / low:.3g})" if low > 0.0 else ""
    table = _table(("parameter", "θ", "σ initial", "σ optimized", "better by"), rows)
    limits = _table(
        ("limit", "worst margin (negative: violated)"),
        [(k, f"{v:.3g}") for k, v in design.limits.items()],
    )
    starts = _table(
        ("start", "cost", "iterations", "outcome"),
        [
            (s.name, f"{s.cost:.5g}", str(s.iterations), s.status.name.lower())
            for s in design.starts
        ],
    )
    iterations = max((row.iteration for row in design.history), default=0)
    violated = [kind for kind, margin in design.limits.items() if margin < 0.0]
    return _sections(
        "## Designed experiment",
        f"**{design.status.value[0].upper()}{design.status.value[1:]}**",
        f"**Limits are violated: {', '.join(violated)}.**" if violated else "",
        "Blue: the initial trajectory. Red: the optimized one. Space bar: play or pause.",
        *_warnings(design.warnings),
        "#### Predicted standard deviation σ of each parameter",
        table,
        "σ is the Cramér-Rao bound: a best case, true if the model and the stated noise are right.",
        f"Smallest eigenvalue of the information: {low:.4g} → {high:.4g}{ratio}."
        f" Cost: {first.cost:.4g} → {last.cost:.4g}."
        f" {iterations} iterations, {design.steps} MuJoCo steps, {design.seconds:.1f} s.",
        limits if design.limits else "",
        f"Best of {len(design.starts)} starts: {design.found_by}."
        if len(design.starts) > 1
        else "",
        starts if len(design.starts) > 1 else "",
        "The plots of ψ show sensitivities: how far a position (→) and its velocity (↑) move per unit of a parameter.",
        summary,
    )


def estimate_text(estimate: Estimate, summary: str = "") -> str:
    """Markdown: outcome, estimated parameters, fit per output, warnings."""
    columns = (
        estimate.parameters,
        estimate.initial_theta,
        estimate.theta,
        estimate.std,
        estimate.interval,
    )
    rows = [
        (
            name,
            f"{a:.5g}",
            f"{b:.5g}",
            f"{s:.2g}",
            f"{low:.4g} … {high:.4g}",
            "yes" if name in estimate.at_bound else "",
        )
        for name, a, b, s, (low, high) in zip(*columns, strict=True)
    ]
    verdict = "no noise: σ is then not accuracy" if estimate.misfit else "as the noise explains"
    return _sections(
        "## Estimated parameters",
        f"**{estimate.status}** ({estimate.iterations} iterations)",
        "Orange: the model with these parameters. Grey: what was measured.",
        *_warnings(estimate.warnings),
        _table(("parameter", "start", "estimate", "formal σ", "95 % interval", "at bound"), rows),
        f"Residuals: χ² = {estimate.chi2:.4g} for {estimate.dof} degrees of freedom, {verdict}.",
        _table(
            ("output", "residual rms"), [(k, f"{v:.3g}") for k, v in estimate.residual_rms.items()]
        ),
        "#### Predictions of what was not fitted" if estimate.predictions else "",
        _table(
            ("what", "error over the nominal model's"),
            [(p.name, f"{p.ratio:.2g}") for p in estimate.predictions],
        )
        if estimate.predictions
        else "",
        summary,
    )


def _sections(*parts: str) -> str:
    """Paragraphs that say something, apart."""
    return "\n\n".join(part for part in parts if part)


def _warnings(sentences: Sequence[str]) -> list[str]:
    """Heading and list, or nothing."""
    return (
        ["#### Warnings", "\n".join(f"- {sentence}" for sentence in sentences)] if sentences else []
    )


def _table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(
        "| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines
    )
