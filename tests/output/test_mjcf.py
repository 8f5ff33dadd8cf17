"""The user's MJCF with identified values: all digits are written and nothing else changes."""

from __future__ import annotations

import difflib
import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mjfim
from mjfim.errors import ModelError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System
from mjfim.model.paths import KINDS, fields_of
from mjfim.output.mjcf.actuators import SHORTCUTS
from mjfim.output.mjcf.document import MjcfDocument
from mjfim.output.mjcf.write import COMPARED, NOT_DYNAMICS, same_dynamics, write_identified
from mjfim.output.mjcf.xml_edit import XmlText
from tests.support.examples import design_file
from tests.support.numerics import make_task, shared_model
from tests.support.paths import MODELS, SHARED_MODELS
from tests.support.shared_models import EXPERIMENTS

PRECISE = 1e-12

# Everything that a path can name, stated by the element and inherited, with irregular formatting.
RICH = """<?xml version="1.0"?>
<!-- größer als ASCII: 2 m² — <joint name="j" damping="99"/> stays a comment -->
<mujoco model='rich'>
  <option   timestep="0.002" gravity="0 0.00 -9.810"
            wind="1 0 0"/>   <!-- two lines -->
  <default>
    <joint damping="0.30 0.010" armature="0.02"/>
    <geom contype="0" conaffinity="0" friction="0.70 0.0050 0.00010"/>
    <default class="servo"><position kp="12.0" kv="0.60"/></default>
  </default>
  <worldbody>
    <!-- <body name="a"><inertial pos="0 0 0" mass="5"/></body> -->
    <body name="a" pos="0.10 0 1.00" euler="0 0 30">
      <inertial pos="0.010 0 0.20" mass="1.50" diaginertia="0.060 0.0660 0.030"/>
      <joint name="j" axis="0 1 0" springref="20" stiffness="2.0"/>
      <geom name="g" type="capsule" fromto="0 0 0 .3 .1 .5" size="0.050"/>
      <site name="s" pos=".1 0 0"
            zaxis="1 0 0"/>
      <body name="b &quot;2&quot;" pos="0 0 .5">
        <joint name='k' axis="1 0 0" damping="0.10 0.020" frictionloss="0.05"/>
        <geom name="h" type="box" size="0.10 0.20 0.30" mass="0.80" pos="0 .1 0"/>
        <geom name="i" type="sphere" size="0.10" density="300" pos="0 0 .10"/>
        <site name="t" pos="0 0 .30"/>
      </body>
    </body>
    <body name="c" pos="1 0 0">
      <inertial pos="0 0 0" mass="1" fullinertia="0.10 0.120 0.11 0.010 0.02 0.01"/>
      <joint name="l" type="slide"/><site name="u"/>
    </body>
  </worldbody>
  <tendon>
    <spatial name="band" stiffness="50" springlength="0.20 0.90" damping="1">
      <site site="t"/><site site="u"/>
    </spatial>
    <fixed name="link" springlength="0.1">
      <joint joint="j" coef="1"/><joint joint="k" coef="-1"/>
    </fixed>
  </tendon>
  <actuator>
    <motor name="m" joint="j" gear="2.0"/>
    <position name="p" joint="k" class="servo"/>
    <velocity name="v" joint="l" kv="3.0"/>
    <general name="g" joint="l" dyntype="filter"
      dynprm="0.050" gainprm="2.0" biastype="affine" biasprm="0 -2.0 -0.10"/>
  </actuator>
  <contact>
    <pair name="touch" geom1="g" geom2="i"   friction="0.50 0.50 0.0050"/>
  </contact>
  <sensor><framepos objtype="site" objname="s" name="seen" noise=".01"/></sensor>
</mujoco>
"""

