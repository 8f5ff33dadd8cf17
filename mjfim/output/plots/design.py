"""Pictures of a design: motion, search, accuracy, limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from mjfim.arrays import Array, finite_or_nan
from mjfim.model.coordinates import split_unit
from mjfim.model.units import FORCE_UNITS, LENGTH, per_second
from mjfim.output.archive import shown_positions
from mjfim.output.page import DESIGNED, INITIAL, as_sentence
from mjfim.output.pages.worth import SMALL_INCREASE, change, headline, percent, price_name
from mjfim.output.panels import (
    SERIES,
    Axis,
    Kind,
    Mark,
    Panel,
    Picture,
    area,
    around,
    bars,
    dots,
    grid,
    hline,
    hspan,
    in_grid,
    line,
    mark,
    row_axis,
    vline,
)
from mjfim.output.plots.accuracy import (
    INITIAL_LOOK,
    Accuracies,
    accuracy_over_time_panel,
    accuracy_panel,
    height_of_rows,
)
from mjfim.output.words import (
    BEST_CASE,
    format_number,
    improvement,
    relative,
    share_note,
    shorten,
    sigma_remark,
    when_learnt,
)
from mjfim.records.design import Design, LimitUsage
from mjfim.records.trajectory import Labels, Trajectory, with_unit
from mjfim.records.worth import SensorWorth, Worth

# Number of turning points above which a curve would be a solid area; its envelope is drawn instead.
MAX_TURNS = 120

# Number of intervals of time of which an envelope shows the smallest and the largest value.
ENVELOPE_INTERVALS = 150


def largest_share(usage: LimitUsage) -> float:
    """Return the largest share of a limit that is used at any time; above 1 it is violated.

    Args:
        usage: The use of the limit.
    """
    return float(np.abs(usage.share).max())


def would_be_solid(usage: LimitUsage) -> bool:
    """Return whether a curve turns so often that its line would fill an area.

    Args:
        usage: The use of the limit.
    """
    change = np.diff(usage.share)
    rising = np.sign(change[change != 0.0])
    return int(np.count_nonzero(np.diff(rising))) > MAX_TURNS


def envelope(usage: LimitUsage) -> tuple[Array, Array, Array]:
    """Return times [s], and smallest and largest shares [%], of successive intervals.

    Args:
        usage: The use of the limit.
    """
    starts = np.unique(np.linspace(0, len(usage.t), ENVELOPE_INTERVALS, endpoint=False).astype(int))
    percent = 100.0 * usage.share
    low, high = np.minimum.reduceat(percent, starts), np.maximum.reduceat(percent, starts)
    ends = np.append(starts[1:], len(usage.t)) - 1
    return 0.5 * (usage.t[starts] + usage.t[ends]), low, high


def whole_percent(share: float) -> str:
    """Write a share in whole percents; one within the bound is never rounded to 100 %.

    Args:
        share: The share, 1 at the bound.
    """
    percent = round(100.0 * share)
    if share < 1.0 and percent == 100:
        return "> 99 %"
    return f"{percent} %"


# Look of the curves of the initial motion where colours tell parameters.

# Number of panels of the trajectories side by side, and largest σ that is drawn over time, over its
# target.
PANEL_COLUMNS = 4

# Widths of the lines of the initial and of the designed trajectory [points].
LINE_WIDTHS = (1.1, 1.6)

# Distance from the motion, over its range, up to which a limit is drawn beside it.
NEAR_LIMIT = 0.5

# Unit of the force of an actuator or joint, by the unit of its control or of its position.
FORCE_OF_CONTROL = {
    coordinate: force
    for unit, force in FORCE_UNITS.items()
    for coordinate in (unit, per_second(unit), force)
}

# Largest number of panels of limits that are as wide as the figure, and of curves of a panel that
# are named with their shares, those closest to a bound.
MAX_WIDE_PANELS, NAMED_CURVES = 3, 3

# Number of envelopes of a panel above which each curve has a row of its own, and largest number of
# these rows; height of a share of 100 % over the height of a row.
MAX_ENVELOPES, MAX_ROWS, FULL_ROW = 2, 12, 0.86


# ---- trajectories


def trajectories(design: Design, labels: Labels) -> Picture:
    """Show states and controls of both motions (the paper's figure 2)."""
    groups = motion_panels(labels, both_motions(design), design.usage)
    columns = min(PANEL_COLUMNS, max(map(len, groups.values())))
    panels: list[Panel] = []
    row = 0
    for name, found in groups.items():
        # The name of a group stands beside the first panel of each row.
        named = [
            replace(panel, y=replace(panel.y, label=name)) if k % columns == 0 else panel
            for k, panel in enumerate(found)
        ]
        panels += in_grid(named, columns, row)
        row += -(-len(found) // columns)
    note = "All horizontal axes: time [s]."
    if groups["controls"]:
        note += " Grey background: controls."
    return Picture(
        title="Initial and designed motion",
        panels=panels,
        note=note,
        heights=[1.15] * row,
        widths=[1.0] * columns,
    )


def both_motions(design: Design) -> dict[str, Trajectory]:
    """Return the initial and the designed motion by their roles."""
    return {INITIAL: design.initial.trajectory, DESIGNED: design.final.trajectory}


def motion_panels(
    labels: Labels,
    trajectories: Mapping[str, Trajectory],
    usage: Sequence[LimitUsage] = (),
    roles: Mapping[str, str] | None = None,
) -> dict[str, list[Panel]]:
    """Return panels of positions, velocities and controls of one or more trajectories.

    Args:
        labels: Names and units of all columns.
        trajectories: The trajectories by their name.
        usage: Limits, which are lines where the motion comes near them.
        roles: Roles of the trajectories by their name; default: the name.
    """
    roles = roles or {name: name for name in trajectories}
    shown = list(trajectories.values())
    positions, qpos = shown_positions(labels, *(each.qpos for each in shown))
    velocities = [label.replace(" velocity [", " [") for label in labels.velocities]
    controls = [label.replace(" (control)", " [model unit]") for label in labels.controls]
    groups = {
        "positions": ("position", positions, qpos),
        "velocities": ("velocity", velocities, [each.qvel for each in shown]),
        "controls": ("control", controls, [each.ctrl for each in shown]),
    }
    bounds = {(used.kind, used.name): (used.lower, used.upper) for used in usage}
    panels: dict[str, list[Panel]] = {}
    for group, (kind, names, values) in groups.items():
        panels[group] = []
        for k, name in enumerate(names):
            columns = [each[:, k] for each in values]
            curves = [
                _curve(trajectory.t, y, roles[key], width, key)
                for (key, trajectory), y, width in zip(
                    trajectories.items(), columns, (*LINE_WIDTHS, *[1.3] * len(shown)), strict=False
                )
            ]
            limits = bounds.get((kind, split_unit(name)[0]), ())
            panels[group].append(
                Panel(
                    title=name,
                    marks=[*curves, *_near_limits(limits, columns)],
                    x=Axis(most=5),
                    y=Axis(most=4),
                    is_shaded=group == "controls",
                )
            )
    return panels


def _curve(t: Array, y: Array, role: str, width: float, label: str) -> Mark:
    """Return a curve over time; a control is held from each time to the next."""
    kind: Kind = "line" if len(y) == len(t) else "steps"
    return mark(kind, t, y, role, width=width, label=label)


def _near_limits(limits: Sequence[float], values: Sequence[Array]) -> list[Mark]:
    """Return lines at the limits that are so near that they do not flatten the curves."""
    every = np.concatenate(values)
    every = every[np.isfinite(every)]
    if not len(every):
        return []
    low, high = float(every.min()), float(every.max())
    reach = NEAR_LIMIT * (high - low)
    return [
        hline(limit, "muted", dash="--", width=0.8, label="limit")
        for limit in limits
        if low - reach <= limit <= high + reach
    ]


# ---- search


def convergence(design: Design) -> Picture:
    """Show cost, slope and smallest eigenvalue over the iterations."""
    history = design.history
    iterations = np.array([row.iteration for row in history], dtype=np.float64)
    values = {
        "cost J [–]": np.array([row.cost for row in history], dtype=np.float64),
        "slope |DJ·ζ| [–]": np.abs([row.slope for row in history]),
        "λ_min [s / (unit of θ)²]": np.array(
            [row.min_eigenvalue for row in history], dtype=np.float64
        ),
    }
    # The search for a release has no slope.
    shown = {name: each for name, each in values.items() if np.isfinite(each).any() or not history}
    stages = [(row.rate, row.mu) for row in history]
    changes = [k for k in range(1, len(stages)) if stages[k] != stages[k - 1]]

    begin: str = INITIAL
    if history and not np.isclose(history[0].cost, design.initial.cost, rtol=1e-9, atol=0.0):
        begin = f"start: {design.found_by}"
    panels = []
    for name, each in shown.items():
        found = _history_marks(iterations, each, begin)
        stage = [vline(iterations[c], "band", width=1.5, front=0.0) for c in changes]
        usable = each[np.isfinite(each)]
        ends = [format_number(value) for value in (*usable[:1], *usable[-1:])]
        panels.append(
            Panel(
                marks=[*stage, *found],
                x=Axis(label="iteration [–]", whole=True),
                y=Axis(label=name, log=bool((each > 0.0).any())),
                title=" → ".join(ends),
                role="muted",
                message="" if found else "no iterations recorded",
            )
        )
    note = as_sentence(design.outcome)
    if changes:
        note += " Thick lines: the time grid becomes finer, or a new stage of the barrier begins."
    if any(row.mu for row in history):
        note += " With limits, the slope is that of log J plus the barrier."
    return grid("Convergence", panels, [2.4] * len(panels), len(panels), note)


def _history_marks(iterations: Array, values: Array, begin: str) -> list[Mark]:
    """Return the curve of one quantity, with dots at its ends."""
    usable = np.isfinite(values) & ((values > 0.0) | ~(values > 0.0).any())
    if not usable.any():
        return []
    x, y = iterations[usable], values[usable]
    curve = line(x, y, "muted", symbol=".", size=3.0)
    ends = [dots(x[-1:], y[-1:], DESIGNED, size=6.0, label=DESIGNED)]
    if usable[0]:
        ends.insert(0, dots(x[:1], y[:1], INITIAL, size=6.0, label=begin))
    return [curve, *ends]


# ---- accuracy


def accuracy(design: Design, labels: Labels) -> Picture:
    """Show the predicted standard deviations of both trajectories in percent, and wanted ones."""
    wanted, combined, rows = list(design.wanted), design.combined, design.rows
    names = [with_unit(each.name, each.unit) for each in rows]
    sizes = np.array([*design.shares[wanted], *(abs(each.value) or np.nan for each in combined)])
    before = np.array([each.further["std_initial"] for each in rows])
    after = np.array([each.std for each in rows])
    goal = np.array([*labels.wanted[wanted], *[np.inf] * len(combined)])
    first = Accuracies(before, INITIAL, INITIAL, size=10.0, hollow=True)
    panel = accuracy_panel(names, sizes, [first, Accuracies(after, DESIGNED, DESIGNED)], goal)
    changes = [improvement(*pair) for pair in zip(before.tolist(), after.tolist(), strict=True)]

    title, shares = "Predicted accuracy of one experiment", after / sizes
    if np.isfinite(shares).any():
        worst = int(np.nanargmax(finite_or_nan(shares)))
        title += f": σ is at most {relative(after[worst], sizes[worst])} ({names[worst]})"
    note = sigma_remark(design.inflation, design.parameters)
    if not np.array_equal(np.abs(design.theta), design.sizes):
        note += " Percent of an entry of a vector or tensor are a share of the whole."
    return Picture(
        title=title,
        panels=[replace(panel, beside=[*panel.beside, ("change", "text", changes)])],
        note=note,
        heights=[height_of_rows(len(names))],
    )


def accuracy_over_time(design: Design, labels: Labels) -> Picture:
    """Show the standard deviation of each parameter, by the measurements up to each time."""
    asked = [j for j in design.wanted if np.isfinite(design.stated_std[j] / design.shares[j])]
    seconds = design.seconds_to(design.targets)
    asked.sort(key=lambda j: (-seconds[j], -design.stated_std[j] / design.sizes[j]))
    shown = sorted(asked[: len(SERIES)])
    return Picture(
        title=when_learnt(design, shorten).removesuffix(".") or "Accuracy over time",
        panels=[
            accuracy_over_time_panel(
                [
                    (design.initial.trajectory.t, design.initial.std_over_time),
                    (design.trajectory.t, design.std_over_time),
                ],
                labels.parameters,
                design.sizes,
                design.targets,
                design.trajectory.t[0] + seconds,
                shown,
                is_stated=bool(np.isfinite(labels.wanted).any()),
            )
        ],
        note="Beside the names: σ at the end. "
        + sigma_remark(design.inflation, design.parameters)
        + share_note(shown, asked, "parameters, those that are known last"),
        heights=[3.4],
        keys=[line([], [], "muted", label="initial motion", **INITIAL_LOOK)],
    )


# ---- limits


def limits(design: Design, labels: Labels) -> Picture:
    """Show the used share of each limit; a joint has the same colour in all panels."""
    panels = limit_panels(design, labels)
    columns = 2 if len(panels) > MAX_WIDE_PANELS else 1
    heights = [
        2.0 if panel.y.names is None else 0.7 + 0.27 * len(panel.y.names) for panel in panels
    ]

    note = (
        "All engine steps of the stated model. ±100 %: at the upper and at the lower bound; grey: "
        "beyond a bound."
    )
    if any(usage.kind == "clearance" for usage in design.usage):
        note += " Of a clearance: required over actual distance."
    if any(panel.y.names for panel in panels):
        note += (
            " In rows: the largest share of each interval of time, whichever bound; the line at "
            "the top of a row is the bound."
        )
    elif any(map(would_be_solid, design.usage)):
        note += " Filled: smallest and largest value of a curve that changes too fast to be seen."
    ends = [
        f"{_words(kind)} {_kept(margin)}"
        for kind, margin in design.limits.items()
        if kind.startswith("end_")
    ]
    if ends:
        note += f" At the end: {', '.join(ends)}."
    return grid("How much of each limit the design uses", panels, heights, columns, note)


def limit_panels(design: Design, labels: Labels, *, rows: bool = True) -> list[Panel]:
    """Return a panel for each kind of limit; a joint has the same role in all of them.

    Args:
        design: The design.
        labels: Labels with the units.
        rows: Whether many curves that change fast have a row each.
    """
    # A fit draws pictures as well, and needs nothing of the excitation.
    from mjfim.excitation.limits.constraints import SUBSTEP_KINDS

    by_kind = {
        kind: curves
        for kind in (*SUBSTEP_KINDS, "control", "control_rate", "clearance")
        if (curves := [usage for usage in design.usage if usage.kind == kind])
    }
    # Names of joints, actuators and pairs of geoms, the closest to a bound first.
    largest: dict[str, float] = {}
    for each in design.usage:
        largest[each.name] = max(largest.get(each.name, 0.0), largest_share(each))
    closest = sorted(largest, key=lambda name: -largest[name])[: len(SERIES)]
    names = [name for name in dict.fromkeys(u.name for u in design.usage) if name in closest]
    roles = {name: f"series{i}" for i, name in enumerate(names)}
    return [
        _limit_panel(curves, roles, _margin_in_words(design, kind, labels), rows=rows)
        for kind, curves in by_kind.items()
    ]


def _limit_panel(
    curves: Sequence[LimitUsage], roles: dict[str, str], margin: str, *, rows: bool
) -> Panel:
    """Return the panel of one kind of limit; the curves closest to a bound are strong."""
    closest = sorted(curves, key=lambda usage: -largest_share(usage))
    # Words with their numbers stay in one line.
    names = [usage.name for usage in curves]
    shares = [
        f"{shorten(usage.name, 18, names)} {whole_percent(largest_share(usage))}".replace(
            " ", "\u00a0"
        )
        for usage in closest[:NAMED_CURVES]
    ]
    solid = [usage for usage in curves if would_be_solid(usage)]
    in_rows = rows and len(solid) > MAX_ENVELOPES
    axis = Axis(label="share of the limit [%]")
    shown, draw = closest, _curve_marks
    if in_rows:
        shown, draw = [usage for usage in curves if usage in closest[:MAX_ROWS]], _row_marks
        axis = row_axis([usage.name for usage in shown])
    # Curves without a colour of their own have no entry in the legend.
    labels = {name: shorten(name, 24, roles) for name in roles}
    marks = [
        each
        for place, usage in enumerate(shown)
        for each in draw(usage, place, roles.get(usage.name, "muted"), labels.get(usage.name, ""))
    ]
    if not in_rows:
        one_sided = curves[0].kind == "clearance"
        reach = max(112.0, 105.0 * largest_share(closest[0]))
        axis = Axis(label=axis.label, limits=(0.0 if one_sided else -reach, reach))
        for side in (1.0,) if one_sided else (1.0, -1.0):
            marks += [hspan(100.0 * side, reach * side), hline(100.0 * side, width=0.8)]
    return Panel(
        marks=marks,
        x=Axis(label="time [s]"),
        y=axis,
        title=margin,
        role=DESIGNED if largest_share(closest[0]) > 1.0 else "text",
        remark=f"largest: {', '.join(shares)}",
    )


def _curve_marks(usage: LimitUsage, place: int, role: str, label: str) -> list[Mark]:
    """Return the curve of one limit, or the envelope of one that changes too fast to be seen."""
    strong, front = place < NAMED_CURVES, 3.0 - 0.01 * place
    if not would_be_solid(usage):
        look = {"width": 1.4 if strong else 0.7, "front": front, "label": label}
        return [line(usage.t, 100.0 * usage.share, role, **look)]
    t, low, high = envelope(usage)
    return [
        area(t, low, high, role, opacity=0.25 if strong else 0.08, front=front),
        line(t, low, role, width=0.9 if strong else 0.4, front=front, label=label),
        line(t, high, role, width=0.9 if strong else 0.4, front=front),
    ]


def _row_marks(usage: LimitUsage, place: int, role: str, label: str) -> list[Mark]:
    """Return a row that is filled up to the largest share of each interval of time."""
    t, low, high = envelope(usage)
    base = place + 0.5 * FULL_ROW
    top = base - FULL_ROW * np.maximum(np.abs(low), np.abs(high)) / 100.0
    return [
        area(t, np.full(len(t), base), top, role, opacity=0.45),
        line(t, top, role, width=0.9, label=label),
        hline(base - FULL_ROW, width=0.6),
    ]


def _words(kind: str) -> str:
    return kind.replace("_", " ")


def _kept(margin: float, unit: str = "") -> str:
    """Say whether a limit holds, and by which margin."""
    size = f"{format_number(abs(margin), 2)} {unit}".rstrip()
    return f"VIOLATED by {size}" if margin < 0.0 else f"smallest margin {size}"


def _margin_in_words(design: Design, kind: str, labels: Labels) -> str:
    """Say whether a kind of limit holds, and by which margin in its unit, if that is known."""
    is_of_actuator = kind in ("control", "control_rate", "force")
    label_units = dict(map(split_unit, labels.controls if is_of_actuator else labels.positions))
    found = {
        label_units.get(usage.name, "")
        for usage in design.usage
        if usage.kind == kind and np.isfinite(usage.share).any()
    }
    base = found.pop() if len(found) == 1 else ""
    unit = LENGTH if kind in ("clearance", "tendon_length") else ""
    if base and base != "model unit":
        unit = {
            "position": base,
            "velocity": per_second(base),
            "acceleration": f"{base}/s²",
            "control": base,
            "control_rate": per_second(base),
            "force": FORCE_OF_CONTROL.get(base, ""),
            "joint_force": FORCE_OF_CONTROL.get(base, ""),
        }.get(kind, unit)
    return f"{_words(kind)}: {_kept(design.limits.get(kind, float('nan')), unit)}"


# Largest number of sensors in the picture; of more, those that change σ most are drawn.
MOST_ROWS = 24


def worth(result: Worth) -> Picture:
    """Show σ without and with each sensor beside the wanted one, and the price of each limit."""
    reach = {each.name: _reach(result, each) for each in result.sensors}
    order = sorted(result.sensors, key=lambda each: -reach[each.name])
    relevant = [each for each in order if reach[each.name] > SMALL_INCREASE] or order
    rows = sorted(relevant[:MOST_ROWS], key=lambda each: each.is_added)
    panels = [_sensors(result, rows)]
    heights = [1.1 + 0.3 * len(rows)]
    if result.prices:
        panels.append(_prices(result, max(len(rows), len(result.prices))))
        heights[0] = max(heights[0], 1.1 + 0.3 * len(result.prices))
    return Picture(
        title=headline(result).removesuffix("."),
        panels=panels,
        note=BEST_CASE + share_note(rows, order, "sensors, those that change σ most"),
        heights=heights,
        widths=[1.6, 1.0][: len(panels)],
    )


def _reach(result: Worth, sensor: SensorWorth) -> float:
    """Ratio of the largest and the smallest σ that a sensor makes a difference for."""
    least = result.ratio(sensor.improved)
    return 1.0 if np.isinf(least) else result.ratio(sensor.without) / least


def _sensors(result: Worth, rows: list[SensorWorth]) -> Panel:
    """Return the largest σ over its wanted value, with and without each sensor."""
    now = result.ratio(result.std)

    def ratios(stds: list[Array]) -> Array:
        """Largest ratio for each row; NaN where it is infinite."""
        found = np.array([result.ratio(std) for std in stds])
        return finite_or_nan(found)

    is_added = np.array([each.is_added for each in rows])
    without = ratios([each.without for each in rows])
    better = ratios([each.improved for each in rows])
    alone = ratios([each.alone for each in rows])
    places = np.arange(len(rows))
    low, high = around(np.concatenate([without, better, [1.0, now]]), factor=2.0)
    without_or_end = np.where(np.isnan(without), high, without)
    marks: list[Mark] = [
        vline(1.0, dash="--", label=result.goal),
        *([vline(now, "muted", label="now")] if np.isfinite(now) else []),
        *(
            line([better[k], without_or_end[k]], np.full(2, k), "band", width=5.0, front=1.0)
            for k in places
        ),
        dots(np.where(alone < high, alone, np.nan), places, "muted", hollow=True, label="alone"),
    ]
    kinds = [
        (~is_added, without, "series1", "without it"),
        (~is_added, better, "series0", "half its noise"),
        (is_added, better, "series2", "with it"),
    ]
    for mask, values, role, label in kinds:
        if mask.any():
            marks.append(dots(values[mask], places[mask], role, size=6.0, label=label))
    texts = [change(result, each.present if each.is_added else each.without) for each in rows]
    return Panel(
        title="Sensors",
        marks=marks,
        x=Axis(label=f"largest σ over {result.goal} [–]", limits=(low, high), log=True),
        y=row_axis([each.name for each in rows]),
        beside=[("without / with", "text", texts)],
    )


def _prices(result: Worth, rows: int) -> Panel:
    """Return the change of σ where each restriction is relaxed, in as many rows as beside it."""
    places = np.arange(len(result.costliest))
    shown = 100.0 * np.array([price.change for price in result.costliest])
    predicted = 100.0 * np.array([price.predicted for price in result.costliest])
    marks = [bars(np.nan_to_num(shown), places, "series0", left=0.0), vline(0.0, "muted")]
    if not np.array_equal(shown, predicted, equal_nan=True):
        look = {"symbol": "|", "size": 12.0, "width": 2.0, "label": "by the multiplier"}
        marks.append(dots(predicted, places, "text", **look))
    rest = [""] * (rows - len(places))
    return Panel(
        title="Prices of restrictions",
        marks=marks,
        x=Axis(label="change of σ [%]", most=4),
        y=row_axis([price_name(price) for price in result.costliest] + rest),
        beside=[("", "text", [percent(price.change) for price in result.costliest] + rest)],
        place=(0, 1),
    )
