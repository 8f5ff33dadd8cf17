"""The Fisher information of a trajectory, its criteria, and the parameters that it cannot identify.

Modules:
    fisher: Information of the measured samples, its reduction for a criterion, its derivatives.
    criteria: Optimality criteria of an information matrix, without nuisance parameters.
    null_space: Combinations of parameters without effect, and the groups that they form.
    identifiability: Null spaces along the trajectory of an experiment and along random ones.
    smoothness: Detection of points at which derivatives do not exist.
    finite_steps: Standard deviations by steps of finite length.
"""

import lazy_loader

# A name is imported from its module, which `__init__.pyi` states, when it is used first.
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
