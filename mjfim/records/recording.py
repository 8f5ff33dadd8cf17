"""Record of the measurements of one experiment."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np

from mjfim.arrays import Array, freeze
from mjfim.errors import RecordingError
from mjfim.records.serialization import SavedRecord


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Recording(SavedRecord):
    """Measured or simulated outputs under a known control, at the times of the log.

    Attributes:
        t: (M,) increasing times [s]; the intervals may differ.
        ctrl: (M-1, nu) controls, held from each row to the next [unit of the actuator].
        y: (M, ny) measured outputs in the order of `outputs` [unit of the output]; NaN where an
            output was not measured.
        outputs: Names of the ny outputs: `qpos:<joint>`, `qvel:<joint>` or the name of a sensor.
        name: Name of the recording in messages, usually its file.
    """

    t: Array
    ctrl: Array
    y: Array
    outputs: tuple[str, ...]
    name: str = "recording"

    file_stem: ClassVar[str] = "recording"
    made_by: ClassVar[str] = "Recording.save"

    def __post_init__(self) -> None:
        for name in ("t", "y"):
            if np.asarray(getattr(self, name)).dtype == np.bool_:
                raise RecordingError(
                    f"{self.name}: {name!r} holds truth values (True and False), which are no "
                    "measurement; give an array of numbers"
                )
        freeze(self, "t", "ctrl", "y")

    def first_rows(self, count: int) -> Recording:
        """The recording without the rows after the first ones.

        Args:
            count: Number of rows that remain, at least 2; a shorter recording is unchanged.
        """
        if len(self.t) <= count:
            return self
        return replace(self, t=self.t[:count], ctrl=self.ctrl[: count - 1], y=self.y[:count])

    def summary(self) -> dict[str, Any]:
        """Return the contents of recording.json."""
        return {
            "name": self.name,
            "rows": len(self.t),
            "outputs": list(self.outputs),
            "nu": self.ctrl.shape[1],
        }
