"""Messages and progress on stderr, and the console of results."""

from __future__ import annotations

import io
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from textwrap import fill
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn
from rich.table import Column
from rich.text import Text

from mjfim.output.live import HERE, design_stage, live_system, progress_line
from mjfim.records.events import Callback, DesignEvent, Event, stages_observed_by

if TYPE_CHECKING:
    from mjfim.experiment.system import System

# Width of the lines of results in a file or a pipe [characters], unless COLUMNS states another one,
# and the smallest width into which tables are fitted.
FILE_WIDTH = 80
LEAST_WIDTH = 20

# Time between two lines of progress where stderr is not a terminal [s].
LINE_SECONDS = 10.0

# Share of all work from which the time that is left follows from the time so far.
LEAST_DONE = 0.1


# Why text for stdout and stderr was lost, by the name of the stream.
_faults: dict[str, str] = {}


class LossyOutput(io.RawIOBase):
    """Bytes of stdout or stderr. Those that cannot be written are lost, and the work goes on."""

    def __init__(self, raw: Any, name: str) -> None:
        self._raw = raw
        self._name = name

    def fileno(self) -> int:
        """Number of the file."""
        return int(self._raw.fileno())

    def isatty(self) -> bool:
        """Whether it is a terminal."""
        return bool(self._raw.isatty())

    def writable(self) -> bool:
        """Always, as far as the writer can see."""
        return True

    def write(self, data: Any) -> int:
        """Write bytes, or note why they are lost."""
        try:
            return int(self._raw.write(data))
        except OSError as error:
            _faults[self._name] = error.strerror or str(error)
            return len(data)


def lose_what_cannot_be_written() -> None:
    """Let stdout and stderr lose text where they are closed or full, and work go on.

    They write "?" for characters that their encoding does not have.
    """
    for number, name in enumerate(("stdout", "stderr"), start=1):
        stream = getattr(sys, name)
        if stream is not None and not isinstance(stream, io.TextIOWrapper):
            continue  # a caller in Python has replaced it
        buffer = io.FileIO(number, "w", closefd=False) if stream is None else stream.buffer
        lossy = LossyOutput(getattr(buffer, "raw", buffer), name)
        encoding = getattr(stream, "encoding", "utf-8")
        text = io.TextIOWrapper(
            io.BufferedWriter(lossy), encoding, errors="replace", line_buffering=True
        )
        setattr(sys, name, text)


def lost_text() -> str:
    """Cause of text for stdout that was lost; empty if none was."""
    sys.stdout.flush()
    return _faults.pop("stdout", "")


def width_of_results() -> int | None:
    """Width of the lines of results [characters]; None for that of the terminal."""
    if sys.stdout is not None and sys.stdout.isatty():
        return None
    stated = os.environ.get("COLUMNS", "")
    width = int(stated) if stated.isdecimal() else FILE_WIDTH
    return width if width >= LEAST_WIDTH else FILE_WIDTH


# Consoles for messages and for results. Brackets and colons in names are no markup and no emoji.
errors = Console(stderr=True, highlight=False, soft_wrap=True, markup=False, emoji=False)
out = Console(highlight=False, width=width_of_results(), markup=False, emoji=False)


def say(sentences: str) -> None:
    """Print sentences on stderr; a terminal breaks them between words, and paths stay whole.

    A line that begins with a space is to be copied, and stays as it is.
    """
    if errors.is_terminal:
        sentences = "\n".join(
            line
            if line.startswith(" ")
            else fill(line, errors.width, break_long_words=False, break_on_hyphens=False)
            for line in sentences.split("\n")
        )
    errors.print(sentences, soft_wrap=True)


class ProgressDisplay:
    """Progress on stderr: a bar on a terminal, otherwise a line from time to time.

    Attributes:
        heading: Work of which all others are parts, such as a round of a campaign.
    """

    def __init__(self, bar: Progress, description: str) -> None:
        self.heading = ""
        self._bar = bar
        self._task = bar.add_task(description, total=None)
        self._told = time.monotonic()

    def show(self, text: str, count: float | None = None, done: float = 0.0) -> None:
        """Show what is done.

        Args:
            text: One line.
            count: Number of all parts; None where it is not known.
            done: Number of finished parts.
        """
        lines = [self.heading, text] if self.heading else [text]
        # An update cannot take away the number of an earlier work.
        self._bar.tasks[0].total = count
        self._bar.update(self._task, description="\n".join(lines), completed=done)
        now = time.monotonic()
        if not errors.is_terminal and now - self._told >= LINE_SECONDS:
            self._told = now
            say(": ".join(lines))

    def begin_stage(self, name: str, index: int, count: int) -> None:
        """Show which work begins, and its number among those of its kind if that is known."""
        self.show(f"{name} ({index + 1}/{count})" if count else name)

    def show_file(self, path: Path) -> None:
        """Show a file that is written."""
        if not path.name.startswith("."):
            self.show(f"written: {path.name}")

    def __call__(self, event: Event) -> None:
        """Show an event."""
        text, done, count = progress_line(event)
        if isinstance(event, DesignEvent) and event.row.mu:
            text = f"{design_stage(event)}: {text}"
        self.show(text, count, done or 0.0)


class _Times(ProgressColumn):
    """The time since the work began, and the time that it takes."""

    def __init__(self, at_most: float | None) -> None:
        super().__init__()
        self._at_most = at_most

    def render(self, task: Task) -> Text:
        """Write the times of a task."""
        elapsed = task.elapsed or 0.0
        done = task.completed / task.total if task.total else 0.0
        text = clock(elapsed)
        if LEAST_DONE <= done < 1.0:
            text += f", about {clock(elapsed * (1.0 / done - 1.0))} left"
        elif self._at_most is not None and self._at_most > elapsed:
            text += f" of at most {clock(self._at_most)}"
        return Text(text, style="progress.elapsed", no_wrap=True)


def clock(seconds: float) -> str:
    """Return a time as minutes and seconds, or as hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


@contextmanager
def progress(description: str, *, at_most: float | None = None) -> Iterator[ProgressDisplay]:
    """Show the progress of long work on stderr.

    Args:
        description: The work before its first event.
        at_most: Time after which the work ends in any case [s]; None without one.

    Yields:
        The display, which is a callback.
    """
    # On a narrow terminal the text is folded, so that the times are not cut.
    folded = Column(no_wrap=False, overflow="fold")
    text = TextColumn("{task.description}", markup=False, table_column=folded)
    columns = (text, BarColumn(bar_width=10), _Times(at_most))
    with Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal) as bar:
        display = ProgressDisplay(bar, description)
        with stages_observed_by(display.begin_stage):
            yield display


@contextmanager
def watched(address: str | None, system: System, display: Callback) -> Iterator[Callback]:
    """Pass events on to the display, and to a viewer if the user wants to watch.

    Args:
        address: Address of the viewer, or `HERE`; None without one.
        system: What is worked on.
        display: The display.
    """
    if address is None:
        yield display
        return
    with live_system(system, None if address == HERE else address, say=say_from_program) as show:

        def both(event: Event) -> None:
            """Show an event twice."""
            display(event)
            show(event)

        yield both


def say_from_program(sentence: str) -> None:
    """Print a sentence of the program about itself, such as about Ctrl-C."""
    say(f"mjfim: {sentence}")
