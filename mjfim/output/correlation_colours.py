"""Strength of the colour of a correlation, the same in pictures and reports."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array

# What a picture says of it.
SCALE_IN_WORDS = "strength of the colour: root of its size"


def colour_strength(correlation: Array) -> Array:
    """Return how strong the colour of each correlation is: the root of its size, with its sign.

    Most correlations of a good experiment are small, and would be as pale as 0 otherwise.

    Args:
        correlation: Correlations of any shape, -1 to 1; NaN stays.
    """
    return np.asarray(np.sign(correlation) * np.sqrt(np.abs(correlation)))
