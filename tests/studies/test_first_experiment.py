"""First experiments: they run without edits, and each choice follows the model."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest

from mjfim.errors import ExperimentError
from mjfim.excitation.limits.verification import verify
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.studies.check import check
from mjfim.studies.first_candidates import Wishes, candidates
from mjfim.studies.first_experiment import (
    Proposal,
    experiment_text,
    identifiable,
    propose_experiment,
)
from mjfim.studies.first_motion import choose_start, require_support
from tests.support.cli import MODELS

# Whole jobs: these tests run in `.ci/run` only.
pytestmark = pytest.mark.slow

URDF = """
<robot name="two">
  <link name="base"/>
  <link name="upper">
    <inertial>
      <origin xyz="0 0 -0.2"/><mass value="1.2"/>
      <inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <link name="lower">
    <inertial>
      <origin xyz="0 0 -0.15"/><mass value="0.7"/>
      <inertia ixx="0.005" iyy="0.005" izz="0.001" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <joint name="shoulder" type="revolute">
    <parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <limit lower="-1.5" upper="1.5" effort="20" velocity="3"/>
    <dynamics damping="0.1" friction="0"/>
  </joint>
  <joint name="elbow" type="revolute">
    <parent link="upper"/><child link="lower"/><origin xyz="0 0 -0.4"/><axis xyz="0 1 0"/>
    <limit lower="-2" upper="2" effort="10" velocity="4"/>
    <dynamics damping="0.05" friction="0"/>
  </joint>
</robot>
"""

# An arm on a base that does not move.
BOLTED = """
<mujoco>
  <worldbody>
    <body name="base">
      <geom size="0.1" mass="1"/>
      <body name="arm">
        <joint name="hinge" axis="0 1 0" damping="0.1"/>
        <geom type="capsule" size="0.02" fromto="0.2 0 0 0.5 0 0" mass="0.4"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge" ctrlrange="-3 3"/></actuator>
</mujoco>
"""

FREE_BODY = """
<mujoco>
  <worldbody>
    <body name="b"><freejoint name="base"/><geom size="0.1" mass="1"/></body>
  </worldbody>
</mujoco>
"""

DOUBLE = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.004" integrator="implicitfast"><flag contact="disable"/></option>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 1 0" range="-0.5 2.0" damping="0.02"/>
      <geom name="rod" type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/>
      <body name="bob" pos="0 0 -0.5">
        <joint name="{kind}" type="{kind}" axis="1 0 0" damping="0.01"/>
        <geom name="bob" type="box" size="0.05 0.1 0.02" mass="0.2"/>
      </body>
    </body>
  </worldbody>
</mujoco>
"""

FALLING = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <option timestep="0.005"/>
  <worldbody>
    <body name="cage" pos="0 0 1">
      <joint name="lift" type="slide" axis="0 0 1" range="-1 1"/>
      <geom type="box" size="0.1 0.1 0.1" mass="1" contype="0" conaffinity="0"/>
      <body name="arm">
        <joint name="arm" axis="0 1 0" damping="0.05"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="0.5" contype="0"
              conaffinity="0"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="arm" joint="arm" ctrlrange="-1 1"/></actuator>
</mujoco>
"""

PENDULUM = """
<mujoco>
  <option timestep="{timestep}" gravity="0 0 {gravity}"/>
  <worldbody>
    <body name="rod">
      <joint name="hinge" axis="0 1 0" damping="{damping}"/>
      <geom name="bob" type="sphere" size="{radius}" mass="{mass}" pos="0 0 -{length}"/>
    </body>
  </worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
