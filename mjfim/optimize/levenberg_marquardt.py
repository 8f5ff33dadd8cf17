"""Levenberg-Marquardt within bounds on condensed least squares, and the undamped Gauss-Newton of the paper.

Knows a protocol, no MuJoCo. The damping follows the ratio of gained to promised reduction (Nielsen 1999); bounds hold in every
step, which is solved as a bounded linear problem.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from mjfim.arrays import Array
from mjfim.optimize.condensed_least_squares import Condensed, Step

FIRST = 1e-3  # damping over the columns' own squares
HARDLY = 1e-6  # damping at which a step says how far the minimum seems to be
MOST = 1e12
STILL = (
    1e-6,
    1e-2,
)  # fall of the cost that is none, over the cost and itself; 1e-2 is a seventh of a standard deviation


INTERRUPTED = "interrupted by the user; the best estimate so far"
PATIENCE = 3  # times in turn that it may be none
FRACTION = 0.3  # standard deviations; a step that short, promised but not found, is the roughness of the simulation


@dataclass(frozen=True, eq=False)
class Unknowns:
    """theta: (p,) what is common, the rest unused;  starts: (P, n) of the pieces;  own: (K, e) of the recordings"""

    theta: Array
    starts: Array
    own: Array = field(default_factory=lambda: np.zeros((0, 0)))


class Problem(Protocol):
    """Half of the squares as a function of unknowns."""

    @property
    def lower(self) -> Array:
        """(c,) bounds of the common unknowns."""

    @property
    def upper(self) -> Array:
        """(c,) bounds of the common unknowns."""

    def cost(self, at: Unknowns) -> float:
        """Half of the loss and the priors; infinite where a simulation diverges."""

    def condense(self, at: Unknowns) -> Condensed | None:
        """Linearised, None where a perturbed simulation diverges."""

    def moved(self, at: Unknowns, step: Step, length: float) -> Unknowns:
        """The unknowns after a part of a step."""

    def place(self, at: Unknowns) -> Array:
        """(c,) values of the common unknowns."""


@dataclass(frozen=True)
class Progress:
    """One iterate. cost: half of the squares;  size: standard deviations that the last step moved the common unknowns"""

    iteration: int
    cost: float
    size: float


@dataclass(frozen=True, eq=False)
class Solution:
    """Where the search ended. condensed: at the unknowns, or a step of less than the tolerance before them"""

    unknowns: Unknowns
    condensed: Condensed
    cost: float
    iterations: int
    success: bool
    status: str
    interrupted: bool = False


@dataclass(frozen=True)
class Search:
    """How to search. tolerance: standard deviations, a step below which is the last;  damped: False: Gauss-Newton, no bounds

    fresh: linearise once more at the end
    """

    iterations: int = 60
    tolerance: float = 1e-4
    damped: bool = True
    fresh: bool = True


def minimise(
    problem: Problem,
    start: Unknowns,
    search: Search,
    tell: Callable[[Progress], None] | None = None,
) -> Solution | None:
    """From a start to a local minimum; None where the start, or its neighbourhood, diverges. Ctrl-C returns the best so far."""
    now, cost = start, problem.cost(start)
    linear = problem.condense(now) if np.isfinite(cost) else None
    if linear is None:
        return None
    loop = _Loop(problem, search, tell)
    try:
        return loop.run(now, cost, linear)
    except KeyboardInterrupt:
        if loop.best is None:
            raise
        return loop.ended(INTERRUPTED, False, interrupted=True)


def completed(problem: Problem, start: Unknowns, search: Search) -> Solution | None:
    """The same where half a search is none: Ctrl-C is raised anew."""
    found = minimise(problem, start, search)
    if found is not None and found.interrupted:
        raise KeyboardInterrupt
    return found


class _Loop:
    def __init__(
        self, problem: Problem, search: Search, tell: Callable[[Progress], None] | None
    ) -> None:
        self.problem, self.search, self.tell = problem, search, tell
        self.best: tuple[Unknowns, Condensed, float] | None = None
        self.count = 0

    def run(self, now: Unknowns, cost: float, linear: Condensed) -> Solution:
        """All iterations."""
        damping, growth = (FIRST if self.search.damped else 0.0), 2.0
        scale, before, still = linear.lengths, np.inf, 0
        self.best = (now, linear, cost)
        for k in range(1, self.search.iterations + 1):
            self.count = k
            scale = np.maximum(scale, linear.lengths)
            while True:
                step = self._step(now, linear, damping, scale)
                trial, found, length = self._try(now, step, cost)
                ratio = min((cost - found) / max(step.gain, 1e-300), 10.0)
                if found <= cost and (ratio > 1e-4 or self._small(step)):
                    break
                if self._small(step) or damping > MOST or not self.search.damped:
                    return self._stuck(self._promised(now, linear, scale))
                damping, growth = max(damping, 1e-12) * growth, 2.0 * growth
            promised = self._promised(now, linear, scale)
            last = (
                length == 1.0 and damping <= FIRST and self._small(step) and self._small(promised)
            )
            hardly = cost - found <= min(STILL[0] * cost, STILL[1], 0.1 * promised.gain)
            still = still + 1 if hardly else 0
            if still == PATIENCE:
                self.best = (trial, linear, found)
                return self._stuck(promised)
            if not self.search.fresh and length == 1.0:
                last = last or self._nearly(promised, step, before)
            before = step.size
            now, cost = trial, found
            self.best = (now, linear, cost)
            if self.tell is not None:
                self.tell(Progress(self.count, cost, step.size))
            if last:
                return self._concluded(now, cost, linear)
            if self.search.damped:
                damping, growth = (
                    max(damping * max(1.0 / 3.0, 1.0 - (2.0 * ratio - 1.0) ** 3), 1e-15),
                    2.0,
                )
            fresh = self.problem.condense(now)
            if fresh is None:
                return self.ended("stopped: the simulation diverges next to the estimate", False)
            linear = fresh
            self.best = (now, linear, cost)
        return self.ended(f"not converged in {self.search.iterations} iterations", False)

    def _step(self, now: Unknowns, linear: Condensed, damping: float, scale: Array) -> Step:
        room = np.full(linear.common, np.inf)
        lower, upper = -room, room
        if self.search.damped:
            place = self.problem.place(now)
            lower, upper = self.problem.lower - place, self.problem.upper - place
        return linear.step(damping, scale, lower, upper)

    def _promised(self, now: Unknowns, linear: Condensed, scale: Array) -> Step:
        """A step that damping does not shorten: any step is short where it does."""
        return self._step(now, linear, HARDLY if self.search.damped else 0.0, scale)

    def _try(self, now: Unknowns, step: Step, cost: float) -> tuple[Unknowns, float, float]:
        """The unknowns after the step, halved while it raises the cost where nothing else shortens it."""
        length = 1.0
        while True:
            trial = self.problem.moved(now, step, length)
            found = self.problem.cost(trial)
            if self.search.damped or found <= cost or length < 1e-8 or self._small(step):
                return trial, found, length
            length *= 0.5

    def _small(self, step: Step) -> bool:
        return step.size < self.search.tolerance and step.each < 10 * self.search.tolerance

    def _nearly(self, promised: Step, step: Step, before: float) -> bool:
        """Gauss-Newton steps shrink quadratically: a fraction of a deviation now, less than the tolerance next."""
        coming = step.size * (step.size / before) ** 2 if before > 0.0 else np.inf
        whole = promised.size < 1.1 * step.size and promised.each < FRACTION
        return whole and step.size < FRACTION and coming < self.search.tolerance

    def _stuck(self, step: Step) -> Solution:
        """No step helps: where the one promised is short, that is the end."""
        if step.size < FRACTION and step.each < FRACTION:
            return self.ended("converged: the residual stopped falling", True)
        return self.ended(
            "stopped: no step lowers the residual any more, though the linearised model promises one",
            False,
        )

    def _concluded(self, now: Unknowns, cost: float, linear: Condensed) -> Solution:
        fresh = self.problem.condense(now) if self.search.fresh else None
        self.best = (now, fresh or linear, cost)
        return self.ended("converged: the step vanished", True)

    def ended(self, status: str, success: bool, interrupted: bool = False) -> Solution:
        """The best so far."""
        if self.best is None:
            raise ValueError("nothing was found yet")
        unknowns, condensed, cost = self.best
        return Solution(unknowns, condensed, cost, self.count, success, status, interrupted)
