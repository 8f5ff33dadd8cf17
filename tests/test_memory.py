"""Work that would fill the memory is refused before it begins."""

from __future__ import annotations

from pathlib import Path

import pytest

import mjfim
from mjfim import memory
from mjfim.errors import ExperimentError
from mjfim.excitation.task import DesignTask
from mjfim.studies.monte_carlo import monte_carlo_system
from tests.support.cli import write_experiment

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
    with pytest.raises(ExperimentError, match=r"trials: 1000000000: this needs at least"):
        monte_carlo_system(task.system, task.initial, trials=1_000_000_000)


def test_too_long_horizon(tmp_path: Path) -> None:
    """A horizon whose linearisation does not fit is refused before its control is made."""
    path = write_experiment(tmp_path, horizon="90000.0", start='{ kind = "sine" }')
    with pytest.raises(ExperimentError, match=r"study\.toml: horizon: 90000 s at 100 Hz: "):
        DesignTask.resolve(mjfim.Experiment.from_file(path))
