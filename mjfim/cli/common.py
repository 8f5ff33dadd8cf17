"""Common parts of all verbs: the app, arguments and options, folders of results, exit codes."""

from __future__ import annotations

import inspect
import shlex
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import wraps
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

import mjfim
from mjfim.cli.progress import lost_text, out, progress, say, say_from_program
from mjfim.errors import (
    MAX_THREADS,
    InterruptedByUserError,
    MjfimError,
    ModelWarning,
    NoResultError,
    NoVideoError,
    RecordingError,
    RecordingWarning,
    UndrawnWarning,
    UnfinishedError,
    WrongLogError,
    first_ones,
)
from mjfim.files import observed_by, remove_temporary_files
from mjfim.output.live import ADDRESS, HERE
from mjfim.output.manifest import write_optional
from mjfim.output.page import REPORT, Page, Part, PictureFormat
from mjfim.output.video import require_format, write_video
from mjfim.parallel.budget import (
    INTERRUPTED_CODE,
    NOTHING_SENTENCE,
    Interruption,
    current_interruption,
)

if TYPE_CHECKING:
    from mjfim.experiment.system import System
    from mjfim.output.film import Filmed
    from mjfim.parallel import Workers
    from mjfim.records.base import ShownRecord

# Verbs by the step of an experiment, with an example of each step, as the help shows them.
STEPS: Mapping[str, tuple[str, ...]] = {
    "Start: mjfim init arm.xml -o arm.toml": ("init", "list", "validate", "check"),
    "Design: mjfim design arm.toml -o out/design": ("design", "rehearse", "worth", "compare"),
    "Learn: mjfim identify arm.toml log.csv -o out/arm": (
        "watch",
        "identify",
        "payload",
        "campaign",
    ),
    "Prove: mjfim montecarlo arm.toml out/design -o out/study": (
        "simulate",
        "montecarlo",
        "compare-robots",
    ),
    "Hand over: mjfim export out/design --to player -o play.py": ("export", "report", "replay"),
}
ORDER = tuple(name for names in STEPS.values() for name in names)

# Files of verbs that share one; every other verb has a file of its own name.
FILES = {
    "list": "inventory",
    "validate": "inventory",
    "rehearse": "check",
    "worth": "check",
    "compare-robots": "compare",
    "payload": "identify",
    "montecarlo": "simulate",
    "export": "results",
    "report": "results",
    "replay": "results",
}

# Number of tasks where it is not known before the work begins: as many processes as there may be.
MAX_PARTS = 1_000_000

# Arguments of verbs that name files which exist.
INPUTS = frozenset(("experiment", "model", "design_file", "recordings", "held_out", "without"))

# The executor where none is stated.
LOCAL = "local"

# What ends with the running verb: folders that it has claimed, and a process that draws.
_claims = ExitStack()

# True in the program `mjfim`, whose verbs may draw in a process of their own.
_may_start_processes = False

# Further entries of a JSON file: none.
NOTHING: Mapping[str, object] = MappingProxyType({})


def _file_of_design(path: Path | None) -> Path | None:
    """The file design.npz where a folder is named."""
    return path / "design.npz" if path is not None and path.is_dir() else path


# Arguments and options that several verbs share.
ExperimentFile = Annotated[
    Path, typer.Argument(metavar="EXPERIMENT", help="Experiment file (TOML).")
]

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

ExperimentOfDesign = Annotated[
    Path | None,
    typer.Option(
        "--experiment",
        metavar="EXPERIMENT",
        help="Experiment file of the design; default: the one that its design.json names.",
    ),
]

ModelFile = Annotated[
    Path,
    typer.Argument(
        metavar="MODEL",
        help="Model file (MJCF or URDF), or a name of the package robot_descriptions.",
    ),
]

# Options of most verbs. The help of `mjfim` explains them once; that of a verb names them.
Verbose = Annotated[
    bool,
    typer.Option("--verbose", "-v", help="Print all tables and sentences.", hidden=True),
]

AsJson = Annotated[
    bool,
    typer.Option("--json", help="Print the result as JSON instead of tables.", hidden=True),
]

Pictures = Annotated[
    PictureFormat,
    typer.Option(
        "--format",
        help="Format of the pictures: png, svg or pdf.",
        case_sensitive=False,
        hidden=True,
    ),
]

