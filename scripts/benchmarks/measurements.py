"""Small measurements that two versions of the package have in common.

Each function runs in a process of its own, with the package of this folder or that of an earlier
commit (`run_in_subprocess`), and returns what JSON can hold. The code is the same for both. It
imports what it needs where it needs it, so that a version that lacks something fails in this one
measurement only.
"""

from __future__ import annotations

import resource
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping
from math import inf, isfinite
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np

import mjfim
from mjfim.parallel import cores
from scripts.benchmarks.checkouts import ROOT

# Folder of the examples.
MODELS = ROOT / "models"

# Fourier series with which designs of the arm of seven hinges are compared.
SERIES = ("fourier5-mjfim", "fourier15-mjfim")


class Figure(NamedTuple):
    """A measured number.

    Attributes:
        value: The number.
        processors: Time of the processors [s], where the number is a wall time.
    """

    value: float
    processors: float | None = None


# Figures of one measurement, by their names.
Figures = dict[str, Figure]


class Time(NamedTuple):
    """A duration.

    Attributes:
        wall: Wall time [s].
        processors: Time of the processors [s].
    """

    wall: float
    processors: float


class Clock:
    """Wall time, and time of the processors of this process and of those that have ended."""

    def __init__(self) -> None:
        self._wall = time.perf_counter()
        self._processors = _processors()

    def read(self) -> Time:
        """Both since the clock was made [s]."""
        return Time(time.perf_counter() - self._wall, _processors() - self._processors)


