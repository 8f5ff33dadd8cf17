"""Equal inputs and seeds give equal files, whatever the number of threads and workers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import mjfim
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.output.archive import write_data
from mjfim.records.events import Event
from tests.support.contents import contents
from tests.support.limits import ARM, cart_inside, floating_task
from tests.support.numerics import filtered_task, make_task

# Whole jobs: these tests run in `.ci/run` only.
pytestmark = pytest.mark.slow


def study(experiment: Experiment, folder: Path, threads: int) -> dict[str, Any]:
    """Design, simulate, identify and repeat with noise; return all files without times."""
    # More threads of the linear algebra libraries must change nothing either.
    with threadpool_limits(threads, user_api="blas"):
        task = DesignTask.resolve(experiment, threads=threads)
        design = design_task(task)
        write_data(folder, design, task.system)

        recording = mjfim.simulate(experiment, design.trajectory, seed=3, threads=threads)
        mjfim.identify(experiment, [recording], threads=threads).save(folder)

        repeated = mjfim.monte_carlo(experiment, design.trajectory, trials=2, threads=threads)
        repeated.save(folder)

    return contents(folder)


def test_long_sums_are_not_divided_among_threads(tmp_path: Path) -> None:
    """The rounding of a sum depends on the number of threads of the linear algebra libraries."""
    task = cart_inside(tmp_path, horizon=0.3)
    seen: list[int] = []

    def look(event: Event) -> None:
        """Note the threads of every library."""
        seen.extend(one["num_threads"] for one in threadpool_info() if one["user_api"] == "blas")

    with threadpool_limits(2, user_api="blas"):
        mjfim.monte_carlo(task.experiment, task.initial, trials=2, callback=look)
        after = [one["num_threads"] for one in threadpool_info()]

    assert seen
    assert set(seen) == {1}
    assert 2 in after


def clearance(folder: Path) -> Experiment:
    """An arm that keeps its distance from the floor and a post, within limits of its servos."""
    sine = {"kind": "sine", "amplitude": 0.3, "frequency": 1.0}
    task = make_task(
        ARM,
        folder,
        horizon=0.4,
        initial={"qpos": (0.2, 0.3), "control": sine},
        parameters={"c": {"target": "joint/shoulder:damping"}},
        noise={"state": 0.02},
        cost={"control": 0.0},
        limits={"control": {"shoulder": (-1.0, 1.0), "elbow": (-1.0, 1.0)}, "clearance": 0.01},
        descent={"max_iterations": 4},
    )
    return task.experiment


def robust(folder: Path) -> Experiment:
    """A robust design, whose parameters are drawn at random, and a fit of several segments."""
    parameters = {"m": {"bounds": (0.5, 4.0)}, "l": {"bounds": (0.5, 2.0)}}
    task = cart_inside(folder, horizon=0.4, descent={"max_iterations": 4})
    return task.experiment.replace(
        parameters=parameters, robust={"samples": 4}, fit={"segments": 0.1}
    )


def floating(folder: Path) -> Experiment:
    """A floating arm with quaternions and an activation state, under many limits."""
    return floating_task(folder, horizon=0.1, descent={"max_iterations": 1}).experiment


def free(folder: Path) -> Experiment:
    """A free design with random initial controls."""
    return filtered_task(folder, descent={"max_iterations": 5, "starts": 2}).experiment


@pytest.mark.parametrize("make", [clearance, robust, floating, free])
def test_two_runs_with_other_numbers_of_threads_give_the_same_files(
    make: Any, tmp_path: Path
) -> None:
    experiment = make(tmp_path)
    first = study(experiment, tmp_path / "first", threads=1)
    assert {"design.csv", "reference.csv", "estimate.npz", "montecarlo.json"} <= set(first)
    assert study(experiment, tmp_path / "second", threads=2) == first
