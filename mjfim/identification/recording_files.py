"""Aligned recordings as files, which all workers of one computer share.

A worker maps such a file into its memory, where the system keeps what is used often. This takes a
small part of the time in which a log is parsed or sent.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import uuid
import weakref
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from mjfim.identification.aligned_recording import AlignedRecording

# Arrays of a recording, each of which is a file.
ARRAYS = ("t", "y", "ctrl")

# Windows removes no file that is mapped into memory, so that arrays are read there.
MAP_MODE: Literal["r"] | None = None if os.name == "nt" else "r"

# Largest share of the free room of a disk that a recording takes.
ROOM_SHARE = 0.5


@dataclass(frozen=True, kw_only=True)
class RecordingFiles:
    """A recording in a folder that a worker may find. It can be pickled.

    Attributes:
        folder: Folder of the arrays; its name occurs once on all computers.
        name: Name of the recording.
        dt: Sample period of the grid [s].
        on_grid: True where every time stamp lies on the grid.
    """

    folder: Path
    name: str
    dt: float
    on_grid: bool

    @classmethod
    def written(cls, parent: Path, recording: AlignedRecording) -> RecordingFiles:
        """Write a recording.

        Args:
            parent: Folder in which a new one is made.
            recording: The recording.

        Raises:
            OSError: It cannot be written.
        """
        # Workers find a folder only when it is complete.
        folder = parent / uuid.uuid4().hex
        unfinished = folder.with_suffix(".part")
        try:
            unfinished.mkdir()
            for array in ARRAYS:
                np.save(unfinished / f"{array}.npy", getattr(recording, array), allow_pickle=False)
            unfinished.rename(folder)
        except OSError:
            shutil.rmtree(unfinished, ignore_errors=True)
            raise
        return cls(folder=folder, name=recording.name, dt=recording.dt, on_grid=recording.on_grid)

    @property
    def is_here(self) -> bool:
        """True where this process finds the files, and may read them."""
        return all(os.access(self.folder / f"{array}.npy", os.R_OK) for array in ARRAYS)

    def mapped(self) -> AlignedRecording:
        """The recording, whose arrays are read from the files when they are used."""
        arrays = {}
        for array in ARRAYS:
            path = self.folder / f"{array}.npy"
            loaded = np.load(path, mmap_mode=MAP_MODE, allow_pickle=False)
            arrays[array] = loaded.view(np.ndarray)
        return AlignedRecording(name=self.name, dt=self.dt, on_grid=self.on_grid, **arrays)


class RecordingFolder:
    """A temporary folder of recordings, removed with this object or at the end of the process."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._is_full = False

    def written(self, recording: AlignedRecording) -> RecordingFiles | None:
        """Write a recording; None where there is no room for it.

        Args:
            recording: The recording.
        """
        if self._is_full:
            return None
        try:
            if self._path is None:
                self._path = Path(tempfile.mkdtemp(prefix="mjfim-recordings-"))
                weakref.finalize(self, shutil.rmtree, self._path, ignore_errors=True)

            # Others who write to the same disk keep at least half of the room.
            size = sum(getattr(recording, array).nbytes for array in ARRAYS)
            if size > ROOM_SHARE * shutil.disk_usage(self._path).free:
                self._is_full = True
                return None
            return RecordingFiles.written(self._path, recording)
        except OSError:
            self._is_full = True
            return None
