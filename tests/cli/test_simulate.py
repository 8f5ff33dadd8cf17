"""`mjfim simulate`: the recording that it writes, and files that it cannot write."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.output import archive
from mjfim.recordings import read as logs
from tests.support.cli import (
    misused,
    names,
    run,
)


def test_simulate_leaves_a_recording(study: Path, recorded: Path, archived: Path) -> None:
    """The control of the design, and the outputs of the true model with the stated noise."""
    task = DesignTask.resolve(mjfim.Experiment.from_file(study))
    recording = logs.read_recording(recorded, task.system.channels)
    curve = archive.read_design(archived)["final"]
    assert np.array_equal(recording.ctrl, curve.ctrl)
    noise = recording.y - np.hstack([curve.qpos, curve.qvel])
    assert noise.std() == pytest.approx(0.05, rel=0.15)


def test_the_seed_determines_the_recording(
    study: Path, recorded: Path, archived: Path, tmp_path: Path
) -> None:
    """An equal seed gives an equal file, another seed gives another file."""
    again = tmp_path / "again.csv"
    for seed, equal in ((1, True), (2, False)):
        result = run("simulate", study, archived, "-o", again, "--seed", seed)
        assert result.exit_code == 0
        assert (again.read_bytes() == recorded.read_bytes()) is equal


@pytest.mark.parametrize("place", ["folder", "file/below.csv"])
def test_recording_cannot_be_written(
    place: str, study: Path, archived: Path, tmp_path: Path
) -> None:
    """The path names a folder, or lies below a file."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    misused(run("simulate", study, archived, "-o", tmp_path / place), "-o")
    assert names(tmp_path) == {"folder", "file"}
