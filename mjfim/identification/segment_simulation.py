"""Simulation of all segments of recordings: predicted outputs at the times of the logs, and their derivatives."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mjfim.arrays import Array
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.segments import Segment, batches
from mjfim.identification.unknowns import UnknownLayout
from mjfim.optimize.levenberg_marquardt import UnknownValues
from mjfim.plant.delay import OutputDelay
from mjfim.plant.rollout_derivatives import MAX_NUMBERS_AT_ONCE, SENSITIVITY_STEP, Response
from mjfim.records.trajectory import Trajectory

# Number of simulated samples, summed over the two sides of all differences, from which differences
# are one-sided.
SAMPLES_FOR_ONE_SIDED = 400_000

# One-sided differences take this share of the step of two-sided ones.
ONE_SIDED_STEP_FACTOR = 0.1


@dataclass(frozen=True, kw_only=True, eq=False)
class SegmentRows:
    """Predictions of k rows of one segment.

    Attributes:
        segment: Index of the segment.
        rows: (k,) rows of its recording.
        y: (k, ny) predicted outputs [y-unit].
        common: (k, ny, p) derivatives by theta [y-unit / theta-unit], or None if not requested.
        private: (k, ny, n) derivatives by the private unknowns, or None if not requested.
    """

    segment: int
    rows: np.ndarray
    y: Array
    common: Array | None
    private: Array | None

    @property
    def jacobians(self) -> tuple[Array, Array]:
        """Derivatives by theta and by the private unknowns; only for rows that were simulated with derivatives."""
        if self.common is None or self.private is None:
            raise ValueError("these rows were simulated without derivatives")
        return self.common, self.private


@dataclass(frozen=True, kw_only=True, eq=False)
class SegmentSimulation:
    """Predicted outputs of all segments as functions of the unknowns.

    Attributes:
        system: The system, its difference steps calibrated along a recording.
        recordings: The K recordings on the sample grid.
        segments: The P segments.
        layout: Which parameters are common, and which are private.
        start_directions: (nx, n) directions of the initial state along which the private unknowns
            move it.
    """

    system: System
    recordings: tuple[AlignedRecording, ...]
    segments: tuple[Segment, ...]
    layout: UnknownLayout
    start_directions: Array

    def with_layout(self, layout: UnknownLayout) -> SegmentSimulation:
        """This simulation with another layout of the unknowns."""
        return replace(self, layout=layout)

    def of_segments(self, indices: np.ndarray) -> SegmentSimulation:
        """The simulation of some segments only."""
        return replace(self, segments=tuple(self.segments[i] for i in indices))

    @cached_property
    def sample_count(self) -> int:
        """Number of samples of all segments together."""
        return sum(segment.samples for segment in self.segments)

    @property
    def private_count(self) -> int:
        """Number of private unknowns of a segment n."""
        return int(self.start_directions.shape[1])

    def segments_of(self, recording: int) -> list[int]:
        """Indices of the segments of one recording."""
        return [i for i, segment in enumerate(self.segments) if segment.recording == recording]

    def predict(self, at: UnknownValues) -> list[Array] | None:
        """Predicted outputs of every recording at its times.

        Args:
            at: The unknowns.

        Returns:
            (M, ny) outputs of every recording [y-unit], NaN in rows without a segment; None where a
            simulation diverges.
        """
        outputs = [np.full(recording.y.shape, np.nan) for recording in self.recordings]
        for found in self.rows(at, derivatives=False):
            if found is None:
                return None
            outputs[self.segments[found.segment].recording][found.rows] = found.y
        return outputs

    def motion(self, at: UnknownValues, recording: int) -> Trajectory | None:
        """The fitted motion of one recording on the sample grid, with its jumps from segment to segment.

        Args:
            at: The unknowns.
            recording: Index of the recording.

        Returns:
            The motion; None where it diverges.
        """
        plant = self.system.plant
        ctrl = self.recordings[recording].ctrl
        model = plant.model(self.layout.theta_of_recording(at, recording))

        states = np.full((len(ctrl) + 1, plant.nominal_initial_state.size), np.nan)
        for i in self.segments_of(recording):
            segment = self.segments[i]
            simulated = plant.simulator.rollout(
                [model], self._initial_state(at, i)[None], self._control(i, segment.samples)[None]
            )
            if not simulated.finite[0]:
                return None

            # Where segments overlap by the delay of the outputs, the earlier one counts.
            part = states[segment.begin : segment.begin + segment.samples + 1]
            missing = np.isnan(part[:, 0])
            part[missing] = simulated.states[0][missing]

        # Samples without a segment show the first known state.
        gap = np.isnan(states[:, 0])
        if gap.all():
            states[:] = plant.nominal_initial_state
        elif gap.any():
            states[gap] = states[np.flatnonzero(~gap)[0]]
        return plant.trajectory(states, ctrl)

    def rows(
        self,
        at: UnknownValues,
        *,
        derivatives: bool,
        central: bool | None = None,
        step: float = SENSITIVITY_STEP,
        by_all_parameters: bool = False,
    ) -> Iterator[SegmentRows | None]:
        """Simulate all segments, batch by batch and stretch of time by stretch of time.

        Args:
            at: The unknowns.
            derivatives: Whether to compute derivatives.
            central: True for two-sided differences; default: two-sided unless there is much data.
            step: Relative step of two-sided differences.
            by_all_parameters: Whether to differentiate by parameters that have no common columns as
                well.

        Yields:
            Predictions of rows of one segment; None, and nothing after it, where a simulation
            diverges.
        """
        plant = self.system.plant
        wanted = self.layout.estimated
        if by_all_parameters:
            wanted = np.ones(len(self.system.parameters), dtype=bool)

        # Two-sided differences are more accurate; with much data they take too long.
        directions = int(wanted.sum()) + self.private_count
        if central is None:
            central = self.sample_count * 2 * directions < SAMPLES_FOR_ONE_SIDED
        if not central:
            step = ONE_SIDED_STEP_FACTOR * step

        simulations = 1
        if derivatives:
            simulations += directions * (2 if central else 1)

        for recording, batch in self._batches(self._max_samples(simulations)):
            theta = self.layout.theta_of_recording(at, recording)
            longest = max(self.segments[i].samples for i in batch)
            responses = plant.derivatives.responses(
                theta,
                np.stack([self._initial_state(at, i) for i in batch]),
                np.stack([self._control(i, longest) for i in batch]),
                start_directions=self.start_directions if derivatives else None,
                central=central,
                step=step,
                wanted=wanted,
            )
            for response in responses:
                if response is None:
                    yield None
                    return
                for place, i in enumerate(batch):
                    found = self._rows_of(theta, i, place, response)
                    if found is not None:
                        yield found

    def _max_samples(self, simulations: int) -> int:
        """Largest number of samples of a batch, so that its states fit into memory for that many simulations of each."""
        state_size = 1 + self.system.plant.nominal_initial_state.size
        numbers_per_sample = simulations * self.system.grid.substeps * state_size
        return max(MAX_NUMBERS_AT_ONCE // numbers_per_sample, 1)

    def _batches(self, max_samples: int) -> Iterator[tuple[int, list[int]]]:
        """Indices of segments that are simulated together, and a recording whose parameters they have."""
        # Without parameters of single recordings, segments of all recordings share a batch.
        if not len(self.layout.per_recording):
            for batch in batches(self.segments, max_samples):
                yield 0, batch
            return

        for recording in range(len(self.recordings)):
            indices = self.segments_of(recording)
            for batch in batches([self.segments[i] for i in indices], max_samples):
                yield recording, [indices[k] for k in batch]

    def _initial_state(self, at: UnknownValues, index: int) -> Array:
        """(ns,) state at which a segment begins."""
        space = self.system.space
        parameters = self.system.parameters
        start = self.segments[index].start
        if self.layout.free_starts:
            return space.plus(start, self.start_directions @ at.private[index])

        theta = np.array(at.theta)
        theta[self.layout.private] = at.private[index]
        return space.plus(start, parameters.initial_state_derivative(space.nx) @ theta)

    def _control(self, index: int, samples: int) -> Array:
        """(samples, nu) control from the begin of a segment; the last value is held beyond the end of the recording."""
        segment = self.segments[index]
        recorded = self.recordings[segment.recording].ctrl
        ctrl = recorded[segment.begin : segment.begin + samples]
        held = np.repeat(ctrl[-1:], samples - len(ctrl), axis=0)
        return np.concatenate([ctrl, held])

    def _rows_of(
        self, theta: Array, index: int, place: int, response: Response
    ) -> SegmentRows | None:
        """Predictions of the rows of a segment that lie in a stretch of time; None where there are none.

        Args:
            theta: (p,) parameters of the recording.
            index: Index of the segment.
            place: Place of the segment in the batch.
            response: Simulation of the batch over the stretch.
        """
        segment = self.segments[index]
        recording = self.recordings[segment.recording]
        delay_derivative = self.system.parameters.delay_derivative
        delayed = bool(delay_derivative.any())

        # Places of the rows in samples since the begin of the segment, earlier by the delay of the
        # outputs.
        delay_samples = float(delay_derivative @ theta) / recording.dt
        wanted = recording.t[segment.rows] / recording.dt - segment.begin - delay_samples

        # Rows in this stretch; the last stretch includes its end.
        samples = response.y.shape[1] - 1
        place_in_segment = np.clip(wanted, 0.0, segment.samples)
        is_last = response.first + samples >= segment.samples
        inside = place_in_segment >= response.first
        inside &= (place_in_segment < response.first + samples) | is_last
        if not inside.any():
            return None

        rows = np.flatnonzero(inside) + segment.rows.start
        wanted = wanted[inside]
        y = response.y[place]
        common = None if response.common is None else response.common[place]
        private = None if response.private is None else response.private[place]

        # Rows on the grid are samples of the simulation.
        if recording.on_grid and not delayed:
            sample = np.rint(wanted).astype(int) - response.first
            return SegmentRows(
                segment=index,
                rows=rows,
                y=y[sample],
                common=None if common is None else common[sample],
                private=None if private is None else private[sample],
            )

        # Other rows are interpolated between the samples; the derivative by the delay is added.
        interpolation = OutputDelay.at(wanted - response.first, samples + 1, recording.dt)
        if common is not None:
            common = interpolation.apply(common)
            if delayed:
                common = common + interpolation.derivative(y)[..., None] * delay_derivative
        return SegmentRows(
            segment=index,
            rows=rows,
            y=interpolation.apply(y),
            common=common,
            private=None if private is None else interpolation.apply(private),
        )