def _processors() -> float:
    """Time of the processors of this process and of its ended children [s]."""
    own, others = (
        resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    return own.ru_utime + own.ru_stime + others.ru_utime + others.ru_stime


def costs_over_time(tables: Mapping[str, Any], seconds: float) -> list[tuple[float, float]]:
    """Run one design until the seconds of the processor are used up.

    Args:
        tables: Tables of the experiment.
        seconds: Seconds of the processor for the search.

    Returns:
        Seconds since the search began, and the best J so far, of every iterate.
    """
    from mjfim.budget import Budget, StopToken
    from mjfim.excitation.design import design_task
    from mjfim.excitation.task import DesignTask
    from mjfim.records.events import DesignEvent

    task = DesignTask.resolve(mjfim.Experiment(**tables))
    token = StopToken()
    begun = time.process_time()
    found: list[tuple[float, float]] = []

    def note(event: DesignEvent) -> None:
        """Note the iterate, and end the run where its time is over."""
        spent = time.process_time() - begun
        if spent > seconds:
            token.request()
        best = min([event.row.cost, *(cost for _, cost in found[-1:])])
        found.append((spent, best))

    design_task(task, callback=note, budget=Budget(stop=token))
    return found


def starts_side_by_side(starts: int) -> Figures:
    """Design the cart-pendulum of the README, without limits, from several starts on all cores."""
    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml")
    experiment = experiment.replace(descent={"starts": starts})

    clock = Clock()
    with mjfim.Pool() as executor:
        design = mjfim.design(experiment, executor=executor, progress=False)
    return {"time": Figure(*clock.read()), "cost": Figure(design.final.cost)}


def survey(p: int) -> Figures:
    """Find what is identifiable of p inertial parameters of the Panda, along its first motion."""
    from mjfim.excitation.task import DesignTask
    from scripts.benchmarks.benchmark_arm import ARM, tables_of

    task = DesignTask.resolve(mjfim.Experiment(**tables_of(ARM, p, 1)))
    sensitivity = task.plant.derivatives.sensitivity(task.theta, task.initial)
    if sensitivity is None:
        raise RuntimeError("the arm diverges")

    steps, clock = task.plant.engine_steps, Clock()
    task.identifiability_test.along(task.initial, sensitivity)
    return {
        "time": Figure(*clock.read()),
        "steps": Figure(float(task.plant.engine_steps - steps)),
    }


def model_work(example: str) -> Figures:
    """Count how often one design of an example parses and compiles its model."""
    import mujoco

    counts: Counter[str] = Counter()

    def counted(name: str) -> Callable[..., Any]:
        """The function of MuJoCo, which counts its calls."""
        function = getattr(mujoco.MjSpec, name)

        def call(*args: Any, **kwargs: Any) -> Any:
            counts[name] += 1
            return function(*args, **kwargs)

        return call

    experiment = mjfim.Experiment.from_file(MODELS / f"{example}.toml")
    with (
        mock.patch.object(mujoco.MjSpec, "from_file", staticmethod(counted("from_file"))),
        mock.patch.object(mujoco.MjSpec, "compile", counted("compile")),
    ):
        mjfim.design(experiment.replace(descent={"max_iterations": 3}), progress=False)
    return {
        "parses": Figure(float(counts["from_file"])),
        "compilations": Figure(float(counts["compile"])),
    }


def arm_iterations(
    p: int, iterations: int, is_limited: bool, by_differences: bool = False
) -> Figures:
    """Design a motion of the Panda for p inertial parameters, for some iterations, on one level.

    Args:
        p: Number of parameters.
        iterations: Number of iterations.
        is_limited: Whether the limits of the model are hard.
        by_differences: Whether all derivatives are differences of the engine, also in a version
            that has them in closed form.

    Returns:
        `iteration` is the median time of an iteration and `steps` that of its engine steps. `rest`
        is all that is not iterations: what is identifiable, the first iterate, derivatives without
        closed form at the last one, and the verification. `bare step` is the time of one step of
        the bare engine, and `engine` that of all steps of an iteration, on average. `wall ratio` is
        the average wall time of an iteration on all cores over it, and `ratio` the average time of
        the processors over it.
    """
    from mjfim.excitation.design import design_task
    from mjfim.excitation.task import DesignTask
    from mjfim.records.events import DesignEvent
    from scripts.benchmarks.benchmark_arm import ARM, tables_of
    from scripts.benchmarks.iteration_parts import bare_step_time

    tables = tables_of(ARM, p, iterations)
    tables["limits"] = {"enforce": is_limited}
    readings: list[Time] = []
    steps: list[int] = []

    clock = Clock()
    task = DesignTask.resolve(mjfim.Experiment(**tables))
    if by_differences and hasattr(task.plant, "closed_form_memory"):
        task.plant.closed_form_memory.tree = None

    def note(event: DesignEvent) -> None:
        """Note the time and the engine steps of an iterate."""
        readings.append(clock.read())
        steps.append(event.row.steps)

    design_task(task, callback=note)
    end = clock.read()

    count = max(len(readings) - 1, 1)
    iteration = Figure(
        float(np.median(np.diff([reading.wall for reading in readings]))),
        float(np.median(np.diff([reading.processors for reading in readings]))),
    )
    wall = readings[-1].wall - readings[0].wall
    processors = readings[-1].processors - readings[0].processors
    bare_step = bare_step_time(task.plant.source.model, task)
    engine = (steps[-1] - steps[0]) * bare_step
    return {
        "iteration": iteration,
        "rest": Figure(
            end.wall - count * iteration.value,
            end.processors - count * (iteration.processors or 0.0),
        ),
        "steps": Figure(float(np.median(np.diff(steps)))),
        "bare step": Figure(bare_step),
        "engine": Figure(engine / count),
        "wall ratio": Figure(wall * cores() / engine if engine > 0.0 else inf),
        "ratio": Figure(processors / engine if engine > 0.0 else inf),
    }


def ratio_to_engine(runs: int) -> Figures:
    """Divide the time of cart-pendulum designs by that of the engine; the worst of all cases."""
    from mjfim.excitation.task import DesignTask
    from scripts.benchmarks import benchmark

    benchmark.mjfim_run("a", "warm-up")
    found: Figures = {}
    for name, descent in (("levels", {}), ("one level", {"coarse": 1})):
        ratios = []
        for case in benchmark.CASES:
            run, design = benchmark.fastest(runs, case, name, **descent)
            task = DesignTask.resolve(benchmark.experiment(case))
            step = benchmark.step_seconds(task, design.trajectory)
            ratios.append(run.seconds * cores() / (design.steps * step))
        found[name] = Figure(max(ratios))
    return found


def limited_cart_pendulum(seconds: float, seed: int) -> Figures:
    """Design the cart-pendulum under hard limits with all cores and a budget of wall time [s]."""
    from scripts.benchmarks.benchmark_limits import run_mjfim

    found = run_mjfim(seconds, seed)
    first = min((t for t, _ in found.history), default=float("inf"))
    return {"smallest eigenvalue": Figure(found.after(seconds)), "first": Figure(first)}


def limited_arm(arm: str, horizon: float, dry: bool, seconds: float) -> Figures:
    """Design the motion of an arm under hard limits with all cores and a budget of wall time [s].

    The figure is the worst relative standard deviation, infinite where the design leaves a limit.
    """
    from scripts.benchmarks import arms
    from scripts.benchmarks.arms_table import FUNDAMENTAL

    with tempfile.TemporaryDirectory() as folder:
        stated = arms.experiment(arm, horizon, dry, Path(folder))
        descent = {"fourier": [FUNDAMENTAL], "max_iterations": 100_000, "seconds": seconds}
        experiment = stated.replace(descent=descent)

        clock = Clock()
        with mjfim.Pool() as executor:
            design = mjfim.design(experiment, executor=executor, progress=False)
        used = clock.read()

    is_kept = min(design.limits.values()) >= 0.0

    # The eigenvalue is that of the information per second of measurements.
    smallest = float(design.final.eigenvalues[0]) * arms.MEASURED
    sigma = smallest**-0.5 if is_kept else float("inf")
    return {"sigma": Figure(sigma), "time": Figure(*used)}


def beside_baselines(example: str, seconds: float) -> Figures:
    """Compare a design of an example with its baselines, each in one thread.

    Args:
        example: Name of the experiment.
        seconds: Budget of every method [s of the processor].
    """
    experiment = mjfim.Experiment.from_file(MODELS / f"{example}.toml")
    return _beside_baselines(example, experiment, seconds)


def arm_beside_baselines(arm: str, dry: bool, seconds: float) -> Figures:
    """Compare a design of an arm with its baselines, each in one thread.

    Args:
        arm: Name of the arm.
        dry: Whether its joints have dry friction.
        seconds: Budget of every method [s of the processor].
    """
    from scripts.benchmarks import anytime, arms

    with tempfile.TemporaryDirectory() as folder:
        experiment = arms.experiment(arm, anytime.HORIZON, dry, Path(folder))
        return _beside_baselines(arm, experiment, seconds)


def _beside_baselines(case: str, experiment: mjfim.Experiment, seconds: float) -> Figures:
    """Compare a design with its baselines.

    Returns:
        J of the design, and the same over the lowest J of the baselines: zero where only the design
        finds a motion, and infinite where it finds none.
    """
    from mjfim.records.comparison import DESIGN
    from scripts.benchmarks import anytime

    rows = anytime.run(case, experiment, seconds, list(anytime.METHODS))
    found = anytime.Results(case, rows)
    cost = found.cost(DESIGN, seconds)
    best, _ = found.best_baseline(seconds)
    return {"cost": Figure(cost), "over best baseline": Figure(_over(cost, best))}


def design_over_series(horizon: float, seconds: float) -> Figures:
    """Compare a design of the arm of seven hinges with the best Fourier series, each in one thread.

    Args:
        horizon: Duration of the motion [s].
        seconds: Budget of every method [s of the processor].

    Returns:
        Worst relative standard deviations of the design and of the best series, infinite where
        nothing keeps the limits, and the first one over the second one.
    """
    from mjfim.budget import measured_by
    from mjfim.excitation.task import DesignTask
    from mjfim.records.comparison import DESIGN
    from mjfim.studies.compare import compare_task
    from scripts.benchmarks import seven_hinges

    with tempfile.TemporaryDirectory() as folder:
        experiment = seven_hinges.experiment(horizon, Path(folder))
        task = DesignTask.resolve(experiment, threads=1)
        with measured_by(time.process_time):
            found = compare_task(task, seconds=seconds, methods=list(SERIES))

    sigmas = {row.method: row.worst_relative_std for row in found.rows if row.sound}
    design = sigmas.pop(DESIGN, inf)
    series = min(sigmas.values(), default=inf)
    return {
        "design": Figure(design),
        "series": Figure(series),
        "over best series": Figure(_over(design, series)),
    }


def automatic_derivatives(model: str) -> Figures:
    """Compare derivatives with those of MJX; the figures are the relative differences.

    Args:
        model: Name of the model.
    """
    from scripts.benchmarks import mjx_oracle

    (case,) = (each for each in mjx_oracle.CASES if each.model == model)
    found = mjx_oracle.agreement(case)
    return {
        name: Figure(getattr(found, name))
        for name in ("psi", "A", "B", "mixed", "psi_closed", "mixed_closed")
    }


def _over(cost: float, best: float) -> float:
    """A figure over the lowest of others; infinite where it is infinite, whatever the others."""
    return cost / best if isfinite(cost) else inf


def short_fit() -> Figures:
    """Fit a recording of 4 s, after a first fit that imports all libraries."""
    from scripts.benchmarks.benchmark_hour import short_recording

    experiment, recording = short_recording()
    mjfim.identify(experiment, [recording], progress=False)
    clock = Clock()
    found = mjfim.identify(experiment, [recording], progress=False)
    return {"time": Figure(*clock.read()), "steps": Figure(float(found.steps))}


def rail_fit(seconds: float) -> Figures:
    """Fit the log of a rail with dry friction, of a duration [s]."""
    from scripts.benchmarks import rail

    found = rail.passes(seconds, 0)
    return {
        "passes": Figure(sum(found.by_reason.values())),
        "steps": Figure(float(found.steps)),
        "time": Figure(found.seconds),
    }
