"""Information that earlier experiments left behind: design.json (predicted) and estimate.json (from data)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from mjfim.errors import ExperimentError
from mjfim.trajectory import Array

START = "initial "  # how names of the nuisance table's deviations of the start begin


def information_of(paths: Sequence[Path], names: Sequence[str]) -> Array:
    """(p, p) information about the named parameters, summed over files, priors of those files left out.

    What a file knows about further parameters is marginalised, under its priors on them; so are deviations of the start, which
    belong to one experiment. Raises ExperimentError naming the file.
    """
    total = np.zeros((len(names), len(names)))
    for path in paths:
        theirs, matrix, prior = _read(path)
        common = [n for n in names if n in theirs and not n.startswith(START)]
        if not common:
            raise ExperimentError(
                f"earlier: {path}: it knows {', '.join(theirs)}, but none of the parameters {', '.join(names)}"
            )
        mine = np.array([list(names).index(n) for n in common])
        at = np.array([theirs.index(n) for n in common])
        total[np.ix_(mine, mine)] += marginal(matrix, prior, at)
    return total


def marginal(information: Array, prior: Array, kept: np.ndarray) -> Array:
    """(k, k) information about the kept parameters once the others, known by their prior, are estimated as well."""
    rest = np.setdiff1d(np.arange(len(information)), kept)
    own = information[np.ix_(kept, kept)]
    if len(rest):
        cross, known = information[np.ix_(kept, rest)], (information + prior)[np.ix_(rest, rest)]
        own = own - cross @ np.linalg.pinv(known, rcond=1e-13, hermitian=True) @ cross.T
    return np.asarray(own)


def shared(information: Array, prior: Array, private: np.ndarray) -> Array:
    """(p, p) information about what several experiments have in common: private: (p,) parameters are marginalised.

    prior: (p, p), what is known of the private ones
    """
    if not private.any():
        return information
    kept = np.flatnonzero(~private)
    out = np.zeros_like(information)
    out[np.ix_(kept, kept)] = marginal(information, prior, kept)
    return out


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
        raise ExperimentError(f"earlier: {path}: neither a design.json nor an estimate.json of mjfim") from None
    if matrix.shape != shape or prior.shape != shape or not (np.isfinite(matrix).all() and np.isfinite(prior).all()):
        raise ExperimentError(f"earlier: {path}: its information is not {len(names)} x {len(names)} finite numbers")
    return names, matrix if "data" in values else matrix - prior, prior
