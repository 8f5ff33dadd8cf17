"""Division of the rows of all segments into blocks, each of which is condensed to one triangle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mjfim.identification.segment_simulation import SegmentRows
from mjfim.identification.segments import Segment

# Smallest number of rows of a block.
MIN_BLOCK_ROWS = 8

# Approximate largest number of blocks into which all rows are divided.
MAX_BLOCKS = 1024


@dataclass(frozen=True, kw_only=True, eq=False)
class BlockDivision:
    """Blocks of rows; every segment is divided evenly into its blocks.

    Attributes:
        segments: The P segments.
        row_count: Number of rows of all recordings, on which the length of a block depends.
    """

    segments: Sequence[Segment]
    row_count: int

    @property
    def count(self) -> int:
        """Number of blocks B."""
        return int(self._offsets[-1])

    @property
    def segment_of_block(self) -> np.ndarray:
        """(B,) index of the segment of every block."""
        return np.repeat(np.arange(len(self.segments)), np.diff(self._offsets))

    @property
    def recording_of_block(self) -> np.ndarray:
        """(B,) index of the recording of every block."""
        recordings = [segment.recording for segment in self.segments]
        return np.repeat(recordings, np.diff(self._offsets))

    @property
    def mean_rows(self) -> np.ndarray:
        """(B,) mean number of rows of every block."""
        counts = np.diff(self._offsets)
        return np.repeat(self._rows_per_segment / counts, counts)

    def of_rows(self, rows: SegmentRows) -> np.ndarray:
        """Blocks of some rows of a segment.

        Args:
            rows: The k rows.

        Returns:
            (k,) index of the block of every row.
        """
        begin = self.segments[rows.segment].rows.start
        return self._block_of_row(rows.segment, rows.rows - begin)

    def containing(self, masks: Sequence[np.ndarray]) -> np.ndarray:
        """(B,) True for the blocks that contain a marked value.

        Args:
            masks: (M, ny) for every recording, True for the marked values.
        """
        found = np.zeros(self.count, dtype=bool)
        for index, segment in enumerate(self.segments):
            rows = np.flatnonzero(masks[segment.recording][segment.rows].any(axis=1))
            found[self._block_of_row(index, rows)] = True
        return found

    def _block_of_row(self, segment: int, rows: np.ndarray) -> np.ndarray:
        """(k,) index of the block of some rows, which are counted from the begin of a segment."""
        first = self._offsets[segment]
        count = self._offsets[segment + 1] - first
        return np.asarray(first + rows * count // self._rows_per_segment[segment])

    @cached_property
    def _rows_per_segment(self) -> np.ndarray:
        """(P,) number of rows of every segment."""
        return np.array([segment.rows.stop - segment.rows.start for segment in self.segments])

    @cached_property
    def _offsets(self) -> np.ndarray:
        """(P+1,) first block of every segment, and the number of all blocks."""
        block_rows = max(MIN_BLOCK_ROWS, math.ceil(self.row_count / MAX_BLOCKS))
        counts = np.rint(self._rows_per_segment / block_rows).astype(int)
        counts = np.maximum(counts, 1)
        return np.concatenate([[0], np.cumsum(counts)])
