"""Groups of parameters that a first experiment may propose."""

from __future__ import annotations

from typing import Literal

Group = Literal["payload", "friction", "inertia", "motors"]

# Groups of parameters, in the order of preference.
GROUPS: tuple[Group, ...] = ("payload", "friction", "inertia", "motors")
