"""Record of the combinations of inertias that a prior determines rather than the recordings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mjfim.errors import first_ones

# Longest list of names in a sentence [characters].
NAMES_TEXT = 120


@dataclass(frozen=True, kw_only=True)
class PriorDirections:
    """How many combinations of the inertial parameters the recordings determine.

    The others are determined by the prior that the inertias of the model are (`cad_prior`). No
    motion of a fixed-base arm shows them, for example the mass of its first link.

    Attributes:
        bodies: Names of the groups of parameters, one for each body.
        count: Number of coordinates of these bodies.
        determined: Number of combinations of which the recordings leave at most half of the
            standard deviation of the prior.
        parameters: Names of the parameters whose standard deviation is more than half of that of
            the prior: their intervals are those of the prior.
    """

    bodies: tuple[str, ...]
    count: int
    determined: int
    parameters: tuple[str, ...]

    def __str__(self) -> str:
        bodies = first_ones(self.bodies, ", ", NAMES_TEXT)
        text = (
            f"The recordings determine {self.determined} of {self.count} combinations of the "
            f"inertial parameters of {bodies}. The other "
            f"{self.count - self.determined} keep the values of the model within `cad_prior`, "
            "which is an assumption and no measurement"
        )
        if not self.parameters:
            return f"{text}."
        names = first_ones(self.parameters, ", ", NAMES_TEXT)
        return f"{text}: it gives most of the intervals of {names}."

    def summary(self) -> dict[str, Any]:
        """Return the contents of `prior_directions` in estimate.json."""
        return {
            "bodies": list(self.bodies),
            "count": self.count,
            "determined": self.determined,
            "parameters": list(self.parameters),
            "words": str(self),
        }
