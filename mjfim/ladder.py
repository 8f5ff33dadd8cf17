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

FACTOR = 1.0 / 3.0
RELAXED = 0.3  # delta over mu
WIDEST = 0.1  # delta at most
SHRUNK = np.concatenate([[1.0, 0.997, 0.99, 0.97, 0.94, 0.9], 0.8 ** np.arange(1, 24)])  # of a start, tried in turn
HOLDING = 4e-3  # mu from which on leaks are answered
SPARE = 1.2  # what was outside at the end of a rung is held back on the next by that much of it
AGAIN = 3  # times that the last rung is repeated because of leaks, at most
ROUNDS = 60  # iterations towards the inside


@dataclass(frozen=True)
class Rungs:
    """first, last: mu;  patience: iterations per rung at most;  settled: slope over mu at which a rung is done

    tolerance: slope at which the last one is
    """

    first: float = 0.1
    last: float = 1e-4
    patience: int = 40
    settled: float = 2.0
    window: int = 8
    tolerance: float = 1e-5


@dataclass(frozen=True, eq=False)
class Rung:
    """An iterate on the ladder. margins: worst of each kind;  status: set on the very last one"""

    iterate: Iterate[InteriorPoint]
    mu: float
    margins: dict[str, float]
    status: Status | None = None

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

    def climb(
        self, control: Array, budget: int, until: float = np.inf, held: Mapping[str, float] | None = None
    ) -> Iterator[Rung]:
        """Every iterate from a control: (N, nu), at most `budget`, until a time of `time.perf_counter`.

        held: shares held back from the bounds at first
        """
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
        yield from self._down(start, direction, budget, until, dict(held or {}))

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
        for iterate in optimize(problem, problem.point(control), direction, self.regulate, Armijo(), 1e-6, ROUNDS):
            margins = self.fence.margins(seen(iterate.point))
            rung = Rung(iterate, np.inf, margins)
            yield rung
            if all(m > 0.0 for m in margins.values()) or time.perf_counter() > until:
                return

    def _down(
        self, control: Array, direction: StructuredBFGS, budget: int, until: float, held: dict[str, float]
    ) -> Iterator[Rung]:
        r, mu = self.rungs, self.rungs.first
        problem = InteriorProblem(self.base, self.fence, mu, WIDEST)
        point = problem.point(control)
        done, again = 0, 0
        while True:
            last = mu <= r.last
            problem = replace(problem, mu=mu, delta=min(WIDEST, RELAXED * mu), fence=self.fence.tightened(held))
            point = problem.again(point)
            patience = min(r.patience * (2 if last else 1), budget - done)
            values: list[float] = []
            for iterate in optimize(problem, point, direction, self.regulate, Armijo(), r.tolerance, patience):
                values.append(iterate.value)
                point, status = iterate.point, iterate.status
                margins = self.fence.margins(seen(point))
                late = time.perf_counter() > until
                ended = status if status is not None and (last or done + iterate.index >= budget) else None
                if ended is Status.CONVERGED and any(m < 0.0 for m in margins.values()) and again < AGAIN:
                    ended = None
                yield Rung(
                    replace(iterate, index=done + iterate.index), mu, margins, Status.MAX_ITERATIONS if late else ended
                )
                if late:
                    return
                if not last and len(values) > r.window and values[-1 - r.window] - values[-1] < r.settled * mu:
                    break
            done += iterate.index
            if mu <= HOLDING:
                held = held_back(held, self.fence.shares(seen(point)))
            if any(m < 0.0 for m in self.fence.margins(seen(point)).values()) and not late:
                yield from self._mended(problem, iterate, mu, done)
            outside = any(m < 0.0 for m in self.fence.margins(seen(point)).values())
            if done >= budget or (last and (not outside or again >= AGAIN)):
                return
            again += last
            mu = max(mu * FACTOR, r.last)

    def _mended(
        self, problem: InteriorProblem, iterate: Iterate[InteriorPoint], mu: float, done: int
    ) -> Iterator[Rung]:
        """An iterate that leaks, shrunk until it does not: the best so far in case that nothing follows."""
        control = self.inside(iterate.point.ctrl)
        if control is not None:
            point = replace(problem, fence=self.fence).point(control)
            if point.sight is not None:
                own = replace(iterate, index=done, point=point, value=problem.value(point), gamma=0.0, status=None)
                yield Rung(own, mu, self.fence.margins(point.sight))


def held_back(held: Mapping[str, float], shares: Mapping[str, float]) -> dict[str, float]:
    """How far each kind is held back from its bounds next: more where it was outside, less where it was well inside."""
    return {
        kind: max(0.0, held.get(kind, 0.0) - share * (SPARE if share < 0.0 else 0.5)) for kind, share in shares.items()
    }
