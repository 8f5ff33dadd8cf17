"""Verdicts agree with the numbers of the same result, and the cause of a misfit stands below."""

from __future__ import annotations

import re
from dataclasses import replace
from html import unescape
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjfim.output.page import Page, as_sentence
from mjfim.output.pages import page_of
from mjfim.output.plots.pictures import pictures_of
from mjfim.output.report import as_html, report_of
from mjfim.records.base import Level
from mjfim.records.check import findings_of_check
from mjfim.records.design import Status
from mjfim.records.studies import DESIGN, CampaignStatus
from tests.output.test_pages import ALONE, BROKEN, STOPPED, UNSTABLE, selection
from tests.support import results
from tests.support.pages import printed
from tests.support.results import THETA, evaluation, rehearsal

GOOD, DOUBTFUL, BAD = Level.GOOD, Level.DOUBTFUL, Level.BAD
WAITING = {"status": CampaignStatus.WAITING}
LENGTH_UNKNOWN = {"theta": np.array([2.0, 1e-3, 1e-3])}

# A search that ended where it began, but for the last digit of its control.
START = evaluation(0.1, 50)
CTRL = np.nextafter(START.trajectory.ctrl, np.inf)
MOVED = {"final": replace(START, trajectory=replace(START.trajectory, ctrl=CTRL))}

# Eleven of the robots reach the clamp of a force, and one breaks a limit besides.
CLAMPED: dict[str, Any] = {
    "limits": tuple(replace(limit, kind="joint_force") for limit in rehearsal().limits[:1]),
    "margins": np.array([0.4, *[0.0] * 11, *[0.4] * 9])[:, None],
}
POOR = replace(results.check().rows[0], relative=4.0, std=4.0 * THETA[0])
AUTOCORRELATED = ("residuals are autocorrelated: q (lag-1 correlation +0.22)",)
LENGTH_POOR = {"std": np.array([0.01, 0.2, 0.01]) * THETA}


def costing(cost: float) -> dict[str, Any]:
    """Other methods of a comparison, of which each has a cost."""
    rows = results.comparison().rows
    return {"rows": tuple(row if row.method == DESIGN else replace(row, cost=cost) for row in rows)}


def heavier(second: float, interval: tuple[float, float], p: float) -> dict[str, Any]:
    """Two robots, of which the second one is heavier."""
    return {
        "values": np.array([[1.0, 1.0, 1.0], [second, 1.0, 1.0]]),
        "interval": np.array([interval, (-0.02, 0.02), (-0.02, 0.02)]),
        "p": np.array([p, 1.0, 1.0]),
        "joint_p": max(p, 0.1) if p > 0.05 else p,
    }


def scattered(name: str, **changes: Any) -> dict[str, Any]:
    """A study, of which the trials along one motion differ."""
    sets = results.study().sets
    inside = replace(sets["initial"], efficiency_interval=np.tile([0.9, 1.1], (3, 1)))
    return {"sets": {**sets, "initial": inside, name: replace(sets[name], **changes)}}


# One interval of six may miss 1 by chance.
BY_CHANCE = np.array([[1.01, 1.2], [0.9, 1.1], [0.9, 1.1]])


