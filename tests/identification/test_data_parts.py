"""Tests of much data use a part of it that is spread over all recordings."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.errors import ExperimentError
from mjfim.experiment.system import System
from mjfim.identification.assessment import term_tests
from mjfim.identification.assessment.term_tests import (
    TermTests,
    part_of_data,
)
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.search import FitTask, of_subset
from mjfim.records.terms import TermTestData
from mjfim.studies import selection
from tests.identification.test_missing_terms import with_failing
from tests.support.terms import (
    experiment_of,
    motor_torque,
    recorded,
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


def test_a_part_has_segments_of_each_recording(tmp_path: Path) -> None:
    problem = problem_of(tmp_path, 3, 0.25)
    assert len(problem.segments) == 24
    at = problem.begin(problem.system.parameters.guess)
    at = replace(at, private=np.arange(at.private.size, dtype=float).reshape(24, -1))
    for share in (0.05, 0.13, 0.6):
        part, segments = part_of_data(problem, share * problem.sample_count)
        assert len({segment.recording for segment in part.segments}) == 3
        assert 0.8 * share < part.sample_count / problem.sample_count <= 1.01 * share

        # The unknowns are those of its segments.
        for segment, private in zip(part.segments, of_subset(at, segments).private, strict=True):
            original = problem.segments[int(private[0]) // at.private.shape[1]]
            assert (segment.recording, segment.begin) == (original.recording, original.begin)


def test_one_long_recording_is_cut_and_little_data_is_not(tmp_path: Path) -> None:
    problem = problem_of(tmp_path, 1)
    assert part_of_data(problem, 50.0)[0].sample_count == 50
    everything, segments = part_of_data(problem, 200.0)
    assert everything is problem
    assert len(segments) == len(problem.segments)


def test_too_many_recordings_are_not_cut_into_crumbs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(term_tests, "ENOUGH_SAMPLES", 50)
    part, _ = part_of_data(problem_of(tmp_path, 6), 100.0)
    first, second = (segment.recording for segment in part.segments)
    assert first < 3 <= second
    assert part.sample_count == 100


def test_a_fit_to_some_seconds_has_segments_of_all_recordings(tmp_path: Path) -> None:
    fit = {"bootstrap": 0, "segments": 0.25, "seconds": 1.5}
    experiment = experiment_of(tmp_path, "tilt", fit=fit)
    system = System.resolve(experiment)
    logs = [recorded(system, motor_torque(2.0, RATE, seed), seed) for seed in range(3)]
    segments = FitTask.of(system, logs).problem().segments
    assert {segment.recording for segment in segments} == {0, 1, 2}
    assert sum(segment.samples for segment in segments) == 1.5 * RATE

    with pytest.raises(ExperimentError, match="seconds needs a length of the segments"):
        experiment.replace(fit={"segments": "whole"})

    found = mjfim.identify(experiment, logs)
    assert any(sentence.startswith("only 6 segments, 1.5 of 6 s") for sentence in found.warnings)
    low, high = found.interval.T
    assert ((low < system.parameters.true) & (system.parameters.true < high)).all()

    # A bias of a recording without a segment that is fitted stays where it is.
    biased = experiment.replace(
        fit={"seconds": 0.75}, nuisance={"bias": {"angle": True}, "per_recording": True}
    )
    logs += [recorded(system, motor_torque(2.0, RATE, seed), seed) for seed in range(3, 6)]
    biases = mjfim.identify(biased, logs).per_recording["bias angle"]
    assert np.abs(biases).max() < 0.1


def test_what_was_not_tested_is_said() -> None:
    for share, recordings, count, untested, words in (
        (1.0, 4, 4, (), ""),
        (0.17, 4, 4, (), "17 % of the data, from all 4 recordings."),
        (0.17, 2, 8, (), "from 2 of 8 recordings."),
        (0.17, 1, 1, (), "the first part of the recording."),
        (1.0, 1, 1, ("a",), "cannot have it: a."),
        (1.0, 1, 1, ("a", "b"), "have them: a, b."),
    ):
        data = TermTestData(share=share, recordings=recordings, count=count, untested=untested)
        assert TermTests(data=data).remark.endswith(words)


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
    ending = found.selection.ending
    assert ending.startswith(f"No further term that was tested is significant. {words}")
    assert ending.endswith("cannot have it: a strange spring.")
    assert any("a strange spring" in sentence for sentence in found.warnings)

    # Of much data, segments are fitted that are spread over them.
    monkeypatch.setattr(selection, "MAX_STEPS", 2_000)
    monkeypatch.setattr(selection, "MORE_SEGMENTS", 1.5)
    found = mjfim.select_terms(experiment, logs)
    assert any(sentence.startswith("only 25 segments, 2.94 of 4 s") for sentence in found.warnings)
