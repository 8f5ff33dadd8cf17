"""Pictures of checks, comparisons, studies of robots, and campaigns."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mjfim.arrays import NORMAL_95, Array, finite_or_nan
from mjfim.output.page import (
    DESIGNED,
    IDENTIFIED,
    INITIAL,
    MEASURED,
    NOMINAL,
    OTHER,
    TRAJECTORY_TERMS,
    as_sentence,
    parameter_names,
    shown_word,
)
from mjfim.output.pages.studies import budget_in_words, progress_of_watch
from mjfim.output.panels import (
    ROBOT_ROLES,
    SERIES,
    Axis,
    Cells,
    Mark,
    Panel,
    Picture,
    area,
    around,
    bars,
    blank_rows,
    dots,
    grid,
    hline,
    hspan,
    in_grid,
    intervals,
    line,
    mark,
    row_axis,
    vline,
    vspan,
    words,
)
from mjfim.output.plots.accuracy import (
    Accuracies,
    accuracy_over_time_panel,
    accuracy_panel,
    height_of_rows,
    share_text,
)
from mjfim.output.words import (
    BEST_CASE,
    format_number,
    format_percent,
    format_with_uncertainty,
    normal_density,
    quotient_unit,
    share_note,
    shorten,
    sigma_remark,
    squared_unit,
    without_zeros,
)
from mjfim.records.base import ParameterValue
from mjfim.records.check import CONFOUNDED_CORRELATION, Check, ParameterCheck
from mjfim.records.rehearsal import MAX_PATHS, Rehearsal, Separation, Valley
from mjfim.records.robots import RobotComparison
from mjfim.records.studies import (
    DESIGN,
    Campaign,
    Comparison,
    MethodResult,
    MonteCarloStudy,
    TrialStatistics,
)
from mjfim.records.trajectory import Labels, with_unit
from mjfim.records.worth import Watch

# Lower end of the axis of a distance between two robots [standard deviations].
LEAST_DISTANCE = 0.1

# Largest numbers of parameters of a Monte Carlo study, of two robots and of a campaign; of more,
# those that say most are drawn.
MAX_STUDIED, MAX_DIFFERENCES, MAX_ROUNDS = 30, 40, 8

# Largest numbers of parameters for which correlations, and ratios, are written into the cells.
MAX_CORRELATIONS, MAX_RATIOS = 8, 12

# Largest number of rounds that have a tick each.
MAX_TICKS = 8

# Number of rows up to which rows are high, and characters of a title above which what stands in
# brackets is left out.
MAX_HIGH_ROWS, MAX_TITLE = 12, 260

# Ratio of standard deviations to the design's at which the colours of the cells end, and ratios at
# the bar of colours.
LARGEST_RATIO, RATIOS = 3.0, (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8)

# Number of fans up to which they are wide; spread over the range of the motion below which a fan is
# thin; distance from the curves, over their range, up to which a limit is drawn.
MAX_WIDE_FANS, THIN_FAN, NEAR_LIMIT = 4, 0.1, 0.5

# Distance from the quartiles beyond which estimates are outliers, over the distance between the
# quartiles, and reach of the bound that a histogram shows [standard deviations].
OUTLIER_DISTANCE, SHOWN_STDS = 4.0, 4.0

# Largest error, smallest margin and largest difference on their axes; what lies beyond is drawn
# there.
LARGEST_ERROR, LEAST_MARGIN, LARGEST_DIFFERENCE = 5.0, -1.0, 6.0


# ---- checks


def check(result: Check) -> Picture:
    """Show predicted and wanted relative standard deviations, and correlations of the estimates."""
    rows = [row for row in result.rows if not row.nuisance]
    combined = result.combined
    both: list[ParameterCheck | ParameterValue] = [*rows, *combined]
    names = [with_unit(row.name, row.unit) for row in both]
    std = np.array([row.std for row in both])
    values = np.array([row.value for row in both])
    sizes = np.array([*(row.size for row in rows), *(abs(each.value) for each in combined)])
    goals = np.array([*(row.wanted for row in rows), *[np.inf] * len(combined)])
    label = f"predicted, {result.source} ({duration(result)})"
    source = Accuracies(std, source_role(result), label)
    # A share of a nominal value of 0 says nothing.
    sizes = np.where(values == 0.0, np.nan, sizes)
    panel = accuracy_panel(names, sizes, [source], goals)
    goal = [f"wanted {share_text(*pair)}" for pair in zip(goals[: len(rows)], sizes, strict=False)]
    panels = [replace(panel, beside=[("", source.role, panel.beside[0][2]), ("", "text", goal)])]

    note = sigma_remark(result.inflation, [row.name for row in result.rows])
    count = len(result.wanted)
    has_correlations = bool(np.isfinite(result.correlation).any()) and count > 1
    if has_correlations:
        panels.append(_correlations(result, len(names)))
    elif count > 1:
        note = f"No parameter is identifiable alone, so there are no correlations. {note}"
    if not all(row.stated for row in rows):
        note += " Without a stated one, the wanted σ is 5 %."
    title = result.findings[0].replace("`", "").removesuffix(".")
    if len(title) > MAX_TITLE:
        title = re.sub(r" \([^()]*\)", "", title)
    return Picture(
        title=as_sentence(title),
        panels=panels,
        note=note,
        heights=[1.8 + height_of_rows(len(names))],
        widths=[1.15, 1.0] if has_correlations else [1.0],
    )


def source_role(result: Check) -> str:
    """Return the role of the motion that was checked."""
    if "recording" in result.source:
        return MEASURED
    return DESIGNED if "design" in result.source else INITIAL


def duration(result: Check) -> str:
    """Return the duration of the motion that was checked, with its unit."""
    return f"{without_zeros(format_number(result.horizon))} s"


def _correlations(result: Check, rows: int) -> Panel:
    """Return the correlation matrix of the estimates as cells, beside rows of bars."""
    # The diagonal is 0, or NaN for a parameter that is not identifiable alone.
    correlation = result.correlation - np.diag(np.diagonal(result.correlation))
    count = len(correlation)
    confounded = np.abs(correlation) > CONFOUNDED_CORRELATION
    far = f"beyond ±{CONFOUNDED_CORRELATION:g}, hardly distinguishable"
    if np.isnan(correlation).any():
        far += "; grey: not identifiable alone"
    panel = Panel(y=blank_rows(rows), place=(0, 1))
    words = "correlation (red: positive, blue: negative)"
    if count > MAX_CORRELATIONS:
        up, across = np.nonzero(confounded)
        return replace(
            panel,
            cells=Cells(values=correlation),
            marks=[dots(across, up, "white", size=3.0)],
            x=Axis(ticks=(), names=()),
            remark=f"{words}; dot: {far}; columns in the order of the rows",
        )
    texts = [
        [f"{value:+.2f}".replace("-", "−") if value and np.isfinite(value) else "" for value in row]
        for row in correlation
    ]
    return replace(
        panel,
        cells=Cells(values=correlation, texts=texts, is_bold=confounded),
        x=Axis(ticks=range(count), names=result.wanted),
        remark=f"{words}; bold: {far}",
    )


# Largest number of parameters of two robots that are drawn, those in which they differ most.
MAX_MOVED = 12


def valley(found: Valley, motions: Sequence[tuple[str, str]]) -> Picture:
    """Show two robots that a motion does not tell apart, and how the designed one does.

    Args:
        found: The robots.
        motions: Name and role of each of the motions.
    """
    every = [found.motion] if found.designed is None else [found.motion, found.designed]
    ends = (
        max(2.4 * found.sigma, *(0.6 * each.largest for each in every)),
        2.0 * max(2.0, *(each.total for each in every)),
    )
    panels = []
    for k, (each, (name, role)) in enumerate(zip(every, motions, strict=True)):
        panels += [
            replace(panel, role=role, place=(row, k))
            for row, panel in enumerate(_separation(found, each, name, *ends))
        ]
    moved = found.moved[:MAX_MOVED]
    rows, percent = np.arange(len(moved)), found.percent[:, moved]
    marks: list[Mark] = [
        vline(0.0, dash="--", label="nominal value"),
        *(line(ends, [k, k], "band", width=3.0, front=1.0) for k, ends in enumerate(percent.T)),
    ]
    beside = []
    for k, role in enumerate(ROBOT_ROLES):
        marks.append(dots(percent[k], rows, role, size=8.0))
        beside.append((f"robot {k + 1}", role, list(map(format_number, found.theta[k, moved]))))
    panels.append(
        Panel(
            marks=marks,
            x=Axis(label="difference from the nominal value [% of its size]"),
            y=row_axis(parameter_names(found, moved, with_unit)),
            beside=beside,
            place=(2, 0),
            is_wide=True,
        )
    )
    return Picture(
        # The panels name the output in which they differ most.
        title=str(found).partition(", most in ")[0].removesuffix("."),
        panels=panels,
        note="Δ: from the mean of both robots. Distance: all measurements up to each time, over "
        "their noise; below 1.96 σ a χ² test at 95 % finds nothing."
        + share_note(moved, found.moved, "parameters, those that differ most"),
        heights=[2.0, 1.7, height_of_rows(len(moved))],
        widths=[1.0] * len(every),
    )


def _separation(
    found: Valley, along: Separation, name: str, reach: float, farthest: float
) -> tuple[Panel, Panel]:
    """Return the output of two robots about its mean, and their distance, with ends of the axes."""
    curves = [
        line(along.t, y, role, label=f"robot {k}")
        for k, (y, role) in enumerate(
            zip(along.y - along.y.mean(axis=0), ROBOT_ROLES, strict=True), start=1
        )
    ]
    band = hspan(-2.0 * found.sigma, 2.0 * found.sigma, label="± 2 σ of one measurement")
    after = "not told apart"
    if np.isfinite(along.seen_after):
        after = f"told apart after {along.seen_after:.3g} s"
    return (
        Panel(
            title=f"{name}: {along.total:.3g} σ apart",
            marks=[band, *curves],
            y=Axis(label=f"Δ {found.output}", limits=(-reach, reach)),
        ),
        Panel(
            title=f"{name}: {after}",
            marks=[
                hspan(LEAST_DISTANCE, NORMAL_95, label="too little to tell apart (95 %)"),
                line(along.t, np.maximum(along.distance, LEAST_DISTANCE), "text"),
            ],
            x=Axis(label="time [s]"),
            y=Axis(label="distance [σ of noise]", limits=(LEAST_DISTANCE, farthest), log=True),
        ),
    )


# ---- comparison of methods

# What stands beside the standard deviations: margins, if there are limits.
BESIDE_STD = {
    True: "the smallest margin of all limits, as a share of half of the limit's range, and its "
    "kind; negative: the limit is violated.",
    False: "J, which also weighs the effort of the control: without limits, more effort buys a "
    "smaller σ.",
}


def compare(comparison: Comparison) -> Picture:
    """Show standard deviations over the design's (cells), and the worst combination (bars)."""
    rows = sorted(
        comparison.rows, key=lambda row: (not row.sound, np.nan_to_num(row.cost, nan=np.inf))
    )
    roles = [_method_role(comparison, row) for row in rows]
    methods = row_axis(
        [row.title for row in rows],
        [role if row.sound else "muted" for role, row in zip(roles, rows, strict=True)],
    )
    first, *others = comparison.findings
    has_margins = any(row.tightest[0] for row in rows)
    note = (
        f"{' '.join(others)} Each method had {budget_in_words(comparison)}. "
        "Predicted standard deviations are the best case. Sorted by the cost J, best first. "
        f"Beside σ: {BESIDE_STD[has_margins]}"
    )
    return Picture(
        title=first.removesuffix("."),
        panels=[
            _ratios(comparison, rows, methods),
            _worst_combinations(comparison, rows, roles, has_margins=has_margins),
        ],
        note=note.strip(),
        heights=[np.clip(1.2 + 0.36 * len(rows), 2.2, 11.0)],
        widths=[np.clip(0.55 * len(comparison.wanted), 2.2, 9.0), 3.6],
    )


