"""Common parts of all verbs: the app, types of arguments, progress on stderr, exit codes."""

from __future__ import annotations

import functools
import io
import os
import shlex
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from textwrap import wrap
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, SpinnerColumn, Task, TextColumn
from rich.progress_bar import ProgressBar
from rich.table import Column
from rich.text import Text
from typer.core import TyperCommand

import mjfim
from mjfim.amounts import MAX_THREADS
from mjfim.cli.inputs import require_inputs
from mjfim.errors import (
    InterruptedByUserError,
    MjfimError,
    ModelWarning,
    NoResultError,
    RecordingError,
    UndrawnWarning,
    UnfinishedError,
)
from mjfim.files import observed_by, remove_temporary_files
from mjfim.output.live import ADDRESS, HERE, live_system
from mjfim.output.optional_files import write_optional
from mjfim.output.picture_format import PictureFormat
from mjfim.output.progress_text import design_stage, design_text, fit_text, part_text
from mjfim.output.report import OWN_REPORTS, REPORT, is_report
from mjfim.output.summary_parts import Summary
from mjfim.output.text import render
from mjfim.output.video.video import NoVideoError, require_format, write_video
from mjfim.parallel.budget import (
    INTERRUPTED_CODE,
    NOTHING_SENTENCE,
    Interruption,
    current_interruption,
)
from mjfim.records.events import (
    Callback,
    DesignEvent,
    Event,
    FitEvent,
    StudyEvent,
    stages_observed_by,
)

if TYPE_CHECKING:
    from mjfim.experiment.system import System
    from mjfim.output.video.film import Filmed

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Design the experiment that identifies a MuJoCo model's parameters, then identify them.",
)


class MessageConsole(Console):
    """A console for sentences.

    A terminal breaks them between words, and never inside a path, which the user may copy. In a
    file each sentence is one line.
    """

    def print(self, *objects: Any, **options: Any) -> None:
        """Print as a console does.

        Args:
            *objects: What is printed.
            **options: Options of `rich.console.Console.print`.
        """
        if self.is_terminal:
            objects = tuple(self._folded(each) for each in objects)
        super().print(*objects, **options)

    def _folded(self, printed: Any) -> Any:
        """Break the lines of a text between words."""
        if not isinstance(printed, str):
            return printed

        lines = []
        for line in printed.split("\n"):
            folded = wrap(line, self.width, break_long_words=False, break_on_hyphens=False)
            lines += folded or [""]
        return "\n".join(lines)


# Console for messages and progress. Brackets and colons in file names are no markup and no emoji.
errors = MessageConsole(stderr=True, highlight=False, soft_wrap=True, markup=False, emoji=False)

# Width of the lines of results in a file or a pipe [characters], unless COLUMNS states another one,
# and the smallest width into which tables are fitted.
FILE_WIDTH = 80
LEAST_WIDTH = 20


def width_of_results() -> int | None:
    """Width of the lines of results [characters]; None for that of the terminal.

    A file or a pipe has the width that the environment states, not that of the terminal in which
    the verb was started, so that the result is the same everywhere.
    """
    if sys.stdout.isatty():
        return None
    stated = os.environ.get("COLUMNS", "")
    width = int(stated) if stated.isdecimal() else FILE_WIDTH
    return width if width >= LEAST_WIDTH else FILE_WIDTH


# Console for results.
out = Console(highlight=False, width=width_of_results(), markup=False, emoji=False)

# Files that the running verb wrote, and how many it may write at most.
_written: list[Path] = []
_names: list[str] = []

# Number of iterations from one line of progress to the next, for a design and for an estimation,
# if stderr is not a terminal.
DESIGN_LINES = 10
FIT_LINES = 5

# Width of bars of progress [characters].
BAR_WIDTH = 10

# Time after which a line of progress is due, if stderr is not a terminal [s].
LINE_SECONDS = 10.0

# Share of all work from which the time that is left follows from the time so far.
LEAST_DONE = 0.1