@pytest.mark.parametrize(
    ("verb", "changes", "level", "ok", "words"),
    [
        ("design", {}, GOOD, True, "Ready to play: one experiment"),
        ("design", {"status": Status.INTERRUPTED}, DOUBTFUL, False, ""),
        ("design", {"limits": {"position": -0.1}}, BAD, False, "violates limits (position)"),
        ("design", LENGTH_UNKNOWN, DOUBTFUL, True, "length, damping: σ is 1000 % of its size for"),
        ("design", {"rehearsal": rehearsal(**BROKEN)}, BAD, False, "Do not play"),
        ("design", {"rehearsal": None}, DOUBTFUL, True, "not rehearsed"),
        ("design", {"rehearsal": rehearsal(**CLAMPED)}, DOUBTFUL, True, "only 9 of 20"),
        ("design", {"rehearsal": rehearsal(**ALONE)}, DOUBTFUL, True, "no robot that"),
        ("design", {**MOVED, **STOPPED}, DOUBTFUL, False, "no better than its start"),
        ("design", MOVED, GOOD, True, "It is no better than its start."),
        ("design", {"final": evaluation(0.01, 50)}, DOUBTFUL, True, "less than its start"),
        ("identify", {}, GOOD, True, "explains the recordings"),
        ("identify", {"selection": selection()}, GOOD, True, "With dry friction of slide added, "),
        ("identify", {"misfit": True, "chi2": 800.0}, DOUBTFUL, False, "2.01 times the noise"),
        (
            "identify",
            {"misfit": True, "chi2": 30.0, "reasons": AUTOCORRELATED},
            DOUBTFUL,
            False,
            "autocorrelated: q",
        ),
        ("identify", {"converged": False, "status": "stopped early"}, BAD, False, "stopped early."),
        ("identify", {"converged": False, "combinations": ("a b",)}, BAD, False, "combination"),
        ("identify", LENGTH_POOR, GOOD, True, "widest for length"),
        ("identify", {**LENGTH_POOR, "nuisance": ("length",)}, GOOD, True, "± 2 %"),
        (
            "identify",
            {"std": 0.8 * THETA},
            DOUBTFUL,
            True,
            "the recordings determine no parameter.",
        ),
        ("check", {}, GOOD, True, "σ of 2 %"),
        ("check", {"rehearsal": rehearsal(**UNSTABLE)}, DOUBTFUL, True, "σ of 2 %"),
        ("check", {"refused": ("too long",), "findings": ("a b",)}, DOUBTFUL, False, "A b."),
        (
            "check",
            {"rows": (POOR, *results.check().rows[1:])},
            DOUBTFUL,
            True,
            "not determine mass",
        ),
        ("compare", {}, GOOD, True, "The design is the best"),
        ("compare", costing(1.1), GOOD, True, "is the best"),
        ("compare", costing(1.002), GOOD, True, "as good as"),
        ("compare", costing(0.99), GOOD, True, "as good as"),
        ("compare-robots", heavier(1.0, (-0.02, 0.02), 1.0), GOOD, True, "no difference between"),
        (
            "compare-robots",
            heavier(1.6, (0.034, 1.06), 0.08),
            DOUBTFUL,
            True,
            "friday is 60 % above",
        ),
        (
            "compare-robots",
            heavier(1.48, (-0.1, 1.06), 0.3),
            DOUBTFUL,
            True,
            "friday is 48 % above",
        ),
        (
            "compare-robots",
            heavier(1.6, (0.5, 0.7), 1e-9),
            DOUBTFUL,
            False,
            "There is a difference",
        ),
        ("montecarlo", {}, GOOD, True, "scatter as predicted"),
        ("montecarlo", scattered("final", failed=3), DOUBTFUL, False, "3 of 200 (designed)"),
        (
            "montecarlo",
            scattered("final", efficiency_interval=BY_CHANCE),
            GOOD,
            True,
            "1 of 6 intervals of 95 % misses it",
        ),
        (
            "montecarlo",
            scattered("final", efficiency_interval=0.2 * BY_CHANCE),
            DOUBTFUL,
            True,
            "the designed trajectory",
        ),
        ("rehearse", {}, GOOD, True, "20 of 20 robots whose parameters are up to 20 % off keep"),
        ("rehearse", BROKEN, BAD, False, "20 leave the limit on position of hinge, by up to"),
        ("rehearse", {"lowest": np.full(21, -0.2)}, BAD, False, "20 pass through the floor"),
        ("rehearse", CLAMPED, DOUBTFUL, True, "only 9 of 20 robots reach no clamp (joint force"),
        ("rehearse", CLAMPED, DOUBTFUL, True, "20 of 20 robots whose"),
        ("rehearse", ALONE, DOUBTFUL, True, "no robot that differs from the model was rehearsed"),
        ("rehearse", {**ALONE, "margins": [[-0.2, 0.4]]}, BAD, False, "The model leaves"),
        ("campaign", {}, GOOD, True, "Reached"),
        ("campaign", {"status": CampaignStatus.INFEASIBLE}, BAD, False, "No design keeps"),
        ("campaign", {**WAITING, "rounds": ()}, GOOD, False, "waits"),
        ("campaign", {**WAITING, "wanted": 0.015 * THETA}, GOOD, False, "waits"),
        ("campaign", {**WAITING, "wanted": 0.005 * THETA}, DOUBTFUL, False, "wanted"),
    ],
)
def test_the_verdict(
    verb: str, changes: dict[str, Any], level: Level, ok: bool, words: str
) -> None:
    """Its level, what it says, and whether what was asked for is reached."""
    verdict = page_of(results.MAKERS[verb](**changes)).verdict
    assert (verdict.level, verdict.ok) == (level, ok)
    assert words in verdict.sentence


