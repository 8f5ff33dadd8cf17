"""Records of an identification: the estimate, its uncertainty, and tests of the fit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from mjfim.arrays import Array, freeze
from mjfim.records.combinations import join_names
from mjfim.records.control_law import ControlLawInLoop
from mjfim.records.horizons import HorizonStudy
from mjfim.records.intervals import NORMAL_95
from mjfim.records.inverse_dynamics import InverseDynamicsFit
from mjfim.records.labels import Labels
from mjfim.records.missing_term import MissingTerm, TermTestData
from mjfim.records.parameter_draws import ParameterDraws
from mjfim.records.payload import PayloadEstimate
from mjfim.records.prior_directions import PriorDirections
from mjfim.records.recording import Recording
from mjfim.records.recording_comparison import RecordingComparison
from mjfim.records.selection import Selection
from mjfim.records.serialization import SavedRecord
from mjfim.records.shown import ShownRecord
from mjfim.records.trajectory import Trajectory

# Number of rows of all recordings above which an estimate does not hold the outputs of the model at
# the initial guess.
MAX_NOMINAL_ROWS = 1_000_000


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Estimate(ShownRecord):
    """Result of `mjfim.identify`: parameters estimated from recordings.

    Attributes:
        parameters: Names of the p parameters.
        theta: (p,) estimate [theta-unit].
        std: (p,) formal standard deviations: Cramér-Rao at the estimate [theta-unit].
        covariance: (p, p) formal covariance.
        initial_theta: (p,) initial guess [theta-unit].
        chi2: Sum of squared whitened residuals. With a robust loss, outliers are left out, and the
            sum is scaled so that its expected value for pure noise stays `dof`.
        dof: Degrees of freedom of `chi2`.
        status: How the fit ended, in words.
        success: True if the fit converged and all parameters are determined inside their bounds.
        misfit: True if the residuals are not noise of the stated size; the formal `std` is then
            too small.
        iterations: Number of iterations.
        residual_rms: Root mean square residual of each output [unit of the output].
        at_bound: Names of the parameters that ended at a bound.
        predicted: Outputs of the fitted model for each recording, (M, ny) [unit of the output].
        recordings: The fitted recordings.
        warnings: Sentences for the user.
        combinations: Groups of parameters that the recordings determine in combination only, in
            words.
        data: (p, p) information of the recordings without priors, in which nuisance parameters
            that belong to a single recording are marginalised.
        std_sandwich: (p,) standard deviations that allow for autocorrelated residuals [theta-unit].
        interval: (p, 2) 95 % interval, which covers the formal, sandwich and bootstrap intervals
            and the disagreement between recordings [theta-unit].
        between_recordings: (p,) standard deviation between recordings that their standard
            deviations do not explain [theta-unit].
        sigma: Noise of each output, stated or estimated [unit of the output].
        reasons: Reasons for `misfit`, in sentences.
        whiteness: Tests of the residuals of each output.
        worst_residual: Interval in which the residuals are largest; None if the fit is good.
        predictions: Prediction errors on data that were not fitted.
        sloppy: Names of the parameters whose interval is wide compared with their size.
        missing_terms: Terms missing in the model that would explain the residuals.
        tested_data: The data on which such terms were tested; None where none were, because of a
            poor fit or a request to stop, and in records of earlier versions.
        per_recording: Values for each recording of the parameters that differ between recordings;
            `theta` holds their values for the first recording.
        robust_uncertainty: Robust uncertainty of the common unknowns, or None.
        motion: Motion of the fitted model for the first recording, at most its first 200 000
            samples; None where it diverges.
        interrupted: True if the user interrupted the fit.
        seconds: Wall time [s].
        steps: MuJoCo steps taken.
        units: Unit of each parameter.
        prior: (p, p) information of the parameters' priors, at the estimate.
        labels: Names and units for figures and tables; None in records of earlier versions.
        restart: How the fit was repeated from fits over segments; None where it was not.
        trace: (n, p) the initial guess, and the parameters at the begin and at each iteration of
            the search over all data [theta-unit]; empty in records of earlier versions.
        nominal: Outputs of the model at the initial guess, with the fitted initial states, for each
            recording, (M, ny) [unit of the output]; empty where it diverges, and for recordings of
            more than 1 000 000 rows together.
        segments: Times at which the segments of each recording begin [s].
        sizes: (p,) sizes of which relative numbers are a share: magnitudes of the values, or of the
            whole vector or tensor of an entry [theta-unit].
        selection: How the model was extended by terms that it lacked; None where that was not
            asked for.
        controllers: Control laws in the loop with which the recordings were simulated; none where
            they hold the controls themselves.
        held: Names of the parameters that kept their guess, whose standard deviation is 0.
        horizons: Lengths of segments that were compared, because the model does not explain whole
            recordings; None where they were not.
        inverse_dynamics: The fit to the equation of motion from which the search started; None
            where there was none.
        draws: Robots that were drawn from the uncertainty, for simulations that vary the robot;
            None where that was not asked for.
        recording_comparison: What each recording suggests alone, the scatter between recordings,
            and which one is odd; None for a single recording.
        prior_directions: Combinations of inertias that the recordings do not determine, but the
            inertias of the model (`cad_prior`); None without any.
        payload: The payload that was looked for; None where none was.
        honest_covariance: (p, p) covariance that agrees with the intervals, for combinations of
            parameters: with weights w, the standard deviation is `sqrt(w @ honest_covariance @ w)`.
            It contains the noise of the stated or estimated size, its autocorrelation, priors,
            disagreement between recordings, lengths of segments and the selection of terms. It
            contains neither the bias of a wrong model nor the errors of held parameters, and no
            scatter of parameters that are stated to differ between recordings. Infinite on the
            diagonal where a parameter is not determined; empty in records of earlier versions.
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
    units: tuple[str, ...] = ()
    prior: Array = field(default_factory=lambda: np.zeros((0, 0)))
    labels: Labels | None = None
    restart: Restart | None = None
    trace: Array = field(default_factory=lambda: np.zeros((0, 0)))
    nominal: tuple[Array, ...] = ()
    segments: tuple[Array, ...] = ()
    sizes: Array = field(default_factory=lambda: np.zeros(0))
    selection: Selection | None = None
    controllers: tuple[ControlLawInLoop, ...] = ()
    horizons: HorizonStudy | None = None
    held: tuple[str, ...] = ()
    inverse_dynamics: InverseDynamicsFit | None = None
    draws: ParameterDraws | None = None
    recording_comparison: RecordingComparison | None = None
    prior_directions: PriorDirections | None = None
    payload: PayloadEstimate | None = None
    tested_data: TermTestData | None = None
    honest_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))

    file_stem: ClassVar[str] = "estimate"
    made_by: ClassVar[str] = "`mjfim identify EXPERIMENT RECORDING... -o DIR`"
    renamed_fields: ClassVar[Mapping[str, str]] = {
        "suspects": "missing_terms",
        "worst": "worst_residual",
        "sandwich": "std_sandwich",
        "between": "between_recordings",
        "each": "per_recording",
        "detail": "robust_uncertainty",
    }

    def __post_init__(self) -> None:
        count = len(self.parameters)

        # Formal values replace robust ones that were not computed.
        if len(self.interval) != count:
            theta = np.asarray(self.theta)
            half_width = NORMAL_95 * np.asarray(self.std)
            interval = np.column_stack([theta - half_width, theta + half_width])
            object.__setattr__(self, "interval", interval)
        if len(self.std_sandwich) != count:
            object.__setattr__(self, "std_sandwich", self.std)
        if len(self.between_recordings) != count:
            object.__setattr__(self, "between_recordings", np.zeros(count))
        if len(self.prior) != count:
            object.__setattr__(self, "prior", np.zeros((count, count)))
        if len(self.sizes) != count:
            object.__setattr__(self, "sizes", np.abs(self.theta))
        if len(self.units) != count:
            object.__setattr__(self, "units", ("",) * count)

        freeze(self, "theta", "std", "covariance", "initial_theta", "data", "prior")
        freeze(self, "std_sandwich", "interval", "between_recordings", "trace", "sizes")
        freeze(self, "honest_covariance")

    @property
    def guess_sizes(self) -> Array:
        """(p,) sizes of the guess, of which its difference from the estimate is a share.

        They are zero for a single number whose guess is zero [theta-unit].
        """
        is_single = self.sizes == np.abs(self.theta)
        return np.where(is_single, np.abs(self.initial_theta), self.sizes)

    @property
    def reason_without_nominal(self) -> str:
        """Sentence that says why `nominal` is empty; empty where it is not."""
        if self.nominal:
            return ""

        rows = sum(len(recording.t) for recording in self.recordings)
        if rows > MAX_NOMINAL_ROWS:
            return (
                "The nominal model is not drawn for recordings of more than "
                f"{MAX_NOMINAL_ROWS:,} rows together."
            )
        if not len(self.trace):
            return "The nominal model is not drawn: an earlier version of mjfim saved the estimate."
        return "The nominal model is not drawn: its simulation diverges."

    def summary(self) -> dict[str, Any]:
        """Return the contents of estimate.json."""
        worst = None if self.worst_residual is None else self.worst_residual.summary()
        return {
            "parameters": list(self.parameters),
            "units": list(self.units),
            "theta": self.theta,
            "std": self.std,
            "covariance": self.covariance,
            "honest_covariance": self.honest_covariance,
            "initial_theta": self.initial_theta,
            "sizes": self.sizes,
            "chi2": self.chi2,
            "dof": self.dof,
            "status": self.status,
            "success": self.success,
            "interrupted": self.interrupted,
            "iterations": self.iterations,
            "residual_rms": self.residual_rms,
            "sigma": self.sigma,
            "misfit": self.misfit,
            "reasons": list(self.reasons),
            "worst": worst,
            "whiteness": [test.summary() for test in self.whiteness],
            "per_recording": self.per_recording,
            "suspects": [term.summary() for term in self.missing_terms],
            "suspects_tested": None if self.tested_data is None else self.tested_data.summary(),
            "std_sandwich": self.std_sandwich,
            "interval": self.interval,
            "between_recordings": self.between_recordings,
            "predictions": [prediction.summary() for prediction in self.predictions],
            "seconds": self.seconds,
            "steps": self.steps,
            "sloppy": list(self.sloppy),
            "at_bound": list(self.at_bound),
            "recordings": [recording.name for recording in self.recordings],
            "warnings": list(self.warnings),
            "prior": self.prior,
            "data": self.data,
            "combinations": list(self.combinations),
            "restart": None if self.restart is None else self.restart.summary(),
            "selection": None if self.selection is None else self.selection.summary(),
            "controllers": [law.summary() for law in self.controllers],
            "held": list(self.held),
            "horizons": None if self.horizons is None else self.horizons.summary(),
            "inverse_dynamics": (
                None if self.inverse_dynamics is None else self.inverse_dynamics.summary()
            ),
            "draws": None if self.draws is None else self.draws.summary(),
            "payload": None if self.payload is None else self.payload.summary(),
            "recording_comparison": (
                None if self.recording_comparison is None else self.recording_comparison.summary()
            ),
            "prior_directions": (
                None if self.prior_directions is None else self.prior_directions.summary()
            ),
        }


