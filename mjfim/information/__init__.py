"""The Fisher information of a trajectory, its criteria, and the parameters that it cannot identify.

Modules:
    fisher: Information of the measured samples, its reduction for a criterion, standard deviations.
    adjoint: Derivatives of a criterion along a trajectory, by one adjoint sweep.
    criteria: Optimality criteria of an information matrix and their derivatives.
    marginal: Schur complement of nuisance parameters.
    null_space: Combinations of parameters without effect, and the groups that they form.
    identifiability: Null spaces along the trajectory of an experiment and along random ones.
    smoothness: Detection of points at which derivatives do not exist.
"""

from mjfim.information.criteria import Criterion
from mjfim.information.fisher import FisherInformation
from mjfim.information.identifiability import IdentifiabilityTest
from mjfim.information.marginal import standard_deviations
from mjfim.information.null_space import NullSpace

__all__ = [
    "Criterion",
    "FisherInformation",
    "IdentifiabilityTest",
    "NullSpace",
    "standard_deviations",
]
