"""Long work is announced before it begins, and is not silent."""

from __future__ import annotations

import re
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.cli import common
from mjfim.cli.announcements import (
    announce_check,
    announce_comparison,
    announce_design,
    announce_fit,
    announce_trials,
)
from mjfim.errors import ExperimentError
from mjfim.excitation.task import DesignTask
from mjfim.excitation.task_parts import stated_control
from mjfim.experiment.system import System
from mjfim.records.trajectory import Recording
from tests.support.cli import write_experiment

START = '{ kind = "sine" }'


def _system(folder: Path, horizon: float, **descent: float) -> System:
    """The cart-pendulum over some horizon."""
    path = write_experiment(folder, horizon=str(horizon), start=START)
    return System.resolve(mjfim.Experiment.from_file(path).replace(descent=descent))


def test_a_long_design_is_announced(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """4000 s took 200 silent seconds; one sentence states an iteration, the whole and Ctrl-C."""
    announce_design(_system(tmp_path, 4000.0), is_default=False)
    told = capsys.readouterr().err
    assert re.search(r"one iteration takes about \S+ \w+, and the design at most about", told)
    assert "Ctrl-C ends it at any time with the best result so far" in told


def test_the_time_of_a_design_is_announced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The time that ends a design is stated with its key."""
    announce_design(_system(tmp_path, 4000.0, seconds=1e-3), is_default=True)
    assert "(default of descent.seconds: 0.001 s)" in capsys.readouterr().err


def test_the_design_of_a_round_is_announced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A campaign makes several designs."""
    system = _system(tmp_path, 4000.0)
    announce_design(system, is_default=False, work="the design of a round")
    assert ", and the design of a round at most about" in capsys.readouterr().err


def test_a_short_design_is_not_announced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    announce_design(_system(tmp_path, 0.5, max_iterations=1), is_default=False)
    assert not capsys.readouterr().err


@pytest.mark.slow
def test_an_iteration_of_hours_is_refused(tmp_path: Path) -> None:
    """The message states the time; a stated time that is longer permits it."""
    system = _system(tmp_path, 40.0)
    with pytest.raises(ExperimentError, match=r"horizon: 40 s at 100 Hz: one iteration would take"):
        announce_design(system, is_default=False, longest_iteration=1e-3)

    patient = replace(system, experiment=system.experiment.replace(descent={"seconds": 1e4}))
    announce_design(patient, is_default=False, longest_iteration=1e-3)
    with pytest.raises(ExperimentError, match="one iteration would take"):
        announce_design(patient, is_default=True, longest_iteration=1e-3)


@pytest.mark.slow
def test_long_checks_fits_and_studies_are_announced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Millions of samples and of trials; the rows of the recording are not even simulated."""
    system = _system(tmp_path, 4.0)
    task = DesignTask.of(system)
    curve = task.initial

    announce_check(system, stated_control(_system(tmp_path, 10_000.0)))
    announce_trials(system, {"final": curve}, 1_000_000)
    announce_comparison(6, 60.0)

    rows = 1_000_000
    recording = Recording(
        t=task.dt * np.arange(rows, dtype=np.float64),
        ctrl=np.resize(curve.ctrl, (rows - 1, 1)),
        y=np.resize(system.plant.outputs(curve.state, None), (rows, 4)),
        outputs=system.outputs.names,
    )
    announce_fit(system, [recording])

    told = capsys.readouterr().err.splitlines()
    assert "the fit, of 10 to 50 passes," in told[-1]
    assert [line.split(" takes ")[0].split(" take ")[0] for line in told] == [
        "mjfim: the check",
        "mjfim: 1,000,000 trials",
        "mjfim: 6 methods of at most 60 s each",
        "mjfim: 1,000,000 rows: one pass over the data",
    ]


def test_silent_work_prints_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    """Without a terminal, work without events says that it is going on."""
    with common.progress("checking", line_seconds=0.02):
        time.sleep(0.3)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) > 2
    assert all(re.fullmatch(r"checking \(0 s\)", line) for line in lines)
