"""The answer that every result gives: how good it is, why, and what to do next."""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple


class Level(StrEnum):
    """Quality of a result."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    BAD = "bad"


class Verdict(NamedTuple):
    """What to think of a result, and what to do next.

    Attributes:
        sentence: The result in a sentence.
        level: How good it is.
        ok: Whether what was asked for was reached. The command line exits with 0 then, else with 1.
        reasons: What is to be fixed first, and what limits the result.
        next: What to do next, the most useful step first.
    """

    sentence: str
    level: Level
    ok: bool = False
    reasons: tuple[str, ...] = ()
    next: tuple[str, ...] = ()

    def __str__(self) -> str:
        next_step = [f"Next: {step}" for step in self.next[:1]]
        return "\n".join([f"{self.level.upper()}: {self.sentence}", *self.reasons, *next_step])
