"""The experiment file: all keys are read, and every fault names the file, the key and what would be
right.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from mjfim.errors import ExperimentError, MjfimError, ModelError, RecordingError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment, json_schema
from mjfim.experiment.system_tables import Signal
from mjfim.experiment.task_tables import LimitKind, Robust
from mjfim.model.inertia import INERTIA_PARAMETRISATIONS
from mjfim.model.limited_elements import KINDS
from mjfim.recordings.section import Section
from tests.support.messages import unsaid
from tests.support.paths import MODELS

# All keys of the contract.
CONTRACT = """
model = "cart_pendulum.xml"
rate = 100.0
measure_rate = 50.0
horizon = 1.0

[initial]
keyframe = "hanging"
control = "cart_pendulum.csv"

[parameters.m]
target = "body/bob:mass"
guess = 2.5
true = 2.0
bounds = [0.1, 10.0]
scale = 1.0
prior = 0.5
unit = "kg"

[parameters.l]
targets = [
  { path = "body/bob:pos[2]", scale = -1.0, offset = 0.25 },
  { path = "geom/rod:pos[2]", scale = 0.5 },
]
guess = -0.75
scale = "guess"

[parameters.c]
target = "joint/hinge:damping"

[noise]
state = 0.05
hinge_angle = 0.01

[cost]
criterion = "A"
information = 2.0
control = { force = 1e-2 }
tracking = { slide = 0.05 }
tracking_velocity = { hinge = 0.1 }
linearize_at = "true"

[descent]
method = "metric"
tolerance = 1e-5
max_iterations = 20

[limits]
position = { slide = [-1.0, 1.0] }
velocity = { hinge = 8.0 }
control = { force = [-5.0, 5.0] }
"""

# A short complete experiment, which the faulty files below change in one place.
SHORT = """
model = "cart_pendulum.xml"
rate = 100.0
horizon = 1.0
[initial]
keyframe = "hanging"
control = { kind = "sine" }
[parameters.m]
target = "body/bob:mass"
[cost]
[noise]
state = 0.05
"""

BAR = '<body name="bar"><joint name="j"/><geom size=".1" pos=".1 0 0"/></body>'
BAD_MODELS = {
    "text.xml": "this is not XML",
    "nan.xml": f'<mujoco><option timestep="nan"/><worldbody>{BAR}</worldbody></mujoco>',
}
BAD_TABLES = {
    "columns.csv": b"t,forc\n0,1\n0.5,1\n1,1\n",
    "nan.csv": b"t,force\n0,1\n0.5,nan\n1,1\n",
    "short.csv": b"t,force\n0,1\n0.1,1\n0.2,1\n",
    "repeated.csv": b"t,force\n0,1\n0.5,1\n0.5,1\n1,1\n",
    "twice.csv": b"t,force,force\n0,1,1\n1,1,1\n",
    "latin.csv": b"t,force,\xe4\n0,1,1\n1,1,1\n",
}


Resolve = Callable[[str], DesignTask]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The cart-pendulum's files beside faulty models and tables."""
    home = tmp_path_factory.mktemp("experiments")
    for source in MODELS.iterdir():
        if source.is_file():
            shutil.copy(source, home)
    for name, text in BAD_MODELS.items():
        (home / name).write_text(text, encoding="utf-8")
    for name, data in BAD_TABLES.items():
        (home / name).write_bytes(data)
    return home


@pytest.fixture
def resolve(folder: Path) -> Resolve:
    """Read a text as the file bad.toml and resolve it."""

    def run(text: str) -> DesignTask:
        (folder / "bad.toml").write_text(text, encoding="utf-8")
        return DesignTask.resolve(Experiment.from_file(folder / "bad.toml"))

    return run


def edited(old: str, new: str) -> str:
    """SHORT with one change."""
    if SHORT.count(old) != 1:
        raise ValueError(f"{old!r} does not stand exactly once in the text")
    return SHORT.replace(old, new)


def parameter(lines: str) -> str:
    """SHORT with other lines in its parameter table."""
    return edited('target = "body/bob:mass"', lines)


def target(path: str) -> str:
    """SHORT with another parameter path."""
    return parameter(f'target = "{path}"')


def control(value: str) -> str:
    """SHORT with another initial control."""
    return edited('{ kind = "sine" }', value)


