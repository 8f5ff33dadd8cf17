"""Memory that work on recordings needs, estimated before it begins."""

from __future__ import annotations

from collections.abc import Sequence

from mjfim.experiment.system import System
from mjfim.identification.segments import free_release
from mjfim.memory import NUMBER_BYTES, require_memory
from mjfim.plant.rollout_derivatives import MAX_NUMBERS_AT_ONCE
from mjfim.records.trajectory import Recording

# Peak of a block of simulations over the numbers of its states, as measured: in a fit, which tests
# its residuals, and in a check.
FIT_COPIES = 15
CHECK_COPIES = 5

# Copies of every recorded number, as measured: read, aligned, predicted, and parts of them while
# residuals are tested.
RECORDED_COPIES = 5


def require_memory_for_recordings(
    system: System,
    recordings: Sequence[Recording],
    *,
    fit: bool,
    available: float | None = None,
) -> None:
    """Refuse recordings whose fit or check does not fit into memory.

    Args:
        system: The system.
        recordings: The recordings.
        fit: True for a fit, False for a check.
        available: Memory that is there [bytes]; None for that of this machine.

    Raises:
        ExperimentError: The memory is too small.
    """
    rows = sum(len(recording.t) for recording in recordings)
    needed = recordings_bytes(system, rows, fit=fit)
    require_memory(
        needed / NUMBER_BYTES, f"recordings of {rows:,} rows in all", available=available
    )


def recordings_bytes(system: System, rows: int, *, fit: bool) -> float:
    """Estimate the peak of the memory of a fit or a check, besides that of the libraries.

    Args:
        system: The system.
        rows: Number of rows of all recordings.
        fit: True for a fit, False for a check.

    Returns:
        The memory [bytes].
    """
    settings = system.experiment.fit
    directions = len(system.parameters)
    is_free = settings.start != "stated" or settings.segment_length is not None
    if is_free or free_release(system):
        directions += system.space.nx

    # The simulations are divided into blocks.
    state = 1 + system.nominal_initial_state.size
    simulated = float(rows) * (1 + 2 * directions) * system.grid.substeps * state
    block = min(simulated, MAX_NUMBERS_AT_ONCE)

    recorded = float(rows) * (1 + len(system.outputs) + len(system.inputs))
    copies = FIT_COPIES if fit else CHECK_COPIES
    return NUMBER_BYTES * (copies * block + RECORDED_COPIES * recorded)