def _method_role(comparison: Comparison, row: MethodResult) -> str:
    if row.method == DESIGN:
        return DESIGNED
    return OTHER if row in comparison.beating else INITIAL


def _ratios(comparison: Comparison, rows: Sequence[MethodResult], methods: Axis) -> Panel:
    """Return standard deviations over the design's, or over the scales if the design has none."""
    wanted = list(comparison.wanted)
    names = [comparison.parameters[j] for j in wanted]
    std = np.array([row.std[wanted] for row in rows]).reshape(len(rows), len(wanted))
    design = comparison.design
    reference, title = comparison.scale[wanted], "σ of each parameter / its scale"
    against_design = design is not None and bool(np.isfinite(design.std[wanted]).any())
    if design is not None and against_design:
        reference, title = design.std[wanted], "σ of each parameter / σ of the design"
    ratios = std / reference
    logarithms = np.log(finite_or_nan(ratios))
    if np.isnan(logarithms).all():
        return Panel(message="no parameter is identifiable alone", y=methods)

    # White is the design's standard deviation; without one, it is the mean of what is shown.
    middle, reach = 0.0, np.log(LARGEST_RATIO)
    if not against_design:
        middle = float(np.nanmean(logarithms))
        reach = max(2.0 * np.nanstd(logarithms), 0.1)
    look: dict[str, Any] = {
        "texts": [
            [format_number(ratio) if np.isfinite(ratio) else "–" for ratio in row] for row in ratios
        ]
    }
    if len(names) > MAX_RATIOS:
        marked = [ratio for ratio in RATIOS if abs(np.log(ratio) - middle) <= reach]
        look = {"scale": (np.log(marked).tolist(), [f"{ratio:g}" for ratio in marked])}
    return Panel(
        title=title,
        cells=Cells(values=logarithms, middle=middle, reach=reach, **look),
        x=Axis(ticks=range(len(names)), names=names),
        y=methods,
    )