# By path, a value and a part of the line that then states it.
STATED: dict[str, tuple[float, str]] = {
    "body/a:mass": (
        1.7,
        '      <inertial pos="0.010 0 0.20" mass="1.7" diaginertia="0.060 0.0660 0.030"/>',
    ),
    'body/b "2":mass': (2.5, ' mass="2.5" '),
    "body/a:pos[1]": (0.3, '    <body name="a" pos="0.10 0.3 1.00" euler="0 0 30">'),
    "body/a:ipos[2]": (
        0.25,
        '      <inertial pos="0.010 0 0.25" mass="1.50" diaginertia="0.060 0.0660 0.030"/>',
    ),
    "body/a:rot[0]": (0.2, '    <body name="a" pos="0.10 0 1.00" quat="0.9'),
    "body/a:inertia[1]": (
        0.07,
        '      <inertial pos="0.010 0 0.20" mass="1.50" diaginertia="0.060 0.07 0.030"/>',
    ),
    "body/c:inertia[1]": (0.13, '      <inertial pos="0 0 0" mass="1" diaginertia="0.1371'),
    "body/c:fullinertia[3]": (0.013, '1" fullinertia="0.10 0.120 0.11 0.013'),
    "body/a:fullinertia[3]": (
        0.004,
        '      <inertial pos="0.010 0 0.20" mass="1.50" fullinertia="0.06',
    ),
    "body/a:firstmoment[2]": (0.31, '      <inertial pos="0.010 0 0.2066'),
    "body/a:origininertia[1]": (
        0.13,
        '      <inertial pos="0.010 0 0.20" mass="1.50" diaginertia="0.060 0.0698',
    ),
    "body/a:logcholesky[0]": (
        0.25,
        '      <inertial pos="0.010 0 0.20" mass="1.6487212707001282" diaginertia="',
    ),
    "body/a:gravcomp": (0.4, '    <body name="a" pos="0.10 0 1.00" euler="0 0 30" gravcomp="0.4">'),
    "joint/j:damping": (
        0.7,
        '      <joint name="j" axis="0 1 0" springref="20" stiffness="2.0" damping="0.7"/>',
    ),
    "joint/k:damping": (
        0.7,
        """<joint name='k' axis="1 0 0" damping="0.7 0.020" frictionloss="0.05"/>""",
    ),
    "joint/j:frictionloss": (0.1 + 0.2, 'stiffness="2.0" frictionloss="0.30000000000000004"/>'),
    "joint/j:armature": (0.03, 'stiffness="2.0" armature="0.03"/>'),
    "joint/j:stiffness": (2.2, 'springref="20" stiffness="2.2"/>'),
    "joint/j:damping[2]": (0.07, 'stiffness="2.0" damping="0.3 0.01 0.07"/>'),
    "joint/k:damping[1]": (0.04, ' damping="0.10 0.04" '),
    "joint/j:stiffness[1]": (0.6, 'springref="20" stiffness="2.0 0.6"/>'),
    "joint/j:springref": (np.pi / 8, 'springref="22.5" stiffness="2.0"/>'),
    "actuator/m:gear": (2.1, 'joint="j" gear="2.1"/>'),
    "actuator/m:gainprm": (1.3, '    <general name="m" joint="j" gear="2.0" gainprm="1.3"/>'),
    "actuator/p:kp": (13.0, '    <position name="p" joint="k" class="servo" kp="13.0"/>'),
    "actuator/p:kv": (0.7, '    <position name="p" joint="k" class="servo" kv="0.7"/>'),
    "actuator/v:kv": (3.3, '    <velocity name="v" joint="l" kv="3.3"/>'),
    "actuator/g:kp": (2.2, 'gainprm="2.2" biastype="affine" biasprm="0 -2.2 -0.10"/>'),
    "actuator/g:biasprm[2]": (-0.2, 'biasprm="0 -2.0 -0.2"/>'),
    "actuator/g:dynprm": (0.06, 'dynprm="0.06" gainprm="2.0"'),
    "geom/h:friction[1]": (0.006, 'pos="0 .1 0" friction="0.7 0.006"/>'),
    "geom/h:solref[0]": (0.03, 'pos="0 .1 0" solref="0.03"/>'),
    "geom/h:size[2]": (0.31, 'size="0.10 0.20 0.31" mass="0.80"'),
    "geom/g:size[0]": (0.06, 'fromto="0 0 0 .3 .1 .5" size="0.06"/>'),
    "geom/g:size[1]": (0.3, ' size="0.050"/>'),
    "geom/g:pos[2]": (0.3, 'fromto="0 0 0.0'),
    "geom/h:pos[2]": (0.02, 'mass="0.80" pos="0 .1 0.02"/>'),
    "geom/h:mass": (0.9, 'size="0.10 0.20 0.30" mass="0.9" pos="0 .1 0"/>'),
    "geom/i:density": (400.0, 'size="0.10" density="400.0" pos="0 0 .10"/>'),
    "site/s:pos[2]": (0.1, '      <site name="s" pos=".1 0 0.1"'),
    "site/s:rot[1]": (0.1, '            quat="'),
    "tendon/band:stiffness": (60.0, 'name="band" stiffness="60.0" springlength="0.20 0.90"'),
    "tendon/band:damping": (2.0, 'springlength="0.20 0.90" damping="2.0">'),
    "pair/touch:friction[2]": (
        0.007,
        '    <pair name="touch" geom1="g" geom2="i"   friction="0.50 0.50 0.007"/>',
    ),
    "pair/touch:solref": (0.03, 'friction="0.50 0.50 0.0050" solref="0.03"/>'),
    "tendon/band:frictionloss": (2.0, 'damping="1" frictionloss="2.0">'),
    "tendon/band:armature": (2.0, 'damping="1" armature="2.0">'),
    "tendon/band:springlength[1]": (0.8, 'springlength="0.20 0.8" damping="1">'),
    "tendon/link:springlength": (0.2, '    <fixed name="link" springlength="0.2">'),
    "tendon/link:springlength[1]": (0.2, '    <fixed name="link" springlength="0.1 0.2">'),
    "option:gravity[2]": (-9.7, '  <option   timestep="0.002" gravity="0 0.00 -9.7"'),
    "option:wind[1]": (0.5, '            wind="1 0.5 0"/>   <!-- two lines -->'),
    "option:density": (1.2, '            wind="1 0 0" density="1.2"/>   <!-- two lines -->'),
    "option:viscosity": (1e-5, 'viscosity="1e-05"/>   <!-- two lines -->'),
}
OUTSIDE = (
    "initial/j:qpos",
    "initial/j:qvel",
    "initial/g:act",
    "output/seen[0]:bias",
    "output/seen[0]:scale",
    "output:delay",
)


