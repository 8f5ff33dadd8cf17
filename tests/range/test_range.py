"""A thinned matrix: what works is equal to plain MuJoCo, and what does not is said."""

from __future__ import annotations

import pytest

from tests.range.cells import Cell, run
from tests.range.plants import PLANTS, Setting

# Settings that differ from the usual one in one or two respects.
SETTINGS = {
    "a microgram": Setting(mass=1e-6),
    "a kiloton": Setting(mass=1e6),
    "light beside heavy": Setting(ratio=1e-6, mass=1e3),
    "heavy beside light": Setting(ratio=1e6, mass=1e-3),
    "Euler": Setting(integrator="Euler"),
    "implicit": Setting(integrator="implicit"),
    "implicitfast": Setting(integrator="implicitfast", timestep=0.001),
    "long timestep": Setting(timestep=0.05),
}


@pytest.mark.parametrize("setting", SETTINGS.values(), ids=SETTINGS)
@pytest.mark.parametrize("plant", PLANTS)
@pytest.mark.slow
def test_nothing_is_wrong_in_silence(plant: str, setting: Setting) -> None:
    cell = run(Cell(plant=plant, setting=setting, verbs=("check", "design", "identify")))
    wrong = [verdict for verdict in cell.verdicts if verdict.word == "WRONG"]
    assert not wrong, f"{cell}: {wrong}"
