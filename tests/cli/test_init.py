"""`mjfim init`, `mjfim list` and `mjfim validate` from the command line."""

from __future__ import annotations

import tomllib
from pathlib import Path

import numpy as np
import pytest
from typer.testing import Result

from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.recordings.read import read_recording
from tests.support.cart_pendulum import cart_pendulum, logs_of
from tests.support.cli import MODELS, done, loads, misused, names, run

MODEL = MODELS / "cart_pendulum.xml"


def test_a_model_without_joints_is_refused(here: Path) -> None:
    (here / "rigid.xml").write_text("<mujoco/>", encoding="utf-8")
    misused(run("init rigid.xml -o a.toml"), "rigid.xml: the model has no joint")


@pytest.mark.slow
def test_init_reads_a_log_of_another_program(here: Path) -> None:
    """The experiment file reads the log as it is, and the next command fits it."""
    (recorded,) = logs_of(cart_pendulum(horizon=1.0), 0)
    slide, hinge = recorded.y[:-1, :2].T
    rows = np.column_stack([1e3 * recorded.t[:-1], recorded.ctrl, slide, np.degrees(hinge)])
    lines = ("; ".join(f"{x:.9f}".replace(".", ",") for x in row) for row in rows)
    log = Path("robot.csv")
    log.write_text("\n".join(("time [ms]; force_cmd; x_slide; hinge [deg]", *lines)), "utf-8")

    result = done("init -o robot.toml --log robot.csv", MODEL)
    assert result.stdout.strip() == "next: mjfim identify robot.toml robot.csv"
    stated = tomllib.loads(Path("robot.toml").read_text(encoding="utf-8"))["recording"]
    columns = {"ctrl:force": "force_cmd", "slide_position": "x_slide", "hinge_angle": "hinge"}
    assert stated == {"time": "time", "columns": columns}
    read = read_recording(log, System.resolve(Experiment.from_file("robot.toml")).channels)
    shown = np.column_stack([1e3 * read.t, read.y[:, 0], np.degrees(read.y[:, 1])])
    assert np.allclose(shown, rows[:, [0, 2, 3]], rtol=0, atol=1e-6)
    assert run("identify robot.toml robot.csv -o fit").exit_code in (0, 1)


def asked(*answers: str, code: int = 0) -> Result:
    """`mjfim init --ask` for a slide with a pendulum, with these answers."""
    result = run("init -o asked.toml --ask", MODEL, answers="".join(f"{a}\n" for a in answers))
    assert result.exit_code == code, result.stderr
    return result


@pytest.mark.slow
def test_init_writes_a_file_that_validate_accepts(here: Path) -> None:
    """Enter takes what it proposes without questions."""
    assert "next: mjfim check cart_pendulum.toml" in done("init", MODEL).stdout
    text = (here / "cart_pendulum.toml").read_text(encoding="utf-8")
    assert "# A first experiment for" in text
    asked(*[""] * 5)
    assert (here / "asked.toml").read_text(encoding="utf-8") == text
    assert "is correct" in done("validate cart_pendulum.toml").stdout


# Two links of a ROS package, whose meshes are files of it.
PACKAGED = """
<robot name="two">
  <link name="base"/>
  <link name="upper">
    <inertial><origin xyz="0 0 -0.2"/><mass value="1.2"/>
      <inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial>
    <collision><geometry><mesh filename="package://arm_description/meshes/a.obj"/></geometry>
    </collision>
  </link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="9" velocity="3"/>
    <dynamics damping="0.1" friction="0"/></joint>
</robot>
"""
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.mark.slow
def test_a_urdf_of_a_ros_package_becomes_a_file_that_validate_accepts(here: Path) -> None:
    """The written MJCF finds the meshes, and has the motors and the mesh of the URDF."""
    for name, text in {"elsewhere/meshes/a.obj": TETRAHEDRON, "first/arm.urdf": PACKAGED}.items():
        (here / name).parent.mkdir(parents=True)
        (here / name).write_text(text, encoding="utf-8")
    (here / "first" / "arm.urdf").rename(here / "arm.urdf")
    done("init arm.urdf -o first/arm.toml --package arm_description=elsewhere")
    file = here / "first" / "arm.toml"
    values = tomllib.loads(file.read_text("utf-8"))
    assert values["limits"]["velocity"] in (3.0, {"shoulder": 3.0})
    done("validate first/arm.toml")
    model = System.resolve(Experiment.from_file(file)).model
    assert (model.nu, model.nmesh, model.actuator("shoulder").ctrlrange[1]) == (1, 1, 9.0)


@pytest.mark.usefixtures("here")
def test_the_load_that_is_asked_for_is_an_unknown() -> None:
    done("init -o arm.toml --payload fore", MODELS / "two_joint_arm.xml")
    payload = tomllib.loads(Path("arm.toml").read_text("utf-8"))["parameters"]["payload"]
    assert payload["targets"][0]["path"] == "body/fore:mass"


@pytest.mark.slow
@pytest.mark.usefixtures("here")
def test_wrong_answers_are_asked_again() -> None:
    answers = ["up", "hanging", "frictions", "friction", "hand", "none", "333", "100", "-1", "3.0"]
    said = asked(*answers).stderr
    for fault in (
        "unknown keyframe at rest 'up'",
        "unknown group 'frictions'",
        "unknown body 'hand'",
        "rates nearby: 50, 100",
        "'-1' is no positive number",
    ):
        assert fault in said
    values = tomllib.loads(Path("asked.toml").read_text("utf-8"))
    assert (values["rate"], values["horizon"]) == (100.0, 3.0)
    assert all("damping" in name for name in values["parameters"])


def test_answers_that_end_too_early_are_a_misuse(here: Path) -> None:
    said = asked("", "", code=2).stderr
    assert "the input ended before the last question" in said
    assert names(here) == set()


@pytest.mark.parametrize(
    ("part", "paths"),
    [
        ("damping", ["joint/slide:damping", "joint/hinge:damping"]),
        # Brackets are a part of paths.
        ("bob:ipos[1]", ["body/bob:ipos[1]"]),
    ],
)
def test_list_finds_paths_by_a_part_of_their_name(part: str, paths: list[str]) -> None:
    found = loads(done("list", MODEL, part, "--json").stdout)
    assert [row["path"] for row in found["parameters"]] == paths
    table = done("list", MODEL, "--kind", "keyframes").stdout
    assert "hanging" in table and "damping" not in table


@pytest.mark.usefixtures("here")
def test_validate_says_what_design_lacks_and_prints_the_schema() -> None:
    Path("log.toml").write_text(
        f'model = "{MODEL.as_posix()}"\nrate = 100.0\nnoise = {{ state = 0.1 }}\n'
        '[parameters.c]\ntarget = "joint/hinge:damping"\n',
        encoding="utf-8",
    )
    found = loads(done("validate log.toml --json").stdout)
    assert found["missing"] == ["horizon", "initial.control"]
    assert "model" in loads(done("validate --schema").stdout)["properties"]
