"""The report of a Monte Carlo study."""

from __future__ import annotations

from html import escape

import numpy as np

from mjfim.arrays import Array
from mjfim.output.labels import complete_labels
from mjfim.output.report.correlations import correlation_of_covariance
from mjfim.output.report.curves import (
    axis,
    correlation_panel,
    curve,
    dots,
    error_bars,
    level,
    packed,
    row_axis,
    rows_height,
)
from mjfim.output.report.page import Key, Page, Panel, PlotGroup, Plotly, Section
from mjfim.output.summaries.monte_carlo import describe_study
from mjfim.output.summaries.verdicts import next_steps, verdict_of
from mjfim.output.vocabulary import TRAJECTORY_TERMS, shown_word
from mjfim.records.monte_carlo import MonteCarloStudy, TrialStatistics

# Standard deviations of the Cramér-Rao bound on each side of the true value that are drawn.
SHOWN_STDS = 4.5

# Number of bars of a histogram, and of points of the normal curve.
BINS, CURVE_POINTS = 45, 181

# Largest number of parameters with a histogram.
MAX_HISTOGRAMS = 24

# Name of the curve of the bound in the legend.
BOUND = "normal curve of the bound"


def study_page(study: MonteCarloStudy) -> Page:
    """Return the report of a Monte Carlo study.

    Args:
        study: The study.
    """
    labels = complete_labels(study)
    summary = describe_study(study, labels.parameter_units)
    details = [table for table in summary.tables if table.detail]
    shown = [part for part in summary.parts if part not in details]

    estimates = _histograms(study, [labels.parameter(j) for j in range(len(study.parameters))])
    sections = [
        Section(title="Efficiency", parts=[_efficiency_plot(study), *shown]),
        Section(title="Estimates", parts=[estimates]),
        Section(title="Covariance", parts=[*_correlation_plots(study), *details]),
    ]
    trials = {shown_word(name): str(trials.trials) for name, trials in study.sets.items()}
    facts = {f"trials, {name}": count for name, count in trials.items()}
    facts["rate of the measurements"] = f"{study.measure_rate:g} Hz"
    return Page(
        kind="Monte Carlo study of the estimates",
        verdict=verdict_of(study),
        next_steps=next_steps(study),
        facts=facts,
        sections=sections,
    )


def _role(trajectory: str) -> str:
    """Return the role of the colour of a trajectory."""
    term = TRAJECTORY_TERMS.get(trajectory)
    return "other" if term is None else term.word


def _keys(study: MonteCarloStudy, shape: str) -> list[Key]:
    """Return the entries of the legend of all trajectories."""
    return [Key(name=shown_word(name), role=_role(name), shape=shape) for name in study.sets]


def _efficiency_plot(study: MonteCarloStudy) -> PlotGroup:
    """Return the efficiencies with their intervals, one row for each parameter."""
    count, sets = len(study.parameters), len(study.sets)
    traces = []
    for k, (name, trials) in enumerate(study.sets.items()):
        # The trajectories of a parameter stand below each other.
        rows = np.arange(float(count)) + 0.3 * (k - 0.5 * (sets - 1))
        low, high = trials.efficiency_interval.T
        texts = [
            f"{parameter}: {trials.efficiency[j]:.3f} ({low[j]:.3f} to {high[j]:.3f})"
            for j, parameter in enumerate(study.parameters)
        ]
        trace = dots(trials.efficiency, rows, shown_word(name), _role(name), size=8, texts=texts)
        trace["error_x"] = error_bars(
            _role(name), high - trials.efficiency, trials.efficiency - low
        )
        traces.append(trace)
    panel = Panel(
        title="efficiency of every estimate, with 95 % interval [–]",
        traces=traces,
        layout={
            "xaxis": axis("Cramér-Rao bound / observed variance [–]"),
            "yaxis": row_axis(study.parameters),
            "shapes": [level(1.0, "text", across="y")],
            "hovermode": "closest",
        },
        height=rows_height(count, 44),
        wide=True,
    )
    note = "The dashed line is 1: the estimates scatter no more than the bound."
    return PlotGroup(title="", panels=[panel], keys=_keys(study, "dot"), note=note)


