"""Results of a round are judged on the stated plant, by a worker or in this process."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from mjfim.excitation.constrained import (
    ConstrainedSlice,
    run_in_worker,
    task_in_worker,
)
from mjfim.excitation.controls_within_limits import LimitedCost
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.rounds import Judge, Judgement
from mjfim.excitation.run_result import RunResult
from mjfim.excitation.search_slices import SearchSlice
from mjfim.parallel import one_blas_thread
from mjfim.parallel.kept import KeptPerThread
from mjfim.parallel.shared_value import SharedValue


@dataclass(frozen=True, kw_only=True, eq=False)
class JudgeOrder:
    """Order to judge the result of a start, for a worker. It can be pickled.

    Attributes:
        judge: Who judges it.
        result: The result, without its history.
        begun: Control with which the round began.
        stated: Order for a search on the stated level, of which the worker makes the cost once.
            Each worker receives it once, by the means of its executor: some of them also send
            functions that have no name.
    """

    judge: Judge
    result: RunResult
    begun: InitialControl
    stated: SharedValue[ConstrainedSlice]


# Cost on the stated plant that a worker keeps.
_costs = KeptPerThread[LimitedCost](1)


def work_of_round(order: ConstrainedSlice | JudgeOrder) -> SearchSlice[Any] | Judgement:
    """Carry out an order of a round, for an executor.

    Args:
        order: The order.

    Returns:
        What the slice has found, or the judgement.
    """
    if isinstance(order, JudgeOrder):
        return _judge_in_worker(order)
    return run_in_worker(order)


def counted_judgement(
    judge: Judge, cost: LimitedCost, result: RunResult, begun: InitialControl
) -> Judgement:
    """Judge a result, and count the engine steps on the stated plant.

    Args:
        judge: Who judges it.
        cost: Cost of controls that keep all limits on the stated plant.
        result: The result.
        begun: Control with which the round began.
    """
    # The controls that hold the start are found once for all results of a process.
    task = cost.level.task
    assert task.centres is not None

    before = task.plant.engine_steps
    judgement = judge.judged(cost, result, begun)
    steps = result.steps + task.plant.engine_steps - before
    return replace(judgement, result=replace(judgement.result, steps=steps))


@one_blas_thread()
def _judge_in_worker(order: JudgeOrder) -> Judgement:
    """Judge a result in a worker."""

    def made() -> LimitedCost:
        """The cost on the stated plant."""
        stated = order.stated.value
        task = task_in_worker(stated.task_key, stated.search)
        return LimitedCost(level=DescentLevel(task, stated.search.combinations))

    cost = _costs.get(order.stated.digest, made)
    return counted_judgement(order.judge, cost, order.result, order.begun)
