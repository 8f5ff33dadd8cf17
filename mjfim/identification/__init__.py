"""Parameter estimation from recordings by multiple shooting, and its diagnostics."""

from mjfim.identification.residuals import FitProblem
from mjfim.identification.task import FitTask

__all__ = [
    "FitProblem",
    "FitTask",
]
