"""npz files as columns: one array per column, or matrices with one column each. Nothing is unpickled."""

from __future__ import annotations

import math
import zipfile
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError
from mjfim.recordings.formats.table import Table, chosen, refuse_bomb, said
from mjfim.recordings.spec import RecordingSpec

WIDEST = 4096  # columns of one matrix
HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
BROKEN = (
    ValueError,
    OSError,
    EOFError,
    KeyError,
    NotImplementedError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)


@dataclass(frozen=True)
class Member:
    """One array of the archive, known by its header."""

    info: zipfile.ZipInfo
    shape: tuple[int, ...]
    numeric: bool

    @property
    def name(self) -> str:
        """Of the array."""
        return self.info.filename.removesuffix(".npy")

    @property
    def labels(self) -> list[str]:
        """Columns that it makes: its name, or `name[i]` of a matrix."""
        return (
            [self.name]
            if len(self.shape) < 2
            else [f"{self.name}[{i}]" for i in range(self.shape[1])]
        )


def read_arrays(path: Path, spec: RecordingSpec) -> Table:
    """Columns of an npz file; numbers that stand alone hold for all rows, a control may lack the last row.

    Raises RecordingError where the file is damaged, unpacks to too much, holds pickles or lacks the time.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            infos = [info for info in archive.infolist() if info.filename.endswith(".npy")]
            refuse_bomb(
                path, path.stat().st_size, sum(info.file_size for info in archive.infolist())
            )
            members = [_member(path, archive, info) for info in infos]
            flat = [m for m in members if len(m.shape) <= 2]
            wide = next((m for m in flat if len(m.shape) == 2 and m.shape[1] > WIDEST), None)
            if wide is not None:
                raise RecordingError(
                    f"{path}: array {wide.name!r} of shape {wide.shape} has too many columns; time runs down"
                )
            wanted = set(chosen([label for m in flat for label in m.labels], spec))
            return _table(path, archive, flat, wanted, spec)
    except BROKEN as error:
        raise RecordingError(
            f"{path}: not a readable npz archive (damaged or truncated?): {said(error)}"
        ) from None


def _member(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> Member:
    """Reads the header alone; what it promises must be there."""
    with archive.open(info) as stream:
        shape, _, dtype = _header(stream)
    if dtype.hasobject:
        raise RecordingError(
            f"{path}: array {info.filename.removesuffix('.npy')!r} holds pickled objects, which are never read; "
            "save it as numbers"
        )
    if math.prod(shape) * dtype.itemsize > info.file_size:
        raise ValueError(f"{info.filename} promises more numbers than it holds")
    return Member(info, shape, dtype.kind in "fiub")


def _header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    version = np.lib.format.read_magic(stream)
    if version not in HEADERS:
        raise ValueError(f"npy version {version} is not known")
    shape, fortran, dtype = HEADERS[version](stream)
    return shape, fortran, dtype


def _table(
    path: Path,
    archive: zipfile.ZipFile,
    members: list[Member],
    wanted: set[str],
    spec: RecordingSpec,
) -> Table:
    time = next((m for m in members if m.name == spec.time), None)
    if time is None or len(time.shape) != 1:
        what = "is missing" if time is None else f"has shape {time.shape}, wanted one row of times"
        raise RecordingError(
            f"{path}: array {spec.time!r} {what}; found: {', '.join(m.name for m in members) or 'none'}"
        )
    rows, columns, faults = time.shape[0], dict[str, Array](), dict[str, str]()
    controls = {s.column for key, s in spec.sources.items() if key.startswith("ctrl:")}
    unread = []
    for member in members:
        held = member.name.startswith("ctrl") or not controls.isdisjoint(member.labels)
        fault = _fault(member, rows, held, spec.time)
        if fault is not None:
            faults.update(dict.fromkeys(member.labels, fault))
        elif wanted.isdisjoint(member.labels):
            unread += member.labels
        else:
            columns.update(_columns(archive, member, rows))
    return Table(path, columns, faults, tuple(unread))


def _fault(member: Member, rows: int, held: bool, time: str) -> str | None:
    """Why an array makes no column."""
    if not member.numeric:
        return "is not numeric"
    if member.shape and member.shape[0] != rows and not (held and member.shape[0] == rows - 1):
        return (
            f"has {member.shape[0]} rows where {time!r} has {rows}; all columns need equally many"
        )
    return None


def _columns(archive: zipfile.ZipFile, member: Member, rows: int) -> Iterator[tuple[str, Array]]:
    with archive.open(member.info) as stream:
        values = np.asarray(np.lib.format.read_array(stream, allow_pickle=False), dtype=np.float64)
    if values.ndim == 0:
        yield member.name, np.full(rows, float(values))
        return
    if len(values) == rows - 1:
        values = np.concatenate([values, np.full((1, *values.shape[1:]), np.nan)])
    yield from zip(member.labels, values.reshape(rows, -1).T, strict=True)
