"""Recordings against the model: whitened residuals, their Jacobian, and both condensed for the solver.

Every recording is one piece or several (`pieces`). What a piece measures is compared at its own times: the prediction is
read between the samples, as late as the outputs lag (`lag`).
"""

from __future__ import annotations

import copy
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise, zip_longest

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, RecordingError, SimulationDivergedError
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import align
from mjfim.identification.segments import cut, groups, whole
from mjfim.identification.unknowns import UnknownLayout
from mjfim.information.null_space import COARSER_STEP_FACTOR, NullSpace
from mjfim.optimize.condensed_least_squares import Condensed, Step, triangle
from mjfim.optimize.levenberg_marquardt import UnknownValues
from mjfim.optimize.robust_losses import RobustLoss
from mjfim.plant.delay import OutputDelay
from mjfim.plant.derivatives import MAX_NUMBERS_AT_ONCE, SENSITIVITY_STEP, Response
from mjfim.plant.noise import Noise
from mjfim.records.recording import Recording
from mjfim.records.trajectory import Trajectory

FINE = 8  # rows of a block at least
BLOCKS = 1024  # about as many
LARGE = 400_000  # samples times sides of differences from which these are one-sided
WIDE = 1e3  # [m, rad, ...] standard deviation of a free start, so that what nothing shows stays where it is
DELAYED = 5.0  # sizes or prior standard deviations by which a delay may grow while it is sought


@dataclass(frozen=True, eq=False)
class Residuals:
    """Whitened residuals of all recordings, then prior rows, then pins, and their Jacobian. r: (n,), J: (n, c + private)."""

    r: Array
    J: Array


@dataclass(frozen=True, eq=False)
class Rows:
    """Some rows of one piece. piece: its place;  rows: (k,) of its track

    y: (k, ny) predicted;  common: (k, ny, p), private: (k, ny, n) derivatives, or None
    """

    piece: int
    rows: np.ndarray
    y: Array
    common: Array | None
    private: Array | None


# Samples of the longest recording along which difference steps are calibrated.
CALIBRATION_SAMPLES = 1000


