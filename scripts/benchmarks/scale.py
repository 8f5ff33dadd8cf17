"""Scale-out: the verbs on a Dask cluster of this computer, and their scheduler on a simulated one.

    python -m scripts.benchmarks scale                     # small work, some minutes
    python -m scripts.benchmarks scale --full --only equal --verb design       # about 5 minutes
    python -m scripts.benchmarks scale --full --only equal --verb montecarlo   # about 8 minutes
    python -m scripts.benchmarks scale --full --only equal --verb identify     # about 8 minutes
    python -m scripts.benchmarks scale --full --only scaling                   # about 8 minutes
    python -m scripts.benchmarks scale --only kill --kills 10                  # about 6 minutes
    python -m scripts.benchmarks scale --only interrupt --kills 10             # about 6 minutes
    python -m scripts.benchmarks scale --only key --kills 10                        # many minutes
    python -m scripts.benchmarks scale --only folder                           # about 2 minutes

Needs the extra `dask`. The durations are those of two cores. The parts, each of which can be chosen
by `--only`, for some of the verbs by `--verb`:

    equal      J, theta and covariances on the cluster and in one process, to the last digit; CPU
               seconds of cluster and caller over those of the same work in one process; the
               largest memory of a worker
    kill       SIGKILL of a worker at random moments: the same result
    interrupt  SIGINT at random moments: seconds until there is a result
    key        Ctrl-C in a terminal at random moments of each command: seconds until it has ended,
               with all data of its result
    folder     workers in an empty folder, after the files of the experiment were deleted
    scaling    seconds with one worker over seconds with two
    simulate   efficiency of a design from many starts on 1 to 256 simulated workers, of the
               cart-pendulum and of an arm, whose orders take much longer

In `equal`, the work of one process is what the cluster does without any overhead: what is above 1
is the price of sending, waiting and resolving the experiment more than once. The other cores do the
same work meanwhile, as they do on the cluster, because cores share caches, memory and power, and
each of them is slower where the others are busy. `equal` and `scaling` compare seconds that are
measured one after the other. A small process simulates meanwhile and measures the speed of a core
(`core_speed.py`); the seconds of the earlier measurement are those that it would have taken at the
speed of the later one. The measured seconds stand beside them. The second worker may itself slow
the first one down, so that `scaling` judges the smaller one of both ratios. `--full` has 64 starts,
1e5 trials and 500 recordings; the work under accidents (kill, interrupt, folder) is always small. A
table at the end says which figures are as wanted.

In `simulate`, a start that goes on takes part in up to four searches one after the other, and the
last one of them has to be waited for. So the efficiency depends on the number of starts for each
worker: many starts (--simulated-starts, --arm-starts) keep 256 workers busy, four starts for each
do not.
"""

from __future__ import annotations

import argparse
import atexit
import logging
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System
from mjfim.output.archive import write_table
from mjfim.output.playback import design_columns, simulate_playback
from scripts.benchmarks import arms
from scripts.benchmarks.benchmark_hour import EXPERIMENT as TWO_JOINTS
from scripts.benchmarks.benchmark_hour import played
from scripts.benchmarks.core_speed import at_speed, core_speed
from scripts.benchmarks.pressed_key import commands, moments, pressed, undisturbed_seconds
from scripts.benchmarks.simulated_design import Efficiency, efficiencies, save_curves

MODELS = Path(__file__).resolve().parents[2] / "models"

PARTS = ("equal", "kill", "interrupt", "key", "folder", "scaling", "simulate")

# What is wanted: CPU seconds of the cluster over those of one process, memory of a worker [MiB],
# seconds from SIGINT to a result, and speed of two workers over that of one.
MOST_CPU, MOST_MEMORY, MOST_SECONDS, LEAST_SPEED = 1.15, 1024.0, 10.0, 1.85

# CPU time of one process from which the ratio is judged [s]; in less work, the start of each worker
# weighs more than what it does.
LARGE_WORK = 60.0

