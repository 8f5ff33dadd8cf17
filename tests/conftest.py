"""Settings of every test process: one BLAS thread, and Ctrl-C as in a terminal."""

from __future__ import annotations

import gc
import os
import signal
import sys
from pathlib import Path

import pytest

# The tests run side by side on all cores, so one thread of BLAS per process is enough.
# BLAS reads the variable when NumPy is imported, which is later than this line.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Where the environment keeps no compiled modules, all test processes and those that they start
# would compile every module again. They share them in a folder that git ignores.
if sys.dont_write_bytecode:
    sys.dont_write_bytecode = False
    sys.pycache_prefix = str(Path(__file__).parents[1] / ".pytest_cache" / "compiled")
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix

# The reports of designs and estimates get no videos, which take seconds. Tests of videos ask for
# the fixture `drawing`.
os.environ["MUJOCO_GL"] = "disable"

# A picture or a page that cannot be drawn is an error of the tests, also in processes they start.
os.environ["PYTHONWARNINGS"] = "error:could not draw"


def pytest_sessionstart(session: pytest.Session) -> None:
    """Restore Python's handler of SIGINT.

    A background job of a shell inherits SIGINT as ignored, and then the tests of Ctrl-C would fail.
    """
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_collection_finish(session: pytest.Session) -> None:
    """Leave the imported modules out of garbage collection, and collect less often.

    The modules and all tests stay until the end. To look at them again and again takes a tenth of
    the time of the tests.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 20, 20)


@pytest.fixture
def drawing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let MuJoCo draw, by any kind of OpenGL that this computer has."""
    monkeypatch.delenv("MUJOCO_GL")


@pytest.fixture
def empty_figures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write empty files in place of figures, for tests that look at the names of the files."""
    # Imported here, because most tests call no verb.
    from tests.support.cli import write_empty_figures

    write_empty_figures(monkeypatch)
