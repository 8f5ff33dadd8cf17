from .outputs import Noise, Outputs
from .plant import Derivatives, Plant
from .state_space import StateSpace

__all__ = [
    "Derivatives",
    "Noise",
    "Outputs",
    "Plant",
    "StateSpace",
]
