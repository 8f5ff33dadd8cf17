"""`mjfim validate`: what an experiment file states, once all its names and numbers are checked."""

from __future__ import annotations

from mjfim.excitation.limits import limits_of
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.experiment.stated_units import probable_degrees
from mjfim.experiment.system import System
from mjfim.identification.laws_in_loop import laws_in_loop
from mjfim.records.inventory import (
    StatedExperiment,
    StatedLimit,
    StatedOutput,
    StatedParameter,
)


def stated_experiment(experiment: Experiment) -> StatedExperiment:
    """Check an experiment against its model, and say what it states.

    Args:
        experiment: The experiment.

    Raises:
        ExperimentError: A name, a file or a number in the experiment is wrong; the message names
            the key.
        ModelError: The model cannot be used.
    """
    system = System.resolve(experiment)

    missing = []
    if experiment.horizon is None:
        missing.append("horizon")
    if experiment.initial.control is None and system.controls:
        missing.append("initial.control")

    # A file for recordings alone needs no task of a design.
    if missing or system.laws is not None:
        limits = limits_of(system.model, system.controls, experiment.limits, system.dt)
    else:
        limits = DesignTask.of(system).limits

    return StatedExperiment(
        source=experiment.source,
        model=str(system.model_path),
        rate=experiment.rate,
        horizon=experiment.horizon,
        parameters=tuple(
            StatedParameter(
                name=parameter.name,
                unit=parameter.unit,
                guess=parameter.guess,
                lower=parameter.bounds[0],
                upper=parameter.bounds[1],
                nuisance=parameter.nuisance,
            )
            for parameter in system.parameters.parameters
        ),
        outputs=tuple(
            StatedOutput(name=output.name, unit=output.unit, sigma=output.sigma)
            for output in system.outputs.outputs
        ),
        controls=system.controls,
        limits=tuple(
            StatedLimit(
                quantity=limit.kind,
                name=limit.name,
                lower=limit.lower,
                upper=limit.upper,
                unit=limit.unit,
            )
            for limit in limits
        ),
        controllers=laws_in_loop(system, system.parameters.guess, {}),
        missing=tuple(missing),
        warnings=probable_degrees(experiment, system.source),
    )
