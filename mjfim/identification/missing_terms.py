"""Score tests of physical terms that a model may lack.

Candidates are dry friction, damping, stiffness and rotor inertia of every joint, the gain of every
direct drive, a tilt of the base, bias of outputs, and a delay between controls and outputs. Each
candidate has a column of sensitivities at the estimate. With its score g and its information I,
both after the parameters are eliminated, the term would reduce the sum of squared residuals by
`g^2 / I`, and its estimated size is `-g / I`. One linearisation tests all candidates.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.experiment.system import System
from mjfim.identification.fit_problem import FitProblem
from mjfim.model.coordinates import scalar_joints
from mjfim.model.elements import element_name
from mjfim.model.paths import unit_of
from mjfim.model.sizes import LEAST_MOVE_PER_SAMPLE, force_sizes, position_sizes
from mjfim.optimize.condensed_least_squares import Condensed
from mjfim.optimize.levenberg_marquardt import UnknownValues
from mjfim.records.estimate import MissingTerm
from mjfim.records.recording import Recording

# Probability, over all candidates, that one is reported although the model is complete.
SIGNIFICANCE = 1e-3

# Smallest share of the sum of squared residuals that a reported term explains.
MIN_EXPLAINED_SHARE = 2e-3

# Size at which the sensitivity of a term is taken where it is zero in the model, relative to the
# inertia of its joint and the natural time of the motion.
LINEARISATION_SIZE = 1e-4

# Largest number of candidates.
MAX_CANDIDATES = 60

# Largest number of terms that are reported.
MAX_NAMED_TERMS = 4

# Terms whose significances differ by less than this share explain the residuals equally well. They
# keep the order of the candidates, which rounding errors cannot change.
EQUAL_SIGNIFICANCE = 1e-3

# Smallest share of a term's information that remains after the parameters are eliminated. With
# less, the term is not identifiable separately from the parameters.
MIN_REMAINING_SHARE = 1e-8

# Eigenvalues of the scaled information of the parameters below this share of the largest one count
# as zero.
INVERSE_TOLERANCE = 1e-12

# Smallest column norm in a denominator.
SMALLEST_NORM = 1e-300

# Fields of a joint that are candidates, with their names in words.
JOINT_TERMS = {
    "frictionloss": "dry friction",
    "damping": "viscous damping",
    "damping[1]": "quadratic damping",
    "armature": "rotor inertia",
    "stiffness": "a spring",
}

# Smallest component of gravity, as a share of it, that does not count as zero.
MIN_GRAVITY_SHARE = 1e-9


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A term to test.

    Attributes:
        description: The term in words.
        path: Parameter path of the term.
        unit: Unit of the term; may be empty.
        positive: True where only positive values make sense.
        value: Value in the model [unit].
        linearised_at: Value at which its sensitivity is taken [unit].
        size: Small size of the term, larger than 0 [unit].
    """

    description: str
    path: str
    unit: str
    positive: bool
    value: float
    linearised_at: float
    size: float


@dataclass(frozen=True, kw_only=True, eq=False)
class _Linearisation:
    """Normal equations of parameters and candidates, columns scaled to length 1.

    Attributes:
        H: (m, m) information.
        g: (m,) gradient of half of the squared residuals, with all candidates at their values in
            the model.
        norms: (m,) lengths of the columns.
        columns: Column of every candidate.
        others: Columns of the parameters.
        inverse: Pseudo-inverse of the information about the parameters.
    """

    H: Array
    g: Array
    norms: Array
    columns: list[int]
    others: np.ndarray
    inverse: Array


def find_missing_terms(
    problem: FitProblem, recordings: Sequence[Recording], at: UnknownValues
) -> tuple[MissingTerm, ...]:
    """Terms that would explain significant residuals.

    Args:
        problem: The least-squares problem of some segments.
        recordings: All recordings.
        at: Solution of the problem.

    Returns:
        The terms, most significant first; empty where no term is significant.
    """
    system = problem.system
    candidates = list(_candidates(system))[:MAX_CANDIDATES]
    if not candidates:
        return ()

    linearisation = _linearise(problem, recordings, at, candidates)
    if linearisation is None:
        return ()

    squares = 2.0 * problem.cost(at)
    found = []
    for candidate, column in zip(candidates, linearisation.columns, strict=True):
        term = _score_test(candidate, column, linearisation, squares, len(candidates))
        if term is not None:
            found.append(term)

    return tuple(_by_significance(found)[:MAX_NAMED_TERMS])


