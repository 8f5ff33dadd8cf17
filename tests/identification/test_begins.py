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

CLEAN = ("cart_pendulum", "quadrotor", "servo_arm", "four_bar")


@pytest.fixture(scope="module")
def experiment() -> mjfim.Experiment:
    """The cart-pendulum, which hangs at rest at first."""
    return cart_pendulum()


def swung(experiment: mjfim.Experiment, seed: int = 1) -> Recording:
    """Six seconds of the motion of the paper."""
    t = 0.01 * np.arange(600)
    return mjfim.simulate(experiment, ((1.0 + t / 4.0) * np.sin(2.0 * t))[:, None], seed)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "said", "widest"),
    [("late", "slide +0.2 m/s", 0.05), ("elsewhere", "hinge +", 0.01)],
)
def test_a_log_that_begins_elsewhere_is_fitted_and_said(
    experiment: mjfim.Experiment, kind: str, said: str, widest: float
) -> None:
    """The intervals are nearly those of a log that begins as stated, and hold the true values."""
    if kind == "late":
        log = swung(experiment)
        log = replace(log, t=log.t[100:] - log.t[100], ctrl=log.ctrl[100:], y=log.y[100:])
    else:
        aside = {"keyframe": None, "qpos": [0.0, np.pi + 1.0]}
        initial = experiment.initial.model_copy(update=aside)
        log = swung(experiment.model_copy(update={"initial": initial}))
    estimate = mjfim.identify(experiment, [log], progress=False)
    assert not estimate.misfit and estimate.converged
    assert any("does not begin where [initial] says" in each for each in estimate.warnings)
    assert any(said in each for each in estimate.warnings)
    low, high = estimate.interval.T
    true = np.array([2.0, 1.0, 1.0])
    assert np.all((low < true) & (true < high))
    assert 0.5 * (high[0] - low[0]) < widest * true[0]


@pytest.mark.slow
@pytest.mark.parametrize(("zero", "scale"), [(0.35, 1.0), (-0.2, 1.0), (0.0, 1.1), (0.0, 0.9)])
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
        mjfim.identify(experiment, [shifted], progress=False)
    line = str(error.value).partition("State in [recording.columns]: ")[2]
    (column,) = tomllib.loads(line).items()
    assert column[0] == "qpos:hinge"
    assert column[1].get("offset", 0.0) == pytest.approx(-zero, abs=0.02)
    assert column[1]["scale"] == pytest.approx(1.0 / scale, abs=0.02)


@pytest.mark.slow
def test_a_log_that_begins_elsewhere_and_misfits_is_fitted(
    experiment: mjfim.Experiment, tmp_path: Path
) -> None:
    """A rail that rubs explains the residuals, and no zero does."""
    text = (MODELS / "cart_pendulum.xml").read_text(encoding="utf-8")
    robot = tmp_path / "robot.xml"
    robot.write_text(text.replace('axis="1 0 0"/>', 'axis="1 0 0" frictionloss="0.5"/>'))
    aside = {"keyframe": None, "qpos": (0.0, np.pi + 1.0)}
    initial = experiment.initial.model_copy(update=aside)
    made = experiment.model_copy(update={"initial": initial}).replace(model=str(robot))
    estimate = mjfim.identify(experiment, [swung(made)], progress=False)
    assert any("does not begin where [initial] says" in each for each in estimate.warnings)
    assert "dry friction of slide" in estimate.causes[0]


LEG = """
<body name="{leg}" pos="{x} {y} 0">
  <joint name="{leg}_hip" axis="0 1 0" damping="0.2" armature="0.01"/>
  <inertial pos="0 0 -0.1" mass="0.6" diaginertia="3e-3 3e-3 4e-4"/>
  <body name="{leg}_calf" pos="0 0 -0.2">
    <joint name="{leg}_knee" axis="0 1 0" damping="0.2" armature="0.01"/>
    <inertial pos="0 0 -0.1" mass="0.3" diaginertia="1e-3 1e-3 1e-4"/>
  </body>
</body>"""
LEGS = {"FL": (0.2, 0.1), "FR": (0.2, -0.1), "RL": (-0.2, 0.1), "RR": (-0.2, -0.1)}


@pytest.mark.slow
def test_a_hanging_quadruped_whose_knees_are_bent_is_fitted(tmp_path: Path) -> None:
    """Its model has straight legs; each of the four knees begins 1.1 rad away."""
    legs = "".join(LEG.format(leg=leg, x=x, y=y) for leg, (x, y) in LEGS.items())
    joints = [f"{leg}_{joint}" for leg in LEGS for joint in ("hip", "knee")]
    motors = "".join(f'<motor name="{each}" joint="{each}"/>' for each in joints)
    (tmp_path / "quadruped.xml").write_text(
        f"""<mujoco><option timestep="0.005" integrator="implicitfast"/>
        <worldbody><body name="trunk" pos="0 0 1"><geom size="0.1" mass="5"/>{legs}</body>
        </worldbody><actuator>{motors}</actuator></mujoco>""",
        encoding="utf-8",
    )
    calves = [{"path": f"body/{leg}_calf:mass"} for leg in LEGS]
    knees = [{"path": f"joint/{leg}_knee:damping"} for leg in LEGS]
    stated = mjfim.Experiment(
        model="quadruped.xml",
        directory=tmp_path,
        rate=200.0,
        parameters={
            "calf": {"targets": calves, "guess": 0.4, "true": 0.3},
            "knee": {"targets": knees, "guess": 0.3, "true": 0.2, "bounds": [0.0, 5.0]},
        },
        noise={"state": 0.02},
        fit={"bootstrap": 0},
    )
    t = 0.005 * np.arange(400)[:, None]
    control = 0.8 * np.sin(2.0 * np.pi * (0.7 + 0.1 * np.arange(8)) * t)
    robot = stated.replace(initial={"qpos": [0.0, -1.1] * 4})
    estimate = mjfim.identify(stated, [mjfim.simulate(robot, control, 1)], progress=False)
    assert estimate.converged and not estimate.misfit
    (said,) = [each for each in estimate.warnings if "does not begin where" in each]
    assert all(f"{leg}_knee -1.1 rad" in said for leg in LEGS) and "hip -" not in said
    low, high = estimate.interval.T
    assert np.all((low < [0.3, 0.2]) & (high > [0.3, 0.2]))
    assert np.all(high - low < 0.1 * np.array([0.3, 0.2]))


def test_more_noise_than_stated_is_no_other_begin(experiment: mjfim.Experiment) -> None:
    """The scatter of the first rows counts where it is larger than the stated noise."""
    system, rng = System.resolve(experiment, threads=1), np.random.default_rng(0)
    log = swung(experiment)
    for _ in range(20):
        noisy = replace(log, y=log.y + 0.15 * rng.standard_normal(log.y.shape))
        assert not FitTask.of(system, [noisy]).elsewhere


@pytest.mark.parametrize("name", CLEAN)
def test_no_other_begin_is_seen_in_clean_logs(name: str) -> None:
    """Ten logs of each model begin as stated, under a random control."""
    stated = mjfim.Experiment.from_file(MODELS / f"{name}.toml")
    system, rng = System.resolve(stated, threads=1), np.random.default_rng(1)
    for seed in range(10):
        control = 0.1 * np.cumsum(rng.standard_normal((40, len(system.inputs))), axis=0)
        log = mjfim.simulate(stated, control, seed)
        assert not FitTask.of(system, [log]).elsewhere
