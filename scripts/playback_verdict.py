"""What the robots of playback_robots.py say about a design: tables, sentences, numbers, a picture."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from playback_robots import Bench, Conditions, Run
from rich.markup import escape
from rich.table import Table
from scipy.stats import binom, chi2

from mjfim.arrays import Array
from mjfim.output.plots import style

CONFIDENCE, WANTED = (
    0.95,
    0.90,
)  # of the intervals;  share of the runs whose interval must hold the true value
HALF = 1.959964  # standard deviations of such an interval to either side


@dataclass(frozen=True, eq=False)
class Verdict:
    """What n runs say, of which g gave an estimate. names, units, wrong: (p,), how far the guess is off

    z: (g, p) errors in standard deviations;  error: (g, p);  std: (g, p) formal, NaN for what no run tells alone
    predicted: (p,) standard deviation before
    joint: runs whose joint region holds the truth: of the experiment's parameters, and of all unknowns
    margins: (n, l) over half of their ranges;  planned: (l,);  kept: (n, l)
    """

    bench: Bench
    names: tuple[str, ...]
    units: tuple[str, ...]
    wrong: Array
    z: Array
    error: Array
    std: Array
    predicted: Array
    joint: tuple[int, int]
    margins: Array
    planned: Array
    kept: np.ndarray
    fit: float
    misfits: int
    again: int
    troubles: dict[str, int]

    @property
    def runs(self) -> int:
        """n"""
        return len(self.margins)

    @property
    def told(self) -> np.ndarray:
        """(p,) True where the parameter is found by itself, not only in combination with others."""
        return np.asarray(np.isfinite(self.std).all(axis=0)) & (len(self.std) > 0)

    @property
    def inside(self) -> np.ndarray:
        """(p,) runs whose interval holds the true value."""
        return np.asarray((np.abs(self.z) <= HALF).sum(axis=0))

    @property
    def observed(self) -> Array:
        """(p,) root mean square of the errors."""
        return np.asarray(np.sqrt((self.error**2).mean(axis=0)))

    @property
    def formal(self) -> Array:
        """(p,) root mean square of the stated standard deviations."""
        return np.asarray(np.sqrt((self.std**2).mean(axis=0)))

    @property
    def all_kept(self) -> int:
        """Runs that keep every limit."""
        return int(self.kept.all(axis=1).sum())

    @property
    def eaten(self) -> Array:
        """(l,) shares of half of each range by which the worst robot comes closer than the plan."""
        return np.asarray(np.maximum(self.planned - self.margins.min(axis=0), 0.0))

    @property
    def covered(self) -> bool:
        """Every parameter's interval holds often enough."""
        return bool((self.inside[self.told] >= WANTED * self.runs - 1e-9).all()) and bool(
            self.told.any()
        )

    @property
    def ok(self) -> bool:
        """Intervals and limits hold."""
        return self.covered and self.all_kept == self.runs

    def reserve(self) -> dict[str, float]:
        """Share of half of each range that a design has to stay away from its limits, by kind."""
        needed: dict[str, float] = {}
        for limit, share in zip(self.bench.limits, self.eaten.tolist(), strict=True):
            if share > 1e-9:
                needed[limit.kind] = max(needed.get(limit.kind, 0.0), share)
        return {kind: float(np.ceil(100.0 * share) / 100.0) for kind, share in needed.items()}


def judge(bench: Bench, runs: Sequence[Run]) -> Verdict:
    """Put all runs side by side."""
    task, stated = bench.task, set(bench.stated.parameters.names)
    names, shape = task.parameters.names, (-1, len(task.parameters))
    good = [run for run in runs if np.isfinite(run.estimate).all()]
    error = np.array([run.estimate - run.theta for run in good]).reshape(shape)
    std = np.array([run.std for run in good]).reshape(shape)
    std = np.where(np.isfinite(std).all(axis=0), std, np.nan)
    told = np.isfinite(std).all(axis=0)
    regions = [np.flatnonzero(told & [name in stated for name in names]), np.flatnonzero(told)]
    joint = [sum(run.far(r) <= chi2.ppf(CONFIDENCE, len(r)) for run in good) for r in regions]
    margins = np.array([run.margins for run in runs])
    clamped = np.array(
        [limit.kind in ("force", "joint_force") for limit in bench.limits], dtype=bool
    )
    return Verdict(
        bench=bench,
        names=names,
        units=task.system.units,
        wrong=np.sqrt(np.mean([(run.theta - task.parameters.guess) ** 2 for run in runs], axis=0)),
        z=error / std,
        error=error,
        std=std,
        predicted=bench.predicted(),
        joint=(int(joint[0]), int(joint[1])),
        margins=margins,
        planned=bench.planned(),
        kept=np.where(clamped, margins > 0.0, margins >= 0.0),
        fit=float(np.mean([run.fit for run in good])) if good else np.nan,
        misfits=sum(run.misfit for run in runs),
        again=sum(run.again for run in runs),
        troubles=dict(Counter(run.trouble for run in runs if run.trouble)),
    )


