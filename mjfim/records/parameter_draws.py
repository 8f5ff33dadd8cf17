"""Draws of identified parameters, for simulations that vary the robot."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mjfim.arrays import Array, freeze


@dataclass(frozen=True, eq=False, kw_only=True)
class ParameterDraws:
    """Robots that are compatible with an identification.

    They are drawn from a normal distribution about the estimate that is truncated at the bounds of
    the parameters. Deviations of initial states, which are no properties of a robot, are left out.

    Attributes:
        parameters: Names of the q drawn parameters.
        units: Unit of each parameter; may be empty.
        values: (n, q) a robot in each row [theta-unit].
        centre: (q,) centre of the distribution: the estimate, and the mean over the recordings for
            parameters that differ between them [theta-unit].
        std: (q,) standard deviations of the distribution before truncation [theta-unit].
        replaced: Number of draws that were replaced because a body had an unphysical inertia.
        held_combinations: Number of combinations of inertias that stay at the estimate, because the
            recordings do not determine them.
        seed: Seed of the draws; None where the caller has made the generator.
    """

    parameters: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    centre: Array
    std: Array
    replaced: int = 0
    held_combinations: int = 0
    seed: int | None = None

    def __post_init__(self) -> None:
        freeze(self, "values", "centre", "std")

    def __len__(self) -> int:
        return len(self.values)

    def __str__(self) -> str:
        count = len(self)
        drawn = "1 robot was" if count == 1 else f"{count} robots were"
        text = f"{drawn} drawn from the uncertainty of the estimate, inside the bounds"
        if self.held_combinations:
            count = self.held_combinations
            noun = "combination" if count == 1 else "combinations"
            text += (
                f"; {count} {noun} of inertias that the recordings do not determine stayed there"
            )
        if not self.replaced:
            return text
        times = "once" if self.replaced == 1 else f"{self.replaced} times"
        return f"{text}; a draw with an unphysical inertia was replaced {times}"

    def summary(self) -> dict[str, Any]:
        """Return the contents of `draws` in estimate.json."""
        return {
            "words": str(self),
            "count": len(self),
            "seed": self.seed,
            "parameters": list(self.parameters),
            "centre": self.centre,
            "std": self.std,
            "replaced": self.replaced,
            "held_combinations": self.held_combinations,
        }
