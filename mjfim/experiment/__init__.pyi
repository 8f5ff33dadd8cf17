from .schema import Experiment, json_schema
from .signals import TimeGrid
from .system import System

__all__ = [
    "Experiment",
    "System",
    "TimeGrid",
    "json_schema",
]