Force = Annotated[
    bool,
    typer.Option(
        "--force",
        help="Replace files that you changed or that mjfim did not write; inputs never.",
        hidden=True,
    ),
]

NoiseSeed = Annotated[int, typer.Option("--seed", min=0, help="Seed of the noise.")]

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
        help="Show the work in a Rerun viewer while it runs; in the one at HOST:PORT if given.",
    ),
]


@dataclass(frozen=True, kw_only=True)
class Run:
    """One run of a verb with a folder of results: the options that these verbs share."""

    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR",
            help="Folder for the results; created if it is missing.",
        ),
    ]
    as_json: AsJson = False
    pictures: Pictures = PictureFormat.PNG
    verbose: Verbose = False
    force: Force = False
    threads: Annotated[
        int | None,
        typer.Option(
            "--threads",
            min=1,
            max=MAX_THREADS,
            help="Threads for MuJoCo; default: all cores.",
            hidden=True,
        ),
    ] = None
    executor: Annotated[
        str,
        typer.Option(
            "--executor",
            metavar="WHERE",
            help="Where to compute: local, local:N (processes), dask://HOST:PORT, dask:FILE.json "
            "or python:MODULE:FACTORY.",
            hidden=True,
        ),
    ] = LOCAL

    def __post_init__(self) -> None:
        if self.executor != LOCAL:
            from mjfim.parallel.workers import StatedExecutor

            StatedExecutor.parse(self.executor)  # a fault is said before the work

    def claim(
        self,
        kind: type[ShownRecord],
        experiment: mjfim.Experiment | None,
        read: Iterable[Path | None] = (),
        further: Iterable[str] = (),
        video: Path | None = None,
    ) -> None:
        """Make sure before the work that a result can be written, and keep other runs out.

        Args:
            kind: The kind of the result.
            experiment: The experiment, whose files must not be replaced.
            read: Other files and folders that the verb reads, likewise.
            further: Files beside those that every result of this kind may have.
            video: A video that the user wants.
        """
        if self.output:
            from mjfim.experiment.packing import input_files
            from mjfim.output.folders import matching, names_of

            inputs = input_files(experiment, read)
            claim_video(video, inputs, force=self.force)
            present = matching(self.output, names_of(kind, self.pictures))
            names = [*(file.name for file in present), *further]
            claim_folder(self.output, names, inputs, force=self.force)

    @contextmanager
    def workers(self, tasks: int = MAX_PARTS, processes: int = 0) -> Iterator[Workers | None]:
        """Start the executor that the user states, and say at the end if a worker was killed.

        Args:
            tasks: Number of tasks, and so the largest number of processes that are started.
            processes: Processes of this computer where the user states none.

        Yields:
            The workers; None where all work is done by this process.
        """
        from mjfim.parallel import LOST_SENTENCE, Pool, Workers
        from mjfim.parallel.workers import ExecutorKind, StatedExecutor

        stated = StatedExecutor.parse(self.executor)
        if stated.kind is not ExecutorKind.LOCAL:
            with stated.started() as workers:
                yield workers
            return

        count = min(stated.processes or processes, tasks)
        if count <= 1:
            yield None
            return

        # Processes share locks in /dev/shm, which some containers do not have.
        try:
            pool = Pool(count)
        except OSError as error:
            say(f"warning: no further processes can be started ({error}); one does all the work")
            yield None
            return
        with pool:
            yield Workers(pool)
        # A signal to all processes ends those that wait for work; then the run was stopped.
        interruption = current_interruption()
        if pool.has_lost_worker and not (interruption and interruption.presses):
            say_from_program(LOST_SENTENCE)

    def finish(
        self,
        result: ShownRecord,
        system: System | None,
        *,
        design: Path | None = None,
        further: Mapping[str, object] = NOTHING,
        sections: Mapping[str, Sequence[Part]] = MappingProxyType({}),
        remarks: Iterable[str] = (),
    ) -> int:
        """Write the files of a result where there is a folder, print it, and draw its pictures.

        Who does not read a bad result on the terminal gets its verdict on stderr.

        Args:
            result: The result.
            system: The experiment; None for a comparison of robots.
            design: The design that the next step names, where the result is one or about one.
            further: Further entries of the JSON file.
            sections: Further sections of the printed page.
            remarks: Sentences that follow the name of the folder.

        Returns:
            The exit code by the verdict.
        """
        from mjfim.output.archive import summary_with_origin
        from mjfim.output.pages import page_of

        try:
            if self.output:
                with writing(self.output, "files"):
                    from mjfim.output.folders import write_result  # slow to import

                    lacks, draw = write_result(self.output, result, system, self.pictures, further)
        finally:
            # It is printed after it is written, also where it cannot be written.
            source = None if system is None else system.experiment.source
            page = page_of(result, experiment=source, design=design, output=self.output)
            page = replace(page, sections={**page.sections, **sections})
            values = {**summary_with_origin(result, system, self.output), **further}
            print_result(self.as_json, values, page, verbose=self.verbose)
            if not page.verdict.ok and (self.as_json or not out.is_terminal):
                say_from_program(page.verdict.sentence)
        if self.output:
            for sentence in lacks:
                say(f"warning: {sentence}")
            say_written(self.output)
        for sentence in remarks:
            say(sentence)
        if self.output:
            with writing(self.output, "pictures"):
                left = draw()
            if left:
                folder = shlex.quote(str(self.output))
                say(f"not drawn: {first_ones(left)}; `mjfim report {folder} --pictures` draws all")
        return 0 if page.verdict.ok else 1


