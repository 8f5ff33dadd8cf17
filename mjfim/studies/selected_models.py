"""Models that a selection compares, and what follows from the selected one."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.held_out_losses import HeldOutLosses, Reduction
from mjfim.identification.honest_covariance import with_honest_covariance
from mjfim.identification.jackknife import student_quantile
from mjfim.identification.report import FitResult
from mjfim.identification.terms import TermTests
from mjfim.model.parameters import ParameterSet
from mjfim.records.estimate import Estimate
from mjfim.records.terms import (
    Decision,
    PooledParameter,
    Selection,
    SelectionStep,
    Term,
)
from mjfim.studies.simplification import simplified_experiment

# Probability that an interval holds the true value.
CONFIDENCE = 0.95

# Fewest parts of the data without which estimates scatter, and the warning where there are fewer.
MIN_PARTS = 2
NOT_WIDENED = (
    "no interval contains that the terms were chosen with the same data, because fewer than two "
    "parts of the recordings could be predicted from the others; give further recordings"
)


@dataclass(frozen=True, kw_only=True, eq=False)
class FittedModel:
    """A fitted model, with the losses of its predictions of left-out data.

    Attributes:
        result: The fit.
        losses: The losses.
        cost: Cost of the fit with the noise of the fit of the stated model.
        terms: The terms that were added to the stated model.
        pooled: Parameters in place of several stated ones.
        held: Names of stated parameters that keep their guess.
        tests: Tests of the terms that the model still lacks; None where they were not made.
    """

    result: FitResult
    losses: HeldOutLosses
    cost: float
    terms: tuple[Term, ...]
    pooled: tuple[PooledParameter, ...] = ()
    held: tuple[str, ...] = ()
    tests: TermTests | None = None

    @property
    def is_changed(self) -> bool:
        """Whether the model differs from the stated one."""
        return bool(self.terms or self.pooled or self.held)

    @property
    def penalised_cost(self) -> float:
        """Cost and the number of parameters of the terms, by which chance reduces it (AIC)."""
        return self.cost + sum(len(term.parameters) for term in self.terms)


def selected_term(candidate: Term, taken: Iterable[str]) -> Term:
    """The term with names of its parameters, and with rounded sizes, which people read.

    Args:
        candidate: The term that tests have found.
        taken: Names of the parameters that the model has already.
    """
    used = set(taken)
    numbers = []
    for number in candidate.numbers:
        name = _name_of(number.path, used)
        used.add(name)
        numbers.append(replace(number, name=name, scale=float(f"{number.scale:.2g}")))
    return replace(candidate, numbers=tuple(numbers))


def selected_experiment(experiment: Experiment, selection: Selection) -> Experiment:
    """The experiment of a selected model.

    Args:
        experiment: The experiment before the selection.
        selection: The selection, `estimate.selection`.

    Returns:
        The experiment with the added terms, with the pooled and held parameters, and with the
        length of the segments that was chosen for them, where it states none.

    Raises:
        ExperimentError: The selection is one of another experiment.
    """
    extended = experiment.replace(**selection.tables)
    if selection.segments is not None and experiment.fit.segments is None:
        extended = extended.replace(fit={"segments": selection.segments})
    return simplified_experiment(extended, selection.pooled, selection.held)


def poorly_known(model: FittedModel) -> tuple[str, ...]:
    """Names of the stated parameters that a fit determines poorly, and that can be held.

    Those with a value for each recording cannot.

    Args:
        model: The fitted model.
    """
    added = {name for term in model.terms for name in term.parameters}
    added |= {pool.name for pool in model.pooled}
    parameters = model.result.task.system.parameters
    own = {parameters.names[j] for j in np.flatnonzero(parameters.recording_specific)}
    excluded = added | own
    return tuple(name for name, _ in model.result.accuracy.poorly_known if name not in excluded)


def pooled_values(pooled: Sequence[PooledParameter], values: dict[str, float]) -> dict[str, float]:
    """Values of pooled parameters where a search begins: the mean of what their members suggest.

    Args:
        pooled: The pooled parameters.
        values: Values of other parameters by name [theta-unit].

    Returns:
        The values of those that have none yet, by name.
    """
    found = {}
    for pool in pooled:
        suggested = [
            values[name] / scale
            for name, scale in zip(pool.members, pool.scales, strict=True)
            if name in values
        ]
        if suggested and pool.name not in values:
            found[pool.name] = float(np.mean(suggested))
    return found


def different(
    estimate: Estimate, theta: Array, interval: Array, parameters: ParameterSet
) -> tuple[str, ...]:
    """Names of the parameters that differ by more than two intervals explain.

    Parameters with a value for each recording differ by nature. The others are compared with wider
    intervals, so that one of them differs by chance in 5 % of the cases only (Bonferroni), as if
    the estimates had normal distributions.

    Args:
        estimate: The estimate from the fitted recordings.
        theta: (p,) estimate from other recordings [theta-unit].
        interval: (p, 2) its 95 % intervals [theta-unit].
        parameters: The p parameters.
    """
    halves = np.stack([0.5 * np.ptp(each, axis=1) for each in (estimate.interval, interval)])
    explained = np.sqrt(np.sum(halves**2, axis=0))
    is_known = np.isfinite(explained) & (explained > 0.0)
    compared = is_known & ~parameters.recording_specific

    chance = 0.5 * (1.0 - CONFIDENCE)
    of_one, of_all = scipy.special.ndtri([chance, chance / max(int(compared.sum()), 1)])
    apart = compared & (np.abs(theta - estimate.theta) > of_all / of_one * explained)
    return tuple(name for name, flag in zip(estimate.parameters, apart, strict=True) if flag)


def stated_values(model: FittedModel, first: FittedModel) -> dict[str, float]:
    """Values of the parameters of the stated model in an extended one.

    Args:
        model: The extended model.
        first: The stated model.

    Returns:
        The values by name, without parameters that are pooled [theta-unit].
    """
    names = model.result.task.system.parameters.names
    values = dict(zip(names, model.result.theta.tolist(), strict=True))
    stated = first.result.task.system.parameters.names
    return {name: values[name] for name in stated if name in values}


def tried_step(candidate: Term, model: FittedModel, reduction: Reduction) -> SelectionStep:
    """Step of a term that was tried, before it is decided on.

    Args:
        candidate: The term.
        model: The model with the term.
        reduction: Reduction of the loss of left-out data by the term.
    """
    return replace(
        unhelpful_step(candidate, len(model.terms) - 1),
        decision=Decision.REJECTED,
        error=model.losses.error,
        reduction=reduction.mean,
        standard_error=reduction.standard_error,
    )


def unhelpful_step(candidate: Term, count: int) -> SelectionStep:
    """Step of a term with which the fit is no better, so that left-out data were not predicted.

    Args:
        candidate: The term.
        count: Number of terms of the model without it.
    """
    return SelectionStep(
        decision=Decision.UNHELPFUL,
        description=candidate.description,
        path=candidate.path,
        count=count,
        error=np.nan,
        sigmas=candidate.sigmas,
        share=candidate.share,
        joints=candidate.joints,
    )


def _name_of(path: str, taken: Iterable[str]) -> str:
    """Name of a new parameter, such as `pivot_damping` for `joint/pivot:damping`."""
    place, _, field = path.partition(":")
    words = re.findall(r"\w+", place.partition("/")[2] or place) + re.findall(r"\w+", field)
    name = "_".join(words)
    used = set(taken)
    number = 2
    while name in used:
        name = f"{'_'.join(words)}_{number}"
        number += 1
    return name


def with_selection(
    estimate: Estimate, selection: Selection, losses: HeldOutLosses, system: System
) -> Estimate:
    """The estimate with its selection.

    The terms were chosen with the same data. Where the scatter between the estimates without each
    part of the data is larger than the interval of the fit, the interval is widened to it. A
    warning says where there are too few parts for a scatter.

    Args:
        estimate: The estimate.
        selection: The selection.
        losses: Losses of predictions of left-out data by the selected model.
        system: The selected model.
    """
    estimate = replace(estimate, selection=selection)
    if not selection.is_changed:
        return estimate

    low, high = estimate.interval.T
    parts = len(losses.estimates)
    if parts < MIN_PARTS:
        estimate = replace(estimate, warnings=(*estimate.warnings, NOT_WIDENED))
    else:
        quantile = student_quantile(parts, CONFIDENCE)
        low = np.minimum(low, estimate.theta - quantile * losses.jackknife)
        high = np.maximum(high, estimate.theta + quantile * losses.jackknife)

    # Held-out recordings took no part in the choice, so that what they contradict is not known.
    if selection.refit is not None:
        differs = np.isin(estimate.parameters, selection.refit.differs)
        other = selection.refit.interval
        low = np.where(differs, np.minimum(low, other[:, 0]), low)
        high = np.where(differs, np.maximum(high, other[:, 1]), high)
    interval = np.column_stack([low, high])
    lower, upper = system.parameters.lower, system.parameters.upper
    widened = replace(estimate, interval=np.clip(interval, lower[:, None], upper[:, None]))
    return with_honest_covariance(widened, system.parameters, without_parts=losses.estimates)
