"""Geom distances: selection of pairs, distances against MuJoCo and by hand, slopes against
differences.
"""

from __future__ import annotations

from itertools import combinations_with_replacement

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.errors import ExperimentError, SimulationDivergedError
from mjfim.model.clearance import BOX, CAPSULE, GeomDistances, find_geom_pairs
from tests.support.numerics import Array, directional_check

ROCK = " ".join(f"{v:.3f}" for v in np.random.default_rng(5).normal(scale=0.1, size=60))
ASSETS = (
    f'<asset><mesh name="rock" vertex="{ROCK}"/>'
    '<hfield name="hills" nrow="3" ncol="3" size="1 1 .2 .1"/></asset>'
)
KINDS = {
    "sphere": 'type="sphere" size="0.1"',
    "capsule": 'type="capsule" size="0.05 0.2"',
    "ellipsoid": 'type="ellipsoid" size="0.05 0.1 0.2"',
    "cylinder": 'type="cylinder" size="0.1 0.15"',
    "box": 'type="box" size="0.1 0.05 0.2"',
    "mesh": 'type="mesh" mesh="rock"',
}
FLOOR = '<geom name="floor" type="plane" size="1 1 0.1" pos="0.1 0 -0.1" euler="20 -10 0"/>'

# Two arms over a tilted floor, by all kinds of joints and of geoms; some bodies have two geoms.
ARMS = f"""
<mujoco>
  {ASSETS}
  <worldbody>
    {FLOOR}
    <body name="left" pos="0 0 0.3"><joint type="hinge" axis="0 1 0"/><geom {KINDS["capsule"]}/>
      <body name="elbow" pos="0 0 0.4"><joint type="ball"/><geom {KINDS["box"]}/>
        <body name="wrist" pos="0.1 0 0.3"><joint type="hinge" axis="1 0 0"/>
          <geom {KINDS["cylinder"]}/>
          <geom {KINDS["sphere"]} pos="0 0 0.2"/></body></body></body>
    <body name="right" pos="0.5 0 0.3"><joint type="slide" axis="1 0 1"/>
      <geom {KINDS["ellipsoid"]}/>
      <body name="hand" pos="0 0 0.4"><joint type="ball"/><geom {KINDS["capsule"]}/></body></body>
    <body name="stone" pos="0.2 0.2 0.8"><freejoint/><geom {KINDS["mesh"]}/></body>
  </worldbody>
</mujoco>
"""


def two(first: str, second: str) -> mujoco.MjModel:
    """Two geoms: a on a hinge and a ball joint, b free; or the tilted floor and b.

    MuJoCo finds the contacts of b within 10 m.
    """
    arm = f"""
          <body name="up" pos="0 0 0.5"><joint type="hinge" axis="1 1 0"/>
            <geom size="0.01" contype="0" conaffinity="0"/>
            <body name="A" pos="0.1 0 0.1"><joint type="ball"/>
              <geom name="a" {KINDS.get(first)} pos="0.05 0 0.1"/></body></body>"""
    return mujoco.MjModel.from_xml_string(
        f"""
        <mujoco>{ASSETS}<worldbody>{FLOOR if first == "floor" else arm}
          <body name="B" pos="0.1 0 0.6"><freejoint/>
            <geom name="b" {KINDS[second]} pos="0 0.02 0" margin="10"/></body>
        </worldbody></mujoco>
        """
    )


def moved(model: mujoco.MjModel, qpos: Array, dq: Array) -> Array:
    """Configuration moved along a tangent vector."""
    out = qpos.copy()
    mujoco.mj_integratePos(model, out, np.ascontiguousarray(dq), 1.0)
    return out


def scattered(model: mujoco.MjModel, count: int, spread: float, seed: int = 0) -> Array:
    """Random configurations about qpos0: (count, nq)."""
    rng = np.random.default_rng(seed)
    kind, first = model.jnt_type[model.dof_jntid], model.jnt_dofadr[model.dof_jntid]
    place = np.where(
        kind == int(mujoco.mjtJoint.mjJNT_FREE), np.arange(model.nv) - first < 3, False
    )
    size = np.where(place | (kind == int(mujoco.mjtJoint.mjJNT_SLIDE)), spread, 2.0)
    moves = size * rng.normal(size=(count, model.nv))
    return np.array([moved(model, model.qpos0, move) for move in moves])


