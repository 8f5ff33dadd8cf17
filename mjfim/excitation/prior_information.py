"""Prior information of a design: what earlier experiments tell about the parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field
from pathlib import Path

import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError, RecordingError, listed
from mjfim.experiment.parameters import INITIAL_STATE_PREFIX
from mjfim.files import read_json
from mjfim.information.criteria import GROUPS, marginal, without_chance


@record
class EarlierExperiments:
    """What other experiments tell about p parameters, and how well.

    Attributes:
        information: (p, p) information without priors [1 / (theta_i theta_j unit)].
        inflation: (p,) factors on standard deviations, at least 1; empty without an estimate.
        sigma: Noise for which the inflation holds, by output [output unit].
    """

    information: Array
    inflation: Array = field(default_factory=lambda: np.zeros(0))
    sigma: dict[str, float] = field(default_factory=dict)

    def plus(self, other: EarlierExperiments) -> EarlierExperiments:
        """Both together; the inflation is that of the latter, if it has one."""
        return EarlierExperiments(
            information=self.information + other.information,
            inflation=other.inflation if len(other.inflation) else self.inflation,
            sigma=self.sigma | other.sigma,
        )


def known_from(paths: Sequence[Path], names: Sequence[str]) -> EarlierExperiments:
    """What earlier experiments tell about the named parameters, and how well.

    The information is their sum, without their priors. Further parameters of a file are
    marginalised, with the priors that the file states for them. So are deviations of the initial
    state, which are parameters of one experiment only.

    The inflation is the honest standard deviation of an estimate over its formal one, which white
    noise would leave: residuals of the same model are expected to widen the next estimate as much.
    One recording shows no scatter between recordings, which then counts as much as that within it.
    Of several estimates the inflation is the root mean square. As it comes from few groups of data,
    the part of the differences between parameters that chance explains is left out. A parameter of
    which none is known has the geometric mean of the others.

    Args:
        paths: Files design.json and estimate.json.
        names: Names of the p parameters.

    Raises:
        ExperimentError: A file cannot be used; the message names it.
    """
    total = np.zeros((len(names), len(names)))
    estimates: list[tuple[Array, int]] = []
    sigma: dict[str, float] = {}
    for path in paths:
        try:
            known, data, prior, ratio, count, noise = _information_in(path)
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
        if ratio is not None:
            inflation = np.full(len(names), np.nan)
            inflation[here] = ratio[there]
            estimates.append((inflation, count))
        sigma |= noise
    inflation = expected_inflation(estimates)
    return EarlierExperiments(information=total, inflation=inflation, sigma=sigma)


def expected_inflation(estimates: Sequence[tuple[Array, int]]) -> Array:
    """(p,) inflations that are expected after those of estimates, as `known_from` returns them.

    Args:
        estimates: (p,) honest over formal standard deviations of each estimate, NaN where they are
            not known, and the number of its recordings.
    """
    known = np.array([ratio for ratio, _ in estimates])
    known[~np.isfinite(known) | (known <= 0.0)] = np.nan
    if not np.isfinite(known).any():
        return np.zeros(0)
    # Scatter within a recording, and between recordings.
    parts = np.array([[2.0 if count == 1 else 1.0] for _, count in estimates])
    squares = 1.0 + parts * (np.maximum(known, 1.0) ** 2 - 1.0)
    is_known = np.isfinite(squares).any(axis=0)
    found = without_chance(np.sqrt(np.nanmean(squares[:, is_known], axis=0)), GROUPS - 1)
    inflation = np.full(len(is_known), np.exp(np.log(found).mean()))
    inflation[is_known] = found
    return inflation


def _information_in(
    path: Path,
) -> tuple[list[str], Array, Array, Array | None, int, dict[str, float]]:
    """Names of the p parameters of a design or an estimate, information and prior: (p, p).

    Of an estimate there are (p,) honest over formal standard deviations as well, the number of its
    recordings, and the noise of its outputs.

    Raises:
        RecordingError: The file has another content, or numbers that are not finite.
    """
    values = read_json(path)
    try:
        names = [str(name) for name in values["parameters"]]
        data, prior = (np.array(values[key], dtype=np.float64) for key in ("data", "prior"))
        ratio, noise = None, {}
        count = len(values.get("recordings", ()))
        if "honest_std" in values:
            honest, formal = (np.array(values[k], dtype=np.float64) for k in ("honest_std", "std"))
            covariance = np.array(values.get("honest_covariance", ()), dtype=np.float64)
            if covariance.shape == (len(honest), len(honest)):
                # A bound may cut intervals off, but not this covariance.
                honest = np.sqrt(np.maximum(np.diag(covariance), 0.0))
            ratio = honest / np.where(formal > 0.0, formal, np.nan)
            noise = {str(name): float(s) for name, s in values.get("sigma", {}).items()}
    except (ValueError, KeyError, TypeError, AttributeError):
        raise RecordingError(f"{path}: neither a design.json nor an estimate.json") from None

    for matrix in (data, prior):
        if matrix.shape != (len(names), len(names)) or not np.isfinite(matrix).all():
            raise RecordingError(
                f"{path}: its information is not {len(names)} x {len(names)} finite numbers"
            )
    if ratio is not None and ratio.shape != (len(names),):
        raise RecordingError(f"{path}: its honest_std and std are not {len(names)} numbers each")
    return names, data, prior, ratio, count, noise
