"""Branches for other operating systems, and processes that leave nothing open."""

from __future__ import annotations

import subprocess
import sys

import pytest

from mjfim.parallel import pool
from tests.support.paths import ROOT


def test_windows_waits_for_at_most_61_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Python refuses pools of more processes there; other systems have no such bound."""
    monkeypatch.setattr(pool, "cores", lambda: 128)
    assert pool.process_count(None) == 128

    monkeypatch.setattr(sys, "platform", "win32")
    assert pool.process_count(None) == 61
    assert pool.process_count(100) == 61
    assert pool.process_count(3) == 3


@pytest.mark.slow
def test_designs_and_fits_leave_no_thread_and_warn_of_nothing() -> None:
    """In Python's development mode files that are not closed are errors."""
    script = (
        "import threading, mjfim\n"
        "e = mjfim.Experiment.from_file('models/cart_pendulum.toml')\n"
        "d = e.descent.model_copy(update={'max_iterations': 1})\n"
        "e = e.model_copy(update={'horizon': 0.3, 'descent': d})\n"
        "design = mjfim.design(e)\n"
        "log = mjfim.simulate(e, design.trajectory)\n"
        "mjfim.identify(e, [log])\n"
        "mjfim.check(e, [log])\n"
        "print(threading.active_count())\n"
    )
    command = [sys.executable, "-X", "dev", "-W", "error", "-c", script]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["1"]
    assert not done.stderr
