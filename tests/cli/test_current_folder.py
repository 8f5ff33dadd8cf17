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
def trap(here: Path) -> Path:
    """The current folder, with modules that leave a file when they are imported."""
    for name in MODULES:
        text = f"open({str(here / 'imported')!r}, 'a').write({name!r})\n"
        (here / f"{name}.py").write_text(text, encoding="utf-8")
    return here


@pytest.mark.slow
def test_a_verb_and_workers_take_nothing_from_the_current_folder(trap: Path) -> None:
    with mjfim.Pool(1) as pool:
        assert pool.submit(os.getpid).result() != os.getpid()
    assert "PYTHONSAFEPATH" not in os.environ

    write_experiment(trap)
    ended = subprocess.run(
        [*PROCESS, "check", "study.toml", "-o", "out"],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert ended.returncode == 0, ended.stderr
    assert (trap / "out" / "check.png").is_file()
    assert not (trap / "imported").exists()
