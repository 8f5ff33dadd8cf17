"""The shortest experiment: its design reaches the targets, and a shorter one does not."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import mjfim
from mjfim.errors import ExperimentError, NoResultError, UnidentifiableError
from mjfim.excitation.design import design_task
from mjfim.excitation.evaluation import evaluate_task
from mjfim.excitation.shortest_horizon import (
    OutOfReachError,
    fit_control,
    largest_ratio_to_target,
    target_accuracies,
)
from mjfim.excitation.task import DesignTask
from mjfim.output.words import when_learnt
from mjfim.parallel.budget import StopToken
from mjfim.records.design import Status
from mjfim.records.events import DesignEvent, StudyEvent
from tests.support.cart_pendulum import cart_pendulum
from tests.support.cli import read, run, write_experiment
from tests.support.paths import MODELS

STUDY = cart_pendulum(
    horizon=1.5,
    initial={"control": {"kind": "sine", "amplitude": 2.0, "frequency": 0.8}},
    descent={"starts": 1, "tolerance": 1e-3, "max_iterations": 15},
    rehearsal={"robots": 4},
)
SIGMA = {"m": 0.0115, "l": 0.02, "c": 0.0125}  # target standard deviations; reached at about 1 s


def wanting(sigma: dict[str, float], **tables: object) -> mjfim.Experiment:
    """The study with target standard deviations."""
    return STUDY.replace(
        parameters={name: {"wanted": value} for name, value in sigma.items()}, **tables
    )


def worst(experiment: mjfim.Experiment) -> float:
    """Largest ratio of a predicted standard deviation of the design to its target."""
    task = DesignTask.resolve(experiment)
    return largest_ratio_to_target(design_task(task).final.std, target_accuracies(task))[0]


@pytest.fixture(scope="module")
def shorter() -> mjfim.ShortestExperiment:
    """The shortest experiment, which is shorter than the stated one."""
    return mjfim.shortest_experiment(wanting(SIGMA), tolerance=0.05)


@pytest.mark.slow
def test_it_reaches_every_target(shorter: mjfim.ShortestExperiment) -> None:
    assert 0.5 < shorter.horizon < 1.4 and shorter.closed
    task = DesignTask.resolve(shorter.experiment)
    assert shorter.design.trajectory.samples == task.samples
    evaluated = evaluate_task(task, shorter.design.trajectory)
    ratio, _ = largest_ratio_to_target(evaluated.std, target_accuracies(task))
    (best,) = [tried for tried in shorter.tried if tried.horizon == shorter.horizon]
    assert best.reached and best.ratio <= 1.0
    assert best.ratio == pytest.approx(ratio, rel=1e-6)
    assert shorter.summary()["horizon"] == shorter.horizon

    # The last parameter is known just before the end, by the numbers of the picture over time.
    seconds = shorter.design.seconds_to(target_accuracies(task))
    assert 0.8 * shorter.horizon < seconds.max() <= shorter.horizon
    assert f"Every wanted σ is reached after {seconds.max():.3g} s" in when_learnt(shorter.design)

    # One that is shorter by the tolerance misses a target, by a separate design.
    below = shorter.missed
    assert 0.0 < shorter.horizon - below.horizon <= shorter.tolerance + 1e-9
    less = round(shorter.horizon - shorter.tolerance, 6)
    assert worst(shorter.experiment.replace(horizon=less)) > 1.0
    assert below.ratio > 1.0 and f"{below.horizon:g} s" in str(shorter)


@pytest.mark.slow
def test_the_horizon_may_become_longer_than_stated(shorter: mjfim.ShortestExperiment) -> None:
    """A search that begins at a horizon that is too short ends near the shortest one as well."""
    events = []
    stated = wanting(SIGMA, horizon=0.8)
    found = mjfim.shortest_experiment(stated, tolerance=0.05, callback=events.append)
    assert found.horizon > 0.8 and abs(found.horizon - shorter.horizon) < 0.11
    messages = [event.message for event in events if isinstance(event, StudyEvent)]
    assert messages == [str(tried) for tried in found.tried]
    assert not found.tried[0].reached and found.tried[0].horizon == 0.8


@pytest.mark.slow
def test_it_is_saved_and_loaded_with_its_experiment(
    shorter: mjfim.ShortestExperiment, tmp_path: Path
) -> None:
    shorter.save(tmp_path)
    loaded = mjfim.ShortestExperiment.load(tmp_path)
    assert loaded.experiment == shorter.experiment
    assert loaded.experiment.directory == shorter.experiment.directory
    assert loaded.summary() == shorter.summary()
    assert_array_equal(loaded.design.trajectory.ctrl, shorter.design.trajectory.ctrl)

    function = {"m": {"function": lambda spec, value: None, "guess": 1.0}}
    values = shorter.experiment.model_dump(exclude_unset=True)
    stated = shorter.experiment.restated({**values, "parameters": function})
    with pytest.raises(TypeError, match="a Python function cannot be saved"):
        replace(shorter, experiment=stated).save(tmp_path)


def test_the_default_longest_horizon_is_that_of_the_table(tmp_path: Path) -> None:
    """The four seconds of a CSV are not extrapolated; a design.csv's last row has no control."""
    for name in ("cart_pendulum.xml", "cart_pendulum.csv"):
        shutil.copy(MODELS / name, tmp_path)
    text = (tmp_path / "cart_pendulum.csv").read_text(encoding="utf-8").splitlines()
    (tmp_path / "half.csv").write_text(
        "\n".join(["t,ctrl:force", *text[1:61], "0.60,"]) + "\n", encoding="utf-8"
    )
    table = cart_pendulum().model_dump(exclude_unset=True)
    table = {**table, "horizon": 0.4, "initial": {"keyframe": "hanging", "control": "half.csv"}}
    hard = mjfim.Experiment(**table, directory=tmp_path).replace(
        parameters={"m": {"wanted": 1e-4}},
        descent={"starts": 1, "max_iterations": 2},
        rehearsal={"robots": 4},
    )
    message = r"even 0\.6 s is too short: the target is missed by m \(σ .*, wanted 0\.0001\)"
    with pytest.raises(OutOfReachError, match=message):
        mjfim.shortest_experiment(hard)


