"""The fuzz suite for some seconds of each kind, and tests that it notices what it looks for."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from mjfim.parallel.budget import measured_by
from tests.fuzz import bad_inputs, inputs, problems
from tests.fuzz.inputs import Ending
from tests.fuzz.mechanisms import Mechanism
from tests.fuzz.odd_inputs import SPOILERS, no_permission
from tests.fuzz.outcome import Case
from tests.fuzz.plants import Ranges, random_plant
from tests.fuzz.player import (
    NEAREST,
    ROUNDING,
    Excess,
    play,
    read_reference,
)
from tests.fuzz.problems import omissions
from tests.fuzz.result_files import PIXEL, faults_in
from tests.fuzz.workers import run_cases
from tests.support.cli import write_experiment
from tests.support.limits import full_rows

# Seeds of the cases of each kind in these tests; the kill is that of a short call.
CASES = {
    "problem": range(8, 11),
    "input": range(8),
    "kill": [34],
    "mechanism": range(4, 7),
    "permission": range(4),
}

# Time after which no further case begins [s].
PATIENCE = 600.0


@pytest.mark.slow
def test_random_cases() -> None:
    """All cases end well; the message has the words that replay a failed one."""
    cases = [Case(kind=kind, seed=seed) for kind, seeds in CASES.items() for seed in seeds]
    outcomes = list(run_cases(cases, workers=1, seconds=PATIENCE))
    replay = [
        f"python -m scripts.fuzz --only {o.case}: {o.complaint}" for o in outcomes if o.complaint
    ]
    assert len(outcomes) == len(cases)
    assert replay == []


# Random problems with a feasible motion that is hard to find: about the holding control, with a
# small share of the initial control, and by steering.
HIDDEN = (2, 19, 62, 113, 472)


@pytest.mark.slow
@pytest.mark.parametrize("seed", HIDDEN)
def test_a_hidden_feasible_motion_is_found(
    seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A case writes its description into the current folder.
    monkeypatch.chdir(tmp_path)
    # Seconds of the processor, so that other programs on the computer do not shorten the search.
    with measured_by(time.process_time):
        outcome = problems.run(Case(kind="problem", seed=seed), tmp_path)
    assert outcome.group == "claimed"
    assert outcome.complaint == ""


@pytest.mark.parametrize("make", [random_plant, Mechanism])
@pytest.mark.parametrize("seed", range(12))
def test_random_plants_compile_with_their_ranges(make: Any, seed: int) -> None:
    plant = make(np.random.default_rng(seed))
    spec = mujoco.MjSpec.from_string(plant.xml)
    model = spec.compile()
    assert (model.njnt, model.nu) == (len(plant.joints), len(plant.drives))
    fields = {
        "position": ("joint", "range"),
        "control": ("actuator", "ctrlrange"),
        "force": ("actuator", "forcerange"),
        "tendon_length": ("tendon", "range"),
        "tendon_force": ("tendon", "actfrcrange"),
    }
    balls = [joint.name for joint in plant.joints if joint.kind == "ball"]
    for (kind, name), (low, high) in plant.ranges.items():
        if kind in fields:
            holder, field = fields[kind]
            found = getattr(getattr(spec, holder)(name), field)
            assert tuple(found) == (0.0 if name in balls else low, high)


def test_ranges_that_a_design_does_not_mention_are_noticed() -> None:
    rng, unheld = np.random.default_rng(18), []
    while not unheld:
        mechanism = Mechanism(rng)
        unheld = [drive.name for drive in mechanism.drives if not drive.is_held]
    assert len(omissions(mechanism, ())) == len(unheld)
    assert omissions(mechanism, (f"ranges of {' '.join(unheld)}",)) == []


@pytest.mark.parametrize("make", [*SPOILERS, no_permission])
def test_everything_can_be_spoiled(make: Any, tmp_path: Path) -> None:
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

# A force of 2 N acts for 0.1 s and then -2 N for 0.1 s, by Euler's method: the velocity reaches
# 0.2 m/s.
FORCED = ({"ctrl:motor": 2.0}, {"ctrl:motor": -2.0}, {})
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

# A ball of 1 kg on a free joint, with a thruster, above a floor. Turned by 1 rad about x, the gain
# of 3 per rad asks for a control of 3.
FLOATING = """<mujoco><option timestep="0.01" gravity="0 0 0">{flag}</option><worldbody>
<geom type="plane" size="1 1 1"/><body pos="0 0 0.5"><freejoint name="free"/>
<geom size="0.1" mass="1"/></body></worldbody>
<actuator><motor name="push" joint="free" gear="0 0 1 0 0 0"/></actuator></mujoco>"""
HELD = {"qpos:free.z": 0.5, "gain:push:qpos:free.rx": 3.0}
TURNED = {**HELD, "qpos:free.qw": float(np.cos(0.5)), "qpos:free.qx": float(np.sin(0.5))}

# A body on a free joint with another one on a ball joint and a tendon to the world. They move at
# constant speeds; the hull turns about z by 0.6 rad, which is no tilt, the mast about x. Both
# bodies turn about their common centre of mass.
TUMBLING = """<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>
<site name="post" pos="3 0 0"/>
<body name="hull" pos="1 0 0"><freejoint name="free"/><geom size="0.1" mass="1"/>
<body name="mast"><joint name="ball" type="ball"/><geom size="0.1" mass="1"/>
<site name="tip"/></body></body></worldbody>
<tendon><spatial name="rope"><site site="post"/><site site="tip"/></spatial></tendon>
<actuator><motor name="pull" tendon="rope"/><motor name="help" tendon="rope"/></actuator>
</mujoco>"""
HULL = ({"qpos:free.x": 1.0, "qvel:free.y": 0.5, "qvel:free.rz": 3.0}, {}, {})
LARGEST_OF_HULL = {
    ("position", "free.x"): 1.0,
    ("position", "free.y"): 0.1,
    ("velocity", "free"): 0.5,
    ("velocity", "free.y"): 0.5,
    ("angular_velocity", "free"): 3.0,
    ("angular_velocity", "free.rz"): 3.0,
    ("tendon_length", "rope"): float(np.hypot(2.0, 0.1)),
}
MAST = ({"qpos:free.x": 1.0, "qvel:ball.rx": 2.0}, {}, {})
LARGEST_OF_MAST = {
    ("position", "ball"): 0.4,
    ("velocity", "ball"): 2.0,
    ("angular_velocity", "ball"): 2.0,
    ("tilt", "ball"): 0.4,
}
PULLED = ({"ctrl:pull": 2.0, "ctrl:help": -0.5, "qvel:free.rz": 3.0}, {})

# The model, the rows, whether feedback is played, and the largest values by kind and name.
Rows = Sequence[dict[str, float]]
PLAYED = (
    (MASS, FORCED, False, LARGEST),
    (MASS, FORCED, True, LARGEST),
    (FLOATING.format(flag=""), (HELD, TURNED, HELD), True, {("control", "push"): 3.0}),
    (TUMBLING, HULL, False, LARGEST_OF_HULL),
    (TUMBLING, MAST, False, LARGEST_OF_MAST),
    (TUMBLING, PULLED, False, {("tendon_force", "rope"): 1.5}),
)


def excesses(xml: str, given: Rows, ranges: Ranges, *, feedback: bool = False) -> Excess:
    """Play rows whose numbers are zero unless they are given."""
    model = mujoco.MjModel.from_xml_string(xml)
    return play(model, full_rows(model, given, 0.1), ranges, 0.1, feedback)


@pytest.mark.parametrize(("xml", "rows", "feedback", "largest"), PLAYED)
def test_the_player_notices_every_kind_of_violation(
    xml: str, rows: Rows, feedback: bool, largest: Any
) -> None:
    """A limit just above the largest value holds; just below it is violated."""
    for factor, is_violated in ((1.0001, False), (0.9999, True)):
        ranges = {limit: (-factor * value, factor * value) for limit, value in largest.items()}
        found = excesses(xml, rows, ranges, feedback=feedback)
        assert len(found.sentences(ROUNDING)) == (len(largest) if is_violated else 0)


def test_without_feedback_and_about_z_there_is_no_violation() -> None:
    """The gains count for nothing, and a turn about z is no tilt."""
    for xml, rows, limit in (
        (FLOATING.format(flag=""), (HELD, TURNED, HELD), ("control", "push")),
        (TUMBLING, PULLED, ("tilt", "free")),
    ):
        assert excesses(xml, rows, {limit: (-1e-6, 1e-6)}).sentences(ROUNDING) == []


def test_a_value_of_reference_csv_beyond_a_limit_is_noticed() -> None:
    row = {"t": 0.0, "qpos:a": 1.0, "qvel:a": 2.0, "qacc:a": 3.0, "force:a": 4.0}
    kinds = ("position", "velocity", "acceleration", "joint_force")
    for factor, is_violated in ((1.001, False), (0.999, True)):
        bounds = {(kind, "a"): (-factor * k, factor * k) for k, kind in enumerate(kinds, start=1)}
        found = read_reference([row], bounds).sentences(ROUNDING)
        assert len(found) == (4 if is_violated else 0)


@pytest.mark.parametrize("flag", ["", '<flag contact="disable"/>'])
def test_the_player_measures_distances(flag: str) -> None:
    """The ball is 0.4 m above the floor, also where contacts are disabled."""
    for least, is_violated in ((0.399, False), (0.401, True)):
        limit = {("clearance", NEAREST): (least, 2.0 * least)}
        found = excesses(FLOATING.format(flag=flag), (HELD, HELD), limit)
        assert bool(found.sentences(ROUNDING)) is is_violated


def test_a_state_that_is_not_a_number_is_a_violation() -> None:
    limit = {("control", "motor"): (-1.0, 1.0)}
    assert excesses(MASS, ({"ctrl:motor": np.nan}, {}), limit).sentences(ROUNDING)


@pytest.mark.parametrize(
    ("name", "content", "faults"),
    [
        ("a.json", b'{"a": 1', 1),
        ("a.json", b'{"a": NaN}', 1),
        ("a.json", b'{"a": null}', 0),
        ("a.npz", b"PK\x03\x04", 1),
        ("a.csv", b"a,b\n1,2\n1", 1),
        ("a.csv", b"", 1),
        ("a.csv", b"a,b\n1,2\n", 0),
        ("a.png", PIXEL[:-3], 1),
        ("a.png", PIXEL, 0),
        ("a.rrd", b"RRF2", 1),
        ("a.xml", b"<mujoco>", 1),
        ("a.xml", MASS.encode(), 0),
        (".histogram_m-abcd12_x.png", PIXEL, 1),
        (".design-k3j2h1g0.npz", b"", 1),
        (".hidden", b"", 0),
    ],
)
def test_half_files_and_temporary_ones_are_noticed(
    name: str, content: bytes, faults: int, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content)
    assert len(faults_in(tmp_path.iterdir())) == faults


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
    for fragment in (
        "run.csv of the user was changed",
        "gone.csv of the user was removed",
        "design.json is not whole",
        "is a temporary file that stayed",
    ):
        assert fragment in told