def asked(model: mujoco.MjModel, chosen: GeomDistances, qpos: Array, limit: float) -> Array:
    """Distances by `mj_geomDistance` for every pair at every configuration, nothing left out: (n,
    p).
    """
    data, out = mujoco.MjData(model), np.empty((len(qpos), len(chosen.pairs)))
    for k, now in enumerate(qpos):
        data.qpos[:] = now
        mujoco.mj_kinematics(model, data)
        out[k] = [
            mujoco.mj_geomDistance(model, data, first, second, limit, None)
            for first, second, _ in chosen.pairs
        ]
    return out


def between(model: mujoco.MjModel, reach: float, grouped: bool = False) -> GeomDistances:
    """Distances of all pairs of a model."""
    return GeomDistances(model, find_geom_pairs(model, ()), reach, grouped)


def slope_error(model: mujoco.MjModel, chosen: GeomDistances, qpos: Array) -> float:
    """Largest error of the slopes of the first column against differences along every dof."""
    slope = chosen(qpos[None], True)[1]
    curves = [
        lambda t, e=e: float(chosen(moved(model, qpos, t * e)[None], True)[0][0, 0])
        for e in np.eye(model.nv)
    ]
    return directional_check(slope[0, 0], curves, 2e-4)


def slope_errors(model: mujoco.MjModel, spread: float, low: float, high: float) -> Array:
    """Largest errors of slopes at up to six distances in a range, by differences along each dof."""
    chosen, qpos = between(model, 2.0), scattered(model, 60, spread, seed=3)
    distances = chosen(qpos, False)[0][:, 0]
    qpos = qpos[(distances > low) & (distances < high)][:6]
    assert len(qpos) > 2
    return np.array([slope_error(model, chosen, now) for now in qpos])


# Everything overlaps, so that MuJoCo's contacts show which pairs it selects.
CROWD = """
<mujoco>
  <option><flag {flag}/></option>
  <default><geom type="sphere" size="5"/></default>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <body name="base"><geom name="base"/><geom name="seen" contype="0" conaffinity="0"/>
      <body name="one" pos="0 0 0.1"><joint axis="1 0 0"/><geom name="one"/>
        <geom name="one_seen" contype="0" conaffinity="0"/>
        <body name="plate" pos="0 0 0.1"><geom name="plate"/>
          <body name="two" pos="0 0 0.1"><joint axis="0 1 0"/><geom name="two"/>
            <body name="three" pos="0 0 0.1"><joint/>
              <geom name="three" contype="2" conaffinity="1"/>
              <body name="tip" pos="0 0 0.1"><joint/>
                <geom name="tip" contype="4" conaffinity="2"/></body>
            </body></body></body></body></body>
    <body name="ball" pos="0 0.1 0"><freejoint/><geom name="ball"/><geom name="ball_two"/></body>
    <body name="cart" pos="0 0.2 0"><joint type="slide"/>
      <geom name="cart" contype="0" conaffinity="1"/></body>
  </worldbody>
  <contact>
    <exclude body1="two" body2="ball"/><exclude body1="cart" body2="ball"/>
    <pair geom1="cart" geom2="ball_two"/><pair geom1="tip" geom2="three"/>
    <pair geom1="one_seen" geom2="cart"/>
  </contact>
</mujoco>
"""


@pytest.mark.parametrize("flag", ['filterparent="enable"', 'filterparent="disable"'])
def test_pairs_agree_with_mujocos_collisions(flag: str) -> None:
    """Welded bodies, parents and children, excluded bodies, collision bits, explicit pairs, the
    world's exception.
    """
    model = mujoco.MjModel.from_xml_string(CROWD.format(flag=flag))
    data = mujoco.MjData(model)
    mujoco.mj_fwdPosition(model, data)
    contacts = {frozenset(map(int, geoms)) for geoms in data.contact.geom}
    found = find_geom_pairs(model, ())
    assert {frozenset(geoms) for *geoms, _ in found} == contacts
    assert len(found) == len(contacts)
    names = {name for _, _, name in found}
    assert {"one - base", "one - floor", "three - tip", "ball_two - cart"} <= names
    assert {n for n in names if "seen" in n} == {"one_seen - cart"}  # by its explicit pair
    assert ("plate - two" in names) == ("disable" in flag)


def test_ignored_bodies_are_left_out() -> None:
    """All pairs of geoms of the two bodies are ignored, in either order, also with the world."""
    model = mujoco.MjModel.from_xml_string(ARMS)
    every = {name for _, _, name in find_geom_pairs(model, ())}
    left = {
        name
        for _, _, name in find_geom_pairs(
            model, {frozenset(("world", "wrist")), frozenset(("wrist", "hand"))}
        )
    }
    assert every - left == {
        "wrist geom 3 - floor",
        "wrist geom 4 - floor",
        "wrist geom 3 - hand geom 6",
        "wrist geom 4 - hand geom 6",
    }
    assert left < every


