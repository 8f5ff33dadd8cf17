"""What a model that does not fit may be missing: score tests of terms that are not among the parameters.

Each candidate (dry friction, damping, a spring, rotor inertia of a joint; bias and lag of what is measured) gets a column of
sensitivities at the estimate. With g its score and I its information once all parameters have followed, `g^2 / I` is the squared
residual that it would explain, and `-g / I` how much of it there would be. One linearisation tests all of them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.stats import norm

from mjfim.errors import ExperimentError
from mjfim.experiment.system import System
from mjfim.identification.residuals import FitProblem
from mjfim.model.coordinates import scalar_joints
from mjfim.model.units import JOINT_FIELD_UNITS
from mjfim.optimize.levenberg_marquardt import UnknownValues
from mjfim.records.estimate import MissingTerm
from mjfim.records.recording import Recording

LEVEL = 1e-3  # probability, over all candidates, from which one is named
WORTH = 2e-3  # of all squared residuals that it has to explain
FAINT = 1e-4  # size of a term at which its sensitivity is taken, where it is zero in the model
MOST = 60  # candidates
LISTED = 4


@dataclass(frozen=True)
class Candidate:
    """A term to test. positive: only positive values make sense;  now: in the model;  at: where its sensitivity is taken"""

    words: str
    path: str
    unit: str
    positive: bool
    now: float
    at: float


def find_missing_terms(
    fit: FitProblem, recordings: Sequence[Recording], pieces: np.ndarray, at: UnknownValues
) -> tuple[MissingTerm, ...]:
    """Terms that would explain significant residuals, the strongest first; none where nothing does.

    fit: of some of the pieces that the recordings are cut into
    """
    system = fit.system
    tested = list(_candidates(system, fit.measured))[:MOST]
    if not tested:
        return ()
    stated = {
        f"?{i}": {"target": c.path, "guess": c.at, "scale": FAINT} for i, c in enumerate(tested)
    }
    try:
        wider = System.resolve(
            system.experiment.replace(parameters=stated),
            threads=system.threads,
            source=system.source,
        )
    except ExperimentError:
        return ()
    own = [wider.parameters.names.index(name) for name in system.parameters.names]
    theta = np.array(wider.parameters.guess)
    theta[own] = at.theta
    other = FitProblem.of(wider, recordings).part(pieces).reweighted(fit.noise)
    found = other.condense(replace(at, theta=theta))
    if found is None:
        return ()
    J = np.concatenate([found.reduced_rows(), found.common_rows])
    unit = np.maximum(np.linalg.norm(J[:, :-1], axis=0), 1e-300)
    J[:, :-1] /= unit
    H, g = J[:, :-1].T @ J[:, :-1], J[:, :-1].T @ J[:, -1]
    moved = np.zeros(
        len(H)
    )  # to where sensitivities are taken; the residuals that count are those without it
    names = np.array(wider.parameters.names)[other.layout.places]
    columns = [int(np.flatnonzero(names == name)[0]) for name in stated]
    moved[columns] = [c.at - c.now for c in tested]
    g = g - H @ (moved * unit)
    rest = np.setdiff1d(np.arange(len(H)), columns)
    inverse = np.linalg.pinv(H[np.ix_(rest, rest)], rcond=1e-12, hermitian=True)
    total, named = 2.0 * fit.cost(at), []
    for candidate, i in zip(tested, columns, strict=True):
        cross = inverse @ H[rest, i]
        left, score = H[i, i] - H[i, rest] @ cross, g[i] - g[rest] @ cross
        if left <= 1e-8 * H[i, i]:  # hardly told from the parameters that there are
            continue
        value, sigmas, share = (
            -score / left / unit[i],
            abs(score) / np.sqrt(left),
            score**2 / left / total,
        )
        wrong = candidate.positive and candidate.now + value < 0.0
        # more than all squares: the fit is too far from its minimum for a linear answer
        if not wrong and sigmas > norm.isf(0.5 * LEVEL / len(tested)) and WORTH < share < 1.0:
            named.append(
                MissingTerm(
                    description=candidate.words,
                    path=candidate.path,
                    value=float(value),
                    unit=candidate.unit,
                    sigmas=float(sigmas),
                    share=float(share),
                )
            )
    return tuple(sorted(named, key=lambda s: -s.sigmas)[:LISTED])


def _candidates(system: System, measured: bool) -> Iterator[Candidate]:
    """Everything that the experiment does not already seek."""
    sought = {t.path.removesuffix("[0]") for p in system.parameters.parameters for t in p.targets}
    model: Any = system.model
    for c in scalar_joints(model):
        dof = c.v
        for field, words, now in (
            ("frictionloss", "dry friction", model.dof_frictionloss[dof]),
            ("damping", "viscous damping", model.dof_damping[dof]),
            ("armature", "rotor inertia", model.dof_armature[dof]),
            ("stiffness", "a spring", model.jnt_stiffness[c.joint]),
        ):
            path, unit = f"joint/{c.name}:{field}", JOINT_FIELD_UNITS[field][c.unit]
            if path not in sought:
                yield Candidate(
                    f"{words} of {c.name}", path, unit, True, float(now), float(now) or FAINT
                )
    for output in system.outputs.outputs:
        path = f"output/{output.name}:bias"
        if path not in sought:
            yield Candidate(f"bias of {output.name}", path, output.unit, False, 0.0, 0.0)
    if not measured and not system.parameters.delay_derivative.any():  # a lag would move the pieces
        yield Candidate("a lag of everything that is measured", "output:delay", "s", True, 0.0, 0.0)
