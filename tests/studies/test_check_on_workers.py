"""A check on workers: the same result as in one process, to the last digit."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.budget import StopToken
from mjfim.excitation.task import DesignTask
from mjfim.experiment.simulate import simulate_system
from mjfim.identification import segment_simulation
from mjfim.information.identifiability import Identifiability
from mjfim.studies.probe_workers import ProbeWorkers
from tests.support.executors import LosingThreads
from tests.support.paths import MODELS


def at_rest() -> DesignTask:
    """The cart-pendulum without a control, so that only random controls show its parameters."""
    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml")
    still = experiment.replace(
        horizon=0.2, initial={"control": {"kind": "constant", "amplitude": 0.0}}
    )
    return DesignTask.resolve(still, threads=1)


def found_by(task: DesignTask, **options: Any) -> Identifiability:
    """What the test of the task finds along its initial control."""
    sensitivity = task.plant.derivatives.sensitivity(task.theta, task.initial)
    assert sensitivity is not None
    test = replace(task.identifiability_test, **options)
    return test.along(task.initial, sensitivity)


def test_random_motions_are_the_same_although_tasks_are_lost() -> None:
    task = at_rest()
    alone = found_by(task)

    with LosingThreads() as threads:
        workers = ProbeWorkers(executor=threads, task=task, stop=StopToken())
        found = found_by(task, differentiated=workers.differentiated)

    # Nothing moves along the initial control; the random motions show everything.
    assert threads.submitted > 3
    assert alone.along_trajectory.count > 0
    assert alone.along_all.count == 0
    assert found.along_all.smallest == alone.along_all.smallest


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
