"""Copies of a model at parameter values that can be written in place."""

from __future__ import annotations

import copy
from collections import OrderedDict
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.model.parameters import ParameterSet
from mjfim.model.variants import PlantModel

# Copies that are kept besides those of the largest call. They take the values that differ from call
# to call, such as those along a direction.
SPARE_COPIES = 8


class WrittenModels:
    """Copies of a model, each with parameter values that were written into it.

    A design asks for the same values at every iterate. They are written once.

    One thread at a time may ask for models and simulate them, because a call overwrites models of
    earlier calls.

    Attributes:
        source: Model into which the parameters are written.
        parameters: The p parameters, of which none needs a compile.
    """

    def __init__(self, source: PlantModel, parameters: ParameterSet) -> None:
        """Begin without copies."""
        self.source = source
        self.parameters = parameters
        self._largest_call = 0

        # The copies by the bytes of their values, those that were asked for last at the end.
        self._copies: OrderedDict[bytes, Any] = OrderedDict()

    def at(self, theta: Array) -> list[Any]:
        """Models at many parameter values.

        A later call may overwrite them.

        Args:
            theta: (m, p) parameters [theta-unit].

        Returns:
            m models; equal rows share one.
        """
        rows = np.ascontiguousarray(theta, dtype=np.float64)
        keys = [row.tobytes() for row in rows]
        self._largest_call = max(self._largest_call, len(keys))

        # Copies of this call go to the end first, so that none of them is overwritten.
        for key in keys:
            if key in self._copies:
                self._copies.move_to_end(key)

        for key, row in zip(keys, rows, strict=True):
            if key not in self._copies:
                model = self._free_copy()
                self.parameters.writer.write(model, row)
                self._copies[key] = self.source.refresh(model)

        return [self._copies[key] for key in keys]

    def _free_copy(self) -> Any:
        """A copy to write into: a new one, or the one that was not asked for the longest."""
        if len(self._copies) < self._largest_call + SPARE_COPIES:
            return copy.copy(self.source.model)

        return self._copies.popitem(last=False)[1]
