"""`mjfim replay`: Rerun files of folders, archives and recordings."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import Result

from mjfim.output import rerun as rerun_log
from tests.support.cli import done


def test_replay_saves(home: Path, identified: Result, tmp_path: Path) -> None:
    """Folders, .rrd files and archives are read; missing folders are made."""
    for source in ("out", "out/design.rrd", "out/design.npz", "fit"):
        target = tmp_path / "new" / f"{Path(source).name}.rrd"
        done("replay", home / source, "--save", target)
        assert target.read_bytes()[:4] == b"RRF2"
    assert (tmp_path / "new" / "out.rrd").read_bytes() == (home / "out" / "design.rrd").read_bytes()


def test_replay_of_a_lonely_archive(folder: Path) -> None:
    """Without its design.json nothing says which model it is of."""
    (folder / "out" / "design.json").unlink()
    said = done("replay out/design.npz --save x.rrd", code=2).stderr
    assert not Path("x.rrd").exists()
    assert "give its file with --experiment" in said
    done("replay out/design.npz --save x.rrd --experiment study.toml")


def test_replay_of_an_archive_leaves_the_full_picture_alone(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The design.rrd beside the archive holds more and is not replaced."""
    shown: list[Path] = []
    monkeypatch.setattr(rerun_log, "show", shown.append)
    full = folder / "out" / "design.rrd"
    full.write_bytes(b"full")
    done("replay out/design.npz")
    assert full.read_bytes() == b"full"
    assert shown[0].is_file() and shown[0].parent != full.parent
