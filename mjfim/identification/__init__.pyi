from .assessment.parameter_draws import complete_theta
from .fit_problem import FitProblem
from .search import FitTask

__all__ = [
    "FitProblem",
    "FitTask",
    "complete_theta",
]
