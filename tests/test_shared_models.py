"""Models of others (`shared_models`): every file loads, and a design beats the chirp tenfold."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest
from numerics import SHARED, shared_model
from shared_models import EXPERIMENTS

import mjfim
from mjfim.models import compile_spec, load_spec
from mjfim.trajectory import Status

# iterations that reach tenfold with margin, where convergence takes longer than a test should
SHORT: dict[str, int] = {}
GAIN = 10.0


def experiment(name: str) -> mjfim.Experiment:
    """The experiment of this name, beside its model; skips where that is absent."""
    path = shared_model(EXPERIMENTS[name]["model"])
    chosen = mjfim.Experiment(**EXPERIMENTS[name], directory=SHARED, source=name)
    assert path == SHARED / chosen.model
    return chosen.replace(descent={"max_iterations": SHORT[name]}) if name in SHORT else chosen


def files() -> list[Path]:
    """Every MJCF of the shared models that stands alone; parts that others include do not."""
    return [p for p in sorted(SHARED.glob("*/*.xml")) if "<worldbody" in p.read_text(encoding="utf-8")]


def test_every_shared_model_loads() -> None:
    if not SHARED.is_dir():
        pytest.skip(f"no shared models at {SHARED}")
    loaded = []
    for path in files():
        meshes = "<mesh " in path.read_text(encoding="utf-8")
        if meshes and not list(path.parent.rglob("*.obj")) + list(path.parent.rglob("*.stl")):
            continue  # its meshes were not copied; the variant without them is
        model = compile_spec(load_spec(path), path)
        mujoco.mj_step(model, mujoco.MjData(model))
        loaded.append(path.parent.name)
    assert {EXPERIMENTS[name]["model"].split("/")[0] for name in EXPERIMENTS} <= set(loaded)


@pytest.mark.parametrize("name", ["cartpole", "acrobot", "furuta", "so_arm100", "panda"])
def test_design_knows_ten_times_more_than_the_chirp(name: str) -> None:
    design = mjfim.design(experiment(name))
    gain = design.final.eigenvalues[0] / design.initial.eigenvalues[0]
    assert gain >= GAIN, f"{gain:.3g}, {design.status.value}"
    assert all(margin >= 0.0 for margin in design.limits.values()), design.limits
    assert not any("clamps" in sentence for sentence in design.warnings), design.warnings
    assert design.status.success or (name in SHORT and design.status is Status.MAX_ITERATIONS)
