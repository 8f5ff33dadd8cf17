"""The sensitivity of recordings, condensed batch by batch."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import pytest

import mjfim
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.simulate import simulate_system
from mjfim.identification import segment_simulation
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.segment_simulation import SegmentBatch
from mjfim.identification.sensitivity_rows import sensitivity_rows
from mjfim.identification.task import FitTask
from tests.support.paths import MODELS


def test_the_recordings_of_the_batch_that_diverges_are_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(segment_simulation, "MAX_NUMBERS_AT_ONCE", 2000)
    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml").replace(horizon=0.5)
    design = DesignTask.resolve(experiment, threads=1)
    recordings = [
        replace(simulate_system(design.system, design.initial, seed), name=f"log{seed}")
        for seed in range(3)
    ]
    problem = FitTask.resolve(experiment, recordings, threads=1).problem()
    last: list[str] = []

    def diverging(_: FitProblem, work: Any, batches: Sequence[SegmentBatch], at: Any) -> Iterator:
        *before, diverges = batches
        assert before
        last.extend(f"log{problem.segments[i].recording}" for i in diverges.segments)
        yield from ({} for _ in before)
        yield None

    monkeypatch.setattr(FitProblem, "of_batches", diverging)
    at = problem.begin(problem.system.parameters.guess)
    with pytest.raises(SimulationDivergedError) as caught:
        sensitivity_rows(problem, at)
    assert "log0" not in last
    assert str(caught.value).startswith(" or ".join(sorted(set(last))) + ": the simulation")
