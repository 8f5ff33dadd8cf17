"""`mjfim simulate`: the recording that it writes, beside which files, and its video."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.output import archive
from mjfim.output.manifest import OutputGuard
from mjfim.recordings import read as logs
from tests.support.cli import done, misused, run


def test_simulate_leaves_a_recording_that_the_seed_determines(folder: Path) -> None:
    """The control of the design, and the outputs of the true model with the stated noise."""
    task = DesignTask.resolve(mjfim.Experiment.from_file("study.toml"))
    first = Path("run.csv").read_bytes()
    recording = logs.read_recording(Path("run.csv"), task.system.channels)
    curve = archive.read_design(folder / "out" / "design.npz", task.system)["final"]
    assert np.array_equal(recording.ctrl, curve.ctrl)
    noise = recording.y - np.hstack([curve.qpos, curve.qvel])
    assert noise.std() == pytest.approx(0.05, rel=0.15)
    for seed in (1, 2):
        done("simulate study.toml out/design.npz -o again.csv --seed", seed)
        assert (Path("again.csv").read_bytes() == first) is (seed == 1)


def test_without_a_name_the_recording_is_written_beside_the_design(folder: Path) -> None:
    """A file of the user is replaced with --force only, one of mjfim is replaced."""
    file = folder / "out" / "recording.csv"
    file.write_text("t\n", encoding="utf-8")
    misused(run("simulate study.toml out --seed 1"), "recording.csv", "--force")
    assert file.read_text(encoding="utf-8") == "t\n"
    for words in ("simulate study.toml out --seed 1 --force", "simulate study.toml out --seed 1"):
        assert "wrote out/recording.csv" in done(words).stderr
        assert file.read_bytes() == Path("run.csv").read_bytes()


VIDEO = "simulate study.toml out -o new.csv --video new.gif"


def test_without_a_renderer_there_is_no_video_and_a_sentence_says_so(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "disable")
    said = done(VIDEO).stderr
    assert "there is no video: the variable MUJOCO_GL turns drawing off" in said
    assert Path("new.csv").exists() and not Path("new.gif").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("drawing")
def test_video_of_a_recording_is_written(folder: Path) -> None:
    """A second run may replace what the first one wrote."""
    result = done(VIDEO)
    if "there is no video" in result.stderr:
        pytest.skip(result.stderr)
    assert "new.gif: The simulated motion, 5 times slower" in result.stderr
    assert Path("new.gif").read_bytes()[:3] == b"GIF"
    OutputGuard([], force=False).check([folder / "new.csv", folder / "new.gif"])
