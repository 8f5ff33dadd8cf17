"""Problems at the solution of a fit: of an extended model, and of a part of the data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, ModelError
from mjfim.experiment.system import System
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.known_activations import KnownActivations
from mjfim.identification.segments import Segment, spread_over_data
from mjfim.model.coordinates import state_names, tangent_names
from mjfim.optimize.levenberg_marquardt import UnknownValues
from mjfim.records.trajectory import Recording

# Number of samples of a segment that tell enough. Where the part would contain fewer of each
# recording, it contains fewer recordings.
ENOUGH_SAMPLES = 500


def extended_problem(
    problem: FitProblem,
    recordings: Sequence[Recording],
    at: UnknownValues,
    parameters: dict[str, Any],
    tables: dict[str, Any],
) -> tuple[FitProblem, UnknownValues] | None:
    """The problem of a model with further parameters and terms, and the solution in it.

    Rows, noise and initial states are those of the stated problem. New parameters have their
    guesses, new coordinates are at rest, and new activations follow from the recordings.

    Args:
        problem: The problem of some segments of the stated system.
        recordings: All recordings.
        at: Its solution.
        parameters: Tables of the further parameters by name.
        tables: Tables of the library of terms by name.

    Returns:
        The problem and its unknowns; None where the model cannot have the terms.
    """
    system = problem.system
    try:
        extended = System.resolve(
            system.experiment.replace(parameters=parameters, terms=tables),
            threads=system.threads,
            source=system.source,
        )
    except (ExperimentError, ModelError):
        return None
    names = extended.parameters.names
    theta = np.array(extended.parameters.guess)
    theta[[names.index(name) for name in system.parameters.names]] = at.theta

    # The rows are those of the solution; a delay as a parameter would let the segments begin
    # earlier.
    wider: FitProblem | None = FitProblem.of(extended, recordings)
    if wider is not None and problem.layout.free_starts and not wider.layout.free_starts:
        wider = wider.cut(None)
    if wider is None:
        return None
    wider = replace(
        wider,
        segments=_extended_segments(problem, wider),
        masks=problem.masks,
        noise=problem.noise,
        difference_step=problem.difference_step,
        central=problem.central,
        workers=problem.workers,
    )
    private = _extended_private(problem, wider, at)
    return wider, replace(at, theta=theta, private=private)


def with_stated_residuals(
    problem: FitProblem, at: UnknownValues, wider: FitProblem, begin: UnknownValues
) -> FitProblem | None:
    """The problem of an extended model whose residuals are those of the stated one.

    Even the smallest size of a term may change the residuals. The readings follow this change.

    Args:
        problem: The stated problem.
        at: Its solution.
        wider: The extended problem.
        begin: The solution in it.

    Returns:
        The extended problem; None where a simulation diverges.
    """
    stated, extended = problem.predict(at), wider.predict(begin)
    if stated is None or extended is None:
        return None
    recordings = tuple(
        replace(recording, y=recording.y + np.nan_to_num(after - before))
        for recording, before, after in zip(wider.recordings, stated, extended, strict=True)
    )
    return replace(wider, recordings=recordings)


def _extended_segments(problem: FitProblem, wider: FitProblem) -> tuple[Segment, ...]:
    """The segments of a problem with initial states of the extended model."""
    system = wider.system
    space, known = system.space, KnownActivations.of(system)
    stated, names = state_names(problem.system.model), state_names(system.model)
    if stated == names:
        return problem.segments

    common = [names.index(name) for name in stated]
    first = space.nq + space.nv
    added = [k for k, address in enumerate(known.addresses) if first + address not in common]
    places = [first + known.addresses[k] for k in added]

    segments = []
    for segment in problem.segments:
        start = np.array(system.plant.nominal_initial_state)
        start[common] = segment.start
        _, qvel, _ = space.split(start)
        recording = wider.recordings[segment.recording]
        values = known.at(recording, np.array([segment.begin]), qvel[None])[0]
        start[places] = values[added]
        segments.append(replace(segment, start=start))
    return tuple(segments)


def _extended_private(problem: FitProblem, wider: FitProblem, at: UnknownValues) -> Array:
    """(P, n) private unknowns of the extended model; those of new coordinates are zero."""
    before, after = _private_names(problem), _private_names(wider)
    if before == after:
        return at.private

    private = np.zeros((len(at.private), len(after)))
    private[:, [after.index(name) for name in before]] = at.private
    return private


def _private_names(problem: FitProblem) -> list[str]:
    """Names of the private unknowns of a segment."""
    if not problem.layout.free_starts:
        return [problem.system.parameters.names[i] for i in problem.layout.private]
    names = np.array(tangent_names(problem.system.model))
    directions = problem.start_directions
    return [str(names[np.flatnonzero(column)[0]]) for column in directions.T]


@dataclass(frozen=True, kw_only=True, eq=False)
class DataPart:
    """A part of the data of a problem.

    Attributes:
        problem: The problem of the part.
        segments: Indices of its segments among those of the whole problem.
        share: Share of the samples of the whole problem, 0 to 1.
    """

    problem: FitProblem
    segments: np.ndarray
    share: float

    @property
    def recording_count(self) -> int:
        """Number of recordings with samples in the part."""
        return len({segment.recording for segment in self.problem.segments})

    def unknowns(self, at: UnknownValues) -> UnknownValues:
        """The unknowns of the part.

        Args:
            at: Unknowns of the whole problem.
        """
        return replace(at, private=at.private[self.segments])


def part_of_data(problem: FitProblem, max_samples: float) -> DataPart:
    """Some segments of each recording, and of these the first parts where that is still too much.

    First parts begin at the initial states of the problem. Other parts of a recording would begin
    at states that are unknown.

    Args:
        problem: Problem of all segments.
        max_samples: Number of samples of the part, at most.

    Returns:
        The part; all data where they are few enough.
    """
    if problem.sample_count <= max_samples:
        everything = np.arange(len(problem.segments))
        return DataPart(problem=problem, segments=everything, share=1.0)

    chosen = _spread_segments(problem, max_samples)
    part = problem.of_segments(chosen)
    if part.sample_count > max_samples:
        part = part.of_first_parts(max_samples / part.sample_count)
    share = part.sample_count / problem.sample_count
    return DataPart(problem=part, segments=chosen, share=share)


def _spread_segments(problem: FitProblem, max_samples: float) -> np.ndarray:
    """Indices of segments of as many recordings as possible, at least one of each of these."""
    samples = np.array([segment.samples for segment in problem.segments])
    of_recording = np.array([segment.recording for segment in problem.segments])

    # Of too many recordings, some have to be enough.
    recordings = np.unique(of_recording)
    least = min(float(samples.mean()), ENOUGH_SAMPLES)
    possible = max(int(max_samples / least), 1)
    if possible < len(recordings):
        recordings = recordings[spread_over_data(len(recordings), possible)]

    # The segments of each recording are spread over its time.
    share = max_samples / samples[np.isin(of_recording, recordings)].sum()
    chosen = []
    for recording in recordings:
        segments = np.flatnonzero(of_recording == recording)
        wanted = min(max(round(share * len(segments)), 1), len(segments))
        chosen.append(segments[spread_over_data(len(segments), wanted)])
    return np.concatenate(chosen)
