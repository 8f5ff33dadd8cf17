"""The least-squares problem of an identification: whitened residuals and their linearisation.

Predictions and measured values are compared at the times of the recordings. For the solver, the
linearised rows are condensed block by block.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise, zip_longest
from typing import Protocol, TypeVar

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import Budget
from mjfim.errors import ExperimentError, RecordingError, SimulationDivergedError
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording, align, on_grid_of
from mjfim.identification.segment_simulation import (
    SegmentBatch,
    SegmentRows,
    SegmentSimulation,
)
from mjfim.identification.segments import (
    Segment,
    cut_into_segments,
    free_release,
    recorded_release,
    whole_recordings,
)
from mjfim.identification.unknowns import UnknownLayout
from mjfim.information.null_space import COARSER_STEP_FACTOR, NullSpace
from mjfim.model.parameters import ParameterSet
from mjfim.optimize.condensed_least_squares import Condensed, Step, triangle
from mjfim.optimize.levenberg_marquardt import SearchSettings, Solution, UnknownValues
from mjfim.optimize.robust_losses import RobustLoss
from mjfim.plant.noise import Noise
from mjfim.plant.rollout_derivatives import SENSITIVITY_STEP
from mjfim.records.recording import Recording
from mjfim.records.trajectory import Trajectory

T = TypeVar("T")

# Work on one batch of a problem, at values of the unknowns.
BatchWork = Callable[["FitProblem", UnknownValues, SegmentBatch], T | None]

# Smallest number of rows of a block.
MIN_BLOCK_ROWS = 8

# Approximate largest number of blocks into which all rows are divided.
MAX_BLOCKS = 1024

# Standard deviation of the prior on a free initial state, relative to the natural sizes of the
# state. This weak prior keeps components finite that no output determines.
FREE_START_SIGMA = 1e3

# Largest increase of a delay during the search, in prior standard deviations of its parameters, or
# in their scales where there is no prior.
MAX_DELAY_GROWTH = 5.0

# Largest increase of a delay without a prior, relative to the duration of the shortest recording;
# five samples of a fast log would be too short.
MAX_DELAY_SHARE = 0.025

# Number of stated samples of the longest recording along which difference steps are calibrated.
CALIBRATION_SAMPLES = 1000


@dataclass(frozen=True, kw_only=True, eq=False)
class Residuals:
    """All rows of a linearised problem.

    Whitened residuals of the recordings come first, then priors, then pins.

    Attributes:
        r: (n,) residuals [standard deviations].
        J: (n, c + P n_private) derivatives by the common unknowns, then by the private ones of each
            segment.
    """

    r: Array
    J: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Pins:
    """Rows that hold combinations of parameters which no recording determines.

    Attributes:
        rows: (k, p) coefficients of the combinations, each over the magnitude of the parameter.
        theta: (p,) parameters at which the combinations are held.
    """

    rows: Array
    theta: Array

    def residual(self, theta: Array) -> Array:
        """Differences of the combinations from their held values.

        Args:
            theta: (p,) parameters.

        Returns:
            (k,) differences.
        """
        return np.asarray(self.rows @ (theta - self.theta))


class BatchWorkers(Protocol):
    """Does work on batches of segments in other processes."""

    def of_batches(
        self,
        problem: FitProblem,
        work: BatchWork[T],
        batches: Sequence[SegmentBatch],
        at: UnknownValues,
    ) -> Sequence[T | None]:
        """Do a work on all batches.

        Args:
            problem: The problem.
            work: Method of the problem that does it for one batch.
            batches: The batches.
            at: The unknowns.

        Returns:
            What is found for every batch, in their order.
        """

    def solutions(
        self,
        problem: FitProblem,
        begins: Sequence[UnknownValues],
        settings: SearchSettings,
        budget: Budget,
    ) -> Iterator[Solution | None]:
        """Search from several starts.

        Args:
            problem: The problem.
            begins: Unknowns at which the searches begin.
            settings: Tolerance and number of iterations.
            budget: Ends the searches early.

        Yields:
            The solution of every search that was not stopped before its begin, in their order; None
            where the simulation diverges at the begin.
        """


@dataclass(frozen=True, kw_only=True, eq=False)
class FitProblem:
    """Residuals of recordings as functions of the unknowns; a `levenberg_marquardt.Problem`.

    Every segment has private unknowns: the deviations of its initial state, or its whole initial
    state where that is measured. All other parameters are common unknowns.

    Attributes:
        simulation: Simulation of the segments.
        masks: (M, ny) for every recording, True for the measured values that count.
        noise: Noise of the outputs.
        loss: Loss of a whitened residual.
        pins: Combinations that no recording determines, and their values.
        with_priors: Whether priors of the parameters count.
        difference_step: Relative step of the two-sided differences of a linearisation.
        workers: Does the work on batches of segments; None for this process.
    """

    simulation: SegmentSimulation
    masks: tuple[np.ndarray, ...]
    noise: Noise
    loss: RobustLoss
    pins: Pins
    with_priors: bool
    difference_step: float = SENSITIVITY_STEP
    workers: BatchWorkers | None = None

    @classmethod
    def of(
        cls, system: System, recordings: Sequence[Recording], *, data_only: bool = False
    ) -> FitProblem:
        """The problem that the `[fit]` table of a system's experiment states.

        Args:
            system: The system.
            recordings: Recordings in SI units.
            data_only: Whether to leave priors and bounds out.

        Returns:
            The problem.

        Raises:
            RecordingError: There is no recording, or one cannot be used.
            ExperimentError: Parameters move the stated initial state, but the settings of the fit
                take the initial state from the measured values.
        """
        if not recordings:
            raise RecordingError("identify needs at least one recording")

        settings = system.experiment.fit
        parameters = system.parameters
        stated_substeps = system.grid.substeps
        system = on_grid_of(system, recordings)
        aligned = tuple(align(system, recording) for recording in recordings)

        # Difference steps depend on how strongly each parameter changes the recorded motion.
        longest = max(aligned, key=lambda recording: len(recording.ctrl))
        samples = CALIBRATION_SAMPLES * stated_substeps // system.grid.substeps
        system = _calibrated_along(system, longest, samples)

        # The initial states of segments are not stated; they come from the measured values.
        free_starts = settings.start == "measured" or settings.segments is not None
        free_starts = free_starts or free_release(system)
        segments, directions = _segments_of(system, aligned, free_starts)

        masks = tuple(_counted_values(recording, free_starts) for recording in aligned)
        if not any(mask.any() for mask in masks):
            raise RecordingError("the recordings contain no measured value after t = 0")

        layout = UnknownLayout.of(
            parameters, len(aligned), free_starts=free_starts, bounded=not data_only
        )
        simulation = SegmentSimulation(
            system=system,
            recordings=aligned,
            segments=segments,
            layout=layout,
            start_directions=directions,
        )
        return cls(
            simulation=simulation,
            masks=masks,
            noise=system.noise,
            loss=RobustLoss(kind=settings.loss, scale=settings.loss_scale),
            pins=Pins(rows=np.zeros((0, len(parameters))), theta=np.array(parameters.guess)),
            with_priors=not data_only,
        )

    # ---- variants

    def on_workers(self, workers: BatchWorkers) -> FitProblem:
        """This problem, the batches of which are simulated by workers.

        Args:
            workers: The workers.
        """
        return replace(self, workers=workers)

    def unbounded(self) -> FitProblem:
        """This problem without bounds."""
        return replace(self, simulation=self.simulation.with_layout(self.layout.unbounded()))

    def with_shared_held(self) -> FitProblem:
        """This problem with all shared parameters held, so that it needs no pins."""
        simulation = self.simulation.with_layout(self.layout.without_shared())
        return replace(
            self, simulation=simulation, pins=replace(self.pins, rows=self.pins.rows[:0])
        )

    def with_noise(self, noise: Noise) -> FitProblem:
        """This problem with other noise.

        Args:
            noise: Noise of the outputs.

        Returns:
            The problem.
        """
        return replace(self, noise=noise)

    def with_longer_differences(self, factor: float) -> FitProblem:
        """This problem with longer steps of the differences that linearise it.

        They give the slope of the trend where contacts, dry friction or chaos make the residuals
        rough, and are less accurate where the residuals are smooth.

        Args:
            factor: Factor by which the steps are longer.

        Returns:
            The problem.
        """
        return replace(self, difference_step=factor * self.difference_step)

    def of_segments(self, indices: np.ndarray) -> FitProblem:
        """The problem of some segments only; only their rows count.

        Args:
            indices: Indices of the segments.

        Returns:
            The problem.
        """
        simulation = self.simulation.of_segments(indices)

        masks = tuple(np.zeros_like(mask) for mask in self.masks)
        for segment in simulation.segments:
            rows = segment.rows
            masks[segment.recording][rows] = self.masks[segment.recording][rows]

        return replace(self, simulation=simulation, masks=masks)

    def masked(self, masks: Sequence[np.ndarray]) -> FitProblem:
        """This problem with some measured values only.

        Args:
            masks: (M, ny) for every recording, True for values that may count.

        Returns:
            The problem of the values that count in both.
        """
        both = tuple(mask & counted for mask, counted in zip(masks, self.masks, strict=True))
        return replace(self, masks=both)

    def pinned(self, theta: Array, null_space: NullSpace) -> FitProblem:
        """This problem with the combinations of parameters held that no recording determines.

        A pin has the weight of a prior whose standard deviation is the magnitude of the parameters.

        Args:
            theta: (p,) parameters at which the combinations are held.
            null_space: Directions of theta about which there is no information.

        Returns:
            The problem.
        """
        magnitude = self.system.parameters.magnitude
        orthonormal = np.linalg.qr(null_space.directions / magnitude[:, None])[0]
        pins = Pins(rows=orthonormal.T / magnitude, theta=np.array(theta))
        return replace(self, pins=pins)

    # ---- sizes

    @property
    def system(self) -> System:
        """The system, its difference steps calibrated along the longest recording."""
        return self.simulation.system

    @property
    def recordings(self) -> tuple[AlignedRecording, ...]:
        """The recordings on the sample grid."""
        return self.simulation.recordings

    @property
    def segments(self) -> tuple[Segment, ...]:
        """The segments."""
        return self.simulation.segments

    @property
    def layout(self) -> UnknownLayout:
        """Layout of the unknowns."""
        return self.simulation.layout

    @property
    def sample_count(self) -> int:
        """Number of samples of all segments together."""
        return self.simulation.sample_count

    @property
    def row_count(self) -> int:
        """Number of rows of all recordings."""
        return sum(len(recording.t) for recording in self.recordings)

    @property
    def value_count(self) -> int:
        """Number of measured values that count."""
        return int(sum(mask.sum() for mask in self.masks))

    @property
    def unknown_count(self) -> int:
        """Number of all unknowns."""
        return self.layout.column_count + len(self.segments) * self.simulation.private_count

    @property
    def segments_with_values(self) -> np.ndarray:
        """Indices of the segments that contain a measured value that counts."""
        indices = []
        for i, segment in enumerate(self.segments):
            if self.masks[segment.recording][segment.rows].any():
                indices.append(i)

        return np.array(indices, dtype=np.intp)

    @cached_property
    def _rows_per_segment(self) -> np.ndarray:
        """(P,) number of rows of every segment."""
        return np.array([segment.rows.stop - segment.rows.start for segment in self.segments])

    @cached_property
    def _block_offsets(self) -> np.ndarray:
        """(P+1,) first block of every segment, and the number of all blocks."""
        block_rows = max(MIN_BLOCK_ROWS, math.ceil(self.row_count / MAX_BLOCKS))
        counts = np.rint(self._rows_per_segment / block_rows).astype(int)
        counts = np.maximum(counts, 1)
        return np.concatenate([[0], np.cumsum(counts)])

    @property
    def blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """(B,) index of the recording, and (B,) mean number of rows, of every block."""
        counts = np.diff(self._block_offsets)
        recording_of_segment = [segment.recording for segment in self.segments]
        recording_of_block = np.repeat(recording_of_segment, counts)

        mean_rows = self._rows_per_segment / counts
        return recording_of_block, np.repeat(mean_rows, counts)

    # ---- unknowns

    @property
    def lower(self) -> Array:
        """(c,) lower bounds of the common unknowns."""
        return self.layout.lower

    @property
    def upper(self) -> Array:
        """(c,) upper bounds of the common unknowns."""
        return self.layout.upper

    def begin(self, theta: Array) -> UnknownValues:
        """Unknowns at given parameters, with every initial state as stated or measured.

        Args:
            theta: (p,) parameters.

        Returns:
            The unknowns.
        """
        return self.layout.begin(theta, len(self.segments), self.simulation.private_count)

    def common_values(self, at: UnknownValues) -> Array:
        """Values of the common unknowns.

        Args:
            at: The unknowns.

        Returns:
            (c,) values.
        """
        return self.layout.common_values(at)

    def moved(self, at: UnknownValues, step: Step, fraction: float) -> UnknownValues:
        """The unknowns after a fraction of a step, clipped to the bounds.

        Args:
            at: The unknowns.
            step: Step of all unknowns.
            fraction: Fraction of the step.

        Returns:
            The moved unknowns.
        """
        return self.layout.moved(at, step, fraction)

    def theta(self, at: UnknownValues) -> Array:
        """Parameters, with the values of the first recording.

        Args:
            at: The unknowns.

        Returns:
            (p,) parameters [theta-unit].
        """
        return self.layout.theta(at)

    # ---- residuals

    def predict(self, at: UnknownValues) -> list[Array] | None:
        """Predicted outputs of every recording at its times.

        Args:
            at: The unknowns.

        Returns:
            (M, ny) outputs of every recording [y-unit]; None where a simulation diverges.
        """
        return self.simulation.predict(at)

    def motion(self, at: UnknownValues, recording: int) -> Trajectory | None:
        """The fitted motion of one recording.

        Args:
            at: The unknowns.
            recording: Index of the recording.

        Returns:
            The motion; None where it diverges.
        """
        return self.simulation.motion(at, recording)

    def errors(self, predicted: Sequence[Array]) -> list[Array]:
        """Predicted minus measured values of every output, for all recordings in their order.

        Args:
            predicted: (M, ny) predicted outputs of every recording [y-unit].

        Returns:
            One array for each output [y-unit].
        """
        data = zip(predicted, self.recordings, self.masks, strict=True)
        differences = [(y - recording.y, mask) for y, recording, mask in data]

        errors = []
        for j in range(len(self.system.outputs)):
            parts = [difference[mask[:, j], j] for difference, mask in differences]
            errors.append(np.concatenate(parts))
        return errors

    def cost(self, at: UnknownValues) -> float:
        """Half of the sum of the residuals' loss and of the squared priors and pins.

        Args:
            at: The unknowns.

        Returns:
            The cost; infinite where a simulation diverges.
        """
        total = 0.0
        batches = self.simulation.batches(derivatives=False)
        for losses in self._of_batches(FitProblem.losses_of_batch, batches, at):
            if losses is None:
                return np.inf
            for loss in losses:
                total += loss

        common = self._common_rows(at)[:, -1]
        private = self._private_rows(at)[:, :, -1]
        return 0.5 * (total + float(common @ common) + float(np.sum(private**2)))

    def condense(self, at: UnknownValues) -> Condensed | None:
        """Linearise about the unknowns and condense block by block.

        Args:
            at: The unknowns.

        Returns:
            The linearisation; None where a perturbed simulation diverges.
        """
        m = self.simulation.private_count + self.layout.column_count + 1
        blocks = np.zeros((int(self._block_offsets[-1]), m, m))
        segment_of_block = np.repeat(np.arange(len(self.segments)), np.diff(self._block_offsets))

        batches = self.simulation.batches(derivatives=True, step=self.difference_step)
        for found in self._of_batches(FitProblem.blocks_of_batch, batches, at):
            if found is None:
                return None
            for index, block in found.items():
                blocks[index] = block

        return Condensed(
            blocks=blocks,
            segment_of_block=segment_of_block,
            private_rows=self._private_rows(at),
            common_rows=self._common_rows(at),
        )

    def losses_of_batch(self, at: UnknownValues, batch: SegmentBatch) -> list[float] | None:
        """Loss of the residuals of a batch, which the cost adds in this order.

        Args:
            at: The unknowns.
            batch: The batch.

        Returns:
            The losses; None where a simulation diverges.
        """
        losses = []
        for rows in self.simulation.rows_of_batch(at, batch):
            if rows is None:
                return None
            losses.append(self.loss.value(self._whitened_residual(rows)))
        return losses

    def blocks_of_batch(self, at: UnknownValues, batch: SegmentBatch) -> dict[int, Array] | None:
        """Condensed blocks of a batch, all of whose rows are in it.

        Args:
            at: The unknowns.
            batch: The batch, with derivatives.

        Returns:
            (m, m) triangle of each block by its index; None where a perturbed simulation diverges.
        """
        m = self.simulation.private_count + self.layout.column_count + 1
        empty = np.zeros((m, m))
        blocks: dict[int, Array] = {}
        for rows in self.simulation.rows_of_batch(at, batch):
            if rows is None:
                return None

            # A robust loss is linearised by weights (iteratively reweighted least squares).
            block, r, J = self._linearised(rows)
            weighted = np.concatenate([J, r[:, None]], axis=1) * self.loss.weight(r)[:, None]

            # Rows are added to the triangle of their block.
            edges = np.flatnonzero(np.diff(block, prepend=-1, append=-1))
            for first, last in pairwise(edges):
                index = int(block[first])
                joined = np.concatenate([blocks.get(index, empty), weighted[first:last]])
                blocks[index] = triangle(joined)
        return blocks

    def _of_batches(
        self, work: BatchWork[T], batches: Iterable[SegmentBatch], at: UnknownValues
    ) -> Iterator[T | None]:
        """Results of a work on batches, in the order of the batches.

        Args:
            work: `losses_of_batch` or `blocks_of_batch`.
            batches: The batches.
            at: The unknowns.
        """
        if self.workers is not None:
            yield from self.workers.of_batches(self, work, list(batches), at)
            return

        for batch in batches:
            yield work(self, at, batch)

    def dense(self, at: UnknownValues) -> Residuals | None:
        """All rows without a loss: recordings first, then priors and pins.

        For small problems and tests.

        Args:
            at: The unknowns.

        Returns:
            Residuals with their derivatives; None where a perturbed simulation diverges.
        """
        n = self.simulation.private_count
        residuals = []
        jacobians = []

        for rows in self.simulation.rows(at, derivatives=True, step=self.difference_step):
            if rows is None:
                return None
            _, residual, J = self._linearised(rows)
            residuals.append(residual)
            jacobians.append(self._wide_jacobian(J[:, n:], J[:, :n], rows.segment))

        common_rows = self._common_rows(at)
        no_private = np.zeros((len(common_rows), n))
        residuals.append(common_rows[:, -1])
        jacobians.append(self._wide_jacobian(common_rows[:, :-1], no_private, 0))

        for segment, private_rows in enumerate(self._private_rows(at)):
            common, private = private_rows[:, n:-1], private_rows[:, :n]
            residuals.append(private_rows[:, -1])
            jacobians.append(self._wide_jacobian(common, private, segment))

        return Residuals(r=np.concatenate(residuals), J=np.concatenate(jacobians))

    def _wide_jacobian(self, common: Array, private: Array, segment: int) -> Array:
        """(k, c + P n) derivatives by all unknowns, for rows of one segment.

        Args:
            common: (k, c) derivatives by the common unknowns.
            private: (k, n) derivatives by the private unknowns of the segment.
            segment: Index of the segment.
        """
        n = private.shape[1]
        c = common.shape[1]
        first = c + segment * n

        wide = np.zeros((len(common), self.unknown_count))
        wide[:, :c] = common
        wide[:, first : first + n] = private
        return wide

    def sensitivity_rows(self, at: UnknownValues) -> list[tuple[Array, Array]]:
        """Condensed rows of the whitened sensitivity G, and their change with a longer step.

        The longer difference step shows the error of the differences. Where the whole initial state
        is free, rows are projected onto the complement of its derivatives.

        Args:
            at: The unknowns.

        Returns:
            (k, p) rows and (k, p) changes of every segment [standard deviations / theta-unit], k at
            most 2p + 2n.

        Raises:
            SimulationDivergedError: A perturbed simulation diverges.
        """
        condensed = self._condensed_sensitivity(at)
        n = self.simulation.private_count if self.layout.free_starts else 0

        found = []
        for segment in sorted(condensed):
            J, change = np.split(condensed[segment], 2, axis=1)
            by_theta = J[:, n:]
            change_by_theta = change[:, n:]

            # A free initial state explains everything in the span of its derivatives.
            Q = np.linalg.qr(J[:, :n])[0]
            remaining = by_theta - Q @ (Q.T @ by_theta)
            remaining_change = change_by_theta - Q @ (Q.T @ change_by_theta)
            found.append((remaining, remaining_change))
        return found

    def _condensed_sensitivity(self, at: UnknownValues) -> dict[int, Array]:
        """Triangle of the whitened sensitivity and its change with a longer step, by segment.

        Its (k, 2 (n+p)) rows hold the derivatives and, next to them, their changes.
        """
        fine, coarse = (
            self.simulation.rows(
                at, derivatives=True, central=True, step=step, by_all_parameters=True
            )
            for step in (SENSITIVITY_STEP, COARSER_STEP_FACTOR * SENSITIVITY_STEP)
        )

        condensed: dict[int, Array] = {}
        for rows, coarse_rows in zip_longest(fine, coarse):
            if rows is None:
                name = self.recordings[0].name
                raise SimulationDivergedError(
                    f"{name}: the simulation diverges under the recorded control"
                )

            # Where the simulation with the longer step diverges, the change is unknown.
            J = self._whitened_sensitivity(rows)
            change = np.zeros_like(J)
            if coarse_rows is not None:
                change = self._whitened_sensitivity(coarse_rows) - J

            both = np.concatenate([J, change], axis=1)
            earlier = condensed.get(rows.segment, both[:0])
            condensed[rows.segment] = triangle(np.concatenate([earlier, both]))
        return condensed

    # ---- rows

    def _mask_of(self, rows: SegmentRows) -> np.ndarray:
        """(k, ny) True for the values of k rows that count."""
        recording = self.segments[rows.segment].recording
        return np.asarray(self.masks[recording][rows.rows])

    def _whitened_sensitivity(self, rows: SegmentRows) -> Array:
        """(k, n+p) whitened derivatives, by the initial state where that is free, then by theta."""
        common, private = rows.jacobians
        G = common
        if self.layout.free_starts:
            G = np.concatenate([private, common], axis=2)
        return self.noise.whiten_present(G, self._mask_of(rows))

    def _whitened_residual(self, rows: SegmentRows) -> Array:
        """(n,) whitened residuals of the values of some rows that count, row by row."""
        mask = self._mask_of(rows)
        segment = self.segments[rows.segment]
        measured = self.recordings[segment.recording].y[rows.rows]

        # Values that do not count may be NaN.
        residual = np.where(mask, rows.y - measured, 0.0)
        return self.noise.whiten_present(residual, mask)

    def _linearised(self, rows: SegmentRows) -> tuple[np.ndarray, Array, Array]:
        """Block, whitened residual and derivatives of every value that counts.

        The (n, n_private + c) derivatives are those by the private, then by the common unknowns.
        """
        mask = self._mask_of(rows)
        segment = self.segments[rows.segment]
        common, private = rows.jacobians
        columns = self.layout.to_columns(common, segment.recording)
        G = np.concatenate([private, columns], axis=2)

        # Every value belongs to the block of its row.
        block_of_row = self._block_of_rows(rows)
        block = np.broadcast_to(block_of_row[:, None], mask.shape)[mask]
        return block, self._whitened_residual(rows), self.noise.whiten_present(G, mask)

    def _block_of_rows(self, rows: SegmentRows) -> np.ndarray:
        """(k,) index of the block of k rows; a segment is divided evenly into its blocks."""
        index = rows.segment
        first = self._block_offsets[index]
        count = self._block_offsets[index + 1] - first
        row_in_segment = rows.rows - self.segments[index].rows.start
        return np.asarray(first + row_in_segment * count // self._rows_per_segment[index])

    def _common_rows(self, at: UnknownValues) -> Array:
        """(l, c+1) rows `[J, r]` of priors and pins on the common unknowns."""
        rows = np.zeros((0, self.layout.column_count + 1))
        if self.with_priors:
            rows = self.layout.prior_rows(at)
        if self._pins_involve_private:
            return rows

        residual = self.pins.residual(self.theta(at))
        columns = self.layout.to_columns(self.pins.rows, 0)
        return np.concatenate([rows, np.column_stack([columns, residual])])

    @cached_property
    def _pins_involve_private(self) -> bool:
        """True where pins involve private unknowns."""
        return bool(self.pins.rows[:, self.layout.private].any())

    def _private_rows(self, at: UnknownValues) -> Array:
        """(P, k, m) rows `[J_private, J_common, r]` of priors and pins on private unknowns."""
        n = self.simulation.private_count
        m = n + self.layout.column_count + 1
        count = len(self.segments)
        diagonal = np.arange(n)

        # A weak prior on a free initial state, for components that no output determines.
        if self.layout.free_starts:
            rows = np.zeros((count, n, m))
            sigma = FREE_START_SIGMA * self.system.plant.sizes.state
            rows[:, diagonal, diagonal] = 1.0 / sigma
            rows[:, :, -1] = at.private / sigma
            return rows
        if not n:
            return np.zeros((count, 0, m))

        # Stated priors on the deviations of the initial state.
        parameters = self.system.parameters
        private = self.layout.private
        weight = np.sqrt(np.diag(parameters.prior_information))[private] * self.with_priors
        pin_count = len(self.pins.rows) if self._pins_involve_private else 0
        rows = np.zeros((count, n + pin_count, m))
        rows[:, diagonal, diagonal] = weight
        rows[:, :n, -1] = weight * (at.private - parameters.guess[private])

        # Pins that involve private unknowns belong to the first segment.
        if pin_count:
            rows[0, n:, :n] = self.pins.rows[:, private]
            rows[0, n:, n:-1] = self.layout.to_columns(self.pins.rows, 0)
            rows[0, n:, -1] = self.pins.residual(self.theta(at))
        return rows


def _calibrated_along(system: System, recording: AlignedRecording, samples: int) -> System:
    """The system with difference steps that suit the first samples of a recording."""
    guess, control = system.parameters.guess, recording.ctrl[:samples]
    nominal = system.plant.nominal_initial_state
    begun = replace(
        system, plant=system.plant.with_initial_state(recorded_release(system, recording))
    )
    calibrated = begun.calibrated(guess, control)
    return replace(calibrated, plant=calibrated.plant.with_initial_state(nominal))


def _segments_of(
    system: System, recordings: Sequence[AlignedRecording], free_starts: bool
) -> tuple[tuple[Segment, ...], Array]:
    """Segments, and (nx, n) directions in which their private unknowns move the initial state."""
    parameters = system.parameters
    if free_starts:
        _require_measured_starts(system)
        length = system.experiment.fit.segments
        duration = min(float(recording.t[-1]) for recording in recordings)
        delay = _max_delay(parameters, duration)
        segments = cut_into_segments(system, recordings, length, delay)
        return segments, np.eye(system.space.nx)

    by_theta = parameters.initial_state_derivative(system.space.nx)
    directions = by_theta[:, parameters.initial_deviations]
    return whole_recordings(system, recordings), directions


def _require_measured_starts(system: System) -> None:
    """Raise ExperimentError where a parameter moves the initial state, which is measured."""
    parameters = system.parameters
    moves_start = parameters.initial_state_derivative(system.space.nx).any(axis=0)
    if moves_start.any():
        name = parameters.names[int(np.argmax(moves_start))]
        raise ExperimentError(
            f"{system.experiment.source}: {name}: the initial state is free where fit.segments or "
            'fit.start = "measured" is stated; remove nuisance.initial and parameters of the '
            "initial state, or remove the settings of the fit"
        )


def _max_delay(parameters: ParameterSet, duration: float) -> float:
    """Largest delay of the outputs that the search may try [s].

    Args:
        parameters: The parameters.
        duration: Duration of the shortest recording [s].
    """
    per_parameter = parameters.delay_derivative
    if not per_parameter.any():
        return 0.0

    growth = MAX_DELAY_GROWTH * np.array([p.prior or p.scale for p in parameters.parameters])
    has_prior = np.array([p.prior is not None for p in parameters.parameters])
    grows = ~has_prior & (per_parameter != 0.0)
    share = MAX_DELAY_SHARE * duration / np.abs(per_parameter[grows])
    growth[grows] = np.maximum(growth[grows], share)

    latest = np.minimum(parameters.guess + growth, parameters.upper)
    return max(float(per_parameter @ latest), 0.0)


def _counted_values(recording: AlignedRecording, free_starts: bool) -> np.ndarray:
    """(M, ny) True for the measured values that count.

    Those at a stated initial state do not count, because they contain no information.
    """
    mask = np.array(recording.measured)
    if not free_starts:
        mask[0] = False
    return mask
