"""The user's MJCF with identified values: all digits are written, and all else stays."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

import mjfim
from mjfim.errors import MjfimError, OutputError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.packing import with_model
from mjfim.experiment.system import System
from mjfim.files import write_json
from mjfim.model.given import same_dynamics
from mjfim.model.paths import KINDS, MODEL_ARRAYS, fields_of
from mjfim.output.archive import summary_with_origin
from mjfim.output.export.mjcf import write_identified
from mjfim.records.estimate import Estimate
from tests.support.cart_pendulum import cart_pendulum
from tests.support.examples import design_file
from tests.support.made_records import bare_estimate
from tests.support.mesh_model import write_mesh_model
from tests.support.numerics import shared_model
from tests.support.paths import MODELS, SHARED_MODELS
from tests.support.shared_models import EXPERIMENTS

PRECISE = 1e-12

# Arrays that determine the motion, and of those the ones that only speed it up, differ where a body
# is "simple", or are compared as matrices.
DYNAMICS = ("body_", "jnt_", "dof_", "qpos", "actuator_", "tendon_", "eq_", "sensor_", "site_pos")
DYNAMICS += ("site_quat", "geom_pos", "geom_quat", "geom_size", "geom_friction", "geom_solref")
DYNAMICS += ("pair_friction", "pair_solref")
NO_DYNAMICS = ("body_bvh", "body_simple", "body_sameframe", "body_margin", "body_inertia")
NO_DYNAMICS += ("body_iquat", "body_invweight0", "dof_simplenum")

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
      <joint name="l" type="slide" range="-2 2"/><site name="u"/>
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

# By path, a value and the words that then state it.
STATED: dict[str, tuple[float, str]] = {
    "body/a:mass": (
        1.7,
        '<inertial pos="0.010 0 0.20" mass="1.7" diaginertia="0.060 0.0660 0.030"/>',
    ),
    'body/b "2":mass': (2.5, 'mass="2.5"'),
    "body/a:pos[1]": (0.3, '<body name="a" pos="0.10 0.3 1.00" euler="0 0 30">'),
    "body/a:ipos[2]": (
        0.25,
        '<inertial pos="0.010 0 0.25" mass="1.50" diaginertia="0.060 0.0660 0.030"/>',
    ),
    "body/a:rot[0]": (0.2, '<body name="a" pos="0.10 0 1.00" quat="0.9'),
    "body/a:inertia[1]": (
        0.07,
        '<inertial pos="0.010 0 0.20" mass="1.50" diaginertia="0.060 0.07 0.030"/>',
    ),
    "body/c:inertia[1]": (0.13, 'diaginertia="0.1371'),
    "body/c:fullinertia[3]": (0.013, 'mass="1" quat="'),
    "body/a:fullinertia[3]": (0.004, 'diaginertia="0.068 0.058 0.030" quat="'),
    "body/a:firstmoment[2]": (0.31, '<inertial pos="0.010 0 0.2066'),
    "body/a:origininertia[1]": (0.13, 'diaginertia="0.0698'),
    "body/a:logcholesky[0]": (0.25, 'mass="1.6487212707001282" diaginertia="'),
    "body/a:gravcomp": (0.4, '<body name="a" pos="0.10 0 1.00" euler="0 0 30" gravcomp="0.4">'),
    "joint/j:damping": (
        0.7,
        '<joint name="j" axis="0 1 0" springref="20" stiffness="2.0" damping="0.7"/>',
    ),
    "joint/k:damping": (
        0.7,
        '<joint name="k" axis="1 0 0" damping="0.7 0.020" frictionloss="0.05"/>',
    ),
    "joint/j:frictionloss": (0.1 + 0.2, 'stiffness="2.0" frictionloss="0.30000000000000004"/>'),
    "joint/j:armature": (0.03, 'stiffness="2.0" armature="0.03"/>'),
    "joint/j:stiffness": (2.2, 'springref="20" stiffness="2.2"/>'),
    "joint/j:damping[2]": (0.07, 'stiffness="2.0" damping="0.3 0.01 0.07"/>'),
    "joint/k:damping[1]": (0.04, 'damping="0.10 0.04"'),
    "joint/j:stiffness[1]": (0.6, 'springref="20" stiffness="2.0 0.6"/>'),
    "joint/j:springref": (np.pi / 8, 'springref="22.5" stiffness="2.0"/>'),
    "actuator/m:gear": (2.1, 'joint="j" gear="2.1"/>'),
    "actuator/m:gainprm": (
        1.3,
        '<general name="m" joint="j" gear="2.0" gainprm="1.3"/>',
    ),
    "actuator/p:kp": (13.0, '<position name="p" joint="k" class="servo" kp="13"/>'),
    "actuator/p:kv": (0.7, '<position name="p" joint="k" class="servo" kv="0.7"/>'),
    "actuator/v:kv": (3.3, '<velocity name="v" joint="l" kv="3.3"/>'),
    "actuator/g:kp": (2.2, 'gainprm="2.2" biastype="affine" biasprm="0 -2.2 -0.10"/>'),
    "actuator/g:biasprm[2]": (-0.2, 'biasprm="0 -2.0 -0.2"/>'),
    "actuator/g:dynprm": (0.06, 'dynprm="0.06" gainprm="2.0"'),
    "geom/h:friction[1]": (0.006, 'pos="0 .1 0" friction="0.7 0.006"/>'),
    "geom/h:solref[0]": (0.03, 'pos="0 .1 0" solref="0.03"/>'),
    "geom/h:size[2]": (0.31, 'size="0.10 0.20 0.31" mass="0.80"'),
    "geom/g:size[0]": (0.06, 'fromto="0 0 0 .3 .1 .5" size="0.06"/>'),
    "geom/g:size[1]": (0.3, 'size="0.05 0.3 0"'),
    "geom/g:pos[2]": (0.3, 'pos="0.15 0.05 0.3"'),
    "geom/h:pos[2]": (0.02, 'mass="0.80" pos="0 .1 0.02"/>'),
    "geom/h:mass": (0.9, 'size="0.10 0.20 0.30" mass="0.9" pos="0 .1 0"/>'),
    "geom/i:density": (400.0, 'size="0.10" density="400" pos="0 0 .10"/>'),
    "site/s:pos[2]": (0.1, '<site name="s" pos=".1 0 0.1"'),
    "site/s:rot[1]": (0.1, '<site name="s" pos=".1 0 0" quat="'),
    "tendon/band:stiffness": (60.0, 'name="band" stiffness="60" springlength="0.20 0.90"'),
    "tendon/band:damping": (2.0, 'springlength="0.20 0.90" damping="2">'),
    "pair/touch:friction[2]": (
        0.007,
        '<pair name="touch" geom1="g" geom2="i" friction="0.50 0.50 0.007"/>',
    ),
    "pair/touch:solref": (0.03, 'friction="0.50 0.50 0.0050" solref="0.03"/>'),
    "tendon/band:frictionloss": (2.0, 'damping="1" frictionloss="2">'),
    "tendon/band:armature": (2.0, 'damping="1" armature="2">'),
    "tendon/band:springlength[1]": (0.8, 'springlength="0.20 0.8" damping="1">'),
    "tendon/link:springlength": (0.2, '<fixed name="link" springlength="0.2">'),
    "tendon/link:springlength[1]": (0.2, '<fixed name="link" springlength="0.1 0.2">'),
    "option:gravity[2]": (-9.7, '<option timestep="0.002" gravity="0 0.00 -9.7"'),
    "option:wind[1]": (0.5, 'wind="1 0.5 0"/>'),
    "option:density": (1.2, 'wind="1 0 0" density="1.2"/>'),
    "option:viscosity": (1e-05, 'viscosity="1e-05"/>'),
}
OUTSIDE = (
    "initial/j:qpos",
    "initial/j:qvel",
    "initial/g:act",
    "output/seen[0]:bias",
    "output/seen[0]:scale",
    "output:delay",
)


def system_of(xml: str | Path, folder: Path, *targets: Any, **tables: Any) -> System:
    """System whose parameters p0, p1 ... have the given targets: paths or tables."""
    given = {
        f"p{i}": {"target": t, "scale": 1.0} if isinstance(t, str) else t
        for i, t in enumerate(targets)
    }
    path = xml
    if isinstance(xml, str):
        path = folder / "model.xml"
        path.write_text(xml, encoding="utf-8")
    tables = {"noise": {"state": 0.1}, **tables}
    return System.resolve(mjfim.Experiment(model=str(path), rate=500.0, parameters=given, **tables))


def compiled(path: Path) -> Any:
    """The compiled model of a file."""
    return mujoco.MjModel.from_xml_path(str(path))


def elements(path: Path) -> list[str]:
    """Start tags and comments of a text, with one blank between words and one kind of quotes."""
    text = path.read_text(encoding="utf-8").replace("'", '"')
    return [" ".join(tag.split()) for tag in re.findall(r"<!--.*?-->|<[^/?!][^>]*>", text)]


def changes(old: Path, new: Path) -> tuple[list[str], list[str]]:
    """Start tags and comments that a text lost, and those that it gained."""
    before, after = elements(old), elements(new)
    lost = [each for each in before if each not in after]
    return lost, [each for each in after if each not in before]


def written(system: System, *theta: float, said: str = "") -> Path:
    """The identified model beside the user's, which was checked, and whose remark holds words."""
    path = system.model_path.parent / "identified.xml"
    remarks = write_identified(path, system, np.array(theta))
    assert (said in " ".join(remarks)) if said else not remarks, remarks
    return path


