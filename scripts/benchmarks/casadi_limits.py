"""Peer solver of the hard-limited design: multi-start CasADi + IPOPT on the hand-derived
cart-pendulum.

    maximise lambda_min(I)    subject to    |u_k| <= 5 N, k = 0..N-1,    |s_k| <= 1 m, k = 1..N

I is as in casadi_peer.py, at theta = (2, 1, 1).  Single shooting in the N = 400 controls, compiled
C, exact Hessian of the Lagrangian; IPOPT minimises 100 / lambda_min, whose barrier then acts as a
homotopy.  Every result is feasible: what counts is the best iterate within the limits at all
samples, evaluated anew.

Many local optima lie close together, so starts are searched on a grid with fewer samples (N = 100:
a twelfth of the time per start) and the promising ones refined on the full grid.  With `--search
400` every start is solved in full. Starts are small: from multisines of 0.01 N 75 % reach the best
basin, from 1..5 N 28 %, from 5 N 19 % (150 starts each).

Usage:  python -m scripts.benchmarks casadi_limits --seconds 60 --seed 0 [--processes 2] [--search
400] [--peak 1 5]
"""

from __future__ import annotations

import argparse
import functools
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from scripts.benchmarks import casadi_peer as peer

Array = NDArray[np.float64]

HORIZON = peer.N * peer.DT  # s
FORCE, SLIDE = 5.0, 1.0  # N, m
WITHIN = 1e-8  # N and m beyond the limits that count as inside
SEARCH = 100  # samples of the search grid
SMALL = 0.01  # N, peak of a random start: the smaller, the more often IPOPT ends in the best basin
HARMONICS = 10  # of 1 / HORIZON in a random multisine
TURN = 3.0  # s of search before a start is refined
CLOSE = 0.99  # share of the best lambda_min on the search grid that makes a start promising
# s, standard deviation by which the best control's switches are moved to refine it once more
SHAKE = 0.01
APART = 0.1  # N, mean distance of controls that are not the same optimum
MAX_ITERATIONS = 200
COMMON: dict[str, Any] = {
    "no_nlp_grad": True,
    "calc_lam_p": False,
    "print_time": False,
    "ipopt.print_level": 0,
    "ipopt.sb": "yes",
    "ipopt.max_iter": MAX_ITERATIONS,
    "ipopt.nlp_scaling_method": "none",
    "ipopt.obj_scaling_factor": 100.0,
    "ipopt.bound_relax_factor": 0.0,
}
COLD: dict[str, Any] = {"ipopt.tol": 1e-5}  # from a random start: the default barrier leads
WARM: dict[str, Any] = {
    "ipopt.tol": 1e-6,
    "ipopt.mu_init": 1e-3,
    "ipopt.bound_push": 1e-4,
    "ipopt.bound_frac": 1e-4,
}


# -- random controls
# -----------------------------------------------------------------------------------------------


def multisine(t: Array, rng: np.random.Generator) -> Array:
    """Return ten harmonics of the horizon with random weights and phases at times t [s]."""
    order = np.arange(1, HARMONICS + 1)[:, None]
    phase = rng.uniform(0, 2 * np.pi, (HARMONICS, 1))
    return np.asarray(rng.random(HARMONICS) @ np.sin(2 * np.pi * order * t / HORIZON + phase))


def sine(t: Array, rng: np.random.Generator) -> Array:
    """Return one sine of 0.25..1.25 Hz with random phase at times t [s]."""
    return np.asarray(np.sin(2 * np.pi * rng.uniform(0.25, 1.25) * t + rng.uniform(0, 2 * np.pi)))


def switched(t: Array, times: Array) -> Array:
    """Return 1 at times t [s] before the first of the switching times [s], then -1, then 1, and so
    on.
    """
    return np.asarray((-1.0) ** np.searchsorted(np.sort(times), t, side="right"))


def switches(u: Array) -> Array:
    """Return the times [s] at which a control (samples,) changes sign."""
    return np.asarray(HORIZON / len(u) * (1 + np.flatnonzero(np.diff(np.where(u > 0, 1, -1)))))


