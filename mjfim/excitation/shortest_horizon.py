"""`mjfim.shortest_experiment`: the shortest experiment whose design tells every parameter as well as wanted.

Standard deviations fall like T^-1/2 or faster with the duration T, so a secant on their logarithms finds the place where
the worst of them, over the wanted one, is 1. Both ends of the bracket are designs: the one that is returned reaches what
is wanted, and one that is shorter by the tolerance does not.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any, NoReturn

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, MjfimError
from mjfim.excitation.design import Monitor, design_task
from mjfim.excitation.target_accuracy import (
    largest_ratio_to_target,
    require_reachable,
    target_accuracies,
)
from mjfim.excitation.task import DesignTask
from mjfim.excitation.unconstrained import AUTO, COARSEST
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system_tables import Signal
from mjfim.optimize.bracketing import SampleGrid, smallest_feasible
from mjfim.recordings.formats.read import read_table
from mjfim.records.campaign import missed_targets
from mjfim.records.design import Design, Status

LONGER = 4.0  # times the stated horizon: how long an experiment may become
TOLERANCE = 0.02  # of the horizon


class OutOfReachError(ExperimentError):
    """Even the longest experiment does not reach what is wanted."""


@dataclass(frozen=True)
class Tried:
    """A duration that was tried. horizon: [s];  ratio: of the worst predicted σ to the wanted one, infinite without a design

    parameter: whose σ that is;  why: there is no design, or empty
    """

    horizon: float
    ratio: float
    parameter: str = ""
    why: str = ""

    @property
    def reached(self) -> bool:
        """Every parameter as well as wanted."""
        return self.ratio <= 1.0

    def __str__(self) -> str:
        if self.why:
            return f"{self.horizon:g} s: {self.why}"
        return f"{self.horizon:g} s: σ of {self.parameter} is {self.ratio:.3f} × the wanted one"


@dataclass(frozen=True, eq=False)
class ShortestExperiment:
    """The shortest design. experiment: as stated, with its horizon and the repeats that divide it

    design: reaches every wanted σ
    tried: all durations, in their order;  tolerance: [s]
    closed: one that is shorter by no more than the tolerance was tried and does not reach it, or there is none
    """

    experiment: Experiment
    design: Design
    tried: tuple[Tried, ...]
    tolerance: float
    closed: bool

    @property
    def horizon(self) -> float:
        """[s]"""
        return float(self.experiment.horizon or 0.0)

    def summary(self) -> dict[str, Any]:
        """Contents of shortest.json."""
        tried = [
            {"horizon": t.horizon, "ratio": t.ratio, "parameter": t.parameter, "why": t.why}
            for t in self.tried
        ]
        return {
            "horizon": self.horizon,
            "tolerance": self.tolerance,
            "closed": self.closed,
            "tried": tried,
        }

    def __str__(self) -> str:
        below = (
            "nothing shorter was tried" if self.missed is None else f"too short is {self.missed}"
        )
        ended = "" if self.closed else "; the search was interrupted, so it may be shorter still"
        return f"shortest horizon: {self.horizon:g} s ({below}){ended}"

    @property
    def missed(self) -> Tried | None:
        """The longest of the shorter ones that do not reach what is wanted."""
        shorter = [t for t in self.tried if not t.reached and t.horizon < self.horizon]
        return max(shorter, key=lambda t: t.horizon, default=None)


def shortest_experiment(
    experiment: Experiment,
    longest: float | None = None,
    tolerance: float | None = None,
    monitor: Monitor | None = None,
    threads: int | None = None,
    report: Callable[[Tried], None] | None = None,
    executor: Executor | None = None,
) -> ShortestExperiment:
    """Find the shortest horizon whose design is predicted to reach every parameter's `wanted` σ, and that design.

    longest: [s], default four times the experiment's horizon, or as long as its table of the initial control lasts
    tolerance: [s] by how much it may be too long, default 2 % of it, a sample at least
    monitor: called with every iterate of every design;  report: with every duration that was tried
    executor: of `concurrent.futures`, runs several starts under hard limits at once
    Every design starts from that of the nearest duration so far instead of the initial control, and where that does not
    reach, from the initial control as well. Ctrl-C returns the shortest one so far.
    Raises OutOfReachError where even the longest does not reach it, ExperimentError where nothing is wanted.
    """
    return _Hunt(experiment, longest, tolerance, monitor, threads, report, executor).run()


class _Hunt:
    """Designs by number of samples, and the bracket around the shortest one that is good enough."""

    def __init__(
        self,
        experiment: Experiment,
        longest: float | None,
        tolerance: float | None,
        monitor: Monitor | None,
        threads: int | None,
        report: Callable[[Tried], None] | None,
        executor: Executor | None,
    ) -> None:
        if tolerance is not None and not tolerance > 0.0:
            raise ExperimentError(f"shortest: tolerance {tolerance:g} s; it must be > 0")
        self.experiment, self.tolerance = experiment, tolerance
        self.monitor, self.threads, self.report, self.executor = monitor, threads, report, executor
        self.base = DesignTask.resolve(experiment, threads=threads)
        self.wanted = target_accuracies(self.base)
        self.grid = _grid(self.base)
        self.longest = _longest(self.base) if longest is None else longest
        if self.longest * experiment.rate < self.grid.minimum:
            raise ExperimentError(
                f"shortest: longest {self.longest:g} s is less than {self.grid.minimum} samples"
            )
        self.tried: dict[int, Tried] = {}
        self.designs: dict[int, Design] = {}
        self.stopped = False

    def run(self) -> ShortestExperiment:
        """Bracket, then narrow."""
        most = self.grid.round_down(self.longest * self.experiment.rate)
        first = min(self.grid.round_up(self.base.samples), most)
        found, below = smallest_feasible(self.ratio, first, most, self.grid, self.slack)
        if found is None and self.stopped:
            raise KeyboardInterrupt
        if found is None:
            self._fail(most)
        least = found <= self.grid.minimum
        closed = least or (below is not None and found - below <= self.slack(found))
        own, tolerance = self.at(found), self.slack(found) / self.experiment.rate
        return ShortestExperiment(
            own, self.designs[found], tuple(self.tried.values()), tolerance, closed
        )

    def slack(self, samples: int) -> int:
        """Tolerance in samples: no less than the grid resolves."""
        wide = (
            TOLERANCE * samples if self.tolerance is None else self.tolerance * self.experiment.rate
        )
        return max(int(wide + 1e-9), samples - self.grid.round_down(samples - 1))

    def at(self, samples: int) -> Experiment:
        """The experiment with so many samples."""
        dividing = tuple(count for count in self.experiment.descent.repeats if samples % count == 0)
        return self.experiment.replace(
            horizon=samples / self.experiment.rate, descent={"repeats": dividing}
        )

    def ratio(self, samples: int) -> float | None:
        """Largest ratio of a predicted σ to the wanted one with a number of samples; None where its design was interrupted."""
        tried = self._try(samples)
        if tried is None:
            self.stopped = True
            return None
        self.tried[samples] = tried
        if self.report is not None:
            self.report(tried)
        return tried.ratio

    def _try(self, samples: int) -> Tried | None:
        """The better of a design from the nearest one so far and, where that is not good enough, from the initial control."""
        near = min(self.designs, key=lambda n: abs(np.log(n / samples)), default=None)
        tried = self._design(samples, near)
        if near is not None and tried is not None and not tried.reached:
            again = self._design(samples, None)
            if again is None:
                return None
            tried = again if again.ratio <= tried.ratio else tried
        return tried

    def _design(self, samples: int, near: int | None) -> Tried | None:
        """One design of so many samples, its control begun from another one's; kept where it is the best of them."""
        horizon = samples / self.experiment.rate
        try:
            task = self.base.restated(self.at(samples))
            begin = None if near is None else fitted(task, self.designs[near].trajectory.ctrl)
            found = design_task(task, self.monitor, begin, self.executor)
            if found.status is Status.INTERRUPTED:
                return None
            require_reachable(task, found, self.wanted)
        except MjfimError as error:
            if not self.tried:
                raise  # as stated, there is no design
            return Tried(horizon, np.inf, why=str(error))
        if found.status is Status.INFEASIBLE:
            return Tried(horizon, np.inf, why=f"{found.status.value} ({_outside(found)})")
        ratio, j = largest_ratio_to_target(found.final.std, self.wanted)
        if (
            samples not in self.designs
            or ratio < largest_ratio_to_target(self.designs[samples].final.std, self.wanted)[0]
        ):
            self.designs[samples] = found
        return Tried(horizon, ratio, task.parameters.names[j])

    def _fail(self, samples: int) -> NoReturn:
        last, found = self.tried[samples], self.designs.get(samples)
        names = self.base.parameters.names
        far = (
            last.why
            if found is None
            else f"it does not tell {missed_targets(names, found.final.std, self.wanted)}"
        )
        raise OutOfReachError(
            f"{self.experiment.source}: even {last.horizon:g} s is not enough: {far}. Allow a longer experiment (`longest`, "
            "or a longer table of the initial control) or a stronger control, or ask for less; `mjfim check` says how many "
            "repetitions reach it"
        )


