"""Records are saved and loaded without loss, and files that cannot be loaded are refused with one
clear message.
"""

from __future__ import annotations

import dataclasses
import io
import itertools
import json
import zipfile
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
from mjfim.records.design import Design, Evaluation
from mjfim.records.estimate import Estimate, PredictionErrors
from mjfim.records.trajectory import Recording, Trajectory
from tests.support import results

# The results of the verbs, and parts of them that have files of their own.
SAVED: list[type[SavedRecord]] = [type(make()) for make in results.MAKERS.values()]
SAVED += [Evaluation, PredictionErrors, Recording, Trajectory]


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


def awkward(kind: type[SavedRecord], count: int, is_optional_given: bool) -> SavedRecord:
    """A record of numbers and texts that are easily lost.

    Its tuples, dictionaries and arrays have `count` entries.
    """
    turn = itertools.count(1)

    def next_of(values: Any) -> Any:
        return values[next(turn) % len(values)]

    def build(hint: Any) -> Any:
        origin, entries = get_origin(hint), get_args(hint)
        if origin in (Union, UnionType):
            inner = next(entry for entry in entries if entry is not NoneType)
            return build(inner) if is_optional_given or NoneType not in entries else None
        if origin is np.ndarray:
            return np.resize(NUMBERS, (count, next_of((1, 2, 3))))
        if origin is tuple:
            return tuple(map(build, entries[:1] * count if entries[-1] is Ellipsis else entries))
        if origin is dict:
            names = [f"{text}{i}" if entries[0] is str else i for i, text in enumerate(TEXTS)]
            return {name: build(entries[1]) for name in names[:count]}
        if dataclasses.is_dataclass(hint):
            hints = get_type_hints(hint)
            return hint(**{name: build(hints[name]) for name in saved_fields(hint)})
        plain = {bool: (True, False), int: (0, 7, 2**60), float: NUMBERS, str: TEXTS}
        return next_of(list(hint) if issubclass(hint, Enum) else plain[hint])

    made: SavedRecord = build(kind)
    return made


@pytest.mark.parametrize("kind", SAVED, ids=lambda kind: kind.__name__)
@pytest.mark.parametrize(("count", "optional"), [(0, False), (1, True), (2, False), (3, True)])
def test_awkward_values_survive(
    kind: type[SavedRecord], count: int, optional: bool, tmp_path: Path
) -> None:
    """Infinity, NaN, negative zero, empty tuples, names with quotes and dots, and every optional
    field.
    """
    record = awkward(kind, count, optional)
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


def replaced(path: Path, name: str, value: Any) -> None:
    """Replace an array or a plain value of an npz file, or take it away where it is None."""
    with np.load(path, allow_pickle=False) as archived:
        arrays = dict(archived)
    content = json.loads(str(arrays[RECORD]))
    fields = content["fields"]
    place = next((each for each in (arrays, content) if name in each), fields)
    place.pop(name, None)
    if value is not None:
        place[name] = value
    if place is not arrays:
        arrays[RECORD] = np.array(json.dumps(content))
    np.savez(path, **arrays)


AGAIN = r"write it again with `mjfim design EXPERIMENT -o DIR`"
OTHER = rf"design\.npz: the array 'record' is missing or of another version .*{AGAIN}"

# Arrays and plain values that are replaced, or taken away, and what is said.
FAULTS = [
    (RECORD, None, OTHER),
    (RECORD, np.array("hello"), OTHER),
    (RECORD, np.array("[1]"), OTHER),
    (
        "initial_qpos",
        None,
        rf"'initial\.trajectory\.qpos': .*the array 'initial_qpos' is missing; {AGAIN}",
    ),
    ("theta", np.array(["a"]), r"the array 'theta' does not hold numbers"),
    ("version", 99, rf"design\.npz: has version 99, not 5; {AGAIN}"),
    ("type", "Check", r"design\.npz: holds a record of type Check, not Design"),
    ("colour", "red", r"the field 'colour': Unexpected keyword"),
    ("status", "BORED", r"the field 'status': Input should be .*converged"),
    ("slope", "steep", r"the field 'slope': Input should be a valid number"),
    ("parameters", [1], r"the field 'parameters\.0': Input should be a valid string"),
    ("steps", True, r"the field 'steps': Input should be a valid integer"),
    ("final", {}, r"the field 'final\.trajectory': Field required"),
]


@pytest.mark.parametrize(("name", "value", "message"), FAULTS)
def test_damaged_files_are_described(name: str, value: Any, message: str, saved: Path) -> None:
    """The file, what is wrong, and how to write it again."""
    replaced(saved / "design.npz", name, value)
    with pytest.raises(RecordingError, match=message):
        Design.load(saved)


def test_fields_with_a_default_may_be_missing(saved: Path) -> None:
    """A later version can add a field."""
    replaced(saved / "design.npz", "found_by", None)
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
