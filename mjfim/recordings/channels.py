"""The signals that a log of an experiment may hold, and how to read them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mjfim.arrays import Array
from mjfim.model.control_laws import ControlLaws
from mjfim.model.coordinates import measurable_columns
from mjfim.recordings.spec import RecordingSpec


@dataclass(frozen=True, kw_only=True, eq=False)
class Channels:
    """Signals of an experiment by name, and everything else that is needed to read and check a log.

    Attributes:
        model: The compiled MuJoCo model (`mujoco.MjModel`) at its nominal parameters.
        controls: nu names of the controls, in the order of the model's actuators.
        laws: Control laws, which read other columns instead of controls; None without any.
        outputs: Names of the m outputs that the experiment measures.
        sigma: (m,) standard deviations of the outputs' measurement noise [output unit].
        spec: The `[recording]` table of the experiment file.
        source: Name of the experiment file, for messages.
    """

    model: Any
    controls: tuple[str, ...]
    laws: ControlLaws | None
    outputs: tuple[str, ...]
    sigma: Array
    spec: RecordingSpec
    source: str

    @property
    def control_columns(self) -> tuple[str, ...]:
        """Columns of a recording that drive a simulation.

        They are the controls, `ctrl:<actuator>`, or what a law reads, `reference:<actuator>`.
        """
        if self.laws is not None:
            return self.laws.columns
        return tuple(f"ctrl:{name}" for name in self.controls)

    @property
    def measurable(self) -> tuple[str, ...]:
        """Column names of everything that can be measured: components of the state, and sensors."""
        return measurable_columns(self.model)