def print_result(
    as_json: bool, values: Mapping[str, object], page: Page, *, verbose: bool = False
) -> None:
    """Print a result on stdout, as JSON or in words and tables."""
    if as_json:
        from mjfim.files import as_json as json_of

        typer.echo(json_of(values), nl=False)
    else:
        from mjfim.output.terminal import laid_out

        out.print(laid_out(page, out, verbose=verbose))


# ---- files


def claim_folder(
    folder: Path,
    names: Iterable[str],
    inputs: Sequence[Path],
    *,
    force: bool,
    exclusive: bool = True,
) -> None:
    """Make sure before the work that results can be written; exclusive: keep other runs out."""
    from mjfim.output.manifest import OutputGuard, claimed, require_writable

    require_writable(folder)
    guard = OutputGuard(inputs, force=force)
    guard.check(folder / name for name in names)
    _claims.enter_context(claimed(folder, guard, exclusive=exclusive))


def claim_file(file: Path, inputs: Sequence[Path], *, force: bool) -> None:
    """Make sure before the work that a single file can be written."""
    if file.is_dir():
        raise RecordingError(f"{file}: is a folder; -o and --save need a file here")
    claim_folder(file.parent, [file.name], inputs, force=force, exclusive=False)


def claim_video(video: Path | None, inputs: Sequence[Path], *, force: bool) -> None:
    """Make sure before the work that a video can be written, if the user wants one."""
    if video is not None:
        require_format(video)
        claim_file(video, inputs, force=force)


def write_wanted_video(video: Path | None, system: System, result: Filmed) -> None:
    """Write the video that the user asks for; where that is impossible, say why."""
    if video is None:
        return

    def write() -> None:
        """Write the file and say what it shows."""
        try:
            with progress("drawing the video"):
                written = write_video(video, system, result)
        except NoVideoError as reason:
            say_from_program(f"there is no video: {reason}")
            return
        say(f"wrote {video}: {written.caption}")

    write_optional(str(video), write)


def permit_processes() -> None:
    """Let verbs draw in processes of their own from now on, as in the program `mjfim`."""
    global _may_start_processes
    _may_start_processes = True


def draw_elsewhere() -> None:
    """Let another process draw the pictures of the running verb's result."""
    if _may_start_processes:
        from mjfim.output.plots.pictures import drawing_elsewhere

        _claims.enter_context(drawing_elsewhere())


def experiment_of(design_file: Path, stated: Path | None) -> mjfim.Experiment:
    """The experiment that the user states for a design, or else the one of the design."""
    from mjfim.output.folders import find_experiment_file

    return mjfim.Experiment.from_file(stated or find_experiment_file(design_file))


def keep_result(folder: Path | None = None) -> None:
    """Say that there is a result, so that Ctrl-C does not end the verb before it is written."""
    interruption = current_interruption()
    if interruption is not None:
        interruption.keep(folder)


