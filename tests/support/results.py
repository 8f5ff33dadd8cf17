"""Made-up results of every verb, for tests of how they are shown; nothing is simulated."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.records.design import (
    Design,
    Evaluation,
    HistoryRow,
    LimitUsage,
    Status,
)
from mjfim.records.estimate import (
    Estimate,
    MissingTerm,
    Prediction,
    PredictionErrors,
    Whiteness,
)
from mjfim.records.labels import Labels
from mjfim.records.recording import Recording
from mjfim.records.trajectory import Trajectory

# Names of the parameters of all results.
PARAMETERS = ("mass", "length", "damping")
UNITS = ("kg", "m", "N m s/rad")
THETA = np.array([2.0, 1.0, 0.5])

# Correlation of the estimates of the first two parameters.
CORRELATION = 0.8


def labels(name: str = "hinge") -> Labels:
    """Labels of a model with one joint."""
    return Labels(
        qpos=(f"{name} [rad]",),
        positions=(f"{name} [rad]",),
        velocities=(f"{name} velocity [rad/s]",),
        controls=("motor [N m]",),
        parameters=PARAMETERS,
        parameter_units=UNITS,
        outputs={f"qpos:{name}": f"qpos:{name} [rad]"},
    )


def covariance(std: Array) -> Array:
    """Covariance with these standard deviations, in which the first two are correlated."""
    correlation = np.eye(len(std))
    correlation[0, 1] = correlation[1, 0] = CORRELATION
    return np.asarray(correlation * np.outer(std, std))


def evaluation(size: float, samples: int) -> Evaluation:
    """A sinusoid of a given size; a larger one tells more."""
    t = np.linspace(0.0, 2.0, samples + 1)
    wave = size * np.sin(6.0 * t)[:, None]
    trajectory = Trajectory(
        t=t,
        qpos=wave,
        qvel=6.0 * size * np.cos(6.0 * t)[:, None],
        act=np.zeros((samples + 1, 0)),
        ctrl=size * np.cos(t[:-1, None]),
    )
    std = 0.01 / size * THETA
    return Evaluation(
        trajectory=trajectory,
        gain=np.zeros((samples, 1, 2)),
        sensitivity=np.zeros((samples + 1, 2, 3)),
        information=np.linalg.inv(covariance(std)),
        eigenvalues=size**2 * np.array([1.0, 2.0, 3.0]),
        std=std,
        min_eigenvalue=size**2 * t,
        criterion=size**-2,
        cost=size**-2,
    )


def design(name: str = "hinge", samples: int = 50, **changes: object) -> Design:
    """A design of ten iterations within a limit of the position."""
    history = tuple(
        HistoryRow(
            iteration=i,
            cost=2.0**-i,
            criterion=2.0**-i,
            min_eigenvalue=2.0**i,
            slope=-(4.0**-i),
            gamma=1.0,
            seconds=0.1 * i,
            steps=100 * i,
        )
        for i in range(10)
    )
    final = evaluation(1.0, samples)
    share = 0.9 * final.trajectory.qpos[:, 0]
    fields: dict[str, object] = {
        "status": Status.CONVERGED,
        "parameters": PARAMETERS,
        "theta": THETA,
        "initial": evaluation(0.1, samples),
        "final": final,
        "history": history,
        "slope": 1e-8,
        "steps": 1000,
        "seconds": 1.5,
        "limits": {"position": 0.1},
        "usage": (LimitUsage(kind="position", name=name, t=final.trajectory.t, share=share),),
        "labels": labels(name),
    }
    return Design(**{**fields, **changes})  # type: ignore[arg-type]


def estimate(name: str = "hinge", samples: int = 200, **changes: object) -> Estimate:
    """An estimate from one recording, with a prediction of another one."""
    t = np.linspace(0.0, 2.0, samples + 1)
    predicted = np.sin(6.0 * t)[:, None]
    noise = 0.05 * np.random.default_rng(0).normal(size=predicted.shape)
    output = f"qpos:{name}"
    recording = Recording(
        t=t,
        ctrl=np.zeros((samples, 1)),
        y=predicted + noise,
        outputs=(output,),
        name="logs/swing.csv",
    )
    std = 0.01 * THETA
    errors = [
        PredictionErrors(name="new", outputs=(output,), rms=np.array([rms]), mae=np.array([rms]))
        for rms in (0.05, 0.2)
    ]
    fields: dict[str, object] = {
        "parameters": PARAMETERS,
        "units": UNITS,
        "theta": THETA,
        "std": std,
        "covariance": covariance(std),
        "initial_theta": 1.2 * THETA,
        "chi2": 201.0,
        "dof": 198,
        "status": "converged",
        "success": True,
        "misfit": False,
        "iterations": 4,
        "residual_rms": {output: 0.05},
        "sigma": {output: 0.05},
        "at_bound": (),
        "predicted": (predicted,),
        "recordings": (recording,),
        "whiteness": (
            Whiteness(
                output=output,
                count=samples,
                variance=1.0,
                correlation=0.01,
                p=0.4,
                inflation=1.0,
                time=1.0,
            ),
        ),
        "predictions": (
            Prediction(name="logs/new.csv", identified=errors[0], nominal=errors[1], held_out=True),
        ),
        "labels": labels(name),
    }
    return Estimate(**{**fields, **changes})  # type: ignore[arg-type]


def missing_term() -> MissingTerm:
    """A term that the residuals ask for."""
    return MissingTerm(
        description="dry friction of the hinge",
        path="joint/hinge:frictionloss",
        value=0.1,
        unit="N m",
        sigmas=12.0,
        share=0.3,
    )
