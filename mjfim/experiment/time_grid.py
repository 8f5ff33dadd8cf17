"""The time grid of an experiment: how its rates divide the time into samples and engine steps."""

from __future__ import annotations

from dataclasses import replace

from mjfim.arrays import record
from mjfim.errors import ExperimentError
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system_tables import NoiseSpec
from mjfim.model.variants import ModelVariant

# Largest number of engine steps of a sample, so that a mistyped rate or timestep does not exhaust
# the memory.
MAX_SUBSTEPS = 100_000

# A ratio of two rates counts as a whole number within this relative tolerance.
RATE_TOLERANCE = 1e-6


@record
class TimeGrid:
    """Division of the time into samples, measurements and engine steps.

    Attributes:
        dt: Sample period [s].
        substeps: Engine steps per sample.
        stride: Samples from one measurement to the next.
        playback_steps: Engine steps per row of design.csv, on the stated grid.
    """

    dt: float
    substeps: int
    stride: int
    playback_steps: int

    @staticmethod
    def stated(experiment: Experiment, timestep: float) -> TimeGrid:
        """The grid that an experiment states, with the timestep of its model [s].

        Raises:
            ExperimentError: A rate does not divide the other one, or is not a whole number of
                timesteps.
        """
        rate, playback_rate = experiment.rate, experiment.playback_rate
        substeps = whole_number(1.0 / (rate * timestep))
        if substeps is None:
            raise ExperimentError(
                f"rate: at {rate:g} Hz, a sample is not a whole number of timesteps ({timestep:g} "
                f"s); write one of {rates_near(1.0 / (rate * timestep), timestep)} Hz. A log keeps "
                "its own rate, whatever `rate` is"
            )
        if substeps > MAX_SUBSTEPS:
            raise ExperimentError(
                f"rate: at {rate:g} Hz, a sample is {substeps:g} timesteps ({timestep:g} s); at "
                f"most {MAX_SUBSTEPS:g} are possible, that is {1.0 / (MAX_SUBSTEPS * timestep):g} "
                "Hz or more"
            )

        rows = 1 if playback_rate is None else whole_number(playback_rate / rate)
        if rows is None or substeps % rows:
            valid = [k for k in range(1, substeps + 1) if substeps % k == 0]
            raise ExperimentError(
                f"playback_rate: {playback_rate:g} Hz is not a multiple of rate ({rate:g} Hz) that "
                f"divides the engine's rate ({substeps * rate:g} Hz); valid: "
                f"{', '.join(written_rate(k * rate) for k in valid)}"
            )
        return TimeGrid(
            dt=substeps * timestep,
            substeps=substeps,
            stride=_stride("measure_rate", rate, experiment.measure_rate or rate),
            playback_steps=substeps // rows,
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

    Raises:
        ExperimentError: A rate does not divide `rate`, or gives no measurement.
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


def whole_number(ratio: float) -> int | None:
    """A ratio of rates that is a whole number within the tolerance, or None."""
    n = round(ratio)
    return n if n >= 1 and abs(ratio - n) <= RATE_TOLERANCE * n else None


def rates_near(steps: float, timestep: float) -> str:
    """Rates [Hz] whose periods are whole numbers of timesteps [s] near a wanted one, in words.

    Those with few digits come first.
    """
    near = max(round(steps), 1)
    rates = [written_rate(1.0 / (k * timestep)) for k in (near + 1, near, near - 1) if k]
    return ", ".join(sorted(rates, key=len))


def parts_of(rate: float) -> str:
    """Some rates that divide another one [Hz], for a message."""
    return ", ".join(written_rate(rate / k) for k in (1, 2, 4, 5, 10))


def written_rate(rate: float) -> str:
    """A rate [Hz] with so many digits that it is within the tolerance when it is read again."""
    return f"{rate:.9g}"


def _stride(key: str, rate: float, measure_rate: float) -> int:
    """Samples from one measurement to the next."""
    stride = whole_number(rate / measure_rate)
    if stride is None:
        raise ExperimentError(
            f"{key}: {measure_rate:g} Hz does not divide rate {rate:g} Hz; valid: {parts_of(rate)}"
        )
    return stride
