from .schema import Experiment, json_schema
from .system import System
from .time_grid import TimeGrid

__all__ = [
    "Experiment",
    "System",
    "TimeGrid",
    "json_schema",
]
