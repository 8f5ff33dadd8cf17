"""All figures of the package.

Each function turns records into a matplotlib Figure; `save` writes it as PNG, SVG or PDF.

Only the modules of this package import matplotlib.
"""

from __future__ import annotations

from mjfim.output.plots.campaign import campaign_figure
from mjfim.output.plots.check import check_figure
from mjfim.output.plots.compare import compare_figure
from mjfim.output.plots.convergence import convergence
from mjfim.output.plots.design import sensitivity_phase, trajectories
from mjfim.output.plots.limit_usage import limits
from mjfim.output.plots.monte_carlo import histogram, study_overview
from mjfim.output.plots.pairs import check_pairs, estimate_pairs
from mjfim.output.plots.parameter_trace import parameter_trace
from mjfim.output.plots.parameters import parameter_intervals, std_bars
from mjfim.output.plots.recording_fit import fit, held_out
from mjfim.output.plots.residuals import predictions, residual_spectra
from mjfim.output.plots.robustness import robustness_figure
from mjfim.output.plots.style import save

__all__ = [
    "campaign_figure",
    "check_figure",
    "check_pairs",
    "compare_figure",
    "convergence",
    "estimate_pairs",
    "fit",
    "held_out",
    "histogram",
    "limits",
    "parameter_intervals",
    "parameter_trace",
    "predictions",
    "residual_spectra",
    "robustness_figure",
    "save",
    "sensitivity_phase",
    "std_bars",
    "study_overview",
    "trajectories",
]
