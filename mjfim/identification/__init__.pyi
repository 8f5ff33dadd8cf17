from .fit_problem import FitProblem
from .search import FitTask

__all__ = [
    "FitProblem",
    "FitTask",
]
