"""Records of an identification: the estimate, its uncertainty, and tests of the fit."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import asdict, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from mjfim.arrays import NORMAL_95, Array, record
from mjfim.errors import RecordingError, first_ones
from mjfim.files import read_json
from mjfim.records.base import (
    ParameterResult,
    ParameterValue,
    Record,
    SavedRecord,
    listed_values,
    no_array,
)
from mjfim.records.check import Check, join_names
from mjfim.records.design import Design
from mjfim.records.estimate_parts import (
    InformationInTime,
    InverseDynamicsFit,
    PayloadEstimate,
    ResidualForce,
)
from mjfim.records.robots import RecordingComparison
from mjfim.records.terms import Selection, Term, TermTestData
from mjfim.records.trajectory import Labels, Recording, Trajectory

# Module that writes identified models; records must not depend on the output.
MODELS = "mjfim.output.export.mjcf"

# Ratio of the errors over the longest and the shortest horizon above which they grow.
GROWTH = 1.2


# Smallest error in a denominator.
SMALLEST_ERROR = 1e-150


@record
class HorizonStudy(Record):
    """Fits over segments of different lengths, and how well each predicts left-out data.

    Each fit predicts parts of the data from the others, over times of each length. The longest
    length is chosen whose predictions over all these times are not clearly worse than the best
    ones, because longer segments give more accurate estimates.

    Attributes:
        lengths: (L,) lengths of the segments, which are the prediction horizons as well [s]. The
            last one is that of whole recordings, if these were fitted.
        errors: (L, L) error of left-out data of the fit over each length, in each horizon [standard
            deviations of the noise].
        chosen: Index of the chosen length.
        is_whole: Whether the last length is that of whole recordings.
        parameters: Names of the p parameters.
        units: (p,) their units.
        theta: (L, p) estimates by each fit [theta-unit].
        half_widths: (L, p) half widths of their 95 % intervals, by the scatter between the
            estimates without each part of the data [theta-unit].
        is_apart: (L, p) whether an estimate differs from that of the chosen length by more than
            chance explains.
        why_not_used: Why the estimate is over whole recordings although segments were chosen, in
            words; empty where it is over the chosen length.
    """

    lengths: Array
    errors: Array
    chosen: int
    is_whole: bool
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    theta: Array
    half_widths: Array
    is_apart: Array
    why_not_used: str = ""

    in_json = (
        "words",
        "lengths",
        "errors",
        "chosen",
        "is_used",
        "is_whole",
        "theta",
        "half_widths",
        "dependent",
    )
    json_names = {"dependent": "depends_on_length"}

    @property
    def dependent(self) -> tuple[str, ...]:
        """Names of the parameters whose estimate depends on the length of the segments."""
        columns = np.flatnonzero(np.asarray(self.is_apart, dtype=bool).any(axis=0))
        return tuple(self.parameters[j] for j in columns)

    @property
    def is_used(self) -> bool:
        """Whether the estimate is over the chosen length."""
        return not self.why_not_used

    @property
    def relative_errors(self) -> Array:
        """(L,) error of each fit over the smallest one in each horizon, as root mean square."""
        errors = self.errors
        least = np.where(np.isfinite(errors), errors, np.inf).min(axis=0)
        ratios = errors / np.maximum(least, SMALLEST_ERROR)
        return np.asarray(np.sqrt(np.mean(ratios**2, axis=1)))

    def name_of(self, index: int) -> str:
        """A length in words.

        Args:
            index: Index of the length.
        """
        if self.is_whole and index == len(self.lengths) - 1:
            return "whole recordings"
        return f"segments of {self.lengths[index]:.2g} s"

    def widened(self, interval: Array) -> Array:
        """Intervals that also hold the estimates of other lengths that chance does not explain.

        Where the estimate is not over the chosen length, they hold the one over it as well.

        Args:
            interval: (p, 2) intervals of the estimate [theta-unit].

        Returns:
            (p, 2) intervals.
        """
        apart = np.array(self.is_apart, dtype=bool)
        if not self.is_used:
            apart[self.chosen] = apart.any(axis=0)
        low = np.where(apart, self.theta, np.inf).min(axis=0)
        high = np.where(apart, self.theta, -np.inf).max(axis=0)
        return np.column_stack([np.minimum(interval[:, 0], low), np.maximum(interval[:, 1], high)])

    def __str__(self) -> str:
        sentences = [self.about_choice, self.about_use, self.about_growth, *self.findings]
        return " ".join(filter(None, sentences))

    @property
    def about_choice(self) -> str:
        """Sentence that says which length was chosen."""
        first, last = self.lengths[0], self.lengths[-1]
        ratios = self.relative_errors
        text = (
            "The model does not explain the recordings, so the length of the segments matters: "
            f"{self.name_of(self.chosen)} were chosen. They are the longest ones whose predictions "
            f"of left-out data are not clearly worse than the best, over times of {first:.2g} to "
            f"{last:.2g} s (error over the smallest one for each time: {ratios[self.chosen]:.3g}"
        )
        others = [i for i in range(len(self.lengths)) if i != self.chosen]
        listed = [f"{ratios[i]:.3g} with {self.name_of(i)}" for i in others]
        return f"{text}, {join_names(listed)})."

    @property
    def about_use(self) -> str:
        """Sentence that says why the estimate is over whole recordings; empty where it is not."""
        if self.is_used:
            return ""
        return (
            f"The estimate is over whole recordings, not over {self.name_of(self.chosen)}: "
            f"{self.why_not_used}."
        )

    @property
    def about_growth(self) -> str:
        """Sentence that says what the error against the horizon means."""
        errors = self.errors[self.chosen]
        if errors[-1] > GROWTH * errors[0]:
            return (
                f"The error grows from {errors[0]:.3g} σ over {self.lengths[0]:.2g} s to "
                f"{errors[-1]:.3g} σ over {self.lengths[-1]:.2g} s: the model misses an effect "
                "that adds up with time."
            )
        return (
            f"The error is {errors[0]:.3g} σ over {self.lengths[0]:.2g} s and {errors[-1]:.3g} σ "
            f"over {self.lengths[-1]:.2g} s: the model misses an effect that does not add up with "
            "time, or the noise is larger than stated."
        )

    @property
    def findings(self) -> tuple[str, ...]:
        """A sentence for each parameter whose estimate depends on the length of the segments."""
        found = []
        for name in self.dependent:
            j = self.parameters.index(name)
            unit = f" {self.units[j]}" if self.units[j] else ""
            values = [
                f"{self.theta[i, j]:.4g}{unit} with {self.name_of(i)}"
                for i in range(len(self.lengths))
                if self.is_apart[i, j] or i == self.chosen
            ]
            found.append(
                f"{name} depends on the length: {join_names(values)}; this is more than chance "
                "explains, so the model misses something, and the interval covers these values."
            )
        return tuple(found)


# Longest list of names in a sentence [characters].
NAMES_TEXT = 120


@record
class PriorDirections(Record):
    """Number of combinations of the inertial parameters that the recordings determine.

    The others are determined by the prior that the inertias of the model are (`cad_prior`). No
    motion of a fixed-base arm shows them, for example the mass of its first link.

    Attributes:
        bodies: Names of the groups of parameters, one for each body.
        count: Number of coordinates of these bodies.
        determined: Number of combinations of which the recordings leave at most half of the
            standard deviation of the prior.
        parameters: Names of the parameters whose standard deviation is more than half of that of
            the prior: their intervals are those of the prior.
    """

    bodies: tuple[str, ...]
    count: int
    determined: int
    parameters: tuple[str, ...]

    in_json = (
        "bodies",
        "count",
        "determined",
        "parameters",
        "words",
    )

    def __str__(self) -> str:
        bodies = first_ones(self.bodies, ", ", NAMES_TEXT)
        text = (
            f"The recordings determine {self.determined} of {self.count} combinations of the "
            f"inertial parameters of {bodies}. The other "
            f"{self.count - self.determined} keep the values of the model within `cad_prior`, "
            "which is an assumption and no measurement"
        )
        if not self.parameters:
            return f"{text}."
        names = first_ones(self.parameters, ", ", NAMES_TEXT)
        return f"{text}: it gives most of the intervals of {names}."


# Share of clipped samples below which it is not worth a word.
RARELY = 1e-3


# Range of a control without limits.
NO_RANGE = [-math.inf, math.inf]


@record
class ControlLawInLoop(Record):
    """Law with which the driver of an actuator computes the control.

    Attributes:
        actuator: Name of the actuator.
        joint: Name of the joint whose position it controls.
        rate: Rate at which it is evaluated [Hz].
        columns: Columns of the log that it reads.
        numbers: Its numbers by the keys of the experiment file, those without effect left out; both
            ends of a range have an index, as in `saturation[0]`.
        units: Unit of each of these numbers; may be empty.
        estimated: Keys of the numbers that are parameters.
        clipped: Share of the samples at which the limits of the law clip its control, 0 to 1.
        replaces_servo: Whether it takes the place of a position servo of the MJCF.
    """

    actuator: str
    joint: str
    rate: float
    columns: tuple[str, ...]
    numbers: dict[str, float]
    units: dict[str, str]
    estimated: tuple[str, ...]
    clipped: float
    replaces_servo: bool

    @property
    def numbers_in_words(self) -> str:
        """The numbers with their units; both ends of the range of the control stand together."""
        words = [
            f"{key} = {value:.5g} {self.units[key]}".rstrip()
            for key, value in self.numbers.items()
            if not key.endswith("]")
        ]
        ends = [self.numbers.get(f"saturation[{i}]", side) for i, side in enumerate(NO_RANGE)]
        if ends != NO_RANGE:
            low, high = (f"{end:.5g}" for end in ends)
            unit = next(unit for key, unit in self.units.items() if key.endswith("]"))
            words.append(f"saturation = {low} to {high} {unit}".rstrip())
        return ", ".join(words)

    def __str__(self) -> str:
        sentence = (
            f"The control of {self.actuator} is that of its law in the loop, evaluated at "
            f"{self.rate:g} Hz: {self.numbers_in_words}"
        )
        if self.clipped > RARELY:
            sentence += f"; its limits clip it at {100.0 * self.clipped:.2g} % of the samples"
        if self.replaces_servo:
            sentence += "; it takes the place of the servo in the MJCF"
        return f"{sentence}."

    @property
    def toml(self) -> str:
        """The numbers as a line of an experiment file, with all their digits."""
        entries = [
            f"{key} = {value!r}" for key, value in self.numbers.items() if not key.endswith("]")
        ]
        ends = [self.numbers.get(f"saturation[{i}]", side) for i, side in enumerate(NO_RANGE)]
        if ends != NO_RANGE:
            entries.append(f"saturation = [{ends[0]!r}, {ends[1]!r}]")
        return f"controllers.{self.actuator} = {{ {', '.join(entries)} }}"

    def summary(self) -> dict[str, Any]:
        """Return the contents of an entry of `controllers` in estimate.json."""
        return {**asdict(self), "words": str(self), "toml": self.toml}


@record
class ParameterDraws(Record):
    """Robots that are compatible with an identification.

    They are drawn from a normal distribution about the estimate that is truncated at the bounds of
    the parameters. Deviations of initial states, which are no properties of a robot, are left out.

    Attributes:
        parameters: Names of the q drawn parameters.
        units: Unit of each parameter; may be empty.
        values: (n, q) a robot in each row [theta-unit].
        centre: (q,) centre of the distribution: the estimate, and the mean over the recordings for
            parameters that differ between them [theta-unit].
        std: (q,) standard deviations of the distribution before truncation [theta-unit].
        replaced: Number of draws that were replaced because a body had an unphysical inertia.
        held_combinations: Number of combinations of inertias that stay at the estimate, because the
            recordings do not determine them.
        seed: Seed of the draws; None where the caller has made the generator.
    """

    parameters: tuple[str, ...]
    units: tuple[str, ...]
    values: Array
    centre: Array
    std: Array
    replaced: int = 0
    held_combinations: int = 0
    seed: int | None = None

    in_json = (
        "words",
        "seed",
        "parameters",
        "centre",
        "std",
        "replaced",
        "held_combinations",
    )

    def __len__(self) -> int:
        return len(self.values)

    def __str__(self) -> str:
        count = len(self)
        drawn = "1 robot was" if count == 1 else f"{count} robots were"
        text = f"{drawn} drawn from the uncertainty of the estimate, inside the bounds"
        if self.held_combinations:
            count = self.held_combinations
            noun = "combination" if count == 1 else "combinations"
            text += (
                f"; {count} {noun} of inertias that the recordings do not determine stayed there"
            )
        if not self.replaced:
            return text
        times = "once" if self.replaced == 1 else f"{self.replaced} times"
        return f"{text}; a draw with an unphysical inertia was replaced {times}"

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON."""
        return {
            **super().summary(),
            "count": len(self),
        }


