"""Remarks about poor data: none about clean logs of quick motions, and all real faults."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.errors import MjfimError
from mjfim.experiment.initial import multisine
from mjfim.experiment.system import System, simulate_system
from mjfim.recordings.checks import plausibility_remarks
from mjfim.records.trajectory import Recording
from tests.support.paths import MODELS, SHARED_MODELS
from tests.support.shared_models import EXPERIMENTS

# A light fin in water follows its servo within one row of a log at 50 Hz.
FIN = """
<mujoco><option timestep="0.004" density="5000" gravity="0 0 0"/>
<worldbody><body name="fin"><joint name="fin" axis="1 0 0" damping="2e-5" stiffness="1e-3"/>
<geom type="ellipsoid" size=".015 .02 .001" pos=".01 0 0" density="2000"/></body></worldbody>
<actuator><position name="fin" joint="fin" kp="3e-4"/></actuator></mujoco>
"""
SHIPPED = (
    "cart_pendulum",
    "double_pendulum",
    "free_pendulum",
    "four_bar",
    "quadrotor",
    "servo_arm",
)


def of_fin(folder: Path) -> tuple[System, Recording, np.ndarray]:
    """The fin, a log of a stepped sine, and the outputs without noise."""
    model = folder / "fin.xml"
    model.write_text(FIN, encoding="utf-8")
    stated = mjfim.Experiment(
        model=str(model),
        rate=50.0,
        horizon=4.0,
        parameters={"c": {"target": "joint/fin:damping"}},
        noise={"state": 1e-3},
    )
    system = System.resolve(stated, threads=1)
    ctrl = 0.3 * np.sin(2.0 * np.pi * np.arange(200) / 50.0)[:, None]
    trajectory = system.plant.simulate(system.theta, ctrl)
    outputs, _ = system.plant.measure(system.theta[None], ctrl)
    return system, simulate_system(system, trajectory, seed=0), outputs[0]


@pytest.mark.parametrize(
    ("fault", "is_found"),
    [
        (lambda v: v, False),
        (lambda v: 2.0 * v, True),
        (lambda v: -v, True),
        (lambda v: np.roll(v, 10), True),
    ],
)
def test_a_quick_velocity_contradicts_its_position_only_where_it_is_wrong(
    fault: Callable[[np.ndarray], np.ndarray], is_found: bool, tmp_path: Path
) -> None:
    system, log, outputs = of_fin(tmp_path)
    y = np.array(log.y)
    j = log.outputs.index("qvel:fin")
    y[:, j] = fault(y[:, j])
    found = plausibility_remarks(system.channels, replace(log, y=y), outputs)
    assert any("the integral of qvel:fin differ" in remark for remark in found) == is_found


@pytest.mark.parametrize("rows", range(594, 606))
def test_a_constant_control_is_no_noise(rows: int, tmp_path: Path) -> None:
    """Its standard deviation is zero but for the rounding of a mean."""
    system, log, _ = of_fin(tmp_path)
    t, y = np.arange(rows) / 50.0, np.resize(log.y, (rows, log.y.shape[1]))
    constant = replace(log, t=t, y=y, ctrl=np.full((rows - 1, 1), 4.2585187))
    assert not any(
        "control" in each for each in plausibility_remarks(system.channels, constant, None)
    )


@pytest.mark.slow
def test_clean_logs_are_not_called_poor() -> None:
    """Of random multisines and of designs; at most one in a hundred is remarked on."""
    rng, count, alarms = np.random.default_rng(0), 0, []
    experiments = [mjfim.Experiment.from_file(MODELS / f"{name}.toml") for name in SHIPPED]
    experiments = [each.replace(noise={"state": 1e-3}) for each in experiments]
    for tables in EXPERIMENTS.values() if SHARED_MODELS.is_dir() else ():
        model = str(SHARED_MODELS / tables["model"])
        experiments.append(mjfim.Experiment(**{**tables, "model": model}))
    for stated in experiments:
        system = System.resolve(stated, threads=1)
        model, horizon = system.model, stated.horizon or 0.0
        t = np.arange(round(horizon / system.dt)) * system.dt
        middle = model.key_ctrl[0] if model.nkey else np.zeros(model.nu)
        low, high = np.where(
            model.actuator_ctrllimited, model.actuator_ctrlrange.T, [[-1.0], [1.0]]
        )
        waves = [multisine(t, model.nu, rng.uniform(0.5, 2.0) / horizon, 5, rng) for _ in range(8)]
        controls = [np.clip(middle + 0.15 * (high - low) * wave, low, high) for wave in waves]
        if len(stated.noise) == 1:
            quick = stated.replace(
                descent={"max_iterations": 1, "seconds": 2.0}, rehearsal={"robots": 0}
            )
            controls += [mjfim.design(quick).trajectory.ctrl] * 5
        for k, ctrl in enumerate(controls):
            try:
                trajectory = system.plant.simulate(system.parameters.true, ctrl)
            except MjfimError:
                continue  # an unstable motion is no log
            log = simulate_system(system, trajectory, seed=k)
            outputs, _ = system.plant.measure(system.parameters.true[None], ctrl)
            count += 1
            alarms += plausibility_remarks(system.channels, log, outputs[0])[:1]
    assert count >= 50
    assert len(alarms) <= 0.01 * count, alarms
