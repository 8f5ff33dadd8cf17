"""One case of the fuzz suite, and its outcome."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

# Time after which a case has failed [s]. It includes the time that a busy machine takes from it.
TIME_LIMITS = {
    "problem": 180.0,
    "input": 60.0,
    "kill": 300.0,
    "mechanism": 180.0,
    "permission": 180.0,
    "log": 600.0,
}


# Kinds of cases; the place of a kind in this list is part of the seed of its random numbers.
KINDS = tuple(TIME_LIMITS)


# File in the current folder of a process that describes the running case.
RUNNING = Path("running.txt")


def announce(description: str) -> None:
    """Write down what the running case is, for the case of a crash."""
    RUNNING.write_text(description, encoding="utf-8")


@dataclass(frozen=True, kw_only=True)
class Case:
    """A case that can be run alone.

    Attributes:
        kind: One of `KINDS`.
        seed: Seed of everything that is random in it.
    """

    kind: str
    seed: int

    def __str__(self) -> str:
        return f"{self.kind}:{self.seed}"

    @property
    def rng(self) -> np.random.Generator:
        """The random numbers of this case."""
        return np.random.default_rng([KINDS.index(self.kind), self.seed])

    @staticmethod
    def parse(text: str) -> Case:
        """Read a case as it is printed, KIND:SEED."""
        kind, _, seed = text.partition(":")
        if kind not in KINDS or not seed.isdecimal():
            raise ValueError(f"{text}: a case is KIND:SEED with a kind of {', '.join(KINDS)}")
        return Case(kind=kind, seed=int(seed))


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What became of a case.

    Attributes:
        case: The case.
        group: How it ended, for the counts: "claimed", "refused", "exit 2", ...
        description: What was random in it, in words.
        complaint: What is wrong; empty where all is well.
        seconds: Duration [s].
    """

    case: Case
    group: str
    description: str
    complaint: str = ""
    seconds: float = 0.0
