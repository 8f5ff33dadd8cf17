"""The section of a report on the fit to the equation of motion."""

from __future__ import annotations

import numpy as np

from mjfim.output.report.curves import axis, curve
from mjfim.output.report.page import Key, Panel, PlotGroup, Section
from mjfim.output.summaries.inverse_dynamics import equation_parts
from mjfim.output.vocabulary import IDENTIFIED, MEASURED
from mjfim.records.inverse_dynamics import EquationFit, InverseDynamicsFit
from mjfim.records.labels import with_unit

# Names in the legend.
GIVEN = "measured, or by the model"
NEEDED = "needed by the measured motion"

# Largest number of equations that are drawn; of more, those with the largest residuals.
MAX_EQUATIONS = 12


def inverse_dynamics_section(fit: InverseDynamicsFit) -> Section:
    """Return how well each equation holds, in a table and as plots of the forces.

    Args:
        fit: The fit.
    """
    worst = sorted(fit.equations, key=lambda each: -np.nan_to_num(each.share))[:MAX_EQUATIONS]
    panels = [_panel(each) for each in fit.equations if each in worst]
    keys = [Key(name=GIVEN, role=MEASURED.word), Key(name=NEEDED, role=IDENTIFIED.word)]
    note = f"Forces in {fit.recording}, averaged over short windows."
    group = PlotGroup(title="", panels=panels, keys=keys, note=note)
    return Section(title="Equation of motion", parts=[*equation_parts(fit), group])


def _panel(each: EquationFit) -> Panel:
    """Return the plot of one equation."""
    share = f"{100.0 * each.share:.2g} %" if np.isfinite(each.share) else "no force"
    return Panel(
        title=f"{with_unit(each.name, each.unit)}, residual {share}",
        traces=[
            curve(each.t, each.measured, GIVEN, MEASURED.word),
            curve(each.t, each.explained, NEEDED, IDENTIFIED.word),
        ],
        layout={"xaxis": axis("time [s]")},
    )
