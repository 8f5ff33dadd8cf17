"""Table of the changes in time and quality since an earlier commit, with the goal of each.

    python -m scripts.benchmarks before_and_after                       # 70 minutes
    python -m scripts.benchmarks before_and_after --quick               # 12 minutes
    python -m scripts.benchmarks before_and_after --only limits starts  # some parts
    python -m scripts.benchmarks before_and_after --results FOLDER      # go on from there

Every measurement runs in processes of its own, in turn with the package of the earlier commit and
with that of this folder, and is the same code for both. The table has the medians. Times are those
of the wall clock, as the goals are, and in parentheses those of the processors. On a machine where
other programs run, the latter tell more.

With --results, every measurement is kept in the folder as JSON and is not made again, so that parts
can be measured one after the other. It is made again where a run has failed, and where the earlier
commit or the number of runs is another one.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from importlib.util import find_spec
from math import inf, isfinite
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markdown import Markdown
from rich.table import Table

from mjfim.parallel import cores
from scripts.benchmarks import arms, benchmark, benchmark_arm, benchmark_hour, rail, start_up
from scripts.benchmarks.checkouts import ROOT, commit_hash, earlier_checkout
from scripts.benchmarks.measurements import Figure, Figures
from scripts.benchmarks.run_in_subprocess import measure_in_subprocess

# The commit before the work on speed began.
BEFORE = "54c4cc9"

# Changes that were tried and did not help.
TRIED = ROOT / "docs" / "explanation" / "tried.md"

# Worst relative standard deviations that designs of 120 s reached before: arm, horizon [s], whether
# the joints have dry friction.
CELLS = {
    ("panda", 5.0, False): 0.0933,
    ("panda", 10.0, False): 0.0693,
    ("panda", 5.0, True): 0.371,
    ("panda", 10.0, True): 0.269,
    ("so_arm100", 5.0, False): 0.0255,
    ("so_arm100", 10.0, False): 0.0181,
    ("so_arm100", 5.0, True): 0.0472,
    ("so_arm100", 10.0, True): 0.0321,
}

# What designs of 120 s should reach.
CELLS_AIM = {("panda", 5.0, False): 0.085, ("so_arm100", 5.0, False): 0.0235}

# Smallest eigenvalues that the cart-pendulum under limits should reach, by seconds.
LIMITS = {5.0: 403.15, 10.0: None, 60.0: 403.34}

# Examples under limits or weights that are compared with baselines, and their budgets [s].
BUDGETS = {
    "cart_pendulum_limits": (2.0, 3.0, 5.0),
    "quadrotor": (3.0,),
    "servo_arm": (3.0,),
    "sliding_block": (2.0, 3.0, 5.0),
}

# Budgets of the SO-ARM100 [s], which is compared with smooth and with dry joints.
ARM_BUDGETS = (2.0, 3.0, 5.0)

# Those of them that a quick run compares.
QUICK_EXAMPLES = ("cart_pendulum_limits",)

# Wall time of a fit of an hour at 1 kHz [s], its memory [GiB], and wall time of a fit of 4 s [s].
HOUR, HOUR_MEMORY, SHORT = 70.0, 1.0, 0.5

# What the earlier commit took where these goals were set [s]: an iteration of the Panda by the
# number of parameters, the fit of an hour, and the first command of the README.
ITERATION_THERE = {30: 0.52, 70: 0.95}
HOUR_THERE, FIRST_COMMAND_THERE = 166.0, 4.4

# Ratio of the time of a design to that of the engine, with short iterations, and with those of at
# least 40 ms in the engine.
SHORT_RATIO, LONG_RATIO = 1.3, 1.15

# Worst relative standard deviation of a design of the arm of seven hinges over that of the best
# series, and duration of the motion [s].
OVER_SERIES, SERIES_HORIZON = 0.9, 4.0

# Numbers of parameters for which the survey of what is identifiable is timed.
SURVEYS = (30, 70)

# Examples whose parses and compilations are counted.
COUNTED = ("cart_pendulum", "servo_arm")

# Models whose derivatives are compared with automatic ones, and largest relative differences of
# first and of mixed second derivatives.
AUTOMATIC = ("cart_pendulum", "two_joint_arm", "servo_arm")
AUTOMATIC_FIRST, AUTOMATIC_MIXED = 1e-7, 1e-5

# Factor from which a goal is said to be missed by a factor instead of a percentage.
FACTOR = 1.1

# Share of the cores above which other programs disturb the wall times.
BUSY = 0.3


@dataclass(frozen=True, kw_only=True)
class Line:
    """A line of the table.

    Attributes:
        name: What the figure is.
        figure: Name of the figure among those of its measurement.
        unit: Unit of the figure, or empty.
        goal: What is wanted, or None.
        is_larger_better: Whether the goal is a lower bound.
        before_there: What the earlier commit took on the machine on which the goal was set; None
            where it is not known. On another machine, the goal is a ratio to the earlier commit.
        derived: Computes the figure from those of the earlier commit and those of the version; None
            for a measured one.
    """

    name: str
    figure: str
    unit: str = ""
    goal: float | None = None
    is_larger_better: bool = False
    before_there: float | None = None
    derived: Callable[[Figures, Figures], Figure] | None = None


@dataclass(frozen=True, kw_only=True)
class Measurement:
    """A measurement, and the lines of the table that it gives.

    Attributes:
        name: Name of its file of results.
        run: Makes it with the package of a folder.
        lines: The lines.
        repeats: Number of times that it is made with each version.
        has_before: Whether the earlier commit can make it.
    """

    name: str
    run: Callable[[Path], Figures | None]
    lines: tuple[Line, ...]
    repeats: int = 1
    has_before: bool = True


@dataclass(frozen=True, kw_only=True)
class Sizes:
    """How large the measurements are.

    Attributes:
        is_quick: Whether they are the short ones.
        hours: Duration of the long recording [h].
        folder: Temporary folder.
    """

    is_quick: bool
    hours: float
    folder: Path


@dataclass(frozen=True, kw_only=True)
class Part:
    """Measurements of one subject.

    Attributes:
        title: The subject.
        minutes: Time expected on two idle cores, and that of the quick ones [min].
        measurements: Lists them.
        absent: Says in a sentence why they cannot be made here; empty where they can.
    """

    title: str
    minutes: tuple[float, float]
    measurements: Callable[[Sizes], Iterator[Measurement]]
    absent: Callable[[], str] = str


def absent_arms() -> str:
    """Say that the models of the arms are absent, where they are."""
    if arms.MODELS.is_dir():
        return ""
    return "left out, because the models of the arms are not part of this repository"


def absent_oracle() -> str:
    """Say that MJX is absent, where it is."""
    if all(find_spec(name) for name in ("jax", "mujoco.mjx")):
        return ""
    return "left out, because MJX or JAX is not installed (pip install 'mjfim[oracle]')"


def start_ups(sizes: Sizes) -> Iterator[Measurement]:
    """Start of the command line, and the first command of the README."""
    wanted = ("--help", "check, a missing file", "check, a mistyped key")
    for command in start_up.commands(sizes.folder):
        is_first = command.goal == start_up.FIRST_COMMAND_GOAL
        if command.name in wanted or is_first:
            yield Measurement(
                name=command.name.replace(" ", "_").strip("-"),
                run=partial(_start_up, command),
                lines=(
                    Line(
                        name=command.name,
                        figure="time",
                        unit="s",
                        goal=command.goal,
                        before_there=FIRST_COMMAND_THERE if is_first else None,
                    ),
                ),
                repeats=3 if sizes.is_quick else 5,
            )


def _start_up(command: start_up.Command, package: Path) -> Figures:
    """Run a command; its modules are compiled if this is the first run."""
    if not (package / "mjfim" / "cli" / "__pycache__").is_dir():
        start_up.timed(package, command)
    run = start_up.timed(package, command)
    return {"time": Figure(run.wall, run.processor)}


def starts(sizes: Sizes) -> Iterator[Measurement]:
    """Several starts of a design without limits, side by side on all cores."""
    count = 4 if sizes.is_quick else 16
    yield _of(
        "starts_side_by_side",
        f"starts_{count}",
        Line(name=f"{count} starts of the cart-pendulum", figure="time", unit="s"),
        Line(name="J of the best start", figure="cost"),
        starts=count,
    )


def surveys(sizes: Sizes) -> Iterator[Measurement]:
    """Time of the survey of what is identifiable, which a design makes before its first iterate."""
    for p in SURVEYS[:1] if sizes.is_quick else SURVEYS:
        yield _of(
            "survey",
            f"survey_{p}",
            Line(name=f"Panda, p = {p}: survey of what is identifiable", figure="time", unit="s"),
            Line(name="its engine steps", figure="steps"),
            repeats=1 if sizes.is_quick else 2,
            p=p,
        )


def model_work(sizes: Sizes) -> Iterator[Measurement]:
    """How often a design parses and compiles its model."""
    for example in COUNTED:
        yield _of(
            "model_work",
            f"model_work_{example}",
            Line(name=f"{example}: parses of the model in a design", figure="parses", goal=1),
            Line(name="compilations of the model", figure="compilations", goal=1),
            example=example,
        )


def iterations(sizes: Sizes) -> Iterator[Measurement]:
    """Iterations of the Panda, and what a design takes beside them."""
    count = 3 if sizes.is_quick else 8
    for p in (10, 30, 70):
        is_limited = p == 10
        name = f"Panda, p = {p}" + (", limits" if is_limited else "")
        lines = [
            Line(
                name=f"{name}: an iteration",
                figure="iteration",
                unit="s",
                goal=benchmark_arm.AIMS.get(p),
                before_there=ITERATION_THERE.get(p),
            ),
            Line(name=f"{name}: engine steps of an iteration", figure="steps"),
            Line(name=f"{name}: all beside iterations", figure="rest", unit="s"),
        ]
        if not is_limited:
            lines.append(
                Line(
                    name=f"{name}: over the engine's time for the steps before",
                    figure="ratio",
                    derived=_over_earlier_steps,
                )
            )
        yield _of(
            "arm_iterations",
            f"panda_{p}_{count}",
            *lines,
            repeats=1 if sizes.is_quick else 2,
            p=p,
            iterations=count,
            is_limited=is_limited,
        )


def arm_ratios(sizes: Sizes) -> Iterator[Measurement]:
    """Time of an iteration of the Panda over that of the engine for its steps.

    In closed form there are few steps, and most of the time is linear algebra in their place. So
    the same version with differences is measured as well, whose time is that of the engine and for
    which the goal holds.
    """
    count = 2 if sizes.is_quick else 6
    for by_differences in (False, True):
        goal = LONG_RATIO if by_differences else None
        kind = "by differences" if by_differences else "as it is"
        yield _of(
            "arm_iterations",
            f"panda_ratio_{'differences' if by_differences else 'own'}_{count}",
            Line(
                name=f"Panda, p = 30, one level, {kind}: engine's time of an iteration",
                figure="engine",
                unit="s",
            ),
            Line(name="wall time on all cores over it", figure="wall ratio", goal=goal),
            Line(name="time of the processors over it", figure="ratio", goal=goal),
            repeats=1 if sizes.is_quick else 2,
            p=30,
            iterations=count,
            is_limited=False,
            by_differences=by_differences,
        )


def _over_earlier_steps(earlier: Figures, own: Figures) -> Figure:
    """Time of the processors in an iteration over the engine's time for the earlier steps.

    It is infinite where the earlier iterations had no steps.
    """
    processors = own["iteration"].processors or own["iteration"].value
    engine = earlier["steps"].value * own["bare step"].value
    return Figure(processors / engine if engine > 0.0 else inf)


def ratios(sizes: Sizes) -> Iterator[Measurement]:
    """Time of cart-pendulum designs over that of the engine."""
    runs = 1 if sizes.is_quick else 3
    yield _of(
        "ratio_to_engine",
        f"ratios_{runs}",
        Line(name="cart-pendulum: wall over engine", figure="levels", goal=SHORT_RATIO),
        Line(name="the same with one level", figure="one level", goal=SHORT_RATIO),
        runs=runs,
    )


def limits(sizes: Sizes) -> Iterator[Measurement]:
    """The cart-pendulum under hard limits with equal time."""
    for seconds, goal in LIMITS.items():
        if sizes.is_quick and seconds > 10.0:
            continue
        name = f"cart-pendulum with limits, {seconds:g} s"
        yield _of(
            "limited_cart_pendulum",
            f"limits_{seconds:g}s",
            Line(
                name=f"{name}: smallest eigenvalue",
                figure="smallest eigenvalue",
                goal=goal,
                is_larger_better=True,
            ),
            Line(name=f"{name}: first control", figure="first", unit="s"),
            repeats=1 if sizes.is_quick or seconds > 10.0 else 2,
            seconds=seconds,
            seed=0,
        )


def arm_cells(sizes: Sizes) -> Iterator[Measurement]:
    """Designs of arms under hard limits with equal time."""
    if sizes.is_quick:
        wanted = [(cell, 20.0, CELLS[cell]) for cell in CELLS_AIM]
    else:
        wanted = [(cell, 40.0, goal) for cell, goal in CELLS.items()]
        wanted += [(cell, 120.0, goal) for cell, goal in CELLS_AIM.items()]

    for (arm, horizon, dry), seconds, goal in wanted:
        joints = "dry" if dry else "smooth"
        yield _of(
            "limited_arm",
            f"{arm}_{joints}_{horizon:g}s_in_{seconds:g}s",
            Line(
                name=f"{arm}, {joints}, {horizon:g} s, in {seconds:g} s: worst relative sigma",
                figure="sigma",
                goal=goal,
            ),
            arm=arm,
            horizon=horizon,
            dry=dry,
            seconds=seconds,
        )


def comparisons(sizes: Sizes) -> Iterator[Measurement]:
    """Designs beside the best baseline at every budget."""
    for example, budgets in BUDGETS.items():
        for seconds in budgets:
            if sizes.is_quick and (example not in QUICK_EXAMPLES or seconds > 3.0):
                continue
            name = f"{example}, {seconds:g} s"
            yield _of(
                "beside_baselines",
                f"beside_baselines_{example}_{seconds:g}s",
                Line(name=f"{name}: J over the best baseline", figure="over best baseline", goal=1),
                Line(name=f"{name}: J of the design", figure="cost"),
                example=example,
                seconds=seconds,
            )


def arm_comparisons(sizes: Sizes) -> Iterator[Measurement]:
    """Designs of the SO-ARM100 beside the best baseline at every budget."""
    for dry in (False, True):
        joints = "dry" if dry else "smooth"
        for seconds in ARM_BUDGETS:
            if sizes.is_quick and (dry or seconds > 2.0):
                continue
            name = f"so_arm100, {joints}, {seconds:g} s"
            yield _of(
                "arm_beside_baselines",
                f"beside_baselines_so_arm100_{joints}_{seconds:g}s",
                Line(name=f"{name}: J over the best baseline", figure="over best baseline", goal=1),
                Line(name=f"{name}: J of the design", figure="cost"),
                arm="so_arm100",
                dry=dry,
                seconds=seconds,
            )


def series_comparisons(sizes: Sizes) -> Iterator[Measurement]:
    """The design of an arm on which a series of 15 harmonics does well, beside Fourier series."""
    for seconds in (10.0,) if sizes.is_quick else (30.0, 60.0):
        name = f"arm of seven hinges, {seconds:g} s"
        yield _of(
            "design_over_series",
            f"design_over_series_{seconds:g}s",
            Line(
                name=f"{name}: worst relative sigma over that of the best series",
                figure="over best series",
                goal=OVER_SERIES,
            ),
            Line(name="that of the design", figure="design"),
            Line(name="that of the best series", figure="series"),
            horizon=SERIES_HORIZON,
            seconds=seconds,
        )


def automatic_derivatives(sizes: Sizes) -> Iterator[Measurement]:
    """Derivatives beside those of MJX by automatic differentiation."""
    names = {
        "psi": ("psi", AUTOMATIC_FIRST),
        "A": ("A", AUTOMATIC_FIRST),
        "B": ("B", AUTOMATIC_FIRST),
        "mixed": ("mixed second derivatives", AUTOMATIC_MIXED),
        "psi_closed": ("psi in closed form", None),
        "mixed_closed": ("mixed second derivatives in closed form", None),
    }
    for model in AUTOMATIC[1:2] if sizes.is_quick else AUTOMATIC:
        yield _of(
            "automatic_derivatives",
            f"automatic_{model}",
            *(
                Line(name=f"{model}: relative error of {name}", figure=figure, goal=goal)
                for figure, (name, goal) in names.items()
            ),
            has_before=False,
            model=model,
        )


def fits(sizes: Sizes) -> Iterator[Measurement]:
    """Fits of a short recording, of a rail, and of an hour."""
    yield _of(
        "short_fit",
        "short_fit",
        Line(name="a fit of 4 s after the start-up", figure="time", unit="s", goal=SHORT),
        Line(name="its engine steps", figure="steps"),
        repeats=3,
    )

    # The goal of the time holds for the whole log.
    seconds = 5.0 if sizes.is_quick else 24.8
    most = None if sizes.is_quick else rail.MOST_SECONDS
    yield _of(
        "rail_fit",
        f"rail_{seconds:g}s",
        Line(name=f"rail, {seconds:g} s: passes", figure="passes", goal=rail.MOST_PASSES),
        Line(name="its engine steps", figure="steps"),
        Line(name="its time of the processors", figure="time", unit="s", goal=most),
        seconds=seconds,
    )

    hours = 0.02 if sizes.is_quick else sizes.hours
    is_whole = hours >= 1.0
    name = f"{hours:g} hours at 1 kHz"
    yield Measurement(
        name=f"hours_{hours:g}",
        run=partial(_hour, hours, sizes.folder),
        lines=(
            Line(
                name=f"{name}: identify, all in",
                figure="time",
                unit="s",
                goal=HOUR if is_whole else None,
                before_there=HOUR_THERE,
            ),
            Line(
                name="its memory",
                figure="memory",
                unit="GiB",
                goal=HOUR_MEMORY if is_whole else None,
            ),
            Line(name="its engine steps", figure="steps"),
        ),
    )


def _hour(hours: float, folder: Path, package: Path) -> Figures:
    """Fit a long recording, which both versions share."""
    log = folder / f"{hours:g}_hours.csv"
    if not log.is_file():
        benchmark_hour.write_hour(hours, 0, log)
    with tempfile.TemporaryDirectory() as results:
        run, estimate = benchmark_hour.fit_hour(log, Path(results) / "out", package)
    return {
        "time": Figure(run.wall, run.processor),
        "memory": Figure(run.gigabytes),
        "steps": Figure(float(estimate["steps"])),
    }


def _of(
    function: str,
    name: str,
    *lines: Line,
    repeats: int = 1,
    has_before: bool = True,
    **arguments: Any,
) -> Measurement:
    """A measurement by a function of `scripts.benchmarks.measurements`."""

    def run(package: Path) -> Figures | None:
        """Measure in a new process."""
        found = measure_in_subprocess(function, package, **arguments)
        return None if found is None else figures_from(found)

    return Measurement(name=name, run=run, lines=lines, repeats=repeats, has_before=has_before)


def figures_from(stored: dict[str, Any]) -> Figures:
    """Figures from their JSON."""
    return {name: Figure(*values) for name, values in stored.items()}


# The parts, in the order of the table.
PARTS = {
    "starts": Part(title="Starts side by side", minutes=(1.0, 0.3), measurements=starts),
    "survey": Part(
        title="Survey of what is identifiable",
        minutes=(1.5, 0.5),
        measurements=surveys,
        absent=absent_arms,
    ),
    "model": Part(
        title="Parses and compilations of a model", minutes=(0.3, 0.3), measurements=model_work
    ),
    "iterations": Part(
        title="Iterations of an arm, and the survey before",
        minutes=(4.0, 2.0),
        measurements=iterations,
        absent=absent_arms,
    ),
    "ratios": Part(
        title="Time of a design over the engine's", minutes=(1.0, 0.3), measurements=ratios
    ),
    "arm_ratios": Part(
        title="Time of an iteration of an arm over the engine's",
        minutes=(3.0, 1.0),
        measurements=arm_ratios,
        absent=absent_arms,
    ),
    "limits": Part(title="Hard limits on a small problem", minutes=(4.0, 0.5), measurements=limits),
    "arms": Part(
        title="Arms under hard limits",
        minutes=(19.0, 1.5),
        measurements=arm_cells,
        absent=absent_arms,
    ),
    "series": Part(
        title="An arm on which Fourier series do well",
        minutes=(9.5, 1.2),
        measurements=series_comparisons,
    ),
    "compare": Part(
        title="Beside baselines at every budget", minutes=(5.0, 1.0), measurements=comparisons
    ),
    "compare_arm": Part(
        title="An arm beside baselines at every budget",
        minutes=(5.0, 0.5),
        measurements=arm_comparisons,
        absent=absent_arms,
    ),
    "identify": Part(title="Fits", minutes=(7.0, 1.0), measurements=fits),
    "start_up": Part(title="Start of the command line", minutes=(1.0, 0.5), measurements=start_ups),
    "oracle": Part(
        title="Derivatives beside automatic differentiation",
        minutes=(5.0, 1.0),
        measurements=automatic_derivatives,
        absent=absent_oracle,
    ),
}


@dataclass(frozen=True, kw_only=True)
class Result:
    """Medians of a measurement with both versions.

    Attributes:
        before: Figures of the earlier commit; None where it failed or was not measured.
        now: Figures of this folder; None where it failed.
    """

    before: Figures | None
    now: Figures | None


@dataclass(frozen=True, kw_only=True)
class Earlier:
    """The earlier version.

    Attributes:
        commit: Hash of its commit.
        folder: Folder of its files.
    """

    commit: str
    folder: Path


def measured(
    measurement: Measurement, earlier: Earlier, kept: Path, say: Callable[[str], None]
) -> Result:
    """Make a measurement with both versions in turn, unless it is kept already.

    Args:
        measurement: The measurement.
        earlier: The earlier version.
        kept: Folder of the results.
        say: Shows a sentence about a run that has failed.
    """
    file = kept / f"{measurement.name}.json"
    settings = {"commit": earlier.commit, "repeats": measurement.repeats}
    versions = ("before", "now") if measurement.has_before else ("now",)
    stored = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    if any(stored.get(name) != value for name, value in settings.items()):
        runs = _runs(measurement, earlier, say)
        stored = {**settings, **runs}

        # A failure may have passed when the measurements go on.
        if all(len(runs[version]) == measurement.repeats for version in versions):
            file.write_text(json.dumps(stored), encoding="utf-8")

    return Result(
        before=medians([figures_from(run) for run in stored["before"]]),
        now=medians([figures_from(run) for run in stored["now"]]),
    )


def _runs(
    measurement: Measurement, earlier: Earlier, say: Callable[[str], None]
) -> dict[str, list[Figures]]:
    """Make the runs of a measurement with both versions in turn; those that fail are left out."""
    runs: dict[str, list[Figures]] = {"before": [], "now": []}
    for _ in range(measurement.repeats):
        for version, package in (("before", earlier.folder), ("now", ROOT)):
            if version == "before" and not measurement.has_before:
                continue
            try:
                found = measurement.run(package)
            except RuntimeError as error:
                say(f"{measurement.name}, {version}: {error}")
                continue
            if found is not None:
                runs[version].append(found)
    return runs


def medians(runs: Sequence[Figures]) -> Figures | None:
    """Medians of all figures of some runs; None if there is no run."""
    if not runs:
        return None

    found: Figures = {}
    for name in runs[0]:
        values = [run[name].value for run in runs]
        times = [run[name].processors for run in runs]
        known = [each for each in times if each is not None]
        processors = statistics.median(known) if known else None
        found[name] = Figure(statistics.median(values), processors)
    return found


def figure_of(line: Line, result: Result, own: Figures | None) -> Figure | None:
    """The figure of a line; None where it was not measured.

    Args:
        line: The line.
        result: Both versions.
        own: Figures of the version that is asked for.
    """
    if own is None:
        return None
    if line.derived is None:
        return own[line.figure]
    return None if result.before is None else line.derived(result.before, own)


def is_found(value: float, line: Line) -> bool:
    """Whether a figure is one.

    Infinity stands for a search that found nothing, and so does zero where larger is better.
    """
    return isfinite(value) and (value != 0.0 or not line.is_larger_better)


def text_of(figure: Figure | None, line: Line) -> str:
    """A figure with its unit, and in parentheses the time of the processors."""
    if figure is None:
        return "failed"

    if not is_found(figure.value, line):
        return "none found"
    if not line.unit:
        return number(figure.value)
    text = f"{figure.value:.3g} {line.unit}"
    return text if figure.processors is None else f"{text} ({figure.processors:.3g})"


def number(value: float) -> str:
    """A number with five digits."""
    return f"{value:,.0f}" if value >= 1e4 else f"{value:.5g}"


def ratio_of(before: Figure | None, now: Figure | None) -> str:
    """The figure now over that before, and in parentheses the same of times of the processors."""
    if before is None or now is None:
        return ""
    if not all(isfinite(each.value) and each.value != 0.0 for each in (before, now)):
        return ""

    text = f"{now.value / before.value:.3g}"
    if before.processors is None or now.processors is None:
        return text
    return f"{text} ({now.processors / before.processors:.3g})"


def verdict(figure: Figure | None, line: Line, before: Figure | None = None) -> str:
    """Whether a figure meets the goal of its line, or how far it is from it; empty without goal.

    Args:
        figure: The figure; None where it was not measured.
        line: The line.
        before: That of the earlier commit on this machine, for a goal that is also a ratio.
    """
    if line.goal is None:
        return ""
    if figure is None or not is_found(figure.value, line):
        return "missed"

    factor = line.goal / figure.value if line.is_larger_better else figure.value / line.goal
    if factor <= 1.0 or line.before_there is None or before is None:
        return _distance(factor)

    # A slower machine takes longer for both versions.
    wanted = line.goal / line.before_there
    relative = _distance(figure.value / before.value / wanted)
    return f"{_distance(factor)}; as a ratio (≤ {wanted:.3g}) {relative}"


def _distance(factor: float) -> str:
    """How far a figure is from its goal, by its ratio to it: at most 1 where it is met."""
    if factor <= 1.0:
        return "met"
    if factor < FACTOR:
        return f"missed by {100.0 * (factor - 1.0):.2g} %"
    return f"missed by a factor {factor:.2g}"


def goal_of(line: Line) -> str:
    """The goal of a line in words."""
    if line.goal is None:
        return ""
    sign = "≥" if line.is_larger_better else "≤"
    return f"{sign} {line.goal:g} {line.unit}".strip()


def empty_table(commit: str) -> Table:
    """The table without lines."""
    table = Table(
        title=f"Before ({commit}) and now, {cores()} cores: medians; in parentheses the time of "
        "the processors",
        title_justify="left",
    )
    table.add_column("line")
    for heading in ("before", "now", "now / before", "goal"):
        table.add_column(heading, justify="right")
    table.add_column("verdict")
    return table


def add_lines(table: Table, measurement: Measurement, result: Result) -> None:
    """Add the lines of a measurement to the table."""
    for line in measurement.lines:
        before = figure_of(line, result, result.before)
        now = figure_of(line, result, result.now)
        table.add_row(
            line.name,
            text_of(before, line) if measurement.has_before else "",
            text_of(now, line),
            ratio_of(before, now),
            goal_of(line),
            verdict(now, line, before),
        )


def fill(table: Table, args: argparse.Namespace, console: Console) -> None:
    """Make all measurements and add their lines to the table.

    Args:
        table: The table.
        args: Options of the command line.
        console: Receives a line for each measurement.
    """
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        earlier = Earlier(
            folder=stack.enter_context(earlier_checkout(args.before)),
            commit=commit_hash(args.before),
        )
        kept = args.results or folder / "results"
        kept.mkdir(parents=True, exist_ok=True)

        # Messages of errors may contain square brackets, which are no markup.
        say = partial(console.print, markup=False)
        sizes = Sizes(is_quick=args.quick, hours=args.hours, folder=folder)
        for name in args.only:
            table.add_section()
            absent = PARTS[name].absent()
            if absent:
                say(f"{PARTS[name].title}: {absent}.")
                table.add_row(PARTS[name].title, "", "", "", "", "not measured")
                continue
            for measurement in PARTS[name].measurements(sizes):
                console.print(f"{PARTS[name].title}: {measurement.name} ...", style="dim")
                result = measured(measurement, earlier, kept, say)
                add_lines(table, measurement, result)


def parts_in_words() -> str:
    """The parts with their times, for the help."""
    lines = ["parts, with the minutes expected on two idle cores (quick):"]
    for name, part in PARTS.items():
        whole, quick = part.minutes
        lines.append(f"  {name:12s} {whole:4g} ({quick:g})   {part.title}")
    return "\n".join(lines)


def main() -> int:
    """Make the measurements and print the table, also after Ctrl-C; 130 after Ctrl-C."""
    parser = argparse.ArgumentParser(
        description=__doc__,
        epilog=parts_in_words(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--before", default=BEFORE, metavar="COMMIT", help="the earlier commit")
    parser.add_argument(
        "--only", nargs="+", choices=list(PARTS), default=list(PARTS), metavar="PART"
    )
    parser.add_argument("--quick", action="store_true", help="short measurements")
    parser.add_argument("--hours", type=float, default=1.0, help="duration of the long recording")
    parser.add_argument("--results", type=Path, help="folder in which the measurements are kept")
    parser.add_argument("--markdown", type=Path, help="also write the table as Markdown")
    args = parser.parse_args()

    console = Console(highlight=False, width=150)
    load = os.getloadavg()[0]
    if load > BUSY * cores():
        console.print(
            f"Other programs keep {load:.1f} of {cores()} cores busy: wall times are longer than "
            "on an idle machine."
        )

    code = 0
    table = empty_table(args.before)
    try:
        fill(table, args, console)
    except KeyboardInterrupt:
        code = 130

    console.print(table)
    console.print(Markdown(TRIED.read_text(encoding="utf-8")))
    if args.markdown:
        args.markdown.write_text(benchmark.markdown([table], {}, cores()), encoding="utf-8")
    return code


if __name__ == "__main__":
    raise SystemExit(main())
