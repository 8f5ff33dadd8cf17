"""Control tables are held from row to row."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest

from mjfim.arrays import Array
from mjfim.errors import RecordingError
from mjfim.output.archive import write_table
from mjfim.recordings.delimited import read_control

Read = Callable[..., Array]


@pytest.fixture
def read(tmp_path: Path) -> Read:
    """Write columns as CSV and read the control back on a grid of period dt."""

    def run(
        columns: Mapping[str, object], N: int, dt: float, names: tuple[str, ...] = ("u",)
    ) -> Array:
        path = tmp_path / "table.csv"
        write_table(path, {name: np.asarray(values) for name, values in columns.items()})
        return read_control(path, np.arange(N) * dt, dt, names)

    return run


def test_a_sample_has_the_value_of_the_row_at_its_time(read: Read) -> None:
    """The last row is held for one period, and round-off such as 0.1 + 0.2 shifts no sample."""
    u = read({"t": [0.0, 0.1, 0.2], "u": [1.0, -2.0, 5.0]}, 30, 0.01)
    assert u.tolist() == [[1.0]] * 10 + [[-2.0]] * 10 + [[5.0]] * 10
    t = np.arange(41) * 0.0025
    assert read({"t": t, "u": t**2}, 10, 0.01)[:, 0].tolist() == (t[:40:4] ** 2).tolist()
    t = np.cumsum(np.full(300, 0.01)) - 0.01
    for stamps in (t, np.round(t, 4)):
        u = read({"t": stamps, "u": np.arange(300.0)}, 300, 0.01)
        assert u[:, 0].tolist() == list(range(300))


def test_columns_are_found_by_name(read: Read) -> None:
    """The order of columns is free; `ctrl:` before the name is accepted."""
    t = [0.0, 0.5, 1.0]
    for kind in ("", "ctrl:"):
        columns = {f"{kind}right": [1.0, 2.0, 3.0], "t": t, f"{kind}left": [4.0, 5.0, 6.0]}
        assert read(columns, 10, 0.1, ("left", "right"))[0].tolist() == [4.0, 1.0]


def test_a_design_table_is_a_control_table(read: Read) -> None:
    """design.csv has states beside the controls, and no control in its last row only."""
    nan = float("nan")
    u = read({"t": [0.0, 0.1, 0.2], "qpos:j": [0.0, 1.0, 2.0], "ctrl:u": [3.0, 4.0, nan]}, 2, 0.1)
    assert u.tolist() == [[3.0], [4.0]]
    with pytest.raises(RecordingError, match="row 2"):
        read({"t": [0.0, 0.1, 0.2, 0.3], "ctrl:u": [3.0, nan, 4.0, nan]}, 3, 0.1)


def test_table_must_cover_the_horizon(read: Read) -> None:
    """A row is held for one period, no longer."""
    columns = {"t": [0.0, 0.1, 0.2], "u": [1.0, 2.0, 3.0]}
    assert len(read(columns, 30, 0.01)) == 30
    with pytest.raises(RecordingError, match="too few rows"):
        read(columns, 31, 0.01)


def test_another_format_is_refused_by_its_name(tmp_path: Path) -> None:
    """The bytes of an archive are no part of a message."""
    path = tmp_path / "design.npz"
    np.savez(path, ctrl=np.zeros((3, 1)))
    with pytest.raises(RecordingError, match=r"design\.npz: not a CSV table; .* design\.csv$"):
        read_control(path, np.zeros(1), 0.1, ("u",))