@dataclass(frozen=True, kw_only=True)
class Restart:
    """Repetition of a fit that did not explain the recordings, from fits over short segments.

    Attributes:
        lengths: Lengths of the segments, in the order of the fits [s].
        cost_before: Half of the sum of squares of the first fit.
        cost: That of the fit that was kept, with the noise of the first fit.
        by_dynamics: Whether the fits over segments began at a fit to the equation of motion, which
            costs less there than the start.
        starts: Number of starts, spread about the guess, from the best of which they began; 1 where
            they began at the guess or at a fit to the equation of motion.
    """

    lengths: tuple[float, ...]
    cost_before: float
    cost: float
    by_dynamics: bool = False
    starts: int = 1

    def __str__(self) -> str:
        lengths = join_names([f"{length:.2g}" for length in self.lengths])
        begin = (
            "The first fit did not explain the recordings or did not converge, so it was restarted "
            f"from fits over segments of {lengths} s"
        )
        if self.by_dynamics:
            begin += ", which began at a fit to the equation of motion"
        if self.starts > 1:
            begin += f", which began at the best of {self.starts} starts spread about the guess"
        if not self.cost < self.cost_before:
            return f"{begin}. This found nothing better, and the first result stands."
        return (
            f"{begin}. Half of the sum of squares fell from {self.cost_before:.6g} to "
            f"{self.cost:.6g}."
        )

    def summary(self) -> dict[str, Any]:
        """Return the contents of `restart` in estimate.json."""
        return {
            "lengths": list(self.lengths),
            "cost_before": self.cost_before,
            "cost": self.cost,
            "by_dynamics": self.by_dynamics,
            "starts": self.starts,
            "words": str(self),
        }


