"""Optimal design of excitation trajectories, with and without limits."""

from mjfim.excitation.constraints import ConstraintSet
from mjfim.excitation.objective import DesignProblem
from mjfim.excitation.task import DesignTask

__all__ = [
    "ConstraintSet",
    "DesignProblem",
    "DesignTask",
]