# Keys beyond those of the paper: correlated noise, rates, nuisance, whole inertias, other criteria.
EXTENDED = """
model = "cart_pendulum.xml"
rate = 100.0
horizon = 1.0

[initial]
keyframe = "hanging"
control = { kind = "sine", offset = { force = 0.5 } }

[parameters.bob]
inertial = "bob"
coordinates = "barycentric"
prior = 0.2
nuisance = true

[parameters.c]
target = "joint/hinge:damping"
wanted = 0.01

[noise]
state.covariance = [
    [4.0, 1.0, 0.0, 0.0], [1.0, 4.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]
]
state.rate = 50.0
hinge_angle = { sigma = [0.01] }
slide_position = 0.02

[[correlated]]
outputs = ["hinge_angle", "slide_position"]
covariance = [[1e-4, 1e-5], [1e-5, 4e-4]]

[nuisance]
initial = { "qpos:slide" = 0.01, "qvel:hinge" = true }
bias = true
delay = 0.005

[cost]
criterion = "c"
subset = ["c"]
control_about = { force = 1.5 }

[robust]
over = "worst"
samples = 3
seed = 4

[descent]
starts = 3
coarse = 2
seed = 5
"""


def test_extended_contract_parses_and_resolves(resolve: Resolve) -> None:
    task = resolve(EXTENDED)
    e, outputs, noise = task.experiment, task.system.outputs.names, task.system.noise
    assert e.robust == Robust(over="worst", samples=3, seed=4)
    assert (e.descent.starts, e.descent.coarse, e.descent.seed) == (3, 2, 5)
    assert noise.strides.tolist() == [2] * 4 + [1] * 2
    assert (noise.covariance[0, 1], noise.covariance[4, 5]) == (1.0, 1e-5)
    deviations = ("initial qpos:slide", "initial qvel:hinge", *(f"bias {n}" for n in outputs))
    bob = [f"bob.{name}" for name in INERTIA_PARAMETRISATIONS["barycentric"].names]
    assert task.parameters.names == (*bob, "c", *deviations, "delay")
    assert task.parameters.wanted[10] == 0.01
    assert task.parameters.interest.tolist() == [10]
    assert Experiment(**e.model_dump(), directory=e.directory, source=e.source) == e


def test_contract_resolves(resolve: Resolve) -> None:
    task = resolve(CONTRACT)
    parameters, grid = task.parameters, task.system.grid
    assert parameters.names == ("m", "l", "c")
    assert parameters.guess.tolist() == [2.5, -0.75, 1.0]  # c: the model's own damping
    assert parameters.true.tolist() == task.theta.tolist() == [2.0, -0.75, 1.0]
    assert parameters.scale.tolist() == [1.0, 0.75, 1.0]
    assert parameters.lower.tolist() == [0.1, -np.inf, 0.0]
    assert parameters.prior_information.tolist() == np.diag([4.0, 0.0, 0.0]).tolist()
    assert (grid.substeps, grid.stride, task.control.shape) == (1, 2, (100, 1))
    assert task.system.measure_rate == 50.0
    assert task.system.outputs.names[-2:] == ("qvel:hinge", "hinge_angle")
    assert task.system.noise.sigma.tolist() == [0.05] * 4 + [0.01]
    assert task.tracking.tolist() == [0.05, 0.0, 0.0, 0.1]
    assert task.control_weight.tolist() == [1e-2]
    assert task.plant.nominal_initial_state.tolist() == [0.0, np.pi, 0.0, 0.0]
    assert {(x.kind, x.name, x.lower, x.upper) for x in task.limits} == {
        ("position", "slide", -1.0, 1.0),
        ("velocity", "hinge", -8.0, 8.0),
        ("control", "force", -5.0, 5.0),
    }


def test_mjcf_noise_is_the_default(resolve: Resolve) -> None:
    """Without a noise table the sensors that state their noise are measured."""
    system = resolve(edited("state = 0.05", "")).system
    sensors = ("slide_position", "hinge_angle", "slide_velocity", "hinge_velocity")
    assert system.outputs.names == sensors
    assert system.noise.sigma.tolist() == [0.05] * 4


@pytest.mark.parametrize(
    ("stated", "state"),
    [("qpos = [0.5, 3.0]\nqvel = [0.0, -1.0]", [0.5, 3.0, 0.0, -1.0]), ("", [0.0] * 4)],
)
def test_start_from_qpos(stated: str, state: list[float], resolve: Resolve) -> None:
    task = resolve(edited('keyframe = "hanging"', stated))
    assert task.plant.nominal_initial_state.tolist() == state


