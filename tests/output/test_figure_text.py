"""No text of a figure overlaps another text or leaves the figure, whatever the size of the result.

The records are made by hand: few and many parameters and joints, with short and with long names.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from matplotlib.figure import Figure

from mjfim.output.plots.draw import figure_of
from mjfim.output.plots.pictures import pictures_of
from mjfim.records.base import ShownRecord, listed_values
from mjfim.records.design import Design, LimitUsage
from mjfim.records.estimate import Estimate, Whiteness
from mjfim.records.rehearsal import Separation, Valley
from mjfim.records.terms import Decision, Selection, SelectionStep
from tests.support import results
from tests.support.figure_text import misplaced_texts
from tests.support.made_records import (
    make_design,
    make_estimate,
    make_labels,
    make_recording_comparison,
    make_study,
)

# Number of characters of a long name, and long names of three parameters.
LONG = 40
NAMES = make_labels(1, 3, LONG).parameters


def design(joints: int, count: int, width: int) -> Design:
    """A design with limits on all joints, and two robots that part in its motion."""
    labels, t = make_labels(joints, count, width), np.linspace(0.0, 2.0, 400)
    speeds = {"position": 3.0, "velocity": 3.0, "force": 200.0, "control": 3.0}
    usage = [
        LimitUsage(kind=kind, name=label.partition(" ")[0], t=t, share=np.sin(speed * t + i))
        for kind, speed in speeds.items()
        for i, label in enumerate(labels.positions)
    ]
    motion, designed = (
        Separation(t=t, y=np.array([np.sin(t), np.sin(t) + far * t]), distance=far * t)
        for far in (0.9, 400.0)
    )
    valley = Valley(
        parameters=labels.parameters,
        units=labels.parameter_units,
        nominal=np.ones(count),
        sizes=np.ones(count),
        theta=1.0 + np.outer((-1.0, 1.0), np.geomspace(0.5, 0.01, count)),
        output=f"qpos:{labels.positions[0]}",
        sigma=0.1,
        motion=motion,
        designed=designed,
    )
    (combined,) = listed_values(["a + 2 b"], [""], np.ones(1), np.full(1, 0.5), std_initial=[1.0])
    return replace(
        make_design(joints, count),
        parameters=labels.parameters,
        labels=labels,
        usage=tuple(usage),
        limits={"position": 0.1, "velocity": -0.01, "force": 1e-5, "control": 1.0},
        combined=(combined,),
        valley=valley,
    )


def estimate(joints: int, count: int, width: int) -> Estimate:
    """An estimate with predictions, segments, the nominal model and all studies."""
    labels, made = make_labels(joints, count, width), make_estimate(joints, count)
    names, units, outputs = labels.parameters, labels.parameter_units, tuple(labels.outputs)
    recording = replace(made.recordings[0], outputs=outputs, name=f"logs/{'n' * 60}.csv")
    held = results.estimate().predictions[0]
    errors = replace(held.identified, outputs=outputs, rms=np.geomspace(1e-3, 10.0, joints))
    held = replace(
        held,
        name=recording.name,
        identified=errors,
        nominal=replace(errors, rms=7.0 * errors.rms),
        recording=recording,
        identified_outputs=made.predicted[0],
        nominal_outputs=1.3 * made.predicted[0],
    )
    white = {"count": 50, "variance": 1.2, "correlation": 0.3, "p": 1e-9, "inflation": 2.0}
    noise = np.random.default_rng(0).normal(size=(50, count))
    draws = replace(
        results.draws(0.01 * results.THETA),
        parameters=names,
        units=units,
        values=made.theta + made.std * noise,
        centre=made.theta,
        std=made.std,
    )
    files = tuple(f"{'n' * width}run_{k}.csv" for k in range(max(joints, 2)))
    return replace(
        made,
        parameters=names,
        units=units,
        labels=labels,
        at_bound=names[:1],
        recordings=(recording,),
        sigma=dict.fromkeys(outputs, 0.05),
        predictions=(held, replace(held, recording=None, held_out=False, name="other.csv")),
        whiteness=tuple(Whiteness(output=name, time=3.0, **white) for name in outputs),
        nominal=(1.3 * made.predicted[0],),
        segments=(np.arange(0.0, 2.0, 0.25),),
        selection=selection(joints),
        horizons=results.horizons(made.theta, names, units),
        recording_comparison=make_recording_comparison(names, units, files),
        draws=draws,
        residual_forces=results.residual_forces(*("n" * width + str(k) for k in range(joints))),
        in_time=results.information_in_time(names, 2.0),
        misfit=True,
    )


def selection(count: int) -> Selection:
    """A selection of as many terms as it rejected; then terms are chosen over segments."""
    begun = SelectionStep(decision=Decision.BEGUN, error=2.0)
    steps = [begun]
    for i in range(1, count + 1):
        error = 1.0 + 1.0 / (i + 1)
        tried = replace(begun, description=f"viscous damping of joint number {i}", count=i)
        steps.append(replace(tried, decision=Decision.REJECTED, error=error + 0.05))
        steps.append(replace(tried, decision=Decision.ADDED, error=error))
    last = replace(begun, count=count, error=0.5, description="segments of 0.5 s")
    steps.append(replace(last, decision=Decision.SHORTENED))
    steps.append(replace(last, decision=Decision.ADDED, description="a delay"))
    return Selection(terms=(), steps=tuple(steps), ending="No further term is significant.")


def named(verb: str) -> ShownRecord:
    """The result of a verb with long names."""
    names = {"name": NAMES[0]} if verb in ("design", "identify", "rehearse") else {}
    return results.MAKERS[verb](parameters=NAMES, **names)


RECORDS = {
    # The title of `watch` is one line, which leaves the figure with such names.
    **{f"named {verb}": partial(named, verb) for verb in results.MAKERS if verb != "watch"},
    "small design": lambda: design(1, 1, 0),
    "large design": lambda: design(12, 30, LONG),
    "small estimate": lambda: estimate(1, 1, 0),
    "large estimate": lambda: estimate(12, 30, LONG),
    "small study": lambda: replace(make_study(1), labels=make_labels(1, 1)),
    "large study": lambda: replace(make_study(30), labels=make_labels(12, 30, LONG)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", RECORDS)
def test_texts_do_not_overlap_and_stay_inside(name: str) -> None:
    """Few dots per inch change no place of a text."""
    faults = {}
    for picture, make in pictures_of(RECORDS[name]()).items():
        if "histogram" not in picture:
            figure = figure_of(make())
            figure.set_dpi(50.0)
            faults[picture] = misplaced_texts(figure)
    assert {picture: found for picture, found in faults.items() if found} == {}


def test_overlapping_and_escaping_texts_are_found() -> None:
    figure = Figure(figsize=(2.0, 1.0))
    figure.text(0.5, 0.5, "one")
    figure.text(0.52, 0.5, "two")
    figure.text(0.9, 0.1, "leaves")
    figure.text(0.5, 0.5, "hidden").set_visible(False)
    assert misplaced_texts(figure) == ["leaves the figure: 'leaves'", "overlap: 'one' and 'two'"]