def assert_is_identified_model(path: Path, system: System, theta: Any) -> None:
    """Assert that the file is the identified model, to 1e-12 of each array's largest number."""
    found = compiled(path)
    wanted = system.model_at(np.asarray(theta, float), at_keyframe=False)
    for name in dir(found):
        if not name.startswith(DYNAMICS) or name.startswith(NO_DYNAMICS):
            continue
        a, b = np.asarray(getattr(found, name)), np.asarray(getattr(wanted, name))
        assert a.shape == b.shape, name
        size = PRECISE * np.abs(b).max(initial=0.0)
        assert_allclose(a, b, rtol=PRECISE, atol=size, err_msg=name)
    for name in (*MODEL_ARRAYS["option"], "timestep"):
        a, b = getattr(found.opt, name), getattr(wanted.opt, name)
        assert_allclose(a, b, rtol=1e-15, err_msg=name)
    mine, theirs = inertias(found), inertias(wanted)
    sizes = PRECISE * np.trace(theirs, axis1=1, axis2=2)[:, None, None]
    assert (np.abs(mine - theirs) <= sizes).all()


def inertias(model: Any) -> Any:
    """(nbody, 3, 3) inertias in the axes of the bodies."""
    R = Rotation.from_quat(model.body_iquat, scalar_first=True).as_matrix()
    return np.einsum("bij,bj,bkj->bik", R, model.body_inertia, R)


