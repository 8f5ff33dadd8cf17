"""The report of a design."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from mjfim.arrays import Array
from mjfim.model.coordinates import split_unit
from mjfim.output.labels import complete_labels
from mjfim.output.limit_curves import (
    closest_to_bounds,
    envelope,
    largest_share,
    whole_percent,
    would_be_solid,
)
from mjfim.output.positions import shown_positions
from mjfim.output.report.correlations import correlation_of
from mjfim.output.report.curves import (
    axis,
    band,
    correlation_panel,
    curve,
    level,
    log_axis,
    row_axis,
    rows_height,
    rows_of_bars,
)
from mjfim.output.report.page import Key, Page, Panel, PlotGroup, Plotly, Section
from mjfim.output.summaries.accuracy import NOT_ALONE, improvement, relative
from mjfim.output.summaries.design import describe_design
from mjfim.output.summaries.verdicts import next_steps, verdict_of
from mjfim.output.summary_parts import Quantity
from mjfim.output.vocabulary import DESIGNED, INITIAL
from mjfim.records.design import Design, Evaluation, LimitUsage
from mjfim.records.labels import Labels

# Entries of the legend of the two trajectories.
TRAJECTORY_KEYS = (
    Key(name=INITIAL.word, role=INITIAL.word),
    Key(name=DESIGNED.word, role=DESIGNED.word),
)

# Largest number of plots in one group; of more columns, the first ones are shown.
MAX_PANELS = 36

# Distance of a bound from the motion, relative to the range of the motion, up to which its plot
# shows the bound.
NEAR_BOUND = 1.0

# Largest number of curves of one kind of limit; of more, those that come closest to a bound.
MAX_LIMIT_CURVES = 8

# Colours of joints, actuators and pairs of geoms in the plots of limits, in the order of their
# closeness to a bound, and that of all others.
LIMIT_ROLES, OTHER_ROLE = tuple(f"series{i}" for i in range(MAX_LIMIT_CURVES)), "muted"


def design_page(design: Design) -> Page:
    """Return the report of a design.

    Args:
        design: The design.
    """
    labels = complete_labels(design)
    summary = describe_design(design, labels.parameter_units)
    seconds = float(design.trajectory.t[-1] - design.trajectory.t[0])

    # Tables of limits and of the search stand with their plots.
    elsewhere = {"limits", "eigenvalues", "starts"}
    table = summary.table("accuracy")
    others = [
        part
        for part in summary.parts
        if part is not table and getattr(part, "key", "") not in elsewhere
    ]
    accuracy = [table, *_accuracy_plots(design, labels), *others]
    sections = [
        Section(title="Accuracy", parts=accuracy),
        Section(title="Motion", parts=list(_motion_plots(design, labels))),
    ]
    limits = [table for table in summary.tables if table.key == "limits"]
    if design.usage:
        sections.append(Section(title="Limits", parts=[_limit_plots(design), *limits]))
    search = [table for table in summary.tables if table.key in ("eigenvalues", "starts")]
    sections.append(Section(title="Optimisation", parts=[_history_plots(design), *search]))

    before, after = design.initial.eigenvalues[0], design.final.eigenvalues[0]
    facts = {
        "duration": f"{seconds:.4g} s",
        "λ_min": f"{Quantity(value=float(before))} → {Quantity(value=float(after))}",
        "iterations": str(design.iterations),
        "time of the search": f"{design.seconds:.3g} s",
    }
    return Page(
        kind="Design of an experiment",
        verdict=verdict_of(design),
        next_steps=next_steps(design),
        warnings=design.warnings,
        facts=facts,
        sections=sections,
    )


# ---- accuracy


def _accuracy_plots(design: Design, labels: Labels) -> Iterator[PlotGroup]:
    """Yield bars of the standard deviations, and the correlations of the estimates."""
    wanted = list(design.wanted)
    names = [design.parameters[j] for j in wanted]
    sizes = np.where(design.sizes > 0.0, design.sizes, np.nan)[wanted]
    initial = 100.0 * design.initial.std[wanted] / sizes
    designed = 100.0 * design.final.std[wanted] / sizes
    bars = Panel(
        title="predicted σ [% of the parameter's size]",
        traces=[
            _std_bars(design, wanted, initial, INITIAL.word, before=True),
            _std_bars(design, wanted, designed, DESIGNED.word, before=False),
        ],
        layout={
            "xaxis": log_axis("σ / size [%]", np.append(initial, designed), room=(0.5, 0.3)),
            "yaxis": row_axis(names),
            "bargap": 0.25,
        },
        height=rows_height(len(names), 44),
    )

    panels = [bars]
    correlation = correlation_of(design.final.information, design.final.std)
    if len(names) > 1 and np.isfinite(correlation[np.ix_(wanted, wanted)]).any():
        title = "correlation of the estimates after the designed motion [–]"
        panels.append(correlation_panel(correlation[np.ix_(wanted, wanted)], names, title))
    keys = [
        Key(name=INITIAL.word, role=INITIAL.word, shape="bar"),
        Key(name=DESIGNED.word, role=DESIGNED.word, shape="bar"),
    ]
    note = (
        "No bar: the parameter is not identifiable alone from this trajectory, or its value is 0."
    )
    some_missing = not (np.isfinite(initial).all() and np.isfinite(designed).all())
    yield PlotGroup(title="", panels=panels, keys=keys, note=note if some_missing else "")


def _std_bars(
    design: Design, wanted: Sequence[int], shares: Array, name: str, *, before: bool
) -> Plotly:
    """Return the bars of one trajectory; shares: (t,) [% of the size]."""
    texts = []
    for j, share in zip(wanted, shares, strict=True):
        evaluation = design.initial if before else design.final
        std, size = float(evaluation.std[j]), float(design.sizes[j])
        text = str(relative(std, size)) if np.isfinite(share) else NOT_ALONE
        if not before:
            text += f"  ({improvement(float(design.initial.std[j]), std)})"
        texts.append(text)
    return rows_of_bars(np.where(np.isfinite(shares), shares, np.nan), name, name, texts=texts)


# ---- motion


@dataclass(frozen=True, eq=False, kw_only=True)
class _Signals:
    """Positions, velocities or controls of both trajectories.

    Attributes:
        title: Title of their plots.
        kind: Kind of their limits.
        labels: n labels, `<name> [<unit>]`.
        values: (N+1, n) or, of controls, (N, n) values of the initial and the designed trajectory.
    """

    title: str
    kind: Literal["position", "velocity", "control"]
    labels: tuple[str, ...]
    values: tuple[Array, ...]


def _motion_plots(design: Design, labels: Labels) -> Iterator[PlotGroup]:
    """Yield plots of positions, velocities, controls and of the information over time."""
    initial, designed = design.initial.trajectory, design.final.trajectory
    positions, both = shown_positions(labels, initial.qpos, designed.qpos)
    groups = (
        _Signals(title="Positions", kind="position", labels=positions, values=both),
        _Signals(
            title="Velocities",
            kind="velocity",
            labels=labels.velocities,
            values=(initial.qvel, designed.qvel),
        ),
        _Signals(
            title="Controls",
            kind="control",
            labels=labels.controls,
            values=(initial.ctrl, designed.ctrl),
        ),
    )
    yield _information_plot(design)
    for group in groups:
        if not group.labels:
            continue
        bounds = _bounds_by_label(design, group)
        panels = [
            _signal_panel(design, group, i, bounds.get(name, ()))
            for i, name in enumerate(group.labels[:MAX_PANELS])
        ]
        note = "Dashed lines: limits. " if any(panel.layout["shapes"] for panel in panels) else ""
        if any(panel.remark for panel in panels):
            note += "Limits far from the motion stand above the plots. "
        if len(group.labels) > MAX_PANELS:
            note += (
                f"The first {MAX_PANELS} of {len(group.labels)} columns are shown; all of them are "
                "in design.npz."
            )
        yield PlotGroup(title=group.title, panels=panels, keys=TRAJECTORY_KEYS, note=note)


def _bounds_by_label(design: Design, group: _Signals) -> dict[str, tuple[float, float]]:
    """Return the finite bounds of positions, velocities or controls, by label."""
    ending = " velocity" if group.kind == "velocity" else ""
    label_of = {split_unit(label)[0].removesuffix(ending): label for label in group.labels}
    return {
        label_of[usage.name]: (usage.lower, usage.upper)
        for usage in design.usage
        if usage.kind == group.kind
        and usage.name in label_of
        and (np.isfinite(usage.lower) or np.isfinite(usage.upper))
    }


def _signal_panel(
    design: Design, group: _Signals, column: int, bounds: tuple[float, float] | tuple[()]
) -> Panel:
    """Return the plot of one column of both trajectories, with its bounds."""
    traces, extremes = [], []
    evaluations = (design.initial, design.final)
    for evaluation, term, rows in zip(evaluations, (INITIAL, DESIGNED), group.values, strict=True):
        values = rows[:, column]
        held = group.kind == "control"
        if held:
            # The last control is held until the end.
            values = np.append(values, values[-1])
        traces.append(curve(evaluation.trajectory.t, values, term.word, term.word, held=held))
        extremes += [float(values.min()), float(values.max())]

    # A bound that the motion comes near is inside the plot; one far away would flatten the curves.
    lines = [bound for bound in bounds if np.isfinite(bound)]
    reach = NEAR_BOUND * float(np.ptp(extremes))
    near = [y for y in lines if min(extremes) - reach <= y <= max(extremes) + reach]
    layout: Plotly = {"xaxis": axis("time [s]"), "shapes": [level(y, "bound") for y in near]}
    if near:
        ends = [*extremes, *near]
        room = 0.06 * float(np.ptp(ends))
        layout["yaxis"] = axis(range=[min(ends) - room, max(ends) + room])
    remark = ""
    if len(near) < len(lines):
        stated = " and ".join(f"{y:.4g}" for y in lines)
        remark = f"limits {stated}" if len(lines) > 1 else f"limit {stated}"
    return Panel(
        title=group.labels[column], traces=traces, layout=layout, linked="time", remark=remark
    )


def _information_plot(design: Design) -> PlotGroup:
    """Return the plot of the information that is gathered up to each time."""
    traces = [
        _root_information(evaluation, term.word)
        for evaluation, term in ((design.initial, INITIAL), (design.final, DESIGNED))
    ]
    panel = Panel(
        title="√λ_min of the information up to each time [√s / unit of θ]",
        traces=traces,
        layout={"xaxis": axis("time [s]")},
        linked="time",
        wide=True,
    )
    note = (
        "λ_min: smallest eigenvalue of the Fisher information up to time t, divided by the rate of "
        "the measurements. It rises where the motion tells most."
    )
    return PlotGroup(title="Information", panels=[panel], keys=TRAJECTORY_KEYS, note=note)


def _root_information(evaluation: Evaluation, name: str) -> Plotly:
    """Return the curve of the root of the smallest eigenvalue of one trajectory."""
    root = np.sqrt(np.maximum(evaluation.min_eigenvalue, 0.0))
    return curve(evaluation.trajectory.t, root, name, name)


# ---- limits


def _limit_plots(design: Design) -> PlotGroup:
    """Return a plot of the used share of each limit, one for each kind."""
    kinds = list(dict.fromkeys(usage.kind for usage in design.usage))
    roles = dict(zip(closest_to_bounds(design.usage), LIMIT_ROLES, strict=False))
    panels = []
    for kind in kinds:
        usages = [usage for usage in design.usage if usage.kind == kind]
        panels.append(_limit_panel(design, kind, usages, roles))
    note = (
        "Every engine step of the designed motion on the stated model, in percent of the way from "
        "the middle of the range to its bound; the dashed lines are the bounds. Where a curve "
        "swings too fast to be seen, its largest size in short intervals is drawn."
    )
    return PlotGroup(title="How much of each limit is used", panels=panels, note=note)


def _limit_panel(
    design: Design, kind: str, usages: list[LimitUsage], roles: dict[str, str]
) -> Panel:
    """Return the plot of one kind of limit; the curves closest to a bound are drawn.

    `roles` holds the role of the colour of a joint or actuator, by its name.
    """
    closest_first = sorted(usages, key=lambda usage: -largest_share(usage))
    shown = closest_first[:MAX_LIMIT_CURVES]
    is_dense = any(would_be_solid(usage) for usage in shown)
    traces, keys = [], []
    for usage in shown:
        role = roles.get(usage.name, OTHER_ROLE)
        name = f"{usage.name} {whole_percent(largest_share(usage))}"
        times, values = usage.t, 100.0 * usage.share
        if is_dense:
            times, low, high = envelope(usage)
            values = np.maximum(np.abs(low), np.abs(high))
        traces.append(curve(times, values, name, role, width=1.3))
        keys.append(Key(name=name, role=role))

    # A clearance has one bound, and an envelope shows the closer one.
    largest = 100.0 * largest_share(closest_first[0])
    one_sided = is_dense or kind == "clearance"
    reach = max(112.0, 1.08 * largest)
    shapes = [level(100.0, "bound"), band(100.0, reach, "forbidden")]
    if not one_sided:
        shapes += [level(-100.0, "bound"), band(-reach, -100.0, "forbidden")]

    share = f"{largest:.4g}" if abs(largest - 100.0) < 0.5 else f"{largest:.0f}"
    margin = design.limits.get(kind, float("nan"))
    remark = f"violated: {share} % used" if margin < 0.0 else f"at most {share} % used"
    more = len(usages) - len(shown)
    return Panel(
        title=f"{kind.replace('_', ' ')}: {_limit_title(kind, is_dense=is_dense)}",
        traces=traces,
        layout={
            "xaxis": axis("time [s]"),
            "yaxis": axis(range=[0.0 if one_sided else -reach, reach]),
            "shapes": shapes,
        },
        remark=remark + (f"; {more} curves with smaller shares are not drawn" if more else ""),
        linked="limits",
        keys=keys,
    )


def _limit_title(kind: str, *, is_dense: bool) -> str:
    """Return what the vertical axis of a limit shows."""
    if kind == "clearance":
        return "required / actual distance [%]"
    return "largest use in short intervals [%]" if is_dense else "place in the range [%]"


# ---- optimisation


def _history_plots(design: Design) -> PlotGroup:
    """Return plots of cost, smallest eigenvalue, slope and margin over the iterations."""
    history = design.history
    iterations = np.array([row.iteration for row in history], dtype=np.float64)
    quantities = {
        "cost J [–]": np.array([row.cost for row in history]),
        "λ_min [s / (unit of θ)²]": np.array([row.min_eigenvalue for row in history]),
        "slope |DJ·ζ| [–]": np.abs([row.slope for row in history]),
    }
    panels = []
    for title, values in quantities.items():
        positive = np.where(values > 0.0, values, np.nan)
        if np.isfinite(positive).any():
            panels.append(_history_panel(title, iterations, positive, logarithmic=True))

    margins = 100.0 * np.array([row.margin for row in history])
    if np.isfinite(margins).any():
        title = "worst margin [% of half of the range]"
        panels.append(_history_panel(title, iterations, margins, logarithmic=False))

    note = f"{design.outcome[:1].upper()}{design.outcome[1:]}."
    is_other = history and not np.isclose(history[0].cost, design.initial.cost, rtol=1e-9, atol=0.0)
    rates = list(dict.fromkeys(row.rate for row in history if row.rate > 0.0))
    if is_other and design.found_by != "initial control":
        note += f" The search did not begin at the initial control, but at {design.found_by}."
    if len(rates) > 1:
        shown = " → ".join(f"{rate:g}" for rate in rates)
        note += f" The time grid becomes finer ({shown} Hz), which changes the cost at once."
    if any(row.mu for row in history):
        note += (
            " With limits, the slope is that of log J plus the barrier, and a vertical step of a "
            "curve is a new stage of the barrier."
        )
    return PlotGroup(title="Trace of the search", panels=panels, note=note)


def _history_panel(title: str, iterations: Array, values: Array, *, logarithmic: bool) -> Panel:
    """Return the plot of one quantity over the iterations."""
    trace = curve(iterations, values, title.split(" [")[0], "text", width=1.4)
    trace["mode"] = "lines+markers"
    trace["marker"] = {"size": 4, "color": "role:text"}
    vertical = log_axis("", values) if logarithmic else axis()
    usable = np.flatnonzero(np.isfinite(values))
    first, last = float(values[usable[0]]), float(values[usable[-1]])
    return Panel(
        title=title,
        traces=[trace],
        layout={"xaxis": axis("iteration [–]"), "yaxis": vertical},
        remark=f"{Quantity(value=first)} → {Quantity(value=last)}",
        linked="iteration",
    )