# Efficiency that is wanted at the largest of these numbers of simulated workers.
LEAST_EFFICIENCY, SIMULATED_WORKERS = 0.8, (1, 4, 16, 64, 256)

# Difference of the numbers of iterations on clusters of different sizes, as a share.
SAME_WORK = 0.03

# The arm whose starts are simulated as well, the duration of its motion [s], and the starts and
# iterations that are carried out to measure the lengths of the orders.
SIMULATED_ARM, ARM_HORIZON = "so_arm100", 5.0
ARM_MEASURED, ARM_ITERATIONS = 4, 20


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """How much work the verbs have.

    Attributes:
        starts: Initial controls of the design.
        iterations: Largest number of its iterations.
        trials: Trials of the Monte-Carlo study.
        recordings: Recordings of the fit.
        seconds: Duration of each of them [s].
        robots: Robots on which a design is played.
    """

    starts: int
    iterations: int
    trials: int
    recordings: int
    seconds: float
    robots: int

    @property
    def gigabytes(self) -> float:
        """Size of the recordings as CSV, at 1 kHz, 7 columns and 17 characters each [GB]."""
        return self.recordings * self.seconds * 1000.0 * 7 * 17 * 1e-9


QUICK = Sizes(starts=8, iterations=12, trials=4000, recordings=24, seconds=2.0, robots=8)
FULL = Sizes(starts=64, iterations=60, trials=100_000, recordings=500, seconds=1.0, robots=60)

# Settings of Dask, as in docs/how-to/cluster.md. Without them, a scheduler and two workers that do
# nothing take 17 % of a core: Dask looks at the stack of each worker a hundred times per second, at
# its memory ten times, and checks its own event loops fifty times.
QUIET_DASK = {
    "distributed.worker.profile.enabled": False,
    "distributed.worker.memory.monitor-interval": "1s",
    "distributed.admin.tick.interval": "1s",
}

# Duration of the motion that is repeated in Monte-Carlo trials [s], and noise of the states with
# which the trials of such a short motion converge soon.
REPEATED_SECONDS = 0.5
REPEATED_NOISE = 0.002


@dataclass(frozen=True, kw_only=True)
class Verb:
    """A verb with its work.

    Attributes:
        name: Its name.
        run: Does the work on an executor, or in this process for None.
        fingerprint: Numbers of a result that have to be equal to the last digit; empty where a
            result has none.
    """

    name: str
    run: Callable[[Any], Any]
    fingerprint: Callable[[Any], bytes]


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """A figure beside what is wanted.

    Attributes:
        verb: The verb.
        figure: What was measured, in words.
        value: What was found.
        wanted: What is wanted.
        good: True where it is as wanted.
    """

    verb: str
    figure: str
    value: str
    wanted: str
    good: bool


# All figures of this run, in their order.
verdicts: list[Verdict] = []


def judge(verb: str, figure: str, value: str, wanted: str, *, good: bool) -> bool:
    """Print a figure beside what is wanted, and keep it for the table at the end."""
    verdicts.append(Verdict(verb=verb, figure=figure, value=value, wanted=wanted, good=good))
    print(_line(verdicts[-1]), flush=True)
    return good


def _line(verdict: Verdict) -> str:
    """A figure in one line."""
    answer = "yes" if verdict.good else "NO"
    return (
        f"{verdict.verb:11s} {verdict.figure:42s} {verdict.value:>28s}   wanted: "
        f"{verdict.wanted:20s} {answer}"
    )


