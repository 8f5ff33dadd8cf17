"""Ctrl-C and SIGTERM on the command line: what one press and two presses do at each moment."""

from __future__ import annotations

import importlib
import signal
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Iterator
from concurrent.futures import Future
from pathlib import Path

import pytest

from mjfim import interruption as module
from mjfim.budget import StopToken, stop_on_interrupt
from mjfim.errors import InterruptedByUserError
from mjfim.interruption import Interruption, hurried, run_optional
from tests.support.paths import ROOT


@pytest.fixture
def sentences() -> list[str]:
    """What the user was told."""
    return []


@pytest.fixture
def interruption(sentences: list[str]) -> Iterator[Interruption]:
    """A handler in force."""
    before = [signal.getsignal(number) for number in module.SIGNALS]
    with Interruption(sentences.append) as handler:
        yield handler
    assert [signal.getsignal(number) for number in module.SIGNALS] == before


def _wait_for_an_end() -> None:
    """Run until an error of the handler comes."""
    end = time.monotonic() + 10.0
    while time.monotonic() < end:
        time.sleep(0.01)
    pytest.fail("no error has come")


@pytest.mark.parametrize("number", module.SIGNALS)
def test_nothing_is_kept_before_there_is_a_result(
    interruption: Interruption, number: signal.Signals
) -> None:
    with pytest.raises(InterruptedByUserError):
        signal.raise_signal(number)


@pytest.mark.parametrize("number", module.SIGNALS)
def test_no_number_of_presses_ends_a_computation_from_outside(
    interruption: Interruption, number: signal.Signals
) -> None:
    inner = StopToken()
    with stop_on_interrupt() as outer, stop_on_interrupt(inner):
        signal.raise_signal(number)
        assert outer.requested
        assert inner.requested
        assert not hurried()

        signal.raise_signal(number)
        assert hurried()

    # The result is written however often the user presses.
    signal.raise_signal(number)
    assert interruption.presses == 3


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


def test_the_second_press_follows_by_itself(
    interruption: Interruption, sentences: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "FINISH_SECONDS", 0.1)

    def draw_for_ever() -> None:
        signal.raise_signal(signal.SIGINT)
        _wait_for_an_end()

    interruption.keep()
    run_optional(draw_for_ever)
    assert sentences == [module.FIRST_SENTENCE]
    assert interruption.incomplete


