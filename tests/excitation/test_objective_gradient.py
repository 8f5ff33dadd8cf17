"""The adjoint gradient of J against central differences of J through the projection, on models of
every kind.

In every experiment here limits, clamps and contacts do not act: the models have none, or the
control is too weak to reach them (a docstring says so).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.search.levels import DescentLevel
from mjfim.excitation.task import DesignTask
from mjfim.optimize.lq import TangentCurve, regulator
from mjfim.optimize.projection_operator import Expansion
from mjfim.plant.mixed_derivatives import (
    CENTRAL_DIFFERENCES,
    FORWARD_DIFFERENCES,
    DifferenceAccuracy,
)
from tests.support.numerics import (
    CART_PARAMETERS,
    CART_PENDULUM,
    Array,
    body_task,
    cart_task,
    filtered_task,
    make_task,
    relative_error,
    richardson,
    shared_model,
)

TRACKING = {
    "tracking": {"slide": 0.3, "hinge": 0.1},
    "tracking_velocity": {"slide": 0.2},
    "control": 1e-2,
}


def furuta(folder: Path) -> DesignTask:
    """The Qube, implicitfast, 20 steps per sample, neither limits nor contacts."""
    parameters = {
        "arm": {"target": "joint/theta:damping", "guess": 1e-3},
        "gear": "actuator/motor:gear",
    }
    control = {"kind": "sine", "amplitude": 5e-3, "frequency": 1.5}
    initial = {"qpos": (0.1, 0.3), "control": control}
    model = shared_model("qube_furuta/furuta_pendulum_implicitfast.xml")
    return make_task(
        model, folder, initial=initial, parameters=parameters, noise={"state": 0.01}, horizon=0.4
    )


def cart(integrator: str = "RK4", **tables: Any) -> Callable[[Path], DesignTask]:
    """Cart-pendulum with changes."""
    return lambda folder: cart_task(folder, integrator, **tables)


def servo(folder: Path) -> DesignTask:
    """Cart under a position servo whose gain and damping are unknown but not wanted."""
    motor, position = "<motor", '<position kp="30" kv="4"'
    xml = CART_PENDULUM.format(integrator="implicitfast").replace(motor, position)
    unwanted = {
        n: {"target": f"actuator/force:{n}", "nuisance": True, "prior": 2.0} for n in ("kp", "kv")
    }
    control = {"kind": "sine", "amplitude": 0.3, "frequency": 1.2}
    return make_task(
        xml,
        folder,
        parameters={**CART_PARAMETERS, **unwanted},
        noise={"angle": 0.01, "rate": 0.05, "drive": 0.1},
        initial={"qpos": (0.1, 3.0), "qvel": (0.0, 0.4), "control": control},
    )


def staged(task: DesignTask, basis: Array | None = None, power: float = np.inf) -> DesignTask:
    """A task with the cost of a stage of the descent."""
    vars(task)["problem"] = DescentLevel(task, basis, power).problem
    return task


# Components of one quaternion measured alike would hold the same information at every orientation.
BALL = {
    "qpos:ball.qw": 0.01,
    "qpos:ball.qx": 0.05,
    "qpos:float": 0.02,
    "qvel:ball": 0.05,
    "gyro": 0.05,
}
COVARIANCE = ((1e-4, 3e-4, 0.0), (3e-4, 2.5e-3, 5e-4), (0.0, 5e-4, 0.01))
CORRELATED = ({"outputs": ("angle", "rate", "drive"), "covariance": COVARIANCE},)
SENSED = {"angle": 0.01, "rate": 0.05, "drive": 0.1, "acc": 0.3}
LATE = {"initial": {"qpos:hinge": 0.05, "qvel:slide": True}, "bias": 0.1, "delay": 0.02}
KNOWN = {n: {**t, "bounds": (0.2, 3.0), "prior": 0.1} for n, t in CART_PARAMETERS.items()}
BASIS = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 2)))[0]

SETUPS = {
    "cart E tracking": cart(cost={**TRACKING, "criterion": "E"}),
    "cart A tracking": cart(cost={**TRACKING, "criterion": "A"}),
    "cart D tracking": cart(cost={**TRACKING, "criterion": "D"}),
    "cart implicitfast, every fifth sample": cart("implicitfast", measure_rate=20.0),
    "cart sensors, priors": cart(
        noise={"acc": 0.3},
        parameters={
            "m": {"target": "body/bob:mass", "prior": 0.2},
            "l": {"target": "body/bob:pos[2]", "prior": 0.3},
            "M": {"target": "body/cart:mass", "scale": 0.5},
        },
        cost={"criterion": "A"},
    ),
    "free body with ball joint": body_task,
    "free body D": lambda folder: body_task(folder, "Euler", cost={"criterion": "D"}),
    "activation": filtered_task,
    "ball joint, start unknown": lambda folder: body_task(
        folder, nuisance={"initial": {"qvel:ball.ry": True}}
    ),
    "bias and delay unknown": cart(nuisance={"bias": True, "delay": True}, cost={"criterion": "D"}),
    "scales and delay wanted": cart(
        parameters={
            **CART_PARAMETERS,
            "angle": {"target": "output/angle:scale", "guess": 0.1},
            "acc": {"target": "output/acc[2]:scale", "guess": -0.05, "prior": 0.1},
            "lag": {"target": "output:delay", "guess": 0.013},
        },
        noise=SENSED,
    ),
    "sensors, all nuisances": cart(
        "implicitfast", noise=SENSED, nuisance=LATE, cost={"criterion": "A"}
    ),
    "servo of unknown gain": servo,
    "correlated noise, nuisances": cart(
        noise=SENSED, correlated=CORRELATED, nuisance=LATE, measure_rate=50.0
    ),
    "every sensor at its own rate": cart(noise={**SENSED, "acc": {"sigma": 0.3, "rate": 20.0}}),
    "quaternions measured": lambda folder: body_task(folder, noise=BALL),
    "all states of a free body": lambda folder: body_task(folder, noise={"state": 0.02}),
    "quaternions measured late": lambda folder: body_task(
        folder, noise=BALL, nuisance={"delay": 0.01}
    ),
    "cart c combination": cart(
        cost={"criterion": "c", "combination": {"m": 1.0, "l": -0.5}}, nuisance=LATE
    ),
    "cart c subset": cart(cost={"criterion": "c", "subset": ("l", "c")}),
    "cart E smooth": lambda folder: staged(cart_task(folder, nuisance=LATE), power=40.0),
    "cart E smooth, nearly a sum": lambda folder: staged(cart_task(folder), power=1.5),
    "cart E on combinations": lambda folder: staged(cart_task(folder, nuisance=LATE), BASIS),
    "cart c on combinations": lambda folder: staged(
        cart_task(folder, cost={"criterion": "c", "subset": ("m", "l", "c")}), BASIS, 40.0
    ),
    "robust mean": cart(parameters=KNOWN, robust={"over": "mean", "samples": 4}, nuisance=LATE),
    "robust worst": cart(parameters=KNOWN, robust={"over": "worst", "samples": 4}, noise=SENSED),
    "robust worst D": cart(
        parameters=KNOWN, robust={"over": "worst", "samples": 3}, cost={"criterion": "D"}
    ),
    "qube_furuta": furuta,
}

# Where feedback takes most of the effect of a direction away, a longer step keeps clear of the
# round-off in J.
STEPS = {"sensors, all nuisances": 1e-2}


def gain(task: DesignTask) -> Array:
    """Regulator with unit weights along the initial trajectory."""
    A, B = (getattr(task.plant.derivatives.linearize(task.theta, task.initial), n) for n in "AB")
    Q, R = np.eye(task.space.nx) * task.dt, np.eye(task.plant.nu) * task.dt
    return regulator(A, B, Q, R, Q / task.dt)


def directions(task: DesignTask, gradient: Array) -> list[Array]:
    """Three control directions, (N, nu), scaled to the control: smooth, white and the gradient."""
    rng, size = np.random.default_rng(7), np.abs(task.control).max()
    t, nu = task.t / task.t[-1], task.plant.nu
    phase = rng.uniform(0, 2 * np.pi, nu)
    smooth = np.sin(2 * np.pi * rng.uniform(0.3, 3.0, nu) * t[:, None] + phase)
    white = rng.normal(size=(len(t), nu))
    return [size * v / np.abs(v).max() for v in (smooth, white, gradient)]


def expansion_of(task: DesignTask, accuracy: DifferenceAccuracy) -> tuple[DesignPoint, Expansion]:
    """A trajectory near the initial one, from which tracking is measured, and J about it."""
    nearby = task.plant.simulate(task.theta, 0.9 * task.control)
    point = task.problem.point(nearby, accuracy)
    assert np.isfinite(point.cost)
    return point, task.problem.expand(point)


# One case of each kind of task.
OFF = [
    "cart E tracking",
    "free body with ball joint",
    "activation",
    "quaternions measured",
    "sensors, all nuisances",
    "robust worst",
]


@pytest.mark.parametrize(
    ("case", "feedback"),
    [
        pytest.param(case, feedback, marks=[] if case in OFF else pytest.mark.slow)
        for case in SETUPS
        for feedback in ((False, True) if case in OFF else (True,))
    ],
    ids=lambda value: {False: "open loop", True: "feedback"}.get(value, value),
)
def test_the_gradient_is_that_of_J_through_the_projection(
    case: str, feedback: bool, tmp_path
) -> None:
    """Closely by central differences of the dynamics, and nearly so by the fast ones."""
    task = SETUPS[case](tmp_path)
    K = gain(task) * feedback
    point, expansion = expansion_of(task, CENTRAL_DIFFERENCES)
    ways = directions(task, expansion.gradient(K))
    measured = []
    for c in ways:
        zeta = expansion.lift(K, c)

        def J(t: float, zeta: TangentCurve = zeta) -> float:
            return task.problem.value(task.problem.project(point, zeta, t, K))

        measured.append(richardson(J, STEPS.get(case, 5e-3)))

    _, fast = expansion_of(task, FORWARD_DIFFERENCES)
    for found, accuracy in ((expansion, 1e-5), (fast, 1e-3)):
        slopes = np.array([found.slope(found.lift(K, c)) for c in ways])
        assert relative_error(slopes, np.array(measured)) < accuracy


def test_the_running_cost_is_the_stated_sum(tmp_path) -> None:
    task = cart_task(tmp_path, cost=TRACKING)
    running, rng = task.problem.running, np.random.default_rng(4)
    curve = task.plant.simulate(task.theta, task.control + rng.normal(size=task.control.shape))
    # 0.01 s per sample; the squares of the deviations and of the control.
    Q, away = 0.01 * np.array([0.3, 0.1, 0.2, 0.0]), (curve.state - task.initial.state)[1:]
    total = 0.5 * np.sum(Q * away**2) + 0.5e-4 * np.sum(curve.ctrl**2)
    assert running.value(curve) == pytest.approx(total, rel=1e-12)
    assert running.value(task.initial) == pytest.approx(0.5e-4 * np.sum(task.control**2), rel=1e-12)


def test_the_size_of_J_of_D_optimality_is_one_nat_per_parameter(tmp_path) -> None:
    for criterion in "EAD":
        task = cart_task(tmp_path, cost={**TRACKING, "criterion": criterion, "information": 0.3})
        point = task.problem.point(task.initial)
        of_d = 0.3 * 3 + task.problem.running.value(task.initial)
        wanted = of_d if criterion == "D" else point.cost
        assert task.problem.size(point) == pytest.approx(wanted)
        assert (point.cost < 0.0) is (criterion == "D")


def test_a_diverged_trial_has_infinite_cost_and_no_expansion(tmp_path) -> None:
    task = cart_task(tmp_path)
    point, expansion = expansion_of(task, FORWARD_DIFFERENCES)
    K = np.zeros((task.samples, 1, 4))
    lost = task.problem.project(point, expansion.lift(K, np.full((task.samples, 1), 9e9)), 1.0, K)
    assert task.problem.value(lost) == np.inf
    with pytest.raises(ValueError, match="diverged"):
        task.problem.expand(lost)


def test_refining_keeps_the_trajectory_and_its_cost_and_is_possible_once(tmp_path) -> None:
    task = cart_task(tmp_path)
    point = task.problem.point(task.initial, FORWARD_DIFFERENCES)
    better = task.problem.refine(point)
    assert better.accuracy is CENTRAL_DIFFERENCES
    assert better.trajectory is point.trajectory
    assert better.cost == point.cost
    assert task.problem.refine(better) is None
