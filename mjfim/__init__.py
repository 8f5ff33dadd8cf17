"""mjfim: system identification on MuJoCo that designs the experiment.

`design` finds the excitation that reveals most about uncertain parameters, `simulate` plays it, `identify` estimates the
parameters from recordings, `monte_carlo` holds the estimator against the Cramer-Rao bound.
"""

from mjfim.checker import Check, check
from mjfim.designer import design
from mjfim.errors import MjfimError
from mjfim.estimate import identify
from mjfim.evaluation import evaluate_trajectory
from mjfim.experiment import Experiment
from mjfim.montecarlo import monte_carlo, simulate
from mjfim.together import design_together
from mjfim.trajectory import Design, Estimate, Recording, Study, Trajectory

__all__ = [
    "Check",
    "Design",
    "Estimate",
    "Experiment",
    "MjfimError",
    "Recording",
    "Study",
    "Trajectory",
    "check",
    "design",
    "design_together",
    "evaluate_trajectory",
    "identify",
    "monte_carlo",
    "simulate",
]
__version__ = "0.1.0"