</mujoco>
"""


def pendulum(folder: Path, *, length: float, mass: float) -> Path:
    """A pendulum of some length [m] and mass [kg] with 1 % of critical damping."""
    omega = np.sqrt(9.81 / length)
    text = PENDULUM.format(
        timestep=f"{0.002 / omega:.6g}",
        gravity=-9.81,
        damping=0.02 * mass * length**2 * omega,
        radius=0.05 * length,
        mass=mass,
        length=length,
    )
    return written(folder, text, f"pendulum_{length:g}_{mass:g}.xml")


def written(folder: Path, text: str, name: str = "model.xml") -> Path:
    """A model file."""
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def proposed(path: Path, folder: Path, **options: object) -> tuple[Proposal, Experiment]:
    """The proposal for a model, and the experiment that its file states."""
    proposal = propose_experiment(path, folder, Wishes(**options), companion_name="motors.xml")
    if proposal.companion is not None:
        written(folder, proposal.companion, "motors.xml")
    file = written(folder, experiment_text(proposal), "first.toml")
    return proposal, Experiment.from_file(file)


@pytest.mark.parametrize(
    "name",
    [
        "cart_pendulum",
        "filtered_drive",
        "four_bar",
        "quadrotor",
        "dfki_simple_pendulum",
    ],
)
def test_the_file_runs_as_it_stands_and_keeps_all_limits(name: str, tmp_path: Path) -> None:
    proposal, experiment = proposed(MODELS / f"{name}.xml", tmp_path)
    task = DesignTask.resolve(experiment)
    margins = verify(task, task.initial).margins
    # A design finds the way back to hovering.
    found_later = {"end_position", "end_velocity"} if proposal.flies else set()
    assert {kind for kind, margin in margins.items() if margin < 0.0} <= found_later
    assert {each.name for each in proposal.chosen} == set(experiment.parameters)
    # The gains of the feedback read positions and velocities, which no sensor shows.
    flight = {"imu_gyro", "qpos:base.pos", "qvel:base.rot"} if proposal.flies else set()
    assert flight <= set(experiment.noise)
    assert experiment.rehearsal.feedback is proposal.flies

    found = check(experiment.replace(rehearsal={"robots": 0}))
    assert not found.not_separable
    assert max(row.relative for row in found.rows) < 0.5


def test_commented_parameters_are_valid_when_they_are_uncommented(tmp_path: Path) -> None:
    proposal, experiment = proposed(MODELS / "cart_pendulum.xml", tmp_path)
    assert proposal.others
    text = Path(experiment.source).read_text(encoding="utf-8")
    uncommented = re.sub(r"^# (\w+ = \{.*\})", r"\1", text, flags=re.MULTILINE)
    (tmp_path / "all.toml").write_text(uncommented, encoding="utf-8")
    names = set(Experiment.from_file(tmp_path / "all.toml").parameters)
    assert names == {each.name for each in (*proposal.chosen, *proposal.others)}


def test_muscles_have_room_to_move(tmp_path: Path) -> None:
    """Without a keyframe, they begin under tension; the robot of plain MuJoCo moves."""
    spec = mujoco.MjSpec.from_file(str(MODELS / "muscle_arm.xml"))
    spec.delete(spec.keys[0])
    proposal, experiment = proposed(written(tmp_path, spec.to_xml()), tmp_path)
    assert proposal.start.held and min(proposal.amplitudes.values()) > 0.02
    motion = DesignTask.resolve(experiment).initial
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "model.xml"))
    data = mujoco.MjData(model)
    data.qpos[:], data.act[:] = motion.qpos[0], motion.act[0]
    places = []
    for row in motion.ctrl:
        data.ctrl[:] = row
        mujoco.mj_step(model, data, round(motion.dt / model.opt.timestep))
        places.append(data.qpos.copy())
    assert (np.ptp(places, axis=0) > 0.2).all()


@pytest.mark.parametrize(
    "actuator", ["<motor ", '<position kp="1000" ctrlrange="-1 2" forcerange="-20 20" ']
)
def test_a_start_at_the_end_of_a_range_moves_where_there_is_room(
    actuator: str, tmp_path: Path
) -> None:
    """Servos are commanded along, so that those with little force hold the start as well."""
    text = pendulum(tmp_path, length=1.0, mass=1.0).read_text(encoding="utf-8")
    text = text.replace("<joint ", '<joint range="-1 90" limited="true" ')
    key = '<keyframe><key name="home" qpos="0" ctrl="0"/></keyframe></mujoco>'
    text = text.replace("<motor ", actuator).replace("</mujoco>", key)
    proposal, _ = proposed(written(tmp_path, text), tmp_path)
    low, high = np.deg2rad([-1.0, 90.0])
    place = (proposal.start.qpos[0] - low) / (high - low)
    assert proposal.start.held and place == pytest.approx(0.25)


def test_proposals_scale_with_the_size_of_the_robot(tmp_path: Path) -> None:
    found = []
    for length, mass in ((1.0, 1.0), (1e-3, 1e-6), (1e3, 1e6)):
        proposal, _ = proposed(pendulum(tmp_path, length=length, mass=mass), tmp_path)
        times, period = proposal.times, 2 * np.pi * np.sqrt(length / 9.81)
        assert times.period == pytest.approx(period, rel=1e-3)
        assert times.samples == pytest.approx(times.horizon * times.rate)
        amplitude = proposal.amplitudes["motor"] / (mass * length)
        found.append((times.samples, amplitude, [each.name for each in proposal.chosen]))
    samples, amplitude, chosen = found[0]
    for other in found[1:]:
        assert other[0] == pytest.approx(samples, rel=0.6)
        assert other[1] == pytest.approx(amplitude, rel=0.1)
        assert other[2] == chosen


def test_a_urdf_gets_motors_and_keeps_its_limits(tmp_path: Path) -> None:
    path = written(tmp_path, URDF, "two.urdf")
    proposal, experiment = proposed(path, tmp_path)
    assert experiment.model == "motors.xml"

    model = mujoco.MjModel.from_xml_path(str(tmp_path / "motors.xml"))
    assert model.nu == 2
    assert model.actuator("shoulder").ctrlrange.tolist() == [-20.0, 20.0]
    assert experiment.limits.velocity == {"shoulder": 3.0, "elbow": 4.0}
    task = DesignTask.resolve(experiment)
    # Motors do not stop the first motion at its end; a design does.
    margins = verify(task, task.initial).margins
    assert {kind for kind, margin in margins.items() if margin < 0.0} <= {
        "end_position",
        "end_velocity",
    }
    assert proposal.boundary == {"start": "rest", "end": "rest"}


def test_a_payload_is_the_difference_from_the_body_that_carries_it(tmp_path: Path) -> None:
    path = written(tmp_path, URDF, "two.urdf")
    _, experiment = proposed(path, tmp_path, payload="lower", groups=("payload",))
    spec = experiment.parameters["payload"]
    assert spec.guess == 0.0
    assert spec.targets[0].offset == pytest.approx(0.7)
    assert set(experiment.parameters) <= {"payload", *(f"payload_moment_{a}" for a in "xyz")}


def test_a_payload_is_unknown_or_refused(tmp_path: Path) -> None:
    path = written(tmp_path, BOLTED)
    found = propose_experiment(path, tmp_path, Wishes(payload="arm"))
    assert found.chosen[0].name == "payload"
    with pytest.raises(ExperimentError, match="does not show a load at 'base'"):
        propose_experiment(path, tmp_path, Wishes(payload="base", groups=("friction",)))

    # Without weight, the load is a share of the robot's mass, not only of the body's.
    text = SERVO_ARM.format(floor="").replace("<option", '<option gravity="0 0 0"')
    [load, *_] = candidates(
        mujoco.MjModel.from_xml_string(text), (), "wrist", length=0.5, period=1.0, rate=100.0
    )
    assert load.scale == pytest.approx(0.05 * 0.92, rel=0.05)

    # The load of a light wrist follows from what the motors lift.
    floor = '<geom type="plane" size="1 1 1" pos="0 0 -0.1" contype="0" conaffinity="0"/>'
    path = written(tmp_path, SERVO_ARM.format(floor=floor))
    found = propose_experiment(path, tmp_path, Wishes(payload="wrist"))
    assert found.chosen[0].name == "payload"
    # Nothing collides with this floor, so a limit states it.
    assert found.limits["floor"] == -0.1
    assert found.chosen[0].scale is not None
    assert 0.01 < found.chosen[0].scale < 1.0


def test_the_floor_of_a_hand_is_below_its_palm(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        """
    <mujoco>
      <worldbody>
        <body name="palm"><geom type="box" size="0.05 0.05 0.02"/>
          <body name="finger" pos="0.1 0 0.02"><joint name="knuckle" axis="0 0 1" damping="0.1"/>
            <geom type="capsule" fromto="0.02 0 0 0.1 0 0" size="0.02" mass="0.1"/>
            <body name="tip" pos="0.15 0 0"><joint name="end" axis="0 0 1" damping="0.1"/>
              <geom type="capsule" fromto="0.02 0 0 0.1 0 0" size="0.02" mass="0.1"/>
      </body></body></body></worldbody>
      <actuator><motor name="a" joint="knuckle" ctrlrange="-1 1"/>
        <motor name="b" joint="end" ctrlrange="-1 1"/></actuator>
    </mujoco>
    """,
    )
    _, experiment = proposed(path, tmp_path)
    assert experiment.limits.floor == -0.02
    assert experiment.limits.clearance is not None and not experiment.limits.ignored


# Four equal servos, the last of which turns a light wrist; no joint has a damping.
SERVO_ARM = """
<mujoco>
  <compiler autolimits="true"/>
  <option integrator="implicitfast"/>
  <default>
    <joint axis="0 1 0" range="-150 150" armature="0.02" frictionloss="0.05"/>
    <geom type="capsule" size="0.02"/>
    <position kp="200" kv="8" forcerange="-20 20" ctrlrange="-2 2"/>
  </default>
  <worldbody>
    {floor}
    <body name="base"><geom type="box" size="0.04 0.04 0.04" pos="0 0 0.04"/>
      <body name="upper" pos="0 0 0.15"><joint name="pan" axis="0 0 1"/>
        <geom fromto="0 0 0 0 0 0.1" mass="0.4"/>
        <body name="lower" pos="0 0 0.1"><joint name="lift"/>
          <geom fromto="0 0 0 0.2 0 0" mass="0.3"/>
          <body name="fore" pos="0.2 0 0"><joint name="elbow"/>
            <geom fromto="0 0 0 0.2 0 0" mass="0.2"/>
            <body name="wrist" pos="0.2 0 0"><joint name="roll" axis="1 0 0"/>
              <geom fromto="0 0 0 0.03 0 0.02" mass="0.02"/>
            </body></body></body></body></body>
  </worldbody>
  <actuator>
    <position name="pan" joint="pan"/><position name="lift" joint="lift"/>
    <position name="elbow" joint="elbow"/><position name="roll" joint="roll"/>
  </actuator>
