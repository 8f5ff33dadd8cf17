"""Derivatives of mjfim, by differences, beside those of MJX, by automatic differentiation.

Development only; the package `mjfim` never imports this file. It needs the extra `oracle`.

MJX is MuJoCo's own second implementation of its engine, in JAX. In float64 one of its samples
equals one of MuJoCo to rounding, and JAX differentiates it exactly: no difference step and no code
of mjfim takes part. Where each parameter stands in the model is stated here once more, so that a
mistake in mjfim's own list would show as well.

The errors that are printed for each model are relative to the largest number of the derivative:

    F       one sample of MJX beside one of MuJoCo
    psi     d x_k / d theta along a whole trajectory, the worst parameter
    A, B    F_x and F_u at every sample
    mixed   d DF[psi w, w] / d (x, u), the second derivatives that give a design its gradient; with
            mjfim's most accurate differences, and with its quickest ones

"Closed" are the derivatives in closed form, which a design takes instead where there are enough
joints; there are none for RK4.

Usage:  python -m scripts.benchmarks mjx_oracle [--models NAME...]
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import field
from types import SimpleNamespace
from typing import Any

import jax
import mujoco
import numpy as np
from mujoco import mjx
from rich.console import Console

from mjfim.arrays import Array, record
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.plant.closed_form import closed_form_tree
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from scripts.benchmarks.child import ROOT, new_table, options_of

MODELS = ROOT / "models"


@record
class Case:
    """An experiment, and where its parameters stand in the model.

    Attributes:
        model: Name of the MJCF.
        keyframe: The initial state.
        control: The initial control.
        sigma: Noise of the state.
        parameters: Target of each parameter, and the array of MuJoCo's model and the index there of
            the number that it sets.
        scales: Scales of parameters; others have that of their guess.
        opposite: Further numbers, which are minus a parameter.
    """

    model: str
    keyframe: str
    control: Mapping[str, Any]
    sigma: float
    parameters: Mapping[str, tuple[Any, ...]]
    scales: Mapping[str, float] = field(default_factory=dict)
    opposite: Mapping[str, tuple[Any, ...]] = field(default_factory=dict)


# Bodies are counted from the world, joints and actuators from zero, in the order of the MJCF.
CASES = (
    Case(
        model="cart_pendulum",  # integrator RK4, one step per sample
        keyframe="hanging",
        control={"kind": "sine", "amplitude": 4.0, "frequency": 0.9},
        sigma=0.05,
        parameters={
            "m": ("body/bob:mass", "body_mass", 3),
            "l": ("body/bob:pos[2]", "body_pos", 3, 2),
            "c": ("joint/hinge:damping", "dof_damping", 1),
        },
        scales=dict.fromkeys("mlc", 1.0),
    ),
    Case(
        model="two_joint_arm",  # integrator implicitfast, ten steps per sample
        keyframe="hanging",
        control={"kind": "multisine", "amplitude": 3.0, "harmonics": 3},
        sigma=0.01,
        parameters={
            "mass": ("body/fore:mass", "body_mass", 2),
            "centre": ("body/fore:ipos[2]", "body_ipos", 2, 2),
            "upper_inertia": ("body/upper:inertia[1]", "body_inertia", 1, 1),
            "fore_inertia": ("body/fore:inertia[1]", "body_inertia", 2, 1),
            "armature": ("joint/elbow:armature", "dof_armature", 1),
            "damping": ("joint/shoulder:damping", "dof_damping", 0),
        },
    ),
    Case(
        model="servo_arm",  # integrator implicitfast, stiff servos, five steps per sample
        keyframe="settled",
        control={"kind": "sine", "amplitude": 0.1, "frequency": 0.9},
        sigma=0.01,
        parameters={
            "payload": ("body/payload:mass", "body_mass", 5),
            "payload_x": ("body/payload:ipos[0]", "body_ipos", 5, 0),
            "damping": ("joint/elbow:damping", "dof_damping", 2),
            "kp": ("actuator/shoulder:kp", "actuator_gainprm", 1, 0),
        },
        scales={"payload_x": 0.01},
        opposite={"kp": ("actuator_biasprm", 1, 1)},
    ),
)


def agreement(case: Case) -> Any:
    """Differentiate an experiment twice, and compare.

    Args:
        case: The experiment.

    Returns:
        Number of parameters p and of samples N, and relative differences: F of the states after one
        sample, psi of the sensitivities of the worst parameter, A of F_x, B of F_u, mixed of the
        mixed second derivatives by the most accurate differences, mixed_quick by the quickest ones,
        and psi_closed and mixed_closed in closed form, NaN where there are none.
    """
    stated = Experiment(
        model=str(MODELS / f"{case.model}.xml"),
        rate=100.0,
        horizon=1.0,
        initial={"keyframe": case.keyframe, "control": case.control},
        parameters={
            name: {"target": target, "scale": case.scales.get(name)}
            for name, (target, *_) in case.parameters.items()
        },
        noise={"state": case.sigma},
    )
    task = DesignTask.resolve(stated, threads=1)
    theta, trajectory, nx = task.theta, task.initial, task.space.nx
    derivatives = task.plant.derivatives
    w = np.abs(theta) * np.linspace(1.0, 0.5, len(theta))

    following, psi, AB, mixed = oracle(case, task, w)

    def worst(found: Array) -> float:
        """Difference of the parameter that is known worst, from (N+1, nx, p) sensitivities."""
        return max(_relative(found[..., j], psi[..., j]) for j in range(len(theta)))

    found = derivatives.sensitivity(theta, trajectory)
    assert found is not None, "the trajectory does not diverge"
    careful, quick = (
        derivatives.bilinear(theta, trajectory, found.psi, w[None], accuracy).F_mixed[0]
        for accuracy in (CENTRAL_DIFFERENCES, derivatives.quickest_accuracy)
    )
    first = derivatives.jacobians(theta, trajectory)

    # The closed form is meant for more joints, since these models are stepped as quickly.
    task.plant.closed_form_memory.tree = closed_form_tree(task.plant.source.model, least_joints=1)
    psi_closed = mixed_closed = np.nan
    closed = derivatives.sensitivity(theta, trajectory, closed_form=True)
    along = derivatives.closed_form_mixed(theta, trajectory, found.psi, w[None])
    if closed is not None and along is not None:
        psi_closed = worst(closed.psi)
        mixed_closed = _relative(np.swapaxes(along[1][0], 1, 2), mixed)

    return SimpleNamespace(
        p=len(theta),
        N=len(trajectory.ctrl),
        F=_relative(trajectory.state[1:], following),
        psi=worst(found.psi),
        A=_relative(first[0], AB[..., :nx]),
        B=_relative(first[1], AB[..., nx:]),
        mixed=_relative(np.swapaxes(careful, 1, 2), mixed),
        mixed_quick=_relative(np.swapaxes(quick, 1, 2), mixed),
        psi_closed=psi_closed,
        mixed_closed=mixed_closed,
    )


def oracle(case: Case, task: DesignTask, w: Array) -> tuple[Array, Array, Array, Array]:
    """Differentiate the samples of a trajectory by MJX and JAX, in float64.

    Args:
        case: Where the parameters stand in the model.
        task: The experiment; its joints are hinges and slides, so that states are plain vectors.
        w: (p,) direction of the mixed second derivatives [theta-unit].

    Returns:
        (N, nx) states after each sample, from the states of the trajectory, (N+1, nx, p)
        derivatives of the states by the parameters, (N, nx, nx+nu) derivatives of each sample by
        state and control, and the same derivatives of `DF[psi w, w]`.
    """
    trajectory, nx, nu = task.initial, task.space.nx, task.plant.nu
    N, p = len(trajectory.ctrl), len(task.theta)
    points = np.hstack([trajectory.state[:-1], trajectory.ctrl, np.tile(task.theta, (N, 1))])
    unit = np.eye(nx + nu + p)

    with jax.enable_x64(True):
        function = _sample_map(case, task)

        def derivatives(z: Any, a: Any, b: Any) -> tuple[Any, Any, Any]:
            """f, Df[a] and D²f[a, b] at a point z."""
            along = lambda z: jax.jvp(function, (z,), (a,))  # noqa: E731
            (value, first), (_, second) = jax.jvp(along, (z,), (b,))
            return value, first, second

        # One compiled function for all derivatives: MJX takes long to compile, and no time to run.
        directional = jax.jit(jax.vmap(derivatives))

        # First derivatives, and from them psi by its recursion.
        no_direction = np.zeros_like(points)
        moves = [directional(points, np.tile(e, (N, 1)), no_direction) for e in unit]
        first = np.stack([np.asarray(move[1]) for move in moves], axis=-1)
        A, E = first[..., :nx], first[..., nx + nu :]
        psi = np.zeros((N + 1, nx, p))
        for k in range(N):
            psi[k + 1] = A[k] @ psi[k] + E[k]

        # Second derivatives along (psi w, 0, w) and along every state and control.
        along = np.hstack([psi[:-1] @ w, np.zeros((N, nu)), np.tile(w, (N, 1))])
        second = [directional(points, np.tile(e, (N, 1)), along)[2] for e in unit[: nx + nu]]
    mixed = np.stack([np.asarray(each) for each in second], axis=-1)
    return np.asarray(moves[0][0]), psi, first[..., : nx + nu], mixed


def _sample_map(case: Case, task: DesignTask) -> Any:
    """Return the function F of one sample by z = (x, u, theta), which JAX can differentiate."""
    model = mujoco.MjModel.from_xml_path(str(MODELS / f"{case.model}.xml"))

    # No contact and no limit is reached; without their rows MJX compiles in seconds.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    nominal = mjx.put_model(model)
    empty = mjx.make_data(nominal)

    def sample(z: Any) -> Any:
        x, u, theta = jax.numpy.split(z, [task.space.nx, task.space.nx + model.nu])
        changed: dict[str, Any] = {}
        for name, value in zip(task.parameters.names, theta, strict=True):
            numbers = [(case.parameters[name][1:], value)]
            numbers += [(case.opposite[name], -value)] if name in case.opposite else []
            for (field_name, *index), number in numbers:
                array = changed.get(field_name, getattr(nominal, field_name))
                changed[field_name] = array.at[tuple(index)].set(number)
        at_theta = nominal.replace(**changed)

        def step(data: Any, _: None) -> tuple[Any, None]:
            return mjx.step(at_theta, data), None

        start = empty.replace(qpos=x[: model.nq], qvel=x[model.nq :], ctrl=u)
        end, _ = jax.lax.scan(step, start, None, length=task.system.grid.substeps)
        return jax.numpy.concatenate([end.qpos, end.qvel])

    return sample


def _relative(found: Array, exact: Array) -> float:
    """Return the largest difference, relative to the largest number."""
    return float(np.abs(found - exact).max() / np.abs(exact).max())


def main() -> int:
    """Compare the models that are named, or all."""
    names = [case.model for case in CASES]
    parser = options_of(__doc__)
    parser.add_argument("--models", nargs="+", choices=names, default=names)
    wanted = parser.parse_args().models
    titles = ("p", "N", "F", "psi", "A", "B", "mixed", "mixed, quick")
    table = new_table("Agreement", "model", *titles, "psi, closed", "mixed, closed")
    for case in (case for case in CASES if case.model in wanted):
        p, N, *differences = vars(agreement(case)).values()
        table.add_row(case.model, str(p), str(N), *(f"{each:.1e}" for each in differences))
    Console(width=140).print(table)
    return 0
