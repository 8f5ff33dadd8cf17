"""What an identification tells: the estimate, how far it may be off, and what speaks against it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from mjfim.arrays import Array, freeze
from mjfim.records.recording import Recording
from mjfim.records.trajectory import Trajectory


@dataclass(frozen=True, eq=False, kw_only=True)
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
    std_sandwich: Array = field(default_factory=lambda: np.zeros(0))
    interval: Array = field(default_factory=lambda: np.zeros((0, 2)))
    between_recordings: Array = field(default_factory=lambda: np.zeros(0))
    sigma: dict[str, float] = field(default_factory=dict)
    reasons: tuple[str, ...] = ()
    whiteness: tuple[Whiteness, ...] = ()
    worst_residual: WorstResidual | None = None
    predictions: tuple[Prediction, ...] = ()
    sloppy: tuple[str, ...] = ()
    missing_terms: tuple[MissingTerm, ...] = ()
    per_recording: dict[str, tuple[float, ...]] = field(default_factory=dict)
    robust_uncertainty: Uncertainty | None = None
    motion: Trajectory | None = None
    interrupted: bool = False
    seconds: float = 0.0
    steps: int = 0

    def __post_init__(self) -> None:
        count = len(self.parameters)
        if len(self.interval) != count:  # none but the formal ones
            theta, half = np.asarray(self.theta), 1.96 * np.asarray(self.std)
            object.__setattr__(self, "interval", np.column_stack([theta - half, theta + half]))
        for name, own in (("std_sandwich", self.std), ("between_recordings", np.zeros(count))):
            if len(getattr(self, name)) != count:
                object.__setattr__(self, name, own)
        names = (
            "theta",
            "std",
            "covariance",
            "initial_theta",
            "data",
            "std_sandwich",
            "interval",
            "between_recordings",
        )
        freeze(self, *names)


@dataclass(frozen=True, kw_only=True)
class WorstResidual:
    """Where residuals are worst. begin, end: [s];  size: their root mean square in sigmas;  share: of all squares"""

    output: str
    recording: str
    begin: float
    end: float
    size: float
    share: float

    def __str__(self) -> str:
        when = f"{self.begin:.3g} to {self.end:.3g} s of {self.recording}"
        return f"worst in {self.output}, {when}: {self.size:.2g} sigmas, {100 * self.share:.0f} % of all squares"


@dataclass(frozen=True, eq=False, kw_only=True)
class PredictionErrors:
    """How far a model is from a recording. name: of it;  rms, mae: (ny,) root mean square and mean absolute errors

    NaN where nothing was measured or the model diverged.
    """

    name: str
    outputs: tuple[str, ...]
    rms: Array
    mae: Array

    def __post_init__(self) -> None:
        freeze(self, "rms", "mae")


@dataclass(frozen=True, eq=False, kw_only=True)
class Prediction:
    """How well something that was not fitted is predicted, by the identified and by the nominal model.

    held_out: stated as held out, not a part of the fitted data
    """

    name: str
    identified: PredictionErrors
    nominal: PredictionErrors
    held_out: bool

    @property
    def ratio(self) -> float:
        """Geometric mean over outputs of identified over nominal root mean square error."""
        own, plain = self.identified.rms, self.nominal.rms
        both = np.isfinite(own) & np.isfinite(plain) & (plain > 0.0) & (own > 0.0)
        return (
            float(np.exp(np.mean(np.log(own[both] / plain[both])))) if both.any() else float("nan")
        )


@dataclass(frozen=True, kw_only=True)
class MissingTerm:
    """A term that would explain residuals. path: a parameter's target;  value: about how much of it there would be [unit]

    sigmas: its value over its standard deviation;  share: of all squared residuals that it explains
    """

    description: str
    path: str
    value: float
    unit: str
    sigmas: float
    share: float

    def __str__(self) -> str:
        amount = f"{self.value:.2g} {self.unit}".strip()
        told = f"about {amount} ({self.sigmas:.0f} σ, {100 * self.share:.2g} % of all squares)"
        return f'{self.description}, {told}; to find it out: target = "{self.path}"'


@dataclass(frozen=True, eq=False, kw_only=True)
class Uncertainty:
    """Of the c common unknowns.

    sandwich: (c,) standard deviations;  interval: (c, 2) 95 %, the hull of formal, sandwich and bootstrap intervals
    between: (c,) standard deviation from recording to recording beyond what the data of each explain
    apart: indices of unknowns on which recordings disagree;  each: (K, c) what every recording alone says, NaN where little
    blocks: number;  draws: (n, c) of the bootstrap
    """

    sandwich: Array
    interval: Array
    between: Array
    apart: tuple[int, ...]
    each: Array
    blocks: int
    draws: Array


@dataclass(frozen=True, kw_only=True)
class Whiteness:
    """Of one output's whitened residuals. count: of them;  variance: their mean square;  correlation: of one with the next

    p: probability that white noise looks so, corrected for the number of looks;  inflation: largest variance of the mean of a
    run over that of white noise;  time: rows over which residuals hang together (integrated autocorrelation)
    """

    output: str
    count: int
    variance: float
    correlation: float
    p: float
    inflation: float
    time: float
