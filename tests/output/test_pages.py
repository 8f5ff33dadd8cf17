"""Pages: verdicts, next steps, and tables and sentences that hold what a reader needs."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

import mjfim
from mjfim.errors import MjfimError
from mjfim.experiment.system import System
from mjfim.output.page import Emphasis, Listing, Row, Table, named, number
from mjfim.output.pages import page_of
from mjfim.output.pages.estimate import selection_parts
from mjfim.output.rerun.documents import as_markdown
from mjfim.output.terminal import laid_out
from mjfim.output.words import improvement, relative, shorten
from mjfim.records.base import Level, ShownRecord, Verdict, listed_values
from mjfim.records.check import findings_of_check
from mjfim.records.design import LimitViolation, ScaledStart, Status
from mjfim.records.studies import CampaignStatus
from mjfim.records.terms import (
    AlternativeTerm,
    Decision,
    Selection,
    SelectionStep,
    Term,
    TermTestData,
)
from mjfim.studies.selected_models import possible_pools, selected_experiment
from tests.support import results
from tests.support.pages import page_with, printed, sentences
from tests.support.paths import ROOT
from tests.support.results import SLIDE_FRICTION

BEGUN = SelectionStep(decision=Decision.BEGUN, error=2.0)


def test_a_record_without_page_is_refused() -> None:
    class Other(ShownRecord):
        """A record that nobody knows."""

    with pytest.raises(MjfimError, match="a Other cannot be shown"):
        page_of(Other())


# ---- verdicts and next steps


BROKEN: dict[str, Any] = {"margins": np.vstack([[0.1, 0.1], np.full((20, 2), [-0.5, 0.1])])}
UNSTABLE: dict[str, Any] = {"margins": 3.0 * BROKEN["margins"], "growth": 70.0}
ALONE: dict[str, Any] = {
    name: getattr(results.rehearsal(), name)[:1]
    for name in (
        *("theta", "margins", "speed", "acceleration", "end_speed", "travel"),
        *("lowest", "end_height", "nearest", "in_contact", "at_stop"),
    )
}
STOPPED: dict[str, Any] = {"status": Status.MAX_ITERATIONS, "improvement": 0.048}


def test_pages_say_what_was_tested_and_which_parameters_are_nuisance() -> None:
    tested = TermTestData(share=0.17, recordings=4, count=4)
    estimate = results.estimate(tested_data=tested, missing_terms=(results.missing_term(),))
    text = printed(page_of(estimate), verbose=True)
    assert "were tested on 17 % of the data, from all 4 recordings." in text
    summary = estimate.summary()
    assert summary["suspects_tested"]["share"] == 0.17
    assert summary["suspects"][0]["path"] == "joint/hinge:frictionloss"
    first, *others = results.check().rows
    check = results.check(rows=(*others, replace(first, nuisance=True)))
    assert "nuisance" in printed(page_of(check))


# ---- numbers and tables


def test_inseparable_parameters_are_marked() -> None:
    """The combination has a row, and nothing is divided by zero."""
    std = np.array([np.inf, 0.1, 0.1])
    (combined,) = listed_values(["m + 2 l"], [""], np.zeros(1), np.full(1, 0.1), std_initial=[0.4])
    start = replace(results.evaluation(0.1, 50), std=std)
    text = printed(
        page_of(
            results.design(
                initial=start,
                final=start,
                combined=(combined,),
                combinations=("m and l only as m + 2 l",),
            )
        )
    )
    assert "not alone" in text and "m + 2 l" in text and "÷ 4.0" in text


def test_an_estimate_names_bounds_and_warnings_in_all_places() -> None:
    """A log without noise may be predicted exactly by both models, which gives no ratio."""
    found = results.estimate().predictions[0]
    exact = replace(found.nominal, rms=0.0 * found.nominal.rms)
    predictions = (replace(found, nominal=exact, identified=exact),)
    changes = {"misfit": True, "at_bound": ("mass",), "warnings": ("residuals are [odd]",)}
    page = page_of(results.estimate(predictions=predictions, **changes))
    for text in (printed(page, verbose=True), as_markdown(page).replace("\\", "")):
        for words in ("at bound", "residuals are [odd]", "does not explain the recordings"):
            assert words in text
        assert "nan" not in text.lower()
    assert "at bound" not in printed(page_of(results.estimate()), verbose=True)


@pytest.mark.parametrize(
    ("shown", "text"),
    [
        (improvement(2.0, 0.5), "÷ 4.0"),
        (improvement(0.5, 2.0), "× 4.0"),
        (improvement(np.inf, 2.0), "-"),
        (improvement(1.0, 0.0), "-"),
        (relative(0.00123, 1.0), "0.12 %"),
        (relative(0.998, 1.0), "99.8 %"),
        (relative(6.32, 1.0), "632 %"),
        # A share of a whole vector names the size.
        (relative(0.0031, 0.039, 0.00048), "7.9 % of 0.039"),
        (relative(0.0031, 0.039, 0.039), "7.9 %"),
        (named("m", "kg"), "m (kg)"),
        (named("ratio", ""), "ratio"),
        (number(0.12345, 2, " %"), "0.12 %"),
        (number(np.nan), "-"),
        (number(-np.inf), "-∞"),
        (number(np.inf, infinite="not alone"), "not alone"),
    ],
)
def test_numbers_and_names_as_text(shown: str, text: str) -> None:
    assert shown == text


def test_markdown_escapes_marks_and_keeps_lines_to_be_copied() -> None:
    table = Table(title="a_b", columns=("x", "y"), rows=(Row(("a|b `c`", "1")),))
    text = as_markdown(page_with(table, Listing("Copy", ("[fit]\nhold = ['a*b']",), code=True)))
    assert r"| a\|b \`c\` | 1 |" in text
    assert "```toml\n[fit]\nhold = ['a*b']\n```" in text


# ---- selection of terms


def selection(*steps: SelectionStep, **changes: Any) -> Selection:
    """A selection that added dry friction of the slide, unless stated otherwise."""
    stated: dict[str, Any] = {"terms": (SLIDE_FRICTION,), "ending": "No further term."}
    return Selection(steps=(BEGUN, *steps), **{**stated, **changes})


ADDED = SelectionStep(
    decision=Decision.ADDED,
    description=SLIDE_FRICTION.description,
    path=SLIDE_FRICTION.path,
    count=1,
    error=1.0,
)


def test_alternatives_of_a_removed_term_are_not_named() -> None:
    other = AlternativeTerm(description="a spring", path="joint/slide:stiffness", values={"m": 2.0})
    added = replace(ADDED, alternatives=(other,))
    for found, is_kept in ((selection(added), True), (selection(added, terms=()), False)):
        said = sentences(page_of(results.estimate(selection=found)))
        assert ("do not tell dry friction of slide apart from a spring" in said) is is_kept
        assert ("do not tell" in said) is is_kept


def test_rows_that_changed_the_model_stand_out_and_useless_ones_have_no_numbers() -> None:
    steps = (
        SelectionStep(decision=Decision.REJECTED, description="a spring", error=1.9),
        ADDED,
        SelectionStep(decision=Decision.UNHELPFUL, description="damping", error=np.nan),
    )
    (table,) = [part for part in selection_parts(selection(*steps)) if isinstance(part, Table)]
    strong = [row.emphasis is Emphasis.STRONG for row in table.rows]
    assert strong == [False, False, True, False]
    assert table.rows[-1].cells == ("damping", "no better fit", "0", "-", "", "")


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
    (number,) = SLIDE_FRICTION.numbers
    numbers = tuple(
        replace(number, name=name, path=f"term/elbow_stribeck:{name}", unit=unit, scale=scale)
        for name, unit, scale in (("friction", "N", 0.1 + 0.2), ("velocity", "rad/s", 1 / 3))
    )
    table = {"kind": "stribeck", "joint": "elbow", "values": {"velocity": 1e-5}}
    stribeck = Term(description="", numbers=numbers, tables={"elbow_stribeck": table})
    (pool,) = possible_pools(System.resolve(experiment).parameters, ("d1", "d2"))
    found = selection(
        terms=(SLIDE_FRICTION, stribeck),
        pooled=(pool,),
        held=("I1",),
        hold=("m2", "I1"),
        segments=0.123456789,
    )
    (listing,) = (part for part in selection_parts(found) if isinstance(part, Listing))
    added = tomllib.loads("\n\n".join(listing.items))

    # Pasted, with the tables of the pooled parameters removed, they give the selected experiment.
    values = experiment.model_dump(exclude_unset=True)
    kept = {n: t for n, t in values["parameters"].items() if n not in pool.members}
    pasted = experiment.restated(
        {
            **values,
            "terms": added["terms"],
            "parameters": {**kept, **added["parameters"]},
            "fit": {**values["fit"], **added["fit"]},
        }
    )
    assert pasted == selected_experiment(experiment, found)
    assert pasted.fit.segments == 0.123456789
    assert "# in place of [parameters.d1], [parameters.d2]" in listing.items[-2]
    # The lines fit into a terminal, so that none is folded.
    assert max(len(line) for item in listing.items for line in item.split("\n")) < 76


def test_a_start_outside_its_limits_is_equal_to_its_scaled_control() -> None:
    """Where the initial control leaves limits, the share that keeps them counts."""
    violation = LimitViolation(
        kind="position", name="hinge", since=0.1, t=0.2, value=2.0, lower=-1.0, upper=1.0
    )
    scaled = ScaledStart(share=0.5, cost=1.01, min_eigenvalue=0.99)
    outside = {"initial_violations": (violation,), **STOPPED}
    for start, is_equal in ((scaled, True), (replace(scaled, min_eigenvalue=0.9), False)):
        design = results.design(scaled_start=start, **STOPPED)
        assert (design.is_start, design.verdict.ok) == (is_equal, not is_equal)
    assert not results.design(**outside).is_start
    # A share that determines nothing is no measure.
    for least, words in ((1e-9, "it determines next to nothing"), (0.1, "times better than that")):
        design = results.design(scaled_start=replace(scaled, min_eigenvalue=least), **outside)
        assert words in printed(page_of(design), verbose=True)


def test_a_design_that_stops_at_its_budget_is_ready_in_its_short_form() -> None:
    """What the search did is a detail where the motion can be played."""
    page = page_of(results.design(**STOPPED))
    assert page.verdict.level is Level.GOOD
    for verbose in (False, True):
        assert ("improving by 4.8 %" in printed(page, verbose=verbose)) is verbose


def test_what_nothing_limits_and_every_end_in_motion_is_said() -> None:
    """The largest of each unit, and all joints that move at the end, the fastest one first."""
    joints = ("cart", "lift", "hinge")
    rows = np.ones((21, 1))
    rehearsal = results.rehearsal(
        joints=joints,
        units=("m/s", "m/s", "rad/s"),
        speed=rows * np.array([2.0, 1.0, 3.0]),
        acceleration=np.zeros((21, 3)),
        end_speed=rows * np.array([0.56, 0.015, 0.85]),
        travel=np.vstack([np.full((20, 3), 0.1), [0.8, 0.2, 2.1]]),
        unlimited=("hinge",),
        unplaced=joints,
    )
    text = page_of(rehearsal).verdict.sentence
    assert text.startswith("Safe to play, then stop it.")
    assert text.endswith(
        "3 positions have no limit, up to 2.1 rad (hinge) and 0.8 m (cart) from the start. "
        "1 speed has no limit, up to 3 rad/s (hinge). "
        "It ends in motion: hinge at 0.85 rad/s, cart at 0.56 m/s."
    )
    resting = replace(rehearsal, end_speed=0.01 * rehearsal.speed, unlimited=(), unplaced=())
    text = page_of(resting).verdict.sentence
    assert text.endswith("It ends at rest.") and "no limit" not in text


def test_shortened_names_stay_different() -> None:
    short = shorten("armature_joint_0_and_2_more", 18, ["armature_joint_3_and_2_more"])
    assert short == "arma…0_and_2_more"


REPEATED = tuple(replace(row, repetitions=4) for row in results.check().rows)
FALLEN = {"lowest": np.full(21, -0.2)}
UNSAFE = {"rehearsal": results.rehearsal(**BROKEN)}
END_IN_MOTION = {"unbraked": {"slide": 20}, "end_speed": np.ones((21, 2))}

# By result: changes, words of the first next step, and whether it says to design again.
NEXT_STEPS: list[tuple[str, dict[str, Any], str, bool]] = [
    ("design", {}, "mjfim export", False),
    ("design", {"limits": {"position": -0.1}}, "Widen the limit", False),
    ("identify", {}, "Use `identified.xml`", False),
    ("campaign", {"status": CampaignStatus.WAITING}, "--recordings FILE", False),
    # Cures by cause: no floor, differences that grow, an end in motion, too little room.
    ("design", UNSAFE, "reserve = { position = 0.46 }", True),
    ("rehearse", FALLEN, "ranges of `position`", True),
    ("rehearse", {**FALLEN, "has_floor": False}, "`[rehearsal] floor`", True),
    ("rehearse", {**BROKEN, "growth": 5.1}, "reserve = {", True),
    ("rehearse", {**UNSTABLE, "growth": 4.9}, "reserve = {", True),
    ("rehearse", UNSTABLE, "grow 70-fold", True),
    ("rehearse", END_IN_MOTION, 'end = "rest"', True),
    ("rehearse", {"end_height": np.full(21, np.nan)}, "a `prior` of each parameter", True),
    # The step after a check agrees with its findings.
    ("check", {}, "a robot can play: `mjfim design my.toml -o my-design`", False),
    ("check", {"rows": REPEATED}, "that tells more: `mjfim design my.toml -o", False),
    ("check", {"is_start": False}, "Estimate the parameters: `mjfim identify my.toml REC", False),
    (
        "check",
        {"is_start": False, "rehearsal": results.rehearsal()},
        "`mjfim export made --to player",
        False,
    ),
    ("check", {"rehearsal": results.rehearsal()}, "Design a motion that a robot can play", False),
    ("check", {"rehearsal": results.rehearsal(**FALLEN)}, "Keep the robot above the", False),
]


@pytest.mark.parametrize(("verb", "changes", "words", "again"), NEXT_STEPS)
def test_the_first_next_step(verb: str, changes: dict[str, Any], words: str, again: bool) -> None:
    """Nothing more is needed, or a motion that tells more; never both."""
    result = results.MAKERS[verb](**changes)
    if verb == "check":
        bare = replace(result, findings=())
        result = replace(bare, findings=tuple(findings_of_check(bare)))
        margins = "Margins of the limits" in printed(page_of(result))
        assert not result.is_start or margins is result.is_dangerous
    page = page_of(result, experiment="my.toml", design=Path("made"))
    first, *others = page.next_steps
    assert words in first
    if again:
        assert "mjfim design" not in first
        assert others[-1] == "Then design again: `mjfim design my.toml -o my-design`."
    text = printed(page, verbose=True)
    assert not ("nothing more is needed" in text and "tells more" in text)
    assert "--design" not in text


def test_robots_that_were_not_asked_for_are_not_counted() -> None:
    text = printed(page_of(results.rehearsal(**ALONE)), verbose=True)
    assert "0 of 0" not in text and "worst robot" not in text
    low = results.rehearsal(lowest=np.full(21, -1.28), floor=-np.inf)
    text = printed(page_of(low), verbose=True)
    assert "lowest point 1.28 m below the origin of the world" in text


def test_the_level_of_a_verdict_has_a_colour() -> None:
    """Red, amber and plain on a terminal."""
    for level, code in ((Level.GOOD, "1"), (Level.DOUBTFUL, "1;33"), (Level.BAD, "1;31")):
        page = replace(page_with(), verdict=Verdict("Done.", level))
        console = Console(force_terminal=True, color_system="standard", width=80)
        with console.capture() as capture:
            console.print(laid_out(page, console))
        assert f"\x1b[{code}mDone." in capture.get()
