"""Signals on the command line: what one press and two presses do at each moment."""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from mjfim.errors import InterruptedByUserError
from mjfim.parallel.budget import (
    FIRST_SENTENCE,
    INTERRUPTED_CODE,
    LAST_SENTENCE,
    NOTHING_SENTENCE,
    SIGNALS,
    Interruption,
    StopToken,
    hurried,
    run_optional,
    stop_on_interrupt,
)
from tests.support.paths import ROOT


@pytest.fixture
def interruption() -> Iterator[Interruption]:
    """A handler in force."""
    before = [signal.getsignal(number) for number in SIGNALS]
    with Interruption(lambda _: None) as handler:
        yield handler
    assert [signal.getsignal(number) for number in SIGNALS] == before


@pytest.mark.parametrize("number", SIGNALS)
def test_nothing_is_kept_before_there_is_a_result(
    interruption: Interruption, number: signal.Signals
) -> None:
    with pytest.raises(InterruptedByUserError):
        signal.raise_signal(number)


@pytest.mark.parametrize("number", SIGNALS)
def test_no_number_of_presses_ends_a_computation_from_outside(
    interruption: Interruption, number: signal.Signals
) -> None:
    inner = StopToken()
    with stop_on_interrupt() as outer, stop_on_interrupt(inner):
        signal.raise_signal(number)
        assert outer.requested
        assert inner.requested
        assert not hurried()

        signal.raise_signal(signal.SIGINT)
        assert hurried()

    # The result is written however often the user presses.
    signal.raise_signal(signal.SIGTERM)
    assert interruption.presses == 3


# What a program heard: those signals that were not ignored when it began, and SIGTERM always.
HEARD = {
    (): {"SIGINT", "SIGTERM", "SIGHUP"},
    ("SIGINT",): {"SIGTERM", "SIGHUP"},
    ("SIGHUP",): {"SIGINT", "SIGTERM"},
    ("SIGINT", "SIGTERM", "SIGHUP"): {"SIGTERM"},
}


@pytest.mark.parametrize("ignored", HEARD)
@pytest.mark.parametrize("other", [signal.SIG_DFL, lambda *_: None])
def test_signals_that_were_ignored_stay_so_but_for_sigterm(
    ignored: tuple[str, ...], other: Callable[..., None] | signal.Handlers
) -> None:
    """A shell ignores SIGINT in a background job, and `nohup` ignores SIGHUP."""
    before = [signal.getsignal(number) for number in SIGNALS]
    try:
        for number in SIGNALS:
            signal.signal(number, signal.SIG_IGN if number.name in ignored else other)
        for number in SIGNALS:
            with Interruption(lambda _: None) as handler, stop_on_interrupt() as token:
                signal.raise_signal(number)
                assert token.requested is (number.name in HEARD[ignored])
            assert handler.presses == int(token.requested)
    finally:
        for number, handled in zip(SIGNALS, before, strict=True):
            signal.signal(number, handled)


def test_a_terminal_that_is_closed_presses_once(interruption: Interruption) -> None:
    with stop_on_interrupt() as token:
        for _ in range(2):
            signal.raise_signal(signal.SIGHUP)
    assert token.requested
    assert not hurried()


def test_a_computation_that_begins_after_a_press_is_stopped_at_once(
    interruption: Interruption,
) -> None:
    interruption.keep()
    signal.raise_signal(signal.SIGINT)
    with stop_on_interrupt() as token:
        assert token.requested


def test_the_second_press_leaves_out_figures_and_the_program_goes_on(
    interruption: Interruption,
) -> None:
    drawn = []

    def draw() -> None:
        drawn.append("begun")
        signal.raise_signal(signal.SIGINT)
        drawn.append("after one press")
        signal.raise_signal(signal.SIGINT)
        drawn.append("after two presses")

    interruption.keep()
    run_optional(draw)
    run_optional(draw)
    assert drawn == ["begun", "after one press"]
    assert interruption.incomplete


def test_what_a_press_says_is_said_before_the_end_of_the_context() -> None:
    """The thread that says it may be late; the sentence would stand among later ones."""
    said = []

    def say_late(sentence: str) -> None:
        time.sleep(0.1)
        said.append(sentence)

    with Interruption(say_late) as handler:
        handler.keep()
        signal.raise_signal(signal.SIGINT)
    assert said == [FIRST_SENTENCE]