class FitProblem:
    """Residuals of an experiment against recordings, as functions of the unknowns (`levenberg_marquardt.Problem`).

    The common unknowns are theta without the private deviations of a start; every piece has its own of those. Pieces that
    start where the data say have all of the state as private unknowns.
    data_only: leave priors and bounds out
    """

    @classmethod
    def of(
        cls, system: System, recordings: Sequence[Recording], *, data_only: bool = False
    ) -> FitProblem:
        """The problem of a system and recordings; data_only leaves priors and bounds out."""
        return cls(system, recordings, data_only)

    def __init__(
        self, system: System, recordings: Sequence[Recording], data_only: bool = False
    ) -> None:
        if not recordings:
            raise RecordingError("identify needs at least one recording")
        self.system, self.data_only = system, data_only
        p, fit = system.parameters, system.experiment.fit
        self.loss = RobustLoss(kind=fit.loss, scale=fit.loss_scale)
        self.noise: Noise = system.noise
        self.recordings = list(recordings)
        self.aligned = [align(system, r) for r in recordings]

        # Difference steps suit the motion that was recorded; a part of it shows how strongly each parameter acts.
        longest = max(self.aligned, key=lambda track: len(track.ctrl))
        self.system = system = system.calibrated(p.guess, longest.ctrl[:CALIBRATION_SAMPLES])
        self.measured = fit.start == "measured" or fit.segments is not None
        if self.measured:
            self._require_free()
            self.free = np.eye(system.space.nx)
            self.pieces = cut(system, self.aligned, fit.segments, self._lead())
        else:
            self.free = p.initial_state_derivative(system.space.nx)[:, p.initial_deviations]
            self.pieces = whole(self.aligned, system.plant.nominal_initial_state)
        self.masks = [self._used(i) for i in range(len(self.aligned))]
        if not any(mask.any() for mask in self.masks):
            raise RecordingError("the recordings hold no measured value after t = 0")
        self.layout = UnknownLayout.of(p, len(self.aligned), self.measured, not data_only)
        self.pins, self.pinned_at = np.zeros((0, len(p))), np.array(p.guess)
        self._offsets = self._partition()

    def _require_free(self) -> None:
        """Raises ExperimentError where deviations of the stated start are asked for though it is measured."""
        starts = self.system.parameters.initial_state_derivative(self.system.space.nx).any(axis=0)
        if starts.any():
            name = self.system.parameters.names[int(np.argmax(starts))]
            raise ExperimentError(
                f"{self.system.experiment.source}: {name}: a start is free where fit.segments or fit.start = \"measured\" is "
                "stated; take nuisance.initial and parameters of the start out, or the other"
            )  # fmt: skip

    def _lead(self) -> float:
        """[s] that outputs may lag at most while the delay is sought."""
        p = self.system.parameters
        reach = np.array([DELAYED * (q.prior or q.scale) for q in p.parameters])
        latest = np.minimum(p.guess + reach, np.where(np.isfinite(p.upper), p.upper, np.inf))
        return max(float(p.delay_derivative @ latest), 0.0) if p.delay_derivative.any() else 0.0

    def _used(self, i: int) -> np.ndarray:
        """(M, ny) measured values of a track; what is measured at a stated start tells nothing."""
        mask = np.array(self.aligned[i].measured)
        if not self.measured:
            mask[0] = False
        return mask

    def _partition(self) -> np.ndarray:
        """First block of every piece, and the number of all blocks."""
        total = sum(len(t.t) for t in self.aligned)
        fine = max(FINE, -(-total // BLOCKS))
        counts = [max(round((p.rows.stop - p.rows.start) / fine), 1) for p in self.pieces]
        return np.concatenate([[0], np.cumsum(counts)])

    # what is sought

    @property
    def samples(self) -> int:
        """Of all pieces together."""
        return sum(p.samples for p in self.pieces)

    @property
    def count(self) -> int:
        """Number of measured values."""
        return int(sum(mask.sum() for mask in self.masks))

    @property
    def occupied(self) -> np.ndarray:
        """Places of the pieces that hold a measured value."""
        hold = [
            i for i, piece in enumerate(self.pieces) if self.masks[piece.track][piece.rows].any()
        ]
        return np.array(hold, dtype=np.intp)

    @property
    def size(self) -> int:
        """Number of unknowns."""
        return self.layout.columns + len(self.pieces) * self.free.shape[1]

    @property
    def lower(self) -> Array:
        """(c,) bounds of the common unknowns."""
        return self.layout.lower

    @property
    def upper(self) -> Array:
        """(c,) bounds of the common unknowns."""
        return self.layout.upper

    def begin(self, theta: Array) -> UnknownValues:
        """Unknowns at theta: (p,), every piece starting as stated or measured."""
        return self.layout.begin(theta, len(self.pieces), self.free.shape[1])

    def common_values(self, at: UnknownValues) -> Array:
        """(c,) values of the common unknowns."""
        return self.layout.common_values(at)

    def moved(self, at: UnknownValues, step: Step, length: float) -> UnknownValues:
        """The unknowns after a part of a step, inside the bounds to the last digit."""
        return self.layout.moved(at, step, length)

    def theta(self, at: UnknownValues) -> Array:
        """(p,) with what is the first recording's."""
        return self.layout.theta(at)

    @property
    def blocks(self) -> tuple[np.ndarray, np.ndarray]:
        """Recording and number of rows of every block."""
        counts = np.diff(self._offsets)
        tracks = np.repeat([piece.track for piece in self.pieces], counts)
        rows = [
            (piece.rows.stop - piece.rows.start) / n
            for piece, n in zip(self.pieces, counts, strict=True)
        ]
        return tracks, np.repeat(rows, counts)

    def unbounded(self) -> FitProblem:
        """The same without bounds."""
        other = copy.copy(self)
        other.layout = self.layout.unbounded()
        return other

    def frozen(self) -> FitProblem:
        """The same at any theta, whose shared part stays as it is."""
        other = copy.copy(self)
        other.layout, other.pins = self.layout.frozen(), self.pins[:0]
        return other

    def reweighted(self, noise: Noise) -> FitProblem:
        """The same with other noise."""
        other = copy.copy(self)
        other.noise = noise
        return other

    def part(self, pieces: np.ndarray) -> FitProblem:
        """Of some pieces alone."""
        other = copy.copy(self)
        other.pieces = tuple(self.pieces[i] for i in pieces)
        other.masks = [np.zeros_like(mask) for mask in self.masks]
        for piece in other.pieces:
            other.masks[piece.track][piece.rows] = self.masks[piece.track][piece.rows]
        other._offsets = other._partition()
        return other

    def masked(self, masks: Sequence[np.ndarray]) -> FitProblem:
        """Of some measured values alone. masks: (M, ny) for every track"""
        other = copy.copy(self)
        other.masks = [mask & own for mask, own in zip(masks, self.masks, strict=True)]
        return other

    def pin(self, theta0: Array, null: NullSpace) -> None:
        """Hold what no recording shows at its start, to one size of each parameter. null: of all p parameters"""
        size = self.system.parameters.magnitude
        self.pins = np.linalg.qr(null.directions / size[:, None])[0].T / size
        self.pinned_at = np.array(theta0)

    # what is computed

    def predicted(self, at: UnknownValues) -> list[Array] | None:
        """(M, ny) of every track at its measured times, NaN outside of all pieces; None where a simulation diverges."""
        found = [np.full(track.y.shape, np.nan) for track in self.aligned]
        for rows in self._rows(at, derivatives=False):
            if rows is None:
                return None
            found[self.pieces[rows.piece].track][rows.rows] = rows.y
        return found

    def errors(self, values: Sequence[Array]) -> list[Array]:
        """Predicted - measured of every output, those of all tracks in one row. values: (M, ny) of every track"""
        parts = list(zip(values, self.aligned, self.masks, strict=True))
        return [
            np.concatenate([(y - track.y)[mask[:, j], j] for y, track, mask in parts])
            for j in range(len(self.system.outputs))
        ]

    def motion(self, at: UnknownValues, track: int) -> Trajectory | None:
        """The fitted motion of one track on its grid, jumps between pieces and all; None where it diverges."""
        plant, whole, theta = (
            self.system.plant,
            self.aligned[track],
            self.layout.of_recording(at, track),
        )
        states = np.full((len(whole.ctrl) + 1, plant.nominal_initial_state.size), np.nan)
        mine = [i for i, piece in enumerate(self.pieces) if piece.track == track]
        for i in mine:
            own = self.pieces[i]
            out = plant.simulator.rollout(
                [plant.model(theta)], self._start(at, i)[None], self._control(i, own.samples)[None]
            )
            if not out.finite[0]:
                return None
            seen = np.isnan(states[own.begin : own.begin + own.samples + 1, 0])
            states[own.begin : own.begin + own.samples + 1][seen] = out.states[0][seen]
        gap = np.isnan(states[:, 0])
        if gap.any():  # rows without a piece
            states[gap] = (
                states[np.flatnonzero(~gap)[0]] if not gap.all() else plant.nominal_initial_state
            )
        return plant.trajectory(states, whole.ctrl)

    def cost(self, at: UnknownValues) -> float:
        """Half of the loss and the priors; infinite where a simulation diverges."""
        total = 0.0
        for rows in self._rows(at, derivatives=False):
            if rows is None:
                return np.inf
            total += self.loss.value(self._whitened(rows)[1])
        further = self._outer(at)[:, -1]
        inner = self._inner(at)[:, :, -1]
        return 0.5 * (total + float(further @ further) + float(np.sum(inner**2)))

    def condense(self, at: UnknownValues) -> Condensed | None:
        """Linearised about the unknowns; None where a perturbed simulation diverges."""
        m = self.free.shape[1] + self.layout.columns + 1
        blocks = np.zeros((int(self._offsets[-1]), m, m))
        owners = np.repeat(np.arange(len(self.pieces)), np.diff(self._offsets))
        for rows in self._rows(at, derivatives=True):
            if rows is None:
                return None
            index, r, J = self._linear(rows)
            stacked = np.concatenate([J, r[:, None]], axis=1) * self.loss.weight(r)[:, None]
            edges = np.flatnonzero(np.diff(index, prepend=-1, append=-1))
            for first, last in pairwise(edges):
                own = np.concatenate([blocks[index[first]], stacked[first:last]])
                blocks[index[first]] = triangle(own)
        return Condensed(
            blocks=blocks,
            segment_of_block=owners,
            private_rows=self._inner(at),
            common_rows=self._outer(at),
        )

    def dense(self, at: UnknownValues) -> Residuals | None:
        """All rows, data first, and the derivative by the common unknowns, then by each piece's own. For small problems."""
        n, c = self.free.shape[1], self.layout.columns
        r, J = [], []
        for rows in self._rows(at, derivatives=True):
            if rows is None:
                return None
            _, residual, slope = self._linear(rows)
            wide = np.zeros((len(residual), self.size))
            wide[:, :c] = slope[:, n:]
            wide[:, c + rows.piece * n : c + (rows.piece + 1) * n] = slope[:, :n]
            r.append(residual)
            J.append(wide)
        outer, inner = self._outer(at), self._inner(at)
        r.append(outer[:, -1])
        J.append(np.pad(outer[:, :-1], ((0, 0), (0, self.size - c))))
        for i, own in enumerate(inner):
            wide = np.zeros((len(own), self.size))
            wide[:, :c], wide[:, c + i * n : c + (i + 1) * n] = own[:, n:-1], own[:, :n]
            r.append(own[:, -1])
            J.append(wide)
        return Residuals(np.concatenate(r), np.concatenate(J))

    def sensed(self, at: UnknownValues) -> list[tuple[Array, Array]]:
        """Whitened rows of G: (n, p) along each piece, and their change with a longer difference step; condensed, (2p, p).

        Of pieces whose whole start is free, what that leaves of them. Raises SimulationDivergedError.
        """
        fine, coarse = (
            self._rows(at, derivatives=True, central=True, step=step, every=True)
            for step in (SENSITIVITY_STEP, COARSER_STEP_FACTOR * SENSITIVITY_STEP)
        )
        found: dict[int, Array] = {}
        n = self.free.shape[1] if self.measured else 0
        for rows, other in zip_longest(fine, coarse):
            if rows is None:
                raise SimulationDivergedError(
                    f"{self.aligned[0].name}: the simulation diverges under its control"
                )
            J = self._columns(rows)
            error = np.zeros_like(J) if other is None else self._columns(other) - J
            both = np.concatenate([J, error], axis=1)
            found[rows.piece] = triangle(np.concatenate([found.get(rows.piece, both[:0]), both]))
        out = []
        for key in sorted(found):
            J, error = np.split(found[key], 2, axis=1)
            Q = np.linalg.qr(J[:, :n])[0]
            kept, doubt = J[:, n:], error[:, n:]
            out.append((kept - Q @ (Q.T @ kept), doubt - Q @ (Q.T @ doubt)))
        return out

    def _columns(self, rows: Rows) -> Array:
        """(k, n + p) whitened derivatives, by the start where that is all free, then by theta."""
        mask = self.masks[self.pieces[rows.piece].track][rows.rows]
        if rows.common is None or rows.private is None:
            raise ValueError("no derivatives were asked for")
        G = np.concatenate([rows.private, rows.common], axis=2) if self.measured else rows.common
        return self.noise.whiten_present(G, mask)

    def _whitened(self, rows: Rows) -> tuple[np.ndarray, Array]:
        """Which values are there, (k, ny), and their whitened residuals, one after the other."""
        track = self.pieces[rows.piece].track
        mask = self.masks[track][rows.rows]
        residual = np.where(mask, rows.y - self.aligned[track].y[rows.rows], 0.0)
        return mask, self.noise.whiten_present(residual, mask)

    def _linear(self, rows: Rows) -> tuple[np.ndarray, Array, Array]:
        """Block of every value, its whitened residual and its derivative by private and common unknowns."""
        mask, r = self._whitened(rows)
        if rows.common is None or rows.private is None:
            raise ValueError("no derivatives were asked for")
        common = self.layout.spread(rows.common, self.pieces[rows.piece].track)
        G = np.concatenate([rows.private, common], axis=2)
        piece, first = self.pieces[rows.piece], int(self._offsets[rows.piece])
        count = int(self._offsets[rows.piece + 1]) - first
        share = (rows.rows - piece.rows.start) * count // (piece.rows.stop - piece.rows.start)
        index = np.broadcast_to((first + share)[:, None], mask.shape)[mask]
        return index, r, self.noise.whiten_present(G, mask)

    def _outer(self, at: UnknownValues) -> Array:
        """(l, c+1) rows of priors and pins on the common unknowns."""
        rows = self.layout.priors(at)
        pins = np.column_stack(
            [self.layout.spread(self.pins, 0), self.pins @ (self.theta(at) - self.pinned_at)]
        )
        return np.concatenate(
            [rows[: 0 if self.data_only else None], pins if self._apart else pins[:0]]
        )

    @property
    def _apart(self) -> bool:
        """True where pins do not touch private unknowns."""
        return not self.pins[:, self.layout.private].any()

    def _inner(self, at: UnknownValues) -> Array:
        """(P, k, m) rows of priors on the private unknowns; pins that touch them belong to the first piece."""
        n, c, p = self.free.shape[1], self.layout.columns, self.system.parameters
        private = self.layout.private
        if self.measured:
            rows = np.zeros((len(self.pieces), n, n + c + 1))
            rows[:, np.arange(n), np.arange(n)] = 1.0 / WIDE
            rows[:, :, -1] = at.private / WIDE
            return rows
        if not n:
            return np.zeros((len(self.pieces), 0, n + c + 1))
        weight = np.sqrt(np.diag(p.prior_information))[private] * (not self.data_only)
        rows = np.zeros((len(self.pieces), n + len(self.pins) * (not self._apart), n + c + 1))
        rows[:, np.arange(n), np.arange(n)] = weight
        rows[:, :n, -1] = weight * (at.private - p.guess[private])
        if not self._apart:
            rows[0, n:, :n], rows[0, n:, n:-1] = (
                self.pins[:, private],
                self.layout.spread(self.pins, 0),
            )
            rows[0, n:, -1] = self.pins @ (self.theta(at) - self.pinned_at)
        return rows

    def _rows(
        self,
        at: UnknownValues,
        derivatives: bool,
        central: bool | None = None,
        step: float = SENSITIVITY_STEP,
        every: bool = False,
    ) -> Iterator[Rows | None]:
        """All rows that belong to pieces, stretch by stretch; None where a simulation diverges.

        every: differentiate by all of theta, what the layout does not seek too
        """
        plant = self.system.plant
        sought = np.ones(len(self.system.parameters), dtype=bool) if every else self.layout.sought
        q = int(sought.sum()) + self.free.shape[1]
        central = self.samples * 2 * q < LARGE if central is None else central
        sides = 1 + (q * (2 if central else 1) if derivatives else 0)
        most = max(
            MAX_NUMBERS_AT_ONCE
            // (sides * self.system.grid.substeps * (1 + plant.nominal_initial_state.size)),
            1,
        )
        step = step if central else 0.1 * step
        for track, batch in self._batches(most):
            theta = self.layout.of_recording(at, track)
            starts = np.stack([self._start(at, i) for i in batch])
            longest = max(self.pieces[i].samples for i in batch)
            ctrl = np.stack([self._control(i, longest) for i in batch])
            free = self.free if derivatives else None
            for response in plant.derivatives.responses(
                theta,
                starts,
                ctrl,
                start_directions=free,
                central=central,
                step=step,
                wanted=sought,
            ):
                if response is None:
                    yield None
                    return
                for s, i in enumerate(batch):
                    rows = self._read(theta, i, s, response)
                    if rows is not None:
                        yield rows

    def _batches(self, most: int) -> Iterator[tuple[int, list[int]]]:
        """Recording whose theta they have, and places, of pieces that are simulated together; at most so many samples."""
        if not len(self.layout.own):
            yield from ((0, batch) for batch in groups(self.pieces, most))
            return
        for track in range(len(self.aligned)):
            mine = [i for i, piece in enumerate(self.pieces) if piece.track == track]
            for batch in groups([self.pieces[i] for i in mine], most):
                yield track, [mine[k] for k in batch]

    def _start(self, at: UnknownValues, piece: int) -> Array:
        """(ns,) where a piece starts."""
        space, p = self.system.space, self.system.parameters
        if self.measured:
            return space.plus(self.pieces[piece].start, self.free @ at.private[piece])
        theta = np.array(at.theta)
        theta[self.layout.private] = at.private[piece]
        return space.plus(self.pieces[piece].start, p.initial_state_derivative(space.nx) @ theta)

    def _control(self, piece: int, longest: int) -> Array:
        """(longest, nu) from the piece's begin; held where the track is over."""
        own = self.pieces[piece]
        ctrl = self.aligned[own.track].ctrl[own.begin : own.begin + longest]
        return np.concatenate([ctrl, np.repeat(ctrl[-1:], longest - len(ctrl), axis=0)])

    def _read(self, theta: Array, piece: int, place: int, response: Response) -> Rows | None:
        """What a response says of the rows of one piece that fall into its stretch; None where none does."""
        own, p = self.pieces[piece], self.system.parameters
        track = self.aligned[own.track]
        late = float(p.delay_derivative @ theta) / track.dt
        wanted = track.t[own.rows] / track.dt - own.begin - late
        n = response.y.shape[1] - 1
        inside = np.clip(wanted, 0.0, own.samples)
        last = response.first + n >= own.samples
        hit = (inside >= response.first) & ((inside < response.first + n) | last)
        if not hit.any():
            return None
        rows = np.flatnonzero(hit) + own.rows.start
        values = (response.y[place], response.common, response.private)
        if track.even and not p.delay_derivative.any():
            at_samples = np.rint(wanted[hit]).astype(int) - response.first
            y, common, private = (
                None if v is None else (v if i == 0 else v[place])[at_samples]
                for i, v in enumerate(values)
            )
        else:
            output_delay = OutputDelay.at(wanted[hit] - response.first, n + 1, track.dt)
            y, common, private = (
                None if v is None else output_delay.apply(v if i == 0 else v[place])
                for i, v in enumerate(values)
            )
            if common is not None and p.delay_derivative.any():
                common = (
                    common
                    + output_delay.derivative(response.y[place])[..., None] * p.delay_derivative
                )
        if y is None:
            raise ValueError("a response without outputs")
        return Rows(piece, rows, y, common, private)
