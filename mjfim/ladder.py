"""The way to a design under hard limits: first inside, then down a ladder of ever sharper barriers."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from mjfim.fence import Fence
from mjfim.interior import InteriorPoint, InteriorProblem, seen
from mjfim.newton import StructuredBFGS
from mjfim.objective import DesignProblem
from mjfim.pronto import Armijo, Iterate, Regulator, optimize
from mjfim.trajectory import Array, Status

FACTOR = 3.0  # between rungs
RELAXED = 0.3  # delta over mu
WIDEST = 0.1  # delta at most
SHRUNK = np.concatenate([[1.0, 0.997, 0.99, 0.97, 0.94, 0.9], 0.8 ** np.arange(1, 24)])  # of a start, tried in turn
HOLDING = 4e-3  # mu from which on leaks are answered
SPARE = 1.2  # what was outside at the end of a rung is held back on the next by that much of it
SLACK = 1.5  # of the time that is left per rung, what one may take
AGAIN = 3  # times that the last rung is repeated because of leaks, at most
ROUNDS = 60  # iterations towards the inside


@dataclass(frozen=True)
class Rungs:
    """first, last: mu;  patience: iterations per rung at most, twice as many on the last

    settled: progress over `window` iterations, over mu, below which a rung is done;  tolerance: slope at which the last is
    """

    first: float = 0.1
    last: float = 1e-4
    patience: int = 40
    settled: float = 2.0
    window: int = 8
    tolerance: float = 1e-5

    def ladder(self) -> list[float]:
        """Every mu, from the first to the last."""
        count = max(round(np.log(self.first / self.last) / np.log(FACTOR)), 1)
        return [float(mu) for mu in np.geomspace(self.first, self.last, count + 1)]


@dataclass(frozen=True, eq=False)
class Rung:
    """An iterate on the ladder. margins: worst of each kind;  status: set on the very last one

    mended: no iterate, but the one before shrunk until it kept all limits
    """

    iterate: Iterate[InteriorPoint]
    mu: float
    margins: dict[str, float]
    status: Status | None = None
    mended: bool = False

    @property
    def feasible(self) -> bool:
        """Inside all limits."""
        return all(margin >= 0.0 for margin in self.margins.values())


@dataclass
class Ladder:
    """One descent. base: the cost on the lifted plant;  basis: (N, M) what the control minus centre is made of, or None

    centre: (nu,) control about which a start is shrunk until it is inside
    """

    base: DesignProblem
    fence: Fence
    centre: Array
    basis: Array | None
    regulate: Regulator
    rungs: Rungs = Rungs()

    def climb(self, control: Array, budget: int, until: float = np.inf) -> Iterator[Rung]:
        """Every iterate from a control: (N, nu), at most `budget`, until a time of `time.perf_counter`."""
        start = self.inside(control)
        direction = self._direction()
        if start is None:
            point = None
            for rung in self._steered(self._fitted(control), direction, until):
                yield rung
                point = rung.iterate.point
                budget -= 1
            if point is None:
                return
            start = point.ctrl
            direction = self._direction()
        yield from self._down(start, direction, budget, until)

    def _direction(self) -> StructuredBFGS:
        N = len(self.base.running.desired) - 1
        ridge = 0.03 / N / self.fence.control.scale**2
        return StructuredBFGS(ridge, self.basis)

    def _fitted(self, control: Array) -> Array:
        """The nearest control that the basis can make."""
        if self.basis is None:
            return control
        return np.asarray(self.centre + self.basis @ np.linalg.lstsq(self.basis, control - self.centre)[0])

    def inside(self, control: Array) -> Array | None:
        """The control shrunk about the centre until all limits hold; None where even the least one leaves them."""
        fitted = self._fitted(control)
        problem = InteriorProblem(self.base, self.fence, 1.0, WIDEST, costs=False)
        for share in SHRUNK:
            candidate = self.centre + share * (fitted - self.centre)
            point = problem.point(candidate)
            if point.sight is not None and all(m > 0.0 for m in self.fence.margins(point.sight).values()):
                return np.asarray(candidate)
        return None

    def _steered(self, control: Array, direction: StructuredBFGS, until: float) -> Iterator[Rung]:
        """Iterates towards the inside, without any cost."""
        problem = InteriorProblem(self.base, self.fence, 1.0, WIDEST, costs=False)
        begin = problem.point(control)
        if begin.sight is None:  # it diverges
            return
        for iterate in optimize(problem, begin, direction, self.regulate, Armijo(), 1e-6, ROUNDS):
            margins = self.fence.margins(seen(iterate.point))
            rung = Rung(iterate, np.inf, margins)
            yield rung
            if all(m > 0.0 for m in margins.values()) or time.perf_counter() > until:
                return

    def _down(self, control: Array, direction: StructuredBFGS, budget: int, until: float) -> Iterator[Rung]:
        r, held = self.rungs, dict[str, float]()
        ladder, done = r.ladder(), 0
        point = InteriorProblem(self.base, self.fence, r.first, WIDEST).point(control)
        for i, mu in enumerate([*ladder, *ladder[-1:] * AGAIN]):
            left, last, now = max(len(ladder) - i, 1), i >= len(ladder) - 1, time.perf_counter()
            deadline = until if last else min(until, now + SLACK * (until - now) / left)
            patience = min(r.patience * (2 if last else 1), -(-(budget - done) // left) if left > 1 else budget - done)
            fence = self.fence.tightened(held)
            problem = InteriorProblem(self.base, fence, mu, min(WIDEST, RELAXED * mu))
            point = problem.again(point)
            values: list[float] = []
            tight = min(r.tolerance, Rungs.tolerance)  # what leaks is mended by less slope than many a stated tolerance
            for iterate in optimize(problem, point, direction, self.regulate, Armijo(), tight, patience):
                point, margins = iterate.point, self.fence.margins(seen(iterate.point))
                kept = all(m >= 0.0 for m in margins.values())
                status = Status.CONVERGED if iterate.slope <= r.tolerance else iterate.status
                status = status if last and kept else None
                yield Rung(replace(iterate, index=done + iterate.index), mu, margins, status)
                if status is Status.CONVERGED:
                    return
                values.append(iterate.value)
                settled = len(values) > r.window and values[-1 - r.window] - values[-1] < r.settled * mu
                if time.perf_counter() > deadline or (settled and not last):
                    break
            done += iterate.index
            over = done >= budget or time.perf_counter() > until
            if not kept:
                yield from self._mended(problem, iterate, mu, done)
            if over or (last and kept):
                return
            if mu <= HOLDING:
                held = held_back(held, self.fence.shares(seen(point)))

    def _mended(
        self, problem: InteriorProblem, iterate: Iterate[InteriorPoint], mu: float, done: int
    ) -> Iterator[Rung]:
        """An iterate that leaks, shrunk until it does not: the best so far in case that nothing follows."""
        control = self.inside(iterate.point.ctrl)
        if control is not None:
            point = replace(problem, fence=self.fence).point(control)
            if point.sight is not None:
                own = replace(iterate, index=done, point=point, value=problem.value(point), gamma=0.0, status=None)
                yield Rung(own, mu, self.fence.margins(point.sight), mended=True)


def held_back(held: Mapping[str, float], shares: Mapping[str, float]) -> dict[str, float]:
    """How far each kind is held back from its bounds next: more where it was outside, less where it was well inside."""
    return {
        kind: max(0.0, held.get(kind, 0.0) - share * (SPARE if share < 0.0 else 0.5)) for kind, share in shares.items()
    }
