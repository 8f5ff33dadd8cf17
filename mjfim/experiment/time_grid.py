"""The time grid of an experiment: how its rates divide the time into samples and engine steps."""

from __future__ import annotations

from dataclasses import dataclass, replace

from mjfim.errors import ExperimentError
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system_tables import NoiseSpec
from mjfim.model.variants import ModelVariant

# Largest number of engine steps of a sample, so that a mistyped rate or timestep does not exhaust
# the memory.
MAX_SUBSTEPS = 100_000

# A ratio of two rates counts as a whole number within this relative tolerance.
RATE_TOLERANCE = 1e-6


@dataclass(frozen=True, kw_only=True)
class TimeGrid:
    """Division of the time into samples, measurements and engine steps.

    Attributes:
        dt: Sample period, for which a control is held [s].
        substeps: Engine steps of a sample.
        stride: Samples from one measurement to the next.
        playback_steps: Engine steps of the stated model from one row of design.csv to the next.
    """

    dt: float
    substeps: int
    stride: int
    playback_steps: int

    @staticmethod
    def stated(experiment: Experiment, timestep: float) -> TimeGrid:
        """The grid that an experiment states.

        Args:
            experiment: The experiment.
            timestep: Timestep of the user's model [s].

        Raises:
            ExperimentError: The rates are not multiples of each other as required.
        """
        rate = experiment.rate
        measure_rate = experiment.measure_rate or rate
        substeps = _substeps(rate, timestep)
        return TimeGrid(
            dt=substeps * timestep,
            substeps=substeps,
            stride=_stride("measure_rate", rate, measure_rate),
            playback_steps=_playback_steps(rate, experiment.playback_rate, substeps),
        )

    @property
    def rows_per_sample(self) -> int:
        """Rows of design.csv in one sample, on the stated grid."""
        return self.substeps // self.playback_steps

    def with_variant(self, variant: ModelVariant) -> TimeGrid:
        """This grid with longer samples or a longer timestep; longer samples are all measured."""
        if self.substeps % variant.timestep_factor:
            raise ValueError(
                f"{self.substeps} engine steps per sample do not divide by "
                f"{variant.timestep_factor}"
            )

        return replace(
            self,
            dt=self.dt * variant.sample_factor,
            substeps=self.substeps // variant.timestep_factor,
            stride=self.stride if variant.sample_factor == 1 else 1,
        )


def noise_strides(experiment: Experiment) -> dict[str, int]:
    """Samples from one measurement to the next for the keys of the table `noise` that state a rate.

    Args:
        experiment: The experiment.

    Returns:
        The strides by key; keys without a rate are measured at `measure_rate`.

    Raises:
        ExperimentError: A rate does not divide that of the samples, or gives no measurement within
            the horizon.
    """
    horizon = experiment.horizon
    strides: dict[str, int] = {}

    for name, spec in experiment.noise.items():
        if not isinstance(spec, NoiseSpec) or spec.rate is None:
            continue

        key = f"noise.{name}.rate"
        strides[name] = _stride(key, experiment.rate, spec.rate)
        if horizon is not None and spec.rate * horizon < 1.0 - RATE_TOLERANCE:
            raise ExperimentError(
                f"{key}: {spec.rate:g} Hz gives no measurement within the horizon ({horizon:g} s)"
            )
    return strides


def whole_timesteps(rate: float, timestep: float) -> int | None:
    """Number of timesteps in a period; None if it is not a whole number.

    Args:
        rate: The rate [Hz].
        timestep: The timestep [s].
    """
    ratio = 1.0 / (rate * timestep)
    n = round(ratio)
    return n if n >= 1 and abs(ratio - n) <= RATE_TOLERANCE * n else None


def possible_rates(timestep: float) -> str:
    """Some rates whose periods are whole numbers of timesteps [Hz], for a message.

    Args:
        timestep: The timestep [s].
    """
    return ", ".join(f"{1.0 / (k * timestep):g}" for k in (1, 2, 4, 5, 10))


def _substeps(rate: float, timestep: float) -> int:
    """Engine steps per sample.

    Raises ExperimentError if a sample is not a whole number of timesteps [s], or too many of them.
    """
    n = whole_timesteps(rate, timestep)
    if n is None:
        raise ExperimentError(
            f"rate: at {rate:g} Hz, a sample is not a whole number of timesteps ({timestep:g} s); "
            f"valid for example: {possible_rates(timestep)} Hz"
        )
    if n > MAX_SUBSTEPS:
        raise ExperimentError(
            f"rate: at {rate:g} Hz, a sample is {n:g} timesteps ({timestep:g} s); at most "
            f"{MAX_SUBSTEPS:g} are possible, that is {1.0 / (MAX_SUBSTEPS * timestep):g} Hz or more"
        )
    return n


def _playback_steps(rate: float, playback_rate: float | None, substeps: int) -> int:
    """Engine steps per row of design.csv, those of a sample where no playback rate [Hz] is stated.

    Raises ExperimentError if a row is not a whole number of engine steps, or a sample not a whole
    number of rows.
    """
    if playback_rate is None:
        return substeps

    valid = [k for k in range(1, substeps + 1) if substeps % k == 0]
    ratio = playback_rate / rate
    rows = round(ratio)
    if rows not in valid or abs(ratio - rows) > RATE_TOLERANCE * rows:
        listed = ", ".join(f"{k * rate:g}" for k in valid)
        raise ExperimentError(
            f"playback_rate: {playback_rate:g} Hz is not a multiple of rate ({rate:g} Hz) that "
            f"divides the engine's rate ({substeps * rate:g} Hz); valid: {listed}"
        )
    return substeps // rows


def _stride(key: str, rate: float, measure_rate: float) -> int:
    """Samples from one measurement to the next.

    Args:
        key: The key that states the rate of measurements, for messages.
        rate: Rate of the samples [Hz].
        measure_rate: Rate of the measurements [Hz].

    Raises:
        ExperimentError: The rate of the measurements does not divide that of the samples.
    """
    ratio = rate / measure_rate
    stride = round(ratio)
    if stride < 1 or abs(ratio - stride) > RATE_TOLERANCE * stride:
        valid = ", ".join(f"{rate / k:g}" for k in (1, 2, 4, 5, 10))
        raise ExperimentError(
            f"{key}: {measure_rate:g} Hz does not divide rate {rate:g} Hz; valid: {valid}"
        )
    return stride
