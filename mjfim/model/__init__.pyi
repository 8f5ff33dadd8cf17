from .clearance import GeomDistances
from .loading import ModelSource
from .parameters import ParameterSet
from .paths import ParameterPath
from .variants import ModelVariant, PlantModel

__all__ = [
    "GeomDistances",
    "ModelSource",
    "ModelVariant",
    "ParameterPath",
    "ParameterSet",
    "PlantModel",
]
