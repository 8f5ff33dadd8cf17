"""Recordings cut into pieces that are simulated on their own, and where each of them starts.

A rollout over a whole recording amplifies what the model cannot know (chaos, slip, a shove); pieces of a few time constants with
starts of their own do not. What is between two pieces, a jump of the state, is left free.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.plant.outputs import outputs_by_state

NEAR = 12  # rows to either side from which a start is read off
FEWEST = 4  # samples of a piece
ALIKE = 1.1  # ratio of lengths up to which pieces share a batch


@dataclass(frozen=True, eq=False)
class Segment:
    """A run of samples of one track. track: its place;  begin: first sample;  samples: of the grid

    rows: of the track that belong to it;  start: (ns,) state at its begin, where the search starts
    """

    track: int
    begin: int
    samples: int
    rows: slice
    start: Array


def whole(tracks: Sequence[AlignedRecording], start: Array) -> tuple[Segment, ...]:
    """Every track one piece from the stated start: (ns,)."""
    return tuple(
        Segment(i, 0, len(t.ctrl), slice(0, len(t.t)), start) for i, t in enumerate(tracks)
    )


def cut(
    system: System, tracks: Sequence[AlignedRecording], length: float | None, lead: float
) -> tuple[Segment, ...]:
    """Pieces of a length [s], None: whole tracks, each with the start that the data show.

    lead: [s] by which a piece is simulated before its first row, the longest delay of the outputs
    """
    found = []
    for i, track in enumerate(tracks):
        bounds = _bounds(track, length)
        ahead = int(np.ceil(lead / track.dt - 1e-9))
        begins = [max(int(b) - ahead, 0) for b in bounds[:-1]]
        starts = measured_starts(system, track, np.array(begins))
        edges = np.searchsorted(track.t, bounds * track.dt - 1e-9 * track.dt)
        edges[-1] = len(track.t)
        for begin, end, first, last, start in zip(
            begins, bounds[1:], edges[:-1], edges[1:], starts, strict=True
        ):
            if last > first:
                found.append(
                    Segment(i, begin, int(end) - begin, slice(int(first), int(last)), start)
                )
    return tuple(found)


def _bounds(track: AlignedRecording, length: float | None) -> np.ndarray:
    """Samples at which pieces begin, and the end; all of nearly the same length."""
    N = len(track.ctrl)
    if length is None:
        return np.array([0, N])
    count = max(round(N * track.dt / length), 1)
    if N // count < FEWEST:
        raise RecordingError(
            f"{track.name}: fit.segments = {length:g} s is too short: pieces need at least {FEWEST} samples of {track.dt:g} s"
        )
    return np.linspace(0, N, count + 1).astype(int)


def measured_starts(system: System, track: AlignedRecording, begins: np.ndarray) -> Array:
    """(n, ns) states at samples: what the log shows; what it does not show, as the model at the guess goes.

    A line through position and velocity of the rows around, a parabola where velocities were not measured.
    """
    states = _nominal(system, track, begins)
    place = _shown(system, track)
    space = system.space
    quaternion = {a for q, _ in space.quaternions for a in range(q, q + 4)}
    velocity = dict(zip(space.scalar_q.tolist(), (space.nq + space.scalar_v).tolist(), strict=True))
    for k, begin in enumerate(begins):
        t0 = begin * track.dt
        for q in range(space.nq):
            if q in place and q not in quaternion:
                states[k, q], states[k, velocity[q]] = _local(track, place[q], t0, 2)
        for v in range(space.nq, space.nq + space.nv):
            if v in place:
                states[k, v] = _local(track, place[v], t0, 1)[0]
        for q, _ in space.quaternions:
            if all(a in place for a in range(q, q + 4)):
                nearest = _nearest(track, [place[a] for a in range(q, q + 4)], t0)
                states[k, q : q + 4] = nearest / np.linalg.norm(nearest)
    return states


def _local(track: AlignedRecording, column: int, t0: float, degree: int) -> tuple[float, float]:
    """Value and slope at t0 of a polynomial through the rows around that hold a value of a column."""
    seen = track.seen[column]
    middle = int(np.searchsorted(seen, np.searchsorted(track.t, t0)))
    rows = seen[max(middle - NEAR, 0) : middle + NEAR]
    s, y = track.t[rows] - t0, track.y[rows, column]
    if len(rows) <= degree:
        return float(y.mean()), 0.0
    unit = max(float(np.abs(s).max()), 1e-12)
    fitted = np.polynomial.polynomial.polyfit(s / unit, y, degree)
    return float(fitted[0]), float(fitted[1] / unit)


def _nearest(track: AlignedRecording, columns: Sequence[int], t0: float) -> Array:
    """The measured values of some columns nearest to t0."""
    seen = track.seen[columns[0]]  # components of one quaternion are measured together
    after = int(np.clip(np.searchsorted(seen, np.searchsorted(track.t, t0)), 0, len(seen) - 1))
    near = min((seen[max(after - 1, 0)], seen[after]), key=lambda row: abs(track.t[row] - t0))
    return np.asarray(track.y[near][list(columns)])


def _nominal(system: System, track: AlignedRecording, begins: np.ndarray) -> Array:
    """(n, ns) states of the model at the guess from the stated start; the start itself where that diverges."""
    start = system.plant.initial_state(system.parameters.guess)
    out = np.tile(start, (len(begins), 1))
    if set(_shown(system, track)).issuperset(range(len(start))) or not begins.any():
        return out
    model = system.plant.model(system.parameters.guess)
    rolled = system.plant.simulator.rollout(
        [model], start[None], track.ctrl[None, : int(begins.max())]
    )
    return np.array(rolled.states[0][begins]) if rolled.finite[0] else out


def _shown(system: System, track: AlignedRecording) -> dict[int, int]:
    """Output that shows a component of the state, by its address, where the track has values of it."""
    return {
        state: i
        for state, i in outputs_by_state(system.model, system.outputs).items()
        if len(track.seen[i])
    }


def groups(pieces: Sequence[Segment], most: int) -> Iterator[list[int]]:
    """Places of pieces that are simulated in one batch: of like length, together at most so many samples."""
    order = sorted(range(len(pieces)), key=lambda i: pieces[i].samples)
    batch: list[int] = []
    for i in order:
        longer = batch and pieces[i].samples > ALIKE * pieces[batch[0]].samples
        if batch and (longer or (len(batch) + 1) * pieces[i].samples > most):
            yield batch
            batch = []
        batch.append(i)
    if batch:
        yield batch