def test_replace_merges_and_checks(folder: Path) -> None:
    """Tables merge, other keys and the old experiment stay, and faults are refused as in a file."""
    e = Experiment.from_file(folder / "cart_pendulum.toml")
    old = e.model_dump()
    new = e.replace(horizon=1.0, cost={"control": 1e-2}, initial={"control": {"kind": "chirp"}})
    changed = Signal(kind="chirp").model_dump()
    cost = {**old["cost"], "control": 1e-2}
    initial = {**old["initial"], "control": changed}
    assert new.model_dump() == {**old, "horizon": 1.0, "cost": cost, "initial": initial}
    assert (e.model_dump(), new.directory, new.source) == (old, e.directory, e.source)
    with pytest.raises(ExperimentError, match=r"cart_pendulum\.toml: cost\.contrl: unknown key"):
        e.replace(cost={"contrl": 1.0})


HOME = "bad.toml"

# By name: text of the file, and parts of the message, which begins with the name of the file.
FAULTS: dict[str, tuple[str, str]] = {
    "top-level key": ("modle = 1\n" + SHORT, "modle … unknown key … 'model' … valid: … horizon"),
    "nested key": (edited("[cost]", "[cost]\ncontrl = 1"), "cost.contrl … 'control' … tracking"),
    "signal without kind": (
        control("{ amplitude = 1 }"),
        "initial.control.kind: this key is required",
    ),
    "limits key": (
        SHORT + "[limits]\nspeed = 1\n",
        "limits.speed … acceleration, angular_velocity, bandwidth, clearance, control, "
        "control_rate, enforce, floor, force, ignored, joint_force, position, reserve, "
        "tendon_force, tendon_length, tilt, velocity",
    ),
    "reserved key": ('source = "x"\n' + SHORT, "source … valid: … model"),
    "missing key": (
        edited("rate = 100.0", ""),
        "rate: this key is required: rate of the samples and of the control … [Hz]",
    ),
    "tracking joint": (
        edited("[cost]", "[cost]\ntracking = { slid = 1 }"),
        "cost.tracking … hinge, slide",
    ),
    "limit joint": (
        SHORT + "[limits]\nposition = { slid = [-1, 1] }\n",
        "limits.position … joint 'slid' … hinge, slide",
    ),
    "cost actuator": (
        edited("[cost]", "[cost]\ncontrol = { motor = 1 }"),
        "cost.control … actuator 'motor' … force",
    ),
    "sensor": (
        edited("state =", "angle ="),
        "noise … sensor 'angle' … hinge_angle … qpos:hinge … state",
    ),
    "keyframe": (
        edited('"hanging"', '"hangin"'),
        "initial.keyframe … 'hangin' … did you mean 'hanging'",
    ),
    "path form": (target("body/bob"), "parameters.m … 'body/bob' … kind/name:field[index]"),
    "rate vanishing": (
        edited("rate = 100.0", "rate = 5e-324"),
        "rate … should be of a size from 1e-100 to 1e+100 … 5e-324",
    ),
    "rate far too low": (
        edited("rate = 100.0", "rate = 1e-6"),
        "rate: at 1e-06 Hz … 1e+08 timesteps … at most 100000 … 0.001 Hz or more",
    ),
    "rate": (
        edited("rate = 100.0", "rate = 30.0"),
        "rate: at 30 Hz … 0.01 s … 25, 50, 33.3333333 Hz … A log keeps its own rate",
    ),
    "measure rate": ("measure_rate = 30.0" + SHORT, "measure_rate: 30 Hz … 100 Hz … 50, 25"),
    "horizon": (
        edited("horizon = 1.0", "horizon = 1.005"),
        "horizon: 1.005 s … whole number … samples",
    ),
    "horizon of one sample": (edited("horizon = 1.0", "horizon = 0.01"), "horizon: 0.01 s … >= 2"),
    "many starts": (
        edited("[cost]", "[descent]\nstarts = 1000000000\n[cost]"),
        "descent.starts … less than or equal to 10000 … 1000000000",
    ),
    "bounds inverted": (
        parameter('target = "body/bob:mass"\nbounds = [5, 1]'),
        "parameters.m … bounds … [5.0, 1.0] … lower < upper",
    ),
    "guess outside": (
        parameter('target = "body/bob:mass"\nbounds = [1, 5]\nguess = 6'),
        "parameters.m.guess … the value 6 is outside bounds [1.0, 5.0]",
    ),
    "model's value outside": (
        parameter('target = "body/bob:mass"\nbounds = [3, 5]'),
        "parameters.m.guess … the value 2 in the model … [3.0, 5.0]",
    ),
    "wrong unit and outside": (
        parameter('target = "body/bob:mass"\nguess = "2.5 deg"\nbounds = [1, 5]'),
        "parameters.m.guess: '2.5 deg' is no number in kg … kg, g",
    ),
    "right unit and outside": (
        parameter('target = "body/bob:mass"\nguess = "2.5 g"\nbounds = [1, 5]'),
        "parameters.m.guess: the value 0.0025 is outside bounds [1.0, 5.0]",
    ),
    "scale word": (
        parameter('target = "body/bob:mass"\nscale = "gues"'),
        "parameters.m.scale … 'guess' … 'gues'",
    ),
    "no target": (
        parameter("guess = 1"),
        "parameters.m … exactly one of target, targets and inertial",
    ),
    "dead target": (
        parameter('targets = [{ path = "body/bob:mass", scale = 0 }]'),
        "parameters.m … scale is 0",
    ),
    "sigma text": (edited("state = 0.05", 'state = "loud"'), "noise.state … number … 'loud'"),
    "control weight": (
        edited("[cost]", "[cost]\ncontrol = -1"),
        "cost.control … greater than or equal to 0 … -1",
    ),
    "no control weight": (
        edited("[cost]", "[cost]\ncontrol = {}"),
        "cost.control … actuator 'force' has neither a weight nor a range … limits.control.force",
    ),
    "criterion c alone": (
        edited("[cost]", '[cost]\ncriterion = "c"'),
        "cost … exactly one of combination and subset",
    ),
    "combination of a stranger": (
        edited("[cost]", '[cost]\ncriterion = "c"\ncombination = { l = 1 }'),
        "cost.combination … wanted parameter 'l' … valid: m",
    ),
    "metric weight without the metric": (
        SHORT + "[descent]\npsi_weight = 1\n",
        "descent … psi_weight can only be given together with method",
    ),
    "nuisance false": (SHORT + "[nuisance]\ndelay = false\n", "nuisance.delay … True"),
    "robust over": (
        SHORT + '[robust]\nover = "best"\n',
        "robust.over … 'mean' or 'worst' … 'best'",
    ),
    "robust without knowledge": (SHORT + "[robust]\n", "robust … state `prior` or `bounds`"),
    "earlier": ('earlier = ["gone.json"]\n' + SHORT, "earlier … gone.json … cannot read"),
    "earlier that is no file of ours": (
        'earlier = ["cart_pendulum.csv"]\n' + SHORT,
        "earlier … cart_pendulum.csv … not a JSON file",
    ),
    "qpos length": (
        edited('keyframe = "hanging"', "qpos = [0, 0, 0]"),
        "initial.qpos … 3 numbers … this model needs 2",
    ),
    "keyframe and qpos": (
        edited('keyframe = "hanging"', 'keyframe = "hanging"\nqpos = [0, 0]'),
        "initial … either keyframe or qpos",
    ),
    "signal kind": (
        control('{ kind = "noise" }'),
        "initial.control … 'constant', 'sine', 'chirp' … noise",
    ),
}

