"""Record of what a robot plays."""

from __future__ import annotations

from dataclasses import dataclass

from mjfim.arrays import Array, freeze


@dataclass(frozen=True, eq=False, kw_only=True)
class Playback:
    """A design at the controller's rate, M rows and the end.

    t: (M+1,) [s];  state: (M+1, nq+nv+na) planned;  ctrl: (M, nu) held over each row
    gain: (M, nu, nx) K, held over each sample of the design
    """

    t: Array
    state: Array
    ctrl: Array
    gain: Array

    def __post_init__(self) -> None:
        freeze(self, "t", "state", "ctrl", "gain")

    @property
    def period(self) -> float:
        """Of the controller [s]."""
        return float(self.t[-1] - self.t[0]) / len(self.ctrl)
