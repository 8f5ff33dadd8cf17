"""When a selection repeats tests of terms, and when it tries terms again at the final fit."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from mjfim.identification.held_out_losses import Reduction
from mjfim.identification.terms import TermTests
from mjfim.parallel.budget import Budget
from mjfim.records.terms import Decision, SelectionStep, Term, TermNumber
from mjfim.studies import selection
from mjfim.studies.selection import EQUAL_COST, INTERRUPTED, _Selector


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
    terms: tuple[str, ...] = ()


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


CANDIDATE = Term(
    description="dry friction of hinge",
    numbers=(TermNumber(path="joint/hinge:frictionloss", value=0.1, unit="N m", scale=0.1),),
    sigmas=9.0,
    share=0.4,
)


class Completion:
    """A selector whose further steps are recorded in place of being done.

    Attributes:
        grown: Models that are extended, and the terms that are not tried again.
        assessed: Fits of which left-out data are predicted.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, stops: bool = False) -> None:
        self.grown: list[Any] = []
        self.assessed: list[Any] = []
        self.selector = selector()

        def grown(
            _: _Selector, model: Any, first: Any, steps: list[SelectionStep], refuted: Any
        ) -> tuple[Any, str]:
            """Keep the arguments."""
            self.grown.append((model, set(refuted)))
            return model, "tried again"

        def assessed(_: _Selector, fit: Any, first: Any) -> Any:
            """The model with the cost of its final fit; None after a request to stop."""
            self.assessed.append(fit)
            if stops:
                self.selector.budget.stop.request()
                return None
            return Model(result=fit.result, cost=fit.cost, tests=None)

        tests = TermTests(terms=(CANDIDATE,))
        monkeypatch.setattr(_Selector, "_grown", grown)
        monkeypatch.setattr(_Selector, "_assessed", assessed)
        monkeypatch.setattr(_Selector, "_term_tests", lambda *_: tests)

    def of(
        self, model: Any, steps: list[SelectionStep] | None = None, cost: float = 50.0
    ) -> tuple[Any, str]:
        """What becomes of a model whose final fit has some cost."""
        final: Any = Result(problem=Problem(cost))
        return self.selector._completed(model, model, final, steps or [], "before")


@pytest.mark.parametrize(
    ("is_changed", "holds", "tries"),
    [(True, False, True), (True, True, False), (False, False, False)],
)
def test_terms_are_tried_again_where_the_tests_do_not_hold_at_the_final_fit(
    monkeypatch: pytest.MonkeyPatch, is_changed: bool, holds: bool, tries: bool
) -> None:
    completion = Completion(monkeypatch)
    cost = 100.0 if holds else 50.0
    found, ending = completion.of(Model(is_changed=is_changed), cost=cost)
    assert found.result.problem.value == cost
    assert ending == ("tried again" if tries else "before")

    # They are compared with the cost and the losses of the final fit, not with earlier ones.
    assert [fit.cost for fit in completion.assessed] == ([50.0] if tries else [])
    assert [model.cost for model, _ in completion.grown] == ([50.0] if tries else [])
    assert all(model.tests.terms == (CANDIDATE,) for model, _ in completion.grown)


def test_terms_that_left_out_data_have_refuted_are_not_tried_a_second_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    completion = Completion(monkeypatch)
    refuted = SelectionStep(
        decision=Decision.REJECTED,
        description=CANDIDATE.description,
        path=CANDIDATE.path,
        error=1.0,
        reduction=-0.1,
    )
    completion.of(Model(), [refuted])
    assert [keys for _, keys in completion.grown] == [{CANDIDATE.key}]

    # The intervals of the final fit are widened by the scatter between its own leave-out fits.
    assert [fit.cost for fit in completion.assessed] == [50.0]


def test_a_stop_before_terms_are_tried_again_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    completion = Completion(monkeypatch, stops=True)
    found, ending = completion.of(Model())
    assert ending == INTERRUPTED
    assert found.result.problem.value == 50.0
    assert not completion.grown


def searched(
    *,
    begin: float = 0.0,
    width: int = 2,
    stated: bool = True,
    success: bool = True,
    slow: bool = False,
) -> Any:
    """A fit over one segment."""
    return SimpleNamespace(
        problem=SimpleNamespace(
            segments=(SimpleNamespace(begin=begin),),
            private_count=width,
        ),
        task=SimpleNamespace(
            noise_is_stated=stated,
            system=SimpleNamespace(parameters=SimpleNamespace(names=("mass",))),
        ),
        solution=SimpleNamespace(success=success, slow=slow),
        theta=np.ones(1),
    )


CASES = {
    "better": (99.0, searched(), True),
    "equal": (100.0, searched(), False),
    "hardly worse": (100.0 + 0.9 * EQUAL_COST, searched(), False),
    "another minimum": (120.0, searched(), True),
    "not converged": (100.0, searched(success=False), True),
    "ended because it was slow": (100.0, searched(slow=True), True),
    "segments that begin earlier": (100.0, searched(begin=-0.1), True),
    "further states": (100.0, searched(width=4), True),
    "noise that is estimated": (100.0, searched(stated=False), True),
}


@pytest.mark.parametrize("name", CASES)
def test_left_out_data_are_predicted_unless_the_fit_shows_that_a_term_explains_nothing(
    monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    cost, result, predicts = CASES[name]
    losses = SimpleNamespace(
        error=1.0, reduction=lambda other: Reduction(mean=0.5, standard_error=0.1)
    )
    model: Any = SimpleNamespace(result=searched(), cost=100.0, terms=(), losses=losses)
    extended: Any = SimpleNamespace(terms=("friction",), losses=losses)
    fit = selection._Refit(model=model, result=result, cost=cost)
    monkeypatch.setattr(_Selector, "_refitted", lambda *_, **__: fit)
    monkeypatch.setattr(_Selector, "_assessed", lambda *_: extended)

    steps: list[SelectionStep] = []
    found = selector()._tried(model, model, CANDIDATE, steps)
    if predicts:
        assert found is not None and found[0] is extended
        assert found[1].reduction == 0.5
        assert not steps
        return
    assert found is None
    (step,) = steps
    assert step.decision is Decision.UNHELPFUL
    assert (step.path, step.count, step.sigmas) == (CANDIDATE.path, 0, 9.0)
    assert np.isnan(step.error)


def test_a_fit_that_was_stopped_shows_nothing_about_a_term(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model: Any = SimpleNamespace(result=searched(), cost=100.0, terms=())
    stopped = selector()

    def refitted(*_: object, **__: object) -> Any:
        """A search that Ctrl-C ends far from its minimum."""
        stopped.budget.stop.request()
        return selection._Refit(model=model, result=searched(), cost=500.0)

    monkeypatch.setattr(_Selector, "_refitted", refitted)
    steps: list[SelectionStep] = []
    assert stopped._tried(model, model, CANDIDATE, steps) is None
    assert not steps