# The same, with the kind of the error, where it is not one of the experiment file.
OTHER_FAULTS: dict[str, tuple[str, type[MjfimError], str]] = {
    "model missing": (
        edited("cart_pendulum.xml", "gone.xml"),
        ModelError,
        "bad.toml … : model:  … gone.xml: no such model file … folder of the experiment file",
    ),
    "model not XML": (
        edited("cart_pendulum.xml", "text.xml"),
        ModelError,
        "text.xml … MuJoCo cannot read … XML",
    ),
    "timestep not a number": (
        edited("cart_pendulum.xml", "nan.xml"),
        ModelError,
        "nan.xml … NaN … finite",
    ),
    "table missing": (control('"gone.csv"'), RecordingError, "gone.csv … no such file"),
    "table columns": (
        control('"columns.csv"'),
        RecordingError,
        "columns.csv … 'force' … expected columns: t, force … t, forc",
    ),
    "table NaN": (control('"nan.csv"'), RecordingError, "nan.csv … 'force' … row 2 … finite"),
    "table too short": (
        control('"short.csv"'),
        RecordingError,
        "short.csv … too few rows … 3 rows … 0 ... 1 s … 100 samples",
    ),
    "table repeats t": (
        control('"repeated.csv"'),
        RecordingError,
        "repeated.csv … 't' must increase",
    ),
    "dead target with a guess": (
        parameter('guess = 1.0\ntargets = [{ path = "body/bob:mass", scale = 0 }]'),
        MjfimError,
        "parameters.m … scale is 0",
    ),
    "two parameters for one number": (
        SHORT + '[parameters.n]\ntarget = "body/bob:mass"\n',
        MjfimError,
        "parameters.n … body/bob:mass",
    ),
    "negative signal seed": (
        control('{ kind = "multisine", seed = -1 }'),
        MjfimError,
        "initial.control.seed … -1",
    ),
    "column twice": (control('"twice.csv"'), MjfimError, "twice.csv … force"),
    "table not UTF-8": (control('"latin.csv"'), MjfimError, "latin.csv"),
}