@contextmanager
def writing(folder: Path, what: str = "files and pictures") -> Iterator[None]:
    """Create a folder for results, keep them from Ctrl-C, and show which files are written."""
    keep_result()
    with progress(f"writing {what}") as show, observed_by(show.show_file):
        folder.mkdir(parents=True, exist_ok=True)
        keep_result(folder)
        yield


def say_written(folder: Path) -> None:
    """Say where the results are, and which page shows all of them."""
    report = folder / REPORT
    say(f"wrote {folder}/{f'; see {report}' if report.is_file() else ''}")


# ---- verbs


def _version(wanted: bool) -> None:
    """Print the version and exit if the option is given."""
    if wanted:
        typer.echo(mjfim.__version__)
        raise typer.Exit


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


def _option(parameter: inspect.Parameter) -> Any:
    """The option of Typer that a parameter of a verb is annotated with."""
    return parameter.annotation.__metadata__[0]


def _names_of(parameter: inspect.Parameter) -> list[str]:
    """The names of an option. Typer holds the first of them as its default."""
    option = _option(parameter)
    return [option.default, *option.param_decls]


def _shared_options() -> str:
    """The help of the shared options, one line each."""
    options = inspect.signature(Run, eval_str=True).parameters.values()
    lines = [f"{', '.join(_names_of(each))}: {_option(each).help}" for each in options]
    return "\n\n".join(["Options of most verbs:", *lines])


