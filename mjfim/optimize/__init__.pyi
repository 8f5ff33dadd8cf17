from .condensed_least_squares import Condensed, RobustLoss
from .cost_models import Bounds, relaxed_log_barrier
from .directions import LBFGS, MetricDescent, StructuredBFGS
from .levenberg_marquardt import minimise
from .lq import regulator

__all__ = [
    "LBFGS",
    "Bounds",
    "Condensed",
    "MetricDescent",
    "RobustLoss",
    "StructuredBFGS",
    "minimise",
    "regulator",
    "relaxed_log_barrier",
]
