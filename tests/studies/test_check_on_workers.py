"""A check on workers: the same result as in one process, to the last digit."""

from __future__ import annotations

import numpy as np
import pytest

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.experiment.simulate import simulate_system
from mjfim.identification import segment_simulation
from mjfim.studies.check import check_task
from tests.support.executors import LosingThreads
from tests.support.paths import MODELS


def at_rest() -> DesignTask:
    """The cart-pendulum without a control, so that only random controls show its parameters."""
    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml")
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
    assert found.verdict == alone.verdict


@pytest.mark.slow
def test_recordings_tell_the_same_although_tasks_are_lost(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(segment_simulation, "STEPS_OF_BATCH", 200)
    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml").replace(horizon=0.5)
    task = DesignTask.resolve(experiment, threads=1)
    recordings = [simulate_system(task.system, task.initial, seed) for seed in range(3)]
    alone = mjfim.check(experiment, recordings, threads=1)

    with LosingThreads() as threads:
        found = mjfim.check(experiment, recordings, threads=1, executor=threads)

    assert threads.submitted > 3
    assert np.array_equal(found.information, alone.information)