@pytest.mark.parametrize(
    ("length", "p", "words"),
    [
        (1.6, 0.4, "agree within their noise"),
        (1.9, 0.01, "may differ in length (intervals apart)"),
        (1.9, 1e-5, "differ in length by more than their noise explains"),
    ],
)
def test_recordings_agree_only_where_their_intervals_meet(
    length: float, p: float, words: str
) -> None:
    """Two recordings, of which the other one has a length of 1.5, with a σ of 0.05."""
    made = results.estimate().recording_comparison
    assert made is not None
    comparison = replace(
        made,
        recordings=("a.csv", "b.csv"),
        values=np.array([[1.0, 1.5, 2.0], [1.0, length, 2.0]]),
        std=np.full((2, 3), 0.05),
        p=np.array([1.0, p, 1.0]),
        joint_p=0.5,
        odd=(),
    )
    assert bool(comparison.separate) == (length - 1.5 > 2.0 * 1.96 * 0.05)
    assert words in str(comparison)
    picture = pictures_of(results.estimate(recording_comparison=comparison))["recordings"]()
    assert words in picture.title


@pytest.mark.parametrize("held_out", [True, False])
def test_only_recordings_that_took_no_part_are_called_not_fitted(held_out: bool) -> None:
    estimate = results.estimate()
    predictions = tuple(replace(each, held_out=held_out) for each in estimate.predictions)
    estimate = replace(estimate, predictions=predictions)
    text = printed(page_of(estimate), verbose=True)
    title = pictures_of(estimate)["predictions"]().title
    assert ("not fitted" in title, "not fitted" in text) == (held_out, held_out)
    assert ("part of the last fit" in text) is not held_out


@pytest.mark.parametrize(
    ("stated", "words", "others"),
    [(True, "3 of 3 parameters miss the wanted σ", "5 %"), (False, "more than 5 %", "wanted")],
)
def test_an_accuracy_is_missed_only_where_one_was_wanted(
    stated: bool, words: str, others: str
) -> None:
    check = results.check()
    rows = tuple(
        replace(row, relative=0.1, std=0.1 * row.size, stated=stated, repetitions=4)
        for row in check.rows
    )
    found = replace(check, rows=rows)
    text = "; ".join(findings_of_check(found))
    assert words in text and others not in text
    page = page_of(replace(found, findings=tuple(findings_of_check(found))))
    assert (page.verdict.level is Level.GOOD) is not stated


# σ over the size of a parameter -> what a design that predicts it says; None for a green box.
DETERMINED = {
    0.01: None,
    0.12: None,
    0.13: "it hardly determines length: σ is 13 % of its size",
    0.23: "it hardly determines length: σ is 23 % of its size",
    0.26: "it does not determine length: σ is 26 % of its size",
    0.8: "it does not determine length: σ is 80 % of its size",
}


@pytest.mark.parametrize("share", DETERMINED)
def test_a_design_and_a_fit_agree_on_what_is_determined(share: float) -> None:
    std = THETA * [0.01, share, 0.01]
    steps = results.finite_steps(predicted=std)
    design = results.design(rehearsal=rehearsal(steps=steps))
    verdict = page_of(replace(design, final=replace(design.final, std=std))).verdict
    words = DETERMINED[share]
    assert verdict.level is (Level.GOOD if words is None else Level.DOUBTFUL)
    assert (words or "determines every parameter") in verdict.sentence

    fit = page_of(results.estimate(std=std)).verdict
    is_undetermined = "does not determine" in verdict.sentence
    assert ("except length (not determined)" in fit.sentence) == is_undetermined
    assert (fit.level is Level.GOOD) is not is_undetermined and fit.ok


# ---- what stands together

# Robots that keep all limits, that leave the position, and that cannot be braked at the end.
LEAVING = np.vstack([[0.31, 0.31], np.full((20, 2), [-0.2, 0.31])])
ROBOTS: dict[str, dict[str, Any]] = {
    "safe": {},
    "leaving": {"margins": LEAVING},
    "unbraked": {"unbraked": {"hinge": 20}, "end_speed": np.full((21, 2), 0.4)},
}
# The reserve that the design kept, which is to be found, or which could not be kept.
RESERVES: dict[str, dict[str, float] | None] = {
    "none": {},
    "kept": {"position": 0.3},
    "to be found": None,
    "not kept": {"position": 0.6},
}
# Whether smaller errors and feedback make the motion safe; None where they were not tried.
TRIED = {"not tried": (None, None), "helps": (0.1, True), "does not": (np.nan, False)}
SAME = evaluation(0.1, 50)
SEARCHES: dict[str, dict[str, Any]] = {
    "converged": {},
    "stopped": {"status": Status.MAX_ITERATIONS, "improvement": 0.048},
}

