"""`mjfim init`, `mjfim list` and `mjfim validate` from the command line."""

from __future__ import annotations

import json
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


def test_init_does_not_overwrite_files_of_the_user(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text("mine", encoding="utf-8")
    misused(run("init", MODELS / "cart_pendulum.xml", "-o", file), "mine.toml")
    assert file.read_text(encoding="utf-8") == "mine"

    # The model itself is never replaced, not even by force.
    model = tmp_path / "model.xml"
    model.write_bytes((MODELS / "cart_pendulum.xml").read_bytes())
    done("init", model, "-o", model, "--force", code=2)
    assert model.read_bytes() == (MODELS / "cart_pendulum.xml").read_bytes()


def test_init_writes_nothing_for_a_wrong_group(tmp_path: Path) -> None:
    words = ("-o", tmp_path / "a.toml", "--parameters", "frictions")
    result = run("init", MODELS / "cart_pendulum.xml", *words)
    misused(result, "unknown group 'frictions'", "'friction'")
    assert names(tmp_path) == set()


def test_a_model_and_an_experiment_in_the_place_of_the_other(tmp_path: Path) -> None:
    model, experiment = MODELS / "cart_pendulum.xml", MODELS / "cart_pendulum.toml"
    for verb in ("validate", "check", "design"):
        result = run(verb, model, *(["-o", tmp_path / "out"] if verb == "design" else []))
        misused(result, f"`mjfim init {model}` writes a first one")

    for verb in ("init", "list"):
        misused(run(verb, experiment), f"{experiment}: an experiment file, but a model")


def test_a_model_without_joints_is_refused(tmp_path: Path) -> None:
    model = tmp_path / "rigid.xml"
    model.write_text("<mujoco/>", encoding="utf-8")
    result = run("init", model, "-o", tmp_path / "a.toml")
    misused(result, "rigid.xml: the model has no joint")


@pytest.mark.slow
def test_init_reads_a_log_of_another_program(tmp_path: Path) -> None:
    """The experiment file reads the log as it is, and the next command fits it."""
    (recorded,) = logs_of(cart_pendulum(), 0)
    slide, hinge = recorded.y[:-1, :2].T
    rows = np.column_stack([1e3 * recorded.t[:-1], recorded.ctrl, slide, np.degrees(hinge)])
    lines = ("; ".join(f"{x:.9f}".replace(".", ",") for x in row) for row in rows)
    log = tmp_path / "robot.csv"
    log.write_text("\n".join(("time [ms]; force_cmd; x_slide; hinge [deg]", *lines)), "utf-8")

    file = tmp_path / "robot.toml"
    result = done("init", MODELS / "cart_pendulum.xml", "--log", log, "-o", file)
    assert result.stdout.strip() == f"next: mjfim identify {file} {log}"
    stated = tomllib.loads(file.read_text(encoding="utf-8"))["recording"]
    columns = {"ctrl:force": "force_cmd", "slide_position": "x_slide", "hinge_angle": "hinge"}
    assert stated == {"time": "time", "columns": columns}
    read = read_recording(log, System.resolve(Experiment.from_file(file)).channels)
    shown = np.column_stack([1e3 * read.t, read.y[:, 0], np.degrees(read.y[:, 1])])
    assert np.allclose(shown, rows[:, [0, 2, 3]], rtol=0, atol=1e-6)
    assert run("identify", file, log, "-o", tmp_path / "fit").exit_code in (0, 1)


def asked(file: Path, *answers: str) -> Result:
    """`mjfim init --ask` for a slide with a pendulum, with these answers."""
    words = ("init", MODELS / "cart_pendulum.xml", "-o", file, "--ask")
    return run(*words, answers="".join(f"{each}\n" for each in answers))


@pytest.mark.slow
def test_init_writes_a_file_that_validate_accepts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Enter takes what it proposes without questions."""
    monkeypatch.chdir(tmp_path)
    result = done("init", MODELS / "cart_pendulum.xml")
    assert "next: mjfim check cart_pendulum.toml" in result.stdout
    text = (tmp_path / "cart_pendulum.toml").read_text(encoding="utf-8")
    assert "# A first experiment for" in text
    assert asked(tmp_path / "asked.toml", *[""] * 5).exit_code == 0
    assert (tmp_path / "asked.toml").read_text(encoding="utf-8") == text

    valid = done("validate", "cart_pendulum.toml")
    assert "is correct" in valid.stdout


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
def test_a_urdf_of_a_ros_package_becomes_a_file_that_validate_accepts(tmp_path: Path) -> None:
    """The written MJCF finds the meshes, and has the motors and the mesh of the URDF."""
    package, urdf = tmp_path / "elsewhere", tmp_path / "arm.urdf"
    (package / "meshes").mkdir(parents=True)
    (package / "meshes" / "a.obj").write_text(TETRAHEDRON, encoding="utf-8")
    urdf.write_text(PACKAGED, encoding="utf-8")
    words = ("--package", f"arm_description={package}")
    file = tmp_path / "first" / "arm.toml"
    file.parent.mkdir()
    done("init", urdf, "-o", file, *words)
    values = tomllib.loads(file.read_text("utf-8"))
    assert values["limits"]["velocity"] in (3.0, {"shoulder": 3.0})
    done("validate", file)
    model = System.resolve(Experiment.from_file(file)).model
    assert (model.nu, model.nmesh, model.actuator("shoulder").ctrlrange[1]) == (1, 1, 9.0)


def test_the_load_that_is_asked_for_is_an_unknown(tmp_path: Path) -> None:
    model, file = MODELS / "two_joint_arm.xml", tmp_path / "arm.toml"
    done("init", model, "-o", file, "--payload", "fore")
    payload = tomllib.loads(file.read_text("utf-8"))["parameters"]["payload"]
    assert payload["targets"][0]["path"] == "body/fore:mass"
    misused(run("init", model, "-o", tmp_path / "b.toml", "--payload", "hand"), "unknown body")
    assert not (tmp_path / "b.toml").exists()


@pytest.mark.slow
def test_wrong_answers_are_asked_again(tmp_path: Path) -> None:
    answers = ["up", "hanging", "frictions", "friction", "hand", "none", "333", "100", "-1", "3.0"]
    result = asked(tmp_path / "asked.toml", *answers)
    assert result.exit_code == 0, result.stderr
    for fault in (
        "unknown keyframe at rest 'up'",
        "unknown group 'frictions'",
        "unknown body 'hand'",
        "rates nearby: 50, 100",
        "'-1' is no positive number",
    ):
        assert fault in result.stderr
    values = tomllib.loads((tmp_path / "asked.toml").read_text("utf-8"))
    assert (values["rate"], values["horizon"]) == (100.0, 3.0)
    assert all("damping" in name for name in values["parameters"])


def test_answers_that_end_too_early_are_a_misuse(tmp_path: Path) -> None:
    result = asked(tmp_path / "asked.toml", "", "")
    assert result.exit_code == 2
    assert "the input ended before the last question" in result.stderr
    assert names(tmp_path) == set()


def test_list_finds_paths_by_a_part_of_their_name() -> None:
    model = MODELS / "cart_pendulum.xml"
    found = loads(run("list", model, "damping", "--json").stdout)
    assert [row["path"] for row in found["parameters"]] == [
        "joint/slide:damping",
        "joint/hinge:damping",
    ]
    # Brackets are a part of paths.
    one = loads(run("list", model, "bob:ipos[1]", "--json").stdout)
    assert [row["path"] for row in one["parameters"]] == ["body/bob:ipos[1]"]

    table = run("list", model, "--kind", "keyframes")
    assert "hanging" in table.stdout
    assert "damping" not in table.stdout

    misused(run("list", model, "xyzzy"), "no path or name contains 'xyzzy'")


def test_validate_says_what_design_lacks(tmp_path: Path) -> None:
    file = tmp_path / "log.toml"
    model = MODELS / "cart_pendulum.xml"
    file.write_text(
        f'model = "{model.as_posix()}"\nrate = 100.0\nnoise = {{ state = 0.1 }}\n'
        '[parameters.c]\ntarget = "joint/hinge:damping"\n',
        encoding="utf-8",
    )
    result = done("validate", file, "--json")
    assert loads(result.stdout)["missing"] == ["horizon", "initial.control"]


def test_validate_prints_the_schema() -> None:
    schema = json.loads(run("validate", "--schema").stdout)
    assert "model" in schema["properties"]
    done("validate", code=2)