def _worst_combinations(
    comparison: Comparison, rows: Sequence[MethodResult], roles: Sequence[str], *, has_margins: bool
) -> Panel:
    """Return the relative σ of the worst combination by method, with its tightest limit."""
    title = "σ of the worst combination"
    worst = np.array([row.worst_relative_std for row in rows])
    known = np.isfinite(worst)
    places = blank_rows(len(rows))
    if not known.any():
        return Panel(
            title=title, message="no method found a usable control", y=places, place=(0, 1)
        )
    high, low = float(worst[known].max()), 0.0
    axis = Axis(label="σ / scale [–]", limits=(0.0, 1.7 * high), most=5)
    if high > 8.0 * worst[known].min():
        low = 0.5 * float(worst[known].min())
        room = (high / low) ** (0.75 if has_margins else 0.45)
        axis = Axis(label=axis.label, limits=(low, high * room), log=True)

    labels: dict[str, str] = {
        DESIGNED: "design",
        INITIAL: "baseline",
        OTHER: "baseline that beats the design",
    }
    marks: list[Mark] = []
    for place, (row, role) in enumerate(zip(rows, roles, strict=True)):
        if not known[place]:
            marks.append(words([low], [place], [row.outcome.value], "muted"))
            continue
        look: dict[str, Any] = {"label": labels[role]}
        if not row.sound:
            role, look = "muted", {"hollow": True, "label": "not usable"}
        kind, margin = row.tightest
        text = f"J {format_number(row.cost)}"
        if kind and np.isfinite(margin):
            text = f"{format_percent(margin)} {kind.replace('_', ' ')}"
        end = [row.worst_relative_std]
        marks += [
            bars(end, [place], role, left=low, **look),
            words(end, [place], [f"{format_number(end[0])}   {text}"], "text"),
        ]
    return Panel(title=title, marks=marks, x=axis, y=places, place=(0, 1))