# Sentences that contradict each other.
CONTRADICTIONS = [
    ("Do not play", "Ready to play"),
    ("not to be played", "mjfim export"),
    ("not to be played", "nothing more is needed"),
    ("Do not play", "nothing more is needed"),
    ("Do not play", "can be played"),
    ("Do not play", "mjfim export"),
    ("Do not play", "Allow more time"),
    ("Do not play", "keep all limits"),
    ("Do not play", "better result"),
    ("no better than", "times smaller than with the initial motion"),
    ("ends at rest", "ends in motion"),
    ("ends at rest", "Let the motion end at rest"),
    ("Converged", "Stopped at its budget"),
    ("with a reserve", "with a larger reserve"),
    ("With feedback, this motion is safe", "Try it with feedback"),
    ("Say better what is known", "where you know yours so well"),
]


def whole(page: Page) -> str:
    """All that a page says, in which no two sentences contradict each other."""
    text = " ".join([*printed(page, verbose=True).split(), *page.next_steps])
    for one, other in CONTRADICTIONS:
        assert not (one in text and other in text), (one, other, text)
    return text


@pytest.mark.parametrize("robots", ROBOTS)
@pytest.mark.parametrize("reserve", RESERVES)
@pytest.mark.parametrize("end", ["free", "rest"])
@pytest.mark.parametrize("tried", TRIED)
def test_sentences_about_a_design_fit_together(
    robots: str, reserve: str, end: str, tried: str
) -> None:
    """In every state of its robots, reserve, end, σ, gain and search."""
    kept, (wrong, feedback) = RESERVES[reserve], TRIED[tried]
    rehearsed = rehearsal(
        **ROBOTS[robots],
        kept_reserve=kept,
        end=end,
        safe_wrong=None if robots == "safe" else wrong,
        safe_with_feedback=None if robots == "safe" else feedback,
    )
    is_safe = robots == "safe"
    advises_rest = robots == "unbraked" and end == "free"
    for is_exact, is_better, search in product((True, False), (True, False), SEARCHES):
        final = evaluation(0.103, 50) if is_better else SAME
        std = final.std if is_exact else 3.0 * final.std
        steps = replace(results.finite_steps(predicted=final.std), std=std)
        design = results.design(
            final=final, rehearsal=replace(rehearsed, steps=steps), **SEARCHES[search]
        )
        page = page_of(design, experiment="arm.toml", design=Path("made"))
        text = whole(page)
        is_cut_off = is_safe and not is_better and search == "stopped"
        said = {
            "Do not play": not is_safe,
            "σ is approximate": is_safe and not is_exact,
            "no better than its start": is_safe and not is_better,
            "only 2.9 % below that of its start": is_safe and is_better,
            "Allow more time": is_cut_off,
            "improving by 4.8 %": search == "stopped",
            # A cure is named where it is known to help, and where it is not in force already.
            "Let the motion end at rest": advises_rest,
            "larger reserve": not is_safe and reserve == "kept",
            "`[rehearsal] wrong = 0.1`": not is_safe and tried == "helps",
            "With feedback, this motion is safe": not is_safe and tried == "helps",
            "Try it with feedback": not is_safe and tried == "not tried",
        }
        assert {words: words in text for words in said} == said
        assert (page.verdict.level is Level.BAD) is not is_safe
        assert not is_cut_off or "Allow more time" in page.next_steps[0]
        advised = re.search(r"reserve = \{ position = ([0-9.]+) \}", text)
        assert bool(advised) is (not is_safe and reserve in ("none", "kept"))
        assert advised is None or float(advised[1]) > (kept or {}).get("position", 0.0)
        assert page.next_steps and (is_safe or "mjfim design" not in page.next_steps[0])

    # The rehearsal alone, and checks of the design and of a start that moves like this.
    for result in (
        rehearsed,
        results.check(rehearsal=rehearsed, is_start=False),
        results.check(rehearsal=rehearsed),
    ):
        text = whole(page_of(result, experiment="arm.toml", design=Path("made")))
        is_start = "Do not play the initial control" in text
        assert ("Do not play" in text or is_start) is not is_safe
        assert is_start or ("Let the motion end at rest" in text) is advises_rest


# ---- causes


