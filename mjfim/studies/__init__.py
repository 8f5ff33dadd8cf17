"""Workflows over designs and estimates: check, compare, Monte Carlo, campaigns."""

from typing import Literal, get_args

# Groups of parameters of a first experiment, in the order of preference; and all of them, with the
# laws of position servos, which a log shows.
Group = Literal["payload", "friction", "inertia", "motors", "servos"]
GROUPS: tuple[Group, ...] = ("payload", "friction", "inertia", "motors")
EVERY_GROUP: tuple[Group, ...] = get_args(Group)