# Number of rows of all recordings above which an estimate does not hold the outputs of the model at
# the initial guess.
MAX_NOMINAL_ROWS = 1_000_000


@record
class Estimate(ParameterResult):
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
        converged: True if the fit converged and all parameters are determined inside their bounds.
        misfit: True if the residuals are not noise of the stated size; the formal `std` is then
            too small.
        iterations: Number of iterations.
        residual_rms: Root mean square residual of each output [unit of the output].
        at_bound: Names of the parameters that ended at a bound.
        predicted: Outputs of the fitted model for each recording, (M, ny) [unit of the output].
        recordings: The fitted recordings.
        warnings: Sentences for the user, the most serious ones first.
        causes: Those of them that say what to fix first, each with its cure.
        details: Those of them that a short form leaves out.
        nuisance: Names of the nuisance parameters.
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
        motion: Motion of the fitted model for the first recording, at most its first 200 000
            samples; None where it diverges.
        interrupted: True if the user interrupted the fit.
        seconds: Wall time [s].
        steps: MuJoCo steps taken.
        units: Unit of each parameter.
        prior: (p, p) information of the parameters' priors, at the estimate.
        labels: Names and units for figures and tables.
        restart: How the fit was repeated from fits over segments; None where it was not.
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
        residual_forces: What the model does not explain at each joint, along the measured motions;
            none where a motion or a force was not measured.
        draws: Robots that were drawn from the uncertainty, for simulations that vary the robot;
            None where that was not asked for.
        recording_comparison: What each recording suggests alone, the scatter between recordings,
            and which one is odd; None for a single recording.
        prior_directions: Combinations of inertias that the recordings do not determine, but the
            inertias of the model (`cad_prior`); None without any.
        payload: The payload that was looked for; None where none was.
        in_time: Which seconds of the recordings decide each parameter; None where some direction of
            the unknowns is not determined.
        honest_covariance: (p, p) covariance that agrees with the intervals, for combinations of
            parameters: with weights w, the standard deviation is `sqrt(w @ honest_covariance @ w)`.
            It contains the noise of the stated or estimated size, its autocorrelation, priors,
            disagreement between recordings, lengths of segments and the selection of terms. It
            contains neither the bias of a wrong model nor the errors of held parameters, and no
            scatter of parameters that are stated to differ between recordings. Infinite on the
            diagonal where a parameter is not determined; empty in records of earlier versions.
        prediction: (p, p) covariance that a design or a check predicted, NaN where it predicted
            none; empty where none was given (`with_prediction`).
        experiment: The experiment (`mjfim.Experiment`), or the path of its file; None where it is
            not known. It is not saved.
    """

    parameters: tuple[str, ...]
    theta: Array
    std: Array
    covariance: Array
    initial_theta: Array
    chi2: float
    dof: int
    status: str
    converged: bool
    misfit: bool
    iterations: int
    residual_rms: dict[str, float]
    at_bound: tuple[str, ...]
    predicted: tuple[Array, ...]
    recordings: tuple[Recording, ...]
    warnings: tuple[str, ...] = ()
    causes: tuple[str, ...] = ()
    details: tuple[str, ...] = ()
    nuisance: tuple[str, ...] = ()
    combinations: tuple[str, ...] = ()
    data: Array = no_array(0, 0)
    std_sandwich: Array = no_array()
    interval: Array = no_array(0, 2)
    between_recordings: Array = no_array()
    sigma: dict[str, float] = field(default_factory=dict)
    reasons: tuple[str, ...] = ()
    whiteness: tuple[Whiteness, ...] = ()
    worst_residual: WorstResidual | None = None
    predictions: tuple[Prediction, ...] = ()
    sloppy: tuple[str, ...] = ()
    missing_terms: tuple[Term, ...] = ()
    per_recording: dict[str, tuple[float, ...]] = field(default_factory=dict)
    motion: Trajectory | None = None
    interrupted: bool = False
    seconds: float = 0.0
    steps: int = 0
    units: tuple[str, ...] = ()
    prior: Array = no_array(0, 0)
    labels: Labels
    restart: Restart | None = None
    nominal: tuple[Array, ...] = ()
    segments: tuple[Array, ...] = ()
    sizes: Array = no_array()
    selection: Selection | None = None
    controllers: tuple[ControlLawInLoop, ...] = ()
    horizons: HorizonStudy | None = None
    held: tuple[str, ...] = ()
    inverse_dynamics: InverseDynamicsFit | None = None
    residual_forces: tuple[ResidualForce, ...] = ()
    draws: ParameterDraws | None = None
    recording_comparison: RecordingComparison | None = None
    prior_directions: PriorDirections | None = None
    payload: PayloadEstimate | None = None
    in_time: InformationInTime | None = None
    tested_data: TermTestData | None = None
    honest_covariance: Array = no_array(0, 0)
    prediction: Array = no_array(0, 0)
    experiment: Any = field(default=None, repr=False, metadata={"saved": False})

    file_stem = "estimate"
    made_by = "`mjfim identify EXPERIMENT RECORDING... -o DIR`"
    in_json = (
        "parameters",
        "units",
        "theta",
        "std",
        "covariance",
        "honest_covariance",
        "honest_std",
        "predicted_std",
        "initial_theta",
        "sizes",
        "chi2",
        "dof",
        "status",
        "converged",
        "interrupted",
        "iterations",
        "residual_rms",
        "sigma",
        "misfit",
        "reasons",
        "worst_residual",
        "whiteness",
        "per_recording",
        "missing_terms",
        "tested_data",
        "std_sandwich",
        "interval",
        "between_recordings",
        "predictions",
        "seconds",
        "steps",
        "sloppy",
        "at_bound",
        "warnings",
        "causes",
        "details",
        "nuisance",
        "prior",
        "data",
        "combinations",
        "restart",
        "selection",
        "controllers",
        "held",
        "horizons",
        "inverse_dynamics",
        "residual_forces",
        "draws",
        "payload",
        "recording_comparison",
        "prior_directions",
        "in_time",
    )
    json_names = {
        "converged": "success",
        "in_time": "information_in_time",
        "worst_residual": "worst",
        "missing_terms": "suspects",
        "tested_data": "suspects_tested",
    }

    def __post_init__(self) -> None:
        # Formal values replace robust ones that were not computed.
        count = len(self.parameters)
        defaults: dict[str, Callable[[], Any]] = {
            "interval": lambda: np.stack(
                [self.theta + side * np.asarray(self.std) for side in (-NORMAL_95, NORMAL_95)],
                axis=1,
            ),
            "std_sandwich": lambda: self.std,
            "between_recordings": lambda: np.zeros(count),
            "prior": lambda: np.zeros((count, count)),
            "sizes": lambda: np.abs(self.theta),
            "units": lambda: ("",) * count,
        }
        for name, value in defaults.items():
            if len(getattr(self, name)) != count:
                object.__setattr__(self, name, value())
        super().__post_init__()

    @classmethod
    def load(cls, path: str | Path) -> Estimate:
        """Read an estimate; it knows the experiment that estimate.json names. See `SavedRecord`."""
        found = super().load(path)
        folder = Path(path) if Path(path).is_dir() else Path(path).parent
        try:
            stated = read_json(folder / f"{cls.file_stem}.json").get("experiment")
        except RecordingError:
            return found
        return found if stated is None else replace(found, experiment=folder / str(stated))

    @property
    def spec(self) -> Any:
        """A new `mujoco.MjSpec` of the user's model with the estimates.

        Raises:
            ExperimentError: The estimate does not know its experiment.
            ModelError: No MJCF expresses the estimates.
        """
        return import_module(MODELS).identified_spec(self)

    @property
    def model(self) -> Any:
        """The `mujoco.MjModel` of `spec`."""
        return self.spec.compile()

    def save_model(self, path: str | Path, *, force: bool = False) -> list[str]:
        """Write the user's MJCF with the estimates, and the URDF from which it came beside it.

        A comment at its head states data, date, version, the accuracy of each value and the
        verdict. Files that mjfim did not write are not replaced.

        Args:
            path: The new file, which ends in .xml.
            force: Whether files of the user are replaced; files of the experiment never are.

        Returns:
            Sentences about everything that a user would not expect.

        Raises:
            OutputError: A file may not be replaced.
            ExperimentError: The estimate does not know its experiment.
            ModelError: No MJCF expresses the estimates.
        """
        found: list[str] = import_module(MODELS).save_identified(self, path, force=force)
        return found

    @property
    def guess_sizes(self) -> Array:
        """(p,) sizes of the guess, of which its difference from the estimate is a share.

        They are zero where the guess is zero [theta-unit].
        """
        is_single = (self.sizes == np.abs(self.theta)) | (self.initial_theta == 0.0)
        return np.where(is_single, np.abs(self.initial_theta), self.sizes)

    @property
    def honest_std(self) -> Array:
        """(p,) a quarter of the width of the 95 % interval; NaN where it is not determined."""
        is_known = np.isfinite(self.std) & np.isin(self.parameters, self.held, invert=True)
        return np.where(is_known, 0.25 * np.ptp(self.interval, axis=1), np.nan)

    @property
    def predicted_std(self) -> Array:
        """(p,) standard deviations that a design or a check predicted; NaN for none."""
        if not len(self.prediction):
            return np.full(len(self.theta), np.nan)
        return np.sqrt(np.diag(self.prediction))

    def each(self) -> Iterator[ParameterValue]:
        """Estimates with the honest σ and the 95 % interval, the formal σ and the guess."""
        std = self.honest_std
        return listed_values(
            self.parameters,
            self.units,
            self.theta,
            std,
            self.labels.targets,
            np.where(np.isfinite(std)[:, None], self.interval, np.nan),
            formal_std=self.std,
            guess=self.initial_theta,
        )

    def with_prediction(self, prediction: Design | Check) -> Estimate:
        """Return the estimate beside the accuracy that was predicted before the recording.

        Args:
            prediction: The design that was played, or a check; parameters are found by name.
        """
        names = prediction.wanted if isinstance(prediction, Check) else prediction.parameters
        places = {name: place for place, name in enumerate(names)}
        of = [places.get(name, len(names)) for name in self.parameters]
        known = np.full((len(names) + 1,) * 2, np.nan)
        known[:-1, :-1] = prediction.covariance
        return replace(self, prediction=known[np.ix_(of, of)])

    @property
    def reason_without_nominal(self) -> str:
        """Sentence that says why `nominal` is empty; empty where it is not."""
        if self.nominal:
            return ""

        if sum(len(recording.t) for recording in self.recordings) > MAX_NOMINAL_ROWS:
            return (
                "The nominal model is not drawn for recordings of more than "
                f"{MAX_NOMINAL_ROWS:,} rows together."
            )
        return "The nominal model is not drawn: its simulation diverges."

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON."""
        return {
            **super().summary(),
            "recordings": [recording.name for recording in self.recordings],
        }


@record
class Restart(Record):
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

    in_json = (
        "lengths",
        "cost_before",
        "cost",
        "by_dynamics",
        "starts",
        "words",
    )

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


@record
class WorstResidual(Record):
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


@record
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

    file_stem = "prediction_errors"
    made_by = "PredictionErrors.save"

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


@record
class Prediction(Record):
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
    identified_outputs: Array = no_array(0, 0)
    nominal_outputs: Array = no_array(0, 0)

    in_json = (
        "name",
        "held_out",
        "ratio",
    )

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

        return float(np.exp(np.mean(np.log(identified[comparable] / nominal[comparable]))))

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON."""
        return {
            **super().summary(),
            "rms": self.identified.by_output(self.identified.rms),
            "mae": self.identified.by_output(self.identified.mae),
            "nominal_rms": self.nominal.by_output(self.nominal.rms),
            "nominal_mae": self.nominal.by_output(self.nominal.mae),
        }


@record
class Whiteness(Record):
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
