"""All formats give equal columns; damaged files, decompression bombs and pickles are refused with
one sentence.
"""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
import pyarrow.csv
import pyarrow.parquet
import pytest
import scipy.io
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from mjfim.errors import RecordingError
from mjfim.recordings.formats import Table, read_columns
from mjfim.recordings.section import RecordingSpec

Array = NDArray[np.float64]
Columns = dict[str, Array]

ALL = RecordingSpec()
ROWS = 50


@pytest.fixture
def columns() -> Columns:
    """Three columns of numbers, one with empty fields, one of all sizes."""
    rng = np.random.default_rng(2)
    q = rng.standard_normal(ROWS)
    q[7:12] = np.nan
    return {
        "t": np.arange(ROWS) * 0.01,
        "q": q,
        "u": rng.standard_normal(ROWS) * 10.0 ** np.arange(-25, 25),
    }


def as_csv(path: Path, columns: Columns) -> None:
    """Write a CSV file with empty fields for NaN."""
    pyarrow.csv.write_csv(arrow_table(columns), path)


def as_gzip(path: Path, columns: Columns) -> None:
    """Write a CSV file that is packed by gzip."""
    as_csv(path, columns)
    path.write_bytes(gzip.compress(path.read_bytes()))


def arrow_table(columns: Columns) -> Any:
    """A table with nulls for NaN."""
    return pyarrow.table({n: pyarrow.array(c, from_pandas=True) for n, c in columns.items()})


def as_parquet(path: Path, columns: Columns) -> None:
    """Write a Parquet file."""
    pyarrow.parquet.write_table(arrow_table(columns), path)


def as_npz(path: Path, columns: Columns) -> None:
    """Write an archive with one array per column."""
    np.savez_compressed(path, **columns)


def records_of(columns: Columns) -> list[dict[str, Any]]:
    """One object for each row, with null for NaN."""
    rows = zip(*(c.tolist() for c in columns.values()), strict=True)
    return [{n: None if v != v else v for n, v in zip(columns, row, strict=True)} for row in rows]


def as_json(path: Path, columns: Columns) -> None:
    """Write a JSON list of records."""
    path.write_text(json.dumps(records_of(columns)), encoding="utf-8")


def as_json_lines(path: Path, columns: Columns) -> None:
    """Write one JSON object a line."""
    path.write_text("\n".join(map(json.dumps, records_of(columns))), encoding="utf-8")


def as_npy(path: Path, columns: Columns) -> None:
    """Write one array with fields."""
    np.save(path, np.rec.fromarrays([*columns.values()], names=[*columns]))


def as_mat(path: Path, columns: Columns) -> None:
    """Write a MATLAB file of vectors."""
    scipy.io.savemat(path, columns, do_compression=True)


WRITERS = {
    ".csv": as_csv,
    ".csv.gz": as_gzip,
    ".parquet": as_parquet,
    ".npz": as_npz,
    ".json": as_json,
    ".jsonl": as_json_lines,
    ".npy": as_npy,
    ".mat": as_mat,
}
formats = pytest.mark.parametrize("ending", WRITERS)


@formats
def test_formats_agree(ending: str, columns: Columns, tmp_path: Path) -> None:
    """The columns are equal bit for bit in float64."""
    path = tmp_path / f"log{ending}"
    WRITERS[ending](path, columns)
    table = read_columns(path, ALL)
    assert set(table.names) == set(columns)
    for name, column in columns.items():
        found = table.column(name)
        assert found.dtype == np.float64 and np.array_equal(found, column, equal_nan=True)


@formats
def test_truncated_files(ending: str, columns: Columns, tmp_path: Path) -> None:
    path = tmp_path / f"log{ending}"
    WRITERS[ending](path, columns)
    whole = path.read_bytes()
    middle = len(whole) // 2
    cuts = [whole.index(b",", middle)] if ending == ".csv" else [middle, len(whole) - 8]
    for cut in cuts:
        path.write_bytes(whole[:cut])
        with pytest.raises(
            RecordingError, match=rf"log\{ending}: not (a )?(readable|log)"
        ) as refused:
            read_columns(path, ALL)
        assert "\n" not in str(refused.value)