@pytest.mark.parametrize("path", STATED)
def test_one_value_changes_one_element(path: str, tmp_path: Path) -> None:
    value, words = STATED[path]
    target: Any = {"target": path, "guess": 1.0, "scale": 1.0}
    system = system_of(RICH, tmp_path, target if path.endswith(("mass", "density")) else path)
    new = written(system, value)
    lost, gained = changes(tmp_path / "model.xml", new)
    assert len(gained) == 1 and words in gained[0], gained
    assert len(lost) == (0 if path.startswith("body/b ") else 1)
    assert_is_identified_model(new, system, [value])


def test_every_field_is_tested() -> None:
    tried = {
        (p.split("/")[0].split(":")[0], re.split(r"[:\[]", p.rsplit(":", 1)[1])[0])
        for p in (*STATED, *OUTSIDE)
    }
    # Control laws need tables of their own: tests/identification/test_control_laws.py.
    kinds = [kind for kind in KINDS if kind != "controller"]
    assert tried == {(kind, field) for kind in kinds for field in fields_of(kind)}


def test_parameters_outside_the_model_are_a_comment(tmp_path: Path) -> None:
    system = system_of(RICH, tmp_path, *OUTSIDE, noise={"seen": 0.1, "qpos:j": 0.1})
    said = "<!-- not part of an MJCF: output/seen[0]:bias = 0.01, output/seen[0]:scale = 0.01, "
    new = written(system, *np.full(len(OUTSIDE), 0.01))
    assert changes(tmp_path / "model.xml", new) == ([], [f"{said}output:delay = 0.01 s -->"])

    # Errors of zero need no comment.
    new = written(system, *np.zeros(len(OUTSIDE)))
    assert changes(tmp_path / "model.xml", new) == ([], [])


