"""Tests of much data use a part of it that is spread over all recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.experiment.system import System
from mjfim.identification.assessment import term_tests
from mjfim.identification.assessment.term_tests import (
    TermTests,
    find_missing_terms,
    part_of_data,
)
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.search import of_subset
from mjfim.records.terms import TermTestData
from tests.identification.test_missing_terms import with_failing
from tests.support.terms import (
    experiment_of,
    motor_torque,
    recorded,
    small_logs,
    solution_near,
    write_pendulum,
)

RATE = 100.0


@pytest.fixture(autouse=True)
def few_samples_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """The recordings of these tests are short."""
    monkeypatch.setattr(term_tests, "ENOUGH_SAMPLES", 10)


def problem_of(folder: Path, count: int, segments: float | str = "whole") -> FitProblem:
    """Recordings of a pendulum of two seconds each."""
    fit = {"bootstrap": 0, "segments": segments}
    system = System.resolve(experiment_of(folder, "tilt", fit=fit))
    logs = [recorded(system, motor_torque(2.0, RATE, seed), seed) for seed in range(count)]
    return FitProblem.of(system, logs)


def test_a_part_has_the_begin_of_each_recording(tmp_path: Path) -> None:
    problem = problem_of(tmp_path, 4)
    assert [segment.samples for segment in problem.segments] == [200] * 4
    part, segments = part_of_data(problem, 136.0)
    found = part.segments
    assert [segment.recording for segment in found] == [0, 1, 2, 3]
    assert [segment.begin for segment in found] == [0] * 4
    assert {segment.samples for segment in found} == {34}
    assert part.sample_count == 136
    assert part.sample_count / problem.sample_count == pytest.approx(0.17)
    assert len({segment.recording for segment in part.segments}) == 4

    # The part has the residuals that these rows have among all.
    at = problem.begin(problem.system.parameters.guess)
    predicted, whole = part.predict(of_subset(at, segments)), problem.predict(at)
    assert predicted is not None and whole is not None
    for y, complete, segment in zip(predicted, whole, found, strict=True):
        np.testing.assert_allclose(y[segment.rows], complete[segment.rows])
        assert np.isnan(y[segment.rows.stop :]).all()


def test_a_part_has_segments_of_each_recording(tmp_path: Path) -> None:
    problem = problem_of(tmp_path, 3, 0.25)
    assert len(problem.segments) == 24
    for share in (0.05, 0.13, 0.3, 0.6):
        part, segments = part_of_data(problem, share * problem.sample_count)
        assert len({segment.recording for segment in part.segments}) == 3
        assert 0.8 * share < part.sample_count / problem.sample_count <= 1.01 * share

        # The unknowns are those of its segments.
        at = problem.begin(problem.system.parameters.guess)
        at = replace(at, private=np.arange(at.private.size, dtype=float).reshape(24, -1))
        for segment, private in zip(part.segments, of_subset(at, segments).private, strict=True):
            index = int(np.flatnonzero((at.private == private).all(axis=1))[0])
            original = problem.segments[index]
            assert (segment.recording, segment.begin) == (original.recording, original.begin)


def test_one_long_recording_is_cut_and_little_data_is_not(tmp_path: Path) -> None:
    problem = problem_of(tmp_path, 1)
    part, segments = part_of_data(problem, 50.0)
    assert part.sample_count == 50
    assert part.sample_count / problem.sample_count == 0.25

    everything, segments = part_of_data(problem, 200.0)
    assert everything is problem
    assert len(segments) == len(problem.segments)


def test_too_many_recordings_are_not_cut_into_crumbs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    problem = problem_of(tmp_path, 6)
    monkeypatch.setattr(term_tests, "ENOUGH_SAMPLES", 50)
    part, _ = part_of_data(problem, 100.0)
    assert len({segment.recording for segment in part.segments}) == 2
    assert part.sample_count == 100
    assert part.segments[0].recording < 3 <= part.segments[1].recording


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({"share": 1.0, "recordings": 4, "count": 4}, ""),
        ({"share": 0.17, "recordings": 4, "count": 4}, "17 % of the data, from all 4 recordings."),
        ({"share": 0.17, "recordings": 2, "count": 8}, "from 2 of 8 recordings."),
        ({"share": 0.17, "recordings": 1, "count": 1}, "the first part of the recording."),
        ({"share": 1.0, "recordings": 1, "count": 1, "untested": ("a",)}, "cannot have it: a."),
        ({"share": 1.0, "recordings": 1, "count": 1, "untested": ("a", "b")}, "have them: a, b."),
    ],
)
def test_what_was_not_tested_is_said(data: dict[str, Any], words: str) -> None:
    assert TermTests(data=TermTestData(**data)).remark.endswith(words)


@pytest.mark.slow
def test_a_term_that_the_first_recording_does_not_show_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first recording shows noise alone: where only it is tested, no term is significant."""
    robot = System.resolve(experiment_of(tmp_path, "asymmetric_friction"))
    write_pendulum(tmp_path, joint='frictionloss="0.03"')
    stated = mjfim.Experiment(
        model="pendulum.xml",
        rate=RATE,
        noise={"angle": 0.001},
        parameters={"damping": {"target": "joint/pivot:damping"}},
        directory=tmp_path,
    )
    system = System.resolve(stated)
    logs = [recorded(system, np.zeros((150, 1)), 0), *small_logs(robot, 1, 2, 3)]
    problem = FitProblem.of(system, logs)
    at = solution_near(problem, system.parameters.guess)

    first = np.zeros(1, dtype=int)
    assert not find_missing_terms(problem.of_segments(first), logs, of_subset(at, first)).terms

    monkeypatch.setattr(term_tests, "part_of_data", lambda problem, _: part_of_data(problem, 300))
    found = find_missing_terms(problem, logs, at)
    assert found.data is not None
    assert found.data.recordings == 4
    assert 0.4 < found.data.share <= 0.5
    assert "term/pivot_asymmetric_friction:offset" in {term.path for term in found.terms}


@pytest.mark.slow
def test_an_estimate_and_a_selection_say_on_how_much_terms_were_tested(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    experiment = experiment_of(tmp_path, "tilt", fit={"bootstrap": 0})
    system = System.resolve(experiment)
    logs = [recorded(system, motor_torque(2.0, RATE, seed), seed) for seed in (0, 1)]
    monkeypatch.setattr(term_tests, "part_of_data", lambda problem, _: part_of_data(problem, 100))
    with_failing("joint/pivot:nothing", monkeypatch)
    found = mjfim.select_terms(experiment, logs)
    assert not found.misfit
    words = "Terms that the model may lack were tested on 25 % of the data, from all 2 recordings."
    assert found.selection is not None
    assert found.selection.ending.startswith(
        f"No further term that was tested is significant. {words}"
    )
    assert found.selection.ending.endswith("cannot have it: a strange spring.")
    assert any("a strange spring" in sentence for sentence in found.warnings)
    assert str(found.tested_data).startswith(words)

    found.save(tmp_path / "out")
    assert mjfim.Estimate.load(tmp_path / "out").tested_data == found.tested_data