def verbs(sizes: Sizes, folder: Path = MODELS) -> list[Verb]:
    """List the verbs that take an executor.

    Args:
        sizes: How much work they have.
        folder: Folder of the experiments.
    """
    limited = mjfim.Experiment.from_file(folder / "cart_pendulum_limits.toml")
    descent = {"starts": sizes.starts, "max_iterations": sizes.iterations, "seconds": 36_000}
    limited = limited.replace(descent=descent).packed()
    cart = mjfim.Experiment.from_file(folder / "cart_pendulum.toml").packed()
    short = cart.replace(horizon=REPEATED_SECONDS, noise={"state": REPEATED_NOISE})
    trajectory = DesignTask.resolve(short, threads=1).initial
    played_design = _played_control(cart)
    pendulum = mjfim.Experiment.from_file(folder / "free_pendulum.toml").packed()

    arm = mjfim.Experiment.from_file(folder / TWO_JOINTS.name).packed()
    system = System.resolve(arm, threads=1)
    recordings = [
        replace(played(system, sizes.seconds, seed), name=f"log {seed}")
        for seed in range(sizes.recordings)
    ]

    def options(executor: Any) -> dict[str, Any]:
        return {"executor": executor, "threads": 1, "progress": False}

    def design(executor: Any) -> Any:
        return mjfim.design(limited, **options(executor))

    def release(executor: Any) -> Any:
        return mjfim.design(pendulum, **options(executor))

    def montecarlo(executor: Any) -> Any:
        return mjfim.monte_carlo(short, trajectory, trials=sizes.trials, **options(executor))

    def identify(executor: Any) -> Any:
        return mjfim.identify(arm, recordings, **options(executor))

    def robustness(executor: Any) -> Any:
        return mjfim.assess_robustness(
            cart, played_design, runs=sizes.robots, executor=executor, progress=False
        )

    return [
        Verb(name="design", run=design, fingerprint=_of_design),
        Verb(name="release", run=release, fingerprint=_of_design),
        Verb(name="montecarlo", run=montecarlo, fingerprint=_of_study),
        Verb(name="identify", run=identify, fingerprint=_of_estimate),
        Verb(name="robustness", run=robustness, fingerprint=_of_robots),
    ]


def _played_control(experiment: mjfim.Experiment) -> Path:
    """File of the initial control of an experiment as a design that robots play."""
    task = DesignTask.resolve(experiment, threads=1)
    path = Path(tempfile.mkdtemp()) / "design.csv"
    atexit.register(shutil.rmtree, path.parent, ignore_errors=True)
    no_gain = np.zeros((task.samples, len(task.controls), task.space.nx))
    playback = simulate_playback(task.system, task.initial, no_gain)
    write_table(path, design_columns(playback, task.system))
    return path


def _of_design(design: Any) -> bytes:
    """Return J and the control."""
    return np.float64(design.final.cost).tobytes() + bytes(design.final.trajectory.ctrl.tobytes())


def _of_study(study: Any) -> bytes:
    """Return the covariances of all trajectories."""
    return b"".join(found.covariance.tobytes() for found in study.sets.values())


def _of_robots(found: Any) -> bytes:
    """Return the errors of all robots and their margins."""
    return bytes(found.error.tobytes() + found.margins.tobytes())


def _of_estimate(estimate: Any) -> bytes:
    """Return theta and its covariance."""
    return bytes(estimate.theta.tobytes() + estimate.covariance.tobytes())


# ---- the cluster


@contextmanager
def cluster(workers: int) -> Iterator[Any]:
    """Start a Dask cluster on this computer, with one process per worker.

    Args:
        workers: Number of workers, of one thread and 1 GiB each.

    Yields:
        A client of the cluster.
    """
    import dask
    from distributed import Client, LocalCluster

    # The workers import the benchmarks as this process does.
    root = str(Path(__file__).resolve().parents[2])
    os.environ["PYTHONPATH"] = os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])
    with (
        dask.config.set(QUIET_DASK),
        tempfile.TemporaryDirectory() as folder,
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit="1GiB",
            dashboard_address=":0",
            local_directory=folder,
            silence_logs=logging.CRITICAL,
        ) as made,
        Client(made, set_as_default=False) as client,
    ):
        client.wait_for_workers(workers)
        client.run(_import)
        yield client


def _import() -> None:
    """Import in a worker what the first task would import."""
    import mjfim.cli.design
    import mjfim.excitation.design  # noqa: F401


