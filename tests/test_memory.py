"""Work that would fill the memory is refused before it begins."""

from __future__ import annotations

import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path

import pytest

import mjfim
from mjfim import memory
from mjfim.errors import ExperimentError
from mjfim.excitation.design_memory import design_bytes, require_memory_for_design
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System
from mjfim.identification.fit_memory import recordings_bytes, require_memory_for_recordings
from mjfim.studies.monte_carlo import (
    chunk_sizes,
    monte_carlo_system,
    require_memory_for_trials,
)
from tests.support.cli import write_experiment
from tests.support.paths import ROOT

GIBIBYTE = 2.0**30


@pytest.fixture(autouse=True)
def _one_gibibyte(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pretend that 1 GiB of memory is available."""
    monkeypatch.setattr(memory, "available_memory", lambda: GIBIBYTE)


def test_memory_is_a_plausible_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    assert 0.01 * GIBIBYTE < memory.available_memory() < 1e6 * GIBIBYTE


def test_bound() -> None:
    """80 % of the available memory may be used; the message states both numbers and the cause."""
    memory.require_memory(0.79 * GIBIBYTE / 8, "trials: 5")
    with pytest.raises(ExperimentError, match=r"trials: 5: .* 1 GiB of memory, and 0\.8 GiB"):
        memory.require_memory(GIBIBYTE / 8, "trials: 5")


def test_too_many_trials(tmp_path: Path) -> None:
    """The number of trials is refused before the first simulation."""
    experiment = mjfim.Experiment.from_file(write_experiment(tmp_path))
    task = DesignTask.resolve(experiment)
    with pytest.raises(ExperimentError, match=r"trials: 1000000000: this needs about"):
        monte_carlo_system(task.system, task.initial, trials=1_000_000_000)


def test_too_long_horizon(tmp_path: Path) -> None:
    """A horizon whose linearisation does not fit is refused before its control is made."""
    path = write_experiment(tmp_path, horizon="90000.0", start='{ kind = "sine" }')
    with pytest.raises(ExperimentError, match=r"study\.toml: horizon: 90000 s at 100 Hz: "):
        DesignTask.resolve(mjfim.Experiment.from_file(path))


# ---- with a stated memory


@pytest.mark.parametrize(("available", "fits"), [(1e5, False), (1e8, True)])
def test_a_horizon_is_compared_with_the_memory_that_is_there(
    available: float, fits: bool, tmp_path: Path
) -> None:
    """1000 samples of the cart-pendulum need about 10 MB."""
    system = System.resolve(mjfim.Experiment.from_file(write_experiment(tmp_path)))
    refused = pytest.raises(ExperimentError, match=r"horizon: 1 s at 100 Hz: this needs about")
    with nullcontext() if fits else refused:
        require_memory_for_design(system, 1000, available)


def test_the_jacobians_of_all_trials_count(tmp_path: Path) -> None:
    """64 long trials that are stepped together fill the memory, though their estimates are few."""
    task = DesignTask.resolve(mjfim.Experiment.from_file(write_experiment(tmp_path)))
    curve = {"final": task.initial}
    require_memory_for_trials(task.system, curve, 64, available=1e9)
    with pytest.raises(ExperimentError, match=r"trials: 64: this needs about"):
        require_memory_for_trials(task.system, curve, 64, available=1e6)


def test_chunks_that_run_side_by_side_count_together(tmp_path: Path) -> None:
    task = DesignTask.resolve(mjfim.Experiment.from_file(write_experiment(tmp_path)))
    curve = {"final": task.initial}
    require_memory_for_trials(task.system, curve, 4000, available=3e9)
    require_memory_for_trials(task.system, curve, 100, side_by_side=32, available=1e9)
    with pytest.raises(ExperimentError, match=r"trials: 4000, on 32 workers of this computer"):
        require_memory_for_trials(task.system, curve, 4000, side_by_side=32, available=1e8)


def test_long_trials_are_stepped_in_smaller_chunks(tmp_path: Path) -> None:
    """However long the trajectory is, a chunk of trials needs at most 1 GB, and a limited time."""
    system = System.resolve(mjfim.Experiment.from_file(write_experiment(tmp_path)))
    assert chunk_sizes(system, 200, 1500) == (250,) * 6
    assert chunk_sizes(system, 200, 600) == (300, 300)
    assert chunk_sizes(system, 200, 10) == (10,)
    assert max(chunk_sizes(system, 100_000, 1500)) < 250
    assert set(chunk_sizes(system, 10_000_000, 1500)) == {1}


def test_a_study_has_chunks_of_at_least_250_trials(tmp_path: Path) -> None:
    system = System.resolve(mjfim.Experiment.from_file(write_experiment(tmp_path)))
    for trials in (250, 499, 1501, 100_000):
        sizes = chunk_sizes(system, 400, trials)
        assert sum(sizes) == trials
        assert min(sizes) >= 250


def test_recordings_are_compared_with_the_memory_that_is_there(tmp_path: Path) -> None:
    """The blocks of simulations are bounded, the recorded numbers are not."""
    task = DesignTask.resolve(mjfim.Experiment.from_file(write_experiment(tmp_path)))
    recording = mjfim.simulate(task.experiment, task.initial, seed=0)
    require_memory_for_recordings(task.system, [recording], fit=True, available=1e8)
    with pytest.raises(ExperimentError, match=r"recordings of \d+ rows in all: this needs about"):
        require_memory_for_recordings(task.system, [recording], fit=True, available=1e4)

    hour, day = (recordings_bytes(task.system, rows, fit=True) for rows in (3_600_000, 86_400_000))
    assert 10.0 < day / hour < 24.0


MEASURED = """
import sys
import threading

import psutil

import mjfim
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask

task = DesignTask.resolve(mjfim.Experiment.from_file(sys.argv[1]))
memory = psutil.Process().memory_info
before, seen, ended = memory().rss, [], threading.Event()

def watch():
    while not ended.wait(0.002):
        seen.append(memory().rss)

thread = threading.Thread(target=watch)
thread.start()
design_task(task)
ended.set()
thread.join()
print(max(seen) - before)
"""


@pytest.mark.slow
def test_the_estimate_is_above_the_measured_peak(tmp_path: Path) -> None:
    """The peak of a design of 100 s at 100 Hz is between half of the estimate and the estimate."""
    path = write_experiment(
        tmp_path, horizon="100.0", start='{ kind = "sine" }', max_iterations="2"
    )
    words = [sys.executable, "-c", MEASURED, str(path)]
    done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=ROOT)

    system = System.resolve(mjfim.Experiment.from_file(path))
    estimate = design_bytes(system, 10_000)
    assert 0.5 * estimate < float(done.stdout) < estimate
