"""The command line: one function per verb. Exit codes: 0 done, 1 ran but did not reach its goal, 2 misuse."""

from __future__ import annotations

import functools
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any, NoReturn

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

import mjfim
from mjfim import archive, report
from mjfim.baselines import METHODS
from mjfim.compare import Glance
from mjfim.duration import OutOfReachError, Shortest
from mjfim.errors import ExperimentError, MjfimError, RecordingError
from mjfim.files import replacing
from mjfim.labels import Labels
from mjfim.levenberg import Progress as Progressed
from mjfim.logs import read_log, read_recording
from mjfim.places import check_file, check_folder, experiment_beside, recording_of
from mjfim.setup import Setup
from mjfim.trajectory import HistoryRow
from mjfim.workers import Pool

app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Design the experiment that identifies a MuJoCo model's parameters, then identify them.",
)
errors = Console(stderr=True, highlight=False, soft_wrap=True)
out = Console(highlight=False, width=None if sys.stdout.isatty() else 110)

ExperimentFile = Annotated[Path, typer.Argument(metavar="EXPERIMENT", help="Experiment file (TOML).")]
DesignFile = Annotated[Path, typer.Argument(metavar="DESIGN.npz", help="design.npz that `mjfim design` left.")]
Folder = Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="Folder for the results, made if absent.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the summary to stdout as JSON.")]
Threads = Annotated[int | None, typer.Option(min=1, help="Threads for MuJoCo; default: all cores.")]


class Unfinished(Exception):
    """Ctrl-C while results were being written; says where."""


@contextmanager
def writing(folder: Path) -> Iterator[ModuleType]:
    """Make the folder and bring what writes into it; an interruption in here is not one before any result."""
    from mjfim import results  # brings matplotlib and rerun

    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield results
    except KeyboardInterrupt:
        raise Unfinished(str(folder)) from None


def _version(wanted: bool) -> None:
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
    """Turn misuse into one message and exit code 2, and Ctrl-C before any result into exit code 1."""

    @functools.wraps(function)
    def wrapped(*args: Any, **kwargs: Any) -> None:
        try:
            function(*args, **kwargs)
        except MjfimError as error:
            errors.print(f"mjfim: {error}", markup=False)
            raise typer.Exit(2) from None
        except OSError as error:
            errors.print(f"mjfim: {error.filename or 'cannot write'}: {error.strerror or error}", markup=False)
            raise typer.Exit(1) from None
        except Unfinished as unfinished:
            errors.print(
                f"mjfim: interrupted; {unfinished}/ holds some of the results, each file complete", markup=False
            )
            raise typer.Exit(1) from None
        except KeyboardInterrupt:
            errors.print("mjfim: interrupted before there was a result; nothing was written")
            raise typer.Exit(1) from None

    app.command()(wrapped)
    return wrapped


@contextmanager
def progress() -> Iterator[Progress]:
    """A transient progress display on stderr; silent where stderr is not a terminal."""
    columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal) as bar:
        yield bar


@verb
def check(
    experiment: ExperimentFile,
    recordings: Annotated[
        list[Path] | None, typer.Argument(metavar="[RECORDING...]", help="Logs to look at instead.")
    ] = None,
    design_file: Annotated[
        Path | None, typer.Option("--design", metavar="DESIGN.npz", help="Look at this design instead.")
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="Folder for check.json and check.png.")
    ] = None,
    as_json: AsJson = False,
    threads: Threads = None,
) -> None:
    """Say what can be identified, how well, and what only in combination; before any fit."""
    setup = Setup(mjfim.Experiment.from_file(experiment), threads)
    loaded = [read_recording(path, setup) for path in recordings or []]
    trajectory = None
    if design_file is not None:
        trajectory = archive.read_design(design_file)["final"]
        archive.check_fits(design_file, trajectory, setup)
    if output is not None:
        check_folder(output)
    with progress() as bar:
        bar.add_task("looking", total=None)
        result = mjfim.check(setup, loaded, trajectory)
    if output is not None:
        with writing(output) as results:
            results.leave_check(output, result)
    _say(as_json, archive.check_summary(result), report.check_report(result))
    if output is not None:
        errors.print(f"wrote {output}/")
    raise typer.Exit(0 if result.ok else 1)


@contextmanager
def several(setup: Setup) -> Iterator[Executor | None]:
    """Processes for the starts of a design under hard limits; None where one start has all threads to itself."""
    d = setup.experiment.descent
    count = d.starts + len(d.previous) + len(d.fourier) + len(d.repeats)
    if count == 1 or not setup.enforced:
        yield None
        return
    with Pool(min(count, setup.plant.engine.threads)) as pool:
        yield pool


