"""Record of one experiment's measurements."""

from __future__ import annotations

from dataclasses import dataclass

from mjfim.arrays import Array, freeze


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """Measured (or simulated) outputs under a known control, at the times at which they were logged.

    t: (M,) [s], increasing, at any intervals;  ctrl: (M-1, nu) held from each row to the next
    y: (M, ny) measured outputs in the order of `outputs`, NaN where an output was not measured at that time
    outputs: ny column names (`qpos:<joint>`, `qvel:<joint>` or a sensor's name);  name: for messages
    """

    t: Array
    ctrl: Array
    y: Array
    outputs: tuple[str, ...]
    name: str = "recording"

    def __post_init__(self) -> None:
        freeze(self, "t", "ctrl", "y")
