"""Several experiments about the same parameters, whose information adds up, designed together."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjfim.designer import Monitor, design
from mjfim.earlier import marginal
from mjfim.errors import ExperimentError, SimulationDiverged
from mjfim.experiment import Experiment
from mjfim.plant import CENTRAL
from mjfim.setup import Setup
from mjfim.trajectory import Array, Design


def design_together(
    experiments: Sequence[Experiment],
    monitor: Monitor | None = None,
    rounds: int = 5,
    tolerance: float = 1e-3,
    threads: int | None = None,
) -> tuple[Design, ...]:
    """Design each experiment in turn, given what the others tell, until none improves the criterion by more than tolerance.

    The designs depend on each other through the sum of their information alone, so where no single one can improve, none
    of them together can to first order. `final.information` of each design holds all of it. The experiments state the same
    parameters in the same order. Raises ExperimentError where they do not; see also `design`.
    """
    setups = [Setup(experiment, threads) for experiment in experiments]
    names = [setup.parameters.names for setup in setups]
    if len(setups) < 2 or any(own != names[0] for own in names):
        told = "; ".join(", ".join(own) for own in names)
        raise ExperimentError(
            f"design_together takes two or more experiments with the same parameters in one order: {told}"
        )
    tells = [_data(setup) for setup in setups]
    controls: list[Array | None] = [None] * len(setups)
    designs: list[Design] = []
    last = np.inf
    for _ in range(rounds):
        designs = []
        for i, setup in enumerate(setups):
            others = sum((tells[j] for j in range(len(setups)) if j != i), start=np.zeros_like(tells[0]))
            found = design(Setup(setup.experiment, threads, added=others), monitor, controls[i])
            controls[i] = found.trajectory.ctrl
            tells[i] = _wanted(setup, found.final.information - found.prior)
            designs.append(found)
        reached = designs[-1].final.criterion
        if last - reached <= tolerance * abs(reached):
            break
        last = reached
    return tuple(designs)


def _data(setup: Setup) -> Array:
    """What the initial control tells about the wanted parameters."""
    information = setup.problem.point(setup.initial, CENTRAL).information
    if information is None:
        raise SimulationDiverged("the simulation diverges when the parameters move a little along the initial control")
    return _wanted(setup, information - setup.information.prior)


def _wanted(setup: Setup, data: Array) -> Array:
    """(p, p) information about the wanted parameters alone: every experiment has its own nuisance, known by its prior."""
    p = setup.parameters
    out = np.zeros_like(data)
    out[np.ix_(p.interest, p.interest)] = marginal(data, p.prior_information, p.interest)
    return out