def cause(**changes: Any) -> Any:
    """An estimate with a cause, ten warnings and a detail."""
    first = (
        "the model may lack dry friction, or let `mjfim identify EXPERIMENT RECORDING --select -o "
        "FOLDER` decide"
    )
    causes, details = (first, "something else"), ("largest residuals in q",)
    warnings = (*causes, *(f"warning number {k}" for k in range(10)), *details)
    fields = {"misfit": True, "warnings": warnings, "causes": causes, "details": details}
    return results.estimate(**{**fields, **changes})


def test_the_cause_stands_under_the_verdict_with_the_command_that_cures_it(tmp_path: Path) -> None:
    """At most three remarks are shown in the short form."""
    folder = tmp_path / "a run"
    page = page_of(cause(), experiment="my arm.toml", output=folder)
    short, complete = (printed(page, 400, verbose=verbose) for verbose in (False, True))
    lines = short.splitlines()
    assert lines[0].startswith("The model does not explain")
    assert lines[1].startswith("Fix first: the model may lack dry friction")
    command = (
        "`mjfim identify 'my arm.toml' logs/swing.csv --held-out logs/new.csv --select -o "
        f"'{folder}'-identify`"
    )
    assert command in lines[1]
    assert [line.split(":")[0] for line in lines[2:4]] == ["Warning", "Warning"]
    assert short.count("Warning:") == 2 and "Not shown here" in short
    assert complete.count("Warning:") == 10
    assert complete.count("Fix first:") == 2 and "Detail: largest residuals in q" in complete
    assert "<li>Largest residuals in q" in report_of([cause()])

    # What a misfit asks for comes before more data, even where parameters are poorly known.
    first, *others = page_of(cause(sloppy=("length",))).next_steps
    assert first == (
        "Decide what the model lacks: `mjfim identify EXPERIMENT logs/swing.csv --held-out "
        "logs/new.csv --select -o FOLDER`."
    )
    assert "tells more" not in " ".join(others)


def test_the_lines_of_a_cure_stay_lines_everywhere() -> None:
    """They are copied from a terminal, a notebook or a report into the experiment file."""
    lines = '[parameters.slide_frictionloss]\ntarget = "joint/slide:frictionloss"\nscale = 0.33'
    text = f"the model may lack friction. Add at the end of the experiment file:\n{lines}"
    estimate = cause(causes=(text,), warnings=(text,), details=())
    assert lines in printed(page_of(estimate), 200)
    assert as_sentence(text).endswith(lines)
    html = unescape(as_html(estimate)).replace("<br/>", "\n")
    assert f"{lines}</p>" in html


@pytest.mark.parametrize("is_stated", [True, False])
def test_worth_names_a_wanted_standard_deviation_only_where_one_is_stated(is_stated: bool) -> None:
    said = " ".join(printed(page_of(results.worth(is_stated=is_stated)), 100, verbose=True).split())
    assert ("the wanted σ" in said, "a σ of 5 %" in said) == (is_stated, not is_stated)


@pytest.mark.parametrize(
    ("std", "said"),
    [
        # Half of the wanted variance of c is missing: as much information again is needed.
        (
            [0.01, 0.01, np.sqrt(2.0) * 0.05],
            "2 of 3 reach the wanted σ; damping needs about 12 s",
        ),
        ([0.01, np.inf, 0.1], "1 of 3 reach the wanted σ; the rows so far do not determine"),
        ([0.01, 0.01, 0.01], "Enough after 4.0 s, in the best case: every parameter reaches"),
    ],
)
def test_a_live_meter_says_what_is_missing(std: list[float], said: str) -> None:
    t = np.linspace(0.1, 12.0, 200)
    result = results.watch(
        wanted=np.full(3, 0.05),
        t=t,
        std_over_time=np.sqrt(12.0 / t)[:, None] * np.array(std),
        reached=np.where(np.array(std) <= 0.05, 4.0, np.inf),
    )
    assert said in " ".join(printed(page_of(result), 100).split())


# ---- in Python


@pytest.mark.parametrize("verb", results.MAKERS)
def test_a_printed_result_is_its_page_on_a_small_terminal(verb: str) -> None:
    record = results.MAKERS[verb]()
    verdict, lines, page = record.verdict, str(record).splitlines(), page_of(record)
    assert verdict.sentence.startswith(lines[0].rstrip())
    assert max(map(len, lines)) <= 80 and len(lines) > 4
    shown = [line for line in lines if line in printed(page, 80)]
    assert len(shown) >= len(lines) - 1
    assert str(verdict).startswith(f"{verdict.level.upper()}: {verdict.sentence}")
    assert (verdict.reasons, verdict.next) == ((*page.causes, *page.warnings), page.next_steps)