# Share of a round, compared with the mean of the earlier ones, at which its bar stops.
MOST_OF_ROUND = 0.95

# Time to write a file of a kind, in that of a picture; data take next to none. The report is
# written again with a video in the folders that have a file for Rerun.
PICTURE_WEIGHTS = {".png": 1.0, ".svg": 1.0, ".pdf": 1.0, ".rrd": 0.5}
VIDEO_WEIGHT = 4.0

# Arguments and options that several verbs share.
ExperimentFile = Annotated[
    Path, typer.Argument(metavar="EXPERIMENT", help="Experiment file (TOML).")
]


def _file_of_design(path: Path | None) -> Path | None:
    """The file design.npz where a folder is named."""
    return path / "design.npz" if path is not None and path.is_dir() else path


DesignFile = Annotated[
    Path,
    typer.Argument(
        metavar="DESIGN",
        help="Folder of `mjfim design`, or its file design.npz.",
        callback=_file_of_design,
    ),
]
InitialOrDesign = Annotated[
    Path | None,
    typer.Argument(
        metavar="DESIGN",
        help="Folder of `mjfim design`, or its file design.npz. Default: the initial control.",
        callback=_file_of_design,
        show_default=False,
    ),
]
OtherDesign = Annotated[
    Path | None,
    typer.Option(
        "--design",
        metavar="DESIGN",
        help="Design to check instead of the initial control: its folder, or its file design.npz.",
        callback=_file_of_design,
    ),
]
ModelFile = Annotated[Path, typer.Argument(metavar="MODEL", help="Model file (MJCF or URDF).")]
Folder = Annotated[
    Path,
    typer.Option(
        "--output", "-o", metavar="DIR", help="Folder for the results; created if it is missing."
    ),
]
Verbose = Annotated[
    bool,
    typer.Option("--verbose", "-v", help="Print all tables and sentences, not only the essential."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON instead of tables.")]
Pictures = Annotated[
    PictureFormat, typer.Option("--format", help="Format of the pictures.", case_sensitive=False)
]
Threads = Annotated[
    int | None,
    typer.Option(min=1, max=MAX_THREADS, help="Threads for MuJoCo; default: all cores."),
]
Force = Annotated[
    bool,
    typer.Option(
        "--force",
        help="Replace files that mjfim did not write, or that were changed since; inputs never.",
    ),
]

VideoFile = Annotated[
    Path | None,
    typer.Option(
        "--video",
        metavar="FILE.mp4 | FILE.gif",
        help="Video of the robot, drawn by MuJoCo; no display is needed.",
    ),
]

LiveView = Annotated[
    str | None,
    typer.Option(
        "--live",
        metavar="[ADDRESS]",
        help="Show the search in a Rerun viewer while it runs; in the one at HOST:PORT if given.",
    ),
]

# What ends with the running verb: folders that it has claimed, and a process that draws.
_claims = ExitStack()

# True in the program `mjfim`.
_may_start_processes = False


def claim_folder(
    folder: Path, names: Iterable[str], inputs: Sequence[Path], *, force: bool
) -> None:
    """Make sure before the work that results can be written, and keep other runs out.

    The claim ends with the verb.

    Args:
        folder: Folder for the results; it is created if it does not exist.
        names: Names of all files that may be written, relative to the folder.
        inputs: Files that the verb reads.
        force: Whether the user permits to replace files that mjfim did not write.

    Raises:
        RecordingError: The folder is a file, or writing is not permitted.
        OutputError: A file may not be replaced, or another run writes into the folder.
    """
    from mjfim.output.folders import check_folder
    from mjfim.output.manifest import OutputGuard, claimed

    _names[:] = names
    check_folder(folder)
    guard = OutputGuard(inputs, force=force)
    guard.check(folder / name for name in _names)
    if REPORT in _names:
        # The pages of other results in the folder name this result, or give it their place.
        guard.check(folder / name for name in OWN_REPORTS)
    _claims.enter_context(claimed(folder, guard, exclusive=True))


def claim_file(file: Path, inputs: Sequence[Path], *, force: bool) -> None:
    """Make sure before the work that a single file can be written.

    Args:
        file: The file.
        inputs: Files that the verb reads.
        force: Whether the user permits to replace a file that mjfim did not write.

    Raises:
        RecordingError: The file is a folder, or writing is not permitted.
        OutputError: The file may not be replaced.
    """
    from mjfim.output.folders import check_file
    from mjfim.output.manifest import OutputGuard, claimed

    check_file(file)
    guard = OutputGuard(inputs, force=force)
    guard.check([file])
    _claims.enter_context(claimed(file.parent, guard, exclusive=False))


def claim_video(video: Path | None, inputs: Sequence[Path], *, force: bool) -> None:
    """Make sure before the work that a video can be written.

    Args:
        video: The file, or None without a video.
        inputs: Files that the verb reads.
        force: Whether the user permits to replace a file that mjfim did not write.

    Raises:
        RecordingError: The file has another ending, is a folder, or writing is not permitted.
        NoVideoError: A package is missing.
        OutputError: The file may not be replaced.
    """
    if video is None:
        return

    require_format(video)
    claim_file(video, inputs, force=force)


def write_wanted_video(video: Path | None, system: System, result: Filmed) -> None:
    """Write the video that the user asks for; where that is impossible, say why.

    Args:
        video: The file, or None without a video.
        system: The experiment.
        result: What the video shows.
    """
    if video is None:
        return

    def write() -> None:
        """Write the file and say what it shows."""
        try:
            with progress("drawing the video"):
                written = write_video(video, system, result)
        except NoVideoError as reason:
            errors.print(f"mjfim: there is no video: {reason}", markup=False)
            return
        errors.print(f"wrote {video}: {written.caption}", markup=False)

    write_optional(str(video), write)


def permit_processes() -> None:
    """Let verbs draw in processes of their own from now on, as in the program `mjfim`.

    Where another program calls verbs, as tests do, a process for each call takes too long.
    """
    global _may_start_processes
    _may_start_processes = True


def draw_elsewhere() -> None:
    """Let another process draw the pictures of the running verb's result.

    It imports what it needs while the verb works. On a single processor, it would delay it.
    """
    if not _may_start_processes:
        return

    from mjfim.output.drawing import drawing_elsewhere

    _claims.enter_context(drawing_elsewhere())


def keep_result(folder: Path | None = None) -> None:
    """Say that there is a result, so that Ctrl-C does not end the verb before it is written.

    Args:
        folder: Folder that receives it, or None.
    """
    interruption = current_interruption()
    if interruption is not None:
        interruption.keep(folder)


def replace_unencodable_characters() -> None:
    """Let stdout and stderr write "?" for characters that their encoding does not have.

    Windows consoles, redirected output and some locales are not UTF-8. Files are always UTF-8.
    """
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")


@contextmanager
def writing(folder: Path) -> Iterator[ModuleType]:
    """Create a folder for results, and import the module that writes them.

    The display of progress counts the files that are written. After Ctrl-C inside the context, the
    data are written completely, but figures are left out if they take too long.

    Args:
        folder: The folder.

    Yields:
        The module `mjfim.output.folders`.
    """
    keep_result()
    _written.clear()
    with progress("writing files and pictures") as show, observed_by(show.count_file):
        from mjfim.output import folders as results  # imports matplotlib and rerun, which is slow

        folder.mkdir(parents=True, exist_ok=True)
        keep_result(folder)
        yield results


def say_written(folder: Path, remark: str = "") -> None:
    """Say where the results are, and which page shows all of them.

    Args:
        folder: Folder with the results.
        remark: What can be done with them; may be empty.
    """
    pages = [path for path in _written if path.parent == folder and is_report(path)]
    report = f"; see {pages[-1]}" if pages else ""
    errors.print(f"wrote {folder}/{report}{remark}", markup=False)


def _version(wanted: bool) -> None:
    """Print the version and exit if the option is given."""
    if wanted:
        typer.echo(mjfim.__version__)
        raise typer.Exit


@app.callback()
def root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Design the experiment that identifies a MuJoCo model's parameters, then identify them."""


def verb(function: Callable[..., None]) -> Callable[..., None]:
    """Register a function as a verb, and turn its errors into messages and exit codes.

    Misuse gives exit code 2. Ctrl-C, and a file that cannot be written, give exit code 1.

    Args:
        function: The function; underscores in its name become hyphens, one at its end is left out
            (verbs such as `list` are names of Python).

    Returns:
        The function with the error handling.
    """

    @functools.wraps(function)
    def wrapped(**kwargs: Any) -> None:
        """Call the verb; print one message and exit for each error."""
        interruption = Interruption(_announce)
        try:
            with interruption, _claims, _worded_warnings():
                require_inputs(kwargs)
                function(**kwargs)
        except (InterruptedByUserError, NoResultError, UnfinishedError):
            _say_what_is_there(interruption)
            raise typer.Exit(INTERRUPTED_CODE) from None
        except (MjfimError, MemoryError, OSError) as error:
            raise _told(error) from None
        except typer.Exit as end:
            # An interrupted verb did not do all that it was asked for.
            if interruption.incomplete:
                _say_what_is_there(interruption)
            if interruption.presses and not end.exit_code:
                raise typer.Exit(INTERRUPTED_CODE) from None
            raise
        finally:
            # A press may have come between the creation of a temporary file and its removal.
            remove_temporary_files()

        if interruption.incomplete:
            _say_what_is_there(interruption)
        if interruption.presses:
            raise typer.Exit(INTERRUPTED_CODE)

    app.command(function.__name__.rstrip("_").replace("_", "-"), cls=VerbCommand)(wrapped)
    return wrapped


def _told(error: MjfimError | MemoryError | OSError) -> typer.Exit:
    """Print one message about an error, and return the end of the verb with its exit code."""
    message, code = str(error), 2
    if isinstance(error, MemoryError):
        message = (
            f"there is not enough memory ({error or 'nothing is left'}); a shorter horizon, a "
            "lower rate, or fewer parameters, recordings or trials need less"
        )
    elif isinstance(error, OSError):
        message, code = f"{error.filename or 'cannot write'}: {error.strerror or error}", 1
    errors.print(f"mjfim: {message}", markup=False)
    return typer.Exit(code)


@contextmanager
def _worded_warnings() -> Iterator[None]:
    """Print warnings about models and drawings as sentences, without the place in the code."""
    with warnings.catch_warnings():
        usual = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *place: Any, **to: Any) -> None:
            """Print a warning."""
            if issubclass(category, (ModelWarning, UndrawnWarning)):
                errors.print(f"warning: {message}", markup=False)
            else:
                usual(message, category, *place, **to)

        warnings.showwarning = show
        yield


def _announce(sentence: str) -> None:
    """Show a sentence about Ctrl-C."""
    errors.print(f"mjfim: {sentence}", markup=False)


def _say_what_is_there(interruption: Interruption) -> None:
    """Say after Ctrl-C whether anything was written."""
    if interruption.folder is None:
        _announce(NOTHING_SENTENCE)
        return

    sentence = (
        f"interrupted; {interruption.folder}/ holds only a part of the results, but each file in "
        "it is complete"
    )
    if _holds_a_result(interruption.folder):
        name = shlex.quote(str(interruption.folder))
        sentence += f"; `mjfim report {name} --pictures` draws the pictures that are missing"
    _announce(sentence)


def _holds_a_result(folder: Path) -> bool:
    """Check whether a folder holds a result that has a report."""
    from mjfim.output.report.build import verbs_in  # takes a while to import

    try:
        return bool(verbs_in(folder))
    except RecordingError:
        return False


class VerbCommand(TyperCommand):
    """A verb whose option --live may stand without an address."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Complete --live, and parse the arguments.

        Args:
            ctx: Context of the command line.
            args: Words of the command line.
        """
        return super().parse_args(ctx, with_live_address(args))


def with_live_address(words: Sequence[str]) -> list[str]:
    """Return the words of a command line, in which --live has an address.

    Args:
        words: The words. A word after --live is its address only if it looks like one.
    """
    completed: list[str] = []
    for k, word in enumerate(words):
        follower = words[k + 1] if k + 1 < len(words) else ""
        is_alone = word == "--live" and not ADDRESS.fullmatch(follower)
        completed.append(f"--live={HERE}" if is_alone else word)
    return completed


@contextmanager
def watched(address: str | None, system: System, display: Callback) -> Iterator[Callback]:
    """Pass events on to the display, and to a viewer if the user wants to watch.

    Args:
        address: Value of the option --live, or None.
        system: The experiment.
        display: Shows the progress.

    Yields:
        The function that takes the events.
    """
    if address is None:
        yield display
        return

    where = None if address == HERE else address
    with live_system(system, where, say=_announce) as show:

        def both(event: Event) -> None:
            """Show an event twice."""
            display(event)
            show(event)

        yield both


class _Rounds:
    """Rounds of a campaign, which take about equally long.

    Attributes:
        count: Largest number of rounds.
        done: Number of complete rounds.
    """

    def __init__(self, *, count: int) -> None:
        """Begin the first round."""
        self.count = count
        self.done = 0
        self._begun = time.monotonic()
        self._lengths: list[float] = []

    def finish_one(self, *, is_new: bool) -> None:
        """Count a complete round.

        Args:
            is_new: False for a round of an earlier call, which is only identified again.
        """
        now = time.monotonic()
        self.done += 1
        if is_new:
            self._lengths.append(now - self._begun)
        self._begun = now

    @property
    def done_so_far(self) -> float:
        """Complete rounds, and the share of the present one, which lasts as long as the others."""
        if not self._lengths:
            return float(self.done)
        mean = sum(self._lengths) / len(self._lengths)
        share = (time.monotonic() - self._begun) / mean
        return self.done + min(share, MOST_OF_ROUND)

    @property
    def seconds_left(self) -> float | None:
        """Time of all rounds that are left [s]; None before the first one is complete."""
        if not self._lengths:
            return None
        mean = sum(self._lengths) / len(self._lengths)
        return (self.count - self.done_so_far) * mean

    def __str__(self) -> str:
        return f"round {min(self.done + 1, self.count)} of at most {self.count}"


def work_on_files(names: Sequence[str]) -> float:
    """Work to write files, in that to draw one picture.

    Args:
        names: Their names; a report that is written for the second time gets a video.
    """
    total = 0.0
    for k, name in enumerate(names):
        is_second_report = name == REPORT and name in names[:k]
        total += VIDEO_WEIGHT if is_second_report else PICTURE_WEIGHTS.get(Path(name).suffix, 0.0)
    return total


def _second_reports(names: Sequence[str]) -> list[str]:
    """The report once more where it gets a video."""
    has_motion = any(name.endswith(".rrd") for name in names)
    return [REPORT] if has_motion and REPORT in names else []


class ProgressDisplay:
    """Display of progress on stderr: a bar on a terminal, otherwise a line from time to time."""

    def __init__(self, bar: Progress, description: str) -> None:
        """Add a row to a progress display.

        Args:
            bar: The display.
            description: Text until the first event.
        """
        self._bar = bar
        self._task = bar.add_task(
            description, total=None, part_began=time.monotonic(), is_whole=False
        )
        self._announced_part = ""
        self._stage = ""
        self._latest = description
        self._begun = self._told = time.monotonic()
        self._rounds: _Rounds | None = None
        self._counts_files = False

        # Work on all files, and on those that are written; data take next to none.
        self._work: tuple[float, float] | None = None

    def count_file(self, path: Path) -> None:
        """Show which share of the work on files is done."""
        if path.name.startswith("."):
            return

        _written.append(path)
        self._counts_files = True
        if path.name == REPORT or path.suffix in PICTURE_WEIGHTS or self._work is None:
            done = work_on_files([each.name for each in _written])
            total = work_on_files([*dict.fromkeys(_names), *_second_reports(_names)])
            self._work = max(done, total), done
        total, done = self._work
        self._show(f"written: {path.name}", total or None, done)

    def count_rounds(self, count: int) -> None:
        """Show from now on how many rounds are done, and the number of the present one.

        Args:
            count: Largest number of rounds.
        """
        self._rounds = _Rounds(count=count)
        self._bar.update(self._task, rounds=self._rounds)
        self.describe(self._latest)

    def begin_stage(self, name: str, index: int, count: int) -> None:
        """Show which work begins, and its number among those of its kind if that is known."""
        if self._counts_files:
            self._bar.update(self._task, description=name)
        elif self._rounds is not None or not count:
            self.describe(name)
        else:
            self._show(name, count, index, is_whole=False)
            if index == 0:
                self._bar.update(self._task, part_began=time.monotonic())

    def describe(self, description: str) -> None:
        """Show what is done until the next event."""
        if self._rounds is None:
            self._show(description)
            return
        done = self._rounds.done_so_far
        total = self._rounds.count if done else None
        self._show(f"{self._rounds}\n{description}", total, done)

    def _show(
        self, text: str, total: float | None = None, done: float = 0.0, *, is_whole: bool = True
    ) -> None:
        """Show what is done.

        Args:
            text: The work, in words.
            total: Number of its parts; None if it is not known.
            done: Number of finished parts.
            is_whole: False where the parts are only those of one stage.
        """
        self._latest = text.replace("\n", ": ")

        # An update cannot take away a total.
        task = next(each for each in self._bar.tasks if each.id == self._task)
        task.total = total
        self._bar.update(self._task, description=text, completed=done, is_whole=is_whole)

    def tell_if_silent(self, seconds: float) -> None:
        """Without a terminal, print what is done if nothing was printed for some seconds."""
        now = time.monotonic()
        if not errors.is_terminal and now - self._told >= seconds:
            self._print(f"{self._latest} ({now - self._begun:.0f} s)")

    def _print(self, text: str) -> None:
        """Print a line of progress."""
        self._told = time.monotonic()
        errors.print(text, markup=False)

    def __call__(self, event: Event) -> None:
        """Show an event.

        Args:
            event: The event.
        """
        if isinstance(event, DesignEvent):
            self._show_design(event)
        elif isinstance(event, FitEvent):
            self._show_fit(event)
        else:
            self._show_study(event)

    def _show_design(self, event: DesignEvent) -> None:
        """Show an iterate of a design; its stage is named where it changes."""
        stage = design_stage(event)
        if stage != self._stage and not errors.is_terminal and event.row.mu:
            self._print(f"{stage}:")
        self._stage = stage
        if event.row.mu and errors.is_terminal:
            self.describe(f"{stage}\n{design_text(event)}")
            return
        self._show_iterate(design_text(event), event.row.iteration, DESIGN_LINES)

    def _show_fit(self, event: FitEvent) -> None:
        """Show an iterate of an estimation."""
        self._show_iterate(fit_text(event), event.iteration, FIT_LINES)

    def _show_iterate(self, text: str, iteration: int, period: int) -> None:
        """Show an iterate on the bar; without a terminal, print every `period`-th iterate."""
        self.describe(text)

        is_due = iteration % period == 0
        if is_due and not errors.is_terminal:
            self._print(self._latest)

    def _show_study(self, event: StudyEvent) -> None:
        """Show the progress of a study; the verb prints the result of a round itself."""
        if self._rounds is not None and event.result is not None:
            is_new = getattr(event.result, "design", None) is not None
            self._rounds.finish_one(is_new=is_new)
            self.describe("designing")
            return

        # Without a known number of parts there is no bar, and each part is a line.
        if event.count is None:
            self._print(event.message)
            return

        part = part_text(event)
        self._show(f"{part}  {event.message}", event.count, event.index + event.share)
        if errors.is_terminal:
            return

        # Without a terminal, each part is a line. A study without messages reports its percentage.
        if not event.message:
            self._print(f"{event.part}: {100 * event.share:.0f} %")
        elif part != self._announced_part:
            self._print(part)
        self._announced_part = part


@contextmanager
def progress(
    description: str, line_seconds: float = LINE_SECONDS, *, at_most: float | None = None
) -> Iterator[ProgressDisplay]:
    """Show the progress of a long computation on stderr, with the time that is left.

    Args:
        description: Text until the first event.
        line_seconds: Silent time after which a line is printed, if stderr is not a terminal [s].
        at_most: Time at which the work ends in any case [s]; None without one.

    Yields:
        The display, which is called with every event.
    """
    # On a narrow terminal the text is folded, so that the times are not cut.
    folded = Column(no_wrap=False, overflow="fold")
    text = TextColumn("{task.description}", markup=False, table_column=folded)
    columns = (SpinnerColumn(), text, _Bar(bar_width=BAR_WIDTH), _TimeColumn(at_most))
    with Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal) as bar:
        display = ProgressDisplay(bar, description)
        with (
            stages_observed_by(display.begin_stage),
            _repeatedly(partial(display.tell_if_silent, line_seconds), 0.1 * line_seconds),
        ):
            yield display