@verb
def design(
    experiment: ExperimentFile,
    output: Folder,
    as_json: AsJson = False,
    starts: Annotated[int | None, typer.Option(min=1, help="Number of starts; overrides [descent] starts.")] = None,
    shortest: Annotated[
        bool, typer.Option("--shortest", help="Find the shortest horizon at which every `wanted` σ is reached.")
    ] = False,
    threads: Threads = None,
) -> None:
    """Design the excitation that reveals most about the parameters."""
    stated = mjfim.Experiment.from_file(experiment)
    if starts is not None:
        stated = stated.replace(descent={"starts": starts})
    setup = Setup(stated, threads)
    check_folder(output)
    with several(setup) as executor, progress() as bar:
        task = bar.add_task("designing", total=None)

        def monitor(row: HistoryRow) -> None:
            text = (
                f"iteration {row.iteration:3d}  J {row.cost:.6g}  λ_min {row.min_eigenvalue:.5g}  slope {row.slope:.1e}"
            )
            bar.update(task, description=text)
            if not errors.is_terminal and row.iteration % 10 == 0:
                errors.print(text)

        found = _shortest(setup, monitor, executor) if shortest else None
        result = mjfim.design(setup, monitor, executor=executor) if found is None else found.design
    if found is not None:
        setup = Setup(found.experiment, threads)
    with writing(output) as results:
        results.leave_design(output, result, setup)
        if found is not None:
            archive.write_json(output / "shortest.json", found.summary())
    told = {} if found is None else {"shortest": found.summary()}
    _say(as_json, {**archive.design_summary(result), **told}, report.design_report(result, setup.units))
    if found is not None:
        errors.print(f"{found}\nto go on with it, state horizon = {found.horizon:g} in {experiment}", markup=False)
    errors.print(f"wrote {output}/ (see it move: mjfim replay {output})")
    if not result.success:
        errors.print(f"mjfim: {'; '.join([result.status.value, *result.warnings])}", markup=False)
    raise typer.Exit(0 if result.success and (found is None or found.closed) else 1)


def _shortest(setup: Setup, monitor: Callable[[HistoryRow], None], executor: Executor | None) -> Shortest:
    """The shortest design, every duration told on the way; exit code 1 where none is long enough."""
    try:
        return mjfim.shortest(
            setup.experiment,
            monitor=monitor,
            threads=setup.plant.engine.threads,
            report=lambda tried: errors.print(str(tried), markup=False),
            executor=executor,
        )
    except OutOfReachError as error:
        errors.print(f"mjfim: {error}", markup=False)
        raise typer.Exit(1) from None


@verb
def compare(
    experiment: ExperimentFile,
    output: Folder,
    seconds: Annotated[float, typer.Option(min=0.0, help="Budget of each method [s].")] = 60.0,
    steps: Annotated[float | None, typer.Option(min=1.0, help="Budget of MuJoCo steps; default: time alone.")] = None,
    methods: Annotated[
        str | None, typer.Option(metavar="NAME,...", help=f"Baselines to run before the design: {', '.join(METHODS)}.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the baselines.")] = 0,
    as_json: AsJson = False,
    threads: Threads = None,
) -> None:
    """Hold the design against chirps, multisines, Fourier series, splines with the same budget; exit code 1 if one is better."""
    setup = Setup(mjfim.Experiment.from_file(experiment), threads)
    chosen = None if methods is None else [name.strip() for name in methods.split(",") if name.strip()]
    check_folder(output)
    with progress() as bar:
        task = bar.add_task("comparing", total=None)
        told = [-1]

        def monitor(glance: Glance) -> None:
            text = f"{glance.place + 1}/{glance.count} {glance.title}  best J {glance.cost:.5g}"
            bar.update(task, description=text, total=glance.count, completed=glance.place + min(glance.used, 1.0))
            if not errors.is_terminal and glance.place > told[0]:
                told[0] = glance.place
                errors.print(f"{glance.place + 1}/{glance.count} {glance.title}", markup=False)

        result = mjfim.compare(setup, seconds, steps, seed, chosen, monitor=monitor, threads=threads)
    if not result.rows:
        raise KeyboardInterrupt
    with writing(output) as results:
        results.leave_comparison(output, result, setup)
    _say(as_json, archive.comparison_summary(result), report.compare_report(result))
    errors.print(f"wrote {output}/")
    if not result.ok:
        errors.print(f"mjfim: {' '.join(result.verdict)}", markup=False)
    raise typer.Exit(0 if result.ok else 1)


@verb
def simulate(
    experiment: ExperimentFile,
    design_file: DesignFile,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE.csv", help="Recording to write.")],
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
) -> None:
    """Play a design on the model at its `true` values, with noise: a synthetic recording."""
    setup = Setup(mjfim.Experiment.from_file(experiment))
    check_file(output)
    trajectory = archive.read_design(design_file)["final"]
    archive.check_fits(design_file, trajectory, setup)
    archive.write_recording(output, mjfim.simulate(setup, trajectory, seed), setup)
    errors.print(f"wrote {output}")


