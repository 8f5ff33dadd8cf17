"""Work on workers that lose tasks: the same results as in one process, to the last digit."""

from __future__ import annotations

from pathlib import Path

import pytest

from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.parallel import dispatch
from mjfim.studies.check import check_task
from tests.support.cart_pendulum import cart_pendulum
from tests.support.executors import LosingThreads
from tests.support.limits import cart_inside


def test_random_motions_of_a_check_do_not_depend_on_lost_tasks() -> None:
    """Nothing moves along the initial control; the random motions show everything."""
    still = {"control": {"kind": "constant", "amplitude": 0.0}}
    task = DesignTask.resolve(cart_pendulum(horizon=0.2, initial=still), threads=1)
    alone = check_task(task)
    with LosingThreads() as threads:
        found = check_task(task, executor=threads)
    assert threads.submitted > 3
    assert alone.not_excited and not alone.not_separable
    assert found.findings == alone.findings


def test_lost_moves_of_a_design_are_done_here(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dispatch, "MAX_LOSSES", 1)
    few = {"descent": {"starts": 2, "max_iterations": 1}, "rehearsal": {"robots": 2}}
    task = cart_inside(tmp_path, **few)
    with LosingThreads() as threads:
        found = design_task(task, executor=threads)
    assert [each.cost for each in found.starts] == [each.cost for each in design_task(task).starts]