def cpu_seconds(without: int) -> float:
    """CPU time of this process and of all that it has started and that are alive [s].

    Args:
        without: Number of a process that does not count.
    """
    own = psutil.Process()
    total = 0.0
    for process in [own, *own.children(recursive=True)]:
        if process.pid == without:
            continue
        try:
            times = process.cpu_times()
        except psutil.NoSuchProcess:
            continue
        total += times.user + times.system
    return total


def peak_memory() -> float:
    """Largest memory of this process so far [MiB]."""
    import resource

    kilobytes = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return kilobytes / (1024.0**2 if sys.platform == "darwin" else 1024.0)


# ---- the parts


@dataclass(frozen=True, kw_only=True)
class Reference:
    """Result and effort of a verb in one process.

    Attributes:
        fingerprint: Numbers of its result.
        cpu: CPU time [s].
        speed: Speed of a core meanwhile [steps/s].
    """

    fingerprint: bytes
    cpu: float
    speed: float


def serial(verb: Verb) -> Reference:
    """Do the work of a verb in this process."""
    with core_speed() as core:
        begun = time.process_time()
        result = verb.run(None)
        used = time.process_time() - begun
    fingerprint = verb.fingerprint(result)
    return Reference(fingerprint=fingerprint, cpu=used, speed=core.steps_per_second)


@contextmanager
def busy_cores(verb: Verb, options: argparse.Namespace) -> Iterator[None]:
    """Let other processes repeat the work of a verb, so that as many cores are busy as workers."""
    words = [sys.executable, "-m", "scripts.benchmarks", "scale", "--repeat", verb.name]
    for name in vars(QUICK):
        size = getattr(options, name)
        words += [] if size is None else [f"--{name}", str(size)]
    words += ["--full"] if options.full else []

    others = [
        subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for _ in range(options.workers - 1)
    ]
    try:
        yield
    finally:
        ended = [other.poll() for other in others]
        for other in others:
            other.kill()
            other.wait()
    if any(code is not None for code in ended):
        raise RuntimeError(f"{verb.name}: a process that repeats the work has ended by itself")


def on_cluster(verb: Verb, reference: Reference, workers: int) -> bool:
    """Compare a verb on the cluster with one process: numbers, CPU time and memory."""
    with cluster(workers) as client:
        with core_speed() as core:
            begun, clock = cpu_seconds(core.probe), time.perf_counter()
            result = verb.run(client)
            used, seconds = cpu_seconds(core.probe) - begun, time.perf_counter() - clock
        memory = max(client.run(peak_memory).values())

    is_equal = verb.fingerprint(result) == reference.fingerprint
    alone = at_speed(reference.cpu, reference.speed, core.steps_per_second)
    ratio = used / alone
    is_large = reference.cpu >= LARGE_WORK
    good = judge(verb.name, "equal to the last digit", str(is_equal), "True", good=is_equal)
    good &= judge(
        verb.name,
        f"CPU s on {workers} workers over those alone",
        f"{used:.1f} / {alone:.1f} ({reference.cpu:.1f}) = {ratio:.3f}",
        f"<= {MOST_CPU}" + ("" if is_large else " in large work"),
        good=ratio <= MOST_CPU or not is_large,
    )
    good &= judge(
        verb.name,
        f"largest memory of a worker [MiB], {seconds:.0f} s",
        f"{memory:.0f}",
        f"<= {MOST_MEMORY:.0f}",
        good=memory <= MOST_MEMORY,
    )
    return good


def killed(verb: Verb, reference: Reference, workers: int, kills: int, seed: int) -> bool:
    """End a worker at random moments of a verb; the result has to be the same."""
    rng = np.random.default_rng(seed)
    same = 0
    with cluster(workers) as client:
        duration = _duration(verb, client)
        for _ in range(kills):
            # A nanny has started another worker in place of the one before.
            client.wait_for_workers(workers)
            victim = int(rng.choice(sorted(client.run(os.getpid).values())))
            timer = threading.Timer(rng.uniform(0.0, duration), _kill, [victim])
            timer.daemon = True
            timer.start()
            same += verb.fingerprint(verb.run(client)) == reference.fingerprint
            timer.cancel()

    return judge(
        verb.name,
        f"same result after SIGKILL, within {duration:.0f} s",
        f"{same} of {kills}",
        "all",
        good=same == kills,
    )


