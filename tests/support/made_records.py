"""Hand-made records of results of any size, for figures and tables."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.records.design import Design, Evaluation, HistoryRow, Status
from mjfim.records.estimate import Estimate
from mjfim.records.robots import (
    OddRecording,
    RecordingComparison,
)
from mjfim.records.studies import (
    Comparison,
    MethodOutcome,
    MethodResult,
    MonteCarloStudy,
    TrialStatistics,
)
from mjfim.records.trajectory import Labels, Recording, Trajectory


def padded(name: str, width: int) -> str:
    """Lengthen a name in its middle to a number of characters, so that its ends differ."""
    head, _, tail = name.partition("_")
    return f"{head}_{'w' * max(width - len(name) - 1, 0)}_{tail}" if width > len(name) else name


def make_labels(dofs: int, count: int, width: int = 0) -> Labels:
    """Make labels of a chain of hinges, with names of at least `width` characters."""
    joints = [padded(f"joint_{i}", width) for i in range(dofs)]
    return Labels(
        qpos=tuple(f"{j} [rad]" for j in joints),
        positions=tuple(f"{j} [rad]" for j in joints),
        velocities=tuple(f"{j} [rad/s]" for j in joints),
        controls=("torque [N m]",),
        parameters=tuple(padded(f"link_{j}.damping", width) for j in range(count)),
        parameter_units=tuple(("N m s/rad", "kg", "")[j % 3] for j in range(count)),
        outputs={f"qpos:{j}": f"{j} [rad]" for j in joints},
    )


def falling(std: Array, t: Array) -> Array:
    """Standard deviations that fall like the root of the time (n,) to the last ones: (n, p)."""
    with np.errstate(divide="ignore"):
        return std * np.sqrt(t[-1] / t)[:, None]


def make_evaluation(
    dofs: int, count: int, size: float, samples: int = 50, speed: float = 1.0
) -> Evaluation:
    """Make sinusoids of the given size; a larger motion is more informative."""
    t = np.linspace(0.0, 2.0, samples + 1)
    waves = size * np.sin(speed * np.outer(t, 1.0 + np.arange(dofs)))
    curve = Trajectory(
        t=t,
        qpos=waves,
        qvel=np.gradient(waves, t, axis=0),
        act=np.zeros((samples + 1, 0)),
        ctrl=size * np.cos(t[:-1, None]),
    )
    std = 0.1 / size / np.sqrt(1.0 + np.arange(count))
    phases = np.multiply.outer(t, 1.0 + np.arange(2 * dofs * count))
    criterion = 1.0 / size**2
    return Evaluation(
        trajectory=curve,
        gain=np.zeros((samples, 1, 2 * dofs)),
        sensitivity=size * np.sin(phases).reshape(-1, 2 * dofs, count),
        information=np.diag(std**-2),
        eigenvalues=size**2 * (1.0 + np.arange(count)),
        std=std,
        std_over_time=falling(std, t),
        criterion=criterion,
        cost=criterion + 0.01,
    )


def make_row(**changes: object) -> HistoryRow:
    """Make an iterate whose numbers are one, with other values of some fields."""
    ones = dict.fromkeys(("cost", "criterion", "min_eigenvalue", "slope", "gamma"), 1.0)
    return HistoryRow(**{**ones, "iteration": 0, "seconds": 0.0, "steps": 0, **changes})


def ten_iterates() -> tuple[HistoryRow, ...]:
    """Ten iterates, each with half of the cost of the one before."""
    return tuple(
        make_row(
            iteration=i,
            cost=2.0**-i,
            criterion=2.0**-i,
            min_eigenvalue=2.0**i,
            slope=-(4.0**-i),
            seconds=0.1 * i,
            steps=100 * i,
        )
        for i in range(10)
    )


def plain_labels(parameters: Sequence[str]) -> Labels:
    """Labels of parameters without units."""
    columns = dict.fromkeys(("qpos", "positions", "velocities", "controls"), ())
    units = ("",) * len(parameters)
    return Labels(parameters=tuple(parameters), parameter_units=units, **columns)


def make_design(dofs: int = 2, count: int = 3) -> Design:
    """Make a design of ten iterations from a small to a large motion."""
    rows = ten_iterates()
    names = tuple(f"link_{j}.damping" for j in range(count))
    return Design(
        status=Status.CONVERGED,
        parameters=names,
        labels=make_labels(dofs, count),
        theta=np.linspace(1.0, 2.0, count),
        initial=make_evaluation(dofs, count, 0.1),
        final=make_evaluation(dofs, count, 1.0),
        history=rows,
        slope=1e-8,
        steps=1000,
        seconds=1.0,
    )


def make_trials(theta: Array, std: float, failed: int, seed: int) -> TrialStatistics:
    """Make efficient estimates; the first `failed` rows are NaN."""
    count = len(theta)
    estimates = theta + std * np.random.default_rng(seed).normal(size=(200, count))
    estimates[:failed] = np.nan
    spread = np.diag(np.full(count, std**2))
    interval = np.tile([0.8, 1.2], (count, 1))
    return TrialStatistics(
        estimates=estimates,
        mean=theta,
        covariance=spread,
        crlb=spread,
        efficiency=np.ones(count),
        efficiency_interval=interval,
        trials=200,
        failed=failed,
    )


def make_study(count: int = 3, failed: int = 5) -> MonteCarloStudy:
    """Make a study of two trajectories; the scatter of the second is fifty times smaller."""
    theta = np.linspace(1.0, 2.0, count)
    sets = {
        "initial": make_trials(theta, 0.2, failed, 0),
        "final": make_trials(theta, 0.004, failed, 1),
    }
    information = {name: np.diag(1.0 / np.diagonal(trials.crlb)) for name, trials in sets.items()}
    names = tuple(f"link_{j}.damping" for j in range(count))
    return MonteCarloStudy(
        parameters=names,
        labels=plain_labels(names),
        theta=theta,
        measure_rate=25.0,
        sets=sets,
        information=information,
    )


def bare_estimate(parameters: Sequence[str], theta: Array, std: Array, **changes: Any) -> Estimate:
    """An estimate that converged with independent errors, from no recording."""
    fields = {
        "parameters": tuple(parameters),
        "labels": plain_labels(parameters),
        "theta": theta,
        "std": std,
        "covariance": np.diag(std**2),
        "initial_theta": 1.2 * theta,
        "chi2": 1.0,
        "dof": 1,
        "status": "converged",
        "converged": True,
        "misfit": False,
        "iterations": 4,
        "residual_rms": {},
        "at_bound": (),
        "predicted": (),
        "recordings": (),
    }
    return Estimate(**{**fields, **changes})


def make_estimate(dofs: int = 2, count: int = 3, misfit: bool = False) -> Estimate:
    """Make an estimate from one recording with gaps; the first parameter is at its bound."""
    t = np.linspace(0.0, 2.0, 51)
    predicted = np.sin(np.outer(t, 1.0 + np.arange(dofs)))
    measured = predicted + 0.05 * np.random.default_rng(2).normal(size=predicted.shape)
    measured[10:20, 0] = np.nan
    recording = Recording(
        t=t,
        ctrl=np.zeros((50, 1)),
        y=measured,
        outputs=tuple(f"qpos:joint_{i}" for i in range(dofs)),
        name="swing",
    )
    theta = np.linspace(1.0, 2.0, count)
    return bare_estimate(
        [f"link_{j}.damping" for j in range(count)],
        theta,
        0.02 * theta,
        chi2=50.0,
        dof=48,
        misfit=misfit,
        at_bound=("link_0.damping",),
        predicted=(predicted,),
        recordings=(recording,),
    )


def make_recording_comparison(
    parameters: tuple[str, ...], units: tuple[str, ...], names: tuple[str, ...]
) -> RecordingComparison:
    """Make a comparison of recordings; the second one is odd in the first parameter."""
    count = len(names)
    truth = np.linspace(1.0, 2.0, len(parameters))
    std = np.tile(0.05 * truth, (count, 1))
    values = truth + std * np.random.default_rng(3).normal(size=std.shape)
    values[1, 0] += 0.5
    values[0, -1], std[0, -1] = np.nan, np.inf
    odd = OddRecording(
        index=1,
        name=names[1],
        p=2e-5,
        parameters=parameters[:1],
        differences=(f"its {parameters[0]} is 50 % above that of the others (p = 2e-05)",),
    )
    half = np.column_stack([truth - 0.05, truth + 0.05])
    return RecordingComparison(
        recordings=names,
        parameters=parameters,
        units=units,
        is_stated=np.zeros(len(parameters)),
        values=values,
        std=std,
        mean=truth,
        interval=half,
        tau=0.02 * truth,
        share=np.full(len(parameters), 0.3),
        p=np.geomspace(1e-5, 1.0, len(parameters)),
        prediction=half + np.array([-0.1, 0.1]),
        joint_p=1e-4,
        odd=(odd,),
    )


def make_method_result(method: str, cost: float, **changes: object) -> MethodResult:
    """Make what a method of a comparison found for one parameter, without limits."""
    found = MethodResult(
        method=method,
        title=method,
        outcome=MethodOutcome.INSIDE,
        control=None,
        cost=cost,
        criterion=cost,
        std=np.array([0.01]),
        min_eigenvalue=1.0,
        worst_relative_std=0.01,
        seconds=1.0,
        steps=100,
        margins={},
        relative_margins={},
    )
    return replace(found, **changes)


def make_comparison(*rows: MethodResult, **changes: object) -> Comparison:
    """Make a comparison of methods by their largest sigma, of one parameter."""
    made = Comparison(
        source="e",
        criterion="E",
        nats=0.0,
        parameters=("m",),
        units=("kg",),
        scale=np.ones(1),
        nuisance=(),
        rows=rows,
        seconds=1.0,
        seed=0,
        weighted=False,
    )
    return replace(made, **changes)