# A module that is imported while the user presses.
PRESSED = """
import signal

signal.raise_signal(signal.SIGINT)
IS_COMPLETE = True
"""


@pytest.fixture
def pressed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Name of a module whose import sends a signal to this process."""
    name = "module_that_is_pressed"
    (tmp_path / f"{name}.py").write_text(PRESSED)
    monkeypatch.syspath_prepend(tmp_path)
    yield name
    sys.modules.pop(name, None)


@pytest.mark.parametrize(
    "begin",
    [Interruption.keep, lambda interruption: interruption.computing(StopToken()).__enter__()],
    ids=["keep", "computing"],
)
def test_no_work_begins_after_a_press_during_an_import(
    interruption: Interruption, pressed: str, begin: Callable[[Interruption], None]
) -> None:
    """Short work would end before the error comes, with a result that was asked to stop."""
    importlib.import_module(pressed)
    with pytest.raises(InterruptedByUserError):
        begin(interruption)

    assert sys.modules[pressed].IS_COMPLETE
    assert interruption.presses == 1


def test_no_figure_begins_some_seconds_after_a_press(
    interruption: Interruption, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mjfim.parallel.budget.FINISH_SECONDS", 0.0)
    drawn = []
    interruption.keep()
    signal.raise_signal(signal.SIGINT)
    run_optional(lambda: drawn.append("a figure"))
    assert interruption.incomplete
    assert not drawn


def test_the_end_of_the_work_does_not_hide_a_press_during_an_import(pressed: str) -> None:
    with pytest.raises(InterruptedByUserError), Interruption(lambda _: None):
        importlib.import_module(pressed)


# A computation that does not look at the request to stop, and is pressed twice.
DEAF = """
import signal
import time

from mjfim.parallel import budget as interruption

interruption.LAST_SECONDS = 0.05


class Ignored:
    def request(self):
        pass


with interruption.Interruption(lambda text: print(text, flush=True)) as handler:
    with handler.computing(Ignored()):
        for _ in range(2):
            signal.raise_signal(signal.SIGINT)
        time.sleep(60.0)
"""


def test_two_presses_end_work_that_does_not_return() -> None:
    assert_ended(ROOT, DEAF, said=[FIRST_SENTENCE, LAST_SENTENCE])


def assert_ended(folder: Path, *words: str, said: list[str]) -> None:
    """A program in a new process is interrupted after these sentences."""
    ended = subprocess.run(
        [sys.executable, "-c", *words],
        capture_output=True,
        text=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])},
        timeout=60.0,
    )
    assert (ended.returncode, ended.stderr) == (INTERRUPTED_CODE, "")
    assert ended.stdout.splitlines() == said


# A program whose work lets threads run, but calls no handler of Python until it ends after minutes,
# as MuJoCo's compile of a large model. It begins a file before, and is pressed during an import, or
# by another thread during the work.
IN_C = """
import hashlib
import os
import signal
import sys
import threading
import time
from contextlib import nullcontext

from mjfim.files import replacing
from mjfim.parallel import budget as interruption

interruption.LAST_SECONDS = 0.3
where, count = sys.argv[1], int(sys.argv[2])


def press():
    for _ in range(count):
        time.sleep(0.2)
        os.kill(os.getpid(), signal.SIGTERM)


with interruption.Interruption(lambda text: print(text, flush=True)), replacing("result.csv"):
    if where == "importing":
        import pressed
    else:
        threading.Thread(target=press).start()
    with interruption.stop_on_interrupt() if where == "computing" else nullcontext():
        hashlib.pbkdf2_hmac("sha256", b"", b"", 2**31 - 1)
"""


@pytest.mark.parametrize(
    ("where", "presses", "said"),
    [
        ("reading", 1, [NOTHING_SENTENCE]),
        ("importing", 1, [NOTHING_SENTENCE]),
        ("computing", 2, [FIRST_SENTENCE, LAST_SENTENCE]),
    ],
)
def test_code_that_calls_no_handler_is_ended(
    where: str, presses: int, said: list[str], tmp_path: Path
) -> None:
    (tmp_path / "pressed.py").write_text(PRESSED.replace("SIGINT", "SIGTERM"))
    assert_ended(tmp_path, IN_C, where, str(presses), said=said)
    assert [path.name for path in tmp_path.iterdir() if path.suffix == ".csv"] == []
