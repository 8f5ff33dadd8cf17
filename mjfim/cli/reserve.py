"""A design with a reserve to its limits, for `mjfim robustness`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import mjfim
from mjfim.cli.common import (
    errors,
    keep_result,
    progress,
)
from mjfim.cli.executors import MAX_PARTS, started_if_stated
from mjfim.errors import ExperimentError, unknown
from mjfim.excitation.design import design_budget, design_task
from mjfim.excitation.task import DesignTask
from mjfim.model.limited_elements import KINDS as LIMIT_KINDS
from mjfim.output.archive import write_design
from mjfim.parallel.budget import stop_on_interrupt
from mjfim.parallel.stated import StatedExecutor

# Kinds of limits from which a design can keep a reserve.
KINDS = (*LIMIT_KINDS, "clearance")


def parse_reserve(words: Sequence[str]) -> dict[str, float]:
    """Read the reserves of a design from the command line.

    Args:
        words: Reserves, each as `KIND=SHARE`.

    Returns:
        Reserve by kind of limit, as a fraction of half a range.

    Raises:
        ExperimentError: A kind is unknown, or a reserve is not a number from 0 to 1.
    """
    shares = {}
    for word in words:
        kind, _, text = word.partition("=")
        if kind not in KINDS:
            raise ExperimentError(f"--reserve: {unknown('kind of limit', kind, KINDS)}")

        try:
            shares[kind] = float(text)
        except ValueError:
            raise ExperimentError(
                f"--reserve: {word!r}: expected a number, as in {kind}=0.2"
            ) from None

        if not 0.0 <= shares[kind] < 1.0:
            raise ExperimentError(
                f"--reserve: {word!r}: expected a fraction of half the range, at least 0 and "
                "below 1"
            )
    return shares


def tightened(experiment: mjfim.Experiment, reserve: Mapping[str, float]) -> mjfim.Experiment:
    """Return the experiment with tighter limits.

    Args:
        experiment: The experiment.
        reserve: Distance by which limits become tighter, by kind of limit, as a fraction of half a
            range; for a clearance, as a fraction of it.

    Returns:
        The changed experiment.
    """
    tables: dict[str, dict[str, tuple[float, float]]] = {}
    for limit in DesignTask.resolve(experiment).limits:
        if reserve.get(limit.kind):
            inner = reserve[limit.kind] * limit.scale
            table = tables.setdefault(limit.kind, {})
            lower = 0.0 if limit.is_magnitude else limit.lower + inner
            table[limit.name] = (lower, limit.upper - inner)

    clearance = experiment.limits.clearance
    if clearance is None:
        return experiment.replace(limits=tables)

    wider = clearance * (1.0 + reserve.get("clearance", 0.0))
    return experiment.replace(limits={**tables, "clearance": wider})


def design_with_reserve(
    experiment: mjfim.Experiment,
    reserve: Mapping[str, float],
    folder: Path,
    place: StatedExecutor,
) -> Path:
    """Design with a reserve to the limits, write the design, and print its status and margins.

    Args:
        experiment: The experiment.
        reserve: Reserve by kind of limit, as a fraction of half a range.
        folder: Folder for the design.
        place: Where the design is made.

    Returns:
        The folder.
    """
    task = DesignTask.resolve(tightened(experiment, reserve))
    with (
        started_if_stated(place, MAX_PARTS) as workers,
        progress("designing") as show,
        stop_on_interrupt() as stop,
    ):
        budget = design_budget(task, stop)
        design = design_task(task, callback=show, executor=workers, budget=budget)

    write_design(folder, design, task.system)
    keep_result(folder)
    margins = ", ".join(f"{kind} {margin:.3g}" for kind, margin in design.limits.items())
    errors.print(f"designed in {design.seconds:.0f} s: {design.outcome}", markup=False)
    errors.print(f"margins to the tightened limits: {margins}", markup=False)
    for warning in design.warnings:
        errors.print(f"warning: {warning}", markup=False)
    return folder