</mujoco>
"""


def test_an_arm_with_servos_gets_a_file_that_a_person_would_play(tmp_path: Path) -> None:
    """Unknowns of equal servos, limits that the motion keeps, and an end at rest."""
    path = written(tmp_path, SERVO_ARM.format(floor='<geom type="plane" size="1 1 1"/>'))
    proposal, experiment = proposed(path, tmp_path)

    # Equal joints share one unknown; what the MJCF does not have stands in a comment.
    assert list(experiment.parameters)[:4] == ["kp", "frictionloss", "armature", "delay"]
    assert [target.path for target in experiment.parameters["kp"].targets] == [
        f"actuator/{name}:kp" for name in ("pan", "lift", "elbow", "roll")
    ]
    # Its size is 5 % of the 20 N m of a servo, at the speed of a pendulum of the robot's length.
    [damping] = [each for each in proposal.others if each.name == "damping"]
    expected = 0.05 * 20.0 * proposal.times.period / (2.0 * np.pi)
    assert damping.scale == pytest.approx(expected, rel=0.01)
    assert damping.bounds == pytest.approx((0.0, 10.0 * expected), rel=0.01)

    limits, boundary = experiment.limits, experiment.boundary
    assert limits.velocity == pytest.approx(np.sqrt(9.81 / 0.4), rel=0.2)
    assert limits.clearance == pytest.approx(0.008, rel=0.4)
    assert limits.bandwidth is not None
    assert limits.floor is None
    assert (boundary.start, boundary.end) == ("rest", "rest")
    task = DesignTask.resolve(experiment)
    assert verify(task, task.initial).is_feasible


TENDON = "<tendon><fixed name='t'><joint joint='c' coef='-3'/></fixed></tendon>"


@pytest.mark.parametrize(
    ("strong", "force"),
    [
        ('<motor joint="b" gear="-50" ctrlrange="-2 2"/>', 100.0),
        ('<motor joint="b" gear="50" ctrlrange="-2 2" forcerange="-1 1"/>', 50.0),
        ('<position joint="b" kp="1000" ctrlrange="-2 2" forcerange="-30 30"/>', 30.0),
        ('<motor tendon="t" gear="2" ctrlrange="-9 9"/>', 54.0),
    ],
)
def test_what_equal_joints_lack_has_the_size_of_the_strongest(strong: str, force: float) -> None:
    """Four joints without friction, the second of which has the strongest actuator."""
    body = '<body name="{0}" pos="0.1 0 0"><joint name="{0}" axis="0 1 0"/><geom size="0.1"/>{1}'
    text = ""
    for name in "dcba":
        text = body.format(name, text) + "</body>"
    weak = "<motor joint='a' ctrlrange='-1 1'/>"
    text = f"<worldbody>{text}</worldbody>{TENDON}<actuator>{strong}{weak}</actuator>"
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{text}</mujoco>")
    sizes = {"length": 0.4, "period": 1.0, "rate": 100.0}
    found = {each.name: each for each in candidates(model, ("friction", "motors"), None, **sizes)}
    expected = {
        "frictionloss": 0.05 * force,
        "damping": 0.05 * force / (2.0 * np.pi),
        "armature": 0.05 * force / (2.0 * np.pi) ** 2,
    }
    for name, size in expected.items():
        assert found[name].scale == pytest.approx(size, rel=0.05)
        assert len(found[name].paths) == 4


def test_robots_that_cannot_be_moved_are_named(tmp_path: Path) -> None:
    with pytest.raises(ExperimentError, match=r"neither an actuator nor a slide, hinge or ball"):
        propose_experiment(written(tmp_path, FREE_BODY), tmp_path)

    # A robot with legs whose file has no floor falls.
    legged = written(tmp_path, WALKER.format(floor=""))
    with pytest.raises(ExperimentError, match=r'nothing is below trunk, .* <geom type="plane"'):
        propose_experiment(legged, tmp_path)
    weightless = WALKER.format(floor="").replace("<mujoco>", '<mujoco><option gravity="0 0 0"/>')
    on_floor = WALKER.format(floor='<geom type="plane" size="0 0 1"/>')
    for text in (weightless, on_floor):
        require_support(mujoco.MjModel.from_xml_string(text), legged)


WALKER = """
<mujoco>
  <worldbody>{floor}
    <body name="trunk" pos="0 0 0.5"><freejoint/><geom type="box" size="0.2 0.1 0.05" mass="3"/>
      <body name="leg"><joint name="hip" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03" mass="0.5"/></body></body>
  </worldbody>
  <actuator><motor name="hip" joint="hip" ctrlrange="-9 9"/></actuator>