class _Bar(BarColumn):
    """A bar where the number of parts is known, and nothing elsewhere."""

    def render(self, task: Task) -> ProgressBar:
        """Draw the bar of a task."""
        bar = super().render(task)
        if task.total is None:
            bar.width = 0
        return bar


class _TimeColumn(ProgressColumn):
    """The time since the work began, and the time that it takes."""

    def __init__(self, at_most: float | None) -> None:
        """Set the time at which the work ends in any case [s]; None without one."""
        super().__init__()
        self._at_most = at_most

    def render(self, task: Task) -> Text:
        """Write the times of a task."""
        elapsed = task.elapsed or 0.0
        text = clock(elapsed)
        done = task.completed / task.total if task.total else 0.0
        rounds = task.fields.get("rounds")
        if rounds is not None and rounds.seconds_left is not None:
            text += f", at most about {clock(rounds.seconds_left)} left"
        elif task.fields.get("is_whole") and LEAST_DONE <= done < 1.0:
            text += f", about {clock(elapsed * (1.0 / done - 1.0))} left"
        elif self._at_most is not None and self._at_most > elapsed:
            text += f" of at most {clock(self._at_most)}"
        elif LEAST_DONE <= done < 1.0:
            of_parts = time.monotonic() - task.fields["part_began"]
            text += f", about {clock(of_parts * (1.0 / done - 1.0))} left"
        return Text(text, style="progress.elapsed", no_wrap=True)


