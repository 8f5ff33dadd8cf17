"""The benchmark of many recordings tells the memory of workers apart from that of their caller."""

from __future__ import annotations

from io import StringIO
from typing import Any

import pytest
from rich.console import Console

from scripts.benchmarks import scale_recordings


def run_with(worker: float, caller: float) -> dict[str, Any]:
    """What was measured with workers, for these memories [GiB]."""
    return {
        "theta": [],
        "steps": 2_000_000,
        "seconds": 30.0,
        "cpu": 11.0,
        "caller": caller,
        "worker": worker,
    }


@pytest.mark.parametrize(
    ("worker", "caller", "is_met"), [(0.16, 3.0, True), (1.0, 0.2, True), (1.01, 0.2, False)]
)
def test_the_limit_is_that_of_the_workers(worker: float, caller: float, is_met: bool) -> None:
    run = run_with(worker, caller)
    assert scale_recordings.is_within_memory(run) is is_met
    said = scale_recordings.memory_in_words(run)
    assert f"{worker:.2f} GiB" in said
    assert f"caller {caller:.2f} GiB" in said
    assert ("MISSED" in said) is not is_met


def test_the_table_shows_both_memories() -> None:
    written = StringIO()
    table = scale_recordings.table_of({"2 workers": run_with(0.16, 0.21)}, 2_400_000, 5e-6)
    Console(file=written, width=140).print(table)
    assert "0.0024 GB" in written.getvalue()
    (row,) = (line for line in written.getvalue().splitlines() if "2 workers" in line)
    cells = [cell.strip() for cell in row.strip("│").split("│")]
    assert cells[-2:] == ["0.21 GiB", "0.16 GiB"]
    assert cells[4] == "1.10"
