"""Optimisation under hard limits from several initial controls, with successive halving.

In the first round all starts are optimised with a large barrier weight, if possible on a plant that
is quicker to simulate. The best of them continue on the stated plant with a small barrier weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mjfim.excitation.halving import HALVING_RATE
from mjfim.excitation.interior_point import BarrierSchedule
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.limited_rounds import LimitedRounds
from mjfim.excitation.limited_searches import SearchTerms
from mjfim.excitation.merged_results import better_of
from mjfim.excitation.rounds import Entry, Judge, Round
from mjfim.excitation.run_result import RunResult
from mjfim.excitation.stated_comparison import LargestShare, StatedComparison

# Last barrier weight mu of the first round.
FIRST_ROUND_MU = 0.01

# Last barrier weight mu of the first round with fewer than `HALVING_RATE` starts, where the coarse
# level differs by its timestep only: its minima are then close to those of the stated level.
FEW_STARTS_MU = 1e-3

# Ratio of the first mu of the second round to the last mu of the first round.
MU_RESTART_FACTOR = 3.0

# Share of the iterations and of the time for the first round.
FIRST_ROUND_SHARE = 0.5

# Last barrier weight mu of the first round, and its share of the time, where the time of a design
# allows few evaluations only. The rest of the time is for the evaluation of the result.
BRIEF_MU = 0.03
BRIEF_SHARE = 0.75


@dataclass(frozen=True, kw_only=True, eq=False)
class Multistart(LimitedRounds):
    """Two rounds of several starts under hard limits.

    Attributes:
        coarse: A level that is quicker to simulate, or smoother; None without one.
        is_brief: Whether the time allows few evaluations on the stated plant only. Most of it then
            is for the coarse level, if that takes fewer engine steps.
    """

    coarse: DescentLevel | None
    is_brief: bool = False

    @cached_property
    def rounds(self) -> Sequence[Round]:
        """Two rounds; a single one for one start whose control is free, on one level."""
        if self._needs_one_round:
            return [Round(level=self.searches.stated)]

        few_starts = len(self.starts) < HALVING_RATE and self._differs_by_timestep_only
        last_mu = FEW_STARTS_MU if few_starts else FIRST_ROUND_MU
        share = FIRST_ROUND_SHARE
        if self._is_coarse_only:
            last_mu, share = BRIEF_MU, BRIEF_SHARE
        first = Round(
            level=self.coarse or self.searches.stated,
            last_mu=last_mu,
            next_mu=min(MU_RESTART_FACTOR * last_mu, FIRST_ROUND_MU),
            share=share,
        )
        return [first, Round(level=self.searches.stated)]

    def terms(self, entry: Entry, seconds: float) -> SearchTerms:
        """Return the limits of the search of a start, see `RoundPlan`."""
        stage = self.rounds[entry.round]
        iterations = self.max_iterations - max(entry.done - 1, 0)
        if entry.round < len(self.rounds) - 1:
            iterations = round(FIRST_ROUND_SHARE * self.max_iterations)

        schedule = BarrierSchedule(first=entry.mu, last=stage.last_mu)
        return SearchTerms(schedule=schedule, max_iterations=iterations, seconds=seconds)

    def judge(self, entry: Entry) -> Judge | None:
        """Who judges the result of a start, see `RoundPlan`."""
        is_last = entry.round == len(self.rounds) - 1
        is_stated = self.coarse is None and all(start.repeats == 1 for start in self.starts)
        if is_last or is_stated:
            return None
        if self.coarse is None or not self._is_coarse_only:
            return StatedComparison()

        # The first start begins with a control that is compared with the design in the end.
        return LargestShare(
            budget=self.searches.budget,
            sample_factor=self.coarse.task.system.variant.sample_factor,
            compares_begin=entry.index > 0,
        )

    def may_begin(self, entry: Entry, *, has_feasible: bool) -> bool:
        """Check whether there is time for a useful search, see `RoundPlan`."""
        if not (self._is_coarse_only and has_feasible):
            return True
        return self.has_time_for(entry)

    def late(self, entry: Entry, result: RunResult, *, is_tried: bool) -> RunResult:
        """Result of a start that was not judged, see `RoundPlan`.

        After a request to stop, its cost is that on the coarse level.
        """
        if is_tried or self.searches.budget.stop.requested:
            return result
        return replace(result, cost=np.inf)

    def merged(self, before: RunResult | None, result: RunResult) -> RunResult:
        """Result of a start after a further round, see `RoundPlan`."""
        return result if before is None else better_of(before, result)

    @property
    def _is_coarse_only(self) -> bool:
        """True where there is hardly any time for the stated level, but for a quicker one.

        A level that is only smoother is not quicker.
        """
        if not self.is_brief or self.coarse is None:
            return False
        return self.coarse.engine_steps < self.searches.stated.engine_steps

    @property
    def _differs_by_timestep_only(self) -> bool:
        """True where the coarse level has a longer timestep, but the stated samples and friction.

        Its minima are then close to those of the stated level.
        """
        if self.coarse is None:
            return True

        variant = self.coarse.task.system.variant
        return replace(variant, timestep_factor=1) == self.searches.stated.task.system.variant

    @property
    def _needs_one_round(self) -> bool:
        """True where there is one start only, whose control is free, and one level."""
        if len(self.starts) > 1 or self.coarse is not None:
            return False

        return all(start.basis is None and start.repeats == 1 for start in self.starts)
