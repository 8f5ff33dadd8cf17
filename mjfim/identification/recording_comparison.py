"""Comparison of recordings: what each suggests alone, their scatter, and which of them is odd.

Each recording suggests values of its own, one Gauss-Newton step from the common estimate, by its
part of the last linearisation; nothing is simulated. Whether recordings agree is tested with
information matrices, so that recordings may determine some directions of the parameters only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import PurePath

import numpy as np

from mjfim.arrays import Array
from mjfim.identification.accuracy import independent_rows
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.independent_blocks import (
    RecordingEvidence,
    independent_blocks,
    recording_evidence,
)
from mjfim.identification.odd_recordings import odd_recordings
from mjfim.identification.random_effects import (
    difference,
    f_tail,
    random_effects,
    satterthwaite,
    t_quantile,
)
from mjfim.identification.recording_views import TOLERANCE, block_freedom, recording_views
from mjfim.information.marginal import standard_deviations
from mjfim.model.parameters import ParameterSet
from mjfim.optimize.levenberg_marquardt import Solution
from mjfim.records.estimate import Uncertainty
from mjfim.records.robots import RecordingComparison


def compare_recordings(
    problem: FitProblem,
    solution: Solution,
    correlation_rows: Sequence[float],
    robust: Uncertainty | None,
) -> RecordingComparison | None:
    """Compare the recordings of a fit with each other.

    Args:
        problem: The least-squares problem.
        solution: Its solution.
        correlation_rows: Autocorrelation time of the residuals of every output [rows].
        robust: Robust uncertainty of the common unknowns, or None.

    Returns:
        The comparison; None for a single recording, and where the recordings have no parameter of
        the robot in common.
    """
    layout = problem.layout
    parameters = problem.system.parameters
    recordings = tuple(PurePath(recording.name).name for recording in problem.recordings)
    if len(recordings) < 2 or not len(layout.shared):
        return None

    condensed = solution.condensed
    recording_of_block = problem.blocks.recording_of_block
    min_rows = independent_rows(problem, correlation_rows)
    blocks = independent_blocks(condensed, recording_of_block, problem.blocks.mean_rows, min_rows)
    evidence = recording_evidence(condensed, blocks, recording_of_block, layout.own_columns)
    shared = compare_evidence(
        solution.unknowns.theta[layout.shared],
        evidence,
        recordings=recordings,
        parameters=tuple(parameters.names[j] for j in layout.shared),
        units=tuple(problem.system.units[j] for j in layout.shared),
        is_single=is_single(parameters, solution.unknowns.theta)[layout.shared],
    )

    # Parameters of the robot that are stated to differ have their values already.
    stated = [i for i, j in enumerate(layout.per_recording) if parameters.changes_model[j]]
    if not stated:
        return _inside_bounds(shared, parameters)
    columns = layout.own_columns[:, stated]
    std = standard_deviations(condensed.information())
    if robust is not None:
        std = np.maximum(std, robust.sandwich)
    complete = _with_stated(
        shared,
        names=[parameters.names[layout.per_recording[i]] for i in stated],
        units=[problem.system.units[layout.per_recording[i]] for i in stated],
        values=solution.unknowns.per_recording[:, stated],
        std=std[columns],
        freedom=block_freedom(evidence),
    )
    return _inside_bounds(complete, parameters)


def is_single(parameters: ParameterSet, theta: Array) -> np.ndarray:
    """(p,) True for single numbers, such as masses, False for entries of vectors and tensors.

    Args:
        parameters: The parameters.
        theta: (p,) values [theta-unit].
    """
    return np.asarray(parameters.sizes(theta) == np.abs(theta))


def _inside_bounds(
    comparison: RecordingComparison, parameters: ParameterSet
) -> RecordingComparison:
    """The comparison with intervals that end at the bounds of the parameters."""
    index = [parameters.names.index(name) for name in comparison.parameters]
    low = np.fmin(parameters.lower[index], comparison.mean)[:, None]
    high = np.fmax(parameters.upper[index], comparison.mean)[:, None]
    return replace(
        comparison,
        interval=np.clip(comparison.interval, low, high),
        prediction=np.where(
            np.isfinite(comparison.prediction),
            np.clip(comparison.prediction, low, high),
            comparison.prediction,
        ),
    )


def compare_evidence(
    theta: Array,
    evidence: RecordingEvidence,
    *,
    recordings: Sequence[str],
    parameters: Sequence[str],
    units: Sequence[str],
    is_single: np.ndarray,
) -> RecordingComparison:
    """Compare recordings by what they say about the unknowns that they share.

    Args:
        theta: (s,) estimate from all recordings [theta-unit].
        evidence: What each of K recordings says.
        recordings: Their K names.
        parameters: Names of the s unknowns.
        units: Units of the s unknowns; may be empty.
        is_single: (s,) True for single numbers, False for entries of vectors and tensors.
    """
    views = recording_views(theta, evidence)
    effects = random_effects(views.values, views.std**2, views.freedom)

    everyone = list(range(evidence.count))
    squares, dof = difference(views.parts, TOLERANCE)
    joint_p = f_tail(squares, dof, views.freedom)
    mean, std = views.mean(everyone, effects.tau2)
    share = effects.tau2 / np.where(std > 0.0, std**2 * evidence.count, 1.0)
    reach = t_quantile(satterthwaite(share, views.freedom, evidence.count - 1)) * std

    count = len(parameters)
    return RecordingComparison(
        recordings=tuple(recordings),
        parameters=tuple(parameters),
        units=tuple(units),
        is_stated=np.zeros(count),
        values=views.values,
        std=views.std,
        mean=mean,
        interval=np.column_stack([mean - reach, mean + reach]),
        tau=np.sqrt(effects.tau2),
        share=effects.share,
        p=np.minimum(count * effects.p, 1.0),
        prediction=effects.prediction,
        joint_p=joint_p,
        odd=tuple(odd_recordings(views, recordings, parameters, units, is_single)),
    )


# ---- parameters that are stated to differ


def _with_stated(
    shared: RecordingComparison,
    *,
    names: Sequence[str],
    units: Sequence[str],
    values: Array,
    std: Array,
    freedom: float,
) -> RecordingComparison:
    """The comparison with parameters that are stated to differ, whose scatter is no surprise.

    Args:
        shared: Comparison of the other parameters.
        names: Names of the e parameters.
        units: Their units.
        values: (K, e) values of each recording.
        std: (K, e) their standard deviations.
        freedom: Degrees of freedom of these.
    """
    effects = random_effects(values, std**2, freedom)
    deviation = np.sqrt(effects.variance)
    between = effects.tau2 / np.where(deviation > 0.0, deviation**2 * len(values), 1.0)
    reach = t_quantile(satterthwaite(between, freedom, len(values) - 1)) * deviation
    count = len(names)
    return RecordingComparison(
        recordings=shared.recordings,
        parameters=(*shared.parameters, *names),
        units=(*shared.units, *units),
        is_stated=np.concatenate([shared.is_stated, np.ones(count)]),
        values=np.column_stack([shared.values, values]),
        std=np.column_stack([shared.std, std]),
        mean=np.concatenate([shared.mean, effects.mean]),
        interval=np.concatenate(
            [shared.interval, np.column_stack([effects.mean - reach, effects.mean + reach])]
        ),
        tau=np.concatenate([shared.tau, np.sqrt(effects.tau2)]),
        share=np.concatenate([shared.share, effects.share]),
        p=np.concatenate([shared.p, np.ones(count)]),
        prediction=np.concatenate([shared.prediction, effects.prediction]),
        joint_p=shared.joint_p,
        odd=shared.odd,
    )