@app.callback(invoke_without_command=True, epilog=_shared_options())
def root(
    context: typer.Context,
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Design the experiment that identifies a MuJoCo model's parameters, then identify them."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())
        if proposed := _first_command(Path()):
            say_from_program(f"in this folder: {proposed}")
        raise typer.Exit(2)


def _first_command(folder: Path) -> str:
    """The first command for the only experiment or model of a folder; may be empty."""
    experiments = [file for file in folder.glob("*.toml") if file.name != "pyproject.toml"]
    models = [file for ending in ("xml", "urdf") for file in folder.glob(f"*.{ending}")]
    if len(experiments) == 1:
        return f"mjfim check {shlex.quote(str(experiments[0]))}"
    if len(models) == 1 and not experiments:
        file = models[0].with_suffix(".toml")
        return f"mjfim init {shlex.quote(str(models[0]))} -o {shlex.quote(str(file))}"
    return ""


# A verb, which returns its exit code; None is 0.
Verb = Callable[..., int | None]


def verb(*, without: Collection[str] = (), needs_folder: bool = True) -> Callable[[Verb], Verb]:
    """Register a function as a verb, and turn its errors into messages and exit codes.

    Args:
        without: Options of a `Run` that the verb does not have. A verb gets all others, if it has
            an argument `run`.
        needs_folder: Whether --output must be stated; otherwise `run.output` may be None.
    """

    def register(function: Verb) -> Verb:
        """Add the shared options."""
        own = dict(inspect.signature(function, eval_str=True).parameters)
        shared: dict[str, inspect.Parameter] = {}
        if own.pop("run", None) is not None:
            options = inspect.signature(Run, eval_str=True).parameters
            shared = {name: each for name, each in options.items() if name not in without}
        if not needs_folder:
            shared["output"] = shared["output"].replace(default=None)
        parameters = [
            each.replace(kind=inspect.Parameter.KEYWORD_ONLY)
            for each in (*own.values(), *shared.values())
        ]

        @wraps(function)
        def wrapped(**arguments: Any) -> None:
            """Call the verb; print one message and exit for each error."""
            options = {name: arguments.pop(name) for name in shared}
            _carry_out(function, arguments, options)

        vars(wrapped)["__signature__"] = inspect.Signature(parameters)
        _add_command(wrapped, parameters)
        return wrapped

    return register


def _add_command(function: Verb, parameters: Iterable[inspect.Parameter]) -> None:
    """Add a verb to the app. The help of `mjfim` shows it at its step of an experiment."""
    name = function.__name__.rstrip("_").replace("_", "-")
    hidden = [_names_of(each)[0] for each in parameters if _option(each).hidden]
    app.command(
        name,
        cls=VerbCommand,
        rich_help_panel=next(step for step, names in STEPS.items() if name in names),
        epilog=f"Also {', '.join(hidden)}: see `mjfim --help`." if hidden else None,
    )(function)


def _require_inputs(arguments: Mapping[str, Any]) -> None:
    """Refuse paths that cannot be opened, before the rooms are imported, which takes a second."""
    for key in INPUTS & arguments.keys():
        value = arguments[key] or []
        for path in value if isinstance(value, list) else [value]:
            # Episodes of a dataset, whose names have no ending, are no files of their own.
            if path.suffix and not path.exists():
                raise RecordingError(f"{path}: no such file")
            if key == "design_file" and path.suffix != ".npz":
                raise RecordingError(f"{path}: give the folder of a design, or its file design.npz")


def _carry_out(function: Verb, arguments: Mapping[str, Any], options: Mapping[str, Any]) -> None:
    """Call a verb with those of a `Run`; print one message and exit for each error and Ctrl-C."""
    interruption = Interruption(say_from_program)
    code = 0
    try:
        with interruption, _claims, _worded_warnings():
            _require_inputs(arguments)
            run = {"run": Run(**options)} if options else {}
            code = function(**arguments, **run) or 0
    except (InterruptedByUserError, NoResultError, UnfinishedError):
        interruption.incomplete, code = True, INTERRUPTED_CODE
    except (MjfimError, MemoryError, OSError) as error:
        raise _told(error) from None
    except Exception as error:
        # MuJoCo has several kinds of errors for a lack of memory.
        if "allocate memory" not in str(error):
            raise
        raise _told(MemoryError(error)) from None
    finally:
        # A press may have come between the creation of a temporary file and its removal.
        remove_temporary_files()
        if fault := lost_text():
            say_from_program(f"stdout: {fault}; the text of the result is lost or not complete")

    # An interrupted verb did not do all that it was asked for.
    if interruption.incomplete:
        _say_what_is_there(interruption.folder)
    if interruption.presses:
        code = code or INTERRUPTED_CODE
    raise typer.Exit(code)


def _told(error: Exception) -> typer.Exit:
    """Print one message about an error, and return the end of the verb with its exit code."""
    message, code = str(error), 1 if isinstance(error, WrongLogError) else 2
    if isinstance(error, MemoryError):
        message = (
            f"there is not enough memory ({error or 'nothing is left'}); a shorter horizon, a "
            "lower rate, or fewer parameters, recordings or trials need less"
        )
    elif isinstance(error, OSError):
        message, code = f"{error.filename or 'cannot write'}: {error.strerror or error}", 1
    say_from_program(message)
    return typer.Exit(code)


@contextmanager
def _worded_warnings() -> Iterator[None]:
    """Print warnings about models, logs and drawings as sentences, without a place in code."""
    with warnings.catch_warnings():
        usual = warnings.showwarning

        def show(message: Warning | str, category: type[Warning], *place: Any, **to: Any) -> None:
            """Print a warning."""
            if issubclass(category, (ModelWarning, RecordingWarning, UndrawnWarning)):
                say(f"warning: {message}")
            else:
                usual(message, category, *place, **to)

        warnings.showwarning = show
        yield


def _say_what_is_there(folder: Path | None) -> None:
    """Say after Ctrl-C whether anything was written."""
    if folder is None:
        say_from_program(NOTHING_SENTENCE)
        return

    from mjfim.output.report import kinds_in  # takes a while to import

    sentence = (
        f"interrupted; {folder}/ holds only a part of the results, but each file in it is complete"
    )
    try:
        has_result = bool(kinds_in(folder))
    except RecordingError:
        has_result = False
    if has_result:
        name = shlex.quote(str(folder))
        sentence += f"; `mjfim report {name} --pictures` draws the pictures that are missing"
    say_from_program(sentence)


class VerbCommand(TyperCommand):
    """A verb whose option --live may stand without an address."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Complete --live, and parse the arguments."""
        return super().parse_args(ctx, with_live_address(args))


def with_live_address(words: Sequence[str]) -> list[str]:
    """Return the words of a command line, in which --live has an address."""
    completed = []
    for word, follower in zip(words, [*words[1:], ""], strict=False):
        is_alone = word == "--live" and not ADDRESS.fullmatch(follower)
        completed.append(f"--live={HERE}" if is_alone else word)
    return completed
