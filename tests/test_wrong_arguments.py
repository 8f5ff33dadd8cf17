"""Public functions refuse a wrong argument with one message, never with an error of Python."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.errors import ExperimentError, MjfimError
from mjfim.records.terms import Selection
from mjfim.records.trajectory import Labels
from tests.support.paths import ROOT

CART = ROOT / "models" / "cart_pendulum.xml"

# Functions, and those of the classes that users make, with the least number of refused values.
FUNCTIONS = [
    *(getattr(mjfim, name) for name in mjfim.__all__ if name[0].islower()),
    *(mjfim.Experiment.from_file, mjfim.Experiment, mjfim.Meter, mjfim.Recording),
]
LEAST_REFUSED = 20


def stopped() -> mjfim.StopToken:
    """A token that ends every search at once."""
    token = mjfim.StopToken()
    token.request()
    return token


@pytest.fixture(scope="module")
def valid() -> dict[str, Any]:
    """Valid arguments by name, with which each call takes little time."""
    experiment = mjfim.Experiment(
        model=CART,
        rate=25.0,
        horizon=0.2,
        initial={"control": {"kind": "multisine"}},
        parameters={"m": {"target": "body/bob:mass", "wanted": 1.0}},
        noise={"state": 0.001},
        descent={"max_iterations": 1, "coarse": 1},
        rehearsal={"robots": 1},
        fit={"max_iterations": 1, "bootstrap": 100},
    )
    recording = mjfim.simulate(experiment)
    design = mjfim.design(experiment, progress=False)
    estimate = mjfim.identify(experiment, recording, progress=False)
    return {
        **{
            "model": CART,
            "unknown": ["body/b*:mass"],
            "horizon": 0.5,
            "parameters": ["body/b*:mass"],
        },
        **{"experiment": experiment, "experiments": [experiment] * 2, "rate": 25.0},
        **{"recordings": recording, "design": design, "trajectory": design, "result": design},
        **{"estimate": estimate, "first": estimate, "second": estimate, "measure": lambda *_: None},
        **{"theta": [1.0], "count": 1, "rng": np.random.default_rng(0), "to": "player"},
        **{"selection": Selection(terms=(), steps=(), ending=""), "address": "127.0.0.1:1"},
        **{"path": Path("file"), "progress": False, "threads": 1, "stop": stopped()},
        **{"trials": 2, "seconds": 0.01, "rounds": 1, "max_terms": 0, "longest": 0.2},
        **{"t": [0.0, 1.0], "ctrl": np.zeros((1, 1)), "y": np.zeros((2, 1)), "outputs": ("qpos",)},
        **{"say": lambda _: None},
    }


def wrong_kinds(folder: Path) -> list[Any]:
    """Values of many kinds, some of which some argument takes."""
    one = np.zeros((2, 1))
    trajectory = mjfim.Trajectory(t=[0, 1], qpos=one, qvel=one, act=one, ctrl=one[1:])
    return [
        *(None, -1, 10**9, float("nan"), float("inf"), 1 + 1j, True, "", "text", "a\0b", b"bytes"),
        *([], [object()], ["text"], (), {}, {"text": object()}, {1: 2}, {"t": [0.0], "ctrl": None}),
        *(np.zeros(3), np.zeros((2, 2, 2)), np.array(["text"]), np.array([np.nan])),
        *(Path("nothing"), folder, folder / "some.toml", object(), lambda *_: None, iter([])),
        *(Labels(qpos=(), positions=(), velocities=(), controls=()), trajectory),
    ]


@pytest.mark.parametrize("function", FUNCTIONS, ids=lambda each: each.__qualname__)
def test_a_wrong_argument_is_refused_in_words(
    function: Callable[..., Any],
    valid: dict[str, Any],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each argument is given each kind of value: there is a result or an error of mjfim."""
    (tmp_path / "some.toml").write_text("[table]")
    monkeypatch.chdir(tmp_path)
    names = inspect.signature(function).parameters
    given = {name: value for name, value in valid.items() if name in names}
    refused = 0
    for name in names:
        for wrong in wrong_kinds(tmp_path):
            try:
                found = function(**{**given, name: wrong})
                # Without an address, a viewer would be opened.
                if isinstance(found, AbstractContextManager) and (name, wrong) != ("address", None):
                    found.__enter__()
                    found.__exit__(None, None, None)
            except MjfimError:
                refused += 1

    assert refused >= LEAST_REFUSED


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda e: mjfim.design(e, seconds="x"), r"seconds: needs number \| None; not 'x'"),
        (lambda e: mjfim.simulate(e, seed=-1), r"seed: needs whole number from 0 \| .*; not -1"),
        (lambda e: mjfim.design(None), r"experiment: needs Experiment \| str \| Path; not None"),
        (lambda e: mjfim.identify(e, method="x"), "method: needs 'least_squares' .* 'newton'; not"),
        (lambda e: mjfim.simulate(e, 3), r"needs Trajectory \| Design \| array of numbers \| None"),
        (lambda e: mjfim.design(e, second=3), "design: got an unexpected .* 'second'"),
        (lambda e: mjfim.evaluate(), "evaluate: missing a required argument: 'experiment'"),
        (lambda e: mjfim.predict(e, [1.0, 2.0], []), "theta: .* expected one per parameter: m"),
        (lambda e: mjfim.identify(e, t=[0.0], q=[0.0]), "unknown argument 'q'; valid: ctrl, qpos"),
        (
            lambda e: mjfim.compare_estimates(e, e),
            "first: needs Estimate; not an object of",
        ),
    ],
)
def test_messages_say_what_would_be_right(
    call: Callable[[Any], Any], message: str, valid: dict[str, Any]
) -> None:
    with pytest.raises(ExperimentError, match=message):
        call(valid["experiment"])


def test_a_design_of_another_model_is_refused(valid: dict[str, Any]) -> None:
    design = valid["design"]
    two_motors = replace(design.trajectory, ctrl=np.zeros((design.trajectory.samples, 2)))
    other = replace(design, final=replace(design.final, trajectory=two_motors))
    for verb in (mjfim.worth, mjfim.rehearse):
        with pytest.raises(MjfimError, match=r"the design: made for .* = \(2, 2, 0, 2\)"):
            verb(valid["experiment"], other)
