"""How accurate an estimate is: formal covariance, honest intervals, what the data hardly tell."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.experiment.system import System
from mjfim.identification.residuals import FitProblem
from mjfim.identification.robust_covariance import together, uncertainty
from mjfim.information.marginal import marginal, standard_deviations
from mjfim.information.null_space import NullSpace, parameter_groups
from mjfim.optimize.condensed_least_squares import Condensed
from mjfim.optimize.levenberg_marquardt import Solution
from mjfim.records.combinations import ParameterGroup
from mjfim.records.estimate import Uncertainty

SLOPPY = 0.25  # half of an interval over the value, from which a parameter is hardly known
TRADED = 0.5  # correlation from which another parameter can stand in for one


@dataclass(frozen=True, eq=False)
class Accuracy:
    """Of theta: (p,). std: (p,), covariance: (p, p) formal;  sandwich, between: (p,);  interval: (p, 2) (see `Estimate`)

    groups: of parameters that are known in combination only;  singular: others are not determined either
    lost: a parameter that was declared alone is among the groups
    sloppy: names of wanted parameters that are hardly known, and how that is said
    data: (p, p) information of the recordings alone;  detail: of the common unknowns, None where one is not determined
    """

    std: Array
    covariance: Array
    sandwich: Array
    interval: Array
    between: Array
    groups: tuple[ParameterGroup, ...]
    singular: bool
    lost: bool
    sloppy: tuple[tuple[str, str], ...]
    data: Array
    detail: Uncertainty | None


def accuracy(
    fit: FitProblem, solution: Solution, null: NullSpace, times: Sequence[float]
) -> Accuracy:
    """Of a solution. null: what no recording shows;  times: rows over which the residuals of each output hang together"""
    p, theta = fit.system.parameters, fit.theta(solution.unknowns)
    covariance, std = _formal(fit, solution)
    groups = parameter_groups(null, p.names, p.magnitude, [q.unit for q in p.parameters])
    lumped = np.isin(p.names, [name for group in groups for name in group.members])
    std = np.where(lumped, np.inf, std)
    covariance = np.where(np.logical_or.outer(lumped, lumped), np.inf, covariance)
    lost = lumped & np.array([not q.group for q in p.parameters])
    detail = _honest(fit, solution, times)
    sandwich, interval, between = _spread(fit, theta, std, detail)
    return Accuracy(
        std,
        covariance,
        sandwich,
        interval,
        between,
        groups,
        not np.isfinite(std[~lumped]).all(),
        bool(lost.any()),
        tuple(_sloppy(fit.system, theta, interval, covariance)),
        _data(fit, solution.condensed),
        detail,
    )


def _formal(fit: FitProblem, solution: Solution) -> tuple[Array, Array]:
    """(p, p) covariance and (p,) standard deviations; of what recordings have of their own, the first one's."""
    layout, condensed = fit.layout, solution.condensed
    H = condensed.information()
    std = standard_deviations(H)
    singular = not np.isfinite(std).all()
    whole = np.full_like(H, np.inf) if singular else np.linalg.inv(H)
    p, first = len(fit.system.parameters), layout.first
    places = layout.places[first]
    covariance, spread = np.zeros((p, p)), np.zeros(p)
    covariance[np.ix_(places, places)], spread[places] = whole[np.ix_(first, first)], std[first]
    private = layout.private
    n = len(private)
    if n and not fit.measured:
        R = condensed.triangles[0, :n, :n]
        free = np.linalg.matrix_rank(R) == n and not singular
        C = condensed.private_response[0]
        alone = np.linalg.inv(R.T @ R) + C @ whole @ C.T if free else np.full((n, n), np.inf)
        cross = (C @ whole)[:, first] if free else np.full((n, len(first)), np.inf)
        covariance[np.ix_(private, private)] = alone
        covariance[np.ix_(private, places)] = cross
        covariance[np.ix_(places, private)] = cross.T
        spread[private] = np.sqrt(np.diag(alone))
    return covariance, spread


def _honest(fit: FitProblem, solution: Solution, times: Sequence[float]) -> Uncertainty | None:
    """What the blocks of the last linearisation say; None where a common unknown is not determined."""
    spec = fit.system.experiment.fit
    if not np.isfinite(standard_deviations(solution.condensed.information())).all():
        return None
    recording, rows = fit.blocks
    total = sum(len(t.t) for t in fit.aligned)
    length = together(times, total)
    if spec.blocks is not None:
        length = spec.blocks * total / sum(float(t.t[-1]) for t in fit.aligned)
    rng = np.random.default_rng(spec.seed)
    place = fit.common_values(solution.unknowns)
    return uncertainty(solution.condensed, place, recording, rows, length, spec.bootstrap, rng)


def _spread(
    fit: FitProblem, theta: Array, std: Array, honest: Uncertainty | None
) -> tuple[Array, Array, Array]:
    """(p,) sandwich deviations, (p, 2) intervals, (p,) deviations between recordings; formal ones where there are none."""
    sandwich, between = np.array(std), np.zeros(len(std))
    interval = np.column_stack([theta - 1.96 * std, theta + 1.96 * std])
    layout, p = fit.layout, fit.system.parameters
    if honest is not None:
        columns = layout.first
        places = layout.places[columns]
        known = np.isfinite(std[places])
        places, columns = places[known], columns[known]
        sandwich[places], between[places] = honest.sandwich[columns], honest.between[columns]
        interval[places] = honest.interval[columns]
    low = np.maximum(interval[:, 0], np.minimum(p.lower, theta))
    high = np.minimum(interval[:, 1], np.maximum(p.upper, theta))
    return sandwich, np.column_stack([low, high]), between


def _data(fit: FitProblem, condensed: Condensed) -> Array:
    """(p, p) information of the recordings alone about what they share, everything else marginalised."""
    p, layout = fit.system.parameters, fit.layout
    H, places = condensed.information(with_common_rows=False), layout.places
    kept, out = np.arange(len(layout.shared)), np.zeros((len(p), len(p)))
    prior = p.prior_information[np.ix_(places, places)] * np.eye(len(places))
    out[np.ix_(layout.shared, layout.shared)] = marginal(H, prior, kept)
    return out


def _sloppy(
    system: System, theta: Array, interval: Array, covariance: Array
) -> Iterator[tuple[str, str]]:
    """Wanted parameters that the data hardly tell, and in words what they may be traded for."""
    p = system.parameters
    told = np.isfinite(np.diag(covariance))
    spread = np.sqrt(np.maximum(np.where(told, np.diag(covariance), 1.0), 1e-300))
    for j in p.interest:
        half = 0.5 * float(interval[j, 1] - interval[j, 0])
        size = max(abs(float(theta[j])), 1e-3 * float(p.magnitude[j]))
        if not np.isfinite(half) or half <= SLOPPY * size:
            continue
        together = np.where(told, covariance[j], 0.0) / (spread * spread[j])
        together[j] = 0.0
        other = int(np.argmax(np.abs(together)))
        traded = f"; it is traded for {p.names[other]} (correlation {together[other]:+.2f})"
        known = (
            f"is known to ±{100 * half / size:.0f} % only"
            if half < 10 * size
            else "may be anything in its interval"
        )
        yield p.names[j], known + (traded if abs(together[other]) > TRADED else "")