def task_of(xml: str | Path, folder: Path, *targets: Any, **tables: Any) -> DesignTask:
    """Experiment whose parameters p0, p1 ... have the given targets: paths or tables."""
    given = {
        f"p{i}": {"target": t, "scale": 1.0} if isinstance(t, str) else t
        for i, t in enumerate(targets)
    }
    return make_task(
        xml,
        folder,
        rate=500.0,
        horizon=0.1,
        parameters=given,
        **{"noise": {"state": 0.1}, **tables},
    )


def lines(old: Path, new: Path) -> tuple[list[str], list[str]]:
    """Removed and added lines."""
    texts = [path.read_text(encoding="utf-8").splitlines() for path in (old, new)]
    found = [line for line in difflib.ndiff(*texts) if line[0] in "-+"]
    return [line[2:] for line in found if line[0] == "-"], [
        line[2:] for line in found if line[0] == "+"
    ]


def assert_is_identified_model(path: Path, task: DesignTask, theta: Any) -> None:
    """Assert that the file is the identified model, to 1e-12 of each array's largest number."""
    found, wanted = (
        mujoco.MjModel.from_xml_path(str(path)),
        task.system.model_at(np.asarray(theta, float), at_keyframe=False),
    )
    for name in dir(found):
        if not name.startswith((*COMPARED, "opt", "eq_", "sensor_")) or name.startswith(
            (*NOT_DYNAMICS, "opt")
        ):
            continue
        a, b = np.asarray(getattr(found, name)), np.asarray(getattr(wanted, name))
        if name == "body_invweight0":  # MuJoCo averages it otherwise where a body is 'simple'
            alike = (found.body_simple > 0) == (wanted.body_simple > 0)
            a, b = a[alike], b[alike]
        assert a.shape == b.shape, name
        np.testing.assert_allclose(
            a, b, rtol=PRECISE, atol=PRECISE * np.abs(b).max(initial=0.0), err_msg=name
        )
    for name in ("gravity", "wind", "density", "viscosity", "timestep"):
        np.testing.assert_allclose(
            getattr(found.opt, name), getattr(wanted.opt, name), rtol=1e-15, err_msg=name
        )
    for b in range(found.nbody):
        R, S = (
            Rotation.from_quat(m.body_iquat[b], scalar_first=True).as_matrix()
            for m in (found, wanted)
        )
        mine, theirs = R * found.body_inertia[b] @ R.T, S * wanted.body_inertia[b] @ S.T
        np.testing.assert_allclose(mine, theirs, rtol=0, atol=PRECISE * np.trace(theirs))


@pytest.mark.parametrize("path", STATED)
def test_one_value_changes_one_element(path: str, tmp_path: Path) -> None:
    value, line = STATED[path]
    target: Any = (
        {"target": path, "guess": 1.0, "scale": 1.0} if path.endswith(("mass", "density")) else path
    )
    task = task_of(RICH, tmp_path, target)
    new = tmp_path / "identified.xml"
    assert write_identified(new, task.system, np.array([value])) is None
    gone, came = lines(tmp_path / "model.xml", new)
    assert any(line in text for text in came), came
    assert (len(gone), len(came)) == ((0, 1) if path.startswith("body/b ") else (1, 1))
    assert_is_identified_model(new, task, [value])


def test_every_field_is_tested() -> None:
    tried = {
        (p.split("/")[0].split(":")[0], re.split(r"[:\[]", p.rsplit(":", 1)[1])[0])
        for p in (*STATED, *OUTSIDE)
    }
    # Control laws need tables of their own: tests/identification/test_control_laws.py.
    kinds = [kind for kind in KINDS if kind != "controller"]
    every = {(kind, field) for kind in kinds for field in fields_of(kind)}
    assert tried == every