@pytest.mark.parametrize(
    ("text", "kind", "parts"),
    [
        *((text, ExperimentError, f"{HOME} … {parts}") for text, parts in FAULTS.values()),
        *OTHER_FAULTS.values(),
    ],
    ids=[*FAULTS, *OTHER_FAULTS],
)
def test_faults_are_named(text: str, kind: type[MjfimError], parts: str, resolve: Resolve) -> None:
    with pytest.raises(kind) as caught:
        resolve(text)
    message = str(caught.value)
    if kind is ExperimentError:
        assert "\n" not in message
    if kind is not MjfimError:
        assert parts.split(" … ")[0] in message.splitlines()[0].split(": ")[0]
    assert unsaid(parts, message) == []


def test_a_free_control_is_named_by_its_actuator(resolve: Resolve) -> None:
    with pytest.raises(ExperimentError, match=r"cost\.control_about: .*actuator 'motor'.*force"):
        _ = resolve(edited("[cost]", "[cost]\ncontrol_about = { motor = 1 }")).problem


def test_the_short_experiment_has_no_fault(resolve: Resolve) -> None:
    """Every fault above is the only one in its file."""
    assert resolve(SHORT).samples == 100


@pytest.mark.parametrize(
    ("data", "fragment"),
    [
        (b"model = \n", "Invalid value"),
        (b'model = "a.xml"\nmodel = "b.xml"\n', "Cannot overwrite a value"),
        (b'model = "\xff.xml"\n', "utf-8"),
    ],
)
def test_not_toml(data: bytes, fragment: str, tmp_path: Path) -> None:
    path = tmp_path / "broken.toml"
    path.write_bytes(data)
    with pytest.raises(ExperimentError) as caught:
        Experiment.from_file(path)
    assert str(caught.value).startswith(f"{path}: not valid TOML: ")
    assert fragment in str(caught.value)


@pytest.mark.parametrize("name", ["log.csv", "log.npz"])
def test_a_log_in_place_of_an_experiment_is_named_as_one(name: str, tmp_path: Path) -> None:
    """The arguments are in the wrong order."""
    (tmp_path / name).write_bytes(b"t,ctrl:force\n0,1\n" if name == "log.csv" else b"PK\x03\xff")
    with pytest.raises(ExperimentError, match=rf"{name}: a log, but an experiment file \(TOML\)"):
        Experiment.from_file(tmp_path / name)


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(
        ExperimentError, match=r"gone\.toml: cannot read the experiment file: No such file"
    ):
        Experiment.from_file(tmp_path / "gone.toml")
    with pytest.raises(ExperimentError, match=r"cannot read the experiment file: Is a directory"):
        Experiment.from_file(tmp_path)


def test_all_faults_at_once(resolve: Resolve) -> None:
    with pytest.raises(ExperimentError) as caught:
        resolve(
            edited("rate = 100.0", "rate = -1.0")
            .replace("state = 0.05", "state = 0")
            .replace("[cost]", "[cst]")
        )
    lines = str(caught.value).splitlines()
    assert len(lines) == 3
    assert all(HOME in line for line in lines)
    assert {"rate", "noise.state", "cst"} == {line.split(": ")[1] for line in lines}


