"""Every example of the repository goes through `check` and `design`, pictures and Rerun file
included.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.output import folders as results
from tests.support.cli import MODELS, read
from tests.support.examples import design_file

EXAMPLES = sorted(
    path.stem for path in MODELS.glob("*.toml") if not path.stem.startswith("cart_pendulum")
)
ROUGH = {
    "sliding_block",
    "double_pendulum",
    "bam_xl330",
    "dfki_double_pendulum",
    "dfki_simple_pendulum",
}  # contact and dry friction

TOGETHER = {"double_pendulum", "ball_pendulum"}  # not every parameter can be told alone


def shortened(name: str, folder: Path) -> mjfim.Experiment:
    """An example of half of its horizon, which few robots rehearse."""
    stated = mjfim.Experiment.from_file(design_file(name, folder))
    return stated.replace(horizon=0.5 * stated.horizon, rehearsal={"robots": 4})


def test_every_model_has_an_experiment() -> None:
    assert {path.stem for path in MODELS.glob("*.xml")} == {*EXAMPLES, "cart_pendulum"}


@pytest.mark.parametrize(
    "name",
    [pytest.param(x, marks=[] if x == "four_bar" else pytest.mark.slow) for x in EXAMPLES],
)
def test_check_names_the_subject_of_the_example(name: str, tmp_path: Path) -> None:
    found = mjfim.check(shortened(name, tmp_path))
    assert np.isfinite(found.self_test.slope)
    assert found.self_test.passed
    acting = found.self_test.acting
    assert not acting or name in ROUGH
    assert all("friction" in cause or "contact" in cause for cause in acting)
    assert bool(found.not_separable) == (name in TOGETHER)
    assert found.not_excited == ()


@pytest.mark.slow
@pytest.mark.usefixtures("empty_figures")
@pytest.mark.parametrize("name", EXAMPLES)
def test_a_short_design_improves_and_writes_all_files(name: str, tmp_path: Path) -> None:
    """All figures are made, and not rendered."""
    task = DesignTask.resolve(shortened(name, tmp_path).replace(descent={"max_iterations": 3}))
    design = design_task(task)
    assert design.final.cost < design.initial.cost
    folder = tmp_path / "out"
    _, draw = results.write_result(folder, design, task.system)
    draw()
    told = read(folder / "design.json")
    assert len(told["final"]["std"]) == len(told["parameters"])
    assert [c["words"] for c in told["combined"]] == [c.name for c in design.combined]
    assert bool(design.combined) == (name in TOGETHER)
