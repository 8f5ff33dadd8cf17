"""Parameter values written into an MjSpec, with which models written in place are compared."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjfim.model.parameter_writer import write_element
from mjfim.model.parameters import ParameterSet
from mjfim.model.paths import resolve
from tests.support.numerics import Array


def write_spec(
    spec: Any, compiled: Any, wanted: Any, parameters: ParameterSet, theta: Array
) -> None:
    """Write values into a spec; `compiled` is its model before, `wanted` that at the values."""
    for parameter, value in zip(parameters.parameters, theta, strict=True):
        if parameter.function is not None:
            parameter.function(spec, float(value))
        for target in parameter.targets:
            written = target.scale * float(value) + target.offset
            for path in target.plain_paths:
                if target.term is not None:
                    written = resolve(wanted, path).read(wanted)
                write_element(spec, compiled, wanted, path, written)


def arrays_of(model: Any) -> dict[str, Array]:
    """Copies of all arrays of a model and of its options."""
    found = {
        f"{holder}.{name}": getattr(value, name)
        for holder, value in (("model", model), ("opt", model.opt))
        for name in dir(value)
        if not name.startswith("_")
    }
    return {name: np.array(v) for name, v in found.items() if isinstance(v, np.ndarray)}
