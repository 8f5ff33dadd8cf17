from .limits.constraints import ConstraintSet
from .objective import DesignProblem
from .task import DesignTask

__all__ = [
    "ConstraintSet",
    "DesignProblem",
    "DesignTask",
]
