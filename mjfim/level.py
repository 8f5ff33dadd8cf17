"""How the plant of a level of the descent differs from the user's: quicker to step, or smoother."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Level:
    """A level.

    coarsen: 1, or how many times longer than stated timestep and sample period are
    stretch: 1, or how many times longer the timestep alone is, and the engine steps of a sample fewer
    lifted: without the clamps and stops that hard limits keep a design away from
    frictionless: without dry friction, whose sticking and slipping makes every cost rough
    """

    coarsen: int = 1
    stretch: int = 1
    lifted: bool = False
    frictionless: bool = False


STATED, FREE = Level(), Level(lifted=True)
