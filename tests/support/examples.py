"""Experiments of the repository as files that can be designed.

Experiments that are made for identification state no horizon, no initial control and no cost; tests
of designs add them.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tests.support.paths import MODELS


@dataclass(frozen=True, kw_only=True)
class DesignTables:
    """TOML that makes an experiment for identification one that can be designed.

    Attributes:
        horizon: Duration of the design [s].
        control: Initial control.
        tables: Further tables.
    """

    horizon: float
    control: str
    tables: str = "[descent]\ntolerance = 1e-2\n"


# Additions to the experiments that state none.
DESIGN_TABLES = {
    "dfki_simple_pendulum": DesignTables(
        horizon=2.0,
        control='{ kind = "chirp", amplitude = 1.2, frequency = 0.4, frequency_end = 1.5 }',
        tables="[cost]\ncontrol = 1e-3\n\n[descent]\ntolerance = 1e-2\n",
    ),
    "dfki_double_pendulum": DesignTables(
        horizon=2.5,
        control='{ kind = "chirp", amplitude = { shoulder = 0.6, elbow = 0.4 }, '
        "frequency = 0.4, frequency_end = 2.0 }",
    ),
    # The goal (pull) swings at kp = 100. The brake grows and fades, which separates it from
    # damping.
    "bam_xl330": DesignTables(
        horizon=6.0,
        control='{ kind = "sine", amplitude = { pull = 2.0, brake = 0.5 }, '
        "offset = { stiffness = 2.1286, brake = 0.5 }, frequency = 0.6 }",
    ),
    "two_joint_arm": DesignTables(
        horizon=4.0,
        control='{ kind = "multisine", amplitude = { shoulder = 8.0, elbow = 3.0 }, '
        "frequency = 0.3, harmonics = 8 }",
        tables="",
    ),
}


def design_file(name: str, folder: Path) -> Path:
    """Return the file of an example that can be designed.

    Args:
        name: Name of the example.
        folder: Folder that receives a copy, where the example needs additions.
    """
    file = MODELS / f"{name}.toml"
    if name not in DESIGN_TABLES:
        return file

    added = DESIGN_TABLES[name]
    text = file.read_text(encoding="utf-8")
    text = text.replace('model = "', f'model = "{MODELS.as_posix()}/')
    text = text.replace("\n[initial]\n", f"\n[initial]\ncontrol = {added.control}\n")
    target = folder / file.name
    target.write_text(f"horizon = {added.horizon}\n{text}\n{added.tables}", encoding="utf-8")
    return target
