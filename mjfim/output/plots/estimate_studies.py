"""Pictures of studies of an estimate: terms, segments, recordings, and scatter of pairs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from mjfim.arrays import NORMAL_95, Array
from mjfim.output.page import DESIGNED, IDENTIFIED, MEASURED, NOMINAL
from mjfim.output.panels import (
    Axis,
    Mark,
    Panel,
    Picture,
    area,
    blank_rows,
    dots,
    grid,
    hline,
    hspan,
    intervals,
    line,
    mark,
    range_of_intervals,
    row_axis,
    vline,
    vspan,
)
from mjfim.output.words import format_number, share_note, shorten
from mjfim.records.estimate import Estimate, HorizonStudy
from mjfim.records.robots import RecordingComparison
from mjfim.records.terms import Decision, SelectionStep
from mjfim.records.trajectory import Labels, with_unit

# Largest numbers of parameters of pictures of pairs and of lengths, of parameters and of recordings
# that are compared; of more, those that say most are drawn.
MAX_PAIRED, MAX_COMPARED, MAX_RECORDINGS = 6, 9, 24

# Errors of rejected terms above this multiple of the largest kept one are arrows at the right end,
# and largest number of rejected terms that have a row each.
LARGEST_DRAWN_RATIO, MAX_NAMED = 1.5, 20

# Dashes and symbols of the curves of the lengths that were not chosen.
DASHES, SYMBOLS = (":", "--", "-."), ("s", "^", "D", "v")

# Half the range of an axis of pairs, places of its ticks, and standard deviations of the ellipses
# with their opacities [standard deviations].
RANGE, TICK, ELLIPSES = 3.2, 2.0, ((2.0, 0.18), (1.0, 0.35))

# Number of points of a curve, largest number of robots that are dots, and bars of a histogram.
CURVE_POINTS, MAX_DOTS, MOST_BARS = 90, 1000, 30


# ---- selection of terms


def selection(estimate: Estimate) -> Picture:
    """Show the error of left-out data with each term that was tried."""
    found = estimate.selection
    assert found is not None
    # A term with which the fit is no better has no error to draw.
    steps = [step for step in found.steps if step.decision is not Decision.UNHELPFUL]
    kept = [step for step in steps if step.is_kept]
    rows = list(range(len(steps)))
    shown: list[SelectionStep | None] = [*steps]
    if len(steps) - len(kept) > MAX_NAMED:
        # Rejected terms share the row of the next kept step; those at the end have an own one.
        rows = np.cumsum([0, *(step.is_kept for step in steps)])[:-1].tolist()
        shown = [*kept, *([] if steps[-1].is_kept else [None])]
    row_of = {id(step): row for step, row in zip(steps, rows, strict=True)}

    # The line joins the models with which the selection continued.
    marks = [
        line(
            [step.error for step in phase],
            [row_of[id(step)] for step in phase],
            IDENTIFIED,
            symbol="o",
            size=6.0,
            label="model of this step",
        )
        for phase in found.phases
    ]
    right = LARGEST_DRAWN_RATIO * max(step.error for step in kept)
    tried = [(step.error, row_of[id(step)]) for step in steps if not step.is_kept]
    for symbol, places in (
        ("x", [each for each in tried if each[0] <= right]),
        (">", [(right, row) for error, row in tried if error > right]),
    ):
        if places:
            x, y = np.array(places, dtype=np.float64).T
            label = "term that was tried"
            marks.append(dots(x, y, "muted", symbol=symbol, size=6.0, label=label))

    note = (
        "Each part of the data is predicted by a fit to the other parts; with the right model and "
        "noise, the error is about 1 σ. A term is added if it lowers the mean loss of left-out "
        f"data by more than one standard error. {found.ending}"
    )
    if len(found.phases) > 1:
        note += " Errors over segments are not comparable with those over whole recordings above."
    before, after = found.errors
    if np.isnan(before):
        title = "No term was tried"
    elif not found.terms:
        title = f"No term was added: error of left-out data {format_number(before)} σ"
    else:
        noun = "term" if len(found.terms) == 1 else "terms"
        change = f"{format_number(before)} σ → {format_number(after)} σ"
        title = f"{len(found.terms)} {noun} added: error of left-out data {change}"
    roles = ["text" if step is not None and step.is_kept else "muted" for step in shown]
    axis = Axis(label="error of left-out data [σ of the noise]", hidden=bool(np.isnan(right)))
    panel = Panel(marks=marks, x=axis, y=row_axis([_step_name(step) for step in shown], roles))
    return Picture(title=title, panels=[panel], note=note, heights=[0.9 + 0.3 * len(shown)])


def _step_name(step: SelectionStep | None) -> str:
    if step is None:
        return "no further term"
    if step.decision is Decision.BEGUN:
        return "the stated model"
    signs = {Decision.REMOVED: "without ", Decision.ADDED: "+ "}
    return f"{signs.get(step.decision, '')}{step.description}"


# ---- lengths of segments


def horizons(estimate: Estimate) -> Picture:
    """Show the error of left-out data over the horizon, and the estimates over the length."""
    study = estimate.horizons
    assert study is not None
    with np.errstate(invalid="ignore", divide="ignore"):
        moves = np.ptp(study.theta, axis=0) / np.nanmax(study.half_widths, axis=0)
    dependent = np.asarray(study.is_apart, dtype=bool).any(axis=0)
    shown = np.sort(np.lexsort((-np.nan_to_num(moves), ~dependent))[:MAX_PAIRED]).tolist()

    lengths = study.lengths
    axis = Axis(log=True, limits=(lengths[0] / 1.6, lengths[-1] * 1.6))
    last = replace(
        axis, label="time over which is predicted, and length of the fitted segments [s]"
    )
    errors = Panel(
        marks=[_curve_of_length(study, i) for i in range(len(lengths))],
        x=axis if shown else last,
        y=Axis(label="error of left-out data [σ]", log=True),
    )
    panels = [_estimates_by_length(study, j, last if j == shown[-1] else axis) for j in shown]
    chosen = study.name_of(study.chosen)
    title = f"{chosen[0].upper()}{chosen[1:]} were chosen"
    if not study.is_used:
        title += ", but not used"
    if study.dependent:
        verb = "depends" if len(study.dependent) == 1 else "depend"
        title += f"; {', '.join(study.dependent[:MAX_PAIRED])} {verb} on the length"
    note = (
        "Each part of the data is predicted by fits to the other parts; with the right model and "
        "noise, the error is about 1 σ over any time. Bars are 95 % intervals by the scatter "
        "between the parts."
    )
    heights = [2.6, *[0.9] * len(panels)]
    heights[-1] += 0.3
    return grid(title, [errors, *panels], heights, 1, note)


def _curve_of_length(study: HorizonStudy, i: int) -> Mark:
    """Return the errors of the fit over segments of one length."""
    name, errors = study.name_of(i), study.errors[i]
    if i == study.chosen:
        look = {"width": 2.2, "symbol": "o", "size": 5.0, "front": 3.0}
        return line(study.lengths, errors, IDENTIFIED, label=f"{name}, chosen", **look)
    dash, symbol = DASHES[i % len(DASHES)], SYMBOLS[i % len(SYMBOLS)]
    look = {"width": 1.1, "dash": dash, "symbol": symbol, "size": 4.5}
    return line(study.lengths, errors, "muted", label=name, **look)


def _estimates_by_length(study: HorizonStudy, j: int, axis: Axis) -> Panel:
    """Return the estimates of one parameter with their intervals."""
    marks = [hline(study.theta[study.chosen, j], IDENTIFIED, width=0.6)]
    for i, length in enumerate(study.lengths.tolist()):
        role = IDENTIFIED if i == study.chosen else "muted"
        value, half = float(study.theta[i, j]), float(np.nan_to_num(study.half_widths[i, j]))
        marks += [
            line([length] * 2, [value - half, value + half], role, symbol="_", size=6.0),
            dots([length], [value], role),
        ]
    label = with_unit(shorten(study.parameters[j], 14, study.parameters), study.units[j])
    return Panel(marks=marks, x=axis, y=Axis(label=label, most=3))


# ---- comparison of recordings


def recordings(estimate: Estimate) -> Picture:
    """Show what each recording suggests for the parameters that differ most."""
    comparison = estimate.recording_comparison
    assert comparison is not None
    odd = [recording.index for recording in comparison.odd]
    others = [k for k in range(len(comparison.recordings)) if k not in odd]
    rows = sorted([*odd, *others][:MAX_RECORDINGS])
    shown = [int(j) for j in comparison.order[:MAX_COMPARED]]
    columns = min(3, len(shown))
    panels = [
        _recordings_panel(comparison, j, rows, odd, is_left=k % columns == 0)
        for k, j in enumerate(shown)
    ]
    count = len(comparison.recordings)
    title = f"{count} recordings that {comparison.finding}"
    if odd:
        names = ", ".join(shorten(each.name) for each in comparison.odd)
        title = f"{names} {'is' if len(odd) == 1 else 'are'} odd among {count} recordings"
    note = "Each value is one Gauss-Newton step away from the estimate of all recordings."
    if np.isfinite(comparison.prediction).any():
        note += " Another recording: 95 % interval of what it would suggest."
    if estimate.misfit:
        note += " The model does not explain the recordings, and its error can make them differ."
    note += share_note(shown, comparison.parameters, "parameters, those that differ most")
    note += share_note(rows, comparison.recordings, "recordings")
    height = 0.95 + 0.2 * (len(rows) + 1)
    return grid(title, panels, [height] * len(panels), columns, note)


def _recordings_panel(
    comparison: RecordingComparison, j: int, rows: list[int], odd: list[int], *, is_left: bool
) -> Panel:
    """Return the values of one parameter, a row for each recording and one for another one."""
    value, half = comparison.values[:, j], NORMAL_95 * comparison.std[:, j]
    mean = float(comparison.mean[j])
    marks = []
    if np.isfinite(mean):
        low, high = comparison.interval[j]
        label = "95 % interval of the mean"
        marks = [
            vspan(low, high, IDENTIFIED, opacity=0.2, label=label),
            vline(mean, IDENTIFIED, width=1.2, label="mean"),
        ]
    for row, k in enumerate(rows):
        role = DESIGNED if k in odd else MEASURED
        label = "odd recording" if k in odd else "one recording, 95 % interval"
        marks += [
            intervals(value[[k]] - half[[k]], value[[k]] + half[[k]], [row], role),
            dots(value[[k]], [row], role, size=4.5, label=label),
        ]
    names = [comparison.recordings[k] for k in rows]
    if np.isfinite(comparison.prediction[j]).all():
        begin, end = comparison.prediction[j]
        names.append("another one")
        marks.append(intervals([begin], [end], [len(rows)], "muted", width=3.0))
    limits = range_of_intervals(value, value - half, value + half)
    roles = [DESIGNED if k in odd else "text" for k in rows]
    shown = row_axis([shorten(name, 16, names) for name in names], roles)
    if not is_left:
        shown = blank_rows(len(names))
    label = with_unit(comparison.parameters[j], comparison.units[j])
    return Panel(marks=marks, x=Axis(label=label, limits=limits, most=3), y=shown)


# ---- scatter of pairs of parameters


def has_pairs(std: Array) -> bool:
    """Return whether at least two parameters have a standard deviation."""
    return bool(np.count_nonzero(np.isfinite(std) & (std > 0.0)) > 1)


class Spread(NamedTuple):
    """A normal distribution of the parameters, or a single value of each of them.

    Attributes:
        values: (p,) middle [theta-unit].
        covariance: (p, p) covariance; not finite where a parameter is not determined.
        role: Role of what is drawn.
        label: What it is, in a word.
        dash: Dashes of its lines.
        symbol: Symbol at the middle, for single values; empty for none.
    """

    values: Array
    covariance: Array
    role: str
    label: str
    dash: str = "-"
    symbol: str = ""


def pairs(
    names: Sequence[str],
    units: Sequence[str],
    spreads: Sequence[Spread],
    *,
    bounds: Array | None = None,
    title: str,
    note: str,
) -> Picture:
    """Show the joint uncertainty of every pair of parameters as ellipses.

    Args:
        names: Names of the p parameters.
        units: Their units.
        spreads: Distributions; the first one is filled, and its σ are the unit of all axes.
        bounds: (p, 2) bounds, which are grey where they are near; None for none.
        title: Title of the picture.
        note: What is behind the first distribution.
    """
    main = spreads[0]
    std = np.sqrt(np.maximum(np.diagonal(main.covariance), 0.0))
    unit = np.where(np.isfinite(std) & (std > 0.0), std, np.nan)
    scaled = [
        each._replace(
            values=(each.values - main.values) / unit,
            covariance=each.covariance / np.outer(unit, unit),
        )
        for each in spreads
    ]
    correlation = np.clip(scaled[0].covariance, -1.0, 1.0)
    limits = np.full((len(unit), 2), np.nan)
    if bounds is not None:
        limits = (bounds - main.values[:, None]) / unit[:, None]

    def density(j: int) -> list[Mark]:
        """Draw the normal densities of one parameter over their peaks."""
        x = np.linspace(-RANGE, RANGE, CURVE_POINTS)
        marks = [area(x, np.zeros(len(x)), np.exp(-0.5 * x**2), main.role)]
        for each in scaled:
            variance = each.covariance[j, j]
            if np.isfinite(variance) and variance > 0.0:
                # A narrow curve has points of its own.
                fine = np.concatenate([x, each.values[j] + np.sqrt(variance) * x])
                fine = np.unique(np.clip(fine, -RANGE, RANGE))
                y = np.exp(-0.5 * (fine - each.values[j]) ** 2 / variance)
                marks.append(line(fine, y, each.role, dash=each.dash))
        return [*marks, *_beyond(limits[j], vspan), *_near(scaled, j, None)]

    def ellipses(j: int, i: int) -> list[Mark]:
        """Draw the ellipses of parameter j across and i up."""
        r = correlation[i, j]
        # Lower and upper half of each ellipse, over its width.
        across = np.sin(np.linspace(-0.5, 0.5, CURVE_POINTS) * np.pi)
        half = np.sqrt((1.0 - r**2) * (1.0 - across**2))
        marks = [
            area(s * across, s * (r * across - half), s * (r * across + half), main.role, opacity=o)
            for s, o in ELLIPSES
        ]
        marks += [mark for each in scaled for mark in _edge(each, j, i)]
        strips = (*_beyond(limits[j], vspan), *_beyond(limits[i], hspan))
        return [*marks, *strips, *_near(scaled, j, i)]

    def axis(j: int) -> Axis:
        """Return the axis of a parameter in its standard deviations, with values at two ticks."""
        ticks = main.values[j] + std[j] * np.array([-TICK, TICK])
        texts = _distinct(ticks)
        return Axis(ticks=[-TICK, TICK], names=texts, limits=(-RANGE, RANGE))

    keys = [
        line([], [], main.role, width=7.0, opacity=opacity + 0.1, label=f"{main.label} {size:g} σ")
        for size, opacity in reversed(ELLIPSES)
    ]
    keys += [
        line([], [], each.role, dash=each.dash, label=f"{each.label} 2 σ")
        for each in spreads[1:]
        if not each.symbol
    ]
    shown = _most_correlated(correlation)
    return _corner(names, units, shown, density, ellipses, axis, title=title, note=note, keys=keys)


def _edge(spread: Spread, j: int, i: int) -> list[Mark]:
    """Return the ellipse of 2 σ of parameter j across and i up; none where it is not known."""
    chosen = [j, i]
    covariance = spread.covariance[np.ix_(chosen, chosen)]
    if not np.isfinite(covariance).all() or not np.diag(covariance).all():
        return []
    values, vectors = np.linalg.eigh(covariance)
    angle = np.linspace(0.0, 2.0 * np.pi, CURVE_POINTS)
    circle = np.stack([np.cos(angle), np.sin(angle)])
    x, y = 2.0 * vectors * np.sqrt(np.maximum(values, 0.0)) @ circle
    middle = spread.values[chosen]
    return [line(x + middle[0], y + middle[1], spread.role, width=0.9, dash=spread.dash)]


def _beyond(limits: Array, span: Callable[..., Mark]) -> list[Mark]:
    """Shade what lower and upper bound of a parameter exclude, where they are near."""
    look = {"opacity": 0.8, "label": "outside the bounds"}
    below, above = (limits[0] > -RANGE), (limits[1] < RANGE)
    ends = [(-RANGE, limits[0])] * bool(below) + [(limits[1], RANGE)] * bool(above)
    return [span(*pair, **look) for pair in ends]


def _near(spreads: Sequence[Spread], j: int, i: int | None) -> list[Mark]:
    """Mark the single values in the panel of parameter j across and i up, or of j alone."""
    marks = []
    for each in spreads:
        across, up = each.values[j], 0.05 if i is None else each.values[i]
        if each.symbol and np.abs([across, up]).max() <= RANGE:
            look = {"symbol": each.symbol, "label": each.label}
            marks.append(dots([across], [up], each.role, size=5.0, **look))
    return marks


def estimate_pairs(estimate: Estimate, labels: Labels) -> Picture:
    """Show the joint uncertainty of the estimates: honest, formal, predicted and prior."""
    theta, guess = estimate.theta, estimate.initial_theta
    spreads = [Spread(theta, estimate.covariance, IDENTIFIED, "formal", ":")]
    if len(estimate.honest_covariance):
        spreads.insert(0, Spread(theta, estimate.honest_covariance, IDENTIFIED, "honest"))
    if len(estimate.prediction):
        spreads.append(Spread(theta, estimate.prediction, DESIGNED, "predicted", "--"))
    known = np.diag(estimate.prior)
    if known.any():
        variances = np.divide(1.0, known, out=np.full(len(known), np.nan), where=known > 0.0)
        spreads.append(Spread(guess, np.diag(variances), "text", "prior", "--"))
    unknown = np.full(estimate.covariance.shape, np.nan)
    spreads += [
        Spread(guess, unknown, NOMINAL, NOMINAL, symbol="x"),
        Spread(labels.published, unknown, MEASURED, "published", symbol="D"),
    ]
    return pairs(
        estimate.parameters,
        estimate.units,
        spreads,
        bounds=labels.bounds,
        title="Joint uncertainty of the identified parameters",
        note=(
            "The honest one agrees with the 95 % intervals. The formal one is right only if the "
            "model and the noise are right."
        ),
    )


def samples(estimate: Estimate) -> Picture:
    """Show the parameters of all drawn robots: a histogram of each, and dots for every pair."""
    draws = estimate.draws
    assert draws is not None
    robots = draws.values[:MAX_DOTS]
    products = np.atleast_2d(np.corrcoef(draws.values.T))
    shown = _most_correlated(np.nan_to_num(products))
    low = np.minimum(draws.values.min(axis=0), draws.centre)
    high = np.maximum(draws.values.max(axis=0), draws.centre)
    margin = np.maximum(0.06 * (high - low), 1e-9 * np.abs(draws.centre) + 1e-300)
    low, high = low - margin, high + margin
    bins = int(np.clip(np.sqrt(len(draws)), 5, MOST_BARS))

    def histogram(j: int) -> list[Mark]:
        """Draw how often the values of one parameter were drawn."""
        counts, edges = np.histogram(draws.values[:, j], bins=bins, range=(low[j], high[j]))
        return [
            mark(
                "columns",
                edges,
                counts / counts.max(),
                MEASURED,
                opacity=0.6,
                label="drawn robots",
            ),
            vline(draws.centre[j], IDENTIFIED, width=1.4, label=IDENTIFIED),
        ]

    def scatter(j: int, i: int) -> list[Mark]:
        """Draw parameter j across and i up."""
        return [
            dots(robots[:, j], robots[:, i], MEASURED, symbol=".", size=2.5, opacity=0.6),
            dots(draws.centre[[j]], draws.centre[[i]], IDENTIFIED),
        ]

    def axis(j: int) -> Axis:
        """Return the axis of a parameter with two ticks."""
        ticks = low[j] + np.array([0.2, 0.8]) * (high[j] - low[j])
        return Axis(ticks=ticks.tolist(), names=_distinct(ticks), limits=(low[j], high[j]))

    note = (
        "Drawn from the normal distribution with the honest covariance of the estimate, which "
        "agrees with the 95 % intervals, inside the bounds."
    )
    if estimate.misfit:
        note += " It does not cover the error of a model that does not explain the recordings."
    if len(shown) > 1 and len(draws) > MAX_DOTS:
        note += f" The panels of pairs show {MAX_DOTS} robots."
    title = f"{len(draws)} drawn {'robot' if len(draws) == 1 else 'robots'}"
    return _corner(
        draws.parameters, draws.units, shown, histogram, scatter, axis, title=title, note=note
    )


def _corner(
    names: Sequence[str],
    units: Sequence[str],
    shown: list[int],
    single: Callable[[int], list[Mark]],
    pair: Callable[[int, int], list[Mark]],
    axis: Callable[[int], Axis],
    *,
    title: str,
    note: str,
    keys: Sequence[Mark] = (),
) -> Picture:
    """Show a panel for each parameter, and below the diagonal one for each pair."""
    which = "parameters, those with the largest correlations"
    panels = []
    for row, i in enumerate(shown):
        for column, j in enumerate(shown[: row + 1]):
            across, up = axis(j), axis(i) if i != j else Axis(ticks=[])
            is_lowest, is_left = row == len(shown) - 1, column == 0 and row > 0
            panels.append(
                Panel(
                    title=shorten(names[i], 18, names) if i == j else "",
                    marks=single(i) if i == j else pair(j, i),
                    x=_outer(across, shorten(names[j], 14, names), units[j], is_lowest),
                    y=_outer(up, shorten(names[i], 14, names), units[i], is_left),
                    place=(row, column),
                )
            )
    heights = [1.2 if len(shown) > 1 else 2.2] * len(shown)
    heights[-1] += 0.6
    return Picture(
        title=title,
        panels=panels,
        note=note + share_note(shown, names, which),
        heights=heights,
        widths=[1.0] * len(shown),
        keys=keys,
    )


def _outer(axis: Axis, name: str, unit: str, is_outer: bool) -> Axis:
    """Return an axis that has words only at the edge of the picture."""
    label = f"{name}\n[{unit}]" if unit else name
    return replace(axis, label=label) if is_outer else replace(axis, names=None, hidden=True)


def _most_correlated(correlation: Array) -> list[int]:
    """Return the parameters to draw: of many, those with the largest correlations."""
    known = np.flatnonzero(np.isfinite(np.diagonal(correlation)))
    others = np.abs(correlation - np.diag(np.diagonal(correlation)))
    largest = np.nan_to_num(others).max(axis=0)[known]
    return sorted(known[np.argsort(-largest, kind="stable")[:MAX_PAIRED]].tolist())


def _distinct(numbers: Array) -> list[str]:
    """Write two numbers with so many digits that they differ."""
    spread = float(np.ptp(numbers)) or 1.0
    largest = float(np.abs(numbers).max()) or 1.0
    digits = int(np.clip(np.ceil(np.log10(largest / spread)) + 2, 2, 9))
    return [format_number(number, digits) for number in numbers]
