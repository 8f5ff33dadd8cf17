"""The figures of every kind of result, by the names of their files without the ending."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial, singledispatch

import numpy as np
from matplotlib.figure import Figure

from mjfim.errors import MjfimError, unknown
from mjfim.output import plots
from mjfim.output.campaign_parameters import CampaignParameters
from mjfim.output.labels import complete_labels
from mjfim.output.plots.names import fit_names, held_out_names, histogram_name
from mjfim.output.plots.pairs import has_pairs
from mjfim.records.base import ShownRecord
from mjfim.records.campaign import Campaign
from mjfim.records.check import Check
from mjfim.records.comparison import Comparison
from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.inverse_dynamics import InverseDynamicsFit
from mjfim.records.monte_carlo import MonteCarloStudy
from mjfim.records.robots import RobotComparison
from mjfim.records.robustness import Robustness

# A function that draws a figure.
DrawPicture = Callable[[], Figure]

# Functions that draw the figures of a record, by the name of the figure.
Pictures = dict[str, DrawPicture]


def picture_names(record: ShownRecord) -> tuple[str, ...]:
    """Return the names of the figures of a record, the usual one first.

    Args:
        record: The record.
    """
    return tuple(pictures_of(record))


def draw(
    record: ShownRecord, picture: str | None = None, file: str | os.PathLike[str] = ""
) -> Figure:
    """Draw a figure of a record.

    Args:
        record: The record.
        picture: Name of the figure; default: the first one.
        file: File to which the figure is written; empty: none.

    Raises:
        MjfimError: The record has no such figure, or the ending of the file is not that of a
            picture.
    """
    pictures = pictures_of(record)
    if not pictures:
        raise MjfimError(f"this {type(record).__name__} has no results yet that can be drawn")

    name = next(iter(pictures)) if picture is None else picture
    if name not in pictures:
        raise MjfimError(unknown(f"picture of a {type(record).__name__}", name, pictures))
    figure = pictures[name]()
    if os.fspath(file):
        plots.save(figure, file)
    return figure


@singledispatch
def pictures_of(record: ShownRecord) -> Pictures:
    """Return the figures of a record, the usual one first.

    Args:
        record: The record.

    Raises:
        MjfimError: This kind of record has no figures.
    """
    raise MjfimError(f"a {type(record).__name__} has no figures")


@pictures_of.register
def _(design: Design) -> Pictures:
    """The figures of a design."""
    labels = complete_labels(design)
    pictures: Pictures = {
        "trajectories": partial(plots.trajectories, design, labels),
        "sensitivity_phase": partial(plots.sensitivity_phase, design, labels),
        "convergence": partial(plots.convergence, design),
        "standard_deviations": partial(plots.std_bars, design, labels),
    }
    if design.usage:
        pictures["limits"] = partial(plots.limits, design, labels)
    return pictures


@pictures_of.register
def _(estimate: Estimate) -> Pictures:
    """The figures of an estimate."""
    labels = complete_labels(estimate)
    pictures: Pictures = {
        "parameters": partial(plots.parameter_intervals, estimate, labels),
        "spectra": partial(plots.residual_spectra, estimate, labels),
    }
    pictures |= _studies(estimate)
    if len(estimate.trace) > 1:
        pictures["trace"] = partial(plots.parameter_trace, estimate, labels)
    if has_pairs(estimate.std):
        pictures["pairs"] = partial(plots.estimate_pairs, estimate, labels)
    if estimate.predictions:
        pictures["predictions"] = partial(plots.predictions, estimate, labels)

    sigma = list(estimate.sigma.values())
    for i, name in enumerate(fit_names(len(estimate.recordings))):
        pictures[name] = partial(plots.fit, estimate, i, labels, sigma)
    kept = sum(prediction.recording is not None for prediction in estimate.predictions)
    for i, name in enumerate(held_out_names(kept)):
        pictures[name] = partial(plots.held_out, estimate, i, labels)
    return pictures


def _studies(estimate: Estimate) -> Pictures:
    """The figures of studies that only some estimates have."""
    pictures: Pictures = {}
    if estimate.selection is not None:
        pictures["selection"] = partial(plots.selection_figure, estimate)
    if estimate.horizons is not None:
        pictures["horizons"] = partial(plots.horizons_figure, estimate)
    if estimate.inverse_dynamics is not None:
        pictures["inverse_dynamics"] = partial(
            plots.inverse_dynamics_figure, estimate.inverse_dynamics
        )
    if estimate.recording_comparison is not None:
        pictures["recordings"] = partial(plots.recording_forest, estimate)
    if estimate.draws is not None:
        pictures["samples"] = partial(plots.drawn_robots, estimate)
    return pictures


@pictures_of.register
def _(result: InverseDynamicsFit) -> Pictures:
    """The figure of a fit to the equation of motion."""
    return {"inverse_dynamics": partial(plots.inverse_dynamics_figure, result)}


@pictures_of.register
def _(study: MonteCarloStudy) -> Pictures:
    """The figures of a Monte Carlo study."""
    labels = complete_labels(study)
    pictures: Pictures = {"overview": partial(plots.study_overview, study, labels)}
    for i, name in enumerate(study.parameters):
        pictures[histogram_name(name)] = partial(plots.histogram, study, i, labels)
    return pictures


@pictures_of.register
def _(check: Check) -> Pictures:
    """The figures of a check."""
    pictures: Pictures = {"check": partial(plots.check_figure, check)}
    if has_pairs(np.array([row.std for row in check.rows if not row.nuisance])):
        pictures["pairs"] = partial(plots.check_pairs, check)
    return pictures


@pictures_of.register
def _(comparison: Comparison) -> Pictures:
    """The figure of a comparison."""
    return {"compare": partial(plots.compare_figure, comparison)}


@pictures_of.register
def _(comparison: RobotComparison) -> Pictures:
    """The figure of a comparison of two robots; none without a parameter in common."""
    if not comparison.parameters:
        return {}
    return {"robots": partial(plots.robot_figure, comparison)}


@pictures_of.register
def _(result: Robustness) -> Pictures:
    """The figure of a robustness study."""
    return {"playback": partial(plots.robustness_figure, result)}


@pictures_of.register
def _(campaign: Campaign) -> Pictures:
    """The figure of a campaign; none before its first round."""
    if not campaign.rounds:
        return {}
    parameters = CampaignParameters.recorded(campaign)
    return {"campaign": partial(plots.campaign_figure, campaign, parameters)}