# Without masses of geoms, which the compiled model does not keep, and inertias, of which a body
# takes one parametrisation.
UNCHANGED = [
    path
    for path in STATED
    if not path.startswith(("geom/h:mass", "geom/i:density"))
    and not re.match(r"body/[ac]:(?!pos)", path)
    and path not in ("actuator/g:biasprm[2]", "tendon/link:springlength[1]")
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
def test_without_a_change_every_number_keeps_its_spelling(
    more: tuple[str, ...], tmp_path: Path
) -> None:
    paths = [*(p for p in UNCHANGED if p != 'body/b "2":mass'), *more]
    system = system_of(RICH, tmp_path, *paths)
    same = written(system, *system.parameters.guess)
    assert changes(tmp_path / "model.xml", same) == ([], [])

    # A written file has the identified values; identified again, it does not change.
    new = written(system, *(system.parameters.guess * 1.0001 + 1e-7 / 3))
    again = system_of(new, tmp_path, *(spec for spec in paths if ":rot" not in spec))
    assert write_identified(tmp_path / "again.xml", again, again.parameters.guess) == []
    assert (tmp_path / "again.xml").read_bytes() == new.read_bytes()


@pytest.mark.parametrize("ending", ["\n", "\r\n"])
def test_texts_of_other_systems(ending: str, tmp_path: Path) -> None:
    """Comments around the model stay, and a new element is on a line of its own."""
    text = "\ufeff" + RICH.replace("?>\n", "?>\n<!DOCTYPE mujoco>\n", 1).replace("\n", ending)
    source = tmp_path / "arm.xml"
    source.write_bytes(text.encode() + b"<!-- the end -->")
    new = written(system_of(source, tmp_path, 'body/b "2":mass'), 2.0)
    text = new.read_text(encoding="utf-8")
    assert text.startswith('<?xml version="1.0" encoding="utf-8"?>\n<!-- größer als ASCII')
    assert text.endswith("</mujoco>\n<!-- the end -->\n")
    assert re.search(r'<body name="b[^>]*>(\s+)<inertial [^>]*/>\1<joint', text)
    lost, gained = changes(source, new)
    assert (lost, len(gained)) == ([], 1)


@pytest.mark.parametrize(("attribute", "said"), [("armature", ""), ("margin", "jnt_margin")])
def test_functions_of_the_spec(attribute: str, said: str, tmp_path: Path) -> None:
    """A text states the numbers that a function changes; MuJoCo prints other changes."""

    def function(spec: Any, value: float) -> None:
        setattr(spec.joint("j"), attribute, value)

    system = system_of(RICH, tmp_path, {"function": function, "guess": 0.1, "scale": 1.0})
    found = compiled(written(system, 0.25, said=said))
    assert same_dynamics(found, system.model_at(np.array([0.25])))


MESH = "v 0 0 0\nv 0.2 0 0\nv 0 0.3 0\nv 0 0 0.4\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.mark.parametrize(
    ("compiler", "file", "stated"),
    [
        ("", "t.obj", '<mesh name="t" file="../model/t.obj"/>'),
        (
            "<compiler autolimits='true'/>",
            "sub/t.obj",
            '<mesh name="t" file="../model/sub/t.obj"/>',
        ),
        ("<compiler meshdir='sub/'/>", "t.obj", '<compiler meshdir="../model/sub"/>'),
        ("<compiler assetdir='sub'/>", "./t.obj", '<compiler assetdir="../model/sub"/>'),
        (
            '<compiler strippath="true"/>',
            "lost/t.obj",
            '<compiler strippath="true" assetdir="../model"/>',
        ),
    ],
)
def test_meshes_are_found_from_another_folder(
    compiler: str, file: str, stated: str, tmp_path: Path
) -> None:
    for folder in ("model", "model/sub"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "t.obj").write_text(MESH, encoding="utf-8")
    assets = f'<asset><mesh name="t" file="{file}"/></asset>'
    xml = RICH.replace("  <default>\n", f"  {compiler}\n  {assets}\n  <default>\n", 1)
    sphere = 'type="sphere" size="0.10" density="300"'
    xml = xml.replace(sphere, 'type="mesh" mesh="t" density="300"')
    system = system_of(xml, tmp_path / "model", "geom/i:pos[1]")
    theta = system.parameters.guess + 0.01
    for folder in ("model", "out"):
        path = tmp_path / folder / "identified.xml"
        assert write_identified(path, system, theta) == []
        _, gained = changes(tmp_path / "model" / "model.xml", path)
        assert (stated in gained) == (folder == "out"), gained
        assert_is_identified_model(path, system, theta)


