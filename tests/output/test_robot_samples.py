"""Models of drawn robots: each equals the model in memory, and nothing is half-written."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import mjfim
from mjfim.experiment.system import System
from mjfim.identification.assessment.parameter_draws import draw_parameters_system
from mjfim.model.given import same_dynamics
from mjfim.output import folders
from mjfim.output.export.mjcf import write_identified
from mjfim.output.folders import clear_samples, sample_files, write_samples
from mjfim.output.manifest import MANIFEST, OutputGuard, claimed
from mjfim.output.page import Text
from mjfim.output.pages.estimate import sample_parts
from mjfim.records.estimate import Estimate, PriorDirections
from tests.identification.test_parameter_draws import COVARIANCE, estimated
from tests.output.test_mjcf import compiled
from tests.support.cart_pendulum import cart_pendulum


def drawn(system: System, covariance: Any, count: int) -> Estimate:
    """An estimate with draws."""
    estimate = estimated(system, np.asarray(covariance))
    rng = np.random.default_rng(0)
    return replace(estimate, draws=draw_parameters_system(system, estimate, count, rng))


@pytest.fixture(scope="module")
def system() -> System:
    return System.resolve(cart_pendulum())


def test_every_model_is_the_one_in_memory(system: System, tmp_path: Path) -> None:
    estimate, out = drawn(system, COVARIANCE, 5), tmp_path / "out"
    values = estimate.draws.values
    assert write_samples(out, estimate.draws, estimate.theta, system) == []
    found = {path.relative_to(out).as_posix() for path in out.rglob("*.*")}
    assert found == {*sample_files(out)}

    for i in range(5):
        written = compiled(out / "samples" / f"robot_{i + 1:04d}.xml")
        theta = np.array(estimate.theta)
        theta[~system.parameters.initial_deviations] = values[i]
        assert same_dynamics(written, system.model_at(theta, at_keyframe=False))
        assert written.body("bob").mass[0] == values[i, 0]

    # The table holds all digits.
    with (out / "samples.csv").open(encoding="utf-8", newline="") as stream:
        header, *rows = csv.reader(stream)
    assert header[:2] == ["robot", "m [kg]"]
    table = np.array([[float(cell) for cell in row] for row in rows])
    assert_array_equal(table, np.column_stack([np.arange(1.0, 6.0), values]))


def test_all_models_are_written_or_none(
    system: System, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The third model cannot be written."""
    estimate = drawn(system, COVARIANCE, 4)
    write = write_identified

    def fail(path: Path, *arguments: Any) -> str | None:
        """Write the model of a robot, but not that of the third."""
        if path.stem.endswith("3"):
            raise mjfim.errors.ModelError("the link has a fault")
        return write(path, *arguments)

    monkeypatch.setattr(folders, "write_identified", fail)
    with claimed(tmp_path, OutputGuard([], force=False), exclusive=True):
        (remark,) = write_samples(tmp_path, estimate.draws, estimate.theta, system)
    assert remark == "no models of drawn robots were written: the link has a fault"
    assert {path.name for path in tmp_path.iterdir()} == {"samples.csv", MANIFEST}


def test_files_of_the_user_remain(system: System, tmp_path: Path) -> None:
    estimate = drawn(system, COVARIANCE, 3)
    with claimed(tmp_path, OutputGuard([], force=False), exclusive=True):
        write_samples(tmp_path, estimate.draws, estimate.theta, system)
    (tmp_path / "samples" / "robot_0002.xml").write_text("edited", encoding="utf-8")
    (tmp_path / "samples" / "notes.txt").write_text("mine", encoding="utf-8")
    with claimed(tmp_path, OutputGuard([], force=False), exclusive=True):
        clear_samples(tmp_path)
    names = {path.name for path in (tmp_path / "samples").iterdir()}
    assert names == {"robot_0002.xml", "notes.txt", MANIFEST}
    assert not (tmp_path / "samples.csv").exists()


def test_what_is_equal_in_all_robots_is_said(system: System) -> None:
    estimate = drawn(system, COVARIANCE, 3)
    assert estimate.draws is not None
    assert "do not differ" not in texts(estimate)

    # A parameter that the fit held, and inertias that the model alone tells.
    held = texts(replace(estimate, held=("c", "another")))
    assert "The drawn robots do not differ in c, which the fit held at the guess" in held
    directions = PriorDirections(bodies=("link1",), count=10, determined=7, parameters=())
    draws = replace(estimate.draws, held_combinations=3)
    said = texts(replace(estimate, draws=draws, prior_directions=directions))
    assert "differ in 7 of 10 combinations of the inertial parameters of link1" in said
    assert "3 combinations of inertias that the recordings do not determine stayed there" in said


def texts(estimate: Estimate) -> str:
    """All sentences about the drawn robots."""
    parts = sample_parts(estimate)
    return " ".join(part.text for part in parts if isinstance(part, Text))
