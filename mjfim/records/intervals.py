"""The width of the 95 % intervals that all results state."""

from __future__ import annotations

# Half width of the 95 % interval of a normal distribution [standard deviations].
NORMAL_95 = 1.959963984540054