def test_height_fields_are_refused_unless_ignored() -> None:
    """MuJoCo's distances to such geoms depend on the largest distance that is requested."""
    model = mujoco.MjModel.from_xml_string(
        f"""
        <mujoco>{ASSETS}<worldbody><geom name="hills" type="hfield" hfield="hills"/>
          <body name="b"><freejoint/><geom name="b" size="0.1"/></body></worldbody></mujoco>
        """
    )
    with pytest.raises(
        ExperimentError,
        match=r"hills is a height field, .* ignore the bodies 'b' and 'world', or use",
    ):
        find_geom_pairs(model, ())
    assert find_geom_pairs(model, {frozenset(("b", "world"))}) == ()


def test_no_pairs_are_refused() -> None:
    model = mujoco.MjModel.from_xml_string(ARMS)
    with pytest.raises(ExperimentError, match="no two geoms can come near each other"):
        GeomDistances(model, (), 0.1)
    with pytest.raises(ExperimentError, match="reach 0 m; needs a positive, finite distance"):
        between(model, 0.0)
    with pytest.raises(ExperimentError, match="reach inf m"):
        between(model, np.inf)


@pytest.mark.parametrize("reach", [0.02, 0.1, 0.5, 5.0])
def test_all_distances_within_reach_are_found(reach: float) -> None:
    """They agree with `mj_geomDistance` within reach; all others are the reach."""
    model = mujoco.MjModel.from_xml_string(ARMS)
    chosen, qpos = between(model, reach), scattered(model, 200, 0.4)
    model.opt.ccd_tolerance, model.opt.ccd_iterations = 1e-10, 200
    d, expected = chosen(qpos, False)[0], asked(model, chosen, qpos, reach)
    shapes = [{int(model.geom_type[g]) for g in geoms} for *geoms, _ in chosen.pairs]
    trusted = (d > -0.05) | np.array([s != {CAPSULE, BOX} for s in shapes])  # see below
    assert trusted.mean() > 0.99
    assert_allclose(d[trusted], expected[trusted], rtol=0, atol=1e-8)
    assert (d[expected == reach] == reach).all()
    assert d.max() <= reach
    assert (
        (d < 0.0).any() and ((d > 0.0) & (d < reach)).any() and (reach > 1.0 or (d == reach).any())
    )


@pytest.mark.parametrize("kind", KINDS)
def test_planes_agree_with_contacts(kind: str) -> None:
    model = two("floor", kind)
    chosen, qpos, data = between(model, 9.0), scattered(model, 200, 1.0), mujoco.MjData(model)
    d, deepest = chosen(qpos, False)[0][:, 0], []
    for now in qpos:
        data.qpos[:] = now
        mujoco.mj_fwdPosition(model, data)
        deepest.append(data.contact.dist.min())
    assert d.min() < -0.3 and d.max() > 0.3
    assert_allclose(d, deepest, rtol=0, atol=1e-12)


def test_a_capsule_deep_in_a_box_has_a_negative_distance() -> None:
    """It agrees with that of the box as a mesh, for which MuJoCo uses another collider."""
    corners = " ".join(
        f"{x} {y} {z}" for x in (-0.1, 0.1) for y in (-0.05, 0.05) for z in (-0.2, 0.2)
    )
    model = mujoco.MjModel.from_xml_string(
        f"""
        <mujoco><asset><mesh name="box" vertex="{corners}"/></asset><worldbody>
          <body><freejoint/><geom {KINDS["capsule"]}/></body>
          <body><freejoint/><geom {KINDS["box"]}/><geom type="mesh" mesh="box" mass="0"/></body>
        </worldbody></mujoco>
        """
    )
    chosen, qpos = between(model, 1.0), scattered(model, 500, 0.06)
    d = chosen(qpos, False)[0]
    assert (d[:, 0] < -0.06).mean() > 0.5
    assert_allclose(d[:, 0], d[:, 1], rtol=0, atol=2e-8)
    worst = asked(model, chosen, qpos, 1.0)[:, 0] - d[:, 0]
    assert worst.max() > 0.05  # what is avoided


# Every kind of geom is in two of the fast cases.
FAST_PAIRS = list(zip(KINDS, [*list(KINDS)[1:], next(iter(KINDS))], strict=True))


