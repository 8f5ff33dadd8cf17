"""Optimisers that know arrays only: neither MuJoCo nor Fisher information.

Modules:
    lq: Linear recursions, regulator and descent of time-varying linear-quadratic problems.
    projection_operator: Algorithm 1 of Wilson & Murphey, a generator of iterates on the trajectory
        manifold.
    directions: Descent directions without limits: metric descent and limited-memory BFGS.
    structured_bfgs: Descent direction under hard limits.
    quasi_newton: The two-loop recursion that both quasi-Newton directions share.
    barrier: Relaxed logarithmic barrier of numbers between bounds.
    eigenvalue_model: Model of the smooth E-criterion where eigenvalues meet.
    condensed_least_squares: Least squares with private unknowns of many segments, eliminated
        segment by segment.
    levenberg_marquardt: Bounded Levenberg-Marquardt on condensed least squares.
    robust_losses: Losses that grow more slowly than the square.
    bracketing: Search for the smallest feasible number of samples.
"""

from mjfim.optimize.barrier import Bounds, relaxed_log_barrier
from mjfim.optimize.bracketing import SampleGrid, smallest_feasible
from mjfim.optimize.condensed_least_squares import Condensed
from mjfim.optimize.directions import LBFGS, MetricDescent
from mjfim.optimize.levenberg_marquardt import minimise
from mjfim.optimize.lq import regulator
from mjfim.optimize.robust_losses import RobustLoss
from mjfim.optimize.structured_bfgs import StructuredBFGS

__all__ = [
    "LBFGS",
    "Bounds",
    "Condensed",
    "MetricDescent",
    "RobustLoss",
    "SampleGrid",
    "StructuredBFGS",
    "minimise",
    "regulator",
    "relaxed_log_barrier",
    "smallest_feasible",
]