def test_parameters_outside_the_model_are_a_comment(tmp_path: Path) -> None:
    task = task_of(RICH, tmp_path, *OUTSIDE, noise={"seen": 0.1, "qpos:j": 0.1})
    path, model = tmp_path / "identified.xml", tmp_path / "model.xml"
    said = "  <!-- not part of an MJCF: output/seen[0]:bias = 0.01, output/seen[0]:scale = 0.01, "
    assert write_identified(path, task.system, np.full(len(OUTSIDE), 0.01)) is None
    gone, came = lines(model, path)
    assert not gone
    assert came == [f"{said}output:delay = 0.01 s -->"]

    # Errors of zero need no comment.
    assert write_identified(path, task.system, np.zeros(len(OUTSIDE))) is None
    assert path.read_bytes() == model.read_bytes()


# Without masses of geoms, which the compiled model does not keep, and inertias, of which a body
# takes one parametrisation.
UNCHANGED = [
    p
    for p in STATED
    if not p.startswith(("geom/h:mass", "geom/i:density")) and not re.match(r"body/[ac]:(?!pos)", p)
]
UNCHANGED = [
    p for p in UNCHANGED if p not in ("actuator/g:biasprm[2]", "tendon/link:springlength[1]")
]


@pytest.mark.parametrize(
    "more",
    [
        ("body/a:mass", "body/a:ipos[2]", "body/a:inertia[1]", "body/c:inertia[0]"),
        ("body/a:fullinertia[3]", "body/c:fullinertia[0]", "body/a:rot[1]", "body/a:gravcomp"),
        ("body/a:firstmoment[2]", "body/a:origininertia[1]", "body/c:origininertia[4]"),
        tuple(f"body/{b}:logcholesky[{i}]" for b in ("a", "c", 'b "2"') for i in range(10)),
    ],
    ids=["moments", "matrix", "barycentric", "logcholesky"],
)
def test_without_a_change_the_file_keeps_every_byte(more: tuple[str, ...], tmp_path: Path) -> None:
    task = task_of(RICH, tmp_path, *(p for p in UNCHANGED if p != 'body/b "2":mass'), *more)
    assert write_identified(tmp_path / "identified.xml", task.system, task.parameters.guess) is None
    assert (tmp_path / "identified.xml").read_bytes() == (tmp_path / "model.xml").read_bytes()


def test_an_identified_file_reproduces_itself(tmp_path: Path) -> None:
    """A written file has the identified values; identified again, it does not change."""
    paths = [p for p in UNCHANGED if p != 'body/b "2":mass'] + [
        "body/a:firstmoment[0]",
        "body/c:fullinertia[3]",
    ]
    first = task_of(RICH, tmp_path, *paths)
    theta = first.parameters.guess * 1.013 + 1e-3 / 3
    assert write_identified(tmp_path / "identified.xml", first.system, theta) is None
    second = task_of(tmp_path / "identified.xml", tmp_path, *paths)
    turned = np.array([":rot" in p for p in paths])
    np.testing.assert_allclose(
        second.parameters.guess[~turned], theta[~turned], rtol=1e-12, atol=1e-13
    )
    assert write_identified(tmp_path / "again.xml", second.system, second.parameters.guess) is None
    assert (tmp_path / "again.xml").read_bytes() == (tmp_path / "identified.xml").read_bytes()


def test_scale_and_offset_reach_every_target(tmp_path: Path) -> None:
    both = {
        "targets": [
            {"path": "joint/j:damping"},
            {"path": "joint/k:damping", "scale": 2.0, "offset": 0.25},
        ],
        "guess": 0.3,
    }
    task = task_of(RICH, tmp_path, both)
    assert write_identified(tmp_path / "identified.xml", task.system, np.array([0.125])) is None
    gone, came = lines(tmp_path / "model.xml", tmp_path / "identified.xml")
    assert len(gone) == 2
    assert ['damping="0.125"' in came[0], 'damping="0.5 0.020"' in came[1]] == [True, True]


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
@pytest.mark.parametrize("head", ["", "\ufeff"], ids=["plain", "byte-order-mark"])
def test_line_ends_and_byte_order_marks_stay(ending: str, head: str, tmp_path: Path) -> None:
    source = tmp_path / "arm.xml"
    text = RICH.replace("\n", ending)
    source.write_bytes((head + text).encode())
    task = task_of(source, tmp_path, "joint/k:frictionloss", 'body/b "2":mass')
    assert write_identified(tmp_path / "identified.xml", task.system, np.array([0.25, 2.0])) is None
    found = (tmp_path / "identified.xml").read_bytes().decode()
    assert found.startswith(head) and found.count(ending) == text.count(ending) + 1
    at = re.search(r'<body name="b[^>]*>(\s+)<inertial [^>]*/>(\s+)<joint', found)
    assert at is not None and at[1] == at[2] == f"{ending}        "
    again = re.sub(
        r"\s+<inertial [^>]*mass=\"2.0\"[^>]*/>", "", found.replace('loss="0.25"', 'loss="0.05"')
    )
    assert again == head + text


