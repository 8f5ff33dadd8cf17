"""An arm that designs with little time bring from rest to rest."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from mjfim.excitation.task import DesignTask
from tests.support.limits import ARM
from tests.support.numerics import make_task

# An arm that has to come to rest, whose initial control leaves its limits by far.
RESTING_ARM: dict[str, Any] = {
    "horizon": 1.0,
    "rate": 100.0,
    "parameters": {
        "m": {"target": "body/fore:mass"},
        "c": {"target": "joint/elbow:damping"},
        "a": {"target": "joint/shoulder:armature"},
    },
    "noise": {"qpos:shoulder": 0.01, "qpos:elbow": 0.01},
    "boundary": {"end": "rest", "position": 1e-3, "velocity": 1e-2},
    "limits": {
        "position": {"shoulder": (-1.0, 1.0), "elbow": (-1.0, 1.0)},
        "velocity": 6.0,
        "control_rate": 20.0,
    },
    "initial": {
        "control": {
            "kind": "sine",
            "amplitude": {"shoulder": 0.1, "elbow": 0.1},
            "frequency": 1.0,
        }
    },
}


def resting_arm(folder: Path, descent: dict[str, Any], **limits: Any) -> DesignTask:
    """An arm from rest to rest with five engine steps in each sample.

    Args:
        folder: Folder for the model.
        descent: The table `[descent]`.
        **limits: Further limits.
    """
    stated = {**RESTING_ARM["limits"], **limits}
    return make_task(ARM, folder, **{**RESTING_ARM, "limits": stated, "descent": descent})
