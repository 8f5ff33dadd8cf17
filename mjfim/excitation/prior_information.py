"""Information that earlier experiments left behind: design.json (predicted) and estimate.json (from data)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.experiment.parameters import INITIAL_STATE_PREFIX
from mjfim.information.marginal import marginal


def information_of(paths: Sequence[Path], names: Sequence[str]) -> Array:
    """(p, p) information about the named parameters, summed over files, priors of those files left out.

    What a file knows about further parameters is marginalised, under its priors on them; so are deviations of the start, which
    belong to one experiment. Raises ExperimentError naming the file.
    """
    total = np.zeros((len(names), len(names)))
    for path in paths:
        theirs, matrix, prior = _read(path)
        common = [n for n in names if n in theirs and not n.startswith(INITIAL_STATE_PREFIX)]
        if not common:
            raise ExperimentError(
                f"earlier: {path}: it knows {', '.join(theirs)}, but none of the parameters {', '.join(names)}"
            )
        mine = np.array([list(names).index(n) for n in common])
        at = np.array([theirs.index(n) for n in common])
        total[np.ix_(mine, mine)] += marginal(matrix, prior, at)
    return total


def _read(path: Path) -> tuple[list[str], Array, Array]:
    """Names, information without prior, and prior of one file."""
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        names = [str(n) for n in values["parameters"]]
        shape = (len(names), len(names))
        prior = np.array(values.get("prior", np.zeros(shape)), dtype=np.float64)
        if "data" in values:
            matrix = np.array(values["data"], dtype=np.float64)
        elif "final" in values:
            matrix = np.array(values["final"]["information"], dtype=np.float64)
        else:
            matrix = np.linalg.inv(np.array(values["covariance"], dtype=np.float64))
    except OSError as error:
        raise ExperimentError(f"earlier: {path}: cannot read: {error.strerror}") from None
    except (ValueError, KeyError, TypeError, np.linalg.LinAlgError):
        raise ExperimentError(
            f"earlier: {path}: neither a design.json nor an estimate.json of mjfim"
        ) from None
    if (
        matrix.shape != shape
        or prior.shape != shape
        or not (np.isfinite(matrix).all() and np.isfinite(prior).all())
    ):
        raise ExperimentError(
            f"earlier: {path}: its information is not {len(names)} x {len(names)} finite numbers"
        )
    return names, matrix if "data" in values else matrix - prior, prior