# ---- Monte Carlo studies


def overview(study: MonteCarloStudy, labels: Labels) -> Picture:
    """Show scatter, Cramér-Rao bound and efficiency of every parameter along each trajectory."""
    smallest = np.min([trials.efficiency for trials in study.sets.values()], axis=0)
    order = np.argsort(np.nan_to_num(smallest, nan=np.inf), kind="stable")
    shown = np.sort(order[:MAX_STUDIED])

    # Standard deviations over the least one of the first trajectory.
    first = next(iter(study.sets.values()))
    least, seen = (np.sqrt(np.diagonal(matrix)[shown]) for matrix in (first.crlb, first.covariance))
    size = np.where(np.isfinite(least), least, seen)
    size = np.where(size > 0.0, size, np.nan)
    scatter = []
    efficiency = [vline(1.0, dash="--")]
    shifts = 0.3 * (np.arange(len(study.sets)) - 0.5 * (len(study.sets) - 1))
    for shift, (key, trials) in zip(shifts, study.sets.items(), strict=True):
        word, role = _trajectory(key)
        rows = np.arange(len(shown)) + shift
        observed = np.sqrt(np.diagonal(trials.covariance)[shown]) / size
        bound = np.sqrt(np.diagonal(trials.crlb)[shown]) / size
        bound = finite_or_nan(bound)
        tick = {"symbol": "|", "size": 10.0, "width": 1.4}
        low, high = trials.efficiency_interval[shown].T
        scatter += [
            dots(observed, rows, role, size=4.5, label=f"{word}: estimates"),
            dots(bound, rows, "text", label="Cramér–Rao bound", **tick),
        ]
        efficiency += [
            line(np.column_stack([low, high, high * np.nan]).ravel(), np.repeat(rows, 3), role),
            dots(trials.efficiency[shown], rows, role, size=4.5),
        ]
    names = [labels.parameter(int(j)) for j in shown]
    label = f"standard deviation / bound of the {_trajectory(next(iter(study.sets)))[0]} trajectory"
    note = (
        f"Simulated recordings of the model with noise of the stated σ, at {study.measure_rate:g} "
        "Hz. Efficiency with its 95 % interval; 1: the bound is reached."
    )
    note += share_note(shown, study.theta, "parameters, those with the smallest efficiency")
    panels = [
        Panel(marks=scatter, x=Axis(label=f"{label} [–]", log=True), y=row_axis(names)),
        Panel(
            marks=efficiency,
            x=Axis(label="efficiency: bound / observed variance [–]"),
            y=blank_rows(len(shown)),
            place=(0, 1),
        ),
    ]
    return Picture(
        title="Monte Carlo study against the Cramér–Rao bound",
        panels=panels,
        note=note,
        heights=[0.9 + 0.36 * len(shown)],
        widths=[1.3, 1.0],
    )