</mujoco>
"""

# A free body with a thrust and three torques.
FLYER = """
<mujoco>
  <option timestep="0.005" gravity="0 0 {gravity}"/>
  <worldbody>
    <body name="b" pos="0 0 1"><freejoint name="base"/>
      <geom type="box" size="0.3 0.3 0.1" mass="2"/><site name="s"/></body>
  </worldbody>
  <actuator>
    <motor name="up" site="s" gear="0 0 1 0 0 0" ctrlrange="-40 40"/>
    <motor name="roll" site="s" gear="0 0 0 1 0 0" ctrlrange="-1 1"/>
    <motor name="pitch" site="s" gear="0 0 0 0 1 0" ctrlrange="-1 1"/>
  </actuator>
</mujoco>
"""


def test_a_robot_that_flies_gets_a_box_speeds_a_tilt_a_floor_and_feedback(tmp_path: Path) -> None:
    """Speeds are sqrt(g l) and sqrt(g / l), with the radius of gyration l of the body."""
    _, experiment = proposed(written(tmp_path, FLYER.format(gravity=-9.81)), tmp_path)
    inertia = 2.0 / 3.0 * np.array([0.1, 0.1, 0.18])
    length = np.sqrt(1.5 * inertia.mean() / 2.0)
    limits = experiment.limits
    velocity, turning = limits.velocity, limits.angular_velocity["base"]
    assert velocity == pytest.approx(np.sqrt(9.81 * length), rel=0.05)
    assert turning == pytest.approx(np.sqrt(9.81 / length), rel=0.05)
    box = np.array(limits.position["base"])
    centre, half = np.array([0.0, 0.0, 1.0]), 2.0 * length
    assert box == pytest.approx(np.stack([centre - half, centre + half], axis=1), rel=0.01)
    assert limits.tilt["base"] == 0.8
    assert limits.floor == 0.0
    assert experiment.rehearsal.feedback
    assert (experiment.boundary.start, experiment.boundary.end) == ("rest", "rest")
    task = DesignTask.resolve(experiment)
    margins = verify(task, task.initial).margins
    assert min(m for kind, m in margins.items() if not kind.startswith("end_")) >= 0.0


def test_a_robot_without_weight_needs_no_floor_and_no_tilt(tmp_path: Path) -> None:
    _, experiment = proposed(written(tmp_path, FLYER.format(gravity=0)), tmp_path)
    assert "base" in experiment.limits.position
    assert not experiment.limits.tilt
    assert experiment.limits.floor is None
    assert not experiment.rehearsal.feedback


def test_joints_that_tendons_drive_have_limits_of_their_speed(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        """
    <mujoco>
      <option integrator="implicitfast"/>
      <worldbody>
        <body name="one"><joint name="a" axis="0 1 0" damping="0.05"/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.3"/>
          <body name="two" pos="0 0 -0.2"><joint name="b" axis="0 1 0" damping="0.05"/>
            <geom type="capsule" fromto="0 0 0 0 0 -0.2" size="0.02" mass="0.2"/></body></body>
        <body name="cart" pos="1 0 0"><joint name="slide" type="slide" axis="1 0 0" damping="1"/>
          <geom size="0.05" mass="1"/></body>
      </worldbody>
      <tendon><fixed name="t"><joint joint="a" coef="1"/><joint joint="b" coef="0.5"/>
        <joint joint="slide" coef="1"/></fixed></tendon>
      <actuator><motor name="pull" tendon="t" ctrlrange="-1 1"/></actuator>
    </mujoco>
    """,
    )
    proposal, experiment = proposed(path, tmp_path)
    natural = 2.0 * np.pi / proposal.times.period
    velocity = experiment.limits.velocity
    assert set(velocity) == {"a", "b", "slide"}
    assert velocity["a"] == velocity["b"] == pytest.approx(natural, rel=0.05)
    # Nothing stops the cart in the MJCF.
    assert set(experiment.limits.position) == {"slide"}
    task = DesignTask.resolve(experiment)
    assert verify(task, task.initial).is_feasible


UPRIGHT = """
<mujoco>
  <worldbody><body name="rod"><joint name="hinge" axis="0 1 0" damping="0.1"/>
  <geom type="capsule" fromto="0 0 0 0 0 0.5" size="0.02" mass="1"/></body></worldbody>
  <actuator><motor joint="hinge" ctrlrange="-9 9"/></actuator>
  {keyframe}
