"""The experiment file as a checked record (schema), and the system that it resolves to."""

from mjfim.experiment.schema import Experiment, json_schema
from mjfim.experiment.system import System
from mjfim.experiment.time_grid import TimeGrid

__all__ = [
    "Experiment",
    "System",
    "TimeGrid",
    "json_schema",
]
