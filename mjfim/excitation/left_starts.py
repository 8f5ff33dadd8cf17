"""Initial controls for which there was no time."""

from __future__ import annotations

from collections.abc import Sequence

from mjfim.errors import listed
from mjfim.excitation.initial_controls import InitialControl
from mjfim.excitation.run_result import RunResult
from mjfim.excitation.task import DesignTask


def starts_without_time(
    task: DesignTask, starts: Sequence[InitialControl], results: Sequence[RunResult]
) -> tuple[str, ...]:
    """Say which initial controls were left out, because the time was too short for them.

    Args:
        task: The task.
        starts: The initial controls.
        results: Results of those that were begun.

    Returns:
        A sentence; none where all of them were begun.
    """
    begun = {result.name for result in results}
    left = [start.name for start in starts if start.name not in begun]
    seconds = task.experiment.descent.seconds
    if not left or not begun or seconds is None:
        return ()

    return (
        f"{len(left)} of {len(starts)} initial controls were left out ({listed(left)}), because "
        f"{seconds:g} s are too short to optimise from all of them; for more of them, raise "
        "descent.seconds or use more workers",
    )
