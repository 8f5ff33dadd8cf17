"""Designs of the release: the initial state within ranges whose motion tells most."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import mjfim
from mjfim.errors import ExperimentError
from mjfim.excitation.design import design_task
from mjfim.excitation.limits.limits import ReleaseSpace
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.model.coordinates import tangent_components
from mjfim.parallel.budget import Budget, StopToken
from mjfim.records.design import Status, is_playable, keeps_limits
from tests.support.cart_pendulum import cart_pendulum
from tests.support.cli import run
from tests.support.limits import played
from tests.support.swing_down import swing_down

HINGE = {"free": {"qpos:hinge": (0.1, 3.1)}}


def short(folder: Path, angle: float = 0.5, **tables: Any) -> Experiment:
    """A swing-down of one second, whose best release is within the range of the angle."""
    return swing_down(folder, angle, **{"horizon": 1.0, "initial": HINGE, **tables})


def cost_of(task: DesignTask, angle: float) -> float:
    """Cost of a release at rest."""
    released = task.released_as(np.array([angle, 0.0]))
    return released.problem.point(released.initial).cost


@pytest.mark.slow
def test_the_designed_release_is_the_best_of_a_fine_grid(tmp_path: Path) -> None:
    experiment, events = short(tmp_path), []
    design = mjfim.design(experiment, callback=events.append)
    task = DesignTask.resolve(experiment)
    costs = {angle: cost_of(task, angle) for angle in np.linspace(0.1, 3.1, 61)}
    best = min(costs, key=costs.__getitem__)
    assert 0.1 < best < 3.1

    assert design.status is Status.RELEASE_FOUND
    assert is_playable(design)
    assert design.final.cost <= costs[best]
    assert design.trajectory.state[0] == pytest.approx([best, 0.0], abs=0.05)
    assert design.warnings == ()

    # The initial trajectory is that of the stated release, and the improvements lead to the last.
    assert design.initial.trajectory.qpos[0, 0] == 0.5
    assert design.initial.cost == pytest.approx(cost_of(task, 0.5))
    assert events[0].row.cost == pytest.approx(design.initial.cost)
    assert np.all(np.diff([row.cost for row in design.history]) < 0.0)
    assert design.history[-1].cost == pytest.approx(design.final.cost)


@pytest.mark.slow
def test_a_limit_of_the_velocity_holds_at_every_engine_step(tmp_path: Path) -> None:
    experiment = short(tmp_path, limits={"velocity": {"hinge": 6.0}})
    design = mjfim.design(experiment)
    assert design.status.success and keeps_limits(design)
    assert 0.0 <= design.limits["velocity"] < 0.01

    model = mujoco.MjModel.from_xml_path(str(tmp_path / "swing_down.xml"))
    motion = design.trajectory
    speeds = played(model, (motion.qpos[0], motion.qvel[0]), motion.ctrl, 5)["v"]
    assert 5.9 < np.abs(speeds).max() <= 6.0


@pytest.mark.slow
def test_a_request_to_stop_before_the_first_release_leaves_the_stated_one(tmp_path: Path) -> None:
    task = DesignTask.resolve(short(tmp_path, horizon=0.1), threads=1)
    stop = StopToken()
    stop.request()
    with ThreadPoolExecutor(2) as executor:
        design = design_task(task, executor=executor, budget=Budget(stop=stop))
    assert np.isfinite(design.final.cost)
    assert len(design.history) == 1


@pytest.mark.slow
def test_an_optimum_at_the_end_of_a_range_is_said(tmp_path: Path) -> None:
    design = mjfim.design(
        short(tmp_path, horizon=0.3, initial={"free": {"qpos:hinge": (-1.0, 1.0)}})
    )
    assert design.trajectory.qpos[0, 0] == 1.0
    assert [w for w in design.warnings if "upper end of the range of qpos:hinge, 1 rad" in w]
    assert is_playable(design)


def test_the_ranges_of_the_model_narrow_those_of_the_release(tmp_path: Path) -> None:
    task = DesignTask.resolve(short(tmp_path, limits={"position": {"hinge": (-2.0, 1.5)}}))
    assert (task.release.lower[0], task.release.upper[0]) == (0.1, 1.5)

    with pytest.raises(
        ExperimentError, match=r"initial\.free\.qpos:hinge.*outside of the position"
    ):
        DesignTask.resolve(short(tmp_path, 0.0, limits={"position": {"hinge": (-1.0, 0.1)}}))


@pytest.mark.parametrize(
    ("free", "message"),
    [
        ({"hinge": (0.0, 1.0)}, r"initial\.free: .*'hinge'.*qpos:hinge"),
        ({"qpos:hinge": (1.0, 0.5)}, "lower"),
        ({}, r"no actuators.*initial\.free.*\"qpos:hinge\" = "),
    ],
)
def test_faults_are_named(free: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(ExperimentError, match=message):
        mjfim.design(short(tmp_path, initial={"free": free}))


def test_studies_of_controls_refuse_a_release(tmp_path: Path) -> None:
    experiment = short(tmp_path)
    for study, argument, name in (
        (mjfim.compare, experiment, "compare"),
        (mjfim.shortest_experiment, experiment, "shortest horizon"),
        (mjfim.design_jointly, [experiment, experiment], "joint design"),
    ):
        with pytest.raises(ExperimentError, match=f"{name} is for designs of a control"):
            study(argument)


@pytest.mark.slow
def test_a_pendulum_at_rest_is_released_where_it_moves(tmp_path: Path) -> None:
    """The stated release tells nothing; position and velocity are chosen together."""
    free = {"qpos:hinge": (-1.0, 1.0), "qvel:hinge": (-2.0, 2.0)}
    experiment = short(tmp_path, 0.0, initial={"free": free}, horizon=0.5)
    design = mjfim.design(experiment)
    assert design.initial.cost == np.inf
    assert np.isfinite(design.final.cost)
    assert abs(design.trajectory.state[0]).max() > 0.5


def test_rotations_of_a_free_body_are_relative_to_the_stated_state(tmp_path: Path) -> None:
    text = (
        '<mujoco><worldbody><body name="b" pos="0 0 1"><freejoint name="base"/>'
        '<geom name="g" type="box" size="0.1 0.2 0.3" mass="1"/></body></worldbody></mujoco>'
    )
    (tmp_path / "box.xml").write_text(text, encoding="utf-8")
    experiment = Experiment(
        model="box.xml",
        rate=100.0,
        horizon=0.2,
        initial={
            "qpos": (0.0, 0.0, 1.0, 0.0, 1.0, 0.0, 0.0),
            "free": {"qpos:base.z": (1.0, 3.0), "qpos:base.rx": (-0.5, 0.5), "qvel:base.x": (0, 1)},
        },
        parameters={"mass": "body/b:mass"},
        noise={"state": 0.01},
        directory=tmp_path,
    )
    system = System.resolve(experiment)
    space = ReleaseSpace.of(system, ())
    assert_allclose(space.state(np.array([0.0, 0.5, 0.0]))[:7], [0, 0, 1, 0, 1, 0, 0])

    # A rotation of 0.5 rad about the same axis as the stated one, which is half a turn.
    half = 0.5 * (np.pi + 0.5)
    expected = [0.0, 0.0, 3.0, np.cos(half), np.sin(half), 0.0, 0.0, 1.0]
    assert_allclose(space.state(np.ones(3))[:8], expected, atol=1e-12)
    assert set(space.names) <= {c.name for c in tangent_components(system.model)}


@pytest.mark.slow
def test_with_actuators_the_stated_control_is_played(tmp_path: Path) -> None:
    experiment = cart_pendulum(
        horizon=0.5,
        cost={"tracking": {}},
        initial={"free": {"qvel:hinge": (-1.0, 1.0)}},
    )
    design = mjfim.design(experiment)
    assert_array_equal(design.trajectory.ctrl, design.initial.trajectory.ctrl)
    assert abs(design.trajectory.qvel[0]).max() > 0.0
    assert design.final.cost < design.initial.cost


def test_a_recording_begins_where_the_design_does(tmp_path: Path) -> None:
    experiment = short(tmp_path)
    trajectory = DesignTask.resolve(experiment).released_as(np.array([2.0, 0.0])).initial
    recording = mjfim.simulate(experiment, trajectory, seed=1)
    assert recording.y[0, 0] == pytest.approx(2.0, abs=0.02)
    evaluated = mjfim.evaluate(experiment, trajectory)
    assert_allclose(evaluated.trajectory.qpos, trajectory.qpos)


@pytest.mark.slow
@pytest.mark.parametrize("nuisance", [{}, {"initial": {"qpos:hinge": True}}])
def test_recordings_from_several_releases_are_identified_together(
    nuisance: Any, tmp_path: Path
) -> None:
    true = {"damping": {"true": 0.013}, "centre": {"true": -0.28}}
    tables = {"horizon": 1.0, "nuisance": nuisance, "fit": {"bootstrap": 0}}
    experiment = short(tmp_path, **tables).replace(parameters=true)
    task = DesignTask.resolve(experiment)
    recordings = [
        mjfim.simulate(experiment, task.released_as(np.array([angle, 0.0])).initial, seed=seed)
        for seed, angle in enumerate((0.7, 1.6, 2.4))
    ]
    estimate = mjfim.identify(experiment, recordings)
    error = np.abs(estimate.theta[:2] - [0.013, -0.28])
    assert (error < 4.0 * estimate.std[:2]).all()
    assert not estimate.misfit
    assert mjfim.check(experiment, recordings).verdict.ok


FILE = """
model = "swing_down.xml"
rate = 50.0
horizon = 1.0
rehearsal.robots = 4
initial = { qpos = ["30 deg"], free = { "qpos:hinge" = ["-120 deg", "120 deg"] } }
parameters.damping = { target = "joint/hinge:damping", guess = 0.012, true = 0.01 }
parameters.centre = { target = "body/rod:ipos[2]", guess = -0.25, true = -0.3 }
nuisance.initial = { "qpos:hinge" = true }
noise = { "qpos:hinge" = 0.002 }
"""


@pytest.mark.slow
@pytest.mark.usefixtures("empty_figures")
def test_every_verb_follows_the_designed_release(tmp_path: Path) -> None:
    swing_down(tmp_path)
    file, log, out = tmp_path / "swing.toml", tmp_path / "log.csv", tmp_path / "out"
    file.write_text(FILE, encoding="utf-8")
    for arguments in (
        ("list", tmp_path / "swing_down.xml"),
        ("validate", file),
        ("check", file, "-o", tmp_path / "check"),
        ("simulate", file, "-o", tmp_path / "initial.csv"),
        ("design", file, "-o", out),
        ("simulate", file, out, "-o", log),
        ("check", file, log),
        ("identify", file, log, "-o", tmp_path / "fit"),
        ("check", file, "--design", out),
        ("montecarlo", file, out, "-o", tmp_path / "study", "--trials", "4"),
        ("rehearse", out, "-o", tmp_path / "robots", "--robots", "1"),
        ("replay", out, "--save", tmp_path / "replay.rrd"),
    ):
        result = run(*arguments)
        assert result.exit_code == 0, result.output
    assert (tmp_path / "fit" / "identified.xml").is_file()
    # There is no column of a control.
    header, row, *_ = log.read_text(encoding="utf-8").splitlines()
    assert header == '"t","qpos:hinge"'
    angle = float(row.split(",")[1])
    assert abs(angle) == pytest.approx(np.deg2rad(120.0), abs=0.02)