def test_computations_are_hurried_by_presses_of_the_user_only(
    interruption: Interruption, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A search for a control within the limits, which may take longer, goes on after the time."""
    monkeypatch.setattr(module, "FINISH_SECONDS", 0.05)
    drawn = []
    with stop_on_interrupt():
        signal.raise_signal(signal.SIGINT)
        time.sleep(0.2)
        assert not hurried()

    run_optional(lambda: drawn.append("a figure"))
    assert interruption.incomplete
    assert not drawn
    assert interruption.presses == 1

    signal.raise_signal(signal.SIGINT)
    assert hurried()


def test_no_press_follows_by_itself_after_the_end() -> None:
    """An error that Python drops is raised again only while the program is in the context."""

    class Held:
        """Something with a callback at its end."""

    def draw() -> None:
        held = Held()
        reference = weakref.ref(held, lambda _: signal.raise_signal(signal.SIGINT))
        signal.raise_signal(signal.SIGINT)
        del held
        assert reference() is None

    seen: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: seen.append(number))
    try:
        with Interruption(lambda _: None) as handler:
            handler.keep()
            run_optional(draw)
        time.sleep(4.0 * module.AGAIN_SECONDS)
    finally:
        signal.signal(signal.SIGINT, before)
    assert handler.presses == 2
    assert not seen


def test_what_a_press_says_is_said_before_the_end_of_the_context() -> None:
    """The thread that says it may be late; the sentence would stand among later ones."""
    said: list[str] = []

    def say_late(sentence: str) -> None:
        time.sleep(0.1)
        said.append(sentence)

    with Interruption(say_late) as handler:
        handler.keep()
        signal.raise_signal(signal.SIGINT)
    assert said == [module.FIRST_SENTENCE]


def test_a_press_during_a_callback_is_not_lost(
    interruption: Interruption, capfd: pytest.CaptureFixture[str]
) -> None:
    """Python shows errors of callbacks of its memory management, and does not raise them."""

    class Held:
        """Something with a callback at its end."""

    def draw() -> None:
        held = Held()
        reference = weakref.ref(held, lambda _: signal.raise_signal(signal.SIGINT))
        signal.raise_signal(signal.SIGINT)
        del held
        assert reference() is None
        _wait_for_an_end()

    interruption.keep()
    run_optional(draw)
    assert interruption.incomplete
    assert interruption.presses == 2
    assert "Traceback" not in capfd.readouterr().err


# A module that is imported while the user presses.
PRESSED = """
import signal

signal.raise_signal(signal.SIGINT)
IS_COMPLETE = True
"""


def _import_and_wait(name: str) -> None:
    """Import a module, and run until an error of the handler comes."""
    assert importlib.import_module(name).IS_COMPLETE
    _wait_for_an_end()


@pytest.fixture
def pressed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Name of a module whose import sends a signal to this process."""
    name = "module_that_is_pressed"
    (tmp_path / f"{name}.py").write_text(PRESSED)
    monkeypatch.syspath_prepend(tmp_path)
    yield name
    sys.modules.pop(name, None)


def test_an_import_is_finished_before_the_program_ends(
    interruption: Interruption, pressed: str
) -> None:
    """Python's own code for imports leaves files open where an error comes from outside."""
    with pytest.raises(InterruptedByUserError):
        _import_and_wait(pressed)
    assert sys.modules[pressed].IS_COMPLETE


def test_an_import_of_a_figure_is_finished_before_the_figure_is_left_out(
    interruption: Interruption, pressed: str
) -> None:
    interruption.keep()
    signal.raise_signal(signal.SIGINT)
    run_optional(lambda: _import_and_wait(pressed))
    assert interruption.incomplete
    assert sys.modules[pressed].IS_COMPLETE

    # The error was raised once, and the signal that did so is no press of the user.
    time.sleep(4.0 * module.AGAIN_SECONDS)
    assert interruption.presses == 2


@pytest.mark.parametrize("begin", ["computing", "keep"])
def test_no_work_begins_after_a_press_during_an_import(
    interruption: Interruption, pressed: str, begin: str
) -> None:
    """Short work would end before the error comes, with a result that was asked to stop."""
    importlib.import_module(pressed)
    with pytest.raises(InterruptedByUserError):
        interruption.keep() if begin == "keep" else _compute(interruption)

    # The error is raised once.
    time.sleep(4.0 * module.AGAIN_SECONDS)
    assert interruption.presses == 1


def _compute(interruption: Interruption) -> None:
    with interruption.computing(StopToken()):
        pytest.fail("the computation has begun")


def test_the_end_of_the_work_does_not_hide_a_press_during_an_import(pressed: str) -> None:
    with pytest.raises(InterruptedByUserError), Interruption(lambda _: None):
        importlib.import_module(pressed)


def test_presses_during_an_import_are_counted(
    interruption: Interruption, tmp_path: Path, pressed: str
) -> None:
    """The second press ends the process after some time, also where the import hangs."""
    (tmp_path / f"{pressed}.py").write_text(PRESSED + "signal.raise_signal(signal.SIGINT)\n")
    with pytest.raises(InterruptedByUserError):
        _import_and_wait(pressed)
    assert interruption.presses == 2


def test_a_file_that_was_open_in_the_moment_of_a_press_is_no_fault(
    interruption: Interruption, tmp_path: Path
) -> None:
    """Python closes it, and warns about that; tests fail with such a warning."""

    def draw() -> None:
        file = (tmp_path / "figure").open("w")
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        file.close()

    interruption.keep()
    run_optional(draw)
    assert interruption.incomplete


def test_the_press_that_follows_ends_waiting(
    interruption: Interruption, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A figure of another process, which may hang, is waited for without a limit of time."""
    monkeypatch.setattr(module, "FINISH_SECONDS", 0.1)
    future: Future[None] = Future()
    late = threading.Timer(5.0, future.set_result, [None])
    late.start()

    def wait_for_figure() -> None:
        signal.raise_signal(signal.SIGINT)
        future.result()

    interruption.keep()
    run_optional(wait_for_figure)
    late.cancel()
    assert not future.done()
    assert interruption.incomplete


# A computation that does not look at the request to stop, and is pressed twice.
DEAF = """
import signal
import time

from mjfim import interruption

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
    ended = subprocess.run(
        [sys.executable, "-c", DEAF],
        capture_output=True,
        text=True,
        cwd=ROOT,
        check=False,
        timeout=30.0,
    )
    assert ended.returncode == module.INTERRUPTED_CODE, ended.stderr
    assert ended.stdout.splitlines() == [module.FIRST_SENTENCE, module.LAST_SENTENCE]
    assert not ended.stderr