def parameter_table(verdict: Verdict) -> Table:
    """One row per unknown: how wrong, how well predicted, how well found."""
    n = verdict.runs
    table = Table(
        title=f"Does information arrive? {n} robots, each identified from the guess",
        title_justify="left",
    )
    for heading in (
        "unknown",
        "wrong by",
        "sigma predicted",
        "sigma stated",
        "error, rms",
        f"inside 95 % of {n}",
    ):
        table.add_column(heading, justify="left" if heading == "unknown" else "right")
    rows = zip(verdict.wrong, verdict.predicted, verdict.formal, verdict.observed, strict=True)
    for name, unit, inside, numbers in zip(
        verdict.names, verdict.units, verdict.inside, rows, strict=True
    ):
        colour = "green" if inside >= WANTED * n else "red"
        cells = ("-" if not np.isfinite(value) else f"{value:.3g}" for value in numbers)
        counted = f"[{colour}]{inside}" if np.isfinite(numbers[2]) else "in combination only"
        table.add_row(escape(f"{name} [{unit}]" if unit else name), *cells, counted)
    return table


def limit_table(verdict: Verdict) -> Table:
    """The tightest limit of every kind."""
    title = "Do limits hold? Margins in percent of half of each range; negative: outside"
    table = Table(title=title, title_justify="left")
    for heading in (
        "limit",
        "tightest of",
        "planned",
        "worst robot",
        "taken at most",
        "robots that keep it",
    ):
        table.add_column(
            heading, justify="left" if heading in ("limit", "tightest of") else "right"
        )
    worst, limits = verdict.margins.min(axis=0), verdict.bench.limits
    for kind in dict.fromkeys(limit.kind for limit in limits):
        rows = [i for i, limit in enumerate(limits) if limit.kind == kind]
        i = min(rows, key=lambda i: float(worst[i]))
        kept = int(verdict.kept[:, rows].all(axis=1).sum())
        shares = (verdict.planned[i], worst[i], verdict.eaten[rows].max())
        colour = "green" if kept == verdict.runs else "red"
        cells = [f"{100 * share:.1f} %" for share in shares]
        table.add_row(kind, escape(limits[i].name), *cells, f"[{colour}]{kept} of {verdict.runs}")
    return table


def conclusions(verdict: Verdict) -> Iterator[str]:
    """What it comes to, in sentences."""
    n, (own, every) = verdict.runs, verdict.joint
    low, high = (int(k) for k in binom.interval(0.99, n, CONFIDENCE))
    inside = verdict.inside[verdict.told]
    yield (
        f"95 % intervals hold the true value in {inside.min(initial=n)} to {inside.max(initial=0)} of {n} runs (chance alone: "
        f"{low} to {high}); joint region of the experiment's parameters in {own}, of all unknowns in {every}; chi2 / dof "
        f"{verdict.fit:.3f}, {verdict.misfits} misfits, {verdict.again} searches begun again"
    )
    for sentence, count in verdict.troubles.items():
        yield f"{count} of {n} runs: {sentence}"
    worst, missed = verdict.margins.min(axis=0), ~verdict.kept.all(axis=0)
    yield f"all limits hold at every engine step on {verdict.all_kept} of {n} robots"
    for i in np.flatnonzero(missed).tolist():
        limit = verdict.bench.limits[i]
        over = -worst[i] * limit.scale
        yield f"{limit.kind} of {limit.name} is {f'exceeded by up to {over:.3g}' if over > 0.0 else 'clamped'}"
    reserve = verdict.reserve()
    if reserve:
        asked = " ".join(f"{kind}={share:g}" for kind, share in reserve.items())
        yield (
            f"what a plan has to stay away from its limits so that such robots keep them, in half ranges: {asked} "
            f"(a design that does: --reserve {asked})"
        )


