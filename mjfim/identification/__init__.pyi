from .fit_problem import FitProblem
from .assessment.parameter_draws import complete_theta
from .task import FitTask

__all__ = [
    "FitProblem",
    "FitTask",
    "complete_theta",
]
