"""The memory of designs, checks and fits is free as soon as nothing uses them any more."""

from __future__ import annotations

import gc
import weakref
from collections.abc import Callable, Iterator

import pytest

import mjfim
from mjfim.model.loading import ModelSource
from mjfim.model.parameters import ParameterSet
from mjfim.model.variants import PlantModel
from mjfim.plant.batch import BatchSimulator
from tests.support.paths import MODELS

# Whole jobs: these tests run in `.ci/run` only.
pytestmark = pytest.mark.slow

# Objects that keep models or simulations of MuJoCo, which the garbage collector counts as small.
KEEPERS = (BatchSimulator, ModelSource, ParameterSet, PlantModel)


@pytest.fixture
def living(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], int]]:
    """Number of living keepers that were made in the test; the garbage collector is off."""
    made = []

    def noted(kind: type) -> None:
        prepare = kind.__init__

        def note(self: object, *arguments: object, **options: object) -> None:
            prepare(self, *arguments, **options)
            made.append(weakref.ref(self))

        monkeypatch.setattr(kind, "__init__", note)

    for kind in KEEPERS:
        noted(kind)

    gc.disable()
    yield lambda: sum(reference() is not None for reference in made)
    gc.enable()


def short(name: str) -> mjfim.Experiment:
    """An experiment of the models' folder over a short time, with one iteration."""
    experiment = mjfim.Experiment.from_file(MODELS / name)
    descent = experiment.descent.model_copy(update={"max_iterations": 1})
    return experiment.model_copy(update={"descent": descent, "horizon": 0.2}).replace(
        rehearsal={"robots": 2}
    )


def test_designs_checks_and_fits_leave_no_simulator_behind(living) -> None:
    """Failed while plants and their derivatives referred to each other."""
    free = short("cart_pendulum.toml")
    recording = mjfim.simulate(free, mjfim.design(free).trajectory)
    before = living()

    for _ in range(2):
        mjfim.design(free)
        mjfim.check(free)
        mjfim.identify(free, [recording])
        assert living() == before


def test_a_design_under_limits_leaves_none_of_its_plants_behind(living) -> None:
    """Its search has further plants, one of them without clamps and stops."""
    mjfim.design(short("cart_pendulum_limits.toml"))
    assert living() == 0
