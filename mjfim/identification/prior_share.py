"""Which combinations of inertias the recordings determine, and which ones the CAD prior does."""

from __future__ import annotations

import numpy as np
import scipy

from mjfim.arrays import Array, scaled_to_unit_diagonal
from mjfim.identification.cad_prior import CadPrior
from mjfim.information.marginal import marginal
from mjfim.model.parameters import ParameterSet
from mjfim.records.prior_directions import PriorDirections

# A combination is determined by the recordings where these leave at most this share of the standard
# deviation of the prior.
DETERMINED_SHARE = 0.5


def prior_directions(
    parameters: ParameterSet, theta: Array, data: Array, std: Array
) -> PriorDirections | None:
    """Compare the information of the recordings about inertias with that of their CAD prior.

    Args:
        parameters: The p parameters.
        theta: (p,) estimate [theta-unit].
        data: (p, p) information of the recordings alone about the parameters that they share.
        std: (p,) standard deviations with the priors [theta-unit].

    Returns:
        The combinations; None without a CAD prior, or where the recordings determine all of them.
    """
    is_shared = ~parameters.recording_specific
    prior = CadPrior.of(parameters).of_bodies(is_shared)
    columns = prior.columns
    if not len(columns):
        return None

    # Other parameters are estimated as well, so that their uncertainty counts.
    others = np.setdiff1d(np.flatnonzero(is_shared), columns)
    kept = np.concatenate([columns, others])
    stated = parameters.prior_information[np.ix_(kept, kept)]
    about = marginal(data[np.ix_(kept, kept)], stated, np.arange(len(columns)))

    # Eigenvalues of the information relative to the prior do not depend on the coordinates.
    known, scale = scaled_to_unit_diagonal(prior.information(theta)[np.ix_(columns, columns)])
    ratios = scipy.linalg.eigvalsh(about / np.outer(scale, scale), known)
    left = 1.0 / np.sqrt(1.0 + np.maximum(ratios, 0.0))
    determined = int((left <= DETERMINED_SHARE).sum())
    if determined == len(columns):
        return None

    prior_std = np.sqrt(np.diag(np.linalg.inv(known))) / scale
    is_prior = std[columns] > DETERMINED_SHARE * prior_std
    groups = [parameters.parameters[j].group for j in columns.tolist()]
    return PriorDirections(
        bodies=tuple(dict.fromkeys(groups)),
        count=len(columns),
        determined=determined,
        parameters=tuple(parameters.names[j] for j in columns[is_prior].tolist()),
    )
