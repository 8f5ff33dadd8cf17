"""The cart-pendulum of the paper, logs of it under its initial control, and fits to them."""

from __future__ import annotations

from typing import Any

from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System, simulate_system
from mjfim.identification.search import FitTask
from mjfim.records.trajectory import Recording
from tests.support.paths import MODELS

# A short study of the same model as Python states it.
MODEL = MODELS / "cart_pendulum.xml"
STATED = {
    "model": MODEL,
    "rate": 50.0,
    "horizon": 0.4,
    "initial": {"control": {"kind": "multisine", "amplitude": 2.0}},
    "parameters": {"m": "body/bob:mass", "c": "joint/hinge:damping"},
    "noise": {"qpos:slide": 0.01, "qpos:hinge": 0.01, "qvel:hinge": 0.1},
}


def cart_pendulum(**tables: Any) -> Experiment:
    """The cart-pendulum with some tables changed; few robots rehearse its designs."""
    tables = {"rehearsal": {"robots": 4}, **tables}
    return Experiment.from_file(MODELS / "cart_pendulum.toml").replace(**tables)


def logs_of(experiment: Experiment, *seeds: int) -> list[Recording]:
    """Logs under the initial control, which differ by their noise."""
    task = DesignTask.resolve(experiment, threads=1)
    return [simulate_system(task.system, task.initial, seed) for seed in seeds]


def fit_of(experiment: Experiment, *seeds: int) -> FitTask:
    """The fit to such logs."""
    return FitTask.of(System.resolve(experiment, threads=1), logs_of(experiment, *seeds))
