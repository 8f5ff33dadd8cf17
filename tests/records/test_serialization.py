"""Records are saved and loaded without loss, and files that cannot be loaded are refused with one
clear message.
"""

from __future__ import annotations

import dataclasses
import io
import json
import shutil
import zipfile
from collections.abc import Callable
from dataclasses import replace
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import numpy as np
import pytest

from mjfim import files
from mjfim.errors import RecordingError
from mjfim.files import as_json
from mjfim.records.base import RECORD, SavedRecord
from mjfim.records.campaign import Campaign
from mjfim.records.check import Check
from mjfim.records.design import Design, Evaluation
from mjfim.records.estimate import Estimate, PredictionErrors
from mjfim.records.rehearsal import Rehearsal
from mjfim.records.robots import RobotComparison
from mjfim.records.studies import Comparison, MonteCarloStudy
from mjfim.records.trajectory import Recording, Trajectory
from mjfim.records.worth import Worth
from tests.support import results

SAVED: tuple[type[SavedRecord], ...] = (
    Campaign,
    Check,
    Comparison,
    Design,
    Estimate,
    Evaluation,
    MonteCarloStudy,
    PredictionErrors,
    Recording,
    Rehearsal,
    RobotComparison,
    Trajectory,
    Worth,
)


def saved_fields(record: Any) -> list[str]:
    """Names of the fields that the files of a record hold."""
    return [each.name for each in dataclasses.fields(record) if each.metadata.get("saved", True)]


def canonical(value: Any) -> Any:
    """Types and values of a record, field by field; arrays and numbers bit by bit."""
    if isinstance(value, np.ndarray):
        return value.dtype.str, value.shape, value.tobytes()
    if dataclasses.is_dataclass(value):
        fields = {name: canonical(getattr(value, name)) for name in saved_fields(value)}
        return type(value), fields
    if isinstance(value, tuple):
        return tuple(map(canonical, value))
    if isinstance(value, dict):
        return [(key, canonical(entry)) for key, entry in value.items()]
    return type(value), repr(value)


def assert_same(left: Any, right: Any) -> None:
    """Compare two records."""
    assert canonical(left) == canonical(right)


# ---- values that files spoil easily

NUMBERS = (
    float("inf"),
    float("-inf"),
    float("nan"),
    -0.0,
    5e-324,
    0.1 + 0.2,
    1.7976931348623157e308,
)
TEXTS = (
    "",
    "Gelenk-Nullpunkt für „α₁“ 😀",
    'a "quoted" \\ name\n',
    "null",
    "inf",
    "../x/y",
    "final.gain",
)


class AwkwardValues:
    """Builds a value of any type that records have, from numbers and texts that are easily lost."""

    def __init__(self, count: int, optional: bool) -> None:
        """Build tuples, dictionaries and arrays with `count` entries; optional values are present
        or None.
        """
        self.count, self.optional, self._turn = count, optional, 0

    def next_of(self, values: Any) -> Any:
        """Return the values in turn."""
        self._turn += 1
        return values[self._turn % len(values)]

    def build(self, hint: Any) -> Any:
        """Return a value of a type."""
        origin = get_origin(hint)
        if origin in (Union, UnionType):
            inner = next(entry for entry in get_args(hint) if entry is not NoneType)
            is_given = self.optional or NoneType not in get_args(hint)
            return self.build(inner) if is_given else None
        if origin is np.ndarray:
            shape = (self.count, self.next_of((1, 2, 3)))
            return np.resize(NUMBERS, shape)
        if origin is tuple:
            entries = get_args(hint)
            if entries[-1] is Ellipsis:
                entries = entries[:1] * self.count
            return tuple(self.build(entry) for entry in entries)
        if origin is dict:
            return {
                f"{text}{i}": self.build(get_args(hint)[1])
                for i, text in enumerate(TEXTS[: self.count])
            }
        if dataclasses.is_dataclass(hint):
            hints = get_type_hints(hint)
            return hint(**{name: self.build(hints[name]) for name in saved_fields(hint)})
        if issubclass(hint, Enum):
            return self.next_of(list(hint))
        return self.next_of(
            {bool: (True, False), int: (0, 7, 2**60), float: NUMBERS, str: TEXTS}[hint]
        )


