"""Limits of the size of packed files, which are checked before memory is allocated."""

from __future__ import annotations

import math
import zipfile
import zlib
from pathlib import Path

import numpy as np

from mjfim.errors import RecordingError

# Largest size of a file's unpacked content, and of the columns read from it [bytes].
MAX_UNPACKED_SIZE = 4 * 2**30

# Unpacked size below which the packing ratio of a file is not checked [bytes].
UNSUSPICIOUS_SIZE = 64 * 2**20

# Largest plausible ratio of unpacked to packed size of measured or simulated data.
MAX_PACKING_RATIO = 200.0

# First bytes of a file that holds one array of NumPy.
ARRAY_MAGIC = b"\x93NUMPY"

# NumPy's readers of array headers, by version of the NPY format.
HEADER_READERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}

# Errors that zipfile and NumPy raise for a damaged archive.
DAMAGED_ARCHIVE = (
    ValueError,
    OSError,
    EOFError,
    KeyError,
    NotImplementedError,
    RuntimeError,
    zipfile.BadZipFile,
    zlib.error,
)

# Shape and type of an array.
Header = tuple[tuple[int, ...], np.dtype]


def check_unpacked_size(path: Path, packed: int, unpacked: int) -> None:
    """Refuse a decompression bomb.

    Args:
        path: The file, for messages.
        packed: Size of the packed content [bytes].
        unpacked: Size of the unpacked content so far, or as the file declares it [bytes].

    Raises:
        RecordingError: The unpacked content is too large, or far larger than the packed one.
    """
    if unpacked > MAX_UNPACKED_SIZE:
        raise RecordingError(
            f"{path}: unpacks to more than {MAX_UNPACKED_SIZE / 2**30:.3g} GiB, the largest size "
            "that is read; split the file"
        )

    if unpacked > UNSUSPICIOUS_SIZE and unpacked > MAX_PACKING_RATIO * packed:
        raise RecordingError(
            f"{path}: unpacks to more than {MAX_PACKING_RATIO:g} times its size, which is unusual "
            "for measured or simulated data; if it holds such data, write it without compression"
        )


def check_column_size(path: Path, rows: int, columns: int) -> None:
    """Refuse columns that would not fit into memory.

    Args:
        path: The file, for messages.
        rows: Number of rows of the file.
        columns: Number of columns that are to be read.

    Raises:
        RecordingError: The columns are too large as float64 numbers.
    """
    if rows * columns * 8 > MAX_UNPACKED_SIZE:
        raise RecordingError(
            f"{path}: {rows} rows of {columns} columns are more than "
            f"{MAX_UNPACKED_SIZE / 2**30:.3g} GiB, the largest size that is read; name fewer "
            "columns in [recording.columns]"
        )


def check_is_archive(path: Path, kind: str) -> None:
    """Refuse a file that holds a single array instead of an archive of named arrays.

    Args:
        path: The file.
        kind: Expected kind of archive, for the message, such as "design".

    Raises:
        RecordingError: The file is an NPY file.
    """
    with path.open("rb") as stream:
        is_array = stream.read(len(ARRAY_MAGIC)) == ARRAY_MAGIC

    if is_array:
        raise RecordingError(
            f"{path}: not a {kind} archive: it holds a single array without a name, as numpy.save "
            "writes it; write named arrays by numpy.savez"
        )


def array_headers(path: Path, archive: zipfile.ZipFile) -> dict[str, Header]:
    """Read the headers of an archive, and check all sizes before memory is allocated.

    Args:
        path: The archive, for messages.
        archive: The opened archive.

    Returns:
        Shape and type of each array by its name.

    Raises:
        RecordingError: The archive or an array is too large, or two arrays have one name.
        ValueError: The archive is damaged, as other errors of `DAMAGED_ARCHIVE`.
    """
    unpacked = sum(info.file_size for info in archive.infolist())
    check_unpacked_size(path, path.stat().st_size, unpacked)

    headers: dict[str, Header] = {}
    for member in archive.namelist():
        name = member.removesuffix(".npy")
        if name in headers:
            raise RecordingError(f"{path}: more than one array is named {name!r}")
        if member.endswith(".npy"):
            headers[name] = _header(archive, member)
    return headers


def _header(archive: zipfile.ZipFile, member: str) -> Header:
    """Shape and type of one array; ValueError if the file is too short for them."""
    with archive.open(member) as stream:
        shape, _, dtype = HEADER_READERS[np.lib.format.read_magic(stream)](stream)

    # NumPy allocates the whole array before it reads the content. Pickled objects, whose size in
    # the file is arbitrary, are never read.
    size = math.prod(shape) * dtype.itemsize
    if size > archive.getinfo(member).file_size and not dtype.hasobject:
        raise ValueError(f"{member} declares more numbers than it holds")
    return shape, dtype
