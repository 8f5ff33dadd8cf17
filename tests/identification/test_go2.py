"""The benchmark of a real Go2, on a second of its log."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import mjfim
from mjfim.experiment.system import System
from scripts.benchmarks import go2
from tests.support.paths import SHARED_DATA, SHARED_MODELS

DATA, MODEL = SHARED_DATA / "iit_go2", SHARED_MODELS / "go2" / "go2_nomesh.xml"

pytestmark = pytest.mark.skipif(
    not DATA.is_dir(), reason="the measured recordings are not beside the repository"
)


def test_dry_friction_of_the_knee_grows_with_the_sine_of_the_angle() -> None:
    """Moment arms of the tendons are sines of the distance from the knots."""
    model = mujoco.MjModel.from_xml_string(go2.leg_alone(MODEL, "RL"))
    data = mujoco.MjData(model)
    for knee in (-2.4, -1.8, -1.3):
        data.qpos[:] = [0.1, 1.0, knee]
        mujoco.mj_forward(model, data)

        arms = np.abs(data.ten_J.reshape(len(go2.KNOTS), 3))
        assert arms[:, :2] == pytest.approx(0.0, abs=1e-9)
        assert arms[:, 2] == pytest.approx(np.abs(np.sin(knee - np.array(go2.KNOTS))), abs=2e-3)


def test_a_leg_alone_moves_as_in_the_whole_robot(tmp_path: Path) -> None:
    """The closed loop of one leg agrees with a plain loop of all legs."""
    go2.write_leg(MODEL, "RL", tmp_path)
    system = System.resolve(mjfim.Experiment.from_file(tmp_path / "RL.toml"))
    names = system.parameters.names
    theta = np.array(system.parameters.guess)
    theta[[i for i, name in enumerate(names) if name.startswith(("lat", "feed", "fric"))]] = 0.0

    references, angles = np.empty((2, 200, 12))
    angles[:] = np.tile([0.0, 1.2, -2.4], 4)
    references[:] = angles + 0.2 * np.sin(0.05 * np.arange(200))[:, None]
    model = go2.hanging(MODEL).compile()
    model.opt.timestep = go2.PERIOD
    model.dof_damping[:] = model.dof_frictionloss[:] = 0.0
    data, expected = mujoco.MjData(model), np.empty((200, 3))
    data.qpos[:] = angles[0]
    for row, reference in enumerate(references):
        expected[row] = data.qpos[6:9]
        data.ctrl[:] = go2.STATED_KP * (reference - data.qpos) - go2.STATED_KD * data.qvel
        mujoco.mj_step(model, data)

    found = go2.open_loop(system, theta, references[:, 6:9], angles[:, 6:9])
    assert found == pytest.approx(expected, abs=1e-6)


@pytest.mark.slow
def test_fits_to_a_second_predict_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Each of two seconds predicts the other better than the model as it comes."""
    halves = {"first": (slice(4200, 4400),), "second": (slice(4400, 4600),)}
    monkeypatch.setattr(go2, "HALVES", halves)
    monkeypatch.setattr(go2, "LEG", go2.LEG.replace("max_iterations = 25", "max_iterations = 8"))
    monkeypatch.setattr("sys.argv", ["go2", str(DATA), str(MODEL), str(tmp_path)])

    assert go2.main() == 0

    lines = capsys.readouterr().out.splitlines()
    factors = [line.split("│")[2] for line in lines if " factor" in line]
    assert len(factors) == 2
    assert all(float(each) > 1.5 for each in factors)
    assert len(list(tmp_path.glob("*.toml"))) == 4