def test_empty_elements_without_spaces(tmp_path: Path) -> None:
    """An empty motor is renamed in its only tag, one with an end tag in both tags."""
    xml = re.sub(
        r"<actuator>.*</actuator>",
        '<actuator><motor name="m" joint="j"{}</actuator>',
        RICH,
        flags=re.DOTALL,
    )
    for i, (end, wanted) in enumerate(
        (("/>", ' gainprm="2.0"/>'), ("></motor >", ' gainprm="2.0"></general >'))
    ):
        (tmp_path / str(i)).mkdir()
        task = task_of(xml.replace('"j"{}', f'"j"{end}'), tmp_path / str(i), "actuator/m:gainprm")
        new = tmp_path / str(i) / "identified.xml"
        assert write_identified(new, task.system, np.array([2.0])) is None
        assert f'<actuator><general name="m" joint="j"{wanted}</actuator>' in new.read_text(
            encoding="utf-8"
        )


ENTITIES = '<!DOCTYPE mujoco [<!ENTITY a "0.3"><!ENTITY b "&a;&a;&a;">]>\n'


def test_a_doctype_is_not_followed(tmp_path: Path) -> None:
    with pytest.raises(ModelError, match="DOCTYPE"):
        XmlText((ENTITIES + "<mujoco>&b;</mujoco>").encode())
    with pytest.raises(ModelError, match="not well-formed"):
        XmlText(b"<mujoco a='1' a='2'/>")
    with pytest.raises(ModelError, match="not well-formed"):
        XmlText("<mujoco a='ü'/>".encode("latin-1"))
    with pytest.raises(ModelError, match="<robot>"):
        MjcfDocument(b"<robot/>")
    task = task_of("<!DOCTYPE mujoco>\n" + RICH.split("?>\n", 1)[1], tmp_path, "joint/j:damping")
    said = write_identified(tmp_path / "identified.xml", task.system, np.array([0.7]))
    assert said is not None and "printed by MuJoCo" in said and "DOCTYPE" in said
    assert (
        mujoco.MjModel.from_xml_path(str(tmp_path / "identified.xml")).joint("j").damping[0] == 0.7
    )


# Changes that the text cannot express: change of the model, path, words of the reason.
INEXPRESSIBLE = {
    "frame": (
        ('<body name="c" pos="1 0 0">', '<frame euler="0 0 9"><body name="c">'),
        "body/c:pos[0]",
        "<frame>",
    ),
    "replicate": (
        (
            "</worldbody>",
            '<replicate count="2" offset="1 0 0">'
            '<body name="r" pos="2 2 0"><joint name="rj"/><geom size=".1"/></body>'
            "</replicate></worldbody>",
        ),
        "joint/rj1:damping",
        "<replicate>",
    ),
    "half a muscle": (
        (
            "</actuator>",
            '<muscle name="x" joint="j" force="5" lengthrange="0 1" ctrlrange="0 1"/></actuator>',
        ),
        "actuator/x:gainprm[2]",
        r"<muscle> has no attribute that sets biasprm\[2\]|gainprm\[2\]",
    ),
}


@pytest.mark.parametrize("case", INEXPRESSIBLE)
def test_mujoco_prints_values_that_the_text_cannot_express(case: str, tmp_path: Path) -> None:
    (old, new), path, reason = INEXPRESSIBLE[case]
    xml = RICH.replace(old, new)
    if case == "frame":
        xml = xml.replace("</body>\n  </worldbody>", "</body></frame>\n  </worldbody>")
    task = task_of(xml, tmp_path, {"target": path, "guess": 0.5, "scale": 1.0})
    said = write_identified(tmp_path / "identified.xml", task.system, np.array([0.6]))
    assert said is not None and said.startswith("identified.xml: it is printed by MuJoCo")
    assert re.search(reason, said)
    found, wanted = (
        mujoco.MjModel.from_xml_path(str(tmp_path / "identified.xml")),
        task.system.model_at(np.array([0.6])),
    )
    for name in ("dof_damping", "body_pos", "actuator_gainprm", "body_mass"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(wanted, name), rtol=1e-5, atol=1e-6
        )