def interrupted(verb: Verb, workers: int, times: int, seed: int) -> bool:
    """Press Ctrl-C at random moments of a verb; there has to be a result within seconds."""
    rng = np.random.default_rng(seed)
    waits: list[float] = []
    results = 0
    with cluster(workers) as client:
        duration = _duration(verb, client)
        for _ in range(times):
            pressed: list[float] = []

            def press(pressed: list[float] = pressed) -> None:
                pressed.append(time.perf_counter())
                os.kill(os.getpid(), signal.SIGINT)

            timer = threading.Timer(rng.uniform(0.1, 0.9) * duration, press)
            timer.daemon = True
            timer.start()
            try:
                results += bool(verb.fingerprint(verb.run(client)))
            except (KeyboardInterrupt, mjfim.MjfimError) as error:
                print(f"{verb.name:11s} no result: {error!r}")
            waits += [time.perf_counter() - moment for moment in pressed]
            timer.cancel()

    longest = max(waits, default=0.0)
    return judge(
        verb.name,
        "results after SIGINT, last one after [s]",
        f"{results} of {times}, {longest:.1f}",
        f"all, <= {MOST_SECONDS:.0f}",
        good=results == times and longest <= MOST_SECONDS,
    )


def keys_pressed(names: Sequence[str] | None, times: int, seed: int) -> bool:
    """Press Ctrl-C at random moments of each command."""
    rng = np.random.default_rng(seed)
    good = True
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for command in commands(folder / "inputs"):
            if names is not None and command.name not in names:
                continue
            duration = undisturbed_seconds(command, folder / "out")
            found = [
                pressed(command, folder / "out", moment) for moment in moments(duration, times, rng)
            ]
            ended = [press for press in found if press is not None]
            for press in ended:
                if press.fault:
                    print(
                        f"{command.name:11s} at {press.moment:.1f} s: {press.fault}; it said last: "
                        f"{press.last_line}"
                    )
            whole = sum(not press.fault for press in ended)
            excused = sum(press.is_excused for press in ended)
            longest = max((press.seconds for press in ended), default=0.0)
            good &= judge(
                command.name,
                f"whole after a key within {duration:.0f} s, last one [s]",
                f"{whole} of {len(ended)} ({excused} empty), {longest:.1f}",
                f"all, <= {MOST_SECONDS:.0f}",
                good=0 < len(ended) == whole and longest <= MOST_SECONDS,
            )
    return good


def in_empty_folder(sizes: Sizes, references: dict[str, Reference], workers: int) -> bool:
    """Do the work in workers without any file: the experiments are deleted meanwhile."""
    with tempfile.TemporaryDirectory() as name, tempfile.TemporaryDirectory() as empty:
        copies = Path(name) / "models"
        shutil.copytree(MODELS, copies)
        chosen = [verb for verb in verbs(sizes, copies) if verb.name in references]
        shutil.rmtree(copies)

        good = True
        with cluster(workers) as client:
            client.run(os.chdir, empty)
            for verb in chosen:
                is_equal = verb.fingerprint(verb.run(client)) == references[verb.name].fingerprint
                is_empty = not any(Path(empty).iterdir())
                good &= judge(
                    verb.name,
                    "same without files, and nothing written",
                    f"{is_equal}, {is_empty}",
                    "True, True",
                    good=is_equal and is_empty,
                )
            client.run(os.chdir, name)
    return good


