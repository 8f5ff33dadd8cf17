"""Workflows over designs and estimates: check, compare, Monte Carlo, campaigns."""

from typing import Literal

# Groups of parameters of a first experiment, in the order of preference.
Group = Literal["payload", "friction", "inertia", "motors"]
GROUPS: tuple[Group, ...] = ("payload", "friction", "inertia", "motors")
