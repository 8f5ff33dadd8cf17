"""The verb `mjfim.shortest_experiment`: the shortest design that reaches all target accuracies.

Standard deviations fall like T^-1/2 or faster with the duration T. So the secant method on their
logarithms finds the duration at which the largest ratio of a predicted to a target standard
deviation is 1. Both ends of the bracket are designs. The returned one reaches the targets, and one
that is shorter by the tolerance does not.

`mjfim design --shortest` calls the verb. Campaigns use its targets and ratios.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from mjfim import recordings
from mjfim.arrays import Array, record
from mjfim.errors import (
    ExperimentError,
    MjfimError,
    NoResultError,
    UnidentifiableError,
    first_ones,
    listed,
)
from mjfim.excitation.design import design_budget, design_task
from mjfim.excitation.search.levels import MIN_COARSE_SAMPLES, SAMPLE_FACTORS
from mjfim.excitation.task import DesignTask
from mjfim.experiment.arguments import checked
from mjfim.experiment.controls import require_controls
from mjfim.experiment.packing import opened
from mjfim.experiment.schema import Experiment, ExperimentLike
from mjfim.experiment.system_tables import Signal
from mjfim.parallel import ExecutorLike, Workers
from mjfim.parallel.budget import StopToken, stop_on_interrupt
from mjfim.records.base import SavedRecord
from mjfim.records.design import Design, Status
from mjfim.records.events import Callback, StudyEvent, shown_progress
from mjfim.records.studies import missed_targets

# Factor between two successive numbers of samples where the ratio is infinite. An infinite ratio
# does not show how far the target is.
FACTOR_WITHOUT_RATIO = 2.0

# Smallest factor between the first two numbers of samples. It is squared from step to step.
MIN_FIRST_FACTOR = 1.05

# Largest factor between two successive numbers of samples.
MAX_FACTOR = 4.0

# Round-off of a number of samples, before it is rounded [samples].
ROUNDING_TOLERANCE = 1e-9

# Distance of a candidate from the ends of the bracket, relative to the tolerance. It is less than
# 1, so that one evaluation can close the bracket.
END_DISTANCE = 0.9

# Number of evaluations after which the middle of the bracket follows instead of the secant.
MIDDLE_PERIOD = 3

# Longest list of identifiable combinations in a message [characters].
LONGEST_COMBINATIONS = 150

# Ratio of the longest horizon that is tried by default to the stated one.
MAX_HORIZON_FACTOR = 4.0

# Default tolerance of the horizon, relative to the horizon.
DEFAULT_TOLERANCE = 0.02


@record
class SampleGrid:
    """Numbers of samples that an experiment may have.

    Small numbers are all allowed. From `first_multiple` on, only multiples of a unit are allowed.

    Attributes:
        unit: Divisor of all numbers from `first_multiple` on.
        first_multiple: Number of samples from which only multiples of the unit are allowed.
        minimum: Smallest number of samples.
    """

    unit: int
    first_multiple: int
    minimum: int = 2

    def round_down(self, samples: float) -> int:
        """Largest allowed number that is not above a number of samples, or the minimum."""
        n = int(np.floor(samples + ROUNDING_TOLERANCE))
        if n >= self.first_multiple:
            n -= n % self.unit

        return max(n, self.minimum)

    def round_up(self, samples: float) -> int:
        """Smallest allowed number that is not below a number of samples."""
        n = int(np.ceil(samples - ROUNDING_TOLERANCE))
        if n >= self.first_multiple:
            n += -n % self.unit

        return max(n, self.minimum)


def smallest_feasible(
    ratio: Callable[[int], float | None],
    first: int,
    largest: int,
    grid: SampleGrid,
    tolerance: Callable[[int], int],
) -> tuple[int | None, int | None]:
    """Find the smallest number of samples whose ratio is at most 1.

    The search assumes that the ratio falls like the inverse square root of the number of samples,
    or faster. It brackets the number where the ratio is 1, and narrows the bracket by secants.

    Args:
        ratio: Ratio of a predicted to a required standard deviation with a number of samples. It is
            infinite where a parameter is not identifiable, and None ends the search.
        first: Number of samples to begin with, on the grid.
        largest: Largest number of samples, on the grid.
        grid: Numbers that are allowed.
        tolerance: Largest acceptable width of the bracket, as a function of its upper end.

    Returns:
        The smallest evaluated number that is feasible, and the largest one that is infeasible; None
        where there is no such number. After a stop, the bracket may be wider than the tolerance.
    """
    known: dict[int, float] = {}
    feasible: int | None = None
    infeasible: int | None = None
    following: int | None = first
    while following is not None and (value := ratio(following)) is not None:
        known[following] = value
        if value <= 1.0:
            feasible = following
        else:
            infeasible = following

        if feasible is None or infeasible is None:
            following = _next_outside(value, following, len(known), largest, grid)
        else:
            width = tolerance(feasible)
            is_open = feasible - infeasible > width
            following = _next_inside(known, infeasible, feasible, width, grid) if is_open else None
    return feasible, infeasible


def _next_outside(
    ratio: float, samples: int, evaluations: int, largest: int, grid: SampleGrid
) -> int | None:
    """Next number of samples while one end of the bracket is open; None where there is none.

    Args:
        ratio: Ratio at the last number of samples.
        samples: This number.
        evaluations: Number of evaluations so far.
        largest: Largest number of samples, on the grid.
        grid: Numbers that are allowed.
    """
    changed = samples * _step_factor(ratio, evaluations)
    if ratio <= 1.0:
        return grid.round_down(min(changed, samples - 1)) if samples > grid.minimum else None
    larger = grid.round_up(max(changed, samples + 1))
    return min(larger, largest) if samples < largest else None


def _step_factor(ratio: float, evaluations: int) -> float:
    """Factor from one number of samples to the next one, while one end of the bracket is open."""
    if not np.isfinite(ratio):
        return FACTOR_WITHOUT_RATIO
    least = min(MIN_FIRST_FACTOR**2.0 ** (evaluations - 1), MAX_FACTOR)
    if ratio <= 1.0:
        return float(np.clip(ratio**2, 1.0 / MAX_FACTOR, 1.0 / least))
    return float(np.clip(ratio**2, least, MAX_FACTOR))


def _secant_or_middle(known: dict[int, float], low: int, high: int) -> float:
    """Where the secant of the logarithms of the ratios reaches 1, or the middle of a bracket."""
    has_secant = np.isfinite(known[low]) and known[high] < known[low]
    if has_secant and len(known) % MIDDLE_PERIOD:
        share = np.log(known[low]) / np.log(known[low] / known[high])
        return float(low * (high / low) ** share)
    return float(np.sqrt(low * high))


def _next_inside(
    known: dict[int, float], low: int, high: int, width: int, grid: SampleGrid
) -> int | None:
    """Next number of samples inside a bracket, by the secant of logarithms or in its middle.

    None where no number of the grid is inside.
    """
    x = _secant_or_middle(known, low, high)
    # A candidate near an end closes the bracket if the ratio is 1 between this end and it.
    if high - low > 2 * width:
        x = float(np.clip(x, low + END_DISTANCE * width, high - END_DISTANCE * width))
    n = grid.round_up(x) if x * x > low * high else grid.round_down(x)
    if n <= low:
        n = grid.round_up(low + 1)
    if n >= high:
        n = grid.round_down(high - 1)
    return n if low < n < high else None


def target_accuracies(task: DesignTask) -> Array:
    """Collect the target standard deviations that the experiment of a task states.

    Returns:
        (p,) standard deviations [theta-unit], infinite for a parameter without a target.

    Raises:
        ExperimentError: No parameter states a target.
    """
    wanted = task.parameters.wanted
    if np.isinf(wanted).all():
        tables = task.experiment.parameters.items()
        name = next((n for n, table in tables if table.inertial is None), "<name>")
        raise ExperimentError(
            f"{task.experiment.source}: no parameter states which standard deviation is wanted; "
            f"state it in the parameter's unit, for example parameters.{name}.wanted = 0.01"
        )
    return wanted


def largest_ratio_to_target(std: Array, wanted: Array) -> tuple[float, int]:
    """Compute the largest ratio of a standard deviation to its target.

    Args:
        std: (p,) standard deviations [theta-unit].
        wanted: (p,) targets, infinite where there is none [theta-unit].

    Returns:
        The ratio, at most 1 where all targets are reached, and the index of its parameter.
    """
    ratio = np.divide(std, wanted, out=np.zeros(len(std)), where=np.isfinite(wanted))
    return float(ratio.max()), int(np.argmax(ratio))


def require_reachable(task: DesignTask, design: Design, wanted: Array) -> None:
    """Require that repetitions of a design can reach every target.

    Args:
        task: The task.
        design: A design of the task.
        wanted: (p,) targets, infinite where there is none [theta-unit].

    Raises:
        UnidentifiableError: A parameter with a target cannot be identified by itself.
    """
    unreachable = np.flatnonzero(np.isfinite(wanted) & ~np.isfinite(design.stated_std))
    if not len(unreachable):
        return

    names = listed([task.parameters.names[j] for j in unreachable])

    # A single combination of many parameters is too long for a message.
    known, words = "", first_ones(design.combinations, "; ", LONGEST_COMBINATIONS)
    if design.combinations:
        known = f": {words}"
    if len(words) > 2 * LONGEST_COMBINATIONS:
        known = " (`mjfim check` shows the combinations that it does identify)"

    raise UnidentifiableError(
        f"{task.experiment.source}: no standard deviation of {names} can be reached, because this "
        f"experiment does not identify every parameter by itself{known}. Remove one of them, give "
        "it a prior, or measure another quantity"
    )


class OutOfReachError(ExperimentError):
    """Even the longest experiment misses a target standard deviation."""


@record
class Tried:
    """A duration that was tried.

    Attributes:
        horizon: The duration [s].
        ratio: Largest ratio of a predicted to a target standard deviation; infinite without a
            design.
        parameter: Name of the parameter with this ratio.
        why: Reason why there is no design; empty where there is one.
    """

    horizon: float
    ratio: float
    parameter: str = ""
    why: str = ""

    @property
    def reached(self) -> bool:
        """True where every target is reached."""
        return self.ratio <= 1.0

    def __str__(self) -> str:
        if self.why:
            return f"{self.horizon:g} s: {self.why}"

        return f"{self.horizon:g} s: σ of {self.parameter} is {self.ratio:.3f} × its target"


@dataclass(frozen=True, kw_only=True, eq=False)
class ShortestExperiment(SavedRecord):
    """The shortest experiment and its design.

    Attributes:
        experiment: The experiment as stated, with its new horizon and those repeats that divide it.
        design: Its design, which reaches every target where `reached` is true.
        tried: All durations in the order in which they were tried.
        tolerance: Largest difference of the horizon from the shortest possible one, where `closed`
            is true [s].
        closed: True where a duration that is shorter by no more than the tolerance does not reach
            the targets, or where there is no shorter one.
    """

    experiment: Experiment
    design: Design
    tried: tuple[Tried, ...]
    tolerance: float
    closed: bool

    file_stem = "shortest"
    made_by = "`mjfim design EXPERIMENT -o DIR --shortest`"

    @property
    def horizon(self) -> float:
        """Duration of the experiment [s]."""
        return float(self.experiment.horizon or 0.0)

    @property
    def reached(self) -> bool:
        """True where the design reaches every target; False only after an early stop."""
        return any(tried.reached for tried in self.tried)

    @property
    def missed(self) -> Tried | None:
        """The longest of the shorter durations that do not reach the targets."""
        shorter = [each for each in self.tried if each.horizon < self.horizon and not each.reached]
        return max(shorter, key=lambda tried: tried.horizon, default=None)

    def summary(self) -> dict[str, Any]:
        """Return the contents of shortest.json."""
        return {
            "horizon": self.horizon,
            "tolerance": self.tolerance,
            "closed": self.closed,
            "tried": [asdict(tried) for tried in self.tried],
        }

    def __str__(self) -> str:
        if not self.reached:
            closest = min(self.tried, key=lambda tried: tried.ratio)
            return (
                "the search was interrupted before any horizon reached the wanted accuracy; the "
                f"best so far is {closest}"
            )

        below = "nothing shorter was tried"
        if self.missed is not None:
            below = f"too short is {self.missed}"

        ending = ""
        if not self.closed:
            ending = "; the search was interrupted, so a shorter one may exist"
        return f"shortest horizon: {self.horizon:g} s ({below}){ending}"


@checked
def shortest_experiment(
    experiment: ExperimentLike,
    *,
    longest: float | None = None,
    tolerance: float | None = None,
    callback: Callback | None = None,
    threads: int | None = None,
    executor: ExecutorLike | None = None,
    stop: StopToken | None = None,
    progress: bool = True,
) -> ShortestExperiment:
    """Find the shortest experiment whose design is predicted to reach all target accuracies.

    Every design begins with the control of the design of the nearest duration so far. Where the
    result does not reach the targets, a second design begins with the initial control.

    Args:
        experiment: The experiment; at least one parameter states `wanted`.
        longest: Longest horizon [s]; default: four times that of the experiment, but no longer than
            the table of its initial control.
        tolerance: Tolerated difference from the shortest horizon [s]; default: 2 % of the horizon;
            at least one sample.
        callback: Called with a `DesignEvent` for every iterate, and a `StudyEvent` for every
            duration that was tried.
        threads: Threads for simulations; default: one per core.
        executor: Where the work is done (`mjfim.ExecutorLike`); None for this process. Each
            design runs its starts side by side.
        stop: Token that ends the search with the shortest experiment so far, as Ctrl-C does.
        progress: False for no bar of progress in a notebook; a callback replaces the bar as well.

    Returns:
        The shortest experiment. If the search was stopped before any duration reached the targets,
        that with the smallest ratio of a standard deviation to its target.

    Raises:
        OutOfReachError: Even the longest horizon does not reach the targets.
        ExperimentError: No parameter states a target, or an argument is out of range.
        NoResultError: The search was stopped before there was any design.
    """
    if longest is not None and not 0.0 < longest < np.inf:
        raise ExperimentError(f"shortest_experiment: longest {longest:g} s; it must be finite, > 0")
    if tolerance is not None and not tolerance > 0.0:
        raise ExperimentError(f"shortest_experiment: tolerance {tolerance:g} s; it must be > 0")

    with (
        stop_on_interrupt(stop) as token,
        shown_progress("designing", callback, progress) as show,
    ):
        task = DesignTask.resolve(experiment, threads=threads)
        require_controls(task.system, "the search for the shortest horizon")
        search = _HorizonSearch(
            base=task,
            tolerance=tolerance,
            callback=show,
            executor=Workers.of_any(executor),
            stop=token,
            targets=target_accuracies(task),
        )
        return search.run(_default_longest(task) if longest is None else longest)


@record
class _HorizonSearch:
    """Search for the smallest number of samples whose design reaches the targets.

    Attributes:
        base: The task of the experiment as stated.
        tolerance: Tolerance of the horizon [s], or None for the default.
        callback: Called with every event.
        executor: Runs several starts side by side, or None.
        stop: Token that ends the search.
        targets: (p,) target standard deviations [theta-unit].
        tried: Result of every number of samples.
        designs: Best design of every number of samples that has one.
    """

    base: DesignTask
    tolerance: float | None
    callback: Callback | None
    executor: ExecutorLike | None
    stop: StopToken
    targets: Array
    tried: dict[int, Tried] = field(default_factory=dict)
    designs: dict[int, Design] = field(default_factory=dict)

    @cached_property
    def grid(self) -> SampleGrid:
        """The numbers of samples that a design may have: those that its coarse level divides."""
        descent = self.base.experiment.descent
        if descent.method != "lbfgs":
            return SampleGrid(unit=1, first_multiple=0)
        if descent.coarse != "auto":
            return SampleGrid(unit=descent.coarse, first_multiple=0, minimum=max(descent.coarse, 2))
        # With the largest factor, horizons would be too far apart.
        unit = SAMPLE_FACTORS[1]
        return SampleGrid(unit=unit, first_multiple=MIN_COARSE_SAMPLES * unit)

    def _closest(self) -> int:
        """Samples of the design that is closest to the targets, the result after a stop."""
        if not self.designs:
            raise NoResultError("the search was stopped before it had found a design")
        return min(self.designs, key=lambda samples: self.tried[samples].ratio)

    def run(self, longest: float) -> ShortestExperiment:
        """Search the horizons up to the longest one [s]."""
        rate = self.base.experiment.rate
        if longest * rate < self.grid.minimum:
            raise ExperimentError(
                f"shortest_experiment: longest {longest:g} s is less than {self.grid.minimum} "
                "samples"
            )

        largest = self.grid.round_down(longest * rate)
        found, below = smallest_feasible(
            self.ratio,
            min(self.grid.round_up(self.base.samples), largest),
            largest,
            self.grid,
            self.tolerance_at,
        )
        has_reached = found is not None
        if found is None:
            if not self.stop.requested:
                raise self._out_of_reach(largest)
            found = self._closest()

        # The bracket is closed where its lower end was tried, or where no shorter design exists.
        is_shortest = has_reached and found <= self.grid.minimum
        is_narrow = below is not None and found - below <= self.tolerance_at(found)
        return ShortestExperiment(
            experiment=self.at(found),
            design=self.designs[found],
            tried=tuple(self.tried.values()),
            tolerance=self.tolerance_at(found) / rate,
            closed=(is_shortest or is_narrow) and not self.stop.requested,
        )

    def tolerance_at(self, samples: int) -> int:
        """Tolerance at a number of samples [samples].

        It is at least the distance to the next smaller number of the grid.
        """
        width = DEFAULT_TOLERANCE * samples
        if self.tolerance is not None:
            width = self.tolerance * self.base.experiment.rate

        resolution = samples - self.grid.round_down(samples - 1)
        return max(int(width + ROUNDING_TOLERANCE), resolution)

    def at(self, samples: int) -> Experiment:
        """The experiment with a number of samples, and those repeats that divide it."""
        repeats = self.base.experiment.descent.repeats
        dividing = tuple(count for count in repeats if samples % count == 0)
        horizon = samples / self.base.experiment.rate
        return self.base.experiment.replace(horizon=horizon, descent={"repeats": dividing})

    def ratio(self, samples: int) -> float | None:
        """Largest ratio of a predicted to a target standard deviation; None if stopped early."""
        tried = None if self.stop.requested else self._try(samples)
        if tried is None:
            return None

        self.tried[samples] = tried
        if self.callback is not None:
            event = StudyEvent(
                study="shortest_experiment",
                part=f"{tried.horizon:g} s",
                index=len(self.tried) - 1,
                count=None,
                share=1.0,
                message=str(tried),
            )
            self.callback(event)
        return tried.ratio

    def _try(self, samples: int) -> Tried | None:
        """Design the experiment with a number of samples, from one or two controls.

        The first design begins with the control of the nearest design so far. Where it does not
        reach the targets, a second one begins with the initial control.

        Returns:
            The better outcome; None where the first design was stopped.
        """
        near = min(self.designs, key=lambda n: abs(np.log(n / samples)), default=None)
        tried = self._design(samples, near)
        if near is None or tried is None or tried.reached:
            return tried

        again = self._design(samples, None)
        if again is None:
            return tried
        return again if again.ratio <= tried.ratio else tried

    def _design(self, samples: int, near: int | None) -> Tried | None:
        """Design the experiment with a number of samples.

        Args:
            samples: Number of samples.
            near: Number of samples of the design with whose control to begin; None for the initial
                control.

        Returns:
            The outcome, or None where the design was stopped.
        """
        horizon = samples / self.base.experiment.rate
        try:
            task = self.base.restated(self.at(samples))
            initial = None
            if near is not None:
                initial = fit_control(task, self.designs[near].trajectory.ctrl)
            design = design_task(
                task,
                callback=self.callback,
                initial_control=initial,
                executor=self.executor,
                budget=design_budget(task, self.stop),
            )
            is_stopped = design.status is Status.INTERRUPTED
            if not is_stopped:
                require_reachable(task, design, self.targets)
        except MjfimError as error:
            # An error at the first horizon ends the search; later ones only exclude their horizon.
            if not self.tried:
                raise
            return Tried(horizon=horizon, ratio=np.inf, why=str(error))

        margins = design.limits.items()
        violated = [f"{kind} by {-margin:.3g}" for kind, margin in margins if margin < 0.0]
        if design.status is Status.INFEASIBLE:
            why = f"{design.status.value} ({', '.join(violated)})"
            return Tried(horizon=horizon, ratio=np.inf, why=why)

        # After a stop, a design counts if it keeps the limits, and reaches the targets or is the
        # first one.
        ratio, parameter = largest_ratio_to_target(design.stated_std, self.targets)
        if is_stopped and (violated or (not ratio <= 1.0 and self.designs)):
            return None
        known = self.designs.get(samples)
        if known is None or ratio < largest_ratio_to_target(known.stated_std, self.targets)[0]:
            self.designs[samples] = design
        name = task.parameters.names[parameter]
        return Tried(horizon=horizon, ratio=ratio, parameter=name)

    def _out_of_reach(self, samples: int) -> OutOfReachError:
        """The error that says how far the longest experiment is from the targets."""
        longest = self.tried[samples]
        design = self.designs.get(samples)

        reason = longest.why
        if design is not None:
            names = self.base.parameters.names
            missed = missed_targets(names, design.stated_std, self.targets)
            reason = f"the target is missed by {missed}"
        return OutOfReachError(
            f"{self.base.experiment.source}: even {longest.horizon:g} s is too short: {reason}. "
            "Allow a longer experiment (`longest`, or a longer table of the initial control) or a "
            "stronger control, or relax the targets; `mjfim check` prints the number of "
            "repetitions that reach them"
        )


def fit_control(task: DesignTask, control: Array) -> Array:
    """Fit a control of another duration to a task: (n, nu) to (N, nu) [u-unit].

    A longer one is cut where the final state is free. A shorter one is repeated where the task has
    no limits. All others are stretched.
    """
    N, n = task.samples, len(control)
    if n == N:
        return control
    if n > N and task.experiment.boundary.end == "free":
        return control[:N]
    if n < N and not task.is_limited:
        return np.asarray(np.resize(control, (N, control.shape[1])))

    # The stretched control is interpolated over the relative time, between middles of samples.
    given = (np.arange(n) + 0.5) / n
    wanted = (np.arange(N) + 0.5) / N
    return np.stack([np.interp(wanted, given, column) for column in control.T], axis=1)


def _default_longest(task: DesignTask) -> float:
    """Longest horizon by default [s], no longer than the table of the initial control."""
    experiment = task.experiment
    longest = MAX_HORIZON_FACTOR * task.horizon
    if isinstance(experiment.initial.control, Signal):
        return longest

    with opened(experiment, str(experiment.initial.control)) as file:
        columns = recordings.read_table(file)
    name = task.controls[0]
    values = columns[name if name in columns else f"ctrl:{name}"]
    t = columns["t"][np.isfinite(values)]
    end = float(t[-1] + np.median(np.diff(t)))
    return max(task.horizon, min(longest, end))