def clock(seconds: float) -> str:
    """Return a time as minutes and seconds, or as hours, minutes and seconds.

    Args:
        seconds: The time [s].
    """
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


@contextmanager
def _repeatedly(call: Callable[[], None], period: float) -> Iterator[None]:
    """Call a function from time to time, from another thread, until the context ends.

    Args:
        call: The function.
        period: Time between two calls [s].
    """
    ended = threading.Event()

    def run() -> None:
        """Call the function until the context has ended."""
        while not ended.wait(period):
            call()

    thread = threading.Thread(target=run, name="mjfim-progress", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def is_elsewhere(as_json: bool) -> bool:
    """Return whether the result is not readable on the terminal that shows the messages.

    How the work ended is then a message, too.

    Args:
        as_json: Whether the result is printed as JSON.
    """
    return as_json or not out.is_terminal


def print_result(
    as_json: bool, values: dict[str, Any], summary: Summary, *, verbose: bool = False
) -> None:
    """Print a result on stdout.

    Args:
        as_json: True for JSON, False for text.
        values: The result as values for JSON.
        summary: The result in words and tables.
        verbose: True for all tables and sentences, False for a screen of text at most.
    """
    if as_json:
        from mjfim.files import as_json as json_of

        typer.echo(json_of(values), nl=False)
    else:
        out.print(render(summary, verbose=verbose))