def stiffen(spec: Any, value: float) -> None:
    """Function of the MjSpec that is a parameter."""
    spec.joint("j").armature = value


def test_functions_of_the_spec_are_printed_by_mujoco(tmp_path: Path) -> None:
    task = task_of(RICH, tmp_path, {"function": stiffen, "guess": 0.1, "scale": 1.0})
    said = write_identified(tmp_path / "identified.xml", task.system, np.array([0.25]))
    assert said is not None and "parameters.p0 is a Python function" in said
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "identified.xml")).dof_armature[0] == 0.25


def test_included_files_are_found_from_another_folder(tmp_path: Path) -> None:
    """Elements of the file are changed in it; those of an included file in a copy beside it."""
    (tmp_path / "parts").mkdir()
    body = '<body name="d" pos="3 0 0"><joint name="dj"/><geom size=".1"/></body>'
    part = f"<mujocoinclude>{body}</mujocoinclude>"
    (tmp_path / "parts" / "d.xml").write_text(part, encoding="utf-8")
    source = tmp_path / "model.xml"
    source.write_text(
        RICH.replace("  </worldbody>", '<include file="parts/d.xml"/></worldbody>'),
        encoding="utf-8",
    )
    task = task_of(source, tmp_path, "joint/j:damping")
    new = tmp_path / "out" / "deep" / "identified.xml"
    assert write_identified(new, task.system, np.array([0.7])) is None
    gone, came = lines(source, new)
    assert len(gone) == len(came) == 2
    assert '<include file="../../parts/d.xml"/></worldbody>' in came
    assert_is_identified_model(new, task, [0.7])
    inside = task_of(source, tmp_path, "joint/dj:damping")
    said = write_identified(new, inside.system, np.array([0.7]))
    assert said is None
    assert '<include file="identified_d.xml"/></worldbody>' in lines(source, new)[1]
    assert (tmp_path / "parts" / "d.xml").read_text(encoding="utf-8") == part
    assert mujoco.MjModel.from_xml_path(str(new)).joint("dj").damping[0] == 0.7


def test_attached_models(tmp_path: Path) -> None:
    """MuJoCo prints a model of which an attached part changes; other values keep the text."""
    body = '<body name="d"><joint name="dj"/><geom size=".1"/></body>'
    part = f'<mujoco model="leg"><worldbody>{body}</worldbody></mujoco>'
    (tmp_path / "leg.xml").write_text(part, encoding="utf-8")
    xml = RICH.replace(
        "  <worldbody>", '  <asset><model name="leg" file="leg.xml"/></asset>\n  <worldbody>'
    )
    xml = xml.replace("  </worldbody>", '<attach model="leg" body="d" prefix="x_"/></worldbody>')
    inside = task_of(xml, tmp_path, "joint/x_dj:damping")
    said = write_identified(tmp_path / "identified.xml", inside.system, np.array([0.7]))
    assert said is not None
    assert "printed by MuJoCo" in said and "joint 'x_dj' is not in the MJCF file itself" in said
    found = mujoco.MjModel.from_xml_path(str(tmp_path / "identified.xml"))
    assert found.joint("x_dj").damping[0] == 0.7

    # From another folder, the text finds the attached model.
    outside = task_of(xml, tmp_path, "joint/j:damping")
    new = tmp_path / "out" / "identified.xml"
    assert write_identified(new, outside.system, np.array([0.7])) is None
    assert '<model name="leg" file="../leg.xml"/>' in new.read_text(encoding="utf-8")
    assert mujoco.MjModel.from_xml_path(str(new)).joint("j").damping[0] == 0.7


MESH = "v 0 0 0\nv 0.2 0 0\nv 0 0.3 0\nv 0 0 0.4\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.mark.parametrize(
    ("compiler", "line"),
    [
        ("", '  <compiler assetdir="../model"/>'),
        (
            "<compiler autolimits='true'/>",
            """  <compiler autolimits='true' assetdir="../model"/>""",
        ),
        (
            "<compiler meshdir='sub/' texturedir='none'/>",
            "  <compiler meshdir='../model/sub' texturedir='none'/>",
        ),
        ("<compiler assetdir='sub'/>", "  <compiler assetdir='../model/sub'/>"),
    ],
)
def test_only_asset_folders_in_use_change(compiler: str, line: str, tmp_path: Path) -> None:
    for folder in ("model", "model/sub"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "t.obj").write_text(MESH, encoding="utf-8")
    assets = '<asset><mesh name="t" file="t.obj"/></asset>'
    xml = RICH.replace("  <default>\n", f"  {compiler}\n  {assets}\n  <default>\n", 1)
    xml = xml.replace(
        'type="sphere" size="0.10" density="300"', 'type="mesh" mesh="t" density="300"'
    )
    task = task_of(xml, tmp_path / "model", "geom/i:pos[1]")
    beside, away = tmp_path / "model" / "identified.xml", tmp_path / "out" / "identified.xml"
    theta = task.parameters.guess + 0.01
    for path, changed in ((beside, 1), (away, 2 if compiler else 1)):
        assert write_identified(path, task.system, theta) is None
        gone, came = lines(tmp_path / "model" / "model.xml", path)
        assert len(gone) == changed
        assert (line in came) == (path is away)
        assert_is_identified_model(path, task, theta)
    plain = task_of(
        RICH.replace("  <default>\n", f"  {compiler}\n  <default>\n", 1),
        tmp_path / "model",
        "joint/j:damping",
    )
    assert write_identified(away, plain.system, np.array([0.7])) is None
    assert len(lines(tmp_path / "model" / "model.xml", away)[1]) == 1