@verb
def identify(
    experiment: ExperimentFile,
    recordings: Annotated[list[Path], typer.Argument(metavar="RECORDING...", help="Logs of any format that is read.")],
    output: Folder,
    held_out: Annotated[
        list[Path] | None,
        typer.Option(
            "--held-out", metavar="FILE", help="Log that is predicted, not fitted; may be given several times."
        ),
    ] = None,
    method: Annotated[str, typer.Option(help="least_squares (with bounds) or newton (the paper's).")] = "least_squares",
    as_json: AsJson = False,
    threads: Threads = None,
) -> None:
    """Estimate the parameters from recordings, and say how far that is to be trusted."""
    if method not in ("least_squares", "newton"):
        raise ExperimentError(f"--method {method!r}: valid: least_squares, newton")
    setup = Setup(mjfim.Experiment.from_file(experiment), threads)
    check_folder(output)
    with progress() as bar:
        task = bar.add_task("reading", total=None)
        loaded, kept = ([read_log(path, setup) for path in paths] for paths in (recordings, held_out or []))
        if not as_json:
            out.print(report.looks_report([log.look for log in (*loaded, *kept)]))

        def tell(what: str, iterate: Progressed) -> None:
            text = f"{what}: iteration {iterate.iteration}, half of the squares {iterate.cost:.6g}, step {iterate.size:.2g} σ"
            bar.update(task, description=text)
            if not errors.is_terminal and iterate.iteration % 5 == 0:
                errors.print(text, markup=False)

        result = mjfim.identify(
            setup,
            [log.recording for log in loaded],
            "newton" if method == "newton" else "least_squares",
            held_out=[log.recording for log in kept],
            tell=tell,
        )
    with writing(output) as results:
        for sentence in results.leave_estimate(output, result, setup):
            errors.print(f"warning: {sentence}", markup=False)
    _say(as_json, archive.estimate_summary(result, setup), report.estimate_report(result, setup.units))
    errors.print(f"wrote {output}/")
    raise typer.Exit(0 if result.success and not result.misfit and not result.interrupted else 1)


@verb
def montecarlo(
    experiment: ExperimentFile,
    design_file: DesignFile,
    output: Folder,
    trials: Annotated[int, typer.Option(min=2, help="Trials per trajectory.")] = 1500,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the noise.")] = 0,
    measure_rate: Annotated[
        float | None, typer.Option(min=0.0, help="Measurement rate [Hz]; divides the rate.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Hold the estimator against the Cramér-Rao bound, on the initial and the designed trajectory."""
    stated = mjfim.Experiment.from_file(experiment)
    setup = Setup(stated if measure_rate is None else stated.replace(measure_rate=measure_rate))
    named = archive.read_design(design_file)
    for trajectory in named.values():
        archive.check_fits(design_file, trajectory, setup)
    check_folder(output)
    with progress() as bar:
        tasks = {name: bar.add_task(f"{trials} trials, {name}", total=1.0) for name in named}

        def tell(name: str, share: float) -> None:
            bar.update(tasks[name], completed=share)
            if not errors.is_terminal:
                errors.print(f"{name}: {100 * share:.0f} %")

        study = mjfim.monte_carlo(setup, named, trials, seed, progress=tell)
    with writing(output) as results:
        results.leave_study(output, study, setup)
    _say(as_json, archive.study_summary(study), report.study_report(study, setup.units))
    errors.print(f"wrote {output}/")
    if len(study.sets) < len(named):
        errors.print(f"mjfim: interrupted; only {', '.join(study.sets)} is finished")
    raise typer.Exit(0 if len(study.sets) == len(named) and all(s.failed == 0 for s in study.sets.values()) else 1)


@verb
def replay(
    source: Annotated[Path, typer.Argument(metavar="DIR | FILE.rrd | DESIGN.npz", help="What to show.")],
    save: Annotated[
        Path | None, typer.Option(metavar="FILE.rrd", help="Write a file instead of opening the viewer.")
    ] = None,
    experiment: Annotated[
        Path | None, typer.Option(help="Experiment of a DESIGN.npz that has no design.json beside it.")
    ] = None,
) -> None:
    """Show a result in the Rerun viewer."""
    from mjfim import rerun_log

    if save is not None and save.suffix != ".rrd":
        raise RecordingError(f"--save {save}: a Rerun file ends in .rrd")
    target = save or Path(tempfile.mkdtemp(prefix="mjfim-")) / "replay.rrd"
    if save is not None:
        check_file(save)
    if source.suffix == ".npz":
        setup = Setup(mjfim.Experiment.from_file(experiment or experiment_beside(source)))
        named = archive.read_design(source)
        for trajectory in named.values():
            archive.check_fits(source, trajectory, setup)
        rerun_log.log_trajectories(target, setup.model_at(setup.theta), named, Labels.of(setup))
    else:
        found = recording_of(source)
        if save is not None:
            with replacing(save) as temporary:
                shutil.copyfile(found, temporary)
        target = save or found
    if save is None:
        rerun_log.show(target)
    else:
        errors.print(f"wrote {target}")


def _say(as_json: bool, summary: dict[str, Any], text: Any) -> None:
    if as_json:
        typer.echo(archive.as_json(summary), nl=False)
    else:
        out.print(text)


def main() -> NoReturn:
    """Entry point."""
    app(prog_name="mjfim")
    sys.exit(0)