def _by_significance(terms: Sequence[MissingTerm]) -> list[MissingTerm]:
    """The terms, most significant first; equally significant ones in their given order."""
    left = list(terms)
    ordered = []
    while left:
        least = (1.0 - EQUAL_SIGNIFICANCE) * max(term.sigmas for term in left)
        ordered += [term for term in left if term.sigmas >= least]
        left = [term for term in left if term.sigmas < least]
    return ordered


def _linearise(
    problem: FitProblem,
    recordings: Sequence[Recording],
    at: UnknownValues,
    candidates: Sequence[Candidate],
) -> _Linearisation | None:
    """Linearise the residuals by parameters and candidates.

    None where the experiment with the candidates is invalid, or where a simulation diverges.
    """
    names = [f"?{i}" for i in range(len(candidates))]
    extended = _extended_system(problem.system, names, candidates)
    if extended is None:
        return None

    # The parameters of the experiment have their estimated values.
    extended_names = extended.parameters.names
    places = [extended_names.index(name) for name in problem.system.parameters.names]
    theta = np.array(extended.parameters.guess)
    theta[places] = at.theta

    # The rows and initial states are those of the solution; a delay as a parameter would let the
    # segments begin earlier.
    wider = FitProblem.of(extended, recordings)
    simulation = replace(wider.simulation, segments=problem.segments)
    wider = replace(
        wider,
        simulation=simulation,
        masks=problem.masks,
        noise=problem.noise,
        difference_step=problem.difference_step,
        central=problem.central,
    )
    condensed = wider.condense(replace(at, theta=theta))
    if condensed is None:
        return None

    column_names = np.array(extended_names)[wider.layout.parameter_of_column]
    columns = [int(np.flatnonzero(column_names == name)[0]) for name in names]
    return _normal_equations(condensed, candidates, columns)


def _extended_system(
    system: System, names: Sequence[str], candidates: Sequence[Candidate]
) -> System | None:
    """The system with candidates as further parameters of given names; None where it is invalid."""
    tables = {}
    for name, candidate in zip(names, candidates, strict=True):
        tables[name] = {
            "target": candidate.path,
            "guess": candidate.linearised_at,
            "scale": candidate.size,
        }

    try:
        return System.resolve(
            system.experiment.replace(parameters=tables),
            threads=system.threads,
            source=system.source,
        )
    except ExperimentError:
        return None


def _normal_equations(
    condensed: Condensed, candidates: Sequence[Candidate], columns: list[int]
) -> _Linearisation:
    """Information and gradient with scaled columns.

    The gradient is that of the residuals with all candidates at their values in the model.
    """
    rows = np.concatenate([condensed.reduced_rows(), condensed.common_rows])
    norms = np.maximum(np.linalg.norm(rows[:, :-1], axis=0), SMALLEST_NORM)
    J = rows[:, :-1] / norms
    H = J.T @ J
    g = J.T @ rows[:, -1]

    # Sensitivities were computed at a small value of each term. Correct the gradient to the
    # residuals without the terms.
    offset = np.zeros(len(H))
    offset[columns] = [candidate.linearised_at - candidate.value for candidate in candidates]
    g = g - H @ (offset * norms)

    # The parameters are eliminated by the pseudo-inverse of their information.
    others = np.setdiff1d(np.arange(len(H)), columns)
    about_others = H[np.ix_(others, others)]
    inverse = np.linalg.pinv(about_others, rcond=INVERSE_TOLERANCE, hermitian=True)
    return _Linearisation(H=H, g=g, norms=norms, columns=columns, others=others, inverse=inverse)


def _score_test(
    candidate: Candidate, column: int, linearisation: _Linearisation, squares: float, count: int
) -> MissingTerm | None:
    """Score test of one candidate; None where it is not significant.

    Args:
        candidate: The term.
        column: Its column in the linearisation.
        linearisation: Normal equations of parameters and candidates.
        squares: Sum of squared residuals.
        count: Number of candidates.
    """
    H = linearisation.H
    g = linearisation.g

    # Information and score after the parameters are eliminated.
    others = linearisation.others
    response = linearisation.inverse @ H[others, column]
    information = H[column, column] - H[column, others] @ response
    score = g[column] - g[others] @ response

    # The term is not identifiable separately from the parameters of the experiment.
    if information <= MIN_REMAINING_SHARE * H[column, column]:
        return None

    value = -score / information / linearisation.norms[column]
    sigmas = abs(score) / np.sqrt(information)
    share = score**2 / information / squares

    # A share above 1 means that the fit is too far from its minimum for a linear test.
    is_impossible = candidate.positive and candidate.value + value < 0.0
    is_significant = sigmas > -scipy.special.ndtri(0.5 * SIGNIFICANCE / count)
    if is_impossible or not is_significant or not MIN_EXPLAINED_SHARE < share < 1.0:
        return None

    return MissingTerm(
        description=candidate.description,
        path=candidate.path,
        value=float(value),
        unit=candidate.unit,
        sigmas=float(sigmas),
        share=float(share),
    )


