"""Record of the Fisher information in the JSON file of a design or of an estimate."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjfim.arrays import Array, freeze
from mjfim.errors import RecordingError


@dataclass(frozen=True, eq=False, kw_only=True)
class SavedInformation:
    """Fisher information about named parameters, read from a design.json or an estimate.json.

    That of a design is predicted, that of an estimate comes from data. The npz file is not needed,
    so a JSON file may be moved without it.

    Attributes:
        parameters: Names of the p parameters.
        data: (p, p) information without priors [1 / (unit of theta_i times unit of theta_j)].
        prior: (p, p) information of the file's priors.
    """

    parameters: tuple[str, ...]
    data: Array
    prior: Array

    def __post_init__(self) -> None:
        freeze(self, "data", "prior")

    @classmethod
    def load(cls, path: str | Path) -> SavedInformation:
        """Read the information of a design.json or of an estimate.json.

        Args:
            path: The file.

        Returns:
            Its information.

        Raises:
            RecordingError: The file cannot be read, has another content, or its matrices have a
                wrong shape or numbers that are not finite.
        """
        path = Path(path)
        try:
            content = path.read_bytes()
        except OSError as error:
            raise RecordingError(f"{path}: cannot read: {error.strerror}") from None

        try:
            values = json.loads(content)
            names = tuple(str(name) for name in values["parameters"])
            prior = np.array(values.get("prior", np.zeros((len(names),) * 2)), dtype=np.float64)
            information, prior_included = _information(values)
        except (ValueError, KeyError, TypeError, np.linalg.LinAlgError):
            raise RecordingError(
                f"{path}: neither a design.json nor an estimate.json of mjfim"
            ) from None

        for matrix in (information, prior):
            if matrix.shape != (len(names), len(names)) or not np.isfinite(matrix).all():
                raise RecordingError(
                    f"{path}: its information is not {len(names)} x {len(names)} finite numbers"
                )

        data = information - prior if prior_included else information
        return cls(parameters=names, data=data, prior=prior)


def _information(values: dict[str, Any]) -> tuple[Array, bool]:
    """Return the information matrix of a file, and whether it includes the file's prior."""
    if "data" in values:
        return np.array(values["data"], dtype=np.float64), False

    # Files without `data` hold the information of the design, or the covariance of the estimate,
    # both with priors.
    if "final" in values:
        return np.array(values["final"]["information"], dtype=np.float64), True
    return np.linalg.inv(np.array(values["covariance"], dtype=np.float64)), True
