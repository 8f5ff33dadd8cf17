"""`mjfim watch`: how accurately the rows of a stream so far determine the parameters."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from queue import Empty, Queue
from threading import Thread
from typing import TYPE_CHECKING, Annotated, Any

import typer

import mjfim
from mjfim.cli.common import ExperimentFile, LiveView, Run, draw_elsewhere, verb
from mjfim.cli.progress import LINE_SECONDS, errors, say, watched
from mjfim.errors import NoResultError, RecordingError
from mjfim.parallel.budget import StopToken, current_interruption, stop_on_interrupt

if TYPE_CHECKING:
    from mjfim.recordings.read import RowReader
    from mjfim.records.events import Event
    from mjfim.records.worth import Watch

# Time between two updates of the table [s].
REFRESH_SECONDS = 0.1

# Largest number of rows between two looks at the time, and of lines that wait at most.
ROWS_AT_ONCE, MOST_WAITING = 10, 1000

# Number of faulty rows up to which each of them is told; the table counts all.
MOST_TOLD = 50

# Lines of the table beside its rows, on a terminal of 80 columns.
LINES_BESIDE_ROWS = 9

# Word for the standard input, as an option and in messages.
STDIN, STDIN_NAME = "-", "stdin"


@verb(without=("executor",), needs_folder=False)
def watch(
    experiment: ExperimentFile,
    run: Run,
    stream: Annotated[
        str,
        typer.Option(
            "--stream",
            metavar="-|FILE",
            help="CSV rows with a header line: - for stdin, or a file or named pipe, which is read "
            "to its end.",
        ),
    ] = STDIN,
    live: LiveView = None,
) -> int:
    """Say while a robot records how accurately the rows so far determine the parameters."""
    stated = mjfim.Experiment.from_file(experiment)
    if stream != STDIN and not (Path(stream).exists() and not Path(stream).is_dir()):
        raise RecordingError(f"{stream}: no such file")

    meter = mjfim.Meter(stated, threads=run.threads)
    if run.output:
        draw_elsewhere()
    files = [] if stream == STDIN else [Path(stream)]
    run.claim(mjfim.Watch, stated, files)
    with (
        stop_on_interrupt() as stop,
        _table() as table,
        watched(live, meter.system, table) as show,
    ):
        result = _followed(meter, stream, stop, show)

    # Ctrl-C is the usual end of a stream, so that nothing is incomplete.
    interruption = current_interruption()
    if interruption is not None:
        interruption.presses = 0
    return run.finish(result, meter.system)


def _followed(
    meter: mjfim.Meter, stream: str, stop: StopToken, show: Callable[[Event], object]
) -> Watch:
    """Read a stream to its end, or until the user stops it, and show what is known meanwhile."""
    from mjfim.output.pages.studies import progress_of_watch
    from mjfim.records.events import StudyEvent

    rows = _Rows(meter, STDIN_NAME if stream == STDIN else stream)
    event = StudyEvent(study="watch", part="", index=0, count=None, share=0.0)
    shown, taken, is_enough = -math.inf, 0, False
    for line in takewhile(lambda _: not stop.requested, _lines(stream)):
        rows.take(line)
        taken += 1
        is_late = time.monotonic() - shown >= REFRESH_SECONDS
        if is_late or taken == ROWS_AT_ONCE:
            taken = 0
            result = rows.result()
            text = progress_of_watch(result)
            if result.enough > is_enough:
                say(text)
            is_enough = result.enough
        if is_late:
            shown = time.monotonic()
            show(replace(event, message=text, result=result))
    try:
        return rows.result(ended=True)
    except RecordingError:
        if stop.requested:
            raise NoResultError from None
        raise


class _Rows:
    """Lines of a stream that become rows of a meter; faulty ones are told, counted, left out."""

    def __init__(self, meter: mjfim.Meter, source: str) -> None:
        self._meter, self._source = meter, source
        self._reader: RowReader | None = None
        self._lines = self._left_out = 0

    def take(self, line: str) -> None:
        """Take a line; the first one is the header."""
        from mjfim.recordings.read import RowReader

        self._lines += bool(line)
        if not line.strip():
            return
        if self._reader is None:
            self._reader = RowReader(line, self._meter.system.channels, self._source)
            return
        try:
            row = self._reader.row(line)
            if row is not None:
                self._meter.add(*row)
        except RecordingError as fault:
            self._left_out += 1
            if self._left_out <= MOST_TOLD:
                said = str(fault).partition(" in data row")[0]
                say(f"warning: {self._source}: line {self._lines}: {said}; the row is left out")

    def result(self, *, ended: bool = False) -> Watch:
        """The accuracy from the rows so far."""
        if ended and self._reader is None:
            raise RecordingError(f"{self._source}: no line; the first one names the columns")
        return replace(self._meter.read(ended=ended), left_out=self._left_out)


def _lines(stream: str) -> Iterator[str]:
    """Lines of a stream as they come; an empty one where none comes for a moment."""
    lines: Queue[str | None] = Queue(MOST_WAITING)

    def read() -> None:
        """Read the stream, also while another thread computes."""
        with open(0 if stream == STDIN else stream, encoding="utf-8-sig", errors="replace") as file:
            for line in file:
                lines.put(line)
        lines.put(None)

    Thread(target=read, daemon=True).start()
    line: str | None = ""
    while line is not None:
        yield line
        try:
            line = lines.get(timeout=REFRESH_SECONDS)
        except Empty:
            line = ""


@contextmanager
def _table() -> Iterator[Callable[[Any], None]]:
    """A table on stderr that events update; a line from time to time where it is no terminal."""
    from rich.live import Live

    from mjfim.output.pages import page_of
    from mjfim.output.terminal import laid_out

    told = time.monotonic()
    with Live(console=errors, auto_refresh=False, transient=True) as drawn:

        def show(event: Any) -> None:
            """Show the result that an event holds."""
            nonlocal told
            if errors.is_terminal:
                has_room = errors.height >= len(event.result.parameters) + LINES_BESIDE_ROWS
                page = page_of(event.result)
                drawn.update(laid_out(page, errors, verbose=has_room), refresh=True)
            elif time.monotonic() - told >= LINE_SECONDS:
                told = time.monotonic()
                say(f"{event.result.seconds:.1f} s: {event.message}")

        yield show
