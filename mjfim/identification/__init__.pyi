from .fit_problem import FitProblem
from .task import FitTask

__all__ = [
    "FitProblem",
    "FitTask",
]
