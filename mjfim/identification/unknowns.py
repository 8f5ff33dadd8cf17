"""Which unknowns a fit has: what all recordings share, what each recording has of its own, what each start deviates by.

The common columns of `condensed` are the shared parameters, then those of the first recording, of the second, and so on;
deviations of starts are the private ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.model.parameters import ParameterSet
from mjfim.optimize.condensed_least_squares import Step
from mjfim.optimize.levenberg_marquardt import UnknownValues


@dataclass(frozen=True, eq=False)
class UnknownLayout:
    """shared: (s,), own: (e,), private: (n,) places in theta;  recordings: K;  c = s + K e common columns

    lower, upper: (c,);  free: the start is private as a whole, and theta holds none of it
    """

    parameters: ParameterSet
    shared: np.ndarray
    own: np.ndarray
    private: np.ndarray
    recordings: int
    lower: Array
    upper: Array
    free: bool

    @staticmethod
    def of(parameters: ParameterSet, recordings: int, free: bool, bounded: bool) -> UnknownLayout:
        """free: starts are measured;  bounded: False: without bounds"""
        p = parameters
        own = p.recording_specific & ~p.initial_deviations
        shared, each = np.flatnonzero(~p.recording_specific), np.flatnonzero(own)
        places = np.concatenate([shared, np.tile(each, recordings)])
        lower, upper = p.lower[places], p.upper[places]
        found = UnknownLayout(
            p, shared, each, np.flatnonzero(p.initial_deviations), recordings, lower, upper, free
        )
        return found if bounded else found.unbounded()

    def unbounded(self) -> UnknownLayout:
        """The same without bounds."""
        return replace(
            self, lower=np.full(self.columns, -np.inf), upper=np.full(self.columns, np.inf)
        )

    def frozen(self) -> UnknownLayout:
        """The same with the shared parameters staying as they are."""
        s = len(self.shared)
        return replace(self, shared=self.shared[:0], lower=self.lower[s:], upper=self.upper[s:])

    @property
    def columns(self) -> int:
        """c, the number of common unknowns."""
        return len(self.shared) + self.recordings * len(self.own)

    @property
    def places(self) -> np.ndarray:
        """(c,) place in theta of every common column."""
        return np.concatenate([self.shared, np.tile(self.own, self.recordings)])

    @property
    def first(self) -> np.ndarray:
        """Common columns of the shared parameters and of the first recording's own."""
        return np.arange(len(self.shared) + len(self.own))

    @property
    def sought(self) -> np.ndarray:
        """(p,) True for the parameters that have common columns."""
        mask = np.zeros(len(self.parameters), dtype=bool)
        mask[self.places] = True
        return mask

    def begin(self, theta: Array, pieces: int, width: int) -> UnknownValues:
        """At theta: (p,), every one of some pieces with a start of some width as stated or measured."""
        theta = np.array(theta, dtype=np.float64)
        start = np.zeros(width) if self.free else theta[self.private]
        return UnknownValues(
            theta=theta,
            private=np.tile(start, (pieces, 1)),
            per_recording=np.tile(theta[self.own], (self.recordings, 1)),
        )

    def common_values(self, at: UnknownValues) -> Array:
        """(c,) values of the common unknowns."""
        return np.concatenate([at.theta[self.shared], at.per_recording.ravel()])

    def moved(self, at: UnknownValues, step: Step, length: float) -> UnknownValues:
        """The unknowns after a part of a step, inside the bounds to the last digit."""
        values = np.clip(self.common_values(at) + length * step.common, self.lower, self.upper)
        theta, s = np.array(at.theta), len(self.shared)
        theta[self.shared] = values[:s]
        return UnknownValues(
            theta=theta,
            private=at.private + length * step.private,
            per_recording=values[s:].reshape(at.per_recording.shape),
        )

    def of_recording(self, at: UnknownValues, recording: int) -> Array:
        """(p,) theta of one recording, its start deviations left as they stand in theta."""
        theta = np.array(at.theta)
        theta[self.own] = at.per_recording[recording]
        return theta

    def theta(self, at: UnknownValues) -> Array:
        """(p,) with what is the first recording's."""
        theta = self.of_recording(at, 0)
        if not self.free and len(self.private):
            theta[self.private] = at.private[0]
        return theta

    def spread(self, G: Array, recording: int) -> Array:
        """(..., c) common columns from derivatives by theta: (..., p) of one recording."""
        s, e = len(self.shared), len(self.own)
        out = np.zeros((*G.shape[:-1], self.columns))
        out[..., :s] = G[..., self.shared]
        out[..., s + recording * e : s + (recording + 1) * e] = G[..., self.own]
        return out

    def priors(self, at: UnknownValues) -> Array:
        """(l, c+1) rows of the stated priors."""
        places = self.places
        weight = np.sqrt(np.diag(self.parameters.prior_information))[places]
        rows = np.column_stack(
            [np.diag(weight), weight * (self.common_values(at) - self.parameters.guess[places])]
        )
        return np.asarray(rows[weight > 0.0])
