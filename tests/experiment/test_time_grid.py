"""Rates: what a message proposes is valid when it is written into the file."""

from __future__ import annotations

import re
from typing import Any

import pytest

from mjfim.errors import ExperimentError
from mjfim.experiment.schema import Experiment
from mjfim.experiment.signals import TimeGrid


def experiment(rate: float, **keys: Any) -> Experiment:
    """An experiment with some rates."""
    return Experiment(
        model="m.xml",
        rate=rate,
        parameters={"m": {"target": "body/b:mass"}},
        noise={"b": 0.1},
        **keys,
    )


@pytest.mark.parametrize("timestep", [0.002, 0.003, 0.007, 0.01])
@pytest.mark.parametrize("rate", [7.3, 30.1, 41.0])
def test_every_rate_that_is_proposed_is_valid(rate: float, timestep: float) -> None:
    with pytest.raises(ExperimentError) as fault:
        TimeGrid.stated(experiment(rate), timestep)
    [named] = re.findall(r"write one of (.*) Hz\. ", str(fault.value))
    assert len(named.split(", ")) >= 2
    for text in named.split(", "):
        grid = TimeGrid.stated(experiment(float(text)), timestep)
        assert grid.dt == pytest.approx(1.0 / rate, rel=0.7)


@pytest.mark.parametrize("key", ["playback_rate", "measure_rate"])
def test_every_further_rate_that_is_proposed_is_valid(key: str) -> None:
    rate, timestep = 33.3333333, 0.001
    with pytest.raises(ExperimentError, match="valid") as fault:
        TimeGrid.stated(experiment(rate, **{key: 41.0}), timestep)
    for text in str(fault.value).partition("valid: ")[2].split(", "):
        TimeGrid.stated(experiment(rate, **{key: float(text)}), timestep)
