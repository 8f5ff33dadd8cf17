"""Models that a selection compares, and what follows from the selected one."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import replace

import numpy as np
import scipy

from mjfim.arrays import Array, record
from mjfim.experiment.arguments import checked
from mjfim.experiment.schema import Experiment, ExperimentLike, experiment_of
from mjfim.experiment.system import System
from mjfim.identification.assessment.accuracy import FitResult
from mjfim.identification.assessment.honest_covariance import (
    with_honest_covariance,
)
from mjfim.identification.assessment.robust_covariance import t_quantile
from mjfim.identification.assessment.term_tests import TermTests
from mjfim.identification.left_out import HeldOutLosses
from mjfim.model.elements import free_name
from mjfim.model.parameters import Parameter, ParameterSet
from mjfim.model.paths import ParameterPath
from mjfim.records.estimate import Estimate
from mjfim.records.terms import (
    PooledParameter,
    Selection,
    Term,
)

# Smallest number of parameters that are pooled.
MIN_MEMBERS = 2

# Probability that an interval holds the true value.
CONFIDENCE = 0.95

# Fewest parts of the data without which estimates scatter, and the warning where there are fewer.
MIN_PARTS = 2
NOT_WIDENED = (
    "no interval contains that the terms were chosen with the same data, because fewer than two "
    "parts of the recordings could be predicted from the others; give further recordings"
)


# Losses of a model before data are predicted by it.
NO_LOSSES = HeldOutLosses(
    losses=np.zeros(0),
    counts=np.zeros(0),
    parts=np.zeros(0, dtype=np.intp),
    estimates=np.zeros((0, 0)),
)


@record
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
    cost: float
    losses: HeldOutLosses = NO_LOSSES
    terms: tuple[Term, ...] = ()
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


@checked
def selected_experiment(experiment: ExperimentLike, selection: Selection) -> Experiment:
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
    experiment = experiment_of(experiment)
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
    return tuple(name for name, _, _ in model.result.accuracy.poorly_known if name not in excluded)


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


def values_of(model: FittedModel) -> dict[str, float]:
    """Values of all parameters of a fitted model, by name [theta-unit]."""
    names = model.result.task.system.parameters.names
    return dict(zip(names, model.result.theta.tolist(), strict=True))


def _with_pools(values: dict[str, float], pooled: Iterable[PooledParameter]) -> dict[str, float]:
    """Values with those of pooled parameters: the means of what their members suggest."""
    found = dict(values)
    for pool in pooled:
        members = zip(pool.members, pool.scales, strict=True)
        suggested = [found[name] / scale for name, scale in members if name in found]
        if suggested and pool.name not in found:
            found[pool.name] = float(np.mean(suggested))
    return found


def start_of(
    parameters: ParameterSet, model: FittedModel, added: Term | None = None, share: float = 1.0
) -> Array:
    """(p,) start of the fit of a changed model, beginning at its fit before the change.

    Held parameters have their guess. A pooled parameter begins at the mean of what its members
    suggest, and a number of a new term at its estimate: a field of a term at the estimate itself,
    a number of the model that much beyond its value.

    Args:
        parameters: The parameters of the changed model.
        model: The changed model.
        added: The new term.
        share: Share of the estimated sizes of the term with which it begins.
    """
    values = _with_pools(values_of(model), model.pooled)
    changes = {
        number.name: (share if number.is_size else 1.0) * number.value
        for number in (() if added is None else added.numbers)
    }
    start = np.array(parameters.guess)
    for i, parameter in enumerate(parameters.parameters):
        if parameter.name in model.held:
            continue
        change = changes.get(parameter.name, 0.0)
        is_field = parameter.name in changes and parameter.targets[0].term is not None
        start[i] = change if is_field else values.get(parameter.name, start[i]) + change
    return np.clip(start, parameters.lower, parameters.upper)


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
        quantile = t_quantile(parts - 1, CONFIDENCE)
        low = np.minimum(low, estimate.theta - quantile * losses.jackknife)
        high = np.maximum(high, estimate.theta + quantile * losses.jackknife)

    # Held-out recordings took no part in the choice, so that what they contradict is not known.
    if selection.refit is not None:
        _, other, names = selection.refit
        differs = np.isin(estimate.parameters, names)
        low = np.where(differs, np.minimum(low, other[:, 0]), low)
        high = np.where(differs, np.maximum(high, other[:, 1]), high)
    interval = np.column_stack([low, high])
    lower, upper = system.parameters.lower, system.parameters.upper
    widened = replace(estimate, interval=np.clip(interval, lower[:, None], upper[:, None]))
    return with_honest_covariance(widened, system.parameters, without_parts=losses.estimates)


# ---- simpler parameters


def possible_pools(parameters: ParameterSet, names: Collection[str]) -> list[PooledParameter]:
    """Groups of parameters that stand for the same field of different elements.

    Args:
        parameters: All parameters.
        names: Names of the parameters that may be pooled.

    Returns:
        A pool for each group of two or more parameters with one target each and common bounds.
    """
    groups: dict[tuple[str, str, int | None, str], list[Parameter]] = {}
    for parameter in parameters.parameters:
        if parameter.name not in names or not _is_plain(parameter):
            continue
        path = ParameterPath.parse(parameter.targets[0].path)
        groups.setdefault((path.kind, path.field, path.index, parameter.unit), []).append(parameter)

    taken = set(parameters.names)
    pools = []
    for (kind, field, _, _), members in groups.items():
        pool = _pool(f"{kind}_{field}", members, taken)
        if pool is not None and len(members) >= MIN_MEMBERS:
            taken.add(pool.name)
            pools.append(pool)
    return pools


def _is_plain(parameter: Parameter) -> bool:
    """Whether a parameter sets one number of an element, and nothing else is stated about it."""
    if len(parameter.targets) != 1 or parameter.function is not None or parameter.group:
        return False
    target = parameter.targets[0]
    is_number = target.scale == 1.0 and target.offset == 0.0
    return is_number and parameter.prior is None and not parameter.per_recording


def _pool(
    stem: str, members: Sequence[Parameter], taken: Collection[str]
) -> PooledParameter | None:
    """One parameter in place of several; None where no value lies within the bounds of all.

    Where all guesses have one sign and differ, it is a factor on the guesses, because elements of
    different size have different values.
    """
    guesses = np.array([member.guess for member in members])
    is_factor = bool((guesses > 0.0).all() or (guesses < 0.0).all()) and np.ptp(guesses) > 0.0
    scales = guesses if is_factor else np.ones(len(members))
    guess = 1.0 if is_factor else float(guesses.mean())

    # The pool keeps the bounds of all members.
    low = max(min(bound / s for bound in m.bounds) for m, s in zip(members, scales, strict=True))
    high = min(max(bound / s for bound in m.bounds) for m, s in zip(members, scales, strict=True))
    if not low < high:
        return None
    guess = float(np.clip(guess, low, high))
    sizes = [m.scale / abs(s) for m, s in zip(members, scales, strict=True)]
    return PooledParameter(
        name=free_name(stem, taken),
        members=tuple(member.name for member in members),
        paths=tuple(member.targets[0].path for member in members),
        scales=tuple(float(scale) for scale in scales),
        guess=guess,
        unit="" if is_factor else members[0].unit,
        scale=max(1.0, *sizes) if is_factor else max(sizes),
        bounds=(float(low), float(high)),
    )


def simplified_experiment(
    experiment: Experiment, pooled: Iterable[PooledParameter], held: Collection[str]
) -> Experiment:
    """An experiment with pooled and held parameters.

    Args:
        experiment: The experiment.
        pooled: Pools, which take the places of their members.
        held: Names of parameters that keep their guess.

    Returns:
        The experiment, checked again.
    """
    pools = list(pooled)
    if not pools and not held:
        return experiment

    values = experiment.model_dump(exclude_unset=True)
    members = {name for pool in pools for name in pool.members}
    tables = {name: table for name, table in values["parameters"].items() if name not in members}
    values["parameters"] = {**tables, **{pool.name: pool.table for pool in pools}}
    if held:
        fit = values.get("fit", {})
        values["fit"] = {**fit, "hold": (*fit.get("hold", ()), *sorted(held))}
    return experiment.restated(values)
