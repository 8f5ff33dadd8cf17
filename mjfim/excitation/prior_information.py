"""Information of earlier experiments about the parameters, from files of designs and estimates."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, RecordingError, listed
from mjfim.experiment.parameters import INITIAL_STATE_PREFIX
from mjfim.information.marginal import marginal
from mjfim.records.saved_information import SavedInformation


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
            saved = SavedInformation.load(path)
        except RecordingError as error:
            raise ExperimentError(f"earlier: {error}") from None

        # Deviations of the initial state have equal names in all experiments, but different values.
        common = [
            name
            for name in names
            if name in saved.parameters and not name.startswith(INITIAL_STATE_PREFIX)
        ]
        if not common:
            raise ExperimentError(
                f"earlier: {path}: it has information about {listed(saved.parameters)}, but not "
                f"about any of the parameters {listed(names)}"
            )

        here = [list(names).index(name) for name in common]
        there = np.array([saved.parameters.index(name) for name in common])
        total[np.ix_(here, here)] += marginal(saved.data, saved.prior, there)
    return total
