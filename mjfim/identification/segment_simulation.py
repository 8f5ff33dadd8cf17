"""Simulation of all segments: predicted outputs at the times of the recordings, and derivatives."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import SimulationDivergedError
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.segments import batches
from mjfim.identification.unknowns import FitUnknowns
from mjfim.optimize.levenberg_marquardt import UnknownValues
from mjfim.plant.batch import Rollouts
from mjfim.plant.outputs import OutputDelay
from mjfim.plant.plant import MAX_NUMBERS_AT_ONCE, SENSITIVITY_STEP, Response
from mjfim.plant.running_law import InputContext
from mjfim.records.trajectory import Trajectory

# Largest number of engine steps of a batch. On small models it takes about 0.2 s on two threads. At
# the end of a batch, all threads wait for its last simulation, so that smaller batches of long
# segments would leave some threads idle. Larger ones would leave workers idle where there are few
# data.
STEPS_OF_BATCH = 200_000

# Number of samples that one linearisation simulates, with two-sided differences, above which
# differences are one-sided.
SAMPLES_FOR_ONE_SIDED = 100_000

# Step of one-sided differences over that of two-sided ones.
ONE_SIDED_STEP_FACTOR = 0.1


# Smallest number of rows of a block.
MIN_BLOCK_ROWS = 8

# Approximate largest number of blocks into which all rows are divided.
MAX_BLOCKS = 1024


class DivergedSegmentError(SimulationDivergedError):
    """A simulation of segments diverges, so that a batch has no result."""


@record
class SegmentRows:
    """Predictions of k rows of one segment.

    Attributes:
        segment: Index of the segment.
        recording: Index of its recording.
        rows: (k,) rows of the recording.
        y: (k, ny) predicted outputs [y-unit].
        jacobians: (k, ny, p) derivatives by theta [y-unit / theta-unit], and (k, ny, n) derivatives
            by the private unknowns; none if not requested.
    """

    segment: int
    recording: int
    rows: np.ndarray
    y: Array
    jacobians: tuple[Array, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class SegmentBatch:
    """Segments that are simulated together, and how they are differentiated.

    Attributes:
        recording: Index of a recording whose parameters the segments have.
        segments: Indices of the segments.
        derivatives: Whether to compute derivatives.
        central: True for two-sided differences.
        step: Relative step of the differences.
        wanted: (p,) True for the parameters by which to differentiate.
    """

    recording: int
    segments: tuple[int, ...]
    derivatives: bool
    central: bool
    step: float
    wanted: np.ndarray


@dataclass(frozen=True, kw_only=True, eq=False)
class SegmentSimulation(FitUnknowns):
    """Predicted outputs of all segments as functions of the unknowns.

    Attributes:
        difference_step: Relative step of the two-sided differences of a linearisation.
        central: True for two-sided differences; None for two-sided ones unless there is much data.
    """

    difference_step: float = SENSITIVITY_STEP
    central: bool | None = None

    @cached_property
    def sample_count(self) -> int:
        """Number of samples of all segments together."""
        return sum(segment.samples for segment in self.segments)

    def segments_of(self, recording: int) -> list[int]:
        """Segments of one recording.

        Args:
            recording: Index of the recording.

        Returns:
            Indices of the segments.
        """
        return [i for i, segment in enumerate(self.segments) if segment.recording == recording]

    def motion(
        self, at: UnknownValues, recording: int, max_samples: int | None = None
    ) -> Trajectory | None:
        """The fitted motion of one recording on the sample grid.

        It may jump from one segment to the next. Its controls are those that act on the model, also
        where control laws compute them.

        Args:
            at: The unknowns.
            recording: Index of the recording.
            max_samples: Number of samples after which the motion ends, if it lasts longer.

        Returns:
            The motion; None where it diverges.
        """
        plant = self.system.plant
        ctrl = self.recordings[recording].ctrl[:max_samples]
        if plant.laws is not None:
            ctrl = np.zeros((len(ctrl), len(self.system.controls)))

        states = np.full((len(ctrl) + 1, plant.nominal_initial_state.size), np.nan)
        for i in self.segments_of(recording):
            segment = self.segments[i]
            samples = min(segment.samples, len(ctrl) - segment.begin)
            if samples <= 0:
                continue
            simulated = self._simulated(at, i, samples)
            if not simulated.finite[0]:
                return None
            if simulated.controls is not None:
                ctrl[segment.begin : segment.begin + samples] = simulated.controls[0]

            # Segments overlap where outputs are delayed; there, the earlier segment counts.
            part = states[segment.begin : segment.begin + samples + 1]
            missing = np.isnan(part[:, 0])
            part[missing] = simulated.states[0][missing]

        # Samples without a segment get the first known state.
        gap = np.isnan(states[:, 0])
        states[gap] = plant.nominal_initial_state if gap.all() else states[np.argmin(gap)]
        return replace(plant.trajectory(states, ctrl[:, :0]), ctrl=ctrl)

    def clipped_shares(self, at: UnknownValues) -> dict[str, float]:
        """Share of the samples at which the limits of control laws clip their controls.

        Args:
            at: The unknowns.

        Returns:
            The share by name of the actuator; none without laws.
        """
        laws = self.system.laws
        if laws is None:
            return {}

        counts = np.zeros(len(laws.laws))
        for i, segment in enumerate(self.segments):
            is_clipped = self._simulated(at, i, segment.samples).is_clipped
            if is_clipped is not None:
                counts += is_clipped[0].sum(axis=0)
        shares = (counts / max(self.sample_count, 1)).tolist()
        return {law.actuator: share for law, share in zip(laws.laws, shares, strict=True)}

    def _simulated(self, at: UnknownValues, index: int, samples: int) -> Rollouts:
        """One segment over some samples."""
        plant, segment = self.system.plant, self.segments[index]
        theta = self.theta_of_recording(at, segment.recording)
        start = self.initial_state(at, index)[None]
        # Before the begin of a recording, its first inputs are held.
        lead = min(plant.lead(theta), segment.begin + 1)
        inputs = self._control(index, samples, lead)[None]
        context = None
        if plant.laws is not None:
            first = np.array([segment.begin - lead])
            place = slice(lead, lead + samples)
            context = InputContext.of_interval(inputs, first, place, lead, None)
        return plant.simulator.rollout(
            [plant.model(theta)], start, inputs[:, lead:], context=context
        )

    def _differences(self, directions: int) -> tuple[bool, float]:
        """Whether differences along some directions are two-sided, and their relative step."""
        # Two-sided differences are more accurate; with much data they take too long.
        central = self.central
        if central is None:
            central = self.sample_count * 2 * directions < SAMPLES_FOR_ONE_SIDED
        factor = 1.0 if central else ONE_SIDED_STEP_FACTOR
        return central, factor * self.difference_step

    def batches(
        self,
        *,
        derivatives: bool,
        wanted: np.ndarray | None = None,
    ) -> Iterator[SegmentBatch]:
        """Divide all segments into batches that fit into memory; every segment is in one of them.

        Args:
            derivatives: Whether to compute derivatives.
            wanted: (p,) True for the parameters by which to differentiate; default: those that have
                common columns.

        Yields:
            The batches.
        """
        if wanted is None:
            wanted = self.estimated

        directions = int(wanted.sum()) + self.private_count
        central, step = self._differences(directions)
        simulations = 1 + derivatives * directions * (1 + central)

        # The states of a batch have to fit into memory.
        numbers_per_step = 1 + self.system.plant.nominal_initial_state.size
        most = min(MAX_NUMBERS_AT_ONCE // numbers_per_step, STEPS_OF_BATCH)
        max_samples = max(most // (simulations * self.system.grid.substeps), 1)

        # Without parameters of single recordings, a batch may contain segments of all recordings.
        groups = [list(range(len(self.segments)))]
        if len(self.per_recording):
            groups = [self.segments_of(recording) for recording in range(len(self.recordings))]
        for recording, indices in enumerate(groups):
            for places in batches([self.segments[i] for i in indices], max_samples):
                yield SegmentBatch(
                    recording=recording,
                    segments=tuple(indices[k] for k in places),
                    derivatives=derivatives,
                    central=central,
                    step=step,
                    wanted=wanted,
                )

    def rows_of_batch(self, at: UnknownValues, batch: SegmentBatch) -> Iterator[SegmentRows]:
        """Simulate a batch over one interval of time after the other.

        Args:
            at: The unknowns.
            batch: The batch.

        Yields:
            Predictions of some rows of one segment.

        Raises:
            DivergedSegmentError: A simulation diverges.
        """
        theta, first = self.theta_of_recording(at, batch.recording), 0
        for response in self._responses(at, batch, theta):
            if response is None:
                raise DivergedSegmentError
            for place, i in enumerate(batch.segments):
                curve = [None if each is None else each[place] for each in response]
                yield from self.rows_of_segment(theta, i, first, *curve)
            first += response[0].shape[1] - 1

    def _responses(
        self, at: UnknownValues, batch: SegmentBatch, theta: Array
    ) -> Iterator[Response | None]:
        """Responses of a batch with the parameters theta, (p,), over one interval after the other.

        None where a simulation diverges.
        """
        longest = max(self.segments[i].samples for i in batch.segments)
        begins = np.array([self.segments[i].begin for i in batch.segments])
        # The last interval of a segment needs no more than all inputs before its end.
        lead = min(self.system.plant.lead(theta), int(begins.max()) + longest)
        return self.system.plant.derivatives.responses(
            theta,
            np.stack([self.initial_state(at, i) for i in batch.segments]),
            np.stack([self._control(i, longest, lead) for i in batch.segments]),
            lead=lead,
            samples=begins - lead,
            start_directions=self.start_directions if batch.derivatives else None,
            central=batch.central,
            step=batch.step,
            wanted=batch.wanted,
        )

    def initial_state(self, at: UnknownValues, index: int) -> Array:
        """(ns,) state at which a segment begins."""
        plant = self.system.plant
        start = self.segments[index].start
        if self.free_starts:
            return plant.space.plus(start, self.start_directions @ at.private[index])

        theta = np.array(at.theta)
        theta[self.private] = at.private[index]
        return plant.space.plus(start, plant.initial_state_derivative @ theta)

    def _control(self, index: int, samples: int, lead: int) -> Array:
        """(lead + samples, nu) control of a segment, from `lead` samples before its begin on.

        Before the begin of the recording, the first value is held, and beyond its end the last one.
        """
        segment = self.segments[index]
        recorded = self.recordings[segment.recording].ctrl
        places = np.arange(segment.begin - lead, segment.begin + samples)
        return recorded[np.clip(places, 0, len(recorded) - 1)]

    def rows_of_segment(
        self, theta: Array, index: int, first: int, *simulated: Array | None
    ) -> Iterator[SegmentRows]:
        """Predictions of the rows of a segment inside a simulated interval, if there are any.

        Args:
            theta: (p,) parameters of the recording.
            index: Index of the segment.
            first: Sample of the segment at which the interval begins.
            *simulated: (n+1, ny) outputs over the interval and, unless they are None, their
                derivatives by theta and by directions of the initial state; see `Response`.
        """
        found = [each for each in simulated if each is not None]
        segment = self.segments[index]
        recording = self.recordings[segment.recording]

        # Times that the rows measure, in samples since the begin of the segment. Delayed outputs
        # measure an earlier time than that of their row.
        delay = float(self.parameters.delay_derivative @ theta)
        times = recording.t[segment.rows] / recording.dt - segment.begin - delay / recording.dt

        # Rows in this interval; the last interval includes its end.
        samples = len(found[0]) - 1
        clipped = np.clip(times, 0.0, segment.samples)
        is_last = first + samples >= segment.samples
        inside = clipped >= first
        inside &= (clipped < first + samples) | is_last
        if inside.any():
            y, *jacobians = self._at_times(found, recording, times[inside] - first)
            yield SegmentRows(
                segment=index,
                recording=segment.recording,
                rows=np.flatnonzero(inside) + segment.rows.start,
                y=y,
                jacobians=tuple(jacobians),
            )

    def _at_times(
        self, found: list[Array], recording: AlignedRecording, times: Array
    ) -> list[Array]:
        """(k, ny) outputs of a segment at some times, and their derivatives if there are any.

        Args:
            found: (n+1, ny) outputs over an interval, and their derivatives if there are any.
            recording: Recording of the segment.
            times: (k,) times of the rows [samples since the begin of the interval].
        """
        delay_derivative = self.parameters.delay_derivative
        is_delayed = bool(delay_derivative.any())

        # Rows on the grid are samples of the simulation.
        if recording.on_grid and not is_delayed:
            sample = np.rint(times).astype(int)
            return [each[sample] for each in found]

        # Other rows are interpolated between the samples; the derivative by the delay is added.
        interpolation = OutputDelay.at(times, len(found[0]), recording.dt)
        at_times = [interpolation.apply(each) for each in found]
        if is_delayed and len(found) > 1:
            change = interpolation.derivative(found[0])
            at_times[1] = at_times[1] + change[..., None] * delay_derivative
        return at_times

    # ---- blocks of rows; every segment is divided evenly into its blocks

    @property
    def row_count(self) -> int:
        """Number of rows of all recordings, on which the length of a block depends."""
        return sum(len(recording.t) for recording in self.recordings)

    @property
    def block_count(self) -> int:
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
    def times_of_block(self) -> Array:
        """(B, 2) times at which the rows of every block begin and end [s]."""
        found = []
        for index, segment in enumerate(self.segments):
            t = self.recordings[segment.recording].t
            t = np.append(t, 2.0 * t[-1] - t[-2])
            rows = np.arange(segment.rows.start, segment.rows.stop)
            first = rows[np.diff(self.blocks_of_rows(index, rows), prepend=-1) > 0]
            edges = t[np.append(first, segment.rows.stop)]
            found.append(np.column_stack([edges[:-1], edges[1:]]))
        return np.concatenate(found)

    @property
    def mean_block_rows(self) -> np.ndarray:
        """(B,) mean number of rows of every block."""
        counts = np.diff(self._offsets)
        return np.repeat(self._rows_per_segment / counts, counts)

    def blocks_containing(self, masks: Sequence[np.ndarray]) -> np.ndarray:
        """(B,) True for the blocks that contain a marked value.

        Args:
            masks: (M, ny) for every recording, True for the marked values.
        """
        found = np.zeros(self.block_count, dtype=bool)
        for index, segment in enumerate(self.segments):
            rows = np.flatnonzero(masks[segment.recording][segment.rows].any(axis=1))
            found[self.blocks_of_rows(index, segment.rows.start + rows)] = True
        return found

    def blocks_of_rows(self, segment: int, rows: np.ndarray) -> np.ndarray:
        """(k,) index of the block of some rows: (k,) of the recording of a segment."""
        first = self._offsets[segment]
        count = self._offsets[segment + 1] - first
        places = rows - self.segments[segment].rows.start
        return np.asarray(first + places * count // self._rows_per_segment[segment])

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
