"""The fuzz suite for some seconds of each kind, and tests that it notices what it looks for."""

from __future__ import annotations

import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from mjfim.parallel.budget import measured_by
from tests.fuzz import bad_inputs, inputs, problems
from tests.fuzz.faults import FAULTS, packed_bomb
from tests.fuzz.inputs import Ending
from tests.fuzz.mechanism_problems import omissions
from tests.fuzz.mechanisms import random_mechanism
from tests.fuzz.outcome import Case, KnownFailure, Outcome
from tests.fuzz.plants import random_plant
from tests.fuzz.player import (
    NEAREST,
    PLACE,
    QUATERNION,
    ROUNDING,
    TURN,
    model_with_force_sensors,
    play,
    read_reference,
)
from tests.fuzz.problems import random_tables
from tests.fuzz.result_files import PIXEL, faults_of, is_temporary
from tests.fuzz.workers import run_cases
from tests.support.cli import write_experiment

# Time of each kind in these tests [s]; no case begins later.
SECONDS = {
    "problem": 8.0,
    "input": 8.0,
    "kill": 12.0,
    "mechanism": 8.0,
    "fault": 8.0,
    "permission": 8.0,
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", SECONDS)
def test_random_cases(kind: str) -> None:
    """All cases end well, from seed 0 on; the message has the words that replay a failed one."""
    cases = (Case(kind=kind, seed=seed) for seed in range(1000))
    outcomes = list(run_cases(cases, workers=1, seconds=SECONDS[kind]))
    failed = [o for o in outcomes if o.complaint and not o.known]
    replay = [f"python -m tests.fuzz --only {o.case}: {o.complaint}" for o in failed]
    assert len(outcomes) > 0
    assert replay == []


# Random problems with a feasible motion that is hard to find: about the holding control, with a
# small share of the initial control, and by steering.
HIDDEN = (2, 19, 62, 113, 472)


@pytest.mark.slow
@pytest.mark.parametrize("seed", HIDDEN)
def test_a_hidden_feasible_motion_is_found(seed: int, tmp_path: Path) -> None:
    # Seconds of the processor, so that other programs on the computer do not shorten the search.
    with measured_by(time.process_time):
        outcome = problems.run(Case(kind="problem", seed=seed), tmp_path)
    assert outcome.group == "claimed"
    assert outcome.complaint == ""


def test_a_case_is_read_as_it_is_printed() -> None:
    case = Case(kind="input", seed=17)
    assert Case.parse(str(case)) == case
    for text in ("input", "nonsense:1", "input:-1", "input:x"):
        with pytest.raises(ValueError, match="a case is KIND:SEED"):
            Case.parse(text)


def test_a_seed_gives_the_same_problem() -> None:
    case = Case(kind="problem", seed=3)
    first, second = case.rng, case.rng
    plants = random_plant(first), random_plant(second)
    assert plants[0].xml == plants[1].xml
    assert random_tables(first, plants[0]) == random_tables(second, plants[1])


@pytest.mark.parametrize("seed", range(10))
def test_random_plants_compile_with_their_ranges(seed: int) -> None:
    plant = random_plant(np.random.default_rng(seed))
    model = mujoco.MjModel.from_xml_string(plant.xml)
    assert (model.njnt, model.nu) == (len(plant.joints), len(plant.drives))
    for (kind, name), bounds in plant.ranges.items():
        if kind == "position":
            assert tuple(model.joint(name).range) == bounds
        if kind == "control":
            assert tuple(model.actuator(name).ctrlrange) == bounds


@pytest.mark.parametrize("seed", range(12))
def test_random_mechanisms_compile_with_their_ranges(seed: int) -> None:
    mechanism = random_mechanism(np.random.default_rng(seed))
    model = mujoco.MjModel.from_xml_string(mechanism.xml)
    assert (model.njnt, model.nu) == (len(mechanism.links), len(mechanism.actuators))
    for (kind, name), bounds in mechanism.ranges.items():
        if kind == "position":
            is_ball = int(model.joint(name).type[0]) == int(mujoco.mjtJoint.mjJNT_BALL)
            lower = 0.0 if is_ball else bounds[0]
            assert tuple(model.joint(name).range) == (lower, bounds[1])
        if kind == "force":
            assert tuple(model.actuator(name).forcerange) == bounds
        if kind == "tendon_length":
            assert tuple(model.tendon_range[model.tendon(name).id]) == bounds
        if kind == "tendon_force":
            assert tuple(model.tendon_actfrcrange[model.tendon(name).id]) == bounds


def test_ranges_that_a_design_does_not_mention_are_noticed() -> None:
    rng = np.random.default_rng(18)
    mechanism = random_mechanism(rng)
    while not mechanism.unheld:
        mechanism = random_mechanism(rng)

    silent: Any = SimpleNamespace(warnings=())
    found = "; ".join(omissions(mechanism, silent))
    assert [name for name in mechanism.unheld if name not in found] == []
    told: Any = SimpleNamespace(warnings=(f"ranges of {' '.join(mechanism.unheld)}",))
    assert omissions(mechanism, told) == []


@pytest.mark.parametrize("make", [make for make, _ in FAULTS if make is not packed_bomb])
def test_every_fault_can_be_made(
    make: Callable[[Any, Path], bad_inputs.Call], tmp_path: Path
) -> None:
    """Nothing but the generator is called; it has to cope with every choice that it makes."""
    names = ("t", "ctrl:force", "qpos:slide", "qpos:hinge", "qvel:slide", "qvel:hinge")
    for seed in range(3):
        folder = tmp_path / str(seed)
        folder.mkdir()
        write_experiment(folder)
        rows = [",".join(names), *(",".join([f"{0.01 * i}"] * 6) for i in range(4))]
        (folder / "run.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
        np.savez(folder / "design.npz", t=np.arange(3), qpos=np.ones((3, 2)), ctrl=np.ones((2, 1)))
        call = make(np.random.default_rng(seed), folder)
        assert len(call.words) > 1
        assert call.spoiled


# A mass of 1 kg on a slide, driven by a motor.
MASS = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody><body>
<joint name="slide" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/></body></worldbody>
<actuator><motor name="motor" joint="slide"/></actuator></mujoco>"""

# Largest values when a force of 2 N acts for 0.1 s and then -2 N for 0.1 s, by Euler's method: the
# velocity reaches 0.2 m/s.
LARGEST = {
    ("velocity", "slide"): 0.2,
    ("acceleration", "slide"): 2.0,
    ("control", "motor"): 2.0,
    ("control_rate", "motor"): 40.0,
    ("force", "motor"): 2.0,
    ("joint_force", "slide"): 2.0,
    ("position", "slide"): 0.02,
    ("end_position", "slide"): 0.02,
}


@pytest.mark.parametrize("limit", LARGEST)
@pytest.mark.parametrize("feedback", [False, True])
def test_the_player_notices_every_kind_of_violation(limit: tuple[str, str], feedback: bool) -> None:
    """A limit just above the largest value holds; just below it is violated."""
    model = model_with_force_sensors(mujoco.MjSpec.from_string(MASS))
    state = {"qpos:slide": 0.0, "qvel:slide": 0.0}
    gains = {f"gain:motor:{name}": 0.0 for name in state}
    controls = (2.0, -2.0, np.nan)
    rows = [{"t": 0.1 * i, "ctrl:motor": c, **state, **gains} for i, c in enumerate(controls)]

    for factor, is_violated in ((1.001, False), (0.999, True)):
        bound = factor * LARGEST[limit]
        found = play(model, rows, {limit: (-bound, bound)}, period=0.1, feedback=feedback)
        assert bool(found.sentences(ROUNDING)) is is_violated


# A servo that starts 1 rad away from its control, with a spring. With RK4 the force of the last
# stage is smaller than that at the beginning of the first step, 10 N m.
SERVO = """<mujoco><option timestep="0.01" integrator="{integrator}"/><worldbody><body>
<joint name="hinge"/><geom size="0.1" mass="1" pos="0 0 -0.2"/></body></worldbody>
<actuator><position name="servo" joint="hinge" kp="10"/></actuator></mujoco>"""


@pytest.mark.parametrize("kind", ["force", "joint_force"])
@pytest.mark.parametrize("integrator", ["Euler", "RK4", "implicit", "implicitfast"])
@pytest.mark.parametrize("away", [1.0, 0.0])
def test_the_player_reads_the_force_at_both_ends_of_every_step(
    kind: str, integrator: str, away: float
) -> None:
    """From rest the force is largest when the step begins. At 1 rad/s it is largest when the step
    ends, about 0.1 N m after 0.01 s; the last stage of RK4 has 0.094 N m.
    """
    model = model_with_force_sensors(mujoco.MjSpec.from_string(SERVO.format(integrator=integrator)))
    first = {"t": 0.0, "ctrl:servo": 0.0, "qpos:hinge": away, "qvel:hinge": 0.0}
    if away == 0.0:
        first["qvel:hinge"] = 1.0
    rows = [first, {**first, "t": 0.01}]
    largest = 10.0 if away else 0.095

    limit = {(kind, "servo" if kind == "force" else "hinge"): (-largest, largest)}
    found = play(model, rows, limit, period=0.01).found
    (excess,) = found.values()
    assert abs(excess) < 1e-12 if away else 0.0 < excess < 0.1


def test_a_value_of_reference_csv_beyond_a_limit_is_noticed() -> None:
    row = {"t": 0.0, "qpos:a": 1.0, "qvel:a": 2.0, "qacc:a": 3.0, "force:a": 4.0}
    kinds = ("position", "velocity", "acceleration", "joint_force")
    for bound, kind in enumerate(kinds, start=1):
        for factor, is_violated in ((1.001, False), (0.999, True)):
            limit = {(kind, "a"): (-factor * bound, factor * bound)}
            assert bool(read_reference([row], limit).sentences(ROUNDING)) is is_violated


def test_feedback_is_played() -> None:
    """With a gain on the position, the control follows the deviation from the planned state."""
    model = model_with_force_sensors(mujoco.MjSpec.from_string(MASS))
    row = {"ctrl:motor": 0.0, "gain:motor:qpos:slide": 3.0, "gain:motor:qvel:slide": 0.0}
    rows = [
        {"t": 0.0, "qpos:slide": 0.0, "qvel:slide": 0.0, **row},
        {"t": 0.1, "qpos:slide": 1.0, "qvel:slide": 0.0, **row},
        {"t": 0.2, "qpos:slide": 1.0, "qvel:slide": 0.0, **row},
    ]
    limit = {("control", "motor"): (-2.9, 2.9)}
    assert not play(model, rows, limit, period=0.1).sentences(ROUNDING)
    assert play(model, rows, limit, period=0.1, feedback=True).sentences(ROUNDING)


# A ball of 1 kg on a free joint, with a thruster, above a floor.
FLOATING = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>
<geom type="plane" size="1 1 1"/><body pos="0 0 0.5"><freejoint name="free"/>
<geom size="0.1" mass="1"/></body></worldbody>
<actuator><motor name="push" joint="free" gear="0 0 1 0 0 0"/></actuator></mujoco>"""


def floating_rows(**last: float) -> list[dict[str, float]]:
    """Rows of a ball that stays at a height of 0.5 m; `last` changes the planned last state."""
    parts = (*PLACE, *TURN)
    row = {f"qpos:free{part}": 0.0 for part in (*PLACE, *QUATERNION)}
    row |= {f"qvel:free{part}": 0.0 for part in parts} | {"ctrl:push": 0.0}
    row |= {f"gain:push:{field}:free{part}": 0.0 for field in ("qpos", "qvel") for part in parts}
    row |= {"qpos:free.z": 0.5, "qpos:free.qw": 1.0, "gain:push:qpos:free.rx": 3.0}
    return [{**row, "t": 0.0}, {**row, "t": 0.1, **last}, {**row, "t": 0.2}]


def test_feedback_on_a_free_joint_takes_the_rotation_vector() -> None:
    """Turned by 1 rad about x, the gain of 3 per rad asks for a control of 3."""
    model = model_with_force_sensors(mujoco.MjSpec.from_string(FLOATING))
    turned = {"qpos:free.qw": float(np.cos(0.5)), "qpos:free.qx": float(np.sin(0.5))}
    for bound, is_violated in ((3.001, False), (2.999, True)):
        limit = {("control", "push"): (-bound, bound)}
        found = play(model, floating_rows(**turned), limit, period=0.1, feedback=True)
        assert bool(found.sentences(ROUNDING)) is is_violated


def test_the_player_measures_distances() -> None:
    """The ball is 0.4 m above the floor, also where contacts are disabled."""
    model = model_with_force_sensors(mujoco.MjSpec.from_string(FLOATING))
    for flags in (0, int(mujoco.mjtDisableBit.mjDSBL_CONTACT)):
        model.opt.disableflags = flags
        for least, is_violated in ((0.399, False), (0.401, True)):
            limit = {("clearance", NEAREST): (least, 2.0 * least)}
            found = play(model, floating_rows(), limit, period=0.1)
            assert bool(found.sentences(ROUNDING)) is is_violated


# A body on a free joint with another one on a ball joint and a tendon to the world. They move at
# constant speeds; the hull turns about z by 0.6 rad, which is no tilt, the mast about x.
TUMBLING = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>
<site name="post" pos="3 0 0"/>
<body name="hull" pos="1 0 0"><freejoint name="free"/><geom size="0.1" mass="1"/>
<body name="mast"><joint name="ball" type="ball"/><geom size="0.1" mass="1"/>
<site name="tip"/></body></body></worldbody>
<tendon><spatial name="rope"><site site="post"/><site site="tip"/></spatial></tendon>
<actuator><motor name="pull" tendon="rope"/><motor name="help" tendon="rope"/></actuator>
</mujoco>"""

# Largest values within 0.2 s without forces. Both bodies turn about their common centre of mass.
LARGEST_IN_SPACE = {
    ("position", "free.x"): 1.0,
    ("position", "free.y"): 0.1,
    ("position", "ball"): 0.4,
    ("velocity", "free"): 0.5,
    ("velocity", "free.y"): 0.5,
    ("velocity", "ball"): 2.0,
    ("angular_velocity", "free"): 3.0,
    ("angular_velocity", "free.rz"): 3.0,
    ("angular_velocity", "ball"): 2.0,
    ("tilt", "ball"): 0.4,
    ("tendon_length", "rope"): float(np.hypot(2.0, 0.1)),
}


@pytest.mark.parametrize("limit", LARGEST_IN_SPACE)
def test_the_player_notices_every_kind_of_violation_in_space(limit: tuple[str, str]) -> None:
    """A limit just above the largest value holds; just below it is violated."""
    model = model_with_force_sensors(mujoco.MjSpec.from_string(TUMBLING))
    names = [f"free{part}" for part in (*PLACE, *TURN)] + [f"ball{part}" for part in TURN]
    row = {f"qvel:{name}": 0.0 for name in names} | {"ctrl:pull": 0.0, "ctrl:help": 0.0}
    row |= {f"qpos:free{part}": 0.0 for part in (*PLACE, *QUATERNION)}
    row |= {f"qpos:ball{part}": 0.0 for part in QUATERNION}
    row |= {"qpos:free.x": 1.0, "qpos:free.qw": 1.0, "qpos:ball.qw": 1.0}
    moving = {"qvel:free.y": 0.5, "qvel:free.rz": 3.0}
    if limit[1] == "ball":
        moving = {"qvel:ball.rx": 2.0}
    rows = [{**row, **moving, "t": 0.0}, {**row, "t": 0.2}]

    for factor, is_violated in ((1.0001, False), (0.9999, True)):
        bound = factor * LARGEST_IN_SPACE[limit]
        found = play(model, rows, {limit: (-bound, bound)}, period=0.2)
        assert bool(found.sentences(ROUNDING)) is is_violated


def test_the_player_adds_the_forces_on_a_tendon_and_sees_no_tilt_of_a_turn_about_z() -> None:
    model = model_with_force_sensors(mujoco.MjSpec.from_string(TUMBLING))
    names = [f"free{part}" for part in (*PLACE, *TURN)] + [f"ball{part}" for part in TURN]
    row = {f"qvel:{name}": 0.0 for name in names} | {"ctrl:pull": 2.0, "ctrl:help": -0.5}
    row |= {f"qpos:free{part}": 0.0 for part in (*PLACE, *QUATERNION)}
    row |= {f"qpos:ball{part}": 0.0 for part in QUATERNION}
    row |= {"qpos:free.qw": 1.0, "qpos:ball.qw": 1.0, "qvel:free.rz": 3.0}
    rows = [{**row, "t": 0.0}, {**row, "t": 0.1}]
    for limit, bound, is_violated in (
        (("tendon_force", "rope"), 1.501, False),
        (("tendon_force", "rope"), 1.499, True),
        (("tilt", "free"), 1e-6, False),
    ):
        found = play(model, rows, {limit: (-bound, bound)}, period=0.1)
        assert bool(found.sentences(ROUNDING)) is is_violated


def test_a_state_that_is_not_a_number_is_a_violation() -> None:
    model = model_with_force_sensors(mujoco.MjSpec.from_string(MASS))
    first = {"t": 0.0, "ctrl:motor": np.nan, "qpos:slide": 0.0, "qvel:slide": 0.0}
    limit = {("control", "motor"): (-1.0, 1.0)}
    assert play(model, [first, {**first, "t": 0.1}], limit, period=0.1).sentences(ROUNDING)


def test_the_toml_of_the_suite_is_read_back() -> None:
    value = {"a b": [1.0, True, "x\n\"'"], "n": 5e-324, "t": {"k": -3}, "i": float("inf")}
    text = f"value = {bad_inputs.toml_of(value)}"
    assert tomllib.loads(text) == {"value": value}


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.json", b'{"a": 1'),
        ("a.json", b'{"a": NaN}'),
        ("a.npz", b"PK\x03\x04"),
        ("a.csv", b"a,b\n1,2\n1"),
        ("a.csv", b""),
        ("a.png", PIXEL[:-3]),
        ("a.rrd", b"RRF2"),
        ("a.xml", b"<mujoco>"),
    ],
)
def test_half_files_are_noticed(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    assert len(faults_of(tmp_path / name)) == 1


def test_whole_files_are_accepted(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t=np.zeros(3))
    for name, content in (
        ("a.json", b'{"a": null}'),
        ("a.csv", b"a,b\n1,2\n"),
        ("a.png", PIXEL),
        ("a.xml", MASS.encode()),
    ):
        (tmp_path / name).write_bytes(content)
    assert [fault for path in tmp_path.iterdir() for fault in faults_of(path)] == []


def test_temporary_files_are_recognised() -> None:
    assert is_temporary(Path("out/.histogram_m-abcd12_x.png"))
    assert is_temporary(Path("out/.design-k3j2h1g0.npz"))
    assert not is_temporary(Path("out/design.npz"))
    assert not is_temporary(Path("out/.hidden"))


@pytest.mark.parametrize(
    ("ending", "refused", "complaint"),
    [
        (Ending(code=2, errors="mjfim: x.toml: rate: should be larger"), True, ""),
        (Ending(code=2, errors="Usage: mjfim design\nNo such option"), True, ""),
        (Ending(code=0, errors="wrote out/"), False, ""),
        (Ending(code=0, errors="wrote out/"), True, "accepted"),
        (Ending(code=1, errors=""), False, "without a message"),
        (Ending(code=2, errors=""), False, "0 messages"),
        (Ending(code=2, errors="mjfim: a\nmjfim: b"), False, "2 messages"),
        (Ending(code=2, errors="mjfim: " + "x" * 700), False, "long message"),
        (Ending(code=-6, errors="free(): invalid pointer"), False, "exit code -6"),
        (Ending(code=1, errors="Traceback (most recent call last)\nKeyError"), False, "KeyError"),
        (Ending(code=1, errors="x", fault="RuntimeWarning: overflow"), False, "RuntimeWarning"),
    ],
)
def test_bad_endings_are_noticed(ending: Ending, refused: bool, complaint: str) -> None:
    call = bad_inputs.Call(words=[], spoiled="", refused=refused)
    found = inputs.judge(call, ending)
    assert len(found) == (1 if complaint else 0)
    assert complaint in "".join(found)


def test_changed_inputs_and_half_written_results_are_noticed(tmp_path: Path) -> None:
    (tmp_path / "run.csv").write_bytes(b"t\n0\n")
    (tmp_path / "gone.csv").write_bytes(b"t\n0\n")
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert inputs.changes(tmp_path, before) == []

    (tmp_path / "run.csv").write_bytes(b"t\n1\n")
    (tmp_path / "gone.csv").unlink()
    (tmp_path / ".design-k3j2h1g0.npz").touch()
    (tmp_path / "design.json").write_bytes(b"{")
    told = "; ".join(inputs.changes(tmp_path, before))
    for fragment in ("run.csv of the user was changed", "gone.csv of the user was removed"):
        assert fragment in told
    assert "design.json is not whole" in told
    assert "is a temporary file that stayed" in told


def test_a_known_failure_is_known_by_kind_description_and_complaint() -> None:
    known = KnownFailure(kind="input", description="twice", complaint="accepted", reason="")
    case = Case(kind="input", seed=0)
    twice = Outcome(case=case, group="", description="log twice", complaint="accepted: exit 0")
    assert known.fits(twice)
    assert not known.fits(Outcome(case=case, group="", description="log twice"))
    other = Outcome(case=case, group="", description="log", complaint="accepted")
    assert not known.fits(other)