def _outside(design: Design) -> str:
    """The limits that a design misses."""
    return ", ".join(
        f"{kind} by {-margin:.3g}" for kind, margin in design.limits.items() if margin < 0.0
    )


def fitted(task: DesignTask, control: Array) -> Array:
    """(N, nu) from the control of another duration: cut or repeated, stretched where it has to keep its end or limits."""
    N, n = task.samples, len(control)
    if n == N:
        return control
    if n > N and task.experiment.boundary.end == "free":
        return control[:N]
    if n < N and not task.is_limited:
        return np.asarray(np.resize(control, (N, control.shape[1])))
    middle, wanted = (np.arange(n) + 0.5) / n, (np.arange(N) + 0.5) / N
    return np.stack([np.interp(wanted, middle, column) for column in control.T], axis=1)


def _grid(task: DesignTask) -> SampleGrid:
    """What coarse levels need: samples that they divide, where they are used."""
    d = task.experiment.descent
    if d.method != "lbfgs":
        return SampleGrid(unit=1, first_multiple=0)
    if d.coarse == "auto":
        return SampleGrid(unit=AUTO, first_multiple=COARSEST * AUTO)
    return SampleGrid(unit=d.coarse, first_multiple=0, minimum=max(d.coarse, 2))


def _longest(task: DesignTask) -> float:
    """[s] that an experiment may last where nobody says it: no longer than its table of the initial control."""
    e, horizon = task.experiment, task.horizon
    wanted = LONGER * horizon
    if isinstance(e.initial.control, Signal):
        return wanted
    columns = read_table(e.directory / str(e.initial.control))
    name = task.controls[0]
    t = columns["t"][np.isfinite(columns[name if name in columns else f"ctrl:{name}"])]
    return max(horizon, min(wanted, float(t[-1] + np.median(np.diff(t)))))