def _trajectory(key: str) -> tuple[str, str]:
    """Return the word and the role of a trajectory of a study."""
    return shown_word(key), TRAJECTORY_TERMS.get(key, OTHER)


def histogram(study: MonteCarloStudy, index: int, labels: Labels) -> Picture:
    """Show the estimates of one parameter along each trajectory (the paper's figures 4 to 6)."""
    unit, label = labels.parameter_units[index], labels.parameter(index)
    theta = float(study.theta[index])
    true = f"true value {format_number(theta)} {unit}".rstrip()
    axis = Axis(label=f"density [{quotient_unit('', unit)}]")
    panels, overlay = [], []
    for place, (key, trials) in enumerate(study.sets.items()):
        word, role = _trajectory(key)
        values = trials.estimates[:, index]
        values = values[np.isfinite(values)]
        if not len(values):
            panels.append(Panel(title=word, message="no successful trials", place=(0, place)))
            continue
        std = np.sqrt(trials.crlb[index, index])
        low, high = _central_range(values, theta, std)
        bins = int(np.clip(2.0 * np.sqrt(len(values)), 8, 60))
        counts, edges = np.histogram(values, bins=bins, range=(low, high))
        density = counts / (len(values) * np.diff(edges))
        marks = [
            mark("columns", edges, density, role, opacity=0.5, label=word),
            vline(theta, dash="--", label=true),
        ]
        if np.isfinite(std) and std > 0.0:
            x = np.linspace(low, high, 400)
            bound = "normal curve of the Cramér–Rao bound"
            marks.append(line(x, normal_density(x, theta, std), "text", width=1.4, label=bound))
        hidden = int(np.sum((values < low) | (values > high)))
        panels.append(
            Panel(
                title=word,
                role=role,
                remark=_statistics(trials, index, unit, hidden),
                marks=marks,
                x=Axis(label=label, limits=(low, high), most=5),
                y=axis,
                place=(0, place),
            )
        )
        peak = max(float(density.max()), 1e-300)
        overlay.append(mark("columns", edges, density / peak, role, opacity=0.5))
    all_on_one = Panel(
        title="all trajectories on one axis",
        role="muted",
        marks=[*overlay, vline(theta, dash="--")],
        message="" if overlay else "no successful trials",
        x=Axis(label=label),
        y=Axis(label="density / peak [–]", limits=(0.0, 1.08)),
        place=(1, 0),
        is_wide=True,
    )
    note = (
        "Simulated recordings of the model with noise of the stated σ. The upper panels have "
        "different ranges."
    )
    return Picture(
        title=f"Monte Carlo estimates of {labels.parameters[index]}",
        panels=[*panels, all_on_one],
        note=note,
        heights=[3.2, 1.5],
        widths=[1.0] * len(study.sets),
    )


def _central_range(values: Array, theta: float, std: float) -> tuple[float, float]:
    """Return a range that shows most estimates and the true value; outliers do not widen it."""
    first, median, third = (float(value) for value in np.quantile(values, (0.25, 0.5, 0.75)))
    reach = OUTLIER_DISTANCE * (third - first)
    low, high = max(float(values.min()), first - reach), min(float(values.max()), third + reach)

    # A bound that is far wider than the estimates would hide them.
    half = 0.5 * (high - low)
    shown = SHOWN_STDS * std if np.isfinite(std) and (std < 20.0 * half or not half) else 0.0
    low, high = min(low - 0.1 * half, theta - shown), max(high + 0.1 * half, theta + shown)

    # Estimates that are all equal need some width around them.
    smallest = 1e-9 * max(abs(median), abs(theta), 1e-9)
    if high - low <= smallest:
        return median - 1e3 * smallest, median + 1e3 * smallest
    return low, high


def _statistics(trials: TrialStatistics, index: int, unit: str, hidden: int) -> str:
    """Return variance, bound, efficiency and counts of one histogram in words."""
    variance, bound = (
        f"{format_number(matrix[index, index])} {squared_unit(unit)}".rstrip()
        for matrix in (trials.covariance, trials.crlb)
    )
    low, high = (format_number(end) for end in trials.efficiency_interval[index])
    text = (
        f"variance {variance}, bound {bound}; efficiency "
        f"{format_number(trials.efficiency[index])}, 95 % interval [{low}, {high}]; "
        f"{trials.trials} trials, {trials.failed} failed"
    )
    return f"{text}, {hidden} outside this range" if hidden else text