</mujoco>
"""

# The name of a keyframe, the end of the reason for the start, lower and upper ends of its position,
# and an MJCF.
STARTS: dict[str, tuple[str, str, list[float], list[float], str]] = {
    "reference outside of the range": (
        "",
        "",
        [np.deg2rad(60.0)],
        [np.deg2rad(120.0)],
        """
    <mujoco>
      <worldbody><body name="b"><joint name="j" axis="0 0 1" range="60 120" limited="true"/>
      <geom size="0.1" mass="1" pos="0.3 0 0"/></body></worldbody>
      <actuator><motor joint="j"/></actuator>
    </mujoco>
    """,
    ),
    "upright is shown": ("", "", [np.pi - 1e-3], [np.pi + 1e-3], UPRIGHT.format(keyframe="")),
    "upright is a keyframe": (
        "up",
        "",
        [0.0],
        [0.0],
        UPRIGHT.format(keyframe='<keyframe><key name="up" qpos="0"/></keyframe>'),
    ),
    # A passive finger falls, while the driven arm stays where the keyframe shows it.
    "keyframe that no control holds": (
        "",
        "from the keyframe 'home' of the MJCF",
        [0.8 - 1e-6, -0.8 - 1e-4],
        [0.8 + 1e-6, -0.8 + 1e-4],
        """
    <mujoco>
      <compiler angle="radian"/>
      <worldbody><body name="arm"><joint name="arm" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.3" size="0.02" mass="1"/>
        <body name="finger" pos="0 0 -0.3"><joint name="finger" axis="0 1 0" damping="0.01"/>
          <geom type="capsule" fromto="0 0 0 0 0 -0.1" size="0.01" mass="0.1"/></body></body>
      </worldbody>
      <actuator><position joint="arm" kp="500" kv="20"/></actuator>
      <keyframe><key name="home" qpos="0.8 0.5" ctrl="0.8"/></keyframe>
    </mujoco>
    """,
    ),
    # The body floats 1 m above the floor; it settles on it.
    "nothing holds the robot": (
        "",
        "",
        [-np.inf] * 8,
        [np.inf, np.inf, 0.2, *[np.inf] * 5],
        """
    <mujoco>
      <worldbody><geom type="plane" size="5 5 1"/>
        <body name="b" pos="0 0 1"><freejoint/><geom type="box" size="0.1 0.1 0.1" mass="1"/>
        <body pos="0 0 0.1"><joint name="j" axis="0 1 0"/>
        <geom size="0.05" mass="0.1" pos="0 0 0.1"/></body></body></worldbody>
      <actuator><motor joint="j" ctrlrange="-1 1"/></actuator>
    </mujoco>
    """,
    ),
    # The weak motor cannot hold the arm, which falls on the end of its range.
    "rest on a stop": (
        "",
        "",
        [-np.deg2rad(59.0)],
        [np.deg2rad(59.0)],
        """
    <mujoco>
      <worldbody><body name="arm"><joint name="j" axis="0 1 0" range="-60 60" limited="true"/>
      <geom size="0.05" mass="1" pos="0.5 0 0"/></body></worldbody>
      <actuator><motor joint="j" ctrlrange="-0.01 0.01"/></actuator>
    </mujoco>
    """,
    ),
}


@pytest.mark.parametrize(("keyframe", "reason", "low", "high", "text"), STARTS.values(), ids=STARTS)
def test_a_start_is_held_inside_the_ranges_or_drifts_least(
    keyframe: str, reason: str, low: list[float], high: list[float], text: str
) -> None:
    """A keyframe is what the user wants, also one that is not stable."""
    start = choose_start(mujoco.MjModel.from_xml_string(text))
    assert (start.keyframe or "") == keyframe
    assert start.reason.endswith(reason)
    assert (low <= start.qpos).all() and (start.qpos <= high).all()


HELD = """
<mujoco>
  <option timestep="{timestep}"/>
  <worldbody>
    <body name="arm" gravcomp="{gravcomp}">
      <joint name="hinge" axis="0 1 0" ref="20" springref="0"/>
      <geom size="{radius}" mass="{mass}" pos="{length} 0 0"/>
    </body>
  </worldbody>
  <actuator><{actuator}/></actuator>
