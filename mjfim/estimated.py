"""What an identification tells: the estimate, how far it may be off, and what speaks against it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mjfim.misfit import Place
from mjfim.prediction import Prediction
from mjfim.suspects import Suspect
from mjfim.trajectory import Array, Recording, Trajectory, freeze
from mjfim.uncertainty import Uncertainty
from mjfim.whiteness import Whiteness


@dataclass(frozen=True, eq=False)
class Estimate:
    """Parameters from recordings.

    theta, std: (p,);  covariance: (p, p) formal (Cramer-Rao at the estimate)
    sandwich: (p,) standard deviations that allow for residuals which follow one another
    interval: (p, 2) 95 %, the hull of formal, sandwich, bootstrap and what recordings disagree by
    between: (p,) standard deviation from recording to recording beyond their own scatter
    chi2: whitened squared residual sum; of a robust loss, of those that are no outliers, over what noise has there
    dof: its degrees of freedom;  residual_rms, sigma: per output, in its unit; sigma is the noise that was stated or estimated
    misfit: residuals are no noise of the stated size: the formal std is then not accuracy;  reasons: why, in sentences
    predicted: per recording, (M, ny);  initial_theta: the start
    combinations: groups of parameters that the recordings tell in combination only, in words
    data: (p, p) information of the recordings, priors left out, private nuisance marginalised
    each: of parameters that every recording has its own of, the values in turn; theta has the first
    sloppy: names of wanted parameters whose interval is wide for their value
    suspects: terms missing in the model that would explain the residuals
    whiteness: of the residuals of each output;  worst: where they are largest
    predictions: of what was not fitted, against the nominal model;  motion: of the first recording as fitted, or None
    """

    parameters: tuple[str, ...]
    theta: Array
    std: Array
    covariance: Array
    initial_theta: Array
    chi2: float
    dof: int
    status: str
    success: bool
    misfit: bool
    iterations: int
    residual_rms: dict[str, float]
    at_bound: tuple[str, ...]
    predicted: tuple[Array, ...]
    recordings: tuple[Recording, ...]
    warnings: tuple[str, ...] = ()
    combinations: tuple[str, ...] = ()
    data: Array = field(default_factory=lambda: np.zeros((0, 0)))
    sandwich: Array = field(default_factory=lambda: np.zeros(0))
    interval: Array = field(default_factory=lambda: np.zeros((0, 2)))
    between: Array = field(default_factory=lambda: np.zeros(0))
    sigma: dict[str, float] = field(default_factory=dict)
    reasons: tuple[str, ...] = ()
    whiteness: tuple[Whiteness, ...] = ()
    worst: Place | None = None
    predictions: tuple[Prediction, ...] = ()
    sloppy: tuple[str, ...] = ()
    suspects: tuple[Suspect, ...] = ()
    each: dict[str, tuple[float, ...]] = field(default_factory=dict)
    detail: Uncertainty | None = None
    motion: Trajectory | None = None
    interrupted: bool = False
    seconds: float = 0.0
    steps: int = 0

    def __post_init__(self) -> None:
        count = len(self.parameters)
        if len(self.interval) != count:  # none but the formal ones
            theta, half = np.asarray(self.theta), 1.96 * np.asarray(self.std)
            object.__setattr__(self, "interval", np.column_stack([theta - half, theta + half]))
        for name, own in (("sandwich", self.std), ("between", np.zeros(count))):
            if len(getattr(self, name)) != count:
                object.__setattr__(self, name, own)
        names = ("theta", "std", "covariance", "initial_theta", "data", "sandwich", "interval", "between")
        freeze(self, *names)