@pytest.mark.parametrize(
    ("key", "value", "fragment"),
    [
        ("descent.starts", "true", "integer"),
        ("descent.starts", '"3"', "should be an integer"),
        ("descent.repeats", "[true]", "integer"),
        ("descent.coarse", "true", "integer"),
        ("fit.bootstrap", "10.0", "integer"),
        ("limits.enforce", "1", "true or false"),
        ("limits.enforce", '"no"', "true or false"),
    ],
)
def test_integers_and_truth_values_are_not_converted(
    key: str, value: str, fragment: str, resolve: Resolve
) -> None:
    """A number of starts is no truth value and no text, and a truth value is neither 1 nor "no"."""
    table, _, name = key.partition(".")
    with pytest.raises(ExperimentError, match=rf"{key}(\.0)?: .*{fragment}"):
        resolve(f"{SHORT}\n[{table}]\n{name} = {value}\n")


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (
            SHORT + "[limits]\n" + "".join(f"k{i} = 1.0\n" for i in range(5000)),
            "limits.k0: unknown key 'k0'; valid: acceleration, angular_velocity … further faults",
        ),
        (SHORT + f"[limits]\n{'x' * 2000} = 1.0\n", "limits.xxx … the beginning of 2002 char"),
        (
            edited("rate = 100.0", f"rate = '{'x' * 100_000}'"),
            "rate: should be a number … the beginning of 100002 characters",
        ),
    ],
    ids=["many faults", "long key", "long value"],
)
def test_messages_stay_short(text: str, parts: str, resolve: Resolve) -> None:
    """Long texts of the user are shortened, and of many faults the first ones are described."""
    with pytest.raises(ExperimentError) as caught:
        resolve(text)
    message = str(caught.value)
    assert len(message.replace(HOME, "")) < 1000
    assert unsaid(parts, message) == []


def described_tables(annotation: Any) -> set[type[Section]]:
    """Every table of the experiment file that a type holds, at any depth."""
    if isinstance(annotation, type) and issubclass(annotation, Section):
        members = [field.annotation for field in annotation.model_fields.values()]
        return {annotation}.union(*(described_tables(member) for member in members))

    return set().union(*(described_tables(member) for member in get_args(annotation)))


def test_every_key_has_a_description() -> None:
    """Each description is a sentence in plain text, for the reference page and the editors."""
    tables = described_tables(Experiment)

    assert len(tables) == 19
    for table in tables:
        for key, field in table.model_fields.items():
            assert field.description, f"{table.__name__}.{key}"
            assert field.description.endswith("."), f"{table.__name__}.{key}"


def test_json_schema_states_the_keys_of_a_file() -> None:
    """The schema is JSON, and leaves out what only Python can state."""
    schema = json.loads(json.dumps(json_schema()))
    keys = {key for key, field in Experiment.model_fields.items() if not field.exclude}
    assert set(schema["properties"]) == keys
    assert "function" not in schema["$defs"]["ParameterSpec"]["properties"]


@pytest.mark.parametrize("values", [{}, {"parameters": {}}, {"model": 3}])
def test_faults_in_python_are_experiment_errors(values: dict[str, Any]) -> None:
    """Without a file the message names the experiment."""
    with pytest.raises(ExperimentError, match=r"^experiment: model: "):
        Experiment(**values)


@pytest.mark.parametrize(
    ("initial", "fragment"),
    [
        ({}, 'for example control = { kind = "multisine", amplitude = 1.0 } in [initial], about'),
        ({"keyframe": "hanging"}, "about the control of the keyframe 'hanging', or control = {"),
    ],
)
def test_a_missing_control_is_proposed(
    initial: dict[str, Any], fragment: str, folder: Path
) -> None:
    values = {"model": "cart_pendulum.xml", "rate": 100.0, "horizon": 1.0}
    parameters = {"m": {"target": "body/bob:mass"}}
    stated = Experiment(**values, initial=initial, parameters=parameters, directory=folder)
    with pytest.raises(ExperimentError) as error:
        DesignTask.resolve(stated)
    assert fragment in str(error.value)
    assert "`mjfim init cart_pendulum.xml`" in str(error.value)


def test_a_reserve_can_be_stated_for_every_kind_of_limit() -> None:
    assert get_args(LimitKind) == (*KINDS, "clearance")