def _candidates(system: System) -> Iterator[Candidate]:
    """All terms that are not among the parameters of the experiment."""
    parameters = system.parameters
    targets = {
        target.path.removesuffix("[0]")
        for parameter in parameters.parameters
        for target in parameter.targets
    }

    physical = (*_joint_terms(system), *_tilts(system), *_gains(system))
    for candidate in (*physical, *_output_biases(system)):
        if candidate.path not in targets:
            yield candidate

    # The delay is negative where the controls act later than the readings are late.
    if not parameters.delay_derivative.any():
        yield Candidate(
            description="a delay between controls and outputs",
            path="output:delay",
            unit="s",
            positive=False,
            value=0.0,
            linearised_at=0.0,
            size=LINEARISATION_SIZE * _period(system),
        )


def _period(system: System) -> float:
    """Stated sample period [s]; logs of another rate are fitted with shorter samples."""
    return 1.0 / system.experiment.rate


def _joint_terms(system: System) -> Iterator[Candidate]:
    """Friction, damping, rotor inertia and stiffness of every joint with one degree of freedom."""
    model: Any = system.model
    time = _period(system) / LEAST_MOVE_PER_SAMPLE
    force = LINEARISATION_SIZE * force_sizes(model, time)
    stiffness = force / position_sizes(model)
    sizes = {
        "frictionloss": force,
        "damping": stiffness * time,
        "damping[1]": stiffness * time**2 / position_sizes(model),
        "armature": stiffness * time**2,
        "stiffness": stiffness,
    }

    for joint in scalar_joints(model):
        for field, words in JOINT_TERMS.items():
            # MuJoCo stores stiffness by joint, the other fields by degree of freedom.
            if field == "stiffness":
                value = float(model.jnt_stiffness[joint.joint])
            elif field == "damping[1]":
                value = float(model.dof_dampingpoly[joint.v, 0])
            else:
                value = float(getattr(model, f"dof_{field}")[joint.v])

            size = float(sizes[field][joint.v])
            path = f"joint/{joint.name}:{field}"
            yield Candidate(
                description=f"{words} of {joint.name}",
                path=path,
                unit=unit_of(model, path),
                positive=True,
                value=value,
                linearised_at=value or size,
                size=size,
            )


def _tilts(system: System) -> Iterator[Candidate]:
    """Components of gravity along the axes of the world that the model has none along.

    A base that is not level turns gravity in the frame of the base.
    """
    model: Any = system.model
    gravity = np.array(model.opt.gravity)
    strength = float(np.linalg.norm(gravity))
    level = np.flatnonzero(np.abs(gravity) <= MIN_GRAVITY_SHARE * strength)
    if strength == 0.0:
        return

    for axis in level.tolist():
        yield Candidate(
            description=f"a tilt of the base along {'xyz'[axis]}",
            path=f"option:gravity[{axis}]",
            unit="m/s²",
            positive=False,
            value=float(gravity[axis]),
            linearised_at=float(gravity[axis]),
            size=LINEARISATION_SIZE * strength,
        )


def _gains(system: System) -> Iterator[Candidate]:
    """Gain of every direct drive, such as a torque constant; servos have gains of their own."""
    model: Any = system.model
    fixed, without_bias = int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtBias.mjBIAS_NONE)
    for actuator in range(model.nactuator):
        name = element_name(model, "actuator", actuator)
        gain = float(model.actuator_gainprm[actuator, 0])
        is_direct = int(model.actuator_gaintype[actuator]) == fixed
        if not (name and gain and is_direct) or model.actuator_biastype[actuator] != without_bias:
            continue

        path = f"actuator/{name}:gainprm[0]"
        yield Candidate(
            description=f"another gain of {name}",
            path=path,
            unit=unit_of(model, path),
            positive=False,
            value=gain,
            linearised_at=gain,
            size=LINEARISATION_SIZE * abs(gain),
        )


def _output_biases(system: System) -> Iterator[Candidate]:
    """A constant bias of every output."""
    for output in system.outputs.outputs:
        yield Candidate(
            description=f"bias of {output.name}",
            path=f"output/{output.name}:bias",
            unit=output.unit,
            positive=False,
            value=0.0,
            linearised_at=0.0,
            size=1.0,
        )
