"""Inputs around the curves of a closed loop, and what its control laws do and remember."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.plant.running_law import LawMemory


@dataclass(frozen=True, kw_only=True, eq=False)
class InputContext:
    """Inputs that a rollout with control laws needs beside those of its samples.

    Attributes:
        before: (m, L, w) inputs of the samples before the curves; none at the begin of recordings.
        after: (m, A, w) inputs of samples after the curves, of which the first one counts; without
            one, the last input of the curves is held.
        samples: (m,) samples from the begin of the recordings to the begin of the curves, which
            show when the laws are evaluated.
        memory: Memory of the laws, grouped by their periods, at the end of rollouts that the curves
            continue; None where they begin.
    """

    before: Array
    after: Array
    samples: np.ndarray
    memory: tuple[LawMemory, ...] | None = None

    @classmethod
    def none(cls, inputs: Array) -> InputContext:
        """The context of curves at the begin of recordings.

        Args:
            inputs: (m, N, w) inputs of the curves.
        """
        nothing = inputs[:, :0]
        begin = np.zeros(len(inputs), dtype=np.intp)
        return cls(before=nothing, after=nothing, samples=begin)

    @classmethod
    def of_interval(
        cls,
        inputs: Array,
        samples: np.ndarray,
        interval: slice,
        lead: int,
        memory: tuple[LawMemory, ...] | None,
    ) -> InputContext:
        """The context of an interval of curves.

        Args:
            inputs: (m, W, w) inputs of the curves, and of samples before them.
            samples: (m,) samples from the begin of the recordings to the first of these inputs.
            interval: Samples of the interval among these inputs.
            lead: Number of samples before the interval that matter.
            memory: Memory at the end of the interval before it; None for the first interval.
        """
        return cls(
            before=inputs[:, interval.start - lead : interval.start],
            after=inputs[:, interval.stop : interval.stop + 1],
            samples=samples + interval.start,
            memory=memory,
        )

    def repeated(self, count: int) -> InputContext:
        """This context of m curves for `count * m` curves, of which the memory is that already.

        Args:
            count: How often all curves are repeated, one repetition after the other.
        """
        return replace(
            self,
            before=np.tile(self.before, (count, 1, 1)),
            after=np.tile(self.after, (count, 1, 1)),
            samples=np.tile(self.samples, count),
        )

    def of_curves(self, chosen: np.ndarray) -> InputContext:
        """The context of some of the curves.

        Args:
            chosen: Indices of the curves.
        """
        memory = self.memory
        return InputContext(
            before=self.before[chosen],
            after=self.after[chosen],
            samples=self.samples[chosen],
            memory=None if memory is None else tuple(each.of_curves(chosen) for each in memory),
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class LoopTrace:
    """Record of control laws along m curves of N samples.

    Attributes:
        controls: (m, N, nu) controls at the begin of every sample [u-unit].
        is_clipped: (m, N, laws) True where the range or the largest change of a control has clipped
            it.
        memory: Memory at the end of the curves, grouped by the periods of the laws.
    """

    controls: Array
    is_clipped: np.ndarray
    memory: tuple[LawMemory, ...]

    @classmethod
    def joined(cls, parts: Sequence[LoopTrace], places: np.ndarray) -> LoopTrace:
        """Put the traces of all curves together.

        Args:
            parts: Traces of some curves each.
            places: (m,) place of each curve among those of all parts.
        """
        memories = zip(*(part.memory for part in parts), strict=True)
        return cls(
            controls=np.concatenate([part.controls for part in parts])[places],
            is_clipped=np.concatenate([part.is_clipped for part in parts])[places],
            memory=tuple(LawMemory.joined(each, places) for each in memories),
        )