# ---- two robots


def robots(comparison: RobotComparison) -> Picture:
    """Show the difference of every parameter of two robots with its interval."""
    order = comparison.order[:MAX_DIFFERENCES].tolist()
    size = np.where(comparison.detectable > 0.0, comparison.detectable, np.nan)[order]
    ends = np.column_stack([comparison.difference, comparison.interval])[order]
    drawn = np.nan_to_num(ends / size[:, None])
    centre, low, high = drawn.T
    largest = np.abs(drawn).max(initial=1.3)
    reach = 1.08 * min(float(largest), LARGEST_DIFFERENCE)
    rows = np.arange(len(order))
    is_changed = np.array([j in comparison.changed for j in order], dtype=bool)
    marks = [vspan(-1.0, 1.0, opacity=0.6, label="would hardly be found"), vline(0.0)]
    for chosen, role, label in (
        (is_changed, DESIGNED, "differs"),
        (~is_changed, IDENTIFIED, "no difference proven"),
    ):
        inside = chosen & (np.abs(centre) <= reach)
        marks += [
            intervals(low[chosen], high[chosen], rows[chosen], role, width=1.4),
            dots(centre[inside], rows[inside], role, size=5.5, label=label),
        ]
    first, second = (shorten(name, 24, comparison.names) for name in comparison.names)
    texts = [
        " → ".join(
            format_with_uncertainty(value, NORMAL_95 * std)
            for value, std in zip(comparison.values[:, j], comparison.std[:, j], strict=True)
        )
        for j in order
    ]
    note = (
        f"Numbers: {first} → {second}, each with half the width of its 95 % interval. A difference "
        "outside the strip would be found with a probability of 80 % or more."
    )
    note += share_note(order, comparison.parameters, "parameters, the most significant ones")
    if not comparison.is_reliable:
        note += " One of the estimates is not reliable, or does not fit its recordings."

    title = f"{second} and {first}: no difference proven"
    if comparison.changed:
        names = [
            shorten(comparison.parameters[j], 26, comparison.parameters)
            for j in comparison.changed[:3]
        ]
        more = len(comparison.changed) - len(names)
        others = f" and {more} more" if more else ""
        title = f"{second} differs from {first} in {', '.join(names)}{others}"
    elif comparison.differs:
        title = f"{second} differs from {first}, but not in a single parameter"
    labels = parameter_names(comparison, order, with_unit)
    panel = Panel(
        marks=marks,
        x=Axis(label="difference / difference that would be found [–]", limits=(-reach, reach)),
        y=row_axis(labels, [DESIGNED if changed else "text" for changed in is_changed]),
        beside=[("", "text", texts)],
    )
    row = 0.36 if len(order) <= MAX_HIGH_ROWS else 0.25
    return Picture(title=title, panels=[panel], note=note, heights=[0.7 + row * len(order)])


# ---- rehearsals