@dataclass(frozen=True, kw_only=True)
class WorstResidual:
    """Interval of a recording in which residuals are largest.

    Attributes:
        output: Name of the output.
        recording: Name of the recording.
        begin: Beginning of the interval [s].
        end: End of the interval [s].
        size: Root mean square of the residuals in it [standard deviations of the noise].
        share: Fraction of the sum of all squared residuals that lies in the interval, 0 to 1.
    """

    output: str
    recording: str
    begin: float
    end: float
    size: float
    share: float

    def __str__(self) -> str:
        percent = 100 * self.share
        interval = f"{self.begin:.3g} to {self.end:.3g} s of {self.recording}"
        size = f"{self.size:.2g} σ, {percent:.0f} % of the sum of squares"
        return f"largest residuals in {self.output}, {interval}: {size}"

    def summary(self) -> dict[str, Any]:
        """Return the contents of `worst` in estimate.json."""
        return {
            "output": self.output,
            "recording": self.recording,
            "begin": self.begin,
            "end": self.end,
            "size": self.size,
            "share": self.share,
        }


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class PredictionErrors(SavedRecord):
    """Differences between a model's outputs and a recording.

    Attributes:
        name: Name of the recording.
        outputs: Names of the ny outputs.
        rms: (ny,) root mean square errors [unit of the output]; NaN for an output without
            measurements, and if the model diverges.
        mae: (ny,) mean absolute errors [unit of the output]; NaN as in `rms`.
    """

    name: str
    outputs: tuple[str, ...]
    rms: Array
    mae: Array

    file_stem: ClassVar[str] = "prediction_errors"
    made_by: ClassVar[str] = "PredictionErrors.save"

    def __post_init__(self) -> None:
        freeze(self, "rms", "mae")

    def summary(self) -> dict[str, Any]:
        """Return the contents of prediction_errors.json."""
        return {
            "name": self.name,
            "rms": self.by_output(self.rms),
            "mae": self.by_output(self.mae),
        }

    def by_output(self, errors: Array) -> dict[str, float]:
        """Return `rms` or `mae` by name of the output."""
        return dict(zip(self.outputs, errors.tolist(), strict=True))


