"""The summary of a selection: the table, what is not told apart, and the tables to keep."""

from __future__ import annotations

import html
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.experiment.system import System
from mjfim.identification.terms import TermTests
from mjfim.output import html as page
from mjfim.output.rerun import text
from mjfim.output.summaries.selection import describe_selection
from mjfim.output.summaries.verdicts import verdict_of
from mjfim.output.summary_parts import Emphasis, Listing, Paragraph, Summary, SummaryTable
from mjfim.records.terms import (
    AlternativeTerm,
    Decision,
    Selection,
    SelectionStep,
    Term,
    TermNumber,
)
from mjfim.studies.selected_models import possible_pools, selected_experiment
from tests.support import results
from tests.support.paths import ROOT
from tests.support.results import SLIDE_FRICTION

BEGUN = SelectionStep(decision=Decision.BEGUN, error=2.0)


def texts_of(selection: Selection) -> str:
    """All paragraphs of the summary."""
    parts = describe_selection(selection)
    return "\n".join(part.text for part in parts if isinstance(part, Paragraph))


def test_alternatives_of_a_removed_term_are_not_named() -> None:
    other = AlternativeTerm(description="a spring", path="joint/slide:stiffness", values={"m": 2.0})
    added = SelectionStep(
        decision=Decision.ADDED,
        description=SLIDE_FRICTION.description,
        path=SLIDE_FRICTION.path,
        count=1,
        error=1.0,
        alternatives=(other,),
    )
    steps = (BEGUN, added)
    kept = Selection(terms=(SLIDE_FRICTION,), steps=steps, ending="No further term.")
    assert "do not tell dry friction of slide apart from a spring" in texts_of(kept)
    removed = Selection(terms=(), steps=steps, ending="No further term.")
    assert "do not tell" not in texts_of(removed)


def test_the_tables_to_keep_state_the_selected_experiment() -> None:
    base = mjfim.Experiment.from_file(ROOT / "models" / "double_pendulum.toml")
    experiment = base.replace(
        parameters={
            "d1": {"guess": 0.2, "bounds": [0.0, 5.0]},
            "d2": {"guess": 0.05, "bounds": [0.0, 5.0]},
        },
        fit={"hold": ["m2"], "bootstrap": 0},
    )

    # A number of the model, a term of the library with two parameters, a pool and held parameters.
    places = [("friction", "N", 0.1 + 0.2), ("velocity", "rad/s", 1 / 3)]
    stribeck = Term(
        description="Stribeck friction of elbow",
        numbers=tuple(
            TermNumber(
                name=f"stribeck_{name}",
                path=f"term/elbow_stribeck:{name}",
                value=0.1,
                unit=unit,
                scale=scale,
            )
            for name, unit, scale in places
        ),
        tables={
            "elbow_stribeck": {"kind": "stribeck", "joint": "elbow", "values": {"velocity": 1e-5}}
        },
    )
    (pool,) = possible_pools(System.resolve(experiment).parameters, ("d1", "d2"))
    selection = Selection(
        terms=(SLIDE_FRICTION, stribeck),
        steps=(BEGUN,),
        ending="No further term.",
        pooled=(pool,),
        held=("I1",),
        hold=("m2", "I1"),
        segments=0.123456789,
    )
    (listing,) = (part for part in describe_selection(selection) if isinstance(part, Listing))
    added = tomllib.loads("\n\n".join(listing.items))

    # Pasted, with the tables of the pooled parameters removed, they give the selected experiment.
    values = experiment.model_dump(exclude_unset=True)
    kept = {n: t for n, t in stated_tables(experiment).items() if n not in pool.members}
    pasted = experiment.restated(
        {
            **values,
            "terms": added["terms"],
            "parameters": {**kept, **added["parameters"]},
            "fit": {**values["fit"], **added["fit"]},
        }
    )
    assert pasted == selected_experiment(experiment, selection)
    assert pasted.fit.hold == ("m2", "I1")
    assert pasted.fit.segments == 0.123456789
    assert "# in place of [parameters.d1], [parameters.d2]" in listing.items[-2]

    # The lines fit into a terminal, so that none is folded.
    assert max(len(line) for item in listing.items for line in item.split("\n")) < 76


def test_tables_to_be_copied_are_shown_as_they_are() -> None:
    """In a list, a copied line would have a bullet, and Markdown would change some characters."""
    selection = Selection(terms=(SLIDE_FRICTION,), steps=(BEGUN,), ending="")
    (listing,) = (part for part in describe_selection(selection) if isinstance(part, Listing))
    (toml,) = listing.items
    summary = Summary(title="", outcome="", parts=(listing,))
    assert f"```toml\n{toml}\n```" in text.render(summary)
    assert f"<pre>{html.escape(toml)}</pre>" in page.render(summary)


def stated_tables(experiment: mjfim.Experiment) -> dict[str, object]:
    """The tables of the parameters of an experiment."""
    return dict(experiment.model_dump(exclude_unset=True)["parameters"])