# Elements inside frames, a copied one and an attached one.
FIRST, LAST = RICH.index('    <body name="c" '), RICH.index("  </worldbody>")
FRAMES = (
    '<frame pos="1 2 3" quat="0.6 0.8 0 0"><frame quat="0.8 0 0.6 0">'
    f"{RICH[FIRST:LAST]}</frame></frame>"
)
FRAMED = (RICH[FIRST:LAST], FRAMES)
REPLICA = """<replicate count="2" offset="1 0 0">
  <body name="r" pos="2 2 0"><joint name="rj"/><geom size=".1"/></body>
</replicate>
"""
TURNED = '<frame euler="0 0 9"><body name="e"><joint/><geom size=".1"/></body></frame>'
ATTACHED = '<attach model="leg" body="d" prefix="x_"/>'
LEG = """<mujoco model="leg">
  <worldbody><body name="d"><joint name="dj"/><geom size=".1"/></body></worldbody>
</mujoco>
"""
BOTH = [{"path": "joint/j:damping"}, {"path": "joint/k:damping", "scale": 2.0, "offset": 0.25}]

# (old, new) text, path, value, and words that state the value; "" where MuJoCo prints the model:
# numbers that the compiler would derive, and those that the text cannot express.
DERIVED: dict[str, tuple[tuple[str, str], tuple[Any, float], str]] = {
    "scale and offset": (("", ""), (BOTH, 0.125), 'damping="0.5 0.020"'),
    "place in frames": (FRAMED, ("body/c:pos[0]", 0.3), '<body name="c" pos="'),
    "rotation in frames": (FRAMED, ("body/c:rot[1]", 0.3), '<body name="c" pos="'),
    "site in frames": (FRAMED, ("site/u:pos[2]", 0.3), '<site name="u" pos="0 0 0.3"'),
    "replica": ((RICH[LAST:], REPLICA + RICH[LAST:]), ("joint/rj1:damping", 0.6 + 1e-9), ""),
    "turned frame": ((RICH[LAST:], TURNED + RICH[LAST:]), ("body/e:pos[0]", 0.6 + 1e-9), ""),
    "attached": (
        (
            RICH[LAST:],
            f'{ATTACHED}</worldbody><asset><model name="leg" file="leg.xml"/></asset><worldbody>'
            f"{RICH[LAST:]}",
        ),
        ("joint/x_dj:damping", 0.6 + 1e-9),
        "",
    ),
    "damping ratio": (
        ('kp="12.0" kv="0.60"', 'kp="12.0" dampratio="1"'),
        ('body/b "2":mass', 2.0),
        '<position name="p" joint="k" class="servo" kv="',
    ),
    "damping ratio of the element": (
        ('class="servo"/>', 'dampratio="1.0" kp="7"/>'),
        ("actuator/p:kp", 9.0),
        '<position name="p" joint="k" kp="9" kv="',
    ),
    "spring by time constant": (
        ('stiffness="2.0"', 'springdamper=".3 1"'),
        ("body/a:mass", 2.0),
        'springref="20" damping="',
    ),
    "rest length": (
        (' springlength="0.20 0.90"', ""),
        ("site/t:pos[2]", 0.4),
        '<spatial name="band" stiffness="50" damping="1" springlength="',
    ),
    "inertia of geoms": (
        ("<default>\n", '<compiler inertiafromgeom="true"/><default>\n'),
        ("body/a:mass", 2.0),
        '<compiler inertiafromgeom="auto"/>',
    ),
    "total mass": (
        ("<default>\n", '<compiler settotalmass="7"/><default>\n'),
        ("body/a:mass", 2.0),
        "",
    ),
    "no option": (
        (RICH[RICH.index("  <option") : RICH.index("  <default>")], ""),
        ("option:gravity[0]", 0.1),
        '<option gravity="0.1 0 -9.81"/>',
    ),
}

