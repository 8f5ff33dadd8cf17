"""Peer solver of the hard-limited design: CasADi + IPOPT with many starts.

    maximise    lambda_min(I)
    subject to  |u_k| <= 5 N, k = 0..N-1,  and  |s_k| <= 1 m, k = 1..N

The model is the hand-derived cart-pendulum, and I is as in casadi_peer.py, at theta = (2, 1, 1).
The method is single shooting in the N = 400 controls, with compiled C and the exact Hessian of the
Lagrangian. IPOPT minimises 100 / lambda_min, and its barrier leads from easy to hard problems.
Every result is feasible: it is the best iterate within the limits at all samples, evaluated anew.

Many local optima lie close together. Starts are therefore searched on a grid with fewer samples
(N = 100 needs a twelfth of the time for each start), and the promising ones are refined on the full
grid. With `--search 400`, every start is solved on the full grid. Starts are small: from multisines
of 0.01 N, 75 % reach the best optimum, from 1 to 5 N, 28 %, from 5 N, 19 % (150 starts each).

Usage:  python -m scripts.benchmarks casadi_limits --seconds 60 --seed 0 [--processes 2]
        [--search 400] [--peak 1 5]
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

# Duration of the experiment [s].
HORIZON = peer.N * peer.DT

# Limits of the force [N] and of the cart position [m].
FORCE, SLIDE = 5.0, 1.0

# Distance beyond the limits [N or m] that still counts as inside.
WITHIN = 1e-8

# Number of samples of the search grid.
SEARCH = 100

# Peak of a random start [N]; the smaller, the more often IPOPT ends at the best optimum.
SMALL = 0.01

# Number of harmonics of 1 / HORIZON in a random multisine.
HARMONICS = 10

# Time of search before a start is refined [s].
SEARCH_TIME = 3.0

# Share of the best lambda_min on the search grid from which on a start is promising.
CLOSE = 0.99

# Standard deviation by which the switches of the best control are moved to refine it again [s].
SWITCH_DEVIATION = 0.01

# Mean distance of two controls from which on they are different optima [N].
APART = 0.1

# Largest number of iterations of IPOPT.
MAX_ITERATIONS = 200

# Options of IPOPT on both grids.
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

# Further options from a random start, where the default barrier leads.
COLD: dict[str, Any] = {"ipopt.tol": 1e-5}

# Further options from a control that is nearly optimal.
WARM: dict[str, Any] = {
    "ipopt.tol": 1e-6,
    "ipopt.mu_init": 1e-3,
    "ipopt.bound_push": 1e-4,
    "ipopt.bound_frac": 1e-4,
}


# ---- random controls


def multisine(t: Array, rng: np.random.Generator) -> Array:
    """Draw a multisine of ten harmonics of the horizon with random weights and phases.

    Args:
        t: Times [s].
        rng: Source of random numbers.

    Returns:
        Values at these times.
    """
    order = np.arange(1, HARMONICS + 1)[:, None]
    phase = rng.uniform(0, 2 * np.pi, (HARMONICS, 1))
    waves = np.sin(2 * np.pi * order * t / HORIZON + phase)
    return np.asarray(rng.random(HARMONICS) @ waves)


def sine(t: Array, rng: np.random.Generator) -> Array:
    """Draw a sine of 0.25 to 1.25 Hz with random phase.

    Args:
        t: Times [s].
        rng: Source of random numbers.

    Returns:
        Values at these times.
    """
    frequency = rng.uniform(0.25, 1.25)
    phase = rng.uniform(0, 2 * np.pi)
    return np.asarray(np.sin(2 * np.pi * frequency * t + phase))


def switched(t: Array, times: Array) -> Array:
    """Compute a wave that begins with 1 and changes its sign at given times.

    Args:
        t: Times of evaluation [s].
        times: Times of the switches [s], in any order.

    Returns:
        Values 1 or -1.
    """
    count = np.searchsorted(np.sort(times), t, side="right")
    return np.asarray((-1.0) ** count)


def switches(u: Array) -> Array:
    """Return the times [s] at which a control (samples,) changes its sign."""
    sign = np.where(u > 0, 1, -1)
    changes = np.flatnonzero(np.diff(sign))
    return np.asarray(HORIZON / len(u) * (1 + changes))


def bang_bang(t: Array, rng: np.random.Generator) -> Array:
    """Draw a wave of values 1 and -1 with four to eight switches at least 0.1 s apart.

    Args:
        t: Times [s].
        rng: Source of random numbers.

    Returns:
        Values at these times.
    """
    while True:
        times = np.sort(rng.uniform(0, HORIZON, rng.integers(4, 9)))
        pieces = np.diff(np.concatenate([[0.0], times, [HORIZON]]))
        if pieces.min() > 0.1:
            return switched(t, times)


# Kinds of random starts.
STARTS: dict[str, Callable[[Array, np.random.Generator], Array]] = {
    "multisine": multisine,
    "sine": sine,
    "bang-bang": bang_bang,
}


@dataclass(frozen=True)
class StartDistribution:
    """Distribution of the random starts.

    Attributes:
        kind: Key of `STARTS`.
        peak: Range of the peak [N].
    """

    kind: str = "multisine"
    peak: tuple[float, float] = (SMALL, SMALL)

    def __post_init__(self) -> None:
        """Check the kind and the range."""
        if self.kind not in STARTS or not 0 < self.peak[0] <= self.peak[1]:
            raise ValueError(
                f"{self}: needs a kind of {sorted(STARTS)} and a peak of 0 < low <= high [N]"
            )


# ---- one grid of samples


@dataclass(frozen=True)
class Grid:
    """The problem with a number of held controls, as functions of u [N] and theta.

    Attributes:
        samples: Number of samples.
        value: 1 / lambda_min, s [m] at samples 1..N, and the entries of I.
        gradient: 1 / lambda_min and its derivative by u.
        slide: s and ds/du, lower triangular.
        hessian: Upper triangle of the Hessian of the Lagrangian, with the arguments of IPOPT.
        build_seconds: Time to build the functions [s].
    """

    samples: int
    value: ca.Function
    gradient: ca.Function
    slide: ca.Function
    hessian: ca.Function
    build_seconds: float

    def measure(self, u: Array) -> tuple[float, float]:
        """Evaluate a control.

        Args:
            u: (samples,) control [N].

        Returns:
            lambda_min, and the largest distance beyond a limit [N or m], negative inside.
        """
        cost, slide, _ = self.value(u, peer.ACTUAL)
        beyond_force = np.abs(u).max() - FORCE
        beyond_slide = np.abs(slide.full()).max() - SLIDE
        return 1 / float(cost), max(beyond_force, beyond_slide)

    @property
    def t(self) -> Array:
        """Times at which the samples begin [s]."""
        return np.asarray(HORIZON / self.samples * np.arange(self.samples), dtype=float)

    def start(self, distribution: StartDistribution, rng: np.random.Generator) -> Array:
        """Draw a random control, and shrink it until the cart stays within its limits.

        Args:
            distribution: Distribution of the starts.
            rng: Source of random numbers.

        Returns:
            (samples,) control [N].
        """
        wave = STARTS[distribution.kind](self.t, rng)
        u = rng.uniform(*distribution.peak) / np.abs(wave).max() * wave
        while self.measure(u)[1] > 0:
            u *= 0.95
        return np.asarray(u)

    def hold(self, u: Array) -> Array:
        """Transfer a control to this grid.

        Args:
            u: Control [N] on a grid that is coarser or finer by an integer factor.

        Returns:
            (samples,) control [N].
        """
        if self.samples >= len(u):
            return np.repeat(u, self.samples // len(u))
        return np.asarray(u.reshape(self.samples, -1).mean(axis=1))


def slide_rows(x: ca.MX, u: ca.MX, theta: ca.MX, dt: float) -> ca.MX:
    """Build the derivative of the cart positions by the controls by one forward sweep.

    Args:
        x: (4, samples) states before each sample.
        u: (samples,) controls.
        theta: Parameters.
        dt: Sample period [s].

    Returns:
        ds/du: (samples, samples), lower triangular.
    """
    samples = u.shape[0]

    # Jacobians A and B of one sample.
    state = ca.SX.sym("x", peer.NX)
    held = ca.SX.sym("u")
    p = ca.SX.sym("theta", peer.NP)
    after = peer.rk4(state, held, p, dt)
    slopes = [ca.jacobian(after, state), ca.jacobian(after, held)]
    linear = ca.Function("plain_linear", [state, held, p], slopes)

    # One step of the sweep; `pick` selects the column of the sample.
    a = ca.MX.sym("a", peer.NX, peer.NX)
    b = ca.MX.sym("b", peer.NX)
    pick = ca.MX.sym("pick", 1, samples)
    columns = ca.MX.sym("columns", peer.NX, samples)
    moved = a @ columns + b @ pick
    step = ca.Function("slide_step", [columns, a, b, pick], [moved, moved[0, :]])
    sweep = step.mapaccum("slide_sweep", samples)

    along = linear.map(samples)(x, u.T, ca.repmat(theta, 1, samples))
    each = ca.DM.eye(samples).full().reshape(1, -1)
    rows = sweep(ca.DM.zeros(peer.NX, samples), along[0], along[1], each)[1]
    return ca.tril(ca.reshape(rows, samples, samples).T)


@functools.cache
def grid(samples: int) -> Grid:
    """Build the functions of a grid once per process; needs a C compiler."""
    begin = time.perf_counter()
    dt = HORIZON / samples
    u = ca.MX.sym("u", samples)
    theta = ca.MX.sym("theta", peer.NP)

    # States, information and criterion.
    parts = peer.stage(dt)
    z = parts.step.mapaccum(samples)(peer.start_of_sweep(), u.T, ca.repmat(theta, 1, samples))
    info = ca.sum2(parts.rate.map(samples)(z))
    slide = z[0, :].T
    cost, slope, bend = parts.criterion(info)

    # Compiled functions.
    before = ca.horzcat(ca.DM(peer.X0), z[: peer.NX, :-1])
    blocks = [
        ca.Function("value", [u, theta], [cost, slide, info]),
        ca.Function("gradient", [u, theta], [cost, ca.gradient(cost, u)]),
        ca.Function("slide_by_u", [u, theta], [slide, slide_rows(before, u, theta, dt)]),
    ]
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        functions = peer.compile_c([*blocks, parts.linear, parts.curvature], folder)
    value, gradient, by_u, linear, curvature = functions
    compiled = replace(parts, linear=linear, curvature=curvature)

    # Hessian of the Lagrangian; the limits of the controls are linear.
    factor = ca.MX.sym("factor")
    multipliers = ca.MX.sym("multipliers", samples)
    slopes = peer.Slopes(
        info=factor * slope,
        info_bend=factor * bend,
        slide=multipliers,
        slide_bend=ca.MX(1, 1),
        control_bend=ca.MX(1, 1),
    )
    triangle = peer.condensed_hessian(u, theta, z, slopes, compiled)
    hessian = ca.Function("hessian", [u, theta, factor, multipliers], [triangle])

    return Grid(
        samples=samples,
        value=value,
        gradient=gradient,
        slide=by_u,
        hessian=hessian,
        build_seconds=time.perf_counter() - begin,
    )


# ---- one run of IPOPT


@dataclass(frozen=True)
class Solve:
    """One run of IPOPT, with its best iterate within the limits, or the last one if there is none.

    Attributes:
        samples: Number of samples.
        start: Number of the random start in its process.
        process: Number of the process.
        information: lambda_min on the grid of this run.
        violation: Largest distance beyond a limit [N or m], negative inside.
        iterations: Number of iterations.
        seconds: Time of the run [s].
        ended: Time since the start of the budget [s].
        converged: Whether IPOPT converged.
        u: (samples,) control [N].
    """

    samples: int
    start: int
    process: int
    information: float
    violation: float
    iterations: int
    seconds: float
    ended: float
    converged: bool
    u: Array

    @property
    def feasible(self) -> bool:
        """Whether the limits hold at all samples."""
        return self.violation <= WITHIN


@dataclass(frozen=True)
class FeasibleIterate:
    """An iterate within the limits.

    Attributes:
        time: Time on the clock of the process [s].
        information: lambda_min.
        u: (samples,) control [N].
    """

    time: float
    information: float
    u: Array


class FeasibleWatch(peer.IterateWatch):
    """Iteration callback of IPOPT that keeps iterates within the limits and stops at the deadline.

    Attributes:
        problem: Grid of the run.
        deadline: Time on the clock of the process at which the run stops [s].
        found: Iterates within the limits, each better than those before.
    """

    def __init__(self, problem: Grid) -> None:
        """Register with CasADi."""
        super().__init__(problem.samples, problem.samples, peer.NP)
        self.problem = problem
        self.deadline = np.inf
        self.found: list[FeasibleIterate] = []

    def eval(self, arg: Sequence[ca.DM]) -> list[int]:
        """Record the iterate and let the solver continue until the deadline."""
        self.note_control(arg[ca.nlpsol_out().index("x")].full().ravel())
        return [int(time.perf_counter() > self.deadline)]

    def note_control(self, u: Array) -> None:
        """Keep a control that is within the limits and better than those before."""
        information, violation = self.problem.measure(u)
        best = self.found[-1].information if self.found else 0.0
        if violation <= WITHIN and information > best:
            self.found.append(FeasibleIterate(time.perf_counter(), information, u))


@functools.cache
def solver(samples: int, warm: bool) -> tuple[ca.Function, FeasibleWatch]:
    """Build IPOPT on a grid.

    Args:
        samples: Number of samples.
        warm: Whether it starts from a control that is nearly optimal.

    Returns:
        The solver and its callback.
    """
    problem = grid(samples)
    watch = FeasibleWatch(problem)
    options = {
        **COMMON,
        **(WARM if warm else COLD),
        "grad_f": problem.gradient,
        "jac_g": problem.slide,
        "hess_lag": problem.hessian,
        "iteration_callback": watch,
    }

    u = ca.MX.sym("u", samples)
    theta = ca.MX.sym("theta", peer.NP)
    cost, slide, _ = problem.value(u, theta)
    symbols = {"x": u, "p": theta, "f": cost, "g": slide}
    return ca.nlpsol("limited", "ipopt", symbols, options), watch


# ---- many starts


@dataclass(frozen=True)
class LimitedRun:
    """Outcome of a search from many starts.

    Attributes:
        best: Best run on the full grid, None if no run was feasible.
        searched: Runs on the search grid.
        refined: Runs on the full grid.
        history: Time [s] and lambda_min of every better control on the full grid.
        build_seconds: Time of differentiation, C generation and compilation [s], before the budget.
    """

    best: Solve | None
    searched: tuple[Solve, ...]
    refined: tuple[Solve, ...]
    history: tuple[tuple[float, float], ...]
    build_seconds: float

    def information_at(self, seconds: float) -> float:
        """Return the best lambda_min that was found within a time [s], 0 if there is none."""
        values = [value for t, value in self.history if t <= seconds]
        return max(values, default=0.0)


class MultistartSearch:
    """Search from random starts until the time is used up.

    Starts are solved on the search grid, and the promising ones are refined on the full grid.
    """

    def __init__(
        self,
        seconds: float,
        search: int,
        distribution: StartDistribution,
        process: int,
        seed: np.random.SeedSequence,
    ) -> None:
        """Build the grids, then start the clock.

        Args:
            seconds: Time after building [s].
            search: Number of samples of the search grid.
            distribution: Distribution of the random starts.
            process: Number of this process.
            seed: Seed of the random numbers.
        """
        begin = time.perf_counter()
        solver(search, warm=False)
        solver(peer.N, warm=True)
        self.begin = time.perf_counter()
        self.build_seconds = self.begin - begin
        self.deadline = self.begin + seconds

        self.search = search
        self.distribution = distribution
        self.process = process
        self.rng = np.random.default_rng(seed)
        self.searched: list[Solve] = []
        self.refined: list[Solve] = []
        self.history: list[tuple[float, float]] = []

    def solve(self, samples: int, warm: bool, start: int, u: Array) -> Solve:
        """Run IPOPT until it converges or the deadline is reached.

        Args:
            samples: Number of samples of the grid.
            warm: Whether the control is nearly optimal.
            start: Number of the random start.
            u: (samples,) initial control [N].

        Returns:
            The run.
        """
        ipopt, watch = solver(samples, warm)
        watch.deadline = self.deadline
        watch.found = []

        begin = time.perf_counter()
        solution = ipopt(x0=u, p=peer.ACTUAL, lbx=-FORCE, ubx=FORCE, lbg=-SLIDE, ubg=SLIDE)
        last = solution["x"].full().ravel()
        end = time.perf_counter()

        watch.note_control(last)
        best = watch.found[-1].u if watch.found else last
        if samples == peer.N:
            for iterate in watch.found:
                self.history.append((iterate.time - self.begin, iterate.information))

        stats = ipopt.stats()
        information, violation = grid(samples).measure(best)
        return Solve(
            samples=samples,
            start=start,
            process=self.process,
            information=information,
            violation=violation,
            iterations=int(stats["iter_count"]),
            seconds=end - begin,
            ended=end - self.begin,
            converged=bool(stats["success"]),
            u=best,
        )

    def promising(self) -> Solve | None:
        """Return the best optimum of the search that is worth refining.

        It is near the best of all in its information, and neither it nor a similar one was refined.
        """
        taken = {solve.start for solve in self.refined}
        known = [solve.u for solve in self.searched if solve.start in taken]
        values = [solve.information for solve in self.searched if solve.feasible]
        least = CLOSE * max(values, default=0.0)

        for candidate in sorted(self.searched, key=lambda solve: -solve.information):
            is_good = candidate.feasible and candidate.information >= least
            is_new = candidate.start not in taken
            if is_good and is_new and not any(similar(candidate.u, u) for u in known):
                return candidate

        return None

    def moved(self, u: Array) -> Array:
        """Return a control (400,) of 5 and -5 N with its switches moved a little."""
        times = switches(u)
        times += SWITCH_DEVIATION * self.rng.standard_normal(len(times))
        middle = grid(peer.N).t + peer.DT / 2
        return np.asarray(np.copysign(FORCE, u[0]) * switched(middle, times))

    def refine(self) -> None:
        """Refine the most promising start; if none is left, the best control again."""
        candidate = self.promising()
        if candidate is not None:
            u = grid(peer.N).hold(candidate.u)
            self.refined.append(self.solve(peer.N, True, candidate.start, u))
            return

        feasible = [solve for solve in self.refined if solve.feasible]
        if feasible:
            best = max(feasible, key=lambda solve: solve.information)
            self.refined.append(self.solve(peer.N, True, best.start, self.moved(best.u)))

    def run(self) -> LimitedRun:
        """Search for some seconds and refine once, in turns, until the time is used up."""
        searching = 0.0
        while time.perf_counter() < self.deadline:
            if searching < SEARCH_TIME:
                u = grid(self.search).start(self.distribution, self.rng)
                solve = self.solve(self.search, False, len(self.searched), u)
                self.searched.append(solve)
                searching += solve.seconds
            else:
                self.refine()
                searching = 0.0

        found = LimitedRun(
            best=None,
            searched=tuple(self.searched),
            refined=tuple(self.refined),
            history=tuple(self.history),
            build_seconds=self.build_seconds,
        )
        return merged([found])


def similar(one: Array, other: Array) -> bool:
    """Whether two controls (samples,) are one optimum, or its mirror image."""
    distance = min(np.abs(one - other).mean(), np.abs(one + other).mean())
    return bool(distance < APART)


def merged(runs: Sequence[LimitedRun]) -> LimitedRun:
    """Merge the outcomes of several processes."""
    searched = tuple(solve for run in runs for solve in run.searched)
    refined = tuple(solve for run in runs for solve in run.refined)
    full = [solve for solve in (*searched, *refined) if solve.samples == peer.N and solve.feasible]

    history: list[tuple[float, float]] = []
    pairs = [pair for run in runs for pair in run.history]
    for seconds, value in sorted(pairs):
        if not history or value > history[-1][1]:
            history.append((seconds, value))

    return LimitedRun(
        best=max(full, key=lambda solve: solve.information, default=None),
        searched=searched,
        refined=refined,
        history=tuple(history),
        build_seconds=max(run.build_seconds for run in runs),
    )


def run_process(
    seconds: float,
    search: int,
    distribution: StartDistribution,
    process: int,
    seed: np.random.SeedSequence,
) -> LimitedRun:
    """Run the search of one process; the arguments are those of `MultistartSearch`."""
    return MultistartSearch(seconds, search, distribution, process, seed).run()


def limited_starts(
    seconds: float,
    seed: int,
    processes: int = 1,
    search: int = SEARCH,
    distribution: StartDistribution | None = None,
) -> LimitedRun:
    """Solve from random starts until the time of each process is used up.

    Args:
        seconds: Wall time after building [s].
        seed: Seed of the random numbers.
        processes: Number of processes.
        search: Number of samples of the search grid, a divisor of 400.
        distribution: Distribution of the random starts.

    Returns:
        Outcome of all processes.

    Raises:
        ValueError: The number of samples is no divisor of 400.
    """
    if search < 1 or peer.N % search:
        raise ValueError(f"search = {search}: needs a divisor of {peer.N}")

    distribution = distribution or StartDistribution()
    seeds = np.random.SeedSequence(seed).spawn(processes)
    if processes == 1:
        return run_process(seconds, search, distribution, 0, seeds[0])

    with ProcessPoolExecutor(processes) as pool:
        tasks = [
            pool.submit(run_process, seconds, search, distribution, i, child)
            for i, child in enumerate(seeds)
        ]
        return merged([task.result() for task in tasks])


def show(run: LimitedRun, seconds: float) -> None:
    """Print every run, the best lambda_min by time and the switches of the best control."""
    counts = f"{len(run.searched)} starts, {len(run.refined)} refined"
    print(f"built in {run.build_seconds:.1f} s; {counts}")
    print("          process  start  lambda_min  violation  iter      s    at s")

    for name, solves in (("searched", run.searched), ("refined", run.refined)):
        for solve in solves:
            result = (
                f"{solve.process:7d}  {solve.start:5d}  {solve.information:10.3f}  "
                f"{solve.violation:9.1e}  {solve.iterations:4d}"
            )
            note = "" if solve.converged else "  not converged"
            print(f"{name:8}  {result}  {solve.seconds:5.1f}  {solve.ended:6.1f}{note}")

    marks = [t for t in (10.0, 30.0, 60.0, 120.0) if t < seconds] + [np.inf]
    best = [f"{min(t, seconds):g} s: {run.information_at(t):.3f}" for t in marks]
    print("best after " + ", ".join(best))

    if run.best is not None:
        times = [f"{t:.2f}" for t in switches(run.best.u)]
        print("switches of the best [s]: " + " ".join(times))


def main() -> None:
    """Run the search that the command line describes."""
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

    distribution = StartDistribution(given.starts, tuple(given.peak))
    run = limited_starts(given.seconds, given.seed, given.processes, given.search, distribution)
    show(run, given.seconds)
    if given.save and run.best is not None:
        np.save(given.save, run.best.u)
