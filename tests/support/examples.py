"""Experiments of the repository as files that can be designed.

Experiments that are made for identification state no horizon, no initial control and no cost; tests
of designs add them.
"""

from __future__ import annotations

from pathlib import Path

from tests.support.paths import MODELS

TOLERANCE = "[descent]\ntolerance = 1e-2\n"

# What is added to the experiments for identification: the duration of the design [s], the initial
# control, and further tables.
DESIGN_TABLES = {
    "dfki_simple_pendulum": (
        2.0,
        '{ kind = "chirp", amplitude = 1.2, frequency = 0.4, frequency_end = 1.5 }',
        f"[cost]\ncontrol = 1e-3\n\n{TOLERANCE}",
    ),
    "dfki_double_pendulum": (
        2.4,
        '{ kind = "chirp", amplitude = { shoulder = 0.6, elbow = 0.4 }, '
        "frequency = 0.4, frequency_end = 2.0 }",
        TOLERANCE,
    ),
    # The goal (pull) swings at kp = 100. The brake grows and fades, which separates it from
    # damping.
    "bam_xl330": (
        6.0,
        '{ kind = "sine", amplitude = { pull = 2.0, brake = 0.5 }, '
        "offset = { stiffness = 2.1286, brake = 0.5 }, frequency = 0.6 }",
        TOLERANCE,
    ),
    "two_joint_arm": (
        4.0,
        '{ kind = "multisine", amplitude = { shoulder = 8.0, elbow = 3.0 }, '
        "frequency = 0.3, harmonics = 8 }",
        "",
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

    horizon, control, tables = DESIGN_TABLES[name]
    text = file.read_text(encoding="utf-8")
    text = text.replace('model = "', f'model = "{MODELS.as_posix()}/')
    text = text.replace("\n[initial]\n", f"\n[initial]\ncontrol = {control}\n")
    target = folder / file.name
    target.write_text(f"horizon = {horizon}\n{text}\n{tables}", encoding="utf-8")
    return target
