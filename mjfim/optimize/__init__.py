"""Optimisers that know arrays only: neither MuJoCo nor Fisher information.

Modules:
    lq: Linear recursions, regulator and descent of time-varying linear-quadratic problems.
    projection_operator: Algorithm 1 of Wilson & Murphey, a generator of iterates on the trajectory
        manifold.
    directions: Descent directions: metric descent and limited-memory BFGS without limits, and
        structured BFGS under hard limits.
    cost_models: Barrier of numbers between bounds, and the smooth E-criterion where eigenvalues
        meet.
    condensed_least_squares: Least squares with private unknowns of many segments, eliminated
        segment by segment, and robust losses.
    levenberg_marquardt: Bounded Levenberg-Marquardt on condensed least squares.
"""

import lazy_loader

# A name is imported from its module, which `__init__.pyi` states, when it is used first.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
