"""mjfim: system identification on MuJoCo that designs the experiment.

`design` finds the excitation that reveals most about uncertain parameters, `simulate` plays it, `identify` estimates the
parameters from recordings, `monte_carlo` holds the estimator against the Cramer-Rao bound.
"""

from mjfim.campaign import Campaign
from mjfim.checker import Check, check
from mjfim.compare import compare
from mjfim.comparison import Comparison
from mjfim.designer import design
from mjfim.duration import Shortest, shortest
from mjfim.errors import MjfimError
from mjfim.estimate import identify
from mjfim.estimated import Estimate
from mjfim.evaluation import evaluate_trajectory
from mjfim.experiment import Experiment
from mjfim.montecarlo import monte_carlo, simulate
from mjfim.prediction import predict
from mjfim.sequential import sequential
from mjfim.together import design_together
from mjfim.trajectory import Design, Recording, Study, Trajectory
from mjfim.workers import Pool

__all__ = [
    "Campaign",
    "Check",
    "Comparison",
    "Design",
    "Estimate",
    "Experiment",
    "MjfimError",
    "Pool",
    "Recording",
    "Shortest",
    "Study",
    "Trajectory",
    "check",
    "compare",
    "design",
    "design_together",
    "evaluate_trajectory",
    "identify",
    "monte_carlo",
    "predict",
    "sequential",
    "shortest",
    "simulate",
]
__version__ = "0.1.0"
