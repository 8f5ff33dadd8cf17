from .campaign import campaign_figure
from .check import check_figure
from .compare import compare_figure
from .convergence import convergence
from .design import sensitivity_phase, trajectories
from .horizons import horizons_figure
from .inverse_dynamics import inverse_dynamics_figure
from .limit_usage import limits
from .monte_carlo import histogram, study_overview
from .pairs import check_pairs, estimate_pairs
from .parameter_trace import parameter_trace
from .parameters import parameter_intervals, std_bars
from .recording_comparison import recording_forest
from .recording_fit import fit, held_out
from .residuals import predictions, residual_spectra
from .robot_comparison import robot_figure
from .robustness import robustness_figure
from .samples import drawn_robots
from .selection import selection_figure
from .style import save

__all__ = [
    "campaign_figure",
    "check_figure",
    "check_pairs",
    "compare_figure",
    "convergence",
    "drawn_robots",
    "estimate_pairs",
    "fit",
    "held_out",
    "histogram",
    "horizons_figure",
    "inverse_dynamics_figure",
    "limits",
    "parameter_intervals",
    "parameter_trace",
    "predictions",
    "recording_forest",
    "residual_spectra",
    "robot_figure",
    "robustness_figure",
    "save",
    "selection_figure",
    "sensitivity_phase",
    "std_bars",
    "study_overview",
    "trajectories",
]
