"""No code and no settings are taken from the folder in which the user works."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import pytest

import mjfim
from tests.support.cli import PROCESS, write_experiment
from tests.support.paths import ROOT

# Modules of Python and of libraries that are imported after the start of a process.
MODULES = ("signal", "socket", "pickle", "struct", "typing", "platform", "numpy", "rerun")


@pytest.fixture
def trap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with modules that leave a file when they are imported."""
    for name in MODULES:
        (tmp_path / f"{name}.py").write_text(
            f"open({str(tmp_path / 'imported')!r}, 'a').write({name!r})\n", encoding="utf-8"
        )
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.slow
def test_workers_import_nothing_from_the_current_folder(trap: Path) -> None:
    with mjfim.Pool(1) as pool:
        assert pool.submit(os.getpid).result() != os.getpid()
    assert not (trap / "imported").exists()
    assert "PYTHONSAFEPATH" not in os.environ


@pytest.mark.slow
def test_a_verb_takes_nothing_from_the_current_folder(trap: Path) -> None:
    path = write_experiment(trap)
    done = subprocess.run(
        [*PROCESS, "check", path, "-o", "out"],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert (trap / "out" / "check.png").is_file()
    assert not (trap / "imported").exists()
