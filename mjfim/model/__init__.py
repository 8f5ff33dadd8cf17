"""MuJoCo models: load, vary, read and write parameters by path."""

from mjfim.model.geom_distance import GeomDistances
from mjfim.model.loading import ModelSource
from mjfim.model.parameters import ParameterSet
from mjfim.model.paths import ParameterPath
from mjfim.model.variants import ModelVariant, PlantModel

__all__ = [
    "GeomDistances",
    "ModelSource",
    "ModelVariant",
    "ParameterPath",
    "ParameterSet",
    "PlantModel",
]
