"""Messages stay short with very many parameters, outputs, joints and bodies."""

from __future__ import annotations

import itertools
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from mjfim.errors import ExperimentError, UnidentifiableError
from mjfim.excitation.design import _require_common_parameters
from mjfim.excitation.evaluation import require_designable
from mjfim.excitation.shortest_horizon import require_reachable
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.identification.assessment.report import _limits_of_search
from mjfim.identification.search import _start
from mjfim.identification.starts import divergence_at_start
from mjfim.output.campaign_folder import accuracy_sentence
from mjfim.records.campaign import missed_targets
from mjfim.records.check import (
    Combination,
    ConfoundedPair,
    ParameterGroup,
    SelfTest,
    groups_in_words,
    verdict_of_check,
)
from mjfim.records.rehearsal import FiniteSteps

# Longest message [characters].
LONGEST_MESSAGE = 600

# Number of joints of a model.
MANY = 60

# Names of many parameters, of which a message shows the first ones.
NAMES = tuple(f"inertia_of_link_{i}" for i in range(300))


def test_warnings_about_many_parameters_list_the_first_ones_and_count_the_others() -> None:
    result = SimpleNamespace(
        task=SimpleNamespace(elsewhere=(), noise_is_stated=False),
        touches="",
        begun_instead="",
        quality=SimpleNamespace(chi2=1.0, dof=1),
        accuracy=SimpleNamespace(singular=False),
    )
    (warning,) = _limits_of_search(result, NAMES, (), interrupted=False)
    assert len(warning) < LONGEST_MESSAGE
    assert "inertia_of_link_0" in warning and " more" in warning


def test_a_start_of_wrong_length_lists_the_first_parameters() -> None:
    system = SimpleNamespace(parameters=SimpleNamespace(guess=np.zeros(300), names=NAMES))
    with pytest.raises(ExperimentError) as raised:
        _start(system, "least_squares", np.zeros(2))
    assert len(str(raised.value)) < LONGEST_MESSAGE


# ---- other messages about many parameters, joints, sensors or bodies

GROUP = ParameterGroup(
    members=NAMES,
    combinations=tuple(
        Combination(members=NAMES, coefficients=(1.0, *(0.1234 * (i + j) for j in range(1, 300))))
        for i in range(50)
    ),
)
SILENT = ParameterGroup(members=NAMES, combinations=())
SHORT = ParameterGroup(
    members=("mass", "gravity"),
    combinations=(Combination(members=("mass", "gravity"), coefficients=(1.0, 2.0)),),
)


def require_short(message: str) -> None:
    """Require that a message lists the first names and counts the others."""
    assert len(message) < LONGEST_MESSAGE, message
    assert "inertia_of_link_0" in message and " more" in message, message


def test_groups_of_parameters_are_short_in_messages_and_whole_in_files() -> None:
    for group in (GROUP, SILENT):
        require_short(group.short)
        words = group.summary()["words"]
        assert all(name in words for name in NAMES)
    require_short(groups_in_words([GROUP, SILENT, SHORT]))
    assert SHORT.short == str(SHORT) == "mass and gravity only as mass + 2 gravity"
    assert groups_in_words([SHORT, SHORT]) == f"{SHORT}; {SHORT}"


def test_the_verdict_of_a_check_is_short() -> None:
    row = SimpleNamespace(
        nuisance=False, stated=True, std=1.0, wanted=0.5, unit="kg", repetitions=4, seconds=8.0
    )
    known = [SimpleNamespace(**{**vars(row), "name": name}) for name in NAMES]
    pairs = [
        ConfoundedPair(first=first, second=second, correlation=0.99)
        for first, second in itertools.pairwise(NAMES)
    ]
    findings = {
        "not_separable": (GROUP, SILENT),
        "not_excited": (GROUP, SILENT),
        "confounded": pairs,
        "refused": (),
        "violations": (),
        "self_test": SelfTest(recursion=0.0, slope=0.0),
        "source": "the initial control",
        "missing": (),
        "steps": None,
        "rehearsal": None,
    }
    for rows in (known, known[:1]):
        check = SimpleNamespace(rows=rows, **findings)
        sentences = list(verdict_of_check(check))
        assert max(map(len, sentences)) < LONGEST_MESSAGE
        assert sum(" more" in sentence for sentence in sentences) == 3


def test_the_causes_of_an_approximation_are_short() -> None:
    causes = tuple(f"limit of {name}" for name in NAMES)
    steps = FiniteSteps(
        names=NAMES,
        predicted=np.ones(300),
        std=np.full(300, 3.0),
        length=np.ones(1),
        ratio=np.ones(1),
        causes=causes,
    )
    require_short(str(steps))
    assert steps.summary()["causes"] == list(causes)


def test_missed_targets_are_short_with_the_worst_first() -> None:
    std, wanted = np.linspace(2.0, 1.0, 300), np.full(300, 0.5)
    require_short(missed_targets(NAMES, std, wanted))
    assert missed_targets(NAMES[:2], std[:2], np.array([3.0, 0.5])).startswith("inertia_of_link_1")
    assert missed_targets(NAMES, std, np.full(300, 3.0)) == ""


def test_the_estimates_of_a_round_are_short() -> None:
    estimate = SimpleNamespace(parameters=NAMES, theta=np.ones(300), std=np.full(300, 0.1))
    require_short(accuracy_sentence(estimate, np.ones(300)))
    assert accuracy_sentence(estimate, np.full(300, np.inf)) == ""


@pytest.mark.parametrize("combinations", [(str(GROUP),), (str(SHORT),) * 40, ()])
def test_targets_out_of_reach_are_short(combinations: tuple[str, ...]) -> None:
    task = SimpleNamespace(
        parameters=SimpleNamespace(names=NAMES), experiment=SimpleNamespace(source="robot.toml")
    )
    design = SimpleNamespace(stated_std=np.full(300, np.inf), combinations=combinations)
    with pytest.raises(UnidentifiableError) as raised:
        require_reachable(task, design, np.ones(300))
    require_short(str(raised.value))


def test_jointly_designed_experiments_with_different_parameters_are_named_shortly() -> None:
    tasks = [
        SimpleNamespace(parameters=SimpleNamespace(names=names)) for names in (NAMES, NAMES[:-1])
    ]
    with pytest.raises(ExperimentError) as raised:
        _require_common_parameters(tasks)
    require_short(str(raised.value))


def test_a_design_that_cannot_begin_says_why_shortly() -> None:
    parameters = [SimpleNamespace(name=name, group=None) for name in NAMES]
    task = SimpleNamespace(
        parameters=SimpleNamespace(parameters=parameters, interest=np.arange(300)),
        contrast=None,
        release=None,
    )
    silent = SimpleNamespace(silent=range(300))
    unexcited = {
        "along_all": SimpleNamespace(silent=(), basis=np.eye(300), count=0),
        "along_trajectory": SimpleNamespace(count=300),
        "groups_along_trajectory": (GROUP, SILENT, SHORT),
    }
    for found in (SimpleNamespace(along_all=silent), SimpleNamespace(**unexcited)):
        with pytest.raises(UnidentifiableError) as raised:
            require_designable(task, found)
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
    """An experiment with 60 ball joints and the damping of each as a parameter."""
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
