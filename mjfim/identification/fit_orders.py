"""Orders of a fit for workers: which part of a problem each of them needs.

An order holds the segments of its batch, the values that count in them, and their private unknowns.
What all parts of a problem have in common, and the recordings, are sent to each worker once.
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError
from mjfim.experiment.system import System
from mjfim.experiment.system_order import SystemOrder
from mjfim.identification.aligned_recording import AlignedRecording, align
from mjfim.identification.batch_workers import BatchWork, ProblemWork
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.pins import Pins
from mjfim.identification.recording_files import RecordingFiles
from mjfim.identification.segment_simulation import SegmentBatch, SegmentSimulation
from mjfim.identification.segments import Segment
from mjfim.identification.unknowns import UnknownLayout
from mjfim.optimize.levenberg_marquardt import UnknownValues
from mjfim.optimize.robust_losses import RobustLoss
from mjfim.parallel.kept import KeptPerThread
from mjfim.parallel.shared_value import AbsentValueError, SharedValue, keep_value, require_values
from mjfim.plant.noise import Noise
from mjfim.recordings.channels import Channels
from mjfim.recordings.log_file import FileContent
from mjfim.recordings.read import read_recording

T = TypeVar("T")

# Number of problems that a worker keeps: a fit has variants with other noise or other segments.
KEPT_PROBLEMS = 8

# The latest systems of a worker, by the hash of their order.
_worker_systems: KeptPerThread[System] = KeptPerThread(KEPT_PROBLEMS)


@dataclass(frozen=True, kw_only=True, eq=False)
class ProblemOrder:
    """Description of a problem that all its parts share. It can be pickled.

    Attributes:
        system: The system.
        row_counts: Number of rows M of every recording.
        segment_rows: (P,) number of rows of every segment.
        layout: Layout of the unknowns.
        start_directions: (nx, n) directions of the initial state.
        noise: Noise of the outputs.
        loss: Loss of a whitened residual.
        pins: Combinations that no recording determines.
        with_priors: Whether priors count.
        difference_step: Relative step of the differences.
        central: Whether they are two-sided; None where that depends on the amount of data.
    """

    system: SharedValue[SystemOrder]
    row_counts: tuple[int, ...]
    segment_rows: np.ndarray
    layout: UnknownLayout
    start_directions: Array
    noise: Noise
    loss: RobustLoss
    pins: Pins
    with_priors: bool
    difference_step: float
    central: bool | None


class SharedRecording(SharedValue[AlignedRecording]):
    """A recording that is sent only to workers that cannot read its file."""

    def to_send(self) -> AlignedRecording:
        """The recording. Raises RecordingError if its file has changed since it was read."""
        recording = self.value
        if recording.file is not None:
            recording.file.require_unchanged()
        return recording


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordingOrder:
    """A recording that a worker reads from files, or else receives. It can be pickled.

    Attributes:
        value: The recording, sent once.
        file: The file that it was read from; None where a worker cannot read it in the same way.
        arrays: Its arrays as files of the caller; None without them.
    """

    value: SharedValue[AlignedRecording]
    file: FileContent | None
    arrays: RecordingFiles | None

    @classmethod
    def of(
        cls,
        recording: AlignedRecording,
        channels: Channels | None,
        arrays: RecordingFiles | None = None,
    ) -> RecordingOrder:
        """Order a recording.

        Args:
            recording: The recording.
            channels: How workers read logs; None where they need not read this one.
            arrays: Its arrays as files of the caller.

        Raises:
            RecordingError: Its file has changed since it was read.
        """
        file = recording.file
        content = None
        if file is not None and channels is not None and file.is_read_by(channels):
            content = file.content
        return cls(
            value=SharedRecording(uuid.uuid4().hex, recording, recording.size),
            file=content,
            arrays=arrays,
        )

    @property
    def is_here(self) -> bool:
        """True where this process has the recording, or finds it as files."""
        if self.value.is_here or (self.arrays is not None and self.arrays.is_here):
            return True
        return self.file is not None and self.file.is_here

    def made(self, system: System) -> AlignedRecording:
        """The recording, read and aligned where this process has not received it.

        Args:
            system: The system of the fit.

        Raises:
            AbsentValueError: It was not received, and cannot be read here.
        """
        if self.value.is_here:
            return self.value.value
        if self.arrays is not None and self.arrays.is_here:
            return self.arrays.mapped()
        if self.file is None:
            return self.value.value
        recording = self._read(self.file, system)
        keep_value(self.value, recording)
        return recording

    def _read(self, file: FileContent, system: System) -> AlignedRecording:
        """The recording from its file. Raises AbsentValueError if the file changes meanwhile."""
        try:
            recording = align(system, read_recording(file.path, system.channels))
        except RecordingError:
            if file.is_here:
                raise
            raise AbsentValueError(self.value.digest) from None
        if not file.is_here:
            raise AbsentValueError(self.value.digest)
        return recording


@dataclass(frozen=True, kw_only=True, eq=False)
class PartOrder:
    """Some segments of a problem, and what only they need. It can be pickled.

    Attributes:
        problem: The problem.
        recordings: Each of the recordings that are needed, by its index.
        segments: The segments, by their index in the problem.
        masks: (k, ny) measured values that count among the rows of each of these segments.
    """

    problem: SharedValue[ProblemOrder]
    recordings: dict[int, RecordingOrder]
    segments: dict[int, Segment]
    masks: dict[int, np.ndarray]

    @classmethod
    def of(
        cls,
        problem: FitProblem,
        indices: Sequence[int],
        shared: SharedValue[ProblemOrder],
        recording_of: Callable[[AlignedRecording], RecordingOrder],
    ) -> PartOrder:
        """Describe some segments of a problem.

        Args:
            problem: The problem.
            indices: Indices of the segments.
            shared: What all parts of the problem have in common.
            recording_of: Shares a recording.
        """
        segments = {i: problem.segments[i] for i in indices}
        needed = sorted({segment.recording for segment in segments.values()})
        return cls(
            problem=shared,
            recordings={i: recording_of(problem.recordings[i]) for i in needed},
            segments=segments,
            masks={i: problem.masks[each.recording][each.rows] for i, each in segments.items()},
        )

    @property
    def size(self) -> int:
        """About the memory that it takes [bytes], without the problem and the recordings."""
        masks = sum(mask.nbytes for mask in self.masks.values())
        return masks + sum(segment.start.nbytes for segment in self.segments.values())

    def made(self) -> FitProblem:
        """Make the problem; recordings and segments that are not needed are empty."""
        absent = [each.value for each in self.recordings.values() if not each.is_here]
        require_values([self.problem, *absent])
        order = self.problem.value
        require_values([order.system])
        system = _worker_systems.get(order.system.digest, lambda: order.system.value.system())

        ny = len(system.outputs)
        known = self.recordings
        recordings = [
            known[i].made(system) if i in known else _without_values(count, ny)
            for i, count in enumerate(order.row_counts)
        ]
        simulation = SegmentSimulation(
            system=system,
            recordings=tuple(recordings),
            segments=self._all_segments(order.segment_rows.tolist()),
            layout=order.layout,
            start_directions=order.start_directions,
        )
        return FitProblem(
            simulation=simulation,
            masks=tuple(self._all_masks(order.row_counts, ny)),
            noise=order.noise,
            loss=order.loss,
            pins=order.pins,
            with_priors=order.with_priors,
            difference_step=order.difference_step,
            central=order.central,
        )

    def _all_segments(self, rows: Sequence[int]) -> tuple[Segment, ...]:
        """Segments of the whole problem; those of other parts have nothing but their size."""
        nothing = np.zeros(0)
        empty = {
            count: Segment(recording=0, begin=0, samples=0, rows=slice(0, count), start=nothing)
            for count in set(rows)
        }
        return tuple(self.segments.get(i) or empty[count] for i, count in enumerate(rows))

    def _all_masks(self, row_counts: Sequence[int], ny: int) -> Iterator[np.ndarray]:
        """(M, ny) for every recording, True for the values of these segments that count."""
        masks = {i: np.zeros((row_counts[i], ny), dtype=bool) for i in self.recordings}
        for i, segment in self.segments.items():
            masks[segment.recording][segment.rows] |= self.masks[i]

        for i, count in enumerate(row_counts):
            yield masks[i] if i in masks else np.broadcast_to(False, (count, ny))


def _without_values(rows: int, outputs: int) -> AlignedRecording:
    """A recording of a length without contents, which takes no memory."""
    nothing = np.array(np.nan)
    nothing.setflags(write=False)
    return AlignedRecording(
        name="",
        t=np.broadcast_to(nothing, (rows,)),
        y=np.broadcast_to(nothing, (rows, outputs)),
        ctrl=np.zeros((0, 0)),
        dt=1.0,
        on_grid=True,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class BatchOrder(Generic[T]):
    """Work on one batch.

    Attributes:
        part: The problem, with the segments of the batch.
        work: Method of the problem that does the work.
        batch: The batch.
        at: The unknowns, with the private ones of the segments of the batch only.
    """

    part: SharedValue[PartOrder]
    work: BatchWork[T]
    batch: SegmentBatch
    at: UnknownValues

    @classmethod
    def of(
        cls,
        part: SharedValue[PartOrder],
        work: BatchWork[T],
        batch: SegmentBatch,
        at: UnknownValues,
    ) -> BatchOrder[T]:
        """Order the work on a batch at values of all unknowns."""
        private = at.private[list(batch.segments)]
        return cls(part=part, work=work, batch=batch, at=replace(at, private=private))

    def unknowns(self, segments: int) -> UnknownValues:
        """Unknowns of a problem with some number of segments; zero for those of other batches."""
        private = np.zeros((segments, self.at.private.shape[1]))
        private[list(self.batch.segments)] = self.at.private
        return replace(self.at, private=private)


@dataclass(frozen=True, kw_only=True, eq=False)
class WholeOrder(Generic[T]):
    """Work on a whole problem.

    Attributes:
        part: The problem, with all its segments.
        work: Does the work.
    """

    part: SharedValue[PartOrder]
    work: ProblemWork[T]
