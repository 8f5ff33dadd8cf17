"""The signals that a log of an experiment may hold, and how to read them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mjfim.arrays import Array
from mjfim.model.coordinates import measurable_columns
from mjfim.recordings.spec import RecordingSpec


@dataclass(frozen=True, kw_only=True, eq=False)
class Channels:
    """Signals of an experiment by name, and everything else that is needed to read and check a log.

    Attributes:
        model: The compiled MuJoCo model (`mujoco.MjModel`) at its nominal parameters.
        controls: nu names of the controls, in the order of the model's actuators.
        outputs: Names of the m outputs that the experiment measures.
        sigma: (m,) standard deviations of the outputs' measurement noise [output unit].
        spec: The `[recording]` table of the experiment file.
        source: Name of the experiment file, for messages.
    """

    model: Any
    controls: tuple[str, ...]
    outputs: tuple[str, ...]
    sigma: Array
    spec: RecordingSpec
    source: str

    @property
    def control_columns(self) -> tuple[str, ...]:
        """Column names of the controls in a recording, `ctrl:<actuator>`."""
        return tuple(f"ctrl:{name}" for name in self.controls)

    @property
    def measurable(self) -> tuple[str, ...]:
        """Column names of everything that can be measured: components of the state, and sensors."""
        return measurable_columns(self.model)
