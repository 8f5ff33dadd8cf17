"""Which combinations of inertias the recordings determine, and which ones the CAD prior does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from mjfim.arrays import Array, scaled_to_unit_diagonal
from mjfim.identification.cad_prior import CadPrior
from mjfim.information.marginal import marginal
from mjfim.model.parameters import ParameterSet
from mjfim.records.estimate import PriorDirections

# A combination is determined by the recordings where these leave at most this share of the standard
# deviation of the prior.
DETERMINED_SHARE = 0.5


@dataclass(frozen=True, kw_only=True, eq=False)
class InertiaCombinations:
    """Combinations of the k inertial coordinates with a CAD prior, by how well they are determined.

    Attributes:
        columns: (k,) indices in theta of the coordinates.
        left: (k,) share of the standard deviation of the prior that the recordings leave.
        axes: (k, k) directions of the coordinates, one in each column, in which recordings and
            prior are uncorrelated and the prior has the standard deviation 1 [theta-unit].
        prior_std: (k,) standard deviations of the prior [theta-unit].
    """

    columns: np.ndarray
    left: Array
    axes: Array
    prior_std: Array

    @staticmethod
    def of(parameters: ParameterSet, theta: Array, data: Array) -> InertiaCombinations | None:
        """Compare the information of the recordings about inertias with that of their CAD prior.

        Args:
            parameters: The p parameters.
            theta: (p,) estimate [theta-unit].
            data: (p, p) information of the recordings alone about the parameters that they share.

        Returns:
            The combinations; None without a CAD prior.
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
        information = prior.information(theta)[np.ix_(columns, columns)]
        known, scale = scaled_to_unit_diagonal(information)
        ratios, vectors = scipy.linalg.eigh(about / np.outer(scale, scale), known)
        return InertiaCombinations(
            columns=columns,
            left=1.0 / np.sqrt(1.0 + np.maximum(ratios, 0.0)),
            axes=vectors / scale[:, None],
            prior_std=np.sqrt(np.diag(np.linalg.inv(known))) / scale,
        )

    @property
    def is_determined(self) -> np.ndarray:
        """(k,) True for the combinations that the recordings determine."""
        return np.asarray(self.left <= DETERMINED_SHARE)

    @property
    def undetermined(self) -> Array:
        """(m, k) weights of the coordinates in the combinations that the prior determines."""
        return np.asarray(np.linalg.inv(self.axes)[~self.is_determined])


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
    found = InertiaCombinations.of(parameters, theta, data)
    if found is None or found.is_determined.all():
        return None

    columns = found.columns
    is_prior = std[columns] > DETERMINED_SHARE * found.prior_std
    groups = [parameters.parameters[j].group for j in columns.tolist()]
    return PriorDirections(
        bodies=tuple(dict.fromkeys(groups)),
        count=len(columns),
        determined=int(found.is_determined.sum()),
        parameters=tuple(parameters.names[j] for j in columns[is_prior].tolist()),
    )
