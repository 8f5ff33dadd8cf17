"""A thinned matrix: what works is equal to plain MuJoCo, and what does not is said."""

from __future__ import annotations

import pytest

from tests.range.cells import Cell, run
from tests.range.plants import Setting

# Each plant in some settings that differ from the usual one; `python -m tests.range` runs all.
CELLS = (
    ("cart-pendulum", Setting(mass=1e-6, horizon=1.0)),
    ("cart-pendulum", Setting(timestep=1e-4, integrator="implicitfast", horizon=0.25)),
    ("inverted pendulum", Setting(mass=1e6, integrator="implicit", horizon=1.0)),
    ("inverted pendulum", Setting(timestep=0.05, horizon=4.0)),
    ("acrobot", Setting(mass=1e-3, ratio=1e6, horizon=1.0)),
    ("acrobot", Setting(timestep=0.05, integrator="Euler", horizon=4.0)),
    ("stiff spring", Setting(mass=1e3, ratio=1e-6, horizon=0.5)),
    ("stiff spring", Setting(timestep=0.05, integrator="implicit", horizon=1.0)),
    ("bouncing ball", Setting(timestep=0.05)),
    ("bouncing ball", Setting(mass=1e3, integrator="Euler", horizon=1.0)),
    ("free body", Setting(mass=1e-6, timestep=0.02, horizon=1.0)),
    ("arm", Setting(mass=1e6, timestep=0.02, integrator="implicit", horizon=1.0)),
)


@pytest.mark.parametrize(("plant", "setting"), CELLS, ids=[f"{p}, {s}" for p, s in CELLS])
@pytest.mark.slow
def test_nothing_is_wrong_in_silence(plant: str, setting: Setting) -> None:
    cell = run(Cell(plant=plant, setting=setting))
    wrong = [verdict for verdict in cell.verdicts if verdict.word == "WRONG"]
    assert not wrong, f"{cell}: {wrong}"