@pytest.mark.parametrize(
    ("first", "second"),
    [
        pytest.param(*pair, marks=[] if {pair, pair[::-1]} & {*FAST_PAIRS} else pytest.mark.slow)
        for pair in combinations_with_replacement(KINDS, 2)
    ],
)
def test_slopes_agree_with_differences(first: str, second: str) -> None:
    """Geoms are near or far and are moved by hinge, ball and free joints."""
    errors = slope_errors(two(first, second), 0.4, 0.02, np.inf)
    assert np.quantile(errors, 0.75) < 1e-6
    assert errors.max() < 1e-4  # the surface bends where another edge or face becomes the nearest


# Depths of boxes and meshes in each other have many edges, at which no slope is the right one.
@pytest.mark.parametrize(
    ("first", "second"),
    [
        *((first, second) for first in ("floor", "sphere", "capsule") for second in KINDS),
        ("cylinder", "cylinder"),
        ("ellipsoid", "box"),
    ],
)
def test_slopes_in_penetration_agree_with_differences(first: str, second: str) -> None:
    """Slopes point outwards; curved surfaces are found to fewer digits inside."""
    spread, least = (1.0, -1.0) if first == "floor" else (0.1, -0.04)
    assert slope_errors(two(first, second), spread, least, -0.01).max() < 1e-4


@pytest.mark.parametrize("offset", [1e-6, 1e-10, 0.0, -1e-10, -1e-6])
@pytest.mark.parametrize("second", ["sphere", "capsule", "ellipsoid", "cylinder"])
def test_touching_geoms_have_slopes(second: str, offset: float) -> None:
    """A sphere is brought to an offset along the slope of the distance; nearest points no longer
    tell the normal.
    """
    model = two("sphere", second)
    chosen, qpos = between(model, 2.0), scattered(model, 1, 0.4)[0]
    start = model.joint(2).qposadr[0]
    for _ in range(40):
        d, slope = chosen(qpos[None], True)
        out = slope[0, 0, -6:-3]
        assert np.linalg.norm(out) == pytest.approx(1.0, abs=1e-9)
        qpos[start : start + 3] -= (d[0, 0] - offset) * out
    assert chosen(qpos[None], False)[0][0, 0] == pytest.approx(offset, abs=2e-11)
    assert slope_error(model, chosen, qpos) < 2e-4


def test_columns_are_pairs_of_bodies() -> None:
    model = mujoco.MjModel.from_xml_string(ARMS)
    chosen, single = between(model, 0.5, grouped=True), between(model, 0.5)
    qpos = scattered(model, 50, 0.4)
    (bodies, by_bodies), (geoms, by_geoms) = chosen(qpos, True), single(qpos, True)
    names = np.array(
        [
            " - ".join(model.body(model.geom_bodyid[g]).name for g in geoms)
            for *geoms, _ in single.pairs
        ]
    )
    assert sorted(chosen.columns) == sorted({*names})
    for i, column in enumerate(chosen.columns):
        own = np.flatnonzero(names == column)
        least = own[geoms[:, own].argmin(axis=1)]
        assert_array_equal(bodies[:, i], geoms[range(50), least])
        assert_array_equal(by_bodies[:, i], by_geoms[range(50), least])


@pytest.mark.parametrize("spread", [0.4, 4.0])
def test_nearest_is_the_smallest_of_all(spread: float) -> None:
    """The distance may be larger than the reach; along a motion not every pose is measured."""
    model = mujoco.MjModel.from_xml_string(ARMS)
    stone = [p for p in find_geom_pairs(model, ()) if "stone" in p[2] and "floor" not in p[2]]
    chosen, qpos = GeomDistances(model, stone, 0.01), scattered(model, 40, spread)
    if spread > 1.0:
        qpos = qpos[(chosen(qpos, False)[0] == 0.01).all(axis=1)]
    model.opt.ccd_tolerance, model.opt.ccd_iterations = 1e-10, 200
    qpos = np.concatenate([qpos, np.linspace(*qpos[:2], 500)])
    every = asked(model, chosen, qpos, 100.0)
    distance, pair = chosen.nearest(qpos)
    assert distance == pytest.approx(every.min(), abs=1e-8)
    assert pair == chosen.pairs[every.min(axis=0).argmin()][2]
    assert (distance > 0.01) == (spread > 1.0)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_diverged_configurations_have_no_distance(value: float) -> None:
    """Their distances are NaN, and their smallest distance is refused."""
    model = mujoco.MjModel.from_xml_string(ARMS)
    chosen, qpos = between(model, 0.5, grouped=True), scattered(model, 5, 0.4)
    qpos[3, 1] = value
    d, _ = chosen(qpos, True)
    assert np.isnan(d[3]).all() and np.isfinite(np.delete(d, 3, axis=0)).all()
    with pytest.raises(SimulationDivergedError, match="configuration 3 is not finite"):
        chosen.nearest(qpos)
