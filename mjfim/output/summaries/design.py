"""A design in words and tables."""

from __future__ import annotations

from collections.abc import Sequence

from mjfim.errors import listed
from mjfim.output.summaries.accuracy import (
    BEST_CASE,
    accuracy_table,
    size_sentence,
)
from mjfim.output.summary_parts import (
    Cell,
    Emphasis,
    Paragraph,
    Part,
    Quantity,
    Row,
    Summary,
    SummaryTable,
    columns,
)
from mjfim.records.design import Design, ScaledStart

# Largest number of limits that the initial control violates and that a summary lists.
MAX_VIOLATIONS = 4

# Largest number of eigenvalues that a table shows one by one; of more, the largest three and the
# smallest two are shown.
MAX_EIGENVALUES = 6

# Smallest divisor of the improvement of an eigenvalue; avoids a division by zero.
TINY = 1e-300

# Digits as subscripts.
SUBSCRIPTS = str.maketrans("0123456789", "₀₁₂₃₄₅₆₇₈₉")


def describe_design(design: Design, units: Sequence[str]) -> Summary:
    """Describe predicted standard deviations before and after a design, and how it ended.

    Args:
        design: The design.
        units: Unit of each of the p parameters.
    """
    parts: list[Part] = [accuracy_table(design, units), *_start_sentences(design)]

    of_size = size_sentence(design.theta, design.sizes)
    if of_size:
        parts.append(Paragraph(text=of_size, emphasis=Emphasis.WEAK))

    before, after = float(design.initial.eigenvalues[0]), float(design.final.eigenvalues[0])
    parts.append(
        Paragraph(
            text=(
                f"λ_min {before:.4g} → {after:.4g} ({after / max(before, TINY):.1f} ×), cost J "
                f"{design.initial.cost:.5g} → {design.final.cost:.5g}, found from the "
                f"{design.found_by}"
            )
        )
    )
    count = design.iterations
    iterations = "1 iteration" if count == 1 else f"{count} iterations"
    parts.append(
        Paragraph(
            text=f"{iterations}, {design.seconds:.2f} s, "
            f"{design.steps / 1e6:.2f} million MuJoCo steps",
            detail=True,
        )
    )
    if design.nuisance:
        names = listed(design.nuisance)
        parts.append(
            Paragraph(
                text=f"Nuisance parameters, whose accuracy the design ignores: {names}", detail=True
            )
        )
    if design.combinations:
        parts.append(
            Paragraph(
                text=(
                    "Some parameters are not identifiable alone; the search maximises the "
                    "information of combinations of them, see design.json"
                )
            )
        )
    parts.append(Paragraph(text=BEST_CASE, emphasis=Emphasis.WEAK))

    parts += _limit_parts(design)
    parts += _start_parts(design)
    parts.append(eigenvalue_table(design))
    return Summary(
        title="Designed experiment",
        outcome=design.outcome,
        parts=tuple(parts),
        warnings=design.warnings,
    )


def eigenvalue_table(design: Design) -> SummaryTable:
    """Tabulate eigenvalues (largest first), criterion and cost of both trajectories.

    Of many eigenvalues, those in the middle are left out.

    Args:
        design: The design.
    """
    count = len(design.final.eigenvalues)
    left_out = count > MAX_EIGENVALUES
    shown = [0, 1, 2, count - 2, count - 1] if left_out else list(range(count))
    headings = [f"λ{str(k + 1).translate(SUBSCRIPTS)}" for k in shown]
    if left_out:
        headings.insert(3, "…")

    rows = []
    for trajectory, title, evaluation in (
        ("initial", "initial", design.initial),
        ("final", "designed", design.final),
    ):
        descending = evaluation.eigenvalues[::-1]
        values: list[Cell] = [Quantity(value=float(descending[k]), digits=5) for k in shown]
        if left_out:
            values.insert(3, "…")
        values += [
            Quantity(value=evaluation.criterion, digits=5),
            Quantity(value=evaluation.cost, digits=5),
        ]
        rows.append(Row(cells=(title, *values), trajectory=trajectory))

    return SummaryTable(
        key="eigenvalues",
        title="Eigenvalues of the Fisher information, and cost",
        columns=columns("trajectory", *headings, "criterion", "J"),
        rows=tuple(rows),
        detail=True,
    )


def _limit_parts(design: Design) -> list[Part]:
    """Return a table of the worst margins, and which limits are violated."""
    if not design.limits:
        return []

    parts: list[Part] = []
    violated = [kind for kind, margin in design.limits.items() if margin < 0.0]
    if violated:
        parts.append(
            Paragraph(
                text=f"Limits are violated: {', '.join(violated)}.",
                emphasis=Emphasis.STRONG_WARNING,
                detail=True,
            )
        )
    rows = tuple(
        Row(cells=(kind, Quantity(value=margin))) for kind, margin in design.limits.items()
    )
    parts.append(
        SummaryTable(
            key="limits",
            title="Limits",
            columns=columns("limit", "worst margin (negative: violated)"),
            rows=rows,
            detail=True,
        )
    )
    return parts


def _start_sentences(design: Design) -> list[Part]:
    """Return which limits the initial control violates, and how a scaled one compares."""
    parts: list[Part] = []
    broken = [str(violation) for violation in design.initial_violations]
    if broken:
        shown = "; ".join(broken[:MAX_VIOLATIONS])
        others = len(broken) - MAX_VIOLATIONS
        more = f"; and {others} more, see limits.initial in design.json" if others > 0 else ""
        parts.append(
            Paragraph(
                text=f"The initial control violates limits: {shown}{more}. Its standard deviations "
                "are those of a motion outside the limits."
            )
        )
    if design.scaled_start is not None:
        parts.append(Paragraph(text=_scaled_sentence(design, design.scaled_start)))
    return parts


def _scaled_sentence(design: Design, scaled: ScaledStart) -> str:
    """Return how a design compares with the initial control, scaled until it keeps all limits."""
    share = f"The initial control scaled by {scaled.share:.2g} keeps all limits"
    if not design.within_limits:
        return f"{share}; the design does not."

    times = float(design.final.eigenvalues[0]) / max(scaled.min_eigenvalue, TINY)
    return (
        f"{share}; the design is {times:.3g} times better than that (λ_min "
        f"{scaled.min_eigenvalue:.4g} → {design.final.eigenvalues[0]:.4g})."
    )


def _start_parts(design: Design) -> list[Part]:
    """Return a table of all initial controls of a multistart, and which was the best."""
    count = len(design.starts)
    if count < 2:
        return []

    rows = tuple(
        Row(
            cells=(
                start.name,
                Quantity(value=start.cost, digits=5),
                str(start.iterations),
                start.status.name.lower(),
            )
        )
        for start in design.starts
    )
    table = SummaryTable(
        key="starts",
        title="Initial controls from which the search started",
        columns=columns("initial control", "cost", "iterations", "outcome", left=["outcome"]),
        rows=rows,
        detail=True,
    )
    return [
        Paragraph(text=f"Best of {count} starts: {design.found_by}.", detail=True),
        table,
    ]
