"""Messages stay short with very many parameters, outputs, joints and bodies."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import mjfim
from mjfim.errors import ExperimentError, MjfimError, UnidentifiableError
from mjfim.excitation.shortest_horizon import require_reachable
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.identification.starts import divergence_at_start
from mjfim.output.campaign_folder import accuracy_sentence
from mjfim.records.check import (
    ParameterGroup,
    groups_in_words,
)
from mjfim.records.rehearsal import FiniteSteps
from mjfim.records.studies import missed_targets

# Longest message [characters].
LONGEST_MESSAGE = 600

# Number of joints of a model.
MANY = 40

# Names of many parameters, of which a message shows the first ones.
NAMES = tuple(f"inertia_of_link_{i}" for i in range(300))


# ---- other messages about many parameters, joints, sensors or bodies

GROUP = ParameterGroup(
    members=NAMES,
    combinations=tuple(
        dict(zip(NAMES, (1.0, *(0.1234 * (i + j) for j in range(1, 300))), strict=True))
        for i in range(50)
    ),
)
SILENT = ParameterGroup(members=NAMES, combinations=())
SHORT = ParameterGroup(
    members=("mass", "gravity"),
    combinations=({"mass": 1.0, "gravity": 2.0},),
)


STEPS = FiniteSteps(
    names=NAMES,
    predicted=np.ones(300),
    std=np.full(300, 3.0),
    length=np.ones(1),
    ratio=np.ones(1),
    causes=tuple(f"limit of {name}" for name in NAMES),
)
STD = np.linspace(2.0, 1.0, 300)
ESTIMATE = SimpleNamespace(parameters=NAMES, theta=np.ones(300), std=np.full(300, 0.1))


@pytest.mark.parametrize(
    "message",
    [
        GROUP.short,
        SILENT.short,
        groups_in_words([GROUP, SILENT, SHORT]),
        str(STEPS),
        missed_targets(NAMES, STD, np.full(300, 0.5)),
        accuracy_sentence(ESTIMATE, np.ones(300)),
    ],
)
def test_messages_of_records_are_short(message: str) -> None:
    require_short(message)


def test_files_are_whole_and_short_messages_are_not_shortened() -> None:
    for group in (GROUP, SILENT):
        assert all(name in group.summary()["words"] for name in NAMES)
    assert STEPS.summary()["causes"] == list(STEPS.causes)
    assert SHORT.short == str(SHORT) == "mass and gravity only as mass + 2 gravity"
    assert groups_in_words([SHORT, SHORT]) == f"{SHORT}; {SHORT}"
    assert missed_targets(NAMES[:2], STD[:2], np.array([3.0, 0.5])).startswith(NAMES[1])
    assert missed_targets(NAMES, STD, np.full(300, 3.0)) == ""
    assert accuracy_sentence(ESTIMATE, np.full(300, np.inf)) == ""


def require_short(message: str) -> None:
    """Require that a message lists the first names and counts the others."""
    assert len(message) < LONGEST_MESSAGE, message
    assert "inertia_of_link_0" in message and " more" in message, message


@pytest.mark.parametrize("combinations", [(str(GROUP),), (str(SHORT),) * 40, ()])
def test_targets_out_of_reach_are_short(combinations: tuple[str, ...]) -> None:
    task = SimpleNamespace(
        parameters=SimpleNamespace(names=NAMES), experiment=SimpleNamespace(source="robot.toml")
    )
    design = SimpleNamespace(stated_std=np.full(300, np.inf), combinations=combinations)
    with pytest.raises(UnidentifiableError) as raised:
        require_reachable(task, design, np.ones(300))
    require_short(str(raised.value))


def test_a_diverging_start_lists_the_first_values() -> None:
    system = SimpleNamespace(
        parameters=SimpleNamespace(names=NAMES), channels=SimpleNamespace(control_columns=())
    )
    task = SimpleNamespace(system=system, start=np.ones(300), recordings=())
    error = divergence_at_start(task, SimpleNamespace(), "the output angle is 1e9 at 2 s")
    assert "inertia_of_link_0 = 1, " in str(error)
    require_short(str(error))


@pytest.fixture
def many_joints(tmp_path: Path) -> Path:
    """An experiment with many ball joints and the damping of each as a parameter."""
    bodies = "".join(
        f'<body name="link_{i}" pos="{i} 0 0"><joint name="ball_{i}" type="ball"/>'
        f'<geom size="0.1" mass="1" contype="0"/></body>'
        for i in range(MANY)
    )
    motors = '<motor name="motor" joint="ball_0" gear="1 0 0"/>'
    (tmp_path / "many.xml").write_text(
        f'<mujoco><option timestep="0.01" gravity="0 0 0"/><worldbody>{bodies}</worldbody>'
        f"<actuator>{motors}</actuator></mujoco>",
        encoding="utf-8",
    )
    parameters = "".join(
        f'[parameters.damping_{i}]\ntarget = "joint/ball_{i}:damping"\nguess = 1.0\n'
        for i in range(MANY)
    )
    path = tmp_path / "many.toml"
    path.write_text(
        'model = "many.xml"\nrate = 50.0\nhorizon = 0.1\n'
        '[initial]\ncontrol = { kind = "sine", amplitude = 1.0, frequency = 2.0 }\n'
        f"{parameters}[noise]\nstate = 0.01\n",
        encoding="utf-8",
    )
    return path


@pytest.mark.parametrize(
    ("table", "named"),
    [
        ("[limits]\nvelocity = { ball = 1.0 }\n", "'ball'"),
        ("[limits]\nposition = { ball_7 = [-1.0, 1.0] }\n", "ball_7"),
        ("[limits]\nposition = { hinge = [-1.0, 1.0] }\n", "'hinge'"),
        ('[cost]\ncriterion = "c"\nsubset = []\n', "damping_0"),
        ('[cost]\ncriterion = "c"\nsubset = ["mass"]\n', "damping_0"),
        ("[tracking]\nhinge = 1.0\n", "tracking"),
    ],
)
def test_faults_of_an_experiment_with_many_joints_are_short(
    many_joints: Path, table: str, named: str
) -> None:
    text = many_joints.read_text(encoding="utf-8")
    many_joints.write_text(f"{text}{table}", encoding="utf-8")
    with pytest.raises(ExperimentError) as raised:
        DesignTask.resolve(Experiment.from_file(many_joints))
    message = str(raised.value)
    assert len(message) < LONGEST_MESSAGE and named in message, message


def test_what_verbs_say_about_many_parameters_is_short(many_joints: Path) -> None:
    """Most joints never move, so that a check and a design have to say which do not."""
    experiment = Experiment.from_file(many_joints)
    fewer = experiment.model_copy(update={"parameters": dict([*experiment.parameters.items()][1:])})
    log = mjfim.simulate(experiment, DesignTask.resolve(experiment).initial, seed=0)
    said = [max(mjfim.check(experiment).findings, key=len)]
    for call in (
        lambda: mjfim.design(experiment),
        lambda: mjfim.identify(experiment, [log], start=np.zeros(2)),
        lambda: mjfim.design_jointly([experiment, fewer]),
    ):
        with pytest.raises(MjfimError) as raised:
            call()
        said.append(str(raised.value))
    for message in said:
        assert len(message) < LONGEST_MESSAGE and " more" in message, message