def _histograms(study: MonteCarloStudy, labels: list[str]) -> PlotGroup:
    """Return a histogram of the estimates of every parameter."""
    panels = [_histogram_panel(study, j, label) for j, label in enumerate(labels)]
    note = (
        "Estimates from simulated recordings. Heights are relative to the peak of the normal "
        "curve of each trajectory's bound, so that all curves reach 1; the dashed line is the "
        "true value."
    )
    if len(panels) > MAX_HISTOGRAMS:
        note += f" The first {MAX_HISTOGRAMS} of {len(panels)} parameters are drawn."
    keys = [*_keys(study, "bar"), Key(name=BOUND, role="text")]
    return PlotGroup(title="", panels=panels[:MAX_HISTOGRAMS], keys=keys, note=note)


def _histogram_panel(study: MonteCarloStudy, j: int, label: str) -> Panel:
    """Return the histograms of one parameter along all trajectories."""
    theta = float(study.theta[j])
    traces: list[Plotly] = []
    for name, trials in study.sets.items():
        std = float(np.sqrt(trials.crlb[j, j]))
        values = trials.estimates[:, j]
        values = values[np.isfinite(values)]
        if values.size and np.isfinite(std) and std > 0.0:
            traces += _histogram(values, theta, std, name)
    return Panel(
        title=label,
        traces=traces,
        layout={
            "xaxis": axis(label),
            "yaxis": axis("density / peak of the bound [–]"),
            "shapes": [level(theta, "muted", across="y")],
            "barmode": "overlay",
            "bargap": 0,
            "hovermode": "closest",
        },
        height=280,
        remark=_outside(study, j),
    )


def _histogram(values: Array, theta: float, std: float, name: str) -> list[Plotly]:
    """Return the bars of the estimates along one trajectory, and the curve of the bound."""
    edges = theta + std * np.linspace(-SHOWN_STDS, SHOWN_STDS, BINS + 1)
    counts, _ = np.histogram(values, bins=edges)
    width = float(edges[1] - edges[0])

    # The peak of the normal curve is 1.
    heights = counts / (len(values) * width) * std * np.sqrt(2.0 * np.pi)
    word, role = shown_word(name), _role(name)
    bars: Plotly = {
        "type": "bar",
        "x": packed(0.5 * (edges[1:] + edges[:-1])),
        "y": packed(heights),
        "width": width,
        "name": escape(word),
        "legendgroup": word,
        "marker": {"color": f"role:{role}", "line": {"width": 0}},
        "opacity": 0.6,
    }
    z = np.linspace(-SHOWN_STDS, SHOWN_STDS, CURVE_POINTS)
    normal = curve(theta + std * z, np.exp(-0.5 * z**2), BOUND, "text", width=1.2)
    normal["hoverinfo"] = "skip"
    return [bars, normal]


def _outside(study: MonteCarloStudy, j: int) -> str:
    """Say how many estimates of parameter j lie outside the drawn range; empty for none."""
    theta = float(study.theta[j])

    def count(trials: TrialStatistics) -> int:
        """Number of estimates beyond the range along one trajectory."""
        distance = np.abs(trials.estimates[:, j] - theta)
        return int(np.sum(distance > SHOWN_STDS * np.sqrt(trials.crlb[j, j])))

    outside = sum(count(trials) for trials in study.sets.values())
    return f"{outside} outside ± {SHOWN_STDS:g} σ" if outside else ""


def _correlation_plots(study: MonteCarloStudy) -> list[PlotGroup]:
    """Return heat maps of the observed correlations along every trajectory."""
    if len(study.parameters) < 2:
        return []
    panels = [
        correlation_panel(
            correlation_of_covariance(trials.covariance),
            study.parameters,
            f"observed correlation, {shown_word(name)} [–]",
        )
        for name, trials in study.sets.items()
        if np.isfinite(trials.covariance).any()
    ]
    return [PlotGroup(title="", panels=panels)] if panels else []