@dataclass(frozen=True, eq=False, kw_only=True)
class Prediction:
    """Prediction errors of the identified and of the nominal model on data that were not fitted.

    Attributes:
        name: Name of the recording, or of a part of it.
        identified: Errors of the identified model.
        nominal: Errors of the nominal model.
        held_out: True if the user held out the data; False if they were left out of a fit for
            cross-validation.
        recording: The held-out recording; None in a cross-validation, and in records of earlier
            versions.
        identified_outputs: (M, ny) outputs of the identified model for the held-out recording
            [unit of the output]; NaN where the model diverges, empty without a recording.
        nominal_outputs: (M, ny) outputs of the nominal model, likewise.
    """

    name: str
    identified: PredictionErrors
    nominal: PredictionErrors
    held_out: bool
    recording: Recording | None = None
    identified_outputs: Array = field(default_factory=lambda: np.zeros((0, 0)))
    nominal_outputs: Array = field(default_factory=lambda: np.zeros((0, 0)))

    def __post_init__(self) -> None:
        freeze(self, "identified_outputs", "nominal_outputs")

    @property
    def ratio(self) -> float:
        """Ratio of the identified to the nominal model's root mean square error.

        It is the geometric mean over the outputs; NaN if no output has both errors.
        """
        identified = self.identified.rms
        nominal = self.nominal.rms
        finite = np.isfinite(identified) & np.isfinite(nominal)
        comparable = finite & (nominal > 0.0) & (identified > 0.0)
        if not comparable.any():
            return float("nan")

        log_ratios = np.log(identified[comparable] / nominal[comparable])
        return float(np.exp(np.mean(log_ratios)))

    def summary(self) -> dict[str, Any]:
        """Return the contents of one entry of `predictions` in estimate.json."""
        return {
            "name": self.name,
            "held_out": self.held_out,
            "rms": self.identified.by_output(self.identified.rms),
            "mae": self.identified.by_output(self.identified.mae),
            "nominal_rms": self.nominal.by_output(self.nominal.rms),
            "nominal_mae": self.nominal.by_output(self.nominal.mae),
            "ratio": self.ratio,
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class Uncertainty:
    """Robust uncertainty of the c unknowns that all recordings have in common [theta-unit].

    It allows for autocorrelated residuals and for recordings that disagree.

    Attributes:
        sandwich: (c,) standard deviations that allow for autocorrelated residuals.
        interval: (c, 2) 95 % intervals, which cover the formal, sandwich and bootstrap intervals.
        between: (c,) standard deviation between recordings that their standard deviations do not
            explain.
        apart: Indices of the unknowns on which recordings disagree.
        each: (K, c) estimates from each recording alone; NaN where a recording has too little
            information.
        blocks: Number of blocks of the bootstrap.
        draws: (n, c) bootstrap replicates of the estimate.
        covariance: (c, c) covariance that is in every direction at least the formal one and the
            sandwich one, without the scatter between recordings; empty in records of earlier
            versions. `Estimate.honest_covariance` is the one for combinations of parameters.
    """

    sandwich: Array
    interval: Array
    between: Array
    apart: tuple[int, ...]
    each: Array
    blocks: int
    draws: Array
    covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))


@dataclass(frozen=True, kw_only=True)
class Whiteness:
    """Tests whether the whitened residuals of one output are white noise of unit variance.

    Attributes:
        output: Name of the output.
        count: Number of residuals.
        variance: Their mean square; 1 for noise of the stated size.
        correlation: Lag-1 autocorrelation, -1 to 1.
        p: p-value of the hypothesis of white noise, corrected for the number of tests.
        inflation: Variance of the mean of successive residuals divided by that of white noise, the
            largest over several numbers of residuals.
        time: Integrated autocorrelation time [rows].
    """

    output: str
    count: int
    variance: float
    correlation: float
    p: float
    inflation: float
    time: float

    def summary(self) -> dict[str, Any]:
        """Return the contents of one entry of `whiteness` in estimate.json."""
        return {
            "output": self.output,
            "count": self.count,
            "variance": self.variance,
            "correlation": self.correlation,
            "p": self.p,
            "inflation": self.inflation,
            "time": self.time,
        }
