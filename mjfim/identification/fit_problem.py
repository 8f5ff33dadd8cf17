"""The least-squares problem of an identification: whitened residuals and their linearisation.

Predictions and measured values are compared at the times of the recordings. For the solver, the
linearised rows are condensed block by block.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import TypeVar

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError, SimulationDivergedError
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording, align, on_grid_of
from mjfim.identification.fit_workers import FitWorkers, ProblemWork
from mjfim.identification.segment_simulation import (
    DivergedSegmentError,
    SegmentBatch,
    SegmentRows,
    SegmentSimulation,
)
from mjfim.identification.segments import (
    free_segments,
    has_free_starts,
    recorded_release,
    spread_over_data,
    stated_segments,
)
from mjfim.information.null_space import COARSER_STEP_FACTOR
from mjfim.optimize.condensed_least_squares import Condensed, RobustLoss, triangle
from mjfim.optimize.levenberg_marquardt import UnknownValues
from mjfim.parallel.budget import Budget
from mjfim.plant.outputs import Noise
from mjfim.plant.plant import SENSITIVITY_STEP
from mjfim.records.trajectory import Recording

T = TypeVar("T")

# Work on one batch of a problem, at values of the unknowns. It raises `DivergedSegmentError`.
BatchWork = Callable[["FitProblem", UnknownValues, SegmentBatch], T]


# Number of stated samples of the longest recording along which difference steps are calibrated.
CALIBRATION_SAMPLES = 1000


@dataclass(frozen=True, kw_only=True, eq=False)
class FitProblem(SegmentSimulation):
    """Residuals of recordings as functions of the unknowns; a `levenberg_marquardt.Problem`.

    Every segment has private unknowns: the deviations of its initial state, or its whole initial
    state where that is measured. All other parameters are common unknowns.

    Attributes:
        masks: (M, ny) for every recording, True for the measured values that count.
        noise: Noise of the outputs.
        loss: Loss of a whitened residual.
        workers: Does the work on batches of segments; None for this process.
    """

    masks: tuple[np.ndarray, ...]
    noise: Noise
    loss: RobustLoss
    workers: FitWorkers | None = None

    @classmethod
    def of(
        cls,
        system: System,
        recordings: Sequence[Recording],
        *,
        data_only: bool = False,
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

        samples = CALIBRATION_SAMPLES * stated_substeps // system.grid.substeps
        system = with_suitable_differences(system, aligned, samples)

        # The initial states of segments are not stated; they come from the measured values.
        free_starts = has_free_starts(system)
        is_held = np.isin(parameters.names, list(settings.hold))
        segments, directions = stated_segments(system, aligned)

        # Values at a stated initial state do not count, because they contain no information.
        masks = tuple(np.array(recording.measured) for recording in aligned)
        for mask in () if free_starts else masks:
            mask[0] = False
        if not any(mask.any() for mask in masks):
            raise RecordingError("the recordings contain no measured value after t = 0")

        return cls(
            system=system,
            recordings=aligned,
            segments=segments,
            start_directions=directions,
            parameters=parameters,
            shared=np.flatnonzero(~parameters.recording_specific & ~is_held),
            free_starts=free_starts,
            bounded=not data_only,
            with_priors=not data_only,
            pins=np.zeros((0, len(parameters))),
            pinned_at=parameters.guess,
            masks=masks,
            noise=system.noise,
            loss=RobustLoss(kind=settings.loss, scale=settings.loss_scale),
        )

    # ---- variants

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
        rough, and are less accurate where the residuals are smooth. They are two-sided, also with
        much data: one side alone shows the slope of the roughness as well.

        Args:
            factor: Factor by which the steps are longer.

        Returns:
            The problem.
        """
        return replace(self, difference_step=factor * self.difference_step, central=True)

    def of_segments(self, indices: np.ndarray) -> FitProblem:
        """The problem of some segments only; only their rows count."""
        segments = tuple(self.segments[i] for i in indices)
        masks = tuple(np.zeros_like(mask) for mask in self.masks)
        for segment in segments:
            masks[segment.recording][segment.rows] = self.masks[segment.recording][segment.rows]
        return replace(self, segments=segments, masks=masks)

    def spread(self, samples: int, least: int) -> np.ndarray:
        """Indices of some segments that are spread over the data.

        Args:
            samples: About the number of their samples.
            least: Least number of segments, if there are as many.
        """
        count = len(self.segments)
        wanted = max(samples * count // self.sample_count, least)
        return spread_over_data(count, min(wanted, count))

    def of_first_parts(self, share: float, most: int | None = None) -> FitProblem:
        """The problem of the first part of every segment only.

        It shows the initial states nearly as well, at less cost.

        Args:
            share: Share of the rows of a segment that count.
            most: Largest number of these rows; None for any.

        Returns:
            The problem, with as many segments.
        """
        segments = tuple(
            segment.first_part(self.recordings[segment.recording], share, most)
            for segment in self.segments
        )
        return replace(self, segments=segments)

    def cut(self, length: float | None) -> FitProblem | None:
        """This problem over segments of a length [s] with free initial states.

        Parameters of the initial state say nothing about segments, and keep their values.

        Args:
            length: About the length of a segment [s]; None for whole recordings.

        Returns:
            The problem without pins; None where the segments would be too short.
        """
        parameters = self.parameters
        is_held = self.system.plant.initial_state_derivative.any(axis=0)
        is_held |= np.isin(parameters.names, list(self.system.experiment.fit.hold))
        try:
            segments, directions = free_segments(self.system, self.recordings, length)
        except RecordingError:
            return None
        return replace(
            self,
            segments=segments,
            shared=np.flatnonzero(~parameters.recording_specific & ~is_held),
            free_starts=True,
            start_directions=directions,
            masks=tuple(np.array(recording.measured) for recording in self.recordings),
            pins=self.pins[:0],
        )

    def masked(self, masks: Sequence[np.ndarray]) -> FitProblem:
        """This problem with some measured values only.

        Args:
            masks: (M, ny) for every recording, True for values that may count.

        Returns:
            The problem of the values that count in both.
        """
        both = tuple(mask & counted for mask, counted in zip(masks, self.masks, strict=True))
        return replace(self, masks=both)

    # ---- sizes

    @property
    def value_count(self) -> int:
        """Number of measured values that count."""
        return int(sum(mask.sum() for mask in self.masks))

    @property
    def unknown_count(self) -> int:
        """Number of all unknowns."""
        return self.column_count + len(self.segments) * self.private_count

    @property
    def segments_with_values(self) -> np.ndarray:
        """Indices of the segments that contain a measured value that counts."""
        return np.flatnonzero(
            [self.masks[segment.recording][segment.rows].any() for segment in self.segments]
        )

    @property
    def curved_rows(self) -> Callable[[UnknownValues, Array], Array | None] | None:
        """Rows of priors and pins along a step, where inertias of whole bodies are unknown."""
        return self.common_rows_after if self.shared_bodies else None

    # ---- residuals

    def predict(self, at: UnknownValues) -> list[Array] | None:
        """Predicted outputs of every recording at its times.

        Args:
            at: The unknowns.

        Returns:
            (M, ny) outputs of every recording [y-unit], NaN in rows without a segment; None where a
            simulation diverges.
        """
        outputs = [np.full(recording.y.shape, np.nan) for recording in self.recordings]
        batches = self.batches(derivatives=False)
        for found in self.of_batches(FitProblem.outputs_of_batch, batches, at):
            if found is None:
                return None
            for part in found:
                outputs[part.recording][part.rows] = part.y
        return outputs

    def errors_at(self, at: UnknownValues) -> list[Array] | None:
        """Predicted minus measured values of every output; None where a simulation diverges."""
        predicted = self.predict(at)
        if predicted is None:
            return None
        return [self.errors_of(j, predicted) for j in range(len(self.system.outputs))]

    def errors_of(self, output: int, predicted: Sequence[Array]) -> Array:
        """Predicted minus measured values of one output, for all recordings in their order.

        Args:
            output: Index of the output.
            predicted: (M, ny) predicted outputs of every recording [y-unit].

        Returns:
            (n,) differences of the values that count [y-unit].
        """
        parts = []
        for y, recording, mask in zip(predicted, self.recordings, self.masks, strict=True):
            counted = mask[:, output]
            parts.append(y[counted, output] - recording.y[counted, output])
        return np.concatenate(parts)

    def cost(self, at: UnknownValues) -> float:
        """Half of the sum of the residuals' loss and of the squared priors and pins.

        Args:
            at: The unknowns.

        Returns:
            The cost; infinite where a simulation diverges.
        """
        total = 0.0
        batches = self.batches(derivatives=False)
        for losses in self.of_batches(FitProblem.losses_of_batch, batches, at):
            if losses is None:
                return np.inf
            for loss in losses:
                total += loss

        # Priors and pins.
        common = self.common_rows(at)[:, -1]
        private = self.private_rows(at)[:, :, -1]
        return 0.5 * total + 0.5 * (float(common @ common) + float(np.sum(private**2)))

    def condense(self, at: UnknownValues) -> Condensed | None:
        """Linearise about the unknowns and condense block by block.

        Args:
            at: The unknowns.

        Returns:
            The linearisation; None where a perturbed simulation diverges.
        """
        m = self.private_count + self.column_count + 1
        blocks = np.zeros((self.block_count, m, m))

        batches = self.batches(derivatives=True)
        for found in self.of_batches(FitProblem.blocks_of_batch, batches, at):
            if found is None:
                return None
            for index, block in found.items():
                blocks[index] = block

        return Condensed(
            blocks=blocks,
            segment_of_block=self.segment_of_block,
            private_rows=self.private_rows(at),
            common_rows=self.common_rows(at),
        )

    def outputs_of_batch(self, at: UnknownValues, batch: SegmentBatch) -> list[SegmentRows]:
        """Predicted outputs of the rows of a batch."""
        return list(self.rows_of_batch(at, batch))

    def losses_of_batch(self, at: UnknownValues, batch: SegmentBatch) -> list[float]:
        """Losses of the rows of a batch, which the cost adds in this order."""
        return [self.loss.value(self.residual(rows)) for rows in self.rows_of_batch(at, batch)]

    def blocks_of_batch(self, at: UnknownValues, batch: SegmentBatch) -> dict[int, Array]:
        """Condensed blocks of a batch, all of whose rows are in it.

        Args:
            at: The unknowns.
            batch: The batch, with derivatives.

        Returns:
            (m, m) triangle of each block by its index.

        Raises:
            DivergedSegmentError: A perturbed simulation diverges.
        """
        m = self.private_count + self.column_count + 1
        empty = np.zeros((m, m))
        blocks: dict[int, Array] = {}
        for rows in self.rows_of_batch(at, batch):
            # The weights are those of iteratively reweighted least squares.
            place, r, J = self.linearised(rows)
            weighted = np.column_stack([J, r]) * self.loss.weight(r)[:, None]

            # Values are added to the triangle of the block of their row.
            block = self.blocks_of_rows(rows.segment, rows.rows)[place]
            edges = np.flatnonzero(np.diff(block, prepend=-1, append=-1))
            for first, last in pairwise(edges):
                index = int(block[first])
                joined = np.concatenate([blocks.get(index, empty), weighted[first:last]])
                blocks[index] = triangle(joined)
        return blocks

    def mask_of(self, rows: SegmentRows) -> np.ndarray:
        """(k, ny) True for the values of k rows that count."""
        return np.asarray(self.masks[rows.recording][rows.rows])

    def residual(self, rows: SegmentRows) -> Array:
        """(n,) whitened residuals of the values of some rows that count [standard deviations]."""
        mask = self.mask_of(rows)
        measured = self.recordings[rows.recording].y[rows.rows]

        # Values that do not count may be NaN.
        return self.noise.whiten_present(np.where(mask, rows.y - measured, 0.0), mask)

    def linearised(self, rows: SegmentRows) -> tuple[np.ndarray, Array, Array]:
        """Whitened residuals of some rows and their derivatives, value by value.

        Returns:
            (n,) place of the row of every value among the rows, (n,) residuals [standard
            deviations], and (n, n_private + c) derivatives by the private and the common unknowns.
        """
        mask = self.mask_of(rows)
        common, private = rows.jacobians
        columns = self.to_columns(common, rows.recording)
        J = self.noise.whiten_present(np.concatenate([private, columns], axis=2), mask)
        return np.nonzero(mask)[0], self.residual(rows), J

    def of_batches(
        self, work: BatchWork[T], batches: Iterable[SegmentBatch], at: UnknownValues
    ) -> Iterator[T | None]:
        """Results of a work on batches, in their order; None where a simulation diverges.

        Args:
            work: Function of the problem, the unknowns and a batch, such as `blocks_of_batch`.
            batches: The batches.
            at: The unknowns.
        """
        works = (partial(_work_on_batch, work=work, at=at, batch=batch) for batch in batches)
        if self.workers is None:
            yield from (each(self, Budget()) for each in works)
        else:
            yield from self.workers.of_batches(self, list(works))

    def of_whole(self, works: Sequence[ProblemWork[T]], budget: Budget) -> Iterator[T]:
        """Results of independent works, in this process or by a worker each.

        Returns:
            The results in their order; those that a request to stop has prevented are missing.
        """
        if self.workers is not None and len(works) >= self.workers.count:
            yield from self.workers.of_whole(self, works, budget)
            return
        # Few works would leave workers idle, which share each pass over the data instead.
        for work in works:
            if budget.exhausted is not None:
                return
            yield work(self, budget)


def with_suitable_differences(
    system: System,
    recordings: Sequence[AlignedRecording],
    samples: int = CALIBRATION_SAMPLES,
    wanted: np.ndarray | None = None,
) -> System:
    """A system with difference steps that suit the first samples of the longest recording.

    They depend on how strongly each parameter changes the recorded motion.

    Args:
        system: The system.
        recordings: The recordings.
        samples: Largest number of these samples.
        wanted: (p,) True for the parameters whose steps change; None for all.
    """
    longest = max(recordings, key=lambda recording: len(recording.ctrl))
    nominal = system.plant.nominal_initial_state
    begun = system.plant.with_initial_state(recorded_release(system, longest))
    guess, ctrl = system.parameters.guess, longest.ctrl[:samples]
    system = replace(system, plant=begun).calibrated(guess, ctrl, wanted)
    return replace(system, plant=system.plant.with_initial_state(nominal))


def _work_on_batch(
    problem: FitProblem,
    _: Budget,
    *,
    work: BatchWork[T],
    at: UnknownValues,
    batch: SegmentBatch,
) -> T | None:
    """A work on one batch as a task on the whole problem; None where a simulation diverges."""
    with suppress(DivergedSegmentError):
        return work(problem, at, batch)
    return None


def have_same_initial_states(problem: FitProblem, other: FitProblem) -> bool:
    """Whether the private unknowns of two problems of the same recordings are alike.

    With a delay among the parameters, segments begin earlier, and their initial states are others.
    A joint or an actuator more has further states.

    Args:
        problem: A problem.
        other: The other one.
    """
    begins, others = ([segment.begin for segment in each.segments] for each in (problem, other))
    width = problem.private_count
    return begins == others and width == other.private_count


def sensitivity_rows(
    problem: FitProblem,
    at: UnknownValues,
    *,
    with_error: bool = True,
    wanted: np.ndarray | None = None,
) -> list[tuple[Array, Array]]:
    """Condensed rows of the whitened sensitivity G, and their change with a longer step.

    The longer difference step shows the error of the differences. Where the whole initial state is
    free, rows are projected onto the complement of its derivatives.

    Args:
        problem: The problem.
        at: The unknowns.
        with_error: False for changes of zero and one-sided differences, at a quarter of the cost.
        wanted: (p,) True for the parameters whose columns are wanted; default: all of them.

    Returns:
        (k, p) rows and (k, p) changes of every segment [standard deviations / theta-unit], k at
        most 2p + 2n.

    Raises:
        SimulationDivergedError: A perturbed simulation diverges.
    """
    if wanted is None:
        wanted = np.ones(len(problem.parameters), dtype=bool)
    work: BatchWork[dict[int, Array]] = partial(_of_batch, with_error=with_error)
    accurate = replace(problem, central=with_error, difference_step=SENSITIVITY_STEP)
    batches = list(accurate.batches(derivatives=True, wanted=wanted))
    condensed: dict[int, Array] = {}
    for batch, of_batch in zip(batches, problem.of_batches(work, batches, at), strict=True):
        if of_batch is None:
            recordings = {problem.segments[segment].recording for segment in batch.segments}
            names = [problem.recordings[index].name for index in sorted(recordings)]
            raise SimulationDivergedError(
                f"{' or '.join(names)}: the simulation diverges under the recorded control"
            )
        condensed.update(of_batch)
    n = problem.private_count if problem.free_starts else 0

    found = []
    for segment in sorted(condensed):
        J, change = np.split(condensed[segment], 2, axis=1)

        # A free initial state explains everything in the span of its derivatives.
        Q = np.linalg.qr(J[:, :n])[0]
        by_theta, its_change = (rows[:, n:] - Q @ (Q.T @ rows[:, n:]) for rows in (J, change))
        found.append((by_theta, its_change))
    return found


def _of_batch(
    problem: FitProblem, at: UnknownValues, batch: SegmentBatch, *, with_error: bool
) -> dict[int, Array]:
    """Condense the whitened sensitivity of a batch, and its change with a longer step.

    Returns:
        (k, 2 (n+p)) triangle of each segment by its index. Changes are zero without an error.
    """
    coarse: Iterator[SegmentRows] = iter(())
    if with_error:
        coarse = problem.rows_of_batch(at, replace(batch, step=COARSER_STEP_FACTOR * batch.step))

    def sensitivity(rows: SegmentRows) -> Array:
        """(k, n+p) derivatives by the initial state where that is free, then by theta."""
        common, private = rows.jacobians
        G = np.concatenate([private, common] if problem.free_starts else [common], axis=2)
        return problem.noise.whiten_present(G, problem.mask_of(rows))

    condensed: dict[int, Array] = {}
    for rows in problem.rows_of_batch(at, batch):
        # Without a simulation with the longer step, the change is unknown.
        J = sensitivity(rows)
        change = np.zeros_like(J)
        with suppress(StopIteration, DivergedSegmentError):
            change = sensitivity(next(coarse)) - J

        both = np.concatenate([J, change], axis=1)
        earlier = condensed.get(rows.segment, both[:0])
        condensed[rows.segment] = triangle(np.concatenate([earlier, both]))
    return condensed