def scaling(verb: Verb) -> bool:
    """Compare the time on one worker with that on two."""
    seconds, speeds = {}, {}
    for workers in (1, 2):
        with cluster(workers) as client, core_speed() as core:
            clock = time.perf_counter()
            verb.run(client)
            seconds[workers] = time.perf_counter() - clock
        speeds[workers] = core.steps_per_second
    alone = at_speed(seconds[1], speeds[1], speeds[2])
    speed = min(alone, seconds[1]) / seconds[2]
    return judge(
        verb.name,
        "speed of two workers over that of one",
        f"{alone:.1f} ({seconds[1]:.1f}) / {seconds[2]:.1f} >= {speed:.2f}",
        f">= {LEAST_SPEED}",
        good=speed >= LEAST_SPEED,
    )


def simulations(sizes: Sizes, options: argparse.Namespace) -> bool:
    """Schedule designs from many starts on simulated workers, and draw the efficiencies."""
    cart = mjfim.Experiment.from_file(MODELS / "cart_pendulum_limits.toml")
    descent = {"starts": sizes.starts, "max_iterations": sizes.iterations}
    curves = {"cart-pendulum": simulation("cart-pendulum", cart, descent, options.simulated_starts)}

    if arms.MODELS.is_dir():
        with tempfile.TemporaryDirectory() as folder:
            arm = arms.experiment(SIMULATED_ARM, ARM_HORIZON, False, folder)
            descent = {"starts": ARM_MEASURED, "max_iterations": ARM_ITERATIONS}
            curves[SIMULATED_ARM] = simulation(SIMULATED_ARM, arm, descent, options.arm_starts)
    else:
        print(f"{SIMULATED_ARM} is left out: its model is not part of this repository")

    save_curves(curves, LEAST_EFFICIENCY, options.picture)
    print(f"the curves are in {options.picture}")
    good = True
    for name, rows in curves.items():
        last = rows[-1]
        good &= judge(
            "design",
            f"{name}: efficiency on {last.workers} workers",
            f"{last.efficiency:.3f}",
            f">= {LEAST_EFFICIENCY}",
            good=last.efficiency >= LEAST_EFFICIENCY,
        )

        # Workers that do what one worker would not do are busy as well.
        counts = [row.iterations for row in rows]
        good &= judge(
            "design",
            f"{name}: iterations on all these clusters",
            f"{min(counts)} to {max(counts)}",
            f"within {SAME_WORK:.0%}",
            good=max(counts) <= (1.0 + SAME_WORK) * min(counts),
        )
    return good


def simulation(
    name: str, experiment: mjfim.Experiment, descent: dict[str, Any], starts: int
) -> list[Efficiency]:
    """Schedule a design from many starts on simulated workers.

    Args:
        name: Name of the experiment.
        experiment: The experiment.
        descent: Number of the starts that are carried out, and largest number of iterations.
        starts: Number of starts that are scheduled.

    Returns:
        The efficiency on each number of workers.
    """
    print(f"{name}: a design from {starts} starts, lengths of {descent['starts']} measured")
    print(
        "workers  seconds  efficiency  of the searches alone  seconds of the caller  its share"
        "  ms per order  of it pickling  seconds of an order"
    )
    rows = []
    stated = experiment.replace(descent={**descent, "seconds": 36_000})
    for row in efficiencies(stated, starts, SIMULATED_WORKERS):
        rows.append(row)
        print(
            f"{row.workers:7d} {row.seconds:8.1f} {row.efficiency:11.3f} {row.of_searches:22.3f} "
            f"{row.caller:22.1f} {row.caller / row.seconds:10.3f} "
            f"{1e3 * row.caller / row.tasks:13.2f} {1e3 * row.pickling / row.tasks:15.2f} "
            f"{row.task_seconds:20.2f}",
            flush=True,
        )
    return rows


def _duration(verb: Verb, client: Any) -> float:
    """Time that a verb takes on the cluster [s]."""
    clock = time.perf_counter()
    verb.run(client)
    return time.perf_counter() - clock


def _kill(pid: int) -> None:
    """End a process at once; it may have ended already."""
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return