# Numbers that the compiler would derive: (old, new) text, path, value, object whose number is
# stated.
DERIVED = {
    "damping ratio": (
        ('kp="12.0" kv="0.60"', 'kp="12.0" dampratio="1"'),
        'body/b "2":mass',
        2.0,
        "actuator 'p'",
    ),
    "damping ratio of the element": (
        ('class="servo"/>', 'dampratio="1.0" kp="7"/>'),
        "actuator/p:kp",
        9.0,
        "actuator 'p'",
    ),
    "spring by time constant": (
        ('stiffness="2.0"', 'springdamper=".3 1"'),
        "body/a:mass",
        2.0,
        "joint 'j'",
    ),
    "rest length": ((' springlength="0.20 0.90"', ""), "site/t:pos[2]", 0.4, "tendon 'band'"),
}


@pytest.mark.parametrize("case", DERIVED)
def test_numbers_that_the_compiler_would_derive_are_stated(case: str, tmp_path: Path) -> None:
    (old, new), path, value, stated = DERIVED[case]
    assert old in RICH
    task = task_of(RICH.replace(old, new), tmp_path, path)
    said = write_identified(tmp_path / "identified.xml", task.system, np.array([value]))
    assert said == (
        "identified.xml: it also states numbers that MuJoCo would otherwise derive from the "
        f"identified values: {stated}"
    )
    assert "größer als ASCII" in (tmp_path / "identified.xml").read_text(encoding="utf-8")
    assert_is_identified_model(tmp_path / "identified.xml", task, [value])


def test_an_option_is_made_where_there_is_none(tmp_path: Path) -> None:
    xml = re.sub(r"\n +<option[^>]*/>[^\n]*", "", RICH)
    assert "<option" not in xml
    task = task_of(xml, tmp_path, "option:gravity[0]", "option:density")
    assert write_identified(tmp_path / "identified.xml", task.system, np.array([0.1, 1.2])) is None
    gone, came = lines(tmp_path / "model.xml", tmp_path / "identified.xml")
    assert (gone, came) == ([], ['  <option gravity="0.1 0.0 -9.81" density="1.2"/>'])
    assert_is_identified_model(tmp_path / "identified.xml", task, [0.1, 1.2])


@pytest.mark.parametrize("turned", ["", ' euler="10 20 30"', ' quat="0.6 0.8 0 0"'])
def test_axes_that_a_sensor_reads_are_those_of_the_model(turned: str, tmp_path: Path) -> None:
    """`objtype="body"` reads the principal axes, whose order the matrix does not determine."""
    watch = '<framequat objtype="body" objname="a" name="axes" noise=".01"/></sensor>'
    xml = RICH.replace("</sensor>", watch).replace('mass="1.50"', f'mass="1.50"{turned}')
    task = task_of(xml, tmp_path, "body/a:fullinertia[3]")
    assert write_identified(tmp_path / "identified.xml", task.system, np.array([0.004])) is None
    found, wanted = (
        mujoco.MjModel.from_xml_path(str(tmp_path / "identified.xml")),
        task.system.model_at(np.array([0.004])),
    )
    np.testing.assert_allclose(found.body_iquat, wanted.body_iquat, rtol=0, atol=1e-15)
    np.testing.assert_allclose(found.body_inertia, wanted.body_inertia, rtol=1e-14)