# Actuators, a path of each, and what states its value: an attribute of its own, or <general>.
for element, field, stated in (
    ('position kp="3" kv="0.2" timeconst="0.1"', "dynprm", 'timeconst="0.7"'),
    ('position kp="3" inheritrange="1"', "gainprm", '<general name="x" joint="l" ctrlrange="-2 2"'),
    ('dcmotor input="none" resistance="1" lugre="9 1 0.1 0.2 0.3"', "biasprm[4]", "<dcmotor"),
    ('intvelocity kp="3" actrange="-1 1"', "kp", '<intvelocity name="x" joint="l" kp="0.7"'),
    ('velocity kv="3"', "kv", 'kv="0.7"'),
    ('damper kv="3" ctrlrange="0 1"', "gainprm[2]", "<damper"),
    ('muscle force="5" lengthrange="0 1" ctrlrange="0 1"', "gainprm[3]", 'gaintype="muscle"'),
    ('cylinder area="2" timeconst="0.3"', "gainprm", 'dyntype="filter"'),
    ('pid kp="3" kv="1" ki="0.1"', "biasprm[2]", "<general"),
):
    tag, _, attributes = element.partition(" ")
    number = -0.7 if tag in ("damper", "pid") else 0.7
    added = f'<{tag} name="x" joint="l" {attributes}/></actuator>'
    DERIVED[element] = (("</actuator>", added), (f"actuator/x:{field}", number), stated)


