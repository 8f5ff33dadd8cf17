"""Terms of one kind that several joints lack are tested and added together."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.experiment.initial import multisine
from mjfim.experiment.system import System
from mjfim.identification.assessment.term_tests import (
    MAX_NAMED_TERMS,
    TermTests,
    find_missing_terms,
    first_terms,
)
from mjfim.identification.fit_problem import FitProblem
from mjfim.records.terms import Term, TermNumber
from mjfim.records.trajectory import Recording
from tests.support.terms import recorded, solution_near

JOINTS = ("pan", "lift", "roll")
EXCESS = (0.5, 0.4, 0.1)
RATE = 200.0

ARM = """<mujoco><option timestep="0.005" integrator="implicitfast" gravity="0 0 -9.81"/>
<worldbody>
  <body><joint name="pan" axis="0 0 1" armature="0.05" frictionloss="0.6"/>
    <inertial pos="0 0 0.1" mass="3" diaginertia="0.02 0.02 0.02"/>
    <body pos="0 0 0.2"><joint name="lift" axis="0 1 0" armature="0.05" frictionloss="0.5"/>
      <inertial pos="0 0 0.15" mass="2" diaginertia="0.02 0.02 0.01"/>
      <body pos="0 0 0.3"><joint name="roll" axis="1 0 0" armature="0.01" frictionloss="0.15"/>
        <inertial pos="0 0.02 0.1" mass="0.6" diaginertia="0.004 0.004 0.002"/>
      </body></body></body>
</worldbody><actuator>
  <position name="pan" joint="pan" kp="300" kv="12"/>
  <position name="lift" joint="lift" kp="300" kv="12"/>
  <position name="roll" joint="roll" kp="60" kv="2"/>
</actuator><sensor>
  <actuatorfrc name="t_pan" actuator="pan"/>
  <actuatorfrc name="t_lift" actuator="lift"/>
  <actuatorfrc name="t_roll" actuator="roll"/>
</sensor></mujoco>"""


def stated(folder: Path) -> mjfim.Experiment:
    """The arm with unknown friction."""
    (folder / "arm.xml").write_text(ARM, encoding="utf-8")
    parameters: dict[str, Any] = {}
    for joint in JOINTS:
        parameters[f"friction {joint}"] = {"target": f"joint/{joint}:frictionloss"}
        parameters[f"damping {joint}"] = {"target": f"joint/{joint}:damping", "scale": 0.5}
    noise = {f"qpos:{joint}": 1e-4 for joint in JOINTS} | {f"t_{joint}": 0.03 for joint in JOINTS}
    return mjfim.Experiment(
        model="arm.xml",
        directory=folder,
        source="arm.toml",
        rate=RATE,
        parameters=parameters,
        noise=noise,
        fit={"bootstrap": 0},
    )


def with_stribeck(experiment: mjfim.Experiment) -> mjfim.Experiment:
    """The arm with Stribeck friction at all joints."""
    terms = {}
    for joint, excess in zip(JOINTS, EXCESS, strict=True):
        values = {"excess": excess, "speed": 0.15}
        terms[f"s_{joint}"] = {"kind": "stribeck", "joint": joint, "values": values}
    return experiment.replace(terms=terms)


def log_of(experiment: mjfim.Experiment, seed: int) -> Recording:
    """A recording of 3 s with noise under a slow multisine."""
    system = System.resolve(experiment, threads=1)
    control = 0.4 * multisine(np.arange(600) / RATE, 3, 0.3, 4, np.random.default_rng(seed))
    return recorded(system, control, seed, theta=system.parameters.guess)


def term_tests(experiment: mjfim.Experiment, log: Recording) -> TermTests:
    """Tests of the terms that the stated model lacks."""
    system = System.resolve(experiment, threads=1)
    problem = FitProblem.of(system, [log])
    return find_missing_terms(problem, solution_near(problem, system.parameters.guess))


@pytest.mark.slow
def test_friction_that_all_joints_lack_is_named_first_and_as_one_term(tmp_path: Path) -> None:
    experiment = stated(tmp_path)
    tests = term_tests(experiment, log_of(with_stribeck(experiment), 0))
    first = tests.terms[0]
    assert first.description == "Stribeck friction at 3 joints"
    assert set(first.joints) == set(JOINTS)
    assert len(first.tables) == 3
    assert np.isfinite(first.sigmas)

    # The test estimates the size at every joint.
    values = {each.path: each.value for each in first.numbers}
    for joint, excess in zip(JOINTS, EXCESS, strict=True):
        assert 0.3 < values[f"term/{joint}_stribeck:excess"] / excess < 3.0

    # The recipe says what to add at the first joint, and names the others.
    _, *others = first.joints
    assert first.recipe.endswith(f"# The same for {', '.join(others)}.")
    assert len(tomllib.loads(first.recipe)["parameters"]) == 2

    # An estimate names other effects in place of those of its single joints, which a selection
    # tries where this term is refuted.
    members = [term for term in tests.terms if first.contains(term)]
    assert members and not any(term in tests.named for term in members)
    assert len(tests.named) == MAX_NAMED_TERMS
    assert members[0] in tests.without({first.key}).named


def missing(path: str, *, sigmas: float, joints: tuple[str, ...] = ()) -> Term:
    """A significant term; one at several joints contains damping at them."""
    paths = [f"joint/{joint}:damping" for joint in joints[1:]]
    return Term(
        description=f"damping at {len(joints)} joints" if joints else path,
        numbers=tuple(
            TermNumber(path=each, value=1.0, unit="", scale=1.0, is_size=True)
            for each in (path, *paths)
        ),
        sigmas=sigmas,
        share=0.1,
        joints=joints,
    )


def test_terms_of_single_joints_take_no_place_of_other_terms() -> None:
    of_joints = missing("joint/pan:damping", sigmas=90.0, joints=JOINTS)
    singles = [missing(f"joint/{joint}:damping", sigmas=80.0 - i) for i, joint in enumerate(JOINTS)]
    others = [missing(f"other {i}", sigmas=20.0 - i) for i in range(5)]

    # A selection may try them all; an estimate names other effects.
    tests = TermTests(terms=first_terms([of_joints, *singles, *others]))
    assert tests.terms == (of_joints, *singles, *others[:3])
    assert tests.named == (of_joints, *others[:3])
    assert tests.without({of_joints.key}).named == (*singles, others[0])

    # A more significant term of one joint is named besides.
    tests = TermTests(terms=first_terms([singles[0], of_joints, *singles[1:], *others]))
    assert tests.named == (singles[0], of_joints, *others[:2])