@pytest.mark.parametrize("element", SHORTCUTS)
def test_shortcuts_set_the_entries_that_mujoco_sets(element: str) -> None:
    """Compare each attribute with the arrays that MuJoCo compiles from it."""
    needs = {
        "intvelocity": 'actrange="-1 1"',
        "damper": 'ctrlrange="0 1"',
        "muscle": 'lengthrange="0 1"',
    }.get(element, "")
    joint = 'body="b" ctrlrange="0 1"' if element == "adhesion" else 'joint="j"'
    for attribute, numbers in SHORTCUTS[element].items():
        values = [1.7 if attribute == "lmax" else 0.7 + 0.2 * i for i in range(len(numbers))]
        if element == "dcmotor":
            needs = 'input="none"' + ' resistance="1"' * (attribute != "resistance")
        written = f'<{element} {joint} {needs} {attribute}="{" ".join(map(str, values))}"/>'
        model = mujoco.MjModel.from_xml_string(
            '<mujoco><worldbody><body name="b"><joint name="j"/><geom size="1"/></body></worldbody>'
            f"<actuator>{written}</actuator></mujoco>"
        )
        for value, number in zip(values, numbers, strict=True):
            for array, column, factor in number:
                assert getattr(model, f"actuator_{array}")[0, column] == factor * value, (
                    attribute,
                    array,
                    column,
                )


@pytest.mark.parametrize("name", sorted(path.stem for path in MODELS.glob("*.toml")))
@pytest.mark.slow
def test_the_models_of_this_repository(name: str, tmp_path: Path) -> None:
    task = DesignTask.resolve(mjfim.Experiment.from_file(design_file(name, tmp_path)))
    theta = task.parameters.guess * (
        1.0 + 0.004 * np.random.default_rng(1).uniform(-1.0, 1.0, len(task.parameters))
    )
    said = write_identified(tmp_path / "identified.xml", task.system, theta)
    assert said is None, said
    assert_is_identified_model(tmp_path / "identified.xml", task, theta)
    gone, came = lines(task.system.model_path, tmp_path / "identified.xml")
    assert 0 < len(gone) == len(came) <= sum(len(p.targets) for p in task.parameters.parameters)
    numbers = re.compile(
        r'"[-+\d. e]*"| (damping|stiffness|armature|quat|euler|timeconst|fullinertia|diaginertia'
        r"|gravcomp)="
    )
    assert [numbers.sub("", text) for text in gone] == [numbers.sub("", text) for text in came]


def test_other_contacts_of_a_body_that_only_slides_are_said(tmp_path: Path) -> None:
    """A body whose centre of mass moves is not 'simple' in the fit, but may be so in the file."""
    experiment = mjfim.Experiment(
        model=str(MODELS / "sliding_block.xml"),
        rate=100.0,
        parameters={"com": {"target": "body/block:ipos[1]", "scale": 0.1, "guess": 0.0}},
        noise={"state": 0.1},
        directory=tmp_path,
        source="block.toml",
    )
    said = write_identified(tmp_path / "identified.xml", System.resolve(experiment), np.zeros(1))
    assert said is not None
    assert "body_invweight0" in said


@pytest.mark.parametrize("name", EXPERIMENTS)
@pytest.mark.slow
def test_models_of_other_projects(name: str, tmp_path: Path) -> None:
    shared_model(EXPERIMENTS[name]["model"])
    task = DesignTask.resolve(
        mjfim.Experiment(**EXPERIMENTS[name], directory=SHARED_MODELS, source=name)
    )
    theta = task.parameters.guess * (
        1.0 + 0.03 * np.random.default_rng(1).uniform(-1.0, 1.0, len(task.parameters))
    )
    said = write_identified(tmp_path / "identified.xml", task.system, theta)
    if name == "so_arm100":  # its servos have damping ratios
        assert said is not None and "it also states" in said and "printed" not in said
    else:
        assert said is None
    assert_is_identified_model(tmp_path / "identified.xml", task, theta)


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        ((4e-13, 4e-13), (4e-13, 8e-13), False),  # a small robot in large units
        ((1.0, 1e-13), (1.0, 0.0), True),  # rounding beside a large number
        ((1e6, 1e-7), (1e6, 0.0), True),
        ((1e6, 1e-5), (1e6, 0.0), False),
    ],
)
def test_what_counts_as_rounding_does_not_depend_on_units(
    one: tuple[float, float], other: tuple[float, float], same: bool
) -> None:
    def model(armatures: tuple[float, float]) -> mujoco.MjModel:
        joints = "".join(
            f'<body><joint armature="{armature!r}"/><geom size="0.1"/></body>'
            for armature in armatures
        )
        return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{joints}</worldbody></mujoco>")

    # The inverse inertias at the reference position follow from the armatures.
    first, second = model(one), model(other)
    first.dof_invweight0[:] = second.dof_invweight0
    first.dof_M0[:] = second.dof_M0
    first.body_invweight0[:] = second.body_invweight0
    assert same_dynamics(first, second) == same