</mujoco>
"""
SERVO = 'position joint="hinge" kp="9"'


@pytest.mark.parametrize(
    ("actuator", "length", "mass", "gravcomp", "control", "act"),
    [
        *(
            ('motor joint="hinge"', length, mass, 0.0, -9.81 * mass * length, [])
            for length, mass in ((1e-3, 1e-6), (1.0, 1.0), (1e3, 1e6))
        ),
        (SERVO, 1.0, 1.0, 1.0, np.deg2rad(20.0), []),
        (f'{SERVO} gear="2"', 1.0, 1.0, 1.0, np.deg2rad(40.0), []),
        # The control of an integrated servo is a velocity, and its activation is the position.
        ('intvelocity joint="hinge" kp="9" actrange="-9 9"', 1.0, 1.0, 1.0, 0.0, [np.deg2rad(20)]),
    ],
)
def test_actuators_hold_arms_of_every_size_where_they_are(
    actuator: str, length: float, mass: float, gravcomp: float, control: float, act: list[float]
) -> None:
    """A motor by its torque, a servo by the place of its joint."""
    text = HELD.format(
        timestep=0.002 * np.sqrt(length),
        radius=0.1 * length,
        mass=mass,
        length=length,
        gravcomp=gravcomp,
        actuator=actuator,
    )
    start = choose_start(mujoco.MjModel.from_xml_string(text))
    assert start.held
    assert start.control == pytest.approx([control], rel=1e-3)
    assert start.act == pytest.approx(act)


def test_what_the_file_says_about_starts_and_names(tmp_path: Path) -> None:
    """A keyframe at a stop is no other keyframe; a weak motor at its end is named."""
    path = written(
        tmp_path,
        """
    <mujoco>
      <compiler angle="radian" autolimits="true"/>
      <worldbody><body name="arm" pos="0 0 1"><joint name="j" axis="0 1 0" range="-1 1"/>
        <geom type="capsule" fromto="0 0 0 0 0 -0.5" size="0.02" mass="1"/>
        <body pos="0 0 -0.5"><joint axis="0 1 0"/><geom size="0.03" mass="0.1"/></body>
        <body pos="0 0 -0.5"><geom size="0.03" mass="0.1"/></body></body></worldbody>
      <actuator><motor name="m" joint="j" ctrlrange="-1 1"/>
        <motor name="weak" joint="j" ctrlrange="-0.1 0.1"/></actuator>
      <keyframe><key name="down" qpos="1 0" ctrl="0 0"/><key name="up" qpos="0 3"/></keyframe>
    </mujoco>
    """,
    )
    proposal, experiment = proposed(path, tmp_path, keyframe="down")
    text = Path(experiment.source).read_text(encoding="utf-8")
    assert "# The start: the keyframe 'down' of the MJCF, with joints moved away" in text
    assert "# Other keyframes: up." in text
    assert "# Note: nothing is proposed for 2 bodies and 1 joint without a name" in text
    [warning] = [text for text in proposal.remarks if text.startswith("Warning: the start holds")]
    assert "m, weak at the end of the range" in warning


def test_parameters_are_chosen_until_one_spoils_the_others() -> None:
    # The second parameter has the same effect as the first one; the third is separate.
    G = np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 1.0], [0.0, 0.0, 2.0]]) * 10.0
    G[:, 1] = G[:, 0]
    sizes = np.ones(3)
    assert identifiable(G.T @ G, sizes) == [0, 2]

    # Units do not matter.
    units = np.array([1e-6, 1e6, 1e3])
    assert identifiable((G.T @ G) / np.outer(units, units), sizes * units) == [0, 2]

    # Where nothing is known well, the best known parameter remains.
    assert identifiable(1e-6 * np.diag([1.0, 3.0, 2.0]), sizes) == [1]


def test_controls_of_an_actuator_with_several_are_told_apart(tmp_path: Path) -> None:
    path = written(
        tmp_path,
        """
    <mujoco>
      <option gravity="0 0 0"/>
      <worldbody><body name="b"><joint name="ball" type="ball" damping="0.1"/>
        <geom size="0.1" mass="1" pos="0.3 0 0"/>
        <body name="c" pos="0.5 0 0"><joint name="hinge" axis="0 1 0" damping="0.1"/>
        <geom size="0.1" mass="1" pos="0.3 0 0"/></body></body></worldbody>
      <actuator><orientation name="turn" joint="ball" kp="2" kv="1"/>
        <position name="elbow" joint="hinge" kp="2" kv="1"/></actuator>
    </mujoco>
    """,
    )
    model = mujoco.MjModel.from_xml_path(str(path))
    start = choose_start(model)
    assert len(start.control) == model.nu == 4
    proposal, _ = proposed(path, tmp_path)
    assert list(proposal.amplitudes) == ["turn[0]", "turn[1]", "turn[2]", "elbow"]


def test_the_horizon_ends_where_a_small_disturbance_has_grown_too_much(tmp_path: Path) -> None:
    # Seen from this small drone, a slight tilt soon leads far away.
    path = written(
        tmp_path,
        """
    <mujoco>
      <worldbody><body name="b" pos="0 0 1"><freejoint name="f"/>
        <geom type="box" size="0.03 0.03 0.01" mass="0.1"/>
        <body name="c" pos="0 0 -0.02"><joint name="j" axis="0 1 0" damping="1e-4"/>
        <geom size="0.005" mass="0.01" pos="0 0 -0.3"/></body>
        <site name="s"/></body></worldbody>
      <actuator><motor name="up" site="s" gear="0 0 1 0 0 0" ctrlrange="0 3"/></actuator>
    </mujoco>
    """,
    )
    proposal, _ = proposed(path, tmp_path)
    assert any("amplifies small disturbances" in remark for remark in proposal.remarks)
    assert 0.4 * proposal.times.period < proposal.times.horizon < 2.9 * proposal.times.period


def test_the_horizon_ends_before_a_falling_robot_leaves_a_limit(tmp_path: Path) -> None:
    """A robot that no control holds falls one metre, to the end of its range, in 0.45 s."""
    path = written(tmp_path, FALLING)
    proposal = propose_experiment(path, tmp_path)
    assert 0.3 < proposal.times.horizon < 0.45
    [remark] = [text for text in proposal.remarks if "leaves a limit by itself" in text]
    assert "position of lift is" in remark

    experiment = Experiment(**proposal.values(), directory=tmp_path)
    task = DesignTask.resolve(experiment)
    assert verify(task, task.initial).is_feasible

    # A horizon that the user wants stays, and the limit is named.
    wished = propose_experiment(path, tmp_path, Wishes(horizon=0.6))
    assert wished.times.horizon == pytest.approx(0.6)
    [warning] = [text for text in wished.remarks if text.startswith("Warning")]
    assert "no motion about this start keeps all limits: position of lift is" in warning


def test_wishes_are_fulfilled(tmp_path: Path) -> None:
    wished: dict[str, object] = {
        "keyframe": "settled",
        "groups": ("friction",),
        "rate": 125.0,
        "horizon": 0.4,
    }
    proposal, experiment = proposed(MODELS / "servo_arm.xml", tmp_path, **wished)
    assert proposal.start.keyframe == experiment.initial.keyframe == "settled"
    assert (experiment.rate, experiment.horizon) == (125.0, 0.4)
    assert {each.group for each in proposal.chosen} == {"friction"}

    # Noise is wished by kind of coordinate, where the MJCF states none.
    path = pendulum(tmp_path, length=1.0, mass=1.0)
    _, experiment = proposed(path, tmp_path, sigmas={"angle": 0.02})
    assert experiment.noise["qpos:hinge"] == 0.02
    assert experiment.noise["qvel:hinge"] != 0.02


@pytest.mark.parametrize(
    ("wished", "message"),
    [
        ({"keyframe": "up"}, "unknown keyframe at rest 'up'; valid: hanging"),
        (
            {"rate": 33.0},
            "33 Hz is no whole number of .* 0.01 s; rates nearby: 25, 50, 33.3",
        ),
        ({"rate": 333.0}, "rates nearby: 50, 100$"),
        ({"horizon": 0.01, "rate": 100.0}, "less than two samples at 100 Hz.* at least 0.02 s"),
        ({"groups": ("motors",)}, "no parameter of motors can be proposed"),
    ],
)
def test_wishes_that_cannot_be_fulfilled_are_named(
    wished: dict[str, object], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ExperimentError, match=message):
        propose_experiment(MODELS / "cart_pendulum.xml", tmp_path, Wishes(**wished))


@pytest.mark.parametrize("kind", ["slide", "ball"])
def test_a_model_without_actuators_is_released(kind: str, tmp_path: Path) -> None:
    """The release is away from the equilibrium, inside the ranges, and its motion keeps them."""
    _, experiment = proposed(written(tmp_path, DOUBLE.format(kind=kind)), tmp_path)
    assert experiment.initial.control is None
    low, high = experiment.initial.free["qpos:hinge"]
    assert -0.5 < low < high < 2.0
    assert set(experiment.nuisance.initial or ()) == set(experiment.initial.free)
    assert len(experiment.initial.free) == (2 if kind == "slide" else 4)

    task = DesignTask.resolve(experiment)
    assert 0.0 < task.initial.qpos[0, 0] < high
    assert task.release is not None
    assert verify(task, task.initial).is_feasible
    assert "hinge_damping" in experiment.parameters


HANGING = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <body name="cup" pos="0 0 1">
      <joint name="lift" type="slide" axis="0 0 1" damping="3" stiffness="20"/>
      <geom size="0.02" mass="0.1" contype="0" conaffinity="0"/><site name="cup"/>
      </body>
    <body name="ball" pos="0 0 0.71">
      <joint name="fall" type="slide" axis="0 0 1"/>
      <geom size="0.02" mass="0.05" contype="0" conaffinity="0"/><site name="ball"/>
    </body>
  </worldbody>
  <tendon><spatial name="string" limited="true" range="0 0.3">
    <site site="ball"/><site site="cup"/></spatial></tendon>
  <actuator><motor name="lift" joint="lift" ctrlrange="-5 5"/></actuator>
</mujoco>
"""


