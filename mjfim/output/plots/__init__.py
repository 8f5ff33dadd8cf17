"""Every figure of the package, each a function from records to a matplotlib Figure; `save` writes it as PNG.

This package is the only importer of matplotlib.
"""

from __future__ import annotations

from mjfim.output.plots.check import check_figure
from mjfim.output.plots.compare import compare_figure
from mjfim.output.plots.design import convergence, sensitivity_phase, trajectories
from mjfim.output.plots.estimates import fit, histogram
from mjfim.output.plots.limits import limits
from mjfim.output.plots.parameters import parameter_intervals, std_bars
from mjfim.output.plots.residuals import predictions, residual_spectra
from mjfim.output.plots.style import save
from mjfim.output.plots.tables import design_table, study_table

__all__ = [
    "check_figure",
    "compare_figure",
    "convergence",
    "design_table",
    "fit",
    "histogram",
    "limits",
    "parameter_intervals",
    "predictions",
    "residual_spectra",
    "save",
    "sensitivity_phase",
    "std_bars",
    "study_table",
    "trajectories",
]
