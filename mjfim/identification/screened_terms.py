"""Screening of terms that change the coordinates of a model: elastic joints and backlash.

Such a term has no effect in a limit that no simulation reaches, so that a score test at zero effect
does not exist. The term is simulated with a few of its values at the solution of the stated model,
all of whose parameters and initial states are kept. The reduction of the cost by the best value is
a lower bound of what a fit would give. Its root is a size and not the probability of a test: the
best of several values has no chi-squared distribution.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mjfim.experiment.system import System
from mjfim.identification.candidates import (
    added_term,
    has_term,
    stated_joints,
    targeted_paths,
)
from mjfim.identification.extended_problems import extended_problem, extended_system
from mjfim.identification.fit_problem import FitProblem
from mjfim.model.coordinates import ScalarJoint
from mjfim.model.elements import element_name
from mjfim.model.terms.library import KINDS
from mjfim.optimize.levenberg_marquardt import UnknownValues
from mjfim.records.terms import AddedTerm, MissingTerm, TermParameter
from mjfim.records.trajectory import Recording

# Name of the parameter in an extended model, which no experiment has.
NAME = "?"

# Factors between successive values, and the largest number of them.
VALUE_FACTOR = 3.0
MAX_VALUES = 6

# Smallest reduction of the sum of squared residuals that counts, in squares of standard deviations.
# It does not depend on the number of joints: with white residuals, chance exceeds it with less than
# 1e-3 for all values of both terms at up to 140 joints.
MIN_REDUCTION = 25.0


@dataclass(frozen=True, kw_only=True)
class _Screening:
    """A term with the field whose values are tried.

    Attributes:
        kind: Kind of the term.
        field: The field.
        words: The term in words, before the name of the joint.
        further: Other fields that a fit estimates as well.
    """

    kind: str
    field: str
    words: str
    further: tuple[str, ...]


SCREENINGS = (
    _Screening(
        kind="joint_elasticity",
        field="compliance",
        words="elasticity of",
        further=("damping",),
    ),
    _Screening(kind="backlash", field="gap", words="backlash of", further=()),
)


def screened_terms(
    problem: FitProblem, recordings: Sequence[Recording], at: UnknownValues, squares: float
) -> list[MissingTerm]:
    """Terms of driven joints with which the stated solution fits the recordings better.

    Args:
        problem: The least-squares problem of some segments.
        recordings: All recordings.
        at: Its solution.
        squares: Sum of squared residuals there.
    """
    found = []
    for joint in _driven_joints(problem.system):
        for screening in SCREENINGS:
            term = _screened(problem, recordings, at, squares, joint, screening)
            if term is not None:
                found.append(term)
    return found


def _driven_joints(system: System) -> Iterator[ScalarJoint]:
    """Joints with a name and a rotor at which an actuator with a control acts.

    Without the inertia of a rotor in the model, an elastic joint would add one.
    """
    model: Any = system.model
    targets = targeted_paths(system)
    joints = {
        int(model.actuator_trnid[actuator, 0])
        for actuator in range(model.nactuator)
        if int(model.actuator_trntype[actuator]) == 0 and model.actuator_ctrlnum[actuator]
    }
    for joint in stated_joints(system):
        has_rotor = model.dof_armature[joint.v] > 0.0
        has_rotor = has_rotor or f"joint/{joint.name}:armature" in targets
        has_name = element_name(model, "joint", joint.joint)
        if joint.joint in joints and has_rotor and has_name:
            yield joint


def _screened(
    problem: FitProblem,
    recordings: Sequence[Recording],
    at: UnknownValues,
    squares: float,
    joint: ScalarJoint,
    screening: _Screening,
) -> MissingTerm | None:
    """A term of one joint with its best value; None where no value is better than none."""
    system = problem.system
    if any(has_term(system, each.kind, joint.name) for each in SCREENINGS):
        return None

    added = added_term(system, screening.kind, joint.name)
    path = f"term/{added.name}:{screening.field}"
    extended = extended_system(system, {NAME: {"target": path}}, {added.name: added.table})
    if extended is None:
        return None
    wider, begin = extended_problem(problem, recordings, at, extended, differentiated_by=())

    quantity = extended.source.terms[added.name].quantity(screening.field)
    first = (
        quantity.value
        if quantity.value > 0.0
        else quantity.size / VALUE_FACTOR ** (MAX_VALUES // 2)
    )
    best, least = 0.0, squares
    for k in range(MAX_VALUES):
        value = first * VALUE_FACTOR**k
        cost = 2.0 * wider.cost(_with_value(wider, begin, value))
        if cost < least:
            best, least = value, cost
        elif best > 0.0:
            break

    reduction = squares - least
    if not best or reduction < MIN_REDUCTION:
        return None
    return MissingTerm(
        description=f"{screening.words} {joint.name}",
        path=path,
        value=best,
        unit=quantity.unit,
        sigmas=float(np.sqrt(reduction)),
        share=reduction / squares,
        further=tuple(_further(extended, added, field) for field in screening.further),
        added=added,
        source=KINDS[screening.kind].sources[0],
    )


def _with_value(problem: FitProblem, at: UnknownValues, value: float) -> UnknownValues:
    """The unknowns with another value of the term."""
    theta = np.array(at.theta)
    theta[problem.system.parameters.names.index(NAME)] = value
    return replace(at, theta=theta)


def _further(system: System, added: AddedTerm, field: str) -> TermParameter:
    """A further parameter of a term, which begins at its value in the model."""
    quantity = system.source.terms[added.name].quantity(field)
    return TermParameter(
        path=f"term/{added.name}:{field}",
        value=quantity.value,
        unit=quantity.unit,
        scale=quantity.size,
    )
