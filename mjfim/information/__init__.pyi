from .criteria import Criterion, standard_deviations
from .fisher import FisherInformation
from .identifiability import IdentifiabilityTest
from .null_space import NullSpace

__all__ = [
    "Criterion",
    "FisherInformation",
    "IdentifiabilityTest",
    "NullSpace",
    "standard_deviations",
]
