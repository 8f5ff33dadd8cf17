"""A fit of many logs, which the workers of a pool read themselves.

    python -m scripts.benchmarks scale_recordings [--logs 20] [--seconds 60] [--workers 2]
    python -m scripts.benchmarks scale_recordings --logs 500 --seconds 300     # 18 GB of logs

The logs of two joints at 1 kHz are written to a temporary folder (`--folder DIR` keeps them for the
next run). A process reads and fits them with a pool of workers, which find the files by the hash of
their contents. The table shows how much was read, the largest memory of the caller and, apart from
it, that of the worker that needed most, and the CPU seconds of all over those that the engine needs
for the same steps. With `--compare`, a fit without workers follows, whose estimate has to be equal
to the last digit. The limits are 1 GiB for each worker and a ratio of 1.15 to the fit without
workers.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

import mjfim
from mjfim.experiment.system import System
from mjfim.output.archive import write_recording
from scripts.benchmarks.benchmark_hour import EXPERIMENT, bare, played
from scripts.benchmarks.run_in_subprocess import run_in_subprocess

# Memory that each worker may need [GiB].
MOST_MEMORY = 1.0

# Code of the process that reads and fits the logs of a folder, with some workers or none.
FIT = """
import resource
from pathlib import Path
import mjfim
from mjfim.experiment.system import System
from mjfim.identification.identify import identify_system
from mjfim.recordings.read import read_recording

def used(who):
    use = resource.getrusage(who)
    return use.ru_utime + use.ru_stime, use.ru_maxrss / 2**20

def fit(executor):
    system = System.resolve(mjfim.Experiment.from_file(sys.argv[1]))
    logs = sorted(Path(sys.argv[2]).glob("log*.csv"))
    recordings = [read_recording(log, system.channels) for log in logs]
    return identify_system(system, recordings, executor=executor)

workers = int(sys.argv[3])
if workers:
    with mjfim.Pool(workers) as pool:
        estimate = fit(pool)
else:
    estimate = fit(None)
caller, worker = used(resource.RUSAGE_SELF), used(resource.RUSAGE_CHILDREN)
found = {
    "theta": [float(value).hex() for value in estimate.theta],
    "steps": estimate.steps,
    "seconds": estimate.seconds,
    "cpu": caller[0] + worker[0],
    "caller": caller[1],
    "worker": worker[1],
}
"""


def write_logs(system: System, folder: Path, logs: int, seconds: float) -> int:
    """Write logs that are not there yet.

    Args:
        system: The system.
        folder: Folder of the logs.
        logs: Number of logs.
        seconds: Duration of each of them [s].

    Returns:
        Size of all logs [bytes].
    """
    size = 0
    for seed in range(logs):
        log = folder / f"log{seed:04d}.csv"
        if not log.is_file():
            write_recording(log, played(system, seconds, seed), system)
        size += log.stat().st_size
    return size


def table_of(runs: dict[str, dict[str, Any]], size: int, engine: float) -> Table:
    """Make the table.

    Args:
        runs: What was measured, by the name of the run.
        size: Size of the logs [bytes].
        engine: CPU time of one engine step [s].
    """
    title = f"a fit of {size / 1e9:.3g} GB of logs (limits: 1 GiB for each worker, CPU ratio 1.15)"
    table = Table(title=title, title_justify="left")
    for heading in (
        "",
        "wall",
        "CPU",
        "engine alone",
        "ratio",
        "steps",
        "caller",
        "largest worker",
    ):
        table.add_column(heading, justify="right")
    for name, run in runs.items():
        useful = run["steps"] * engine
        table.add_row(
            name,
            f"{run['seconds']:.0f} s",
            f"{run['cpu']:.0f} s",
            f"{useful:.0f} s",
            f"{run['cpu'] / useful:.2f}",
            f"{run['steps'] / 1e6:.0f} M",
            f"{run['caller']:.2f} GiB",
            f"{run['worker']:.2f} GiB" if run["worker"] else "",
        )
    return table


def memory_in_words(run: dict[str, Any]) -> str:
    """Say how much memory the workers and the caller needed, and whether the workers kept to it.

    Args:
        run: What was measured with workers.
    """
    verdict = "met" if is_within_memory(run) else "MISSED"
    return (
        f"memory: no worker needed more than {run['worker']:.2f} GiB "
        f"(limit {MOST_MEMORY:g} GiB: {verdict}), and the caller {run['caller']:.2f} GiB"
    )


def is_within_memory(run: dict[str, Any]) -> bool:
    """Whether every worker needed less memory than it may, whatever the caller needed."""
    return bool(run["worker"] <= MOST_MEMORY)


def measured(options: argparse.Namespace, folder: Path) -> bool:
    """Fit the logs of a folder, print the table, and return whether all is as it should be.

    Args:
        options: Options of the command line.
        folder: Folder of the logs.
    """
    console = Console(width=140)
    system = System.resolve(mjfim.Experiment.from_file(EXPERIMENT))
    size = write_logs(system, folder, options.logs, options.seconds)

    # The engine on one thread shows its CPU time.
    alone = System.resolve(mjfim.Experiment.from_file(EXPERIMENT), threads=1)
    clock = time.process_time()
    samples = 400_000
    bare(alone, samples)
    engine = bare(alone, samples) / samples
    console.print(f"measured the engine in {time.process_time() - clock:.0f} CPU s")

    count = options.workers
    runs = {f"{count} {'worker' if count == 1 else 'workers'}": (count,)}
    if options.compare:
        runs["no workers"] = (0,)
    found = {
        name: run_in_subprocess(FIT, EXPERIMENT, folder, *arguments)
        for name, arguments in runs.items()
    }
    if any(run is None for run in found.values()):
        return False
    console.print(table_of(found, size, engine))

    first, *others = found.values()
    console.print(memory_in_words(first))
    good = all(other["theta"] == first["theta"] for other in others)
    for other in others:
        verdict = "equal to the last digit" if good else "DIFFERENT"
        ratio = first["cpu"] / other["cpu"]
        console.print(
            f"estimates: {verdict}; CPU of the fit with workers: {ratio:.2f} of the other"
        )
        good &= ratio <= 1.15
    return good and is_within_memory(first)


def main() -> int:
    """Measure and print the table; return 1 where a limit is exceeded."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--logs", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--compare", action="store_true")
    options = parser.parse_args()

    if options.folder is not None:
        options.folder.mkdir(parents=True, exist_ok=True)
        return int(not measured(options, options.folder))
    with tempfile.TemporaryDirectory() as folder:
        return int(not measured(options, Path(folder)))
