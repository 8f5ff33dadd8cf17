"""What else could be played: ways to spend a budget of seconds and MuJoCo steps on finding a control of an experiment.

All look for it under the same limits, on the same plant, by the same cost J. Chirps, multisines and random steps are
searched at random over the few numbers that they are made of, each scaled up to the limits; `series` has the others.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

import numpy as np
from threadpoolctl import threadpool_limits

from mjfim.arrays import Array
from mjfim.excitation.bandwidth import bandwidth_basis
from mjfim.signals import Chirp, Excitation, ExcitationSettings, Multisine, RandomSteps
from mjfim.studies.baselines.budget import Arena, Attempt, Job, Monitor, Spent
from mjfim.studies.baselines.parametric import (
    BASES,
    KNOTS,
    Optimiser,
    fourier,
    own,
    scipy_determinant,
    scipy_own,
    splines,
    tournament,
)

CYCLES = 40.0  # within the horizon, at most
LARGEST = 6.0  # size of a control where nothing bounds it, over that of the initial one
BOUNDED = 2.0  # the same where a range does, over half of it
SOFTEST = 0.03  # the same where weights make the best one smaller
STRAY = 0.3  # share of the tries that look anywhere, not about the best
MUTATED = 0.3  # share of the numbers that change about the best


@dataclass(frozen=True)
class Baseline:
    """title: in tables;  run: spends the budget;  limited: whether it makes sense under hard limits alone"""

    title: str
    run: Callable[[Arena], None]
    limited: bool = False


def perform(job: Job, monitor: Monitor | None = None) -> Attempt:
    """Run a baseline from beginning to end; may be sent to an executor."""
    with threadpool_limits(1, user_api="blas"):
        arena = Arena(job, monitor)
        with suppress(Spent):
            METHODS[job.method].run(arena)
        return arena.finished()


def search(arena: Arena, kind: Callable[[ExcitationSettings], Excitation]) -> None:
    """Random search over the numbers of an excitation, about the best or anywhere, until the budget is used up."""
    shaper = Shaper(arena)
    excitation, rng = kind(shaper.frame), arena.rng
    best, cost, spread = np.zeros(0), np.inf, 0.3
    while True:
        arena.require()
        z = rng.random(
            1 + excitation.parameter_count
        )  # the first one: how large, where weights decide that
        about = len(best) > 0 and rng.random() > STRAY
        if about:
            changed = rng.random(len(z)) < max(MUTATED, 2.0 / len(z))
            z = reflected(best + spread * changed * rng.normal(size=len(z)))
        swing = shaper.swing(excitation.curve(z[1:]))
        scale = arena.largest(swing, shaper.most)
        if scale == 0.0:
            continue
        if shaper.weighted:
            scale *= SOFTEST ** (1.0 - z[0])
        found = arena.offer(arena.looking.point(arena.centre + scale * swing))
        if about:
            spread = float(np.clip(spread * (1.5 if found < cost else 0.93), 0.01, 0.5))
        if found < cost:
            best, cost = z, found


def reflected(z: Array) -> Array:
    """Numbers put back between 0 and 1 as by mirrors there."""
    return np.asarray(1.0 - np.abs(1.0 - np.abs(z) % 2.0))


class Shaper:
    """Makes waves fit an experiment: from rest to rest, within the bandwidth, as large as the limits allow.

    weighted: the cost has weights, which may make a smaller control the better one
    """

    def __init__(self, arena: Arena) -> None:
        self.arena = arena
        task, constraints = arena.task, arena.constraints
        e = task.experiment
        fastest = min(e.limits.bandwidth or np.inf, 0.25 * e.rate, CYCLES / task.horizon)
        jumps = (
            constraints.rate is None and e.limits.bandwidth is None and e.boundary.start != "rest"
        )
        self.frame = ExcitationSettings(
            t=task.t,
            horizon=task.horizon,
            nu=len(task.controls),
            min_frequency=min(0.5 / task.horizon, fastest),
            max_frequency=fastest,
            may_jump=jumps,
        )
        self.weighted = bool(task.control_weight.any() or task.tracking.any()) or not arena.holds
        self.most = BOUNDED if np.isfinite(constraints.control.bounds.lower).all() else LARGEST
        self.window = task.fade(task.samples)
        self.basis = bandwidth_basis(task, task.t)
        self.fit = None if self.basis is None else np.linalg.pinv(self.basis)

    def swing(self, wave: Array) -> Array:
        """(N, nu) what is added to the centre; at scale 1 as large as half of the controls' range."""
        windowed = self.window * wave * self.arena.constraints.control.bounds.scale
        return (
            windowed
            if self.basis is None or self.fit is None
            else np.asarray(self.basis @ (self.fit @ windowed))
        )


def _harmonics(count: int, optimise: Optimiser) -> Callable[[Arena], None]:
    return lambda arena: tournament(arena, fourier(arena, count), len(BASES), optimise)


def _knots(optimise: Optimiser) -> Callable[[Arena], None]:
    return lambda arena: tournament(arena, splines(arena), len(KNOTS), optimise)


METHODS = {
    "chirp": Baseline("chirp", partial(search, kind=Chirp)),
    "multisine": Baseline("multisine (Schroeder)", partial(search, kind=Multisine)),
    "steps": Baseline("random steps", partial(search, kind=RandomSteps)),
    "fourier5": Baseline("Fourier 5", _harmonics(5, scipy_own)),
    "fourier5-D": Baseline("Fourier 5, on D", _harmonics(5, scipy_determinant)),
    "fourier15": Baseline("Fourier 15", _harmonics(15, scipy_own)),
    "splines": Baseline("B-splines", _knots(scipy_own)),
    "splines-D": Baseline("B-splines, on D", _knots(scipy_determinant)),
    "fourier5-mjfim": Baseline("Fourier 5, mjfim's optimiser", _harmonics(5, own), limited=True),
    "fourier15-mjfim": Baseline("Fourier 15, mjfim's optimiser", _harmonics(15, own), limited=True),
}
