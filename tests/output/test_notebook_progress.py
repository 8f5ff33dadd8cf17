"""Progress of verbs in a notebook."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from types import ModuleType, SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import pytest

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.output import live
from mjfim.output.live import NotebookProgress
from mjfim.records import events
from mjfim.records.events import Event, FitEvent, StudyEvent
from tests.support.cart_pendulum import cart_pendulum


class Shown(list[str]):
    """What a notebook shows at one place, the latest last."""

    def update(self, data: dict[str, str], *, raw: bool) -> None:
        """Replace what is shown."""
        assert raw and data["text/plain"]
        self.append(data["text/html"])


@pytest.fixture
def places(monkeypatch: pytest.MonkeyPatch) -> list[Shown]:
    """The places at which something is shown, in a notebook without delay between updates."""
    found: list[Shown] = []

    def display(data: dict[str, str], *, raw: bool, display_id: bool) -> Shown:
        """Show something at a new place."""
        assert raw and display_id
        found.append(Shown([data["text/html"]]))
        return found[-1]

    monkeypatch.setattr(events, "in_notebook", lambda: True)
    monkeypatch.setattr("IPython.display.display", display)
    monkeypatch.setattr(live, "UPDATE_SECONDS", 0.0)
    return found


@pytest.fixture(scope="module")
def experiment() -> mjfim.Experiment:
    """The cart-pendulum for 0.4 s."""
    return cart_pendulum(horizon=0.4, descent={"max_iterations": 2})


def repeat(e: mjfim.Experiment, **options: Any) -> object:
    """Repeat the initial trajectory."""
    return mjfim.monte_carlo(e, DesignTask.resolve(e).initial, trials=3, **options)


def identify(e: mjfim.Experiment, **options: Any) -> object:
    """Identify from the initial trajectory."""
    return mjfim.identify(e, [mjfim.simulate(e, DesignTask.resolve(e).initial)], **options)


@pytest.mark.parametrize(
    ("begin", "call"),
    [
        ("designing: iteration   1", mjfim.design),
        ("checking", mjfim.check),
        ("comparing", partial(mjfim.compare, seconds=0.5, methods=["multisine"])),
        ("repeating the experiment", repeat),
        ("identifying: all data", identify),
    ],
)
@pytest.mark.slow
def test_a_notebook_shows_the_progress_of_each_verb_once(
    begin: str, call: Callable[..., Any], experiment: mjfim.Experiment, places: list[Shown]
) -> None:
    call(experiment)
    (shown,) = places
    assert "<progress" in shown[0] and "<progress" not in shown[-1]
    assert any(begin in html for html in shown)
    for html in shown:
        assert ElementTree.fromstring(html).tag == "div"

    places.clear()
    call(experiment, progress=False)
    assert places == []


def test_a_callback_replaces_the_bar_and_programs_show_nothing(
    experiment: mjfim.Experiment, places: list[Shown], monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[Event] = []
    mjfim.design(experiment, callback=told.append)
    assert places == [] and len(told) >= 2

    monkeypatch.setattr(events, "in_notebook", lambda: False)
    mjfim.check(experiment)
    assert places == []


def test_an_error_is_said_where_the_bar_was(places: list[Shown]) -> None:
    with pytest.raises(ZeroDivisionError), live.progress("dividing"):
        _ = 1 / 0
    assert "dividing (ended by an error after 0.0 s)" in places[0][-1]


def test_the_share_of_a_study_is_drawn_and_text_is_escaped(places: list[Shown]) -> None:
    show = NotebookProgress("comparing")
    show(StudyEvent(study="compare", part="a<b", index=1, count=4, share=0.5, message="J & λ"))
    (bar,) = ElementTree.fromstring(places[0][-1]).iter("progress")
    assert float(bar.attrib["value"]) / float(bar.attrib["max"]) == 0.375
    assert "a&lt;b  J &amp; λ" in places[0][-1]

    show(StudyEvent(study="campaign", part="", index=0, count=None, share=1.0, message="round 1"))
    assert "comparing: round 1" in places[0][-1]


def test_updates_that_come_too_soon_are_left_out(
    places: list[Shown], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "UPDATE_SECONDS", 1e6)
    show = NotebookProgress("identifying")
    for i in range(100):
        show(FitEvent(phase="all data", iteration=i, cost=1.0, step=1.0))
    show.end(failed=False)
    ((_, last),) = places
    assert "iteration 99" in last


def test_a_notebook_is_known_by_its_kernel(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ipykernel", ModuleType("ipykernel"))
    for shell in (SimpleNamespace(kernel=object()), SimpleNamespace()):
        monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: shell))  # noqa: B023
        assert events.in_notebook() is hasattr(shell, "kernel")
    monkeypatch.delitem(sys.modules, "IPython")
    assert not events.in_notebook()