def summary(verdict: Verdict, conditions: Conditions) -> dict[str, Any]:
    """Contents of playback.json."""
    worst = verdict.margins.min(axis=0)
    return {
        "ok": verdict.ok,
        "conditions": asdict(conditions),
        "runs": verdict.runs,
        "parameters": [
            {
                "name": name,
                "unit": unit,
                "wrong": verdict.wrong[j],
                "predicted": verdict.predicted[j],
                "stated": verdict.formal[j],
                "error": verdict.observed[j],
                "inside": int(verdict.inside[j]),
            }
            for j, (name, unit) in enumerate(zip(verdict.names, verdict.units, strict=True))
        ],
        "joint": {"parameters": verdict.joint[0], "all": verdict.joint[1]},
        "fit": verdict.fit,
        "misfits": verdict.misfits,
        "begun_again": verdict.again,
        "troubles": verdict.troubles,
        "all_limits_kept": verdict.all_kept,
        "limits": [
            {
                "kind": limit.kind,
                "name": limit.name,
                "range": [limit.lower, limit.upper],
                "planned": verdict.planned[i] * limit.scale,
                "worst": worst[i] * limit.scale,
                "kept": int(verdict.kept[:, i].sum()),
            }
            for i, limit in enumerate(verdict.bench.limits)
        ],
        "reserve": verdict.reserve(),
    }


def picture(verdict: Verdict, path: Path, conditions: Conditions) -> None:
    """Margins of every limit on every robot; errors in standard deviations; coverage; before and after."""
    figure = style.new_figure(13.0, max(7.0, 0.8 + 0.27 * len(verdict.bench.limits)))
    grid = figure.add_gridspec(1, 2, width_ratios=(1.0, 1.25))
    left, right = figure.add_subfigure(grid[0]), figure.add_subfigure(grid[1])
    draw_limits(left.subplots(), verdict)
    axes = right.subplots(3, 1, sharex=True, height_ratios=(1.5, 0.8, 1.0))
    draw_errors(axes[0], verdict)
    draw_coverage(axes[1], verdict)
    draw_arrival(axes[2], verdict)
    how = "open loop" if not conditions.feedback else "with the gains K(t)"
    title = (
        f"{verdict.runs} robots, every parameter {100 * conditions.wrong:g} % off, commands "
        f"{1e3 * conditions.latency:g} ms late, {how}"
    )
    figure.suptitle(title, x=0.01, ha="left", fontsize=style.LARGE_FONT, color=style.TEXT_COLOUR)
    style.save(figure, path)


def draw_limits(axes: Axes, verdict: Verdict) -> None:
    """A row per limit: the plan and all robots."""
    style.format_axes(axes, "margin over half of the range [%]")
    rng, limits = np.random.default_rng(0), verdict.bench.limits
    place = np.arange(len(limits))[::-1]
    shown = 100.0 * np.maximum(verdict.margins, -1.0)
    low = min(-5.0, float(shown.min(initial=0.0)) - 5.0)
    axes.axvspan(low, 0.0, color=style.OPTIMIZED_COLOUR, alpha=0.10, linewidth=0.0)
    for i, y in enumerate(place):
        colour = style.INITIAL_COLOUR if verdict.kept[:, i].all() else style.OPTIMIZED_COLOUR
        spread = y + rng.uniform(-0.22, 0.22, verdict.runs)
        axes.plot(
            shown[:, i], spread, ".", color=colour, markersize=4.5, alpha=0.4, markeredgewidth=0.0
        )
        axes.plot(
            [100.0 * verdict.planned[i]] * 2,
            [y - 0.32, y + 0.32],
            color=style.TEXT_COLOUR,
            linewidth=1.6,
        )
    axes.set_yticks(
        place,
        [style.shorten(f"{limit.kind.replace('_', ' ')} {limit.name}", 26) for limit in limits],
    )
    axes.set_xlim(low, max(100.0, 100.0 * float(verdict.planned.max(initial=0.0)) + 5.0))
    axes.set_ylim(-0.7, len(limits) - 0.3)
    title = f"Limits at every engine step: {verdict.all_kept} of {verdict.runs} robots keep all"
    axes.set_title(title, fontsize=style.NORMAL_FONT, loc="left", color=style.TEXT_COLOUR)
    handles = [
        Line2D([], [], color=style.TEXT_COLOUR, linewidth=1.6, label="plan"),
        Line2D([], [], color=style.INITIAL_COLOUR, marker=".", linestyle="", label="robots"),
        Line2D(
            [],
            [],
            color=style.OPTIMIZED_COLOUR,
            marker=".",
            linestyle="",
            label="robots, limit exceeded by some",
        ),
    ]
    axes.legend(
        handles=handles,
        fontsize=style.SMALL_FONT,
        frameon=False,
        loc="upper left",
        bbox_to_anchor=(0.0, -0.06),
        ncols=3,
    )


