"""Searches in several processes: stopped early, they return their best results."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

import mjfim
from mjfim import parallel as workers
from mjfim.cli.common import Run
from mjfim.errors import ExperimentError
from mjfim.excitation.design import design_task
from mjfim.parallel import dispatch
from mjfim.parallel.budget import Budget, Interruption, StopToken
from mjfim.records.design import Status, keeps_limits
from tests.support.cart_pendulum import cart_pendulum
from tests.support.cli import PROCESS, read, write_experiment
from tests.support.limits import cart_inside
from tests.support.paths import ROOT


def identity() -> int:
    """Return the number of this process."""
    return os.getpid()


def wait_for_stop(longest: float) -> tuple[bool, int]:
    """Wait for the request of the pool to stop; return whether it came, and the process."""
    end = time.monotonic() + longest
    while time.monotonic() < end and not workers.pool_stop_token().requested:
        time.sleep(0.02)
    return workers.pool_stop_token().requested, os.getpid()


@pytest.mark.slow
def test_a_stopped_pool_can_be_used_again_once_nothing_runs() -> None:
    stop = StopToken()
    with mjfim.Pool(1) as pool:
        process = pool.submit(identity).result()
        assert process != os.getpid()
        threading.Timer(0.5, stop.request).start()
        budget = Budget(stop=stop)
        found = list(workers.carry_out(pool, wait_for_stop, [60.0, 60.0, 60.0], budget))
        assert found[0] == (0, ((True, process),))
        assert pool.submit(wait_for_stop, 0.1).result(timeout=30.0) == (False, process)


def offer_and_go_on(result: int) -> int:
    """Offer a result, then do not look at the request to stop for a minute."""
    workers.offer_result(result)
    time.sleep(60.0)
    return -1


@pytest.mark.slow
def test_a_task_that_does_not_end_in_time_hands_over_its_best_so_far(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As an optimisation whose single iterate takes longer than anybody waits."""
    monkeypatch.setattr(dispatch, "GRACE", 2.0)
    stop = StopToken()
    with mjfim.Pool(1) as pool:
        process = pool.submit(identity).result()
        threading.Timer(1.0, stop.request).start()
        begin = time.monotonic()
        found = list(workers.carry_out(pool, offer_and_go_on, [7], Budget(stop=stop)))
        assert found == [(0, (7,))]
        assert time.monotonic() - begin < 8.0

        # The process that goes on is ended, and another one does what follows.
        assert pool.submit(identity).result(timeout=30.0) != process
        assert not pool.has_lost_worker


@pytest.mark.parametrize("is_stopped", [False, True])
def test_a_run_that_is_stopped_blames_nobody_for_the_end_of_a_worker(
    is_stopped: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A signal to the group ends the workers that wait for work, too."""
    with Interruption(lambda _: None) as interruption:
        interruption.keep()
        with Run(output=tmp_path).workers(processes=2) as started:
            process = started.submit(identity).result()
            if is_stopped:
                signal.raise_signal(signal.SIGTERM)
            os.kill(process, signal.SIGTERM)
            with suppress(BrokenExecutor):
                while started.submit(identity).result() == process:
                    time.sleep(0.1)
    assert (workers.LOST_SENTENCE in capsys.readouterr().err) is not is_stopped


def test_a_search_that_is_stopped_at_once_is_not_worse_than_an_initial_control_within_limits(
    tmp_path: Path,
) -> None:
    """On the coarse level, the mean control of each two samples costs slightly more."""
    task, stop = cart_inside(tmp_path, descent={"starts": 3, "max_iterations": 30}), StopToken()
    design = design_task(task, callback=lambda event: stop.request(), budget=Budget(stop=stop))
    assert design.status is Status.INTERRUPTED
    assert not design.initial_violations
    assert keeps_limits(design)
    assert design.final.cost <= design.initial.cost


@pytest.mark.slow
@pytest.mark.parametrize(("number", "presses"), [(signal.SIGINT, 1), (signal.SIGTERM, 2)])
def test_signals_on_the_command_line_reach_all_processes_and_leave_the_best(
    number: signal.Signals, presses: int, tmp_path: Path
) -> None:
    """A terminal sends SIGINT, and `timeout` SIGTERM, to all processes of the group."""
    hard = (
        "[limits]\ncontrol = { force = [-5.0, 5.0] }\nposition = { slide = [-0.5, 0.5] "
        "}\ncontrol_rate = 100.0"
    )
    endless = {"tolerance": "1e-12", "max_iterations": f"100000\nstarts = 2000\n{hard}"}
    words = [*PROCESS, "design", write_experiment(tmp_path, **endless), "-o", tmp_path / "out"]
    with subprocess.Popen(
        words, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as p:
        try:
            # The first start has ended, and others are running.
            assert any("iteration " in line for line in iter(p.stderr.readline, ""))
            os.killpg(p.pid, number)
            if presses > 1:
                time.sleep(1.0)
                os.killpg(p.pid, number)
            _, told = p.communicate(timeout=60)
        finally:
            with suppress(ProcessLookupError):
                os.killpg(p.pid, signal.SIGKILL)
    assert p.returncode == 1, told
    assert "Traceback" not in told
    assert workers.LOST_SENTENCE not in told
    data = read(tmp_path / "out" / "design.json")
    assert data["status"] == "interrupted"

    # A start that was stopped before its first step on the coarse level has a control that is
    # slightly worse than the initial one, which keeps the limits here.
    assert data["final"]["cost"] <= data["initial"]["cost"]


# A program with one busy and one idle worker, which says when both are running.
BUSY_AND_IDLE = """
import time

import mjfim

if __name__ == "__main__":
    with mjfim.Pool(2) as pool:
        pool.submit(time.sleep, 60.0)
        pool.submit(time.sleep, 0.0).result()
        print("running", flush=True)
        time.sleep(60.0)
"""


@pytest.mark.slow
def test_the_workers_of_a_killed_process_end_by_themselves(tmp_path: Path) -> None:
    """The processes share one stdout, which ends when the last of them has ended."""
    script = tmp_path / "busy_and_idle.py"
    script.write_text(BUSY_AND_IDLE, encoding="utf-8")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, str(script)], stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        assert process.stdout.readline() == "running\n"

        process.kill()
        process.communicate(timeout=5.0)
    assert process.returncode != 0


@pytest.mark.parametrize(
    ("threads", "message"),
    [(0, "0 .* from 1 to 1024"), (10**6, "1000000 .* to 1024"), (1.5, "needs whole .*; not 1.5")],
)
def test_impossible_numbers_of_threads_are_refused(threads: Any, message: str) -> None:
    """The message states the bounds or the kind, before anything is allocated."""
    with pytest.raises(ExperimentError, match=rf"threads: {message}"):
        mjfim.check(cart_pendulum(), threads=threads)
