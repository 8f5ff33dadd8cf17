"""The names at the top of the package, and the messages for names of earlier versions."""

from __future__ import annotations

import pydoc
from typing import Any

import pytest

import mjfim
from mjfim.errors import explain_renamed_arguments
from tests.support.paths import MODELS

# Functions that report their progress to `callback`.
VERBS_WITH_CALLBACK = (
    "assess_robustness",
    "compare",
    "design",
    "design_jointly",
    "identify",
    "identify_payload",
    "monte_carlo",
    "run_campaign",
    "shortest_experiment",
)


def test_all_public_names_exist() -> None:
    for name in mjfim.__all__:
        assert getattr(mjfim, name) is not None


def test_help_describes_the_public_names_only() -> None:
    text = pydoc.render_doc(mjfim, renderer=pydoc.plaintext)
    assert "optimal experiment design" in text
    assert [name for name in mjfim.__all__ if name not in text] == []
    assert [name for name in ("import_module", "RENAMED", "MODULES") if name in text] == []


def test_progress_is_true_or_false_and_no_function_any_more() -> None:
    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml")
    with pytest.raises(TypeError, match=r"progress.*callback"):
        mjfim.design(experiment, progress=print)  # type: ignore[arg-type]
    short = experiment.replace(horizon=0.2, descent={"max_iterations": 0})
    assert mjfim.design(short, progress=False).iterations == 0


@pytest.mark.parametrize(("old", "new"), mjfim.RENAMED.items())
def test_an_old_name_is_an_error_that_names_the_new_one(old: str, new: str) -> None:
    assert old not in mjfim.__all__
    assert new in mjfim.__all__
    with pytest.raises(ImportError, match=f"{old}.*{new}"):
        getattr(mjfim, old)
    with pytest.raises(ImportError, match=f"{old}.*{new}"):
        exec(f"from mjfim import {old}")


def test_the_setup_of_earlier_versions_is_an_error_that_names_system_and_task() -> None:
    with pytest.raises(ImportError, match=r"Setup.*System.*DesignTask"):
        mjfim.Setup  # noqa: B018 - the attribute does not exist


def test_an_unknown_name_is_an_ordinary_error() -> None:
    with pytest.raises(AttributeError, match=r"no attribute 'desing'$"):
        getattr(mjfim, "desing")  # noqa: B009 - the name does not exist


@pytest.mark.parametrize("old", ["monitor", "tell", "progress"])
@pytest.mark.parametrize("verb", VERBS_WITH_CALLBACK)
def test_an_old_argument_is_an_error_that_names_the_new_one(verb: str, old: str) -> None:
    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml")
    with pytest.raises(TypeError, match=f"{old}.*callback"):
        getattr(mjfim, verb)(experiment, **{old: print})


def test_the_old_name_of_the_initial_control_is_an_error_that_names_the_new_one() -> None:
    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml")
    with pytest.raises(TypeError, match=r"start.*initial_control"):
        mjfim.design(experiment, start=None)  # type: ignore[call-arg]


def test_an_argument_that_the_function_has_is_passed_on() -> None:
    @explain_renamed_arguments
    def function(*, report: Any, callback: Any = None) -> Any:
        return report

    assert function(report=3) == 3