# Parts that measure large work, and parts that repeat small work many times.
LARGE_PARTS, SMALL_PARTS = {"equal", "scaling"}, {"kill", "interrupt", "folder"}


def run(options: argparse.Namespace) -> bool:
    """Run the chosen parts; return whether all figures are as wanted."""
    given = {key: getattr(options, key) for key in vars(QUICK) if getattr(options, key)}
    small = replace(QUICK, **given)
    large = replace(FULL if options.full else QUICK, **given)
    parts = set(options.only or PARTS)
    if options.repeat:
        (verb,) = (each for each in verbs(large) if each.name == options.repeat)
        while True:
            verb.run(None)

    good = True
    if parts & LARGE_PARTS:
        good &= _large_work(large, parts, options)
    if parts & SMALL_PARTS:
        good &= _small_work(small, parts, options)
    if "key" in parts:
        good &= keys_pressed(options.verb, options.kills, options.seed)
    if "simulate" in parts:
        good &= simulations(large, options)

    print("\nAll figures of this run:")
    for verdict in verdicts:
        print(_line(verdict))
    return good


def _chosen(sizes: Sizes, options: argparse.Namespace) -> list[Verb]:
    """List the verbs that are chosen."""
    return [verb for verb in verbs(sizes) if options.verb is None or verb.name in options.verb]


def _large_work(sizes: Sizes, parts: set[str], options: argparse.Namespace) -> bool:
    """Measure what does not depend on accidents."""
    print(f"{sizes}: {sizes.gigabytes:.2f} GB of recordings")
    good = True

    # One worker needs twice the time of two, so that the work is smaller where that is measured.
    fewer = replace(sizes, trials=sizes.trials // 3, recordings=-(-sizes.recordings // 3))
    half = _chosen(fewer, options) if "scaling" in parts else []
    for verb in _chosen(sizes, options):
        if "equal" in parts:
            with busy_cores(verb, options):
                reference = serial(verb)
            good &= on_cluster(verb, reference, options.workers)
        if "scaling" in parts:
            good &= scaling(next(each for each in half if each.name == verb.name))
    return good


def _small_work(sizes: Sizes, parts: set[str], options: argparse.Namespace) -> bool:
    """Repeat small work under accidents."""
    print(f"under accidents: {sizes}")
    chosen = _chosen(sizes, options)
    references = {verb.name: serial(verb) for verb in chosen}

    good = True
    for verb in chosen:
        if "kill" in parts:
            kills = options.kills
            good &= killed(verb, references[verb.name], options.workers, kills, options.seed)
        if "interrupt" in parts:
            good &= interrupted(verb, options.workers, options.kills, options.seed)
    if "folder" in parts:
        good &= in_empty_folder(sizes, references, options.workers)
    return good


def main() -> int:
    """Run the benchmark; return 1 where a figure is not as wanted."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--full", action="store_true", help="the work of a large study")
    parser.add_argument("--only", nargs="+", choices=PARTS, help="parts; default: all")
    parser.add_argument("--verb", nargs="+", help="verbs; default: all that take an executor")
    parser.add_argument(
        "--repeat", metavar="VERB", help="do nothing else than to repeat the work of a verb"
    )
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kills", type=int, default=2, help="random moments per verb")
    parser.add_argument("--seed", type=int, default=0, help="of the random moments")
    for name, value in vars(QUICK).items():
        parser.add_argument(f"--{name}", type=type(value), help=f"default: {value}")
    parser.add_argument("--simulated-starts", type=int, default=8192, help="of the cart-pendulum")
    parser.add_argument("--arm-starts", type=int, default=4096, help="simulated starts of the arm")
    parser.add_argument("--picture", type=Path, default=Path("out/scale.png"))
    options = parser.parse_args()

    # A shell starts its background jobs with SIGINT ignored, and the commands that they start would
    # ignore it as well.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    return 0 if run(options) else 1


if __name__ == "__main__":
    raise SystemExit(main())
