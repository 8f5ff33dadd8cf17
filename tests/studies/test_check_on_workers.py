"""A check on workers: the same result as in one process, to the last digit."""

from __future__ import annotations

from mjfim.excitation.task import DesignTask
from mjfim.studies.check import check_task
from tests.support.cart_pendulum import cart_pendulum
from tests.support.executors import LosingThreads


def at_rest() -> DesignTask:
    """The cart-pendulum without a control, so that only random controls show its parameters."""
    experiment = cart_pendulum()
    still = experiment.replace(
        horizon=0.2, initial={"control": {"kind": "constant", "amplitude": 0.0}}
    )
    return DesignTask.resolve(still, threads=1)


def test_random_motions_are_the_same_although_tasks_are_lost() -> None:
    task = at_rest()
    alone = check_task(task)
    with LosingThreads() as threads:
        found = check_task(task, executor=threads)

    # Nothing moves along the initial control; the random motions show everything.
    assert threads.submitted > 3
    assert alone.not_excited and not alone.not_separable
    assert found.findings == alone.findings
