"""A fit to the equation of motion in words and tables."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from mjfim.errors import first_ones
from mjfim.output.page import (
    Emphasis,
    Level,
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
from mjfim.output.pages.accuracy import NOT_ALONE
from mjfim.records.inverse_dynamics import InverseDynamicsFit

# Residuals above this share of the forces are a warning.
LARGE_SHARE = 0.2


def equation_page(fit: InverseDynamicsFit) -> Page:
    """Describe a fit to the equation of motion."""
    verdict = _verdict(fit)
    steps = ('Identify with `fit.start = "inverse_dynamics"`, which predicts the motion itself.',)
    if verdict.level is not Level.GOOD:
        steps = ("Look at the forces in `inverse_dynamics.png`: signs, units, delays, friction.",)
    return Page(
        kind="Parameters fitted to the equation of motion",
        verdict=verdict,
        next_steps=steps,
        sections=[
            Section("Parameters", [Text(capitalised(fit.status)), _parameter_table(fit)]),
            Section("Equation of motion", list(equation_parts(fit))),
        ],
    )


def _verdict(fit: InverseDynamicsFit) -> Verdict:
    worst = max(fit.equations, key=lambda each: float(np.nan_to_num(each.share)))
    share = f"{100.0 * worst.share:.2g} %"
    if not fit.success:
        return Verdict(f"The fit to the equation of motion {fit.status}.", Level.BAD)
    if not worst.share <= LARGE_SHARE:
        text = f"The equation of motion of {worst.name} does not hold: residuals are {share} of it."
        return Verdict(text, Level.DOUBTFUL)
    text = f"The equation of motion holds: residuals are at most {share} of the forces."
    return Verdict(text, Level.GOOD)


def equation_parts(fit: InverseDynamicsFit) -> Iterator[Part]:
    """Yield the table of the equations, and what the fit does not determine."""
    found = fit.equations
    yield tabulated(
        "Equation of motion: forces that the measured motion needs, and those of the motors",
        {
            "equation": [named(each.name, each.unit) for each in found],
            "residual": numbers([each.residual for each in found]),
            "of the force": numbers([100.0 * each.share for each in found], suffix=" %"),
            "rows": [str(each.rows) for each in found],
            "up to [Hz]": numbers([each.cutoff for each in found], 2),
        },
        warned(not each.share <= LARGE_SHARE for each in found),
        spare=("rows",),
        note="residual: root mean square of averages over short windows",
    )
    text = (
        f"The equation of motion along the recordings determines {fit.determined} combinations of "
        f"{len(fit.parameters) - len(fit.absent)} parameters (condition number "
        f"{fit.condition:.3g})."
    )
    if fit.undetermined:
        text += f" Not alone: {first_ones(fit.undetermined)}."
    if fit.absent:
        text += f" It does not contain {first_ones(fit.absent)}, which keep their start."
    yield Text(text)
    text = (
        "The standard deviations of a fit to the equation of motion are formal: they contain "
        "neither the bias by noise in velocities and accelerations nor that by a wrong model."
    )
    yield Text(text, Emphasis.WEAK, detail=True)
    yield Plot("inverse_dynamics")


def _parameter_table(fit: InverseDynamicsFit) -> Table:
    """Tabulate the parameters."""
    std = [
        number(value, 2, infinite="-" if name in fit.absent else NOT_ALONE)
        for name, value in zip(fit.parameters, fit.std, strict=True)
    ]
    return tabulated(
        "Parameters",
        {
            "parameter": list(map(named, fit.parameters, fit.units)),
            "start": numbers(fit.start, 4),
            "estimate": numbers(fit.theta, 5),
            "formal σ": std,
        },
    )