def draw_errors(axes: Axes, verdict: Verdict) -> None:
    """Estimates against the truth, in standard deviations."""
    style.format_axes(axes, "", "(estimate − truth) / σ")
    rng = np.random.default_rng(0)
    axes.axhspan(-HALF, HALF, color=style.MEASURED_COLOUR, alpha=0.12, linewidth=0.0)
    axes.axhline(0.0, color=style.MUTED_COLOUR, linewidth=0.8)
    for j in range(len(verdict.names)):
        z = np.clip(verdict.z[:, j], -5.0, 5.0)
        hit = np.abs(z) <= HALF
        x = j + rng.uniform(-0.28, 0.28, len(z))
        for some, colour in ((hit, style.MEASURED_COLOUR), (~hit, style.OPTIMIZED_COLOUR)):
            axes.plot(
                x[some], z[some], ".", color=colour, markersize=4.0, alpha=0.7, markeredgewidth=0.0
            )
    axes.set_ylim(-5.2, 5.2)
    axes.set_title(
        "Errors of the estimates; shaded: 95 %",
        fontsize=style.NORMAL_FONT,
        loc="left",
        color=style.TEXT_COLOUR,
    )


def draw_coverage(axes: Axes, verdict: Verdict) -> None:
    """How often the interval holds the true value."""
    n, x = verdict.runs, np.arange(len(verdict.names))
    share = 100.0 * verdict.inside / n
    style.format_axes(axes, "", "inside 95 % [%]")
    low, high = (100.0 * k / n for k in binom.interval(CONFIDENCE, n, CONFIDENCE))
    axes.axhspan(low, high, color=style.MEASURED_COLOUR, alpha=0.12, linewidth=0.0)
    axes.axhline(100.0 * WANTED, color=style.OPTIMIZED_COLOUR, linewidth=1.0, linestyle="--")
    axes.plot(x, share, "o", color=style.TEXT_COLOUR, markersize=5.0)
    for i, value in enumerate(share):
        axes.annotate(
            f"{value:.0f}",
            (i, value),
            (6, 3),
            textcoords="offset points",
            fontsize=style.SMALL_FONT,
            color=style.TEXT_COLOUR,
        )
    axes.set_ylim(min(85.0, float(share.min(initial=100.0)) - 3.0), 103.0)
    title = "Coverage; dashed: wanted, shaded: what chance makes of 95 %"
    axes.set_title(title, fontsize=style.NORMAL_FONT, loc="left", color=style.TEXT_COLOUR)


def draw_arrival(axes: Axes, verdict: Verdict) -> None:
    """How wrong before, how wrong predicted, how wrong after."""
    x = np.arange(len(verdict.names))
    style.format_axes(axes, "", "error, guess = 100 [%]")
    before = np.where(verdict.wrong > 0.0, verdict.wrong, np.nan)
    for y, marker, colour, label in (
        (np.full(len(x), 100.0), "o", style.MUTED_COLOUR, "guess"),
        (100.0 * verdict.predicted / before, "_", style.TEXT_COLOUR, "σ predicted before any run"),
        (
            100.0 * verdict.observed / before,
            ".",
            style.OPTIMIZED_COLOUR,
            "root mean square error of all robots",
        ),
    ):
        size = {"o": 4.0, "_": 20.0, ".": 9.0}[marker]
        axes.plot(
            x,
            y,
            marker,
            color=colour,
            markersize=size,
            markeredgewidth=1.8 if marker == "_" else 0.0,
            label=label,
        )
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    low = float(np.nanmin([verdict.predicted / before, verdict.observed / before], initial=1.0))
    axes.set_ylim(60.0 * low, 400.0)
    axes.set_xticks(x, [style.shorten(name, 24) for name in verdict.names], rotation=30, ha="right")
    axes.legend(
        fontsize=style.SMALL_FONT,
        frameon=False,
        loc="lower left",
        bbox_to_anchor=(0.0, 0.98),
        ncols=3,
        borderpad=0.0,
    )
