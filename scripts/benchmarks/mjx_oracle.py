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

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import mujoco
import numpy as np
from mujoco import mjx

from mjfim.arrays import Array, record
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.plant.closed_form import closed_form_tree
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from scripts.benchmarks.child import ROOT, options_of

MODELS = ROOT / "models"


@record
class Entry:
    """A number of the model that a parameter sets.

    Attributes:
        array: Array of MuJoCo's model.
        index: Its index there.
        factor: Number per parameter.
    """

    array: str
    index: tuple[int, ...]
    factor: float = 1.0


@record
class Case:
    """An experiment, and where its parameters stand in the model.

    Attributes:
        model: Name of the MJCF.
        entries: Numbers of the model that each parameter sets, by its name.
        tables: Tables of the experiment.
    """

    model: str
    entries: Mapping[str, tuple[Entry, ...]]
    tables: Mapping[str, Any]


@record
class Derivatives:
    """Derivatives of a trajectory.

    Attributes:
        following: (N, nx) state after each sample, from the states of the trajectory.
        psi: (N+1, nx, p) derivatives of the states by the parameters.
        AB: (N, nx, nx+nu) derivatives of each sample by state and control.
        mixed: (N, nx, nx+nu) derivatives of `DF[psi w, w]` by state and control.
    """

    following: Array
    psi: Array
    AB: Array
    mixed: Array


@record
class Agreement:
    """Relative differences between mjfim and MJX.

    Attributes:
        model: Name of the model.
        parameters: Number of parameters.
        samples: Number of samples.
        F: Difference of the states after one sample.
        psi: Difference of the sensitivities, of the worst parameter.
        A: Difference of F_x.
        B: Difference of F_u.
        mixed: Difference of the mixed second derivatives, most accurate differences.
        mixed_quick: The same with the quickest differences.
        psi_closed: Difference of the sensitivities in closed form; NaN where there are none.
        mixed_closed: Difference of the mixed second derivatives in closed form; NaN as well.
    """

    model: str
    parameters: int
    samples: int
    F: float
    psi: float
    A: float
    B: float
    mixed: float
    mixed_quick: float
    psi_closed: float
    mixed_closed: float


def _entry(array: str, *index: int, factor: float = 1.0) -> tuple[Entry, ...]:
    """Return one number of the model."""
    return (Entry(array=array, index=index, factor=factor),)


# Bodies are counted from the world, joints and actuators from zero, in the order of the MJCF.
CASES = (
    Case(
        model="cart_pendulum",  # integrator RK4, one step per sample
        entries={
            "m": _entry("body_mass", 3),
            "l": _entry("body_pos", 3, 2),
            "c": _entry("dof_damping", 1),
        },
        tables={
            "initial": {
                "keyframe": "hanging",
                "control": {"kind": "sine", "amplitude": 4.0, "frequency": 0.9},
            },
            "parameters": {
                "m": {"target": "body/bob:mass", "scale": 1.0},
                "l": {"target": "body/bob:pos[2]", "scale": 1.0},
                "c": {"target": "joint/hinge:damping", "scale": 1.0},
            },
            "noise": {"state": 0.05},
        },
    ),
    Case(
        model="two_joint_arm",  # integrator implicitfast, ten steps per sample
        entries={
            "mass": _entry("body_mass", 2),
            "centre": _entry("body_ipos", 2, 2),
            "upper_inertia": _entry("body_inertia", 1, 1),
            "fore_inertia": _entry("body_inertia", 2, 1),
            "armature": _entry("dof_armature", 1),
            "damping": _entry("dof_damping", 0),
        },
        tables={
            "initial": {
                "keyframe": "hanging",
                "control": {"kind": "multisine", "amplitude": 3.0, "harmonics": 3},
            },
            "parameters": {
                "mass": {"target": "body/fore:mass"},
                "centre": {"target": "body/fore:ipos[2]"},
                "upper_inertia": {"target": "body/upper:inertia[1]"},
                "fore_inertia": {"target": "body/fore:inertia[1]"},
                "armature": {"target": "joint/elbow:armature"},
                "damping": {"target": "joint/shoulder:damping"},
            },
            "noise": {"state": 0.01},
        },
    ),
    Case(
        model="servo_arm",  # integrator implicitfast, stiff servos, five steps per sample
        entries={
            "payload": _entry("body_mass", 5),
            "payload_x": _entry("body_ipos", 5, 0),
            "damping": _entry("dof_damping", 2),
            "kp": (
                Entry(array="actuator_gainprm", index=(1, 0)),
                Entry(array="actuator_biasprm", index=(1, 1), factor=-1.0),
            ),
        },
        tables={
            "initial": {
                "keyframe": "settled",
                "control": {"kind": "sine", "amplitude": 0.1, "frequency": 0.9},
            },
            "parameters": {
                "payload": {"target": "body/payload:mass"},
                "payload_x": {"target": "body/payload:ipos[0]", "scale": 0.01},
                "damping": {"target": "joint/elbow:damping"},
                "kp": {"target": "actuator/shoulder:kp"},
            },
            "noise": {"state": 0.01},
        },
    ),
)


