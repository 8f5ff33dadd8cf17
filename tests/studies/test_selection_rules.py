"""When a selection repeats tests of terms, and when it tries terms again at the final fit."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mjfim.budget import Budget
from mjfim.identification.held_out_losses import Reduction
from mjfim.identification.missing_terms import TermTests
from mjfim.records.missing_term import MissingTerm
from mjfim.records.selection import Decision, SelectionStep
from mjfim.studies import selection
from mjfim.studies.selection import EQUAL_COST, _Selector


@dataclass(frozen=True)
class Problem:
    """A problem of some segments whose cost is known."""

    value: float = 100.0
    segments: tuple[int, ...] = (0, 1)
    noise: str = "stated"

    def with_noise(self, noise: str) -> Problem:
        assert noise == "stated"
        return self

    def cost(self, at: object) -> float:
        return self.value


@dataclass(frozen=True, eq=False)
class Solution:
    """A solution without any values."""

    unknowns: None = None


@dataclass(frozen=True)
class Quality:
    """Quality of a fit."""

    unexplained: tuple[str, ...] = ()


@dataclass(frozen=True)
class Result:
    """A fit."""

    problem: Problem = field(default_factory=Problem)
    solution: Solution = field(default_factory=Solution)
    quality: Quality = field(default_factory=Quality)


@dataclass(frozen=True)
class Model:
    """A model that a selection compares."""

    result: Result = field(default_factory=Result)
    cost: float = 100.0
    tests: TermTests | None = field(default_factory=TermTests)
    is_changed: bool = True


def selector() -> _Selector:
    """A selector whose budget is not exhausted."""
    return _Selector(held_out=(), budget=Budget(), callback=None, workers=None, max_terms=6)


FINAL = {
    "as it was fitted in the selection": (Result(), True),
    "nearly as good": (Result(problem=Problem(100.0 - 0.9 * EQUAL_COST)), True),
    "much better": (Result(problem=Problem(100.0 - 1.1 * EQUAL_COST)), False),
    "much worse": (Result(problem=Problem(100.0 + 1.1 * EQUAL_COST)), False),
    "over segments": (Result(problem=Problem(segments=(0, 1, 2))), False),
    "unexplained": (Result(quality=Quality(unexplained=("angle",))), False),
}


@pytest.mark.parametrize("name", FINAL)
def test_tests_of_terms_hold_at_a_final_fit_that_is_as_good(name: str) -> None:
    model: Any = Model()
    final: Any
    final, holds = FINAL[name]
    found = selector()._tests_of(model, final, model)
    assert found is (model.tests if holds else None)


def test_tests_that_were_not_made_do_not_hold() -> None:
    model: Any = Model(tests=None)
    assert selector()._tests_of(model, model.result, model) is None


def test_tests_do_not_hold_after_a_request_to_stop() -> None:
    model: Any = Model()
    stopped = selector()
    assert stopped._tests_of(model, model.result, model) is model.tests
    stopped.budget.stop.request()
    assert stopped._tests_of(model, model.result, model) is None


@pytest.mark.parametrize(
    ("is_changed", "holds", "tries"),
    [(True, False, True), (True, True, False), (False, False, False)],
)
def test_terms_are_tried_again_where_the_tests_do_not_hold_at_the_final_fit(
    monkeypatch: pytest.MonkeyPatch, is_changed: bool, holds: bool, tries: bool
) -> None:
    model: Any = Model(is_changed=is_changed)
    final: Any = Result(problem=Problem(100.0 if holds else 50.0))
    refuted = SelectionStep(
        decision=Decision.REJECTED, description="a spring", path="spring", error=1.0, reduction=-0.1
    )
    asked: list[Any] = []

    def grown(
        self: _Selector, model: Any, first: Any, steps: list[SelectionStep], refuted: Any
    ) -> tuple[Any, str]:
        """Keep the arguments."""
        asked.append((model, set(refuted)))
        return model, "tried again"

    monkeypatch.setattr(selection._Selector, "_grown", grown)
    found, ending = selector()._completed(model, model, final, [refuted], "before")
    assert found.result is final
    assert ending == ("tried again" if tries else "before")

    # Terms that left-out data have refuted are not tried a second time.
    assert [keys for _, keys in asked] == ([{refuted.key}] if tries else [])


@pytest.mark.parametrize(("cost", "predicts"), [(99.0, True), (100.0, False), (120.0, False)])
def test_left_out_data_are_predicted_only_with_terms_that_fit_better(
    monkeypatch: pytest.MonkeyPatch, cost: float, predicts: bool
) -> None:
    names = SimpleNamespace(names=("mass",))
    task = SimpleNamespace(system=SimpleNamespace(parameters=names))
    losses = SimpleNamespace(
        error=1.0, reduction=lambda other: Reduction(mean=0.5, standard_error=0.1)
    )
    model: Any = SimpleNamespace(
        result=SimpleNamespace(task=task, theta=np.ones(1)), cost=100.0, terms=(), losses=losses
    )
    extended: Any = SimpleNamespace(terms=("friction",), losses=losses)
    candidate = MissingTerm(
        description="dry friction of hinge",
        path="joint/hinge:frictionloss",
        value=0.1,
        unit="N m",
        sigmas=9.0,
        share=0.4,
    )
    fit: Any = selection._Refit(model=model, result=model.result, cost=cost)
    monkeypatch.setattr(_Selector, "_refitted", lambda *_, **__: fit)
    asked: list[Any] = []

    def assessed(self: _Selector, fit: Any, first: Any) -> Any:
        """Keep the fit."""
        asked.append(fit)
        return extended

    monkeypatch.setattr(_Selector, "_assessed", assessed)
    steps: list[SelectionStep] = []
    found = selector()._tried(model, model, candidate, steps)
    assert bool(asked) == predicts
    if predicts:
        assert found is not None and found[0] is extended
        assert found[1].reduction == 0.5
        assert not steps
        return
    assert found is None
    (step,) = steps
    assert step.decision is Decision.UNHELPFUL
    assert (step.path, step.count, step.sigmas) == (candidate.path, 0, 9.0)
    assert np.isnan(step.error)