@formats
def test_damaged_files(ending: str, columns: Columns, tmp_path: Path) -> None:
    """Overwritten bytes cause no other error than RecordingError, whose message is one line."""
    path = tmp_path / f"log{ending}"
    WRITERS[ending](path, columns)
    whole, rng, said = path.read_bytes(), np.random.default_rng(3), list[str]()
    for _ in range(100):
        damaged = bytearray(whole)
        for at in rng.integers(0, len(whole), 4).tolist():
            damaged[at] = int(rng.integers(256))
        path.write_bytes(bytes(damaged))
        try:
            read_columns(path, ALL)
        except RecordingError as error:
            said.append(str(error))
    assert len(said) > 20
    assert "\n" not in "".join(said)


@formats
def test_empty_files(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"log{ending}"
    path.touch()
    with pytest.raises(RecordingError, match="the file is empty"):
        read_columns(path, ALL)


def test_unknown_endings(tmp_path: Path) -> None:
    (tmp_path / "log.xlsx").write_text("x", encoding="utf-8")
    with pytest.raises(
        RecordingError,
        match=r"log\.xlsx: unknown format.*\.csv, \.csv\.gz, \.parquet, \.npz, \.json",
    ):
        read_columns(tmp_path / "log.xlsx", ALL)
    with pytest.raises(RecordingError, match=r"gone\.csv: no such file"):
        read_columns(tmp_path / "gone.csv", ALL)
    with pytest.raises(RecordingError, match=r"is not a ROS 2 bag"):
        read_columns(tmp_path, ALL)


# ---- CSV and Parquet


def test_text_is_a_fault_only_if_it_is_used(tmp_path: Path) -> None:
    path = tmp_path / "log.csv"
    path.write_text(
        "t,mode,q,big,odd\n0,idle,1.5,1700000000000000123,1\n0.1,run,,1700000000000000124,abc\n",
        encoding="utf-8",
    )
    table = read_columns(path, ALL)
    assert np.array_equal(table.column("q"), [1.5, np.nan], equal_nan=True)
    assert table.column("big")[0] == 1.7e18
    with pytest.raises(RecordingError, match=r"log\.csv: column 'mode' is not numeric"):
        table.column("mode")
    with pytest.raises(RecordingError, match=r"'odd' is not numeric: row 2 holds 'abc'$"):
        table.column("odd")


def test_parquet_columns_of_one_name(tmp_path: Path) -> None:
    """It is not clear which of the columns is meant, so the file is refused."""
    twice = pyarrow.table([[0.0, 1.0], [1.0, 2.0], [3.0, 4.0]], names=["t", "q", "q"])
    pyarrow.parquet.write_table(twice, tmp_path / "log.parquet")
    for spec in (ALL, RecordingSpec(columns={"qpos:j": "q", "ctrl:m": "t"})):
        with pytest.raises(RecordingError, match=r"log\.parquet: more than one column .* 'q'"):
            read_columns(tmp_path / "log.parquet", spec)


def test_parquet_dictionaries(tmp_path: Path) -> None:
    """A dictionary of numbers gives its numbers; one of text is refused, also of digits."""
    contents = {
        "t": pyarrow.array([0.0, 1.0, 2.0]),
        "q": pyarrow.array([7.5, None, -2.0]).dictionary_encode(),
        "text": pyarrow.array(["1", "2", "1"]).dictionary_encode(),
        "view": pyarrow.array(["1", "2", "1"]).cast(pyarrow.string_view()),
        "bytes": pyarrow.array([b"1", b"2", b"1"]),
        "on": pyarrow.array([True, False, True]).dictionary_encode(),
    }
    pyarrow.parquet.write_table(pyarrow.table(contents), tmp_path / "log.parquet")
    table = read_columns(tmp_path / "log.parquet", ALL)

    assert np.array_equal(table.column("q"), [7.5, np.nan, -2.0], equal_nan=True)
    with pytest.raises(RecordingError, match="holds truth values"):
        table.measurement("on")
    for name in ("text", "view", "bytes"):
        with pytest.raises(RecordingError, match=f"column '{name}' is not numeric"):
            table.column(name)


@pytest.mark.parametrize("ending", [".csv", ".parquet", ".npz", ".json"])
def test_truth_values_are_no_measurement(ending: str, tmp_path: Path) -> None:
    """They are 1 and 0 for a control or a factor, but neither a time nor a measured column."""
    path = tmp_path / f"log{ending}"
    columns = {"t": np.array([0.0, 0.1, 0.2]), "q": np.array([True, False, True])}
    WRITERS[ending](path, columns)
    table = read_columns(path, ALL)

    assert table.measurement("t").tolist() == [0.0, 0.1, 0.2]
    assert table.column("q").tolist() == [1.0, 0.0, 1.0]
    with pytest.raises(RecordingError, match=rf"log\{ending}: column 'q' holds truth values"):
        table.measurement("q")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"t,q,q\n0,1,2\n", "more than one column is named 'q'"),
        (b"t,q\n0,1\n1\n", "not a readable CSV table: .*Expected 2 columns, got 1"),
        (b"t,q\xff\n0,1\n", "not a readable CSV table"),
    ],
)
@pytest.mark.parametrize("ending", [".csv", ".csv.gz"])
def test_ill_formed_csv(ending: str, content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / f"log{ending}"
    path.write_bytes(gzip.compress(content, mtime=0) if ending == ".csv.gz" else content)
    with pytest.raises(RecordingError, match=message):
        read_columns(path, ALL)


@pytest.mark.parametrize("content", [gzip.compress(b"t,q\n0,1\n", mtime=0) + b"more", b"t,q\n"])
def test_what_is_not_packed_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "log.csv.gz"
    path.write_bytes(content)
    with pytest.raises(RecordingError, match="Not a gzipped file"):
        read_columns(path, ALL)


# ---- npz


def test_single_array_instead_of_an_archive(tmp_path: Path) -> None:
    with (tmp_path / "log.npz").open("wb") as stream:
        np.save(stream, np.arange(3.0))
    with pytest.raises(
        RecordingError, match=r"log\.npz: not a log archive \(npz of named arrays .*numpy\.savez"
    ):
        read_columns(tmp_path / "log.npz", ALL)


def test_pickles_are_not_loaded(tmp_path: Path) -> None:
    """An array of pickled objects is refused whether it is needed or not."""
    np.savez(tmp_path / "log.npz", t=np.arange(3.0), q=np.array([{}], dtype=object))
    for spec in (ALL, RecordingSpec(columns={"qpos:j": "t", "ctrl:m": "t"})):
        with pytest.raises(RecordingError, match=r"log\.npz: not a log archive .*without pickles"):
            read_columns(tmp_path / "log.npz", spec)


def test_matrices_become_columns(tmp_path: Path) -> None:
    """A matrix gives columns `name[i]`; a control may lack the last row; a number holds for all
    rows; cubes are ignored.
    """
    q = np.arange(8.0).reshape(4, 2)
    np.savez(
        tmp_path / "log.npz", t=np.arange(4.0), qpos=q, ctrl=q[:3], kp=2.5, gain=np.zeros((3, 2, 2))
    )
    table = read_columns(tmp_path / "log.npz", ALL)
    assert table.names == ("t", "qpos[0]", "qpos[1]", "ctrl[0]", "ctrl[1]", "kp")
    assert table.column("qpos[1]").tolist() == [1.0, 3.0, 5.0, 7.0]
    assert np.array_equal(table.column("ctrl[0]"), [0.0, 2.0, 4.0, np.nan], equal_nan=True)
    assert table.column("kp").tolist() == [2.5] * 4


def test_arrays_of_other_lengths(tmp_path: Path) -> None:
    """Only a control may lack the last row, whatever its name in the log is."""
    np.savez(
        tmp_path / "log.npz",
        t=np.arange(4.0),
        q=np.zeros(3),
        u=np.zeros(3),
        name=np.array(list("abcd")),
    )
    table = read_columns(
        tmp_path / "log.npz", RecordingSpec(columns={"qpos:j": "q", "ctrl:m": "u"})
    )
    assert np.isnan(table.column("u")[-1])
    with pytest.raises(RecordingError, match=r"column 'q' has 3 rows, but 't' has 4"):
        table.column("q")
    with pytest.raises(RecordingError, match=r"column 'name' is not numeric"):
        table.column("name")


# ---- JSON


def read_json(content: object, tmp_path: Path, spec: RecordingSpec = ALL) -> Table:
    """Write content as JSON and read its columns."""
    (tmp_path / "log.json").write_text(json.dumps(content), encoding="utf-8")
    return read_columns(tmp_path / "log.json", spec)


def test_json_records(tmp_path: Path) -> None:
    """Constants, booleans, nested objects and lists become columns; a field that a record lacks is
    empty.
    """
    content = {
        "kp": 100,
        "motor": {"kt": 0.3, "name": "xl"},
        "t": 7,
        "entries": [
            {"t": 0.0, "on": True, "joint": {"q": 1.5}, "imu": [1, 2]},
            {"t": 0.1, "on": False, "joint": {"q": None}, "imu": [3, 4], "late": 5, "note": "x"},
        ],
    }
    table = read_json(content, tmp_path)
    expected = {
        "kp": [100, 100],
        "motor.kt": [0.3, 0.3],
        "t": [0, 0.1],
        "on": [1, 0],
        "joint.q": [1.5, np.nan],
        "imu[0]": [1, 3],
        "imu[1]": [2, 4],
        "late": [np.nan, 5],
    }
    assert set(table.names) == {*expected, "motor.name", "note"}
    for name, values in expected.items():
        assert_array_equal(table.column(name), values)
    with pytest.raises(RecordingError, match="row 2 holds 'x'"):
        table.column("note")


def test_json_with_several_lists_of_records(tmp_path: Path) -> None:
    """The experiment file must select one of several lists of records, by a path that exists."""
    content = {"k": 1, "a": {"gain": 2, "left": [{"t": 0}], "right": [{"t": 1}, {"t": 2}]}}
    said = r"several lists of records: a\.left, a\.right; .*recording\.records"
    with pytest.raises(RecordingError, match=said):
        read_json(content, tmp_path)
    table = read_json(content, tmp_path, RecordingSpec(records="a.right"))
    found = {name: table.column(name).tolist() for name in table.names}
    assert found == {"t": [1, 2], "k": [1, 1], "a.gain": [2, 2]}
    for wrong in ("a.rigth", "k.right", "k"):
        said = rf"recording\.records: .*'{wrong}'.*a\.left, a\.right"
        with pytest.raises(RecordingError, match=said):
            read_json(content, tmp_path, RecordingSpec(records=wrong))


def test_json_lists(tmp_path: Path) -> None:
    table = read_json(
        {"t": [0, 1, 2], "q": [1, None, 3], "short": [1, 2], "k": 4, "s": ["a", 1, 2]}, tmp_path
    )
    assert np.array_equal(table.column("q"), [1, np.nan, 3], equal_nan=True)
    assert table.column("k").tolist() == [4, 4, 4]
    with pytest.raises(RecordingError, match=r"column 'short' has 2 rows, but 't' has 3"):
        table.column("short")
    with pytest.raises(RecordingError, match=r"column 's' is not numeric"):
        table.column("s")
    ragged = read_json([{"t": 0, "q": [1, 2]}, {"t": 1, "q": [1]}], tmp_path)
    with pytest.raises(RecordingError, match=r"column 'q\[0\]' is ragged: row 2 does not have 2"):
        ragged.column("q[0]")


@pytest.mark.parametrize("content", [3, [], [1, 2], {"a": 1}, {}, "text", None])
def test_json_without_records(content: object, tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match=r"log\.json: holds no list of records"):
        read_json(content, tmp_path)
