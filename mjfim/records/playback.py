"""Record of a design at the rate of a robot's controller."""

from __future__ import annotations

from dataclasses import dataclass

from mjfim.arrays import Array, freeze


@dataclass(frozen=True, eq=False, kw_only=True)
class Playback:
    """A design at the controller's rate, with M rows of control and the final state.

    Attributes:
        t: (M+1,) times [s].
        state: (M+1, nq+nv+na) planned positions, velocities and activations.
        ctrl: (M, nu) controls, held over each row [unit of the actuator].
        gain: (M, nu, nx) feedback gains K, held over each sample of the design [u-unit / x-unit].
    """

    t: Array
    state: Array
    ctrl: Array
    gain: Array

    def __post_init__(self) -> None:
        freeze(self, "t", "state", "ctrl", "gain")

    @property
    def period(self) -> float:
        """Sample period of the controller [s]."""
        return float(self.t[-1] - self.t[0]) / len(self.ctrl)
