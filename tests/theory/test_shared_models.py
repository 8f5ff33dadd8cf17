"""Models from other projects (`shared_models`).

Every file loads, and a design has ten times the information of a chirp.
"""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

import mjfim
from mjfim.errors import ModelError
from mjfim.model.loading import compile_spec, load_spec
from tests.support.numerics import shared_model
from tests.support.paths import SHARED_MODELS
from tests.support.shared_models import EXPERIMENTS

# Smallest ratio of the information of a design to that of its initial chirp.
GAIN = 10.0


def experiment(name: str) -> mjfim.Experiment:
    """The experiment of this name, next to its model; the test is skipped where it is missing."""
    shared_model(EXPERIMENTS[name]["model"])
    return mjfim.Experiment(**EXPERIMENTS[name], directory=SHARED_MODELS, source=name)


def test_every_shared_model_loads() -> None:
    """Files that compile alone: not included by another file, and without mesh files."""
    if not SHARED_MODELS.is_dir():
        pytest.skip(f"no shared models at {SHARED_MODELS}")
    loaded = set()
    for path in sorted(SHARED_MODELS.glob("*/*.xml")):
        text = path.read_text(encoding="utf-8")
        if "<worldbody" not in text or "<mesh " in text:
            continue
        # MuJoCo finds no length range for this one; the variant beside it states one.
        if path.name == "arm26.xml":
            with pytest.raises(ModelError, match="Lengthrange"):
                compile_spec(load_spec(path), path)
            continue
        model = compile_spec(load_spec(path), path)
        data = mujoco.MjData(model)
        mujoco.mj_step(model, data)
        assert np.isfinite(data.qpos).all()
        loaded.add(path.parent.name)
    assert loaded == {folder.name for folder in SHARED_MODELS.iterdir() if folder.is_dir()}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "descent"),
    [
        ("cartpole", {}),
        ("acrobot", {"max_iterations": 8}),
        ("furuta", {"max_iterations": 8}),
        ("panda", {}),
        ("so_arm100", {"max_iterations": 4}),
    ],
)
def test_a_design_has_ten_times_the_information_of_the_chirp(
    name: str, descent: dict[str, int]
) -> None:
    stated = experiment(name).replace(descent=descent, rehearsal={"robots": 4})
    design = mjfim.design(stated)
    gain = design.final.eigenvalues[0] / design.initial.eigenvalues[0]
    assert gain >= GAIN, f"{gain:.3g}, {design.status.value}"
    assert all(margin >= 0.0 for margin in design.limits.values()), design.limits
    assert not any("clamps" in sentence for sentence in design.warnings), design.warnings
    assert design.rehearsal is not None


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name == "pendulum" else pytest.mark.slow)
        for name in EXPERIMENTS
    ],
)
def test_check_passes(name: str) -> None:
    """Every initial trajectory shows every parameter."""
    found = mjfim.check(experiment(name).replace(rehearsal={"robots": 4}))
    assert not found.not_separable
    assert not found.not_excited
    assert all(np.isfinite(row.std) for row in found.rows)
    assert found.self_test.passed, found.self_test
    assert found.steps is not None
