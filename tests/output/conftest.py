"""Designs that several tests of exports share; their accuracy does not matter."""

from __future__ import annotations

from typing import Any

import pytest

import mjfim
from tests.support.paths import MODELS

# An experiment and a design for it.
Designed = tuple[mjfim.Experiment, mjfim.Design]


def designed(name: str, **tables: Any) -> Designed:
    """An example and its design after two iterations."""
    stated = mjfim.Experiment.from_file(MODELS / f"{name}.toml")
    stated = stated.replace(
        **{"descent": {"max_iterations": 2}, "rehearsal": {"robots": 4}, **tables}
    )
    return stated, mjfim.design(stated)


@pytest.fixture(scope="session")
def cart() -> Designed:
    """A design of 4 s at 100 Hz with a motor of ±20 N on one of two joints."""
    limits = {"control": {"force": [-20.0, 20.0]}}
    return designed("cart_pendulum", measure_rate=100.0, limits=limits)


@pytest.fixture(scope="session")
def arm() -> Designed:
    """A design of 0.5 s at 100 Hz with a position servo on every joint."""
    return designed("servo_arm", horizon=0.5)
