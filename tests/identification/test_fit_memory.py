"""Memory of reading and assessing long recordings."""

from __future__ import annotations

import time
import tracemalloc
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow
import pytest

import mjfim
from mjfim.experiment.system import System
from mjfim.identification import segment_simulation
from mjfim.identification.assessment.residual_tests import fit_quality
from mjfim.identification.search import FitTask
from mjfim.output.archive import write_recording
from mjfim.recordings.read import read_recording
from mjfim.records.trajectory import Recording
from tests.support.paths import MODELS


def recorded(rows: int) -> tuple[System, Recording]:
    """Two joints at rest with noise."""
    system = System.resolve(mjfim.Experiment.from_file(MODELS / "two_joint_arm.toml"), threads=1)
    y = 0.01 * np.random.default_rng(0).normal(size=(rows, 4))
    t = np.arange(rows) * system.dt
    names = system.outputs.names
    return system, Recording(t=t, ctrl=np.zeros((rows - 1, 2)), y=y, outputs=names, name="rest")


def test_a_recording_keeps_nothing_of_the_parsed_file(tmp_path: Path) -> None:
    system, recording = recorded(3000)
    write_recording(tmp_path / "log.csv", recording, system)
    before = pyarrow.total_allocated_bytes()
    found = read_recording(tmp_path / "log.csv", system.channels)

    # A thread of the parser may give its last buffer back shortly after the file was read.
    deadline = time.monotonic() + 10.0
    while pyarrow.total_allocated_bytes() > before and time.monotonic() < deadline:
        time.sleep(0.01)
    assert pyarrow.total_allocated_bytes() <= before

    # A fit shares the arrays.
    aligned = FitTask.of(system, [found]).problem().recordings[0]
    assert aligned.y is found.y
    assert np.shares_memory(aligned.ctrl, found.ctrl)


@pytest.mark.slow
def test_residuals_are_assessed_with_little_more_than_the_predictions(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Copies of all residuals would take three times the memory of the recording."""
    monkeypatch.setattr(segment_simulation, "MAX_NUMBERS_AT_ONCE", 100_000)
    system, recording = recorded(60_000)
    problem = FitTask.of(system, [recording]).problem()
    at = problem.begin(system.parameters.guess)
    solution: Any = SimpleNamespace(unknowns=at, condensed=SimpleNamespace(rank=9))

    # The first call imports what it needs.
    fit_quality(problem, solution)
    tracemalloc.start()
    fit_quality(problem, solution)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2.2 * sum(each.nbytes for each in (recording.t, recording.y, recording.ctrl))
