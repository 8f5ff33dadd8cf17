"""No text of a figure overlaps another text or leaves the figure, whatever the size of the result.

The records are hand-made: few and many parameters and joints, with short and with long names.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from matplotlib.figure import Figure

from mjfim.output.plots.draw import figure_of
from mjfim.output.plots.pictures import pictures_of
from mjfim.records.base import ShownRecord
from mjfim.records.campaign import Campaign, CampaignStatus, Round
from mjfim.records.check import Check
from mjfim.records.design import CombinationAccuracy, Design, LimitUsage
from mjfim.records.estimate import (
    Estimate,
    HorizonStudy,
    ParameterDraws,
    Prediction,
    PredictionErrors,
    Whiteness,
)
from mjfim.records.estimate_parts import InformationInTime, ResidualForce
from mjfim.records.rehearsal import Rehearsal, RehearsedLimit, Separation, Valley
from mjfim.records.robots import RobotComparison
from mjfim.records.studies import (
    DESIGN,
    Comparison,
    MethodOutcome,
    MonteCarloStudy,
)
from mjfim.records.terms import Decision, Selection, SelectionStep
from mjfim.records.trajectory import Labels
from tests.support import results
from tests.support.figure_text import misplaced_texts
from tests.support.made_records import (
    make_comparison,
    make_design,
    make_estimate,
    make_labels,
    make_method_result,
    make_recording_comparison,
    make_study,
)

# Number of characters of a long name.
LONG = 40


@dataclasses.dataclass(frozen=True)
class Size:
    """Size of the records that are drawn.

    Attributes:
        joints: Number of joints.
        parameters: Number of parameters.
        width: Least number of characters of a name.
    """

    joints: int
    parameters: int
    width: int = 0

    @property
    def labels(self) -> Labels:
        """Names and units."""
        return make_labels(self.joints, self.parameters, self.width)


SMALL, LARGE = Size(1, 1), Size(12, 30, LONG)
WIDE = Size(2, 3, LONG)


@cache
def design(size: Size) -> Design:
    """A design with limits on all joints."""
    found = make_design(size.joints, size.parameters)
    t = np.linspace(0.0, 2.0, 400)
    names = [label.partition(" ")[0] for label in size.labels.positions]
    usage = [
        LimitUsage(
            kind=kind, name=name, t=t, share=np.sin((200.0 if kind == "force" else 3.0) * t + i)
        )
        for kind in ("position", "velocity", "force", "control")
        for i, name in enumerate(names)
    ]
    margins = {"position": 0.1, "velocity": -0.01, "force": 1e-5, "control": 1.0}
    combined = (
        CombinationAccuracy(expression="a + 2 b", value=1.0, std_initial=1.0, std_final=0.5),
    )
    return dataclasses.replace(
        found,
        parameters=size.labels.parameters,
        labels=size.labels,
        usage=tuple(usage),
        limits=margins,
        combined=combined,
        valley=valley(size, is_designed=True),
    )


def valley(size: Size, *, is_designed: bool) -> Valley:
    """Two robots that differ in every parameter, and part in a designed motion."""
    t = np.linspace(0.0, 2.0, 201)
    wave = np.sin(3.0 * t)
    along = [
        Separation(t=t, y=np.array([wave, wave + far * t]), distance=far * t)
        for far in (0.9, 400.0)
    ]
    size_of_step = np.geomspace(0.5, 0.01, size.parameters)
    return Valley(
        parameters=size.labels.parameters,
        units=size.labels.parameter_units,
        nominal=np.ones(size.parameters),
        sizes=np.ones(size.parameters),
        theta=1.0 + np.outer((-1.0, 1.0), size_of_step),
        output=f"qpos:{size.labels.positions[0]}",
        sigma=0.1,
        motion=along[0],
        designed=along[1] if is_designed else None,
    )


@cache
def estimate(size: Size) -> Estimate:
    """An estimate with predictions, segments and the nominal model."""
    made = make_estimate(size.joints, size.parameters)
    recording = made.recordings[0]
    labels = size.labels
    outputs = tuple(labels.outputs)
    recording = dataclasses.replace(recording, outputs=outputs, name="logs/" + "n" * 60 + ".csv")
    errors = PredictionErrors(
        name=recording.name,
        outputs=outputs,
        rms=np.geomspace(1e-3, 10.0, size.joints),
        mae=np.geomspace(1e-3, 10.0, size.joints),
    )
    nominal = dataclasses.replace(errors, rms=7.0 * errors.rms)
    held = Prediction(
        name=recording.name,
        identified=errors,
        nominal=nominal,
        held_out=True,
        recording=recording,
        identified_outputs=made.predicted[0],
        nominal_outputs=1.3 * made.predicted[0],
    )
    other = dataclasses.replace(held, recording=None, held_out=False, name="other.csv")
    whiteness = tuple(
        Whiteness(
            output=name, count=50, variance=1.2, correlation=0.3, p=1e-9, inflation=2.0, time=3.0
        )
        for name in outputs
    )
    return dataclasses.replace(
        made,
        parameters=labels.parameters,
        units=labels.parameter_units,
        labels=labels,
        at_bound=labels.parameters[:1],
        recordings=(recording,),
        sigma=dict.fromkeys(outputs, 0.05),
        predictions=(held, other, other) if size.joints > 1 else (held,),
        whiteness=whiteness,
        nominal=(1.3 * made.predicted[0],),
        segments=(np.arange(0.0, 2.0, 0.25),),
    )


@cache
def check(size: Size) -> Check:
    """A check with a combination; of several parameters, the first one is not known alone."""
    labels = size.labels
    count = size.parameters
    std = np.geomspace(1e-4, 1.0, count)
    correlation = np.full((count, count), 0.97)
    np.fill_diagonal(correlation, 1.0)
    if count > 1:
        std[0], correlation[0], correlation[:, 0] = np.inf, np.nan, np.nan
    row = dataclasses.replace(results.check().rows[0], value=1.0, size=1.0, stated=True)
    rows = tuple(
        dataclasses.replace(row, name=name, std=value, relative=value)
        for name, value in zip(labels.parameters, std.tolist(), strict=True)
    )
    return results.check(
        rows=rows,
        wanted=labels.parameters,
        information=np.eye(count),
        eigenvalues=np.ones(count),
        correlation=correlation,
        confounded=(),
        findings=(
            f"{count} parameters miss their wanted sigma; the worst is {rows[-1].name}. Stop",
        ),
        combined=(
            CombinationAccuracy(expression="a + b", value=1.0, std_initial=0.1, std_final=0.1),
        ),
        valley=valley(size, is_designed=False),
    )


@cache
def comparison(size: Size) -> Comparison:
    """A comparison of six methods, one of which cannot be used."""
    std = np.linspace(0.01, 0.02, size.parameters)
    titles = ("chirp", "multisine " + "m" * 30, "steps", "splines", "random", "mjfim's design")
    rows = [
        make_method_result(
            DESIGN if "design" in title else title,
            1.0 + i,
            title=title,
            outcome=MethodOutcome.OUTSIDE if title == "steps" else MethodOutcome.INSIDE,
            std=(1.0 + i) * std,
            worst_relative_std=0.02 * (1.0 + i),
            margins={"control_rate": 0.1},
            relative_margins={"control_rate": 0.01},
        )
        for i, title in enumerate(titles)
    ]
    return make_comparison(
        *rows,
        parameters=size.labels.parameters,
        units=size.labels.parameter_units,
        scale=np.ones(size.parameters),
        seconds=6.0,
    )


@cache
def rehearsal(size: Size) -> Rehearsal:
    """A rehearsal of twenty robots, some of which leave limits."""
    labels = size.labels
    rng = np.random.default_rng(0)
    joints = tuple(label.partition(" ")[0] for label in labels.positions)
    speed = rng.uniform(1.0, 9.0, (21, len(joints)))
    limits = tuple(
        RehearsedLimit(kind="control_rate", name=name, lower=-1.0, upper=1.0, scale=1.0)
        for name in joints
    )
    return results.rehearsal(
        limits=limits,
        fans=tuple(map(results.fan, limits[:6])),
        margins=rng.uniform(-0.1, 0.5, (21, len(joints))),
        joints=joints,
        units=("rad/s",) * len(joints),
        speed=speed,
        acceleration=10.0 * speed,
        end_speed=0.1 * speed,
        unlimited=joints[::2],
    )


@cache
def campaign(size: Size) -> Campaign:
    """A campaign of three rounds."""
    found = estimate(size)
    rounds = tuple(
        Round(
            number=k,
            theta=1.1 * found.theta,
            predicted=0.03 / k * found.theta,
            control=np.zeros((2, 1)),
            recordings=found.recordings,
            estimate=found,
        )
        for k in (1, 2, 3)
    )
    return Campaign(
        parameters=size.labels.parameters,
        wanted=0.01 * found.theta,
        rounds=rounds,
        status=CampaignStatus.EXHAUSTED,
    )


def selection(size: Size) -> Selection:
    """A selection with as many terms as joints, and as many rejected ones."""
    steps = [SelectionStep(decision=Decision.BEGUN, error=2.0)]
    for i in range(size.joints):
        term = f"viscous damping of joint number {i + 1}"
        error = 1.0 + 1.0 / (i + 2)
        rejected = SelectionStep(
            decision=Decision.REJECTED, description=term, count=i, error=error + 0.05
        )
        added = dataclasses.replace(rejected, decision=Decision.ADDED, count=i + 1, error=error)
        steps += [rejected, added]

    # Then terms are chosen over segments.
    cut = SelectionStep(
        decision=Decision.SHORTENED,
        description="segments of 0.5 s",
        count=size.joints,
        error=0.6,
    )
    last = SelectionStep(
        decision=Decision.ADDED, description="a delay", count=size.joints + 1, error=0.5
    )
    steps += [cut, last]
    ending = "No further term that was tested is significant."
    return Selection(terms=(), steps=tuple(steps), ending=ending)


def horizons(size: Size) -> HorizonStudy:
    """Four lengths of segments, on which some parameters depend."""
    found = estimate(size)
    scales = np.array([1.2, 1.1, 1.0, 0.9])[:, None]
    apart = np.zeros((4, size.parameters), dtype=bool)
    apart[0, ::2] = True
    return HorizonStudy(
        lengths=np.array([0.12, 0.48, 1.9, 4.0]),
        errors=np.array([[1.0, 1.2, 2.0, 9.0], [1.1, 1.2, 1.8, 5.0], [1.1, 1.2, 1.5, 3.0]] * 2)[:4],
        chosen=2,
        is_whole=True,
        parameters=size.labels.parameters,
        units=size.labels.parameter_units,
        theta=scales * found.theta,
        half_widths=np.abs(0.05 * scales * found.theta),
        is_apart=apart,
    )


@cache
def robots(size: Size) -> RobotComparison:
    """Two robots, the first parameter of which differs."""
    labels = size.labels
    count = size.parameters
    values = np.linspace(1.0, 2.0, count)
    other = values + np.append(0.8, np.zeros(count - 1))
    return results.robots(
        names=("n" * 30, "m" * 30),
        parameters=labels.parameters,
        units=labels.parameter_units,
        is_single=np.ones(count),
        values=np.array([values, other]),
        std=np.full((2, count), 0.02),
        interval=np.column_stack([other - values - 0.05, other - values + 0.05]),
        p=np.append(1e-9, np.ones(count - 1)),
        detectable=np.full(count, 0.1),
        is_reliable=False,
    )


def draws(size: Size) -> ParameterDraws:
    """50 drawn robots."""
    found = estimate(size)
    noise = np.random.default_rng(0).normal(size=(50, size.parameters))
    return ParameterDraws(
        parameters=size.labels.parameters,
        units=size.labels.parameter_units,
        values=found.theta + found.std * noise,
        centre=found.theta,
        std=found.std,
    )


def residual_forces(size: Size) -> tuple[ResidualForce, ...]:
    """Residual forces of as many joints."""
    rng = np.random.default_rng(1)
    speed = np.sin(np.linspace(0.0, 40.0, 300))
    return tuple(
        ResidualForce(
            joint="n" * size.width + str(k),
            unit="N m",
            position=np.cumsum(speed),
            speed=speed,
            force=np.sign(speed) + 0.1 * rng.normal(size=300),
            sigma=0.1,
            size=2.0,
        )
        for k in range(size.joints)
    )


def information_in_time(size: Size) -> InformationInTime:
    """Information of ten blocks of each recording."""
    count, blocks = size.parameters, 10
    recordings = len(estimate(size).recordings)
    edges = np.linspace(0.0, float(estimate(size).recordings[0].t[-1]), blocks + 1)
    times = np.column_stack([edges[:-1], edges[1:]])
    shape = (recordings * blocks, count)
    return InformationInTime(
        parameters=size.labels.parameters,
        recording=np.repeat(np.arange(recordings), blocks),
        times=np.tile(times, (recordings, 1)),
        shares=np.full(shape, 0.9 / shape[0]),
        pulls=np.where(np.arange(count) % 2, 2.0, -2.0) * np.ones(shape),
        scatter=1.0,
    )


@cache
def studied(size: Size) -> Estimate:
    """An estimate with all studies."""
    labels = size.labels
    names = tuple(f"{'n' * size.width}run_{k}.csv" for k in range(max(size.joints, 2)))
    return dataclasses.replace(
        estimate(size),
        selection=selection(size),
        horizons=horizons(size),
        recording_comparison=make_recording_comparison(
            labels.parameters, labels.parameter_units, names
        ),
        draws=draws(size),
        residual_forces=residual_forces(size),
        in_time=information_in_time(size),
        misfit=True,
    )


def study(size: Size) -> MonteCarloStudy:
    """A Monte Carlo study."""
    return dataclasses.replace(make_study(size.parameters), labels=size.labels)


RECORDS: dict[str, Callable[[Size], ShownRecord]] = {
    "design": design,
    "estimate": studied,
    "check": check,
    "comparison": comparison,
    "robots": robots,
    "rehearsal": rehearsal,
    "study": study,
    "campaign": campaign,
}


def misplaced(record: str, picture: str, size: Size) -> list[str]:
    """Texts of a picture that overlap or leave it; few dots per inch change no place of a text."""
    figure = figure_of(pictures_of(RECORDS[record](size))[picture]())
    figure.set_dpi(50.0)
    return misplaced_texts(figure)


@pytest.mark.slow
@pytest.mark.parametrize("size", [SMALL, WIDE, LARGE], ids=str)
@pytest.mark.parametrize("record", RECORDS)
def test_texts_do_not_overlap_and_stay_inside(record: str, size: Size) -> None:
    pictures = [name for name in pictures_of(RECORDS[record](size)) if "histogram" not in name]
    found = {name: misplaced(record, name, size) for name in pictures}
    assert {name: faults for name, faults in found.items() if faults} == {}


def test_overlapping_and_escaping_texts_are_found() -> None:
    figure = Figure(figsize=(2.0, 1.0))
    figure.text(0.5, 0.5, "one")
    figure.text(0.52, 0.5, "two")
    figure.text(0.9, 0.1, "leaves")
    figure.text(0.5, 0.5, "hidden").set_visible(False)
    assert misplaced_texts(figure) == ["leaves the figure: 'leaves'", "overlap: 'one' and 'two'"]