def rehearsal(result: Rehearsal) -> Picture:
    """Show the fans of the robots' motions, and the margin of every limit for all robots."""
    fans = fan_panels(result)
    columns = 3 if len(fans) > MAX_WIDE_FANS else 2 if len(fans) > 1 else 1
    panels = in_grid(fans, columns)
    heights = [1.8] * -(-len(fans) // columns)
    if result.limits:
        panels.append(replace(_margins(result), place=(len(heights), 0), is_wide=True))
        heights.append(max(1.4, 0.8 + 0.24 * len(result.limits)))
    control = "with the gains K(t)" if result.feedback else "open loop"
    found = "some reach a clamp" if result.is_clamping else "safe to play"
    title = (
        f"{result.robots} robots, parameters up to {100 * result.wrong:g} % off, {control}: "
        f"{found if result.is_safe else 'do not play'}"
    )
    note = (
        "Horizontal axes of the curves: time [s]; deviations are from the model. Dots are robots, "
        "bars the model."
    )
    shown = {fan.limit.name for fan in result.fans}
    shown |= {name.rpartition(".")[0] for name in shown}
    hidden = [name for name in result.joints if name.removesuffix(" (rotation)") not in shown]
    if hidden:
        note += f" The curves of {len(hidden)} further joints are not drawn."
    if result.robots > MAX_PATHS:
        note += f" Curves: the first {MAX_PATHS} robots."
    if not result.limits:
        note += " The experiment states no limits."
    elif (result.margins > 1.0).any():
        note += " Margins above 100 % are drawn there."
    return Picture(
        title=title,
        panels=panels or [Panel(message="neither robots nor limits")],
        note=note,
        heights=heights or [1.4],
        widths=[1.0] * columns,
    )


def fan_panels(result: Rehearsal) -> list[Panel]:
    """Return a panel for each fan: where the robots are before and after the experiment.

    A fan that would hardly be wider than a line is drawn as deviations from the model.

    Args:
        result: The rehearsal.
    """
    panels = []
    for fan in result.fans:
        limit, broken = fan.limit, 0
        if limit in result.limits:
            broken = int((~result.kept[1:, result.limits.index(limit)]).sum())
        # Robots that leave a limit are drawn however many curves there are.
        is_thin = fan.spread_before < THIN_FAN * np.ptp(fan.model)
        origin = fan.model if is_thin else np.zeros(len(fan.t))
        spreads = (format_number(each, 2) for each in (fan.spread_before, fan.spread_after))
        remark = "spread ±{}, after the experiment ±{}".format(*spreads)
        nearest = "robot closest to the limit"
        if broken:
            remark = f"{broken} of {result.robots} leave the limit; {remark}"
            nearest = "robot farthest beyond the limit"

        low, high = fan.before - origin
        worst = np.full(len(fan.t), np.nan) if is_thin and not broken else fan.worst - origin
        marks = [
            area(fan.t, low, high, MEASURED, label="90 % of the robots"),
            # A strip that is thinner than a line can be seen, too.
            *(
                line(fan.t, edge - origin, IDENTIFIED, label="90 % after the experiment")
                for edge in fan.after
            ),
            line(fan.t, fan.model - origin, "text", dash="--", width=1.0, label="model"),
        ]
        if np.isfinite(worst).any():
            role = DESIGNED if broken else MEASURED
            marks.append(line(fan.t, worst, role, width=1.0, label=nearest))
        every = np.stack([low, high, fan.model - origin, worst])
        least, most = np.nanmin(every), np.nanmax(every)
        reach = NEAR_LIMIT * (most - least)
        # Zero is no limit of a magnitude.
        is_magnitude = limit.lower == 0.0 and limit.scale == limit.upper
        for bound in (limit.lower, limit.upper)[is_magnitude:]:
            edge = bound - origin
            is_near = (least - reach < edge) & (edge < most + reach)
            if is_near.any():
                edge = np.where(is_near, edge, np.nan)
                marks.append(line(fan.t, edge, "muted", dash=":", label="limit"))
        panels.append(
            Panel(
                title=with_unit(f"{limit.kind.replace('_', ' ')} {limit.name}", limit.unit),
                role=DESIGNED if broken else "text",
                remark=remark,
                marks=marks,
                x=Axis(most=5),
                y=Axis(label="deviation" if is_thin else "", most=4),
            )
        )
    return panels


def _margins(result: Rehearsal) -> Panel:
    """Return a row per limit: margin of the model, and of every robot."""
    margins = np.where(np.isfinite(result.margins), result.margins, LEAST_MARGIN)
    percent = 100.0 * np.clip(margins, LEAST_MARGIN, 1.0)
    low = min(-5.0, float(percent.min(initial=0.0)) - 5.0)
    marks = [vspan(low, 0.0, DESIGNED, opacity=0.1)]
    for i in range(len(result.limits)):
        role, label = MEASURED, "robots"
        if not result.kept[:, i].all():
            role, label = DESIGNED, "robots, some exceed the limit"
            if result.is_clamped[i]:
                role, label = NOMINAL, "robots, some reach the clamp"
        marks += _row(percent[:, i], i, role, label)
    names = [f"{limit.kind.replace('_', ' ')} {limit.name}" for limit in result.limits]
    title = f"{result.all_kept} of {result.robots} robots keep all limits"
    if result.unbraked:
        title += f", {max(result.unbraked.values())} end too fast to be braked"
    return Panel(
        title=title,
        marks=marks,
        x=Axis(label="margin over half of the range [%]", limits=(low, 105.0)),
        y=row_axis(names),
    )


def _row(values: Array, row: int, role: str, label: str) -> list[Mark]:
    """Return dots for the robots, spread over the height of a row, and a bar for the model."""
    rng = np.random.default_rng(0)
    rows = row + rng.uniform(-0.22, 0.22, len(values) - 1)
    look = {"symbol": "|", "size": 14.0, "width": 1.6}
    return [
        dots(values[1:], rows, role, size=3.5, opacity=0.5, label=label),
        dots(values[:1], [row], "text", **look),
    ]


# ---- campaigns


def campaign(result: Campaign, true: Array | None = None) -> Picture:
    """Show standard deviation and estimate of each parameter over the rounds.

    Args:
        result: The campaign.
        true: (p,) true values of its parameters [theta-unit], where they are known.
    """
    has_target = np.isfinite(result.wanted)
    shown = sorted(result.interest, key=lambda j: not has_target[j])[:MAX_ROUNDS]
    numbers = np.array([float(r.number) for r in result.rounds])
    limits = (0.5, float(numbers[-1]) + 0.5)
    panels = []
    for j in shown:
        name = shorten(result.parameters[j], 18, result.parameters)
        unit = result.rounds[0].estimate.units[j]
        label = "round" if j == shown[-1] else ""
        ticks = numbers.tolist() if len(numbers) <= MAX_TICKS else None
        axis = Axis(label=label, limits=limits, ticks=ticks, most=MAX_TICKS, whole=True)
        guess = format_number(result.rounds[0].theta[j], 4)
        panels += [
            _accuracy_over_rounds(
                result, numbers, j, title=with_unit(f"σ of {name}", unit), axis=axis
            ),
            _estimate_over_rounds(
                result,
                numbers,
                j,
                true,
                title=f"{with_unit(name, unit)}, first design at {guess}",
                axis=axis,
            ),
        ]
    count = len(numbers)
    note = (
        f"{as_sentence(result.status.value)} Bars, and the band of the last round: ± 1 and ± 2 "
        "formal σ, which are the true accuracy only if the model and the noise are right."
    )
    title = f"{count} {'round' if count == 1 else 'rounds'} of design, recording and estimate"
    return grid(title, panels, [1.75] * len(panels), 2, note)


# ---- live meter


def watch(result: Watch) -> Picture:
    """Show the standard deviation of each parameter, by the rows up to each time."""
    known = np.flatnonzero(np.isfinite(result.std) & np.isfinite(result.wanted))
    share = result.std[known] / result.wanted[known]
    shown = sorted(known[np.argsort(-share)][: len(SERIES)].tolist())
    panel = accuracy_over_time_panel(
        [(result.t, result.std_over_time)],
        result.parameters,
        result.sizes,
        result.wanted,
        result.reached,
        shown,
        is_stated=result.is_stated,
    )
    which = "parameters, those furthest from it"
    return Picture(
        title=progress_of_watch(result).removesuffix("."),
        panels=[panel],
        note=f"Beside the names: σ at the end, at the guess. {BEST_CASE}"
        + share_note(shown, known, which),
        heights=[3.4],
    )


def _accuracy_over_rounds(
    result: Campaign, numbers: Array, j: int, *, title: str, axis: Axis
) -> Panel:
    """Return predicted and formal standard deviations of parameter j."""
    predicted = np.array([r.predicted[j] for r in result.rounds])
    attained = np.array([r.attained[j] for r in result.rounds])
    wanted = float(result.wanted[j])
    low, high = around(np.concatenate([predicted, attained, [wanted]]), factor=1.5)
    before, after = "predicted before the round", "estimated after the round, from all recordings"
    marks = [
        dots(numbers, predicted, DESIGNED, size=8.0, hollow=True, label=before),
        line(numbers, attained, IDENTIFIED, symbol="o", front=3.0, label=after),
    ]
    if np.isfinite(wanted):
        title += f", wanted {format_number(wanted, 2)}"
        marks += [
            hline(wanted, dash="--", label="wanted"),
            hspan(low, wanted, "text", opacity=0.06),
        ]
    return Panel(title=title, marks=marks, x=axis, y=Axis(log=True, limits=(low, high)))


def _estimate_over_rounds(
    result: Campaign,
    numbers: Array,
    j: int,
    true: Array | None,
    *,
    title: str,
    axis: Axis,
) -> Panel:
    """Return the estimates of parameter j, with the true value if it is known."""
    theta = np.array([r.estimate.theta[j] for r in result.rounds])
    std = finite_or_nan(np.array([r.attained[j] for r in result.rounds]))
    marks = [dots(numbers, theta, IDENTIFIED)]
    for factor, width in ((1.0, 2.4), (2.0, 0.9)):
        ends = theta[:, None] + np.outer(factor * std, [-1.0, 1.0, np.nan])
        marks.append(line(np.repeat(numbers, 3), ends.ravel(), IDENTIFIED, width=width))
        if np.isfinite(std[-1]):
            marks.append(hspan(ends[-1, 0], ends[-1, 1], IDENTIFIED, opacity=0.07))
    if true is not None:
        marks.append(hline(true[j], label="true value"))
    return Panel(title=title, marks=marks, x=axis, y=Axis(most=4))
