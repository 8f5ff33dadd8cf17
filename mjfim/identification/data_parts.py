"""A part of the data that is quick enough to simulate, spread over all recordings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.segments import spread_over_data
from mjfim.optimize.levenberg_marquardt import UnknownValues

# Number of samples of a segment that tell enough. Where the part would contain fewer of each
# recording, it contains fewer recordings.
ENOUGH_SAMPLES = 500


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
