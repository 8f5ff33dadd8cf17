"""Thinned motions of the iterates of a design, from which a viewer can show how the search went."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mjfim.parallel.sealed import opened, sealed
from mjfim.records.trajectory import Trajectory

# Largest number of iterates of one search whose motions are kept, and number of samples of each.
MAX_MOTIONS, MOTION_SAMPLES = 40, 200

# Arrays of a motion, and the attribute that holds them as bytes.
MOTION_ARRAYS = ("t", "qpos", "ctrl")
SEALED = "_sealed"

# Motions are only drawn, so that half of the digits are enough.
DrawnArray = NDArray[np.float32]


def _freeze_drawn(record: object, *names: str) -> None:
    """Replace named fields of a frozen record by read-only float32 arrays."""
    for name in names:
        # What is too large for this type is drawn nowhere.
        with np.errstate(over="ignore"):
            array = np.array(getattr(record, name), dtype=np.float32)
        array.setflags(write=False)
        object.__setattr__(record, name, array)


@dataclass(frozen=True, eq=False, kw_only=True)
class IterateMotion:
    """Motion of one iterate at `MOTION_SAMPLES` evenly spread samples, n in all.

    It is pickled as bytes, which are read when an array is asked for first: a process that collects
    the iterates of many searches draws the motions of one of them only.

    Attributes:
        t: (n,) times [s].
        qpos: (n, nq) positions [m or rad; unit quaternions for ball and free joints].
        ctrl: (n, nu) controls; the last one is repeated at the end [unit of the actuator].
    """

    t: DrawnArray
    qpos: DrawnArray
    ctrl: DrawnArray

    def __post_init__(self) -> None:
        _freeze_drawn(self, "t", "qpos", "ctrl")

    def __reduce__(self) -> tuple[Callable[[bytes], IterateMotion], tuple[bytes]]:
        """Pickle the arrays as bytes, which are made once."""
        data = self.__dict__.get(SEALED)
        if data is None:
            data = sealed({name: getattr(self, name) for name in MOTION_ARRAYS})
            object.__setattr__(self, SEALED, data)
        return _sealed_motion, (data,)

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Read the arrays of a motion that comes from another process."""
            data = self.__dict__.get(SEALED)
            if data is None or name not in MOTION_ARRAYS:
                raise AttributeError(f"{type(self).__name__} has no attribute {name!r}")

            for key, array in opened(data).items():
                array.setflags(write=False)
                object.__setattr__(self, key, array)
            return self.__dict__[name]

    @classmethod
    def of(cls, trajectory: Trajectory | None) -> IterateMotion | None:
        """Thin a trajectory.

        Args:
            trajectory: The trajectory; None for an iterate whose simulation diverged.

        Returns:
            The motion; None without a trajectory, and where it is not finite.
        """
        if trajectory is None or not np.isfinite(trajectory.qpos).all():
            return None

        # A trajectory with fewer samples repeats some, so that all motions have the same size.
        last = trajectory.samples
        rows = np.linspace(0, last, MOTION_SAMPLES).round().astype(np.intp)
        held = np.minimum(rows, last - 1)
        return cls(
            t=trajectory.t[rows].astype(np.float32),
            qpos=trajectory.qpos[rows].astype(np.float32),
            ctrl=trajectory.ctrl[held].astype(np.float32),
        )


def _sealed_motion(data: bytes) -> IterateMotion:
    """A motion whose arrays are read later."""
    motion = object.__new__(IterateMotion)
    object.__setattr__(motion, SEALED, data)
    return motion


@dataclass(frozen=True, eq=False, kw_only=True)
class IterateMotions:
    """Motions of m iterates of a design, with n samples each.

    Attributes:
        iteration: (m,) ascending numbers of the iterates.
        t: (m, n) times [s].
        qpos: (m, n, nq) positions [m or rad; unit quaternions for ball and free joints].
        ctrl: (m, n, nu) controls [unit of the actuator].
    """

    iteration: DrawnArray
    t: DrawnArray
    qpos: DrawnArray
    ctrl: DrawnArray

    def __post_init__(self) -> None:
        _freeze_drawn(self, "iteration", "t", "qpos", "ctrl")

    @classmethod
    def of(cls, motions: Sequence[tuple[int, IterateMotion]]) -> IterateMotions | None:
        """Join motions.

        Args:
            motions: Number and motion of each iterate, ascending.

        Returns:
            The motions; None if there are none.
        """
        if not motions:
            return None
        return cls(
            iteration=np.array([iteration for iteration, _ in motions], dtype=np.float32),
            t=np.stack([motion.t for _, motion in motions]),
            qpos=np.stack([motion.qpos for _, motion in motions]),
            ctrl=np.stack([motion.ctrl for _, motion in motions]),
        )


def superfluous(iterations: Sequence[int], limit: int = MAX_MOTIONS) -> set[int]:
    """Choose iterates whose motions are dropped, so that at most `limit` remain.

    One after the other the iterate is dropped whose neighbours are nearest to each other. The first
    and the last one stay.

    Args:
        iterations: Ascending numbers of the iterates that have a motion.
        limit: Largest number that remains, at least 2.

    Returns:
        Places in `iterations` of those that are dropped.
    """
    kept = list(range(len(iterations)))
    while len(kept) > limit:
        numbers = np.array([iterations[place] for place in kept])
        gaps = numbers[2:] - numbers[:-2]
        del kept[1 + int(np.argmin(gaps))]
    return set(range(len(iterations))) - set(kept)