@pytest.mark.parametrize("kind", SAVED, ids=lambda kind: kind.__name__)
@pytest.mark.parametrize(("count", "optional"), [(0, False), (1, True), (2, False), (3, True)])
def test_awkward_values_survive(
    kind: type[SavedRecord], count: int, optional: bool, tmp_path: Path
) -> None:
    """Infinity, NaN, negative zero, empty tuples, names with quotes and dots, and every optional
    field.
    """
    record = AwkwardValues(count, optional).build(kind)
    record.save_archive(tmp_path / "new" / "folder")
    assert_same(kind.load(tmp_path / "new" / "folder"), record)


# ---- results of verbs


def round_trip(record: SavedRecord, folder: Path) -> None:
    """Save and load a record, by folder and by each of its files."""
    record.save(folder)
    stem = record.file_stem
    assert {path.name for path in folder.iterdir()} == {f"{stem}.json", f"{stem}.npz"}
    for path in (folder, str(folder), folder / f"{stem}.json", folder / f"{stem}.npz"):
        assert_same(type(record).load(path), record)
    loaded = type(record).load(folder)
    assert_same(record.as_saved(), loaded)
    assert as_json(loaded.summary()) == as_json(record.summary())
    assert (folder / f"{stem}.json").read_text(encoding="utf-8") == as_json(record.summary())


@pytest.mark.parametrize("verb", results.MAKERS)
def test_a_result_is_loaded_as_it_was(verb: str, tmp_path: Path) -> None:
    """Where it is printed, it is a few short lines."""
    record = results.MAKERS[verb]()
    round_trip(record, tmp_path)
    lines = repr(record).splitlines()
    assert lines[0] == f"{type(record).__name__}("
    assert max(map(len, lines)) < 100 and len(lines) <= 60


def test_a_design_that_ends_where_it_began_has_all_arrays(tmp_path: Path) -> None:
    design = results.design()
    replace(design, final=design.initial).save(tmp_path)
    assert not Design.load(tmp_path).theta.flags.writeable
    with np.load(tmp_path / "design.npz") as arrays:
        for name in ("t", "qpos", "qvel", "act", "ctrl", "gain", "sensitivity"):
            assert np.array_equal(arrays[name], arrays[f"initial_{name}"])


def test_large_arrays_are_not_compressed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Noise can hardly be compressed, and the record is the same."""
    monkeypatch.setattr(files, "MAX_COMPRESSED_BYTES", 1000)
    round_trip(results.estimate(), tmp_path)
    with zipfile.ZipFile(tmp_path / "estimate.npz") as stored:
        assert all(member.compress_type == zipfile.ZIP_STORED for member in stored.infolist())


# ---- files that cannot be loaded


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """Folder of a saved design."""
    results.design().save(tmp_path / "saved")
    return tmp_path / "saved"


def rewritten(path: Path, change: Callable[[dict[str, np.ndarray]], object]) -> None:
    """Change the arrays of an npz file."""
    with np.load(path, allow_pickle=False) as archived:
        arrays = {name: archived[name] for name in archived.files}
    change(arrays)
    np.savez(path, **arrays)


def with_content(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the record's plain values in an npz file."""

    def apply(arrays: dict[str, np.ndarray]) -> None:
        content = json.loads(str(arrays[RECORD]))
        change(content)
        arrays[RECORD] = np.array(json.dumps(content))

    rewritten(path, apply)


AGAIN = r"write it again with `mjfim design EXPERIMENT -o DIR`"
OTHER = rf"design\.npz: the array 'record' is missing or of another version .*{AGAIN}"

