"""`mjfim replay`: Rerun files of folders, archives and recordings."""

from __future__ import annotations

import shutil
from pathlib import Path

from typer.testing import Result

from mjfim.output import rerun as rerun_log
from tests.support.cli import done, misused, run
from tests.support.paths import MODELS


def test_replay_saves(home: Path, archived: Path, identified: Result, tmp_path: Path) -> None:
    """Folders, .rrd files and archives are read; missing folders are made."""
    for source in (home / "out", home / "out" / "design.rrd", archived, home / "fit"):
        target = tmp_path / "new" / f"{source.name}.rrd"
        result = run("replay", source, "--save", target)
        assert (result.exit_code, target.is_file()) == (0, True), result.stderr
        assert target.read_bytes()[:4] == b"RRF2"
    assert (tmp_path / "new" / "out.rrd").read_bytes() == (home / "out" / "design.rrd").read_bytes()


def test_replay_of_a_lonely_archive(archived: Path, tmp_path: Path) -> None:
    """Without its design.json nothing says which model it is of."""
    shutil.copy(archived, tmp_path)
    target = tmp_path / "x.rrd"
    result = run("replay", tmp_path / "design.npz", "--save", target)
    assert (result.exit_code, target.exists()) == (2, False)
    assert "give its file with --experiment" in result.stderr
    stated = ("--experiment", MODELS / "cart_pendulum.toml")
    done("replay", tmp_path / "design.npz", "--save", target, *stated)


def test_replay_into_a_folder(home: Path, designed: Result, tmp_path: Path) -> None:
    """The option --save needs a file."""
    misused(run("replay", home / "out", "--save", tmp_path), str(tmp_path))


def test_replay_of_an_archive_leaves_the_full_picture_alone(
    home: Path, designed: Result, monkeypatch
) -> None:
    """The design.rrd beside the archive holds more and is not replaced."""
    shown: list[Path] = []
    monkeypatch.setattr(rerun_log, "show", shown.append)
    before = (home / "out" / "design.rrd").read_bytes()
    done("replay", home / "out" / "design.npz")
    assert (home / "out" / "design.rrd").read_bytes() == before
    assert shown[0].is_file()
    assert shown[0].parent != home / "out"