def test_a_soft_range_that_the_state_at_rest_exceeds_is_written_wider(tmp_path: Path) -> None:
    """A ball hangs at a string that gives way; no motion could keep the range of the MJCF."""
    proposal, experiment = proposed(written(tmp_path, HANGING), tmp_path)
    assert not any("no motion about this start" in remark for remark in proposal.remarks)
    low, high = experiment.limits.tendon_length["string"]
    assert low == 0.0
    assert 0.3 < high < 0.315
    task = DesignTask.resolve(experiment)
    assert verify(task, task.initial).is_feasible
    # The string still acts along a design.
    assert verify(task.relaxed(), task.relaxed().initial).is_feasible

    # A range that is far wider than the MJCF's has no effect.
    wide = experiment.replace(limits={"tendon_length": {"string": [-1.0, 1.0]}})
    [limit] = [each for each in DesignTask.resolve(wide).limits if each.kind == "tendon_length"]
    assert (limit.lower, limit.upper) == (0.0, 0.3)


def test_bodies_that_touch_at_the_start_are_named_with_the_line_that_parts_them(
    tmp_path: Path,
) -> None:
    """A base that stands still collides with its child, which a moving one does not."""
    leg = (
        '<mujoco><worldbody><body name="base" pos="0 0 1"><geom size="0.1" pos="0.1 0 -0.15"/>'
        '<body name="leg"><joint name="hip" axis="0 1 0" range="-0.04 0.04"/><geom type="capsule" '
        'size="0.03" fromto="0 0 0 0 0 -0.3"/></body></body></worldbody>{}<actuator>'
        '<motor name="m" joint="hip" ctrlrange="-5 5"/></actuator></mujoco>'
    )
    exclude = '<exclude body1="base" body2="leg"/>'
    file = tmp_path / "leg.xml"
    for contact, is_named in (("", True), (f"<contact>{exclude}</contact>", False)):
        file.write_text(
            leg.format(contact).replace("<mujoco>", '<mujoco><compiler angle="radian"/>')
        )
        remarks = " ".join(propose_experiment(file, tmp_path).remarks)
        assert (exclude in remarks) == is_named, remarks
