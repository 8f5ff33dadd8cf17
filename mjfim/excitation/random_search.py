"""Search for better controls within hard limits by random changes, without derivatives.

It takes over from a descent that is held up, see `mjfim.excitation.short_steps`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterator
from functools import cached_property

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.controls_within_limits import (
    BANDWIDTHS,
    ControlsWithinLimits,
    InsideControl,
    LimitedCost,
)
from mjfim.excitation.evaluation import UNSTABLE_GROWTH, growth_along
from mjfim.records.design import HistoryRow
from mjfim.records.events import DesignEvent

# Bandwidths of the first random controls. Neighbours differ much, because a search may end early.
FIRST_BANDWIDTHS = (0.6, 0.15, 1.0, 0.35, 0.06)
CONTROLS_PER_BANDWIDTH = 2

# Size of a random change relative to the control, at first and within bounds, and the factors by
# which it changes after a success and after a failure. After four failures for one success the
# size remains.
FIRST_SIZE = 0.3
SMALLEST_SIZE, LARGEST_SIZE = 0.03, 1.0
AFTER_SUCCESS = 1.5
AFTER_FAILURE = AFTER_SUCCESS**-0.25

# Factor by which a control that amplifies disturbances too much is made smaller, and the number of
# sizes that are tried.
SMALLER = 0.6
SMALLER_TRIALS = 3

# Share of the changes that concern one actuator alone.
SINGLE_SHARE = 0.5

# Decrease of the cost that counts as progress (relative), and the number of changes without
# progress after which a search ends.
LEAST_PROGRESS = 0.01
PATIENCE = 16

# Largest number of changes, which ends a search without a limit of time.
MOST_CHANGES = 64


class RandomSearch:
    """Random controls, and random changes of the best one, that keep all limits.

    A control that amplifies small disturbances too much is left out, because no robot could
    repeat its motion.

    Args:
        cost: Cost of controls that keep all limits.
        name: Name of the initial control from which the design began, for the history.
        time: Time of the whole design, from which the seconds of the history count.
        seed: Seed of the random numbers.
    """

    def __init__(self, cost: LimitedCost, name: str, time: Budget, seed: int) -> None:
        self.cost = cost
        self.name = name
        self.time = time
        self.rng = np.random.default_rng(seed)

        # Bandwidths of random controls that have not been tried yet; None stands for the first
        # control, as large as the limits allow.
        self._untried: deque[float | None] = deque(
            (None, *CONTROLS_PER_BANDWIDTH * FIRST_BANDWIDTHS)
        )

    @cached_property
    def largest_growth(self) -> float:
        """Largest amplification of a small disturbance that a control may have."""
        return max(UNSTABLE_GROWTH, self._growth(self.cost.level.task.control))

    def run(
        self, best: InsideControl, budget: Budget, patience: float = PATIENCE
    ) -> Generator[DesignEvent, None, tuple[InsideControl, tuple[HistoryRow, ...]]]:
        """Search for a better control.

        Args:
            best: The best control so far, which keeps all limits.
            budget: Time of this search.
            patience: Number of changes without progress after which the search ends; 0 to try
                random controls only.

        Yields:
            Every improvement.

        Returns:
            The best control, and the improvements as rows of the history.
        """
        trials = ControlsWithinLimits(cost=self.cost, budget=budget, share=1.0)
        rows: list[HistoryRow] = []

        for found in self._improvements(best, trials, patience):
            best = found
            rows.append(self.row(found, len(rows)))
            yield DesignEvent(start=self.name, row=rows[-1])
        return best, tuple(rows)

    def _improvements(
        self, best: InsideControl, trials: ControlsWithinLimits, patience: float
    ) -> Iterator[InsideControl]:
        """Controls, each of which is better than all before."""
        for proposed in self._first_ones(best, trials):
            found = self._repeatable(proposed, best, trials)
            if found is not None:
                best = found
                yield best

        yield from self._changed(best, trials, patience)

    def _first_ones(
        self, best: InsideControl, trials: ControlsWithinLimits
    ) -> Iterator[InsideControl | None]:
        """The best control, enlarged, and random controls of all bandwidths."""
        while self._untried and not trials.is_over:
            bandwidth = self._untried.popleft()
            if bandwidth is None:
                yield trials.enlarged(self._as_large_as_possible(best, trials))
            else:
                yield self._random(best, bandwidth, trials)

    def _changed(
        self, best: InsideControl, trials: ControlsWithinLimits, patience: float
    ) -> Iterator[InsideControl]:
        """Improvements by random changes of the best control."""
        size, without_progress = FIRST_SIZE, 0
        successes = np.ones(len(BANDWIDTHS))
        for _ in range(MOST_CHANGES if np.isinf(trials.budget.deadline) else 10**9):
            if trials.is_over or without_progress >= patience:
                return

            # Bandwidths that have led to improvements are tried more often.
            choice = int(self.rng.choice(len(BANDWIDTHS), p=successes / successes.sum()))
            changed = trials.largest(best.about, self._change(best, choice, size, trials))
            found = self._repeatable(changed, best, trials)
            if found is None:
                size = max(size * AFTER_FAILURE, SMALLEST_SIZE)
                without_progress += 1
                continue

            is_progress = found.cost < best.cost - LEAST_PROGRESS * abs(best.cost)
            without_progress = 0 if is_progress else without_progress + 1
            size = min(size * AFTER_SUCCESS, LARGEST_SIZE)
            successes[choice] += 1.0
            best = found
            yield best

    def _change(
        self, best: InsideControl, choice: int, size: float, trials: ControlsWithinLimits
    ) -> Array:
        """(N, nu) deviation with a random change of all actuators, or of one of them."""
        noise = trials.noise(BANDWIDTHS[choice], self.rng)
        actuators = noise.shape[1]
        if actuators > 1 and self.rng.random() < SINGLE_SHARE:
            noise[:, np.arange(actuators) != self.rng.integers(actuators)] = 0.0

        # An actuator that rests gets a change in proportion to the others.
        widths = self.cost.constraints.control.bounds.scale
        used = np.sqrt(((best.deviation / widths) ** 2).mean(axis=0))
        used = widths * np.maximum(used, used.mean())
        strength = np.sqrt((noise**2).mean(axis=0))
        strength = np.where(strength > 0.0, strength, 1.0)
        return np.asarray(best.deviation + trials.fitted(size * used * noise / strength))

    def _random(
        self, best: InsideControl, bandwidth: float, trials: ControlsWithinLimits
    ) -> InsideControl | None:
        """A random control of a bandwidth that is as large as the limits allow."""
        noise = trials.noise(bandwidth, self.rng)
        widths = self.cost.constraints.control.bounds.scale
        wanted = trials.fitted(widths * noise / np.abs(noise).max(axis=0))
        found = trials.largest(best.about, wanted)
        if found is None or found.cost >= best.cost:
            return found
        return trials.enlarged(found)

    def _as_large_as_possible(
        self, best: InsideControl, trials: ControlsWithinLimits
    ) -> InsideControl:
        """The best control with the largest deviation of this form that the limits allow."""
        widths = self.cost.constraints.control.bounds.scale
        used = float((np.abs(best.deviation) / widths).max())
        if used == 0.0:
            return best
        return trials.largest(best.about, best.deviation / used) or best

    def _repeatable(
        self, found: InsideControl | None, best: InsideControl, trials: ControlsWithinLimits
    ) -> InsideControl | None:
        """A control, or a smaller one of its form, that can be repeated and costs less.

        Args:
            found: The control, or None.
            best: The best control so far.
            trials: Evaluates the smaller ones.

        Returns:
            The control; None where it does not cost less than the best one.
        """
        for _ in range(SMALLER_TRIALS):
            if found is None or found.cost >= best.cost:
                return None

            # The growth along the initial control is needed only where this one is strong.
            growth = self._growth(found.control)
            if growth <= UNSTABLE_GROWTH or growth <= self.largest_growth:
                return found
            if trials.is_over:
                return None
            found = trials.inside(found.about, SMALLER * found.deviation, SMALLER * found.share)
        return None

    def _growth(self, control: Array) -> float:
        """Amplification of a small disturbance along a control: (N, nu)."""
        task = self.cost.level.task
        try:
            return growth_along(task, task.plant.simulate(task.theta, control))
        except SimulationDivergedError:
            return np.inf

    def row(self, found: InsideControl, number: int) -> HistoryRow:
        """A control as a row of the history.

        Args:
            found: The control.
            number: Number of the row.
        """
        values = self.cost.values(found.control)
        margins = {} if values is None else self.cost.constraints.relative_margins(values)
        return HistoryRow(
            iteration=number,
            cost=found.cost,
            criterion=found.criterion,
            min_eigenvalue=found.min_eigenvalue,
            slope=np.nan,
            gamma=np.nan,
            seconds=self.time.seconds_used,
            steps=0,
            rate=1.0 / self.cost.level.task.dt,
            margin=min(margins.values(), default=np.nan),
            margins=margins,
        )
