"""Rows of score tests: those of a linearisation by all parameters at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.arrays import Array
from mjfim.excitation.task import DesignTask
from mjfim.experiment.simulate import simulate_system
from mjfim.identification import segment_simulation
from mjfim.identification.extended_problems import extended_problem, extended_system
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.fit_workers import FitWorkers
from mjfim.identification.score_rows import ScoreRows
from mjfim.identification.task import FitTask
from mjfim.optimize.condensed_least_squares import Condensed
from mjfim.optimize.levenberg_marquardt import UnknownValues
from tests.support.executors import LosingThreads
from tests.support.paths import MODELS

# Parameters of the extended model: friction of the cart, and a number that needs no simulation.
FURTHER: dict[str, Any] = {
    "slide_damping": {"target": "joint/slide:damping", "guess": 0.0, "scale": 0.1},
    "shift": {"target": "output/qpos:hinge:bias", "guess": 0.0, "scale": 0.1},
}

# Whole recordings, short segments with fewer values than columns, and a robust loss.
FITS: dict[str, dict[str, Any]] = {
    "whole": {},
    "free starts": {"start": "measured"},
    "segments": {"segments": 0.05, "start": "measured"},
    "robust": {"loss": "soft_l1", "loss_scale": 0.5},
}


def recordings_of(experiment: mjfim.Experiment) -> list[mjfim.Recording]:
    """Three recordings that differ by their noise."""
    task = DesignTask.resolve(experiment, threads=1)
    return [simulate_system(task.system, task.initial, seed) for seed in range(3)]


def stated(fit: dict[str, Any], **tables: Any) -> tuple[FitProblem, list[mjfim.Recording]]:
    """The fit to short recordings of the cart-pendulum, and the recordings."""
    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml").replace(
        horizon=0.5, fit=fit, **tables
    )
    recordings = recordings_of(experiment)
    return FitTask.resolve(experiment, recordings, threads=1).problem(), recordings


def extended(
    problem: FitProblem, recordings: Sequence[mjfim.Recording], at: UnknownValues
) -> tuple[FitProblem, UnknownValues, list[int]]:
    """The problem with further parameters, its unknowns, and the indices of these parameters."""
    system = extended_system(problem.system, FURTHER, {})
    assert system is not None
    wider, begin = extended_problem(problem, recordings, at, system)
    names = system.parameters.names
    return wider, begin, [names.index(name) for name in FURTHER]


def information(condensed: Condensed, order: Sequence[int]) -> Array:
    """(c+1, c+1) products of the rows without private unknowns, columns in some order."""
    rows = np.concatenate([condensed.reduced_rows(), condensed.common_rows])
    rows = rows[:, [*order, -1]]
    return np.asarray(rows.T @ rows)


def of_all_parameters(wider: FitProblem, begin: UnknownValues, problem: FitProblem) -> Array:
    """Products of the rows of the extended problem, further parameters last."""
    condensed = wider.condense(begin)
    assert condensed is not None
    names = wider.system.parameters.names
    of_column = [names[i] for i in wider.layout.parameter_of_column]
    known = [problem.system.parameters.names[i] for i in problem.layout.parameter_of_column]
    return information(condensed, [of_column.index(name) for name in (*known, *FURTHER)])


@pytest.mark.parametrize("case", FITS)
def test_they_are_those_of_a_linearisation_by_all_parameters(case: str) -> None:
    problem, recordings = stated(FITS[case])
    at = problem.begin(0.9 * problem.system.parameters.guess)
    wider, begin, further = extended(problem, recordings, at)

    rows = ScoreRows.of(problem, at)
    assert rows is not None
    condensed = rows.beside(wider, begin, further)
    assert condensed is not None
    found = information(condensed, range(condensed.common_count))

    expected = of_all_parameters(wider, begin, problem)
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, rtol=0.0, atol=1e-6)


def test_the_stated_columns_are_simulated_once() -> None:
    problem, recordings = stated({})
    at = problem.begin(problem.system.parameters.guess)
    rows = ScoreRows.of(problem, at)
    assert rows is not None
    wider, begin, further = extended(problem, recordings, at)

    plant = wider.system.plant
    before = plant.engine_steps
    assert rows.beside(wider, begin, further) is not None
    samples = sum(segment.samples for segment in problem.segments)

    # Two simulations for the friction, one at the unknowns, and none for the bias.
    assert plant.engine_steps - before == 3 * samples * plant.simulator.substeps


def test_workers_find_the_same_digits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segment_simulation, "MAX_NUMBERS_AT_ONCE", 2000)
    problem, recordings = stated(FITS["segments"])
    at = problem.begin(problem.system.parameters.guess)
    wider, begin, further = extended(problem, recordings, at)

    def condensed(problem: FitProblem, wider: FitProblem) -> Condensed:
        """The rows of a problem beside those of the extended one."""
        rows = ScoreRows.of(problem, at)
        assert rows is not None
        found = rows.beside(wider, begin, further)
        assert found is not None
        return found

    alone = condensed(problem, wider)
    with LosingThreads() as threads:
        workers = FitWorkers(threads)
        divided = condensed(problem.on_workers(workers), wider.on_workers(workers))
    assert threads.submitted > 4
    assert np.array_equal(divided.blocks, alone.blocks)


def test_a_model_that_diverges_with_further_parameters_has_no_rows() -> None:
    problem, recordings = stated({})
    at = problem.begin(problem.system.parameters.guess)
    rows = ScoreRows.of(problem, at)
    assert rows is not None
    wider, begin, further = extended(problem, recordings, at)

    theta = np.array(begin.theta)
    theta[further[0]] = -1e9
    assert rows.beside(wider, replace(begin, theta=theta), further) is None


def test_a_problem_that_diverges_has_no_rows() -> None:
    problem, _ = stated({})
    assert ScoreRows.of(problem, problem.begin(np.array([1e-3, 1e-3, -1e6]))) is None