def test_the_rows_that_changed_the_model_stand_out() -> None:
    """They stay where a terminal has room for one row alone."""
    steps = (
        BEGUN,
        SelectionStep(decision=Decision.REJECTED, description="a spring", error=1.9),
        SelectionStep(decision=Decision.ADDED, description=SLIDE_FRICTION.description, error=1.0),
    )
    selection = Selection(terms=(SLIDE_FRICTION,), steps=steps, ending="No further term.")
    (table,) = [part for part in describe_selection(selection) if isinstance(part, SummaryTable)]
    emphases = [row.emphasis for row in table.rows]
    assert emphases == [Emphasis.NORMAL, Emphasis.NORMAL, Emphasis.STRONG]


def test_a_term_with_which_the_fit_is_no_better_has_no_numbers_in_the_table() -> None:
    unhelpful = SelectionStep(
        decision=Decision.UNHELPFUL, description="a spring", path="joint/a:stiffness", error=np.nan
    )
    selection = Selection(terms=(), steps=(BEGUN, unhelpful), ending="")
    (table,) = [part for part in describe_selection(selection) if isinstance(part, SummaryTable)]
    assert [str(cell) for cell in table.rows[1].cells] == [
        "a spring",
        "no better fit",
        "0",
        "-",
        "",
        "",
    ]

    # It is not tried again, and is no reason for a misfit. The model stays the stated one.
    assert selection.refuted == {unhelpful.key}
    assert not unhelpful.is_kept
    assert selection.errors == (2.0, 2.0)


def test_the_verdict_names_the_added_terms() -> None:
    selection = Selection(terms=(SLIDE_FRICTION,), steps=(BEGUN,), ending="No further term.")
    verdict = verdict_of(results.estimate(selection=selection))
    assert verdict.text.startswith("With dry friction of slide added, the model explains")


def tried(
    path: str, decision: Decision, reduction: float, joints: tuple[str, ...] = ()
) -> SelectionStep:
    """A step that tried a term."""
    return SelectionStep(
        decision=decision,
        description="damping at 3 joints" if joints else path,
        path=path,
        error=1.0,
        reduction=reduction,
        joints=joints,
    )


def test_terms_that_left_out_data_refute_are_those_of_the_last_attempt() -> None:
    steps = (
        BEGUN,
        tried("worse", Decision.REJECTED, -0.1),
        tried("unclear", Decision.REJECTED, 0.1),
        tried("better later", Decision.REJECTED, -0.1),
        tried("worse later", Decision.REJECTED, 0.1),
        tried("better later", Decision.ADDED, 0.2),
        tried("worse later", Decision.REJECTED, -0.2),
    )
    selection = Selection(terms=(), steps=steps, ending="No further term.")
    assert selection.refuted == {"worse", "worse later"}


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("is_joint_refuted", [True, False])
def test_a_term_at_several_joints_is_refuted_apart_from_that_of_its_first_joint(
    order: int, is_joint_refuted: bool
) -> None:
    """Both have the same path."""
    joints = ("pan", "lift", "roll")
    reduction = 0.1 if is_joint_refuted else -0.1
    steps = (
        tried("joint/pan:damping", Decision.REJECTED, reduction),
        tried("joint/pan:damping", Decision.REJECTED, -reduction, joints),
    )
    selection = Selection(terms=(), steps=(BEGUN, *steps[::order]), ending="No further term.")
    pan, roll = (
        (TermNumber(path=f"joint/{joint}:damping", value=0.1, unit="", scale=0.1),)
        for joint in ("pan", "roll")
    )
    single = replace(results.missing_term(), numbers=pan)
    of_joints = replace(single, description="damping at 3 joints", joints=joints)
    left = TermTests(terms=(of_joints, single)).without(selection.refuted)
    assert left.terms == ((single,) if is_joint_refuted else (of_joints,))

    # The same joints in another order are the same term.
    again = replace(of_joints, numbers=roll, joints=joints[::-1])
    assert (again.key in selection.refuted) == is_joint_refuted


def test_the_removal_of_a_term_is_no_attempt_at_another_one() -> None:
    """A step that removes a term at several joints has the path of its first joint."""
    steps = (
        BEGUN,
        tried("joint/pan:damping", Decision.REJECTED, -0.1),
        tried("joint/pan:damping", Decision.ADDED, 0.2, ("pan", "lift", "roll")),
        tried("joint/pan:damping", Decision.REMOVED, 0.0),
    )
    selection = Selection(terms=(), steps=steps, ending="No further term.")
    assert selection.refuted == {"joint/pan:damping"}


def test_a_saved_selection_keeps_the_joints(
    tmp_path: Path,
) -> None:
    step = tried("joint/pan:damping", Decision.REJECTED, -0.1, ("pan", "lift", "roll"))
    selection = Selection(terms=(SLIDE_FRICTION,), steps=(BEGUN, step), ending="No further term.")
    estimate = results.estimate(selection=selection)
    estimate.save(tmp_path)
    found = mjfim.Estimate.load(tmp_path).selection
    assert found is not None and found.steps == (BEGUN, step)
    assert selection.summary()["steps"][1]["joints"] == ["pan", "lift", "roll"]