def test_messages_about_faulty_requests_name_valid_values() -> None:
    for experiment, options, message in (
        (STUDY, {}, r"parameters\.m\.wanted"),
        (wanting(SIGMA), {"tolerance": 0.0}, "tolerance"),
        (wanting(SIGMA), {"longest": 0.01}, "longest"),
    ):
        with pytest.raises(ExperimentError, match=message):
            mjfim.shortest_experiment(experiment, **options)


@pytest.mark.slow
def test_a_stopped_search_returns_the_shortest_so_far() -> None:
    stop = StopToken()
    horizons = []

    def callback(event: DesignEvent | StudyEvent) -> None:
        if isinstance(event, StudyEvent):
            horizons.append(event.part)
        elif len(horizons) == 1:
            stop.request()

    found = mjfim.shortest_experiment(wanting(SIGMA), tolerance=0.05, callback=callback, stop=stop)
    assert found.horizon == 1.5 and not found.closed and "interrupted" in str(found)
    with pytest.raises(NoResultError):
        mjfim.shortest_experiment(wanting(SIGMA), stop=stop)


def test_a_search_that_is_stopped_in_its_first_design_returns_it() -> None:
    """It says how far the design is from the targets."""
    stop = StopToken()
    wanted = wanting({"m": 1e-6})
    found = mjfim.shortest_experiment(wanted, callback=lambda event: stop.request(), stop=stop)
    assert not found.reached and not found.closed
    assert found.horizon == 1.5 and found.design.status is Status.INTERRUPTED
    assert "before any horizon reached the wanted accuracy" in str(found)
    assert "σ of m is" in str(found)


@pytest.mark.slow
def test_a_duration_without_a_measurement_does_not_reach() -> None:
    """One measurement in 1.4 s: shorter experiments measure nothing."""
    loose = wanting(dict.fromkeys(SIGMA, 10.0), measure_rate=100.0 / 140.0)
    found = mjfim.shortest_experiment(loose, tolerance=0.05)
    assert 1.4 <= found.horizon <= 1.45
    assert "measures nothing" in found.missed.why


def test_an_error_at_the_first_duration_ends_the_search() -> None:
    still = {"control": {"kind": "constant", "amplitude": 0.0}}
    with pytest.raises(UnidentifiableError):
        mjfim.shortest_experiment(wanting(SIGMA, initial=still))


def test_control_of_another_duration(tmp_path: Path) -> None:
    """It is cut where the end is free and repeated without limits; else it is stretched."""
    control = np.arange(4.0)[:, None]

    def made(samples: int, **tables: object) -> list[float]:
        task = DesignTask.resolve(STUDY.replace(horizon=samples / 100.0, **tables))
        return fit_control(task, control).ravel().tolist()

    limited = {"limits": {"control": {"force": (-5.0, 5.0)}}}
    assert made(3) == [0.0, 1.0, 2.0] and made(4) == [0.0, 1.0, 2.0, 3.0]
    assert made(6) == [0.0, 1.0, 2.0, 3.0, 0.0, 1.0]
    assert made(3, **limited) == [0.0, 1.0, 2.0]
    assert made(8, **limited) == [0.0, 0.25, 0.75, 1.25, 1.75, 2.25, 2.75, 3.0]
    assert made(2, boundary={"end": "periodic"}) == [0.5, 2.5]


@pytest.mark.slow
@pytest.mark.usefixtures("empty_figures")
def test_the_command_line(tmp_path: Path) -> None:
    """The design of the shortest horizon is written; exit code 1 where no horizon is enough."""
    study = write_experiment(tmp_path, tolerance="1e-2", max_iterations="10")
    text = study.read_text(encoding="utf-8")
    folder, old = tmp_path / "out", "[parameters.m] "
    assert old in text

    # The table of the initial control ends after one second, which is the longest horizon then.
    table = (tmp_path / "cart_pendulum.csv").read_text(encoding="utf-8").splitlines()
    (tmp_path / "cart_pendulum.csv").write_text("\n".join(table[:101]) + "\n", encoding="utf-8")

    for wanted, code, said in (
        ("wanted = 1e-9", 1, "is too short"),
        ("", 2, "wanted"),
        ("wanted = 0.03", 0, "shortest horizon: "),
    ):
        study.write_text(text.replace(old, f"[parameters.m]\n{wanted}\n#"), encoding="utf-8")
        done = run("design", study, "-o", folder, "--shortest")
        assert done.exit_code == code, done.output
        assert said in done.output

    kept = read(folder / "shortest.json")
    assert kept["closed"] and kept["horizon"] < 1.0
    assert read(folder / "design.json")["shortest"]["horizon"] == kept["horizon"]
    assert f"shortest horizon: {kept['horizon']:g} s" in done.output
    with np.load(folder / "design.npz", allow_pickle=False) as arrays:
        assert arrays["t"][-1] == pytest.approx(kept["horizon"])