@pytest.mark.parametrize("case", DERIVED)
def test_numbers_that_are_not_in_the_text_are_stated_or_printed(case: str, tmp_path: Path) -> None:
    """The print has all digits of the elements that have names."""
    (old, new), (path, value), words = DERIVED[case]
    assert old in RICH
    target: dict[str, Any] = {"target": path} if isinstance(path, str) else {"targets": path}
    (tmp_path / "leg.xml").write_text(LEG, encoding="utf-8")
    changed = RICH.replace(old, new, 1)
    system = system_of(changed, tmp_path, {**target, "guess": value, "scale": 1.0})
    file = written(system, value, said="" if words else "printed by MuJoCo, without comments")
    if words:
        assert words in " ".join(changes(tmp_path / "model.xml", file)[1])
        assert_is_identified_model(file, system, [value])
    else:
        found, wanted = compiled(file), system.model_at(np.array([value]))
        for name in ("dof_damping", "body_pos", "body_mass", "actuator_gainprm"):
            assert_allclose(getattr(found, name), getattr(wanted, name), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("turned", ["", ' euler="10 20 30"', ' quat="0.6 0.8 0 0"'])
def test_axes_that_a_sensor_reads_are_those_of_the_model(turned: str, tmp_path: Path) -> None:
    """`objtype="body"` reads the principal axes, whose order the matrix does not determine."""
    xml = RICH.replace('mass="1.50"', f'mass="1.50"{turned}')
    system = system_of(xml, tmp_path, "body/a:fullinertia[3]")
    found = compiled(written(system, 0.004))
    wanted = system.model_at(np.array([0.004]))
    assert_allclose(found.body_iquat, wanted.body_iquat, rtol=0, atol=1e-15)
    assert_allclose(found.body_inertia, wanted.body_inertia, rtol=1e-14)


def test_a_negative_mass_is_named_and_a_floor_of_the_experiment_is_left_out(tmp_path: Path) -> None:
    """Nothing is written where a value is impossible; the floor is no part of the model."""
    floor = System.resolve(cart_pendulum(limits={"clearance": 0.01, "floor": -3.0}))
    path, theta = tmp_path / "deep" / "identified.xml", [2.3456789, 1.2345678, 0.7654321]
    assert write_identified(path, floor, np.array(theta)) == []
    assert_is_identified_model(path, System.resolve(cart_pendulum()), theta)

    before = path.read_bytes()
    with pytest.raises(MjfimError, match="mass"):
        write_identified(path, floor, np.array([-1.0, 1.0, 1.0]))
    assert path.read_bytes() == before
    assert [each.name for each in path.parent.iterdir()] == ["identified.xml"]


@pytest.mark.parametrize(
    "name", [*sorted(path.stem for path in MODELS.glob("*.toml")), *EXPERIMENTS]
)
@pytest.mark.slow
def test_models_of_this_and_other_projects(name: str, tmp_path: Path) -> None:
    if name in EXPERIMENTS:
        shared_model(EXPERIMENTS[name]["model"])
        experiment = mjfim.Experiment(**EXPERIMENTS[name], directory=SHARED_MODELS, source=name)
    else:
        experiment = mjfim.Experiment.from_file(design_file(name, tmp_path))
    system = System.resolve(experiment)
    change = 0.004 * np.random.default_rng(1).uniform(-1.0, 1.0, len(system.parameters))
    theta = system.parameters.guess * (1.0 + change)
    new = tmp_path / "identified.xml"
    assert write_identified(new, system, theta) == []
    assert_is_identified_model(new, system, theta)


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
    body = '<body><joint armature="{!r}"/><geom size="0.1"/></body>'
    first, second = (
        mujoco.MjModel.from_xml_string(
            f"<mujoco><worldbody>{''.join(map(body.format, armatures))}</worldbody></mujoco>"
        )
        for armatures in (one, other)
    )

    # The inverse inertias at the reference position follow from the armatures.
    first.dof_invweight0[:] = second.dof_invweight0
    first.dof_M0[:] = second.dof_M0
    assert same_dynamics(first, second) == same


def test_a_model_in_memory_is_written_with_the_files_that_it_needs(tmp_path: Path) -> None:
    """A spec with meshes, one of which is attached from a folder that it does not know any more."""
    spec = mujoco.MjSpec.from_file(str(write_mesh_model(tmp_path / "robot")))
    stated = mjfim.Experiment(
        model=spec,
        directory=tmp_path / "nowhere",
        rate=50.0,
        parameters={"mass": "body/tool:mass"},
        noise={"angle": 0.01},
    )
    system, file = System.resolve(stated), tmp_path / "out" / "identified.xml"
    assert write_identified(file, system, np.array([1.5])) == []
    assert same_dynamics(compiled(file), system.model_at(np.array([1.5])))
    assert [each.name for each in file.parent.iterdir()] == [file.name]


# ---- models of an estimate

MESH_ARM = """<mujoco>
  <asset><mesh name="t" file="tetra.obj"/></asset>
  <worldbody>
    <body><joint name="j" damping="0.1"/><geom type="mesh" mesh="t" mass="1"/></body>
  </worldbody>
</mujoco>"""


@pytest.fixture(scope="module")
def identified(tmp_path_factory: pytest.TempPathFactory) -> Estimate:
    """An estimate whose model file exists in the memory only."""
    folder = tmp_path_factory.mktemp("user")
    for file in MODELS.glob("cart_pendulum*"):
        (folder / file.name).write_bytes(file.read_bytes())
    stated = mjfim.Experiment.from_file(folder / "cart_pendulum_guess.toml").replace(horizon=1.0)
    experiment = with_model(stated)
    (folder / experiment.model).unlink()
    recording = mjfim.simulate(experiment, DesignTask.resolve(experiment).initial, seed=0)
    named = replace(recording, name="log --\x07.csv")
    return replace(mjfim.identify(experiment, [named], threads=1), causes=())


def test_an_estimate_gives_its_model(identified: Estimate, tmp_path: Path) -> None:
    mass = float(identified["body/bob:mass"])
    spec = identified.spec
    assert spec.body("bob").mass == pytest.approx(mass, rel=PRECISE)
    spec.body("bob").mass = 7.0  # each call makes a new one
    assert identified.model.body("bob").mass == pytest.approx(mass, rel=PRECISE)

    file = tmp_path / "arm.xml"
    assert identified.save_model(file) == []
    written = compiled(file)
    assert same_dynamics(written, identified.model)
    head = file.read_text(encoding="utf-8").partition("-->")[0]
    assert f"mjfim {mjfim.__version__} and MuJoCo {mujoco.__version__}" in head
    assert "Data: log - - .csv (101 rows)" in head
    for each in identified.each():
        assert f"{each.name} {' '.join(each.targets)} = {each}, σ {each.std:.3g}" in head
    assert f"Verdict: {identified.verdict.level}." in head


def test_meshes_of_the_memory_are_written_beside_the_model(tmp_path: Path) -> None:
    (tmp_path / "tetra.obj").write_text(MESH)
    (tmp_path / "arm.xml").write_text(MESH_ARM)
    stated = mjfim.Experiment(
        model="arm.xml",
        directory=tmp_path,
        rate=100.0,
        parameters={"d": "joint/j:damping"},
        noise={"qpos:j": 1e-3},
    )
    experiment = with_model(stated)
    for file in tmp_path.iterdir():
        file.unlink()
    estimate = bare_estimate(("d",), np.array([0.3]), np.array([0.1]), experiment=experiment)
    spec = estimate.spec
    assert [*spec.assets] == ["tetra.obj"]
    assert spec.compile().dof_damping[0] == 0.3

    new = tmp_path / "new"
    assert estimate.save_model(new / "first.xml") == estimate.save_model(new / "second.xml") == []
    names = {file.name for file in new.glob("[!.]*")}
    assert names == {"first.xml", "first_tetra.obj", "second.xml", "second_tetra.obj"}
    assert compiled(new / "second.xml").dof_damping[0] == 0.3
    (new / "third_tetra.obj").write_text("mine")
    with pytest.raises(OutputError, match="third_tetra"):
        estimate.save_model(new / "third.xml")


def test_files_of_a_user_are_not_replaced(identified: Estimate, tmp_path: Path) -> None:
    file = tmp_path / "arm.xml"
    file.write_text("mine")
    with pytest.raises(OutputError, match="not listed in"):
        identified.save_model(file)
    identified.save_model(file, force=True)
    assert file.read_text(encoding="utf-8").startswith("<mujoco")
    identified.save_model(file)  # what mjfim wrote is replaced
    for wrong in (tmp_path / "arm.urdf", tmp_path, 3, None):
        with pytest.raises(OutputError, match="save_model writes an MJCF"):
            identified.save_model(wrong)  # type: ignore[arg-type]


def test_an_estimate_of_a_folder_finds_its_experiment(identified: Estimate, tmp_path: Path) -> None:
    identified.save(tmp_path)
    with pytest.raises(MjfimError, match="does not know its experiment"):
        mjfim.Estimate.load(tmp_path).spec  # noqa: B018 - a property

    stated = cart_pendulum()
    system = System.resolve(stated)
    write_json(tmp_path / "estimate.json", summary_with_origin(identified, system, tmp_path))
    found = mjfim.Estimate.load(tmp_path / "estimate.npz")
    assert same_dynamics(found.model, identified.model)
    other = replace(found, parameters=("a", "b", "c"))
    with pytest.raises(MjfimError, match="has the parameters"):
        other.spec  # noqa: B018 - a property
