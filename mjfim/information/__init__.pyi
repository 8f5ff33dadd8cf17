from .criteria import Criterion
from .fisher import FisherInformation
from .identifiability import IdentifiabilityTest
from .marginal import standard_deviations
from .null_space import NullSpace

__all__ = [
    "Criterion",
    "FisherInformation",
    "IdentifiabilityTest",
    "NullSpace",
    "standard_deviations",
]
