from .derivatives import Derivatives
from .noise import Noise
from .outputs import Outputs
from .plant import Plant
from .state_space import StateSpace

__all__ = [
    "Derivatives",
    "Noise",
    "Outputs",
    "Plant",
    "StateSpace",
]