def agreement(case: Case) -> Agreement:
    """Differentiate an experiment twice, and compare.

    Args:
        case: The experiment.
    """
    stated = Experiment(
        model=str(MODELS / f"{case.model}.xml"), rate=100.0, horizon=1.0, **case.tables
    )
    task = DesignTask.resolve(stated, threads=1)
    theta, trajectory, nx = task.theta, task.initial, task.space.nx
    w = np.abs(theta) * np.linspace(1.0, 0.5, len(theta))

    exact = oracle(case, task, w)

    found = task.plant.derivatives.sensitivity(theta, trajectory)
    assert found is not None, "the trajectory does not diverge"
    mixed = [
        task.plant.derivatives.bilinear(theta, trajectory, found.psi, w[None], accuracy)
        for accuracy in (CENTRAL_DIFFERENCES, task.plant.derivatives.quickest_accuracy)
    ]
    careful, quick = (np.swapaxes(each.F_mixed[0], 1, 2) for each in mixed)

    first = task.plant.derivatives.jacobians(theta, trajectory)

    # The closed form is meant for more joints, since these models are stepped as quickly.
    task.plant.closed_form_memory.tree = closed_form_tree(task.plant.source.model, least_joints=1)
    psi_closed = mixed_closed = np.nan
    closed = task.plant.derivatives.sensitivity(theta, trajectory, closed_form=True)
    along = task.plant.derivatives.closed_form_mixed(theta, trajectory, found.psi, w[None])
    if closed is not None and along is not None:
        psi_closed = _worst_parameter(closed.psi, exact.psi)
        mixed_closed = _relative(np.swapaxes(along[1][0], 1, 2), exact.mixed)

    return Agreement(
        model=case.model,
        parameters=len(theta),
        samples=len(trajectory.ctrl),
        F=_relative(trajectory.state[1:], exact.following),
        psi=_worst_parameter(found.psi, exact.psi),
        A=_relative(first[0], exact.AB[..., :nx]),
        B=_relative(first[1], exact.AB[..., nx:]),
        mixed=_relative(careful, exact.mixed),
        mixed_quick=_relative(quick, exact.mixed),
        psi_closed=psi_closed,
        mixed_closed=mixed_closed,
    )


