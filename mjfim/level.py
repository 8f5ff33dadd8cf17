"""How the plant of a level of the descent differs from the user's: quicker to step, or smoother."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Level:
    """A level.

    coarsen: 1, or how many times longer than stated timestep and sample period are
    stretch: 1, or how many times longer the timestep alone is, and the engine steps of a sample fewer
    lifted: without the clamps and stops that hard limits keep a design away from
    soft: speeds of every degree of freedom and tendon at which dry friction turns viscous where derivatives are taken, empty
        where it is as it is;  softened: so it is in the motion as well
    """

    coarsen: int = 1
    stretch: int = 1
    lifted: bool = False
    soft: tuple[float, ...] = ()
    softened: bool = False


STATED, FREE = Level(), Level(lifted=True)