# Arrays that are replaced, or taken away, and what is said.
FAULTY_ARRAYS: dict[str, tuple[str, np.ndarray | None, str]] = {
    "an older version": (RECORD, None, OTHER),
    "another text": (RECORD, np.array("hello"), OTHER),
    "another list": (RECORD, np.array("[1]"), OTHER),
    "a missing array": (
        "initial_qpos",
        None,
        rf"'initial\.trajectory\.qpos': .*the array 'initial_qpos' is missing; {AGAIN}",
    ),
    "an array of texts": ("theta", np.array(["a"]), r"the array 'theta' does not hold numbers"),
}

# Plain values, of the record or of its fields, and what is said.
FAULTY_VALUES: dict[str, tuple[object, str]] = {
    "version": (99, rf"design\.npz: has version 99, not 3; {AGAIN}"),
    "type": ("Check", r"design\.npz: holds a record of type Check, not Design"),
    "colour": ("red", r"the field 'colour': Unexpected keyword"),
    "status": ("BORED", r"the field 'status': Input should be .*converged"),
    "slope": ("steep", r"the field 'slope': Input should be a valid number"),
    "parameters": ([1], r"the field 'parameters\.0': Input should be a valid string"),
    "steps": (True, r"the field 'steps': Input should be a valid integer"),
    "final": ({}, r"the field 'final\.trajectory': Field required"),
}


@pytest.mark.parametrize("name", [*FAULTY_ARRAYS, *FAULTY_VALUES])
def test_damaged_files_are_described(name: str, saved: Path) -> None:
    """The file, what is wrong, and how to write it again."""
    if name in FAULTY_ARRAYS:
        key, array, message = FAULTY_ARRAYS[name]
        replaced = {} if array is None else {key: array}
        rewritten(saved / "design.npz", lambda arrays: (arrays.pop(key), arrays.update(replaced)))
    else:
        value, message = FAULTY_VALUES[name]
        with_content(
            saved / "design.npz",
            lambda content: (content if name in content else content["fields"]).update(
                {name: value}
            ),
        )
    with pytest.raises(RecordingError, match=message):
        Design.load(saved)


def test_fields_with_a_default_may_be_missing(saved: Path) -> None:
    """A later version can add a field."""
    with_content(saved / "design.npz", lambda content: content["fields"].pop("found_by"))
    assert_same(Design.load(saved), results.design(found_by="initial control"))


def test_missing_files_are_named(saved: Path, tmp_path: Path) -> None:
    """Each with what the call takes."""
    (tmp_path / "notes.txt").write_text("mine", encoding="utf-8")
    needs = r"estimate\.npz: this file is missing, but Estimate\.load needs it; write"
    takes = r"notes\.txt: Design\.load takes a folder, a design\.json or a design"
    for kind, place, said in (
        (Design, tmp_path / "gone", "gone: no such file or folder"),
        (Estimate, saved, needs),
        (Design, tmp_path / "notes.txt", takes),
    ):
        with pytest.raises(RecordingError, match=said):
            kind.load(place)
    (saved / "design.npz").unlink()
    with pytest.raises(RecordingError, match=rf"design\.npz: this file is missing, .*{AGAIN}"):
        Design.load(saved / "design.json")


def test_headers_that_announce_too_much(tmp_path: Path) -> None:
    """No memory is allocated for numbers that the file does not hold."""
    stream = io.BytesIO()
    header = {"descr": "<f8", "fortran_order": False, "shape": (10**13,)}
    np.lib.format.write_array_header_1_0(stream, header)
    with zipfile.ZipFile(tmp_path / "design.npz", "w") as archive:
        archive.writestr("t.npy", stream.getvalue())
    with pytest.raises(RecordingError, match=r"design\.npz: not a design archive"):
        Design.load(tmp_path)


def test_records_may_be_moved(saved: Path, tmp_path: Path) -> None:
    """The npz file alone is enough, under any name."""
    shutil.copy(saved / "design.npz", tmp_path / "best.npz")
    assert_same(Design.load(tmp_path / "best.npz"), results.design())
