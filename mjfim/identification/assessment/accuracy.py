"""Result of the searches of an identification, and the accuracy of its estimate.

That is the formal covariance, robust intervals, and the poorly known parameters.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy

from mjfim.arrays import (
    NORMAL_95,
    POORLY_KNOWN_SHARE,
    UNDETERMINED_SHARE,
    Array,
    record,
    scaled_to_unit_diagonal,
)
from mjfim.identification.assessment.honest_covariance import between_covariance
from mjfim.identification.assessment.residual_tests import FitQuality
from mjfim.identification.assessment.robust_covariance import (
    Uncertainty,
    block_length,
    inverse_root,
    robust_uncertainty,
)
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.linear_coordinates import cad_bodies, cad_information, columns_of
from mjfim.identification.search import FitTask, of_subset
from mjfim.information.criteria import marginal, standard_deviations
from mjfim.information.null_space import NullSpace, parameter_groups
from mjfim.model.parameters import ParameterSet
from mjfim.optimize.levenberg_marquardt import Solution, UnknownValues
from mjfim.records.check import ParameterGroup
from mjfim.records.estimate import HorizonStudy, PriorDirections, Restart
from mjfim.records.estimate_parts import InformationInTime, InverseDynamicsFit

# A combination is determined by the recordings where these leave at most this share of the standard
# deviation of the prior.
DETERMINED_SHARE = 0.5


def inertia_combinations(
    parameters: ParameterSet, theta: Array, data: Array
) -> tuple[np.ndarray, np.ndarray, Array] | None:
    """Compare the information of the recordings about inertias with that of their CAD prior.

    Args:
        parameters: The p parameters.
        theta: (p,) estimate [theta-unit].
        data: (p, p) information of the recordings alone about the parameters that they share.

    Returns:
        (k,) indices in theta of the coordinates with a CAD prior, (k,) True for their combinations
        that the recordings determine, and (k, k) directions of the coordinates, one in each column,
        in which recordings and prior are uncorrelated and the prior has the standard deviation 1
        [theta-unit]. None without a CAD prior.
    """
    is_shared = ~parameters.recording_specific
    bodies = [body for body in cad_bodies(parameters) if is_shared[body.columns].all()]
    columns = columns_of(bodies)
    if not len(columns):
        return None

    # Other parameters are estimated as well, so that their uncertainty counts.
    kept = np.concatenate([columns, np.setdiff1d(np.flatnonzero(is_shared), columns)])
    both = np.ix_(kept, kept)
    about = marginal(data[both], parameters.prior_information[both], np.arange(len(columns)))

    # Eigenvalues of the information relative to the prior do not depend on the coordinates.
    own = np.ix_(columns, columns)
    known, scale = scaled_to_unit_diagonal(cad_information(bodies, theta)[own])
    ratios, vectors = scipy.linalg.eigh(about / np.outer(scale, scale), known)
    left = 1.0 / np.sqrt(1.0 + np.maximum(ratios, 0.0))
    return columns, left <= DETERMINED_SHARE, vectors / scale[:, None]


def prior_directions(
    parameters: ParameterSet, theta: Array, data: Array, std: Array
) -> PriorDirections | None:
    """Count the combinations of inertias that the recordings determine.

    Args:
        parameters: The p parameters.
        theta: (p,) estimate [theta-unit].
        data: (p, p) information of the recordings alone about the parameters that they share.
        std: (p,) standard deviations with the priors [theta-unit].

    Returns:
        The combinations; None without a CAD prior, or where the recordings determine all of them.
    """
    found = inertia_combinations(parameters, theta, data)
    if found is None or found[1].all():
        return None

    columns, is_determined, axes = found
    is_prior = std[columns] > DETERMINED_SHARE * np.linalg.norm(axes, axis=1)
    groups = [parameters.parameters[j].group for j in columns.tolist()]
    return PriorDirections(
        bodies=tuple(dict.fromkeys(groups)),
        count=len(columns),
        determined=int(is_determined.sum()),
        parameters=tuple(parameters.names[j] for j in columns[is_prior].tolist()),
    )


# Ratio of two standard deviations above which one of them counts as much larger.
GROWN = 3.0

# Correlation above which another parameter is named as confounded.
CONFOUNDED_CORRELATION = 0.5

# The width of an interval is compared with the size of the estimated value, or with this share of
# the parameter's magnitude where the value is smaller.
SMALLEST_RELATIVE_SIZE = 1e-3

# Smallest variance in a denominator.
SMALLEST_VARIANCE = 1e-300


@record
class Accuracy:
    """Accuracy of the p parameters, with the values of the first recording.

    Attributes:
        std: (p,) formal standard deviations [theta-unit].
        covariance: (p, p) formal covariance.
        robust_covariance: (p, p) covariance that allows for autocorrelated residuals and for
            recordings that disagree; infinite on the diagonal where a parameter is not determined.
        sandwich: (p,) standard deviations that allow for autocorrelated residuals [theta-unit].
        interval: (p, 2) 95 % intervals [theta-unit].
        between: (p,) standard deviations from recording to recording [theta-unit].
        groups: Parameters of which only combinations are identifiable.
        singular: True where parameters outside these groups are not identifiable either.
        single_unidentifiable: True where one of the groups contains a parameter that was not
            declared as a member of a parameter group.
        poorly_known: Parameters of interest that are poorly known: the name, a remark, and half the
            width of the interval over the size of the value.
        data_information: (p, p) information of the recordings alone, without priors.
        robust: Robust uncertainty of the common unknowns; None where one of them is not determined.
        prior_directions: Combinations of inertias that the CAD prior determines, or None.
        in_time: Which seconds decide the parameters; None where one of them is not determined.
    """

    std: Array
    covariance: Array
    robust_covariance: Array
    sandwich: Array
    interval: Array
    between: Array
    groups: tuple[ParameterGroup, ...]
    singular: bool
    single_unidentifiable: bool
    poorly_known: tuple[tuple[str, str, float], ...]
    data_information: Array
    robust: Uncertainty | None
    prior_directions: PriorDirections | None
    in_time: InformationInTime | None


def _accuracy_of(fit: FitResult) -> Accuracy:
    """Assess the accuracy of a fit."""
    problem, solution = fit.problem, fit.solution
    system = problem.system
    parameters, theta = system.parameters, problem.theta(solution.unknowns)
    columns = problem.first_columns
    index = problem.parameter_of_column[columns]

    # The formal covariance; unknowns of each recording have the values of the first one.
    H = solution.condensed.information()
    common_std = standard_deviations(H)
    is_regular = bool(np.isfinite(common_std).all())
    common: Array = np.full_like(H, np.inf)
    if is_regular:
        root = inverse_root(H)
        common = root @ root.T
    formal = _of_parameters(problem, solution, common)
    std = np.sqrt(np.diag(formal))
    std[index] = common_std[columns]

    # Members of a group are not identifiable separately, though pins make their information
    # regular.
    groups = parameter_groups(fit.null_space, parameters.names, parameters.magnitude, system.units)
    members = [name for group in groups for name in group.members]
    in_group = np.isin(parameters.names, members)
    std[in_group] = np.inf
    formal[in_group], formal[:, in_group] = np.inf, np.inf
    declared_alone = np.array([not parameter.group for parameter in parameters.parameters])

    # Robust values, from the blocks of the last linearisation; formal ones where there are none.
    robust = None
    covariance, sandwich, between = np.array(formal), np.array(std), np.zeros(len(std))
    interval = np.column_stack([theta - NORMAL_95 * std, theta + NORMAL_95 * std])
    if is_regular:
        settings = system.experiment.fit
        robust = robust_uncertainty(
            solution.condensed,
            problem.common_values(solution.unknowns),
            problem.recording_of_block,
            problem.mean_block_rows,
            min_rows=fit.independent_rows,
            draws=settings.bootstrap,
            rng=np.random.default_rng(settings.seed),
            own=problem.own_columns,
            inflation=fit.quality.inflation,
            is_white=fit.quality.is_white,
        )
        covariance = _of_parameters(
            problem, solution, robust.covariance + between_covariance(robust)
        )
        is_known = np.isfinite(std[index])
        known, places = index[is_known], columns[is_known]
        sandwich[known] = robust.sandwich[places]
        between[known] = robust.between[places]
        interval[known] = robust.interval[places]
    is_unknown = ~np.isfinite(std) | ~np.isfinite(np.diag(covariance))
    covariance[is_unknown] = 0.0
    covariance[:, is_unknown] = 0.0
    covariance[is_unknown, is_unknown] = np.inf

    # Intervals end at the bounds. An estimate beyond its bounds, which the method newton allows,
    # stays inside its interval.
    low, high = np.minimum(parameters.lower, theta), np.maximum(parameters.upper, theta)
    interval = np.clip(interval, low[:, None], high[:, None])

    # Information of the recordings alone about the parameters that they share. Only the priors on
    # the other unknowns, which are marginalised, count.
    J = problem.prior_rows(solution.unknowns)[:, :-1]
    of_data = solution.condensed.information(with_common_rows=False)
    data = np.zeros_like(formal)
    shared = np.arange(len(problem.shared))
    data[np.ix_(problem.shared, problem.shared)] = marginal(of_data, J.T @ J, shared)
    return Accuracy(
        std=std,
        covariance=formal,
        robust_covariance=covariance,
        sandwich=sandwich,
        interval=interval,
        between=between,
        groups=groups,
        singular=not np.isfinite(std[~in_group]).all(),
        single_unidentifiable=bool((in_group & declared_alone).any()),
        poorly_known=tuple(_poorly_known(fit, theta, interval, formal)),
        data_information=data,
        robust=robust,
        prior_directions=prior_directions(parameters, theta, data, std),
        in_time=_information_in_time(fit, common, std) if is_regular else None,
    )


def _information_in_time(fit: FitResult, covariance: Array, std: Array) -> InformationInTime | None:
    """The seconds that decide the parameters with a standard deviation: (p,); None without any.

    When a parameter moves and all other unknowns follow at their optimum, they move along its
    column of the covariance: (c, c).
    """
    problem, condensed = fit.problem, fit.solution.condensed
    names = problem.system.parameters.names
    known = np.isfinite(std[problem.parameter_of_column])
    columns = problem.first_columns[known[problem.first_columns]]
    if not len(columns):
        return None
    variance = np.diag(covariance)[columns]
    along = covariance[:, columns]
    information = np.sum(along * (condensed.block_information @ along), axis=1)
    return InformationInTime(
        parameters=tuple(names[j] for j in problem.parameter_of_column[columns]),
        recording=problem.recording_of_block,
        times=problem.times_of_block,
        shares=information / variance,
        pulls=-condensed.block_scores @ along / np.sqrt(variance),
        scatter=float(np.sqrt(max(fit.quality.chi2 / fit.quality.dof, 1.0))),
    )


def _of_parameters(problem: FitProblem, solution: Solution, common: Array) -> Array:
    """(p, p) covariance of the parameters from that of the common unknowns: (c, c).

    Unknowns of each recording have the values of the first recording. Deviations of the first
    initial state, which are private unknowns, follow the common ones.
    """
    p = len(problem.parameters)
    columns = problem.first_columns
    index = problem.parameter_of_column[columns]
    covariance = np.zeros((p, p))
    covariance[np.ix_(index, index)] = common[np.ix_(columns, columns)]

    private = problem.private
    if not len(private) or problem.free_starts:
        return covariance

    # The private unknowns follow the common ones linearly; both are infinite where an unknown is
    # not determined.
    condensed, n = solution.condensed, solution.condensed.private_count
    R = condensed.triangles[0, :n, :n]
    of_private, cross = np.full((n, n), np.inf), np.full((n, len(columns)), np.inf)
    if np.linalg.matrix_rank(R) == n and np.isfinite(common).all():
        response = condensed.private_response[0]
        of_private = np.linalg.inv(R.T @ R) + response @ common @ response.T
        cross = (response @ common)[:, columns]
    covariance[np.ix_(private, private)] = of_private
    covariance[np.ix_(private, index)] = cross
    covariance[np.ix_(index, private)] = cross.T
    return covariance


def _poorly_known(
    fit: FitResult, theta: Array, interval: Array, covariance: Array
) -> Iterator[tuple[str, str, float]]:
    """Parameters of interest that are poorly known, each with a remark and a share.

    The remark says how accurate the estimate is, and why it is no better. The share is half the
    width of the interval over the size of the value. Inertias with a CAD prior are left out: single
    ones of an arm are no result, and what the recordings determine of them is said once for all
    (`prior_share`).
    """
    parameters = fit.problem.system.parameters
    variance = np.diag(covariance)
    is_known = np.isfinite(variance)
    std = np.sqrt(np.maximum(np.where(is_known, variance, 1.0), SMALLEST_VARIANCE))
    sizes = np.maximum(parameters.sizes(theta), SMALLEST_RELATIVE_SIZE * parameters.magnitude)
    half_widths = 0.5 * (interval[:, 1] - interval[:, 0])
    shares = np.where(np.isfinite(half_widths), half_widths / sizes, 0.0)
    chosen = np.setdiff1d(parameters.interest, columns_of(cad_bodies(parameters)))
    chosen = chosen[shares[chosen] > POORLY_KNOWN_SHARE]
    at_guess = std_at_start(fit) if (shares[chosen] >= UNDETERMINED_SHARE).any() else std

    for j in chosen.tolist():
        # The name of the most correlated parameter helps to choose the next experiment.
        correlation = np.where(is_known, covariance[j], 0.0) / (std * std[j])
        correlation[j] = 0.0
        other = int(np.argmax(np.abs(correlation)))
        confounded = ""
        if abs(correlation[other]) > CONFOUNDED_CORRELATION:
            name = parameters.names[other]
            confounded = f"; it is confounded with {name} (correlation {correlation[other]:+.2f})"
        remark = f"is known to ±{100 * shares[j]:.0f} % only{confounded}"
        if shares[j] >= UNDETERMINED_SHARE:
            low, high = interval[j]
            span = f"{low:.3g} to {high:.3g} {parameters.parameters[j].unit}".rstrip()
            why = "; its effect on these motions is smaller than the noise"
            if NORMAL_95 * std[j] < UNDETERMINED_SHARE * sizes[j]:
                # White noise of this size would leave the parameter determined.
                confounded = ""
                why = "; correlated or uneven residuals make it wider than white noise would"
            elif std[j] > GROWN * at_guess[j]:
                why = "; the motion depends on it much less at the estimate than at the guess"
            elif max(abs(low), abs(high)) < abs(fit.task.start[j]):
                why = "; it is smaller than the guess, and too small to be seen"
            remark = (
                f"is not determined by these logs: its interval is {span} (predicted σ "
                f"{at_guess[j]:.2g} at the guess, {std[j]:.2g} at the estimate){confounded or why}"
            )
        yield parameters.names[j], remark, float(shares[j])


def std_at_start(fit: FitResult) -> Array:
    """(p,) formal standard deviations that the recordings give at the start of a fit [theta-unit].

    They are those of a quick part of the data, scaled to all of them; infinite where the model
    diverges there.
    """
    problem, _ = fit.quick
    condensed = problem.condense(problem.begin(fit.task.start))
    std = np.full(len(fit.theta), np.inf)
    if condensed is not None:
        columns = problem.first_columns
        found = standard_deviations(condensed.information())[columns]
        share = problem.value_count / max(fit.problem.value_count, 1)
        std[problem.parameter_of_column[columns]] = found * np.sqrt(share)
    return std


@dataclass(frozen=True, kw_only=True, eq=False)
class FitResult:
    """Result of the searches of one identification.

    Attributes:
        task: System, recordings and settings.
        problem: The least-squares problem, with the noise of the last search.
        solution: Its solution.
        quality: Size and whiteness of its residuals.
        null_space: Directions of theta about which neither recordings nor priors contain
            information.
        held_out: Problem of the held-out recordings; None without any.
        subset: Indices of segments that are quick to simulate, evenly spread over the data.
        restart: How the fit was repeated from fits over segments; None where it was not.
        horizons: Lengths of segments that were compared; None where they were not.
        inverse_dynamics: The fit to the equation of motion from which the search started, or None.
        begun_instead: Where it began instead of the stated start, at which the model diverges, in
            words; empty where it does not diverge there.
        touches: Stops and contacts that made the search begin anew near its result, in words.
    """

    task: FitTask
    problem: FitProblem
    solution: Solution
    quality: FitQuality
    null_space: NullSpace
    held_out: FitProblem | None
    subset: np.ndarray
    restart: Restart | None
    horizons: HorizonStudy | None = None
    inverse_dynamics: InverseDynamicsFit | None = None
    begun_instead: str = ""
    touches: str = ""

    @property
    def theta(self) -> Array:
        """(p,) estimate, with the values of the first recording."""
        return self.problem.theta(self.solution.unknowns)

    @property
    def quick(self) -> tuple[FitProblem, UnknownValues]:
        """The problem of the segments that are quick to simulate, and its unknowns."""
        return self.problem.of_segments(self.subset), of_subset(self.solution.unknowns, self.subset)

    @cached_property
    def accuracy(self) -> Accuracy:
        """Accuracy of the estimate."""
        return _accuracy_of(self)

    @cached_property
    def independent_rows(self) -> float:
        """Number of rows of a block of the data that counts as independent.

        It is stated in seconds, or follows from the autocorrelation of the residuals.
        """
        stated, rows = self.problem.system.experiment.fit.blocks, self.problem.row_count
        if stated is not None:
            return stated * rows / sum(float(each.t[-1]) for each in self.problem.recordings)
        tests = self.quality.whiteness
        return block_length([test.time * rows / max(test.count, 1) for test in tests], rows)
