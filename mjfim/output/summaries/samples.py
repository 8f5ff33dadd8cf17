"""The robots that are drawn from an estimate, in words and a table."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mjfim.arrays import NORMAL_95
from mjfim.errors import first_ones
from mjfim.identification.accuracy import POORLY_KNOWN_SHARE
from mjfim.output.summary_parts import (
    Emphasis,
    Name,
    Paragraph,
    Part,
    Quantity,
    Row,
    SummaryTable,
    columns,
)
from mjfim.records.estimate import Estimate

# Heading of the standard deviation of the distribution.
STD = "σ"


def describe_samples(estimate: Estimate) -> list[Part]:
    """Describe which robots were drawn, where they are, and what they do not cover.

    Args:
        estimate: The estimate; without draws, there is nothing to describe.
    """
    draws = estimate.draws
    if draws is None:
        return []

    parts: list[Part] = [Paragraph(text=f"{draws}."), _table(estimate)]
    if estimate.misfit:
        text = (
            "The drawn robots do not cover the error of a model that does not explain the "
            "recordings; find the missing term first (--select), or randomise more widely."
        )
        parts.append(Paragraph(text=text, emphasis=Emphasis.WARNING))
    wide = [name for name in estimate.sloppy if _is_wide(name, estimate)]
    if wide:
        text = (
            f"The drawn robots differ widely in {first_ones(wide)}, which the recordings hardly "
            "determine."
        )
        parts.append(Paragraph(text=text, emphasis=Emphasis.WARNING))
    parts += [Paragraph(text=text, emphasis=Emphasis.WARNING) for text in _about_equal(estimate)]
    return parts


def _is_wide(name: str, estimate: Estimate) -> bool:
    """Whether robots differ widely in a parameter, also where combinations of others are held."""
    draws = estimate.draws
    assert draws is not None
    if name not in draws.parameters:
        return False
    half_width = NORMAL_95 * float(draws.std[draws.parameters.index(name)])
    size = float(estimate.sizes[estimate.parameters.index(name)])
    return half_width > POORLY_KNOWN_SHARE * size


def _about_equal(estimate: Estimate) -> Iterator[str]:
    """Sentences about what is equal in all drawn robots although it is not known."""
    draws, directions = estimate.draws, estimate.prior_directions
    assert draws is not None
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


def _table(estimate: Estimate) -> SummaryTable:
    """Tabulate the range of every drawn parameter."""
    draws = estimate.draws
    assert draws is not None
    low, high = draws.values.min(axis=0), draws.values.max(axis=0)
    middle = np.median(draws.values, axis=0)
    rows = tuple(
        Row(
            cells=(
                Name(name=name, unit=draws.units[j]),
                Quantity(value=float(draws.centre[j]), digits=4),
                Quantity(value=float(draws.std[j]), digits=2),
                Quantity(value=float(low[j]), digits=4),
                Quantity(value=float(middle[j]), digits=4),
                Quantity(value=float(high[j]), digits=4),
            )
        )
        for j, name in enumerate(draws.parameters)
    )
    return SummaryTable(
        key="samples",
        title="Parameters of the drawn robots",
        columns=columns(
            "parameter", "centre", STD, "smallest", "median", "largest", optional=["median"]
        ),
        rows=rows,
        note=(
            "σ is that of the 95 % intervals, before the bounds cut the distribution off; a bound "
            "shifts the median. It is smaller where combinations of inertias stay at the estimate."
        ),
        detail=True,
    )
