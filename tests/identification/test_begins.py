"""Recordings that do not begin at the stated initial state: found, said, and fitted well."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.errors import WrongLogError
from mjfim.experiment.system import System
from mjfim.identification.search import FitTask
from mjfim.records.trajectory import Recording
from tests.support.cart_pendulum import cart_pendulum
from tests.support.paths import MODELS


@pytest.fixture(scope="module")
def experiment() -> mjfim.Experiment:
    """The cart-pendulum, which hangs at rest at first."""
    return cart_pendulum()


def swung(experiment: mjfim.Experiment, rows: int = 600) -> Recording:
    """Six seconds of the motion of the paper."""
    t = 0.01 * np.arange(rows)
    return mjfim.simulate(experiment, ((1.0 + t / 4.0) * np.sin(2.0 * t))[:, None], 1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "said", "widest"),
    [("late", "slide +0.2 m/s", 0.05), ("elsewhere", "hinge +", 0.01)],
)
def test_a_log_that_begins_elsewhere_is_fitted_and_said(
    experiment: mjfim.Experiment, kind: str, said: str, widest: float
) -> None:
    """The intervals are nearly those of a log that begins as stated, and hold the true values."""
    log = swung(experiment if kind == "late" else moved(experiment))
    if kind == "late":
        log = replace(log, t=log.t[100:], ctrl=log.ctrl[100:], y=log.y[100:])
    estimate = mjfim.identify(experiment, [log])
    assert not estimate.misfit and estimate.converged
    (sentence,) = [each for each in estimate.warnings if "does not begin where [initial]" in each]
    assert said in sentence and ("slide" in sentence) == (kind == "late")
    low, high = estimate.interval.T
    assert ((low < [2.0, 1.0, 1.0]) & (high > [2.0, 1.0, 1.0])).all()
    assert 0.5 * (high[0] - low[0]) < widest * 2.0


def moved(experiment: mjfim.Experiment) -> mjfim.Experiment:
    """The experiment with the pendulum 1 rad away from hanging at first."""
    initial = {"keyframe": None, "qpos": (0.0, np.pi + 1.0)}
    changed = experiment.initial.model_copy(update=initial)
    return experiment.model_copy(update={"initial": changed})


@pytest.mark.slow
@pytest.mark.parametrize(("zero", "scale"), [(0.35, 1.0), (0.0, 1.1), (0.0, 0.9)])
def test_another_reading_of_an_encoder_is_named_with_the_line_that_cures_it(
    experiment: mjfim.Experiment, zero: float, scale: float
) -> None:
    """The log begins at rest, elsewhere by the error; equations of motion are too noisy for it.

    The hinge hangs at an angle of pi, so that a wrong scale is seen at the begin as well.
    """
    log = swung(experiment)
    is_wrong = np.array(log.outputs) == "qpos:hinge"
    shifted = replace(log, y=np.where(is_wrong, scale * log.y + zero, log.y))
    word = "zero" if zero else "scale"
    with pytest.raises(WrongLogError, match=f"another {word} of qpos:hinge") as error:
        mjfim.identify(experiment, [shifted])
    cure = tomllib.loads(str(error.value).partition("State in [recording.columns]: ")[2])
    column = cure["qpos:hinge"]
    assert column.get("offset", 0.0) == pytest.approx(-zero, abs=0.02)
    assert column["scale"] == pytest.approx(1.0 / scale, abs=0.02)


@pytest.mark.slow
def test_a_log_that_begins_elsewhere_and_misfits_is_fitted(
    experiment: mjfim.Experiment, tmp_path: Path
) -> None:
    """A rail that rubs explains the residuals, and no zero does."""
    text = (MODELS / "cart_pendulum.xml").read_text(encoding="utf-8")
    robot = tmp_path / "robot.xml"
    robot.write_text(text.replace('axis="1 0 0"/>', 'axis="1 0 0" frictionloss="0.5"/>'))
    made = moved(experiment).replace(model=str(robot))
    estimate = mjfim.identify(experiment, [swung(made, rows=300)])
    assert any("does not begin where [initial] says" in each for each in estimate.warnings)
    assert "dry friction of slide" in estimate.causes[0]


def test_more_noise_than_stated_is_no_other_begin(experiment: mjfim.Experiment) -> None:
    """The scatter of the first rows counts where it is larger than the stated noise."""
    system, rng = System.resolve(experiment, threads=1), np.random.default_rng(0)
    log = swung(experiment)
    for _ in range(20):
        noisy = replace(log, y=log.y + 0.15 * rng.standard_normal(log.y.shape))
        assert not FitTask.of(system, [noisy]).elsewhere


@pytest.mark.parametrize("name", ["cart_pendulum", "quadrotor", "servo_arm", "four_bar"])
def test_no_other_begin_is_seen_in_clean_logs(name: str) -> None:
    """Ten logs of each model begin as stated, under a random control."""
    stated = mjfim.Experiment.from_file(MODELS / f"{name}.toml")
    system, rng = System.resolve(stated, threads=1), np.random.default_rng(1)
    for seed in range(10):
        control = 0.1 * np.cumsum(rng.standard_normal((40, len(system.inputs))), axis=0)
        log = mjfim.simulate(stated, control, seed)
        assert not FitTask.of(system, [log]).elsewhere