def oracle(case: Case, task: DesignTask, w: Array) -> Derivatives:
    """Differentiate the samples of a trajectory by MJX and JAX, in float64.

    Args:
        case: Where the parameters stand in the model.
        task: The experiment; its joints are hinges and slides, so that states are plain vectors.
        w: (p,) direction of the mixed second derivatives [theta-unit].
    """
    trajectory, nx, nu = task.initial, task.space.nx, task.plant.nu
    N, p = len(trajectory.ctrl), len(task.theta)
    points = np.hstack([trajectory.state[:-1], trajectory.ctrl, np.tile(task.theta, (N, 1))])
    unit = np.eye(nx + nu + p)

    with jax.enable_x64(True):
        # One compiled function for all derivatives: MJX takes long to compile, and no time to run.
        directional = jax.jit(_directional(_sample_map(case, task)))

        # First derivatives, and from them psi by its recursion.
        no_direction = np.zeros_like(points)
        moves = [directional(points, np.tile(e, (N, 1)), no_direction) for e in unit]
        following = np.asarray(moves[0][0])
        first = np.stack([np.asarray(move[1]) for move in moves], axis=-1)
        A, E = first[..., :nx], first[..., nx + nu :]
        psi = np.zeros((N + 1, nx, p))
        for k in range(N):
            psi[k + 1] = A[k] @ psi[k] + E[k]

        # Second derivatives along (psi w, 0, w) and along every state and control.
        along = np.hstack([psi[:-1] @ w, np.zeros((N, nu)), np.tile(w, (N, 1))])
        second = [directional(points, np.tile(e, (N, 1)), along)[2] for e in unit[: nx + nu]]
    return Derivatives(
        following=following,
        psi=psi,
        AB=first[..., : nx + nu],
        mixed=np.stack([np.asarray(each) for each in second], axis=-1),
    )


def _directional(function: Any) -> Any:
    """Return the function of (N, n) points and two directions that gives f, Df[a] and D²f[a, b]."""

    def at(z: Any, a: Any, b: Any) -> tuple[Any, Any, Any]:
        def along_a(z: Any) -> Any:
            return jax.jvp(function, (z,), (a,))

        (value, first), (_, second) = jax.jvp(along_a, (z,), (b,))
        return value, first, second

    return jax.vmap(at)


def _sample_map(case: Case, task: DesignTask) -> Any:
    """Return the function F of one sample by z = (x, u, theta), which JAX can differentiate."""
    model = mujoco.MjModel.from_xml_path(str(MODELS / f"{case.model}.xml"))

    # No contact and no limit is reached; without their rows MJX compiles in seconds.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    nominal = mjx.put_model(model)
    empty = mjx.make_data(nominal)
    entries = [case.entries[name] for name in task.parameters.names]

    def sample(z: Any) -> Any:
        x, u, theta = jax.numpy.split(z, [task.space.nx, task.space.nx + model.nu])
        changed: dict[str, Any] = {}
        for value, numbers in zip(theta, entries, strict=True):
            for entry in numbers:
                array = changed.get(entry.array, getattr(nominal, entry.array))
                changed[entry.array] = array.at[entry.index].set(entry.factor * value)
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


def _worst_parameter(found: Array, exact: Array) -> float:
    """Return the difference of the parameter that is known worst, from (N+1, nx, p) arrays."""
    return max(_relative(found[..., j], exact[..., j]) for j in range(exact.shape[2]))


def table(rows: Sequence[Agreement]) -> str:
    """Return the agreements as a table of text.

    Args:
        rows: One agreement per model.
    """
    titles = ("model", "p", "N", "F", "psi", "A", "B", "mixed", "mixed, quick")
    widths = "{:15s} {:>2s} {:>4s} {:>9s} {:>9s} {:>9s} {:>9s} {:>9s} {:>13s} {:>12s} {:>14s}"
    lines = [widths.format(*titles, "psi, closed", "mixed, closed")]
    lines += [
        f"{row.model:15s} {row.parameters:2d} {row.samples:4d} {row.F:9.1e} {row.psi:9.1e} "
        f"{row.A:9.1e} {row.B:9.1e} {row.mixed:9.1e} {row.mixed_quick:13.1e} "
        f"{row.psi_closed:12.1e} {row.mixed_closed:14.1e}"
        for row in rows
    ]
    return "\n".join(lines)


def main() -> int:
    """Compare the models that are named, or all."""
    names = [case.model for case in CASES]
    parser = options_of(__doc__)
    parser.add_argument("--models", nargs="+", choices=names, default=names)
    wanted = parser.parse_args().models
    print(table([agreement(case) for case in CASES if case.model in wanted]))
    return 0
