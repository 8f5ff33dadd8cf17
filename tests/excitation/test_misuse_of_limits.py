"""Hard limits and boundaries that cannot be kept: a message with file and key, exit code 2."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.errors import ExperimentError
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.controls import holding_control
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.output import folders
from tests.support.cli import loads, misused, names, run, write_experiment
from tests.support.numerics import CART_PENDULUM, make_task

MOTOR = (
    '<motor name="force" joint="slide"/>',
    '<motor name="force" joint="slide" ctrlrange="-4 4"/>',
)
SIDE = (
    "</keyframe>",
    '<key name="side" qpos="0 1"/><key name="far" qpos="2.5 3.141592653589793"/></keyframe>',
)
SOLID = ('contype="0" conaffinity="0" mass="0"', 'mass="0"')

# Lines at the end of the file, what the message must hold, and edits of the model, by name.
FAULTS = {
    "start outside": (
        "[limits]\nposition = { hinge = [-1.0, 1.0] }",
        "limits.position.hinge: the initial state is at 3.14159 rad, outside [-1, 1]; "
        "widen the limit … or move the initial state",
    ),
    "start outside the model's range": (
        "",
        "limits.position.slide: the initial state is at 0 m, outside [0.5, 2] … in "
        "the MJCF if it is stated there",
        ('type="slide" axis="1 0 0"', 'type="slide" axis="1 0 0" range="0.5 2"'),
    ),
    "ranges that exclude each other": (
        "[limits]\ncontrol = { force = [5.0, 9.0] }",
        "limits.control.force: [5, 9] and the MJCF's range [-4, 4] exclude each other",
        MOTOR,
    ),
    "start that falls": (
        '[boundary]\nstart = "rest"',
        "boundary.start: no control holds the initial state: joint 'hinge' still "
        "accelerates by 7.59 per s² … an equilibrium",
        ("3.141592653589793", "2.0"),
    ),
    "start that moves": (
        '[boundary]\nstart = "rest"',
        "boundary.start: no control holds the initial state: joint 'slide' moves at 0.5 per s",
        ('qpos="0 3.141592653589793"', 'qpos="0 3.141592653589793" qvel="0.5 0"'),
    ),
    "end that falls": (
        '[boundary]\nend = "rest"\nkeyframe = "side"',
        "boundary.end: no control holds the final state: joint 'hinge' still "
        "accelerates by 6.38 per s²",
        SIDE,
    ),
    "end outside": (
        '[boundary]\nend = "rest"\nkeyframe = "far"\n[limits]\nposition = { slide = [-1.0, 1.0] }',
        "limits.position.slide: the final state is at 2.5 m, outside [-1, 1] … or "
        "move the final state",
        SIDE,
    ),
    "unknown end": (
        '[boundary]\nend = "rest"\nkeyframe = "hangin"',
        "boundary.keyframe: unknown keyframe 'hangin' (did you mean 'hanging'?); valid: hanging",
    ),
    "end of nothing": (
        '[boundary]\nkeyframe = "hanging"',
        'boundary: keyframe needs end = "rest"',
    ),
    "unknown way to end": (
        '[boundary]\nend = "still"',
        "boundary.end: … 'free', 'rest' or 'periodic' … 'still'",
    ),
    "hold outside the control's range": (
        '[boundary]\nstart = "rest"\n[limits]\ncontrol = { force = [0.5, 2.0] }',
        "boundary.start: standing still requires force = … outside limits.control [0.5, 2]",
    ),
    "hold beyond the actuator's force": (
        '[boundary]\nstart = "rest"\n[limits]\nforce = { force = 2.0 }',
        "boundary.start: standing still requires force = -5, outside limits.force [-2, 2]",
        ('type="slide" axis="1 0 0"', 'type="slide" axis="1 0 0" stiffness="10" springref="0.5"'),
    ),
    "start in collision": (
        "[limits]\nclearance = 0.01",
        "limits.clearance: the initial state is in collision: cart - rail are -0. … "
        "have to be 0.01 m apart … limits.ignored",
        SOLID,
    ),
    "start too close": (
        '[limits]\nclearance = 3.0\nignored = [["cart", "world"], ["pendulum", "world"]]',
        "limits.clearance: the initial state is too close: bob - rail are 0.885 m "
        "apart, but have to be 3 m apart",
        SOLID,
        ('<geom name="rod" type', '<geom name="rod" contype="0" conaffinity="0" type'),
    ),
    "nothing that could collide": (
        "[limits]\nclearance = 0.01",
        "limits.clearance: no two geoms can come near each other … contype and conaffinity",
    ),
    "ignored pairs without a clearance": (
        '[limits]\nignored = [["cart", "bob"]]',
        "limits: ignored can only be given together with clearance",
    ),
    "a body and itself": (
        '[limits]\nclearance = 0.01\nignored = [["bob", "bob"]]',
        "limits.ignored: ['bob'] is no pair of bodies",
    ),
    "three bodies": (
        '[limits]\nignored = [["bob", "cart", "world"]]',
        "limits.ignored.0",
    ),
    "unknown body, not even enforced": (
        '[limits]\nclearance = 0.01\nenforce = false\nignored = [["bob", "carts"]]',
        "limits.ignored: unknown body 'carts' (did you mean 'cart'?); valid: bob, "
        "cart, pendulum, world",
        SOLID,
    ),
    "bandwidth above that of the samples": (
        "[limits]\nbandwidth = 60.0",
        "limits.bandwidth: 60 Hz; a control at 100 Hz has 50 Hz at most",
    ),
    "no bandwidth": (
        "[limits]\nbandwidth = 0.0",
        "limits.bandwidth:  … greater than 0",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_reported_with_file_and_key_before_any_optimisation(
    name: str, tmp_path: Path
) -> None:
    lines, said, *edits = FAULTS[name]
    path = write_experiment(tmp_path)
    path.write_text(f"{path.read_text(encoding='utf-8')}\n{lines}\n", encoding="utf-8")
    model = tmp_path / "cart_pendulum.xml"
    text = model.read_text(encoding="utf-8")
    for old, new in edits:
        assert text.count(old) >= 1
        text = text.replace(old, new)
    model.write_text(text, encoding="utf-8")
    result = run("design", path, "-o", tmp_path / "out")
    misused(result, "study.toml: ", *said.split(" … "))
    assert "iteration" not in result.stderr
    assert names(tmp_path) == {"study.toml", "cart_pendulum.xml", "cart_pendulum.csv"}


def test_a_control_that_holds_is_found_where_others_diverge(tmp_path: Path) -> None:
    path = write_experiment(tmp_path)
    model = tmp_path / "cart_pendulum.xml"
    strong = '<general name="force" joint="slide" gainprm="1e306"/>'
    text = model.read_text(encoding="utf-8").replace(MOTOR[0], strong)
    model.write_text(text, encoding="utf-8")

    system = System.resolve(Experiment.from_file(path))
    state = system.plant.initial_state(system.theta)
    hold = holding_control(system, state, np.zeros(1), key="boundary.start", place="the start")
    assert hold.tolist() == pytest.approx([0.0], abs=1e-300)
    with pytest.raises(ExperimentError, match=r"no control holds the start: .* diverges within"):
        holding_control(system, state, np.ones(1), key="boundary.start", place="the start")


def with_control_weight(folder: Path, lines: str) -> Path:
    """An experiment file without weight on its control."""
    path = write_experiment(folder)
    text = path.read_text(encoding="utf-8").replace("control = 1e-3", "control = 0.0")
    path.write_text(f"{text}\n{lines}\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    "lines", ["", "[limits]\ncontrol = { force = [-5.0, 5.0] }\nenforce = false"]
)
def test_a_control_with_neither_weight_nor_hard_range_is_refused(
    lines: str, tmp_path: Path
) -> None:
    path = with_control_weight(tmp_path, lines)
    said = "cost.control: actuator 'force' has neither a weight nor a range"
    misused(
        run("design", path, "-o", tmp_path / "out"),
        "study.toml: ",
        said,
        "limits.control.force = [lower, upper]",
    )


def test_a_hard_range_replaces_the_weight(tmp_path: Path) -> None:
    """It may be stated in the file or in the MJCF."""
    model = tmp_path / "cart_pendulum.xml"
    for lines in ("[limits]\ncontrol = { force = [-5.0, 5.0] }", ""):
        path = with_control_weight(tmp_path, lines)
        assert DesignTask.resolve(Experiment.from_file(path)).control_weight.tolist() == [0.0]
        model.write_text(model.read_text(encoding="utf-8").replace(*MOTOR), encoding="utf-8")


def test_a_start_that_falls_is_refused_at_a_high_rate(tmp_path: Path) -> None:
    """It falls only a little within a sample."""
    task = make_task(
        CART_PENDULUM.format(integrator="RK4").replace('timestep="0.01"', 'timestep="0.0005"'),
        tmp_path,
        rate=2000.0,
        parameters={"m": "body/bob:mass"},
        noise={"state": 0.01},
        initial={"qpos": (0.0, 2.0), "control": {"kind": "sine"}},
        boundary={"start": "rest"},
    )
    message = r"no control holds the initial state: joint 'hinge' still accelerates by \d\.\d+ per"
    with pytest.raises(ExperimentError, match=message):
        design_task(task)


@pytest.mark.slow
def test_limits_that_no_control_can_keep_end_with_exit_code_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pendulum falls faster than its limit allows; the message names the violated limit."""
    hard = "[limits]\nvelocity = { hinge = 0.5 }\ncontrol = { force = [-0.01, 0.01] }"
    path = write_experiment(tmp_path, horizon="0.3", max_iterations=f"4\nseconds = 3.0\n{hard}")
    model = (tmp_path / "cart_pendulum.xml").read_text(encoding="utf-8")
    (tmp_path / "cart_pendulum.xml").write_text(
        model.replace("3.141592653589793", "2.0"), encoding="utf-8"
    )
    # The files are not looked at; to draw the figures takes seconds.
    monkeypatch.setattr(folders, "write_result", lambda *_: ([], list))
    result = run("design", path, "-o", tmp_path / "out", "--json")
    summary = loads(result.stdout)
    found = (result.exit_code, summary["status"], summary["limits"]["satisfied"])
    assert found == (1, "infeasible", False)
    assert "it violates limits (velocity" in result.stderr
    assert "checked, not enforced" not in result.stderr


@pytest.mark.slow
def test_a_jump_at_rest_is_warned_about(tmp_path: Path) -> None:
    path = write_experiment(tmp_path, max_iterations='2\n[boundary]\nstart = "rest"')
    jump = "the control may jump where the design begins or ends at rest"
    assert any(jump in sentence for sentence in mjfim.design(Experiment.from_file(path)).warnings)
    slow = Experiment.from_file(path).replace(limits={"control_rate": 50.0})
    assert not any(jump in sentence for sentence in mjfim.design(slow).warnings)