def bang_bang(t: Array, rng: np.random.Generator) -> Array:
    """Return +-1 with four to eight random switches, at least 0.1 s apart, at times t [s]."""
    while True:
        times = np.sort(rng.uniform(0, HORIZON, rng.integers(4, 9)))
        if np.diff(np.concatenate([[0.0], times, [HORIZON]])).min() > 0.1:
            return switched(t, times)


STARTS: dict[str, Callable[[Array, np.random.Generator], Array]] = {
    "multisine": multisine,
    "sine": sine,
    "bang-bang": bang_bang,
}


@dataclass(frozen=True)
class Draw:
    """How random starts are drawn: the kind of wave and the range of its peak [N]."""

    kind: str = "multisine"
    peak: tuple[float, float] = (SMALL, SMALL)

    def __post_init__(self) -> None:
        """Check the kind and the range."""
        if self.kind not in STARTS or not 0 < self.peak[0] <= self.peak[1]:
            raise ValueError(
                f"{self}: needs a kind of {sorted(STARTS)} and a peak of 0 < low <= high [N]"
            )


# -- one sampling of the horizon
# -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Grid:
    """The problem with `samples` held controls; functions of (u [N], theta)."""

    samples: int
    value: ca.Function  # 1 / lambda_min, s [m] at samples 1..N, entries of I
    gradient: ca.Function  # 1 / lambda_min and its derivative by u
    slide: ca.Function  # s and ds/du, lower triangular
    hessian: ca.Function  # of the Lagrangian, upper triangle, in IPOPT's signature
    build_seconds: float

    def measure(self, u: Array) -> tuple[float, float]:
        """Return lambda_min and how far a control leaves the limits [N or m], negative inside."""
        cost, slide, _ = self.value(u, peer.ACTUAL)
        return 1 / float(cost), max(np.abs(u).max() - FORCE, np.abs(slide.full()).max() - SLIDE)

    @property
    def t(self) -> Array:
        """Return the times [s] at which the samples begin."""
        return np.asarray(HORIZON / self.samples * np.arange(self.samples), dtype=float)

    def start(self, draw: Draw, rng: np.random.Generator) -> Array:
        """Return a random control [N], shrunk until the cart stays within its limits."""
        wave = STARTS[draw.kind](self.t, rng)
        u = rng.uniform(*draw.peak) / np.abs(wave).max() * wave
        while self.measure(u)[1] > 0:
            u *= 0.95
        return np.asarray(u)

    def hold(self, u: Array) -> Array:
        """Return the same control [N] on this grid, coarser or finer than its own by an integer
        factor.
        """
        if self.samples >= len(u):
            return np.repeat(u, self.samples // len(u))
        return np.asarray(u.reshape(self.samples, -1).mean(axis=1))


def slide_rows(x: ca.MX, u: ca.MX, theta: ca.MX, dt: float) -> ca.MX:
    """Return ds/du (samples, samples) along the states x (4, samples) before each sample, by one
    forward sweep.
    """
    samples, now, held, p = (
        u.shape[0],
        ca.SX.sym("x", peer.NX),
        ca.SX.sym("u"),
        ca.SX.sym("theta", peer.NP),
    )
    after = peer.rk4(now, held, p, dt)
    linear = ca.Function(
        "plain_linear", [now, held, p], [ca.jacobian(after, now), ca.jacobian(after, held)]
    )
    a, b, pick = (
        ca.MX.sym("a", peer.NX, peer.NX),
        ca.MX.sym("b", peer.NX),
        ca.MX.sym("pick", 1, samples),
    )
    columns = ca.MX.sym("columns", peer.NX, samples)
    moved = a @ columns + b @ pick
    sweep = ca.Function("slide_step", [columns, a, b, pick], [moved, moved[0, :]]).mapaccum(
        "slide_sweep", samples
    )
    along = linear.map(samples)(x, u.T, ca.repmat(theta, 1, samples))
    each = ca.DM.eye(samples).full().reshape(1, -1)
    rows = sweep(ca.DM.zeros(peer.NX, samples), along[0], along[1], each)[1]
    return ca.tril(ca.reshape(rows, samples, samples).T)


@functools.cache
def grid(samples: int) -> Grid:
    """Build the functions once per process; needs a C compiler."""
    begin, dt, u, theta = (
        time.perf_counter(),
        HORIZON / samples,
        ca.MX.sym("u", samples),
        ca.MX.sym("theta", peer.NP),
    )
    parts, start = peer.stage(dt), ca.DM([*peer.X0, *([0.0] * (peer.NZ - peer.NX))])
    z = parts.step.mapaccum(samples)(start, u.T, ca.repmat(theta, 1, samples))
    info, slide = ca.sum2(parts.rate.map(samples)(z)), z[0, :].T
    cost, slope, bend = parts.criterion(info)
    before = ca.horzcat(ca.DM(peer.X0), z[: peer.NX, :-1])
    blocks = [
        ca.Function("value", [u, theta], [cost, slide, info]),
        ca.Function("gradient", [u, theta], [cost, ca.gradient(cost, u)]),
        ca.Function("slide_by_u", [u, theta], [slide, slide_rows(before, u, theta, dt)]),
    ]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        value, gradient, by_u, linear, curvature = peer.compile_c(
            [*blocks, parts.linear, parts.curvature], folder
        )
    compiled = replace(parts, linear=linear, curvature=curvature)
    factor, multipliers = ca.MX.sym("factor"), ca.MX.sym("multipliers", samples)
    slopes = peer.Slopes(factor * slope, factor * bend, multipliers, ca.MX(1, 1), ca.MX(1, 1))
    triangle = peer.condensed_hessian(u, theta, z, slopes, compiled)
    hessian = ca.Function("hessian", [u, theta, factor, multipliers], [triangle])
    return Grid(samples, value, gradient, by_u, hessian, time.perf_counter() - begin)


# -- one solve
# -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Solve:
    """One run of IPOPT; the best iterate within the limits, or the last one if there was none."""

    samples: int
    start: int  # number of the random start in its process
    process: int
    information: float  # lambda_min on the grid of this solve
    violation: float  # N or m beyond the limits, negative inside
    iterations: int
    seconds: float
    ended: float  # s since the budget began
    converged: bool
    u: Array  # (samples,) N

    @property
    def feasible(self) -> bool:
        """Whether the limits hold at all samples."""
        return self.violation <= WITHIN


class FeasibleWatch(peer.IterateWatch):
    """IPOPT's iteration callback: keeps the best iterate within the limits, stops at the deadline."""

    def __init__(self, problem: Grid) -> None:
        """Register with CasADi."""
        super().__init__(problem.samples, problem.samples, peer.NP)
        self.problem, self.deadline = problem, np.inf
        self.found: list[
            tuple[float, float, Array]
        ] = []  # time [s], lambda_min, u [N], each better than before

    def eval(self, arg: Sequence[ca.DM]) -> list[int]:
        """Note the iterate and let the solver go on until the deadline."""
        self.note_control(arg[ca.nlpsol_out().index("x")].full().ravel())
        return [int(time.perf_counter() > self.deadline)]

    def note_control(self, u: Array) -> None:
        """Keep a control that is within the limits and better than those before."""
        information, violation = self.problem.measure(u)
        if violation <= WITHIN and information > (self.found[-1][1] if self.found else 0.0):
            self.found.append((time.perf_counter(), information, u))


@functools.cache
def solver(samples: int, warm: bool) -> tuple[ca.Function, FeasibleWatch]:
    """Return IPOPT on a grid, and its watch."""
    problem = grid(samples)
    u, theta, watch = ca.MX.sym("u", samples), ca.MX.sym("theta", peer.NP), FeasibleWatch(problem)
    derivatives = {"grad_f": problem.gradient, "jac_g": problem.slide, "hess_lag": problem.hessian}
    options = {**COMMON, **(WARM if warm else COLD), **derivatives, "iteration_callback": watch}
    cost, slide, _ = problem.value(u, theta)
    return ca.nlpsol(
        "limited", "ipopt", {"x": u, "p": theta, "f": cost, "g": slide}, options
    ), watch


# -- the race
# ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class LimitedRun:
    """Outcome of a multi-start. history: (seconds, lambda_min) of every better control on the full
    grid.
    """

    best: Solve | None
    searched: tuple[Solve, ...]
    refined: tuple[Solve, ...]
    history: tuple[tuple[float, float], ...]
    build_seconds: float  # differentiation, C generation and compilation, before the budget began

    def information_at(self, seconds: float) -> float:
        """Return the best lambda_min found within so many seconds, 0 if none."""
        return max((value for t, value in self.history if t <= seconds), default=0.0)


class Race:
    """Random starts on the search grid, the promising ones refined on the full grid, until the time
    is used.
    """

    def __init__(
        self, seconds: float, search: int, draw: Draw, process: int, seed: np.random.SeedSequence
    ) -> None:
        """Build the grids, then start the clock."""
        begin = time.perf_counter()
        for samples, warm in ((search, False), (peer.N, True)):
            solver(samples, warm)
        self.begin = time.perf_counter()
        self.build_seconds, self.deadline = self.begin - begin, self.begin + seconds
        self.search, self.draw, self.process, self.rng = (
            search,
            draw,
            process,
            np.random.default_rng(seed),
        )
        self.searched: list[Solve] = []
        self.refined: list[Solve] = []
        self.history: list[tuple[float, float]] = []

    def solve(self, samples: int, warm: bool, start: int, u: Array) -> Solve:
        """Run IPOPT from u [N] until it converges or the deadline is reached."""
        run, watch = solver(samples, warm)
        watch.deadline, watch.found = self.deadline, []
        begin = time.perf_counter()
        solution = run(x0=u, p=peer.ACTUAL, lbx=-FORCE, ubx=FORCE, lbg=-SLIDE, ubg=SLIDE)
        last, end = solution["x"].full().ravel(), time.perf_counter()
        watch.note_control(last)
        u = watch.found[-1][2] if watch.found else last
        if samples == peer.N:
            self.history += [(t - self.begin, value) for t, value, _ in watch.found]
        stats, (information, violation) = run.stats(), grid(samples).measure(u)
        iterations, converged = int(stats["iter_count"]), bool(stats["success"])
        times = end - begin, end - self.begin
        return Solve(
            samples, start, self.process, information, violation, iterations, *times, converged, u
        )

    def promising(self) -> Solve | None:
        """Return the best searched optimum that is near the best of all and was not refined, nor
        one like it.
        """
        taken = {solve.start for solve in self.refined}
        known = [solve.u for solve in self.searched if solve.start in taken]
        least = CLOSE * max(
            (solve.information for solve in self.searched if solve.feasible), default=0.0
        )
        for candidate in sorted(self.searched, key=lambda solve: -solve.information):
            near = any(
                min(np.abs(candidate.u - u).mean(), np.abs(candidate.u + u).mean()) < APART
                for u in known
            )
            if (
                candidate.feasible
                and candidate.information >= least
                and candidate.start not in taken
                and not near
            ):
                return candidate
        return None

    def moved(self, u: Array) -> Array:
        """Return a control (400,) as +-5 N with its switches moved a little."""
        times = switches(u)
        times += SHAKE * self.rng.standard_normal(len(times))
        return np.asarray(np.copysign(FORCE, u[0]) * switched(grid(peer.N).t + peer.DT / 2, times))

    def refine(self) -> None:
        """Refine the most promising start; when none is left, the best control once more."""
        if (candidate := self.promising()) is not None:
            u = grid(peer.N).hold(candidate.u)
        elif done := [solve for solve in self.refined if solve.feasible]:
            candidate = max(done, key=lambda solve: solve.information)
            u = self.moved(candidate.u)
        if candidate is not None:
            self.refined.append(self.solve(peer.N, True, candidate.start, u))

    def run(self) -> LimitedRun:
        """Search for a turn, refine once, and so on."""
        turn = 0.0
        while time.perf_counter() < self.deadline:
            if turn < TURN:
                u = grid(self.search).start(self.draw, self.rng)
                self.searched.append(self.solve(self.search, False, len(self.searched), u))
                turn += self.searched[-1].seconds
            else:
                self.refine()
                turn = 0.0
        found = tuple(self.searched), tuple(self.refined), tuple(self.history)
        return merged([LimitedRun(None, *found, self.build_seconds)])


def merged(runs: Sequence[LimitedRun]) -> LimitedRun:
    """Return several processes' outcomes as one."""
    searched = tuple(solve for run in runs for solve in run.searched)
    refined = tuple(solve for run in runs for solve in run.refined)
    full = [solve for solve in (*searched, *refined) if solve.samples == peer.N and solve.feasible]
    best = max(full, key=lambda solve: solve.information, default=None)
    history: list[tuple[float, float]] = []
    for seconds, value in sorted(pair for run in runs for pair in run.history):
        if not history or value > history[-1][1]:
            history.append((seconds, value))
    return LimitedRun(
        best, searched, refined, tuple(history), max(run.build_seconds for run in runs)
    )


def race(
    seconds: float, search: int, draw: Draw, process: int, seed: np.random.SeedSequence
) -> LimitedRun:
    """Run one process's share."""
    return Race(seconds, search, draw, process, seed).run()


def limited_starts(
    seconds: float, seed: int, processes: int = 1, search: int = SEARCH, draw: Draw | None = None
) -> LimitedRun:
    """Solve from random starts until `seconds` of wall time are used in each process; building
    comes before.

    search: samples of the grid on which starts are first solved, a divisor of 400;  draw: how
    starts are drawn
    """
    if search < 1 or peer.N % search:
        raise ValueError(f"search = {search}: needs a divisor of {peer.N}")
    draw, seeds = draw or Draw(), np.random.SeedSequence(seed).spawn(processes)
    if processes == 1:
        return race(seconds, search, draw, 0, seeds[0])
    with ProcessPoolExecutor(processes) as pool:
        tasks = [pool.submit(race, seconds, search, draw, i, own) for i, own in enumerate(seeds)]
        return merged([task.result() for task in tasks])


def show(run: LimitedRun, seconds: float) -> None:
    """Print every solve, the best lambda_min by time and the switches of the best control."""
    print(
        f"built in {run.build_seconds:.1f} s; {len(run.searched)} starts, {len(run.refined)} "
        "refined"
    )
    print("          process  start  lambda_min  violation  iter      s    at s")
    for name, solves in (("searched", run.searched), ("refined", run.refined)):
        for r in solves:
            result = (
                f"{r.process:7d}  {r.start:5d}  {r.information:10.3f}  {r.violation:9.1e}  "
                f"{r.iterations:4d}"
            )
            note = "" if r.converged else "  not converged"
            print(f"{name:8}  {result}  {r.seconds:5.1f}  {r.ended:6.1f}{note}")
    marks = [t for t in (10.0, 30.0, 60.0, 120.0) if t < seconds] + [np.inf]
    print(
        "best after "
        + ", ".join(f"{min(t, seconds):g} s: {run.information_at(t):.3f}" for t in marks)
    )
    if run.best is not None:
        print("switches of the best [s]: " + " ".join(f"{t:.2f}" for t in switches(run.best.u)))


def main() -> None:
    """Solve as the command line says."""
    parser = argparse.ArgumentParser(
        description="Multi-start of the hard-limited design with CasADi + IPOPT."
    )
    parser.add_argument("--seconds", type=float, default=60.0, help="wall time after building")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument(
        "--search", type=int, default=SEARCH, help="samples of the search grid, a divisor of 400"
    )
    parser.add_argument("--starts", choices=sorted(STARTS), default="multisine")
    parser.add_argument(
        "--peak", type=float, nargs=2, default=(SMALL, SMALL), help="range of the starts' peak [N]"
    )
    parser.add_argument("--save", help="write the best control [N] to this .npy file")
    given = parser.parse_args()
    draw = Draw(given.starts, tuple(given.peak))
    run = limited_starts(given.seconds, given.seed, given.processes, given.search, draw)
    show(run, given.seconds)
    if given.save and run.best is not None:
        np.save(given.save, run.best.u)
