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
from mjfim.information.criteria import marginal


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
    Of several estimates it is the root mean square. As it comes from few groups of data, the part
    of the differences between parameters that chance explains is left out. A parameter of which
    none is known has the geometric mean of the others.

    Args:
        paths: Files design.json and estimate.json.
        names: Names of the p parameters.

    Raises:
        ExperimentError: A file cannot be used; the message names it.
    """
    total = np.zeros((len(names), len(names)))
    ratios: list[Array] = []
    sigma: dict[str, float] = {}
    for path in paths:
        try:
            known, data, prior, ratio, noise = _information_in(path)
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
            ratios.append(np.full(len(names), np.nan))
            ratios[-1][here] = ratio[there]
        sigma |= noise
    return EarlierExperiments(information=total, inflation=expected_inflation(ratios), sigma=sigma)


# Variance of the logarithm of a standard deviation with three degrees of freedom: honest ones come
# from the scatter between four groups of data.
VARIANCE_OF_LOG = 0.234


def expected_inflation(ratios: Sequence[Array]) -> Array:
    """(p,) inflations that are expected after those of estimates, as `known_from` returns them.

    Args:
        ratios: (p,) inflation of each estimate; NaN where it is not known.
    """
    known = np.array(ratios)
    known[~np.isfinite(known) | (known <= 0.0)] = np.nan
    if not np.isfinite(known).any():
        return np.zeros(0)
    squares = np.maximum(known, 1.0) ** 2
    is_known = np.isfinite(squares).any(axis=0)
    logs = 0.5 * np.log(np.nanmean(squares[:, is_known], axis=0))
    # What chance explains of their differences is shrunk (James & Stein).
    usual, spread = float(logs.mean()), float(logs.var())
    found = np.full(len(is_known), usual)
    if spread > VARIANCE_OF_LOG:
        found[is_known] += (1.0 - VARIANCE_OF_LOG / spread) * (logs - usual)
    return np.asarray(np.exp(found))


def _information_in(
    path: Path,
) -> tuple[list[str], Array, Array, Array | None, dict[str, float]]:
    """Names of the p parameters of a design or an estimate, information and prior: (p, p).

    Of an estimate there are (p,) honest over formal standard deviations as well, and the noise of
    its outputs.

    Raises:
        RecordingError: The file has another content, or numbers that are not finite.
    """
    values = read_json(path)
    try:
        names = [str(name) for name in values["parameters"]]
        data, prior = (np.array(values[key], dtype=np.float64) for key in ("data", "prior"))
        ratio, noise = None, {}
        if "honest_std" in values:
            honest, formal = (np.array(values[k], dtype=np.float64) for k in ("honest_std", "std"))
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
    return names, data, prior, ratio, noise
