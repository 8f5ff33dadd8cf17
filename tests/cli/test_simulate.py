"""`mjfim simulate`: the recording that it writes, and files that it cannot write."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.output import archive
from mjfim.output.manifest import OutputGuard
from mjfim.recordings import read as logs
from tests.support.cli import (
    done,
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
        done("simulate", study, archived, "-o", again, "--seed", seed)
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


def test_the_folder_of_a_design_stands_for_its_file(
    study: Path, recorded: Path, archived: Path, tmp_path: Path
) -> None:
    """Without -o, the recording is written beside the design."""
    folder = tmp_path / "out"
    folder.mkdir()
    shutil.copy(archived, folder)
    for _ in range(2):
        result = done("simulate", study, folder, "--seed", 1)
        assert f"wrote {folder / 'recording.csv'}" in result.stderr
    assert (folder / "recording.csv").read_bytes() == recorded.read_bytes()


def test_a_folder_without_a_design(study: Path, tmp_path: Path) -> None:
    misused(run("simulate", study, tmp_path), str(tmp_path / "design.npz"))
    assert names(tmp_path) == set()


def test_a_foreign_recording_beside_the_design_stays(
    study: Path, archived: Path, tmp_path: Path
) -> None:
    shutil.copy(archived, tmp_path)
    (tmp_path / "recording.csv").write_text("t\n", encoding="utf-8")
    misused(run("simulate", study, tmp_path), "recording.csv", "--force")
    assert (tmp_path / "recording.csv").read_text(encoding="utf-8") == "t\n"
    done("simulate", study, tmp_path, "--force")
    assert (tmp_path / "recording.csv").read_text(encoding="utf-8") != "t\n"


def test_another_ending_of_a_video_is_refused_before_the_work(study: Path, tmp_path: Path) -> None:
    result = run("design", study, "-o", tmp_path / "out", "--video", tmp_path / "film.avi")
    misused(result, "film.avi", ".mp4 or .gif")
    assert names(tmp_path) == set()


def test_a_video_does_not_replace_a_file_of_the_user(
    study: Path, archived: Path, tmp_path: Path
) -> None:
    film = tmp_path / "film.gif"
    film.write_text("mine", encoding="utf-8")
    target = tmp_path / "recording.csv"
    misused(run("simulate", study, archived, "-o", target, "--video", film), "film.gif", "--force")
    assert film.read_text(encoding="utf-8") == "mine"
    assert names(tmp_path) == {"film.gif"}


def test_without_a_renderer_there_is_no_video_and_a_sentence_says_so(
    study: Path, archived: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "disable")
    target, film = tmp_path / "recording.csv", tmp_path / "film.gif"
    result = done("simulate", study, archived, "-o", target, "--video", film)
    assert "there is no video: the variable MUJOCO_GL turns drawing off" in result.stderr
    assert not film.exists()
    assert target.exists()


@pytest.mark.slow
@pytest.mark.usefixtures("drawing")
def test_video_of_a_recording_is_written(study: Path, archived: Path, tmp_path: Path) -> None:
    """A second run may replace what the first one wrote."""
    target, film = tmp_path / "recording.csv", tmp_path / "film.gif"
    result = done("simulate", study, archived, "-o", target, "--video", film)
    if "there is no video" in result.stderr:
        pytest.skip(result.stderr)
    assert "film.gif: The simulated motion, 5 times slower" in result.stderr
    assert film.read_bytes()[:3] == b"GIF"
    OutputGuard([], force=False).check([target, film])
