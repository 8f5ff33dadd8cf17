"""Information of earlier experiments about the parameters, from files of designs and estimates."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, RecordingError, listed
from mjfim.experiment.parameters import INITIAL_STATE_PREFIX
from mjfim.files import read_json
from mjfim.information.marginal import marginal


def information_of(paths: Sequence[Path], names: Sequence[str]) -> Array:
    """Sum the information of earlier experiments about the named parameters, without their priors.

    Further parameters of a file are marginalised, with the priors that the file states for them.
    So are deviations of the initial state, which are parameters of one experiment only.

    Args:
        paths: Files design.json and estimate.json.
        names: Names of the p parameters.

    Returns:
        (p, p) information [1 / (unit of theta_i times unit of theta_j)].

    Raises:
        ExperimentError: A file cannot be used; the message names it.
    """
    total = np.zeros((len(names), len(names)))
    for path in paths:
        try:
            known, data, prior = _information_in(path)
        except RecordingError as error:
            raise ExperimentError(f"earlier: {error}") from None

        # Deviations of the initial state have equal names in all experiments, but different values.
        common = [
            name for name in names if name in known and not name.startswith(INITIAL_STATE_PREFIX)
        ]
        if not common:
            raise ExperimentError(
                f"earlier: {path}: it has information about {listed(known)}, but not "
                f"about any of the parameters {listed(names)}"
            )

        here = [list(names).index(name) for name in common]
        there = np.array([known.index(name) for name in common])
        total[np.ix_(here, here)] += marginal(data, prior, there)
    return total


def _information_in(path: Path) -> tuple[list[str], Array, Array]:
    """Names of the p parameters of a design or an estimate, information and prior: (p, p).

    Raises:
        RecordingError: The file has another content, or numbers that are not finite.
    """
    values = read_json(path)
    try:
        names = [str(name) for name in values["parameters"]]
        data, prior = (np.array(values[key], dtype=np.float64) for key in ("data", "prior"))
    except (ValueError, KeyError, TypeError):
        raise RecordingError(f"{path}: neither a design.json nor an estimate.json") from None

    for matrix in (data, prior):
        if matrix.shape != (len(names), len(names)) or not np.isfinite(matrix).all():
            raise RecordingError(
                f"{path}: its information is not {len(names)} x {len(names)} finite numbers"
            )
    return names, data, prior
